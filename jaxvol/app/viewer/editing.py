"""Edits of a transfer function by the controls of a viewer."""

import math

import numpy as np
from jaxtyping import Float
from matplotlib.colors import to_hex, to_rgb

from ..._util.checks import Arrayable
from ..._util.srgb import from_srgb, to_srgb
from ...scene.labels import LabelTransferFunction
from ...scene.transfer import TransferFunction, extinction_of


MAX_POINTS = 16  # control points that a viewer edits
POINTS = "values", "colors", "extinction"


def window_level(transfer: TransferFunction) -> tuple[float, float]:
    """Width and middle of the range of values between the first point and the last."""
    low, high = np.asarray(transfer.values, np.float64)[[0, -1]].tolist()
    return high - low, (low + high) / 2


def with_window_level(transfer: TransferFunction, window: float, level: float) -> TransferFunction:
    """The function with its values moved and stretched to another range."""
    old_window, old_level = window_level(transfer)
    relative = (np.asarray(transfer.values, np.float64) - old_level) / (old_window or 1.0)
    return TransferFunction(level + window * relative, transfer.colors, transfer.extinction)


def rounded(value: float, span: float) -> float:
    """A value rounded to a thousandth of a span, or a few."""
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
    """The function with a point moved, at most to its neighbours."""
    values = np.asarray(transfer.values, np.float64)
    gap = 1e-4 * (values[-1] - values[0])  # so that no three are equal
    low = values[index - 1] + gap if index else -math.inf
    high = values[index + 1] - gap if index + 1 < len(values) else math.inf
    return _with_point(transfer, index, values=np.clip(value, low, high))


def with_color(transfer: TransferFunction, index: int, color: str) -> TransferFunction:
    """The function with another colour at a point: sRGB, in a form that matplotlib knows."""
    return _with_point(transfer, index, colors=from_srgb(np.asarray(to_rgb(color))))


def with_opacity(
    transfer: TransferFunction, index: int, opacity: float, unit_distance: float
) -> TransferFunction:
    """The function with another opacity in [0, 1] at a point, for a layer `unit_distance` thick."""
    return _with_point(transfer, index, extinction=extinction_of([opacity], unit_distance)[0])


def with_points_at(transfer: TransferFunction, at: Arrayable) -> TransferFunction:
    """The same function with more points, at increasing values."""
    values = np.asarray(transfer.values, np.float64)
    if len(values) + len(at) > MAX_POINTS:
        raise ValueError(f"there is no room for another of {MAX_POINTS} points.")
    colors, extinction = np.asarray(transfer.colors), np.asarray(transfer.extinction)
    index = np.searchsorted(values, at)
    return TransferFunction(
        np.insert(values, index, at),
        np.insert(colors, index, np.stack([np.interp(at, values, c) for c in colors.T], 1), axis=0),
        np.insert(extinction, index, np.interp(at, values, extinction)),
    )


def without_point(transfer: TransferFunction, index: int) -> TransferFunction:
    """The function without a point. **Raises** `ValueError` if fewer than two remain."""
    if len(transfer.values) <= 2:
        raise ValueError("a transfer function has at least 2 points.")
    points = (np.asarray(getattr(transfer, name)) for name in POINTS)
    return TransferFunction(*(np.delete(p, index, axis=0) for p in points))


def _with_point(transfer: TransferFunction, index: int, **changes: Arrayable) -> TransferFunction:
    points = {name: np.array(getattr(transfer, name)) for name in POINTS}
    for name, value in changes.items():
        points[name][index] = value
    return TransferFunction(**points)
