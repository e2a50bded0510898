"""Which transfer function do a viewer's control points make, and how are they moved?"""

import math
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from ..._util.srgb import from_srgb, to_srgb
from ...scene.transfer import TransferFunction
from .look import Color, Ranged, with_item


MOST = 16
"""Control points that a viewer edits. All transfer functions of so many points or fewer are padded to it, so
that one program renders them all."""

T = TypeVar("T")


@dataclass(frozen=True)
class Curve(Ranged):
    """Control points of a transfer function.

    - `values`: in increasing order. `colors`: linear RGB. `extinctions`: 1/length.
    - `unit_distance`: world length of the layer to which opacities refer that are shown and set.
    """

    colors: tuple[Color, ...]
    extinctions: tuple[float, ...]
    unit_distance: float

    @classmethod
    def of(cls, transfer: TransferFunction, unit_distance: float) -> "Curve":
        """The control points of a transfer function."""
        colors = tuple((float(r), float(g), float(b)) for r, g, b in np.asarray(transfer.colors))
        values, extinctions = (tuple(map(float, a)) for a in (transfer.values, transfer.extinction))
        return cls(values, colors, extinctions, unit_distance)

    def __len__(self) -> int:
        return len(self.values)

    @property
    def count(self) -> str:
        return f"{len(self)} points"

    @property
    def editable(self) -> bool:
        """Whether there are so few points that each can be set by itself."""
        return len(self) <= MOST

    def opacity(self, index: int) -> float:
        """Of a layer of `unit_distance`, at a point."""
        return -math.expm1(-self.extinctions[index] * self.unit_distance)

    def display_color(self, index: int) -> Color:
        """sRGB, in [0, 1], at a point."""
        r, g, b = (float(c) for c in to_srgb(np.asarray(self.colors[index])))
        return r, g, b

    def changed(
        self,
        index: int,
        *,
        value: float | None = None,
        color: Color | None = None,
        opacity: float | None = None,
    ) -> "Curve":
        """With another value, sRGB color, or opacity of `unit_distance` at a point. A value is moved no
        farther than the points beside it.

        **Raises:** `ValueError` for a point that there is not, and numbers that are no color or opacity."""
        self._check(index)
        given = [n for n in (value, opacity, *(color or ())) if n is not None]
        in_unit = [n for n in (opacity, *(color or ())) if n is not None]
        if not all(map(math.isfinite, given)) or any(n < 0 or n > 1 for n in in_unit):
            raise ValueError(f"color and opacity must be in [0, 1], and value finite; got {given}.")
        curve = self
        if value is not None:
            near = 1e-4 * self.window  # apart, so that no three are equal
            low = self.values[index - 1] + near if index else -math.inf
            high = self.values[index + 1] - near if index + 1 < len(self) else math.inf
            curve = replace(curve, values=with_item(curve.values, index, min(max(value, low), high)))
        if color is not None:
            r, g, b = (float(c) for c in from_srgb(np.asarray(color)))
            curve = replace(curve, colors=with_item(curve.colors, index, (r, g, b)))
        if opacity is not None:
            extinction = -math.log1p(-min(opacity, 1 - 2.0**-24)) / self.unit_distance
            curve = replace(curve, extinctions=with_item(curve.extinctions, index, extinction))
        return curve

    def split(self, index: int) -> "Curve":
        """With one more point half-way between this one and the next, which does not change the function.

        **Raises:** `ValueError` where there is no next point, or as many as there may be, and in a step."""
        self._check(index)
        if index + 1 == len(self) or len(self) >= MOST:
            raise ValueError(f"there is no room for another of {MOST} points behind point {index}.")
        if self.values[index] == self.values[index + 1]:
            raise ValueError(
                f"there is no room for another point in a step: two are at {self.values[index]:g} already."
            )
        middle = [
            (np.asarray(of[index]) + np.asarray(of[index + 1])) / 2
            for of in (self.values, self.colors, self.extinctions)
        ]
        r, g, b = map(float, middle[1])
        return replace(
            self,
            values=_inserted(self.values, index + 1, float(middle[0])),
            colors=_inserted(self.colors, index + 1, (r, g, b)),
            extinctions=_inserted(self.extinctions, index + 1, float(middle[2])),
        )

    def without(self, index: int) -> "Curve":
        """Without a point.

        **Raises:** `ValueError` where only two are left."""
        self._check(index)
        if len(self) <= 2:
            raise ValueError("a transfer function has at least 2 points.")
        left = {
            name: getattr(self, name)[:index] + getattr(self, name)[index + 1 :]
            for name in ("values", "colors", "extinctions")
        }
        return replace(self, **left)

    def transfer(self) -> TransferFunction:
        return TransferFunction(self.values, self.colors, self.extinctions)

    def padded(self) -> TransferFunction:
        """By `MOST` points where there are fewer: beyond the last one it is constant."""
        missing = max(MOST - len(self), 0)
        step = max(self.window or 1.0, 1e-3 * abs(self.values[-1]))
        beyond = tuple(self.values[-1] + step * (k + 1) for k in range(missing))
        return TransferFunction(
            self.values + beyond,
            self.colors + self.colors[-1:] * missing,
            self.extinctions + self.extinctions[-1:] * missing,
        )

    def _check(self, index: int) -> None:
        if not 0 <= index < len(self):
            raise ValueError(f"there is no point {index}; there are {len(self)}.")


def _inserted(items: tuple[T, ...], index: int, item: T) -> tuple[T, ...]:
    return (*items[:index], item, *items[index:])
