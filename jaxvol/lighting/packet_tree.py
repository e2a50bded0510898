"""Templates as published: packets of light from the origin leave a photon at each scatterer and go on as two,
refracted and reflected, a binary tree that is simulated level by level in arrays of static shape.

Lee, Kwon and Shin: Scattered light representation in accordance with the material using scatterer template in
volume rendering (2016), section 3.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from .._util.checks import integer, number
from .._util.vec3 import Scalar, golden_spiral, root, turned
from ..xla.platform import is_traced
from .materials import Material, Optics, smoothstep
from .template import ScattererTemplate


FADES = 0.8
"""A photon fades out between the threshold and this fraction of it."""

ThresholdOn = Literal["photon", "level"]

MOST_PHOTONS = 2**12
"""Most photons of a template whose levels are kept whole."""

MERGE = 0.01
"""Photons closer than this fraction of the mean free path are merged into one."""


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
        """Levels with photons above the threshold: the brightest of level k has `α (1 - α)^k / packets`."""
        if opacity == 1:
            return 1
        return 1 + math.floor(math.log(self.faintest * self.packets / opacity) / math.log(1 - opacity) + 1e-9)

    def levels_of(self, materials: Sequence[Material], levels: int | Sequence[int] | None) -> tuple[int, ...]:
        """Levels of each material, by default as its opacity allows. **Raises** `ValueError` for no photon,
        too many, or a traced opacity without a number."""
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
        """Upper bound of a template's photons: levels at most double, and, by opacity, energy limits them."""
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
        """Photons of a tree, merged and sorted; NaN if a traced opacity leaves none."""
        origin, draws = jax.random.split(key)
        # evenly spread over the sphere and rotated at random, so that each alone is uniformly distributed
        q, r = jnp.linalg.qr(jax.random.normal(origin, (3, 3)))
        spread = golden_spiral(self.packets)
        directions = jnp.asarray(spread, q.dtype) @ (q * jnp.sign(jnp.diagonal(r))[None]).T
        packets = jnp.zeros((self.packets, 3)), directions, jnp.full(self.packets, 1 / self.packets)
        sine_of_critical_angle = jnp.minimum(optics.refractive_index, 1 / optics.refractive_index)
        cone = 1 - root(1 - sine_of_critical_angle**2)

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


def _turned(direction: Float[Array, "n 3"], cosine: Scalar, u: Scalar) -> Float[Array, "n 3"]:
    """Directions at an angle to `direction` given by its cosine; `u` in [0, 1) selects the azimuth."""
    x, y, z = direction.T
    sine = root(1 - cosine**2)
    around = 2 * jnp.pi * u
    return jnp.stack(turned((sine * jnp.cos(around), sine * jnp.sin(around), cosine), (x, y, z)), axis=-1)
