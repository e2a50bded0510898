"""How do a viewer's controls change a transfer function?"""

import math
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.colors import to_hex, to_rgb

from ..._util.srgb import from_srgb, to_srgb
from ...scene.labels import LabelTransferFunction
from ...scene.transfer import TransferFunction, extinction_of


MAX_POINTS = 16
"""Control points that a viewer edits."""

POINTS = "values", "colors", "extinction"


def window_level(transfer: TransferFunction) -> tuple[float, float]:
    """Width and middle of the range of values between the first point and the last."""
    low, high = np.asarray(transfer.values, np.float64)[[0, -1]].tolist()
    return high - low, (low + high) / 2


def with_window_level(transfer: TransferFunction, window: float, level: float) -> TransferFunction:
    """The same function, its values moved and stretched to another range."""
    old_window, old_level = window_level(transfer)
    relative = (np.asarray(transfer.values, np.float64) - old_level) / (old_window or 1.0)
    return TransferFunction(level + window * relative, transfer.colors, transfer.extinction)


def rounded(value: float, span: float) -> float:
    """A value to a thousandth of a span, or a few: without digits that nobody set."""
    return round(value, 3 - math.ceil(math.log10(span))) if span > 0 else value


def display_color(linear: Float[np.ndarray, "3"]) -> str:
    """A linear colour as sRGB, `#rrggbb`."""
    r, g, b = np.clip(to_srgb(linear), 0, 1).tolist()
    return to_hex((r, g, b))


def colors_of(transfer: LabelTransferFunction) -> Float[np.ndarray, "labels 3"]:
    """The densest colour of each label, as sRGB."""
    colors, extinction = (np.asarray(getattr(transfer.stacked, name)) for name in POINTS[1:])
    return np.asarray(to_srgb(colors[np.arange(len(colors)), extinction.argmax(axis=1)]))


def with_value(transfer: TransferFunction, index: int, value: float) -> TransferFunction:
    """With a point moved, no farther than to its neighbours."""
    values = np.asarray(transfer.values, np.float64)
    gap = 1e-4 * (values[-1] - values[0])  # so that no three are equal
    low = values[index - 1] + gap if index else -math.inf
    high = values[index + 1] - gap if index + 1 < len(values) else math.inf
    return _with_point(transfer, index, values=np.clip(value, low, high))


def with_color(transfer: TransferFunction, index: int, color: str) -> TransferFunction:
    """With another colour at a point: sRGB, as matplotlib takes it."""
    return _with_point(transfer, index, colors=from_srgb(np.asarray(to_rgb(color))))


def with_opacity(
    transfer: TransferFunction, index: int, opacity: float, unit_distance: float
) -> TransferFunction:
    """With another opacity in [0, 1] at a point, of a layer of this thickness."""
    return _with_point(transfer, index, extinction=extinction_of([opacity], unit_distance)[0])


def with_points_at(transfer: TransferFunction, at: Any) -> TransferFunction:
    """With more points, at these increasing values, which do not change the function."""
    values = np.asarray(transfer.values, np.float64)
    if len(values) + len(at) > MAX_POINTS:
        raise ValueError(f"there is no room for another of {MAX_POINTS} points.")
    colors, extinction = np.asarray(transfer.colors), np.asarray(transfer.extinction)
    index = np.searchsorted(values, at)
    return TransferFunction(
        np.insert(values, index, at),
        np.insert(colors, index, np.stack([np.interp(at, values, each) for each in colors.T], 1), axis=0),
        np.insert(extinction, index, np.interp(at, values, extinction)),
    )


def without_point(transfer: TransferFunction, index: int) -> TransferFunction:
    """Without a point, of which at least two remain."""
    if len(transfer.values) <= 2:
        raise ValueError("a transfer function has at least 2 points.")
    points = (np.asarray(getattr(transfer, name)) for name in POINTS)
    return TransferFunction(*(np.delete(p, index, axis=0) for p in points))


def _with_point(transfer: TransferFunction, index: int, **changed: Any) -> TransferFunction:
    points = {name: np.array(getattr(transfer, name)) for name in POINTS}
    for name, value in changed.items():
        points[name][index] = value
    return TransferFunction(**points)
