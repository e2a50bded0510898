"""Which settings made a picture? They are written into a PNG, and read again as data that anyone may have
made."""

import argparse
import json
import re
import warnings
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

from ..._util.checks import shortened
from ...fitting.files import transfer_fields, transfer_of_fields
from ...scene.transfer import Transfer, TransferFunction
from .checksum import checksum


KEYWORD = "jaxvol"
"""Of the text in a PNG."""

LEFT_OUT = frozenset({"file", "output", "depth", "like", "config", "programs", "kept_transfer", "transfer"})
"""Options that say where things are, and not how the picture looks; a transfer function is written out."""

MOST = 2**20
"""Bytes of settings that are read, at most."""


class Recorded(NamedTuple):
    """What a picture says of how it was made: the command, its options by name, the volume's file as it was
    named, the SHA-256 of that, and the transfer function if a file held it."""

    command: str
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


def text_of(
    command: str,
    settings: dict[str, Any],
    file: Path | None = None,
    sha256: str | None = None,
    transfer: Transfer | None = None,
) -> dict[str, str]:
    """The text that a PNG carries: for `save_image`.

    `file`: of the volume, and `sha256`: its checksum, if it is known. `transfer`: one that a file held.
    """
    content: dict[str, Any] = {"jaxvol": own_version(), "command": command, "settings": settings}
    if file is not None:
        content["file"] = {"name": str(file), "sha256": sha256 or checksum(file)}
    if isinstance(transfer, TransferFunction):
        content["transfer"] = transfer_fields(transfer)
    return {KEYWORD: json.dumps(content, sort_keys=True)}


def settings_of(options: argparse.Namespace, without: frozenset[str] = frozenset()) -> dict[str, Any]:
    """The options that made a picture, by their names on the command line."""
    hidden = LEFT_OUT | without | {"command", "run", "action"}
    return {
        name.replace("_", "-"): value
        for name, value in vars(options).items()
        if name not in hidden and value is not None
    }


def transfer_from_file(options: argparse.Namespace, transfer: Transfer) -> Transfer | None:
    """The transfer function, if a file or a picture held it and the options do not tell it."""
    held = options.transfer is not None or getattr(options, "kept_transfer", None) is not None
    return transfer if held else None


def recorded_in(path: Path) -> Recorded:
    """What a picture says of how it was made.

    **Raises:** `ValueError`, naming the file, if it is no PNG, says nothing, or says what jaxvol does not
    write. Options are checked where they are used.
    """
    text = _text_in(path)
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as fault:
        raise ValueError(f"{path}: the settings in it are damaged: they are not JSON.") from fault
    shapes = {"jaxvol": str, "command": str, "settings": dict}
    if not isinstance(content, dict) or not all(
        isinstance(content.get(n), kind) for n, kind in shapes.items()
    ):
        raise ValueError(f"{path}: the settings in it are damaged: {', '.join(shapes)} are needed.")
    file, digest = None, None
    if "file" in content:
        file, digest = _file(path, content["file"])
    transfer = None
    if "transfer" in content:
        transfer = transfer_of_fields(f"{path}: the transfer function in it", content["transfer"])
    return Recorded(content["command"], content["settings"], file, digest, transfer)


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
            "that the command jaxvol writes as .png hold them, unless another program has saved them anew."
        )
    if len(text) > MOST:
        raise ValueError(f"{path}: the settings in it are damaged: they take {len(text)} letters.")
    return text


def _file(path: Path, content: Any) -> tuple[str, str]:
    if isinstance(content, dict):
        name, digest = content.get("name"), content.get("sha256")
        if isinstance(name, str) and isinstance(digest, str) and re.fullmatch("[0-9a-f]{64}", digest):
            return name, digest
    raise ValueError(
        f"{path}: the settings in it are damaged: file must have a name and a SHA-256; got "
        f"{shortened(content)}."
    )
