"""Controls of a viewer's transfer function: presets, curve and points, or labels."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from string import Template
from typing import Any, cast

import numpy as np
from jaxtyping import Float
from matplotlib.colors import to_hex

from ..._util.checks import Arrayable
from ...scene.labels import LabelTransferFunction
from ...scene.presets import PRESETS, fitted_range, preset
from ...scene.transfer import TransferFunction
from ...scene.volume import Volume
from ..automatic import preset_unit, sampled
from . import editing
from .control import Control, press_of
from .model import Model


MAX_LABEL_OPACITY = 4.0  # largest factor of a label's extinction
BINS, WIDTH, HEIGHT = 128, 320, 110  # of the plot of the histogram
ORIGINAL = "as given"
PLOT = Template(Path(__file__).with_name("curve.html").read_text("utf-8"))


def transfer_controls(model: Model) -> list[Control]:
    """The controls for the kind of the initial transfer function."""
    if isinstance(model.state.transfer, LabelTransferFunction):
        return _label_controls(model)
    if isinstance(model.state.transfer, TransferFunction):
        return _point_controls(model)
    return [Control("pad", get=lambda: "of another kind, not edited here")]


def edit(model: Model, change: Callable[..., Any], *arguments: Any) -> None:
    """Replace the transfer function by `change(transfer, *arguments)`."""
    model.apply(lambda state: replace(state, transfer=change(state.transfer, *arguments)))


def histogram(volume: Volume) -> tuple[float, float, Float[np.ndarray, " bins"]]:
    """Least and greatest value, and log(1 + count) of the bins between them, scaled to at most 1."""
    values = sampled(volume).ravel().astype(np.float64)
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)
    high = high if high > low else low + max(abs(low), 1.0)
    counts = np.log1p(np.histogram(values, BINS, (low, high))[0])
    return low, high, counts / max(counts.max(), 1)


def _plot(low: float, high: float, bars: Any, transfer: TransferFunction, voxel: float, chosen: int) -> str:
    """HTML of a pad: histogram, square root of the opacity (to show thin materials), points as parts."""
    at, extinction = np.asarray(transfer.values, np.float64), np.asarray(transfer.extinction)
    across = WIDTH * np.clip((at - low) / (high - low), 0, 1)
    colors = [editing.display_color(color) for color in np.asarray(transfer.colors)]

    def height(extinction: Arrayable) -> Any:
        return HEIGHT - (HEIGHT - 2) * np.sqrt(-np.expm1(-np.asarray(extinction, np.float64) * voxel))

    def points(down: Float[np.ndarray, " n"]) -> str:
        across = np.linspace(0, WIDTH, len(down))
        return " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(across, down, strict=True))

    dots = list(zip(across, height(extinction), colors, strict=True))
    stops = ", ".join(f"{color} {x / WIDTH:.2%}" for x, _, color in dots)
    circles = "".join(
        f'<circle data-part="{i}" cx="{x:.1f}" cy="{y:.1f}" r="{7 if i == chosen else 5}" fill="{color}"'
        f' stroke="currentColor" style="cursor: move" />'
        for i, (x, y, color) in enumerate(dots)
    )
    line = height(np.interp(np.linspace(low, high, 4 * BINS), at, extinction))
    shown = {"width": WIDTH, "height": HEIGHT, "low": f"{low:.4g}", "high": f"{high:.4g}", "stops": stops}
    shown |= {"bars": points(HEIGHT * (1 - bars)), "line": points(line)}
    return PLOT.substitute(shown, circles=circles if len(at) <= editing.MAX_POINTS else "")


def _point_controls(model: Model) -> list[Control]:
    """Controls of presets, curve, window and level, and value, colour and opacity (in a voxel) of a point."""
    low, high, bars = histogram(model.scene.volume)
    voxel, original, chosen, gesture, note = model.scene.voxel, model.state.transfer, 0, "", ""
    shown = ORIGINAL

    def transfer() -> TransferFunction:
        return cast(TransferFunction, model.state.transfer)

    def put(change: Callable[..., Any], *arguments: Any) -> None:
        nonlocal chosen
        edit(model, change, *arguments)
        chosen = min(chosen, len(transfer().values) - 1)

    def choose_preset(name: str) -> None:
        nonlocal note, shown
        volume, shown = model.scene.volume, name
        clim, warning = (None, None) if name == ORIGINAL else fitted_range(name, sampled(volume))
        note = f'<div style="font-size: 11px">{warning or ""}</div>'
        put(lambda _: original if name == ORIGINAL else preset(name, clim, preset_unit(volume)))

    def press(message: str) -> None:
        nonlocal chosen, gesture
        (number, _, part, twice, x, y), count = press_of(message), len(transfer().values)
        height = min((1 - y) * HEIGHT / (HEIGHT - 2), 1.0)
        value, opacity = editing.rounded(low + x * (high - low), high - low), round(height**2, 3)
        if count > editing.MAX_POINTS:
            return
        if number != gesture:
            gesture, chosen = number, min(max(int(part or 0), 0), count - 1)
            if twice:
                put(editing.without_point, chosen)
            elif not part:
                put(editing.with_points_at, [value])
                values = np.asarray(transfer().values)
                chosen = min(int(np.searchsorted(values, np.float32(value))), len(values) - 1)
                gesture = number if len(values) > count else ""  # without a new point, nothing is dragged
        elif not twice:
            put(editing.with_value, chosen, value)
            put(editing.with_opacity, chosen, opacity, voxel)

    def of_range(label: str, index: int, limits: tuple[float, float, float]) -> Control:
        def get() -> float:
            return float(np.clip(editing.rounded(editing.window_level(transfer())[index], span), *limits[:2]))

        def set_value(value: float) -> None:
            window_level = [*editing.window_level(transfer())]
            window_level[index] = value
            put(editing.with_window_level, *window_level)

        return Control("slider", label, get, set_value, limits)

    # NumPy: JAX would compile a program per number of points, after the one being compiled
    value, color, opacity = (
        lambda: editing.rounded(float(np.asarray(transfer().values)[chosen]), span),
        lambda: editing.display_color(np.asarray(transfer().colors)[chosen]),
        lambda: round(-math.expm1(-float(np.asarray(transfer().extinction)[chosen]) * voxel), 3),
    )
    window, level = editing.window_level(transfer())
    first, last = min(low, level - window / 2), max(high, level + window / 2)
    span = editing.rounded(last - first, last - first)
    unit, middle = 10.0 ** np.ceil(np.log10(span) - 3), editing.rounded((first + last) / 2, span)
    controls = [
        Control("dropdown", "preset", lambda: shown, choose_preset, choices=(ORIGINAL, *PRESETS)),
        Control("pad", "curve", lambda: _plot(low, high, bars, transfer(), voxel, chosen) + note, press),
        of_range("window", 0, (min(unit, window), 2 * span, unit)),
        of_range("level", 1, (middle - span, middle + span, unit)),
        Control("number", "value", value, lambda new: put(editing.with_value, chosen, new)),
        Control("color", "color", color, lambda new: put(editing.with_color, chosen, new)),
        Control("slider", "opacity", opacity, lambda new: put(editing.with_opacity, chosen, new, voxel)),
    ]
    return controls if len(transfer().values) <= editing.MAX_POINTS else controls[:-3]


def _label_controls(model: Model) -> list[Control]:
    """Controls of a label, chosen by name or densest colour: visibility, and factor of its extinction."""
    stacked: Any = model.state.transfer.stacked  # pyright: ignore[reportAttributeAccessIssue]
    extinction = np.asarray(stacked.extinction)
    labels = np.flatnonzero(extinction.max(axis=1) > 0).tolist()
    colors = editing.colors_of(model.state.transfer)[labels]  # pyright: ignore[reportArgumentType]
    ids = dict(enumerate(model.scene.volume.label_ids or ()))
    names, chosen, highest = [str(ids.get(label, label)) for label in labels], 0, MAX_LABEL_OPACITY

    def choose(name: str) -> None:
        nonlocal chosen
        chosen = names.index(name)

    def legend() -> str:
        style = "padding: 0 5px; border-radius: 3px; color: #fff; text-shadow: 0 0 3px #000; cursor: pointer"
        entries = "".join(
            f'<span data-part="{i}" style="{style}; background: {to_hex(tuple(color))}; '
            f'outline: {2 * (i == chosen)}px solid currentColor">{name}</span>'
            for i, (name, color) in enumerate(zip(names, colors, strict=True))
        )
        style = "display: flex; flex-wrap: wrap; gap: 4px; max-height: 130px; overflow: auto; padding: 3px"
        return f'<div data-pad="labels" style="{style}">{entries}</div>'

    def press(message: str) -> None:
        if (part := press_of(message)[2]) in map(str, range(len(names))):
            choose(names[int(part)])

    def get(name: str) -> float:
        return float(np.asarray(getattr(model.state.transfer, name))[labels[chosen]])

    def show(on: bool) -> None:
        edit(model, LabelTransferFunction.with_visibility, {labels[chosen]: on})

    def set_opacity(opacity: float) -> None:
        edit(model, LabelTransferFunction.with_opacity, {labels[chosen]: opacity})

    if not names:
        return [Control("pad", get=lambda: "no label can be seen")]
    return [
        Control("dropdown", "label", lambda: names[chosen], choose, choices=names),
        Control("pad", "labels", legend, press),
        Control("checkbox", "shown", lambda: bool(get("shown")), show),
        Control("slider", "opacity", lambda: min(get("opacity"), highest), set_opacity, (0.0, highest, 0.05)),
    ]
