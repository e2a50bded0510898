"""How does a file appear whole or not at all? It is written beside its place, and moved there in one
operation."""

import itertools
import os
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


_UNDERWAY: set[Path] = set()
_MOVING = threading.Lock()
_NUMBERS = itertools.count()


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A path beside `path`, of the same ending, to write a file to. At the end of the context the file takes
    the place of `path`; after an error it is removed, and `path` is as it was."""
    with _beside(path) as part:
        yield part
        with _MOVING:
            os.replace(part, path)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """An empty folder beside `path` to write files to. At the end of the context they take their places in
    `path`, which may hold others; after an error all are removed."""
    with _beside(path) as part:
        part.mkdir(parents=True)
        yield part
        with _MOVING:
            for file in sorted(part.rglob("*")):
                there = path / file.relative_to(part)
                if file.is_dir():
                    there.mkdir(parents=True, exist_ok=True)
                else:
                    there.parent.mkdir(parents=True, exist_ok=True)
                    os.replace(file, there)


@contextmanager
def _beside(path: Path) -> Iterator[Path]:
    # not by tempfile, whose files nobody else may read; several processes may write the same file
    part = path.with_name(f".{path.stem}.{os.getpid()}-{next(_NUMBERS)}.part{path.suffix}")
    _UNDERWAY.add(part)
    try:
        yield part
    finally:
        _remove(part)
        _UNDERWAY.discard(part)


def remove_unfinished() -> None:
    """Remove all that is not whole yet. For a process that ends at once: nothing takes its place
    afterwards."""
    _MOVING.acquire()  # and never released
    for part in list(_UNDERWAY):
        _remove(part)


def _remove(part: Path) -> None:
    if part.is_dir():
        shutil.rmtree(part, ignore_errors=True)
    else:
        part.unlink(missing_ok=True)
