"""A transform that a traced number turns on or off, so that all subsets of transforms share one program.

`switch(transform, on)` answers the seams that the transform overrides: as it does where `on` is true, and by
the defaults elsewhere.
Programs of a march with it contain the transform whether it is on or not: that a transform which is not asked
for costs nothing is for static tests to show.
"""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

import jaxvol as jv
from jaxvol.march.beams import EmptySpaceIndex, Skips
from jaxvol.scene.occupancy import BLOCK
from jaxvol.scene.space import Space


def either(on, new, old):
    """`new` where `on` is true, leaf by leaf."""
    return jax.tree.map(partial(jnp.where, on), new, old)


class _Switch(jv.Transform):
    inner: jv.Transform
    on: Bool[Array, ""]

    @property
    def tested_every(self):
        return self.inner.tested_every

    @property
    def block_side(self):
        return self.inner.block_side

    @property
    def valid(self):
        return self.inner.valid


class _Index(EmptySpaceIndex):
    """Another index, or one to which nothing is empty."""

    inner: EmptySpaceIndex
    on: Bool[Array, ""]

    def skips(self, box, stretch):
        return _Skips(self.inner.skips(box, stretch), self.on)

    def within_ranges(self):
        return _Index(self.inner.within_ranges(), self.on)


class _Skips(Skips):
    inner: Skips
    on: Bool[Array, ""]

    def any_visible(self):
        return self.inner.any_visible() | ~self.on

    def skip_to(self, beam, rays, depth):
        return jnp.where(self.on, self.inner.skip_to(beam, rays, depth), depth)


class _Space(Space):
    """A space of which a part is left out, or all of it. What does not differ is that of the whole."""

    clipped: Space
    inner: Space
    on: Bool[Array, ""]

    @property
    def searches(self):
        return self.inner.searches

    @property
    def anchor(self):
        return self.inner.anchor

    @property
    def local(self):
        return _Space(self.clipped.local, self.inner.local, self.on)

    @property
    def diagonal(self):
        return self.inner.diagonal

    @property
    def middle(self):
        return self.inner.middle

    def coordinate(self, point):
        return self.inner.coordinate(point)

    def point(self, coordinate):
        return self.inner.point(coordinate)

    def least_distances(self, low, high):
        return self.inner.least_distances(low, high)

    def path(self, entry, direction):
        return self.inner.path(entry, direction)

    def interval(self, origin, direction):
        return either(self.on, *(s.interval(origin, direction) for s in (self.clipped, self.inner)))

    def gaps(self, entry, direction, length):
        nowhere = jnp.full_like(length, jnp.inf)
        return tuple(
            either(self.on, gap, (nowhere, nowhere)) for gap in self.clipped.gaps(entry, direction, length)
        )

    def occupancy(self, visible, first=None, side=BLOCK):
        return either(self.on, *(s.occupancy(visible, first, side) for s in (self.clipped, self.inner)))


def _clip(self, space):
    return _Space(self.inner.clip(space), space, self.on)


def _start(self, steps, ray):
    return jnp.where(self.on, self.inner.start(steps, ray), steps)


def _shift(self, ray):
    return jnp.where(self.on, self.inner.shift(ray), 0)


def _empty_space(self, occupancy, view):
    return _Index(self.inner.empty_space(occupancy, view), self.on)


def _cut(self, cell, ray, volume):
    first, *others = self.inner.cut(cell, ray, volume)
    end = cell.front + cell.width
    none = type(cell)(end, jnp.zeros_like(end), cell.cut)
    return either(self.on, first, cell), *(either(self.on, piece, none) for piece in others)


def _stop(self, stopped, transmittance):
    return jnp.where(self.on, self.inner.stop(stopped, transmittance), stopped)


SEAMS = {
    "clip": _clip,
    "start": _start,
    "shift": _shift,
    "empty_space": _empty_space,
    "cut": _cut,
    "stop": _stop,
}


STATIC = (
    "joins",
    "ends_at_exit",
    "tested_every",
    "valid",
    "block_side",
    "rules",
    "reads_labels",
    "leaves_gaps",
)


@cache
def _class(kind: type[jv.Transform], part: str) -> type[_Switch]:
    overridden = {name for name in vars(kind) if not name.startswith("_") and hasattr(jv.Transform, name)}
    assert overridden <= {*SEAMS, *STATIC}, f"{kind.__name__} overrides what cannot be switched"
    members = {
        name: seam for name, seam in SEAMS.items() if getattr(kind, name) is not getattr(jv.Transform, name)
    }
    # off, it cuts nothing, and so leaves joined what is; but it does not end cells at the exit
    members |= {"joins": kind.joins, "__annotations__": {}}
    return type(f"Switched{kind.__name__}{part}", (_Switch,), members)


def switch(transform: jv.Transform, on, part: str = "") -> jv.Transform:
    """The transform, if `on`; it may be traced. `part`: tells two switches of one class apart, since a march
    takes each class of transforms once."""
    if type(transform).locate is not jv.Transform.locate:
        raise ValueError("a space is static: compare marches with and without it.")
    on = jax.device_put(np.asarray(on, bool)) if isinstance(on, bool) else jnp.asarray(on, bool)
    return _class(type(transform), part)(transform, on)
