"""Interface of lightings: `render` takes a `Lighting`, which makes a `Shading` for each image; engines call
the `Shader`, which sums a sample's terms."""

import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from functools import partial, reduce
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._util.checks import check_answer
from .._util.vec3 import Scalar, Vec3
from ..march.march import March
from ..scene.space import Space
from ..scene.transfer import Classification, Measured, Transfer, classification_of
from ..scene.volume import (
    Volume,
    fetches_of,
    grids,
    read_as,
    voxels_of,
    with_fetches,
    with_voxels,
    without_voxels,
)
from ..scene.voxel_fetch import OneByOne
from ..xla.memory import in_memory
from ..xla.sharding import varying
from ..xla.trees import PyTree


T = TypeVar("T")

TERMS_AT_ONCE = 8
"""Terms of many samples computed at a time, at most: kernels then do enough work for their launch."""

FEW_TERMS_AT_ONCE = 4
"""The same for a lighting that `skips_hidden`, so that fewer unneeded terms are computed."""


class Sample(NamedTuple):
    """A sample to be shaded.

    Attributes:
        point: world point.
        direction: unit vector of the ray.
        measured: values read from the volume; only the first, `measured[0]`, has a gradient.
        color: the transfer function's colour.
        extinction: the transfer function's extinction.
        transmittance: between the sample and the camera.
        pixel: (column, row), which keys random numbers.
        place: the point relative to the `anchor` of its space, which float32 resolves far from the world's
            origin, too; or None.
    """

    point: Vec3
    direction: Vec3
    measured: Measured
    color: Vec3
    extinction: Scalar
    transmittance: Scalar
    pixel: tuple[Int[Array, ""], Int[Array, ""]]
    place: Vec3 | None = None


class ClassifiedPoint(NamedTuple):
    """Volume and transfer function at a world point. `inside`: 1 in the volume, falling to 0 one voxel
    outside, so that light does not jump at the volume's faces; `extinction` is multiplied by it."""

    inside: Scalar
    coordinate: Vec3
    value: Scalar
    extinction: Scalar


class Surroundings(eqx.Module):
    """The scene around a sample.

    Attributes:
        live: condition for `in_memory`; None: nothing is stored, as fetches in a branch cannot be recorded.
        tables: the classification, if it was computed before.
    """

    volume: Volume
    transfer: Transfer
    space: Space
    live: Bool[Array, ""] | None = None
    tables: Classification | None = None

    def in_memory_by(self, live: Bool[Array, ""], sample: Sample) -> "Surroundings":
        """Put what is `stored` for this sample in memory."""
        return replace(self, live=varying(live, sample))

    @property
    def classification(self) -> Classification:
        """The transfer function, applied to the volume."""
        return classification_of(self.transfer, self.volume) if self.tables is None else self.tables

    def stored(self, f: Callable[[], T]) -> T:
        """Call `f` once; XLA would otherwise compute it again for each of its uses."""
        return f() if self.live is None else in_memory(self.live, f)

    def measured(self, point: Vec3) -> Measured:
        """Read the volume for the transfer function at a world point."""
        return self.classification.at(self.space.coordinate(point))

    def classified(self, point: Vec3, measured: Measured) -> ClassifiedPoint:
        """Classify what was `measured` at a world point."""
        coordinate = self.space.coordinate(point)
        x, y, z = (
            jnp.clip(jnp.minimum(c + 1, n - c), 0, 1)
            for c, n in zip(coordinate, self.volume.shape, strict=True)
        )
        inside = x * y * z
        _, extinction = self.classification.classify(measured)
        return ClassifiedPoint(inside, coordinate, measured[0], inside * extinction)


class Lighting(eqx.Module):
    """Base class of the lightings of `render`. To add a lighting, subclass `Shading`."""

    @property
    def reads_gradient(self) -> bool:
        """True if samples read the volume's gradient; by default False."""
        return False

    @property
    def reads_value(self) -> bool:
        """True if samples read the volume's value, which then must have one channel; by default True."""
        return True

    @property
    def farthest_read(self) -> float | None:
        """Distance from a sample, world length, up to which its shading reads the volume; None, the default:
        unknown or unbounded."""
        return None

    def medium(self, transfer: Transfer) -> Transfer:
        """The transfer function by which rays see the volume; by default, that of the scene."""
        return transfer

    def baked(self, volume: Volume, transfer: Transfer, march: March) -> "Lighting":
        """The lighting with what is computed once for all images of a scene; by default, itself."""
        return self

    @abstractmethod
    def for_image(self, around: Surroundings) -> "Shading":
        """Make the shading of one image, with all that does not depend on the sample."""


class Shading(Lighting):
    """A lighting that shades one sample at a time, by its methods `begin`, `term` and `color`; only `color`
    is required.

    The light at a sample is a sum of `terms`, such as one for each light source. Only `term` may read voxels:
    under replay, voxels that other methods read get no gradient.

    If there is one term and it reads only the gradient at the sample (`reads_gradient` is true and
    `farthest_read` is 0), all samples are shaded, also invisible ones. `begin` and `term` then get only the
    position of the sample, and `color` also its colour; its transmittance is 1, and all else NaN.
    """

    @property
    def terms(self) -> int:
        """The number of terms; by default 0."""
        return 0

    def thresholds(self) -> Float[Array, " terms"] | None:
        """Transmittance, between a sample and the camera, below which a term and all later ones add nothing,
        nor do their derivatives. Thresholds increase. None, the default: all terms count."""
        return None

    @property
    def skips_hidden(self) -> bool:
        """True if, by its `thresholds`, a sample behind little transmittance may need no term at all."""
        return False

    def for_image(self, around: Surroundings) -> "Shading":
        return self

    def begin(self, around: Surroundings, sample: Sample) -> PyTree:
        """Compute, once for each sample, what all terms and `color` share."""
        return ()

    def term(self, around: Surroundings, sample: Sample, shared: PyTree, number: Int[Array, ""]) -> PyTree:
        """Compute a term: arrays, which are summed over all terms. Not called where `terms` is 0."""
        return ()

    @abstractmethod
    def color(self, sample: Sample, shared: PyTree, sums: PyTree) -> Vec3:
        """Compute the shaded colour. `sums`: over all terms; None where `terms` is 0."""


def lit_classification(
    volume: Volume, transfer: Transfer, space: Space, lighting: Lighting | None, *, integrated: bool = False
) -> Classification:
    """The classification of a volume, with a shader if there is a lighting."""
    classification = classification_of(transfer, volume, integrated=integrated)
    if lighting is None:
        return classification
    return classification._replace(light=Shader.of(lighting, Surroundings(volume, transfer, space)))


class Shader(NamedTuple):
    """A shading and the scene around its samples, for engines."""

    shading: Shading
    around: Surroundings

    @classmethod
    def of(cls, lighting: Lighting, around: Surroundings) -> "Shader":
        return cls(lighting.for_image(around), around)

    @property
    def inline(self) -> bool:
        """True if all samples are shaded, during the march: see `Shading`."""
        shading = self.shading
        return shading.terms == 1 and shading.reads_gradient and shading.farthest_read == 0

    @property
    def leaves(self) -> PyTree:
        """The parts with a gradient, except the transfer function and the voxels."""
        volume = self.around.volume
        plain = read_as(volume, *[OneByOne()] * len(grids(volume)))  # without the packed copies of its voxels
        return self.shading, self.around.space, without_voxels(plain)

    def with_leaves(self, leaves: PyTree, transfer: Transfer) -> "Shader":
        (shading, space, plain), volume = leaves, self.around.volume
        volume = with_fetches(with_voxels(plain, voxels_of(volume)), fetches_of(volume))
        return Shader(shading, Surroundings(volume, transfer, space))

    def __call__(self, sample: Sample) -> Vec3:
        """The shaded colour of a sample, or of many, without terms that no sample needs."""
        shading, around = self
        if self.inline:  # as in the fast engine, which passes nothing else
            one, unknown = (jnp.full_like(sample.extinction, value) for value in (1, jnp.nan))
            sample = sample._replace(measured=(), extinction=unknown, transmittance=one)
        if sample.extinction.ndim == 0:
            shared = shading.begin(around, sample)
            return self.color(sample, shared, _all_terms(shading, around, sample, shared))
        shared = jax.vmap(partial(shading.begin, around))(sample)
        return jax.vmap(self.color)(sample, shared, needed_terms(shading, around, sample, shared))

    def color(self, sample: Sample, shared: PyTree, sums: PyTree) -> Vec3:
        """Call `Shading.color`, and check its answer."""
        color = self.shading.color(sample, shared, sums)
        check_answer(self.shading, "color", color, sample.color)
        return color


def _all_terms(shading: Shading, around: Surroundings, sample: Sample, shared: PyTree) -> PyTree:
    """Sum a sample's terms; None if there are none."""
    if shading.terms == 0:
        return None

    @jax.checkpoint  # so that the backward pass holds the intermediate values of one term, not of all
    def add(sums: PyTree, number: Int[Array, ""]) -> tuple[PyTree, None]:
        term = shading.term(looped.in_memory_by(number >= 0, sample), sample, shared, number)
        return jax.tree.map(jnp.add, sums, term), None

    looped, zeros = replace(around, tables=around.classification), no_terms(shading, around, sample, shared)
    return jax.lax.scan(add, varying(zeros, sample), jnp.arange(shading.terms))[0]


@eqx.filter_custom_jvp
def needed_terms(shading: Shading, around: Surroundings, samples: Sample, shared: PyTree) -> PyTree:
    """Sum, for all samples, the terms that any sample needs; None if the shading has none. The derivative is
    that of all terms, since JAX cannot differentiate this loop in reverse."""
    if shading.terms == 0:
        return None

    looped = replace(around, tables=around.classification)
    limit = FEW_TERMS_AT_ONCE if shading.skips_hidden else TERMS_AT_ONCE
    size = math.ceil(shading.terms / math.ceil(shading.terms / limit))

    def add(group: Int[Array, ""], sums: PyTree) -> PyTree:
        term = partial(shading.term, looped.in_memory_by(group >= 0, samples))
        numbers = group * size + jnp.arange(size, dtype=jnp.int32)
        of_samples = jax.vmap(term, in_axes=(0, 0, None))
        terms = jax.vmap(of_samples, in_axes=(None, None, 0))(samples, shared, numbers)

        def total(leaf: Array) -> Array:  # `jnp.sum` over the terms would not be vectorized over the samples
            return reduce(jnp.add, (jnp.where(numbers[i] < shading.terms, leaf[i], 0) for i in range(size)))

        return jax.tree.map(jnp.add, sums, jax.tree.map(total, terms))

    zeros = jax.vmap(partial(no_terms, shading, around))(samples, shared)
    groups = -(-terms_needed(shading, samples.transmittance) // size)
    return jax.lax.fori_loop(0, groups, add, varying(zeros, samples))


@needed_terms.def_jvp
def _(primals: Any, tangents: Any) -> Any:
    def all_terms(shading: Shading, around: Surroundings, samples: Sample, shared: PyTree) -> PyTree:
        return jax.vmap(partial(_all_terms, shading, around))(samples, shared)

    return eqx.filter_jvp(all_terms, primals, tangents)


def terms_needed(shading: Shading, transmittance: Float[Array, " samples"]) -> Int[Array, ""]:
    """Count the first terms that any sample needs; all terms for a transmittance of NaN."""
    thresholds = shading.thresholds()
    if thresholds is None:
        return jnp.asarray(shading.terms, jnp.int32)
    return jnp.sum(~(jnp.max(transmittance) < thresholds), dtype=jnp.int32)


def no_terms(shading: Shading, around: Surroundings, sample: Sample, shared: PyTree) -> PyTree:
    """Zeros of the shapes of a sample's terms."""
    shapes = jax.eval_shape(partial(shading.term, around, sample, shared), jnp.zeros((), jnp.int32))
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
