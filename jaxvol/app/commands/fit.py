"""`jaxvol fit`: fits a transfer function to images of a volume."""

import argparse
import warnings
from pathlib import Path

from ..._util.checks import output_file
from ..._util.progress import progress
from ...fitting import ImageResidual, fit, flat_grey, read_views, write_transfer
from ...xla.persistent_cache import keep_programs_by_default
from ..picture import background_of, quick_march, volume_of
from .options import Parser, add_clim, add_output, add_quiet, add_sampling, add_volume, refuse_to_replace


def run_fit(options: argparse.Namespace) -> None:
    refuse_to_replace(options, "output", "checkpoint")
    output_file("--output", options.output)
    # checked before the volume is read
    views = read_views(options.images, options.cameras)
    if options.labels is not None:
        raise ValueError("--labels: fit finds one transfer function of the values, not one for each label.")
    keep_programs_by_default()
    background = background_of(options)
    with progress(f"reading {options.file}", quiet=options.quiet):
        volume = volume_of(options)
    step = float(volume.spacing.min()) / 2 if options.step is None else options.step
    march = quick_march(step)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always", UserWarning)
        result = fit(
            ImageResidual(lambda transfer, camera: (volume, transfer, camera, march), views, background),
            flat_grey(volume, options.points, options.clim),
            max_steps=options.max_steps,
            checkpoint=options.checkpoint,
            quiet=options.quiet,
        )
    path = write_transfer(options.output, result.parameters)
    error = (2 * result.loss) ** 0.5
    print(f"{path}: RMSE {error:.5f} in linear RGB after {len(result.losses)} steps. {result.message}")
    for warning in warned:  # of points that the images do not determine
        print(f"{path}: {warning.message}")


def add_fit(parser: Parser) -> None:
    add_volume(parser)
    add_sampling(parser)
    text = "sRGB, as PNG"
    parser.add_argument("--images", type=Path, nargs="+", required=True, metavar="IMAGE", help=text)
    text = "list of an object per image: position, focal_point [view_up, view_angle, parallel_scale, window]"
    parser.add_argument("--cameras", type=Path, required=True, metavar="JSON", help=text)
    add_output(parser, "transfer.json", "JSON to write")
    text = "points of the transfer function, initially flat grey (default: 8)"
    parser.add_argument("--points", type=int, default=8, metavar="N", help=text)
    add_clim(parser)
    parser.add_argument("--max-steps", type=int, default=100, metavar="N", help="at most (default: 100)")
    add_quiet(parser)
    text = "save the fit here as it goes on; resume from here after an interruption"
    parser.add_argument("--checkpoint", type=Path, metavar="FILE", help=text)
