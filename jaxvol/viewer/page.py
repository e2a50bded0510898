"""A viewer as a page of its own, by viser: it turns the camera in the browser, and the image is what lies
behind its scene, which is empty."""

import contextlib
import io
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import viser

from .curve import Curve
from .drawing import Content
from .model import Frame, Model
from .orbit import Orbit
from .state import State


HOST = "127.0.0.1"

OWN_NAMES = {HOST, "localhost"}

JPEG = {"coarse": 75, "drawing": 85, "fine": 92}
"""Quality of the images that are sent."""


class _Server(viser.ViserServer):
    """viser's server without what leaves this machine."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """None: no tunnel to a public address, which any client could ask for otherwise."""
        return None


class Page:
    """What `serve` returns: a server of pages on which a volume is looked at.

    Each page (tab of a browser) has a view of its own.

    - `url`: to open in a browser. `port`: on which it is served.
    - `models`: of the pages that are open, by viser's numbers of clients.
    - `close()` ends it.
    """

    def __init__(self, content: Content, state: State, *, port: int = 8080, title: str = "jaxvol"):
        self._content, self._state = content, state
        low, high = (np.asarray(corner, np.float64) for corner in content.volume.corners)
        # viser's cameras have limits that suit scenes of about this size
        self._center, self._radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-30)
        self.models: dict[int, Model] = {}
        with contextlib.redirect_stdout(io.StringIO()):  # viser's own banner
            self._server = _Server(host=HOST, port=port, label=title, verbose=False)
        self.port = self._server.get_port()
        self.url = f"http://localhost:{self.port}"
        self._server._websock_server.on_client_connect(self._only_own_pages)
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
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
        """Any page that a browser shows may connect to a port of this machine; viser takes them all."""
        socket = self._server._websock_server._live_connections[connection.client_id]
        request = socket.request
        origin = urlsplit(request.headers.get("Origin", "") if request else "")
        if origin.hostname not in OWN_NAMES or origin.port != self.port:
            await socket.close(1008, "this viewer is shown by its own pages only")

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
            model.close()


class _Panel:
    """The controls of one page."""

    def __init__(self, client: viser.ClientHandle, content: Content, state: State):
        self.client, self.gui = client, client.gui
        self.status = self.gui.add_markdown("starting …")
        self.model = Model(content, state, self._show, self._tell)
        self._folders: list[Any] = []
        with self.gui.add_folder("transfer function"):
            low, high = state.curve.values[0], state.curve.values[-1]
            wide = max(high - low, 1e-12)
            self.window = self.gui.add_slider("window", wide / 100, 4 * wide, wide / 100, wide)
            self.level = self.gui.add_slider("level", low - wide, high + wide, wide / 100, state.curve.level)
            self.points = self.gui.add_folder("points")
        self.window.on_update(self._ranged)
        self.level.on_update(self._ranged)
        self._rows()
        self._march()

    def look(self, orbit: Orbit, width: float, height: float) -> None:
        """From where, and at how many pixels."""
        self.model.apply(lambda state: replace(state.with_size(width, height), orbit=orbit))

    def _show(self, frame: Frame) -> None:
        self.client.scene.set_background_image(frame.pixels, format="jpeg", jpeg_quality=JPEG[frame.stage])
        self.client.flush()

    def _tell(self, text: str) -> None:
        self.status.content = f"`{text}`"

    def _march(self) -> None:
        state, choices = self.model.state, self.model.content.choices
        with self.gui.add_folder("march and light"):
            step = self.gui.add_slider("step (voxels)", 0.0625, 8.0, 0.0625, min(state.step, 8.0))

            @step.on_update
            async def _(_: Any) -> None:
                self.model.apply(lambda s: s.with_step(step.value))

            for name in choices.names:
                self._switch(name)
            light = self.gui.add_checkbox("light", state.lit)

            @light.on_update
            async def _(_: Any) -> None:
                self.model.change(lit=bool(light.value))

    def _switch(self, name: str) -> None:
        box = self.gui.add_checkbox(name, name in self.model.state.on)

        @box.on_update
        async def _(_: Any) -> None:
            self.model.apply(lambda s: s.with_transform(name, bool(box.value)))

    async def _ranged(self, event: Any) -> None:
        if event.client is None:  # set by this program
            return
        window, level = self.window.value, self.level.value
        if self._changed(lambda curve: curve.over(window, level)):
            self._rows()

    def _changed(self, change: Callable[[Curve], Curve]) -> bool:
        """Change the curve; whether that could be done."""
        return self.model.apply(lambda s: replace(s, curve=change(s.curve))) is None

    def _rows(self) -> None:
        """The controls of each point."""
        for folder in self._folders:
            folder.remove()
        curve = self.model.state.curve
        with self.points:
            if not curve.editable:
                self._folders = [self.gui.add_markdown(f"{len(curve)} points: too many to edit")]
                return
            self._folders = [self._row(curve, index) for index in range(len(curve))]

    def _row(self, curve: Curve, index: int) -> Any:
        folder = self.gui.add_folder(f"{index + 1}: {curve.values[index]:.5g}", expand_by_default=False)
        with folder:
            value = self.gui.add_number("value", curve.values[index])
            r, g, b = (round(255 * c) for c in curve.display_color(index))
            color = self.gui.add_rgb("color", (r, g, b))
            opacity = self.gui.add_slider("opacity", 0.0, 1.0, 0.001, curve.opacity(index))
            buttons = self.gui.add_button_group("point", ("one more behind", "remove"))

        @value.on_update
        async def _(event: Any) -> None:
            if event.client is not None and self._changed(lambda c: c.changed(index, value=value.value)):
                now = self.model.state.curve
                folder.label = f"{index + 1}: {now.values[index]:.5g}"
                self.window.value, self.level.value = now.window, now.level

        @color.on_update
        async def _(_: Any) -> None:
            r, g, b = (channel / 255 for channel in color.value)
            self._changed(lambda c: c.changed(index, color=(r, g, b)))

        @opacity.on_update
        async def _(_: Any) -> None:
            self._changed(lambda c: c.changed(index, opacity=opacity.value))

        @buttons.on_click
        async def _(_: Any) -> None:
            more = buttons.value != "remove"
            if self._changed(lambda c: c.split(index) if more else c.without(index)):
                self._rows()

        return folder
