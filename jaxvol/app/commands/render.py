"""`jaxvol render`: renders a volume file. `jaxvol plan`: prints the cheapest march within a tolerance."""

import argparse
import time
from pathlib import Path

import jax
import numpy as np

from ..._util.progress import progress
from ..._util.srgb import displayed
from ...io.display import image_file, save_image
from ...scene.labels import LabelTransferFunction
from ...scene.rendering import Rendering
from ...scene.volume import Volume
from ...xla.persistent_cache import keep_programs_by_default
from ..picture import PictureRequest, scene_of, with_march
from ..recorded import text_of_options
from ..show import why_empty
from .options import SWITCH, Parser, add_output, add_scene, refuse_to_replace


def run_render(options: argparse.Namespace) -> None:
    begun = time.perf_counter()
    refuse_to_replace(options, "output", "depth")
    image_file("--output", options.output, 4 if options.transparent else 3)
    if options.depth:
        image_file("--depth", options.depth, 0)
    keep_programs_by_default()
    scene = with_march(scene_of(options), options)
    ready = time.perf_counter()
    rendering = scene.picture(options.quiet)
    ended = time.perf_counter()
    before = "reading and planning" if options.step is None else "reading"
    steps = f"{before} {ready - begun:.2f} s, compiling and rendering {ended - ready:.2f} s"
    _print_facts(options.output, scene, rendering, f"{ended - begun:.2f} s ({steps})")
    if isinstance(scene.transfer, LabelTransferFunction):
        print(f"{options.output}: {legend(scene.volume, scene.transfer)}")
    image = rendering.rgba if options.transparent else rendering.image(scene.background)
    is_png = options.output.suffix.lower() == ".png"
    save_image(options.output, image, text=text_of_options(options, scene.transfer) if is_png else {})
    if options.depth:
        print(f"{save_image(options.depth, rendering.depth)}: distances, world length")
    if reason := why_empty(scene, rendering):
        print(f"{options.output}: {reason}")


def legend(volume: Volume, transfer: LabelTransferFunction) -> str:
    """Text of a volume's labels with their colours."""
    kinds = np.unique(np.asarray(volume.labels))
    colors = displayed(np.asarray(transfer.stacked.colors, np.float32)[None, :, -1])[0]
    ids = volume.label_ids or range(256)
    texts = [f"{ids[kind]} #{bytes(colors[kind]).hex()}" for kind in kinds.tolist() if 0 < kind < len(colors)]
    return f"labels {', '.join(texts[:24])}{', …' * (len(texts) > 24)}"


def _print_facts(path: Path, scene: PictureRequest, rendering: Rendering, spent: str) -> None:
    device = jax.devices()[0]
    millions = np.asarray(rendering.samples).sum(dtype=np.int64) / 1e6
    pixels, shape = rendering.rgba.shape[1::-1], scene.volume.shape
    print(
        f"{path}: {' x '.join(map(str, pixels))} pixels of {' x '.join(map(str, shape))} voxels, "
        f"{millions:.1f} million samples in {spent}, on {device.device_kind} ({device.platform})"
    )
    if np.asarray(rendering.exhausted).any():
        print(f"{path}: incomplete: rays used up their {scene.march.most_samples} samples; use a longer step")


def add_render(parser: Parser) -> None:
    add_scene(parser)
    text = "image to write: .png (with its options: see --like), .jpg, .tif or .npy (linear float32)"
    add_output(parser, "out.png", text)
    text = "write opacity instead of a background: .png (straight alpha), .tif or .npy (premultiplied)"
    parser.add_argument("--transparent", action=SWITCH, default=False, help=text)
    text = "also write depth, the (mean) distance to what is visible, else infinite: .npy or .tif, float32"
    parser.add_argument("--depth", type=Path, metavar="FILE", help=text)


def run_plan(options: argparse.Namespace) -> None:
    if options.step is not None:
        raise ValueError("--step sets the step; jaxvol plan finds one: leave it out.")
    keep_programs_by_default()
    scene = scene_of(options)
    with progress("planning", quiet=options.quiet):
        plans = scene.plans([scene.camera], options.tolerance)
    print(*plans)


def add_plan(parser: Parser) -> None:
    add_scene(parser)
