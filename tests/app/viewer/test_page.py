"""Who may connect to the page of `jaxvol view`, and what can a client make it do?"""

import asyncio
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import jaxvol as jv
from jaxvol.app.viewer.editing import display_color


viser = pytest.importorskip("viser", reason="needs viser: pip install jaxvol[view]")
client = pytest.importorskip("websockets.sync.client")
exceptions = pytest.importorskip("websockets.exceptions")
frames = pytest.importorskip("websockets.frames")
protocol = pytest.importorskip("websockets.client")
uri = pytest.importorskip("websockets.uri")

VOLUME = jv.Volume(np.arange(27, dtype=np.uint8).reshape(3, 3, 3))
GRAY = jv.TransferFunction(np.linspace(0, 26, 4), np.linspace((0, 0, 0), (1, 1, 1), 4), np.linspace(0, 9, 4))
VISER = [f"viser-v{viser.__version__}"]


@pytest.fixture(scope="module")
def page():
    served = jv.serve(VOLUME, GRAY, port=18080)
    yield served
    served.close()


def is_taken(page, origin: str) -> bool:
    """Whether a client from a page of this origin receives anything before it is sent away."""
    with client.connect(f"ws://127.0.0.1:{page.port}", origin=origin, subprotocols=VISER) as connection:
        try:
            connection.recv(timeout=30)
        except exceptions.ConnectionClosed:
            return False
        return True


def test_only_its_own_pages_may_connect(page):
    """Any page that the browser shows may open a connection to a port of this machine."""
    assert is_taken(page, page.url)
    assert is_taken(page, f"http://127.0.0.1:{page.port}")
    for origin in ("https://example.org", f"http://example.org:{page.port}", "http://localhost:1", "null"):
        assert not is_taken(page, origin)


def handled(page, origin: str) -> int:
    """Messages that viser handles of a client from a page of this origin, which sends one along with its
    request for a connection."""
    server, message = page._server._websock_server, viser._messages.ShareUrlDisconnect
    messages, ended = [], threading.Event()

    def note(_: int, message: object) -> None:
        messages.append(message)

    server.register_handler(message, note)
    server.on_client_disconnect(lambda _: ended.set())
    asked = protocol.ClientProtocol(
        uri.parse_uri(page.url.replace("http", "ws")), origin=origin, subprotocols=VISER
    )
    asked.send_request(asked.connect())
    packed = viser.infra._messages.msgspec.msgpack.encode({"type": message.__name__})
    frame = frames.Frame(frames.Opcode.BINARY, packed).serialize(mask=True)
    end = frames.Frame(frames.Opcode.CLOSE, frames.Close(1000, "").serialize()).serialize(mask=True)
    with socket.create_connection(("127.0.0.1", page.port), timeout=20) as connection:
        connection.sendall(b"".join(asked.data_to_send()) + frame)
        assert connection.recv(1 << 16).startswith(b"HTTP/1.1 101")
        connection.sendall(end)
        while connection.recv(1 << 16):
            pass
    assert ended.wait(20)
    server.unregister_handler(message, note)
    return len(messages)


def test_what_others_send_is_not_handled(page):
    assert handled(page, page.url) == 1
    assert handled(page, "https://example.org") == 0


def test_a_message_that_viser_does_not_know_is_told_in_one_line(page, caplog):
    packed = viser.infra._messages.msgspec.msgpack.encode({"type": "\x1b[2J"})
    for message in (packed, b"\xc1", "text"):
        how = {"origin": page.url, "subprotocols": VISER}
        with client.connect(f"ws://127.0.0.1:{page.port}", **how) as connection:
            connection.send(message)
            with suppress(exceptions.ConnectionClosed):
                while True:
                    connection.recv(timeout=30)
    told = [record for record in caplog.records if record.name == "websockets.server"]
    assert len(told) == 3
    for record in told:
        assert record.exc_info is None
        assert record.getMessage().startswith("a page was sent away: its message is unknown (")
        assert record.getMessage().isprintable()


def test_nobody_else_reaches_it_and_it_serves_no_other_files(page):
    with socket.create_connection(("127.0.0.1", page.port), timeout=5):
        pass  # as browsers do in advance
    # an address of this machine, too, but not the one that it is bound to
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.2", page.port), timeout=5)
    assert (
        page._server.request_share_url() is None
    )  # a message of viser's asks for a tunnel to a public address
    assert page._server._share_tunnel is None
    for path in ("/../../../../etc/passwd", "/%2e%2e/%2e%2e/%2e%2e/etc/passwd"):
        with socket.create_connection(("127.0.0.1", page.port), timeout=5) as connection:
            connection.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
            answer = connection.recv(1 << 16)
        assert b"root:" not in answer
        assert not answer.startswith(b"HTTP/1.1 200")


def test_the_camera_of_a_page_is_that_of_the_volume(page):
    """viser's scene has the size of 1, whatever the volume's."""
    orbit = page.shown[1].orbit
    again = page._center + page._radius * page._to_viser(orbit.position)
    np.testing.assert_allclose(again, orbit.position)
    assert 1 < np.linalg.norm(page._to_viser(orbit.position)) < 10


@contextmanager
def panel_of(*scene, **how) -> Iterator[tuple[Any, dict[str, Any]]]:
    """The panel of a page that is opened, and its widgets by their labels."""
    from jaxvol.app.viewer.page import _Panel

    page = jv.serve(*scene, port=18090, **how)
    try:
        gui = page._server.gui
        turned, client = [], SimpleNamespace(gui=gui)
        panel: Any = _Panel(client, page, turned.append)  # pyright: ignore[reportArgumentType]
        panel.turned = turned
        panel.model.close()
        yield panel, {handle.label: handle for handle in gui._gui_input_handle_from_uuid.values()}
    finally:
        page.close()


def choose(widget, value, client: str | None = "a browser"):
    """What is changed in a browser, or, without a client, what the program itself shows."""
    widget._impl.value = value
    for call in widget._impl.update_cb:
        asyncio.run(call(SimpleNamespace(client=client)))


def test_the_controls_show_how_it_begins():
    with panel_of(VOLUME, GRAY, march=jv.March(16.0), compositing="average") as (_, found):
        assert found["step (voxels)"].value == found["step (voxels)"].max == 16
        assert "SpaceLeaping" in {name.replace("\u200b", "") for name in found}
    step = jv.TransferFunction([9, 9], [(1, 0, 0), (0, 0, 1)], [0, 2])
    with panel_of(VOLUME, step) as (_, found):
        assert (found["window"].value, found["level"].value) == (0, 9)
        assert found["level"].max - found["level"].min > 20
        assert "light" in found


def test_the_widgets_change_the_model_and_show_what_it_has():
    with panel_of(VOLUME, GRAY) as (panel, found):
        given = panel.model.state.transfer
        choose(found["level"], 20.0, None)
        assert panel.model.state.transfer is given
        choose(found["level"], 20.0)
        assert found["value"].value == 7
        press = "1,curve,3,false,1,0"
        choose(found["curve"], press)
        assert (found["value"].value, found["color"].value) == (33, (255, 255, 255))
        choose(found["color"], (128, 64, 255))
        assert display_color(np.asarray(panel.model.state.transfer.colors)[3]) == "#8040ff"
        choose(found["value"], 39.0)
        assert found["window"].value == pytest.approx(32)
        choose(found["curve"], press.replace("1,", "2,", 1).replace("false", "true"))
        assert len(panel.model.state.transfer.values) == 3
        for message in ("", "3,curve,x,false,0,0", "5,curve,9,false,nan,0", "<b>"):
            choose(found["curve"], message)
        assert len(panel.model.state.transfer.values) == 3
        assert panel.turned == []
        choose(found["look from"], "-x")
        np.testing.assert_allclose(panel.turned[0].toward, (-1, 0, 0), atol=2e-3)
        choose(found["x"], (3.0, 3.0))
        assert found["clip"].value
        assert panel.model.state.box[0] < panel.model.state.box[1]


def test_a_port_that_is_none_is_named():
    for port in (99999, 0, -5, "x"):
        with pytest.raises(ValueError, match="port must be an integer from 1 to 65535; got"):
            jv.serve(VOLUME, port=port)
