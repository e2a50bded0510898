"""Materials: their optical properties, and their shares at a point of a volume."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, SupportsIndex

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._util.checks import Arrayable, finite_array, integer, number, require, unit_interval
from .._util.vec3 import Scalar


EDGE = 0.1
"""Materials with soft edges fade in and out over this fraction of the narrowest value range."""


class Optics(NamedTuple):
    """Optical properties of a material; arrays for several materials."""

    opacity: Float[Array, "..."]
    mean_free_path: Float[Array, "..."]
    refractive_index: Float[Array, "..."]

    @property
    def reflectance(self) -> Float[Array, "..."]:
        """Reflectance R of a half-space of the white material under light from all sides, within 0.0014 of
        the integral over Chandrasekhar's H function: `R = r (1 - γ / (3 (1 + γ)))`, `r = (1 - γ) / (1 + γ)`,
        `γ = √opacity`. Source: Hapke, Theory of Reflectance and Emittance Spectroscopy, 1993.
        """
        # bounded away from 0, where the derivative of the square root is infinite
        gamma = jnp.sqrt(jnp.maximum(self.opacity, jnp.finfo(self.opacity.dtype).tiny ** 0.5))
        return (1 - gamma) / (1 + gamma) * (1 - gamma / (3 * (1 + gamma)))


class Material(eqx.Module):
    """A material that scatters light, such as skin, muscle or bone.

    All but `values` and `label` are differentiable. For instance, in mm and chosen for appearance: skin
    `Material(0.5, 0.7, 1.39)`, muscle `Material(0.6, 1.4, 1.37)`, bone `Material(0.8, 0.6, 1.55)`.

    Args:
        opacity: α, the fraction of light absorbed at each scattering, in [0, 1]: 1 minus the transparency of
            Lee, Kwon and Shin (2016), and, for a white colour, 1 minus the single-scattering albedo of path
            tracing. Scatterer templates need an opacity above 0, see their `threshold`. The paper's
            transparency is T(d), of the transfer function at the material's value d. To tie α to it, also
            in its gradient: `-jnp.expm1(-transfer(d)[1] * mean_free_path)`, with the `levels` of templates.
        mean_free_path: λ, the mean distance between scatterings, world length, > 0; see
            `lighting.mean_free_path`.
        refractive_index: positive; 1 in air.
        values: (low, high), low < high, range of the volume's values in this material.
        label: the volume's label for this material. Without `values` or `label`, it is everywhere.

    Raises:
        ValueError: for numbers out of these ranges, and if both `values` and `label` are given.
    """

    opacity: Float[Array, ""]
    mean_free_path: Float[Array, ""]
    refractive_index: Float[Array, ""]
    values: Float[Array, "2"] | None
    label: int | None = eqx.field(static=True)

    def __init__(
        self,
        opacity: Arrayable,
        mean_free_path: Arrayable,
        refractive_index: Arrayable = 1.0,
        *,
        values: Arrayable | None = None,
        label: SupportsIndex | None = None,
    ):
        self.opacity = unit_interval("opacity", opacity, ())
        self.mean_free_path = number("mean_free_path", mean_free_path, above=0)
        self.refractive_index = number("refractive_index", refractive_index, above=0)
        if values is not None and label is not None:
            raise ValueError(f"values and label must not both be given; got {values!r} and {label!r}.")
        if values is not None:
            message = "values must be (low, high) with low < high; got {got}."
            values = require(finite_array("values", values, (2,)), lambda v: v[1:] > v[:1], message)
        self.values, self.label = values, None if label is None else integer("label", label, 0)

    @property
    def optics(self) -> Optics:
        return Optics(self.opacity, self.mean_free_path, self.refractive_index)


def mean_free_path(density: Arrayable, cross_section: Arrayable) -> Float[Array, ""]:
    """Mean free path λ = 1 / (√2 n σ), world length (Lee, Kwon and Shin 2016, after Maxwell and Boltzmann).

    Args:
        density: n, scatterers per volume, 1/length³, > 0.
        cross_section: σ, effective area of a scatterer, length², > 0.

    Returns:
        The mean distance between scatterings, for `Material`.

    Raises:
        ValueError: for numbers that are not above 0 or not finite.
    """
    n, area = number("density", density, above=0), number("cross_section", cross_section, above=0)
    return 1 / (math.sqrt(2) * n * area)


def materials_of(materials: Material | Sequence[Material]) -> tuple[Material, ...]:
    """Convert to a tuple of materials; `ValueError` for anything else."""
    materials = (materials,) if isinstance(materials, Material) else tuple(materials)
    if not materials:
        raise ValueError("materials must hold at least one Material; got none.")
    for material in materials:
        if not isinstance(material, Material):
            raise ValueError(f"materials must hold jaxvol materials; got {material!r}.")
    return materials


def optics_of(materials: Sequence[Material]) -> Optics:
    """Stack the optics of materials."""
    return jax.tree.map(lambda *numbers: jnp.stack(numbers), *(material.optics for material in materials))


def shares(
    materials: tuple[Material, ...],
    labelled: Callable[[int], Scalar],
    value: Scalar,
    *,
    edge: float = 0.0,
    at_bound: float = 0.5,
) -> tuple[Scalar, ...]:
    """Shares of materials at a place with this value: 1 for the first present; sum at most 1. `labelled`:
    the share of a label there. `edge`: fraction of the narrowest range over which materials fade; above 0,
    shares by values are continuous. `at_bound`: share at the ends of a material's range then, ½ or 1."""
    remaining, fractions = jnp.ones_like(value), []
    ranges = [m.values[1] - m.values[0] for m in materials if m.values is not None]
    width = edge * jax.lax.stop_gradient(jnp.min(jnp.stack(ranges))) if ranges else jnp.zeros_like(value)
    for material in materials:
        if material.label is not None:
            share = labelled(material.label)
        elif material.values is None:
            share = jnp.ones_like(value)
        else:
            low, high = jax.lax.stop_gradient(material.values)
            if edge == 0:
                share = step(value - low) * step(high - value)
            else:
                share = smoothstep((value - low) / width + at_bound) * smoothstep(
                    (high - value) / width + at_bound
                )
        # so that two materials of adjacent ranges have half each where they meet
        fractions.append(jnp.where(share > remaining, remaining, share))  # NaN stays NaN
        remaining = remaining - fractions[-1]
    return tuple(fractions)


def step(x: Scalar, at_0: float = 1.0) -> Scalar:
    """Step function: 0 below 0, `at_0` at 0, 1 above. NaN stays NaN (a comparison would make it 0)."""
    return jnp.where(x == 0, at_0, (jnp.sign(x) + 1) / 2)


def smoothstep(x: Scalar) -> Scalar:
    """Smooth ramp from 0 at 0 to 1 at 1."""
    x = jnp.clip(x, 0, 1)
    return x * x * (3 - 2 * x)
