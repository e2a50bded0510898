"""Writes files that appear whole or not at all: beside their place, then moved there in one operation."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


_UNFINISHED: dict[Path, list[Path]] = {}
"""Temporary folders, and the folders that were made to hold each, innermost first."""


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A path of the same name, in a temporary folder, to write a file to. When the context ends, the file
    replaces `path`, whose folder is made; after an error nothing has changed. What a link points to is
    replaced; a pipe or a device is written to."""
    name, path = path.name, path.resolve()
    special = path.exists() and not (path.is_file() or path.is_dir())
    with _temporary_folder(Path(tempfile.gettempdir()) if special else path.parent) as folder:
        yield folder / name
        if special:
            with (folder / name).open("rb") as content, path.open("wb") as target:
                shutil.copyfileobj(content, target)
        else:
            os.replace(folder / name, path)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """An empty temporary folder to write files to. When the context ends they are moved into `path`, beside
    the files that are there; after an error nothing has changed."""
    path = path.resolve()
    with _temporary_folder(path.parent) as folder:
        yield folder
        for file in sorted(file for file in folder.rglob("*") if not file.is_dir()):
            target = path / file.relative_to(folder)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, target)


@contextmanager
def _temporary_folder(parent: Path) -> Iterator[Path]:
    made = [folder for folder in (parent, *parent.parents) if not folder.exists()]
    parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix=".jaxvol-", dir=parent))
    _UNFINISHED[folder] = made
    try:
        yield folder
    finally:
        _remove(folder)


def remove_unfinished() -> None:
    """Remove all temporary folders, for a process that ends at once, whatever its threads still write."""
    for folder in list(_UNFINISHED):
        _remove(folder)


def _remove(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    with suppress(OSError):  # it holds what was written
        for made in _UNFINISHED.pop(folder, []):
            made.rmdir()
