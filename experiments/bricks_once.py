"""What is missing if each brick of a scan is read once, as published, and how much less is read?

The schedule of Kim, Kwon and Shin 2008, to the letter: bricks in the order of the distance of their centres,
each read once, longer towards the probe by K*, and each ray goes on from where it has come to until it leaves
the brick. The scan of `bricks`, by split and view, with no overlap, with K* by the formula, and with as many
voxels as the paper's column of overlap says. Counted are the rays that have not come to their ends after the
last brick, and the pixels that differ from those of the whole volume by more than 1/255; beside them what is
read, and what `render_bricks` reads, whose images are those of the whole volume, by overlap and by reading
again.
"""

import math
from argparse import Namespace
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxvol as jv
from jaxvol.bricks import BrickGrid, overlap_of
from jaxvol.bricks.grid import stored_shape
from jaxvol.bricks.traversal import Load, Traversal
from jaxvol.engine.wavefront import CellRange
from jaxvol.scene.space import Ray

from .bricks import EYES, SHAPE, TABLE, Split, camera, grid, marching, named, phantom, probe
from .harness import experiment
from .scan_conversion import BODY


NONE, FORMULA, PRINTED = "no overlap", "K*", "overlap as printed"
SPLITS: tuple[Split, ...] = ((2, 2, 1), (2, 1, 2), (1, 1, 4), (2, 2, 2), (2, 4, 2), (2, 2, 4))
ASKED = "voxels asked for of the paper's, times the volume"
LIMIT = 1 / 255


class EachOnce:
    """A `method` of `render_bricks`, the paper's. What a ray has not come to after the last brick is missing.

    Attributes:
        extension: voxels by which bricks reach farther towards the probe, for each face between two bricks
            along γ, from the probe outwards.
        incomplete: the share of rays, of those that meet the scan, that did not come to their ends in the
            last image.
    """

    def __init__(self, extension: Sequence[float]):
        self.extension, self.incomplete = np.array([0.0, *extension]), math.nan

    def __call__(self, traversal: Traversal) -> Iterator[Load]:
        bricks, nodes = traversal.grid, traversal.grid.shape
        # with one voxel around what is marched, for interpolation
        sizes = np.array(bricks.size) + 3 + np.array([0, 0, math.ceil(self.extension.max())])
        x, y, z = np.minimum(sizes, nodes).tolist()
        traversal.stored = stored_shape(nodes, (x, y, z))
        inside, column, depth = places(traversal)
        index, reached = np.arange(inside.shape[-1]), np.zeros(inside.shape[:-1], np.int64)
        for brick in traversal.order:
            low, high = (np.asarray(node) for node in bricks.cells(brick))
            low[2] -= math.ceil(nearer := self.extension[low[2] // bricks.size[2]])
            # rounding may put what is in the volume beyond its faces
            first = bricks.cells(brick)[0][2] - nearer if brick % bricks.counts[2] else -math.inf
            last = high[2] if high[2] < nodes[2] - 1 else math.inf
            here = (column == brick // bricks.counts[2]) & (depth >= first) & (depth < last)
            ahead = index >= reached[..., None]
            leaves = inside & ~here & ahead
            until = np.where(leaves.any(-1), np.argmax(leaves, axis=-1), len(index))
            marched = inside & here & ahead & (index < until[..., None])
            if traversal.visible[brick] and marched.any():
                cells = CellRange(*(jnp.asarray(end, jnp.int32) for end in (reached, until)))
                yield traversal.load(brick, cells, (low - 1, high + 1))
            reached = until
        missing = np.any(inside & (index >= reached[..., None]), axis=-1)
        self.incomplete = float(missing.sum() / inside.any(-1).sum())


def places(traversal: Traversal) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the cells of rays begin, (*rays, cells): whether in the volume, in which column of bricks, and at
    which node along γ."""
    bricks, rays, step = traversal.grid, traversal.rays, float(traversal.scene.march.step)
    number = math.ceil(float(rays.length.max()) / step) + 1
    depths = jnp.asarray(step * np.arange(number), rays.length.dtype)
    inside, *coordinate = (np.moveaxis(np.asarray(each), 0, -1) for each in located(rays, depths))
    beta, sigma = (
        np.clip(np.nan_to_num(along) // size, 0, count - 1).astype(int)
        for along, size, count in zip(coordinate[:2], bricks.size[:2], bricks.counts[:2], strict=True)
    )
    return inside, beta * bricks.counts[1] + sigma, coordinate[2]


@jax.jit
def located(rays: Ray, depths: Array) -> tuple[Array, Array, Array, Array]:
    """Whether rays, (tiles, groups, rays), are in the volume at these depths, and their grid coordinates
    there."""

    def at(depth: Array) -> tuple[Array, Array, Array, Array]:
        return jax.vmap(jax.vmap(jax.vmap(lambda ray: (ray.contains(depth), *ray.path(depth)))))(rays)

    return jax.lax.map(at, depths)


def extensions(scan: jv.ToroidalMap, bricks: BrickGrid, split: Split) -> dict[str, list[float]]:
    """Voxels at each face; the printed overlap, a share of the volume, is spread evenly over the faces."""
    formula = overlap_of(scan, bricks)
    printed = TABLE[split].overlap / 100 * bricks.shape[2] / max(len(formula), 1)
    return {NONE: [0.0] * len(formula), FORMULA: formula, PRINTED: [printed] * len(formula)}


def asked(bricks: BrickGrid, extension: Sequence[float]) -> float:
    """Voxels of all bricks with the layers that they share and their extension, over those of the volume."""
    total = 0
    for brick in range(bricks.number):
        low, high = bricks.cells(brick)
        sides = np.subtract(high, low) + 1
        sides[2] += math.ceil([0.0, *extension][low[2] // bricks.size[2]])
        total += int(np.prod(sides))
    return total / math.prod(bricks.shape)


@experiment(
    size=96,
    resolution=320,
    splits=SPLITS,
    quick={"size": 16, "resolution": 48, "splits": ((2, 1, 2),)},
)
def main(chosen: Namespace) -> dict[str, Any]:
    volume, scan = phantom(chosen.resolution)
    scene = volume, jv.TransferFunction.from_points(BODY)
    march, voxels = marching(scan, volume), math.prod(volume.shape)
    wholes = {
        view: np.asarray(jv.render(*scene, camera(view, chosen.size), march, outputs="rgba").rgba)
        for view in EYES
    }
    rows: dict[str, Any] = {}
    for split in chosen.splits:
        bricks, large = grid(volume.shape, split), grid(SHAPE, split)
        paper = extensions(probe(), large, split)
        methods: dict[str, Any] = {n: EachOnce(ext) for n, ext in extensions(scan, bricks, split).items()}
        methods |= {"overlap": "overlap", "reload": "reload"}
        sizes = {name: asked(large, extension) for name, extension in paper.items()}
        rows[named(split)] = {ASKED: sizes, "views": {view: {} for view in EYES}}
        for (view, whole), (name, method) in ((v, m) for v in wholes.items() for m in methods.items()):
            how: dict[str, Any] = {"bricks": split, "method": method, "outputs": "rgba"}
            found = jv.render_bricks(*scene, camera(view, chosen.size), march, **how)
            off = np.abs(np.asarray(found.rgba) - whole).max(-1)
            assert found.bricks is not None
            rows[named(split)]["views"][view][name] = {
                "incomplete rays": method.incomplete if isinstance(method, EachOnce) else 0.0,
                "wrong pixels": float(np.mean(off > LIMIT) / np.mean(whole[..., 3] > 0)),
                "largest error": float(off.max()),
                "loads": found.bricks.loads,
                "read, times the volume": round(found.bricks.bytes_read / (4 * voxels), 4),
            }
    return {"image": [chosen.size] * 2, "voxels": list(volume.shape), "splits": rows}
