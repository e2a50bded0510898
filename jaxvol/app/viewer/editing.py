"""How do a viewer's controls change a transfer function?"""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.colors import to_hex, to_rgb

from ..._util.srgb import from_srgb, to_srgb
from ...scene.labels import LabelTransferFunction
from ...scene.transfer import TransferFunction, extinction_of


MAX_POINTS = 16
"""Control points that a viewer edits. All transfer functions of so many points or fewer are padded to it, so
that one program renders them all."""

POINTS = "values", "colors", "extinction"


def window_level(transfer: TransferFunction) -> tuple[float, float]:
    """Width and middle of the range of values between the first point and the last."""
    low, high = np.asarray(transfer.values, np.float64)[[0, -1]].tolist()
    return high - low, (low + high) / 2


def with_window_level(transfer: TransferFunction, window: float, level: float) -> TransferFunction:
    """The same function, its values moved and stretched to another range. **Raises** `ValueError` for a
    window or a level that leaves no increasing, finite values."""
    old_window, old_level = window_level(transfer)
    relative = (np.asarray(transfer.values, np.float64) - old_level) / (old_window or 1.0)
    return _with_points(transfer, values=level + window * relative)


def has_editable_points(transfer: TransferFunction) -> bool:
    """Whether it has few enough points to be edited one by one."""
    return len(transfer.values) <= MAX_POINTS


def opacities(transfer: TransferFunction, unit_distance: float) -> Float[np.ndarray, " n"]:
    """Of a layer of this thickness, at the points."""
    return -np.expm1(-np.asarray(transfer.extinction, np.float64) * unit_distance)


def display_color(linear: Float[np.ndarray, "3"]) -> str:
    """A linear colour as sRGB, `#rrggbb`."""
    r, g, b = np.clip(to_srgb(linear), 0, 1).tolist()
    return to_hex((r, g, b))


def with_value(transfer: TransferFunction, index: int, value: float) -> TransferFunction:
    """With a point moved, no farther than to its neighbours."""
    values = np.array(transfer.values, np.float64)
    gap = 1e-4 * (values[-1] - values[0])  # so that no three are equal
    low = values[index - 1] + gap if index else -math.inf
    high = values[index + 1] - gap if index + 1 < len(values) else math.inf
    values[index] = np.clip(value, low, high)
    return _with_points(transfer, values=values)


def with_color(transfer: TransferFunction, index: int, color: str) -> TransferFunction:
    """With another colour at a point: sRGB, as matplotlib takes it."""
    linear = jnp.asarray(from_srgb(np.asarray(to_rgb(color))))
    return _with_points(transfer, colors=jnp.asarray(transfer.colors).at[index].set(linear))


def with_opacity(
    transfer: TransferFunction, index: int, opacity: float, unit_distance: float
) -> TransferFunction:
    """With another opacity in [0, 1] at a point, of a layer of this thickness."""
    extinction = extinction_of([opacity], unit_distance)[0]
    return _with_points(transfer, extinction=jnp.asarray(transfer.extinction).at[index].set(extinction))


def with_point_after(transfer: TransferFunction, index: int) -> TransferFunction:
    """With one more point half-way between this one and the next, which does not change the function.

    **Raises:** `ValueError` where there is no next point, or as many as there may be, and in a step."""
    values = np.asarray(transfer.values)
    is_last = index + 1 == len(values)
    if is_last or len(values) >= MAX_POINTS or values[index] == values[index + 1]:
        raise ValueError(f"there is no room for another of {MAX_POINTS} points behind point {index + 1}.")
    points = (np.asarray(getattr(transfer, name)) for name in POINTS)
    between = (np.insert(p, index + 1, (p[index] + p[index + 1]) / 2, axis=0) for p in points)
    return TransferFunction(*between)


def without_point(transfer: TransferFunction, index: int) -> TransferFunction:
    """Without a point, of which at least two remain."""
    if len(transfer.values) <= 2:
        raise ValueError("a transfer function has at least 2 points.")
    points = (np.asarray(getattr(transfer, name)) for name in POINTS)
    return TransferFunction(*(np.delete(p, index, axis=0) for p in points))


def padded(transfer: Any) -> Any:
    """The same function by `MAX_POINTS` points where there are fewer: beyond the last one it is constant."""
    if not isinstance(transfer, TransferFunction) or not has_editable_points(transfer):
        return transfer
    missing = MAX_POINTS - len(transfer.values)
    values, colors, extinction = (np.asarray(getattr(transfer, name)) for name in POINTS)
    step = max(window_level(transfer)[0] or 1.0, 1e-3 * abs(float(values[-1])))
    return TransferFunction(
        np.append(values, values[-1] + step * np.arange(1, missing + 1)),
        np.append(colors, np.repeat(colors[-1:], missing, axis=0), axis=0),
        np.append(extinction, np.repeat(extinction[-1], missing)),
    )


def labels_of(transfer: LabelTransferFunction) -> list[int]:
    """The labels of which something can be seen."""
    return np.flatnonzero(np.asarray(transfer.stacked.extinction).max(axis=1) > 0).tolist()


def label_color(transfer: LabelTransferFunction, label: int) -> str:
    """sRGB of a label where it is densest, `#rrggbb`."""
    densest = np.argmax(np.asarray(transfer.stacked.extinction)[label])
    return display_color(np.asarray(transfer.stacked.colors)[label, densest])


def _with_points(transfer: TransferFunction, **changed: Any) -> TransferFunction:
    return TransferFunction(**{name: getattr(transfer, name) for name in POINTS} | changed)
