"""`jaxvol warm`: compiles the programs of usual pictures, and keeps them for later processes."""

import argparse
from argparse import Namespace
from typing import Any

import jax
import numpy as np

from ..._util.progress import progress
from ...compositing.modes import MODES
from ...io.phantoms import phantom
from ...render import render
from ...scene.transfer import Transfer
from ...scene.volume import Volume
from ...xla.persistent_cache import keep_programs
from ..picture import PictureRequest, scene_of, with_march
from ..settings import DEFAULTS
from .options import Parser, add_quiet, add_size


KINDS: dict[str, dict[str, Any]] = {
    "lit": {},
    "not lit": {"shade": False},
    "by a step": {"step": 0.02},
    "orthographic": {"parallel": True},
    "a preset": {"preset": "engine"},
    "clipped": {"clip_box": (-0.5, 1.0, -1.0, 1.0, -1.0, 1.0)},
    **{name: {"compositing": name} for name in MODES if name != "over"},
    "isosurface": {"compositing": "isosurface", "isovalue": 60.0},
}
"""Pictures of 8-bit voxels: name, and options of `jaxvol render`."""

TYPES = np.int16, np.float32  # more types of voxels, for the first kind of picture
RESOLUTION = 64  # voxels along each axis


def run_warm(options: argparse.Namespace) -> None:
    folder = keep_programs()
    head = phantom("head", RESOLUTION)
    pictures = {name: (head, settings) for name, settings in KINDS.items()}
    for kind in TYPES:
        volume = Volume(np.asarray(head.data, kind), head.spacing, head.origin)
        pictures[f"of {np.dtype(kind).name}"] = volume, {}
    with progress("compiling", len(pictures) + 1, quiet=options.quiet) as done:
        for name, (volume, settings) in pictures.items():
            scene = _drawn(volume, tuple(options.size), **settings)
            print(f"{name}: {scene.march.quadrature}, {len(scene.march.transforms)} transforms", flush=True)
            done()
        scene = _drawn(head, tuple(options.size), shade=False)

        def mean(transfer: Transfer) -> Any:
            return render(scene.volume, transfer, scene.camera, scene.march).image(scene.background).mean()

        jax.block_until_ready(jax.grad(mean)(scene.transfer))
        print("gradient of the transfer function", flush=True)
        done()
    files = [file for file in folder.iterdir() if file.is_file()]
    print(f"{folder}: {len(files)} files, {sum(file.stat().st_size for file in files) / 1e6:.1f} MB")


def _drawn(volume: Volume, size: tuple[int, ...], **settings: Any) -> PictureRequest:
    """The scene of the settings, rendered once."""
    settings |= {"quiet": True, "size": size, "recorded_transfer": None, "file": volume}
    options = Namespace(**DEFAULTS | settings)
    scene = with_march(scene_of(options), options)
    scene.render(scene.camera)
    return scene


def add_warm(parser: Parser) -> None:
    add_size(parser)
    add_quiet(parser)
