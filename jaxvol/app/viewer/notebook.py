"""A viewer in a notebook: rendercanvas shows the image and takes the pointer, ipywidgets are the controls."""

import asyncio
import contextlib
from collections.abc import Callable
from typing import Any

import ipywidgets

from ...lighting.shading import Lighting
from ...march.march import March
from ...scene.camera import Camera
from ...scene.transfer import Transfer
from ...scene.volume import Volume
from .canvas import PromptCanvas
from .drawing import Content
from .model import Frame, Model
from .notebook_look import WIDE, look_controls
from .state import State


PER_NOTCH = 1.2
"""How much nearer one notch of a mouse wheel brings the camera, which browsers report as 100."""


class NotebookView(ipywidgets.HBox):
    """What `view` returns: an image with its controls, a widget of ipywidgets.

    - `volume`, `camera`, `transfer`, `march`, `lighting`: as they are now, to be passed to `render`.
    - `model`: the viewer's state, `model.state`; `model.wait()` waits until it is drawn.
    - `canvas`: the image, a canvas of rendercanvas.
    - `close()` ends the viewer's thread. A cell that shows another viewer does not.

    **Arguments:** `content`, `state`: what is looked at, and how at first. `view` makes them.
    """

    def __init__(self, content: Content, state: State):
        super().__init__()
        self._loop: asyncio.AbstractEventLoop | None = None
        with contextlib.suppress(RuntimeError):
            self._loop = asyncio.get_running_loop()
        self.canvas = PromptCanvas(size=state.size)
        self.canvas.add_event_handler(self._pointed, "pointer_down", "pointer_move", "pointer_up", "wheel")
        self.canvas.add_event_handler(self._resized, "resize")
        self.canvas.add_event_handler(self._reset, "double_click")
        self._status = ipywidgets.HTML(layout=WIDE)
        self.model = Model(content, state, self._show, self._tell)
        self._first = state
        self._at: tuple[float, float] | None = None
        self.children = (self.canvas, ipywidgets.VBox(self._controls(), layout={"margin": "0 0 0 12px"}))
        self.model.draw()

    @property
    def volume(self) -> Volume:
        """What is looked at. Of voxels that are labels, shown without a transfer function, it is a smooth
        volume with them."""
        return self.model.content.volume

    @property
    def camera(self) -> Camera:
        """The camera, with the size of the image."""
        return self.model.state.orbit.camera(self.model.state.size)

    @property
    def transfer(self) -> Transfer:
        """The transfer function."""
        return self.model.state.look.transfer()

    @property
    def march(self) -> March:
        """The march of the fine image."""
        return self.model.content.choices.march(self.model.state)

    @property
    def lighting(self) -> Lighting | None:
        """The light, None if it is off."""
        return self.model.content.choices.light(self.model.state)

    def close(self) -> None:
        """Remove the widget, and end its thread."""
        self.model.close()
        self.canvas._is_closed = True  # its scheduler ends; in rendercanvas 2.7, its `close` calls itself
        ipywidgets.Widget.close(self.canvas)
        super().close()

    # The thread that draws calls these two; widgets belong to the thread of the event loop.

    def _show(self, frame: Frame) -> None:
        self._in_loop(lambda: self.canvas.show(frame.pixels, frame.quality))

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
            self.model.zoom(PER_NOTCH ** (-float(event["dy"]) / 100))
        elif kind == "pointer_down":
            self._at = at
        elif kind == "pointer_up":
            self._at = None
        elif (
            self._at is not None and event["buttons"]
        ):  # one without may come late, after the button went down
            ratio = self.canvas.get_pixel_ratio()
            moved = [(new - old) * ratio for new, old in zip(at, self._at, strict=True)]
            self._at = at
            pans = "Shift" in event["modifiers"] or 1 not in event["buttons"]
            self.model.drag(*moved, pan=pans)

    def _resized(self, event: dict[str, Any]) -> None:
        ratio = float(event["pixel_ratio"])
        size = event["width"] * ratio, event["height"] * ratio
        if min(size) >= 1:
            self.model.apply(lambda state: state.with_size(*size))

    def _reset(self, event: dict[str, Any] | None = None) -> None:
        self.model.change(orbit=self._first.orbit)

    def _controls(self) -> list[ipywidgets.Widget]:
        state, choices = self.model.state, self.model.content.choices
        step = ipywidgets.FloatLogSlider(
            value=state.step, base=2, min=-4, max=4, step=0.25, description="step (voxels)", layout=WIDE
        )
        step.style.description_width = "initial"  # pyright: ignore[reportAttributeAccessIssue]
        step.observe(lambda change: self.model.apply(lambda s: s.with_step(change["new"])), "value")
        light = _box("light", state.lit, lambda on: self.model.change(lit=on))
        reset = ipywidgets.Button(description="reset view", layout={"width": "110px"})
        reset.on_click(lambda _: self._reset())
        self._look = look_controls(self.model)
        return [
            self._status,
            _heading("transfer function"),
            self._look,
            _heading("march and light"),
            step,
            *(self._switch(name) for name in choices.names),
            *([] if choices.lighting is None else [light]),
            reset,
        ]

    def _switch(self, name: str) -> ipywidgets.Checkbox:
        return _box(
            name,
            name in self.model.state.on,
            lambda on: self.model.apply(lambda state: state.with_transform(name, on)),
        )


def _heading(text: str) -> ipywidgets.HTML:
    return ipywidgets.HTML(f"<b>{text}</b>")


def _box(name: str, on: bool, switch: Callable[[bool], Any]) -> ipywidgets.Checkbox:
    box = ipywidgets.Checkbox(value=on, description=name, indent=False, layout=WIDE)
    box.observe(lambda change: switch(bool(change["new"])), "value")
    return box
