"""The axes x, y, z in another order."""

from collections.abc import Sequence
from typing import TypeAlias, TypeVar


T = TypeVar("T")

Axes: TypeAlias = tuple[int, int, int]
XYZ: Axes = (0, 1, 2)


def permuted(of_axes: Sequence[T], axes: Axes) -> tuple[T, T, T]:
    """What belongs to x, y and z, in the order `axes`."""
    a, b, c = axes
    return of_axes[a], of_axes[b], of_axes[c]


def inverse(axes: Axes) -> Axes:
    """The order that undoes `axes`."""
    return axes.index(0), axes.index(1), axes.index(2)
