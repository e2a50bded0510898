"""How much memory and time does an image take of a volume that does not fit into the memory given?

The head phantom with a grain of its own in each voxel, of 64 MiB to 2 GiB, is written to a temporary folder
as a raw file and as Zarr, and rendered by `render_bricks` with 256 MiB for voxels, at 512 x 512 pixels and
steps of one voxel: under a transfer function whose bones hide what is behind them, and under one of 1/50 of
its extinction, through which everything is seen. Each file is rendered in a process of its own, which tells
its greatest resident memory over what it had before the first image.

Beside it, `render` of the whole volume in memory: at 2 GiB, and at 64 MiB, scaled by the number of samples.
The goals: a peak of at most the budget and 30 % over what an image of a volume of 2 MiB takes (the rays of
the image, and compiled programs), and 1.5 times the time in memory.
"""

import json
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxvol as jv

from . import timing
from .harness import experiment, show
from .peak_memory import peak
from .scenes import seen_head


LARGE, FITTING = 2048, 64
"""MiB of voxels: of the size that the goals are for, and of the one whose time in memory is scaled."""
SMALL = 128
"""Voxels along a side of the volume whose images take little but what all images take."""
OVER = 1.3
FORMATS = "raw", "zarr"
SCENES = {"opaque": 1.0, "translucent": 0.02}
"""Factors to the extinction."""
REPETITIONS = 2
"""Images that are timed of each scene, once programs are compiled and ranges of values known."""


# -- a volume of any size, made on disk without ever being in memory ---------------------------------------

COARSE = 192
"""Voxels along a side of the phantom that is interpolated."""
GRAIN, AIR = 8, 8
"""Values by which neighbouring voxels differ beside what the phantom says, and up to which they do not, so
that a compressed file is no smaller than that of a scan."""
CHUNK = 64
"""Voxels along a side of a Zarr chunk."""


def slabs(n: int, seed: int) -> Iterator[np.ndarray]:
    """Slabs (thickness, n, n) of n³ voxels of type uint8, data[z, y, x], from the first to the last."""
    coarse = np.asarray(jv.phantom("head", COARSE).data, np.float32)
    at = np.linspace(0, COARSE - 1, n)
    low, rows = np.minimum(at.astype(int), COARSE - 2), np.arange(n)
    weights = np.zeros((n, COARSE), np.float32)  # of linear interpolation
    weights[rows, low], weights[rows, low + 1] = 1 - (at - low), at - low
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


def volume(folder: Path, n: int, kind: str, seed: int) -> Path:
    """The file of a volume of n³ voxels, which is made if it is not there."""
    raw = folder / f"head_{n}.raw"
    path = raw.with_suffix(f".{kind}")
    if kind == "raw" and not raw.exists():
        with raw.open("wb") as file:
            for slab in slabs(n, seed):
                file.write(slab.data)
    if kind == "zarr" and not path.exists():
        zarr_of_raw(path, raw, n)
    return path


def zarr_of_raw(path: Path, raw: Path, n: int) -> None:
    """The voxels of a raw file as a Zarr array, version 3, in compressed chunks."""
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


# -- its images, in a process of their own ------------------------------------------------------------------

CHILD = """
import json, sys
from pathlib import Path
from experiments.out_of_core import measure
path, *sizes = sys.argv[1:]
print(json.dumps(measure(Path(path), *map(int, sizes))))
"""


def in_a_process(path: Path, voxels: int, pixels: int, memory: int) -> dict[str, Any]:
    """What `measure` finds. `memory`: MiB; 0 for all."""
    words = [str(path), str(voxels), str(pixels), str(memory * 2**20)]
    ran = subprocess.run(
        [sys.executable, "-c", CHILD, *words],
        cwd=Path(__file__).parent.parent,
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(ran.stdout.splitlines()[-1])


def measure(path: Path, voxels: int, pixels: int, memory: int) -> dict[str, Any]:
    """Time and memory of images of a file, at steps of one voxel, leaping over empty space. `memory`: bytes;
    0 to render the volume as a whole, in memory."""
    _, opaque, camera, _ = seen_head(jv.phantom("head", 16), pixels)
    spacing, origin = (2 / (voxels - 1),) * 3, (-1.0,) * 3
    march = jv.March(spacing[0], (jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination()), "midpoint")
    jax.block_until_ready(camera.position + 1)  # JAX is up
    found: dict[str, Any] = {"before": round(peak(), 1)}
    if memory:
        raw = {"shape": (voxels,) * 3, "dtype": "uint8"} if path.suffix == ".raw" else {}
        source = jv.bricks.source_of(path, spacing=spacing, origin=origin, **raw)
        render, how = partial(jv.render_bricks, source), {"memory": memory}
    else:
        whole = jv.Volume(np.fromfile(path, np.uint8).reshape((voxels,) * 3).T, spacing, origin)
        render, how = partial(jv.render, whole), {}
    for name, factor in SCENES.items():
        transfer = jv.TransferFunction(opaque.values, opaque.colors, factor * opaque.extinction)
        draw = partial(render, transfer, camera, march, outputs="rgba", **how)
        begun = time.perf_counter()
        rendering = jax.block_until_ready(draw())
        row: dict[str, Any] = {"first seconds": round(time.perf_counter() - begun, 3)}
        row["seconds"] = timing.interleaved({name: draw}, REPETITIONS)[name]
        row["peak"] = round(peak() - found["before"], 1)
        row["mean"] = np.mean(np.asarray(rendering.rgba, np.float64), (0, 1)).tolist()
        if memory:
            row["bricks"] = rendering.bricks._asdict()
        else:
            row["samples"] = int(np.sum(np.asarray(render(transfer, camera, march).samples), dtype=np.int64))
        found[name] = row
    return found


# -- against the goals --------------------------------------------------------------------------------------


def compared(result: dict[str, Any], large: str, fitting: str) -> dict[str, Any]:
    """The largest size of both kinds, against the goals. `fitting`: the size in memory that is scaled."""
    found: dict[str, Any] = {}
    for kind in FORMATS:
        rows, constant = result["bricks"][kind][large], result["constant"][kind]
        peaks, least = (max(of[name]["peak"] for name in SCENES) for of in (rows, constant))
        found[kind] = {"peak": peaks, "allowed": round(OVER * result["memory"] + least, 1)}
        for name in SCENES:
            small, whole = (result["resident"][size][name] for size in (fitting, large))
            taken, resident, scaled = (timing.median(row["seconds"]) for row in (rows[name], whole, small))
            scaled *= whole["samples"] / small["samples"]
            found[kind][name] = {
                "seconds": taken,
                "in memory": resident,
                "ratio": round(taken / resident, 3),
                "scaled": round(scaled, 4),
                "ratio, scaled": round(taken / scaled, 3),
                "difference": float(np.max(np.abs(np.subtract(rows[name]["mean"], whole["mean"])))),
            }
    return found


@experiment(
    size=512,
    sizes={"nargs": "+", "type": int, "default": (FITTING, 256, LARGE), "help": "MiB of voxels"},
    memory={"type": int, "default": 256, "help": "MiB, the budget"},
    resident=(FITTING, LARGE),
    quick={"size": 32, "sizes": [2], "memory": 4, "resident": (2, 2)},
)
def main(chosen: Namespace) -> dict[str, Any]:
    result: dict[str, Any] = {"pixels": chosen.size, "sizes": chosen.sizes, "memory": chosen.memory}
    result |= {"constant": {}, "bricks": {kind: {} for kind in FORMATS}, "resident": {}}
    with tempfile.TemporaryDirectory() as temporary:

        def measured(voxels: int, kind: str, memory: int) -> dict[str, Any]:
            found = in_a_process(
                volume(Path(temporary), voxels, kind, chosen.seed), voxels, chosen.size, memory
            )
            show(found, f"{voxels}³", kind, f"{memory} MiB" if memory else "in memory")
            return found

        for kind in FORMATS:
            result["constant"][kind] = measured(SMALL, kind, 8)
        for size in chosen.sizes:
            side = int((size * 2**20) ** (1 / 3))
            for kind in FORMATS:
                result["bricks"][kind][str(size)] = measured(side, kind, chosen.memory)
            if size in chosen.resident:
                result["resident"][str(size)] = measured(side, "raw", 0)
    fitting, large = map(str, chosen.resident)
    result["compared"] = compared(result, large, fitting)
    return result
