"""`jaxvol demo`: what the toolkit does, on one page."""

import argparse
import time
import warnings
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.ndimage import gaussian_filter

from .._util.checks import output_file
from .._util.whole_files import whole_folder
from ..camera import Camera
from ..display import save_image
from ..fitting import Fit, ImageResidual, fit, flat_grey
from ..lighting import Phong
from ..march import March
from ..modes import compositing_of
from ..phantoms import phantom
from ..presets import preset
from ..rendering import Rendering
from ..transfer import TransferFunction
from ..transforms.alpha_correction import AlphaCorrection
from ..volume import Volume
from .demo_page import page
from .frames import FAST, Frames
from .options import add_output, add_size
from .progress import working
from .recorded import settings_of, text_of
from .render import rendered


OVER = compositing_of("over")


def add_demo(commands: Any, shared: argparse.ArgumentParser) -> None:
    """Add the subcommand. `commands`: what `add_subparsers` returned."""
    text = "Render a shaded head, wood grain before and after, and a fit by gradients, and a page of them."
    parser = commands.add_parser(
        "demo", parents=[shared], help="show what the toolkit does", description=text
    )
    add_output(parser, "jaxvol-demo", "where to write", "FOLDER")
    add_size(parser)
    parser.add_argument("--resolution", type=int, default=320, help="voxels per axis of the head")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS), help="some of the pictures")
    parser.set_defaults(run=_demo)


def _demo(options: argparse.Namespace) -> None:
    output_file("--output", options.output / "index.html")
    text = text_of("demo", settings_of(options))

    def save(name: str, image: Float[Array, "height width 3"]) -> None:
        save_image(folder / f"{name}.png", image, text=text)

    with whole_folder(options.output) as folder:
        said: dict[str, str] = {}
        for part in options.only:
            said |= PARTS[part](options, save)
        (folder / "index.html").write_text(
            page(said, options.resolution, tuple(options.size)), encoding="utf-8"
        )
    print(f"open {options.output / 'index.html'}")


Save = Callable[[str, Float[Array, "height width 3"]], None]
"""Writes a picture under a name."""


def _image(options: argparse.Namespace, name: str, frames: Frames, camera: Camera) -> Rendering:
    return rendered(frames, camera, options.output / f"{name}.png")


def _head(options: argparse.Namespace, save: Save) -> dict[str, str]:
    with working("making a head"):
        head = _smooth(phantom("head", options.resolution))
    camera = Camera.looking_at(head, (0.65, -1, 0.15), size=tuple(options.size)).zoom(1.65)
    look = preset("head", (0, SCALE * 255), unit_distance=0.01)
    march = March(float(head.spacing[0]) / 3, FAST, "preintegrated")
    begun = time.perf_counter()
    image = _image(options, "head", Frames(head, look, march, OVER, Phong()), camera)
    save("head", image.image((1, 1, 1)))
    return {"head": f"{time.perf_counter() - begun:.1f} s, compilation included"}


BLUR = 1.5
"""Standard deviation of the Gaussian, voxels."""

SCALE = 128
"""Levels of a smoothed voxel for each level of an 8-bit one."""


def _smooth(volume: Volume) -> Volume:
    """The volume, smoothed by a Gaussian. A border that is one voxel wide has normals that follow the grid,
    and shaded it shows rings."""
    data = gaussian_filter(SCALE * np.asarray(volume.data, np.float32), BLUR)
    return Volume(np.round(data).astype(np.uint16), volume.spacing, volume.origin)


def _grain(options: argparse.Namespace, save: Save) -> dict[str, str]:
    # A translucent cube at a far too long step: each ray's last cell reaches past the cube by a different
    # fraction of a step, which shows as terraces unless the cell is cut at the exit.
    cube = phantom("linear", 64)
    transfer = TransferFunction.from_points([(0, (0.9, 0.35, 0.1), 0.45), (1, (0.15, 0.35, 0.9), 0.45)])
    camera = Camera.looking_at(cube, (-0.6, 0.5, -1), (0, 1, 0), size=tuple(options.size)).zoom(1.05)
    for name, transforms in (("before", ()), ("after", (AlphaCorrection(),))):
        image = _image(options, name, Frames(cube, transfer, March(0.25, transforms), OVER, None), camera)
        save(name, image.image((0, 0, 0)))
    return {"before": "", "after": ""}


VIEWS = (0.5, -1, 0.4), (-1, -0.3, 0.5)
"""Directions of the images that the fit sees."""

HELD_OUT = (0.8, 0.9, 0.7)

FITTED = 48
"""Voxels along each axis of what is fitted, and pixels along each side of the images."""


def _fit(options: argparse.Namespace, save: Save) -> dict[str, str]:
    engine = phantom("engine", FITTED)
    true = preset("engine", unit_distance=0.04)
    march = March(float(engine.spacing[0]) / 2, FAST, "midpoint")
    cameras = [Camera.looking_at(engine, side, size=(FITTED, FITTED)).zoom(1.4) for side in VIEWS]
    frames = Frames(engine, true, march, OVER, None)
    views = [(camera, frames.render(camera).image((1, 1, 1))) for camera in cameras]
    start = flat_grey(engine, points=8)
    begun = time.perf_counter()
    with working("fitting a transfer function, steps") as told, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # two images do not determine the colours of what is transparent
        found: Fit = fit(
            ImageResidual(lambda transfer, camera: (engine, transfer, camera, march), views),
            start,
            max_steps=STEPS,
            callback=lambda step, *_: told(step, STEPS),
        )
    took = time.perf_counter() - begun
    there = Camera.looking_at(engine, HELD_OUT, size=tuple(options.size)).zoom(1.4)
    looks = {"fit_start": start, "fit_found": found.parameters, "fit_true": true}
    images = {
        name: _image(options, name, frames._replace(transfer=look), there) for name, look in looks.items()
    }
    shown = {name: image.image((1, 1, 1)) for name, image in images.items()}
    for name, image in shown.items():
        save(name, image)
    error = {
        name: float(jnp.sqrt(jnp.mean((image - shown["fit_true"]) ** 2))) for name, image in shown.items()
    }
    said = f"{len(found.losses)} steps in {took:.1f} s, compilation included; "
    said += f"RMSE of this view {error['fit_start']:.3f} at the start, {error['fit_found']:.4f} at the end"
    print(f"{options.output / 'fit_found.png'}: {said}")
    return {"fit_start": "", "fit_found": said, "fit_true": ""}


STEPS = 12

PARTS: dict[str, Callable[[argparse.Namespace, Save], dict[str, str]]] = {
    "head": _head,
    "grain": _grain,
    "fit": _fit,
}
"""Makes each part's pictures; returns their names, with what they took."""
