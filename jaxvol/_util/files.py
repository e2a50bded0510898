"""Does a file hold what is said of it?

Sizes are checked against headers before memory is taken, or, where only decompressing tells, while
the file is read, never a byte further.
"""

import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np


CHUNK = 2**20
MOST_VOXELS = 2**31 - 1  # Volume's own limit
# RuntimeError: ITK's own, and zipfile's for encryption and unknown compression; OSError: gzip's own
CORRUPT = (EOFError, OSError, RuntimeError, zipfile.BadZipFile, zlib.error)


@runtime_checkable
class Stream(Protocol):
    """Bytes that are read one piece after the other: of a file, of gzip, of a member of a zip archive."""

    def read(self, size: int = -1, /) -> bytes: ...

    def tell(self) -> int: ...


class Header(NamedTuple):
    """What the caller of `load` said of a file's voxels, as it came; None where nothing was said."""

    shape: Sequence[int] | Any | None
    dtype: str | Any | None

    def refuse(self, path: Path) -> None:
        """For readers of files that carry their own header: a second one is an error."""
        if any(said is not None for said in self):
            raise ValueError(
                f"shape and dtype are for raw files; {path} carries its own, and got shape={self.shape} "
                f"and dtype={self.dtype} besides. Leave them out."
            )


def file_size(path: Path) -> int:
    """Bytes of a regular file that is not empty."""
    if not path.is_file():
        fault = "is a directory" if path.is_dir() else "is not a regular file"
        raise ValueError(f"path: {path} {fault}; give the path of one file.")
    held = path.stat().st_size
    if held == 0:
        raise ValueError(f"path: {path} is empty (0 bytes). Fetch or write it again.")
    return held


def read_all(path: Path, stream: Stream, expected: int) -> bytearray:
    """All bytes of a stream, which are as many as expected; of more than that, one is read."""
    content = bytearray()  # grows with what is there: a header alone takes no memory
    for chunk in chunks(stream, expected + 1):
        content += chunk
    check_size(path, len(content), expected)
    return content


def chunks(stream: Stream, limit: int) -> Iterator[bytes]:
    """A stream piece by piece, at most `limit` bytes of it."""
    while limit > 0 and (chunk := stream.read(min(limit, CHUNK))):
        limit -= len(chunk)
        yield chunk


def check_size(path: Path, held: int, expected: int) -> None:
    """Bytes of voxels that are there must be as many as the header says."""
    if held != expected:
        fault = f"cut short: it holds {held}" if held < expected else f"oversized: it holds {held} or more"
        raise ValueError(
            f"path: {path} is {fault} bytes of voxels where its header (shape and dtype) says {expected}. "
            "Check the header, or fetch the file again."
        )


@contextmanager
def decoding(path: Path) -> Iterator[None]:
    """What a decoder raises within, of whatever kind, becomes the `ValueError` of a corrupt file."""
    try:
        yield
    except CORRUPT as fault:
        raise ValueError(
            f"path: {path} cannot be read: corrupt, cut short or incomplete ({fault})."
        ) from fault


def as_array(
    content: bytes | bytearray, shape: Sequence[int], dtype: np.dtype, order: Literal["C", "F"]
) -> np.ndarray:
    """Bytes as an array in native byte order, its last axis fastest in memory."""
    array = np.frombuffer(content, dtype).reshape(shape, order=order)
    return np.ascontiguousarray(array, dtype=dtype.newbyteorder("="))
