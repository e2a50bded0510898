"""Atomic writes of files: to a temporary folder, then moved in one operation."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


_UNFINISHED: set[Path] = set()
"""Temporary folders in use."""


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Context with a temporary path, whose file replaces `path` or its link's target if no error is raised; a
    pipe or device is written to. Missing folders are made."""
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
    """Remove all temporary folders, for a process that exits while its threads may still write."""
    for folder in list(_UNFINISHED):
        shutil.rmtree(folder, ignore_errors=True)
