"""`jaxvol render`: an image of a volume file."""

import argparse
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ...io.display import image_file, save_image
from ...scene.camera import Camera
from ...scene.rendering import Rendering
from ..unseen import why_unseen
from .data import refuse_to_replace
from .frames import Frames, frames_of
from .options import add_output, scene_options, view_options
from .orbit import axis_of, turned, views_of
from .progress import working
from .recorded import settings_of, text_of, transfer_from_file
from .scene import scene_of


def add_render(commands: Any, shared: argparse.ArgumentParser, examples: str = "") -> None:
    """Add the subcommand. `commands`: what `add_subparsers` returned."""
    parser = commands.add_parser(
        "render",
        parents=[shared, scene_options(), view_options()],
        help="render a volume file to an image",
        description="Render a volume file to an image.",
        epilog=examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    kinds = ".png or .jpg (sRGB, 8 bits), .tif or .npy (linear float32)"
    add_output(
        parser, "out.png", f"image to write: {kinds}. A .png holds the options that made it: see --like"
    )
    parser.add_argument(
        "--transparent",
        action=argparse.BooleanOptionalAction,
        default=False,
        help="write opacity instead of a background: .png (straight alpha), .tif or .npy (premultiplied)",
    )
    parser.add_argument(
        "--depth",
        type=Path,
        metavar="FILE",
        help="also write depth, the (mean) distance to what is visible, else infinite: .npy or .tif, float32",
    )
    parser.add_argument(
        "--turn", type=float, default=0, metavar="DEGREES", help="turn the camera about --axis (default: 0)"
    )
    parser.add_argument(
        "--orbit",
        type=float,
        metavar="DEGREES",
        help="plan for all of an orbit of so many degrees, as jaxvol animate does",
    )
    parser.set_defaults(run=_render)


def _render(options: argparse.Namespace) -> None:
    begun = time.perf_counter()
    refuse_to_replace(options, "output", "depth")
    image_file("--output", options.output, 4 if options.transparent else 3)
    if options.depth:
        image_file("--depth", options.depth, 0)
    scene = scene_of(options)
    camera = turned(scene.camera, options.turn, axis_of(options, scene.camera))
    views = (camera,) if options.orbit is None else views_of(options, scene.camera, options.orbit)
    frames = frames_of(options, scene, views)
    before = "reading and planning" if options.step is None else "reading"
    rendering = rendered(frames, camera, options.output, {before: time.perf_counter() - begun})
    told = {}
    if options.output.suffix.lower() == ".png":
        held = transfer_from_file(options, scene.transfer)
        told = text_of("render", settings_of(options), options.file, transfer=held)
    image = rendering.rgba if options.transparent else rendering.image(scene.background)
    save_image(options.output, image, text=told)
    if options.depth:
        print(f"{save_image(options.depth, rendering.depth)}: distances, world length")
    if scene.source is None:
        why = why_unseen(frames.volume, frames.transfer, camera, frames.march, rendering, scene.compositing)
        if why is not None:
            print(f"{options.output}: nothing is seen: {why}")


def rendered(
    frames: Frames, camera: Camera, path: Path, before: Mapping[str, float] | None = None
) -> Rendering:
    """One image; prints what it took, under the name of the file that it is for. `before`: the seconds that
    were needed for it until now, by what was done in them."""
    begun = time.perf_counter()
    with working(f"compiling and rendering {path}") as told:
        rendering = frames.render(camera, told)
    spent = {**(before or {}), "compiling and rendering": time.perf_counter() - begun}
    parts = ", ".join(f"{what} {seconds:.2f} s" for what, seconds in spent.items())
    parts = parts if len(spent) > 1 else next(iter(spent))  # a single one is the whole
    device = jax.devices()[0]
    millions = np.asarray(rendering.samples).sum(dtype=np.int64) / 1e6
    shape = frames.volume.shape if frames.source is None else frames.source.shape
    print(
        f"{path}: {' x '.join(map(str, camera.size))} pixels of {' x '.join(map(str, shape))} voxels, "
        f"{millions:.1f} million samples in {sum(spent.values()):.2f} s ({parts}), "
        f"on {device.device_kind} ({device.platform})"
    )
    if frames.source is not None:
        bricks = rendering.bricks
        counts = " x ".join(map(str, bricks.counts))
        print(f"{path}: {bricks.loads} of {counts} bricks read, {bricks.bytes_read} bytes")
        if frames.volume.shape != shape:
            copy = " x ".join(map(str, frames.volume.shape))
            what = "transfer function, view, step"
            print(f"{path}: what was not given ({what}) was chosen by {copy} of the voxels")
    if np.any(rendering.exhausted):
        print(
            f"{path}: incomplete: rays used up their {frames.march.most_samples} samples; use a longer step"
        )
    return rendering
