"""`jaxvol animate`: a volume file seen from a camera that turns about it, as GIF, MP4 or a folder of PNGs."""

import argparse
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from ..._util.checks import integer, output_file
from ..._util.whole_files import whole_file, whole_folder
from ...io.display import displayed, save_image
from .frames import frames_of
from .options import SCENE, Command, Option, output
from .orbit import angles_of
from .progress import show_progress
from .recorded import checksum, text_of
from .render import RENDER, orbit_views
from .scene import Scene, scene_of


Picture = UInt8[np.ndarray, "height width 3"]

GIF_FPS = 50
"""Frames a second of a GIF, at most: browsers show those of less than 2/100 s for 10/100 s."""


def _animate(options: argparse.Namespace) -> None:
    count = integer("--frames", options.frames, 1)
    if not 0 < options.fps <= 240:
        raise ValueError(f"--fps must be above 0, and 240 at most; got {options.fps:g}.")
    folder = options.output.is_dir()
    output_file("--output", options.output / "frame_0000.png" if folder else options.output)
    kind = "" if folder else options.output.suffix.lower()
    if kind not in ("", ".gif", ".mp4"):
        raise ValueError(f"--output: must end in .gif or .mp4, or be a folder; got {options.output}.")
    if not kind and options.output.is_file():
        raise ValueError(f"--output: {options.output} is a file, and no folder for frames.")
    if kind == ".gif" and options.fps > GIF_FPS:
        raise ValueError(
            f"--fps: a .gif has {GIF_FPS} frames a second at most; got {options.fps:g}. Write an .mp4."
        )
    if kind == ".mp4" and find_spec("imageio_ffmpeg") is None:
        raise ImportError(
            '--output: an .mp4 needs imageio-ffmpeg: pip install "jaxvol[video]". Or write a .gif, or a '
            "folder of PNGs."
        )
    if kind == ".mp4" and any(side % 2 for side in options.size):
        width, height = options.size
        raise ValueError(f"--size: an .mp4 has an even number of pixels on each side; got {width} {height}.")
    scene = scene_of(options, orbit=options.degrees)
    begun = time.perf_counter()
    with whole_folder(options.output) if not kind else whole_file(options.output) as part:
        images = _images(options, scene, count, part if not kind else None)
        if kind == ".gif":
            _write_gif(part, images, options.fps, count)
        elif kind == ".mp4":
            _write_mp4(part, images, options.fps)
        else:
            for _ in images:
                pass
    took = time.perf_counter() - begun
    print(f"{options.output}: {count} frames of {' x '.join(map(str, options.size))} pixels in {took:.1f} s")


def _images(options: argparse.Namespace, scene: Scene, count: int, folder: Path | None) -> Iterator[Picture]:
    """The frames, one after the other; written into the folder if one is given, each with the options by
    which `jaxvol render` makes it."""
    frames = frames_of(options, scene, orbit_views(scene, options.degrees))
    sha256 = checksum(options.file) if folder else None
    with show_progress(f"rendering {options.output}, frames") as report:
        for number, angle in enumerate(angles_of(options.degrees, count)):
            image = frames.render(scene.view(angle)).image(scene.background)
            if folder is not None:
                settings = vars(options) | {"turn": angle, "orbit": options.degrees}
                text = text_of(RENDER.options, settings, scene.transfer, sha256)
                save_image(folder / f"frame_{number:04d}.png", image, text=text)
            yield displayed(np.asarray(image, np.float32))
            report(number + 1, count)


def _write_gif(path: Path, images: Iterator[Picture], fps: float, count: int) -> None:
    """Each frame with 256 colours of its own; it is shown again and again."""
    from PIL import Image

    # frames last whole hundredths of a second: their ends are rounded, so that the whole lasts as it should
    ends = np.round(np.arange(count + 1) * 100 / fps)
    milliseconds = (10 * np.diff(ends)).astype(int).tolist()
    pictures = (Image.fromarray(image).quantize(256) for image in images)
    first = next(pictures)
    first.save(path, save_all=True, append_images=pictures, duration=milliseconds, loop=0, disposal=1)


def _write_mp4(path: Path, images: Iterator[Picture], fps: float) -> None:
    """H.264 with colours at half the resolution, which every player shows."""
    from imageio.v3 import imopen

    how: dict[str, Any] = {"codec": "libx264", "pixelformat": "yuv420p", "quality": 8, "macro_block_size": 2}
    with imopen(path, "w", plugin="FFMPEG", legacy_mode=True) as opened:
        file: Any = opened
        file.write(images, is_batch=True, fps=fps, ffmpeg_log_level="error", **how)


_OUTPUT = "what to write: .gif, .mp4 (needs jaxvol[video]), or a folder, of one .png for each frame"

ANIMATE = Command(
    "animate",
    "render a volume file from a camera that turns about it",
    (
        *SCENE,
        output("orbit.gif", _OUTPUT),
        Option("frames", "number of images", int, default=36),
        Option("degrees", "angle that the camera turns about --axis", float, default=360.0),
        Option("fps", "frames a second", float, default=12.0),
    ),
    _animate,
)
