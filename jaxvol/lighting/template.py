"""Scatterer templates: how light spreads inside a material, as a few photons around a point.

Packets of light start from the origin. Each travels to its next scatterer, leaves a photon there, and goes on
as two packets, one refracted and one reflected. This binary tree is simulated level by level in arrays of
static shape, so that many templates of many materials are simulated at once.

Lee, Kwon and Shin: Scattered light representation in accordance with the material using scatterer template in
volume rendering (2016), section 3.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, TypeAlias, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from .._util.checks import Arrayable, integer, number
from .._util.vec3 import Scalar, golden_spiral, turned
from ..xla.platform import is_traced
from .materials import Material, Optics, materials_of, optics_of, smoothstep
from .random_walks import unit_walks


Form = Literal["published", "transport"]

FADES = 0.8
"""A photon fades out between the threshold and this fraction of it."""

ThresholdOn = Literal["photon", "level"]

MOST_PHOTONS = 2**12
"""Most photons of a template whose levels are kept whole."""

MERGE = 0.01
"""Photons closer than this fraction of the mean free path are merged into one."""


class ScattererTemplate(eqx.Module):
    """Photons around a sample, brightest first; or several such sets, along leading axes.

    Attributes:
        offset: from the sample, world length.
        intensity: the fraction of the light that each photon holds; 0 for padding.
        parent: the photon from which light comes to each, -1 for the first; None where it is not kept.
    """

    offset: Float[Array, "*templates n 3"]
    intensity: Float[Array, "*templates n"]
    parent: Int[Array, "*templates n"] | None = None

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
    threshold_on: ThresholdOn | Any = "photon",
    merge: float = MERGE,
    levels: int | None = None,
    form: Form | Any = "published",
    anisotropy: Arrayable = 0.0,
) -> ScattererTemplate:
    """Simulate how light spreads around a point inside a material.

    A packet of energy I travels Δx = -λ ln u in its direction, u uniform. Where it arrives, in a material of
    opacity α, αI is absorbed and becomes a photon; of the rest I' = (1 - α) I, `I' cos θ'` is refracted by an
    angle θ', into a direction uniformly distributed over the cone within the critical angle of total
    reflection between the material and air; and `I' (1 - cos θ')` is reflected into any direction of the
    half-space it came from. Packets, or whole levels of the tree, end at the threshold.

    So all parts add up to I, and a template's energy falls short of 1 only by what the threshold cuts off.
    The paper's tables were made in this way; its equations (1) to (3) as printed hand on αI
    (`experiments/printed_templates.py`). Its count of 56 to 63 photons, at an opacity of 50 % and a threshold
    of 0.01, is that of `threshold_on="level"`: 63 of one packet (six levels), 60 of four (four levels each,
    whose photons are a quarter as bright), less those that were merged.

    Where it fails: `experiments/stability.py`, "lopsided templates", "energy of templates as printed".

    Args:
        material: its opacity, mean free path λ and refractive index.
        key: a JAX key, or an integer seed. All draws depend on it alone, so offsets are λ times fixed ones.
        packets: how many packets share the light, of energy 1, at the origin. Their directions are spread
            evenly and rotated at random. One packet makes a lopsided template.
        threshold: in (0, 1), of a photon's intensity. The first photons are the brightest, of α / `packets`
            each: with a threshold above 1.25 times that (by levels, above that), a template is empty.
        threshold_on: what is compared with the threshold. `"photon"`: each photon, which fades out between
            this and 0.8 times this, instead of vanishing at once. `"level"`: the brightest possible photon
            of a level k, α (1 - α)^k / `packets`; levels from there on are left out and others kept whole,
            as in the paper. Nothing fades: how many levels there are is fixed when the template is made, and
            depends on nothing that is traced.
        merge: photons closer than this fraction of λ are merged, as in the paper's tables.
        levels: of the tree; required if the opacity is traced. By default as many as may hold photons above
            the threshold.
        form: `"published"`, or `"transport"`, which is ours: the photons are the vertices of `packets` random
            walks, the first of them the point itself, and keep their `parent`. Flights are as long as above;
            directions follow the phase function, and nothing is merged. Of the light, α (1 - α)^k is at the
            k-th vertices, so that the sum over photons inside a homogeneous object, all of whose ancestors
            are inside, estimates multiple scattering without bias.
        anisotropy: g of the phase function (Henyey and Greenstein), in (-1, 1), for `"transport"`.

    Returns:
        A `ScattererTemplate`, differentiable in the material's mean free path, opacity and refractive index
        (at an index of 1, where the critical angle has no derivative, the derivative used is 0).

    Raises:
        ValueError: for numbers out of range, missing `levels`, and if all photons are below the threshold; of
            a traced opacity, intensities are then NaN. For whole levels of more than 4096 photons.
    """
    how = packets, threshold, threshold_on, merge, levels, form, anisotropy
    of_template, (own_levels,) = _simulation((material,), *how)
    return of_template(material.optics, _key(key), own_levels, None)


def scatterer_templates(
    materials: Material | Sequence[Material],
    key: PRNGKeyArray | int,
    *,
    count: int = 8,
    packets: int = 4,
    threshold: float = 0.01,
    threshold_on: ThresholdOn | Any = "photon",
    merge: float = MERGE,
    levels: int | Sequence[int] | None = None,
    form: Form | Any = "published",
    anisotropy: Arrayable = 0.0,
) -> ScattererTemplate:
    """Several templates for each of several materials, simulated at once.

    Args:
        materials: one or several.
        key: as for `scatterer_template`. The draws are also keyed by the indices of material and template.
        count: templates per material.
        packets: as for `scatterer_template`.
        threshold: as for `scatterer_template`.
        threshold_on: as for `scatterer_template`.
        merge: as for `scatterer_template`.
        levels: as for `scatterer_template`; one number for all materials, or, of the published form, one for
            each.
        form: as for `scatterer_template`.
        anisotropy: as for `scatterer_template`.

    Returns:
        A `ScattererTemplate` with leading axes (materials, count).

    Raises:
        ValueError: as `scatterer_template` does.
    """
    materials, count, key = materials_of(materials), integer("count", count, 1), _key(key)
    how = packets, threshold, threshold_on, merge, levels, form, anisotropy
    of_template, own = _simulation(materials, *how)

    def one(
        optics: Optics, own_levels: Int[Array, ""], material: Int[Array, ""], template: Int[Array, ""]
    ) -> ScattererTemplate:
        draws = jax.random.fold_in(jax.random.fold_in(key, material), template)
        return of_template(optics, draws, max(own), own_levels)

    several = jax.vmap(jax.vmap(one, in_axes=(None, None, None, 0)), in_axes=(0, 0, 0, None))
    numbers = jnp.arange(len(materials))
    return several(optics_of(materials), jnp.asarray(own), numbers, jnp.arange(count))


def _simulation(
    materials: Sequence[Material],
    packets: int,
    threshold: float,
    threshold_on: Any,
    merge: float,
    levels: Any,
    form: Any,
    anisotropy: Arrayable,
) -> tuple[Callable[..., ScattererTemplate], tuple[int, ...]]:
    """What simulates one template, from its optics, key, the most levels of any and its own number; and the
    number of levels of each material."""
    check_form(form)
    tree = PacketTree(packets, threshold, threshold_on)
    if form == "transport":
        g = number("anisotropy", anisotropy, above=-1, below=1)

        def walks(optics: Optics, draws: PRNGKeyArray, most: int, _: Any) -> ScattererTemplate:
            return walk_template(optics, draws, most, tree.packets, g)

        return walks, (scatterings(materials, tree.threshold, levels),) * len(materials)
    check_isotropic(anisotropy)

    def photons(optics: Optics, draws: PRNGKeyArray, most: int, own: Any) -> ScattererTemplate:
        return tree.template(optics, draws, most, merge, own if tree.whole_levels else None)

    return photons, tree.levels_of(materials, levels)


def check_isotropic(anisotropy: Any) -> None:
    """Raise `ValueError` for an anisotropy with the published form, whose directions follow refraction."""
    if not isotropic(anisotropy):
        raise ValueError(f'anisotropy is of form="transport"; got {anisotropy!r} for form="published".')


def isotropic(anisotropy: Any) -> bool:
    """Whether an anisotropy is known to be 0 when a program is traced; None stands for 0."""
    return anisotropy is None or (isinstance(anisotropy, int | float | np.number) and anisotropy == 0)


def check_form(form: Any) -> None:
    """Raise `ValueError` for what is no `Form`."""
    if form not in get_args(Form):
        raise ValueError(f"form must be one of {', '.join(get_args(Form))}; got {form!r}.")


def scatterings(materials: Sequence[Material], threshold: float, levels: Any) -> int:
    """Number of scatterings of a random walk: as given, or after which less than `threshold` of the light is
    left in any of the materials. **Raises** `ValueError` where that depends on a traced opacity, or is
    never."""
    if levels is not None:
        return integer("levels", levels, 1)
    if is_traced([material.opacity for material in materials]):
        raise ValueError("levels must be given where opacity is traced: the length of walks depends on it.")
    least = min(float(material.opacity) for material in materials)
    if least == 0:
        raise ValueError("levels must be given for a material of opacity 0, in which no light is absorbed.")
    return 1 if least == 1 else max(1, math.ceil(math.log(threshold) / math.log(1 - least)))


@partial(jax.jit, static_argnums=(2, 3))
def walk_template(
    optics: Optics, key: PRNGKeyArray, levels: int, packets: int, anisotropy: Scalar
) -> ScattererTemplate:
    """The template of `form="transport"`."""
    directions, lengths = unit_walks(key, 1, packets, levels, anisotropy)
    vertices = jnp.cumsum(directions[0] * lengths[0, ..., None], axis=1) * optics.mean_free_path
    by_level = jnp.moveaxis(vertices, 0, 1).reshape(-1, 3)
    k = jnp.repeat(jnp.arange(1, levels + 1), packets)
    light = optics.opacity * (1 - optics.opacity) ** k.astype(by_level.dtype) / packets
    parents = jnp.maximum(jnp.arange(1, k.size + 1) - packets, 0)
    return ScattererTemplate(
        jnp.concatenate([jnp.zeros((1, 3), by_level.dtype), by_level]),
        jnp.concatenate([optics.opacity[None], light]),
        jnp.concatenate([jnp.full(1, -1), parents]),
    )


Packets: TypeAlias = tuple[Float[Array, "n 3"], Float[Array, "n 3"], Float[Array, " n"]]
"""Start, direction and energy of each packet of light."""


@dataclass
class PacketTree:
    """The tree of packets of a template, with the arguments of `scatterer_template`."""

    packets: int = 4
    threshold: float = 0.01
    threshold_on: ThresholdOn | Any = "photon"

    def __post_init__(self):
        self.packets = integer("packets", self.packets, 1)
        self.threshold = float(number("threshold", self.threshold, above=0, below=1))
        if self.threshold_on not in get_args(ThresholdOn):
            raise ValueError(
                f"threshold_on must be one of {', '.join(get_args(ThresholdOn))}; got {self.threshold_on!r}."
            )

    @property
    def whole_levels(self) -> bool:
        """Whether the threshold ends levels, not photons."""
        return self.threshold_on == "level"

    @property
    def faintest(self) -> float:
        """Intensity below which there is no photon, or no level whose brightest possible photon has it."""
        return self.threshold if self.whole_levels else FADES * self.threshold

    @property
    def max_width(self) -> float:
        """Most packets of a level: as many as can be above the threshold, as their energies sum to 1."""
        return math.inf if self.whole_levels else math.floor(1 / self.faintest + 1e-9)

    def levels(self, opacity: float) -> int:
        """Number of levels that may hold a photon above the threshold. The brightest possible photon of level
        k has `α (1 - α)^k / packets`."""
        if opacity == 1:
            return 1
        return 1 + math.floor(math.log(self.faintest * self.packets / opacity) / math.log(1 - opacity) + 1e-9)

    def levels_of(self, materials: Sequence[Material], levels: int | Sequence[int] | None) -> tuple[int, ...]:
        """The number of levels of each material, by default as many as its opacity allows. **Raises**
        `ValueError` for an opacity that leaves no photon, for one that is traced, if no number is given, and
        for too many photons."""
        found = []
        for material in materials:
            if is_traced(material.opacity):
                if levels is None:
                    raise ValueError(
                        "levels must be given where opacity is traced: the number of photons depends on it."
                    )
                continue
            opacity = float(material.opacity)
            if opacity <= self.faintest * self.packets:
                advice = f"a threshold below {opacity / self.packets:.3g}" if opacity else "one above 0"
                raise ValueError(
                    f"opacity {opacity:g} leaves no photon above threshold={self.threshold:g} with "
                    f"packets={self.packets}; give {advice}."
                )
            found.append(self.levels(opacity))
        if isinstance(levels, Sequence):
            if len(levels) != len(materials):
                raise ValueError(f"levels must be one number, or {len(materials)}; got {levels!r}.")
            found = [integer("levels", each, 1) for each in levels]
        elif levels is not None:
            found = [integer("levels", levels, 1)] * len(materials)
        if self.whole_levels and self.packets * 2.0 ** max(found) > MOST_PHOTONS:
            raise ValueError(
                f'threshold_on="level" keeps {max(found)} levels of packets={self.packets} whole, more than '
                f"{MOST_PHOTONS} photons; give a higher threshold, or fewer levels."
            )
        return tuple(found)

    def capacity(self, levels: int, opacity: float | None = None) -> int:
        """Upper bound of a template's photons: in each level at most twice as many as in the one before, and,
        for a given opacity, no more than its energy allows."""
        total = 0
        for k in range(levels):
            most = self.max_width
            if opacity is not None and not self.whole_levels:
                most = math.floor((1 - opacity) ** k * opacity / self.faintest + 1e-9)
            total += min(self.packets * 2 ** min(k, 64), most)
        return int(min(total, self.max_width))

    def template(
        self,
        optics: Optics,
        key: PRNGKeyArray,
        levels: int,
        merge: float = MERGE,
        own_levels: Int[Array, ""] | None = None,
    ) -> ScattererTemplate:
        """The photons of a tree of so many levels, merged and sorted; NaN if a traced opacity leaves none.
        `own_levels`: of this material, if it has fewer than others."""
        origin, draws = jax.random.split(key)
        # evenly spread over the sphere and rotated at random, so that each alone is uniformly distributed
        q, r = jnp.linalg.qr(jax.random.normal(origin, (3, 3)))
        spread = golden_spiral(self.packets)
        directions = jnp.asarray(spread, q.dtype) @ (q * jnp.sign(jnp.diagonal(r))[None]).T
        packets = jnp.zeros((self.packets, 3)), directions, jnp.full(self.packets, 1 / self.packets)
        sine_of_critical_angle = jnp.minimum(optics.refractive_index, 1 / optics.refractive_index)
        cone = 1 - _root(1 - sine_of_critical_angle**2)

        def advance(packets: Packets, level: Any) -> tuple[Packets, ScattererTemplate]:
            """The packets that go on from a level, and the photons that they leave (lengths in λ)."""
            position, direction, light = packets
            u = jax.random.uniform(jax.random.fold_in(draws, level), (6, light.shape[0]))
            flight = -jnp.log1p(-u[0])
            position = position + flight[:, None] * direction
            light, passed = self.energies(optics.opacity, light, flight, u[1])
            if own_levels is not None:
                light = jnp.where(level < own_levels, light, 0)
            cosine = 1 - u[2] * cone
            after = (
                jnp.concatenate([position] * 2),
                jnp.concatenate([_turned(direction, cosine, u[3]), _turned(-direction, u[4], u[5])]),
                jnp.concatenate([passed * cosine, passed * (1 - cosine)]),
            )
            if after[2].shape[0] > self.max_width:
                _, brightest = jax.lax.top_k(jax.lax.stop_gradient(after[2]), int(self.max_width))
                after = jax.tree.map(lambda leaf: leaf[brightest], after)
            return after, ScattererTemplate(position, optics.opacity * light)

        by_level, level = [], 0
        while level < levels and packets[2].shape[0] < self.max_width:
            packets, photons = advance(packets, level)
            by_level.append(photons)
            level += 1
        if level < levels:  # from here on, all levels have the same width
            _, photons = jax.lax.scan(advance, packets, jnp.arange(level, levels))
            by_level.append(jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), photons))
        photons = jax.tree.map(lambda *each: jnp.concatenate(each), *by_level).sorted()
        if merge > 0:
            photons = photons.clustered(merge)
        photons = jax.tree.map(lambda leaf: leaf[: self.capacity(levels)], photons)
        any_left = optics.opacity > self.faintest * self.packets
        return ScattererTemplate(
            photons.offset * optics.mean_free_path, jnp.where(any_left, photons.intensity, jnp.nan)
        )

    def energies(
        self, opacity: Scalar, light: Scalar, flight: Scalar, uniform: Scalar
    ) -> tuple[Scalar, Scalar]:
        """The energy of packets after their flights (lengths in λ), and what of it they hand on."""
        light = self.faded(opacity, light)
        return light, (1 - opacity) * light

    def faded(self, opacity: Scalar, light: Scalar) -> Scalar:
        """The energy of packets, less of those whose photons fade out."""
        if self.whole_levels:
            return light
        return light * smoothstep((opacity * light / self.threshold - FADES) / (1 - FADES))


def _key(key: PRNGKeyArray | int) -> PRNGKeyArray:
    return jax.random.key(key) if isinstance(key, int | np.integer) else key


def _root(squared: Scalar) -> Scalar:
    """Square root; 0 with derivative 0 for arguments up to 0. NaN stays NaN."""
    clamped = squared <= 0
    return jnp.where(clamped, 0, jnp.sqrt(jnp.where(clamped, 1, squared)))


def _turned(direction: Float[Array, "n 3"], cosine: Scalar, u: Scalar) -> Float[Array, "n 3"]:
    """Directions at an angle to `direction` given by its cosine; `u` in [0, 1) selects the azimuth."""
    x, y, z = direction.T
    sine = _root(1 - cosine**2)
    around = 2 * jnp.pi * u
    return jnp.stack(turned((sine * jnp.cos(around), sine * jnp.sin(around), cosine), (x, y, z)), axis=-1)
