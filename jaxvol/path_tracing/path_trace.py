"""Unbiased path tracing of light that is scattered many times: the reference for cheaper lighting."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from .._util.checks import Arrayable, all_finite, described, flag, integer, number
from .._util.noise import hashed_uniforms_4, is_key
from .._util.vec3 import Scalar, Vec3
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
from ..xla.linear import differentiable, moving_leaves
from ..xla.platform import in_numpy, is_traced
from ..xla.trees import PyTree, constant, floats
from .fixed_paths import has_step, with_constant_paths
from .lanes import Index, walk_all
from .likelihood import OF_DERIVATIVES, OF_IMAGES, Sampling
from .medium import Medium
from .replay import Inputs, Pulled, replay_all
from .walks import Walk, WalkResult, WalkScene, Words, step


LANES = 2**13
"""Walks that run side by side by default on a CPU; 32 times as many on a GPU."""

WALKS_PER_LANE = 128
"""Mean number of walks that a lane of a batch runs, one after the other."""

FIRST_ONLY = (
    "path_trace has first derivatives in either mode, and forward mode over forward mode; take jax.jacfwd or "
    "jax.jvp of these in place of jax.grad."
)
"""Error message for reverse mode over a derivative, and forward mode over reverse mode."""


class PathTraced(eqx.Module):
    """A path-traced image.

    Attributes:
        radiance: linear RGB of the light that the volume scatters into the camera, mean over all paths,
            without the background.
        opacity: fraction of paths that collide.
        deviations: sum over paths of the squared deviation of their radiance from the mean.
        exhausted: True where `max_scatterings` cut off a path, whose further light is missing.
        paths: number of paths of a pixel.
        seed: seed of the random numbers of the last paths.
        groups: mean radiance and, as last channel, opacity of each group of paths; None for one group, and
            where groups of different sizes were joined.
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
        xp, (deviations,) = in_numpy(self.deviations)
        return jnp.asarray(xp.sqrt(deviations / (self.paths * (self.paths - 1))), deviations.dtype)

    def image(self, background: Arrayable = (1.0, 1.0, 1.0)) -> Float[Array, "height width 3"]:
        """Linear RGB over a background.

        Args:
            background: one colour (3,), or an image of the same shape.

        Raises:
            ValueError: for another shape.
        """
        return self.radiance + (1 - self.opacity[..., None]) * _background(background, self.radiance)

    def images(self, background: Arrayable = (1.0, 1.0, 1.0)) -> Float[Array, "groups height width 3"]:
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
        """Image by the paths of two images of a scene.

        Args:
            other: an image of the same scene by another key.

        Returns:
            The image by all paths.

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
        groups = _all_groups(self, other)
        return PathTraced(radiance, opacity, deviations, exhausted, paths, other.seed, groups)


def _all_groups(a: PathTraced, b: PathTraced) -> Array | None:
    """The groups of two images, if they are of the same size."""
    if a.groups is None or b.groups is None or a.paths * len(b.groups) != b.paths * len(a.groups):
        return None
    return jnp.concatenate([a.groups, b.groups])


def _background(background: Arrayable, image: Array) -> Float[Array, "height width 3"]:
    background = jnp.asarray(background, image.dtype)
    if background.shape not in ((3,), image.shape):
        raise ValueError(f"background must have shape (3,) or {image.shape}; got {background.shape}.")
    return jnp.broadcast_to(background, image.shape)


def path_trace(
    volume: Volume,
    transfer: Transfer | Any,
    camera: Camera | Any,
    lights: Light | Sequence[Light],
    *,
    paths: int | Any = 16,
    key: Arrayable = 0,
    materials: Material | tuple[Material, ...] | None = None,
    anisotropy: Arrayable = 0.0,
    max_scatterings: int = 2**20,
    antialias: bool | Any = False,
    lanes: int | None = None,
    groups: int = 1,
) -> PathTraced:
    """Render a volume that scatters light any number of times by path tracing.

    The extinction is the transfer function's, at the trilinear value, and the single-scattering albedo is its
    colour, clipped to [0, 1]: an image corresponds to one by Mitsuba's `volpath` with a heterogeneous medium.
    (`render` treats the colour as light that the medium emits.)

    The image is radiance, in the unit of `lights`, as that of `ScattererTemplates`: in a white furnace
    (albedo 1 under a `ConstantLight` of radiance L) it is L times the opacity. Images are float32, also of
    float64 scenes. NaN or infinity in any input makes every pixel NaN, since any path may reach it (arguments
    with a range, such as a mean free path, raise an error instead). Extinctions above 128 per voxel count as
    that, for time. Random numbers have 24 bits, so free
    paths longer than 16.6 mean free paths within a block of voxels, of probability 6e-8, are never drawn.

    **Derivatives** are with respect to the transfer function's colours and extinction, the opacity and mean
    free path of materials, the anisotropy, the emission of lights, and, without materials, voxels. They are
    unbiased: decisions stay as drawn, and their probabilities enter as weights, so that the image does not
    change. Forward mode (`jax.jvp`, `jax.jacfwd`) takes the same paths for all its columns; with `groups`, a
    derivative has the standard error of the mean over groups. Reverse mode (`jax.grad`) is for many
    parameters, such as voxels. It sums over the same paths, which it walks again (`replay`): no step is
    stored, so that memory does not grow with the number of scatterings. Second derivatives are in forward
    mode over forward mode. The first gradient takes half a minute to compile on a CPU.

    An image and its derivative are by the same random numbers, so the gradient of a squared error is biased
    by their covariance. The product of two independent residuals, by `groups=2` or two keys, is without bias:
    `jnp.sum((a - reference) * (b - reference)) / 2`, with `a, b = traced.images(background)`.

    Derivatives have more noise than the image, which grows with the number of collisions of a path: take many
    paths in very thick media of high albedo. At a colour of 0 or 1, where the albedo is clipped, and at an
    extinction of 0, derivatives are one-sided. They are NaN with respect to an extinction of 0 inside a
    material, which would appear all at once. `deviations` and `standard_error` count as constants.

    Sources: Kajiya and Von Herzen 1984; Novák et al. 2018; see `tracking`. For derivatives: Vicini, Speierer
    and Jakob 2021; Nimier-David et al. 2022; see `likelihood`.

    Args:
        volume: a volume without a curved grid (`ToroidalMap`).
        transfer: a `TransferFunction`, a `LabelTransferFunction`, or another one with a `majorant`.
        camera: a camera, whose rays pass through the centres of pixels, as in `render`.
        lights: a light, or several. At every scattering, a random one of those with a position or a direction
            is sampled; a `ConstantLight` is gathered by paths that leave the volume. A `PointLight` inside a
            medium is also unbiased, but has infinite variance: a few pixels are far too bright.
        paths: number of paths of a pixel, ≥ 1. A path takes 64 bytes, and 16 for each derivative in forward
            mode, in batches of 128 `lanes` paths. `PathTraced.joined` adds more paths of another key.
        key: a seed, or a key of `jax.random`. The random numbers along a path depend only on the key, the
            pixel and the path's number.
        materials: where the transfer function shows a material, the extinction is 1/λ instead, and the albedo
            is colour · (1 - opacity). Where materials overlap, the first counts.
        anisotropy: g in (-1, 1), the mean cosine of a scattering (Henyey and Greenstein).
        max_scatterings: number of scatterings after which a path ends, ≥ 1. By default 2²⁰, so that only
            Russian roulette ends a path, with a probability that depends on its throughput. A smaller number
            renders light scattered at most that many times; `exhausted` marks the pixels that lack some.
        antialias: let rays pass through random points of their pixels.
        lanes: number of paths that are traced side by side. Memory grows with it; the result does not change.
        groups: number of groups of paths, a divisor of `paths`. Each of several groups keeps an image, 16
            bytes a pixel, and as much for each derivative; so any function of images has a standard error,
            `std(axis=0, ddof=1) / sqrt(groups)` over `PathTraced.images`.

    Returns:
        A `PathTraced`, with the standard error of each pixel.

    Raises:
        ValueError: for arguments out of range, no lights, a transfer function without a majorant, labels
            where the volume has none, and reverse mode over forward mode.
        RuntimeError: for any mode over reverse mode, and for differentiation with respect to inputs that
            move paths or jumps of the medium: the camera, the volume's place, directions and positions of
            lights, the control points' values of the transfer function, the values of materials, and voxels
            where there are materials or a transfer function has a step (the derivative is NaN if the
            transfer function is traced).
    """
    order = "path_trace(volume, transfer, camera, lights)"
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
    volume, transfer, camera, materials = with_constant_paths(volume, transfer, camera, materials, lights)
    blocks = Blocks.of(constant(volume), slopes=transfer.reads_gradient)
    inputs = Inputs(volume, transfer, materials, lights, anisotropy)
    options = TraceOptions(paths, groups, lanes, pixels, antialias)
    constants = camera, blocks, words_of(volume), jnp.asarray(limit, jnp.int32), seed
    trace = _differentiable if is_traced(inputs) else _trace
    return trace(inputs, constants, options)


def _seed(key: Arrayable) -> UInt32[Array, ""]:
    """Random word from a seed, or from a key of `jax.random`."""
    if not is_key(key):
        if not is_traced(key):
            key = integer("key", key, 0, otherwise=", or a key of jax.random")
        elif key.shape != () or not jnp.issubdtype(key.dtype, jnp.integer):
            raise ValueError(f"key must be an integer, or a key of jax.random; got {described(key)}.")
        key = jax.random.key(key)
    return _word(key)


_word = jax.jit(lambda key: jax.random.bits(key, (), jnp.uint32))


@dataclass(frozen=True)
class TraceOptions:
    """Static arguments. `pixels`: number of pixels of a batch."""

    paths: int
    groups: int
    lanes: int
    pixels: int
    antialias: bool

    @property
    def count(self) -> int:
        """Number of paths of a batch."""
        return self.pixels * self.paths

    def batches(self, camera: Camera) -> Int[Array, " batches"]:
        """Numbers of the batches of an image."""
        width, height = camera.size
        return jnp.arange(-(-width * height // self.pixels), dtype=jnp.int32)


Constants: TypeAlias = tuple[
    Camera, Blocks, UInt32[Array, " voxels"] | None, Int[Array, ""], UInt32[Array, ""]
]
"""Camera, ranges of blocks, the volume's packed voxels, `max_scatterings`, and the seed."""


class Walks(NamedTuple):
    """The walks of an image, in float32. `valid`: False makes the image NaN."""

    scene: WalkScene
    inputs: Inputs
    camera: Camera
    seed: UInt32[Array, ""]
    valid: Bool[Array, ""]

    @classmethod
    def of(cls, inputs: Inputs, constants: Constants, sampling: Sampling) -> "Walks":
        """The walks by some sampling."""
        # float64 becomes float32, whose rounding is far below the noise
        (volume, transfer, materials, lights, anisotropy), (camera, blocks, words, limit, seed) = (
            jax.tree.map(
                lambda leaf: leaf.astype(jnp.float32) if leaf.dtype == jnp.float64 else leaf,
                (inputs, constants),
            )
        )
        packed = with_words(volume, [words])
        medium = Medium.of(packed, blocks, transfer, materials, sampling)
        scene = WalkScene(packed, medium, lights, anisotropy, limit, sampling)
        # Checked here, since comparisons in the walks would hide a NaN. The values of a custom field are
        # unknown and their ranges infinite, which is not an error.
        ranges = blocks if volume.field is None else None
        valid = all_finite((without_voxels(volume), ranges, medium.majorants, transfer))
        valid &= all_finite((materials, lights, anisotropy, camera)) & transfer.valid & camera.valid
        return cls(scene, Inputs(packed, transfer, materials, lights, anisotropy), camera, seed, valid)

    def begin(
        self, options: TraceOptions, batch: Int[Array, ""], index: Index, *, replayed: bool = False
    ) -> Walk:
        """Walks of a batch by index."""
        pixel, path = batch * options.pixels + index // options.paths, index % options.paths
        width, height = self.camera.size
        alive = self.valid & (index < options.count) & (pixel < width * height)
        words = pixel.astype(jnp.uint32), path.astype(jnp.uint32), jnp.broadcast_to(self.seed, index.shape)
        return jax.vmap(partial(_begin, self.scene, self.camera, options.antialias, replayed))(words, alive)


def _traced_by(walks: Walks, options: TraceOptions) -> PathTraced:
    """Trace the image in batches of pixels."""
    (width, height), paths, pixels = walks.camera.size, options.paths, options.pixels

    def advance(batch: Walk, none: tuple[()]) -> tuple[Walk, tuple[()]]:
        return step(walks.scene, batch), none

    def batch(number: Int[Array, ""]) -> tuple[Array, ...]:
        results, _ = walk_all(partial(walks.begin, options, number), advance, options.count, options.lanes)
        results = jax.tree.map(lambda leaf: leaf.reshape(pixels, paths), results)
        radiance = jnp.stack(results.radiance, axis=-1)
        mean = radiance.mean(axis=1)
        deviations = jnp.square(radiance - mean[:, None]).sum(axis=1)
        numbers = mean, results.opacity.mean(axis=1), deviations, results.exhausted.any(axis=1)
        if options.groups == 1:
            return numbers
        rgba = jnp.concatenate([radiance, results.opacity[..., None]], axis=-1)
        return *numbers, rgba.reshape(pixels, options.groups, -1, 4).mean(axis=2)

    def image(leaf: Array) -> Array:
        return leaf.reshape(-1, *leaf.shape[2:])[: width * height].reshape(height, width, *leaf.shape[2:])

    outputs = map(image, jax.lax.map(batch, options.batches(walks.camera)))
    radiance, opacity, deviations, exhausted, *groups = outputs
    numbers = radiance, opacity, deviations, *(jnp.moveaxis(group, 2, 0) for group in groups)
    # by nan * array, the derivative becomes NaN, too
    radiance, opacity, deviations, *groups = (
        jnp.where(walks.valid, array, jnp.nan * array) for array in numbers
    )
    return PathTraced(radiance, opacity, deviations, exhausted, paths, walks.seed, *groups)


def _image(inputs: Inputs, constants: Constants, options: TraceOptions) -> PathTraced:
    return _traced_by(Walks.of(inputs, constants, OF_IMAGES), options)


def _push(tangents: Inputs, inputs: Inputs, constants: Constants, options: TraceOptions) -> PyTree:
    """Tangents of an image, by walks for derivatives."""

    def image(moving: Inputs) -> PathTraced:
        walks = Walks.of(eqx.combine(moving, inputs), constants, OF_DERIVATIVES)
        return floats(_traced_by(walks, options))

    derivative = jax.jvp(image, (moving_leaves(inputs, tangents),), (tangents,))[1]
    if jax.tree.leaves(tangents.volume):  # a transfer function that is traced was not checked
        derivative = jax.tree.map(partial(jnp.where, has_step(inputs.transfer), jnp.nan), derivative)
    return eqx.tree_at(lambda d: d.deviations, derivative, jnp.zeros_like(derivative.deviations))


def _pull(
    cotangents: PathTraced,
    perturbed: Inputs,
    _: tuple[()],
    inputs: Inputs,
    constants: Constants,
    options: TraceOptions,
) -> Inputs:
    """Cotangents of the perturbed inputs, by replays of the walks for derivatives."""
    inputs = eqxi.nondifferentiable(inputs, msg=FIRST_ONLY)
    walks = Walks.of(inputs, constants, OF_DERIVATIVES)
    bars = jnp.concatenate([cotangents.radiance, cotangents.opacity[..., None]], axis=-1)[None]
    if cotangents.groups is not None:
        bars = bars + options.groups * cotangents.groups
    bars = bars.reshape(len(bars), -1, 4) / options.paths

    def batch(sums: Pulled, number: Int[Array, ""]) -> tuple[Pulled, None]:
        def bars_of(index: Index) -> tuple[Vec3, Scalar]:
            pixel = jnp.minimum(number * options.pixels + index // options.paths, bars.shape[1] - 1)
            group = index % options.paths * len(bars) // options.paths
            r, g, b, opacity = jnp.moveaxis(bars[group, pixel], -1, 0)
            return (r, g, b), opacity

        begin = partial(walks.begin, options, number, replayed=True)
        return replay_all(walks.scene, walks.inputs, begin, bars_of, sums, options.count, options.lanes), None

    zeros, batches = Pulled.zeros(walks.inputs, perturbed), options.batches(walks.camera)
    result = jax.lax.scan(batch, zeros, batches)[0].cotangents(walks.inputs)
    step = has_step(inputs.transfer)
    volume = jax.tree.map(partial(jnp.where, step, jnp.nan), result.volume)
    result = jax.tree.map(partial(jnp.where, ~walks.valid, jnp.nan), result._replace(volume=volume))
    return jax.tree.map(lambda bar, leaf: bar.astype(leaf.dtype), result, eqx.filter(inputs, perturbed))


_trace = compiled(_image, by_jvp=True)
_differentiable = differentiable(
    _trace,
    lambda *args: (_trace(*args), ()),
    compiled(_push, in_turn=False),
    compiled(_pull, by_jvp=True),
    FIRST_ONLY,
)


def _begin(
    scene: WalkScene, camera: Camera, antialias: bool, replayed: bool, words: Words, alive: Bool[Array, ""]
) -> Walk:
    """Start a walk at the entry of the camera's ray into the volume."""
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
    zero, no = jnp.zeros_like(flight.depth), jnp.zeros((), bool)
    black, white = (zero, zero, zero), (zero + 1, zero + 1, zero + 1)
    result = WalkResult(black, zero, jnp.zeros((), jnp.int32), no, black if replayed else None)
    steps, alive = jnp.zeros((), jnp.int32), alive & (ray.length > 0)
    importance = None if scene.sampling.importance is None else zero + 1
    dark = white if replayed else None
    return Walk(words, steps, flight, no, direction, white, importance, black, zero, result, alive, dark)
