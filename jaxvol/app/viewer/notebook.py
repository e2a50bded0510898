"""A viewer in a notebook: rendercanvas shows the image and takes the pointer, ipywidgets are the controls."""

import asyncio
import contextlib
import math
from collections.abc import Callable
from typing import Any

import ipywidgets
import numpy as np
from rendercanvas.anywidget import RenderCanvas

from ...lighting.shading import Lighting
from ...march.march import March
from ...scene.camera import Camera
from ...scene.transfer import Transfer
from ...scene.volume import Volume
from .controls import Control, controls_of
from .model import JPEG_QUALITY, Model, Stage
from .state import Scene, State
from .tiles import Pixels


ZOOM_PER_NOTCH = 1.2
"""How much nearer one notch of a mouse wheel brings the camera, which browsers report as 100."""

WIDE, LABEL = {"width": "330px"}, {"description_width": "90px"}
"""Layout and style of what stands in a line of its own."""


class NotebookView(ipywidgets.HBox):
    """What `view` returns: an image with its controls, a widget of ipywidgets.

    - `volume`, `camera`, `transfer`, `march`, `lighting`: as they are now, to be passed to `render`.
    - `model`: the viewer's state, `model.state`; `model.wait()` waits until it is drawn.
    - `canvas`: the image, a canvas of rendercanvas.
    - `close()` ends the viewer's thread. A cell that shows another viewer does not.

    **Arguments:** `scene`, `state`: what is looked at, and how at first. `view` makes them.
    """

    def __init__(self, scene: Scene, state: State):
        super().__init__()
        self._loop: asyncio.AbstractEventLoop | None = None
        with contextlib.suppress(RuntimeError):
            self._loop = asyncio.get_running_loop()
        self.canvas = PromptCanvas(size=state.size)
        self.canvas.add_event_handler(self._pointed, "pointer_down", "pointer_move", "pointer_up", "wheel")
        self.canvas.add_event_handler(self._resized, "resize")
        self.canvas.add_event_handler(self._reset, "double_click")
        self._status = ipywidgets.HTML(layout=WIDE)
        self.model = Model(scene, state, self._show, self._tell)
        self._first = state
        self._pointer: tuple[float, float] | None = None
        self._widgets: list[tuple[Any, Control]] = []
        self._updating = False
        self.children = (self.canvas, ipywidgets.VBox(self._controls(), layout={"margin": "0 0 0 12px"}))
        self.model.ask(state)

    @property
    def volume(self) -> Volume:
        """What is looked at. Of voxels that are labels, shown without a transfer function, it is a smooth
        volume with them."""
        return self.model.scene.volume

    @property
    def camera(self) -> Camera:
        """The camera, with the size of the image."""
        return self.model.state.orbit.camera(self.model.state.size)

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
        """The light, None if it is off."""
        return self.model.scene.light(self.model.state)

    def close(self) -> None:
        """Remove the widget, and end its thread."""
        self.model.close()
        self.canvas._is_closed = True  # its scheduler ends; in rendercanvas 2.7, its `close` calls itself
        ipywidgets.Widget.close(self.canvas)
        super().close()

    # The thread that draws calls these two; widgets belong to the thread of the event loop.

    def _show(self, pixels: Pixels, stage: Stage) -> None:
        self._in_loop(lambda: self.canvas.show(pixels, JPEG_QUALITY[stage]))

    def _tell(self, text: str) -> None:
        self._in_loop(lambda: setattr(self._status, "value", text.replace("\n", "<br>")))

    def _in_loop(self, call: Callable[[], Any]) -> None:
        if self._loop is None or self._loop.is_closed():
            call()
        else:
            self._loop.call_soon_threadsafe(call)

    def _pointed(self, event: dict[str, Any]) -> None:
        kind, at = event["event_type"], (float(event["x"]), float(event["y"]))
        if kind == "wheel":
            factor = ZOOM_PER_NOTCH ** (-float(event["dy"]) / 100)
            self.model.change(orbit=self.model.state.orbit.zoomed(factor))
        elif kind == "pointer_down":
            self._pointer = at
        elif kind == "pointer_up":
            self._pointer = None
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
        self.model.change(orbit=self._first.orbit)

    def _controls(self) -> list[ipywidgets.Widget]:
        shown: list[ipywidgets.Widget] = [self._status]
        for heading, controls in controls_of(self.model).items():
            shown += [ipywidgets.HTML(f"<b>{heading}</b>"), *map(self._widget, controls)]
        return shown

    def _widget(self, control: Control) -> ipywidgets.Widget:
        """A widget that shows what a control describes, and changes the model."""
        if control.kind == "buttons":
            buttons = [ipywidgets.Button(description=text) for text in control.choices()]
            for button in buttons:
                button.on_click(lambda pressed: self._change(control.set, pressed.description))
            return ipywidgets.HBox(buttons)
        widget = _widget_of_value(control)
        if control.kind != "html":
            widget.observe(lambda event: self._change(control.set, event["new"]), "value")
        self._widgets.append((widget, control))
        return widget

    def _change(self, change: Callable[[Any], None], value: Any) -> None:
        """Change the model, and let all controls show it; not while they are being made to."""
        if self._updating:
            return
        change(value)
        self._updating = True
        try:
            for widget, control in self._widgets:
                if control.kind == "dropdown":
                    widget.options = control.choices()
                widget.value = control.get()
        finally:
            self._updating = False


def _widget_of_value(control: Control) -> Any:
    how: dict[str, Any] = {"value": control.get(), "layout": WIDE}
    if control.kind == "html":
        return ipywidgets.HTML(**how)
    how["description"] = control.label
    if control.kind == "checkbox":
        return ipywidgets.Checkbox(indent=False, **how)
    how["style"] = LABEL
    low, high, step = control.limits
    if control.kind == "dropdown":
        return ipywidgets.Dropdown(options=control.choices(), **how)
    if control.kind == "log slider":
        return ipywidgets.FloatLogSlider(base=2, min=math.log2(low), max=math.log2(high), step=0.25, **how)
    if control.kind == "slider":
        return ipywidgets.FloatSlider(min=low, max=high, step=step, readout_format=".4g", **how)
    return (ipywidgets.FloatText if control.kind == "number" else ipywidgets.ColorPicker)(**how)


class PromptCanvas(RenderCanvas):
    """Calls handlers of events at once, and sends an image as soon as fewer than two wait for the browser.

    rendercanvas does both at ticks of a scheduler, sends each image once more without loss, and its browser's
    part keeps moves of the pointer back for 20 ms: too long for a coarse image that is to follow within
    150 ms. `pixels`: of the next image.
    """

    _esm = RenderCanvas._esm.replace("setThrottle(20)", "setThrottle(0)")
    pixels: Pixels | None = None

    def __init__(self, **how: Any):
        super().__init__(**how)
        self._bitmap = self.get_bitmap_context()
        self.request_draw(self._set_bitmap)

    def show(self, pixels: Pixels, quality: int) -> None:
        """Send an image, in place of those that have not been sent. In the thread of the event loop.
        `quality`: of JPEG, below 100."""
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
