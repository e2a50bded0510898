"""Controls of a transfer function on the page: of its range, its points, or its labels."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import viser

from .curve import Curve
from .labelled import DENSEST, Labelled
from .look import Color, Ranged
from .model import Model


ADD, REMOVE = "add behind", "remove"


def add_look(gui: viser.GuiApi, model: Model) -> None:
    """Add the controls for what the model shows."""
    if isinstance(model.state.look, Labelled):
        _LabelControls(gui, model)
    else:
        _RangeControls(gui, model)


class _LabelControls:
    """A label to choose, its colour, whether it is shown, and the factor of its extinction."""

    def __init__(self, gui: viser.GuiApi, model: Model):
        self.model = model
        labels = tuple(map(str, self._look.labels))
        self.label = gui.add_dropdown("label", labels)
        self.color = gui.add_rgb("color", (0, 0, 0), disabled=True)
        self.shown = gui.add_checkbox("shown", True)
        self.opacity = gui.add_slider("opacity", 0.0, DENSEST, 0.05, 1.0)
        self._refresh()
        answer(self.label, self._refresh)
        answer(self.shown, lambda: self._change(shown=bool(self.shown.value)))
        answer(self.opacity, lambda: self._change(opacity=self.opacity.value))

    @property
    def _look(self) -> Labelled:
        look = self.model.state.look
        assert isinstance(look, Labelled)
        return look

    def _change(self, **changes: Any) -> None:
        changed = self._look.changed(int(self.label.value), **changes)
        self.model.change(look=changed)

    def _refresh(self) -> None:
        """Show the label that is chosen."""
        look, label = self._look, int(self.label.value)
        self.color.value, self.shown.value = _bytes(look.color(label)), look.shown[label]
        self.opacity.value = min(look.opacities[label], DENSEST)


class _RangeControls:
    """The histogram behind a transfer function, window and level, and a point of a curve to choose."""

    def __init__(self, gui: viser.GuiApi, model: Model):
        self.model = model
        look = self._look
        self.plot = gui.add_html(model.content.histogram.plot(look))
        wide = look.window or model.content.histogram.width
        low, high = look.values[0] - wide, look.values[-1] + wide
        least = min(wide / 100, look.window)
        self.window = gui.add_slider("window", least, 4 * wide, wide / 100, look.window)
        self.level = gui.add_slider("level", low, high, wide / 100, look.level)
        for each in (self.window, self.level):
            answer(each, lambda: self._edit(lambda c: c.over(self.window.value, self.level.value)))
        if not isinstance(look, Curve) or not look.editable:
            gui.add_markdown(f"{look.count}, not edited one by one")
            return
        self.point = gui.add_dropdown("point", _names(look))
        self.value = gui.add_number("value", look.values[0])
        self.color = gui.add_rgb("color", _bytes(look.display_color(0)))
        self.opacity = gui.add_slider("opacity", 0.0, 1.0, 0.001, look.opacity(0))
        number = gui.add_button_group("points", (ADD, REMOVE))
        answer(self.point, self._refresh)
        answer(self.value, lambda: self._edit(lambda c: c.changed(self._at, value=self.value.value)))
        answer(self.opacity, lambda: self._edit(lambda c: c.changed(self._at, opacity=self.opacity.value)))
        answer(self.color, lambda: self._edit(lambda c: c.changed(self._at, color=_unit(self.color.value))))
        change = {ADD: Curve.split, REMOVE: Curve.without}
        number.on_click(_async(lambda: self._edit(lambda c: change[number.value](c, self._at))))

    @property
    def _look(self) -> Ranged:
        look = self.model.state.look
        assert isinstance(look, Ranged)
        return look

    @property
    def _at(self) -> int:
        """Index of the point that is chosen."""
        return int(self.point.value.partition(":")[0]) - 1

    def _edit(self, change: Callable[[Any], Ranged]) -> None:
        """Change the look, and let the controls show it."""
        self.model.apply(lambda state: replace(state, look=change(state.look)))
        look = self._look
        self.plot.content = self.model.content.histogram.plot(look)
        self.window.value, self.level.value = look.window, look.level
        if isinstance(look, Curve) and look.editable:
            index = min(self._at, len(look) - 1)
            self.point.options = _names(look)
            self.point.value = _names(look)[index]
            self._refresh()

    def _refresh(self) -> None:
        """Show the point that is chosen."""
        look, index = self._look, self._at
        assert isinstance(look, Curve)
        self.value.value, self.color.value = look.values[index], _bytes(look.display_color(index))
        self.opacity.value = look.opacity(index)


def answer(control: Any, call: Callable[[], Any]) -> None:
    """Call when a control was changed in the browser; not when this program changed it."""

    @control.on_update
    async def _(event: Any) -> None:
        if event.client is not None:
            call()


def _async(call: Callable[[], Any]) -> Callable[[Any], Any]:
    # viser runs coroutines in its loop, one after the other, and plain functions in any order
    async def called(_: Any) -> None:
        call()

    return called


def _names(curve: Curve) -> tuple[str, ...]:
    """Of its points."""
    return tuple(f"{index + 1}: {value:.5g}" for index, value in enumerate(curve.values))


def _bytes(color: Color) -> tuple[int, int, int]:
    r, g, b = (round(255 * channel) for channel in color)
    return r, g, b


def _unit(color: tuple[int, int, int]) -> Color:
    r, g, b = (channel / 255 for channel in color)
    return r, g, b
