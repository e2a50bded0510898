"""Checks of files' sizes against their headers, before memory is allocated or while decompressing."""

import importlib
import logging
import re
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BufferedIOBase
from pathlib import Path
from typing import IO, Any, Literal, TypeAlias

import numpy as np

from .checks import printable


CHUNK = 2**20
MOST_VOXELS = 2**31 - 1  # Volume's own limit
MOST_COMPRESSED = 2000  # bytes of pixels per byte of a compressed file; headers that say more are refused
# RuntimeError: by ITK, and by zipfile for encryption and unknown compression; OSError: by gzip
CORRUPT = (EOFError, OSError, RuntimeError, zipfile.BadZipFile, zlib.error)

Stream: TypeAlias = BufferedIOBase | IO[bytes]
"""Stream of bytes: a file, a gzip stream or a member of a zip archive."""


class Refused(ValueError):
    """Fault of a file, without its path, which `refusing` prepends."""


def check(holds: object, fault: str) -> None:
    """Raise `Refused(fault)` unless a condition on a file holds."""
    if not holds:
        raise Refused(fault)


def ensure(holds: object, fault: str) -> None:
    """Raise `ValueError(fault)` unless a condition holds."""
    if not holds:
        raise ValueError(fault)


def file_size(path: Path) -> int:
    """Size in bytes of a regular, non-empty file."""
    if not path.is_file():
        fault = "is a directory" if path.is_dir() else "is not a regular file"
        raise ValueError(f"path: {path} {fault}; give the path of one file.")
    size = path.stat().st_size
    if size == 0:
        raise ValueError(f"path: {path} is empty (0 bytes). Fetch or write it again.")
    return size


def read_all(stream: Stream, expected: int, *, more: bool = False) -> bytearray:
    """Read the `expected` number of bytes, and fail if the stream ends sooner or, unless `more`, later."""
    content = bytearray()  # grows with the data, so a header alone allocates nothing
    while chunk := stream.read(min(expected + 1 - len(content), CHUNK)):
        content += chunk
    check_size(len(content), expected, more=more)
    del content[expected:]
    return content


def check_size(size: int, expected: int, *, more: bool = False) -> None:
    """Check that a file holds as many bytes of voxels as its header says. `more`: other data may follow."""
    fault = f"cut short: it holds {size}" if size < expected else f"oversized: it holds {size} or more"
    check(
        size == expected or (more and size > expected),
        f"is {fault} bytes of voxels where its header (shape and dtype) says {expected}. "
        "Check the header, or fetch the file again.",
    )


@contextmanager
def decoding() -> Iterator[None]:
    """Context that turns errors of a decoder into `Refused`."""
    try:
        yield
    except RuntimeError:  # `refusing` reports its reason, too
        raise
    except CORRUPT as fault:
        raise Refused(f"cannot be read: corrupt, cut short or incomplete ({reason(fault)}).") from fault


ARGUMENTS = ("path:", "shape must", "dtype must", "spacing must", "time must", "time:")
"""Beginnings of messages that name an argument."""


@contextmanager
def refusing(path: Path) -> Iterator[None]:
    """Context that turns exceptions into a `ValueError` about a file, and mutes warnings of libraries."""
    loggers = [logging.getLogger(name) for name in ("tifffile", "nibabel.global", "pydicom")]
    before = [logger.disabled for logger in loggers]
    try:
        for logger in loggers:
            logger.disabled = True
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (MemoryError, ImportError):
        raise
    except Exception as fault:
        if isinstance(fault, ValueError) and str(fault).startswith(ARGUMENTS):
            raise
        if isinstance(fault, Refused):
            raise ValueError(f"path: {path}{'' if str(fault).startswith(':') else ' '}{fault}") from fault
        hint = "Is it cut short, or of a kind that is not supported?"
        raise ValueError(f"path: {path} cannot be read: {reason(fault)}. {hint}") from fault
    finally:
        for logger, disabled in zip(loggers, before, strict=True):
            logger.disabled = disabled


def reason(fault: BaseException) -> str:
    """Last line of an error's message, without the line of ITK's source with which ITK's messages begin."""
    last = str(fault).strip().rpartition("\n")[2]
    text = re.sub(r"^.*ERROR: \w+\s*\(0x[0-9a-f]+\): |^\[\w+\] \w+: ", "", last.strip())[:200]
    return printable(text).rstrip(".") or type(fault).__name__


def library(name: str, path: Path) -> Any:
    """Import a module that reads `path`. Raises an `ImportError` that says what to install."""
    try:
        return importlib.import_module(name)
    except ImportError as fault:
        raise ImportError(f"{path} needs {name}: pip install 'jaxvol[io]' ({fault})") from fault


def as_array(
    content: bytes | bytearray, shape: Sequence[int], dtype: np.dtype, order: Literal["C", "F"]
) -> np.ndarray:
    """Array from bytes, in native byte order, with its last axis fastest in memory."""
    array = np.frombuffer(content, dtype).reshape(shape, order=order)
    return np.ascontiguousarray(array, dtype=dtype.newbyteorder("="))
