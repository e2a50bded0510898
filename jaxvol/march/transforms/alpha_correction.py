"""Sampling alignment, also called alpha correction: the width of a cell that crosses a face (Kye 2013)."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from ..._util.checks import Flag, flag
from ..._util.vec3 import Scalar, Vec3, greatest, minus
from ...scene.space import Path, Ray
from ...scene.volume import Volume
from ...scene.voxel_fetch import Node, direction_bit, flat_index, nearest_node, to_index
from ...xla.memory import gather, in_memory
from ..march import Cell, CellRules, DivisionTest, Transform, cut_at_entry, cut_at_exit


SHARED = 1e-3
"""By how much of a voxel a cell may be longer than one voxel, and be looked through at once."""

LIMIT = 2**15
"""Planes between nodes along a cell, of which any more are passed over."""


class AlphaCorrection(Transform):
    """Cut cells at the exit, and optionally at faces of labels: back faces are smooth, gradients complete.

    A ray's last sample then represents only the width e up to the exit, and back faces are smooth: its
    opacity is `1 - exp(-extinction e)`, the paper's `1 - (1 - α)^(e/d)`. A volume of constant extinction is
    rendered exactly at any step. Cells are also cut at the ends of a ray's gaps, as under `ToroidalMap` or
    `Clip`; of several gaps in one cell, at the first and the last end.

    With this transform, the image is continuous in all that moves the exit, and its gradient complete.
    Without it, the image jumps when a sample crosses the exit, and the gradient misses these jumps.

    Args:
        labels: also cut cells at the first and the last plane, half-way between nodes, where the label of the
            nearest node changes, so that the faces of a segmentation stay smooth under jitter. What lies
            between two labels of one cell has the label behind the first face. A frame takes about 1.5 to
            2 times as long, 2.3 to 3.5 times where many neighbours differ, as in thresholds of noise, and
            four bytes per label, computed once; 3 to 5 times as long with lighting, under other modes than
            "over", on GPUs, and where labels are traced. Gradients include the motion of exit and faces.

    Where it fails: `experiments/stability.py`, "grazing exits", "exits at the end of a cell",
    "jitter at label faces", "gradients at label faces".

    Raises:
        ValueError: for `labels` that are not true or false, and when a volume without labels is rendered
            with `labels=True`.

    Source: Kye 2013, section 3.2 (sampling position alignment), for the cut at the exit; the paper names
    labels as future work.
    """

    joins: ClassVar[bool] = True
    ends_at_exit: ClassVar[bool] = True

    labels: bool = eqx.field(static=True)

    def __init__(self, labels: Flag = False):
        self.labels = flag("labels", labels)

    def cut(self, cell: Cell, ray: Ray, volume: Volume) -> tuple[Cell, ...]:
        return self._divide(cut_at_exit(cell, ray), ray, volume)

    def rules(self, rules: CellRules) -> CellRules:
        may_divide = DivisionTest(_parts, _may_change) if self.labels else None
        return replace(rules, at_exit=np.asarray(True), divide=self._divide, may_divide=may_divide)

    @property
    def reads_labels(self) -> bool:
        return self.labels

    @property
    def _divide(self) -> Callable[[Cell, Ray, Volume], tuple[Cell, ...]]:
        return _divided_by_labels if self.labels else _divided_by_gaps


def _divided_by_labels(cell: Cell, ray: Ray, volume: Volume) -> tuple[Cell, ...]:
    first, last, changes = _label_faces(cell, ray, volume)
    if ray.gaps:
        begin, end, cut = _gap_faces(cell, ray)
        first = jnp.where(cut & ~(changes & (first < begin)), begin, first)
        last = jnp.where(cut & ~(changes & (last > end)), end, last)
        changes |= cut
    return _divided(cell, first, last, changes)


def _divided_by_gaps(cell: Cell, ray: Ray, volume: Volume) -> tuple[Cell, ...]:
    return _divided(cell, *_gap_faces(cell, ray)) if ray.gaps else (cell,)


def _divided(cell: Cell, first: Scalar, last: Scalar, changes: Bool[Array, ""]) -> tuple[Cell, Cell, Cell]:
    """Split a cell at its first and last face if it `changes`; else the last two pieces have width 0."""
    end = cell.front + cell.width
    first = jnp.where(changes, first, end)
    last = jnp.where(changes, last, end)
    last = jnp.where(last < first, first, last)
    return (
        Cell(cell.front, first - cell.front, cell.cut & (first >= end)),
        Cell(first, last - first, cell.cut & (first < end) & (last >= end)),
        Cell(last, end - last, cell.cut),
    )


def _gap_faces(cell: Cell, ray: Ray) -> tuple[Scalar, Scalar, Bool[Array, ""]]:
    """The first and the last end of a gap within a cell, and whether there is any."""
    first = last = cell.front
    cuts = jnp.zeros_like(cell.cut)
    for depth in (end for gap in ray.gaps for end in gap):
        within = (depth > cell.front) & (depth < cell.front + cell.width)
        first = jnp.where(within & ~(cuts & (first < depth)), depth, first)
        last = jnp.where(within & (last < depth), depth, last)
        cuts |= within
    return first, last, cuts


def _label_faces(cell: Cell, ray: Ray, volume: Volume) -> tuple[Scalar, Scalar, Bool[Array, ""]]:
    """The first and the last face of labels within a cell, and whether there is any. A label is that of the
    nearest node, so that faces are planes half-way between nodes."""
    cell = jax.lax.stop_gradient(cut_at_entry(cell))  # in front of the entry lies no face
    path = jax.lax.stop_gradient(ray.path)
    parts = _parts(cell, ray)

    def search(part: Any, crossed: Int[Array, ""]) -> Int[Array, ""]:
        first, last = _changes(_crossings(cell, part, parts, path, volume), volume)
        before, after = crossed // LIMIT, crossed % LIMIT
        before = jnp.where((before == 0) & (first > 0), 3 * part + first, before)
        return before * LIMIT + jnp.where(last > 0, 3 * part + last, after)

    # one number for both faces, since XLA repeats the look-ups for each result of a loop
    crossed = jax.lax.fori_loop(0, parts, search, jnp.zeros(cell.front.shape, jnp.int32))
    first, last = (
        _face(cell, number, parts, ray.path, volume) for number in (crossed // LIMIT, crossed % LIMIT)
    )
    return first, last, crossed > 0


def _may_change(cell: Cell, ray: Ray, volume: Volume, part: Any, parts: Any) -> Bool[Array, ""]:
    """True if `_divided_by_labels` may cut a part of a cell, by the volume's `Fetch.changes`."""
    words = volume.fetch.changes
    assert words is not None
    inner, path = jax.lax.stop_gradient((cut_at_entry(cell), ray.path))

    def step() -> tuple[Int[Array, ""], Int[Array, ""]]:
        """The place of the node nearest to the beginning, and the direction of the one nearest to the end."""
        length = inner.width / parts.astype(inner.front.dtype)
        front = inner.front + part.astype(length.dtype) * length
        begin, end = (
            [_nearest(c, n) for c, n in zip(path(depth), volume.shape, strict=True)]
            for depth in (front, front + length)
        )
        sides = [jnp.sign(j - i) for i, j in zip(begin, end, strict=True)]
        i, j, k = (to_index(node, n) for node, n in zip(begin, volume.shape, strict=True))
        return flat_index((i, j, k), volume.shape), to_index(direction_bit(sides), 27)

    # kernels of their own, as in `_labels_behind`
    live = volume.spacing[0] > 0
    place, bit = in_memory(live, step)
    word = in_memory(live, partial(gather, words), place)
    changes = word >> bit.astype(word.dtype) & 1 == 1
    return changes | _gap_faces(cell, ray)[2] if ray.gaps else changes


def _nearest(coordinate: Scalar, n: Any) -> Scalar:
    """`nearest_node` along an axis of `n` nodes, as a float: faster, since few integers are compared."""
    node, last = jnp.floor(coordinate + 0.5), jnp.asarray(n - 1, coordinate.dtype)
    node = jnp.where(node > 0, node, 0)  # 0 for NaN
    return jnp.where(node < last, node, last)


def _parts(cell: Cell, ray: Ray) -> Int[Array, ""]:
    """The number of parts into which a cell is divided, so that each crosses one plane of an axis at most."""
    path = jax.lax.stop_gradient(ray.path)
    x, y, z = minus(path(cell.front + cell.width), path(cell.front))
    longest = jnp.ceil(greatest((jnp.abs(x), jnp.abs(y), jnp.abs(z))) - SHARED)
    return jnp.clip(longest, 1, LIMIT // 3 - 1).astype(jnp.int32)


class Crossings(NamedTuple):
    """The planes half-way between nodes that are crossed in a part of a cell.

    Attributes:
        node: nearest to where it begins.
        sides: of each axis, to which side the next node lies: -1, 1, or 0 if no plane is crossed.
        depths: of each axis, where its plane is crossed; inf if it is not.
    """

    node: Node
    sides: Node
    depths: Vec3


def _crossings(cell: Cell, part: Any, parts: Any, path: Path, volume: Volume) -> Crossings:
    """The planes that are crossed in a part of a cell, as if the ray were straight there."""
    length = cell.width / parts.astype(cell.front.dtype)
    front = cell.front + part.astype(length.dtype) * length
    begin, end = path(front), path(front + length)
    node, next_node = nearest_node(begin, volume.shape), nearest_node(end, volume.shape)
    sides, depths = [], []
    for i, j, low, high in zip(node, next_node, begin, end, strict=True):
        side = jnp.sign(j - i)
        share = (_plane(i, side, low.dtype) - low) / jnp.where(side == 0, 1, high - low)
        sides.append(side)
        depths.append(jnp.where(side == 0, jnp.inf, front + length * share))
    return Crossings(node, cast(Node, tuple(sides)), cast(Vec3, tuple(depths)))


def _changes(crossings: Crossings, volume: Volume) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """The axes, 1 to 3, of the first and the last plane at which the label changes; 0 if none does."""
    depths = crossings.depths
    ahead, *labels = _labels_behind(crossings, volume)
    front = jnp.full_like(depths[0], -jnp.inf)
    first = last = jnp.zeros(front.shape, jnp.int32)
    begins, ends = -front, front
    for axis, depth in enumerate(depths):
        before, at = ahead, front
        for label, crossed in zip(labels, depths, strict=True):
            nearer = (crossed < depth) & (crossed >= at)
            before, at = jnp.where(nearer, label, before), jnp.where(nearer, crossed, at)
        changes = (depth < jnp.inf) & (labels[axis] != before)
        first = jnp.where(changes & (depth < begins), axis + 1, first)
        begins = jnp.where(changes & (depth < begins), depth, begins)
        last = jnp.where(changes & (depth > ends), axis + 1, last)
        ends = jnp.where(changes & (depth > ends), depth, ends)
    return first, last


def _labels_behind(crossings: Crossings, volume: Volume) -> list[Int[Array, ""]]:
    """The labels where a part of a cell begins, and just behind each of its crossings."""

    def places(node: Node, sides: Node, depths: Vec3) -> list[Int[Array, ""]]:
        return [
            flat_index(_moved(node, sides, [depth <= at for depth in depths]), volume.shape)
            for at in (jnp.full_like(depths[0], -jnp.inf), *depths)
        ]

    def read(places: list[Int[Array, ""]]) -> list[Int[Array, ""]]:
        return [volume.label_at(place) for place in places]

    # A kernel that gathers is computed for one cell after the other (AVX2): the places, and what is made of
    # the labels, are kernels of their own.
    live = volume.spacing[0] > 0
    return in_memory(live, read, in_memory(live, places, *crossings))


def _moved(node: Node, sides: Node, crossed: list[Bool[Array, ""]]) -> Node:
    """The node behind the planes that are crossed."""
    i, j, k = (n + jnp.where(is_, side, 0) for n, side, is_ in zip(node, sides, crossed, strict=True))
    return i, j, k


def _face(cell: Cell, number: Int[Array, ""], parts: Any, path: Path, volume: Volume) -> Scalar:
    """The depth just behind a plane, given by its part of the cell and its axis, with which it moves."""
    still = jax.lax.stop_gradient
    part, axis = jnp.maximum(number - 1, 0) // 3, jnp.maximum(number - 1, 0) % 3

    def chosen(values: Any) -> Array:
        return jnp.where(axis == 0, values[0], jnp.where(axis == 1, values[1], values[2]))

    crossings = _crossings(cell, part, parts, still(path), volume)
    depth = jnp.where(number > 0, chosen(crossings.depths), cell.front)
    plane = _plane(chosen(crossings.node), chosen(crossings.sides), depth.dtype)
    coordinate = chosen(path(depth))
    _, slope = jax.jvp(still(path), (depth,), (jnp.ones_like(depth),))
    rate = chosen(slope)
    rate = jnp.where(rate == 0, 1, rate)
    # so far behind it that a sample there reads the label behind
    nodes = jnp.asarray(chosen(volume.shape), depth.dtype)
    margin = 4 * float(jnp.finfo(depth.dtype).eps) * nodes / jnp.abs(rate)
    return depth + jnp.where(number > 0, (plane - coordinate) / rate + margin, 0)


def _plane(node: Int[Array, ""], side: Int[Array, ""], dtype: Any) -> Scalar:
    """The coordinate half-way between a node and the next one on this side."""
    return node.astype(dtype) + 0.5 * side.astype(dtype)
