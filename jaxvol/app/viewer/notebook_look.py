"""Controls of a transfer function in a notebook: of its range, its points, or its labels."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import ipywidgets

from .curve import Curve
from .labelled import DENSEST, Labelled
from .look import Color, Ranged
from .model import Model
from .plot import hex_of


WIDE = {"width": "330px"}


def look_controls(model: Model) -> ipywidgets.VBox:
    """The controls for what the model shows."""
    return (LabelControls if isinstance(model.state.look, Labelled) else RangeControls)(model)


class LabelControls(ipywidgets.VBox):
    """A row for each label: its colour, whether it is shown, and the factor of its extinction."""

    def __init__(self, model: Model):
        super().__init__(layout={**WIDE, "max_height": "300px"})
        self._model, look = model, model.state.look
        assert isinstance(look, Labelled)
        self.children = tuple(self._row(look, label) for label in look.labels)

    def _row(self, look: Labelled, label: int) -> ipywidgets.HBox:
        swatch = ipywidgets.HTML(_swatch(look.color(label)), layout={"width": "20px"})
        box = ipywidgets.Checkbox(
            value=look.shown[label], description=str(label), indent=False, layout={"width": "60px"}
        )
        opacity = ipywidgets.FloatSlider(
            value=min(look.opacities[label], DENSEST),
            min=0,
            max=DENSEST,
            step=0.05,
            readout_format=".2f",
            layout={"width": "220px"},
            tooltip="factor of the extinction",
        )
        box.observe(lambda event: self._change(label, shown=bool(event["new"])), "value")
        opacity.observe(lambda event: self._change(label, opacity=event["new"]), "value")
        own_height = {"flex": "0 0 auto"}  # or all share that of the box
        return ipywidgets.HBox([swatch, box, opacity], layout=own_height)

    def _change(self, label: int, **changes: Any) -> None:
        look = self._model.state.look
        assert isinstance(look, Labelled)
        self._model.change(look=look.changed(label, **changes))


class RangeControls(ipywidgets.VBox):
    """The histogram behind a transfer function, window and level, and a row for each point of a curve.

    - `window`, `level`, `points`: these widgets.
    """

    def __init__(self, model: Model):
        super().__init__()
        self._model, self._quiet = model, False
        look = self._look
        low, high = look.values[0], look.values[-1]
        wide = look.window or model.content.histogram.width
        self.window = _slider("window", look.window, min(wide / 100, look.window), 4 * wide, wide / 100)
        self.level = _slider("level", look.level, low - wide, high + wide, wide / 100)
        for each in (self.window, self.level):
            each.observe(self._ranged, "value")
        self._plot = ipywidgets.HTML(layout=WIDE)
        self.points = ipywidgets.VBox()
        self._rows()
        self.children = (self._plot, self.window, self.level, self.points)

    @property
    def _look(self) -> Ranged:
        look = self._model.state.look
        assert isinstance(look, Ranged)
        return look

    def _ranged(self, change: Any) -> None:
        window, level = self.window.value, self.level.value
        self._edit(lambda look: look.over(window, level))

    def _edit(self, change: Callable[[Any], Ranged]) -> None:
        """Change the look, and let the controls show it; not while they are being made to."""
        if self._quiet:
            return
        before = self._look.values
        self._model.apply(lambda state: replace(state, look=change(state.look)))
        look = self._look
        if len(look.values) != len(before):
            self._rows()
        self._quiet = True
        try:
            self.window.value, self.level.value = look.window, look.level
            self._plot.value = self._model.content.histogram.plot(look)
            if isinstance(look, Curve) and look.editable:
                for value, row in zip(look.values, self.points.children, strict=True):
                    row.children[0].value = _rounded(value)
        finally:
            self._quiet = False

    def _rows(self) -> None:
        """A row of controls for each point."""
        look = self._look
        self._plot.value = self._model.content.histogram.plot(look)
        if isinstance(look, Curve) and look.editable:
            self.points.children = tuple(self._row(look, index) for index in range(len(look)))
        else:
            self.points.children = (ipywidgets.HTML(f"<i>{look.count}, not edited one by one</i>"),)

    def _row(self, curve: Curve, index: int) -> ipywidgets.HBox:
        value = ipywidgets.FloatText(value=_rounded(curve.values[index]), layout={"width": "70px"})
        color = ipywidgets.ColorPicker(
            value=hex_of(curve.display_color(index)), concise=True, layout={"width": "32px"}
        )
        opacity = ipywidgets.FloatSlider(
            value=curve.opacity(index),
            min=0,
            max=1,
            step=0.005,
            readout_format=".3f",
            layout={"width": "150px"},
        )
        more = _button("+", "one more point behind this one")
        less = _button("−", "remove this point")
        value.observe(lambda change: self._edit(lambda c: c.changed(index, value=change["new"])), "value")
        opacity.observe(lambda change: self._edit(lambda c: c.changed(index, opacity=change["new"])), "value")
        color.observe(
            lambda change: self._edit(lambda c: c.changed(index, color=_rgb(change["new"]))), "value"
        )
        more.on_click(lambda _: self._edit(lambda c: c.split(index)))
        less.on_click(lambda _: self._edit(lambda c: c.without(index)))
        return ipywidgets.HBox([value, color, opacity, more, less])


def _slider(name: str, value: float, low: float, high: float, step: float) -> ipywidgets.FloatSlider:
    return ipywidgets.FloatSlider(
        value=value, min=low, max=high, step=step, description=name, readout_format=".4g", layout=WIDE
    )


def _button(text: str, tooltip: str) -> ipywidgets.Button:
    return ipywidgets.Button(description=text, tooltip=tooltip, layout={"width": "30px", "padding": "0"})


def _swatch(color: Color) -> str:
    return f'<div style="background: {hex_of(color)}; width: 14px; height: 14px; margin-top: 7px"></div>'


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def _rgb(text: str) -> Color:
    """Of `#rrggbb`."""
    r, g, b = (int(text[at : at + 2], 16) / 255 for at in (1, 3, 5))
    return r, g, b
