"""Simulation of templates as published: packets of light from the origin leave a photon at each scatterer and
split into a refracted and a reflected one, a binary tree. Its levels are arrays of static shape.

Lee, Kwon and Shin: Scattered light representation in accordance with the material using scatterer template in
volume rendering (2016), section 3.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, SupportsIndex, TypeAlias, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from .._util.checks import integer, number
from .._util.vec3 import Scalar, golden_spiral, root, turned
from ..xla.platform import is_traced
from .materials import Material, Optics, smoothstep
from .template import ScattererTemplate


FADES = 0.8
"""Photons fade out between the threshold and this fraction of it."""

ThresholdOn = Literal["photon", "level"]

MOST_PHOTONS = 2**12
"""Upper bound of the photons of a template whose levels are kept whole."""

MERGE = 0.01
"""Photons closer than this fraction of the mean free path are merged into one."""


Packets: TypeAlias = tuple[Float[Array, "n 3"], Float[Array, "n 3"], Float[Array, " n"]]
"""Start, direction and energy of each packet of light."""


@dataclass
class PacketTree:
    """The tree of packets of a template, with the arguments of `scatterer_template`, which it checks."""

    packets: Any = 4
    threshold: Any = 0.01
    threshold_on: Any = "photon"

    def __post_init__(self):
        self.packets = integer("packets", self.packets, 1)
        self.threshold = float(number("threshold", self.threshold, above=0, below=1))
        if self.threshold_on not in get_args(ThresholdOn):
            raise ValueError(
                f"threshold_on must be one of {', '.join(get_args(ThresholdOn))}; got {self.threshold_on!r}."
            )

    @property
    def whole_levels(self) -> bool:
        """True if the threshold ends levels, not photons."""
        return self.threshold_on == "level"

    @property
    def faintest(self) -> float:
        """Intensity below which a photon, or a level by its brightest possible photon, is left out."""
        return self.threshold if self.whole_levels else FADES * self.threshold

    @property
    def max_width(self) -> float:
        """Upper bound of the packets of a level above the threshold, as their energies sum to 1."""
        return math.inf if self.whole_levels else math.floor(1 / self.faintest + 1e-9)

    def levels(self, opacity: float) -> int:
        """Levels with photons above the threshold: the brightest of level k has `α (1 - α)^k / packets`."""
        if opacity == 1:
            return 1
        return 1 + math.floor(math.log(self.faintest * self.packets / opacity) / math.log(1 - opacity) + 1e-9)

    def levels_of(
        self, materials: Sequence[Material], levels: SupportsIndex | Sequence[SupportsIndex] | None
    ) -> tuple[int, ...]:
        """Levels of each material, by default as its opacity allows. **Raises** `ValueError` for materials
        without photons, too many photons, and traced opacities without `levels`."""
        counts = []
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
            counts.append(self.levels(opacity))
        if isinstance(levels, Sequence):
            if len(levels) != len(materials):
                raise ValueError(f"levels must be one number, or {len(materials)}; got {levels!r}.")
            counts = [integer("levels", count, 1) for count in levels]
        elif levels is not None:
            counts = [integer("levels", levels, 1)] * len(materials)
        if self.whole_levels and self.packets * 2.0 ** max(counts) > MOST_PHOTONS:
            raise ValueError(
                f'threshold_on="level" keeps {max(counts)} levels of packets={self.packets} whole, more than '
                f"{MOST_PHOTONS} photons; give a higher threshold, or fewer levels."
            )
        return tuple(counts)

    def capacity(self, levels: int, opacity: float | None = None) -> int:
        """Upper bound of a template's photons. Levels at most double; with `opacity`, energy limits them."""
        total = 0
        for k in range(levels):
            width = self.max_width
            if opacity is not None and not self.whole_levels:
                width = math.floor((1 - opacity) ** k * opacity / self.faintest + 1e-9)
            total += min(self.packets * 2 ** min(k, 64), width)
        return int(min(total, self.max_width))

    def template(
        self,
        optics: Optics,
        key: PRNGKeyArray,
        levels: int,
        merge: float = MERGE,
        material_levels: Int[Array, ""] | None = None,
    ) -> ScattererTemplate:
        """Photons of a tree, merged and sorted; NaN if a traced opacity leaves none. Photons of levels from
        `material_levels` on have no energy."""
        origin, draws = jax.random.split(key)
        # spread evenly over the sphere and rotated at random, so that each direction is uniformly distributed
        q, r = jnp.linalg.qr(jax.random.normal(origin, (3, 3)))
        spread = golden_spiral(self.packets)
        directions = jnp.asarray(spread, q.dtype) @ (q * jnp.sign(jnp.diagonal(r))[None]).T
        packets = jnp.zeros((self.packets, 3)), directions, jnp.full(self.packets, 1 / self.packets)
        sine_of_critical_angle = jnp.minimum(optics.refractive_index, 1 / optics.refractive_index)
        cone = 1 - root(1 - sine_of_critical_angle**2)

        def advance(packets: Packets, level: Int[Array, ""] | int) -> tuple[Packets, ScattererTemplate]:
            """The next level's packets, and the photons of this level (lengths in λ)."""
            position, direction, light = packets
            u = jax.random.uniform(jax.random.fold_in(draws, level), (6, light.shape[0]))
            flight = -jnp.log1p(-u[0])
            position = position + flight[:, None] * direction
            light, passed = self.energies(optics.opacity, light, flight, u[1])
            if material_levels is not None:
                light = jnp.where(level < material_levels, light, 0)
            cosine = 1 - u[2] * cone
            children = (
                jnp.concatenate([position] * 2),
                jnp.concatenate([_turned(direction, cosine, u[3]), _turned(-direction, u[4], u[5])]),
                jnp.concatenate([passed * cosine, passed * (1 - cosine)]),
            )
            if children[2].shape[0] > self.max_width:
                _, brightest = jax.lax.top_k(jax.lax.stop_gradient(children[2]), int(self.max_width))
                children = jax.tree.map(lambda leaf: leaf[brightest], children)
            return children, ScattererTemplate(position, optics.opacity * light)

        by_level, level = [], 0
        while level < levels and packets[2].shape[0] < self.max_width:
            packets, photons = advance(packets, level)
            by_level.append(photons)
            level += 1
        if level < levels:  # the levels that follow have the same width
            _, photons = jax.lax.scan(advance, packets, jnp.arange(level, levels))
            by_level.append(jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), photons))
        photons = jax.tree.map(lambda *parts: jnp.concatenate(parts), *by_level).sorted()
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
        """The energy of packets after their flights (lengths in λ), and the part that their children get."""
        light = self.faded(opacity, light)
        return light, (1 - opacity) * light

    def faded(self, opacity: Scalar, light: Scalar) -> Scalar:
        """The energy of packets, reduced where their photons fade out."""
        if self.whole_levels:
            return light
        return light * smoothstep((opacity * light / self.threshold - FADES) / (1 - FADES))


def _turned(direction: Float[Array, "n 3"], cosine: Scalar, u: Scalar) -> Float[Array, "n 3"]:
    """Directions at an angle to `direction` given by its cosine; `u` in [0, 1) selects the azimuth."""
    x, y, z = direction.T
    sine, azimuth = root(1 - cosine**2), 2 * jnp.pi * u
    return jnp.stack(turned((sine * jnp.cos(azimuth), sine * jnp.sin(azimuth), cosine), (x, y, z)), axis=-1)
