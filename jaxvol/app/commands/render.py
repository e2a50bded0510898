"""`jaxvol render`: an image of a volume file."""

import argparse
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ...io.display import image_file, save_image
from ...scene.rendering import Rendering
from ..empty_image import why_empty
from .data import refuse_to_replace
from .frames import Frames, frames_of
from .options import SWITCH, add_command, add_output, add_scene
from .recorded import text_of
from .scene import scene_of


def _render(options: argparse.Namespace) -> None:
    begun = time.perf_counter()
    refuse_to_replace(options, "output", "depth")
    image_file("--output", options.output, 4 if options.transparent else 3)
    if options.depth:
        image_file("--depth", options.depth, 0)
    scene = scene_of(options)
    frames = frames_of(options, scene, [scene.camera])
    ready = time.perf_counter()
    rendering = frames.render(scene.camera)
    ended = time.perf_counter()
    before = "reading and planning" if options.step is None else "reading"
    steps = f"{before} {ready - begun:.2f} s, compiling and rendering {ended - ready:.2f} s"
    _print_facts(options.output, frames, rendering, f"{ended - begun:.2f} s ({steps})")
    image = rendering.rgba if options.transparent else rendering.image(scene.background)
    is_png = options.output.suffix.lower() == ".png"
    save_image(options.output, image, text=text_of(options, scene.transfer) if is_png else {})
    if options.depth:
        print(f"{save_image(options.depth, rendering.depth)}: distances, world length")
    if scene.source is None:
        what = frames.volume, scene.transfer, scene.camera, frames.march, rendering, scene.compositing
        if (why := why_empty(*what)) is not None:
            print(f"{options.output}: nothing is seen: {why}")


def _print_facts(path: Path, frames: Frames, rendering: Rendering, spent: str) -> None:
    """Print how large the image and the volume are, and what the image took."""
    device = jax.devices()[0]
    millions = np.asarray(rendering.samples).sum(dtype=np.int64) / 1e6
    shape = frames.volume.shape if frames.source is None else frames.source.shape
    pixels = rendering.rgba.shape[1::-1]
    print(
        f"{path}: {' x '.join(map(str, pixels))} pixels of {' x '.join(map(str, shape))} voxels, "
        f"{millions:.1f} million samples in {spent}, on {device.device_kind} ({device.platform})"
    )
    if frames.source is not None:
        bricks = rendering.bricks
        counts = " x ".join(map(str, bricks.counts))
        print(f"{path}: {bricks.loads} of {counts} bricks read, {bricks.bytes_read} bytes")
    if np.any(rendering.exhausted):
        most = frames.march.most_samples
        print(f"{path}: incomplete: rays used up their {most} samples; use a longer step")


def add_render(commands: Any) -> None:
    parser = add_command(commands, "render", "render a volume file to an image", _render)
    add_scene(parser)
    text = (
        "image to write: .png or .jpg (sRGB, 8 bits), .tif or .npy (linear float32). A .png holds the "
        "options that made it: see --like"
    )
    add_output(parser, "out.png", text)
    text = "write opacity instead of a background: .png (straight alpha), .tif or .npy (premultiplied)"
    parser.add_argument("--transparent", action=SWITCH, default=False, help=text)
    text = "also write depth, the (mean) distance to what is visible, else infinite: .npy or .tif, float32"
    parser.add_argument("--depth", type=Path, metavar="FILE", help=text)
