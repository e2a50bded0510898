"""The options that made a picture, written into a PNG, and read as data that anyone may have made. No file is
read because a picture names it."""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .._util.checks import shortened
from ..fitting.files import transfer_fields, transfer_of_fields
from ..scene.transfer import Transfer, TransferFunction


KEYWORD = "jaxvol"  # of the text in a PNG


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
    settings: Mapping[str, Any], file: Any, transfer: Any = None, further: Sequence[str] = ()
) -> dict[str, str]:
    """Text of a PNG: options as command-line words, the volume's file, a `TransferFunction`."""
    words = [word for name, value in settings.items() for word in words_of(name, value)]
    content: dict[str, Any] = {"options": words, "file": str(file)}
    if further:
        content["further"] = list(further)
    if isinstance(transfer, TransferFunction):
        content["transfer"] = transfer_fields(transfer)
    return {KEYWORD: json.dumps(content, sort_keys=True)}


def text_of_options(options: argparse.Namespace, transfer: Transfer) -> dict[str, str]:
    """Text of changed options, with a transfer function that was read; other files are only named."""
    further = [name for name in ("labels", "others") if getattr(options, name)]
    given = {name: getattr(options, name) for name in options.defaults.keys() - {"quiet"}}
    changed = {name: value for name, value in given.items() if value != options.defaults[name]}
    kept = {name: value for name, value in changed.items() if name not in further}
    settings = {name: value for name, value in kept.items() if not isinstance(value, Path)}
    from_file = options.transfer is not None or options.recorded_transfer is not None
    return text_of(settings, options.file, transfer if from_file else None, further)


def recorded_in(path: Path) -> dict[str, Any]:
    """What `text_of` wrote: `options`, unchecked words, and maybe a `transfer`."""
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
        known = isinstance(content["options"], list)
        known = known and all(isinstance(word, str) for word in content["options"])
        known = known and all(name in ("labels", "others") for name in content.get("further", ()))
    except (ValueError, RecursionError, KeyError, TypeError):
        known = False
    if not known:
        raise ValueError(f"{path}: the settings in it are damaged.")
    if "transfer" in content:
        content["transfer"] = transfer_of_fields(f"{path}: the transfer function in it", content["transfer"])
    return content
