"""What can be changed in a viewer? Its controls, described once; each face makes its own widgets of them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import numpy as np
from jaxtyping import Float

from ...scene.labels import LabelTransferFunction
from ...scene.transfer import TransferFunction
from ...scene.volume import Volume
from ..automatic import sampled
from . import editing
from .model import Model
from .state import MAX_STEP, MIN_STEP


MAX_LABEL_OPACITY = 4.0  # factor of a label's extinction
BINS, WIDTH, HEIGHT = 128, 320, 84  # of the plot of the histogram


@dataclass(frozen=True)
class Control:
    """Something to look at ("html") or to change.

    Attributes:
        kind: of widget.
        label: beside it.
        get: what it shows now: a text, a number, True or False, or a color: sRGB, `#rrggbb`.
        set: changes the model; of buttons, called with the text of one.
        limits: of a slider, lowest and highest number and the step between two.
        choices: of a dropdown or buttons, the texts that there are now.
    """

    kind: Literal["html", "buttons", "number", "checkbox", "color", "slider", "log slider", "dropdown"]
    label: str = ""
    get: Callable[[], Any] = str
    set: Callable[[Any], None] = lambda value: None
    limits: tuple[float, float, float] = (0.0, 1.0, 0.001)
    choices: Callable[[], list[str]] = list


def controls_of(model: Model) -> dict[str, list[Control]]:
    """A viewer's controls, by the heading of their group. When one has changed the model, others may have
    something else to show."""
    transfer = model.state.transfer
    if isinstance(transfer, LabelTransferFunction):
        controls = _label_controls(model)
    elif isinstance(transfer, TransferFunction):
        controls = _range_controls(model)
        controls += _point_controls(model) if len(transfer.values) <= editing.MAX_POINTS else []
    else:
        controls = [Control("html", get=lambda: "of another kind, not edited here")]
    return {"transfer function": controls, "march and light": _march_controls(model)}


def _edit(model: Model, change: Callable[..., Any], *arguments: Any) -> None:
    """Replace the transfer function by `change(transfer, *arguments)`."""
    model.apply(lambda state: replace(state, transfer=change(state.transfer, *arguments)))


def _range_controls(model: Model) -> list[Control]:
    """The histogram with the transfer function, and window and level."""
    low, high, bars = histogram(model.scene.volume)

    def shown() -> TransferFunction:
        return cast(TransferFunction, model.state.transfer)

    def now() -> tuple[float, float]:
        return editing.window_level(shown())

    def set_window(window: float) -> None:
        _edit(model, editing.with_window_level, window, now()[1])

    def set_level(level: float) -> None:
        _edit(model, editing.with_window_level, now()[0], level)

    window, level = now()
    width = window or high - low
    windows = min(width / 100, window), 4 * width, width / 100
    levels = level - window / 2 - width, level + window / 2 + width, width / 100
    return [
        Control("html", get=lambda: _plot(low, high, bars, shown(), model.scene.voxel)),
        Control("slider", "window", lambda: now()[0], set_window, windows),
        Control("slider", "level", lambda: now()[1], set_level, levels),
    ]


def histogram(volume: Volume) -> tuple[float, float, Float[np.ndarray, " bins"]]:
    """The least and the greatest value, and log(1 + count) of the bins between them, 1 at most."""
    values = sampled(volume).ravel().astype(np.float64)
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)
    high = high if high > low else low + max(abs(low), 1.0)
    counts = np.log1p(np.histogram(values, BINS, (low, high))[0])
    return low, high, counts / max(counts.max(), 1)


def _plot(low: float, high: float, bars: Any, transfer: TransferFunction, unit_distance: float) -> str:
    """An SVG of the histogram and, as a line, the square root of the opacity, which shows thin materials."""
    values = np.linspace(low, high, 4 * BINS)
    extinction = np.interp(values, np.asarray(transfer.values), np.asarray(transfer.extinction))

    def points(heights: Float[np.ndarray, " n"]) -> str:
        across, down = np.linspace(0, WIDTH, len(heights)), HEIGHT - (HEIGHT - 2) * heights
        return " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(across, down, strict=True))

    line = points(np.sqrt(-np.expm1(-extinction * unit_distance)))
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" width="100%" xmlns="http://www.w3.org/2000/svg">'
        f'<polygon points="0,{HEIGHT} {points(bars)} {WIDTH},{HEIGHT}" fill="#8888" />'
        f'<polyline points="{line}" fill="none" stroke="currentColor" /></svg>'
        f'<div style="display: flex; justify-content: space-between; font-size: 10px">'
        f"<span>{low:.4g}</span><span>{high:.4g}</span></div>"
    )


def _point_controls(model: Model) -> list[Control]:
    """A point, its value, colour and opacity, which is that of a layer as thick as a voxel."""
    voxel, chosen = model.scene.voxel, 0

    def transfer() -> Any:
        return model.state.transfer

    def names() -> list[str]:
        return [f"{number}: {value:.5g}" for number, value in enumerate(transfer().values.tolist(), 1)]

    def choose(name: str) -> None:
        nonlocal chosen
        chosen = names().index(name)

    def edit(change: Callable[..., Any], *more: Any) -> Callable[[Any], None]:
        return lambda value: _edit(model, change, chosen, value, *more)

    def add_or_remove(option: str) -> None:
        nonlocal chosen
        change = editing.with_point_after if option == "add after" else editing.without_point
        _edit(model, change, chosen)
        chosen = min(chosen, len(transfer().values) - 1)

    def value() -> float:
        return float(f"{float(transfer().values[chosen]):.6g}")

    def color() -> str:
        return editing.display_color(np.asarray(transfer().colors)[chosen])

    def opacity() -> float:
        return float(transfer().opacity(voxel)[chosen])

    return [
        Control("dropdown", "point", lambda: names()[chosen], choose, choices=names),
        Control("number", "value", value, edit(editing.with_value)),
        Control("color", "color", color, edit(editing.with_color)),
        Control("slider", "opacity", opacity, edit(editing.with_opacity, voxel)),
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
        _edit(model, LabelTransferFunction.with_visibility, {labels[chosen]: on})

    def set_opacity(opacity: float) -> None:
        _edit(model, LabelTransferFunction.with_opacity, {labels[chosen]: opacity})

    def opacity() -> float:
        return min(get("opacity"), MAX_LABEL_OPACITY)

    return [
        Control("dropdown", "label", lambda: names[chosen], choose, choices=lambda: names),
        Control("html", get=swatch),
        Control("checkbox", "shown", lambda: bool(get("shown")), show),
        Control("slider", "opacity", opacity, set_opacity, (0.0, MAX_LABEL_OPACITY, 0.05)),
    ]


def _march_controls(model: Model) -> list[Control]:
    def switch(name: str) -> Control:
        def turn(on: bool) -> None:
            enabled = model.state.enabled - {name}
            model.change(enabled=enabled | {name} if on else enabled)

        return Control("checkbox", name, lambda: name in model.state.enabled, turn)

    def set_step(step: float) -> None:
        model.change(step=min(max(step, MIN_STEP), MAX_STEP))

    limits = (MIN_STEP, MAX_STEP, MIN_STEP)
    step = Control("log slider", "step (voxels)", lambda: model.state.step, set_step, limits)
    switches = [switch(type(transform).__name__) for transform in model.scene.transforms]
    light = Control("checkbox", "light", lambda: model.state.lit, lambda on: model.change(lit=on))
    return [step, *switches, light] if model.scene.lighting is not None else [step, *switches]
