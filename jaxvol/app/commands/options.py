"""Which options do several commands share? Where programs are kept, what a scene is, how it is looked at."""

import argparse
from pathlib import Path

from ...compositing.modes import MODES
from ...scene.presets import PRESETS, SHADED
from ...xla.persistent_cache import default_programs
from .data import add_data_options


def shared_options() -> argparse.ArgumentParser:
    """Options of every command."""
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument(
        "--config",
        type=Path,
        metavar="TOML",
        help="a file of options, by their names without dashes in front; those given here as well count",
    )
    shared.add_argument(
        "--programs",
        type=Path,
        default=default_programs(),
        metavar="FOLDER",
        help="cache of compiled programs (default: %(default)s)",
    )
    return shared


def add_output(parser: argparse.ArgumentParser, default: str, kind: str, metavar: str = "FILE") -> None:
    """Add where a command writes. `kind`: what it writes, for the help."""
    text = f"{kind} (default: %(default)s)"
    parser.add_argument("-o", "--output", type=Path, default=Path(default), metavar=metavar, help=text)


def add_size(parser: argparse.ArgumentParser) -> None:
    """Add the size of an image."""
    parser.add_argument("--size", type=int, nargs=2, default=(512, 512), metavar=("W", "H"), help="pixels")


def add_clim(group: argparse._ArgumentGroup, text: str) -> None:
    """Add a range of values. `text`: of what, for the help."""
    group.add_argument("--clim", type=float, nargs=2, metavar=("LOW", "HIGH"), help=text)


def scene_options() -> argparse.ArgumentParser:
    """Options of all commands that render a volume file."""
    scene = argparse.ArgumentParser(add_help=False)
    add_data_options(scene)
    scene.add_argument(
        "--step",
        type=float,
        help="distance between samples, world length (default: half a voxel for fit; as planned for render)",
    )
    scene.add_argument(
        "--background",
        type=float,
        nargs=3,
        metavar=("R", "G", "B"),
        help="linear RGB (default: white; black behind maximum, minimum and average)",
    )
    return scene


def view_options() -> argparse.ArgumentParser:
    """Options of all commands that look at a volume through a camera."""
    view = argparse.ArgumentParser(add_help=False, parents=[transfer_options()])
    add_size(view)
    view.add_argument(
        "--like",
        type=Path,
        metavar="PNG",
        help="a picture that jaxvol wrote: take its options, and its volume unless another is named",
    )
    view.add_argument(
        "--memory",
        type=memory_size,
        metavar="BYTES",
        help="read the volume in bricks, with so much memory for them, such as 256M or 2G: files of .raw, "
        ".npy and Zarr",
    )
    view.add_argument(
        "--tolerance",
        type=float,
        help="RMSE of the image's linear colours, by which step and transforms are chosen "
        "(default: 1/255; not with --step)",
    )
    _appearance(view)
    _camera(view)
    _clip(view)
    return view


def memory_size(text: str) -> int:
    """A number of bytes, such as 1000000, 256M or 2G (powers of 1024)."""
    number, factor = text.strip(), 1
    for power, letter in enumerate("KMG", 1):
        if number[-1:].upper() == letter:
            number, factor = number[:-1], 1024**power
    try:
        count = int(float(number) * factor)
    except (ValueError, OverflowError) as fault:
        raise argparse.ArgumentTypeError(
            f"must be a number of bytes, such as 256M or 2G; got {text!r}"
        ) from fault
    if count < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1 byte; got {text!r}")
    return count


def transfer_options() -> argparse.ArgumentParser:
    """Options of all commands that show a volume: its transfer function."""
    look = argparse.ArgumentParser(add_help=False)
    group = look.add_argument_group("transfer function")
    kinds = "; ".join(f"{name}: {text}" for name, (text, _, _) in PRESETS.items())
    transfer = group.add_mutually_exclusive_group()
    transfer.add_argument(
        "--preset", metavar="NAME", help=f"{kinds} (default: what the volume's histogram suggests)"
    )
    transfer.add_argument(
        "--cmap",
        metavar="NAME",
        help="a matplotlib colormap, or a colour, over --clim (default with --clim, --opacity, and modes "
        "other than over: gray; isosurfaces: white)",
    )
    transfer.add_argument(
        "--transfer", type=Path, metavar="JSON", help="a transfer function written by jaxvol fit"
    )
    group.add_argument("--opacity", metavar="RAMP", help="with --cmap: linear (default) or sigmoid")
    add_clim(group, "range of values that it covers")
    group.add_argument("--unit-distance", type=float, help="length to which opacities refer (default: 1)")
    return look


def _appearance(view: argparse.ArgumentParser) -> None:
    group = view.add_argument_group("appearance")
    group.add_argument(
        "--compositing",
        choices=(*MODES, "isosurface"),
        default="over",
        help="how samples become a pixel: over (default), by emission and absorption; maximum, minimum, "
        "average: that value of the ray, as classified; isosurface: where --isovalue is first crossed",
    )
    group.add_argument(
        "--isovalue", type=float, metavar="VALUE", help="with --compositing isosurface: the value on it"
    )
    group.add_argument(
        "--shade",
        action=argparse.BooleanOptionalAction,
        help="shade by the gradient of the values, under a light at the camera; by default isosurfaces, and "
        "what is composited with the automatic transfer function or the presets "
        f"{', '.join(sorted(SHADED))}",
    )


def _camera(view: argparse.ArgumentParser) -> None:
    group = view.add_argument_group("camera")
    group.add_argument(
        "--camera",
        type=float,
        nargs=6,
        metavar=("X", "Y", "Z", "FX", "FY", "FZ"),
        help="position and focal point in the world; the camera may be inside the volume",
    )
    group.add_argument(
        "--direction",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="without --camera: the side from which to view the whole volume (default: 0.5 -1 0.4, or as "
        "--view-up has it)",
    )
    group.add_argument(
        "--view-up",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="what is up in the image (default: 0 0 1; or, for files that do not say how they lie, shown as "
        "the histogram suggests: away from the one face that cuts the object, if there is such a face)",
    )
    group.add_argument(
        "--view-angle",
        type=float,
        default=30,
        help="degrees from the lower to the upper edge of the image (default: 30)",
    )
    group.add_argument(
        "--parallel",
        action=argparse.BooleanOptionalAction,
        default=False,
        help="orthographic camera; use with --direction",
    )
    group.add_argument("--zoom", type=float, default=1, help="magnification of the image (default: 1)")
    group.add_argument(
        "--axis",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="what the camera turns about, through its focal point (default: --view-up)",
    )


def _clip(view: argparse.ArgumentParser) -> None:
    group = view.add_argument_group("clip", "show a part of the volume; box and planes in world coordinates")
    group.add_argument(
        "--clip-box",
        type=float,
        nargs=6,
        metavar=("X_MIN", "X_MAX", "Y_MIN", "Y_MAX", "Z_MIN", "Z_MAX"),
        help="show what is inside this box",
    )
    group.add_argument(
        "--clip-plane",
        type=float,
        nargs=6,
        action="append",
        default=[],
        metavar=("X", "Y", "Z", "NX", "NY", "NZ"),
        help="show what lies on the side of the plane through (X, Y, Z) to which the normal (NX, NY, NZ) "
        "points; may be given several times",
    )
    group.add_argument(
        "--clip-inside-out",
        action=argparse.BooleanOptionalAction,
        default=False,
        help="cut away what is inside the box and on that side of all planes, and show the rest",
    )
