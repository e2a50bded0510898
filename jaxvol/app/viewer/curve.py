"""The controls of a viewer's transfer function: its curve over the histogram, points, presets and colormaps, or
its labels."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import numpy as np
from jaxtyping import Float

from ...scene.labels import LabelTransferFunction
from ...scene.presets import PRESETS, preset
from ...scene.transfer import TransferFunction
from ...scene.volume import Volume
from ..automatic import automatic_transfer, sampled
from . import editing
from .control import Control, Press
from .model import Model


MAX_LABEL_OPACITY = 4.0  # factor of a label's extinction
BINS, WIDTH, HEIGHT = 128, 320, 110  # of the plot of the histogram
GIVEN, AUTOMATIC = "as given", "automatic"
COLORMAPS = (
    *("gray", "viridis", "inferno", "magma", "plasma", "cividis", "turbo", "jet", "hot", "bone", "copper"),
    *("coolwarm", "RdBu_r", "Spectral_r", "rainbow"),
)


def transfer_controls(model: Model) -> list[Control]:
    """The controls of the transfer function that is shown at first, of its kind."""
    transfer = model.state.transfer
    if isinstance(transfer, LabelTransferFunction):
        return _label_controls(model)
    if isinstance(transfer, TransferFunction):
        return _point_controls(model)
    return [Control("html", get=lambda: "of another kind, not edited here")]


def edit(model: Model, change: Callable[..., Any], *arguments: Any) -> None:
    """Replace the transfer function by `change(transfer, *arguments)`."""
    model.apply(lambda state: replace(state, transfer=change(state.transfer, *arguments)))


def histogram(volume: Volume) -> tuple[float, float, Float[np.ndarray, " bins"]]:
    """The least and the greatest value, and log(1 + count) of the bins between them, 1 at most."""
    values = sampled(volume).ravel().astype(np.float64)
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)
    high = high if high > low else low + max(abs(low), 1.0)
    counts = np.log1p(np.histogram(values, BINS, (low, high))[0])
    return low, high, counts / max(counts.max(), 1)


def _plot(low: float, high: float, bars: Any, transfer: TransferFunction, voxel: float, chosen: int) -> str:
    """A pad with the histogram, and as a line the square root of the opacity, which shows thin materials; its
    points, in their colours, are parts of the pad."""
    values = np.linspace(low, high, 4 * BINS)
    at, extinction = np.asarray(transfer.values, np.float64), np.asarray(transfer.extinction)
    colors = [editing.display_color(color) for color in np.asarray(transfer.colors)]
    few = len(at) <= editing.MAX_POINTS

    def heights(extinction: Any) -> Any:
        return HEIGHT - (HEIGHT - 2) * np.sqrt(-np.expm1(-np.asarray(extinction, np.float64) * voxel))

    def points(down: Float[np.ndarray, " n"]) -> str:
        return " ".join(
            f"{x:.1f},{y:.1f}" for x, y in zip(np.linspace(0, WIDTH, len(down)), down, strict=True)
        )

    across = np.clip((at - low) / (high - low), 0, 1)
    stops = "".join(
        f'<stop offset="{x:.4f}" stop-color="{c}" />' for x, c in zip(across, colors, strict=True)
    )
    circles = "".join(
        f'<circle data-part="{i}" cx="{WIDTH * x:.1f}" cy="{y:.1f}" r="{7 if i == chosen else 5}" fill="{color}"'
        f' stroke="currentColor" stroke-width="{2 if i == chosen else 1}" style="cursor: move" />'
        for i, (x, y, color) in enumerate(zip(across, heights(extinction), colors, strict=True))
    )
    return (
        f'<svg data-pad="curve" viewBox="0 0 {WIDTH} {HEIGHT}" width="100%" xmlns="http://www.w3.org/2000/svg"'
        f' style="overflow: visible; touch-action: none; cursor: crosshair; display: block">'
        f'<linearGradient id="jaxvol-colors">{stops}</linearGradient>'
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#8882" />'
        f'<polygon points="0,{HEIGHT} {points(HEIGHT - (HEIGHT - 2) * bars)} {WIDTH},{HEIGHT}" fill="#8888" />'
        f'<rect y="{HEIGHT}" width="{WIDTH}" height="8" fill="url(#jaxvol-colors)" />'
        f'<polyline points="{points(heights(np.interp(values, at, extinction)))}" fill="none"'
        f' stroke="currentColor" />{circles if few else ""}</svg>'
        f'<div style="display: flex; justify-content: space-between; font-size: 10px; margin-top: 8px">'
        f"<span>{low:.4g}</span><span>{high:.4g}</span></div>"
    )


def _point_controls(model: Model) -> list[Control]:
    """Presets and colormaps, the curve, window and level, and the chosen point: its value, colour and opacity,
    which is that of a layer as thick as a voxel."""
    low, high, bars = histogram(model.scene.volume)
    voxel, given, chosen, gesture, dragging = model.scene.voxel, model.state.transfer, 0, "", False
    names = {"preset": GIVEN, "colors": GIVEN}

    def transfer() -> TransferFunction:
        return cast(TransferFunction, model.state.transfer)

    def put(new: Any) -> None:
        nonlocal chosen
        edit(model, lambda old: new(old) if callable(new) else new)
        chosen = min(chosen, len(transfer().values) - 1)

    def choose_preset(name: str) -> None:
        names["preset"], names["colors"] = name, GIVEN
        made = {GIVEN: lambda _: given, AUTOMATIC: lambda _: automatic_transfer(model.scene.volume)}
        put(made.get(name, lambda _: preset(name, unit_distance=voxel)))

    def choose_colors(name: str) -> None:
        names["colors"] = name
        if name != GIVEN:
            put(lambda old: editing.recolored(old, name))

    def now() -> tuple[float, float]:
        return editing.window_level(transfer())

    window, level = now()
    first, last = min(low, level - window / 2), max(high, level + window / 2)
    span = last - first
    unit = 10.0 ** (np.ceil(np.log10(span)) - 3)

    def shown(number: float, limits: tuple[float, float, float]) -> float:
        return min(max(editing.rounded(number, span), limits[0]), limits[1])

    windows = min(unit, editing.rounded(window, span)), editing.rounded(4 * span, span), unit
    levels = editing.rounded(first - span, span), editing.rounded(last + span, span), unit
    range_controls = [
        Control(
            "slider",
            "window",
            lambda: shown(now()[0], windows),
            lambda to: edit(model, editing.with_window_level, to, now()[1]),
            windows,
        ),
        Control(
            "slider",
            "level",
            lambda: shown(now()[1], levels),
            lambda to: edit(model, editing.with_window_level, now()[0], to),
            levels,
        ),
    ]

    def press(pressed: Press) -> None:
        nonlocal chosen, gesture, dragging
        height = min((1 - pressed.y) * HEIGHT / (HEIGHT - 2), 1.0)
        value, opacity = editing.rounded(low + pressed.x * (high - low), high - low), round(height**2, 3)
        if pressed.gesture != gesture:
            gesture, count, dragging = pressed.gesture, len(transfer().values), True
            if pressed.part:
                chosen = min(int(pressed.part), count - 1)
            else:
                edit(model, editing.with_point_at, value)
                chosen = int(np.searchsorted(np.asarray(transfer().values), np.float32(value)))
                dragging = len(transfer().values) > count
            if pressed.twice:
                dragging = False
                put(lambda old: editing.without_point(old, chosen))
        if dragging:
            edit(
                model,
                lambda t: editing.with_opacity(editing.with_value(t, chosen, value), chosen, opacity, voxel),
            )

    def point_names() -> list[str]:
        return [f"{number}: {value:.4g}" for number, value in enumerate(transfer().values.tolist(), 1)]

    def choose(name: str) -> None:
        nonlocal chosen
        chosen = point_names().index(name)

    def change(how: Callable[..., Any], *more: Any) -> Callable[[Any], None]:
        return lambda value: edit(model, how, chosen, value, *more)

    def add_or_remove(option: str) -> None:
        how = editing.with_point_after if option == "add after" else editing.without_point
        put(lambda old: how(old, chosen))

    def color() -> str:
        return editing.display_color(np.asarray(transfer().colors)[chosen])

    def dropdown(name: str, choose: Callable[[str], None], choices: list[str]) -> Control:
        return Control("dropdown", name, lambda: names[name], choose, choices=lambda: choices)

    controls = [
        dropdown("preset", choose_preset, [GIVEN, AUTOMATIC, *PRESETS]),
        dropdown("colors", choose_colors, [GIVEN, *COLORMAPS]),
        Control("pad", get=lambda: _plot(low, high, bars, transfer(), voxel, chosen), set=press),
        *range_controls,
    ]
    if len(transfer().values) > editing.MAX_POINTS:
        return controls
    return [
        *controls,
        Control("dropdown", "point", lambda: point_names()[chosen], choose, choices=point_names),
        Control(
            "number",
            "value",
            lambda: float(f"{float(transfer().values[chosen]):.4g}"),
            change(editing.with_value),
        ),
        Control("color", "color", color, change(editing.with_color)),
        Control(
            "slider",
            "opacity",
            lambda: round(float(transfer().opacity(voxel)[chosen]), 3),
            change(editing.with_opacity, voxel),
        ),
        Control("buttons", "points", set=add_or_remove, choices=lambda: ["add after", "remove"]),
    ]


def _label_controls(model: Model) -> list[Control]:
    """A label that can be seen, its densest colour, whether it is shown, and the factor of its extinction."""
    stacked: Any = model.state.transfer.stacked  # pyright: ignore[reportAttributeAccessIssue]
    extinction = np.asarray(stacked.extinction)
    labels = np.flatnonzero(extinction.max(axis=1) > 0).tolist()
    colors = np.asarray(stacked.colors)[labels, extinction[labels].argmax(axis=1)]
    names, chosen = [str(label) for label in labels], 0

    def choose(name: str) -> None:
        nonlocal chosen
        chosen = names.index(name)

    def swatch() -> str:
        return f'<div style="background: {editing.display_color(colors[chosen])}; height: 14px"></div>'

    def get(name: str) -> float:
        return float(np.asarray(getattr(model.state.transfer, name))[labels[chosen]])

    def show(on: bool) -> None:
        edit(model, LabelTransferFunction.with_visibility, {labels[chosen]: on})

    def set_opacity(opacity: float) -> None:
        edit(model, LabelTransferFunction.with_opacity, {labels[chosen]: opacity})

    def opacity() -> float:
        return min(get("opacity"), MAX_LABEL_OPACITY)

    return [
        Control("dropdown", "label", lambda: names[chosen], choose, choices=lambda: names),
        Control("html", get=swatch),
        Control("checkbox", "shown", lambda: bool(get("shown")), show),
        Control("slider", "opacity", opacity, set_opacity, (0.0, MAX_LABEL_OPACITY, 0.05)),
    ]
