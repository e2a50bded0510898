"""Medium of light by transport: that of `path_trace`, with soft edges of materials."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._util.vec3 import Scalar, Vec3
from ..scene.occupancy import Blocks
from ..scene.transfer import Classify, Measured, Transfer
from ..scene.volume import Volume
from .materials import Material, shares
from .shading import Surroundings


FADE = 0.02
"""Materials fade beyond their ends over this fraction of the narrowest value range, so that their edges have
derivatives. At the ends themselves, which the largest voxels may have, they are whole, as for paths."""


class MediumTransfer(Transfer):
    """Extinction and albedo of the medium of `path_trace`, as a transfer function.

    In a material of mean free path λ and opacity α, the extinction is 1/λ wherever `transfer` shows anything,
    and the colour is the albedo, that of `transfer` clipped to [0, 1], times 1 - α; elsewhere, the extinction
    is that of `transfer`, and the colour its albedo. Cells cannot be integrated.
    """

    bands = 3
    transfer: Transfer
    materials: tuple[Material, ...]

    @property
    def title(self) -> str:
        return 'lighting by ScattererTemplates(..., form="transport")'

    @property
    def channels(self) -> int | None:
        return self.transfer.channels

    @property
    def valid(self) -> Bool[Array, ""] | bool:
        return self.transfer.valid

    @property
    def reads_gradient(self) -> bool:
        return self.transfer.reads_gradient

    @property
    def reads_labels(self) -> bool:
        """True if materials are distinguished by the volume's labels."""
        return any(material.label is not None for material in self.materials)

    @property
    def reads_more(self) -> bool:
        return self.reads_labels or self.transfer.reads_more

    def attributes(self, volume: Volume, coordinate: Vec3) -> Measured:
        label = (volume.label(coordinate),) if self.reads_labels else ()
        return (*self.transfer.attributes(volume, coordinate), *label)

    def majorant(self, blocks: Blocks) -> Float[Array, "bx by bz"]:
        bound = jax.lax.stop_gradient(self.transfer.majorant(blocks))
        for material in jax.lax.stop_gradient(self.materials):
            bound = jnp.where(bound > 0, jnp.maximum(bound, 1 / material.mean_free_path), bound)
        return bound

    def visible(self, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        return self.transfer.visible(blocks)

    def classifier(self) -> Classify:
        classify, search = self.transfer.classifier(), self.transfer.search()

        def medium(measured: Measured) -> tuple[Vec3, Scalar]:
            inner, label = (measured[:-1], measured[-1]) if self.reads_labels else (measured, None)
            (r, g, b), extinction = classify(inner if search is None else (*inner, *search(inner)))
            value = measured[0]

            def labelled(number: int) -> Scalar:
                return jnp.asarray(label == number, value.dtype)

            fractions = shares(self.materials, labelled, value, edge=FADE, at_bound=1)
            rate, remaining, kept = jnp.zeros_like(value), jnp.ones_like(value), jnp.ones_like(value)
            for fraction, material in zip(fractions, self.materials, strict=True):
                rate = rate + fraction / material.mean_free_path
                remaining = remaining - fraction
                kept = kept - fraction * material.opacity
            rate = rate + remaining * extinction
            albedo = clipped(r) * kept, clipped(g) * kept, clipped(b) * kept
            return albedo, jnp.where(extinction > 0, rate, 0)

        return medium


class Scattering(NamedTuple):
    """Scattering properties at a point.

    Attributes:
        extinction: 1/length; 0 where nothing is visible.
        albedo: single-scattering albedo, (r, g, b).
    """

    extinction: Scalar
    albedo: Vec3


def scattering_at(around: Surroundings, point: Vec3) -> Scattering:
    """Scattering properties at a world point, where `around` has a `MediumTransfer`."""
    measured = around.measured(point)
    albedo, _ = around.classification.classify(measured)
    return Scattering(around.classified(point, measured).extinction, albedo)


@jax.custom_jvp
def clipped(albedo: Scalar) -> Scalar:
    """Clip to [0, 1]; the derivative at 0 and 1 is that inside the range."""
    return jnp.clip(albedo, 0, 1)


@clipped.defjvp
def _(primals: tuple[Scalar], tangents: tuple[Scalar]) -> tuple[Scalar, Scalar]:
    ((albedo,), (tangent,)) = primals, tangents
    return clipped(albedo), jnp.where((albedo >= 0) & (albedo <= 1), tangent, 0)
