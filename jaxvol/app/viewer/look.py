"""By which transfer function does a viewer show a volume, as its controls change it?

A look is one kind of transfer function with what can be changed of it: `curve.Curve`, `table.Table`,
`labelled.Labelled`. Looks never change themselves.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import TypeVar

from ...scene.transfer import Transfer


Color = tuple[float, float, float]

T = TypeVar("T")
R = TypeVar("R", bound="Ranged")


class Look(ABC):
    """The interface of all looks."""

    @abstractmethod
    def transfer(self) -> Transfer:
        """The transfer function, as it is."""

    def padded(self) -> Transfer:
        """The same function, of a shape of which there are few, for each of which a program is compiled."""
        return self.transfer()


@dataclass(frozen=True, eq=False)
class Ranged(Look):
    """A look that colours a range of values. `values`: in increasing order."""

    values: tuple[float, ...]

    @property
    @abstractmethod
    def count(self) -> str:
        """How many points it has, in words."""

    @property
    def window(self) -> float:
        """Width of the range of values between the first and the last."""
        return self.values[-1] - self.values[0]

    @property
    def level(self) -> float:
        """Middle of that range."""
        return (self.values[0] + self.values[-1]) / 2

    def over(self: R, window: float, level: float) -> R:
        """The same values, moved and stretched to another range. Two values may have a window of 0, a step; a
        wider one makes a ramp of it.

        **Raises:** `ValueError` for a window that is not positive, or 0 for more than two values, and numbers
        that are not finite."""
        wide_enough = window >= 0 if len(self.values) == 2 else window > 0
        if not (math.isfinite(level) and math.isfinite(window) and wide_enough):
            raise ValueError(f"window must be above 0, and level a number; got {window} and {level}.")
        own = self.window
        parts = [(v - self.level) / own for v in self.values] if own else [-0.5, 0.5]
        return replace(self, values=tuple(level + window * part for part in parts))


def with_item(items: tuple[T, ...], index: int, item: T) -> tuple[T, ...]:
    """With another item at this index."""
    return (*items[:index], item, *items[index + 1 :])
