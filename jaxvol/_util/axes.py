"""Permutations of the axes x, y, z."""

from collections.abc import Sequence
from typing import TypeAlias, TypeVar


T = TypeVar("T")

Axes: TypeAlias = tuple[int, int, int]
XYZ: Axes = (0, 1, 2)


def permuted(items: Sequence[T], axes: Axes) -> tuple[T, T, T]:
    """Items of x, y and z, reordered by the permutation `axes`."""
    a, b, c = axes
    return items[a], items[b], items[c]


def inverse(axes: Axes) -> Axes:
    """Inverse of the permutation `axes`."""
    return axes.index(0), axes.index(1), axes.index(2)
