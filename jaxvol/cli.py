"""What does the command `jaxvol` do? It renders volume files, plans how to, fits transfer functions,
tells what a file holds, and fetches public ones."""

import argparse
import os
import sys
import threading
import time
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ._util.checks import output_file
from .camera import Camera
from .commands.data import add_data_options, volume_of
from .commands.datasets import add_datasets
from .commands.info import add_info
from .commands.view import add_view
from .compositing import Compositing, Over
from .display import image_file, save_image
from .figures import add_figures
from .fitting import ImageResidual, fit, flat_grey, read_transfer, read_views, write_transfer
from .isosurface import Isosurface
from .lighting import Lighting, Phong
from .march import March, Transform
from .modes import MODES, Mode, compositing_of
from .phantoms import phantom
from .planning import plan
from .presets import PRESETS, SHADED, colormap, preset
from .projections import Average
from .render import PLANNED, render
from .transfer import TransferFunction
from .transforms.alpha_correction import AlphaCorrection
from .transforms.clip import Clip
from .transforms.early_termination import EarlyTermination
from .transforms.space_leaping import SpaceLeaping
from .unseen import why_unseen
from .volume import Volume


EXAMPLES = """\
examples:
  jaxvol demo
  jaxvol datasets list
  jaxvol datasets fetch engine
  jaxvol info engine_256x256x128_uint8.raw.gz
  jaxvol render engine_256x256x128_uint8.raw.gz --preset engine -o engine.png
  jaxvol render head_256x256x113_uint16le.raw.gz --spacing 1 1 2 --preset ct_skin_bone --clim 0 4000 \\
      --direction -0.7 -1 0.25 --view-up 0 0 -1 -o head.png
  jaxvol render engine_256x256x128_uint8.raw.gz --preset engine --clip-plane 128 128 64 1 -1 0 -o half.png
  jaxvol render engine_256x256x128_uint8.raw.gz --cmap gray --compositing maximum -o mip.png
  jaxvol render engine_256x256x128_uint8.raw.gz --preset engine --compositing isosurface --isovalue 170
  jaxvol plan engine_256x256x128_uint8.raw.gz --preset engine --tolerance 0.001
  jaxvol render chest.npy --preset ct_airway --camera 99 64 165 96 78 140 --view-angle 90 -o inside.png
  jaxvol fit engine_256x256x128_uint8.raw.gz --images a.png b.png --cameras cameras.json -o transfer.json
  jaxvol render engine_256x256x128_uint8.raw.gz --transfer transfer.json --transparent --depth depth.npy
"""


FAST = SpaceLeaping(), AlphaCorrection(), EarlyTermination()

INTERRUPTED = 130
"""Exit code after Ctrl-C, as in shells."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    **Returns:** the exit code: 0, or 2 for bad input, reported in one line. Ctrl-C is reported in one line,
    too, and ends the process at once with code 130, by `os._exit`: XLA does not stop compiling or computing
    for a signal.
    """
    options = _parser().parse_args(arguments)
    jax.config.update("jax_compilation_cache_dir", str(options.programs))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    try:
        _run_in_thread(options)
    except (ValueError, OSError, ImportError) as fault:
        print(f"jaxvol {options.command}: error: {' '.join(str(fault).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        checkpoint = getattr(options, "checkpoint", None)
        hint = f"; the same command resumes from {checkpoint}" if checkpoint and checkpoint.exists() else ""
        print(f"\njaxvol {options.command}: interrupted{hint}", file=sys.stderr, flush=True)
        sys.stdout.flush()
        os._exit(INTERRUPTED)
    return 0


def _run_in_thread(options: argparse.Namespace) -> None:
    """Run a command in a thread of its own. Python delivers signals to the main thread, which only waits and
    so can handle them while XLA is busy."""
    faults: list[BaseException] = []

    def run() -> None:
        try:
            options.run(options)
        except BaseException as fault:
            faults.append(fault)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join()
    if faults:
        raise faults[0]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxvol",
        description="Direct volume rendering in JAX.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {_version()}")
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument(
        "--programs",
        type=Path,
        default=_programs(),
        metavar="FOLDER",
        help="cache of compiled programs (default: %(default)s)",
    )
    scene, view = _scene_options(), _view_options()
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    demo_command = commands.add_parser(
        "demo", parents=[shared], help="render a built-in head, and the effect of one transform"
    )
    demo_command.add_argument("-o", "--output", type=Path, default=Path("jaxvol-demo"), metavar="FOLDER")
    demo_command.add_argument(
        "--size", type=int, nargs=2, default=(512, 512), metavar=("W", "H"), help="pixels"
    )
    demo_command.add_argument("--resolution", type=int, default=320, help="voxels per axis of the phantom")
    demo_command.set_defaults(run=_demo)

    render_command = commands.add_parser(
        "render",
        parents=[shared, scene, view],
        help="render a volume file to an image",
        description="Render a volume file to an image.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    render_command.add_argument(
        "-o",
        "--output",
        type=Path,
        default=Path("out.png"),
        metavar="FILE",
        help="image to write: .png or .jpg (sRGB, 8 bits), .tif or .npy (linear float32); "
        "default: %(default)s",
    )
    render_command.add_argument(
        "--transparent",
        action="store_true",
        help="write opacity instead of a background: .png (straight alpha), .tif or .npy (premultiplied)",
    )
    render_command.add_argument(
        "--depth",
        type=Path,
        metavar="FILE",
        help="also write depth, the (mean) distance to what is visible, else infinite: .npy or .tif, float32",
    )
    render_command.set_defaults(run=_render)

    plan_command = commands.add_parser(
        "plan",
        parents=[shared, scene, view],
        help="show the cheapest way to render a volume file within a tolerance, and why",
        description="Show the cheapest way to render a volume file within a tolerance, and why. The command "
        "`render` uses it.",
    )
    plan_command.set_defaults(run=_plan)

    fit_command = commands.add_parser(
        "fit",
        parents=[shared, scene],
        help="fit a transfer function to images of a volume",
        description="Fit a transfer function to images of a volume.",
    )
    fit_command.add_argument(
        "--images", type=Path, nargs="+", required=True, metavar="IMAGE", help="sRGB, as PNG"
    )
    fit_command.add_argument(
        "--cameras",
        type=Path,
        required=True,
        metavar="JSON",
        help="a list with one object per image: position, focal_point, and optionally view_up, view_angle, "
        "parallel_scale, window",
    )
    fit_command.add_argument(
        "-o",
        "--output",
        type=Path,
        default=Path("transfer.json"),
        help="JSON to write (default: %(default)s)",
    )
    start = fit_command.add_argument_group("start")
    start.add_argument(
        "--start", type=Path, metavar="JSON", help="a transfer function written by this command"
    )
    start.add_argument(
        "--points", type=int, default=8, help="else, flat grey with this many points (default: 8)"
    )
    start.add_argument(
        "--clim", type=float, nargs=2, metavar=("LOW", "HIGH"), help="range of their values (default: all)"
    )
    solver = fit_command.add_argument_group("solver")
    solver.add_argument("--solver", default="levenberg_marquardt", help="or gauss_newton, bfgs, adam")
    solver.add_argument("--max-steps", type=int, default=100)
    solver.add_argument(
        "--checkpoint",
        type=Path,
        metavar="FILE",
        help="save every step here; resume from here after an interruption",
    )
    solver.add_argument("--progress", action="store_true", help="show a progress bar")
    fit_command.set_defaults(run=_fit)
    add_figures(commands, shared)
    add_info(commands, shared)
    add_datasets(commands, shared)
    add_view(commands, shared)
    return parser


def _view_options() -> argparse.ArgumentParser:
    """Options shared by all commands that look at a volume through a camera."""
    view = argparse.ArgumentParser(add_help=False)
    view.add_argument("--size", type=int, nargs=2, default=(512, 512), metavar=("W", "H"), help="pixels")

    appearance = view.add_argument_group("appearance")
    kinds = "; ".join(f"{name}: {text}" for name, (text, _, _) in PRESETS.items())
    transfer = appearance.add_mutually_exclusive_group()
    transfer.add_argument("--preset", metavar="NAME", help=kinds)
    transfer.add_argument(
        "--cmap",
        metavar="NAME",
        help="a matplotlib colormap, or a colour, over --clim (default: gray; isosurfaces: white)",
    )
    transfer.add_argument(
        "--transfer", type=Path, metavar="JSON", help="a transfer function written by jaxvol fit"
    )
    appearance.add_argument("--opacity", metavar="RAMP", help="with --cmap: linear (default) or sigmoid")
    appearance.add_argument(
        "--clim", type=float, nargs=2, metavar=("LOW", "HIGH"), help="range of values that it covers"
    )
    appearance.add_argument(
        "--unit-distance", type=float, help="length to which opacities refer (default: 1)"
    )

    appearance.add_argument(
        "--compositing",
        choices=(*MODES, "isosurface"),
        default="over",
        help="how samples become a pixel: over (default), by emission and absorption; maximum, minimum, "
        "average: that value of the ray, as classified; isosurface: where --isovalue is first crossed",
    )
    appearance.add_argument(
        "--isovalue", type=float, metavar="VALUE", help="with --compositing isosurface: the value on it"
    )

    appearance.add_argument(
        "--shade",
        action=argparse.BooleanOptionalAction,
        help="shade by the gradient of the values, under a light at the camera; by default isosurfaces, and "
        f"what is composited with the presets {', '.join(sorted(SHADED))}",
    )

    camera = view.add_argument_group("camera")
    camera.add_argument(
        "--camera",
        type=float,
        nargs=6,
        metavar=("X", "Y", "Z", "FX", "FY", "FZ"),
        help="position and focal point in the world; the camera may be inside the volume",
    )
    camera.add_argument(
        "--direction",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="without --camera: the side from which to view the whole volume (default: 0.5 -1 0.4)",
    )
    camera.add_argument("--view-up", type=float, nargs=3, default=(0, 0, 1), metavar=("X", "Y", "Z"))
    camera.add_argument(
        "--view-angle",
        type=float,
        default=30,
        help="degrees from the lower to the upper edge of the image (default: 30)",
    )
    camera.add_argument("--parallel", action="store_true", help="orthographic camera; use with --direction")
    camera.add_argument("--zoom", type=float, default=1, help="magnification of the image (default: 1)")

    clip = view.add_argument_group("clip", "show a part of the volume; box and planes in world coordinates")
    clip.add_argument(
        "--clip-box",
        type=float,
        nargs=6,
        metavar=("X_MIN", "X_MAX", "Y_MIN", "Y_MAX", "Z_MIN", "Z_MAX"),
        help="show what is inside this box",
    )
    clip.add_argument(
        "--clip-plane",
        type=float,
        nargs=6,
        action="append",
        default=[],
        metavar=("X", "Y", "Z", "NX", "NY", "NZ"),
        help="show what lies on the side of the plane through (X, Y, Z) to which the normal (NX, NY, NZ) "
        "points; may be given several times",
    )
    clip.add_argument(
        "--clip-inside-out",
        action="store_true",
        help="cut away what is inside the box and on that side of all planes, and show the rest",
    )
    view.add_argument(
        "--tolerance",
        type=float,
        help="RMSE of the image's linear colours, by which step and transforms are chosen "
        "(default: 1/255; not with --step)",
    )
    return view


def _scene_options() -> argparse.ArgumentParser:
    """Options shared by all commands that render a volume file."""
    scene = argparse.ArgumentParser(add_help=False)
    add_data_options(scene)
    scene.add_argument(
        "--step",
        type=float,
        help="distance between samples, world length (default: half a voxel for fit; as planned for render)",
    )
    scene.add_argument(
        "--background", type=float, nargs=3, default=(1, 1, 1), metavar=("R", "G", "B"), help="linear RGB"
    )
    return scene


def _version() -> str:
    """Versions of jaxvol, as installed, and of JAX."""
    try:
        own = metadata.version("jaxvol")
    except metadata.PackageNotFoundError:  # run from a checkout
        own = "(not installed)"
    return f"{own} (jax {jax.__version__})"


def _programs() -> Path:
    """The compilation cache folder: JAX's own if that is set, else one in the user's cache."""
    chosen = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(chosen) if chosen else caches / "jaxvol" / "programs"


def _demo(options: argparse.Namespace) -> None:
    size = tuple(options.size)
    output_file("--output", options.output / "head.png")
    head = phantom("head", options.resolution)
    camera = Camera.looking_at(head, (0.65, -1, 0.15), size=size).zoom(1.45)
    # steps of half a voxel would leave rings on the crown
    march = March(float(head.spacing[0]) / 6, FAST, "midpoint")
    look, path = preset("head", unit_distance=0.01), options.output / "head.png"
    _picture(head, look, camera, march, path, lighting=Phong())

    # A translucent cube at a far too long step: each ray's last cell reaches past the cube by a different
    # fraction of a step, which shows as terraces unless the cell is cut at the exit.
    cube = phantom("linear", 64)
    transfer = TransferFunction.from_points([(0, (0.9, 0.35, 0.1), 0.45), (1, (0.15, 0.35, 0.9), 0.45)])
    camera = Camera.looking_at(cube, (-0.6, 0.5, -1), (0, 1, 0), size=size).zoom(1.3)
    for name, transforms in (("before", ()), ("after", (AlphaCorrection(),))):
        path = options.output / f"{name}.png"
        _picture(cube, transfer, camera, March(0.25, transforms), path, background=(0, 0, 0))


def _render(options: argparse.Namespace) -> None:
    image_file("--output", options.output, 4 if options.transparent else 3)
    if options.depth:
        image_file("--depth", options.depth, 0)
    mode = _mode(options)
    volume, transfer, camera = _view(options)
    background = None if options.transparent else options.background
    lighting = _lighting(options, mode)
    volume, march, lighting = _march(options, volume, transfer, camera, _clip(options), mode, lighting)
    _picture(
        *(volume, transfer, camera, march, options.output),
        compositing=mode,
        lighting=lighting,
        background=background,
        depth=options.depth,
    )


def _plan(options: argparse.Namespace) -> None:
    if options.step is not None:
        raise ValueError("--step sets the step; jaxvol plan finds one: leave it out.")
    mode = _mode(options)
    how = {"transforms": _clip(options), "compositing": mode, "lighting": _lighting(options, mode)}
    print(plan(*_view(options), _tolerance(options), **how))


def _lighting(options: argparse.Namespace, mode: Compositing[Any]) -> Lighting | None:
    """The light that the options ask for, or that is usual for what they show."""
    shade = options.shade
    if shade and isinstance(mode, Average):
        raise ValueError("--shade needs a place that is shaded; leave it out with --compositing average.")
    if shade is None:
        of_preset = options.preset in SHADED and isinstance(mode, Over)
        shade = of_preset or isinstance(mode, Isosurface)
    return Phong() if shade else None


def _mode(options: argparse.Namespace) -> Compositing[Any]:
    """The compositing mode that the options name."""
    shows_surface, value = options.compositing == "isosurface", options.isovalue
    if shows_surface and value is None:
        raise ValueError("--compositing isosurface needs the value on the surface: --isovalue VALUE.")
    if value is not None and not shows_surface:
        raise ValueError(
            f"--isovalue goes with --compositing isosurface; got --compositing {options.compositing}."
        )
    return Isosurface(value) if shows_surface else compositing_of(options.compositing)


def _tolerance(options: argparse.Namespace) -> float:
    return PLANNED if options.tolerance is None else options.tolerance


def _view(options: argparse.Namespace) -> tuple[Volume, TransferFunction, Camera]:
    """What is looked at, and from where."""
    volume = volume_of(options)
    transfer = _look(options, volume)
    view = {"view_up": options.view_up, "view_angle": options.view_angle, "size": tuple(options.size)}
    if options.camera and options.parallel:
        raise ValueError(
            "--parallel goes with --direction, which shows the whole volume; leave out --camera."
        )
    if options.camera and options.direction:
        raise ValueError("--camera sets the position; leave out --direction.")
    if options.camera:
        camera = Camera(options.camera[:3], options.camera[3:], **view)
    else:
        side = options.direction or (0.5, -1, 0.4)
        camera = Camera.looking_at(volume, side, parallel=options.parallel, **view)
    return volume, transfer, camera.zoom(options.zoom)


def _march(
    options: argparse.Namespace,
    volume: Volume,
    transfer: TransferFunction,
    camera: Camera,
    clip: tuple[Transform, ...],
    mode: Compositing[Any],
    lighting: Lighting | None,
) -> tuple[Volume, March, Lighting | None]:
    """The volume, its march and its light: with the given step; without one, as planned."""
    if options.step is None:
        scene = volume, transfer, camera
        how = {"transforms": clip, "compositing": mode, "lighting": lighting}
        found = plan(*scene, _tolerance(options), **how)
        if not found.within:
            print(f"not proven to be within an RMSE of {found.tolerance:.2g}; jaxvol plan tells more")
        return found.volume, found.march, found.lighting
    if options.tolerance is not None:
        raise ValueError("--tolerance finds a step; leave out --step.")
    return volume, March(options.step, (*clip, *FAST), "midpoint"), lighting


def _clip(options: argparse.Namespace) -> tuple[Transform, ...]:
    """What is cut away, if anything is."""
    planes = [(plane[:3], plane[3:]) for plane in options.clip_plane]
    if options.clip_box is None and not planes:
        if options.clip_inside_out:
            raise ValueError("--clip-inside-out goes with --clip-box or --clip-plane.")
        return ()
    return (Clip(options.clip_box, planes, inside_out=options.clip_inside_out),)


def _look(options: argparse.Namespace, volume: Volume) -> TransferFunction:
    """The transfer function that the options specify."""
    if options.transfer:
        for name in ("clim", "opacity", "unit_distance"):
            if getattr(options, name) is not None:
                raise ValueError(
                    f"--{name.replace('_', '-')} is for presets and colormaps; --transfer needs none."
                )
        return read_transfer(options.transfer)
    unit_distance = 1.0 if options.unit_distance is None else options.unit_distance
    if options.preset and options.opacity is not None:
        raise ValueError("--opacity is for colormaps; a preset has its own.")
    if options.preset:
        return preset(options.preset, options.clim, unit_distance)
    clim = options.clim or (float(volume.data.min()), float(volume.data.max()))
    cmap = options.cmap or ("white" if options.compositing == "isosurface" else "gray")
    return colormap(cmap, clim, options.opacity or "linear", unit_distance)


def _fit(options: argparse.Namespace) -> None:
    output_file("--output", options.output)
    volume = volume_of(options)
    # half a voxel
    step = float(volume.spacing.min()) / 2 if options.step is None else options.step
    march = March(step, FAST, "midpoint")
    views = read_views(options.images, options.cameras)
    file = options.start
    start = read_transfer(file) if file else flat_grey(volume, options.points, options.clim)
    result = fit(
        ImageResidual(lambda transfer, camera: (volume, transfer, camera, march), views, options.background),
        start,
        solver=options.solver,
        max_steps=options.max_steps,
        checkpoint=options.checkpoint,
        checkpoint_seconds=0,  # Ctrl-C may come at any time, and a checkpoint is small
        progress=options.progress,
    )
    path = write_transfer(options.output, result.parameters)
    error = (2 * result.loss) ** 0.5
    print(f"{path}: RMSE {error:.5f} in linear RGB after {len(result.losses)} steps. {result.message}")


def _picture(
    volume: Volume,
    transfer: TransferFunction,
    camera: Camera,
    march: March,
    output: Path,
    *,
    compositing: Compositing[Any] | Mode = "over",
    lighting: Lighting | None = None,
    background: Sequence[float] | None = (1, 1, 1),
    depth: Path | None = None,
) -> None:
    """Render to files, with opacity if there is no background; print their paths and the time taken."""
    begun = time.perf_counter()
    how = {"compositing": compositing, "lighting": lighting}
    rendering = jax.block_until_ready(render(volume, transfer, camera, march, **how))
    took = time.perf_counter() - begun
    path = save_image(output, rendering.rgba if background is None else rendering.image(background))
    device = jax.devices()[0]
    millions = np.asarray(rendering.samples).sum(dtype=np.int64) / 1e6
    print(
        f"{path}: {' x '.join(map(str, camera.size))} pixels of {' x '.join(map(str, volume.shape))} voxels, "
        f"{millions:.1f} million samples in {took:.2f} s including compilation, "
        f"on {device.device_kind} ({device.platform})"
    )
    if depth:
        print(f"{save_image(depth, rendering.depth)}: distances, world length")
    if np.any(rendering.exhausted):
        print(f"{path}: incomplete: rays used up their {march.most_samples} samples; use a longer step")
    if (why := why_unseen(volume, transfer, camera, march, rendering, compositing)) is not None:
        print(f"{path}: nothing is seen: {why}")
