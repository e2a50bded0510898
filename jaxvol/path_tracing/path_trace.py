"""Unbiased path tracing of light that is scattered many times: the reference for cheaper lighting."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from .._util.checks import Arrayable, all_finite, described, flag, integer, number
from .._util.noise import hashed_uniforms_4, is_key
from ..engine.acceleration import with_words, words_of
from ..lighting.lights import Light, lights_of
from ..lighting.materials import Material, materials_of
from ..ray import bands_of, check_arguments
from ..scene.camera import Camera
from ..scene.occupancy import Blocks
from ..scene.space import Affine, enter
from ..scene.transfer import Transfer, sized
from ..scene.volume import Volume, check_one_channel, without_voxels
from ..xla.compiling import compiled
from ..xla.differentiation import forward_only, refuse_reverse_mode
from ..xla.platform import is_traced
from ..xla.trees import constant, is_none
from .fixed_paths import check_voxels, has_step, with_constant_paths
from .lanes import walk_all
from .likelihood import OF_DERIVATIVES, OF_IMAGES, Sampling
from .medium import Medium
from .walks import Walk, WalkResult, WalkScene, Words, step


LANES = 2**13
"""Walks that run side by side by default on a CPU; 32 times as many on a GPU."""

WALKS_PER_LANE = 128
"""Walks that each lane of a batch runs, one after the other."""

FORWARD_ONLY = (
    "path_trace has derivatives in forward mode only; take jax.jacfwd or jax.jvp in place of jax.grad, "
    "jax.vjp or jax.jacrev."
)
"""Error message: a reverse pass would have to keep or repeat all that happens along each path."""


class PathTraced(eqx.Module):
    """A path-traced image, from the paths traced so far.

    Attributes:
        radiance: linear RGB of the light that the volume scatters into the camera, mean over all paths,
            without the background.
        opacity: the fraction of camera rays that met anything.
        deviations: sums of the squared deviations of each path's radiance from the mean.
        exhausted: whether any path was cut off by `max_scatterings`; the pixel lacks what it would have
            contributed.
        paths: per pixel.
        seed: of the last paths' random numbers.
        groups: of each group of paths, the mean radiance and, last, opacity; None for one group, and where
            groups of different sizes were joined.
    """

    radiance: Float[Array, "height width 3"]
    opacity: Float[Array, "height width"]
    deviations: Float[Array, "height width 3"]
    exhausted: Bool[Array, "height width"]
    paths: int = eqx.field(static=True)
    seed: UInt32[Array, ""]
    groups: Float[Array, "groups height width 4"] | None = None

    @property
    def standard_error(self) -> Float[Array, "height width 3"]:
        """Standard error of `radiance`, from the variance of the pixel's paths; infinite for a single path.

        If a pixel's few paths miss a rare bright one, the pixel is too dark and its error too small.
        """
        if self.paths < 2:
            return jnp.full_like(self.deviations, jnp.inf)
        return jnp.sqrt(self.deviations / (self.paths * (self.paths - 1)))

    def image(self, background: Any = (1.0, 1.0, 1.0)) -> Float[Array, "height width 3"]:
        """Linear RGB over a background.

        Args:
            background: one colour (3,), or an image of the same shape.

        Raises:
            ValueError: for another shape.
        """
        return self.radiance + (1 - self.opacity[..., None]) * _background(background, self.radiance)

    def images(self, background: Any = (1.0, 1.0, 1.0)) -> Float[Array, "groups height width 3"]:
        """Linear RGB over a background, by each group of paths: independent images, whose mean is `image`.

        Args:
            background: as for `image`.

        Returns:
            The images.

        Raises:
            ValueError: for another shape, and for paths in one group.
        """
        if self.groups is None:
            raise ValueError("images are by groups of paths; call path_trace(..., groups=) with 2 or more.")
        background = _background(background, self.radiance)
        return self.groups[..., :3] + (1 - self.groups[..., 3:]) * background[None]

    def joined(self, other: "PathTraced") -> "PathTraced":
        """The image by the paths of both, of the same scene and different keys.

        Args:
            other: by another key.

        Returns:
            The image.

        Raises:
            ValueError: for the same key, whose paths would count twice, and for another size.

        Source: Chan, Golub and LeVeque 1983.
        """
        if self.opacity.shape != other.opacity.shape:
            sizes = f"{self.opacity.shape} and {other.opacity.shape}"
            raise ValueError(f"other must be of the same size; got (height, width) {sizes}.")
        if not is_traced(self.seed, other.seed) and self.seed == other.seed:
            raise ValueError("other must be of another key; both hold the same paths.")
        paths = self.paths + other.paths
        share = other.paths / paths
        between = jnp.square(other.radiance - self.radiance) * (self.paths * share)
        radiance = self.radiance + (other.radiance - self.radiance) * share
        opacity = self.opacity + (other.opacity - self.opacity) * share
        deviations = self.deviations + other.deviations + between
        exhausted = self.exhausted | other.exhausted
        return PathTraced(
            radiance, opacity, deviations, exhausted, paths, other.seed, self._all_groups(other)
        )

    def _all_groups(self, other: "PathTraced") -> Array | None:
        """The groups of both, if they are of the same size."""
        if self.groups is None or other.groups is None:
            return None
        same = self.paths * len(other.groups) == other.paths * len(self.groups)
        return jnp.concatenate([self.groups, other.groups]) if same else None


def _background(background: Any, image: Float[Array, "height width 3"]) -> Float[Array, "height width 3"]:
    background = jnp.asarray(background, image.dtype)
    if background.shape not in ((3,), image.shape):
        raise ValueError(f"background must have shape (3,) or {image.shape}; got {background.shape}.")
    return jnp.broadcast_to(background, image.shape)


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
    max_scatterings: int | Any = 2**20,
    antialias: bool | Any = False,
    lanes: int | Any = None,
    groups: int | Any = 1,
) -> PathTraced:
    """Image of a volume that scatters light any number of times.

    The extinction is the transfer function's, at the trilinear value, and the single-scattering albedo is its
    colour, clipped to [0, 1]: an image corresponds to one by Mitsuba's `volpath` with a heterogeneous medium.
    (`render` treats the colour as light that the medium emits.)

    The image is radiance, in the unit of `lights`, as that of `ScattererTemplates`: in a white furnace
    (albedo 1 under a `ConstantLight` of radiance L) it is L times the opacity.

    NaN or infinity in any input makes the whole image NaN, since any path may reach it (what has a range,
    such as a mean free path, is an error then). Images are float32, also of float64 scenes.

    Random numbers have 24 bits, so free paths longer than 16.6 mean free paths within a block of voxels, of
    probability 6e-8, are never drawn.

    **Derivatives** are in forward mode (`jax.jvp`, `jax.jacfwd`), with respect to the transfer function's
    colours and extinction, the opacity and mean free path of materials, the anisotropy, what lights emit,
    and, without materials, voxels. They are unbiased: decisions stay as drawn, and their probabilities enter
    as weights. The image is the same as without. `jax.jacfwd` takes the same paths for all its columns; with
    `groups`, a derivative has a standard error, too: that of the mean over groups.

    Their noise is greater than that of the image, and grows with the number of collisions of a path: in very
    thick media of high albedo, take many paths. At a colour of 0 or 1, where the albedo is clipped, and an
    extinction of 0, derivatives are one-sided. They are NaN with respect to an extinction of 0 inside a
    material, which would appear all at once. `deviations` and the `standard_error` count as constants.

    Sources: Kajiya and Von Herzen 1984; Novák et al. 2018; see `tracking`. Of derivatives: Vicini, Speierer
    and Jakob 2021; Nimier-David et al. 2022; see `likelihood`.

    Args:
        volume: on its own grid; curved grids (`ToroidalMap`) are not supported.
        transfer: a `TransferFunction`, a `LabelTransferFunction`, or another one with a `majorant`.
        camera: its rays pass through the centres of pixels, as in `render`.
        lights: those with a position or a direction are sampled at every scattering, one of them at random; a
            `ConstantLight` is gathered by paths that leave the volume. A `PointLight` inside a medium is also
            unbiased, but has infinite variance: its inverse square makes a few pixels far too bright.
        paths: per pixel, ≥ 1. A pixel's paths take 64 bytes each at once, and 16 for each derivative. More
            paths of another key are added by `PathTraced.joined`.
        key: a seed, or a key of `jax.random`. The random numbers along a path depend only on it, on the pixel
            and on the path's number.
        materials: where the transfer function shows a material, the extinction is 1/λ instead, and the albedo
            is colour · (1 - opacity). Where materials overlap, the first counts.
        anisotropy: g in (-1, 1), the mean cosine of a scattering (Henyey and Greenstein).
        max_scatterings: after which a path ends, ≥ 1. By default 2²⁰, so that only Russian roulette ends a
            path, with a probability that depends on its throughput. A smaller number gives an image of light
            scattered at most that many times, and `exhausted` marks the pixels that lack some.
        antialias: let rays pass through random points of their pixels.
        lanes: paths that are traced side by side. Memory grows with it; the result does not change.
        groups: that paths are split into, a divisor of `paths`. Of several, each keeps an image,
            16 bytes a pixel, and as much for each derivative; so whatever is computed of images has a
            standard error, `std(axis=0, ddof=1) / sqrt(groups)` over `PathTraced.images`.

    Returns:
        A `PathTraced`, with the standard error of each pixel.

    Raises:
        ValueError: for arguments out of these ranges, no lights, a transfer function without a majorant, and
            labels where the volume has none.
            Also if it is differentiated in reverse mode (`jax.grad`).
        RuntimeError: if it is differentiated with respect to what moves paths or jumps of the medium: the
            camera, the volume's place, directions and positions of lights, the control points' values of the
            transfer function, the values of materials, and voxels where there are materials or a transfer
            function has a step (if it is traced, the derivative is NaN).
    """
    order = "path_trace(volume, transfer, camera, lights)"
    given = volume, transfer, camera, lights, materials, anisotropy
    refuse_reverse_mode(given, FORWARD_ONLY)
    transfer = sized(transfer, volume)
    check_arguments(order, volume=volume, transfer=transfer, camera=camera)
    check_one_channel(volume, "path_trace")
    if (bands := bands_of(transfer, volume)) != 3:
        got = f"{bands} of {described(transfer)}"
        raise ValueError(f"transfer must give three colours to path_trace; got {got}.")
    lights = lights_of(lights)
    materials = () if materials is None else materials_of(materials)
    if volume.labels is None and any(material.label is not None for material in materials):
        raise ValueError("materials use labels, but this volume has none; give Volume(..., labels=...).")
    paths = integer("paths", paths, 1)
    anisotropy = number("anisotropy", anisotropy, above=-1, below=1)
    limit = min(integer("max_scatterings", max_scatterings, 1), 2**31 - 1)
    if lanes is None:
        lanes = LANES if jax.default_backend() == "cpu" else 32 * LANES
    groups = integer("groups", groups, 1)
    if paths % groups:
        raise ValueError(f"groups must divide paths; got groups = {groups} and paths = {paths}.")
    lanes, antialias, seed = integer("lanes", lanes, 1), flag("antialias", antialias), _seed(key)
    pixels = min(max(WALKS_PER_LANE * lanes // paths, 1), camera.size[0] * camera.size[1])
    volume, transfer, camera, materials = with_constant_paths(volume, transfer, camera, materials)
    blocks = Blocks.of(constant(volume), slopes=transfer.reads_gradient)
    inputs = Inputs(volume, transfer, materials, lights, anisotropy)
    how = How(paths, groups, lanes, pixels, antialias)
    limit = jnp.asarray(limit, jnp.int32)
    return forward_only(_traced(inputs, (camera, blocks, words_of(volume), limit, seed), how), FORWARD_ONLY)


def _seed(key: Any) -> UInt32[Array, ""]:
    """Random word from a seed, or from a key of `jax.random`."""
    if not is_key(key):
        if not is_traced(key):
            key = integer("key", key, 0, otherwise=", or a key of jax.random")
        elif key.shape != () or not jnp.issubdtype(key.dtype, jnp.integer):
            raise ValueError(f"key must be an integer, or a key of jax.random; got {described(key)}.")
        key = jax.random.key(key)
    return jax.random.bits(key, (), jnp.uint32)


class Inputs(NamedTuple):
    """What an image may be differentiated with respect to, at least in part."""

    volume: Volume
    transfer: Transfer
    materials: tuple[Material, ...]
    lights: tuple[Light, ...]
    anisotropy: Float[Array, ""]


@dataclass(frozen=True)
class How:
    """Static arguments. `pixels`: of a batch."""

    paths: int
    groups: int
    lanes: int
    pixels: int
    antialias: bool
    sampling: Sampling = OF_IMAGES


Constants: TypeAlias = tuple[
    Camera, Blocks, UInt32[Array, " voxels"] | None, Int[Array, ""], UInt32[Array, ""]
]
"""Camera, ranges of blocks, the volume's packed voxels, `max_scatterings`, and the seed."""


@eqx.filter_custom_jvp
def _traced(inputs: Inputs, constants: Constants, how: How) -> PathTraced:
    return _trace(inputs, constants, how)


@_traced.def_jvp
def _(primals: tuple[Inputs, Constants, How], tangents: tuple[Any, Any, Any]) -> tuple[PathTraced, Any]:
    inputs, constants, how = primals
    traced, moving = _traced(*primals), tangents[0]
    constant = jax.tree.map(lambda _: None, traced)
    if not jax.tree.leaves(moving):
        return traced, constant
    if jax.tree.leaves(moving.volume):
        check_voxels(inputs.transfer, inputs.materials)
    how = replace(how, sampling=OF_DERIVATIVES)
    found = _derivative(inputs, moving, constants, how)
    return traced, eqx.tree_at(_estimates, constant, found, is_leaf=is_none)


def _estimates(traced: PathTraced) -> tuple[Any, ...]:
    """What has a derivative."""
    return traced.radiance, traced.opacity, traced.groups


def _derivative_of(inputs: Inputs, tangents: Inputs, constants: Constants, how: How) -> tuple[Any, ...]:
    """Derivatives of the `_estimates` along tangents, which are None where they are 0."""
    perturbed = jax.tree.map(lambda _, tangent: tangent is not None, inputs, tangents)
    moving, fixed = eqx.partition(inputs, perturbed)

    def image(moving: Inputs) -> tuple[Any, ...]:
        return _estimates(_traced_by(eqx.combine(moving, fixed), constants, how))

    _, found = jax.jvp(image, (moving,), (tangents,))
    if jax.tree.leaves(moving.volume):  # a transfer function that is traced was not checked
        found = jax.tree.map(partial(jnp.where, has_step(inputs.transfer), jnp.nan), found)
    return found


def _traced_by(inputs: Inputs, constants: Constants, how: How) -> PathTraced:
    """Trace the image in batches of pixels."""
    # float64 becomes float32, whose rounding is far below the noise
    (volume, transfer, materials, lights, anisotropy), (camera, blocks, words, max_scatterings, seed) = (
        jax.tree.map(
            lambda leaf: leaf.astype(jnp.float32) if leaf.dtype == jnp.float64 else leaf, (inputs, constants)
        )
    )
    packed, (width, height) = with_words(volume, [words]), camera.size
    medium = Medium.of(packed, blocks, transfer, materials, how.sampling)
    scene = WalkScene(packed, medium, lights, anisotropy, max_scatterings, how.sampling)
    # Checked here, since comparisons in the walks would hide a NaN. The values of a volume with its own field
    # are unknown and its ranges infinite, which is not an error.
    ranges = blocks if volume.field is None else None
    valid = all_finite((without_voxels(volume), ranges, medium.majorants, transfer))
    valid &= all_finite((materials, lights, anisotropy, camera)) & transfer.valid & camera.valid
    paths, pixels = how.paths, how.pixels
    batches, count = -(-width * height // pixels), pixels * paths

    def batch(number: Int[Array, ""]) -> tuple[Array, ...]:
        def begin(index: Int[Array, " lanes"]) -> Walk:
            pixel, path = number * pixels + index // paths, index % paths
            alive = valid & (index < count) & (pixel < width * height)
            words = pixel.astype(jnp.uint32), path.astype(jnp.uint32), jnp.broadcast_to(seed, index.shape)
            return jax.vmap(partial(_begin, scene, camera, how.antialias))(words, alive)

        results = walk_all(begin, partial(step, scene), count, how.lanes)
        results = jax.tree.map(lambda leaf: leaf.reshape(pixels, paths), results)
        radiance = jnp.stack(results.radiance, axis=-1)
        mean = radiance.mean(axis=1)
        opacity = results.opacity.mean(axis=1)
        deviations = jnp.square(radiance - mean[:, None]).sum(axis=1)
        numbers = mean, opacity, deviations, results.exhausted.any(axis=1)
        if how.groups == 1:
            return numbers
        each = jnp.concatenate([radiance, results.opacity[..., None]], axis=-1)
        return *numbers, each.reshape(pixels, how.groups, -1, 4).mean(axis=2)

    def image(leaf: Array) -> Array:
        return leaf.reshape(-1, *leaf.shape[2:])[: width * height].reshape(height, width, *leaf.shape[2:])

    found = map(image, jax.lax.map(batch, jnp.arange(batches, dtype=jnp.int32)))
    radiance, opacity, deviations, exhausted, *groups = found
    numbers = radiance, opacity, deviations, *(jnp.moveaxis(each, 2, 0) for each in groups)
    # also of a derivative all numbers
    radiance, opacity, deviations, *groups = (jnp.where(valid, each, jnp.nan * each) for each in numbers)
    return PathTraced(radiance, opacity, deviations, exhausted, paths, seed, *groups)


_trace, _derivative = compiled(_traced_by), compiled(_derivative_of, in_turn=False)


def _begin(scene: WalkScene, camera: Camera, antialias: bool, words: Words, alive: Bool[Array, ""]) -> Walk:
    """Start a walk where the camera's ray enters the volume."""
    pixel, path, seed = words
    row, column = jnp.divmod(pixel.astype(jnp.int32), camera.size[0])
    if antialias:
        no_step = jnp.full_like(pixel, np.uint32(2**32 - 1))  # in place of a step's number
        x, y, *_ = hashed_uniforms_4(pixel, path, no_step, seed)
        origin, direction = camera.ray(column.astype(x.dtype) + x - 0.5, row.astype(y.dtype) + y - 0.5)
    else:
        origin, direction = camera.ray(column, row)
    ray = enter(Affine(scene.volume), origin, direction, (column, row))
    start = ray.path(jnp.zeros_like(ray.length))
    flight = scene.flight(start, direction, jnp.full_like(ray.length, jnp.inf))
    zero, result = jnp.zeros_like(flight.depth), WalkResult.zeros(())
    black, white = (zero, zero, zero), (zero + 1, zero + 1, zero + 1)
    steps, to_light, alive = jnp.zeros((), jnp.int32), jnp.zeros((), bool), alive & (ray.length > 0)
    importance = None if scene.sampling.importance is None else zero + 1
    return Walk(words, steps, flight, to_light, direction, white, importance, black, zero, result, alive)
