"""A viewer as a page of its own, by viser: it turns the camera in the browser, and the image is what lies
behind its scene, which is empty."""

import contextlib
import io
import logging
import math
import re
from dataclasses import replace
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import viser
from websockets.exceptions import ConnectionClosed

from .drawing import Content
from .model import Frame, Model
from .orbit import Orbit
from .page_look import add_look, answer
from .state import LONGEST, SHORTEST, State


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

    **Arguments:** `content`, `state`: what is looked at, and how at first; `serve` makes them. `port` and
    `title`: as for `serve`.
    """

    def __init__(self, content: Content, state: State, *, port: int = 8080, title: str = "jaxvol"):
        self._content, self._state = content, state
        low, high = (np.asarray(corner, np.float64) for corner in content.volume.corners)
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
        first.position, first.look_at = (
            self._shown(state.orbit.position),
            self._shown(state.orbit.focal_point),
        )
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

    def _shown(self, point: np.ndarray) -> np.ndarray:
        """A world point in viser's scene."""
        return (point - self._center) / self._radius

    def _orbit(self, camera: viser.CameraHandle) -> Orbit:
        """The camera of a page."""
        position, focal = (self._center + self._radius * v for v in (camera.position, camera.look_at))
        return Orbit.at(position, focal, camera.up_direction, math.degrees(camera.fov))

    async def _opened(self, client: viser.ClientHandle) -> None:
        panel = _Panel(client, self._content, self._state)
        self.models[client.client_id] = panel.model

        @client.camera.on_update
        async def _(camera: viser.CameraHandle) -> None:
            panel.look(self._orbit(camera), camera.image_width, camera.image_height)

        panel.look(self._orbit(client.camera), client.camera.image_width, client.camera.image_height)

    async def _closed(self, client: viser.ClientHandle) -> None:
        model = self.models.pop(client.client_id, None)
        if model is not None:
            model.close(wait=False)  # viser's loop must not wait


class _Panel:
    """The controls of one page."""

    def __init__(self, client: viser.ClientHandle, content: Content, state: State):
        self.client, self.gui = client, client.gui
        self.status = self.gui.add_markdown("starting …  \n")
        self.model = Model(content, state, self._show, self._tell)
        with self.gui.add_folder("transfer function"):
            add_look(self.gui, self.model)
        with self.gui.add_folder("march and light"):
            self._march(state)

    def look(self, orbit: Orbit, width: float, height: float) -> None:
        """From where, and at how many pixels."""
        self.model.apply(lambda state: replace(state.with_size(width, height), orbit=orbit))

    def _show(self, frame: Frame) -> None:
        self.client.scene.set_background_image(frame.pixels, format="jpeg", jpeg_quality=frame.quality)
        self.client.flush()

    def _tell(self, text: str) -> None:
        self.status.content = text.replace("\n", "  \n")  # in Markdown, a new line

    def _march(self, state: State) -> None:
        choices = self.model.content.choices
        step = self.gui.add_slider("step (voxels)", SHORTEST, float(LONGEST), SHORTEST, state.step)
        answer(step, lambda: self.model.apply(lambda s: s.with_step(step.value)))
        for name in choices.names:
            self._switch(name, name in state.on)
        if choices.lighting is None:
            return
        light = self.gui.add_checkbox("light", state.lit)
        answer(light, lambda: self.model.change(lit=bool(light.value)))

    def _switch(self, name: str, on: bool) -> None:
        may_wrap = re.sub("(?<=[a-z])(?=[A-Z])", "\u200b", name)  # where words meet
        box = self.gui.add_checkbox(may_wrap, on)
        answer(box, lambda: self.model.apply(lambda s: s.with_transform(name, bool(box.value))))
