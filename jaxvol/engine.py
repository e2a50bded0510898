"""How are many rays rendered? In tiles, each marched as one batch until its last ray is finished.

Rays are made tile by tile from the camera, and a tile's memory is all that a march holds beside the
finished pixels, however large the image. Tiles are square, so that the rays of one see much the same
part of the volume and finish together.
"""

import math
from collections.abc import Callable
from typing import Any, Literal, TypeAlias, get_args

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .camera import Camera
from .checks import Arrayable, finite, require
from .locate import enter
from .march import March
from .reference import Progress, begin, end, samples_across, step
from .rendering import Rendering
from .transfer import Classify, Transfer
from .triple import Scalar, Triple
from .volume import Volume


Adjoint: TypeAlias = Literal["replay", "forward", "direct"]
Lanes: TypeAlias = Float[Array, " rays"]
Points: TypeAlias = tuple[Lanes, Lanes, Lanes]
Pixels: TypeAlias = tuple[Int[Array, " rays"], Int[Array, " rays"]]

TILE = 64
"""Pixels along the side of a tile: 4096 rays. Smaller batches drown in kernel launches, larger ones
leave the cache."""

CHECKPOINTS = 16
"""States that a replay keeps per ray: from the nearest one before it, each sample is computed again."""


def render(
    volume: Volume,
    transfer: Transfer,
    camera: Camera,
    march: March,
    *,
    adjoint: Adjoint = "replay",
) -> Rendering:
    """The image of a volume.

    **Arguments:**

    - `volume`, `transfer`: what is there, and how it looks.
    - `camera`: one ray for each pixel.
    - `march`: step and transforms.
    - `adjoint`: how the image is differentiated; the image itself is the same.
        - `"replay"`: reverse mode (`jax.grad`). A backward march recomputes the samples, so that
          memory does not grow with their number. A gradient to the volume passes over the whole
          volume at every step, and is slow.
        - `"forward"`: forward mode (`jax.jvp`, `jax.jacfwd`).
        - `"direct"`: both, and higher derivatives, by letting JAX differentiate
          `render_ray_reference`. Memory grows with the number of samples.

    **Returns:** a `Rendering` with leading shape (height, width), in float32.

    **Raises:** `ValueError` for an unknown adjoint, and for `"direct"` where the march or the spacing
    is traced and `march.max_samples` is not given.

    Without `AlphaCorrection` the gradient of an image with respect to the camera, the spacing and
    whatever else moves the exit is wrong by the jumps made when a sample crosses the exit.
    """
    return _render(volume, transfer, camera, march, _Loop.of(adjoint, volume, march))


def render_rays(
    volume: Volume,
    transfer: Transfer,
    origins: Arrayable,
    directions: Arrayable,
    march: March,
    *,
    adjoint: Adjoint = "replay",
) -> Rendering:
    """What rays of one's own see. As `render`, but for:

    - `origins`, `directions`: (*rays, 3) world points, and directions of any length but 0. Distances
      are measured in world length whatever the length of a direction.

    **Returns:** a `Rendering` with leading shape `*rays`. What is random along a ray is keyed by its
    place in the flattened array, as pixel (place, 0).

    **Raises:** as `render`, and `ValueError` for shapes that differ or do not end in 3, NaN or
    infinity, and directions of length 0.
    """
    origins, directions = _rays("origins", origins), _rays("directions", directions)
    if origins.shape != directions.shape:
        raise ValueError(
            f"origins and directions must agree in shape; got {origins.shape} and {directions.shape}."
        )
    message = "directions must not have length 0."
    directions = require(directions, lambda d: jnp.any(d != 0, axis=-1), message)
    directions = directions / jnp.linalg.norm(directions, axis=-1, keepdims=True)
    return _render_rays(volume, transfer, origins, directions, march, _Loop.of(adjoint, volume, march))


class _Loop(eqx.Module):
    """How a tile repeats its step: by a loop that can be differentiated as the adjoint asks."""

    adjoint: Adjoint = eqx.field(static=True)
    length: int = eqx.field(static=True)

    @classmethod
    def of(cls, adjoint: Any, volume: Volume, march: March) -> "_Loop":
        if adjoint not in get_args(Adjoint):
            raise ValueError(f"adjoint must be one of {', '.join(get_args(Adjoint))}; got {adjoint!r}.")
        if adjoint != "direct":
            return cls(adjoint, march.most_samples)
        length = samples_across(volume, march)
        # to the next of few lengths, so that a change of step rarely compiles the program again
        return cls(adjoint, min(-(-length // 64) * 64, march.most_samples))

    def tiles(self, tile: Callable[[Any], Rendering], numbered: Any) -> Rendering:
        """Every tile's rendering, one after the other."""
        # a replay starts again from what a tile was given, so no tile keeps a state for the backward pass
        return jax.lax.map(jax.checkpoint(tile) if self.adjoint == "replay" else tile, numbered)

    def run(self, advance: Callable[[Progress], Progress], start: Progress) -> Progress:
        """The state in which all rays are finished."""
        if self.adjoint == "direct":
            return jax.lax.scan(lambda at, _: (advance(at), None), start, None, length=self.length)[0]
        return eqxi.while_loop(
            lambda at: ~jnp.all(at.finished),
            advance,
            start,
            max_steps=self.length,
            kind="checkpointed" if self.adjoint == "replay" else "lax",
            checkpoints=CHECKPOINTS if self.adjoint == "replay" else None,
        )


@eqx.filter_jit
def _render(volume: Volume, transfer: Transfer, camera: Camera, march: March, loop: _Loop) -> Rendering:
    width, height = camera.size
    side = min(TILE, max(width, height))
    across, down = -(-width // side), -(-height // side)
    lane = jnp.arange(side * side)

    def tile(number: Int[Array, ""]) -> Rendering:
        column = (number % across) * side + lane % side
        row = (number // across) * side + lane // side
        rays = jax.vmap(camera.ray)(column, row)
        return _march(volume, transfer, rays, (column, row), (column < width) & (row < height), march, loop)

    def assemble(leaf: Array) -> Array:
        image = leaf.reshape(down, across, side, side, *leaf.shape[2:]).swapaxes(1, 2)
        return image.reshape(down * side, across * side, *leaf.shape[2:])[:height, :width]

    return jax.tree.map(assemble, loop.tiles(tile, jnp.arange(across * down)))


@eqx.filter_jit
def _render_rays(
    volume: Volume,
    transfer: Transfer,
    origins: Float[Array, "*rays 3"],
    directions: Float[Array, "*rays 3"],
    march: March,
    loop: _Loop,
) -> Rendering:
    shape = origins.shape[:-1]
    count = math.prod(shape)
    batch = min(TILE * TILE, max(count, 1))
    batches = -(-count // batch)

    def in_batches(rays: Float[Array, "*_ 3"]) -> Float[Array, "_ 3 _"]:
        padded = jnp.pad(rays.reshape(count, 3), ((0, batches * batch - count), (0, 0)), mode="edge")
        return padded.reshape(batches, batch, 3).swapaxes(1, 2)

    def tile(given: tuple[Array, Array, Array]) -> Rendering:
        number, origin, direction = given
        place = number * batch + jnp.arange(batch)
        rays = tuple(origin), tuple(direction)
        return _march(volume, transfer, rays, (place, jnp.zeros_like(place)), place < count, march, loop)

    def assemble(leaf: Array) -> Array:
        return leaf.reshape(-1, *leaf.shape[2:])[:count].reshape(*shape, *leaf.shape[2:])

    given = jnp.arange(batches), in_batches(origins), in_batches(directions)
    return jax.tree.map(assemble, loop.tiles(tile, given))


def _march(
    volume: Volume,
    transfer: Transfer,
    rays: tuple[Points, Points],
    pixel: Pixels,
    wanted: Bool[Array, " rays"],
    march: March,
    loop: _Loop,
) -> Rendering:
    """One batch of rays, from entry to end. Rays that are not wanted fill up the batch and cost nothing."""
    ray = jax.vmap(enter, in_axes=(None, 0, 0, 0))(march.locate(volume), *rays, pixel)
    ray = eqx.tree_at(lambda r: r.length, ray, jnp.where(wanted, ray.length, 0))
    classify = transfer.over(volume)

    def advance(at: Progress) -> Progress:
        once = _computed_once(classify, jnp.any(~at.finished))
        return jax.vmap(lambda ray, at: step(march, ray, volume, once, at))(ray, at)

    start = jax.vmap(begin, in_axes=(None, 0))(march, ray)
    return jax.vmap(end)(ray, loop.run(advance, start))


def _computed_once(classify: Classify, live: Bool[Array, ""]) -> Classify:
    """The same classification, its result put in memory for all that use it.

    On CPU XLA fuses what a gather feeds into each of its consumers, and would fetch the voxels again for
    every channel and for each transform that asks for the extinction. It does not fuse across a branch.
    """

    def nothing(coordinate: Triple) -> tuple[Triple, Scalar]:
        zero = jnp.zeros_like(coordinate[0])
        return (zero, zero, zero), zero

    return lambda coordinate: jax.lax.cond(live, classify, nothing, coordinate)


def _rays(name: str, rays: Arrayable) -> Float[Array, "*rays 3"]:
    rays = jnp.asarray(rays, dtype=float)
    if rays.ndim < 1 or rays.shape[-1] != 3:
        raise ValueError(f"{name} must have shape (*rays, 3); got {rays.shape}.")
    return require(rays, finite, f"{name} must be finite.")
