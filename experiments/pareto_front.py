"""Which points are Pareto-optimal, and which points of other programs lie in front of our front?

A point is an error and a time; less is better in both. Of points that are equal in both, all are kept.
"""

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np


Point: TypeAlias = tuple[float, float]
"""Error and time."""


def front(points: Sequence[Point]) -> list[int]:
    """Numbers of the points of which none other is better in one and as good in both, by growing error.

    **Raises:** `ValueError` for points that are not pairs of numbers, and for NaN.
    """
    at = np.asarray(points, float).reshape(-1, 2) if len(points) == 0 else np.asarray(points, float)
    if at.ndim != 2 or at.shape[1] != 2 or np.isnan(at).any():
        raise ValueError(f"points must be pairs of numbers, (error, time), without NaN; got {points!r}.")
    found: list[int] = []
    for i in np.lexsort((at[:, 1], at[:, 0])):
        if not found or at[i, 1] < at[found[-1], 1] or (at[i] == at[found[-1]]).all():
            found.append(int(i))
    return found


def behind(
    ours: Sequence[Point], theirs: Mapping[str, Point], same: float = 0.0
) -> dict[str, dict[str, float | None]]:
    """The points of other programs that no point of ours is as good as, in error and in time.

    `same`: errors that differ by this part count as equal, since programs that take the same samples differ
    by rounding.

    For each, by what factor we miss it: `time`: that of our fastest point at its error, over its own;
    `error`: that of our best point in its time, over its own. None where we have no such point.
    """
    found: dict[str, dict[str, float | None]] = {}
    for name, (error, seconds) in theirs.items():
        enough = error * (1 + same)
        if any(e <= enough and s <= seconds for e, s in ours):
            continue
        fastest = min((s for e, s in ours if e <= enough), default=None)
        best = min((e for e, s in ours if s <= seconds), default=None)
        found[name] = {
            "time": None if fastest is None else fastest / seconds,
            "error": None if best is None else best / error if error else None,
        }
    return found
