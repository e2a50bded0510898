"""Scatterer templates: how light spreads inside a material, as a few photons around a point.

Packets of light start from the origin. Each travels to its next scatterer, leaves a photon there, and goes on
as two packets, one refracted and one reflected. This binary tree is simulated level by level in arrays of
static shape, so that many templates of many materials are simulated at once.

Lee, Kwon and Shin: Scattered light representation in accordance with the material using scatterer template in
volume rendering (2016), section 3.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from .._util.checks import integer, number
from .._util.vec3 import Scalar, golden_spiral, turned
from ..xla.platform import is_traced
from .materials import Material, Optics, materials_of, optics_of, smoothstep


FADES = 0.8
"""A photon fades out between the threshold and this fraction of it."""

MERGE = 0.01
"""Photons closer than this fraction of the mean free path are merged into one."""


class ScattererTemplate(eqx.Module):
    """Photons around a sample, brightest first; or several such sets, along leading axes.

    - `offset`: from the sample, world length.
    - `intensity`: the fraction of the light that each photon holds; 0 for padding.
    """

    offset: Float[Array, "*templates n 3"]
    intensity: Float[Array, "*templates n"]

    def sorted(self) -> "ScattererTemplate":
        """The same photons, brightest first."""
        order = jnp.argsort(-jax.lax.stop_gradient(self.intensity), axis=-1, stable=True)
        return ScattererTemplate(
            jnp.take_along_axis(self.offset, order[..., None], axis=-2),
            jnp.take_along_axis(self.intensity, order, axis=-1),
        )

    def brightest(self, photons: int) -> "ScattererTemplate":
        """The `photons` brightest photons, scaled to hold the energy of all."""
        count = min(integer("photons", photons, 1), self.intensity.shape[-1])
        kept, energy = self.intensity[..., :count], jnp.sum(self.intensity, axis=-1, keepdims=True)
        kept_energy = jnp.sum(kept, axis=-1, keepdims=True)
        scale = energy / jnp.where(kept_energy > 0, kept_energy, 1)
        return ScattererTemplate(self.offset[..., :count, :], kept * scale)

    def normalized(self) -> "ScattererTemplate":
        """The same photons, scaled so that each template has energy 1. NaN for a template without energy."""
        return ScattererTemplate(self.offset, self.intensity / self.intensity.sum(axis=-1, keepdims=True))

    def blended(self) -> "ScattererTemplate":
        """Merge the templates along the last leading axis into one with all their photons and mean energy."""
        *rest, templates, n = self.intensity.shape
        offset = self.offset.reshape(*rest, templates * n, 3)
        intensity = self.intensity.reshape(*rest, templates * n) / templates
        return ScattererTemplate(offset, intensity).sorted()

    def clustered(self, distance: float) -> "ScattererTemplate":
        """One sorted template, in which the brightest photon within this distance gets the intensity of each
        fainter one, which stays with intensity 0."""
        offset = jax.lax.stop_gradient(self.offset)
        near = sum((offset[:, None, i] - offset[None, :, i]) ** 2 for i in range(3)) <= distance**2
        # Photons are sorted, so argmax finds the brightest. A host may have a host in turn; doubling follows
        # the chain to its end.
        host = jnp.argmax(near, axis=-1)
        for _ in range(math.ceil(math.log2(max(host.shape[0], 2)))):
            host = host[host]
        intensity = jnp.zeros_like(self.intensity).at[host].add(self.intensity)
        return ScattererTemplate(self.offset, intensity).sorted()


def scatterer_template(
    material: Material,
    key: PRNGKeyArray | int,
    *,
    packets: int = 4,
    threshold: float = 0.01,
    merge: float = MERGE,
    levels: int | None = None,
) -> ScattererTemplate:
    """Simulate how light spreads around a point inside a material.

    A packet of energy I travels Δx = -λ ln u in its direction, u uniform. Where it arrives, in a material of
    opacity α, αI is absorbed and becomes a photon; of the rest I' = (1 - α) I, `I' cos θ'` is refracted by an
    angle θ', into a direction uniformly distributed over the cone within the critical angle of total
    reflection between the material and air; and `I' (1 - cos θ')` is reflected into any direction of the
    half-space it came from. A packet whose photon would be fainter than the threshold ends.

    So all parts add up to I, and a template's energy falls short of 1 only by what the threshold cuts off.
    The paper's tables were made in this way; its equations (1) to (3) as printed hand on αI
    (`experiments/printed_templates.py`).

    **Arguments:**

    - `material`: its opacity, mean free path λ and refractive index.
    - `key`: a JAX key, or an integer seed. All draws depend on it alone, so offsets are λ times fixed ones.
    - `packets`: how many packets share the light, of energy 1, at the origin. Their directions are spread
      evenly and rotated at random. One packet makes a lopsided template.
    - `threshold`: in (0, 1), of a photon's intensity. A photon fades out between this and 0.8 times this,
      instead of vanishing at once. The first photons are the brightest, of α / `packets` each: with a
      threshold above 1.25 times that, a template is empty.
    - `merge`: photons closer than this fraction of λ are merged, as in the paper's tables.
    - `levels`: of the tree; required if the opacity is traced. By default as many as leave photons above the
      threshold.

    **Returns:** a `ScattererTemplate` with room for the photons of the tree, or for as many above the
    threshold as energy 1 could fill; differentiable in the material's mean free path, opacity and refractive
    index (at an index of 1, where the critical angle has no derivative, the derivative used is 0).

    Where it fails: `experiments/stability.py`, "lopsided templates", "energy of templates as printed".

    **Raises:** `ValueError` for numbers out of range, if `levels` are required but missing, and if all
    photons are below the threshold; if the opacity is traced, the intensities are NaN in the last case.
    """
    tree = PacketTree.checked(packets, threshold)
    levels = tree.levels_of((material,), levels)
    return tree.template(material.optics, _key(key), levels, merge)


def scatterer_templates(
    materials: Material | Sequence[Material],
    key: PRNGKeyArray | int,
    *,
    count: int = 8,
    packets: int = 4,
    threshold: float = 0.01,
    merge: float = MERGE,
    levels: int | None = None,
) -> ScattererTemplate:
    """Several templates for each of several materials, simulated at once.

    **Arguments:** `materials`: one or several. `count`: templates per material. The others, `key` among them,
    as for `scatterer_template`.

    **Returns:** a `ScattererTemplate` with leading axes (materials, count). The draws are keyed by the index
    of the material and that of the template.

    **Raises:** as `scatterer_template` does.
    """
    materials, count, key = materials_of(materials), integer("count", count, 1), _key(key)
    tree = PacketTree.checked(packets, threshold)
    levels = tree.levels_of(materials, levels)

    def one(optics: Optics, material: Int[Array, ""], template: Int[Array, ""]) -> ScattererTemplate:
        draws = jax.random.fold_in(jax.random.fold_in(key, material), template)
        return tree.template(optics, draws, levels, merge)

    several = jax.vmap(jax.vmap(one, in_axes=(None, None, 0)), in_axes=(0, 0, None))
    return several(optics_of(materials), jnp.arange(len(materials)), jnp.arange(count))


class _Packets(NamedTuple):
    """Packets of light: start, direction and energy of each."""

    position: Float[Array, "n 3"]
    direction: Float[Array, "n 3"]
    light: Float[Array, " n"]


@dataclass(frozen=True)
class PacketTree:
    """The tree of packets of a template. Fields are as for `scatterer_template`."""

    packets: int = 4
    threshold: float = 0.01

    @classmethod
    def checked(cls, packets: Any, threshold: Any) -> "PacketTree":
        """**Raises** `ValueError` for invalid arguments."""
        return cls(integer("packets", packets, 1), float(number("threshold", threshold, above=0, below=1)))

    @property
    def faintest(self) -> float:
        """Intensity below which there is no photon."""
        return FADES * self.threshold

    @property
    def max_width(self) -> float:
        """Most packets of one level that go on: as many as can be above the threshold, as their energies sum
        to 1."""
        return math.floor(1 / self.faintest + 1e-9)

    def size(self, levels: int) -> int:
        """Photons of all levels, each twice as wide as the one before, up to `max_width`."""
        return int(sum(min(self.packets * 2 ** min(k, 64), self.max_width) for k in range(levels)))

    def capacity(self, levels: int) -> int:
        """Number of photons that a template has room for."""
        return int(min(self.size(levels), self.max_width))

    def levels_of(self, materials: Sequence[Material], levels: int | None) -> int:
        """The given number of levels, by default the most of any material. **Raises** `ValueError` for an
        opacity that leaves no photon, and for one that is traced, if no number is given."""
        for material in materials:
            self._require_photons(material)
        return max(map(self.levels, materials)) if levels is None else integer("levels", levels, 1)

    def levels(self, material: Material) -> int:
        """Number of levels that may hold a photon above the threshold. The brightest possible photon of level
        k has `α (1 - α)^k / packets`."""
        if is_traced(material.opacity):
            raise ValueError(
                "levels must be given where opacity is traced: the number of photons depends on it."
            )
        alpha = float(np.asarray(material.opacity))
        if alpha == 1:
            return 1
        return 1 + math.floor(math.log(self.faintest * self.packets / alpha) / math.log(1 - alpha) + 1e-9)

    def most_photons(self, material: Material) -> int:
        """Upper bound of a template's photons above 0: in each level, no more than its energy allows."""
        alpha = float(np.asarray(material.opacity))
        by_energy = (
            int((1 - alpha) ** k * alpha / self.faintest + 1e-9) for k in range(self.levels(material))
        )
        return max(1, sum(min(self.packets * 2 ** min(k, 32), most) for k, most in enumerate(by_energy)))

    def _require_photons(self, material: Material) -> None:
        """**Raises** `ValueError` if the first photons are below the threshold; traced opacities are not
        checked."""
        if is_traced(material.opacity):
            return
        alpha = float(np.asarray(material.opacity))
        if alpha == 0:
            raise ValueError(
                "opacity must be above 0 for scatterer templates: without absorption there are no photons."
            )
        if alpha <= self.faintest * self.packets:
            raise ValueError(
                f"opacity {alpha:g} leaves no photon above threshold={self.threshold:g} with "
                f"packets={self.packets}: use a threshold of at most {alpha / self.packets:.3g}, or fewer."
            )

    def template(
        self, optics: Optics, key: PRNGKeyArray, levels: int, merge: float = MERGE
    ) -> ScattererTemplate:
        """The photons of a tree of so many levels, merged and sorted; NaN if a traced opacity leaves none."""
        origin, draws = jax.random.split(key)
        packets = _Packets(
            jnp.zeros((self.packets, 3)),
            _spread(origin, self.packets),
            jnp.full(self.packets, 1 / self.packets),
        )

        def next_(packets: _Packets, level: Any) -> tuple[_Packets, ScattererTemplate]:
            return self._level(optics, jax.random.fold_in(draws, level), packets)

        by_level, level = [], 0
        while level < levels and packets.light.shape[0] < self.max_width:
            packets, photons = next_(packets, level)
            by_level.append(photons)
            level += 1
        if level < levels:  # from here on, all levels have the same width
            _, photons = jax.lax.scan(next_, packets, jnp.arange(level, levels))
            by_level.append(jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), photons))
        photons = jax.tree.map(lambda *each: jnp.concatenate(each), *by_level).sorted()
        if merge > 0:
            photons = photons.clustered(merge)
        photons = jax.tree.map(lambda leaf: leaf[: self.capacity(levels)], photons)
        any_left = optics.opacity > self.faintest * self.packets
        return ScattererTemplate(
            photons.offset * optics.mean_free_path, jnp.where(any_left, photons.intensity, jnp.nan)
        )

    def _level(
        self, optics: Optics, key: PRNGKeyArray, packets: _Packets
    ) -> tuple[_Packets, ScattererTemplate]:
        """Advance packets by one level: the packets that go on, and the photons they leave (lengths in λ)."""
        position, direction, light = packets
        u = jax.random.uniform(key, (6, light.shape[0]))
        flight = -jnp.log1p(-u[0])
        position = position + flight[:, None] * direction
        light, passed = self.energies(optics.opacity, light, flight, u[1])
        sine_of_critical_angle = jnp.minimum(optics.refractive_index, 1 / optics.refractive_index)
        cosine = 1 - u[2] * (1 - _root(1 - sine_of_critical_angle**2))
        after = _Packets(
            jnp.concatenate([position] * 2),
            jnp.concatenate([_turned(direction, cosine, u[3]), _turned(-direction, u[4], u[5])]),
            jnp.concatenate([passed * cosine, passed * (1 - cosine)]),
        )
        if after.light.shape[0] > self.max_width:
            _, brightest = jax.lax.top_k(jax.lax.stop_gradient(after.light), int(self.max_width))
            after = jax.tree.map(lambda leaf: leaf[brightest], after)
        return after, ScattererTemplate(position, optics.opacity * light)

    def energies(
        self, opacity: Scalar, light: Scalar, flight: Scalar, uniform: Scalar
    ) -> tuple[Scalar, Scalar]:
        """The energy of packets at the end of their flights (lengths in λ), and what of it they hand on."""
        light = self.faded(opacity, light)
        return light, (1 - opacity) * light

    def faded(self, opacity: Scalar, light: Scalar) -> Scalar:
        """The energy of packets, less of those whose photons fade out."""
        return light * smoothstep((opacity * light / self.threshold - FADES) / (1 - FADES))


def _key(key: PRNGKeyArray | int) -> PRNGKeyArray:
    return jax.random.key(key) if isinstance(key, int | np.integer) else key


def _root(squared: Scalar) -> Scalar:
    """Square root; 0 with derivative 0 for arguments up to 0. NaN stays NaN."""
    clamped = squared <= 0
    return jnp.where(clamped, 0, jnp.sqrt(jnp.where(clamped, 1, squared)))


def _spread(key: PRNGKeyArray, n: int) -> Float[Array, "n 3"]:
    """Directions spread evenly over the sphere and rotated at random: each alone is uniformly distributed."""
    q, r = jnp.linalg.qr(jax.random.normal(key, (3, 3)))
    return jnp.asarray(golden_spiral(n), q.dtype) @ (q * jnp.sign(jnp.diagonal(r))[None]).T


def _turned(direction: Float[Array, "n 3"], cosine: Scalar, u: Scalar) -> Float[Array, "n 3"]:
    """Directions at an angle to `direction` given by its cosine; `u` in [0, 1) selects the azimuth."""
    x, y, z = direction.T
    sine = _root(1 - cosine**2)
    around = 2 * jnp.pi * u
    return jnp.stack(turned((sine * jnp.cos(around), sine * jnp.sin(around), cosine), (x, y, z)), axis=-1)
