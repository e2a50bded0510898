"""How is a volume of any size made on disk, without ever being in memory?

The head phantom is interpolated to n³ voxels, and what is not air gets a grain of its own in each voxel, so
that the volume holds detail of the size of its voxels, as a scan does, and a compressed file is no smaller
than that of one. It is made and written in slabs.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

import jaxvol as jv


COARSE = 192
"""Voxels along a side of the phantom that is interpolated."""
GRAIN = 8
"""Values by which neighbouring voxels may differ beside what the phantom says; 8 bits hold 256."""
AIR = 8
"""Voxels of less than this value have no grain."""
CHUNK = 64
"""Voxels along a side of a Zarr chunk."""


def slabs(n: int, seed: int) -> Iterator[np.ndarray]:
    """Slabs (thickness, n, n) of n³ voxels of type uint8, data[z, y, x], from the first to the last."""
    coarse = np.asarray(jv.phantom("head", COARSE).data, np.float32)
    weights = _weights(n)
    rng = np.random.default_rng(seed)
    for first in range(0, n, CHUNK):
        along_z = np.tensordot(weights[first : first + CHUNK], coarse, (1, 2))  # (z, x, y)
        slab = np.empty((len(along_z), n, n), np.uint8)  # (z, y, x)
        for plane, found in zip(along_z, slab, strict=True):
            values = weights @ (weights @ plane).T
            grain = rng.integers(0, GRAIN, values.shape, np.uint8)
            grain[values < AIR] = 0
            np.minimum(np.rint(values) + grain, 255, out=found, casting="unsafe")
        yield slab


def _weights(n: int) -> np.ndarray:
    """(n, COARSE): linear interpolation between the nodes of the phantom, whose first and last stay so."""
    at = np.linspace(0, COARSE - 1, n)
    low = np.minimum(at.astype(int), COARSE - 2)
    weights = np.zeros((n, COARSE), np.float32)
    weights[np.arange(n), low] = 1 - (at - low)
    weights[np.arange(n), low + 1] = at - low
    return weights


def write_raw(path: Path, n: int, seed: int) -> Path:
    """A raw file, x fastest."""
    with path.open("wb") as file:
        for slab in slabs(n, seed):
            file.write(slab.data)
    return path


def zarr_of_raw(path: Path, raw: Path, n: int) -> Path:
    """The voxels of a raw file as a Zarr array, version 3, in compressed chunks of CHUNK³ voxels."""
    import tensorstore

    codec = {"name": "blosc", "configuration": {"cname": "lz4", "clevel": 5, "shuffle": "noshuffle"}}
    grid = {"name": "regular", "configuration": {"chunk_shape": [CHUNK] * 3}}
    spec = {
        "driver": "zarr3",
        "kvstore": {"driver": "file", "path": f"{path}/"},
        "metadata": {"shape": [n] * 3, "data_type": "uint8", "chunk_grid": grid, "codecs": [codec]},
        "store_data_equal_to_fill_value": True,  # an empty chunk is not a missing one
    }
    array = tensorstore.open(spec, create=True, delete_existing=True).result()
    with raw.open("rb") as file:
        for first in range(0, n, CHUNK):
            slab = np.fromfile(file, np.uint8, n * n * min(CHUNK, n - first)).reshape(-1, n, n)
            array[:, :, first : first + len(slab)].write(slab.transpose(2, 1, 0)).result()
    return path
