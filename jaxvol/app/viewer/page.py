"""A viewer as a page of its own, by viser, which turns the camera in the browser. The image is the background
of viser's scene, which is empty."""

import contextlib
import html
import io
import logging
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import viser
from matplotlib.colors import to_rgb
from websockets.exceptions import ConnectionClosed

from ..._util.checks import shortened
from .control import PRESSED, Control
from .controls import FOLDED, controls_of
from .model import JPEG_QUALITY, Model, Stage
from .state import Orbit, Scene, State
from .tiles import Pixels


HOST = "127.0.0.1"
OWN_NAMES = {HOST, "localhost"}
# of viser's widgets, only a text field sends what a script tells: each pad has a hidden one
PAD = Template(Path(__file__).with_name("pad.html").read_text("utf-8"))


class _Server(viser.ViserServer):
    def request_share_url(self, verbose: bool = True) -> str | None:
        """None: no tunnel to a public address, which any client could ask for otherwise."""
        return None


class Page:
    """What `serve` returns: a server of pages on which a volume is looked at.

    Each page (tab of a browser) has a view of its own.

    Attributes:
        url: to open in a browser.
        port: on which it is served.
        models: of the pages that are open, by viser's numbers of clients.
        shown: scene and first state.

    Args:
        scene: what is looked at. `serve` makes it.
        state: how at first.
        port: as for `serve`, as is `title`.
    """

    def __init__(self, scene: Scene, state: State, *, port: int, title: str):
        self.shown = scene, state
        low, high = (np.asarray(corner, np.float64) for corner in scene.volume.corners)
        # viser's cameras have limits that suit scenes of about this size
        self._center, self._radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-30)
        self.models: dict[int, Model] = {}
        # browsers open connections in advance, and close those that they do not need
        log = logging.getLogger("websockets.server")
        log.addFilter(_in_one_line)
        with contextlib.redirect_stdout(io.StringIO()):  # viser's own banner
            self._server = _Server(host=HOST, port=port, label=title, verbose=False)
        self.port = self._server.get_port()
        self.url = f"http://localhost:{self.port}"
        self._server._websock_server.on_client_connect(self._only_own_pages)
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self._server.gui.main_panel.dock_right()
        self._server.scene.set_up_direction(tuple(state.orbit.view_up))
        first = self._server.initial_camera
        first.up = tuple(state.orbit.view_up)
        first.position = self._to_viser(state.orbit.position)
        first.look_at = self._to_viser(state.orbit.focal_point)
        first.fov = math.radians(state.orbit.view_angle)
        self._server.on_client_connect(self._opened)
        self._server.on_client_disconnect(self._closed)

    def close(self) -> None:
        """Serve no more."""
        for model in list(self.models.values()):
            model.close()
        self._server.stop()

    async def _only_own_pages(self, connection: Any) -> None:
        """Refuse pages of others; viser reads messages only after this, so theirs are dropped here."""
        client = self._server._websock_server._live_connections[connection.client_id]
        origin = urlsplit(client.request.headers.get("Origin", "") if client.request else "")
        if origin.hostname not in OWN_NAMES or origin.port != self.port:
            await client.close(1008, "this viewer is shown by its own pages only")
            with contextlib.suppress(ConnectionClosed):
                while True:
                    await client.recv(decode=False)

    def _to_viser(self, point: np.ndarray) -> np.ndarray:
        """A world point in viser's scene."""
        return (point - self._center) / self._radius

    async def _opened(self, client: viser.ClientHandle) -> None:
        def turn(orbit: Orbit) -> None:
            with client.atomic():
                client.camera.up_direction = tuple(orbit.view_up)
                client.camera.position = self._to_viser(orbit.position)
                client.camera.look_at = self._to_viser(orbit.focal_point)

        model = _Panel(client, self, turn).model
        self.models[client.client_id] = model

        async def turned(camera: viser.CameraHandle) -> None:
            position, focal = (self._center + self._radius * v for v in (camera.position, camera.look_at))
            (width, height), first = self.shown[1].size, self.shown[1].orbit.view_angle
            # a window that is narrower than what was framed shows all of its width
            narrower = max(1.0, width / height * camera.image_height / max(camera.image_width, 1))
            camera.fov = 2 * math.atan(narrower * math.tan(math.radians(first) / 2))
            orbit = Orbit.at(position, focal, camera.up_direction, math.degrees(camera.fov))
            model.resize(camera.image_width, camera.image_height, orbit=orbit)

        client.camera.on_update(turned)

        async def picked(event: Any) -> Any:  # beside the others, in turn
            model.pick(*event.screen_pos)

        client.scene.on_click()(picked)  # pyright: ignore[reportArgumentType]
        await turned(client.camera)

    async def _closed(self, client: viser.ClientHandle) -> None:
        model = self.models.pop(client.client_id, None)
        if model is not None:
            model.close(wait=False)  # viser's loop must not wait


def _in_one_line(record: logging.LogRecord) -> bool:
    """Whether to log a record; a client's unknown message is told in one line."""
    told = record.getMessage()
    if told == "connection handler failed" and record.exc_info:
        fault = shortened(record.exc_info[1])
        record.msg, record.exc_info = f"a page was sent away: its message is unknown ({fault})", None
    return told != "opening handshake failed"


class _Panel:
    """The model and the controls of one page. `turn`: turns the browser's camera."""

    def __init__(self, client: viser.ClientHandle, page: Page, turn: Callable[[Orbit], None]):
        self.client, self._turn = client, turn
        self.status = client.gui.add_markdown("starting …  \n")
        self.model = Model(*page.shown, self._show, self._set_status, self._deliver)
        self._widgets: list[tuple[Any, Control]] = []
        for heading, controls in controls_of(self.model).items():
            with client.gui.add_folder(heading, expand_by_default=heading not in FOLDED):
                for control in controls:
                    self._add(control)
        self.model.marked = self._update

    def _deliver(self, png: bytes) -> None:
        self.client.send_file_download("jaxvol.png", png, save_immediately=True)

    def _show(self, pixels: Pixels, stage: Stage) -> None:
        self.client.scene.set_background_image(pixels, "jpeg", jpeg_quality=JPEG_QUALITY[stage])
        self.client.flush()

    def _set_status(self, text: str) -> None:
        self.status.content = text.replace("\n", "  \n")  # in Markdown, a new line

    def _add(self, control: Control) -> None:
        widget = _widget(self.client.gui, control)
        source = self.client.gui.add_text(control.label, "") if control.kind == "pad" else widget

        # viser runs coroutines one after the other, and plain functions in any order
        async def changed(event: Any) -> None:
            if event.client is not None:  # in a browser, and not by `_update`
                value, orbit = source.value, self.model.state.orbit
                with contextlib.suppress(ValueError, KeyError):  # of what no widget sends
                    control.set("#{:02x}{:02x}{:02x}".format(*value) if control.kind == "color" else value)
                if self.model.state.orbit is not orbit:
                    self._turn(self.model.state.orbit)
                self._update()

        if control.kind == "buttons":
            widget.on_click(changed)
            return
        if control.kind == "pad":
            told, field = control.get, {"field": source._impl.uuid, "pressed": html.escape(PRESSED)}
            control = replace(control, get=lambda: PAD.substitute(**field, content=told()))
            _update(widget, control)
        self._widgets.append((widget, control))
        source.on_update(changed)

    def _update(self) -> None:
        for each in self._widgets:
            _update(*each)


def _widget(gui: viser.GuiApi, control: Control) -> Any:
    if control.kind == "pad":
        return gui.add_html("")
    if control.kind == "buttons":
        return gui.add_button_group(control.label, tuple(control.choices))
    label = re.sub("(?<=[a-z])(?=[A-Z])", "\u200b", control.label)  # may wrap where words meet
    value = _value(control)
    if control.kind == "range":
        return gui.add_multi_slider(label, *control.limits, value)
    if control.kind in ("slider", "log slider"):
        return gui.add_slider(label, *control.limits, value)
    if control.kind == "dropdown":
        return gui.add_dropdown(label, tuple(control.choices), initial_value=value)
    add = {"number": gui.add_number, "checkbox": gui.add_checkbox, "color": gui.add_rgb}[control.kind]
    return add(label, value)


def _update(widget: Any, control: Control) -> None:
    """Let a widget show what the model has."""
    if control.kind == "pad":
        if widget.content != (content := control.get()):
            widget.content = content
        return
    value = _value(control)
    # what only rounding has changed is not sent back, or a slider would lag behind in a drag
    if not (isinstance(value, float) and math.isclose(value, widget.value, rel_tol=1e-5)):
        widget.value = value


def _value(control: Control) -> Any:
    """What a control shows; of a colour viser's three integers."""
    value = control.get()
    return tuple(round(255 * channel) for channel in to_rgb(value)) if control.kind == "color" else value
