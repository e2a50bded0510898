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
class Html:
    """Something to look at. `get`: its text now."""

    get: Callable[[], str]


@dataclass(frozen=True)
class Buttons:
    """Several in a row. `press`: called with the text of one."""

    label: str
    options: tuple[str, ...]
    press: Callable[[str], None]


@dataclass(frozen=True)
class Field:
    """A number, True or False, or a color: sRGB, `#rrggbb`. `get`: what it is now. `set`: changes it."""

    kind: Literal["number", "checkbox", "color"]
    label: str
    get: Callable[[], Any]
    set: Callable[[Any], None]


@dataclass(frozen=True)
class Slider:
    """A number from `low` to `high`, in steps; `logarithmic` where the face has such sliders."""

    label: str
    get: Callable[[], float]
    set: Callable[[float], None]
    low: float
    high: float
    step: float
    logarithmic: bool = False


@dataclass(frozen=True)
class Dropdown:
    """One of some texts. `options`: those that there are now."""

    label: str
    get: Callable[[], str]
    set: Callable[[str], None]
    options: Callable[[], list[str]]


Input = Field | Slider | Dropdown

Control = Html | Buttons | Input


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
            return [Html(lambda: "a function of value and gradient, which is not edited here")]
        if editing.has_editable_points(self.transfer):
            return [*self._range(), *self._point()]
        return self._range()

    @property
    def transfer(self) -> Any:
        return self.model.state.transfer

    def edit(self, change: Callable[..., Any], *arguments: Any) -> None:
        """Replace the transfer function by `change(transfer, *arguments)`."""
        self.model.apply(lambda state: replace(state, transfer=change(state.transfer, *arguments)))

    def _choice(self, label: str, options: Callable[[], list[str]]) -> Dropdown:
        def choose(option: str) -> None:
            self.chosen = options().index(option)

        return Dropdown(label, lambda: options()[self.chosen], choose, options)

    def _range(self) -> list[Control]:
        """The histogram behind the transfer function, and window and level."""
        histogram, voxel = self.model.scene.histogram, self.model.scene.voxel
        window, level = editing.window_level(self.transfer)
        width = window or histogram.high - histogram.low

        def get(index: int) -> float:
            return editing.window_level(self.transfer)[index]

        return [
            Html(lambda: histogram.plot(self.transfer, voxel)),
            Slider(
                "window",
                lambda: get(0),
                lambda value: self.edit(editing.with_window_level, value, get(1)),
                low=min(width / 100, window),
                high=4 * width,
                step=width / 100,
            ),
            Slider(
                "level",
                lambda: get(1),
                lambda value: self.edit(editing.with_window_level, get(0), value),
                low=level - window / 2 - width,
                high=level + window / 2 + width,
                step=width / 100,
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
            Field(
                "number",
                "value",
                lambda: value(self.chosen),
                lambda value: self.edit(editing.with_value, self.chosen, value),
            ),
            Field(
                "color",
                "color",
                lambda: editing.display_color(np.asarray(self.transfer.colors)[self.chosen]),
                lambda color: self.edit(editing.with_color, self.chosen, color),
            ),
            Slider(
                "opacity",
                lambda: float(editing.opacities(self.transfer, voxel)[self.chosen]),
                lambda opacity: self.edit(editing.with_opacity, self.chosen, opacity, voxel),
                low=0.0,
                high=1.0,
                step=0.001,
            ),
            Buttons("points", ("add behind", "remove"), add_or_remove),
        ]

    def _label(self) -> list[Control]:
        """A label, its colour, whether it is shown, and the factor of its extinction."""
        labels = editing.labels_of(self.transfer)

        def swatch() -> str:
            color = editing.label_color(self.transfer, labels[self.chosen])
            return f'<div style="background: {color}; height: 14px"></div>'

        def change(function: Callable[..., Any]) -> Callable[[Any], None]:
            return lambda value: self.edit(function, {labels[self.chosen]: value})

        return [
            self._choice("label", lambda: [str(label) for label in labels]),
            Html(swatch),
            Field(
                "checkbox",
                "shown",
                lambda: bool(np.asarray(self.transfer.shown)[labels[self.chosen]]),
                change(LabelTransferFunction.with_visibility),
            ),
            Slider(
                "opacity",
                lambda: min(float(np.asarray(self.transfer.opacity)[labels[self.chosen]]), MAX_LABEL_OPACITY),
                change(LabelTransferFunction.with_opacity),
                low=0.0,
                high=MAX_LABEL_OPACITY,
                step=0.05,
            ),
        ]


def _march_controls(model: Model) -> list[Control]:
    """Step, transforms, light."""

    def switch(name: str) -> Field:
        def turn(on: bool) -> None:
            enabled = model.state.enabled - {name}
            model.change(enabled=enabled | {name} if on else enabled)

        return Field("checkbox", name, lambda: name in model.state.enabled, turn)

    step = Slider(
        "step (voxels)",
        lambda: model.state.step,
        lambda step: model.change(step=min(max(step, MIN_STEP), MAX_STEP)),
        low=MIN_STEP,
        high=MAX_STEP,
        step=MIN_STEP,
        logarithmic=True,
    )
    switches = [switch(type(transform).__name__) for transform in model.scene.transforms]
    if model.scene.lighting is not None:
        switches.append(Field("checkbox", "light", lambda: model.state.lit, lambda on: model.change(lit=on)))
    return [step, *switches]
