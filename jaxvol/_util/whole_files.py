"""How does a file appear whole or not at all? It is written beside its place, and moved there in one
operation."""

import itertools
import os
import shutil
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


_UNDERWAY: dict[Path, list[Path]] = {}
"""Files and folders that are not whole, and the folders made for each, the innermost first."""
_MOVING = threading.Lock()
_NUMBERS = itertools.count()


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A path beside `path`, of the same ending, to write a file to; its folder is made. At the end of the
    context the file takes the place of `path`; after an error it is removed, with the folders that were made
    for it, and `path` is as it was. A link stays one: what it points to is replaced. Into what is no regular
    file, such as a pipe or `/dev/null`, the content is written at the end."""
    ending, path = path.suffix, path.resolve()
    with _beside(path, ending) as part:
        yield part
        with _MOVING:
            if _is_special(path):
                with part.open("rb") as content, path.open("wb") as target:
                    shutil.copyfileobj(content, target)
            else:
                os.replace(part, path)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """An empty folder beside `path` to write files to. At the end of the context they take their places in
    `path`, which may hold others; after an error all are removed."""
    path = path.resolve()
    with _beside(path, "") as part:
        part.mkdir()
        yield part
        with _MOVING:
            for file in sorted(part.rglob("*")):
                there = path / file.relative_to(part)
                if file.is_dir():
                    there.mkdir(parents=True, exist_ok=True)
                else:
                    there.parent.mkdir(parents=True, exist_ok=True)  # path itself, at least
                    os.replace(file, there)


@contextmanager
def _beside(path: Path, ending: str) -> Iterator[Path]:
    # not by tempfile, whose files nobody else may read; several processes may write the same file
    folder = Path(tempfile.gettempdir()) if _is_special(path) else path.parent
    part = folder / f".{path.stem}.{os.getpid()}-{next(_NUMBERS)}.part{ending}"
    missing = list(itertools.takewhile(lambda above: not above.exists(), path.parents))
    _UNDERWAY[part] = missing
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield part
    finally:
        _remove(part, missing)
        del _UNDERWAY[part]


def _is_special(path: Path) -> bool:
    return path.exists() and not (path.is_file() or path.is_dir())


def remove_unfinished() -> None:
    """Remove all that is not whole yet. For a process that ends at once: nothing takes its place
    afterwards."""
    _MOVING.acquire()  # and never released
    for part, made in list(_UNDERWAY.items()):
        _remove(part, made)


def _remove(part: Path, made: list[Path]) -> None:
    if part.is_dir():
        shutil.rmtree(part, ignore_errors=True)
    else:
        part.unlink(missing_ok=True)
    for folder in made:
        try:
            folder.rmdir()
        except OSError:  # it holds what was written, or was not made
            break
