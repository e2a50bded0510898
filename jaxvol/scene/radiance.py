"""Transfer function of volumes that store colour and density: radiance fields, RGBA images."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._util.checks import Arrayable, described, not_negative
from .._util.piecewise_linear import ROUNDING, not_negative as clipped
from .._util.vec3 import Scalar, Vec3
from ..xla.differentiation import check_captured
from .occupancy import Blocks
from .transfer import Classify, Measured, Transfer


Activation = Callable[[Scalar], Scalar]

OPAQUE = 1e30
"""Activated density that counts as opaque."""


class RadianceField(Transfer):
    """Colour and extinction from a volume of four channels: `data[x, y, z]` is (red, green, blue, density).

    Channels are interpolated, then activated: the colour is `color` of the first three, the extinction
    `scale` × `density` of the last. Rays leap over blocks of voxels whose greatest density activates to 0.

    Args:
        scale: extinction (1/length) where the activated density is 1, at least 0. Differentiable.
        density: activation of the stored density, a non-decreasing function of one number such as
            `jax.nn.softplus`; by default the identity. Results are clipped to [0, 1e30] (`jnp.exp` may
            overflow), without a gradient outside.
        color: activation of a stored channel to linear colour, such as `jax.nn.sigmoid`; by default the
            identity, also for integers: divide 8-bit colours by 255, and choose `scale` for stored densities.

    Reuse function objects: each new `lambda` is compiled anew. Parameters that need gradients are arrays of a
    module (`eqx.Module`, `jax.tree_util.Partial`), not captured by a `lambda`.

    Gradients reach all channels (`Volume.data`), in every adjoint, except where rays leap (`SpaceLeaping`).
    `quadrature="preintegrated"`, modes that compare values, and lightings are refused, as they need one
    value; `ScattererTemplates` are supported if their materials have labels and no `values`.

    Source: Mildenhall et al. 2020; activation after interpolation: Sun et al. 2022 (DVGO).

    Raises:
        ValueError: for a scale that is negative or not finite, and an activation that is no function; and
            when rendering a volume of another number of channels.
    """

    bands = 3
    scale: Float[Array, ""]
    density: Activation
    color: Activation

    def __init__(
        self,
        scale: Arrayable = 1.0,
        density: Activation | None = None,
        color: Activation | None = None,
    ):
        self.scale = not_negative("scale", scale)
        for name, function in (("density", density), ("color", color)):
            if function is not None and not callable(function):
                raise ValueError(f"{name} must be a function of a channel; got {described(function)}.")
            check_captured(name, function)
        self.density, self.color = map(_activation, (density, color))

    @property
    def channels(self) -> int:
        return 4

    def classifier(self) -> Classify:
        def classify(measured: Measured) -> tuple[Vec3, Scalar]:
            r, g, b, density = measured
            return (self.color(r), self.color(g), self.color(b)), self.scale * clipped(
                self._activated(density)
            )

        return classify

    def _activated(self, density: Scalar) -> Scalar:
        """`density`, saturated at `OPAQUE`: the slope of an infinite one would be infinity times 0."""
        if isinstance(self.density, _Fixed) and self.density.function is _as_stored:
            return density
        opaque = jnp.asarray(OPAQUE, density.dtype)
        saturated = self.density(jax.lax.stop_gradient(density)) >= opaque  # NaN stays
        return jnp.where(
            saturated, opaque, self.density(jnp.where(saturated, jnp.zeros_like(density), density))
        )

    def majorant(self, blocks: Blocks) -> Float[Array, "bx by bz"]:
        bound = jax.lax.stop_gradient(self.scale * clipped(self._greatest(blocks)))
        return (bound * (1 + ROUNDING)).astype(blocks.high.dtype)

    def visible(self, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        return self._greatest(blocks) > 0

    def _greatest(self, blocks: Blocks) -> Float[Array, "bx by bz"]:
        """Activated greatest density of each block, in the type of `scale`, which may be wider."""
        return self.density(blocks.high[3].astype(self.scale.dtype))


class _Fixed(eqx.Module):
    """A function without parameters."""

    function: Activation = eqx.field(static=True)

    def __call__(self, channel: Scalar) -> Scalar:
        return self.function(channel)


def _activation(function: Activation | None) -> Activation:
    """The function as a pytree of its parameters."""
    function = _as_stored if function is None else function
    function = function if any(map(eqx.is_array, jax.tree.leaves(function))) else _Fixed(function)
    like = jax.ShapeDtypeStruct((), jnp.result_type(float))
    if getattr(answer := eqx.filter_eval_shape(function, like), "shape", None) != ():
        raise ValueError(f"density and color must return a number for a number; got {answer}.")
    return function


def _as_stored(channel: Scalar) -> Scalar:
    return channel
