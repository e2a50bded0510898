"""Scatterer templates as Lee, Kwon and Shin (2016) print them, where the library differs.

`PrintedTree`: equations (1) to (3). The energy I of a packet that arrives after a flight of length Δx is
multiplied by exp(-Δx / λ) cos θ, where the cosine of the angle of incidence θ is drawn uniformly; then αI is
handed on where (1 - α) I is left. So a template does not hold the energy that it was given: without the
factors of flight it holds α / (1 - α), more than 1 for α > ½. The paper's tables were not made in this way
(`jaxvol.scatterer_template`).

`PrintedSteps`: steps 4 and 5 of shading. A photon adds its colour under the light's full irradiance, however
little light reaches the sample; and in another material its intensity, not just its colour, is scaled by the
ratio of opacities.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import jax
import jax.numpy as jnp

import jaxvol as jv
from jaxvol._util.vec3 import Scalar
from jaxvol.lighting import ScattererTemplates
from jaxvol.lighting.packet_tree import PacketTree
from jaxvol.lighting.photons import PhotonShading
from jaxvol.lighting.shading import Shading, Surroundings


@dataclass
class PrintedTree(PacketTree):
    """`flights`: whether each flight weakens a packet, by equation (1)."""

    flights: bool = True

    def energies(self, opacity: Any, light: Any, flight: Any, uniform: Any) -> tuple[Any, Any]:
        if self.flights:
            light = light * jnp.exp(-flight) * uniform
        light = self.faded(opacity, light)
        return light, opacity * light

    def capacity(self, levels: int, opacity: float | None = None) -> int:
        return int(sum(min(self.packets * 2 ** min(k, 64), self.max_width) for k in range(levels)))

    def levels(self, opacity: float) -> int:
        return 1 + math.floor(math.log(self.faintest * self.packets / opacity) / math.log(opacity) + 1e-9)


def printed_templates(
    material: jv.Material, seed: int, *, count: int, flights: bool = True, merge: float = 0.01
) -> jv.lighting.ScattererTemplate:
    """Several templates of a material, (1, count, photons), as by `scatterer_templates`."""
    tree, key = PrintedTree(flights=flights), jax.random.fold_in(jax.random.key(seed), 0)
    levels = tree.levels(float(material.opacity))
    keys = jax.vmap(lambda number: jax.random.fold_in(key, number))(jnp.arange(count))
    each = jax.vmap(lambda key: tree.template(material.optics, key, levels, merge))(keys)
    return jax.tree.map(lambda leaf: leaf[None], each)


class PrintedShading(PhotonShading):
    def lit(
        self, color: Scalar, inner: Scalar, brightness: Sequence[Scalar], irradiance: Sequence[Scalar]
    ) -> Scalar:
        lit = color * sum(b * light for b, light in zip(brightness, irradiance, strict=True))
        return lit + inner * sum(irradiance)

    def counted(self, visible: Scalar, shows: Scalar, ratio: Scalar) -> tuple[Scalar, Scalar]:
        return visible * ratio, shows * ratio


class PrintedSteps(ScattererTemplates):
    """`ScattererTemplates` under interpolated occlusion, with steps 4 and 5 as printed."""

    def for_image(self, around: Surroundings) -> Shading:
        ours = super().for_image(around)
        assert isinstance(ours, PhotonShading)
        return PrintedShading(*(getattr(ours, field.name) for field in fields(ours)))
