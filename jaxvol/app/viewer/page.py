"""A viewer as a page of its own, by viser: it turns the camera in the browser, and the image is what lies
behind its scene, which is empty."""

import contextlib
import io
import logging
import math
import re
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import viser
from matplotlib.colors import to_rgb
from websockets.exceptions import ConnectionClosed

from .controls import Control, controls_of
from .model import JPEG_QUALITY, Model, Stage
from .orbit import Orbit
from .state import Scene, State
from .tiles import Pixels


HOST = "127.0.0.1"

OWN_NAMES = {HOST, "localhost"}


class _Server(viser.ViserServer):
    """viser's server without what leaves this machine."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """None: no tunnel to a public address, which any client could ask for otherwise."""
        return None


def _unless_never_opened(record: logging.LogRecord) -> bool:
    # browsers open connections in advance, and close those that they do not need
    return record.getMessage() != "opening handshake failed"


class Page:
    """What `serve` returns: a server of pages on which a volume is looked at.

    Each page (tab of a browser) has a view of its own.

    - `url`: to open in a browser. `port`: on which it is served.
    - `models`: of the pages that are open, by viser's numbers of clients.
    - `close()` ends it.

    **Arguments:** `scene`, `state`: what is looked at, and how at first; `serve` makes them. `port` and
    `title`: as for `serve`.
    """

    def __init__(self, scene: Scene, state: State, *, port: int = 8080, title: str = "jaxvol"):
        self._scene, self._state = scene, state
        low, high = (np.asarray(corner, np.float64) for corner in scene.volume.corners)
        # viser's cameras have limits that suit scenes of about this size
        self._center, self._radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-30)
        self.models: dict[int, Model] = {}
        logging.getLogger("websockets.server").addFilter(_unless_never_opened)
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
        """Any page that a browser shows may connect to a port of this machine; viser takes them all. It reads
        messages only after this call, so that those of others are read here, and dropped."""
        socket = self._server._websock_server._live_connections[connection.client_id]
        request = socket.request
        origin = urlsplit(request.headers.get("Origin", "") if request else "")
        if origin.hostname not in OWN_NAMES or origin.port != self.port:
            await socket.close(1008, "this viewer is shown by its own pages only")
            with contextlib.suppress(ConnectionClosed):
                while True:
                    await socket.recv(decode=False)

    def _to_viser(self, point: np.ndarray) -> np.ndarray:
        """A world point in viser's scene."""
        return (point - self._center) / self._radius

    def _orbit(self, camera: viser.CameraHandle) -> Orbit:
        """The camera of a page."""
        position, focal = (self._center + self._radius * v for v in (camera.position, camera.look_at))
        return Orbit.at(position, focal, camera.up_direction, math.degrees(camera.fov))

    async def _opened(self, client: viser.ClientHandle) -> None:
        model = _Panel(client, self._scene, self._state).model
        self.models[client.client_id] = model

        async def turned(camera: viser.CameraHandle) -> None:
            model.resize(camera.image_width, camera.image_height, orbit=self._orbit(camera))

        client.camera.on_update(turned)
        await turned(client.camera)

    async def _closed(self, client: viser.ClientHandle) -> None:
        model = self.models.pop(client.client_id, None)
        if model is not None:
            model.close(wait=False)  # viser's loop must not wait


class _Panel:
    """The model and the controls of one page."""

    def __init__(self, client: viser.ClientHandle, scene: Scene, state: State):
        self.client = client
        self.status = client.gui.add_markdown("starting …  \n")
        self.model = Model(scene, state, self._show, self._tell)
        self._widgets: list[tuple[Any, Control]] = []
        for heading, controls in controls_of(self.model).items():
            with client.gui.add_folder(heading):
                for control in controls:
                    self._add(control)

    def _show(self, pixels: Pixels, stage: Stage) -> None:
        quality = JPEG_QUALITY[stage]
        self.client.scene.set_background_image(pixels, format="jpeg", jpeg_quality=quality)
        self.client.flush()

    def _tell(self, text: str) -> None:
        self.status.content = text.replace("\n", "  \n")  # in Markdown, a new line

    def _add(self, control: Control) -> None:
        widget = _widget(self.client.gui, control)
        self._widgets.append((widget, control))

        # viser runs coroutines one after the other, and plain functions in any order
        async def changed(event: Any) -> None:
            if event.client is None:  # changed by `_update`
                return
            control.set(_from_viser(widget.value))
            for each in self._widgets:
                _update(*each)

        if control.kind == "buttons":
            widget.on_click(changed)
        elif control.kind != "html":
            widget.on_update(changed)


def _widget(gui: viser.GuiApi, control: Control) -> Any:
    if control.kind == "html":
        return gui.add_html(control.get())
    if control.kind == "buttons":
        return gui.add_button_group(control.label, tuple(control.choices()))
    label = re.sub("(?<=[a-z])(?=[A-Z])", "\u200b", control.label)  # may wrap where words meet
    value = _to_viser(control.get())
    if control.kind in ("slider", "log slider"):
        return gui.add_slider(label, *control.limits, value)
    if control.kind == "dropdown":
        return gui.add_dropdown(label, tuple(control.choices()), initial_value=value)
    add = {"number": gui.add_number, "checkbox": gui.add_checkbox, "color": gui.add_rgb}[control.kind]
    return add(label, value)


def _update(widget: Any, control: Control) -> None:
    """Let a widget show what the model has."""
    if control.kind == "buttons":
        return
    if control.kind == "html":
        widget.content = control.get()
        return
    if control.kind == "dropdown":
        widget.options = control.choices()
    value = _to_viser(control.get())
    # what only rounding has changed is not sent back, or a slider would lag behind in a drag
    if not (isinstance(value, float) and math.isclose(value, widget.value, rel_tol=1e-5)):
        widget.value = value


def _to_viser(value: Any) -> Any:
    """viser's colours are three integers."""
    is_color = isinstance(value, str) and value.startswith("#")
    return tuple(round(255 * channel) for channel in to_rgb(value)) if is_color else value


def _from_viser(value: Any) -> Any:
    return "#{:02x}{:02x}{:02x}".format(*value) if isinstance(value, tuple) else value
