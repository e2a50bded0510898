"""Does the notebook's face hand on what the pointer and the controls do? Without a browser."""

import asyncio
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

import jaxvol as jv
from jaxvol.app.viewer.editing import window_level

from .test_model import BALL, LABELS, LOOK, MARCH


pytest.importorskip("rendercanvas.anywidget", reason="needs rendercanvas: pip install jaxvol[notebooks]")
ipywidgets = pytest.importorskip("ipywidgets")


@pytest.fixture(autouse=True)
def undrawn(monkeypatch):
    """Nothing is drawn: what is drawn is for `test_model.py`."""
    monkeypatch.setattr("jaxvol.app.viewer.model.Model.ask", lambda self, request: None)


@contextmanager
def viewed(*scene, **more) -> Iterator[Any]:
    view = jv.view(*scene, **{"march": MARCH, "lit": False, "size": (300, 210), **more})
    try:
        yield view
    finally:
        view.close()


@pytest.fixture
def shown():
    with viewed(BALL, LOOK) as view:
        yield view


def pointer(kind, x, y, *, buttons=(), modifiers=(), **more):
    return {"event_type": kind, "x": x, "y": y, "buttons": buttons, "modifiers": modifiers, **more}


def test_a_drag_orbits_and_with_shift_or_the_right_button_it_moves(shown):
    first = shown.model.state.orbit
    shown._pointed(pointer("pointer_move", 5, 5))
    assert shown.model.state.orbit is first  # no button is down
    shown._pointed(pointer("pointer_down", 10, 10, buttons=(1,)))
    # browsers' moves are sent late, so that one from before may come now
    shown._pointed(pointer("pointer_move", 9, 9))
    shown._pointed(pointer("pointer_move", 31, 10, buttons=(1,)))
    turned = first.turned(21 / 210, 0)
    np.testing.assert_allclose(shown.model.state.orbit.toward, turned.toward)
    shown._pointed(pointer("pointer_move", 31, 52, buttons=(1,), modifiers=("Shift",)))
    moved = turned.panned(0, 42 / 210)
    np.testing.assert_allclose(shown.model.state.orbit.focal_point, moved.focal_point)
    picked: list[tuple[float, float]] = []
    shown.model.pick = lambda *at: picked.append(at)
    shown._pointed(pointer("pointer_up", 31, 52))
    shown._pointed(pointer("pointer_down", 150, 105, buttons=(1,)))
    shown._pointed(pointer("pointer_up", 151, 105))
    assert picked == [(151 / 300, 0.5)]
    shown._pointed(pointer("pointer_move", 90, 90, buttons=(1,)))
    np.testing.assert_allclose(shown.model.state.orbit.toward, moved.toward)
    shown._pointed(pointer("wheel", 0, 0, dy=-100))
    assert shown.model.state.orbit.distance == pytest.approx(first.distance / 1.2)
    shown._reset()
    assert shown.model.state.orbit is first


def test_what_is_drawn_and_told_is_shown(shown, monkeypatch):
    images, pixels = [], np.zeros((210, 300, 3), np.uint8)
    monkeypatch.setattr(shown.canvas, "show", lambda *image: images.append(image))
    shown.model._show(pixels, "coarse", 0.1, shown.model.state)
    shown.model._set_status("one\ntwo")
    assert images[0][0].shape == pixels.shape
    assert images[0][1] == 85
    assert shown._status.value == "one<br>two"
    shown.model.close()
    shown.model._show(pixels, "fine", 0.1, shown.model.state)
    shown.model._set_status("nothing more")
    assert (len(images), shown._status.value) == (1, "one<br>two")


def test_what_is_shown_can_be_rendered(shown):
    assert shown.camera.size == (300, 210)
    np.testing.assert_allclose(shown.transfer.extinction, LOOK.extinction, rtol=1e-6)
    assert float(shown.march.step) == pytest.approx(float(MARCH.step))
    assert [type(t) for t in shown.march.transforms] == [type(t) for t in MARCH.transforms]
    assert shown.lighting is None
    shown.model.change(lit=True)
    assert isinstance(shown.lighting, jv.lighting.Phong)


def widgets(view) -> dict[str, Any]:
    """The controls by their descriptions, and the buttons."""
    found = {control.label: widget for widget, control in view._widgets if control.label}
    groups = [group.children[0].children for group in view.children[1].children[1:]]
    rows = [row.children for group in groups for row in group if isinstance(row, ipywidgets.HBox)]
    return found | {button.description: button for row in rows for button in row}


def test_the_widgets_change_the_model_and_show_what_it_has(shown):
    found = widgets(shown)
    plot = next(widget for widget, control in shown._widgets if control.kind == "pad")
    before = plot.value
    found["level"].value = 150.0
    assert window_level(shown.transfer)[1] == pytest.approx(150)
    assert plot.value != before
    plot.sent = "1,curve,1,false,0.5,0.5"
    assert found["value"].value == 110
    found["color"].value = "#ff0000"
    np.testing.assert_allclose(shown.transfer.colors[1], (1, 0, 0))
    plot.sent = "2,curve,2,false,0.5,0.5"
    found["value"].value = 260.0
    assert found["window"].value == 180
    plot.sent = "3,curve,,false,0.5,0.5"
    assert len(shown.transfer.values) == 4
    found["mode"].value = "maximum"
    assert isinstance(shown.compositing, jv.Maximum)
    found["orthographic"].value = True
    assert float(shown.camera.parallel_scale) == pytest.approx(shown.model.state.orbit.half_height)
    found["-y"].click()
    np.testing.assert_allclose(shown.model.state.orbit.toward, (0, -1, 0), atol=2e-3)
    found["step (voxels)"].value = 1.0
    assert shown.model.state.step == 1
    found["Jitter"].value = True
    assert "Jitter" in shown.model.state.enabled


def test_a_step_alone_is_moved_by_its_level():
    with viewed(BALL, jv.TransferFunction([90, 90], [(1, 0, 0), (0, 0, 1)], [0, 2])) as view:
        found = widgets(view)
        assert (found["window"].value, found["level"].value) == (0, 90)
        found["level"].value = 110.0
        assert view.transfer.values.tolist() == [110, 110]


def test_labels_are_hidden_by_their_widgets():
    with viewed(LABELS) as view:
        found = widgets(view)
        assert found["label"].options == ("1", "2")
        found["shown"].value = False
        found["label"].value = "2"
        assert found["shown"].value
        found["opacity"].value = 0.25
        assert np.asarray(view.transfer.shown).tolist()[1:3] == [False, True]
        assert np.asarray(view.transfer.opacity).tolist()[1:3] == [1.0, 0.25]
        assert view.volume.labels is not None


def test_the_canvas_waits_for_no_tick(monkeypatch):
    """An event is handled when it comes, and an image sent in the next turn of the event loop, and once."""
    from jaxvol.app.viewer.notebook import PromptCanvas

    sent, handled, pixels = [], [], np.zeros((4, 6, 3), np.uint8)
    monkeypatch.setattr(PromptCanvas, "send", lambda self, message, buffers: sent.append(message["mimetype"]))

    async def run():
        canvas = PromptCanvas(size=(6, 4))
        resized = {"type": "resize", "width": 6, "height": 4, "pwidth": 6, "pheight": 4, "ratio": 1}
        canvas._rfb_handle_msg(canvas, resized, [])
        canvas._has_visible_views = True
        canvas.add_event_handler(handled.append, "pointer_down")
        canvas.submit_event(pointer("pointer_down", 1, 1))
        assert len(handled) == 1
        for quality in (80, 94):
            canvas.show(pixels, quality)
            await asyncio.sleep(0)
        assert canvas._rfb_lossless_draw_info is None
        assert "this.setThrottle(0)" in canvas._esm
        canvas._is_closed = True

    asyncio.run(run())
    assert sent == ["image/jpeg"] * 2


@pytest.mark.parametrize(
    ("call", "module", "extra"), [(jv.view, "rendercanvas", "notebooks"), (jv.serve, "viser", "view")]
)
def test_without_the_extra_the_error_says_what_to_install(call, module, extra, monkeypatch):
    for name in [module, *(n for n in sys.modules if n.startswith(f"{module}."))]:
        monkeypatch.setitem(sys.modules, name, None)
    for own in ("notebook", "page"):
        monkeypatch.delitem(sys.modules, f"jaxvol.app.viewer.{own}", raising=False)
        monkeypatch.delattr(f"jaxvol.app.viewer.{own}", raising=False)
    with pytest.raises(ImportError, match=rf"pip install 'jaxvol\[{extra}\]'"):
        call(BALL)
