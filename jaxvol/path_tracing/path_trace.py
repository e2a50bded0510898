"""Unbiased path tracing of light that is scattered many times: the reference for cheaper lighting."""

from functools import partial
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from .._util.checks import Arrayable, all_finite, described, flag, integer, number
from .._util.noise import hashed_uniforms_4, is_key
from ..engine.acceleration import with_words, words_of
from ..lighting.lights import Light, lights_of
from ..lighting.materials import Material, materials_of
from ..ray import check_arguments
from ..scene.camera import Camera
from ..scene.occupancy import Blocks
from ..scene.space import Affine, enter
from ..scene.transfer import Transfer
from ..scene.volume import Volume, without_voxels
from ..xla.compiling import compiled
from ..xla.platform import is_traced
from .lanes import walk_all
from .medium import Medium
from .walks import Walk, WalkResult, WalkScene, Words, step


LANES = 2**13
"""Walks that run side by side by default on a CPU; 32 times as many on a GPU."""

WALKS_PER_LANE = 128
"""Walks that each lane of a batch runs, one after the other."""

NOT_DIFFERENTIABLE = (
    "path_trace has no derivative, but an input carries a tangent here (jax.grad, jax.jvp). Differentiate "
    "lighting.ScattererTemplates instead, or apply jax.lax.stop_gradient to the inputs."
)
"""Error message: how often and where a path collides jumps with the extinction."""


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
    """

    radiance: Float[Array, "height width 3"]
    opacity: Float[Array, "height width"]
    deviations: Float[Array, "height width 3"]
    exhausted: Bool[Array, "height width"]
    paths: int = eqx.field(static=True)
    seed: UInt32[Array, ""]

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
        background = jnp.asarray(background, self.radiance.dtype)
        if background.shape not in ((3,), self.radiance.shape):
            shapes = f"(3,) or {self.radiance.shape}"
            raise ValueError(f"background must have shape {shapes}; got {background.shape}.")
        background = jnp.broadcast_to(background, self.radiance.shape)
        return self.radiance + (1 - self.opacity[..., None]) * background

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
        return PathTraced(radiance, opacity, deviations, self.exhausted | other.exhausted, paths, other.seed)


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
) -> PathTraced:
    """Image of a volume that scatters light any number of times.

    The extinction is the transfer function's, at the trilinear value, and the single-scattering albedo is its
    colour, clipped to [0, 1]: an image corresponds to one by Mitsuba's `volpath` with a heterogeneous medium.
    (`render` treats the colour as light that the medium emits.)

    The image is radiance, in the unit of `lights`, as that of `ScattererTemplates`: in a white furnace
    (albedo 1 under a `ConstantLight` of radiance L) it is L times the opacity.

    NaN or infinity in any input makes the whole image NaN, since any path may reach it.

    Random numbers have 24 bits, so free paths longer than 16.6 mean free paths within a block of voxels, of
    probability 6e-8, are never drawn.

    Sources: Kajiya and Von Herzen 1984; Novák et al. 2018; see `tracking`.

    Args:
        volume: on its own grid; curved grids (`ToroidalMap`) are not supported.
        transfer: a `TransferFunction`, a `LabelTransferFunction`, or another one with a `majorant`.
        camera: its rays pass through the centres of pixels, as in `render`.
        lights: those with a position or a direction are sampled at every scattering, one of them at random; a
            `ConstantLight` is gathered by paths that leave the volume. A `PointLight` inside a medium is also
            unbiased, but has infinite variance: its inverse square makes a few pixels far too bright.
        paths: per pixel, ≥ 1. A pixel's paths take 64 bytes each at once. More paths of another key are added
            by `PathTraced.joined`.
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

    Returns:
        A `PathTraced`, with the standard error of each pixel.

    Raises:
        ValueError: for arguments out of these ranges, no lights, a transfer function without a majorant, and
            labels where the volume has none.
        RuntimeError: if it is differentiated with respect to any of its inputs. It may be called in a
            function that is differentiated with respect to something else.
    """
    order = "path_trace(volume, transfer, camera, lights)"
    check_arguments(order, volume=volume, transfer=transfer, camera=camera)
    volume, transfer, camera, lights, materials, anisotropy = eqxi.nondifferentiable(
        (volume, transfer, camera, lights, materials, anisotropy), msg=NOT_DIFFERENTIABLE
    )
    lights = lights_of(lights)
    materials = () if materials is None else materials_of(materials)
    if volume.labels is None and any(material.label is not None for material in materials):
        raise ValueError("materials use labels, but this volume has none; give Volume(..., labels=...).")
    paths = integer("paths", paths, 1)
    anisotropy = number("anisotropy", anisotropy, above=-1, below=1)
    limit = min(integer("max_scatterings", max_scatterings, 1), 2**31 - 1)
    if lanes is None:
        lanes = LANES if jax.default_backend() == "cpu" else 32 * LANES
    lanes, antialias, seed = integer("lanes", lanes, 1), flag("antialias", antialias), _seed(key)
    pixels = min(max(WALKS_PER_LANE * lanes // paths, 1), camera.size[0] * camera.size[1])
    blocks = Blocks.of(volume, slopes=transfer.reads_gradient)
    inputs = volume, blocks, transfer, materials, lights, anisotropy, camera
    limit = jnp.asarray(limit, jnp.int32)
    return _trace(inputs, words_of(volume), limit, seed, paths, lanes, pixels, antialias)


def _seed(key: Any) -> UInt32[Array, ""]:
    """Random word from a seed, or from a key of `jax.random`."""
    if not is_key(key):
        if not is_traced(key):
            key = integer("key", key, 0, otherwise=", or a key of jax.random")
        elif key.shape != () or not jnp.issubdtype(key.dtype, jnp.integer):
            raise ValueError(f"key must be an integer, or a key of jax.random; got {described(key)}.")
        key = jax.random.key(key)
    return jax.random.bits(key, (), jnp.uint32)


@compiled
def _trace(
    inputs: tuple[Any, ...],
    words: UInt32[Array, " voxels"] | None,
    max_scatterings: Int[Array, ""],
    seed: UInt32[Array, ""],
    paths: int,
    lanes: int,
    pixels: int,
    antialias: bool,
) -> PathTraced:
    """Trace the image in batches of `pixels`. `words`: the volume's packed voxels."""
    # float64 becomes float32, whose rounding is far below the noise
    volume, blocks, transfer, materials, lights, anisotropy, camera = jax.tree.map(
        lambda leaf: leaf.astype(jnp.float32) if leaf.dtype == jnp.float64 else leaf, inputs
    )
    packed, (width, height) = with_words(volume, words), camera.size
    medium = Medium.of(packed, blocks, transfer, materials)
    scene = WalkScene(packed, medium, lights, anisotropy, max_scatterings)
    # Checked here, since comparisons in the walks would hide a NaN. The values of a volume with its own field
    # are unknown and its ranges infinite, which is not an error.
    ranges = blocks if volume.field is None else None
    valid = all_finite((without_voxels(volume), ranges, medium.majorants, transfer))
    valid &= all_finite((materials, lights, anisotropy, camera))
    batches, count = -(-width * height // pixels), pixels * paths

    def batch(number: Int[Array, ""]) -> tuple[Array, ...]:
        def begin(index: Int[Array, " lanes"]) -> Walk:
            pixel, path = number * pixels + index // paths, index % paths
            alive = valid & (index < count) & (pixel < width * height)
            words = pixel.astype(jnp.uint32), path.astype(jnp.uint32), jnp.broadcast_to(seed, index.shape)
            return jax.vmap(partial(_begin, scene, camera, antialias))(words, alive)

        results = walk_all(begin, partial(step, scene), count, lanes)
        results = jax.tree.map(lambda leaf: leaf.reshape(pixels, paths), results)
        radiance = jnp.stack(results.radiance, axis=-1)
        mean = radiance.mean(axis=1)
        opacity = results.met.astype(mean.dtype).mean(axis=1)
        deviations = jnp.square(radiance - mean[:, None]).sum(axis=1)
        return mean, opacity, deviations, results.exhausted.any(axis=1)

    def image(leaf: Array) -> Array:
        return leaf.reshape(-1, *leaf.shape[2:])[: width * height].reshape(height, width, *leaf.shape[2:])

    *numbers, exhausted = map(image, jax.lax.map(batch, jnp.arange(batches, dtype=jnp.int32)))
    radiance, opacity, deviations = (jnp.where(valid, each, jnp.nan) for each in numbers)
    return PathTraced(radiance, opacity, deviations, exhausted, paths, seed)


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
    return Walk(words, steps, flight, to_light, direction, white, black, zero, result, alive)
