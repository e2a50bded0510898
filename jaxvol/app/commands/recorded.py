"""Which settings made a picture? They are written into a PNG, and read again as data that anyone may have
made. A picture names no file but its volume, whose SHA-256 it holds."""

import hashlib
import json
import re
import warnings
from collections.abc import Iterable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

from ..._util.checks import shortened
from ...bricks.opening import METADATA
from ...fitting.files import transfer_fields, transfer_of_fields
from ...io.formats import files_of
from ...scene.transfer import Transfer, TransferFunction
from .options import Option
from .progress import show_progress


KEYWORD = "jaxvol"
"""Of the text in a PNG."""


class Recorded(NamedTuple):
    """What a picture says of how it was made by `jaxvol render`: options by name, the volume's file as it was
    named and its SHA-256, and the transfer function if a file held it."""

    settings: dict[str, Any]
    file: str | None
    sha256: str | None
    transfer: TransferFunction | None


def own_version() -> str:
    """The version of jaxvol that is installed."""
    try:
        return metadata.version("jaxvol")
    except metadata.PackageNotFoundError:  # run from a checkout
        return "(not installed)"


def in_pictures(options: Iterable[Option]) -> list[Option]:
    """Those that a picture records: all but files and folders."""
    return [option for option in options if option.type is not Path]


def text_of(
    table: Iterable[Option], options: Mapping[str, Any], transfer: Transfer, sha256: str | None = None
) -> dict[str, str]:
    """The text that a PNG carries, for `save_image`: the options of `jaxvol render` (`table`) that make it.
    The transfer function is written out if a file or a picture held it. `sha256`: of the volume, if it is
    known."""
    settings = {option.name: options.get(option.key) for option in in_pictures(table)}
    content: dict[str, Any] = {
        "jaxvol": own_version(),
        "command": "render",
        "settings": {name: value for name, value in settings.items() if value is not None},
        "file": {"name": str(options["file"]), "sha256": sha256 or checksum(options["file"])},
    }
    from_file = options["transfer"] is not None or options["recorded_transfer"] is not None
    if from_file and isinstance(transfer, TransferFunction):
        content["transfer"] = transfer_fields(transfer)
    return {KEYWORD: json.dumps(content, sort_keys=True)}


def recorded_in(path: Path) -> Recorded:
    """What a picture says of how it was made.

    **Raises:** `ValueError`, naming the file, if it is no PNG, says nothing, or says what jaxvol does not
    write. Options are checked where they are used.
    """
    damaged = f"{path}: the settings in it are damaged"
    text = _text_in(path)
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as fault:
        raise ValueError(f"{damaged}: they are not JSON.") from fault
    shapes = {"jaxvol": str, "command": str, "settings": dict}
    if not isinstance(content, dict) or not all(isinstance(content.get(n), k) for n, k in shapes.items()):
        raise ValueError(f"{damaged}: {', '.join(shapes)} are needed.")
    if content["command"] != "render":
        made_by = shortened(content["command"])
        raise ValueError(f"{path} was not made by jaxvol render, but, as it says, by jaxvol {made_by}.")
    file, sha256 = None, None
    if (named := content.get("file")) is not None:
        file, sha256 = (named.get("name"), named.get("sha256")) if isinstance(named, dict) else (None, None)
        if not (isinstance(file, str) and isinstance(sha256, str) and re.fullmatch("[0-9a-f]{64}", sha256)):
            raise ValueError(f"{damaged}: file must have a name and a SHA-256; got {shortened(named)}.")
    transfer = None
    if "transfer" in content:
        transfer = transfer_of_fields(f"{path}: the transfer function in it", content["transfer"])
    return Recorded(content["settings"], file, sha256, transfer)


def _text_in(path: Path) -> str:
    from PIL import Image

    if not path.is_file():
        raise ValueError(f"there is no file {path}.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            # pixels are not decoded, and texts have a limit in Pillow
            with Image.open(path, formats=["PNG"]) as picture:
                size, text = picture.size, picture.info.get(KEYWORD)
    except Exception as fault:  # of Pillow's many kinds
        raise ValueError(f"{path} cannot be read as a PNG: {shortened(str(fault))}") from fault
    if not isinstance(text, str):
        raise ValueError(
            f"{path} holds no settings of jaxvol, only a picture of {size[0]} x {size[1]} pixels. Pictures "
            "that the command jaxvol writes as .png hold them, unless another program has saved them again."
        )
    return text


def volume_of_picture(path: Path, found: Recorded) -> Path:
    """The volume that a picture shows, unchanged: where it was, or beside the picture."""
    if found.file is None:
        raise ValueError(f"{path} does not say which volume it shows: name one.")
    for candidate in (Path(found.file), path.parent / Path(found.file).name):
        if candidate.exists():
            if checksum(candidate) == found.sha256:
                return candidate
            raise ValueError(
                f"{candidate} is not the volume that {path} shows: its SHA-256 differs. To render it all the "
                f"same, name it: jaxvol render {candidate} --like {path}"
            )
    raise ValueError(
        f"{path} shows the volume {shortened(found.file)}, which is not there. Name it, or another: "
        f"jaxvol render FILE --like {path}"
    )


def checksum(path: Path) -> str:
    """SHA-256 of a volume: of one file, its content; of several, their names and contents.

    **Raises:** `ValueError` if there is no volume, as `load` and `render_bricks` read it."""
    files = files_of(path)
    if not files and any((path / name).is_file() for name in METADATA):
        files = sorted(file for file in path.rglob("*") if file.is_file())  # Zarr
    if not files:
        raise ValueError(f"{path} is no volume: a file, or a folder of DICOM slices, TIFF images or Zarr.")
    found = hashlib.sha256()
    with show_progress(f"SHA-256 of {path}"):
        for file in files:
            if len(files) > 1:
                name = file.relative_to(path).as_posix() if path.is_dir() else file.name
                found.update(name.encode() + b"\0")
            with file.open("rb") as content:
                while chunk := content.read(2**20):
                    found.update(chunk)
    return found.hexdigest()
