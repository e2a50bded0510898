"""Does a viewer draw what its state says: coarse at once, fine at rest, the image of `render`?"""

import math
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxvol as jv
from jaxvol import to_srgb
from jaxvol.app.viewer.drawing import Drawing
from jaxvol.app.viewer.labelled import Labelled
from jaxvol.app.viewer.model import Model
from jaxvol.app.viewer.pace import BUDGET, LADDER, Pace
from jaxvol.app.viewer.start import begin
from jaxvol.app.viewer.table import Table
from jaxvol.app.viewer.tiles import Grid
from jaxvol.metrics import rmse


SIZE = 38, 27
"""Two columns and rows of tiles, of which most lie past the image."""

BALL = jv.Volume(
    np.clip(200 - 14 * np.linalg.norm(np.mgrid[:24, :24, :24] - 11.5, axis=0), 0, 255).astype(np.uint8),
    spacing=(1.0, 1.2, 0.8),
)
LOOK = jv.TransferFunction.from_points(
    [(60, (0.1, 0.2, 0.9), 0.0), (90, (0.9, 0.3, 0.1), 0.2), (200, (1, 1, 1), 0.8)]
)
MARCH = jv.March(0.4, (jv.AlphaCorrection(), jv.SpaceLeaping()), "midpoint")
LABELS = jv.Volume(np.repeat(np.arange(3, dtype=np.uint8), 8)[:, None, None] * np.ones((1, 24, 24), np.uint8))
"""Slabs of the labels 0, 1 and 2."""

HOW = {"lighting": None, "lit": False, "compositing": "over", "background": (0.2, 0.5, 0.8), "size": SIZE}


def begun(volume=BALL, transfer: Any = LOOK, camera=None, march: jv.March | None = MARCH, **more):
    return begin(volume, transfer, camera, march, **{**HOW, **more})


class Shown:
    """A model, and what it showed and told."""

    def __init__(self):
        self.frames, self.told = [], []
        self.model = Model(*begun(), self.frames.append, self.told.append, rest=0)

    def after(self, change):
        """The fine image after a change of the state."""
        self.model.apply(change)
        assert self.model.wait(600)
        assert self.frames[-1].stage == "fine"
        return self.frames[-1].pixels.astype(float)


@pytest.fixture(scope="module")
def shown(side):
    made = Shown()
    made.model.draw()
    assert made.model.wait(600)
    yield made
    made.model.close()


def test_a_coarse_image_is_followed_by_the_fine_one_of_render(shown, side, monkeypatch):
    state, content = shown.model.state, shown.model.content
    first, last = shown.frames[0], shown.frames[-1]
    assert (last.stage, last.state, last.pixels.shape) == ("fine", state, (27, 38, 3))
    for left, top in ((0, 0), (38 - side, 27 - side)):  # by the program of a tile
        camera = state.orbit.camera(state.size).crop(left, top, side, side)
        rendering = jv.render(BALL, state.look.padded(), camera, content.choices.march(state), outputs="rgba")
        expected = np.round(255 * np.asarray(to_srgb(rendering.image((0.2, 0.5, 0.8)))))
        difference = np.abs(last.pixels[top : top + side, left : left + side].astype(int) - expected)
        assert difference.max() <= 1
        assert np.mean(difference > 0) < 1e-3
    assert float(content.choices.march(state).step) == pytest.approx(0.4)
    assert first.stage == "coarse"
    assert first.latency >= first.seconds > 0
    rows, columns = (np.arange(n) * m // n for n, m in zip(SIZE[::-1], first.pixels.shape, strict=False))
    stretched = first.pixels[rows[:, None], columns[None, :]].astype(float)
    assert np.abs(stretched - last.pixels).mean() < 12  # the same view
    assert shown.told[0].startswith("compiling …")
    assert "RMSE" in shown.told[-1]
    assert first.quality < last.quality
    monkeypatch.setattr("jaxvol.app.viewer.model.EVERY", 0.0)  # seconds until a part of it is shown
    shown.after(lambda s: s)
    assert shown.frames[-2].stage == "drawing"


def test_changes_need_no_other_program(shown, side):
    """What a drag or a slider changes is traced: nothing is compiled again."""
    content, state = shown.model.content, shown.model.state
    changed = state.with_step(state.step * 1.7)
    changed = replace(changed, orbit=state.orbit.turned(0.1, 0.2).zoomed(1.3), look=state.look.over(90, 110))
    changed = replace(changed, look=changed.look.split(1), size=(67, 43))
    before, after = Drawing(content, state), Drawing(content, changed, 4.0)
    before.tile(Grid(1, 1, (side, side)), 0, 0)
    compiled: list[str] = []

    def note(event: str, duration_secs: float, **kwargs: str | int) -> None:
        compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(note)
    pixels = after.tile(Grid.fine(changed.size), 1, 1)
    assert after.program == before.program
    assert np.ptp(pixels) > 50
    assert not [event for event in compiled if "compile" in event]
    jax.jit(lambda x: x + 17.25)(np.float32(1))
    assert [event for event in compiled if "compile" in event]  # it would have been seen
    assert Drawing(content, replace(state, on=state.on - {"SpaceLeaping"})).program != before.program


def test_a_drag_turns_the_image_and_a_point_changes_it(shown):
    def middle(pixels):
        """Where what is not background lies, on average: (x, y)."""
        rows, columns = np.nonzero(np.any(pixels != pixels[0, 0], axis=-1))
        return columns.mean(), rows.mean()

    state = shown.model.state
    start = shown.after(lambda s: s)
    nearer = shown.after(lambda s: replace(s, orbit=s.orbit.zoomed(1.5)))
    background = start[0, 0]
    assert np.any(nearer != background, -1).mean() > 1.7 * np.any(start != background, -1).mean()
    moved = shown.after(lambda s: replace(state, orbit=state.orbit.panned(5 / 27, 0)))  # to the right
    assert np.subtract(middle(moved), middle(start)) == pytest.approx((5, 0), abs=0.5)
    red = shown.after(lambda s: replace(state, look=state.look.changed(2, color=(1.0, 0.0, 0.0))))
    center = tuple(n // 2 for n in SIZE[::-1])
    assert red[center][2] < start[center][2] - 30  # less blue in what was white


def test_bad_input_and_faults_are_told_and_the_viewer_lives_on(shown):
    state, told = shown.model.state, len(shown.told)
    for change in (
        lambda s: s.with_step(math.nan),
        lambda s: s.with_step(0),
        lambda s: s.with_size(0, 100),
        lambda s: replace(s, look=s.look.over(-1, 0)),
        lambda s: replace(s, look=s.look.over(1e-9, 1e3)),  # float32 has one number there
    ):
        assert shown.model.apply(change) is not None
    assert shown.model.state is state
    assert len(shown.told) == told + 5
    shown.model.apply(lambda s: replace(s, orbit=replace(s.orbit, view_up=np.zeros(3))))
    assert shown.model.wait(600)
    assert shown.told[-1].startswith("not drawn:\nview_up")
    shown.after(lambda s: begun()[1])


def test_the_error_is_about_that_of_the_image(side):
    """Compared with steps a sixteenth as long."""
    content, state = begun(march=jv.March(0.8, MARCH.transforms, "midpoint"))
    whole = Grid(1, 1, (side, side))
    drawing, truth = Drawing(content, state), Drawing(content, state, 1 / 16)
    rgba = [np.asarray(each._rgba(whole, 0, 0)) for each in (drawing, truth)]
    background = np.asarray(content.background, np.float32)
    images = [each[..., :3] + (1 - each[..., 3:]) * background for each in rgba]
    first, second, error = drawing.error()
    assert first is second is None
    assert error == pytest.approx(float(rmse(*images)), rel=0.5)


def test_grids_cover_the_view_without_gaps(side):
    for size, most in ((SIZE, 1), (SIZE, 4), ((160, 90), 6), ((13, 113), 5)):
        for grid in (Grid.fine(size), Grid.coarse(size, most)):
            aspect = size[0] / size[1]
            tiles = sorted(grid.inside_out())
            assert len(set(tiles)) == len(grid) == grid.columns * grid.rows
            windows = {tile: grid.window(*tile, aspect) for tile in tiles}
            left, _, _, top = windows[0, 0]
            assert (left, top) == pytest.approx((-aspect, 1))
            for column, row in tiles:
                _, right, bottom, _ = windows[column, row]
                if column + 1 < grid.columns:
                    assert windows[column + 1, row][0] == pytest.approx(right)
                if row + 1 < grid.rows:
                    assert windows[column, row + 1][3] == pytest.approx(bottom)
            _, right, bottom, _ = windows[grid.columns - 1, grid.rows - 1]
            assert right >= aspect - 1e-9
            assert bottom <= -1 + 1e-9
    assert Grid.fine((side, side + 1)) == Grid(1, 2, (side, side + 1))
    assert Grid.coarse((1600, 400), 4).columns == 4
    assert Grid.fine((3 * side + 5, 2 * side + 9)).inside_out()[0] == (1, 1)


def test_the_pace_settles_on_what_is_fast_enough():
    def settled(seconds_per_tile):
        pace, taken = Pace(), 0.0
        for _ in range(20):
            taken = pace.tiles * seconds_per_tile * (0.4 + 0.6 / pace.coarser)
            pace.took(taken, 100)
        return pace, taken

    pace, taken = settled(0.02)
    assert BUDGET / 2.5 <= taken <= BUDGET
    assert pace.tiles > 1
    slow, _ = settled(0.3)
    assert (slow.tiles, slow.coarser) == LADDER[0]
    fast, _ = settled(1e-6)
    assert (fast.tiles, fast.coarser) == LADDER[-1]
    small = Pace()
    for _ in range(20):
        small.took(1e-6, 2)
    assert small.tiles == 1


def equal_arrays(one, other):
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.allclose(a, b, rtol=1e-6) for a, b in pairs)


def test_every_kind_of_transfer_function_is_drawn_as_it_is_changed():
    content, state = begun(LABELS, None)
    look = state.look
    assert isinstance(look, Labelled)
    assert look.labels == (1, 2)
    changed = replace(state, look=look.changed(1, shown=False).changed(2, opacity=0.02))
    expected = look.function.with_visibility({1: False}).with_opacity({2: 0.02})
    assert equal_arrays(Drawing(content, changed).transfer, expected)
    with pytest.raises(ValueError, match="there is no label 3; there are 1, 2"):
        look.changed(3, shown=True)
    with pytest.raises(ValueError, match="from 0 to 4"):
        look.changed(1, opacity=math.nan)

    given = jv.TransferFunction2D.from_transfer(LOOK, (2.0, 20.0), 0.5)
    content, state = begun(BALL, given)
    look = state.look
    assert isinstance(look, Table)
    assert look.count == "3 x 2 points"
    assert content.histogram.plot(look).count("<line") == 2  # the ends of its range
    moved = replace(state, look=look.over(look.window, look.level + 300))
    assert equal_arrays(look.transfer(), given)
    assert equal_arrays(
        Drawing(content, moved).transfer, eqx.tree_at(lambda t: t.values, given, given.values + 300)
    )
    _, state = begun(transfer=None, march=None)  # found from the volume's values
    assert state.look == begun(transfer=jv.automatic_transfer(BALL), march=None)[1].look


def test_what_the_viewer_does_not_show_is_refused():
    parallel = jv.Camera.looking_at(BALL, parallel=True)
    bad = [
        ({"volume": np.zeros((3, 3, 3)), "transfer": None}, "volume must be a jaxvol Volume"),
        ({"transfer": MARCH}, "shows a TransferFunction or TransferFunction2D or Label"),
        ({"camera": parallel}, "perspective"),
        ({"camera": MARCH}, "camera must be"),
        ({"march": jv.March(20.0)}, r"march must .* from 0\.05 to 12\.8, 0\.0625 to 16 voxels, .* got one"),
        ({"lighting": PHONG, "compositing": "average"}, "lighting must be None where an average"),
        ({"volume": LABELS, "transfer": None, "compositing": "average"}, "LabelTransferFunction reads more"),
    ]
    bad += [({"background": each}, "background must") for each in ((1, 2), None, "white", (0, 0, math.inf))]
    for camera in (None, jv.Camera.looking_at(BALL)):
        bad += [({"size": size, "camera": camera}, "size must") for size in (None, (3,), (0, 5))]
    for given, message in bad:
        with pytest.raises(ValueError, match=message):
            begun(**given)


PHONG = jv.lighting.Phong()
MODES = ["over", "maximum", "minimum", "average", jv.FirstVisible(), jv.Isosurface(90.0)]


def test_every_mode_is_shown_as_it_begins_and_lit_where_it_can_be(side):
    for mode in MODES:
        content, state = begun(march=None, lit=True, compositing=mode)
        drawing = Drawing(content, state)
        if mode in MODES[-3::2]:
            tile = jax.eval_shape(
                lambda d=drawing: d._rgba(Grid(1, 1, (side, side)), 0, 0)
            )  # compiles nothing
            assert tile.shape == (side, side, 4)
        assert state.lit == (mode != "average")
        assert (content.choices.light(replace(state, lit=True)) is not None) == (mode != "average")
    for given in (None, PHONG):
        for lit in (True, False):
            content, state = begun(lighting=given, lit=lit)
            assert state.lit is lit
            assert isinstance(content.choices.lighting, jv.lighting.Phong)
            assert (content.choices.light(state) is not None) is lit


def test_without_a_march_the_defaults_are_on_and_all_others_are_offered():
    content, state = begun(transfer=None, march=None, lit=True)
    assert state.on == {"AlphaCorrection", "SpaceLeaping", "EarlyTermination"}
    assert state.lit
    assert {"Jitter", "EmptySpaceJitter", "AdaptiveSampling"} <= set(content.choices.names)
    clip = jv.Clip(box=(0, 5, 0, 5, 0, 5))
    own, state = begun(march=jv.March(0.2, (clip,)))
    assert own.choices.names[0] == "Clip"
    assert state.on == {"Clip"}
    assert own.choices.voxel == pytest.approx(0.8)
    assert state.step == pytest.approx(0.25)
    march = own.choices.march(state.with_transform("Jitter", True).with_transform("Clip", False))
    assert [type(t).__name__ for t in march.transforms] == ["Jitter"]
