"""Does a viewer draw what its state says: coarse at once, fine at rest, the image of `render`?"""

import math
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.display import to_srgb
from jaxvol.metrics import rmse
from jaxvol.viewer.curve import Curve
from jaxvol.viewer.drawing import Drawing
from jaxvol.viewer.labelled import Labelled
from jaxvol.viewer.model import Model
from jaxvol.viewer.pace import BUDGET, LADDER, Pace
from jaxvol.viewer.start import begin
from jaxvol.viewer.table import Table
from jaxvol.viewer.tiles import SIDE, Grid


SIZE = 300, 210
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


def begun(march: jv.March | None = MARCH, **more):
    how = {"lighting": None, "lit": False, "compositing": "over", "background": (0.2, 0.5, 0.8), "size": SIZE}
    return begin(BALL, LOOK, None, march, **{**how, **more})


class Shown:
    """A model, and what it showed and told."""

    def __init__(self, march=MARCH, **more):
        self.frames, self.told = [], []
        self.model = Model(*begun(march, **more), self.frames.append, self.told.append, rest=0)


@pytest.fixture(scope="module")
def shown():
    made = Shown()
    made.model.draw()
    assert made.model.wait(600)
    yield made
    made.model.close()


def test_the_fine_image_is_that_of_render(shown):
    state, content = shown.model.state, shown.model.content
    last = shown.frames[-1]
    assert (last.stage, last.state, last.pixels.shape) == ("fine", state, (210, 300, 3))
    camera = state.orbit.camera(state.size)
    rendering = jv.render(BALL, LOOK, camera, content.choices.march(state), outputs="rgba")
    expected = np.round(255 * np.asarray(to_srgb(rendering.image((0.2, 0.5, 0.8)))))
    difference = np.abs(last.pixels.astype(int) - expected)
    assert difference.max() <= 1
    assert np.mean(difference > 0) < 1e-3
    assert float(content.choices.march(state).step) == pytest.approx(0.4)


def test_the_coarse_image_comes_first_and_is_the_same_view(shown):
    first, last = shown.frames[0], shown.frames[-1]
    assert first.stage == "coarse"
    assert first.latency >= first.seconds > 0
    rows, columns = (np.arange(n) * m // n for n, m in zip(SIZE[::-1], first.pixels.shape, strict=False))
    stretched = first.pixels[rows[:, None], columns[None, :]].astype(float)
    assert np.abs(stretched - last.pixels).mean() < 3
    assert shown.told[0].startswith("compiling …")
    assert "RMSE" in shown.told[-1]


def test_changes_need_no_other_program(shown):
    """What a drag or a slider changes is traced: nothing is compiled again."""
    content, state = shown.model.content, shown.model.state
    changed = state.with_step(state.step * 1.7)
    changed = replace(changed, orbit=state.orbit.turned(0.1, 0.2).zoomed(1.3), look=state.look.over(90, 110))
    changed = replace(changed, look=changed.look.split(1), size=(517, 333))
    before = Drawing(content, state)
    before.tile(Grid(1, 1, (SIDE, SIDE)), 0, 0)
    compiled: list[str] = []

    def note(event: str, duration_secs: float, **kwargs: str | int) -> None:
        compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(note)
    after = Drawing(content, changed, 4.0)
    pixels = after.tile(Grid.fine(changed.size), 1, 1)
    assert after.program == before.program
    assert np.ptp(pixels) > 50
    assert not [event for event in compiled if "compile" in event]
    state = replace(state, look=Curve.of(jv.colormap("gray", (0, 255)), 1.0))
    Drawing(content, state).tile(Grid(1, 1, (SIDE, SIDE)), 0, 0)
    assert [event for event in compiled if "compile" in event]  # it would have been seen


def test_a_drag_turns_the_image_and_a_transform_and_a_point_change_it(shown):
    def drawn(change):
        shown.model.apply(change)
        assert shown.model.wait(600)
        return shown.frames[-1].pixels.astype(float)

    state = shown.model.state
    start = drawn(lambda s: s)
    nearer = drawn(lambda s: replace(s, orbit=s.orbit.zoomed(1.5)))
    background = start[0, 0]
    assert np.any(nearer != background, -1).mean() > 1.8 * np.any(start != background, -1).mean()
    drawn(lambda s: state)
    moved = drawn(lambda s: replace(s, orbit=s.orbit.panned(30 / 210, 0)))  # to the right
    assert _middle(moved)[0] - _middle(start)[0] == pytest.approx(30, abs=2)
    assert _middle(moved)[1] - _middle(start)[1] == pytest.approx(0, abs=2)
    drawn(lambda s: state)
    red = drawn(lambda s: replace(s, look=s.look.changed(2, color=(1.0, 0.0, 0.0))))
    middle = tuple(n // 2 for n in SIZE[::-1])
    assert red[middle][2] < start[middle][2] - 30  # less blue in what was white


def _middle(pixels):
    """Where what is not background lies, on average: (x, y)."""
    rows, columns = np.nonzero(np.any(pixels != pixels[0, 0], axis=-1))
    return columns.mean(), rows.mean()


def test_bad_input_changes_nothing_and_is_told(shown):
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


def test_a_fault_while_drawing_is_told_and_the_viewer_lives_on(shown):
    shown.model.apply(lambda s: s.with_transform("Jitter", True))  # with EmptySpaceJitter, legal
    shown.model.apply(lambda s: replace(s, orbit=replace(s.orbit, view_up=np.zeros(3))))
    assert shown.model.wait(600)
    assert shown.told[-1].startswith("not drawn:\nview_up")
    shown.model.apply(lambda s: begun()[1])
    assert shown.model.wait(600)
    assert shown.frames[-1].stage == "fine"


def test_the_error_is_about_that_of_the_image(shown):
    """Compared with steps a sixteenth as long."""
    content, state = begun(jv.March(0.8, MARCH.transforms, "midpoint"))
    whole = Grid(1, 1, (SIDE, SIDE))
    drawing, truth = Drawing(content, state), Drawing(content, state, 1 / 16)
    rgba = [np.asarray(each._rgba(whole, 0, 0)) for each in (drawing, truth)]
    background = np.asarray(content.background, np.float32)
    images = [each[..., :3] + (1 - each[..., 3:]) * background for each in rgba]
    first, second, error = drawing.error()
    assert first is second is None
    assert error == pytest.approx(float(rmse(*images)), rel=0.5)


def test_grids_cover_the_view_without_gaps():
    for size, most in ((SIZE, 1), (SIZE, 4), ((1280, 720), 6), ((100, 900), 5)):
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
    assert Grid.fine((SIDE, SIDE + 1)) == Grid(1, 2, (SIDE, SIDE + 1))
    assert Grid.coarse((1600, 400), 4).columns == 4
    assert Grid.fine((700, 500)).inside_out()[0] == (1, 1)


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


def test_a_viewer_begins_with_the_automatic_transfer_function():
    _, state = begin(BALL, None, None, None, **HOW)
    _, same = begin(BALL, jv.automatic_transfer(BALL), None, None, **HOW)
    assert state.look == same.look


def drawn(volume: jv.Volume, transfer: Any, change: Any = lambda look: look) -> Any:
    """A tile of a scene from the right side of the slabs, after a change of its look."""
    camera = jv.Camera.looking_at(volume, (0, 0, 1), view_up=(0, 1, 0))
    content, state = begin(volume, transfer, camera, MARCH, **{**HOW, "lit": False})
    state = replace(state, look=change(state.look))
    return Drawing(content, state).tile(Grid(1, 1, (SIDE, SIDE)), 0, 0).astype(float), state.look


def test_a_volume_of_labels_is_shown_by_them_and_one_is_hidden():
    def blue(image):
        return np.count_nonzero((image[..., 2] > 1.5 * image[..., 0]) & (image[..., 2] > 80))

    both, look = drawn(LABELS, None)
    hidden, changed = drawn(LABELS, None, lambda look: look.changed(1, shown=False))
    fainter, _ = drawn(LABELS, None, lambda look: look.changed(1, opacity=0.02))
    assert isinstance(look, Labelled)
    assert look.labels == (1, 2)
    assert blue(both) > 2000 > 100 > blue(hidden)
    assert fainter.mean() > both.mean()
    expected = look.function.with_visibility({1: False})
    for one, other in zip(*map(jax.tree.leaves, (changed.transfer(), expected)), strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(ValueError, match="there is no label 3; there are 1, 2"):
        look.changed(3, shown=True)
    with pytest.raises(ValueError, match="from 0 to 4"):
        look.changed(1, opacity=math.nan)


def test_a_function_of_value_and_magnitude_is_shown_and_its_values_are_moved():
    given = jv.TransferFunction2D.from_transfer(LOOK, (2.0, 20.0), 0.5)
    image, look = drawn(BALL, given)
    moved, changed = drawn(BALL, given, lambda look: look.over(look.window, look.level + 300))
    assert np.ptp(image) > 50
    assert np.ptp(moved) == 0  # out of the volume's values
    assert isinstance(look, Table)
    np.testing.assert_allclose(look.transfer().extinction, given.extinction)
    np.testing.assert_allclose(changed.transfer().values, np.asarray(given.values) + 300)
    assert look.count == "3 x 2 points"


def test_what_the_viewer_does_not_show_is_refused():
    with pytest.raises(ValueError, match="volume must be a jaxvol Volume"):
        begin(np.zeros((3, 3, 3)), None, None, None, **HOW)
    with pytest.raises(ValueError, match="shows a TransferFunction or TransferFunction2D or Label"):
        begin(BALL, MARCH, None, None, **HOW)
    with pytest.raises(ValueError, match="perspective"):
        begin(BALL, LOOK, jv.Camera.looking_at(BALL, parallel=True), None, **HOW)
    for background in ((1, 2), None, "white", (0, 0, math.inf)):
        with pytest.raises(ValueError, match="background must"):
            begin(BALL, LOOK, None, None, **{**HOW, "background": background})
    for size in (None, (3,), (0, 5)):
        for camera in (None, jv.Camera.looking_at(BALL)):
            with pytest.raises(ValueError, match="size must"):
                begin(BALL, LOOK, camera, None, **{**HOW, "size": size})
    with pytest.raises(
        ValueError, match=r"march must .* from 0\.05 to 12\.8, 0\.0625 to 16 voxels, .* got one"
    ):
        begin(BALL, LOOK, None, jv.March(20.0), **HOW)
    with pytest.raises(ValueError, match="camera must be"):
        begin(BALL, LOOK, MARCH, None, **HOW)


PHONG = jv.lighting.Phong()


@pytest.mark.parametrize("lit", [True, False])
@pytest.mark.parametrize("given", [None, PHONG], ids=["default", "given"])
def test_light_is_on_at_first_where_this_is_asked_for(given, lit):
    content, state = begun(lighting=given, lit=lit)
    assert state.lit is lit
    assert isinstance(content.choices.lighting, jv.lighting.Phong)
    assert (content.choices.light(state) is not None) is lit


def test_an_average_lies_nowhere_and_is_not_lit():
    content, state = begun(lit=True, compositing="average")
    assert not state.lit
    assert content.choices.light(replace(state, lit=True)) is None
    with pytest.raises(ValueError, match="lighting must be None where an average"):
        begun(lighting=PHONG, compositing="average")
    with pytest.raises(ValueError, match="depends on the value alone; LabelTransferFunction reads more"):
        begin(LABELS, None, None, None, **{**HOW, "compositing": "average"})


MODES = ["over", "maximum", "minimum", "average", jv.FirstVisible(), jv.Isosurface(90.0)]


@pytest.mark.parametrize(
    "mode", MODES, ids=lambda mode: mode if isinstance(mode, str) else type(mode).__name__
)
def test_every_mode_is_shown_as_it_begins(mode):
    content, state = begun(march=None, lit=True, compositing=mode)
    drawing = Drawing(content, state)
    tile = jax.eval_shape(lambda: drawing._rgba(Grid(1, 1, (SIDE, SIDE)), 0, 0))  # nothing is compiled
    assert tile.shape == (SIDE, SIDE, 4)


HOW = {"lighting": None, "lit": True, "compositing": "over", "background": (1, 1, 1), "size": (64, 64)}


def test_without_a_march_the_defaults_are_on_and_all_others_are_offered():
    content, state = begin(BALL, None, None, None, **HOW)
    assert state.on == {"AlphaCorrection", "SpaceLeaping", "EarlyTermination"}
    assert state.lit
    names = content.choices.names
    assert {"Jitter", "EmptySpaceJitter", "AdaptiveSampling"} <= set(names)
    clip = jv.Clip(box=(0, 5, 0, 5, 0, 5))
    own, state = begin(BALL, None, None, jv.March(0.2, (clip,)), **HOW)
    assert own.choices.names[0] == "Clip"
    assert state.on == {"Clip"}
    assert own.choices.voxel == pytest.approx(0.8)
    assert state.step == pytest.approx(0.25)
    march = own.choices.march(state.with_transform("Jitter", True).with_transform("Clip", False))
    assert [type(t).__name__ for t in march.transforms] == ["Jitter"]
