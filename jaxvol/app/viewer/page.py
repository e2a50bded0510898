"""The viewer as a page, with viser, which turns the camera in the browser. The image is the background of an
empty scene."""

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
from .state import Orbit, State, ViewerSetup
from .tiles import Pixels


HOST = "127.0.0.1"
OWN_NAMES = {HOST, "localhost"}
# only viser's text field sends the text of a script: each pad has a hidden one
PAD = Template(Path(__file__).with_name("pad.html").read_text("utf-8"))


class _Server(viser.ViserServer):
    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse a tunnel to a public address, which any client may request."""
        return None


class Page:
    """A server of viewer pages, made by `serve`. Each page (tab of a browser) has an independent view.

    Attributes:
        url: address to open in a browser.
        port: port of the server.
        models: viewer models of the open pages, by viser's client numbers.
        shown: scene and initial state.

    Args:
        scene: the constant part of the viewer, made by `serve`.
        state: the initial state.
        port: as for `serve`, as is `title`.
    """

    def __init__(self, scene: ViewerSetup, state: State, *, port: int, title: str):
        self.shown = scene, state
        low, high = (np.asarray(corner, np.float64) for corner in scene.volume.corners)
        # the limits of viser's cameras suit scenes of size 1
        self._center, self._radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-30)
        self.models: dict[int, Model] = {}
        # browsers open connections in advance, and close unneeded ones
        logging.getLogger("websockets.server").addFilter(_in_one_line)
        with contextlib.redirect_stdout(io.StringIO()):  # viser's banner
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
        """Stop the server."""
        for model in list(self.models.values()):
            model.close()
        self._server.stop()

    async def _only_own_pages(self, connection: Any) -> None:
        """Refuse foreign pages, and drop their messages, which viser would read after this callback."""
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
            # a narrower window than the framed one shows its whole width
            narrower = max(1.0, width / height * camera.image_height / max(camera.image_width, 1))
            camera.fov = 2 * math.atan(narrower * math.tan(math.radians(first) / 2))
            orbit = Orbit.at(position, focal, camera.up_direction, math.degrees(camera.fov))
            model.resize(camera.image_width, camera.image_height, orbit=orbit)

        client.camera.on_update(turned)

        async def picked(event: Any) -> Any:  # a coroutine, so that viser calls it in order
            model.pick(*event.screen_pos)

        client.scene.on_click()(picked)  # pyright: ignore[reportArgumentType]
        await turned(client.camera)

    async def _closed(self, client: viser.ClientHandle) -> None:
        model = self.models.pop(client.client_id, None)
        if model is not None:
            model.close(wait=False)  # viser's loop must not wait


def _in_one_line(record: logging.LogRecord) -> bool:
    """Filter log records; shorten that of a client's unknown message to one line."""
    message = record.getMessage()
    if message == "connection handler failed" and record.exc_info:
        fault = shortened(record.exc_info[1])
        record.msg, record.exc_info = f"a page was sent away: its message is unknown ({fault})", None
    return message != "opening handshake failed"


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

        # viser runs coroutines in order, plain functions in any order
        async def changed(event: Any) -> None:
            if event.client is not None:  # from a browser, not from `_update`
                value, orbit = source.value, self.model.state.orbit
                with contextlib.suppress(ValueError, KeyError):  # of messages that no widget sends
                    control.set("#{:02x}{:02x}{:02x}".format(*value) if control.kind == "color" else value)
                if self.model.state.orbit is not orbit:
                    self._turn(self.model.state.orbit)
                self._update()

        if control.kind == "buttons":
            widget.on_click(changed)
            return
        if control.kind == "pad":
            get, fields = control.get, {"field": source._impl.uuid, "pressed": html.escape(PRESSED)}
            control = replace(control, get=lambda: PAD.substitute(**fields, content=get()))
            _update(widget, control)
        self._widgets.append((widget, control))
        source.on_update(changed)

    def _update(self) -> None:
        for widget, control in self._widgets:
            _update(widget, control)


def _widget(gui: viser.GuiApi, control: Control) -> Any:
    if control.kind == "pad":
        return gui.add_html("")
    if control.kind == "buttons":
        return gui.add_button_group(control.label, tuple(control.choices))
    label = re.sub("(?<=[a-z])(?=[A-Z])", "\u200b", control.label)  # lines may break between words
    value = _value(control)
    if control.kind == "range":
        return gui.add_multi_slider(label, *control.limits, value)
    if control.kind == "slider":
        return gui.add_slider(label, *control.limits, value)
    if control.kind == "dropdown":
        return gui.add_dropdown(label, tuple(control.choices), initial_value=value)
    add = {"number": gui.add_number, "checkbox": gui.add_checkbox, "color": gui.add_rgb}[control.kind]
    return add(label, value)


def _update(widget: Any, control: Control) -> None:
    """Update a widget from the model."""
    if control.kind == "pad":
        if widget.content != (content := control.get()):
            widget.content = content
        return
    value = _value(control)
    # rounded values are not sent back, or a slider would lag behind a drag
    if not (isinstance(value, float) and math.isclose(value, widget.value, rel_tol=1e-5)):
        widget.value = value


def _value(control: Control) -> Any:
    """Value of a control, a colour as viser's three integers."""
    value = control.get()
    return tuple(round(255 * channel) for channel in to_rgb(value)) if control.kind == "color" else value
