"""A scatterer template: the spread of light inside a material, as a few photons around a point."""

import math
from typing import SupportsIndex

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._util.checks import integer


class ScattererTemplate(eqx.Module):
    """Photons around a sample, brightest first; or several such sets, along leading axes.

    Attributes:
        offset: offset of each photon from the sample, world length.
        intensity: fraction of the light in each photon; 0 for padding.
    """

    offset: Float[Array, "*templates n 3"]
    intensity: Float[Array, "*templates n"]

    def sorted(self) -> "ScattererTemplate":
        """Sort the photons, brightest first."""
        order = jnp.argsort(-jax.lax.stop_gradient(self.intensity), axis=-1, stable=True)
        return ScattererTemplate(
            jnp.take_along_axis(self.offset, order[..., None], axis=-2),
            jnp.take_along_axis(self.intensity, order, axis=-1),
        )

    def brightest(self, photons: SupportsIndex) -> "ScattererTemplate":
        """Keep the `photons` brightest photons, scaled to hold the energy of all."""
        count = min(integer("photons", photons, 1), self.intensity.shape[-1])
        kept, energy = self.intensity[..., :count], jnp.sum(self.intensity, axis=-1, keepdims=True)
        kept_energy = jnp.sum(kept, axis=-1, keepdims=True)
        scale = energy / jnp.where(kept_energy > 0, kept_energy, 1)
        return ScattererTemplate(self.offset[..., :count, :], kept * scale)

    def normalized(self) -> "ScattererTemplate":
        """Scale the photons so that each template has energy 1. NaN for a template without energy."""
        return ScattererTemplate(self.offset, self.intensity / self.intensity.sum(axis=-1, keepdims=True))

    def blended(self) -> "ScattererTemplate":
        """Merge the templates along the last leading axis into one with all their photons and mean energy."""
        *axes, templates, n = self.intensity.shape
        offset = self.offset.reshape(*axes, templates * n, 3)
        intensity = self.intensity.reshape(*axes, templates * n) / templates
        return ScattererTemplate(offset, intensity).sorted()

    def clustered(self, distance: float) -> "ScattererTemplate":
        """Merge photons into the brightest one within the distance, and sort them."""
        offset = jax.lax.stop_gradient(self.offset)
        near = sum((offset[:, None, i] - offset[None, :, i]) ** 2 for i in range(3)) <= distance**2
        # Photons are sorted, so argmax finds the brightest. A host may have a host in turn; doubling follows
        # the chain to its end.
        host = jnp.argmax(near, axis=-1)
        for _ in range(math.ceil(math.log2(max(host.shape[0], 2)))):
            host = host[host]
        intensity = jnp.zeros_like(self.intensity).at[host].add(self.intensity)
        return ScattererTemplate(self.offset, intensity).sorted()
