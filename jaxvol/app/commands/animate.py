"""`jaxvol animate`: a volume file seen from a camera that turns about it, as GIF, MP4 or a folder of PNGs."""

import argparse
import importlib
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import UInt8

from ..._util.checks import integer, output_file
from ..._util.whole_files import whole_file, whole_folder
from ...io.display import displayed, save_image
from .checksum import checksum
from .frames import frames_of
from .options import add_output, scene_options, view_options
from .orbit import angles_of, axis_of, turned, views_of
from .progress import working
from .recorded import settings_of, text_of, transfer_from_file
from .scene import Scene, scene_of


Picture = UInt8[np.ndarray, "height width 3"]

GIF_FPS = 50
"""Frames a second of a GIF, at most: browsers show those of less than 2/100 s for 10/100 s."""

OWN = frozenset({"frames", "degrees", "fps"})
"""Options that the command render has not."""


def add_animate(commands: Any, shared: argparse.ArgumentParser) -> None:
    """Add the subcommand. `commands`: what `add_subparsers` returned."""
    parser = commands.add_parser(
        "animate",
        parents=[shared, scene_options(), view_options()],
        help="render a volume file from a camera that turns about it",
        description="Render a volume file from a camera that turns about it.",
    )
    kinds = ".gif, .mp4 (needs jaxvol[video]), or a folder, of one .png for each frame"
    add_output(parser, "orbit.gif", f"what to write: {kinds}")
    parser.add_argument("--frames", type=int, default=36, help="number of images (default: 36)")
    parser.add_argument(
        "--degrees", type=float, default=360, help="angle that the camera turns about --axis (default: 360)"
    )
    parser.add_argument("--fps", type=float, default=12, help="frames a second (default: 12)")
    parser.set_defaults(run=_animate)


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
    if kind == ".mp4":
        _check_mp4(options.size)
    scene = scene_of(options)
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
    """The frames, one after the other; written into the folder if one is given."""
    frames = frames_of(options, scene, views_of(options, scene.camera, options.degrees))
    digest = checksum(options.file) if folder else ""
    axis = axis_of(options, scene.camera)
    with working(f"rendering {options.output}, frames") as told:
        for number, angle in enumerate(angles_of(options.degrees, count)):
            image = frames.render(turned(scene.camera, angle, axis)).image(scene.background)
            if folder is not None:
                turn = {"turn": angle, "orbit": options.degrees}
                held = transfer_from_file(options, scene.transfer)
                settings = settings_of(options, OWN) | turn
                text = text_of("render", settings, options.file, digest, held)
                save_image(folder / f"frame_{number:04d}.png", image, text=text)
            yield displayed(np.asarray(image, np.float32))
            told(number + 1, count)


def _write_gif(path: Path, images: Iterator[Picture], fps: float, count: int) -> None:
    """Each frame with 256 colours of its own; it is shown again and again."""
    from PIL import Image

    # frames last whole hundredths of a second: their ends are rounded, so that the whole lasts as it should
    ends = np.round(np.arange(count + 1) * 100 / fps)
    milliseconds = (10 * np.diff(ends)).astype(int).tolist()
    pictures = (Image.fromarray(image).quantize(256) for image in images)
    first = next(pictures)
    first.save(path, save_all=True, append_images=pictures, duration=milliseconds, loop=0, disposal=1)


def _ffmpeg() -> ModuleType:
    try:
        return importlib.import_module("imageio_ffmpeg")
    except ImportError as fault:
        raise ImportError(
            '--output: an .mp4 needs imageio-ffmpeg: pip install "jaxvol[video]". Or write a .gif, or a '
            "folder of PNGs."
        ) from fault


def _check_mp4(size: Any) -> None:
    _ffmpeg()
    if any(side % 2 for side in size):
        raise ValueError(
            f"--size: an .mp4 has an even number of pixels on each side; got {size[0]} {size[1]}."
        )


def _write_mp4(path: Path, images: Iterator[Picture], fps: float) -> None:
    """H.264 with colours at half the resolution, which every player shows."""
    first = next(images)
    height, width, _ = first.shape
    writer = _ffmpeg().write_frames(
        *(str(path), (width, height)),
        fps=fps,
        codec="libx264",
        pix_fmt_out="yuv420p",
        quality=8,
        macro_block_size=2,
        ffmpeg_log_level="error",
    )
    writer.send(None)
    try:
        writer.send(np.ascontiguousarray(first))
        for image in images:
            writer.send(np.ascontiguousarray(image))
    finally:
        writer.close()
