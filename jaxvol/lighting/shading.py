"""How is a classified sample shaded? The interface of lightings.

Shading comes between the transfer function and compositing. A user passes a `Lighting`; it makes a `Shading`
for each image, which adds up terms for points around a sample, one by one; and engines call the `Shader`.
"""

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

from .._util.vec3 import Scalar, Vec3
from ..march.march import March
from ..scene.space import Line, Space
from ..scene.transfer import Classification, Measured, Transfer, classification_of
from ..scene.volume import Volume, read_as, with_fetch, with_voxels, without_voxels
from ..scene.voxel_fetch import OneByOne
from ..xla.memory import in_memory
from ..xla.sharding import varying
from ..xla.trees import PyTree


T = TypeVar("T")

TOGETHER = 8
"""Most terms of many samples that are computed at a time. To launch a kernel on several threads takes longer
than 2048 samples of one term take in it."""


class Sample(NamedTuple):
    """A sample to be shaded.

    - `point`: in the world. `direction`: of the ray, a unit vector.
    - `measured`, `color`, `extinction`: from the volume and the transfer function. Of what was measured, only
      the value, `measured[0]`, has a gradient.
    - `transmittance`: between the sample and the camera.
    - `pixel`: (column, row), which keys random numbers.
    """

    point: Vec3
    direction: Vec3
    measured: Measured
    color: Vec3
    extinction: Scalar
    transmittance: Scalar
    pixel: tuple[Int[Array, ""], Int[Array, ""]]


class ClassifiedPoint(NamedTuple):
    """What is at a point of the world.

    - `inside`: 1 in the volume, falling to 0 at one voxel outside, so that light does not jump at the
      volume's faces. `extinction` is multiplied by it.
    """

    inside: Scalar
    coordinate: Vec3
    value: Scalar
    extinction: Scalar


class Surroundings(eqx.Module):
    """The scene, as seen from a sample."""

    volume: Volume
    transfer: Transfer
    space: Space
    live: Bool[Array, ""] | None = None
    """Always true, but opaque to XLA: see `xla.in_memory`. None: no branches, since fetches cannot be
    recorded inside one."""
    tables: Classification | None = None
    """The classification, if its tables were computed before."""

    def before_loop(self) -> "Surroundings":
        """The same, with the transfer function's tables, which a loop would compute again each time."""
        return replace(self, tables=self.classification)

    def in_memory_by(self, live: Bool[Array, ""], sample: Sample) -> "Surroundings":
        """The same, with what is `stored` for this sample put in memory."""
        return replace(self, live=varying(live, sample))

    @property
    def classification(self) -> Classification:
        """The transfer function, applied to the volume."""
        return classification_of(self.transfer, self.volume) if self.tables is None else self.tables

    def stored(self, f: Callable[[], T]) -> T:
        """`f()`, computed once for all its uses."""
        return f() if self.live is None else in_memory(self.live, f)

    def fetched(self, points: list[Vec3]) -> list[Measured]:
        """What the transfer function reads at world points."""
        classification = self.classification
        return [classification.at(self.space.coordinate(point)) for point in points]

    def classified(self, point: Vec3, measured: Measured) -> ClassifiedPoint:
        """What is at a world point, from what was fetched there."""
        coordinate = self.space.coordinate(point)
        x, y, z = (
            jnp.clip(jnp.minimum(c + 1, n - c), 0, 1)
            for c, n in zip(coordinate, self.volume.shape, strict=True)
        )
        inside = x * y * z
        _, extinction = self.classification.classify(measured)
        return ClassifiedPoint(inside, coordinate, measured[0], inside * extinction)


class Shading(eqx.Module):
    """A lighting, made ready for one image. All methods see one sample.

    A sample's light is a sum of `terms` over points around it. Only `term` may read voxels: under replay,
    those that are read elsewhere get no gradient.
    """

    @property
    def terms(self) -> int:
        """The number of terms."""
        return 0

    @property
    def inline(self) -> bool:
        """Whether all samples are shaded where they are, visible or not, since that takes less time than to
        gather those that are visible. For shading by one term that is nearly all of its work. `about` and
        `term` are told where the sample is, `color` also its colour; all else is as for a sample that nothing
        hides."""
        return False

    def thresholds(self, *, derivative: bool = False) -> Float[Array, " terms"]:
        """For each term, the transmittance below which neither it nor any after it adds anything to a sample;
        or, for the `derivative`, to any of its parts. They increase. By default all terms are needed."""
        return jnp.zeros(self.terms)

    @property
    def has_dark_samples(self) -> bool:
        """Whether behind little transmittance a sample may need no term at all. Its colour is then `dark`."""
        return False

    def dark(self, around: Surroundings, sample: Sample) -> Vec3:
        """The colour of a sample without any terms."""
        return sample.color

    @abstractmethod
    def about(self, around: Surroundings, sample: Sample) -> PyTree:
        """What all terms and `color` share: it is computed once for each sample."""

    def term(self, around: Surroundings, sample: Sample, shared: PyTree, number: Int[Array, ""]) -> PyTree:
        """One term: arrays, which are summed over all terms. Not called where `terms` is 0."""
        return ()

    @abstractmethod
    def color(self, sample: Sample, shared: PyTree, sums: PyTree) -> Vec3:
        """The shaded colour."""


class Lighting(eqx.Module):
    """How samples are shaded; or finished pixels, by a lighting that overrides `shade_pixel`."""

    @property
    def shades_pixels(self) -> bool:
        """Whether rays are marched without light, and `shade_pixel` is called once for each of them."""
        return type(self).shade_pixel is not Lighting.shade_pixel

    @property
    def reads_gradient(self) -> bool:
        """Whether samples read the volume's gradient, so that it is worth storing slopes. By default not."""
        return False

    @property
    def farthest_read(self) -> float | None:
        """Distance from a sample, world length, up to which its shading reads the volume: more than 0 must be
        read around a part of it. By default None: there is no such distance, or nobody knows it."""
        return None

    @abstractmethod
    def shading(self, around: Surroundings) -> Shading:
        """The shading of one image. What does not depend on the sample is computed here, once."""

    @property
    def smooth(self) -> "Lighting":
        """This lighting without its noise and savings: what others are compared with. By default itself."""
        return self

    @property
    def simpler(self) -> tuple["Simpler", ...]:
        """Lightings that cost less and may look nearly the same, the cheapest first. By default none."""
        return ()

    def prepared(self, volume: Volume, transfer: Transfer, march: March) -> "Lighting":
        """This lighting with what is worth computing once for several images, where nothing is traced."""
        return self

    def shade_pixel(
        self,
        classification: Classification,
        space: Space,
        line: Line,
        rgba: Float[Array, "4"],
        depth: Scalar,
    ) -> Float[Array, "4"]:
        """The premultiplied colour and opacity of a ray, as shaded, from those without light and its mean
        depth. `classification.light` shades samples. Not called unless overridden."""
        return rgba


class Simpler(NamedTuple):
    """A lighting in place of another one, what it is, and whether it has gradients."""

    lighting: Lighting
    what: str
    has_gradient: bool = True


def lit_classification(
    volume: Volume, transfer: Transfer, space: Space, lighting: Lighting | None, *, integrated: bool = False
) -> Classification:
    """Measuring, classifying and, where there is a lighting, shading the points of a volume, or also cells
    that are `integrated`."""
    classification = classification_of(transfer, volume, integrated=integrated)
    if lighting is None:
        return classification
    around = Surroundings(volume, transfer, space)
    return classification._replace(light=Shader(lighting.shading(around), around))


def _plain(volume: Volume) -> Volume:
    """The volume without the packed copy of its voxels."""
    return read_as(volume, OneByOne())


class Shader(NamedTuple):
    """What shades the samples of an image."""

    shading: Shading
    around: Surroundings

    @property
    def leaves(self) -> PyTree:
        """All that has a gradient, except the transfer function and the voxels."""
        return self.shading, self.around.space, without_voxels(_plain(self.around.volume))

    def with_leaves(self, leaves: PyTree, transfer: Transfer) -> "Shader":
        """The same with these leaves, a transfer function, and the same voxels."""
        (shading, space, rest), volume = leaves, self.around.volume
        whole = with_fetch(with_voxels(rest, volume.data), volume.fetch)
        return Shader(shading, Surroundings(whole, transfer, space))

    def __call__(self, sample: Sample) -> Vec3:
        """The shaded colour of a sample, or those of many along one axis."""
        shade = shade_sample if sample.extinction.ndim == 0 else shade_samples
        return shade(self.shading, self.around, sample)


def shade_sample(shading: Shading, around: Surroundings, sample: Sample) -> Vec3:
    """The shaded colour of a sample."""
    shared = shading.about(around, sample)
    return shading.color(sample, shared, _all_terms(shading, around, sample, shared))


def _all_terms(shading: Shading, around: Surroundings, sample: Sample, shared: PyTree) -> PyTree:
    """The sums of a sample's terms; None where there are none."""
    if shading.terms == 0:
        return None

    # The backward pass computes each term again, so that memory holds the intermediate values of one term,
    # not of all.
    @jax.checkpoint
    def add(sums: PyTree, number: Int[Array, ""]) -> tuple[PyTree, None]:
        added = shading.term(looped.in_memory_by(number >= 0, sample), sample, shared, number)
        return jax.tree.map(jnp.add, sums, added), None

    looped = around.before_loop()
    term = partial(shading.term, around, sample, shared)
    return jax.lax.scan(add, varying(zeros_like_result(term), sample), jnp.arange(shading.terms))[0]


def shade_samples(shading: Shading, around: Surroundings, samples: Sample) -> Vec3:
    """The shaded colours of samples along one axis. Terms that none of them needs are left out."""
    shared = jax.vmap(partial(shading.about, around))(samples)
    sums = needed_terms(shading, around, samples, shared)
    return jax.vmap(shading.color)(samples, shared, sums)


@eqx.filter_custom_jvp
def needed_terms(shading: Shading, around: Surroundings, samples: Sample, shared: PyTree) -> PyTree:
    """The sums of the terms that any of these samples needs; None where there are none. Their derivative is
    that of all terms: a term of 0 may have one, and JAX cannot differentiate this loop in reverse."""
    if shading.terms == 0:
        return None

    looped = around.before_loop()
    together = math.ceil(shading.terms / math.ceil(shading.terms / TOGETHER))

    def terms(first: Int[Array, ""]) -> PyTree:
        here = looped.in_memory_by(first >= 0, samples)
        of_samples = jax.vmap(partial(shading.term, here), in_axes=(0, 0, None))
        numbers = first + jnp.arange(together, dtype=jnp.int32)
        each = jax.vmap(of_samples, in_axes=(None, None, 0))(samples, shared, numbers)

        def total(leaf: Array) -> Array:  # `jnp.sum` over the terms would not be vectorized over the samples
            return reduce(
                jnp.add, (jnp.where(numbers[i] < shading.terms, leaf[i], 0) for i in range(together))
            )

        return jax.tree.map(total, each)

    def add(group: Int[Array, ""], sums: PyTree) -> PyTree:
        return jax.tree.map(jnp.add, sums, terms(group * together))

    needed = terms_above(shading.thresholds(), samples.transmittance)
    groups = -(-needed // together)
    return jax.lax.fori_loop(0, groups, add, varying(zeros_like_result(terms), samples))


@needed_terms.def_jvp
def _(primals: Any, tangents: Any) -> Any:
    def all_(shading: Shading, around: Surroundings, samples: Sample, shared: PyTree) -> PyTree:
        return jax.vmap(partial(_all_terms, shading, around))(samples, shared)

    return eqx.filter_jvp(all_, primals, tangents)


def terms_above(
    thresholds: Float[Array, " terms"], transmittance: Float[Array, " samples"]
) -> Int[Array, ""]:
    """How many terms, from the first one on, any of these samples needs. Of NaN, all."""
    return jnp.sum(~(jnp.max(transmittance) < thresholds), dtype=jnp.int32)


def zeros_like_result(of_number: Callable[[Int[Array, ""]], PyTree]) -> PyTree:
    """Zeros of the shapes of what a function of a term's number returns."""
    shapes = jax.eval_shape(of_number, jnp.zeros((), jnp.int32))
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
