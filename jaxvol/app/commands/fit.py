"""`jaxvol fit`: a transfer function that makes given images of a volume."""

import argparse
import re
import sys
import warnings
from pathlib import Path
from typing import Any

from ..._util.checks import output_file
from ...fitting import ImageResidual, fit, flat_grey, read_views, write_transfer
from ...fitting.driver import UNDETERMINED
from ...fitting.uncertainty import Uncertainty
from ...march.march import March
from .data import refuse_to_replace, volume_of
from .frames import FAST
from .options import add_clim, add_command, add_output, add_sampling, add_volume
from .scene import background_of


def _fit(options: argparse.Namespace) -> None:
    refuse_to_replace(options, "output", "checkpoint")
    output_file("--output", options.output)
    # these are checked before the volume is read
    views = read_views(options.images, options.cameras)
    background = background_of(options)
    volume = volume_of(options)
    step = float(volume.spacing.min()) / 2 if options.step is None else options.step
    march = March(step, FAST, "midpoint")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=UNDETERMINED)  # reported below, by point
        result = fit(
            ImageResidual(lambda transfer, camera: (volume, transfer, camera, march), views, background),
            flat_grey(volume, options.points, options.clim),
            max_steps=options.max_steps,
            checkpoint=options.checkpoint,
            callback=_show_step if sys.stderr.isatty() else None,
        )
    path = write_transfer(options.output, result.parameters)
    error = (2 * result.loss) ** 0.5
    print(f"{path}: RMSE {error:.5f} in linear RGB after {len(result.losses)} steps. {result.message}")
    if points := _undetermined(result.uncertainty):
        values = ", ".join(f"{float(result.parameters.values[point]):g}" for point in points)
        print(
            f"{path}: what the images do not determine is arbitrary: colours or extinction of "
            f"{len(points)} of {len(result.parameters.values)} points, those of the values {values}"
        )


def _show_step(step: int, parameters: Any, loss: float) -> None:
    print(f"\rstep {step}, loss {loss:.4g}", end="", file=sys.stderr, flush=True)


def _undetermined(found: Uncertainty | None) -> list[int]:
    """Points of a transfer function with numbers that the images do not determine."""
    names = [] if found is None else [name for each in found.undetermined for name in each]
    return sorted({int(index) for name in names for index in re.findall(r"\[(\d+)", name)})


def add_fit(commands: Any) -> None:
    parser = add_command(commands, "fit", "fit a transfer function to images of a volume", _fit)
    add_volume(parser)
    add_sampling(parser)
    parser.add_argument("--images", type=Path, nargs="+", metavar="IMAGE", help="sRGB, as PNG")
    text = (
        "a list with one object per image: position, focal_point, and optionally view_up, view_angle, "
        "parallel_scale, window"
    )
    parser.add_argument("--cameras", type=Path, metavar="JSON", help=text)
    add_output(parser, "transfer.json", "JSON to write")
    text = "of the transfer function, flat grey at first (default: 8)"
    parser.add_argument("--points", type=int, default=8, metavar="N", help=text)
    add_clim(parser)
    parser.add_argument("--max-steps", type=int, default=100, metavar="N", help="at most (default: 100)")
    text = "save every step here; resume from here after an interruption"
    parser.add_argument("--checkpoint", type=Path, metavar="FILE", help=text)
