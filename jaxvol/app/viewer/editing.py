"""How do a viewer's controls change a transfer function?"""

import math
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.colors import to_hex, to_rgb

from ..._util.checks import increasing
from ..._util.srgb import from_srgb, to_srgb
from ...scene.labels import LabelTransferFunction
from ...scene.transfer import TransferFunction, extinction_of
from ...scene.transfer2d import TransferFunction2D


MAX_POINTS = 16
"""Control points that a viewer edits. All transfer functions of so many points or fewer are padded to it, so
that one program renders them all."""

EditableTransfer = TransferFunction | TransferFunction2D | LabelTransferFunction

T = TypeVar("T", TransferFunction, TransferFunction2D)


def window_level(transfer: TransferFunction | TransferFunction2D) -> tuple[float, float]:
    """Width and middle of the range of values between the first point and the last."""
    values = np.asarray(transfer.values, np.float64)
    low, high = float(values[0]), float(values[-1])
    return high - low, (low + high) / 2


def with_window_level(transfer: T, window: float, level: float) -> T:
    """The same function, its values moved and stretched to another range. Two values may have a window of 0,
    a step; a wider one makes a ramp of it.

    **Raises:** `ValueError` for a window that is not positive, or 0 for more than two values, and numbers
    that are not finite."""
    values = np.asarray(transfer.values, np.float64)
    wide_enough = window >= 0 if len(values) == 2 else window > 0
    if not (math.isfinite(level) and math.isfinite(window) and wide_enough):
        raise ValueError(f"window must be above 0, and level a number; got {window} and {level}.")
    old_window, old_level = window_level(transfer)
    relative = (values - old_level) / old_window if old_window else np.array([-0.5, 0.5])
    moved = increasing("values", level + window * relative)
    return eqx.tree_at(lambda t: t.values, transfer, moved)


def has_editable_points(transfer: EditableTransfer) -> bool:
    """Whether its points can be edited one by one: it depends on the value alone, and has few of them."""
    return isinstance(transfer, TransferFunction) and len(transfer.values) <= MAX_POINTS


def opacities(transfer: TransferFunction, unit_distance: float) -> Float[np.ndarray, " n"]:
    """Of a layer of this thickness, at the points."""
    return -np.expm1(-np.asarray(transfer.extinction, np.float64) * unit_distance)


def display_color(linear: Float[np.ndarray, "3"]) -> str:
    """A linear colour as sRGB, `#rrggbb`."""
    r, g, b = np.clip(to_srgb(linear), 0, 1).tolist()
    return to_hex((r, g, b))


def point_color(transfer: TransferFunction, index: int) -> str:
    """sRGB at a point, `#rrggbb`."""
    return display_color(np.asarray(transfer.colors)[index])


def with_value(transfer: TransferFunction, index: int, value: float) -> TransferFunction:
    """With a point moved, no farther than to its neighbours."""
    values = np.array(transfer.values, np.float64)
    gap = 1e-4 * (values[-1] - values[0])  # so that no three are equal
    low = values[index - 1] + gap if index else -math.inf
    high = values[index + 1] - gap if index + 1 < len(values) else math.inf
    values[index] = np.clip(value, low, high)
    return eqx.tree_at(lambda t: t.values, transfer, increasing("values", values))


def with_color(transfer: TransferFunction, index: int, color: str) -> TransferFunction:
    """With another colour at a point: sRGB, as matplotlib takes it."""
    colors = np.array(transfer.colors)
    colors[index] = from_srgb(np.asarray(to_rgb(color)))
    return eqx.tree_at(lambda t: t.colors, transfer, jnp.asarray(colors))


def with_opacity(
    transfer: TransferFunction, index: int, opacity: float, unit_distance: float
) -> TransferFunction:
    """With another opacity at a point, of a layer of this thickness.

    **Raises:** `ValueError` for one outside [0, 1]."""
    extinction = np.array(transfer.extinction)
    extinction[index] = np.asarray(extinction_of([opacity], unit_distance))[0]
    return eqx.tree_at(lambda t: t.extinction, transfer, jnp.asarray(extinction))


def with_point_after(transfer: TransferFunction, index: int) -> TransferFunction:
    """With one more point half-way between this one and the next, which does not change the function.

    **Raises:** `ValueError` where there is no next point, or as many as there may be, and in a step."""
    values = np.asarray(transfer.values)
    if index + 1 == len(values) or len(values) >= MAX_POINTS:
        raise ValueError(f"there is no room for another of {MAX_POINTS} points behind point {index + 1}.")
    if values[index] == values[index + 1]:
        raise ValueError(
            f"there is no room for another point in a step: two are at {values[index]:g} already."
        )
    points = map(np.asarray, _points(transfer))
    between = (np.insert(p, index + 1, (p[index] + p[index + 1]) / 2, axis=0) for p in points)
    return _with_points(transfer, *between)


def without_point(transfer: TransferFunction, index: int) -> TransferFunction:
    """Without a point.

    **Raises:** `ValueError` where only two are left."""
    if len(transfer.values) <= 2:
        raise ValueError("a transfer function has at least 2 points.")
    return _with_points(transfer, *(np.delete(np.asarray(p), index, axis=0) for p in _points(transfer)))


def padded(transfer: Any) -> Any:
    """The same function by `MAX_POINTS` points where there are fewer: beyond the last one it is constant."""
    if type(transfer) is not TransferFunction or not has_editable_points(transfer):
        return transfer
    missing = MAX_POINTS - len(transfer.values)
    values, colors, extinction = map(np.asarray, _points(transfer))
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
    colors, extinction = (
        np.asarray(leaf)[label] for leaf in (transfer.stacked.colors, transfer.stacked.extinction)
    )
    return display_color(colors[np.argmax(extinction)])


def _with_points(transfer: TransferFunction, values: Any, colors: Any, extinction: Any) -> TransferFunction:
    """With other control points, once they are checked; of the same class."""
    checked = TransferFunction(values, colors, extinction)
    return eqx.tree_at(_points, transfer, _points(checked))


def _points(transfer: TransferFunction) -> tuple[Any, Any, Any]:
    return transfer.values, transfer.colors, transfer.extinction
