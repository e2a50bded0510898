"""Writes the options of a picture into its PNG, and reads them as untrusted data, which name no files."""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .._util.checks import shortened
from ..fitting.files import transfer_fields, transfer_of_fields
from ..scene.transfer import Transfer, TransferFunction


KEYWORD = "jaxvol"  # of the PNG's text


def words_of(name: str, value: object) -> list[str]:
    """Command-line words of an option."""
    flag = name.replace("_", "-")
    if isinstance(value, bool):
        return [f"--{flag}" if value else f"--no-{flag}"]
    if not isinstance(value, list | tuple):
        return [f"--{flag}={value}"]
    rows = value if value and isinstance(value[0], list) else [value]
    return [word for row in rows for word in (f"--{flag}", *map(str, row))]


def text_of(
    settings: Mapping[str, Any], file: object, transfer: Transfer | None = None, further: Sequence[str] = ()
) -> dict[str, str]:
    """Text of a PNG: options as words, file name, a `TransferFunction`, and options of `further` files."""
    words = [word for name, value in settings.items() for word in words_of(name, value)]
    content: dict[str, Any] = {"options": words, "file": str(file)}
    if further:
        content["further"] = list(further)
    if isinstance(transfer, TransferFunction):
        content["transfer"] = transfer_fields(transfer)
    return {KEYWORD: json.dumps(content, sort_keys=True)}


def text_of_options(options: argparse.Namespace, transfer: Transfer) -> dict[str, str]:
    """Text of changed options, with a transfer function that was read from a file."""
    further = [name for name in ("labels", "others") if getattr(options, name)]
    values = {name: getattr(options, name) for name in options.defaults.keys() - {"quiet", *further}}
    changed = {name: value for name, value in values.items() if value != options.defaults[name]}
    settings = {name: value for name, value in changed.items() if not isinstance(value, Path)}
    from_file = options.transfer is not None or options.recorded_transfer is not None
    return text_of(settings, options.file, transfer if from_file else None, further)


def recorded_in(path: Path) -> dict[str, Any]:
    """Content of a PNG written with `text_of`: `options`, unchecked words, and optionally `transfer`."""
    from PIL import Image

    if not path.is_file():
        raise ValueError(f"there is no file {path}.")
    try:
        with Image.open(path, formats=["PNG"]) as picture:  # decodes no pixels; limits the size of texts
            text = picture.info.get(KEYWORD)
    except Exception as fault:  # Pillow raises many kinds
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
