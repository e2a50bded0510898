"""Which options say what a volume file holds, where the file and its name do not?"""

import argparse
from pathlib import Path

from ..formats import load
from ..volume import Volume


def add_data_options(parser: argparse.ArgumentParser) -> None:
    """Add the file and its options to a parser."""
    parser.add_argument(
        "file", type=Path, help="volume: NAME_XxYxZ_TYPE.raw[.gz], .npy, .npz, and more with jaxvol[io]"
    )
    data = parser.add_argument_group("data", "needed if the file and its name do not specify it")
    data.add_argument(
        "--shape", type=int, nargs=3, metavar=("X", "Y", "Z"), help="voxels, x fastest in the file"
    )
    data.add_argument("--dtype", help="such as uint8 or uint16le")
    data.add_argument(
        "--spacing", type=float, nargs=3, metavar=("X", "Y", "Z"), help="world length between voxels"
    )


def volume_of(options: argparse.Namespace) -> Volume:
    """The volume in the file."""
    return load(options.file, shape=options.shape, dtype=options.dtype, spacing=options.spacing)
