"""How wide is a cell that crosses a face? Sampling alignment, also called alpha correction (Kye 2013)."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from ..._util.checks import flag
from ..._util.vec3 import Scalar
from ...scene.space import Ray
from ...scene.volume import Volume
from ..march import Cell, CellRules, Transform, cut_at_entry, cut_at_exit


PROBES = 4
"""Depths of a cell, besides its front, at which the region is looked up."""

BISECTIONS = 14
"""Bisections of a face, which is found to 2⁻¹⁶ of a step."""


class AlphaCorrection(Transform):
    """Cut the cells of a ray at the faces that they cross.

    A ray's last sample then stands only for the width e up to the exit, and back faces are smooth: its
    opacity is `1 - exp(-extinction e)`, the paper's `1 - (1 - α)^(e/d)`. A volume of constant extinction is
    rendered exactly at any step. Cells are also cut at the ends of a ray's gaps, as under `ToroidalMap` or
    `Clip`; of several gaps in one cell, at the first and the last end.

    With this transform, the image is continuous in all that moves the exit, and its gradient complete.
    Without it, the image jumps when a sample crosses the exit, and the gradient misses these jumps.

    Args:
        labels: also cut cells where the volume's label changes, found by bisection, so that the faces of a
            segmentation stay smooth under jitter. A label that lasts less than a quarter of a cell may be
            missed: rounding decides, and a pixel may differ by 0.01 between float32 and float64. Costs a
            label fetch per bisection, and two more samples per cell. Gradients then take the faces of labels
            and the ends of gaps as fixed in space; the motion of the exit is included.

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

    def __init__(self, labels: bool | Any = False):
        self.labels = flag("labels", labels)

    def cut(self, cell: Cell, ray: Ray, volume: Volume) -> tuple[Cell, ...]:
        return self._divide(cut_at_exit(cell, ray), ray, volume)

    def rules(self, rules: CellRules) -> CellRules:
        return replace(rules, at_exit=np.asarray(True), divide=self._divide)

    @property
    def reads_labels(self) -> bool:
        return self.labels

    @property
    def _divide(self) -> Callable[[Cell, Ray, Volume], tuple[Cell, ...]]:
        return _divided_by_labels if self.labels else _divided_by_gaps


def _divided_by_labels(cell: Cell, ray: Ray, volume: Volume) -> tuple[Cell, ...]:
    return _divided(cell, *_label_faces(cell, ray, volume))


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
    found = jnp.zeros_like(cell.cut)
    for depth in (end for gap in ray.gaps for end in gap):
        here = (depth > cell.front) & (depth < cell.front + cell.width)
        first = jnp.where(here & ~(found & (first < depth)), depth, first)
        last = jnp.where(here & (last < depth), depth, last)
        found |= here
    return first, last, found


def _label_faces(cell: Cell, ray: Ray, volume: Volume) -> tuple[Scalar, Scalar, Bool[Array, ""]]:
    """Where a cell's label first and last changes, and whether it does. Gaps have a label of their own."""

    def region(s: Scalar) -> Int[Array, ""]:
        return jnp.where(ray.in_gap(s), -1, volume.label(ray.path(s)))

    cell = jax.lax.stop_gradient(cut_at_entry(cell))  # in front of the entry lies no face
    depths = [cell.front + cell.width * (i / PROBES) for i in range(PROBES + 1)]
    regions = [region(depth) for depth in depths]

    def face(depths: list[Scalar], regions: list[Array]) -> tuple[Scalar, Scalar]:
        """Both sides of the face where the region first differs from that at the first depth."""
        inner, near, far = regions[0], depths[0], depths[0]
        for i in reversed(range(PROBES)):
            changed = regions[i + 1] != inner
            near, far = jnp.where(changed, depths[i], near), jnp.where(changed, depths[i + 1], far)

        def halve(_: Any, bracket: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
            near, far = bracket
            middle = (near + far) / 2
            same = region(middle) == inner
            return jnp.where(same, middle, near), jnp.where(same, far, middle)

        return jax.lax.fori_loop(0, BISECTIONS, halve, (near, far))

    # each piece begins on its own side of the face, since it is sampled there
    _, first = face(depths, regions)
    last, _ = face(depths[::-1], regions[::-1])
    return first, last, jnp.any(jnp.stack(regions) != regions[0])
