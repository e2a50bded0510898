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
    """A path of the same name, in a temporary folder, to write a file to. When the context ends, the file
    replaces `path`, whose folder is made; after an error nothing has changed. What a link points to is
    replaced; a pipe or a device is written to."""
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
