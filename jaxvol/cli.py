"""What does the command `jaxvol` do? Pictures of volumes, and transfer functions of pictures, without a line
of Python."""

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from .alignment import AlphaCorrection
from .camera import Camera
from .display import save_png
from .engine import render
from .fitting import ImageResidual, fit, flat_grey, read_transfer, read_views, write_transfer
from .formats import load
from .leaping import SpaceLeaping
from .march import March
from .phantoms import phantom
from .presets import PRESETS, colormap, preset
from .rendering import Rendering
from .termination import EarlyTermination
from .transfer import TransferFunction
from .volume import Volume


EXAMPLES = """\
examples:
  jaxvol demo
  jaxvol render engine_256x256x128_uint8.raw.gz --preset engine -o engine.png
  jaxvol render head_256x256x113_uint16le.raw.gz --spacing 1 1 2 --preset ct_skin_bone --clim 0 4000 \\
      --direction -0.7 -1 0.25 --view-up 0 0 -1 -o head.png
  jaxvol render chest.npy --preset ct_airway --camera 99 64 165 96 78 140 --view-angle 90 -o inside.png
  jaxvol fit engine_256x256x128_uint8.raw.gz --images a.png b.png --cameras cameras.json -o transfer.json
"""


FAST = SpaceLeaping(), AlphaCorrection(), EarlyTermination()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0, or 2 for bad input, told in one line."""
    options = _parser().parse_args(arguments)
    jax.config.update("jax_compilation_cache_dir", str(options.programs))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    try:
        options.run(options)
    except (ValueError, OSError, ImportError) as fault:
        print(f"jaxvol {options.command}: error: {' '.join(str(fault).split())}", file=sys.stderr)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxvol",
        description="Direct volume rendering in JAX.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument(
        "--programs",
        type=Path,
        default=_programs(),
        metavar="FOLDER",
        help="where compiled programs are kept for the next time (default: %(default)s)",
    )
    scene = _scene_options()
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    demo = commands.add_parser(
        "demo", parents=[shared], help="render a built-in head, and what one transform changes"
    )
    demo.add_argument("-o", "--output", type=Path, default=Path("jaxvol-demo"), metavar="FOLDER")
    demo.add_argument("--size", type=int, nargs=2, default=(512, 512), metavar=("W", "H"), help="pixels")
    demo.add_argument("--resolution", type=int, default=192, help="voxels along an axis of the phantom")
    demo.set_defaults(run=_demo)

    one = commands.add_parser(
        "render",
        parents=[shared, scene],
        help="render a volume file to a PNG",
        description="Render a volume file to a PNG.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    one.add_argument(
        "-o", "--output", type=Path, default=Path("out.png"), help="picture to write (default: %(default)s)"
    )
    one.add_argument("--size", type=int, nargs=2, default=(512, 512), metavar=("W", "H"), help="pixels")

    look = one.add_argument_group("the look")
    kinds = "; ".join(f"{name}: {text}" for name, (text, _, _) in PRESETS.items())
    chosen = look.add_mutually_exclusive_group()
    chosen.add_argument("--preset", metavar="NAME", help=kinds)
    chosen.add_argument("--cmap", metavar="NAME", help="a matplotlib colormap over --clim (default: gray)")
    look.add_argument("--opacity", default="linear", metavar="RAMP", help="with --cmap: linear or sigmoid")
    look.add_argument(
        "--clim", type=float, nargs=2, metavar=("LOW", "HIGH"), help="range of values to stretch it over"
    )
    look.add_argument(
        "--unit-distance", type=float, default=1.0, help="length over which opacities count (default: 1)"
    )

    view = one.add_argument_group("the camera")
    view.add_argument(
        "--camera",
        type=float,
        nargs=6,
        metavar=("X", "Y", "Z", "FX", "FY", "FZ"),
        help="position and focal point, world; it may stand inside the volume",
    )
    view.add_argument(
        "--direction",
        type=float,
        nargs=3,
        default=(0.5, -1, 0.4),
        metavar=("X", "Y", "Z"),
        help="without --camera: the side from which to see the whole volume",
    )
    view.add_argument("--view-up", type=float, nargs=3, default=(0, 0, 1), metavar=("X", "Y", "Z"))
    view.add_argument(
        "--view-angle", type=float, default=30, help="degrees between lower and upper edge (default: 30)"
    )
    view.add_argument("--zoom", type=float, default=1, help="magnification of the image (default: 1)")
    one.set_defaults(run=_render)

    found = commands.add_parser(
        "fit",
        parents=[shared, scene],
        help="find the transfer function under which a volume looks as in pictures",
        description="Find the transfer function under which a volume looks as in pictures.",
    )
    found.add_argument(
        "--images", type=Path, nargs="+", required=True, metavar="PICTURE", help="sRGB, as PNG"
    )
    found.add_argument(
        "--cameras",
        type=Path,
        required=True,
        metavar="JSON",
        help="a list with an object for each picture: position, focal_point, and optionally view_up, "
        "view_angle, parallel_scale, window",
    )
    found.add_argument(
        "-o",
        "--output",
        type=Path,
        default=Path("transfer.json"),
        help="JSON to write (default: %(default)s)",
    )
    begin = found.add_argument_group("the start")
    begin.add_argument(
        "--start", type=Path, metavar="JSON", help="a transfer function, as this command writes"
    )
    begin.add_argument("--points", type=int, default=8, help="else, flat grey of so many points (default: 8)")
    begin.add_argument(
        "--clim", type=float, nargs=2, metavar=("LOW", "HIGH"), help="range of their values (default: all)"
    )
    how = found.add_argument_group("the solver")
    how.add_argument("--solver", default="levenberg_marquardt", help="or gauss_newton, bfgs, adam")
    how.add_argument("--max-steps", type=int, default=100)
    how.add_argument("--checkpoint", type=Path, metavar="FILE", help="go on from here after a break")
    how.add_argument("--progress", action="store_true", help="show a progress bar")
    found.set_defaults(run=_fit)
    return parser


def _scene_options() -> argparse.ArgumentParser:
    """Options of all that is rendered from a volume file."""
    scene = argparse.ArgumentParser(add_help=False)
    scene.add_argument(
        "file", type=Path, help="volume: NAME_XxYxZ_TYPE.raw[.gz], .npy, .npz, and more with jaxvol[io]"
    )
    scene.add_argument(
        "--step", type=float, help="distance between samples, world length (default: half a voxel)"
    )
    scene.add_argument(
        "--background", type=float, nargs=3, default=(1, 1, 1), metavar=("R", "G", "B"), help="linear RGB"
    )
    what = scene.add_argument_group("the data", "needed where the file and its name do not tell")
    what.add_argument(
        "--shape", type=int, nargs=3, metavar=("X", "Y", "Z"), help="voxels, x fastest in the file"
    )
    what.add_argument("--dtype", help="such as uint8 or uint16le")
    what.add_argument(
        "--spacing", type=float, nargs=3, metavar=("X", "Y", "Z"), help="world length between voxels"
    )
    return scene


def _programs() -> Path:
    """The folder of compiled programs: JAX's own where that is set, else one in the user's cache."""
    chosen = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(chosen) if chosen else caches / "jaxvol" / "programs"


def _demo(options: argparse.Namespace) -> None:
    size = tuple(options.size)
    head = phantom("head", options.resolution)
    camera = Camera.looking_at(head, (0.65, -1, 0.15), size=size).zoom(1.45)
    march = March(float(head.spacing[0]) / 2, FAST, "midpoint")
    _timed(head, preset("head", unit_distance=0.01), camera, march, options.output / "head.png")

    # A translucent cube at a step far too long: the last cell of each ray reaches past the cube by
    # another part of a step, which shows as terraces, until it is cut at the exit.
    cube = phantom("linear", 64)
    transfer = TransferFunction.from_points([(0, (0.9, 0.35, 0.1), 0.45), (1, (0.15, 0.35, 0.9), 0.45)])
    camera = Camera.looking_at(cube, (-0.6, 0.5, -1), (0, 1, 0), size=size).zoom(1.3)
    for name, transforms in (("before", ()), ("after", (AlphaCorrection(),))):
        _timed(cube, transfer, camera, March(0.25, transforms), options.output / f"{name}.png", (0, 0, 0))


def _render(options: argparse.Namespace) -> None:
    volume, march = _scene(options)
    if options.preset:
        transfer = preset(options.preset, options.clim, options.unit_distance)
    else:
        clim = options.clim or (float(volume.data.min()), float(volume.data.max()))
        transfer = colormap(options.cmap or "gray", clim, options.opacity, options.unit_distance)
    view = {"view_up": options.view_up, "view_angle": options.view_angle, "size": tuple(options.size)}
    if options.camera:
        camera = Camera(options.camera[:3], options.camera[3:], **view)
    else:
        camera = Camera.looking_at(volume, options.direction, **view)
    _timed(volume, transfer, camera.zoom(options.zoom), march, options.output, options.background)


def _fit(options: argparse.Namespace) -> None:
    volume, march = _scene(options)
    views = read_views(options.images, options.cameras)
    given = options.start
    start = read_transfer(given) if given else flat_grey(volume, options.points, options.clim)
    found = fit(
        ImageResidual(lambda transfer, camera: (volume, transfer, camera, march), views, options.background),
        start,
        solver=options.solver,
        max_steps=options.max_steps,
        checkpoint=options.checkpoint,
        progress=options.progress,
    )
    path = write_transfer(options.output, found.parameters)
    error = (2 * found.loss) ** 0.5
    print(f"{path}: RMSE {error:.5f} in linear RGB after {len(found.losses)} steps. {found.message}")


def _scene(options: argparse.Namespace) -> tuple[Volume, March]:
    """The volume in the file, and how it is marched."""
    volume = load(options.file, shape=options.shape, dtype=options.dtype, spacing=options.spacing)
    step = float(volume.spacing.min()) / 2 if options.step is None else options.step
    return volume, March(step, FAST, "midpoint")


def _timed(
    volume: Volume,
    transfer: TransferFunction,
    camera: Camera,
    march: March,
    output: Path,
    background: Sequence[float] = (1, 1, 1),
) -> None:
    """Render to a file, and tell where it is and what it took, compilation apart."""

    def image() -> tuple[Rendering, float]:
        begun = time.perf_counter()
        rendering = jax.block_until_ready(render(volume, transfer, camera, march))
        return rendering, time.perf_counter() - begun

    _, first = image()  # compiled with the first image, and not again
    rendering, again = image()
    path = save_png(output, rendering.image(background))
    device = jax.devices()[0]
    millions = np.asarray(rendering.samples).sum(dtype=np.int64) / 1e6
    print(
        f"{path}: {' x '.join(map(str, camera.size))} pixels of {' x '.join(map(str, volume.shape))} voxels, "
        f"{millions:.1f} million samples in {again:.2f} s "
        f"({first:.2f} s with compilation), on {device.device_kind} ({device.platform})"
    )
    if np.any(rendering.exhausted):
        print(f"{path}: incomplete: rays ran out of their {march.most_samples} samples; take a longer step")
