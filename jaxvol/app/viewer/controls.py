"""What can be changed in a viewer? Its controls, described once; each face makes its own widgets of them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ...scene.labels import LabelTransferFunction
from ...scene.transfer2d import TransferFunction2D
from . import editing
from .model import Model
from .state import MAX_STEP, MIN_STEP


MAX_LABEL_OPACITY = 4.0
"""Factor of a label's extinction."""


@dataclass(frozen=True)
class Control:
    """Something to look at ("html") or to change.

    - `get`: what it shows now: a text, a number, True or False, or a color: sRGB, `#rrggbb`.
    - `set`: changes the model; of buttons, called with the text of one.
    - `limits`: of a slider, lowest and highest number and the step between two.
    - `choices`: of a dropdown or buttons, the texts that there are now.
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
    return {
        "transfer function": _TransferControls(model).controls(),
        "march and light": _march_controls(model),
    }


class _TransferControls:
    """The controls of a model's transfer function; `chosen`: the index of the point or label that they
    change."""

    def __init__(self, model: Model):
        self.model, self.chosen = model, 0

    def controls(self) -> list[Control]:
        if isinstance(self.transfer, LabelTransferFunction):
            return self._label()
        if isinstance(self.transfer, TransferFunction2D):
            return [Control("html", get=lambda: "a function of value and gradient, not edited here")]
        if editing.has_editable_points(self.transfer):
            return [*self._range(), *self._point()]
        return self._range()

    @property
    def transfer(self) -> Any:
        return self.model.state.transfer

    def edit(self, change: Callable[..., Any], *arguments: Any) -> None:
        """Replace the transfer function by `change(transfer, *arguments)`."""
        self.model.apply(lambda state: replace(state, transfer=change(state.transfer, *arguments)))

    def _choice(self, label: str, choices: Callable[[], list[str]]) -> Control:
        def choose(choice: str) -> None:
            self.chosen = choices().index(choice)

        return Control("dropdown", label, lambda: choices()[self.chosen], choose, choices=choices)

    def _range(self) -> list[Control]:
        """The histogram behind the transfer function, and window and level."""
        histogram, voxel = self.model.scene.histogram, self.model.scene.voxel
        window, level = editing.window_level(self.transfer)
        width = window or histogram.high - histogram.low

        def get(index: int) -> float:
            return editing.window_level(self.transfer)[index]

        return [
            Control("html", get=lambda: histogram.plot(self.transfer, voxel)),
            Control(
                "slider",
                "window",
                lambda: get(0),
                lambda value: self.edit(editing.with_window_level, value, get(1)),
                limits=(min(width / 100, window), 4 * width, width / 100),
            ),
            Control(
                "slider",
                "level",
                lambda: get(1),
                lambda value: self.edit(editing.with_window_level, get(0), value),
                limits=(level - window / 2 - width, level + window / 2 + width, width / 100),
            ),
        ]

    def _point(self) -> list[Control]:
        """A point, its value, colour and opacity, which is that of a layer as thick as a voxel."""
        voxel = self.model.scene.voxel

        def value(index: int) -> float:
            return float(f"{float(np.asarray(self.transfer.values)[index]):.6g}")

        def names() -> list[str]:
            return [f"{index + 1}: {value(index):.5g}" for index in range(len(self.transfer.values))]

        def add_or_remove(option: str) -> None:
            change = editing.with_point_after if option == "add behind" else editing.without_point
            self.edit(change, self.chosen)
            self.chosen = min(self.chosen, len(self.transfer.values) - 1)

        return [
            self._choice("point", names),
            Control(
                "number",
                "value",
                lambda: value(self.chosen),
                lambda value: self.edit(editing.with_value, self.chosen, value),
            ),
            Control(
                "color",
                "color",
                lambda: editing.display_color(np.asarray(self.transfer.colors)[self.chosen]),
                lambda color: self.edit(editing.with_color, self.chosen, color),
            ),
            Control(
                "slider",
                "opacity",
                lambda: float(editing.opacities(self.transfer, voxel)[self.chosen]),
                lambda opacity: self.edit(editing.with_opacity, self.chosen, opacity, voxel),
            ),
            Control("buttons", "points", set=add_or_remove, choices=lambda: ["add behind", "remove"]),
        ]

    def _label(self) -> list[Control]:
        """A label, its colour, whether it is shown, and the factor of its extinction."""
        labels = editing.labels_of(self.transfer)

        def swatch() -> str:
            color = editing.label_color(self.transfer, labels[self.chosen])
            return f'<div style="background: {color}; height: 14px"></div>'

        def get(name: str) -> float:
            return float(np.asarray(getattr(self.transfer, name))[labels[self.chosen]])

        def change(function: Callable[..., Any]) -> Callable[[Any], None]:
            return lambda value: self.edit(function, {labels[self.chosen]: value})

        return [
            self._choice("label", lambda: [str(label) for label in labels]),
            Control("html", get=swatch),
            Control(
                "checkbox",
                "shown",
                lambda: bool(get("shown")),
                change(LabelTransferFunction.with_visibility),
            ),
            Control(
                "slider",
                "opacity",
                lambda: min(get("opacity"), MAX_LABEL_OPACITY),
                change(LabelTransferFunction.with_opacity),
                limits=(0.0, MAX_LABEL_OPACITY, 0.05),
            ),
        ]


def _march_controls(model: Model) -> list[Control]:
    """Step, transforms, light."""

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
    if model.scene.lighting is not None:
        light = Control("checkbox", "light", lambda: model.state.lit, lambda on: model.change(lit=on))
        switches.append(light)
    return [step, *switches]
