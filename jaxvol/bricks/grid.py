"""How is a volume divided into bricks, and in which order are these rendered?"""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._util.vec3 import Vec3, apart
from ..march.transforms import ToroidalMap
from ..scene.camera import Camera, axes_of
from ..scene.space import Space, Straight


Node = tuple[int, int, int]


@dataclass(frozen=True)
class BrickGrid:
    """Bricks of equally many cells, numbered in row-major order; the last ones along an axis may have fewer.

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
        """All bricks, front to back, by the depth of their centers.

        Where rays are straight in the grid, depth is the sum of the distances along the three axes, counted
        in bricks: none of the three falls along a ray, so that no ray meets a brick after one behind it.
        Where rays are curved, it is the distance from the camera, as in the paper, and a ray may meet bricks
        in another order."""
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
            points = np.stack([np.asarray(c) for c in jax.vmap(space.point)((x, y, z))], axis=-1)
            toward = points - np.asarray(eye)
            depth = toward @ np.asarray(forward) if parallel else np.linalg.norm(toward, axis=-1)
        return np.argsort(depth, kind="stable").tolist()


def is_straight(space: Space) -> bool:
    """Whether rays are straight in the grid."""
    zero, one = jnp.zeros(()), jnp.ones(())
    return isinstance(space.path((zero, zero, zero), (one, zero, zero)), Straight)


def overlap_of(probe: ToroidalMap, grid: BrickGrid) -> list[float]:
    """By how much bricks must overlap at their curved faces along γ, so that each ray meets each brick once.

    A ray may enter a brick, pass through the one nearer to the probe, and come back. If the farther brick
    includes the cap between the curved face and its chord, it need not be rendered again. At a face at the
    distance l from the apex the cap has the height K = l - l cos(θ/2), where θ is the angle of a brick's fan;
    along the sweep, l is measured from the motor axis, and θ is the angle of its sweep. The larger counts.
    With less, rays from side to side of a brick are blended in the wrong order. `render_bricks` does not use
    it for what it reads, which follows from the rays.

    **Arguments:** `probe`: of the volume. `grid`: how it is divided into bricks.

    **Returns:** K* of each face between two bricks, from the probe outwards, voxels.

    Source: Kim, Kwon and Shin 2008, section 3.2.
    """
    cells = [n - 1 for n in grid.shape]
    beta, sigma, gamma = (
        np.asarray(ends, float) for ends in (probe.beta_range, probe.sigma_range, probe.gamma_range)
    )
    sweep, fan, depth = (
        np.ptp(ends) * size / n for ends, size, n in zip((beta, sigma, gamma), grid.size, cells, strict=True)
    )
    at: Float[np.ndarray, " faces"] = gamma[0] + depth * np.arange(1, grid.counts[2])
    from_apex, from_axis = float(probe.b) + at, float(probe.a) + float(probe.b) + at
    height = np.maximum(from_apex * (1 - np.cos(fan / 2)), from_axis * (1 - np.cos(sweep / 2)))
    return (np.maximum(height, 0) * cells[2] / np.ptp(gamma)).tolist()
