"""How wide is a cell that meets a face? Sampling alignment, also called alpha correction (Kye 2013), for the
exit; the same idea for faces of labels and of gaps."""

from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._util.vec3 import Scalar
from ..march import Cell, Transform
from ..space import Ray
from ..volume import Volume


Region: TypeAlias = Callable[[Scalar], Int[Array, ""]]
Bracket: TypeAlias = tuple[Scalar, Scalar, Bool[Array, ""]]
"""Inner end, outer end, whether the region at the outer end is another than that looked for."""

PROBES = 4
"""Places in a cell, beside its front, at which the region is looked up: what lasts a quarter of a step or
more is not missed."""

BISECTIONS = 14
"""A face is found to 2⁻¹⁶ of a step, below what float32 resolves along most rays."""


class AlphaCorrection(Transform):
    """Cut the cells of a ray at the faces that they reach across.

    The last sample's cell reaches past the exit, by a different part of a step in every pixel, which
    makes the back face of a non-transparent volume bumpy. Here that sample stands for the width e up to
    the exact exit alone: its opacity becomes `1 - exp(-extinction e)`, which is the paper's
    `1 - (1 - α)^(e/d)`. A volume of constant extinction comes out exact at any step.

    Where a ray may leave the volume and come back, as under `ToroidalMap`, the faces of such gaps are
    found by bisection and cells cut there, too; a gap shorter than a quarter of a step may be missed.

    With it the image is continuous in the camera and in everything else that moves the exit, and its
    gradient is whole. Without it the image jumps when a sample crosses the exit, and the gradient
    with respect to the camera misses these jumps.

    **Arguments:**

    - `labels`: cut cells also where the volume's label changes between two samples, the face found by
      bisection. The part before it is classified at the sample, the part behind at the face, each so by
      its own label, and faces of a segmentation stay smooth under jitter. A label that lasts less than
      a step may be missed. Costs a label fetch for every bisection, and a second sample for every cell.

    Gradients take the faces of labels and of gaps as fixed in space: with respect to the camera they miss
    how such a face moves along a ray. The exit's motion they hold.

    **Raises:** `ValueError` when rendering with `labels=True` a volume that has none.

    Source: Kye 2013, section 3.2 (sampling position alignment), for the cut at the exit. The cuts at faces
    of labels and of gaps are not in the paper, which names the noise that jitter makes at the faces of a
    segmentation as future work.
    """

    labels: bool = eqx.field(static=True, default=False)

    def cut(self, cell: Cell, ray: Ray, volume: Volume) -> tuple[Cell, ...]:
        reaches_past = cell.front + cell.width > ray.length
        # A cell that lies past the exit altogether is not sampled; its width just has to be ≥ 0.
        # Not by a maximum, whose derivative XLA loses in the loops of the CPU (jaxlib 0.10).
        left = jnp.where(cell.front < ray.length, ray.length - cell.front, 0)
        cell = Cell(cell.front, jnp.where(reaches_past, left, cell.width), cell.cut | reaches_past)
        if not self.labels and not ray.path.gaps:
            return (cell,)

        def region(s: Scalar) -> Int[Array, ""]:
            coordinate = ray.path(s)
            inside = ray.path.contains(coordinate)
            return jnp.where(inside, volume.label(coordinate) if self.labels else 0, -1)

        return _divided(cell, region)


def _divided(cell: Cell, region: Region) -> tuple[Cell, Cell, Cell]:
    """The cell up to where its region first changes, from where it last changes, and what lies between;
    where nothing changes, the last two have width 0."""
    front, width = jax.lax.stop_gradient((cell.front, cell.width))
    places = [front + width * (i / PROBES) for i in range(PROBES + 1)]
    regions = [region(place) for place in places]

    def face(inner: Int[Array, ""], brackets: list[Bracket]) -> tuple[Scalar, Scalar]:
        """Either side of the face at which the region ceases to be `inner`, in the first bracket at whose
        outer end it is another."""
        near, far = brackets[0][0], brackets[0][0]
        for start, stop, changed in reversed(brackets):
            near, far = jnp.where(changed, start, near), jnp.where(changed, stop, far)

        def halve(_: Any, bracket: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
            near, far = bracket
            middle = (near + far) / 2
            same = region(middle) == inner
            return jnp.where(same, middle, near), jnp.where(same, far, middle)

        return jax.lax.fori_loop(0, BISECTIONS, halve, (near, far))

    changed_to = [r != regions[0] for r in regions]
    changed_from = [r != regions[-1] for r in regions]
    forward = list(zip(places, places[1:], changed_to[1:], strict=False))
    backward = list(zip(places[:0:-1], places[-2::-1], changed_from[-2::-1], strict=True))
    changes = jnp.any(jnp.stack(changed_to))
    # each piece begins on its own side of the face, where it is sampled
    _, first = face(regions[0], forward)
    last, _ = face(regions[-1], backward)
    end = cell.front + cell.width
    first = jnp.where(changes, first, end)
    last = jnp.maximum(first, jnp.where(changes, last, end))
    return (
        Cell(cell.front, first - cell.front, cell.cut & (first >= end)),
        Cell(first, last - first, cell.cut & (first < end) & (last >= end)),
        Cell(last, end - last, cell.cut),
    )
