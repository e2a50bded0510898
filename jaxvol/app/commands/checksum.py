"""Is a volume the one that was rendered? By the SHA-256 of the files that hold it."""

import hashlib
from pathlib import Path

from ...bricks.opening import METADATA
from ...io.formats import files_of
from .progress import working


def checksum(path: Path) -> str:
    """SHA-256 of a volume: of one file, its content; of several, their names and contents.

    **Raises:** `ValueError` if there is no volume, as `load` and `render_bricks` read it."""
    files = files_of(path)
    if not files and any((path / name).is_file() for name in METADATA):
        files = sorted(file for file in path.rglob("*") if file.is_file())  # Zarr
    if not files:
        raise ValueError(f"{path} is no volume: a file, or a folder of DICOM slices, TIFF images or Zarr.")
    found = hashlib.sha256()
    with working(f"SHA-256 of {path}"):
        for file in files:
            if len(files) > 1:
                name = file.relative_to(path).as_posix() if path.is_dir() else file.name
                found.update(name.encode() + b"\0")
            with file.open("rb") as stream:
                while chunk := stream.read(2**20):
                    found.update(chunk)
    return found.hexdigest()
