"""`jaxvol render`: an image of a volume file."""

import argparse
import time
from pathlib import Path

import jax
import numpy as np

from ...io.display import image_file, save_image
from ...scene.camera import Camera
from ...scene.rendering import Rendering
from ..empty_image import why_empty
from .data import refuse_to_replace
from .frames import Frames, frames_of
from .options import SCENE, Command, Option, output
from .orbit import angles_of
from .progress import show_progress
from .recorded import text_of
from .scene import Scene, scene_of


PLANNED_VIEWS = 4
"""Views of an orbit, evenly spaced, for which its march is planned."""


def render_command(options: argparse.Namespace) -> None:
    """Render an image, and write it."""
    begun = time.perf_counter()
    refuse_to_replace(options, "output", "depth")
    image_file("--output", options.output, 4 if options.transparent else 3)
    if options.depth:
        image_file("--depth", options.depth, 0)
    scene = scene_of(options, turn=options.turn, orbit=options.orbit)
    camera = scene.view(options.turn)
    views = [camera] if options.orbit is None else orbit_views(scene, options.orbit)
    frames = frames_of(options, scene, views)
    ready = time.perf_counter()
    with show_progress(f"compiling and rendering {options.output}") as report:
        rendering = frames.render(camera, report)
    ended = time.perf_counter()
    before = "reading and planning" if options.step is None else "reading"
    steps = f"{before} {ready - begun:.2f} s, compiling and rendering {ended - ready:.2f} s"
    _print_facts(options.output, frames, rendering, f"{ended - begun:.2f} s ({steps})")
    image = rendering.rgba if options.transparent else rendering.image(scene.background)
    text = {}
    if options.output.suffix.lower() == ".png":
        text = text_of(RENDER.options, vars(options), scene.transfer)
    save_image(options.output, image, text=text)
    if options.depth:
        print(f"{save_image(options.depth, rendering.depth)}: distances, world length")
    if scene.source is None:
        why = why_empty(frames.volume, scene.transfer, camera, frames.march, rendering, scene.compositing)
        if why is not None:
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
        if frames.volume.shape != shape:
            copy = " x ".join(map(str, frames.volume.shape))
            what = "transfer function, view, step"
            print(f"{path}: what was not given ({what}) was chosen by {copy} of the voxels")
    if np.any(rendering.exhausted):
        print(
            f"{path}: incomplete: rays used up their {frames.march.most_samples} samples; use a longer step"
        )


def orbit_views(scene: Scene, degrees: float) -> list[Camera]:
    """Views for which the march of an orbit is planned: the same for all of its frames."""
    return [scene.view(angle) for angle in angles_of(degrees, PLANNED_VIEWS)]


_OUTPUT = (
    "image to write: .png or .jpg (sRGB, 8 bits), .tif or .npy (linear float32). A .png holds the options "
    "that made it: see --like"
)

_TRANSPARENT = "write opacity instead of a background: .png (straight alpha), .tif or .npy (premultiplied)"

_DEPTH = "also write depth, the (mean) distance to what is visible, else infinite: .npy or .tif, float32"

_ORBIT = "plan for all of an orbit of so many degrees, as jaxvol animate does"

RENDER = Command(
    "render",
    "render a volume file to an image",
    (
        *SCENE,
        output("out.png", _OUTPUT),
        Option("transparent", _TRANSPARENT, bool, default=False),
        Option("depth", _DEPTH, Path, "FILE"),
        Option("turn", "turn the camera about --axis", float, "DEGREES", 0.0),
        Option("orbit", _ORBIT, float, "DEGREES"),
    ),
    render_command,
)
