"""Names of length units and of axes, as files and libraries spell them."""

import re
import unicodedata
from collections.abc import Callable, Sequence

from .checks import shortened


PREFIXES = {"kilo": 1e6, "": 1e3, "deci": 100.0, "centi": 10.0, "milli": 1.0, "micro": 1e-3, "nano": 1e-6}
PREFIXES |= {"pico": 1e-9, "femto": 1e-12}
LENGTHS = {f"{prefix}meter": length for prefix, length in PREFIXES.items()}
LENGTHS |= dict(zip(("km", "m", "dm", "cm", "mm", "μm", "nm", "pm", "fm"), PREFIXES.values(), strict=True))
LENGTHS |= dict.fromkeys(("um", "mum", "mcm", "mc", "micron", "μ", "μ meter"), 1e-3)
LENGTHS |= dict.fromkeys(("å", "a", "ang", "angstrom", "ångström", "ångstrom"), 1e-7)
LENGTHS |= {"in": 25.4, "inch": 25.4, "inche": 25.4, '"': 25.4, "ft": 304.8, "foot": 304.8, "feet": 304.8}
LENGTHS |= {"yd": 914.4, "yard": 914.4, "mi": 1609344.0, "mile": 1609344.0, "thou": 0.0254, "mil": 0.0254}
LENGTHS |= {"li": 25.4 / 12, "pt": 25.4 / 72}
"""Lengths of units in mm, by name in lower case, without a plural's s."""

NAMES = {
    "x": "x lon longitude i col column width w easting rlon right-left left-right",
    "y": "y lat latitude j row length northing rlat anterior-posterior posterior-anterior",
    "z": "z lev level k depth alt altitude slice plane page elevation plev layer inferior-superior",
    "t": "t time frame timepoint date acquisition repetition",
    "c": "c channel ch band component wavelength color colour e lambda",
    "s": "s sample rgb rgba",
}
AXES = {name: letter for letter, names in NAMES.items() for name in names.split()}
"""Letters of axes, by name in lower case, without a plural's s."""


def length_of(unit: str | None) -> float | None:
    """Length of a unit in mm; None for no unit or an unknown one, such as "pixel"."""
    name = str(unit or "").replace("\\u00b5", "μ").replace("\\u00B5", "μ")
    name = unicodedata.normalize("NFKC", name).strip().strip(".'").lower().replace("metre", "meter")
    return next((LENGTHS[word] for word in (name, name.removesuffix("s")) if word in LENGTHS), None)


def axis_letters(subject: str, names: Sequence[str], note: Callable[[str], None]) -> str:
    """Letters of axes: x, y and z of space, t of time, c of channels, s of values in a voxel.

    If as many names are unknown as axes of space are missing, they are taken as the missing ones in order,
    and so are three unknown names; `note` is called with a remark, unless names are only numbered. Raises
    `ValueError`, beginning with `subject`, for other unknown names and for two axes of one kind."""
    words = [str(name).strip().lower() for name in names]
    letters = [AXES.get(word) or AXES.get(word.removesuffix("s")) or "?" for word in words]
    if "height" in words:  # the rows of an image, or altitude
        letters[words.index("height")] = "y" if "y" not in letters else "z"
    missing = [letter for letter in "xyz" if letter not in letters]
    letters = ["?"] * 3 if len(words) == len(missing) == 3 else letters
    unknown = [str(name) for name, letter in zip(names, letters, strict=True) if letter == "?"]
    if unknown and len(unknown) == len(missing):
        free = iter(missing)
        letters = [next(free) if letter == "?" else letter for letter in letters]
        if not all(re.fullmatch(r"(dim|axis|phony_dim)_?\d+", name.strip().lower()) for name in unknown):
            note(f"axes {', '.join(map(repr, unknown))}: taken as {', '.join(missing)}")
    if "?" in letters or len({*letters}) < len(letters):
        raise ValueError(
            f"{subject} must have axes named such as x, y, z, time and channel, each once; got "
            f"{shortened(', '.join(map(str, names)))}. Rename the axes, or select some of them, first."
        )
    return "".join(letters)
