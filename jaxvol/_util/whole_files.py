"""Writes files that appear whole or not at all: in a temporary folder, then moved in one operation."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


_UNFINISHED: set[Path] = set()
"""Temporary folders."""


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary path of the same name, to write to. At the end the file replaces `path`, or what it links
    to (a pipe or device is written to), and its folder is made; after an error nothing has changed."""
    name, path = path.name, path.resolve()
    special = path.exists() and not (path.is_file() or path.is_dir())
    nearest = next(folder for folder in path.parents if folder.exists())  # on the same disk
    folder = Path(tempfile.mkdtemp(prefix=".jaxvol-", dir=None if special else nearest))
    _UNFINISHED.add(folder)
    try:
        yield folder / name
        if special:
            with (folder / name).open("rb") as content, path.open("wb") as target:
                shutil.copyfileobj(content, target)
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            os.replace(folder / name, path)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        _UNFINISHED.discard(folder)


def remove_unfinished() -> None:
    """Remove all temporary folders, for a process that ends at once, whatever its threads still write."""
    for folder in list(_UNFINISHED):
        shutil.rmtree(folder, ignore_errors=True)
