"""How is a volume split into bricks, and in which order are these rendered?"""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from .._util.vec3 import Vec3, apart
from ..scene.camera import Camera, axes_of
from ..scene.space import Space, Straight


Node = tuple[int, int, int]


@dataclass(frozen=True)
class BrickGrid:
    """Bricks of equally many cells; the last ones along an axis may have fewer. Bricks are numbered in
    row-major order.

    - `shape`: nodes of the volume. `size`: cells of a brick.
    """

    shape: Node
    size: Node

    @property
    def counts(self) -> Node:
        """Number of bricks along each axis."""
        x, y, z = (-(-(n - 1) // s) for n, s in zip(self.shape, self.size, strict=True))
        return x, y, z

    @property
    def number(self) -> int:
        """Number of all bricks."""
        return math.prod(self.counts)

    def cells(self, brick: int) -> tuple[Node, Node]:
        """First cell of a brick along each axis, and the one after its last: also the nodes between which it
        lies."""
        index = np.unravel_index(brick, self.counts)
        x, y, z = (int(i) * s for i, s in zip(index, self.size, strict=True))
        end = [min(a + s, n - 1) for a, s, n in zip((x, y, z), self.size, self.shape, strict=True)]
        return (x, y, z), (end[0], end[1], end[2])

    def brick_of(self, coordinate: Vec3) -> Int[Array, "..."]:
        """The brick in which a grid coordinate lies, or the nearest one. NaN lies in any."""
        number = jnp.zeros(jnp.shape(coordinate[0]), jnp.int32)
        for c, size, count in zip(coordinate, self.size, self.counts, strict=True):
            index = jnp.floor(c * (1 / size)).astype(jnp.int32)
            number = number * count + jnp.clip(index, 0, count - 1)
        return number

    def order(self, space: Space, camera: Camera) -> list[int]:
        """All bricks, front to back, by the depth of their centres as the camera sees them.

        Where rays are straight in the grid, no ray meets a brick after one that is behind it in this order:
        depth is counted in bricks there, as the sum of the distances along the three axes, none of which
        falls along a ray. (The distance itself would do for bricks of equal size; the last ones may be
        smaller.) Where rays are curved it is the paper's rule, by distance, and a ray may meet them in
        another order."""
        index = np.stack(np.unravel_index(np.arange(self.number), self.counts), axis=-1)
        centers = (index + 0.5) * self.size
        eye, (_, _, forward) = camera.position, axes_of(camera)
        parallel = camera.parallel_scale is not None
        path = space.path(apart(eye), apart(forward))
        if isinstance(path, Straight):
            # not from the coordinates of two points, which float32 rounds to the same ones far away
            start, rate = (np.array([float(c) for c in part]) for part in (path.start, path.rate))
            if parallel:
                depth = index @ np.sign(rate)
            else:
                depth = np.sum(np.abs(centers - start) / self.size, axis=-1)
        else:
            x, y, z = (jnp.asarray(c) for c in np.minimum(centers, np.asarray(self.shape) - 1).T)
            toward = np.stack(
                [np.asarray(p) for p in jax.vmap(space.point)((x, y, z))], axis=-1
            ) - np.asarray(eye)
            depth = toward @ np.asarray(forward) if parallel else np.linalg.norm(toward, axis=-1)
        return np.argsort(depth, kind="stable").tolist()


def is_straight(space: Space) -> bool:
    """Whether rays are straight in the grid."""
    zero, one = jnp.zeros(()), jnp.ones(())
    return isinstance(space.path((zero, zero, zero), (one, zero, zero)), Straight)
