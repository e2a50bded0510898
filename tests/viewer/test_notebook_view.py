"""Does the notebook's face hand on what the pointer and the controls do? Without a browser."""

import asyncio
import sys

import numpy as np
import pytest

import jaxvol as jv

from .test_model import BALL, LOOK, MARCH


pytest.importorskip("rendercanvas.anywidget", reason="needs rendercanvas: pip install jaxvol[notebooks]")


@pytest.fixture
def shown():
    view = jv.view(BALL, LOOK, march=MARCH, lit=False, size=(300, 210))
    yield view
    view.close()


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
    shown._pointed(pointer("pointer_up", 31, 52))
    shown._pointed(pointer("pointer_move", 90, 90, buttons=(1,)))
    np.testing.assert_allclose(shown.model.state.orbit.toward, moved.toward)
    shown._pointed(pointer("wheel", 0, 0, dy=-100))
    assert shown.model.state.orbit.distance == pytest.approx(first.distance / 1.2)
    shown._reset()
    assert shown.model.state.orbit is first


def test_what_is_shown_can_be_rendered(shown):
    assert shown.camera.size == (300, 210)
    np.testing.assert_allclose(shown.transfer.extinction, LOOK.extinction, rtol=1e-6)
    assert float(shown.march.step) == pytest.approx(float(MARCH.step))
    assert [type(t) for t in shown.march.transforms] == [type(t) for t in MARCH.transforms]
    assert shown.lighting is None
    shown.model.change(lit=True)
    assert isinstance(shown.lighting, jv.lighting.Phong)


def test_the_controls_of_points_window_and_level_agree(shown):
    shown._level.value = 150.0
    assert shown.model.state.curve.level == pytest.approx(150)
    value, color, opacity, more, _ = shown._points.children[1].children
    assert value.value == pytest.approx(shown.model.state.curve.values[1])
    opacity.value, color.value = 0.5, "#ff0000"
    assert shown.model.state.curve.opacity(1) == pytest.approx(0.5)
    assert shown.model.state.curve.colors[1] == pytest.approx((1, 0, 0))
    last = shown._points.children[2].children[0]
    last.value = last.value + 40
    assert shown._window.value == pytest.approx(180)
    more.click()
    assert len(shown.model.state.curve) == len(shown._points.children) == 4
    shown._points.children[0].children[4].click()
    assert len(shown.model.state.curve) == len(shown._points.children) == 3


def test_the_canvas_waits_for_no_tick(monkeypatch):
    """An event is handled when it comes, and an image sent in the next turn of the event loop, once more
    without loss only if it is to stay."""
    from jaxvol.viewer.canvas import PromptCanvas

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
        for final in (False, True):
            canvas.show(pixels, final=final)
            await asyncio.sleep(0)
            assert (canvas._rfb_lossless_draw_info is not None) == final
        canvas._is_closed = True

    asyncio.run(run())
    assert sent == ["image/jpeg"] * 2


@pytest.mark.parametrize(
    ("call", "module", "extra"), [(jv.view, "rendercanvas", "notebooks"), (jv.serve, "viser", "view")]
)
def test_without_the_extra_the_error_says_what_to_install(call, module, extra, monkeypatch):
    for name in [module, *(n for n in sys.modules if n.startswith(f"{module}."))]:
        monkeypatch.setitem(sys.modules, name, None)
    for own in ("notebook", "canvas", "page"):
        monkeypatch.delitem(sys.modules, f"jaxvol.viewer.{own}", raising=False)
        monkeypatch.delattr(f"jaxvol.viewer.{own}", raising=False)
    with pytest.raises(ImportError, match=rf"pip install jaxvol\[{extra}\]"):
        call(BALL)
