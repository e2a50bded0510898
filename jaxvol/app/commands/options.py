"""The options of the command `jaxvol`: rows of a table, from which flags, `--help`, the keys of TOML files
and the settings in pictures derive (`parsing.py`). Here are those that several subcommands share."""

import argparse
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from ...compositing.modes import MODES
from ...scene.presets import PRESETS, SHADED
from ...xla.persistent_cache import default_programs


class Option(NamedTuple):
    """An option of a command.

    - `name`: without dashes. An argument without a flag is in the group `ARGUMENT`.
    - `values`: what follows the flag, as `--help` shows it. Several words stand for as many values, and dots
      for one or more.
    - `type`: of each value, made from its text; `bool` for a switch, which `--no-NAME` turns off.
    """

    name: str
    help: str
    type: Callable[..., Any] = str
    values: str = ""
    default: Any = None
    choices: tuple[str, ...] = ()
    repeated: bool = False
    required: bool = False
    group: str = ""

    @property
    def key(self) -> str:
        """The name in Python."""
        return self.name.replace("-", "_")

    @property
    def nargs(self) -> int | str | None:
        """How many values follow the flag, as argparse takes it."""
        if self.values.endswith("..."):
            return "+"
        words = self.values.split()
        return len(words) if len(words) > 1 else None


class Command(NamedTuple):
    """A subcommand."""

    name: str
    help: str
    options: tuple[Option, ...]
    run: Callable[[argparse.Namespace], None]


def memory_size(text: str | int) -> int:
    """A number of bytes, such as 1000000, 256M or 2G (powers of 1024)."""
    found = re.fullmatch(r"(\d{1,15}(?:\.\d*)?|\.\d+)([KMG]?)", str(text).strip().upper())
    count = int(float(found[1]) * 1024 ** " KMG".index(found[2] or " ")) if found else 0
    if count < 1:
        raise argparse.ArgumentTypeError(f"must be a number of bytes, such as 256M or 2G; got {text!r}")
    return count


def output(default: str, help: str, values: str = "FILE") -> Option:
    """Where a command writes."""
    return Option("output", help, Path, values, Path(default))


def grouped(title: str, *options: Option) -> tuple[Option, ...]:
    """Options under a title in `--help`."""
    return tuple(option._replace(group=title) for option in options)


ARGUMENT = "arguments"
"""The group of options without a flag."""

SHARED = (
    Option("config", "a file of options, by their names without dashes; those given here win", Path, "TOML"),
    Option("programs", "cache of compiled programs", Path, "FOLDER", default_programs()),
)
"""Options of every command."""

_FILE = "volume: NAME_XxYxZ_TYPE.raw[.gz], .npy, .npz, and more with jaxvol[io]"

DATA = (
    *SHARED,
    Option("file", _FILE, Path, "FILE", required=True, group=ARGUMENT),
    *grouped(
        "data: needed if the file and its name do not specify it",
        Option("shape", "voxels, x fastest in the file", int, "X Y Z"),
        Option("dtype", "such as uint8 or uint16le"),
        Option("spacing", "world length between voxels", float, "X Y Z"),
    ),
)
"""Options of commands that read a volume."""

SIZE = Option("size", "pixels", int, "W H", (512, 512))

_STEP = "distance between samples, world length (default: half a voxel for fit; as planned for render)"

_BACKGROUND = "linear RGB (default: white; black behind maximum, minimum and average)"

SAMPLING = Option("step", _STEP, float), Option("background", _BACKGROUND, float, "R G B")
"""Options of commands that render images."""

CLIM = Option("clim", "range of values that it covers (default: all)", float, "LOW HIGH")

_PRESETS = "; ".join(f"{name}: {text}" for name, (text, _, _) in PRESETS.items())

TRANSFER = grouped(
    "transfer function",
    Option("preset", f"{_PRESETS} (default: what the histogram suggests)", values="NAME"),
    Option(
        "cmap",
        "a matplotlib colormap, or a colour, over --clim (default with --clim, --opacity, and modes other "
        "than over: gray; isosurfaces: white)",
        values="NAME",
    ),
    Option("transfer", "a transfer function written by jaxvol fit", Path, "JSON"),
    Option("opacity", "with --cmap: linear (default) or sigmoid", values="RAMP"),
    CLIM,
    Option("unit-distance", "length to which opacities refer (default: 1)", float),
)

APPEARANCE = grouped(
    "appearance",
    Option(
        "compositing",
        "how samples become a pixel: over, by emission and absorption; maximum, minimum, average: that value "
        "of the ray, as classified; isosurface: where --isovalue is first crossed",
        default="over",
        choices=(*MODES, "isosurface"),
    ),
    Option("isovalue", "with --compositing isosurface: the value on it", float, "VALUE"),
    Option(
        "shade",
        "shade by the gradient of the values, under a light at the camera; by default isosurfaces, and what "
        f"is composited with the automatic transfer function or the presets {', '.join(sorted(SHADED))}",
        bool,
    ),
)

_CAMERA = "position and focal point in the world; the camera may be inside the volume"

_AXIS = "what the camera turns about, through its focal point (default: --view-up)"

CAMERA = grouped(
    "camera",
    Option("camera", _CAMERA, float, "X Y Z FX FY FZ"),
    Option(
        "direction",
        "without --camera: the side from which to view the whole volume (default: 0.5 -1 0.4, or as "
        "--view-up has it)",
        float,
        "X Y Z",
    ),
    Option(
        "view-up",
        "what is up in the image (default: 0 0 1; or, for files that do not say how they lie, shown as the "
        "histogram suggests: away from the one face that cuts the object, if there is such a face)",
        float,
        "X Y Z",
    ),
    Option("view-angle", "degrees from the lower to the upper edge of the image", float, default=30.0),
    Option("parallel", "orthographic camera; use with --direction", bool, default=False),
    Option("zoom", "magnification of the image", float, default=1.0),
    Option("axis", _AXIS, float, "X Y Z"),
)

_PLANE = (
    "show what lies on the side of the plane through (X, Y, Z) to which the normal (NX, NY, NZ) points; may "
    "be given several times"
)

_OUTSIDE = "cut away what is inside the box and on that side of all planes, and show the rest"

CLIP = grouped(
    "clip: show a part of the volume; box and planes in world coordinates",
    Option("clip-box", "show what is inside this box", float, "X_MIN X_MAX Y_MIN Y_MAX Z_MIN Z_MAX"),
    Option("clip-plane", _PLANE, float, "X Y Z NX NY NZ", (), repeated=True),
    Option("clip-inside-out", _OUTSIDE, bool, default=False),
)

_LIKE = "a picture that jaxvol wrote: take its options, and its volume unless another is named"

SCENE = (
    *DATA,
    *SAMPLING,
    SIZE,
    Option("like", _LIKE, Path, "PNG"),
    Option(
        "memory",
        "read the volume in bricks, with so much memory for them, such as 256M or 2G: .raw, .npy and Zarr",
        memory_size,
        "BYTES",
    ),
    Option(
        "tolerance",
        "RMSE of the image's linear colours, by which step and transforms are chosen (default: 1/255; not "
        "with --step)",
        float,
    ),
    *TRANSFER,
    *APPEARANCE,
    *CAMERA,
    *CLIP,
)
"""Options of commands that look at a volume through a camera."""


def defaults_of(options: Iterable[Option]) -> dict[str, Any]:
    """What options are where nothing is given."""
    return {option.key: option.default for option in options}
