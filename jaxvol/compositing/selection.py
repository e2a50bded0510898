"""Selections: compositing modes whose pixel shows one depth of a ray, such as that of the greatest value."""

from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple, cast

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._util.vec3 import Color, Scalar, Vec3, along
from ..lighting.shading import Sample
from ..scene.occupancy import Blocks
from ..scene.space import Ray, Space
from ..scene.transfer import Classification, Measured, Transfer
from .blending import Compositing, Fragment, Outputs, State


class RaySampler(NamedTuple):
    """Measures, classifies and shades samples of a ray. Depths are past the entry.

    Attributes:
        ray: the ray.
        classification: measures, classifies and shades samples.
        depth_scale: 1, with the derivative by the step of depths at a fixed number of steps.
        gradient: gradient of the volume's value at a `place`; None during the march.
        chosen: the selected depth, as a constant and as a function of the scene; None during the march.
        space: the volume's space.
    """

    ray: Ray
    classification: Classification
    depth_scale: Scalar | int = 1
    gradient: Callable[[Vec3], Vec3] | None = None
    chosen: tuple[Scalar, Scalar] | None = None
    space: Space = cast(Space, None)

    def value(self, depth: Scalar) -> Scalar:
        """The volume's value at this depth."""
        return self.classification.measure(self.coordinate(depth))[0]

    def coordinate(self, depth: Scalar) -> Vec3:
        """The grid coordinate at this depth."""
        return self.ray.path(self.differentiable_depth(depth))

    def place(self, depth: Scalar) -> Vec3:
        """The world point at this depth, relative to the `anchor` of the space."""
        return along(self.ray.entry, self.ray.direction, self.differentiable_depth(depth))

    def point(self, depth: Scalar) -> Vec3:
        """The world point at this depth."""
        return self.space.world(self.place(depth))

    def differentiable_depth(self, depth: Scalar) -> Scalar:
        """The depth as a function of the step, and, for the selected sample, of the faces of its cell."""
        if self.chosen is None:
            return depth * self.depth_scale
        number, moving = self.chosen
        return jnp.where(depth == number, moving, depth * self.depth_scale)

    def color(
        self, depth: Scalar, measured: Measured, classified: tuple[Color, Scalar], transmittance: Scalar
    ) -> Color:
        """Colour of a sample at this depth behind this transmittance; shaded if there is a lighting."""
        color, extinction = classified
        if self.classification.light is None:
            return color
        place, (direction, pixel) = self.place(depth), (self.ray.direction, self.ray.pixel)
        point = self.space.world(place)
        red, green, blue = color
        shown = (red, green, blue), extinction, transmittance
        sample = Sample(point, direction, measured, *shown, pixel, place)
        return self.classification.light(sample)

    def shaded(self, depth: Scalar) -> tuple[Color, Scalar]:
        """Colour, shaded if there is a lighting, and extinction at this depth, without occlusion."""
        measured = self.classification.at(self.coordinate(depth))
        classified = self.classification.classify(measured)
        return self.color(depth, measured, classified, jnp.ones_like(depth)), classified[1]


class Selection(Compositing[State]):
    """A mode that selects one depth on a ray by comparing samples. `pixel` then computes the pixel at this
    depth, once for each ray, after the march.

    Gradients are those of `pixel`, also for parameters: the sample stays in the same cell, while the ray, the
    step, the faces that cut the cell, and the scene change. They miss the jumps of a pixel where another cell
    is selected. The gradient of voxels takes an array of their size for each fetch of `pixel` and chunk of
    2048 pixels: slow for large volumes.
    """

    @abstractmethod
    def depth(self, state: State) -> Scalar:
        """The selected depth, past the entry; infinite if there is none."""

    @abstractmethod
    def pixel(self, sampler: RaySampler, state: State) -> tuple[Float[Array, " n"], Scalar]:
        """Premultiplied colour and opacity, and the reported depth (infinite if nothing is visible), of a ray
        with a selected depth. JAX differentiates it. To compute with a depth, use
        `sampler.differentiable_depth(depth)`."""

    def normal(self, sampler: RaySampler, depth: Scalar) -> Float[Array, "3"] | None:
        """The unit normal, in the world, at the depth that `pixel` reports; None by default. JAX
        differentiates it."""
        return None

    @property
    def has_normal(self) -> bool:
        """True if `normal` is overridden."""
        return type(self).normal is not Selection.normal

    @property
    def resolves(self) -> bool:
        return True

    @property
    def can_be_lit(self) -> bool:
        return True

    def end(self, state: State) -> tuple[Float[Array, " n"], Scalar]:
        depth = self.depth(state)
        none, chosen = jnp.zeros_like(depth), (~jnp.isinf(depth)).astype(depth.dtype)
        return jnp.stack([none, none, none, chosen]), depth

    def transmittance(self, state: State) -> Scalar:
        """Transmittance 1: selections have no occlusion."""
        return jnp.ones_like(self.depth(state))

    def occupied(self, transfer: Transfer, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        """Mask of all blocks, by default, since transparent samples may be selected."""
        return jnp.ones(blocks.shape, bool)


class FirstVisible(Selection[Scalar]):
    """The first sample of positive opacity, shown opaque."""

    def begin(self, zero: Scalar, outputs: Outputs | None) -> Scalar:
        return jnp.full_like(zero, jnp.inf)

    def add(self, state: Scalar, fragment: Fragment) -> Scalar:
        return jnp.where((state == jnp.inf) & ~(fragment.alpha <= 0), fragment.depth, state)

    def depth(self, state: Scalar) -> Scalar:
        return state

    def finished(self, state: Scalar) -> Bool[Array, ""]:
        return state < jnp.inf

    def occupied(self, transfer: Transfer, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        return transfer.visible(blocks)

    def pixel(self, sampler: RaySampler, state: Scalar) -> tuple[Float[Array, " n"], Scalar]:
        color, _ = sampler.shaded(state)
        return jnp.stack([*color, jnp.ones_like(state)]), state
