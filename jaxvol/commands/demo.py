"""`jaxvol demo`: what the toolkit does, on one page."""

import argparse
from pathlib import Path
from typing import Any

from .._util.checks import output_file
from ..camera import Camera
from ..display import save_image
from ..lighting import Phong
from ..march import March
from ..modes import compositing_of
from ..phantoms import phantom
from ..presets import preset
from ..transfer import TransferFunction
from ..transforms.alpha_correction import AlphaCorrection
from .frames import FAST, Frames
from .recorded import settings_of, text_of
from .render import rendered


def add_demo(commands: Any, shared: argparse.ArgumentParser) -> None:
    """Add the subcommand. `commands`: what `add_subparsers` returned."""
    parser = commands.add_parser(
        "demo", parents=[shared], help="render a built-in head, and the effect of one transform"
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("jaxvol-demo"), metavar="FOLDER")
    parser.add_argument("--size", type=int, nargs=2, default=(512, 512), metavar=("W", "H"), help="pixels")
    parser.add_argument("--resolution", type=int, default=320, help="voxels per axis of the phantom")
    parser.set_defaults(run=_demo)


def _demo(options: argparse.Namespace) -> None:
    size = tuple(options.size)
    output_file("--output", options.output / "head.png")
    text = text_of("demo", settings_of(options))
    head = phantom("head", options.resolution)
    camera = Camera.looking_at(head, (0.65, -1, 0.15), size=size).zoom(1.45)
    # steps of half a voxel would leave rings on the crown
    march = March(float(head.spacing[0]) / 6, FAST, "midpoint")
    over = compositing_of("over")
    path = options.output / "head.png"
    image = rendered(Frames(head, preset("head", unit_distance=0.01), march, over, Phong()), camera, path)
    save_image(path, image.image((1, 1, 1)), text=text)

    # A translucent cube at a far too long step: each ray's last cell reaches past the cube by a different
    # fraction of a step, which shows as terraces unless the cell is cut at the exit.
    cube = phantom("linear", 64)
    transfer = TransferFunction.from_points([(0, (0.9, 0.35, 0.1), 0.45), (1, (0.15, 0.35, 0.9), 0.45)])
    camera = Camera.looking_at(cube, (-0.6, 0.5, -1), (0, 1, 0), size=size).zoom(1.3)
    for name, transforms in (("before", ()), ("after", (AlphaCorrection(),))):
        path = options.output / f"{name}.png"
        image = rendered(Frames(cube, transfer, March(0.25, transforms), over, None), camera, path)
        save_image(path, image.image((0, 0, 0)), text=text)
