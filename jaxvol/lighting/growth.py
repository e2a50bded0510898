"""Grows scatterer templates: simulates how light spreads around a point inside a material.

Packets of light start from the origin. Each travels to its next scatterer, leaves a photon there, and goes on
as two packets, one refracted and one reflected. This binary tree grows level by level in arrays of static
shape, so that many templates of many materials grow at once.

Lee, Kwon and Shin: Scattered light representation in accordance with the material using scatterer template in
volume rendering (2016), section 3.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from .._util.checks import integer, number
from .._util.memory import require_room
from .._util.vec3 import Scalar, golden_spiral, turned
from .materials import Material, Optics, materials_of, smoothstep
from .merging import merged
from .template import ScattererTemplate
from .threshold import FADES, Energy, Threshold, ThresholdOn


BYTES_PER_PHOTON, BYTES_PER_PAIR = 256, 16
"""Memory per photon while a template grows, including its draws, sorting and gathering; and per pair of
photons, for the distances by which they are merged."""

MERGE = 0.01
"""Photons closer than this fraction of the mean free path are merged into one."""


def scatterer_template(
    material: Material | Optics,
    key: PRNGKeyArray | int,
    *,
    packets: int = 4,
    threshold: float = 0.01,
    threshold_on: ThresholdOn | Any = "photon",
    energy: Energy | Any = "conserving",
    flights: bool = True,
    critical_angle: float | Any | None = None,
    merge: float = MERGE,
    levels: int | None = None,
) -> ScattererTemplate:
    """Simulate how light spreads around a point inside a material.

    A packet of energy I travels Δx = -λ ln u in its direction, u uniform. Where it arrives, in a material of
    opacity α, αI is absorbed and becomes a photon; `I' cos θ'` is refracted by an angle θ', into a direction
    uniformly distributed over the cone within the critical angle; and `I' (1 - cos θ')` is reflected into any
    direction of the half-space it came from. A packet whose photon would be fainter than the threshold ends.

    **Arguments:**

    - `material`: its opacity, mean free path λ and refractive index.
    - `key`: a JAX key, or an integer seed. All draws depend on it alone, so offsets are λ times fixed ones.
    - `packets`: how many packets share the light, of energy 1, at the origin. Their directions are spread
      evenly and rotated at random. One packet makes a lopsided template.
    - `threshold`: in (0, 1), of intensity. `threshold_on`: of which photons' intensity.
      `"photon"`: of each one's own. A photon fades out between this and 0.8 times this, instead of vanishing
      at once. `"level"`: of the brightest possible photon of a level: levels in which that is below the
      threshold are left out, others are kept whole, with photons fainter than the threshold. It gives the
      paper's counts: at an opacity of ½ and a threshold of 0.01, one packet leaves 63 photons, a full tree of
      six levels, before any are merged; the paper counts 56 to 63, and lists fainter ones.
      The first photons are the brightest, of α / `packets` each: with a threshold above that (on photons,
      above 1.25 times that), a template is empty.
    - `energy`: `"conserving"`: I' = (1 - α) I, so that all parts add up to I, and the template's energy falls
      short of 1 only by what the threshold cuts off. The paper's tables were made with this form: it gives
      their photons of the first and second level (that of the second is α (1 - α) cos θ' / `packets`).
      `"printed"`: the paper's equations (1) to (3) as printed, although misprinted: I' = α I, after I is
      multiplied by exp(-Δx / λ) cos θ, where θ is the angle of incidence and its cosine is drawn uniformly.
      The energy is not 1; without these factors (`flights=False`) it is α / (1 - α), above 1 for α > ½.
    - `flights`: with printed energy, whether each flight weakens a packet by the factor of equation (1).
    - `critical_angle`: degrees, in (0, 90]. By default that of total reflection between the material and
      air: arcsin of 1/n, or of n if n is below 1.
    - `merge`: photons closer than this fraction of λ are merged, and their intensities added. The photons in
      the paper's tables that are brighter than a packet could leave are merged ones.
    - `levels`: of the tree. By default as many as leave photons above the threshold, which requires an
      opacity known at compile time; required if the opacity is traced.

    **Returns:** a `ScattererTemplate` of `template_capacity` photons, differentiable in the material's mean
    free path, opacity and refractive index (at an index of 1, where the critical angle has no derivative,
    the derivative used is 0).

    Where it fails, and where not: `experiments/stability.py`, "energy of templates as printed",
    "lopsided templates".

    **Raises:** `ValueError` for numbers out of range, if `levels` are required but missing, for a tree that
    does not fit into memory, and if all photons are below the threshold. If the opacity is traced, the
    intensities are NaN in the last case.
    """
    ends = Threshold.checked(packets, threshold, threshold_on, energy)
    ends.require_photons(material)
    if not flights and energy != "printed":
        raise ValueError(
            'flights=False requires energy="printed"; a conserving template has no flight factors.'
        )
    levels = ends.levels(material) if levels is None else integer("levels", levels, 1)
    grow = _Growth(ends, levels, flights, float(merge))
    grow.require_room(1)
    return grow(material.optics, _cosine_of_critical_angle(material.optics, critical_angle), _key(key))


def scatterer_templates(
    materials: Material | Sequence[Material],
    key: PRNGKeyArray | int,
    *,
    count: int = 8,
    packets: int = 4,
    threshold: float = 0.01,
    threshold_on: ThresholdOn | Any = "photon",
    energy: Energy | Any = "conserving",
    merge: float = MERGE,
    levels: int | None = None,
    **how: Any,
) -> ScattererTemplate:
    """Several templates for each of several materials, grown at once.

    **Arguments:** `materials`: one or several. `count`: templates per material. The others, `how` among them,
    are as for `scatterer_template`.

    **Returns:** a `ScattererTemplate` with leading axes (materials, count). The draws are keyed by the index
    of the material and that of the template.

    **Raises:** as `scatterer_template` does; the memory checked is that of all templates.
    """
    materials, count, key = materials_of(materials), integer("count", count, 1), _key(key)
    ends = Threshold.checked(packets, threshold, threshold_on, energy)
    ends.require_photons(materials)
    levels = max(map(ends.levels, materials)) if levels is None else integer("levels", levels, 1)
    _Growth(ends, levels, True, float(merge)).require_room(count * len(materials))
    optics = jax.tree.map(lambda *each: jnp.stack(each), *(each.optics for each in materials))
    same: Any = {"packets": packets, "threshold": threshold, "threshold_on": threshold_on, "energy": energy}

    def one(optics: Optics, material: Int[Array, ""], template: Int[Array, ""]) -> ScattererTemplate:
        draws = jax.random.fold_in(jax.random.fold_in(key, material), template)
        return scatterer_template(optics, draws, merge=merge, levels=levels, **same, **how)

    several = jax.vmap(jax.vmap(one, in_axes=(None, None, 0)), in_axes=(0, 0, None))
    return several(optics, jnp.arange(len(materials)), jnp.arange(count))


class _Growth(NamedTuple):
    """Grows a template; holds the static settings."""

    ends: Threshold
    levels: int
    flights: bool
    merge: float

    def require_room(self, templates: int) -> None:
        """**Raises** `ValueError` if this many templates would not fit into memory."""
        tree, ends = self.ends.tree_size(self.levels), self.ends
        each = tree * (BYTES_PER_PHOTON + (BYTES_PER_PAIR * tree if self.merge > 0 else 0))
        require_room(
            templates * each,
            f"{templates} templates, grown from {tree} photons each (packets={ends.packets}, "
            f"threshold={ends.value:g}, levels={self.levels}); use fewer templates or levels, or a "
            "higher threshold",
        )

    def __call__(self, optics: Optics, cone: Scalar, key: PRNGKeyArray) -> ScattererTemplate:
        origin, draws = jax.random.split(key)
        number, capacity = self.ends.packets, self.ends.capacity(self.levels)
        packets = _Packets(jnp.zeros((number, 3)), _spread(origin, number), jnp.full(number, 1 / number))
        by_level, level = [], 0
        while level < self.levels and packets.light.shape[0] < self.ends.max_width:
            packets, photons = self._level(optics, cone, jax.random.fold_in(draws, level), packets)
            by_level.append(photons)
            level += 1
        if level < self.levels:  # from here on, all levels have the same width

            def one(packets: _Packets, level: Int[Array, ""]) -> tuple[_Packets, ScattererTemplate]:
                return self._level(optics, cone, jax.random.fold_in(draws, level), packets)

            _, photons = jax.lax.scan(one, packets, jnp.arange(level, self.levels))
            by_level.append(jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), photons))
        photons = jax.tree.map(lambda *each: jnp.concatenate(each), *by_level).sorted()
        if self.merge > 0:
            photons = merged(photons, self.merge).sorted()
        offset = photons.offset[:capacity] * optics.mean_free_path
        # NaN if no photon is left: `require_photons` cannot check a traced opacity
        least = self.ends.faintest * number if self.ends.fades else 0
        any_left = optics.opacity > least
        return ScattererTemplate(offset, jnp.where(any_left, photons.intensity[:capacity], jnp.nan))

    def _level(
        self, optics: Optics, cone: Scalar, key: PRNGKeyArray, packets: "_Packets"
    ) -> tuple["_Packets", ScattererTemplate]:
        """Advance packets by one level: the photons they leave (lengths in λ), and the packets that go on."""
        position, direction, light = packets
        alpha = optics.opacity
        u = jax.random.uniform(key, (6, light.shape[0]))
        flight = -jnp.log1p(-u[0])
        position = position + flight[:, None] * direction
        conserving, wide = self.ends.energy == "conserving", self.ends.max_width
        if self.flights and not conserving:
            light = light * jnp.exp(-flight) * u[1]
        if self.ends.fades:
            light = light * _fade(alpha * light / self.ends.value)
        passed = ((1 - alpha) if conserving else alpha) * light
        cosine = 1 - u[2] * (1 - cone)
        after = _Packets(
            jnp.concatenate([position] * 2),
            jnp.concatenate([_turned(direction, cosine, u[3]), _turned(-direction, u[4], u[5])]),
            jnp.concatenate([passed * cosine, passed * (1 - cosine)]),
        )
        if after.light.shape[0] > wide:
            _, brightest = jax.lax.top_k(jax.lax.stop_gradient(after.light), int(wide))
            after = jax.tree.map(lambda leaf: leaf[brightest], after)
        return after, ScattererTemplate(position, alpha * light)


class _Packets(NamedTuple):
    """Packets of light: start, direction and energy of each."""

    position: Float[Array, "n 3"]
    direction: Float[Array, "n 3"]
    light: Float[Array, " n"]


def _key(key: PRNGKeyArray | int) -> PRNGKeyArray:
    return jax.random.key(key) if isinstance(key, int | np.integer) else key


def _cosine_of_critical_angle(optics: Optics, degrees: Any) -> Scalar:
    if degrees is not None:
        return jnp.cos(jnp.deg2rad(number("critical_angle", degrees, above=0, below=90.001)))
    sine = jnp.minimum(optics.refractive_index, 1 / optics.refractive_index)
    return _root(1 - sine**2)


def _root(squared: Scalar) -> Scalar:
    """Square root; 0 with derivative 0 for arguments up to 0. NaN stays NaN."""
    clamped = squared <= 0
    return jnp.where(clamped, 0, jnp.sqrt(jnp.where(clamped, 1, squared)))


def _fade(x: Scalar) -> Scalar:
    """Smooth ramp from 0 at `FADES` to 1 at 1."""
    return smoothstep((x - FADES) / (1 - FADES))


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
