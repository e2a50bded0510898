"""`jaxvol warm`: compiles the programs of usual pictures, and keeps them for the processes to come."""

import argparse
from argparse import Namespace
from typing import Any

import jax
import numpy as np

from ...io.phantoms import phantom
from ...render import render
from ...scene.volume import Volume
from ...xla.persistent_cache import keep_programs
from ..picture import Scene, scene_of, with_march
from ..progress import progress
from ..settings import DEFAULTS
from .options import Parser, add_quiet, add_size


KINDS: dict[str, dict[str, Any]] = {
    "lit": {},
    "not lit": {"shade": False},
    "by a step": {"step": 0.02},
    "orthographic": {"parallel": True},
    "a preset": {"preset": "engine"},
    "clipped": {"clip_box": (-0.5, 1.0, -1.0, 1.0, -1.0, 1.0)},
    "maximum": {"compositing": "maximum"},
    "minimum": {"compositing": "minimum"},
    "average": {"compositing": "average"},
    "X-ray": {"compositing": "integral"},
    "isosurface": {"compositing": "isosurface", "isovalue": 60.0},
}
"""Pictures of 8-bit voxels, by what they show: options of `jaxvol render`."""

TYPES = np.int16, np.float32
"""Other types of voxels, of which the first kind is drawn."""

RESOLUTION = 64
"""Voxels along each axis."""


def _warm(options: argparse.Namespace) -> None:
    folder = keep_programs()
    head = phantom("head", RESOLUTION)
    others = [Volume(np.asarray(head.data, kind), head.spacing, head.origin) for kind in TYPES]
    pictures = {name: (head, how) for name, how in KINDS.items()}
    pictures |= {f"of {np.dtype(t).name}": (each, {}) for t, each in zip(TYPES, others, strict=True)}
    with progress("compiling", len(pictures) + 1, quiet=options.quiet) as done:
        for name, (volume, how) in pictures.items():
            scene = _drawn(volume, tuple(options.size), **how)
            print(f"{name}: {scene.march.quadrature}, {len(scene.march.transforms)} transforms", flush=True)
            done()
        scene = _drawn(head, tuple(options.size), shade=False)
        jax.block_until_ready(jax.grad(lambda transfer: _mean(scene, transfer))(scene.transfer))
        print("gradient of the transfer function", flush=True)
        done()
    files = [file for file in folder.iterdir() if file.is_file()]
    print(f"{folder}: {len(files)} files, {sum(file.stat().st_size for file in files) / 1e6:.1f} MB")


def _drawn(volume: Volume, size: tuple[int, ...], **how: Any) -> Scene:
    """A scene that was rendered once."""
    given = {"quiet": True, "size": size, "recorded_transfer": None, "file": volume}
    chosen = Namespace(**DEFAULTS | how | given)
    scene = scene_of(chosen)
    scene = with_march(scene, chosen, [scene.camera])
    scene.render(scene.camera)
    return scene


def _mean(scene: Scene, transfer: Any) -> Any:
    return render(scene.volume, transfer, scene.camera, scene.march).image(scene.background).mean()


def add_warm(parser: Parser) -> None:
    parser.set_defaults(execute=_warm)
    add_size(parser)
    add_quiet(parser)
