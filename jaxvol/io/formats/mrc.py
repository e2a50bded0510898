"""Reads MRC and CCP4 maps of electron microscopy with mrcfile."""

import warnings
from pathlib import Path

import numpy as np

from ..._util.files import file_size, library, refusing
from ..._util.image_record import ImageRecord


ENDINGS = (".mrc", ".map", ".ccp4", ".rec")


def read_mrc(path: Path) -> ImageRecord:
    """Reader, in ångström. Axes are those of MAPC, MAPR, MAPS; the place is `origin`, or else that of the
    numbers of the first column, row and section."""
    size = file_size(path)
    with path.open("rb") as stream:
        extended = stream.read(96)[92:]
    if min(int.from_bytes(extended, order) for order in ("little", "big")) > size:  # which mrcfile would take
        raise ValueError(f"path: {path} is cut short: its extended header is longer than its {size} bytes.")
    with refusing(path), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        file = library("mrcfile", path).mmap(path, permissive=True)
        if file.data is None or file.data.ndim not in (3, 4) or file.data.dtype.kind not in "iuf":
            raise ValueError("cut short, or no 3-D image of numbers")
        header, data = file.header, file.data
        order = [int(header[name]) for name in ("maps", "mapr", "mapc")]
        order = order if sorted(order) == [1, 2, 3] else [3, 2, 1]
        axes = "t" * (data.ndim - 3) + "".join("xyz"[number - 1] for number in order)
        lengths, counts = (
            [float(part[axis]) for axis in part.dtype.names] for part in (header.cella, header[list(COUNTS)])
        )
        steps = {
            a: length / n for a, length, n in zip("xyz", lengths, counts, strict=True) if length > 0 and n > 0
        }
        origin = np.array([float(header.origin[axis]) for axis in "xyz"])
        if not np.any(origin):
            starts = dict(zip(axes[-3:], (int(header[f"n{axis}start"]) for axis in "zyx"), strict=True))
            origin = np.array([starts[axis] * steps.get(axis, 1.0) for axis in "xyz"])
        return ImageRecord(data, axes, steps, "angstrom" if steps else None, origin, what=f"path: {path}")


COUNTS = "mx", "my", "mz"
