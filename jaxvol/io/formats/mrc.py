"""Reads MRC and CCP4 maps of electron microscopy (`.mrc`, `.map`, `.ccp4`, `.rec`) with mrcfile."""

import warnings
from pathlib import Path

import numpy as np

from ..._util.files import check_size, file_size, library, reason
from ..._util.image_record import ImageRecord


ENDINGS = (".mrc", ".map", ".ccp4", ".rec")


def read_mrc(path: Path) -> ImageRecord:
    """Reader, in ångström. Axes are those of MAPC, MAPR, MAPS; the place is `origin`, or else the number of
    the first column, row and section."""
    mrcfile = library("mrcfile", path)
    size = file_size(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with mrcfile.open(path, permissive=True, header_only=True) as file:
                header = file.header.copy()
            dtype = mrcfile.utils.data_dtype_from_header(header)
        order = [int(header[name]) for name in ("mapc", "mapr", "maps")]
        order = order if sorted(order) == [1, 2, 3] else [1, 2, 3]
        counts, begin = [int(header[f"n{axis}"]) for axis in "xyz"], 1024 + int(header.nsymbt)
        if min(counts) < 1 or header.nsymbt < 0 or dtype.kind not in "iuf":
            raise ValueError(f"its header says {counts} voxels of {dtype} from byte {begin} on")
        cells = {axis: (float(header.cella[axis]), int(header[f"m{axis}"])) for axis in "xyz"}
        steps = {axis: length / n for axis, (length, n) in cells.items() if n > 0 and 0 < length < np.inf}
        first = np.zeros(3)
        for number, axis in zip(order, "xyz", strict=True):
            first[number - 1] = int(header[f"n{axis}start"]) * steps.get("xyz"[number - 1], 1.0)
        origin = np.array([float(header.origin[axis]) for axis in "xyz"])
    except Exception as fault:  # of many kinds
        raise ValueError(f"path: {path} cannot be read as MRC: {reason(fault)}.") from fault
    check_size(path, max(size - begin, 0), int(np.prod(counts, dtype=object)) * dtype.itemsize, more=True)
    data = np.memmap(path, dtype, "r", begin, tuple(counts[::-1]))
    origin = origin if np.any(origin) and np.all(np.isfinite(origin)) else first
    axes = "".join("xyz"[number - 1] for number in order)[::-1]
    return ImageRecord(data, axes, steps, "angstrom", origin, what=f"path: {path}")
