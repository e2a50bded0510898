"""The interface of lightings: `render` takes a `Lighting`, which makes a `Shading` for each image; engines
call the `Shader`, which adds up a sample's terms."""

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

TOGETHER = 8
"""Most terms of many samples computed at a time, so that kernels do enough work for their launch."""

FEW_TOGETHER = 4
"""The same where few terms are needed, so that fewer are computed that are not."""


class Sample(NamedTuple):
    """A sample to be shaded.

    Attributes:
        point: in the world.
        direction: of the ray, a unit vector.
        measured: what was read from the volume; only the value, `measured[0]`, has a gradient.
        color: from the transfer function.
        extinction: from the transfer function.
        transmittance: between the sample and the camera.
        pixel: (column, row), which keys random numbers.
        place: the point, from the `anchor` of its space on, which float32 resolves where the world's zero is
            far away, too; or None.
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
    """What is at a point of the world. `inside`: 1 in the volume, falling to 0 at one voxel outside, so that
    light does not jump at the volume's faces; `extinction` is multiplied by it."""

    inside: Scalar
    coordinate: Vec3
    value: Scalar
    extinction: Scalar


class Surroundings(eqx.Module):
    """The scene around a sample.

    Attributes:
        live: of `in_memory`; None: nothing is stored, since fetches cannot be recorded inside a branch.
        tables: the classification, if it was computed before.
    """

    volume: Volume
    transfer: Transfer
    space: Space
    live: Bool[Array, ""] | None = None
    tables: Classification | None = None

    def in_memory_by(self, live: Bool[Array, ""], sample: Sample) -> "Surroundings":
        """The same, with what is `stored` for this sample put in memory."""
        return replace(self, live=varying(live, sample))

    @property
    def classification(self) -> Classification:
        """The transfer function, applied to the volume."""
        return classification_of(self.transfer, self.volume) if self.tables is None else self.tables

    def stored(self, f: Callable[[], T]) -> T:
        """`f()`, which XLA would otherwise compute again for each of its uses."""
        return f() if self.live is None else in_memory(self.live, f)

    def measured(self, point: Vec3) -> Measured:
        """What the transfer function reads at a world point."""
        return self.classification.at(self.space.coordinate(point))

    def classified(self, point: Vec3, measured: Measured) -> ClassifiedPoint:
        """What is at a world point, from what was `measured` there."""
        coordinate = self.space.coordinate(point)
        x, y, z = (
            jnp.clip(jnp.minimum(c + 1, n - c), 0, 1)
            for c, n in zip(coordinate, self.volume.shape, strict=True)
        )
        inside = x * y * z
        _, extinction = self.classification.classify(measured)
        return ClassifiedPoint(inside, coordinate, measured[0], inside * extinction)


class Lighting(eqx.Module):
    """What `render` takes as lighting. To add a lighting, subclass `Shading`."""

    @property
    def reads_gradient(self) -> bool:
        """Whether samples read the volume's gradient. By default not."""
        return False

    @property
    def reads_value(self) -> bool:
        """Whether samples read the volume's value, so that it must have one channel. By default so."""
        return True

    @property
    def farthest_read(self) -> float | None:
        """Distance from a sample, world length, up to which its shading reads the volume. By default None:
        unknown, or unbounded."""
        return None

    @abstractmethod
    def for_image(self, around: "Surroundings") -> "Shading":
        """What shades the samples of one image; here is computed what does not depend on the sample."""


class Shading(Lighting):
    """A lighting that shades samples, by three methods, each of which sees one sample: `begin`, `term` and
    `color`, of which only the last one is required.

    The light at a sample is a sum of `terms`, such as one for each light source. Only `term` may read voxels:
    under replay, those that are read elsewhere get no gradient.

    If there is one term and all it reads is the gradient at the sample (`reads_gradient` is true and
    `farthest_read` is 0), all samples are shaded, also invisible ones. Of a sample, `begin` and `term` are
    then told where it is, and `color` also its colour; its transmittance is 1, and all else NaN.
    """

    @property
    def terms(self) -> int:
        """The number of terms; by default 0."""
        return 0

    def thresholds(self) -> Float[Array, " terms"] | None:
        """For each term, the transmittance between a sample and the camera below which neither this term nor
        any later one adds anything, nor do their derivatives. They increase. By default None: all count."""
        return None

    @property
    def skips_hidden(self) -> bool:
        """Whether, by its `thresholds`, a sample behind little transmittance may need no term at all."""
        return False

    def for_image(self, around: "Surroundings") -> "Shading":
        return self

    def begin(self, around: "Surroundings", sample: Sample) -> PyTree:
        """What all terms and `color` share. It is computed once for each sample."""
        return ()

    def term(self, around: "Surroundings", sample: Sample, shared: PyTree, number: Int[Array, ""]) -> PyTree:
        """One term: arrays, which are summed over all terms. Not called where `terms` is 0."""
        return ()

    @abstractmethod
    def color(self, sample: Sample, shared: PyTree, sums: PyTree) -> Vec3:
        """The shaded colour. `sums`: over all terms; None where `terms` is 0."""


def lit_classification(
    volume: Volume, transfer: Transfer, space: Space, lighting: Lighting | None, *, integrated: bool = False
) -> Classification:
    """The classification of a volume, with the shader of its samples if there is a lighting."""
    classification = classification_of(transfer, volume, integrated=integrated)
    if lighting is None:
        return classification
    around = Surroundings(volume, transfer, space)
    return classification._replace(light=Shader.of(lighting, around))


class Shader(NamedTuple):
    """What shades the samples of an image."""

    shading: Shading
    around: Surroundings

    @classmethod
    def of(cls, lighting: Lighting, around: Surroundings) -> "Shader":
        return cls(lighting.for_image(around), around)

    @property
    def inline(self) -> bool:
        """Whether all samples are shaded where they are: see `Shading`."""
        shading = self.shading
        return shading.terms == 1 and shading.reads_gradient and shading.farthest_read == 0

    @property
    def leaves(self) -> PyTree:
        """All that has a gradient, except the transfer function and the voxels."""
        volume = self.around.volume
        plain = read_as(volume, *[OneByOne()] * len(grids(volume)))  # without the packed copies of its voxels
        return self.shading, self.around.space, without_voxels(plain)

    def with_leaves(self, leaves: PyTree, transfer: Transfer) -> "Shader":
        (shading, space, rest), volume = leaves, self.around.volume
        whole = with_fetches(with_voxels(rest, voxels_of(volume)), fetches_of(volume))
        return Shader(shading, Surroundings(whole, transfer, space))

    def __call__(self, sample: Sample) -> Vec3:
        """The shaded colour of a sample, or those of many, without terms that none needs."""
        shading, around = self
        if self.inline:  # told no more than the fast engine tells it
            one, unknown = (jnp.full_like(sample.extinction, value) for value in (1, jnp.nan))
            sample = sample._replace(measured=(), extinction=unknown, transmittance=one)
        if sample.extinction.ndim == 0:
            shared = shading.begin(around, sample)
            return self.color(sample, shared, _all_terms(shading, around, sample, shared))
        shared = jax.vmap(partial(shading.begin, around))(sample)
        return jax.vmap(self.color)(sample, shared, needed_terms(shading, around, sample, shared))

    def color(self, sample: Sample, shared: PyTree, sums: PyTree) -> Vec3:
        """`Shading.color`, whose answer is checked."""
        color = self.shading.color(sample, shared, sums)
        check_answer(self.shading, "color", color, sample.color)
        return color


def _all_terms(shading: Shading, around: Surroundings, sample: Sample, shared: PyTree) -> PyTree:
    """The sums of a sample's terms; None where there are none."""
    if shading.terms == 0:
        return None

    @jax.checkpoint  # so that the backward pass holds the intermediate values of one term, not of all
    def add(sums: PyTree, number: Int[Array, ""]) -> tuple[PyTree, None]:
        added = shading.term(looped.in_memory_by(number >= 0, sample), sample, shared, number)
        return jax.tree.map(jnp.add, sums, added), None

    looped, none = replace(around, tables=around.classification), no_terms(shading, around, sample, shared)
    return jax.lax.scan(add, varying(none, sample), jnp.arange(shading.terms))[0]


@eqx.filter_custom_jvp
def needed_terms(shading: Shading, around: Surroundings, samples: Sample, shared: PyTree) -> PyTree:
    """The sums of the terms that any of these samples needs; None where there are none. Their derivative is
    that of all terms, since JAX cannot differentiate this loop in reverse."""
    if shading.terms == 0:
        return None

    looped = replace(around, tables=around.classification)
    most = FEW_TOGETHER if shading.skips_hidden else TOGETHER
    together = math.ceil(shading.terms / math.ceil(shading.terms / most))

    def add(group: Int[Array, ""], sums: PyTree) -> PyTree:
        here = looped.in_memory_by(group >= 0, samples)
        of_samples = jax.vmap(partial(shading.term, here), in_axes=(0, 0, None))
        numbers = group * together + jnp.arange(together, dtype=jnp.int32)
        each = jax.vmap(of_samples, in_axes=(None, None, 0))(samples, shared, numbers)

        def total(leaf: Array) -> Array:  # `jnp.sum` over the terms would not be vectorized over the samples
            return reduce(
                jnp.add, (jnp.where(numbers[i] < shading.terms, leaf[i], 0) for i in range(together))
            )

        return jax.tree.map(jnp.add, sums, jax.tree.map(total, each))

    none = jax.vmap(partial(no_terms, shading, around))(samples, shared)
    groups = -(-terms_needed(shading, samples.transmittance) // together)
    return jax.lax.fori_loop(0, groups, add, varying(none, samples))


@needed_terms.def_jvp
def _(primals: Any, tangents: Any) -> Any:
    def all_terms(shading: Shading, around: Surroundings, samples: Sample, shared: PyTree) -> PyTree:
        return jax.vmap(partial(_all_terms, shading, around))(samples, shared)

    return eqx.filter_jvp(all_terms, primals, tangents)


def terms_needed(shading: Shading, transmittance: Float[Array, " samples"]) -> Int[Array, ""]:
    """How many terms, from the first one on, any of these samples needs. Of NaN, all."""
    thresholds = shading.thresholds()
    if thresholds is None:
        return jnp.asarray(shading.terms, jnp.int32)
    return jnp.sum(~(jnp.max(transmittance) < thresholds), dtype=jnp.int32)


def no_terms(shading: Shading, around: Surroundings, sample: Sample, shared: PyTree) -> PyTree:
    """The sums of none of a sample's terms: zeros."""
    shapes = jax.eval_shape(partial(shading.term, around, sample, shared), jnp.zeros((), jnp.int32))
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
