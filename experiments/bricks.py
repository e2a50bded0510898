"""What do bricks cost in an ultrasound scan, by how it is split, and does overlap save time?

The scan of Kim, Kwon and Shin 2008 in float32, on disk: a phantom of a fetus, sampled by a probe of the
paper's proportions. `render_bricks` renders it under the splits of the paper's Table 1 by `"overlap"`, by
`"reload"`, and in the naive order, which is wrong, all in turn with `render` of the whole volume. Beside the
times stand the loads, and the voxels read over those of the volume, with what is read around each brick. The
best split is measured from several sides, since a ray's way decides whether it comes back to a brick.

Under two conditions: a quarter of the scan along each axis, for which there is memory enough; and the paper's
scan and size of the image, with a quarter of the scan's bytes for bricks (`memory`). A frame of that takes a
minute or more, so that it is rendered once, under some splits, and what JAX takes to compile is subtracted.

Before each frame the file is dropped from the system's page cache, where the system can do that. A split into
many bricks is timed once.
"""

import math
import os
import tempfile
from argparse import Namespace
from collections.abc import Iterable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol.bricks import BrickGrid, VoxelSource, overlap_of, source_of
from jaxvol.bricks.traversal import Load, Traversal

from . import timing
from .harness import experiment, recorded, show, some_of
from .scan_conversion import BODY


Split = tuple[int, int, int]
"""Bricks along β, σ and γ, the axes of data[β, σ, γ]."""

SHAPE = 325, 490, 1280
"""Voxels along β, σ and γ."""
A, B = 70.04, 338.11
"""Of the probe, mm."""
BETA, SIGMA = math.radians(57.29), math.radians(103.64)
"""Ranges of angles."""
BEST = 2, 4, 2

NEAR, DEEP = 245.0, 349.0
"""Fitted, since the paper does not print the range of depths: distances, from the centre of curvature, of the
near end of the scan, and from there to its far end, in a unit that is unexplained: DEEP is 1280 voxels. The
column of overlap follows from three changes together: K in this unit counts as a number of voxels, a = 0, and
K is taken at the near face of each brick (`printed_overlap`)."""


class Row(NamedTuple):
    """A row of the table: overlap in percent of the volume, and frames per second."""

    overlap: float
    reload: float
    proposed: float


TABLE: dict[Split, Row] = {
    (2, 2, 1): Row(0, 13.99, 13.97),
    (2, 1, 2): Row(7.58, 11.57, 1.30),
    (1, 2, 2): Row(2.03, 11.64, 13.27),
    (1, 1, 4): Row(30.23, 8.35, 0.63),
    (2, 2, 2): Row(2.03, 15.49, 16.61),
    (2, 2, 4): Row(7.97, 17.66, 0.99),
    (2, 4, 2): Row(0.63, 20.88, 22.87),
    (4, 2, 2): Row(2.03, 1.07, 1.05),
    (2, 2, 8): Row(20.78, 17.62, 1.10),
    (2, 8, 2): Row(0.63, 19.92, 21.46),
    (8, 2, 2): Row(2.03, 1.57, 1.50),
    (4, 4, 4): Row(2.11, 3.19, 2.73),
    (2, 8, 4): Row(2.58, 15.43, 17.93),
    (2, 32, 2): Row(0.63, 10.49, 11.77),
    (4, 4, 8): Row(5.47, 2.94, 3.02),
    (4, 4, 16): Row(12.89, 4.22, 1.98),
    (8, 8, 4): Row(0.70, 4.97, 3.92),
}
"""As printed, in the paper's order."""


def probe(scale: float = 1.0) -> jv.ToroidalMap:
    """The paper's probe, all lengths times `scale`. Its range of depths is to `b` as fitted."""
    beta, sigma = ((math.pi / 2 - angle / 2, math.pi / 2 + angle / 2) for angle in (BETA, SIGMA))
    return jv.ToroidalMap(A * scale, B * scale, beta, sigma, (0.0, B * scale * DEEP / NEAR))


def grid(shape: tuple[int, int, int], split: Split) -> BrickGrid:
    """Bricks as `render_bricks` makes them of so many along each axis."""
    x, y, z = (-(-(n - 1) // count) for n, count in zip(shape, split, strict=True))
    return BrickGrid(shape, (x, y, z))


def printed_overlap(split: Split) -> float:
    """Overlap in percent by the paper's formula (`jaxvol.bricks.overlap_of`), in the unit in which it gives
    the printed column: to 0.1 in 12 of 17 rows, and to 0.4 in the others. K is taken at the near face of each
    brick but the last, which is that between two bricks if the scan began a brick nearer; both planes
    count from the same centre."""
    near, (beta, sigma) = NEAR - DEEP / split[2], (probe().beta_range, probe().sigma_range)
    if split[2] == 1:
        return 0.0
    scan = jv.ToroidalMap(0.0, near, beta, sigma, (0.0, DEEP))
    voxel = DEEP / (SHAPE[2] - 1)
    return share([k * voxel for k in overlap_of(scan, grid(SHAPE, split))], SHAPE[2])


def share(overlaps: Iterable[float], nodes: int) -> float:
    """The part of a volume of so many voxels along γ that is read twice, in percent: whole layers at each
    face."""
    return 100 * sum(map(math.ceil, overlaps)) / nodes


def each_at_once(traversal: Traversal) -> Iterator[Load]:
    """A `method` of `render_bricks`, the paper's order without overlap: each brick with all its cells of each
    ray, so that what the ray meets between these, in other bricks, is blended in the wrong order."""
    for brick in traversal.order:
        if not traversal.visible[brick]:
            continue
        outside = np.ones(traversal.grid.number + 1, bool)
        outside[brick] = False
        own = ~outside
        own[-1] = True  # a ray goes on through a gap, in which there is no brick
        reached, load = jnp.zeros(traversal.rays.length.shape, jnp.int32), None
        while (found := traversal.cells_of(brick, own, outside, reached)) is not None:
            load = load or traversal.load(brick, found.cells)
            reached = found.reached
            yield load._replace(cells=found.cells)


METHODS: dict[str, Any] = {"overlap": "overlap", "reload": "reload", "naive": each_at_once}
SCALE = 0.17
"""Of the probe, so that the fetus lies within the scan."""
MANY = 100
"""From so many bricks on, a split is timed once, after a warm frame."""


class Condition(NamedTuple):
    """Samples along a beam, the part of the scan's bytes that bricks may take (None: a quarter of the
    machine's memory), and the methods. `once`: each frame is the first, less what JAX takes to compile."""

    resolution: int
    part: float | None = None
    methods: tuple[str, ...] = tuple(METHODS)
    once: bool = False


FITS, QUARTER = "the scan fits", "a quarter of it fits"
CONDITIONS = {
    FITS: Condition(320),
    QUARTER: Condition(SHAPE[2], 1 / 4, ("overlap", "reload"), once=True),
}

EYES: dict[str, tuple[float, float, float]] = {
    "across": (0, -290, 40),
    "along": (290, 0, 100),
    "from below": (0, -20, 410),
    "from the probe": (0, -20, -200),
}
"""Where the camera is, mm. Across and along the fan, rays pass the curved faces at small angles."""
VIEW = "across"
WHOLE = "whole"


def phantom(
    resolution: int, dtype: str = "float32", *, speckle: bool = True
) -> tuple[jv.Volume, jv.ToroidalMap]:
    """The fetus as the paper's probe would see it, with so many samples along a beam."""
    x, y, z = (max(8, n * resolution // SHAPE[2]) for n in SHAPE)
    volume, scan = jv.toroidal_phantom("fetus", (x, y, z), probe=probe(SCALE), speckle=speckle)
    return jv.Volume(np.asarray(volume.data).astype(dtype)), scan


def camera(view: str, size: int) -> jv.Camera:
    up = (0, 0, 1) if view == "along" else (1, 0, 0)
    return jv.Camera(EYES[view], (0, 0, 110), up, 36.0, size=(size, size))


def marching(scan: jv.ToroidalMap, volume: jv.Volume) -> jv.March:
    """By steps of two samples of a beam."""
    first, last = scan.gamma_range
    return jv.March(2 * float(last - first) / (volume.shape[2] - 1), (scan,))


class Scan(NamedTuple):
    """A scan on disk."""

    path: Path
    source: VoxelSource
    probe: jv.ToroidalMap
    march: jv.March

    def render(self, view: jv.Camera, **how: Any) -> jv.Rendering:
        """By bricks; or, without options, as a whole. First, the file is dropped from the system's page
        cache, where that is possible."""
        if hasattr(os, "posix_fadvise"):
            with self.path.open("rb") as file:
                os.fsync(file.fileno())
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        scene = jv.TransferFunction.from_points(BODY), view, self.march
        if how:
            return jv.render_bricks(self.source, *scene, outputs="rgba", **how)
        return jv.render(jv.Volume(np.load(self.path)), *scene, outputs="rgba")


def stored(folder: Path, resolution: int) -> Scan:
    volume, scan = phantom(resolution)
    path = folder / "fetus.npy"
    np.save(path, np.asarray(volume.data))
    return Scan(path, source_of(path), scan, marching(scan, volume))


def compared(
    scan: Scan, view: jv.Camera, split: Split, how: Condition, repetitions: int, whole: Any = None
) -> dict[str, dict[str, Any]]:
    """Time, reads and error of each method, and time of the volume rendered whole. `whole`: seconds and image
    of that; then the methods are run once."""
    voxels = int(np.prod(scan.source.shape)) * 4
    memory = how.part and int(how.part * voxels)
    programs: dict[str, Any] = {
        name: partial(scan.render, view, bricks=split, method=METHODS[name], memory=memory)
        for name in how.methods
    }
    if whole is not None:
        runs = {name: timing.first(program) for name, program in programs.items()} | {WHOLE: whole}
        renderings = {name: rendering for name, (_, rendering) in runs.items()}
        seconds = {name: [taken] for name, (taken, _) in runs.items()}
    else:
        programs[WHOLE] = partial(scan.render, view)
        seconds = timing.interleaved(programs, repetitions)
        renderings = {name: program() for name, program in programs.items()}
    truth = np.asarray(renderings[WHOLE].rgba)
    rows: dict[str, dict[str, Any]] = {WHOLE: {"seconds": timing.median(seconds[WHOLE])}}
    for method in how.methods:
        report = renderings[method].bricks
        rows[method] = {
            "seconds": timing.median(seconds[method]),
            "ratio to overlap": timing.ratio(seconds[method], seconds["overlap"]),
            "needed": report.needed,
            "loads": report.loads,
            "read, times the volume": round(float(report.bytes_read / voxels), 4),
            "held, MiB": round(report.bytes_held / 2**20, 3),
            "largest error": float(np.max(np.abs(np.asarray(renderings[method].rgba) - truth))),
        }
    return rows


def named(split: Split) -> str:
    return ",".join(map(str, split))


def measured(chosen: Namespace, how: Condition, size: int, splits: tuple[Split, ...]) -> dict[str, Any]:
    """The splits from one side, and the best one from the others."""
    rows: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        scan = stored(Path(folder), min(how.resolution, chosen.resolution))

        @cache
        def whole(view: str) -> tuple[float, Any]:
            return timing.first(partial(scan.render, camera(view, size)))

        def measure(split: Split, view: str) -> dict[str, Any]:
            repetitions = chosen.repetitions if np.prod(split) < MANY and not how.once else 1
            found = compared(
                scan, camera(view, size), split, how, repetitions, whole(view) if how.once else None
            )
            show(found, named(split), view)
            return {"bricks": int(np.prod(split)), "repetitions": repetitions, **found}

        views = {view: measure(BEST, view) for view in EYES if view != VIEW and BEST in splits}
        for split in splits:
            overlap = overlap_of(scan.probe, grid(scan.source.shape, split))
            rows[named(split)] = {
                "paper": TABLE[split]._asdict(),
                "formula": round(printed_overlap(split), 3),
                "formula, of these voxels": round(share(overlap, scan.source.shape[2]), 3),
                **measure(split, VIEW),
            }
    about: dict[str, Any] = {"image": [size] * 2, "voxels": list(scan.source.shape), "view": VIEW}
    if how.part:
        about["memory, MiB"] = round(float(how.part * np.prod(scan.source.shape) * 4 / 2**20), 1)
    return {**about, "splits": rows, f"{named(BEST)} from": views}


@experiment(
    repetitions=5,
    size=64,
    resolution={"type": int, "default": SHAPE[2], "help": "samples along a beam, at most"},
    only=some_of(CONDITIONS, "CONDITION"),
    splits=tuple(TABLE),
    large=(375,),
    large_splits=((2, 1, 2), (2, 2, 2), (2, 4, 2), (2, 2, 4)),
    quick={
        "size": 16,
        "resolution": 48,
        "repetitions": 1,
        "splits": ((2, 1, 2),),
        "large": (16,),
        "large_splits": ((2, 1, 2),),
    },
)
def main(chosen: Namespace) -> dict[str, Any]:
    each = {FITS: (chosen.size, chosen.splits), QUARTER: (*chosen.large, chosen.large_splits)}
    found = recorded(chosen, "conditions", [name for name in CONDITIONS if name not in chosen.only])
    found |= {name: measured(chosen, CONDITIONS[name], *each[name]) for name in chosen.only}
    return {"conditions": {name: found[name] for name in CONDITIONS if name in found}}
