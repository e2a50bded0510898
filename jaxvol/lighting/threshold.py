"""Where does a template end? How many levels and photons a threshold leaves of its tree of packets."""

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from .._util.checks import integer, number
from ..xla.platform import is_traced
from .materials import Material, Optics


Energy = Literal["conserving", "printed"]

ThresholdOn = Literal["photon", "level"]

FADES = 0.8
"""A photon fades out between the threshold and this fraction of it."""


class Threshold(NamedTuple):
    """What ends the tree of packets that a template grows as. All as for `scatterer_template`: `value` is its
    `threshold`, `on` its `threshold_on`."""

    packets: int = 4
    value: float = 0.01
    on: ThresholdOn = "photon"
    energy: Energy = "conserving"

    @classmethod
    def checked(cls, packets: Any, threshold: Any, threshold_on: Any, energy: Any) -> "Threshold":
        """**Raises** `ValueError` for invalid arguments."""
        for name, given, allowed in (("energy", energy, Energy), ("threshold_on", threshold_on, ThresholdOn)):
            if given not in get_args(allowed):
                raise ValueError(f"{name} must be one of {', '.join(get_args(allowed))}; got {given!r}.")
        value = float(number("threshold", threshold, above=0, below=1))
        return cls(integer("packets", packets, 1), value, threshold_on, energy)

    @property
    def fades(self) -> bool:
        """Whether each photon fades out at the threshold."""
        return self.on == "photon"

    @property
    def faintest(self) -> float:
        """Intensity below which there is no photon, or no level of which it is the brightest possible one."""
        return FADES * self.value if self.fades else self.value

    @property
    def max_width(self) -> float:
        """Most packets of one level that go on: as many as can be above the threshold, as their energies sum
        to 1."""
        return math.floor(1 / self.faintest + 1e-9) if self.fades else math.inf

    def tree_size(self, levels: int) -> int:
        """Photons of all levels, each twice as wide as the one before, up to `max_width`."""
        doubling = sum(min(self.packets * 2**level, self.max_width) for level in range(min(levels, 64)))
        beyond = levels - 64
        return int(doubling + (beyond * min(self.packets * 2**64, self.max_width) if beyond > 0 else 0))

    def capacity(self, levels: int) -> int:
        """Number of photons that a template of so many levels has room for: its tree, and no more than energy
        1 could fill."""
        size = self.tree_size(levels)
        return int(min(size, self.max_width)) if self.energy == "conserving" else size

    def levels(self, material: Material | Optics) -> int:
        """Number of tree levels that may hold a photon above the threshold. The brightest possible photon of
        level k has `α (1 - α)^k / packets`, or in the printed form `α^(k + 1) / packets`.

        **Raises:** `ValueError` if the material's opacity is traced, or leaves no photon.
        """
        if is_traced(material.opacity):
            raise ValueError(
                "levels must be given where opacity is traced: the number of photons depends on it."
            )
        alpha = float(np.asarray(material.opacity))
        self.require_photons(material)
        passed = self._passed_on(alpha)
        if passed == 0:
            return 1
        if passed == 1:
            raise ValueError(
                'opacity must be below 1 with energy="printed", or the tree would never end; got 1.'
            )
        return 1 + math.floor(math.log(self.faintest * self.packets / alpha) / math.log(passed) + 1e-9)

    def photons(self, material: Material | Optics) -> int:
        """Upper bound of a template's photons above 0: in each level, no more than its energy allows. Often
        far fewer than `template_capacity`, which follows from the tree alone."""
        levels = self.levels(material)
        if not self.fades:
            return self.tree_size(levels)
        alpha = float(np.asarray(material.opacity))
        passed = self._passed_on(alpha)
        by_energy = (passed**level * alpha / self.faintest + 1e-9 for level in range(levels))
        return max(
            1, sum(min(self.packets * 2 ** min(k, 32), int(bound)) for k, bound in enumerate(by_energy))
        )

    def require_photons(self, materials: Material | Optics | Sequence[Material]) -> None:
        """**Raises** `ValueError` for a material whose templates would hold no light: its brightest photons,
        the first ones, are below the threshold. Traced opacities are not checked."""
        for each in (materials,) if isinstance(materials, Material | Optics) else materials:
            if (
                is_traced(each.opacity)
                or (alpha := float(np.asarray(each.opacity))) > self.faintest * self.packets
            ):
                continue
            if alpha == 0:
                raise ValueError(
                    "opacity must be above 0 for scatterer templates: a material that absorbs nothing leaves "
                    "no photons."
                )
            dropped = f", and photons below {FADES:g} times the threshold are dropped" if self.fades else ""
            raise ValueError(
                f"opacity {alpha:g} leaves no photon above threshold={self.value:g}: the brightest photons, "
                f"the first of packets={self.packets}, hold {alpha / self.packets:.3g} each{dropped}. Use a "
                f"threshold of at most {alpha / self.packets:.3g}, or fewer packets."
            )

    def _passed_on(self, alpha: float) -> float:
        """Fraction of a packet's energy that its successors get."""
        return 1 - alpha if self.energy == "conserving" else alpha


def template_capacity(
    material: Material | Optics,
    *,
    packets: int = 4,
    threshold: float = 0.01,
    threshold_on: ThresholdOn | Any = "photon",
    energy: Energy | Any = "conserving",
) -> int:
    """Number of photons that a template has room for: a tree of as many levels as may hold a photon above
    the threshold, and no more than energy 1 could fill.

    **Arguments:** `material`, `packets`, `threshold`, `threshold_on`, `energy`: as for `scatterer_template`.

    **Returns:** the number, before photons are merged.

    **Raises:** `ValueError` as `scatterer_template` does, and for a traced opacity.
    """
    ends = Threshold.checked(packets, threshold, threshold_on, energy)
    return ends.capacity(ends.levels(material))
