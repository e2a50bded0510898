"""How wide is a cell that crosses a face? Sampling alignment, also called alpha correction (Kye 2013), at the
exit; the same idea at faces of labels and gaps."""

from collections.abc import Callable
from typing import Any, ClassVar, TypeAlias

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
"""Inner end, outer end, and whether the region at the outer end differs from the inner one."""

PROBES = 4
"""Depths per cell, besides its front, at which the region is looked up: a region that lasts a quarter of a
step or more is not missed."""

BISECTIONS = 14
"""Bisections per face: it is located to 2⁻¹⁶ of a step, below what float32 resolves along most rays."""


class AlphaCorrection(Transform):
    """Cut the cells of a ray at the faces that they cross.

    The last sample's cell extends past the exit, by a different fraction of a step in every pixel, which
    makes the back face of a non-transparent volume bumpy. With this transform, that sample stands only for
    the width e up to the exact exit: its opacity becomes `1 - exp(-extinction e)`, which is the paper's
    `1 - (1 - α)^(e/d)`. A volume of constant extinction is rendered exactly at any step.

    Where a ray may leave the volume and re-enter it, as under `ToroidalMap`, the faces of such gaps are
    found by bisection and cells are cut there, too; a gap shorter than a quarter of a cell may be missed.

    With this transform, the image is continuous in the camera and in everything else that moves the exit,
    and its gradient is complete. Without it, the image jumps when a sample crosses the exit, and the
    gradient with respect to the camera misses these jumps.

    **Arguments:**

    - `labels`: also cut cells where the volume's label changes between two samples; the face is found by
      bisection. The part before it is classified at the sample, the part behind it at the face: each by
      its own label, so that the faces of a segmentation stay smooth under jitter. A label that lasts less
      than a cell may be missed. Costs a label fetch per bisection, and a second sample per cell.

    Gradients treat the faces of labels and gaps as fixed in space: with respect to the camera, they miss
    how such a face moves along a ray. The motion of the exit is included.

    Where it fails, and where not: `experiments/stability.py`, "grazing exits", "exits at the end of a cell",
    "jitter at label faces", "gradients at label faces".

    **Raises:** `ValueError` when a volume without labels is rendered with `labels=True`.

    Source: Kye 2013, section 3.2 (sampling position alignment), for the cut at the exit. The cuts at faces
    of labels and gaps are not in the paper, which names the noise of jitter at the faces of a segmentation
    as future work.
    """

    joins: ClassVar[bool] = True
    ends_at_exit: ClassVar[bool] = True

    labels: bool = eqx.field(static=True, default=False)

    def cut(self, cell: Cell, ray: Ray, volume: Volume) -> tuple[Cell, ...]:
        back = cell.front + cell.width
        reaches_past = back > ray.length
        # A cell entirely past the exit is not sampled; its width only has to be ≥ 0.
        # Not jnp.maximum: inside loops on CPU, XLA loses its derivative (jaxlib 0.10).
        left = jnp.where(cell.front < ray.length, ray.length - cell.front, 0)
        # A cell that ends at the exit is not cut, but its width is the exit's to change.
        cell = Cell(cell.front, jnp.where(back >= ray.length, left, cell.width), cell.cut | reaches_past)
        if not self.labels and not ray.path.gaps:
            return (cell,)

        def region(s: Scalar) -> Int[Array, ""]:
            coordinate = ray.path(s)
            inside = ray.path.contains(coordinate)
            return jnp.where(inside, volume.label(coordinate) if self.labels else 0, -1)

        return _divided(cell, region)


def _divided(cell: Cell, region: Region) -> tuple[Cell, Cell, Cell]:
    """Split a cell where its region first and last changes: three pieces, front to back. If the region does
    not change, the last two have width 0."""
    front, width = jax.lax.stop_gradient((cell.front, cell.width))
    depths = [front + width * (i / PROBES) for i in range(PROBES + 1)]
    regions = [region(depth) for depth in depths]

    def face(inner: Int[Array, ""], brackets: list[Bracket]) -> tuple[Scalar, Scalar]:
        """Both sides of the face where the region stops being `inner`, in the first bracket whose outer end
        lies in another region."""
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
    forward = list(zip(depths, depths[1:], changed_to[1:], strict=False))
    backward = list(zip(depths[:0:-1], depths[-2::-1], changed_from[-2::-1], strict=True))
    changes = jnp.any(jnp.stack(changed_to))
    # each piece begins on its own side of the face, since it is sampled there
    _, first = face(regions[0], forward)
    last, _ = face(regions[-1], backward)
    end = cell.front + cell.width
    first = jnp.where(changes, first, end)
    last = jnp.where(changes, last, end)
    last = jnp.where(last < first, first, last)
    return (
        Cell(cell.front, first - cell.front, cell.cut & (first >= end)),
        Cell(first, last - first, cell.cut & (first < end) & (last >= end)),
        Cell(last, end - last, cell.cut),
    )
