"""`jaxvol fit`: a transfer function that makes given images of a volume."""

import argparse
import re
import warnings
from pathlib import Path
from typing import get_args

from ..._util.checks import output_file
from ...fitting import ImageResidual, fit, flat_grey, read_transfer, read_views, write_transfer
from ...fitting.driver import UNDETERMINED, Solver
from ...fitting.uncertainty import Uncertainty
from ...march.march import March
from .data import refuse_to_replace, volume_of
from .frames import FAST
from .options import CLIM, DATA, SAMPLING, Command, Option, grouped, output
from .progress import show_progress
from .scene import background_of


def _fit(options: argparse.Namespace) -> None:
    refuse_to_replace(options, "output", "checkpoint")
    output_file("--output", options.output)
    # these are checked before the volume is read
    views = read_views(options.images, options.cameras)
    start = read_transfer(options.start) if options.start else None
    background = background_of(options)
    with show_progress(f"reading {options.file}"):
        volume = volume_of(options)
    half_a_voxel = float(volume.spacing.min()) / 2
    step = half_a_voxel if options.step is None else options.step
    march = March(step, FAST, "midpoint")
    if start is None:
        start = flat_grey(volume, options.points, options.clim)
    with show_progress("fitting, steps") as report, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=UNDETERMINED)  # reported below, by point
        result = fit(
            ImageResidual(lambda transfer, camera: (volume, transfer, camera, march), views, background),
            start,
            solver=options.solver,
            max_steps=options.max_steps,
            checkpoint=options.checkpoint,
            callback=lambda step, parameters, loss: report(step, options.max_steps),
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


def _undetermined(found: Uncertainty | None) -> list[int]:
    """Points of a transfer function with numbers that the images do not determine."""
    names = [] if found is None else [name for each in found.undetermined for name in each]
    return sorted({int(index) for name in names for index in re.findall(r"\[(\d+)", name)})


_CAMERAS = (
    "a list with one object per image: position, focal_point, and optionally view_up, view_angle, "
    "parallel_scale, window"
)

_CHECKPOINT = "save every step here; resume from here after an interruption"

FIT = Command(
    "fit",
    "fit a transfer function to images of a volume",
    (
        *DATA,
        *SAMPLING,
        Option("images", "sRGB, as PNG", Path, "IMAGE...", required=True),
        Option("cameras", _CAMERAS, Path, "JSON", required=True),
        output("transfer.json", "JSON to write"),
        *grouped(
            "start",
            Option("start", "a transfer function written by this command", Path, "JSON"),
            Option("points", "else, flat grey with this many points", int, default=8),
            CLIM,
        ),
        *grouped(
            "solver",
            Option("solver", "how to minimise", default="levenberg_marquardt", choices=get_args(Solver)),
            Option("max-steps", "at most", int, default=100),
            Option("checkpoint", _CHECKPOINT, Path, "FILE"),
        ),
    ),
    _fit,
)
