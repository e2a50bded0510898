"""What does light that is scattered many times make of a volume? A reference, by path tracing.

Unbiased: an image is its answer plus noise, whose size it tells, and which falls with the square root of
the number of paths. It is what cheaper lighting is held against, and refuses to be differentiated.
"""

from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, UInt32

from .._util.checks import Arrayable, all_finite, described, integer, is_traced, number
from .._util.memory import require_room
from .._util.noise import hashed_uniforms_4, is_key
from .._util.vec3 import Scalar
from .._util.xla import compiled
from ..camera import Camera
from ..engine.packing import with_words, words_of
from ..lighting.lights import Light, lights_of
from ..lighting.materials import Material, materials_of
from ..occupancy import Blocks
from ..scene import check_scene
from ..space import Affine, enter
from ..transfer import Transfer
from ..volume import Volume, without_voxels
from .lanes import PathResults, walk_all
from .majorants import Majorants
from .medium import Medium
from .result import PathTraced
from .walks import Scene, Walk, Words, step


LANES = 2**13
"""Walks that go on side by side, by default on a CPU; 32 times as many on a GPU."""

TURNS = 128
"""Walks for each lane of a wave, one after the other."""

UNTIL_CHANCE_ENDS_IT = 2**20
"""Scatterings that a walk may have by default. A path of albedo 1 leaves a medium of optical thickness τ
after some τ² scatterings, so this bounds none but those in media a thousand mean free paths thick."""

BYTES_OF_WALK, BYTES_OF_RESULT = 2**10, 2**6
"""Memory that a walk takes in its lane, and what it has brought until its wave is over."""

NOT_DIFFERENTIABLE = (
    "path_trace has no derivative, and volume, transfer, camera, lights, materials or anisotropy carries a "
    "tangent here (jax.grad, jax.jvp, jax.linearize). Differentiate scatterer templates instead, as "
    "render(..., lighting=lighting.ScattererTemplates(...)); or, where the path-traced image is to count as "
    "constant, pass jax.lax.stop_gradient of what it is made of."
)
"""What its error says. The walks' own derivative would not be that of the image in any case: how often, and
where, a path collides jumps with the extinction."""

BEFORE_ALL = np.uint32(2**32 - 1)
"""In place of the number of a walk's step, for what is drawn before the first."""


def path_trace(
    volume: Volume | Any,
    transfer: Transfer | Any,
    camera: Camera | Any,
    lights: Light | tuple[Light, ...] | Any,
    *,
    paths: int | Any = 16,
    key: Any = 0,
    materials: Material | tuple[Material, ...] | None = None,
    anisotropy: Arrayable = 0.0,
    max_scatterings: int | Any = None,
    antialias: bool = False,
    onto: PathTraced | Any = None,
    lanes: int | Any = None,
) -> PathTraced:
    """The image of a volume that scatters light any number of times.

    Extinction is the transfer function's, at the trilinear value, and the single-scattering albedo is its
    colour, clipped to [0, 1]: an image corresponds to one of Mitsuba's `volpath` with a heterogeneous
    medium. (`render` takes the colour for light that the medium emits. With albedo 0 the two agree on
    opacity.)

    The image is in radiance, in the unit that `lights` gives it: in a white furnace (albedo 1 under a
    `ConstantLight` of radiance L) it is L times the opacity. A half-space of albedo ω reflects, of light from
    all sides, (1 - γ H(μ)) L, with γ = √(1 - ω), Chandrasekhar's function H, and the cosine μ at which it is
    seen. `ScattererTemplates` are on the same scale.

    **Arguments:**

    - `volume`: on its own grid; curved ones (`ToroidalMap`) are not supported.
    - `transfer`: a `TransferFunction` or `LabelTransferFunction`.
    - `camera`: its rays pass through the middles of pixels, as in `render`; with `antialias`, through any
      place in them.
    - `lights`: those with a place or a direction are sampled at every scattering, one of them at random;
      a `ConstantLight` is met by paths that leave the volume. A `PointLight` inside a medium is unbiased,
      too, but of infinite variance: its inverse square makes a few pixels far too bright.
    - `paths`: for each pixel, ≥ 1.
    - `key`: a seed, or a key of `jax.random`. What is random along a path depends on it, on the pixel and
      on the path's number alone.
    - `materials`: what the transfer function shows of a material has an extinction of 1/λ in place of its
      own, and an albedo of colour · (1 - opacity). Where materials overlap, the first counts.
    - `anisotropy`: g in (-1, 1), the mean cosine of a scattering (Henyey and Greenstein).
    - `max_scatterings`: after which a path ends, ≥ 1. By default 2²⁰: only chance ends a path, in
      proportion to what it may still bring. A smaller number makes an image of light scattered so many
      times at most, and `exhausted` tells where it lacks some.
    - `onto`: an earlier result of the same scene, camera and key, to which these paths are added. The
      result is that of all paths at once, but for rounding.
    - `lanes`: paths that are traced side by side. Memory grows with it, and no result changes.

    **Raises:** `ValueError` for arguments out of these ranges, no lights, a transfer function of another
    kind, labels where the volume has none, `onto` of another size or key, and lanes or paths that do not fit
    into memory; `RuntimeError` where it is differentiated, by grad or jvp, with respect to anything that it
    is made of. In a function that is differentiated with respect to something else it may stand.

    NaN or infinity in any number that the image is made of makes the whole image NaN: each path may come by.

    Random numbers have 24 bits, so free paths longer than 16.6 mean ones within a block of voxels, one in
    6e-8, are not drawn.

    Sources: Kajiya and Von Herzen 1984; Novák et al. 2018; see `tracking`.
    """
    order = "path_trace(volume, transfer, camera, lights)"
    check_scene(order, volume=volume, transfer=transfer, camera=camera)
    volume, transfer, camera, lights, materials, anisotropy = eqxi.nondifferentiable(
        (volume, transfer, camera, lights, materials, anisotropy), msg=NOT_DIFFERENTIABLE
    )
    lights = lights_of(lights)
    materials = () if materials is None else materials_of(materials)
    if volume.labels is None and any(material.label is not None for material in materials):
        raise ValueError("materials name labels and this volume has none; give Volume(..., labels=...).")
    paths = integer("paths", paths, 1)
    anisotropy = number("anisotropy", anisotropy, above=-1, below=1)
    most = UNTIL_CHANCE_ENDS_IT
    if max_scatterings is not None:
        most = min(integer("max_scatterings", max_scatterings, 1), 2**31 - 1)
    if lanes is None:
        lanes = LANES if jax.default_backend() == "cpu" else 32 * LANES
    how = _How(paths, integer("lanes", lanes, 1), bool(antialias))
    how.require_room(camera)
    seed = _seed(key)
    first = 0
    if onto is not None:
        first = _checked(onto, camera, seed).paths
    given = _Given(
        volume,
        words_of(volume),
        Blocks.of(volume),
        transfer,
        materials,
        lights,
        anisotropy,
        jnp.asarray(most, jnp.int32),
    )
    traced = _trace(given, camera, seed, jnp.asarray(first, jnp.uint32), how)
    return traced if onto is None else onto.joined(traced)


class _How(eqx.Module):
    """What a program is compiled for."""

    paths: int = eqx.field(static=True)
    lanes: int = eqx.field(static=True)
    antialias: bool = eqx.field(static=True)

    def pixels(self, camera: Camera) -> int:
        """How many go on in one wave."""
        return min(max(TURNS * self.lanes // self.paths, 1), camera.size[0] * camera.size[1])

    def require_room(self, camera: Camera) -> None:
        """**Raises** `ValueError` where a wave would not fit into memory."""
        walks = self.pixels(camera) * self.paths
        require_room(
            walks * BYTES_OF_RESULT + min(self.lanes, walks) * BYTES_OF_WALK,
            f"lanes={self.lanes} and paths={self.paths}, {self.pixels(camera)} pixels at once; take fewer "
            "lanes, which changes no result, or fewer paths, and add others to them by `onto`",
        )


def _seed(key: Any) -> UInt32[Array, ""]:
    """A word from a seed, or from a key of `jax.random`."""
    if not is_key(key):
        if not is_traced(key):
            key = integer("key", key, 0, otherwise=", or a key of jax.random")
        elif key.shape != () or not jnp.issubdtype(key.dtype, jnp.integer):
            raise ValueError(f"key must be an integer, or a key of jax.random; got {described(key)}.")
        key = jax.random.key(key)
    return jax.random.bits(key, (), jnp.uint32)


def _checked(onto: Any, camera: Camera, seed: UInt32[Array, ""]) -> PathTraced:
    if not isinstance(onto, PathTraced):
        raise ValueError(f"onto must be an earlier result of path_trace; got {onto!r}.")
    width, height = camera.size
    if onto.opacity.shape != (height, width):
        raise ValueError(
            f"onto must be of the camera's size {(height, width)}; got one of {onto.opacity.shape}."
        )
    if not is_traced(onto.seed, seed) and onto.seed != seed:
        raise ValueError("onto must be of the same key: other paths would be drawn again.")
    return onto


class _Given(eqx.Module):
    """A scene as it comes, with what is known of its volume."""

    volume: Volume
    words: UInt32[Array, " voxels"] | None
    blocks: Blocks
    transfer: Transfer
    materials: tuple[Material, ...]
    lights: tuple[Light, ...]
    anisotropy: Scalar
    most: Int[Array, ""]

    def scene(self) -> Scene:
        volume = with_words(self.volume, self.words)
        return Scene(
            volume,
            Medium.of(volume, self.transfer, self.materials),
            Majorants.of(volume, self.blocks, self.transfer, self.materials),
            self.lights,
            self.anisotropy,
            self.most,
        )


@compiled
def _trace(
    given: _Given, camera: Camera, seed: UInt32[Array, ""], first: UInt32[Array, ""], how: _How
) -> PathTraced:
    """The pixels row by row, in waves that bound the memory."""
    given, camera = jax.tree.map(_single, (given, camera))
    scene, (width, height) = given.scene(), camera.size
    # walks compare, and a comparison with NaN has an answer
    # of a volume that measures in its own way nothing is known, and its ranges are infinite
    ranges = given.blocks if given.volume.field is None else None
    sound = all_finite((without_voxels(given.volume), ranges, scene.majorants, given.transfer))
    sound &= all_finite((given.materials, given.lights, given.anisotropy, camera))
    pixels = how.pixels(camera)
    waves = -(-width * height // pixels)
    count = pixels * how.paths

    def wave(number: Int[Array, ""]) -> tuple[Array, ...]:
        def begin(place: Int[Array, " lanes"]) -> Walk:
            pixel, path = number * pixels + place // how.paths, place % how.paths
            wanted = sound & (place < count) & (pixel < width * height)
            words = (
                pixel.astype(jnp.uint32),
                first + path.astype(jnp.uint32),
                jnp.broadcast_to(seed, place.shape),
            )
            return jax.vmap(lambda *of_one: _begin(scene, camera, how, *of_one))(words, wanted)

        brought = walk_all(begin, lambda walks: step(scene, walks), count, how.lanes)
        return _summed(jax.tree.map(lambda leaf: leaf.reshape(pixels, how.paths), brought))

    def image(leaf: Array) -> Array:
        return leaf.reshape(-1, *leaf.shape[2:])[: width * height].reshape(height, width, *leaf.shape[2:])

    sums = jax.tree.map(image, jax.lax.map(wave, jnp.arange(waves, dtype=jnp.int32)))
    sums = jax.tree.map(
        lambda leaf: jnp.where(sound, leaf, jnp.nan) if eqx.is_inexact_array(leaf) else leaf, sums
    )
    return PathTraced(*sums, seed=seed, paths=how.paths)


def _single(leaf: Array) -> Array:
    """float64, where it is on, as float32: noise is larger by far than its rounding."""
    return leaf.astype(jnp.float32) if leaf.dtype == jnp.float64 else leaf


def _begin(scene: Scene, camera: Camera, how: _How, words: Words, wanted: Bool[Array, ""]) -> Walk:
    """A path from the camera on to the volume."""
    pixel, path, seed = words
    row, column = jnp.divmod(pixel.astype(jnp.int32), camera.size[0])
    if how.antialias:
        x, y, *_ = hashed_uniforms_4(pixel, path, jnp.full_like(pixel, BEFORE_ALL), seed)
        origin, direction = camera.ray(column.astype(x.dtype) + x - 0.5, row.astype(y.dtype) + y - 0.5)
    else:
        origin, direction = camera.ray(column, row)
    ray = enter(Affine(scene.volume), origin, direction, (column, row))
    start = ray.path(jnp.zeros_like(ray.length))
    flight = scene.flight(start, direction, jnp.full_like(ray.length, jnp.inf))
    return Walk.begin(words, flight, direction, wanted & (ray.length > 0))


def _summed(brought: PathResults) -> tuple[Array, ...]:
    """Of (pixels, paths): mean and squared deviations of radiance, and the rest as `PathTraced` has it."""
    radiance = jnp.stack([brought.red, brought.green, brought.blue], axis=-1)
    mean = radiance.mean(axis=1)
    deviations = jnp.square(radiance - mean[:, None]).sum(axis=1)
    met, scatterings = (leaf.astype(mean.dtype).mean(axis=1) for leaf in (brought.met, brought.scatterings))
    return mean, met, deviations, scatterings, brought.exhausted.any(axis=1)
