"""What does a material do to light inside it, and where in a volume is it?"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._util.checks import Arrayable, finite_array, integer, number, require, unit_interval
from .._util.vec3 import Scalar, Vec3
from ..volume import Volume


class Optics(NamedTuple):
    """What a material does to light, wherever it is; of several materials, arrays."""

    opacity: Float[Array, "..."]
    mean_free_path: Float[Array, "..."]
    refractive_index: Float[Array, "..."]

    @property
    def optics(self) -> "Optics":
        """Itself, so that it may stand where a `Material` does."""
        return self

    @property
    def reflectance(self) -> Float[Array, "..."]:
        """R, the share of light from all sides that a half-space of the material sends back, were it white:
        of the single-scattering albedo ω = 1 - opacity, alike in all directions.

        `R = r (1 - γ / (3 (1 + γ)))`, `r = (1 - γ) / (1 + γ)`, `γ = √(1 - ω)`; off by at most 0.0014 from the
        integral over Chandrasekhar's function H. Source: Hapke, Theory of Reflectance and Emittance
        Spectroscopy, 1993.
        """
        # never 0, where its derivative is infinite
        gamma = jnp.sqrt(jnp.maximum(self.opacity, jnp.finfo(self.opacity.dtype).tiny ** 0.5))
        return (1 - gamma) / (1 + gamma) * (1 - gamma / (3 * (1 + gamma)))


class Material(eqx.Module):
    """Something that scatters light: skin, muscle, bone.

    **Arguments:**

    - `opacity`: α, the share of light that is absorbed where it is scattered, in [0, 1]: 1 minus the
      transparency of Lee, Kwon and Shin (2016), and, in white matter, 1 minus the single-scattering albedo of
      path tracing. Templates ask for one above 0, see their `threshold`.
    - `mean_free_path`: λ, the mean distance from one scattering to the next, world length, > 0.
      `from_scatterers` computes it.
    - `refractive_index`: > 0; 1 in air.
    - `values`: (low, high), the values of the volume that are of this material, low < high; or
    - `label`: the label of the volume that is. One of the two says where the material is;
      neither: everywhere.

    All but `values` and `label` are differentiable.

    **Raises:** `ValueError` for numbers out of these ranges, and for both `values` and `label`.
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
        label: int | None = None,
    ):
        self.opacity = unit_interval("opacity", opacity, ())
        self.mean_free_path = number("mean_free_path", mean_free_path, above=0)
        self.refractive_index = number("refractive_index", refractive_index, above=0)
        if values is not None and label is not None:
            raise ValueError(f"values and label must not both be given; got {values!r} and {label!r}.")
        self.values = None
        if values is not None:
            self.values = require(
                finite_array("values", values, (2,)),
                lambda v: v[1:] > v[:1],
                "values must be (low, high) with low < high; got {got}.",
            )
        self.label = None if label is None else integer("label", label, 0)

    @property
    def optics(self) -> Optics:
        """Opacity, mean free path and refractive index."""
        return Optics(self.opacity, self.mean_free_path, self.refractive_index)

    @classmethod
    def from_scatterers(
        cls,
        opacity: Arrayable,
        density: Arrayable,
        cross_section: Arrayable,
        *rest: Arrayable,
        **where: Arrayable,
    ) -> "Material":
        """A material of so many scatterers.

        **Arguments:**

        - `density`: n, scatterers per volume, > 0. `cross_section`: σ, the effective area of each, > 0.
          The mean free path is `1 / (√2 n σ)`, as between the particles of a Maxwell–Boltzmann gas.
        - All else as for the class.
        """
        density, cross_section = (
            number("density", density, above=0),
            number("cross_section", cross_section, above=0),
        )
        return cls(opacity, 1 / (jnp.sqrt(2.0) * density * cross_section), *rest, **where)


PRESETS = {"skin": (0.5, 0.7, 1.39), "muscle": (0.6, 1.4, 1.37), "bone": (0.8, 0.6, 1.55)}
"""Opacity, mean free path in mm, refractive index. The paths are those between two scatterings after which
light has lost its direction (1 / μs′ of soft tissue and bone in red light); the opacities are chosen for
pictures: tissue absorbs far less of each scattering than templates of a few dozen photons can follow."""


def material(name: str, *, millimetre: float = 1.0, **where: Arrayable) -> Material:
    """A material of `PRESETS`: "skin", "muscle" or "bone".

    **Arguments:**

    - `millimetre`: its length in world units, where these are not mm.
    - `values` or `label`: as for `Material`.

    **Raises:** `ValueError` for another name, and as `Material` does.
    """
    if name not in PRESETS:
        raise ValueError(f"name must be one of {', '.join(PRESETS)}; got {name!r}.")
    opacity, path, index = PRESETS[name]
    return Material(opacity, path * number("millimetre", millimetre, above=0), index, **where)


def materials_of(materials: Material | Sequence[Any]) -> tuple[Material, ...]:
    """One or several materials as a tuple. **Raises** `ValueError` for none, and for what is no material."""
    several = (materials,) if isinstance(materials, Material) else tuple(materials)
    if not several:
        raise ValueError("materials must hold a Material at least; got none.")
    for each in several:
        if not isinstance(each, Material):
            raise ValueError(f"materials must hold jaxvol materials; got {each!r}.")
    return several


def shares(
    materials: tuple[Material, ...], volume: Volume, coordinate: Vec3, value: Scalar, *, edge: float = 0.0
) -> tuple[Scalar, ...]:
    """How much of a place each material has: 1 for the first that is there and 0 for all others; or, where
    they meet, shares that sum to at most 1.

    **Arguments:**

    - `value`: of the volume at the grid coordinate.
    - `edge`: 0 for a sharp choice. Above 0, the part of its range of values over which a material comes and
      goes, and the label is looked up trilinearly, so that shares are continuous, and differentiable.
    """
    left, each = jnp.ones_like(value), []
    for one in materials:
        if one.label is not None:
            sharp = volume.label(coordinate) == one.label if edge == 0 else None
            there = volume.label_share(coordinate, one.label) if sharp is None else sharp.astype(value.dtype)
        elif one.values is None:
            there = jnp.ones_like(value)
        else:
            low, high = jax.lax.stop_gradient(one.values)
            if edge == 0:
                there = step(value - low) * step(high - value)
            else:
                width = edge * (high - low)
                there = smoothstep((value - low) / width + 0.5) * smoothstep((high - value) / width + 0.5)
        each.append(left * there)
        left = left * (1 - there)
    return tuple(each)


def step(x: Scalar, at_0: float = 1.0) -> Scalar:
    """0 below 0, and 1 above. Of NaN NaN, which a comparison would make a 0."""
    return jnp.where(x == 0, at_0, (jnp.sign(x) + 1) / 2)


def smoothstep(x: Scalar) -> Scalar:
    """From 0 at 0 to 1 at 1, smoothly."""
    x = jnp.clip(x, 0, 1)
    return x * x * (3 - 2 * x)
