"""Scatterer templates by equations (1) to (3) of Lee, Kwon and Shin (2016) as printed.

The energy I of a packet that arrives after a flight of length Δx is multiplied by exp(-Δx / λ) cos θ, where
the cosine of the angle of incidence θ is drawn uniformly; then αI is handed on where (1 - α) I is left. So a
template does not hold the energy that it was given: without the factors of flight it holds α / (1 - α), more
than 1 for α > ½. The paper's tables were not made in this way (`jaxvol.scatterer_template`).
"""

import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol.lighting.template import PacketTree


class LevelTree(PacketTree):
    """With the paper's threshold: levels whose brightest possible photon is below it are left out, others are
    kept whole. One packet at an opacity of 50 % then leaves the paper's 56 to 63 photons."""

    @property
    def faintest(self) -> float:
        return self.threshold

    @property
    def max_width(self) -> float:
        return math.inf

    def faded(self, opacity: Any, light: Any) -> Any:
        return light


@dataclass(frozen=True)
class PrintedTree(PacketTree):
    """`flights`: whether each flight weakens a packet, by equation (1)."""

    flights: bool = True

    def energies(self, opacity: Any, light: Any, flight: Any, uniform: Any) -> tuple[Any, Any]:
        if self.flights:
            light = light * jnp.exp(-flight) * uniform
        light = self.faded(opacity, light)
        return light, opacity * light

    def capacity(self, levels: int) -> int:
        return self.size(levels)

    def levels(self, material: jv.Material) -> int:
        alpha = float(np.asarray(material.opacity))
        return 1 + math.floor(math.log(self.faintest * self.packets / alpha) / math.log(alpha) + 1e-9)


def printed_templates(
    material: jv.Material, seed: int, *, count: int, flights: bool = True, merge: float = 0.01
) -> jv.lighting.ScattererTemplate:
    """Several templates of a material, (1, count, photons), as by `scatterer_templates`."""
    tree, key = PrintedTree(flights=flights), jax.random.fold_in(jax.random.key(seed), 0)
    levels = tree.levels(material)
    keys = jax.vmap(lambda number: jax.random.fold_in(key, number))(jnp.arange(count))
    each = jax.vmap(lambda key: tree.template(material.optics, key, levels, merge))(keys)
    return jax.tree.map(lambda leaf: leaf[None], each)
