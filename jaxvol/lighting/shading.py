"""How is a classified sample shaded? The interface of lightings.

Shading comes between the transfer function and compositing. A user passes a `Lighting`; it makes a `Shading`
for each image; and engines call `shade_sample`, which adds up terms for points around a sample, one by one.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._util.trees import PyTree
from .._util.vec3 import Scalar, Vec3
from .._util.voxel_fetch import Recording
from .._util.xla import in_memory
from ..march import March
from ..space import Line, Space
from ..transfer import Classification, Measured, Transfer, classification_of
from ..volume import Volume, with_fetch


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
    color: Vec3
    extinction: Scalar


class Surroundings(eqx.Module):
    """The scene, as seen from a sample."""

    volume: Volume
    transfer: Transfer
    space: Space
    live: Bool[Array, ""] | None = None
    """Always true, but opaque to XLA: see `xla.in_memory`. None: no branches, since fetches cannot be
    recorded inside one."""

    def at(self, point: Vec3) -> ClassifiedPoint:
        """What is at a world point."""
        inside, coordinate, measured = self._measured(point)

        def found(measured: Measured) -> tuple[Vec3, Scalar]:
            return self.transfer.classification(self.volume).classify(measured)

        color, extinction = self._in_memory(found, measured)
        return ClassifiedPoint(inside, coordinate, measured[0], color, inside * extinction)

    def extinction(self, point: Vec3) -> Scalar:
        """The extinction at a world point."""
        inside, _, measured = self._measured(point)
        return inside * self.transfer.classification(self.volume).classify(measured)[1]

    def _measured(self, point: Vec3) -> tuple[Scalar, Vec3, Measured]:
        coordinate = self.space.coordinate(point)
        classification = self.transfer.classification(self.volume)
        x, y, z = (
            jnp.clip(jnp.minimum(c + 1, n - c), 0, 1)
            for c, n in zip(coordinate, self.volume.shape, strict=True)
        )
        return x * y * z, coordinate, self._in_memory(classification.at, coordinate)

    def _in_memory(self, f: Callable[[Any], Any], argument: Any) -> Any:
        return f(argument) if self.live is None else in_memory(self.live, f, argument)


class Shading(eqx.Module):
    """A lighting, made ready for one image. All methods see one sample.

    A sample's light is a sum of `terms` over points around it. Only `term` may read voxels: under replay,
    those that are read elsewhere get no gradient.
    """

    @property
    def terms(self) -> int:
        """The number of terms."""
        return 0

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
    shading = lighting.shading(around)
    return classification._replace(light=lambda sample: shade_sample(shading, around, sample)[0])


def shade_sample(
    shading: Shading, around: Surroundings, sample: Sample, perturbations: Any = None
) -> tuple[Vec3, Any]:
    """The shaded colour of a sample, and the first voxels of the cubes that its terms fetched.

    `perturbations`: None, and then no voxels are returned; or, for a gradient of the voxels, those of
    `Recording`. Perturbations and voxels are arrays with a leading axis over the terms."""
    shared = shading.about(around, sample)

    # The backward pass computes each term again, so that memory holds the intermediate values of one term,
    # not of all.
    @jax.checkpoint
    def one(sums: PyTree, each: tuple[Int[Array, ""], Any]) -> tuple[PyTree, Any]:
        number, perturbations = each
        volume, live, bases = around.volume, number >= 0, None
        if perturbations is not None:
            bases, live = [], None
            volume = with_fetch(volume, Recording(perturbations, bases))
        here = Surroundings(volume, around.transfer, around.space, live)
        added = shading.term(here, sample, shared, number)
        return jax.tree.map(jnp.add, sums, added), bases

    if shading.terms == 0:
        return shading.color(sample, shared, None), None if perturbations is None else []
    term = jax.eval_shape(lambda: shading.term(around, sample, shared, jnp.zeros((), jnp.int32)))
    none = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), term)
    sums, bases = jax.lax.scan(one, none, (jnp.arange(shading.terms), perturbations))
    return shading.color(sample, shared, sums), bases
