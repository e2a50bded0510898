"""Checks the sizes of files against their headers: before memory is allocated or, if only decompressing
tells, while a file is read, never further than one byte past the expected size."""

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
MOST_COMPRESSED = 2000  # bytes of pixels for each of a compressed file; a header that says more is refused
# RuntimeError: of ITK, and of zipfile for encryption and unknown compression; OSError: of gzip
CORRUPT = (EOFError, OSError, RuntimeError, zipfile.BadZipFile, zlib.error)

Stream: TypeAlias = BufferedIOBase | IO[bytes]
"""Of a file, of gzip, of a member of a zip archive."""


class Refused(ValueError):
    """What is wrong with a file, without its path, which `refusing` puts in front."""


def check(holds: object, fault: str) -> None:
    """Raise `Refused` with this text unless what a file must be is so, which it never is of NaN."""
    if not holds:
        raise Refused(fault)


def ensure(holds: object, fault: str) -> None:
    """Raise `ValueError` with this text unless something holds."""
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
    """All bytes of a stream, which must be `expected`; at most one further is read. `more`: others follow."""
    content = bytearray()  # grows with the data, so a header alone allocates nothing
    while chunk := stream.read(min(expected + 1 - len(content), CHUNK)):
        content += chunk
    check_size(len(content), expected, more=more)
    del content[expected:]
    return content


def check_size(size: int, expected: int, *, more: bool = False) -> None:
    """Check that a file holds as many bytes of voxels as its header says; or `more`, where others follow."""
    fault = f"cut short: it holds {size}" if size < expected else f"oversized: it holds {size} or more"
    check(
        size == expected or (more and size > expected),
        f"is {fault} bytes of voxels where its header (shape and dtype) says {expected}. "
        "Check the header, or fetch the file again.",
    )


@contextmanager
def decoding() -> Iterator[None]:
    """Turn any error of a decoder within the context into one that says what is wrong."""
    try:
        yield
    except RuntimeError:  # also of whole files
        raise
    except CORRUPT as fault:
        raise Refused(f"cannot be read: corrupt, cut short or incomplete ({reason(fault)}).") from fault


ARGUMENTS = ("path:", "shape must", "dtype must", "spacing must", "time must", "time:")
"""Beginnings of errors that name an argument."""


@contextmanager
def refusing(path: Path) -> Iterator[None]:
    """Turn whatever is raised within the context into a `ValueError` that says what is wrong with a file.
    What libraries warn of and log, which may be a line for each of a file's faults, is left out."""
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
        told = f"{reason(fault)}. Is it cut short, or of a kind that is not supported?"
        raise ValueError(f"path: {path} cannot be read: {told}") from fault
    finally:
        for logger, disabled in zip(loggers, before, strict=True):
            logger.disabled = disabled


def reason(fault: BaseException) -> str:
    """The last line of an error, without the place in ITK's source with which its errors begin."""
    last = str(fault).strip().rpartition("\n")[2]
    told = re.sub(r"^.*ERROR: \w+\s*\(0x[0-9a-f]+\): |^\[\w+\] \w+: ", "", last.strip())[:200]
    return printable(told).rstrip(".") or type(fault).__name__


def library(name: str, path: Path) -> Any:
    """A module that reads files. Raises `ImportError` that says what to install for `path`."""
    try:
        return importlib.import_module(name)
    except ImportError as fault:
        raise ImportError(f"{path} needs {name}: pip install 'jaxvol[io]' ({fault})") from fault


def as_array(
    content: bytes | bytearray, shape: Sequence[int], dtype: np.dtype, order: Literal["C", "F"]
) -> np.ndarray:
    """Bytes as an array in native byte order, with its last axis fastest in memory."""
    array = np.frombuffer(content, dtype).reshape(shape, order=order)
    return np.ascontiguousarray(array, dtype=dtype.newbyteorder("="))
