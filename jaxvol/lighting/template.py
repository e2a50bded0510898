"""Scatterer templates: how light spreads inside a material, simulated once as a few photons.

Packets of light start from the origin. Each travels to its next scatterer, leaves a photon there, and goes on
as two packets, one refracted and one reflected. This binary tree grows level by level in arrays of static
shape, so that many templates of many materials grow at once.

Lee, Kwon and Shin: Scattered light representation in accordance with the material using scatterer template in
volume rendering (2016), section 3.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from .._util.checks import integer, is_traced, number
from .._util.memory import require_room
from .._util.npy import read_arrays
from .._util.vec3 import Scalar, golden_spiral, turned
from .materials import Material, Optics, materials_of, smoothstep


Energy = Literal["conserving", "printed"]

BYTES_PER_PHOTON, BYTES_PER_PAIR = 256, 16
"""Memory per photon while a template grows, including its draws, sorting and gathering; and per pair of
photons, for the distances by which they are merged."""

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
        return _sorted(ScattererTemplate(offset, intensity))

    def save(self, path: str | Path) -> None:
        """Write the template to a NumPy file, `.npz`."""
        path = Path(path)
        if path.suffix != ".npz":
            raise ValueError(f"path must end in .npz; got {path}.")
        np.savez(path, offset=np.asarray(self.offset), intensity=np.asarray(self.intensity))

    @classmethod
    def load(cls, path: str | Path) -> "ScattererTemplate":
        """Read a template written by `save`. **Raises** `ValueError` naming what is wrong with the file."""
        arrays = read_arrays(Path(path), ("offset", "intensity"))
        offset, intensity = arrays["offset"], arrays["intensity"]
        if offset.shape != (*intensity.shape, 3) or intensity.ndim < 1:
            raise ValueError(
                f"path: {path} must hold offset (*templates, n, 3) and intensity (*templates, n); "
                f"got {offset.shape} and {intensity.shape}."
            )
        if not (np.isfinite(offset).all() and np.isfinite(intensity).all() and (intensity >= 0).all()):
            raise ValueError(f"path: {path} must hold finite offsets and finite intensities of at least 0.")
        return cls(jnp.asarray(offset, float), jnp.asarray(intensity, float))


def scatterer_template(
    material: Material | Optics,
    key: PRNGKeyArray | int,
    *,
    packets: int = 4,
    threshold: float = 0.01,
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

    - `key`: a JAX key, or an integer seed. All draws depend on it alone, so offsets are λ times fixed ones.
    - `packets`: how many packets share the light, of energy 1, at the origin. Their directions are spread
      evenly and rotated at random. One packet makes a lopsided template.
    - `threshold`: of a photon's intensity, in (0, 1). A photon fades out between this and 0.8 times this,
      instead of vanishing at once. (The paper's threshold seems to end whole levels: it counts 56 to 63
      photons, a full tree of six levels, at an opacity of ½, and lists fainter ones.) The first photons are
      the brightest, of α / `packets` each: with a threshold above 1.25 times that, a template is empty.
    - `energy`: `"conserving"`: I' = (1 - α) I, so that all parts add up to I, and the template's energy falls
      short of 1 only by what the threshold cuts off. The paper's tables were made with this form: it gives
      their photons of the first and second level (that of the second is α (1 - α) cos θ' / `packets`).
      `"printed"`: the paper's equations (1) to (3) as printed, although misprinted: I' = α I, after I is
      multiplied by exp(-Δx / λ) cos θ, where θ is the angle of incidence and its cosine is drawn uniformly.
      The energy is not 1; without these factors (`flights=False`) it is α / (1 - α), above 1 for α > ½.
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
    packets, threshold, energy = settings(packets, threshold, energy)
    require_photons(material, packets, threshold)
    if not flights and energy != "printed":
        raise ValueError(
            'flights=False requires energy="printed"; a conserving template has no flight factors.'
        )
    if levels is None:
        levels = template_levels(material, packets=packets, threshold=threshold, energy=energy)
    grow = _Growth(
        packets, threshold, energy == "conserving", flights, float(merge), integer("levels", levels, 1)
    )
    grow.require_room(1)
    return grow(material.optics, _cosine_of_critical_angle(material.optics, critical_angle), _key(key))


def scatterer_templates(
    materials: Material | Sequence[Material],
    key: PRNGKeyArray | int,
    *,
    count: int = 8,
    packets: int = 4,
    threshold: float = 0.01,
    energy: Energy | Any = "conserving",
    merge: float = MERGE,
    levels: int | None = None,
    **how: Any,
) -> ScattererTemplate:
    """Several templates for each of several materials, grown at once.

    **Arguments:** as for `scatterer_template`, and `count`: templates per material.

    **Returns:** a `ScattererTemplate` with leading axes (materials, count). The draws are keyed by the index
    of the material and that of the template.

    **Raises:** as `scatterer_template` does; the memory checked is that of all templates.
    """
    materials, count, key = materials_of(materials), integer("count", count, 1), _key(key)
    packets, threshold, energy = settings(packets, threshold, energy)
    require_photons(materials, packets, threshold)
    if levels is None:
        levels = max(
            template_levels(each, packets=packets, threshold=threshold, energy=energy) for each in materials
        )
    same: Any = {"packets": packets, "threshold": threshold, "merge": merge, "levels": levels}
    _Growth(conserving=energy == "conserving", flights=True, **same).require_room(count * len(materials))
    optics = jax.tree.map(lambda *each: jnp.stack(each), *(each.optics for each in materials))

    def one(optics: Optics, material: Int[Array, ""], template: Int[Array, ""]) -> ScattererTemplate:
        draws = jax.random.fold_in(jax.random.fold_in(key, material), template)
        return scatterer_template(optics, draws, energy=energy, **same, **how)

    several = jax.vmap(jax.vmap(one, in_axes=(None, None, 0)), in_axes=(0, 0, None))
    return several(optics, jnp.arange(len(materials)), jnp.arange(count))


def settings(packets: Any, threshold: Any, energy: Any) -> tuple[int, float, Energy]:
    """Check and convert these arguments. **Raises** `ValueError` for invalid ones."""
    if energy not in get_args(Energy):
        raise ValueError(f"energy must be one of {', '.join(get_args(Energy))}; got {energy!r}.")
    return (
        integer("packets", packets, 1),
        float(number("threshold", threshold, above=0, below=1)),
        energy,
    )


def require_photons(
    materials: Material | Optics | Sequence[Material], packets: int, threshold: float
) -> None:
    """**Raises** `ValueError` for a material whose templates would hold no light: its brightest photons, the
    first ones, are below the threshold. Traced opacities are not checked."""
    for each in (materials,) if isinstance(materials, Material | Optics) else materials:
        if (
            is_traced(each.opacity)
            or (alpha := float(np.asarray(each.opacity))) > FADES * threshold * packets
        ):
            continue
        if alpha == 0:
            raise ValueError(
                "opacity must be above 0 for scatterer templates: a material that absorbs nothing leaves no "
                "photons."
            )
        raise ValueError(
            f"opacity {alpha:g} leaves no photon above threshold={threshold:g}: the brightest photons, the "
            f"first of packets={packets}, hold {alpha / packets:.3g} each, and photons below {FADES:g} times "
            f"the threshold are dropped. Use a threshold of at most {alpha / packets:.3g}, or fewer packets."
        )


def template_levels(
    material: Material | Optics, *, packets: int = 4, threshold: float = 0.01, energy: Energy = "conserving"
) -> int:
    """Number of tree levels that may hold a photon above the threshold. The brightest photon of level k has
    `α (1 - α)^k / packets`, or in the printed form `α^(k + 1) / packets`.

    **Raises:** `ValueError` if the material's opacity is traced, or leaves no photon.
    """
    if is_traced(material.opacity):
        raise ValueError("levels must be given where opacity is traced: the number of photons depends on it.")
    alpha = float(np.asarray(material.opacity))
    require_photons(material, packets, threshold)
    passed, least = (1 - alpha if energy == "conserving" else alpha), FADES * threshold * packets
    if passed == 0:
        return 1
    if passed == 1:
        raise ValueError('opacity must be below 1 with energy="printed", or the tree would never end; got 1.')
    return 1 + math.floor(math.log(least / alpha) / math.log(passed) + 1e-9)


def photons_above(
    material: Material | Optics, *, packets: int = 4, threshold: float = 0.01, energy: Energy = "conserving"
) -> int:
    """Upper bound of a template's photons above 0: in each level, no more than its energy allows. Often far
    fewer than `template_capacity`, which follows from the tree alone."""
    levels = template_levels(material, packets=packets, threshold=threshold, energy=energy)
    alpha = float(np.asarray(material.opacity))
    passed = 1 - alpha if energy == "conserving" else alpha
    by_energy = (passed**level * alpha / (FADES * threshold) + 1e-9 for level in range(levels))
    return max(1, sum(min(packets * 2 ** min(k, 32), int(bound)) for k, bound in enumerate(by_energy)))


def template_capacity(
    material: Material | Optics, *, packets: int = 4, threshold: float = 0.01, energy: Energy = "conserving"
) -> int:
    """Number of photons that a template has room for: a tree of `template_levels`, and no more than energy 1
    could fill."""
    levels = template_levels(material, packets=packets, threshold=threshold, energy=energy)
    return _Growth(packets, threshold, energy == "conserving", True, 0.0, levels).capacity


class _Growth(NamedTuple):
    """Grows a template; holds the static settings."""

    packets: int
    threshold: float
    conserving: bool
    flights: bool
    merge: float
    levels: int

    @property
    def max_width(self) -> int:
        """Most packets of one level that can be above the threshold, as their energies sum to 1."""
        return math.floor(1 / (FADES * self.threshold) + 1e-9)

    @property
    def tree_size(self) -> int:
        """Photons of all levels, each twice as wide as the one before, up to `max_width`."""
        doubling = sum(min(self.packets * 2**level, self.max_width) for level in range(min(self.levels, 64)))
        return doubling + max(self.levels - 64, 0) * self.max_width

    @property
    def capacity(self) -> int:
        return min(self.tree_size, self.max_width) if self.conserving else self.tree_size

    def require_room(self, templates: int) -> None:
        """**Raises** `ValueError` if this many templates would not fit into memory."""
        tree = self.tree_size
        each = tree * (BYTES_PER_PHOTON + (BYTES_PER_PAIR * tree if self.merge > 0 else 0))
        require_room(
            templates * each,
            f"{templates} templates, grown from {tree} photons each (packets={self.packets}, "
            f"threshold={self.threshold:g}, levels={self.levels}); use fewer templates or levels, or a "
            "higher threshold",
        )

    def __call__(self, optics: Optics, cone: Scalar, key: PRNGKeyArray) -> ScattererTemplate:
        origin, draws = jax.random.split(key)
        start, even = jnp.zeros((self.packets, 3)), jnp.full(self.packets, 1 / self.packets)
        packets = _Packets(start, _spread(origin, self.packets), even)
        by_level, level = [], 0
        while level < self.levels and packets.light.shape[0] < self.max_width:
            packets, photons = self._level(optics, cone, jax.random.fold_in(draws, level), packets)
            by_level.append(photons)
            level += 1
        if level < self.levels:  # from here on, all levels have the same width

            def one(packets: _Packets, level: Int[Array, ""]) -> tuple[_Packets, ScattererTemplate]:
                return self._level(optics, cone, jax.random.fold_in(draws, level), packets)

            _, photons = jax.lax.scan(one, packets, jnp.arange(level, self.levels))
            by_level.append(jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), photons))
        photons = _sorted(jax.tree.map(lambda *each: jnp.concatenate(each), *by_level))
        if self.merge > 0:
            photons = _sorted(_merged(photons, self.merge))
        offset = photons.offset[: self.capacity] * optics.mean_free_path
        # NaN if no photon is above the threshold: `require_photons` cannot check a traced opacity
        any_left = optics.opacity > FADES * self.threshold * self.packets
        return ScattererTemplate(offset, jnp.where(any_left, photons.intensity[: self.capacity], jnp.nan))

    def _level(
        self, optics: Optics, cone: Scalar, key: PRNGKeyArray, packets: "_Packets"
    ) -> tuple["_Packets", ScattererTemplate]:
        """Advance packets by one level: the photons they leave (lengths in λ), and the packets that go on."""
        position, direction, light = packets
        alpha = optics.opacity
        u = jax.random.uniform(key, (6, light.shape[0]))
        flight = -jnp.log1p(-u[0])
        position = position + flight[:, None] * direction
        if self.flights and not self.conserving:
            light = light * jnp.exp(-flight) * u[1]
        light = light * _fade(alpha * light / self.threshold)
        passed = ((1 - alpha) if self.conserving else alpha) * light
        cosine = 1 - u[2] * (1 - cone)
        after = _Packets(
            jnp.concatenate([position] * 2),
            jnp.concatenate([_turned(direction, cosine, u[3]), _turned(-direction, u[4], u[5])]),
            jnp.concatenate([passed * cosine, passed * (1 - cosine)]),
        )
        if after.light.shape[0] > self.max_width:
            _, brightest = jax.lax.top_k(jax.lax.stop_gradient(after.light), self.max_width)
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


def _sorted(photons: ScattererTemplate) -> ScattererTemplate:
    """Sort photons by intensity, brightest first."""
    order = jnp.argsort(-jax.lax.stop_gradient(photons.intensity), axis=-1, stable=True)
    return ScattererTemplate(
        jnp.take_along_axis(photons.offset, order[..., None], axis=-2),
        jnp.take_along_axis(photons.intensity, order, axis=-1),
    )


def _merged(photons: ScattererTemplate, distance: float) -> ScattererTemplate:
    """Add each photon's intensity to the brightest photon within this distance."""
    offset = jax.lax.stop_gradient(photons.offset)
    near = sum((offset[:, None, i] - offset[None, :, i]) ** 2 for i in range(3)) <= distance**2
    # Photons are sorted, so argmax finds the brightest: the photon itself if none near is brighter. A host
    # may have a host in turn; doubling follows the chain to its end.
    host = jnp.argmax(near, axis=-1)
    for _ in range(math.ceil(math.log2(max(host.shape[0], 2)))):
        host = host[host]
    intensity = jnp.zeros_like(photons.intensity).at[host].add(photons.intensity)
    return ScattererTemplate(photons.offset, intensity)
