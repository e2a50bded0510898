"""Maps between the world and the grid, and rays clipped to the grid: a `Space` (seam `locate`). Rays are
straight in the grid of the default, `Affine`; other spaces return another `Path`."""

import math
from abc import abstractmethod
from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple, TypeAlias, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._util.vec3 import Frame, Scalar, Vec3, along, apart, minus, plus, times
from .occupancy import BLOCK, Occupancy, Sums
from .several import Several
from .volume import Volume


class Path(eqx.Module):
    """A ray in grid coordinates."""

    @abstractmethod
    def __call__(self, s: Scalar) -> Vec3:
        """Grid coordinate at depth `s`, in world length past the entry."""


Gap: TypeAlias = tuple[Scalar, Scalar]
"""Entry and exit depth of an interval along a ray, such as one outside the grid."""

CUBES = 48
"""Cells per side of the cube around a space, in its default occupancy grid."""

FAR = 1e6
"""Nodes: beyond any grid."""


class Space(eqx.Module):
    """The mapping between the world and a volume's grid, which `Transform.locate` returns. Methods take one
    point or ray, as tuples of three numbers, and work elementwise.

    A subclass overrides `coordinate`, `interval`, `middle` and `diagonal`; `gaps` if rays may leave the grid
    and come back; `least_distances`, so that rays leap over empty space; and `point`, for `plan`,
    `render_bricks`, and lighting by `ScattererTemplates`. The node `data[i, j, k]` has the coordinate
    (i, j, k). From its entry to its exit, except in its gaps, a ray must be inside the grid. Float arrays
    have gradients through `coordinate`, `interval` and `gaps`.
    """

    @property
    def searches(self) -> bool:
        """True if `interval` and `gaps` are loops."""
        return False

    @property
    def anchor(self) -> Vec3 | None:
        """A world point near the volume, the origin of points in `local` and `occupancy`, since float32 is
        coarse far from the world's origin. None: the world's origin."""
        return None

    @property
    def local(self) -> "Space":
        """The same space for points relative to `anchor`."""
        return self

    def world(self, place: Vec3) -> Vec3:
        """World point of a point relative to `anchor`."""
        return place if self.anchor is None else plus(self.anchor, place)

    def place(self, point: Vec3) -> Vec3:
        """A world point, relative to `anchor`."""
        return point if self.anchor is None else minus(point, self.anchor)

    @property
    def whole(self) -> "Space":
        """The space without clips, since light is that of the whole volume."""
        return self

    @property
    @abstractmethod
    def diagonal(self) -> Scalar:
        """Upper bound on the length of a ray through the grid."""

    @property
    @abstractmethod
    def middle(self) -> Vec3:
        """World point within half of `diagonal` of every point of the grid."""

    @abstractmethod
    def interval(self, origin: Vec3, direction: Vec3) -> tuple[Scalar, Scalar]:
        """Distances at which a line enters and leaves the grid; on a miss, the first exceeds the second."""

    def gaps(self, entry: Vec3, direction: Vec3, length: Scalar) -> tuple[Gap, ...]:
        """Depths between which a line is outside the grid, from its entry to its exit at `length`: a static
        number of gaps in any order, which may overlap; unused gaps begin at infinity."""
        return ()

    def spans(self, entry: Vec3, direction: Vec3) -> tuple[Gap, ...]:
        """Entry and exit depth for each volume of a group, () for one volume. On a miss, exit < entry."""
        return ()

    @abstractmethod
    def coordinate(self, point: Vec3) -> Vec3:
        """Grid coordinate of a world point."""

    def point(self, coordinate: Vec3) -> Vec3:
        """World point of a grid coordinate.

        Raises:
            ValueError: unless it is overridden.
        """
        raise ValueError(f"{type(self).__name__} needs a method point(coordinate), inverse to coordinate.")

    def least_distances(self, low: Vec3, high: Vec3) -> Vec3:
        """Least world distance between neighbouring layers of nodes along each axis (the reciprocal of the
        steepest rise of the coordinate), in a box of grid coordinates that may exceed the grid; 0 where nodes
        coincide or the coordinate jumps. By default 0: unknown."""
        zero = jnp.zeros_like(low[0])
        return zero, zero, zero

    def occupancy(
        self, visible: Bool[Array, "bx by bz"], first: Vec3 | None = None, side: int = BLOCK
    ) -> Occupancy:
        """Cells that may hold anything visible, relative to `anchor`, from the visible blocks of `side`³
        cells of the grid, or of a part of it that begins at the node `first`. By default, cubes of the world
        from which a visible block is in reach by `least_distances`."""
        space, middle, width = jax.lax.stop_gradient(
            (self.local, self.place(self.middle), self.diagonal / CUBES)
        )
        low = cast(Vec3, tuple(m - width * CUBES / 2 for m in middle))
        middles = (m + width * (jnp.arange(CUBES, dtype=m.dtype) + 0.5) for m in low)
        x, y, z = jnp.meshgrid(*middles, indexing="ij")
        center, radius = space.coordinate((x, y, z)), width * (math.sqrt(3) / 2 + 1e-3)

        def changes(box: Sequence[Scalar]) -> list[Scalar]:
            """Most that coordinates change in the sphere around a cube, if they stay in this box."""
            ends = ([c + sign * b for c, b in zip(center, box, strict=True)] for sign in (-1, 1))
            distances = space.least_distances(*(cast(Vec3, tuple(end)) for end in ends))
            return [radius / jnp.maximum(d, radius / FAR) for d in distances]

        zero = jnp.zeros_like(x)
        box = [2 * change for change in changes([zero, zero, zero])]
        # Coordinates stay in a box in which none may change by more than the box. Where one may, the box
        # becomes all of its axis, and the others are tested again.
        for _ in range(3):
            pairs = zip(changes(box), box, strict=True)
            box = [jnp.where(change <= half, half, FAR) for change, half in pairs]
        reached = blocks_in_reach(center, changes(box), visible, first, side)
        return Occupancy(reached, low, (width, width, width), anchor=self.anchor)

    def path(self, entry: Vec3, direction: Vec3) -> Path:
        """The straight world ray from `entry`, in grid coordinates."""
        return Curved(self, entry, direction)


class Line(NamedTuple):
    """A ray before it is clipped to the volume: origin, unit direction, (column, row), end distance, and an
    offset `beside` of the origin, added relative to the volume, since float32 would lose it in the world."""

    origin: Vec3
    direction: Vec3
    pixel: tuple[Int[Array, ""], Int[Array, ""]]
    until: Scalar | None = None
    beside: Vec3 | None = None


class Ray(eqx.Module):
    """One ray, clipped to the volume. Depths are relative to the entry, for float32 and far cameras."""

    entry: Vec3
    """Entry point into the volume, relative to the `anchor` of its space."""
    direction: Vec3
    """Unit direction in the world."""
    t_in: Scalar
    """Distance from the ray's origin to the entry."""
    length: Scalar
    """Distance from entry to exit; 0 on a miss."""
    path: Path
    pixel: tuple[Int[Array, ""], Int[Array, ""]]
    """(column, row); seeds all random numbers of the ray."""
    gaps: tuple[Gap, ...] = ()
    """Depths between entry and exit where the ray is outside the volume."""
    spans: tuple[Gap, ...] = ()
    """Entry and exit depth for each volume of a group."""
    reach: Scalar | None = None
    """End of sampling; None: the exit."""

    @property
    def end(self) -> Scalar:
        """Depth at which sampling ends."""
        return self.length if self.reach is None else self.reach

    def contains(self, depth: Scalar) -> Bool[Array, "..."]:
        """True where a depth is sampled inside the volume: neither past the end nor in a gap."""
        inside = depth < self.end
        for begin, end in self.gaps:
            inside &= ~((depth >= begin) & (depth < end))
        return inside


def enter(
    space: Space,
    origin: Vec3,
    direction: Vec3,
    pixel: tuple[Int[Array, ""], Int[Array, ""]],
    until: Scalar | None = None,
    offset: Vec3 | None = None,
) -> Ray:
    """Clip a ray to the volume, ahead of its origin (+ `offset`) and to `until`; `invalid` if not finite."""
    origin, space = space.place(origin), space.local
    if offset is not None:
        origin = plus(origin, offset)
    # distances are relative to a point close to the volume, since those from a far camera are rounded
    toward = sum((m - o) * d for m, o, d in zip(space.middle, origin, direction, strict=True))
    base = jax.lax.stop_gradient(jnp.maximum(toward - space.diagonal / 2, 0))
    close = along(origin, direction, base)
    near, far = space.interval(close, direction)
    start = jnp.maximum(near, -base)
    hit = far > start
    start = jnp.where(hit, start, 0)  # a miss has infinite distances, whose products are NaN
    entry = along(close, direction, start)
    length = jnp.where(hit, far - start, 0)
    # gaps may reach past the end of the ray
    path, gaps = space.path(entry, direction), space.gaps(entry, direction, length)
    spans = space.spans(entry, direction)
    fault = ~jnp.isfinite(toward)
    if until is not None:
        until_depth = until - base - start
        length = jnp.where(until_depth < length, jnp.where(until_depth > 0, until_depth, 0), length)
        fault |= jnp.isnan(until)
    ray = Ray(entry, direction, base + start, length, path, pixel, gaps, spans)
    return invalid(ray, fault)


def invalid(ray: Ray, fault: Bool[Array, "..."]) -> Ray:
    """Replace the ray where `fault` is true by one of length 0 that renders as NaN: a march might not end."""
    t_in, length = jnp.where(fault, jnp.nan, ray.t_in), jnp.where(fault, 0, ray.length)
    return eqx.tree_at(lambda ray: (ray.t_in, ray.length), ray, (t_in, length))


class Curved(Path):
    """A straight world ray in any grid."""

    space: Space
    entry: Vec3
    direction: Vec3

    def __call__(self, s: Scalar) -> Vec3:
        return self.space.coordinate(along(self.entry, self.direction, s))


class Straight(Path):
    """A path that is straight in the grid: `start + s rate`."""

    start: Vec3
    rate: Vec3

    def __call__(self, s: Scalar) -> Vec3:
        return along(self.start, self.rate, s)


class Affine(Space):
    """A grid given by spacing, origin and direction."""

    first: Vec3 | None
    """The first node; None: points are relative to it."""
    high: Vec3
    """The last node, relative to the first one, along the axes of `frame`."""
    spacing: Vec3
    frame: Frame
    inner: "tuple[Affine, ...]"
    """The grids of a group of volumes inside this one."""

    def __init__(self, volume: Volume):
        field = volume.field
        self.inner = tuple(map(Affine, field.volumes)) if isinstance(field, Several) else ()
        self.first, self.spacing, self.frame = apart(volume.origin), apart(volume.spacing), volume.frame
        x, y, z = (
            step * jnp.asarray(n - 1, step.dtype) for step, n in zip(self.spacing, volume.shape, strict=True)
        )
        self.high = x, y, z

    @property
    def anchor(self) -> Vec3 | None:
        return self.first

    @property
    def local(self) -> "Affine":
        if self.first is None:
            return self
        firsts = [minus(cast(Vec3, grid.first), self.first) for grid in self.inner]
        inner = tuple(eqx.tree_at(lambda g: g.first, *pair) for pair in zip(self.inner, firsts, strict=True))
        return eqx.tree_at(lambda space: (space.first, space.inner), self, (None, inner))

    @property
    def diagonal(self) -> Scalar:
        return self.frame.diagonal(self.high)

    @property
    def middle(self) -> Vec3:
        half = jnp.full_like(self.high[0], 0.5)
        return self.world(self.frame.vector(times(self.high, (half, half, half))))

    def interval(self, origin: Vec3, direction: Vec3) -> tuple[Scalar, Scalar]:
        zero = jnp.zeros_like(self.high[0])
        return slab_interval(
            self._components(origin), self.frame.components(direction), (zero, zero, zero), self.high
        )

    def spans(self, entry: Vec3, direction: Vec3) -> tuple[Gap, ...]:
        return tuple(grid.interval(entry, direction) for grid in self.inner)

    def coordinate(self, point: Vec3) -> Vec3:
        # times the reciprocal: XLA stores quotients that are used more than once
        x, y, z = (p * (1 / step) for p, step in zip(self._components(point), self.spacing, strict=True))
        return x, y, z

    def point(self, coordinate: Vec3) -> Vec3:
        return self.world(self.frame.vector(times(coordinate, self.spacing)))

    def least_distances(self, low: Vec3, high: Vec3) -> Vec3:
        x, y, z = (step * (1 / self.frame.stretch) for step in self.spacing)
        return x, y, z

    def occupancy(
        self, visible: Bool[Array, "bx by bz"], first: Vec3 | None = None, side: int = BLOCK
    ) -> Occupancy:
        x, y, z = (side * step for step in self.spacing)
        zero = jnp.zeros_like(x)
        low = (zero, zero, zero) if first is None else times(first, self.spacing)
        return Occupancy(visible, low, (x, y, z), self.frame, self.anchor)

    def path(self, entry: Vec3, direction: Vec3) -> Straight:
        direction = self.frame.components(direction)
        dx, dy, dz = (d / step for d, step in zip(direction, self.spacing, strict=True))
        return Straight(self.coordinate(entry), (dx, dy, dz))

    def _components(self, point: Vec3) -> Vec3:
        """Components of a point along the axes, relative to the first node."""
        return self.frame.components(self.place(point))


def blocks_in_reach(
    center: Vec3,
    changes: Sequence[Scalar],
    visible: Bool[Array, "bx by bz"],
    first: Vec3 | None,
    side: int,
    lasts: Sequence[int] | None = None,
) -> Bool[Array, "cx cy cz"]:
    """Mask of cells, True where a visible block is in reach from the `center` by these `changes` of its
    coordinates. `visible`, `first`, `side`: as for `Space.occupancy`. `lasts`: last node along each axis."""
    begin, stop, reached = [], [], jnp.ones(center[0].shape, bool)
    for axis, (change, blocks) in enumerate(zip(changes, visible.shape, strict=True)):
        c = center[axis] - (0 if first is None else first[axis])
        last = side * blocks if lasts is None else min(lasts[axis], side * blocks)
        nodes = change + 1e-3 * (last + 1)
        reached &= (c + nodes >= 0) & (c - nodes <= last)
        for end, bounds in ((c - nodes, begin), (c + nodes, stop)):
            bounds.append(jnp.clip(jnp.floor(end / side).astype(jnp.int32), 0, blocks - 1))
    shows = Sums.of(visible).any_between((begin[0], begin[1], begin[2]), (stop[0], stop[1], stop[2]))
    return reached & shows


def slab_interval(origin: Vec3, direction: Vec3, low: Vec3, high: Vec3) -> tuple[Scalar, Scalar]:
    """Distances at which a line enters and leaves a box; on a miss, the first exceeds the second."""
    nears, fars = zip(*map(_slab, origin, direction, low, high), strict=True)
    return reduce(jnp.maximum, nears), reduce(jnp.minimum, fars)


def median_node_distance(space: Space, *middles: Array) -> Scalar:
    """Size of a voxel: median over grid coordinates of the least world distance between nodes."""

    def distance(x: Scalar, y: Scalar, z: Scalar) -> Scalar:
        jacobian = jax.jacfwd(lambda c: jnp.stack(space.point((c[0], c[1], c[2]))))(jnp.stack([x, y, z]))
        return jnp.sqrt(jnp.min(jnp.sum(jacobian * jacobian, axis=0)))

    coordinates = [middle.astype(space.middle[0].dtype) for middle in middles]
    return jnp.median(jnp.vectorize(distance)(*jnp.meshgrid(*coordinates, indexing="ij")))


def world_gradient(volume: Volume, space: Space, point: Vec3) -> Vec3:
    """World gradient of the value: `Volume.gradient` times the transposed Jacobian of `coordinate`."""
    coordinate, transpose = jax.vjp(space.coordinate, point)
    slopes = volume.gradient(coordinate)
    per_node = tuple(slope * volume.spacing[i] for i, slope in enumerate(slopes))
    return transpose(per_node)[0]


def _slab(origin: Scalar, direction: Scalar, low: Scalar, high: Scalar) -> tuple[Scalar, Scalar]:
    """Distances to the nearer and the farther of two parallel planes."""
    # smaller components count as parallel: the derivative of 1/d, 1/d², must be finite
    parallel = jnp.abs(direction) < float(jnp.finfo(direction.dtype).tiny) ** 0.25
    slope = jnp.where(parallel, 1, direction)
    a, b = (low - origin) / slope, (high - origin) / slope
    between = (low <= origin) & (origin <= high)
    near = jnp.where(parallel, jnp.where(between, -jnp.inf, jnp.inf), jnp.minimum(a, b))
    far = jnp.where(parallel, jnp.where(between, jnp.inf, -jnp.inf), jnp.maximum(a, b))
    return near, far
