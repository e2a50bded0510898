"""`jaxvol render`, an image of a volume file, and `jaxvol plan`, the cheapest way to it."""

import argparse
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..._util.vec3 import apart
from ...compositing.isosurface import Isosurface
from ...io.display import image_file, save_image
from ...scene.rendering import Rendering
from ...scene.space import enter
from ...scene.transfer import TransferFunction, voxel_size
from .options import SWITCH, add_command, add_output, add_scene
from .recorded import text_of
from .scene import Scene, refuse_to_replace, scene_of, with_march


FAINT = 0.01
"""Opacity that is hardly seen: before white, it changes the 8 bits of a pixel by 1."""


def _render(options: argparse.Namespace) -> None:
    begun = time.perf_counter()
    refuse_to_replace(options, "output", "depth")
    image_file("--output", options.output, 4 if options.transparent else 3)
    if options.depth:
        image_file("--depth", options.depth, 0)
    scene = scene_of(options)
    scene = with_march(scene, options, [scene.camera])
    print(*scene.notes, sep="\n", end="\n" * bool(scene.notes))
    ready = time.perf_counter()
    rendering = scene.render(scene.camera)
    ended = time.perf_counter()
    before = "reading and planning" if options.step is None else "reading"
    steps = f"{before} {ready - begun:.2f} s, compiling and rendering {ended - ready:.2f} s"
    _print_facts(options.output, scene, rendering, f"{ended - begun:.2f} s ({steps})")
    image = rendering.rgba if options.transparent else rendering.image(scene.background)
    is_png = options.output.suffix.lower() == ".png"
    save_image(options.output, image, text=text_of(options, scene.transfer) if is_png else {})
    if options.depth:
        print(f"{save_image(options.depth, rendering.depth)}: distances, world length")
    if why := why_empty(scene, rendering):
        print(f"{options.output}: {why}")


def _print_facts(path: Path, scene: Scene, rendering: Rendering, spent: str) -> None:
    device = jax.devices()[0]
    millions = np.asarray(rendering.samples).sum(dtype=np.int64) / 1e6
    shape = scene.volume.shape if scene.source is None else scene.source.shape
    pixels = rendering.rgba.shape[1::-1]
    print(
        f"{path}: {' x '.join(map(str, pixels))} pixels of {' x '.join(map(str, shape))} voxels, "
        f"{millions:.1f} million samples in {spent}, on {device.device_kind} ({device.platform})"
    )
    if scene.source is not None:
        bricks = rendering.bricks
        counts = " x ".join(map(str, bricks.counts))
        print(f"{path}: {bricks.loads} of {counts} bricks read, {bricks.bytes_read} bytes")
    if np.any(rendering.exhausted):
        print(f"{path}: incomplete: rays used up their {scene.march.most_samples} samples; use a longer step")


def why_empty(scene: Scene, rendering: Rendering) -> str | None:
    """Why an image shows nothing, and what to change; None where a pixel's opacity is above `FAINT`."""
    volume, opacity = scene.source or scene.volume, float(np.asarray(rendering.rgba)[..., 3].max())
    if opacity > FAINT or np.isnan(opacity):
        return None
    if opacity > 0:
        size = f"voxels have the size {voxel_size(volume):.3g}"
        change = f"a shorter --unit-distance ({size}) or another --clim"
        return f"hardly anything is visible: the opacity is at most {opacity:.2g}. Use {change}."
    return f"nothing is visible: {_why_nothing(scene)}"


def _why_nothing(scene: Scene) -> str:
    """Why all pixels are transparent."""
    volume, transfer = scene.volume, scene.transfer
    space, zero = scene.march.locate(volume), jnp.zeros((), jnp.int32)
    lengths = jax.jit(jax.vmap(lambda o, d: enter(space, apart(o), apart(d), (zero, zero)).length))
    if not (lengths(*(each.reshape(-1, 3) for each in scene.camera.rays())) > 0).any():
        bounds = " to ".join(str(np.asarray(corner)) for corner in volume.corners)
        return f"no ray of the camera meets the volume, {bounds}, or what the clip leaves of it."
    data = np.asarray(volume.data)
    low, high = float(data.min()), float(data.max())
    where = f"the volume's values run from {low:g} to {high:g}"
    if isinstance(scene.compositing, Isosurface):
        return f"{where}, and no ray crosses the isosurface's value, {float(scene.compositing.value):g}."
    if not isinstance(transfer, TransferFunction):
        return f"{where}, and the transfer function shows none of those that the rays meet."
    shown = np.flatnonzero(np.asarray(transfer.extinction) > 0)
    if not shown.size:
        return f"{where}, and the transfer function's opacity is 0 everywhere."
    # the opacity of a point extends to its neighbours, that of the first and the last to infinity
    at = [-np.inf, *np.asarray(transfer.values), np.inf]
    return (
        f"{where}, and the transfer function shows values between {at[shown[0]]:g} and "
        f"{at[shown[-1] + 2]:g}. A clim from {low:g} to {high:g} would show something."
    )


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


def _plan(options: argparse.Namespace) -> None:
    if options.step is not None:
        raise ValueError("--step sets the step; jaxvol plan finds one: leave it out.")
    scene = scene_of(options)
    print(*scene.plans([scene.camera], options.tolerance))


def add_plan(commands: Any) -> None:
    text = "show the cheapest way to render a volume file within a tolerance, and why"
    add_scene(add_command(commands, "plan", text, _plan))
