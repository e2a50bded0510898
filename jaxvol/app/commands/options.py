"""Options that several subcommands of `jaxvol` share."""

import argparse
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ...compositing.modes import MODES
from ...scene.presets import PRESETS, SHADED
from .parsing import Parser


SWITCH = argparse.BooleanOptionalAction


def memory_size(text: str) -> int:
    """A number of bytes, such as 1000000, 256M or 2G (powers of 1024)."""
    found = re.fullmatch(r"(\d{1,15}(?:\.\d*)?|\.\d+)([KMG]?)", text.strip().upper())
    count = int(float(found[1]) * 1024 ** " KMG".index(found[2] or " ")) if found else 0
    if count < 1:
        raise argparse.ArgumentTypeError(f"must be a number of bytes, such as 256M or 2G; got {text!r}")
    return count


def add_command(commands: Any, name: str, help: str, execute: Callable[[argparse.Namespace], None]) -> Parser:
    """A subcommand, with its function."""
    parser = commands.add_parser(name, help=help, description=f"{help[0].upper()}{help[1:]}.")
    parser.set_defaults(execute=execute, parser=parser)
    return parser


def add_output(parser: Parser, default: str, help: str) -> None:
    """Where a command writes."""
    text = f"{help} (default: %(default)s)"
    parser.add_argument("-o", "--output", type=Path, default=Path(default), help=text)


def add_vector(group: Any, flag: str, names: str, help: str, **more: Any) -> None:
    """An option of several numbers, as many as there are names."""
    metavar = tuple(names.split())
    group.add_argument(
        flag, **{"type": float, "nargs": len(metavar), "metavar": metavar, "help": help} | more
    )


def add_size(parser: Parser) -> None:
    """Of an image."""
    add_vector(parser, "--size", "W H", "pixels (default: 512 512)", type=int, default=(512, 512))


def add_volume(parser: Parser) -> None:
    """The volume that a command reads, and a file of options."""
    text = "volume: NAME_XxYxZ_TYPE.raw[.gz], .npy, .npz, and more with jaxvol[io]"
    parser.add_argument("file", type=Path, nargs="?", metavar="FILE", help=text)
    text = "a file of options, by their names without dashes; those given here win"
    parser.add_argument("--config", type=Path, metavar="TOML", help=text)
    group = parser.add_argument_group("data: needed if the file and its name do not specify it")
    add_vector(group, "--shape", "X Y Z", "voxels, x fastest in the file", type=int)
    group.add_argument("--dtype", help="such as uint8 or uint16le")
    add_vector(group, "--spacing", "X Y Z", "world length between voxels")


def add_sampling(parser: Parser) -> None:
    """How images are sampled, and what is behind."""
    text = "distance between samples, world length (default: half a voxel for fit; as planned for render)"
    parser.add_argument("--step", type=float, help=text)
    text = "linear RGB (default: white; black behind maximum, minimum and average)"
    add_vector(parser, "--background", "R G B", text)


def add_clim(group: Any) -> None:
    """The range of a transfer function."""
    add_vector(group, "--clim", "LOW HIGH", "range of values that it covers (default: all)")


def add_transfer(parser: Parser) -> None:
    """The transfer function."""
    group = parser.add_argument_group("transfer function (default: what the histogram suggests)")
    presets = "; ".join(f"{name}: {text}" for name, (text, _, _) in PRESETS.items())
    group.add_argument("--preset", metavar="NAME", help=presets.replace("%", "%%"))
    text = "a matplotlib colormap, or a colour, over --clim (default with --clim: gray; isosurfaces: white)"
    group.add_argument("--cmap", metavar="NAME", help=text)
    text = "a transfer function written by jaxvol fit"
    group.add_argument("--transfer", type=Path, metavar="JSON", help=text)
    add_clim(group)
    text = "length to which opacities refer (default: 1)"
    group.add_argument("--unit-distance", type=float, metavar="LENGTH", help=text)


def add_scene(parser: Parser) -> None:
    """A volume that is looked at through a camera."""
    add_volume(parser)
    add_sampling(parser)
    add_size(parser)
    text = "a picture that jaxvol wrote: take its options, and its volume unless another is named"
    parser.add_argument("--like", type=Path, metavar="PNG", help=text)
    text = "read the volume in bricks, with so much memory for them, such as 256M: .raw, .npy and Zarr"
    parser.add_argument("--memory", type=memory_size, metavar="BYTES", help=text)
    text = "RMSE of linear colours, by which step and transforms are chosen (default: 1/255; not with --step)"
    parser.add_argument("--tolerance", type=float, help=text)
    add_transfer(parser)
    _add_appearance(parser)
    _add_camera(parser)
    _add_clip(parser)


def _add_appearance(parser: Parser) -> None:
    group = parser.add_argument_group("appearance")
    group.add_argument(
        "--compositing",
        choices=(*MODES, "isosurface"),
        default="over",
        help="how samples become a pixel: over (default), by emission and absorption; maximum, minimum, "
        "average: that value of the ray, as classified; isosurface: where --isovalue is first crossed",
    )
    text = "with --compositing isosurface: the value on it"
    group.add_argument("--isovalue", type=float, metavar="VALUE", help=text)
    text = (
        "shade by the gradient of the values, under a light at the camera; by default isosurfaces, the "
        f"automatic transfer function, and the presets {', '.join(sorted(SHADED))}"
    )
    group.add_argument("--shade", action=SWITCH, help=text)


def _add_camera(parser: Parser) -> None:
    group = parser.add_argument_group("camera")
    text = "position and focal point in the world; the camera may be inside the volume"
    add_vector(group, "--camera", "X Y Z FX FY FZ", text)
    text = "without --camera: the side from which to view the whole volume (default: 0.5 -1 0.4)"
    add_vector(group, "--direction", "X Y Z", text)
    add_vector(
        group, "--view-up", "X Y Z", "what is up in the image (default: 0 0 1)", default=(0.0, 0.0, 1.0)
    )
    text = "degrees from the lower to the upper edge of the image (default: 30)"
    group.add_argument("--view-angle", type=float, default=30.0, metavar="DEGREES", help=text)
    text = "orthographic camera; use with --direction"
    group.add_argument("--parallel", action=SWITCH, default=False, help=text)
    text = "magnification of the image (default: 1)"
    group.add_argument("--zoom", type=float, default=1.0, metavar="FACTOR", help=text)


def _add_clip(parser: Parser) -> None:
    group = parser.add_argument_group("clip: show a part of the volume; box and planes in world coordinates")
    text = "show what is inside this box"
    add_vector(group, "--clip-box", "X_MIN X_MAX Y_MIN Y_MAX Z_MIN Z_MAX", text)
    text = (
        "show what lies on the side of the plane through (X, Y, Z) to which the normal (NX, NY, NZ) points; "
        "may be given several times"
    )
    add_vector(group, "--clip-plane", "X Y Z NX NY NZ", text, action="append", default=[])
    text = "cut away what is inside the box and on that side of all planes, and show the rest"
    group.add_argument("--clip-inside-out", action=SWITCH, default=False, help=text)
