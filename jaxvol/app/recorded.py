"""The options that made a picture: written into a PNG, and read again as data that anyone may have made. A
picture names no file but its volume, whose SHA-256 it holds."""

import argparse
import hashlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .._util.checks import shortened
from ..bricks.opening import METADATA
from ..fitting.files import transfer_fields, transfer_of_fields
from ..io.formats import files_of
from ..scene.transfer import Transfer, TransferFunction


KEYWORD = "jaxvol"  # of the text in a PNG
NO_FILE = {"name": "a volume in memory", "bytes": 0, "sha256": 64 * "0"}


def words_of(name: str, value: Any) -> list[str]:
    """An option as words of a command line."""
    flag = name.replace("_", "-")
    if isinstance(value, bool):
        return [f"--{flag}" if value else f"--no-{flag}"]
    if not isinstance(value, list | tuple):
        return [f"--{flag}={value}"]
    rows = value if value and isinstance(value[0], list) else [value]
    return [word for row in rows for word in (f"--{flag}", *map(str, row))]


def text_of(
    settings: Mapping[str, Any], file: Path | None, transfer: Any = None, further: Sequence[str] = ()
) -> dict[str, str]:
    """The text that a PNG carries, by its keyword: options, as words of a command line; the volume's file, if
    it has one; and a transfer function of points, if it holds one."""
    words = [word for name, value in settings.items() for word in words_of(name, value)]
    content: dict[str, Any] = {"options": words, "file": NO_FILE if file is None else fields_of(file)}
    if further:
        content["further"] = list(further)
    if isinstance(transfer, TransferFunction):
        content["transfer"] = transfer_fields(transfer)
    return {KEYWORD: json.dumps(content, sort_keys=True)}


def text_of_options(options: argparse.Namespace, transfer: Transfer) -> dict[str, str]:
    """That of the options that are not at their defaults, with a transfer function that a file or a picture
    held; and which options held other files, which a picture may not name."""
    further = [name for name in ("labels", "others") if getattr(options, name)]
    given = {name: getattr(options, name) for name in options.defaults.keys() - {"quiet"}}
    changed = {name: value for name, value in given.items() if value != options.defaults[name]}
    kept = {name: value for name, value in changed.items() if name not in further}
    settings = {name: value for name, value in kept.items() if not isinstance(value, Path)}
    from_file = options.transfer is not None or options.recorded_transfer is not None
    return text_of(settings, options.file, transfer if from_file else None, further)


def fields_of(file: Path) -> dict[str, Any]:
    """What a picture holds of its volume's file."""
    size = sum(each.stat().st_size for each in _files(file))
    return {"name": str(file), "bytes": size, "sha256": checksum(file)}


def recorded_in(path: Path) -> dict[str, Any]:
    """What `text_of` wrote: `options`, unchecked words, the `file` of the volume, and maybe a `transfer`."""
    from PIL import Image

    if not path.is_file():
        raise ValueError(f"there is no file {path}.")
    try:
        with Image.open(path, formats=["PNG"]) as picture:  # decodes no pixels, and limits texts
            text = picture.info.get(KEYWORD)
    except Exception as fault:  # of Pillow's many kinds
        raise ValueError(f"{path} cannot be read as a PNG: {shortened(str(fault))}") from fault
    if not isinstance(text, str):
        raise ValueError(f"{path} holds no settings of jaxvol: another program saved it.")
    content: Any = None
    try:
        content = json.loads(text)
        known = isinstance(content["options"], list) and isinstance(content["file"]["name"], str)
        known = known and all(isinstance(word, str) for word in content["options"])
        known = known and re.fullmatch("[0-9a-f]{64}", content["file"]["sha256"])
        known = known and isinstance(content["file"]["bytes"], int)
        known = known and all(name in ("labels", "others") for name in content.get("further", ()))
    except (ValueError, RecursionError, KeyError, TypeError):
        known = False
    if not known:
        raise ValueError(f"{path}: the settings in it are damaged.")
    if "transfer" in content:
        content["transfer"] = transfer_of_fields(f"{path}: the transfer function in it", content["transfer"])
    return content


def volume_of_picture(picture: Path, name: str, size: int, sha256: str) -> Path:
    """The volume that a picture shows, unchanged: where it was, or in the picture's folder. Of what the
    picture names, only files of as many `size` bytes in all are read, and it is said which."""
    for path in (Path(name), picture.parent / Path(name).name):
        if Path(str(path).partition("::")[0]).exists():
            found = sum(file.stat().st_size for file in _files(path))
            print(f"{picture} names the volume {shortened(str(path))}, {found} bytes", flush=True)
            if found == size and checksum(path) == sha256:
                return path
            told = "its SHA-256 differs" if found == size else f"that has {size} bytes"
            raise ValueError(f"{path} is not the volume that {picture} shows: {told}. Name one.")
    raise ValueError(f"{picture} shows the volume {shortened(name)}, which is not there. Name one.")


def checksum(path: Path) -> str:
    """SHA-256 of a volume: of the names and contents of its files."""
    found = hashlib.sha256()
    for file in _files(path):
        name = file.relative_to(path).as_posix() if path.is_dir() else file.name
        found.update(name.encode() + b"\0")
        with file.open("rb") as content:
            found.update(hashlib.file_digest(content, "sha256").digest())
    return found.hexdigest()


def _files(path: Path) -> list[Path]:
    """The files of a volume, none of which is a device or one of the kernel's, which may have no end."""
    files = files_of(path) if _is_ordinary(path) else []
    if not files and any((path / name).is_file() for name in METADATA):
        files = sorted(file for file in path.rglob("*") if file.is_file())  # Zarr
    if not files or not all(map(_is_ordinary, files)):
        raise ValueError(f"{path} is no volume: a file, or a folder of DICOM slices, TIFF images or Zarr.")
    return files


def _is_ordinary(path: Path) -> bool:
    """Whether a path is a folder, or a file that holds something, and not of the kernel."""
    real = Path(os.path.realpath(str(path).partition("::")[0]))
    # of /dev only its devices, which are no files: in /dev/shm are ordinary ones
    ours = not any(real.is_relative_to(folder) for folder in ("/proc", "/sys"))
    return ours and (real.is_dir() or (real.is_file() and real.stat().st_size > 0))
