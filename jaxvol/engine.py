"""How is an image rendered? In beams of neighbouring pixels, and waves of beams.

Rays are made wave by wave from the camera, and a wave's memory is all that a march holds beside the
finished pixels, however large the image. How the rays of a wave are marched is `wavefront`'s business; what
they see is `reference`'s.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal, TypeAlias, get_args

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from .beams import Box
from .camera import Camera
from .checks import Arrayable, finite, is_traced, require
from .leaping import FirstHit
from .locate import Ray, Space, enter
from .march import March, Survey, View
from .occupancy import Blocks, Occupancy
from .packed import with_words, words_of
from .reference import Progress, begin, end, samples_across, step
from .rendering import Rendering
from .transfer import Transfer
from .volume import Volume
from .wavefront import GROUP, Beams, march_beams


Adjoint: TypeAlias = Literal["replay", "forward", "direct"]
Lanes: TypeAlias = Float[Array, "groups rays"]
Points: TypeAlias = tuple[Lanes, Lanes, Lanes]
Pixels: TypeAlias = tuple[Int[Array, "groups rays"], Int[Array, "groups rays"]]

SIDE = math.isqrt(GROUP)
"""Pixels along the side of a group of rays."""

BEAM = 2 * SIDE
"""Pixels along the side of a beam, which is 2 x 2 groups."""

WAVE = 4096
"""Beams in a wave: 262 144 rays. A wave's memory is all that is held beside the finished pixels."""

PLAIN_WAVE = 64
"""Beams in a wave that is marched cell by cell, to be differentiated."""

OPTIONS = {
    # 16 lanes at once where the processor has them: XLA prefers 8
    "xla_cpu_prefer_vector_width": 512,
    # kernels one after the other, each on all threads, rather than several on one thread each
    "xla_cpu_enable_concurrency_optimized_scheduler": False,
}
"""How XLA compiles: 20 % faster on CPU, and of no meaning elsewhere."""

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
    how = _How.of(adjoint, volume, march)
    return _render((volume, transfer, camera, march), how, Known.of(volume, march))


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
    directions = require(directions, lambda d: (d != 0).any(axis=-1), message)
    directions = directions / jnp.linalg.norm(directions, axis=-1, keepdims=True)
    how = _How.of(adjoint, volume, march)
    return _render_rays((volume, transfer, origins, directions, march), how, Known.of(volume, march))


class Known(eqx.Module):
    """What was found out about a volume before, and is found out anew for other voxels."""

    words: UInt32[Array, " voxels"] | None
    blocks: Blocks | None

    @classmethod
    def of(cls, volume: Volume, march: March) -> "Known":
        return cls(words_of(volume), Blocks.of(volume) if march.leaps else None)


class _How(eqx.Module):
    """By which loop rays are marched to their ends: one for the image, others that can be differentiated."""

    adjoint: Adjoint = eqx.field(static=True)
    length: int = eqx.field(static=True)
    backward: bool = eqx.field(static=True, default=False)
    """Whether the image is made anew to be differentiated."""

    @classmethod
    def of(cls, adjoint: Any, volume: Volume, march: March) -> "_How":
        if adjoint not in get_args(Adjoint):
            raise ValueError(f"adjoint must be one of {', '.join(get_args(Adjoint))}; got {adjoint!r}.")
        if adjoint != "direct":
            return cls(adjoint, march.most_samples)
        length = samples_across(volume, march)
        # to the next of few lengths, so that a change of step rarely compiles the program again
        return cls(adjoint, min(-(-length // 64) * 64, march.most_samples))

    @property
    def plain(self) -> bool:
        """Whether one cell is marched after the other, by a loop that reverse mode goes through."""
        return self.backward or self.adjoint == "direct"

    @property
    def most_beams(self) -> int:
        """Beams in a wave. Where states are kept for a backward pass, fewer."""
        return PLAIN_WAVE if self.plain else WAVE

    def in_turn(self, wave: Callable[[Any], Rendering], numbered: Any) -> Rendering:
        """Every wave's rendering, one after the other."""
        # a replay starts again from what a wave was given, so no wave keeps a state for the backward pass
        return jax.lax.map(jax.checkpoint(wave) if self.backward else wave, numbered)

    def run(self, advance: Callable[[Progress], Progress], start: Progress) -> Progress:
        """The state in which all rays are finished."""
        if self.adjoint == "direct":
            return jax.lax.scan(lambda at, _: (advance(at), None), start, None, length=self.length)[0]
        return eqxi.while_loop(
            lambda at: ~jnp.all(at.finished),
            advance,
            start,
            max_steps=self.length,
            kind="checkpointed",
            checkpoints=CHECKPOINTS,
        )


def _replayed(image: Callable[..., Rendering], scene: Any, how: _How, known: Known) -> Rendering:
    """`image(scene, how, known)`; in reverse mode, the derivative of the same image made cell by cell."""
    if how.adjoint != "replay":
        return image(scene, how, known)

    @eqx.filter_custom_vjp
    def once(scene: Any, known: Known) -> Rendering:
        return image(scene, how, known)

    @once.def_fwd
    def _(perturbed: Any, scene: Any, known: Known) -> tuple[Rendering, Any]:
        moving, still = eqx.partition(scene, perturbed)
        again = replace(how, backward=True)
        out, pull = eqx.filter_vjp(lambda moving: image(eqx.combine(moving, still), again, known), moving)
        return out, (out, pull)

    @once.def_bwd
    def _(residuals: Any, gradient: Any, perturbed: Any, scene: Any, known: Known) -> Any:
        out, pull = residuals
        # None stands for what the loss does not use
        whole = jax.tree.map(
            lambda leaf, part: jnp.zeros_like(leaf) if part is None and eqx.is_inexact_array(leaf) else part,
            *(out, gradient),
            is_leaf=lambda leaf: leaf is None,
        )
        return pull(whole)[0]

    return once(scene, jax.lax.stop_gradient(known))


def _compiled(function: Callable[..., Rendering]) -> Callable[..., Rendering]:
    """The function under jit, compiled with `OPTIONS` where it is a program of its own."""
    options: Any = {"compiler_options": OPTIONS}
    inner, alone = eqx.filter_jit(function), eqx.filter_jit(function, **options)
    # a program within another one, or within a transformation, cannot have options of its own
    return lambda *args: (inner if is_traced(args, jnp.zeros(())) else alone)(*args)


@_compiled
def _render(scene: tuple[Volume, Transfer, Camera, March], how: _How, known: Known) -> Rendering:
    return _replayed(_image, scene, how, known)


def _image(scene: tuple[Volume, Transfer, Camera, March], how: _How, known: Known) -> Rendering:
    volume, transfer, camera, march = scene
    volume = with_words(volume, known.words)
    width, height = camera.size
    across, down = -(-width // BEAM), -(-height // BEAM)
    count = min(how.most_beams, across * down)
    waves = -(-across * down // count)
    space = march.locate(volume)

    def first_hit(survey: Survey, columns: Int[Array, "*rays"], rows: Int[Array, "*rays"]) -> Array:
        first = March(march.step, (FirstHit(),), march.quadrature, max_samples=march.max_samples)
        origin, direction = _each_ray(camera.ray)(columns.reshape(-1, 1), rows.reshape(-1, 1))
        rays = jnp.stack(origin, -1).reshape(-1, 3), jnp.stack(direction, -1).reshape(-1, 3)
        beams = _own_beams(space, *rays, columns.size)
        depth = _march(volume, transfer, first, how, survey, beams).depth
        return depth.reshape(-1)[: columns.size].reshape(columns.shape)

    survey = _survey(space, transfer, march, known, how, View(camera.ray, camera.size, first_hit))

    def wave(number: Int[Array, ""]) -> Rendering:
        def pixel(part_y: Array, part_x: Array) -> Pixels:
            """Columns and rows of these places in each beam."""
            beam = (number * count + jnp.arange(count))[:, None]
            return (beam % across) * BEAM + part_x[None], (beam // across) * BEAM + part_y[None]

        def box(occupancy: Occupancy) -> Box:
            y, x = jnp.divmod(jnp.arange(4), 2)
            return Box.within(occupancy, *_each_ray(camera.ray)(*pixel(y * (BEAM - 1), x * (BEAM - 1))))

        # within a beam, group by group
        group_y, group_x, y, x = jnp.unravel_index(jnp.arange(BEAM * BEAM), (2, 2, SIDE, SIDE))
        column, row = (i.reshape(-1, GROUP) for i in pixel(group_y * SIDE + y, group_x * SIDE + x))
        rays = _enter(
            space, _each_ray(camera.ray)(column, row), (column, row), (column < width) & (row < height)
        )
        return _march(volume, transfer, march, how, survey, Beams(rays, count, box))

    def assemble(leaf: Array) -> Array:
        leaf = leaf.reshape(-1, BEAM * BEAM, *leaf.shape[3:])[: across * down]
        image = leaf.reshape(down, across, 2, 2, SIDE, SIDE, *leaf.shape[2:])
        image = jnp.moveaxis(image, (0, 2, 4), (0, 1, 2))
        return image.reshape(down * BEAM, across * BEAM, *leaf.shape[2:])[:height, :width]

    return jax.tree.map(assemble, how.in_turn(wave, jnp.arange(waves)))


@_compiled
def _render_rays(scene: tuple[Volume, Transfer, Array, Array, March], how: _How, known: Known) -> Rendering:
    return _replayed(_own_rays, scene, how, known)


def _own_rays(scene: tuple[Volume, Transfer, Array, Array, March], how: _How, known: Known) -> Rendering:
    volume, transfer, origins, directions, march = scene
    volume = with_words(volume, known.words)
    shape = origins.shape[:-1]
    count = math.prod(shape)
    in_wave = min(how.most_beams * BEAM * BEAM, max(count, 1))
    waves = -(-count // in_wave)
    space = march.locate(volume)
    survey = _survey(space, transfer, march, known, how, None)

    def in_waves(rays: Float[Array, "*_ 3"]) -> Float[Array, "waves rays 3"]:
        padded = jnp.pad(rays.reshape(count, 3), ((0, waves * in_wave - count), (0, 0)), mode="edge")
        return padded.reshape(waves, in_wave, 3)

    def wave(given: tuple[Array, Array, Array]) -> Rendering:
        number, origin, direction = given
        beams = _own_beams(space, origin, direction, count, number * in_wave)
        return jax.tree.map(
            lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:in_wave],
            _march(volume, transfer, march, how, survey, beams),
        )

    def assemble(leaf: Array) -> Array:
        return leaf.reshape(-1, *leaf.shape[2:])[:count].reshape(*shape, *leaf.shape[2:])

    given = jnp.arange(waves), in_waves(origins), in_waves(directions)
    return jax.tree.map(assemble, how.in_turn(wave, given))


def _own_beams(
    space: Space,
    origins: Float[Array, "rays 3"],
    directions: Float[Array, "rays 3"],
    count: int,
    first: Any = 0,
) -> Beams:
    """Beams of rays in the order in which they were given, of which the first one has this number."""
    length = origins.shape[0]
    beams = max(-(-length // (BEAM * BEAM)), 1)
    place = jnp.arange(beams * BEAM * BEAM).reshape(-1, GROUP)
    at = jnp.minimum(place, max(length - 1, 0))
    origin, direction = ((part[at, 0], part[at, 1], part[at, 2]) for part in (origins, directions))
    wanted = (place < length) & (first + place < count)
    rays = _enter(space, (origin, direction), (first + place, jnp.zeros_like(place)), wanted)

    def box(occupancy: Occupancy) -> Box:
        return Box.around(occupancy, jax.tree.map(lambda leaf: leaf.reshape(beams, -1), rays))

    return Beams(rays, beams, box)


def _survey(
    space: Space, transfer: Transfer, march: March, known: Known, how: _How, view: View | None
) -> Survey | None:
    if known.blocks is None or how.plain:
        return None
    return march.survey(space.occupancy(transfer.visible(known.blocks)), view)


def _each_ray(f: Callable[..., Any]) -> Callable[..., Any]:
    """A function of one ray, of arrays (groups, rays in a group)."""
    return jax.vmap(jax.vmap(f))


def _enter(
    space: Space, rays: tuple[Points, Points], pixel: Pixels, wanted: Bool[Array, "groups rays"]
) -> Ray:
    """Rays cut to the volume. Those that are not wanted fill up groups, and miss it."""
    ray = _each_ray(lambda origin, direction, pixel: enter(space, origin, direction, pixel))(*rays, pixel)
    return eqx.tree_at(lambda ray: ray.length, ray, jnp.where(wanted, ray.length, 0))


def _march(
    volume: Volume, transfer: Transfer, march: March, how: _How, survey: Survey | None, beams: Beams
) -> Rendering:
    """A wave of beams, from entry to end: (groups, rays in a group)."""
    seen = transfer.over(volume)
    if how.plain:
        one = _each_ray(lambda ray, at: step(march, ray, volume, seen, at))
        at = how.run(lambda at: one(beams.rays, at), _each_ray(lambda ray: begin(march, ray))(beams.rays))
    else:
        at = march_beams(march, volume, seen, survey, beams)
    return _each_ray(end)(beams.rays, at)


def _rays(name: str, rays: Arrayable) -> Float[Array, "*rays 3"]:
    rays = jnp.asarray(rays, dtype=float)
    if rays.ndim < 1 or rays.shape[-1] != 3:
        raise ValueError(f"{name} must have shape (*rays, 3); got {rays.shape}.")
    return require(rays, finite, f"{name} must be finite.")
