"""Clipping: shows the part of a volume inside a box and planes, or outside of them."""

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..._util.checks import Arrayable, Flag, finite_array, flag, require, shortened
from ..._util.vec3 import Scalar, Vec3, apart, dot, minus
from ...scene.occupancy import BLOCK, Occupancy
from ...scene.space import Gap, Path, Space
from ...xla.platform import stack
from ..march import Transform


class Clip(Transform):
    """Show only what lies inside a box, and on the side of each plane to which its normal points; or, inside
    out, cut this away and show the rest.

    A ray enters and leaves the volume at the cuts: its first sample lies on the cut face, and
    `AlphaCorrection` cuts its last cell there. With `inside_out`, what is cut away is a gap of the ray, at
    whose ends `AlphaCorrection` cuts cells, too; where a gap comes to reach a ray's entry, the image jumps by
    the error of the step. Values and light stay those of the whole volume.

    Args:
        box: (x_min, x_max, y_min, y_max, z_min, z_max), as `Volume.bounds` has it; world coordinates.
        planes: any number of pairs (origin, normal): a world point of the plane, and a vector of any length
            that points to what is inside, as in VTK's `vtkVolumeMapper.AddClippingPlane` (not PyVista's
            `clip`).
        inside_out: cut away what is inside all of these, and show the rest.

    `box`, `origins` and `normals` are differentiable; where a face of the box coincides with one of the
    volume, the derivative is that of moving it inwards. Without `AlphaCorrection`, gradients miss the jumps
    of the image when a sample crosses a cut. A ray that lies in a plane counts as inside. Inside out, a film
    of less than 2e-6 of the volume's diagonal between a face of the volume and the cut counts as rounding,
    and is not shown.

    Where it fails: `experiments/stability.py`, "jitter behind cuts".

    Raises:
        ValueError: without a box or a plane, for numbers that are not finite, a box whose ends do not
            increase, and a normal of length 0.
    """

    box: Float[Array, "6"] | None
    origins: Float[Array, "planes 3"]
    normals: Float[Array, "planes 3"]
    inside_out: bool = eqx.field(static=True)

    def __init__(
        self,
        box: Arrayable | None = None,
        planes: Sequence[tuple[Arrayable, Arrayable]] = (),
        *,
        inside_out: Flag = False,
    ):
        self.box = None
        if box is not None:
            expected = "(x_min, x_max, y_min, y_max, z_min, z_max), minima below maxima"
            box = finite_array("box", box, (6,))
            self.box = require(
                box, lambda ends: (ends[0::2] < ends[1::2]).all(), f"box must be {expected}; got {{got}}."
            )
        self.origins, self.normals = _planes(planes)
        if box is None and not len(self.origins):
            raise ValueError("Clip must be given a box, planes, or both; got neither.")
        self.inside_out = flag("inside_out", inside_out)

    @property
    def valid(self) -> Bool[Array, ""]:
        box = jnp.array([0.0, 1.0] * 3) if self.box is None else self.box
        return jnp.all(box[0::2] < box[1::2]) & jnp.all(jnp.any(self.normals != 0, axis=1))

    @property
    def leaves_gaps(self) -> bool:
        return self.inside_out

    def clip(self, space: Space) -> Space:
        origins, normals = [*self.origins], [*self.normals]
        if self.box is not None:
            axes = jnp.eye(3, dtype=self.box.dtype)
            origins = [self.box[0::2]] * 3 + [self.box[1::2]] * 3 + origins
            normals = [*axes, *-axes, *normals]
        return _Clipped(space, tuple(map(HalfSpace.of, origins, normals)), self.inside_out)


class HalfSpace(NamedTuple):
    """Points on the side of a plane through `point` to which its unit `normal` points."""

    point: Vec3
    normal: Vec3

    @classmethod
    def of(cls, origin: Float[Array, "3"], normal: Float[Array, "3"]) -> "HalfSpace":
        largest = jax.lax.stop_gradient(jnp.max(jnp.abs(normal)))
        scale = normal / largest  # whose square does not underflow
        return cls(apart(origin), apart(scale / jnp.sqrt(jnp.sum(scale * scale))))

    def height(self, at: Vec3) -> Scalar:
        """Distance of a point from the plane, negative outside."""
        (x, y, z), (px, py, pz) = at, self.point
        return dot(self.normal, (x - px, y - py, z - pz))

    def interval(self, origin: Vec3, direction: Vec3) -> tuple[Scalar, Scalar]:
        """Distances at which a line enters and leaves, or ±infinity; outside, the first is greater."""
        height, rate = self.height(origin), dot(self.normal, direction)
        # Smaller rates count as parallel. Not 0: the derivative of 1/x, 1/x², must be finite.
        parallel = jnp.abs(rate) < float(jnp.finfo(rate.dtype).tiny) ** 0.25
        at = -height / jnp.where(parallel, 1, rate)
        outside = parallel & (height < 0)
        near = jnp.where(~parallel & (rate > 0), at, jnp.where(outside, jnp.inf, -jnp.inf))
        far = jnp.where(~parallel & (rate < 0), at, jnp.where(outside, -jnp.inf, jnp.inf))
        return near, far

    def over(self, grid: Occupancy) -> tuple[Float[Array, "cx cy cz"], Scalar]:
        """Heights of cells' middles, and how far cells reach along the normal, with a rounding margin."""
        shape = grid.occupied.shape
        x, y, z = (
            low + size * (jnp.arange(n, dtype=size.dtype) + 0.5)
            for low, size, n in zip(grid.origin, grid.size, shape, strict=True)
        )
        a, b, c = map(jnp.abs, grid.frame.rises(self.normal))
        # the greatest coordinate, which rounds most
        ends = jnp.stack([jnp.abs(grid.origin[i]) + grid.size[i] * shape[i] for i in range(3)])
        if grid.frame.turned is not None:
            ends = jnp.sum(ends)
        reach = 0.51 * dot((a, b, c), grid.size) + 16 * float(jnp.finfo(ends.dtype).eps) * jnp.max(ends)
        middle = x[:, None, None], y[None, :, None], z[None, None]
        return self.height(grid.frame.vector(middle)), reach


class _Clipped(Space):
    """A space that shows what is inside all `sides`, or only the rest."""

    inner: Space
    sides: tuple[HalfSpace, ...]
    inside_out: bool = eqx.field(static=True)

    @property
    def searches(self) -> bool:
        return self.inner.searches

    @property
    def anchor(self) -> Vec3 | None:
        return self.inner.anchor

    @property
    def local(self) -> "_Clipped":
        if self.anchor is None:
            return self
        sides = tuple(HalfSpace(minus(point, self.anchor), normal) for point, normal in self.sides)
        return _Clipped(self.inner.local, sides, self.inside_out)

    @property
    def whole(self) -> Space:
        return self.inner.whole

    @property
    def diagonal(self) -> Scalar:
        return self.inner.diagonal

    @property
    def middle(self) -> Vec3:
        return self.inner.middle

    def coordinate(self, point: Vec3) -> Vec3:
        return self.inner.coordinate(point)

    def point(self, coordinate: Vec3) -> Vec3:
        return self.inner.point(coordinate)

    def least_distances(self, low: Vec3, high: Vec3) -> Vec3:
        return self.inner.least_distances(low, high)

    def path(self, entry: Vec3, direction: Vec3) -> Path:
        return self.inner.path(entry, direction)

    def _inside(self, origin: Vec3, direction: Vec3) -> tuple[Scalar, Scalar]:
        """Distances at which a line enters and leaves all sides; if not, the first is at least the second."""
        nears, fars = zip(*(side.interval(origin, direction) for side in self.sides), strict=True)
        return reduce(_later, nears), reduce(_earlier, fars)

    def interval(self, origin: Vec3, direction: Vec3) -> tuple[Scalar, Scalar]:
        near, far = self.inner.interval(origin, direction)
        enters, leaves = self._inside(origin, direction)
        if not self.inside_out:
            return _later(near, enters), _earlier(far, leaves)
        film = 16 * float(jnp.finfo(near.dtype).eps) * jax.lax.stop_gradient(self.diagonal)
        # a ray begins at its origin, if that lies in the volume
        begin, cut = jnp.where(near > 0, near, 0), leaves > enters
        first = jnp.where(cut & (enters <= begin + film), _later(near, leaves), near)
        last = jnp.where(cut & (leaves >= far - film), _earlier(far, enters), far)
        return first, last

    def gaps(self, entry: Vec3, direction: Vec3, length: Scalar) -> tuple[Gap, ...]:
        # searched up to the exit of the whole: where a cut lies in a gap, that ends behind it
        _, far = self.inner.interval(entry, direction)
        gaps = self.inner.gaps(entry, direction, _later(length, far))
        if not self.inside_out:
            return gaps
        enters, leaves = self._inside(entry, direction)
        between = (leaves > enters) & (enters > 0) & (leaves < length)
        return *gaps, (jnp.where(between, enters, jnp.inf), jnp.where(between, leaves, jnp.inf))

    def spans(self, entry: Vec3, direction: Vec3) -> tuple[Gap, ...]:
        return self.inner.spans(entry, direction)

    def occupancy(
        self, visible: Bool[Array, "bx by bz"], first: Vec3 | None = None, side: int = BLOCK
    ) -> Occupancy:
        grid = self.inner.occupancy(visible, first, side)
        over = [side.over(grid) for side in self.local.sides]
        if self.inside_out:
            visible = reduce(jnp.logical_or, [height <= reach for height, reach in over])
        else:
            visible = reduce(jnp.logical_and, [height >= -reach for height, reach in over])
        return replace(grid, occupied=grid.occupied & visible)


def _later(a: Scalar, b: Scalar) -> Scalar:
    """The greater distance; of equal ones, the derivatives of `b`."""
    # not by maxima: inside loops on CPU, XLA loses their derivatives (jaxlib 0.10)
    return jnp.where(b >= a, b, a)


def _earlier(a: Scalar, b: Scalar) -> Scalar:
    """The smaller distance; of equal ones, the derivatives of `b`."""
    return jnp.where(b <= a, b, a)


def _planes(planes: Any) -> tuple[Float[Array, "planes 3"], Float[Array, "planes 3"]]:
    try:
        pairs = [(origin, normal) for origin, normal in planes]
    except (TypeError, ValueError) as fault:
        raise ValueError(f"planes must be pairs [(origin, normal), ...]; got {shortened(planes)}.") from fault
    origins, normals = [], []
    for i, (origin, normal) in enumerate(pairs):
        name = f"the normal of planes[{i}]"
        normal, message = finite_array(name, normal, (3,)), f"{name} must not be 0; got {{got}}."
        origins.append(finite_array(f"the origin of planes[{i}]", origin, (3,)))
        normals.append(require(normal, lambda normal: abs(normal).max() > 0, message))
    if not pairs:
        none = finite_array("planes", np.zeros((0, 3)), (0, 3))
        return none, none
    return stack(origins), stack(normals)
