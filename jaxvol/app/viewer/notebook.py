"""The viewer in a notebook, with rendercanvas for image and pointer and ipywidgets for the controls."""

import asyncio
import contextlib
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import anywidget
import ipywidgets
import numpy as np
import traitlets
from rendercanvas.anywidget import RenderCanvas

from ...compositing.blending import Compositing
from ...lighting.shading import Lighting
from ...march.march import March
from ...scene.camera import Camera
from ...scene.transfer import Transfer
from ...scene.volume import Volume
from .control import PRESSED, Control
from .controls import FOLDED, controls_of
from .model import JPEG_QUALITY, Model, Stage
from .state import State, ViewerSetup
from .tiles import Pixels


WIDE = {"width": "98%"}  # layout of widgets that fill a line, and of the controls, for JupyterLab's width
PANEL = {"width": "298px", "flex": "0 0 auto", "display": "block", "overflow": "hidden auto"}


class NotebookView(ipywidgets.HBox):
    """Widget of an image with its controls, made by `view`.

    Attributes:
        model: the viewer's model, with `model.state`; `model.wait()` waits until it is drawn.
        canvas: the image, a canvas of rendercanvas.

    Args:
        scene: the constant part of the viewer, made by `view`.
        state: the initial state.
    """

    def __init__(self, scene: ViewerSetup, state: State):
        super().__init__()
        self._loop: asyncio.AbstractEventLoop | None = None
        with contextlib.suppress(RuntimeError):
            self._loop = asyncio.get_running_loop()
        self.canvas = PromptCanvas(size=state.size)
        self.canvas.add_event_handler(self._pointed, "pointer_down", "pointer_move", "pointer_up", "wheel")
        self.canvas.add_event_handler(self._resized, "resize")
        self.canvas.add_event_handler(self._reset, "double_click")
        self._status = ipywidgets.HTML(layout=WIDE)
        self.model = Model(scene, state, self._show, self._set_status, self._deliver)
        self._pointer: tuple[float, float] | None = None
        self._pressed: tuple[float, float] | None = None
        self._widgets: list[tuple[Any, Control]] = []
        self._updating = False
        shown: list[ipywidgets.Widget] = [self._status]
        for heading, controls in controls_of(self.model).items():
            inner = ipywidgets.VBox([*map(self._widget, controls)], layout={"margin": "-8px -12px"})
            selected = None if heading in FOLDED else 0
            shown.append(ipywidgets.Accordion([inner], titles=[heading], selected_index=selected))
        panel = ipywidgets.VBox(shown, layout=PANEL | {"height": f"{max(state.size[1], 640)}px"})
        self.children = (self.canvas, panel)
        self.layout.flex_flow = "row wrap"
        self.model.marked = self._update
        self.model.ask(state)

    @property
    def volume(self) -> Volume:
        """The volume; for labels without a transfer function, that of `labels_shown`."""
        return self.model.scene.volume

    @property
    def camera(self) -> Camera:
        """The camera, with the size of the image."""
        return self.model.scene.camera(self.model.state, self.model.state.size)

    @property
    def transfer(self) -> Transfer:
        """The transfer function."""
        return self.model.state.transfer

    @property
    def march(self) -> March:
        """The march of the fine image."""
        return self.model.scene.march(self.model.state)

    @property
    def lighting(self) -> Lighting | None:
        """The light, or None if it is off."""
        return self.model.scene.light(self.model.state)

    @property
    def compositing(self) -> Compositing[Any]:
        """The compositing."""
        return self.model.scene.compositing(self.model.state)

    def close(self) -> None:
        """Remove the widget and end its thread, which continues when a cell shows another viewer."""
        self.model.close()
        self.canvas._is_closed = True  # its scheduler ends; in rendercanvas 2.7, its `close` calls itself
        ipywidgets.Widget.close(self.canvas)
        super().close()

    def _deliver(self, png: bytes) -> None:
        path = Path(f"jaxvol-{time.time_ns() // 10**6}.png")
        path.write_bytes(png)
        self._set_status(f"saved in the notebook's folder:\n{path}")

    # The drawing thread calls these two; widgets belong to the thread of the event loop.

    def _show(self, pixels: Pixels, stage: Stage) -> None:
        self._in_loop(lambda: self.canvas.show(pixels, JPEG_QUALITY[stage]))

    def _set_status(self, text: str) -> None:
        self._in_loop(lambda: setattr(self._status, "value", text.replace("\n", "<br>")))

    def _in_loop(self, call: Callable[[], Any]) -> None:
        if self._loop is None or self._loop.is_closed():
            call()
        else:
            self._loop.call_soon_threadsafe(call)

    def _pointed(self, event: dict[str, Any]) -> None:
        kind, at = event["event_type"], (float(event["x"]), float(event["y"]))
        if kind == "wheel":
            notches = -float(event["dy"]) / 100  # of a mouse's wheel, as browsers report it
            self.model.change(orbit=self.model.state.orbit.zoomed(1.2**notches))
        elif kind == "pointer_down":
            self._pointer = self._pressed = at
        elif kind == "pointer_up":
            if self._pressed is not None and math.dist(at, self._pressed) < 3:
                ratio, size = self.canvas.get_pixel_ratio(), self.model.state.size
                self.model.pick(at[0] * ratio / size[0], at[1] * ratio / size[1])
            self._pointer = self._pressed = None
        elif self._pointer is not None and event["buttons"]:
            # a move without a button may come late, after the button went down
            scale = self.canvas.get_pixel_ratio() / self.model.state.size[1]
            right, down = ((new - old) * scale for new, old in zip(at, self._pointer, strict=True))
            self._pointer, orbit = at, self.model.state.orbit
            pans = "Shift" in event["modifiers"] or 1 not in event["buttons"]
            self.model.change(orbit=orbit.panned(right, down) if pans else orbit.turned(right, down))

    def _resized(self, event: dict[str, Any]) -> None:
        ratio = float(event["pixel_ratio"])
        self.model.resize(event["width"] * ratio, event["height"] * ratio)

    def _reset(self, _: Any = None) -> None:
        self.model.change(orbit=self.model.first.orbit)

    def _widget(self, control: Control) -> ipywidgets.Widget:
        """The widget of a control."""
        if control.kind == "buttons":
            narrow = {"width": "auto", "min_width": "30px", "padding": "0 4px"}
            buttons = [ipywidgets.Button(description=text, layout=narrow) for text in control.choices]
            for button in buttons:
                button.on_click(lambda pressed: self._change(control.set, pressed.description))
            return ipywidgets.HBox(buttons)
        widget = _widget_of_value(control)
        name = "sent" if control.kind == "pad" else "value"
        widget.observe(lambda event: self._change(control.set, event["new"]), name)
        self._widgets.append((widget, control))
        return widget

    def _change(self, change: Callable[[Any], None], value: Any) -> None:
        """Change the model and update all controls, unless the change is part of an update."""
        if not self._updating:
            change(value)
            self._update()

    def _update(self) -> None:
        self._updating = True
        try:
            for widget, control in self._widgets:
                widget.value = control.get()
        finally:
            self._updating = False


def _widget_of_value(control: Control) -> Any:
    kwargs: dict[str, Any] = {"value": control.get(), "layout": WIDE}
    if control.kind == "pad":
        return Pad(**kwargs)
    kwargs["description"] = control.label
    if control.kind == "checkbox":
        return ipywidgets.Checkbox(indent=False, **kwargs)
    kwargs["style"] = {"description_width": "78px"}
    low, high, step = control.limits
    if control.kind == "dropdown":
        return ipywidgets.Dropdown(options=control.choices, **kwargs)
    if control.kind == "log slider":
        limits = {"min": math.log2(low), "max": math.log2(high), "step": 0.25}
        return ipywidgets.FloatLogSlider(base=2, **limits, **kwargs)
    if control.kind in ("range", "slider"):
        slider = ipywidgets.FloatRangeSlider if control.kind == "range" else ipywidgets.FloatSlider
        return slider(min=low, max=high, step=step, readout_format=".4g", **kwargs)
    return (ipywidgets.FloatText if control.kind == "number" else ipywidgets.ColorPicker)(**kwargs)


class Pad(anywidget.AnyWidget):
    """HTML whose boxes send the positions of presses."""

    _esm = Path(__file__).with_name("pad.js").read_text("utf-8").replace("$pressed", PRESSED)
    value = traitlets.Unicode().tag(sync=True)
    sent = traitlets.Unicode().tag(sync=True)


class PromptCanvas(RenderCanvas):
    """A canvas without delays: events are handled at once, and an image is sent if fewer than two wait for
    the browser; without rendercanvas's scheduler, lossless repeats and 20 ms between moves."""

    _esm = RenderCanvas._esm.replace("setThrottle(20)", "setThrottle(0)")
    pixels: Pixels | None = None

    def __init__(self, **kwargs: Any):
        super().__init__(**kwargs)
        self._bitmap = self.get_bitmap_context()
        self.request_draw(self._set_bitmap)

    def show(self, pixels: Pixels, quality: int) -> None:
        """Send an image as JPEG, in place of unsent ones. Call it in the event loop's thread."""
        self.pixels, self._quality = pixels, quality
        self.request_draw()

    def request_draw(self, draw_function: Callable[[], None] | None = None) -> None:
        super().request_draw(draw_function)
        self._rc_request_draw()

    def submit_event(self, event: dict[str, Any]) -> None:
        super().submit_event(event)
        self._events.flush()

    def _set_bitmap(self) -> None:
        if self.pixels is not None:
            self._bitmap.set_bitmap(np.pad(self.pixels, ((0, 0), (0, 0), (0, 1)), constant_values=255))

    def _rfb_schedule_lossless_draw(self, array: Any, delay: float = 0.3) -> None:
        pass
