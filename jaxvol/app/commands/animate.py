"""`jaxvol animate`: renders an orbit about a volume to a GIF or MP4."""

import argparse
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import UInt8

from ..._util.checks import Arrayable, integer, output_file
from ..._util.progress import progress
from ..._util.srgb import displayed
from ..._util.whole_files import whole_file
from ...fitting.bijections import RigidMotion
from ...scene.camera import Camera
from ...xla.persistent_cache import keep_programs_by_default
from ..picture import scene_of, with_march
from ..show import why_empty
from .options import Parser, add_option, add_output, add_scene


FRAMED_VIEWS, PLANNED_VIEWS = 24, 4  # evenly spaced views to frame the camera and to plan the march


def run_animate(options: argparse.Namespace) -> None:
    count = integer("--frames", options.frames, 1, 2**20)
    path = output_file("--output", options.output)
    kind = path.suffix.lower()
    if kind not in (".gif", ".mp4"):
        raise ValueError(f"--output: must end in .gif or .mp4; got {path}.")
    fastest = 50 if kind == ".gif" else 240  # browsers show GIF frames of less than 2/100 s for 10/100 s
    if not 0.01 <= options.fps <= fastest:
        raise ValueError(f"--fps of a {kind} must be from 0.01 to {fastest}; got {options.fps:g}.")
    if kind == ".mp4" and any(n % 2 for n in options.size):
        raise ValueError(f"--size of an .mp4 must be even; got {' x '.join(map(str, options.size))}.")
    if kind == ".mp4" and find_spec("imageio_ffmpeg") is None:
        raise ImportError('--output: an .mp4 needs imageio-ffmpeg: pip install "jaxvol[video]".')

    def views(camera: Camera, count: int) -> list[Camera]:
        axis = camera.view_up if options.axis is None else options.axis
        return [turned(camera, angle, axis) for angle in angles_of(options.degrees, count)]

    keep_programs_by_default()
    scene = scene_of(options, lambda camera: views(camera, FRAMED_VIEWS))
    begun = time.perf_counter()
    scene = with_march(scene, options, views(scene.camera, PLANNED_VIEWS))
    empty: list[str | None] = []

    def image_of(camera: Camera) -> UInt8[np.ndarray, "height width 3"]:
        rendering = scene.render(camera)
        empty.append(why_empty(scene, rendering))
        return displayed(np.asarray(rendering.image(scene.background), np.float32))

    with progress("drawing", count, quiet=options.quiet) as drawn, whole_file(path) as part:
        write = _write_gif if kind == ".gif" else _write_mp4
        images = map(image_of, views(scene.camera, count))
        write(part, (image for image in images if drawn() or True), options.fps)
    took = time.perf_counter() - begun
    print(f"{path}: {count} frames of {' x '.join(map(str, options.size))} pixels in {took:.1f} s")
    if all(empty):
        print(f"{path}: {empty[0]}")


def turned(camera: Camera, degrees: float, axis: Arrayable) -> Camera:
    """The camera turned about an axis through its focal point."""
    axis = np.asarray(axis, float)
    if not np.isfinite(axis).all() or not axis.any():
        raise ValueError(f"--axis must not be 0; got {' '.join(map(str, axis))}.")
    turn = np.deg2rad(degrees) * axis / np.linalg.norm(axis)
    return eqx.filter_jit(RigidMotion.camera)(RigidMotion(turn, np.zeros(3), camera.focal_point), camera)


def angles_of(degrees: float, frames: int) -> list[float]:
    """Evenly spaced angles from 0 to `degrees`; of full turns, to one frame before `degrees`."""
    closed = degrees % 360 == 0
    return [degrees * i / max(frames if closed else frames - 1, 1) for i in range(frames)]


def _write_gif(path: Path, images: Iterator[UInt8[np.ndarray, "height width 3"]], fps: float) -> None:
    """Write a GIF: 256 colours per frame, durations in hundredths of a second."""
    from PIL import Image

    pictures: Any = (Image.fromarray(image).quantize(256) for image in images)
    duration = 10 * round(100 / fps)
    next(pictures).save(path, save_all=True, append_images=pictures, duration=duration, loop=0, disposal=1)


def _write_mp4(path: Path, images: Iterator[UInt8[np.ndarray, "height width 3"]], fps: float) -> None:
    """Write H.264 with half the resolution for colours, which every player shows."""
    from imageio.v3 import imopen

    kwargs: dict[str, Any] = {"codec": "libx264", "pixelformat": "yuv420p", "quality": 8, "fps": fps}
    with imopen(path, "w", plugin="FFMPEG", legacy_mode=True) as opened:
        file: Any = opened
        file.write(images, is_batch=True, ffmpeg_log_level="error", macro_block_size=2, **kwargs)


def add_animate(parser: Parser) -> None:
    add_scene(parser)
    add_output(parser, "orbit.gif", "what to write: .gif, or .mp4, which needs jaxvol[video]")
    text = "axis that the camera turns about, through its focal point (default: --view-up)"
    add_option(parser, "--axis", "X Y Z", text)
    add_option(parser, "--frames", "N", "number of images (default: 36)", type=int, default=36)
    add_option(parser, "--degrees", "ANGLE", "angle of the turn about --axis (default: 360)", default=360.0)
    add_option(parser, "--fps", "FPS", "frames a second (default: 12)", default=12.0)
