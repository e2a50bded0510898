"""Two scenes that are rendered as a whole and by bricks: one of straight rays, and one of curved ones.

The straight one is longer than other tests' volumes, so that bricks with what is read around them are smaller
than it. The curved space is one whose rays are found in closed form: the roots of a `ToroidalMap`, which the
slow tests use, take 15 s to compile.
"""

from functools import cache
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol._util.vec3 import along, plus
from jaxvol.scene.space import Affine, Path as RayPath, Space, slab_interval

from ..scenes import SIZE


def assert_same(found, whole, tolerance=2e-5, fields=("exhausted",)):
    """Of an image by bricks, as far as `render_bricks` promises."""
    assert np.asarray(whole.rgba)[..., 3].max() > 0.1
    np.testing.assert_allclose(found.rgba, whole.rgba, rtol=0, atol=tolerance)
    np.testing.assert_allclose(found.depth, whole.depth, rtol=1e-6)  # infinite at the same pixels
    for name in fields:
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name), err_msg=name)


# ---- straight ----

SHAPE = (44, 25, 60)
"""So many that several devices are given a copy once, and not for each image."""
PLACE: Any = {"spacing": (1.0, 0.7, 1.3), "origin": (3.0, -2.0, 5.0)}
TRANSFER = jv.TransferFunction.from_points(
    [(60, (0, 0, 0), 0.0), (90, (0.8, 0.7, 0.5), 0.02), (255, (1, 1, 1), 0.9)]
)
CAMERA, WIDE = (
    jv.Camera((190, 90, 190), (23, 6, 44), (0, 1, 0), 22.0, size=size) for size in (SIZE, (65, 43))
)
"""The second one of 9 x 6 beams, the last ones cut: more than a few for each of eight devices."""
LEAPING = jv.March(
    0.5, (jv.Jitter(5), jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination(1e-5)), "midpoint"
)
"""With an `EarlyTermination` of less than what images may differ by: devices that own bricks differ."""


@cache
def balls() -> np.ndarray:
    """Two balls in empty space, the nearer one opaque; x fastest in memory, as in a raw file."""
    x, y, z = np.indices(SHAPE)
    near = (x - 28) ** 2 + (y - 12) ** 2 + (z - 46) ** 2 < 90
    far = (x - 9) ** 2 + (y - 11) ** 2 + (z - 14) ** 2 < 70
    return np.asfortranarray(np.where(near, 200 + z, np.where(far, 90 + z, 0)).astype(np.uint8))


def raw_file(folder: Path) -> Path:
    """The balls in a file whose name tells its shape and type."""
    path = folder / f"balls_{'x'.join(map(str, SHAPE))}_uint8.raw"
    path.write_bytes(balls().tobytes(order="F"))
    return path


@cache
def whole() -> jv.Rendering:
    return of_volume(TRANSFER, CAMERA, LEAPING)


# ---- gradients ----

PLAIN = jv.March(0.5, (jv.Jitter(5),))
"""Without leaps, so that what has no extinction has a gradient, too."""


def weighted(rendering):
    """A number that depends on colours and depths."""
    return _weighted(rendering.rgba, rendering.depth)


@jax.jit
def _weighted(rgba, depth):
    height, width = rgba.shape[:2]
    weights = np.random.default_rng(1).normal(size=(height, width, 4)).astype(np.float32)
    seen = jnp.where(jnp.isfinite(depth), depth, 0)
    return jnp.sum(weights * rgba) + 1e-2 * jnp.sum(weights[..., 0] * seen)


def loss(extinction, position, render):
    """Of an image from this position, and the image. Gradients to more take twice as long to compile."""
    transfer = eqx.tree_at(lambda transfer: transfer.extinction, TRANSFER, extinction)
    camera = eqx.tree_at(lambda camera: camera.position, WIDE, position)
    rendering = render(transfer, camera, PLAIN)
    return weighted(rendering), rendering


AT = TRANSFER.extinction, WIDE.position
gradient_of = jax.grad(loss, (0, 1), has_aux=True)


@cache
def whole_gradient() -> tuple[Any, jv.Rendering]:
    return gradient_of(*AT, of_volume)


def of_volume(*parts, **more):
    return jv.render(jv.Volume(balls(), **PLACE), *parts, **more)


# ---- curved ----


class Bent(jv.Transform):
    """Bends a volume down along x, as a parabola: rays may leave it through its lower face, and come back."""

    bend: Any

    def locate(self, space, volume):
        assert isinstance(space, Affine)
        return _Bent(space, self.bend)


class _Bent(Space):
    flat: Affine
    bend: Any

    @property
    def diagonal(self):
        return 2 * self.flat.diagonal

    @property
    def middle(self):
        return self.flat.middle

    @property
    def low(self):
        zero = jnp.zeros_like(self.flat.high[0])
        return self.flat.point((zero, zero, zero))

    def _down(self, x):
        return self.bend * (x - self.flat.middle[0]) ** 2

    def coordinate(self, point):
        x, y, z = point
        return self.flat.coordinate((x, y, z + self._down(x)))

    @eqx.filter_jit  # where it is computed at once, one program
    def point(self, coordinate):
        x, y, z = self.flat.point(coordinate)
        return x, y, z - self._down(x)

    def least_distances(self, low, high):
        x, y, z = self.flat.spacing
        aside = [jnp.abs(end[0] * x + self.low[0] - self.flat.middle[0]) for end in (low, high)]
        return x, y, z / jnp.sqrt(1 + (2 * self.bend * jnp.maximum(*aside)) ** 2)

    def _below(self, origin, direction, level):
        """Between which depths a ray is below a level of the grid."""
        (x, _, z), (dx, _, dz) = origin, direction
        a, b = self.bend * dx**2, dz / 2 + self.bend * (x - self.flat.middle[0]) * dx
        square = b**2 - a * (z + self._down(x) - level)
        root = jnp.sqrt(jnp.maximum(square, 0))
        return (-b - root) / a, (-b + root) / a

    def interval(self, origin, direction):
        (x0, y0, z0), (x1, y1, z1) = self.low, plus(self.low, self.flat.high)
        near, far = slab_interval(origin, direction, (x0, y0, z0 - self._down(x0)), (x1, y1, z1))
        first, last = self._below(origin, direction, z1)
        near, far = jnp.maximum(near, first), jnp.minimum(far, last)
        left, back = self._below(origin, direction, z0)
        return (
            jnp.where((left <= near) & (near < back), back, near),
            jnp.where((left <= far) & (far < back), left, far),
        )

    def gaps(self, entry, direction, length):
        left, back = self._below(entry, direction, self.low[2])
        some = (left > 0) & (back < length)
        return ((jnp.where(some, left, jnp.inf), jnp.where(some, back, jnp.inf)),)

    def occupancy(self, visible, first=None, side=4):
        raise AssertionError("nothing is leapt over here")

    def path(self, entry, direction):
        return _BentPath(self, entry, direction)


class _BentPath(RayPath):
    space: _Bent
    entry: Any
    direction: Any

    def __call__(self, s):
        return self.space.coordinate(along(self.entry, self.direction, s))


RED, BLUE = (1, 0, 0), (0, 0, 1)
SHEETS = jv.TransferFunction.from_points(
    [(0.2, RED, 0.0), (0.25, RED, 0.05), (0.5, RED, 0.05), (0.55, BLUE, 0.05), (1.0, BLUE, 0.05)], 0.5
)
FROM_THE_SIDE = jv.Camera((120, 10, 40), (11.5, 7.5, 28), (0, 0, 1), 30.0, size=SIZE)
CURVED = jv.March(0.5, (Bent(jax.device_put(np.float32(0.12))), jv.EmptySpaceJitter(0)))


@cache
def fog() -> np.ndarray:
    """Values that grow along z: nothing, then red, then blue, both translucent."""
    return np.broadcast_to(np.linspace(0, 1, 64, dtype=np.float32), (24, 16, 64)).copy()


@cache
def whole_fog() -> jv.Rendering:
    return jv.render(jv.Volume(fog()), SHEETS, FROM_THE_SIDE, CURVED)
