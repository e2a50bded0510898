"""Which settings made a picture? They are written into a PNG, and read again as data that anyone may have
made. A picture names no file but its volume, whose SHA-256 it holds."""

import argparse
import hashlib
import json
import re
from pathlib import Path
from typing import Any

from ..._util.checks import shortened
from ...bricks.opening import METADATA
from ...fitting.files import transfer_fields, transfer_of_fields
from ...io.formats import files_of
from ...scene.transfer import Transfer, TransferFunction


KEYWORD = "jaxvol"
"""Of the text in a PNG."""


def text_of(options: argparse.Namespace, transfer: Transfer) -> dict[str, str]:
    """The text that a PNG carries, for `save_image`: the options that are not at their defaults. The transfer
    function is written out if a file or a picture held it."""
    settings = {
        name.replace("_", "-"): value
        for name, default in options.defaults.items()
        if (value := getattr(options, name)) != default and not isinstance(value, Path)
    }
    file = {"name": str(options.file), "sha256": checksum(options.file)}
    content: dict[str, Any] = {"settings": settings, "file": file}
    from_file = options.transfer is not None or options.recorded_transfer is not None
    if from_file and isinstance(transfer, TransferFunction):
        content["transfer"] = transfer_fields(transfer)
    return {KEYWORD: json.dumps(content, sort_keys=True)}


def recorded_in(path: Path) -> dict[str, Any]:
    """What `text_of` wrote: `settings` by name, unchecked, the `file` of the volume, and maybe a `transfer`.

    **Raises:** `ValueError`, naming the picture, if it is no PNG, or says nothing, or something else."""
    from PIL import Image

    if not path.is_file():
        raise ValueError(f"there is no file {path}.")
    try:
        with Image.open(path, formats=["PNG"]) as picture:  # decodes no pixels, and limits texts
            text = picture.info.get(KEYWORD)
    except Exception as fault:  # of Pillow's many kinds
        raise ValueError(f"{path} cannot be read as a PNG: {shortened(str(fault))}") from fault
    if not isinstance(text, str):
        raise ValueError(f"{path} holds no settings of jaxvol; another program may have saved it again.")
    content: Any = None
    try:
        content = json.loads(text)
        known = isinstance(content["settings"], dict) and isinstance(content["file"]["name"], str)
        known = known and re.fullmatch("[0-9a-f]{64}", content["file"]["sha256"])
    except (ValueError, RecursionError, KeyError, TypeError):
        known = False
    if not known:
        raise ValueError(f"{path}: the settings in it are damaged.")
    if "transfer" in content:
        content["transfer"] = transfer_of_fields(f"{path}: the transfer function in it", content["transfer"])
    return content


def volume_of_picture(picture: Path, name: str, sha256: str) -> Path:
    """The volume that a picture shows, unchanged: where it was, or beside the picture."""
    for path in (Path(name), picture.parent / Path(name).name):
        if path.exists():
            if checksum(path) == sha256:
                return path
            raise ValueError(f"{path} is not the volume that {picture} shows: its SHA-256 differs. Name one.")
    raise ValueError(f"{picture} shows the volume {shortened(name)}, which is not there. Name one.")


def checksum(path: Path) -> str:
    """SHA-256 of a volume: of the names and contents of its files. **Raises** `ValueError` without them."""
    files = files_of(path)
    if not files and any((path / name).is_file() for name in METADATA):
        files = sorted(file for file in path.rglob("*") if file.is_file())  # Zarr
    if not files:
        raise ValueError(f"{path} is no volume: a file, or a folder of DICOM slices, TIFF images or Zarr.")
    found = hashlib.sha256()
    for file in files:
        name = file.relative_to(path).as_posix() if path.is_dir() else file.name
        found.update(name.encode() + b"\0")
        with file.open("rb") as content:
            found.update(hashlib.file_digest(content, "sha256").digest())
    return found.hexdigest()
