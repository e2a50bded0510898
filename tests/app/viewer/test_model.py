"""Does a viewer draw what its state says: coarse at once, fine at rest, the image of `render`?"""

import base64
import io
import math
import re
import threading
import time
from contextlib import suppress
from dataclasses import replace
from itertools import product
from typing import Any

import jax
import numpy as np
import pytest
from PIL import Image

import jaxvol as jv
from jaxvol import to_srgb
from jaxvol.app.cli import parser_of_all
from jaxvol.app.recorded import recorded_in
from jaxvol.app.viewer.controls import controls_of
from jaxvol.app.viewer.editing import with_color, with_opacity, with_points_at, with_window_level
from jaxvol.app.viewer.model import BUDGET, LEVELS, Model, adapted
from jaxvol.app.viewer.state import initial
from jaxvol.app.viewer.tiles import Grid, TileRenderer, estimated_error
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

LABELS_OF_ONES = jv.Volume(LABELS.data, labels=np.ones(LABELS.shape, np.uint8))

HOW = {"lighting": None, "lit": False, "compositing": "over", "background": (0.2, 0.5, 0.8), "size": SIZE}


WHOLE = jv.Camera.looking_at(BALL, size=SIZE)


def begun(volume=BALL, transfer: Any = LOOK, camera: Any = WHOLE, march: jv.March | None = MARCH, **more):
    return initial(volume, transfer, camera, march, **{**HOW, **more})


class Shown:
    """A model, and what it showed and told."""

    def __init__(self):
        self.images, self.told = [], []
        self.model = Model(*begun(), lambda *image: self.images.append(image), self.told.append)
        self.model.idle_delay = 0

    def after(self, change):
        """The fine image after a change of the state."""
        self.model.apply(change)
        assert self.model.wait()
        pixels, stage = self.images[-1]
        assert stage == "fine"
        return pixels.astype(float)


@pytest.fixture(scope="module")
def shown(side):
    made = Shown()
    made.after(lambda s: s)
    yield made
    made.model.close()


def test_a_coarse_image_is_followed_by_the_fine_one_of_render(shown, side, monkeypatch):
    state, scene = shown.model.state, shown.model.scene
    (first, stage), (last, _) = shown.images[0], shown.images[-1]
    assert last.shape == (27, 38, 3)
    for left, top in ((0, 0), (38 - side, 27 - side)):  # by the program of a tile
        camera = state.orbit.camera(state.size).crop(left, top, side, side)
        rendering = jv.render(BALL, state.transfer, camera, scene.march(state))
        expected = np.round(255 * np.asarray(to_srgb(np.asarray(rendering.image((0.2, 0.5, 0.8))))))
        difference = np.abs(last[top : top + side, left : left + side].astype(int) - expected)
        assert difference.max() <= 1
        assert np.mean(difference > 0) < 1e-3
    assert float(scene.march(state).step) == pytest.approx(0.4)
    assert stage == "coarse"
    rows, columns = (np.arange(n) * m // n for n, m in zip(SIZE[::-1], first.shape, strict=False))
    stretched = first[rows[:, None], columns[None, :]].astype(float)
    assert np.abs(stretched - last).mean() < 12  # the same view
    assert shown.told[0].startswith("compiling …")
    assert "RMSE" in shown.told[-1]
    monkeypatch.setattr("jaxvol.app.viewer.model.INTERVAL", 0.0)  # seconds until a part of it is shown
    shown.after(lambda s: s)
    assert shown.images[-2][1] == "drawing"


def test_changes_need_no_other_program(shown, side):
    """What a drag or a slider changes is traced: nothing is compiled again."""
    scene, state = shown.model.scene, shown.model.state
    changed = replace(state, step=state.step * 1.7, orbit=state.orbit.turned(0.1, 0.2).zoomed(1.3))
    transfer = with_points_at(with_window_level(state.transfer, 90, 110), [120])
    changed = replace(changed, transfer=transfer, size=(67, 43))
    before, after = TileRenderer(scene, state), TileRenderer(scene, changed, 4.0)
    before.coarse(1)
    grid = Grid.fine(changed.size)
    compiled: list[str] = []

    def note(event: str, duration_secs: float, **kwargs: str | int) -> None:
        compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(note)
    pixels = np.zeros((grid.rows * side, grid.columns * side, 3), np.uint8)
    after.draw(pixels, grid, 1, 1)
    assert after.program_key == before.program_key
    assert np.ptp(pixels[side:, side : 2 * side]) > 50
    assert not [event for event in compiled if "compile" in event]
    jax.jit(lambda x: x + 17.25)(np.float32(1))
    assert [event for event in compiled if "compile" in event]  # it would have been seen
    other = replace(state, enabled=state.enabled - {"SpaceLeaping"})
    assert TileRenderer(scene, other).program_key != before.program_key


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
    red = shown.after(lambda s: replace(state, transfer=with_color(state.transfer, 2, "red")))
    center = tuple(n // 2 for n in SIZE[::-1])
    assert red[center][2] < start[center][2] - 30  # less blue in what was white


def test_bad_input_and_faults_are_told_and_the_viewer_lives_on(shown):
    model, told = shown.model, len(shown.told)
    state = model.state
    for window, level in ((-1, 0), (1e-9, 1e3)):
        model.apply(lambda s, to=(window, level): replace(s, transfer=with_window_level(s.transfer, *to)))
    for size in ((0, 100), (math.nan, 100), (math.inf, 100)):
        model.resize(*size)
    assert model.state is state
    assert len(shown.told) == told + 2
    model.change(orbit=replace(state.orbit, view_up=np.zeros(3)))
    assert model.wait()
    assert shown.told[-1].startswith("not drawn:\nview_up")
    shown.after(lambda s: begun()[1])


def test_what_is_picked_lies_where_the_ray_meets_the_ball(shown):
    model = shown.model
    shown.after(lambda s: replace(s, transfer=with_opacity(s.transfer, 1, 1.0, 1.0)))  # opaque from 90 on
    orbit, center = model.state.orbit, np.asarray(BALL.center)
    model.pick(0.5, 0.5)
    voxels = np.linalg.norm((model.state.point - center) / np.asarray(BALL.spacing))
    assert 9 < voxels < 10.1  # opaque soon after 60, which is (200 - 60) / 14 voxels from the middle
    np.testing.assert_allclose(np.cross(model.state.point - center, orbit.toward), 0, atol=0.1)
    assert (model.state.point - center) @ orbit.toward > 0
    picked = model.state.point
    model.pick(0.01, 0.01)
    assert model.state.point is picked  # nothing is there
    model.state = begun()[1]


def test_a_saved_image_has_any_size_and_its_settings(tmp_path):
    path, done = tmp_path / "saved.png", threading.Event()
    drawn = Model(*begun(), lambda *_: None, lambda _: None, lambda png: path.write_bytes(png) and done.set())
    state = drawn.state = replace(drawn.state, isovalue=7.0, background=(0.0, 0.5, 1.0))
    drawn.save(2.5 * SIZE[0])
    assert done.wait(600)
    drawn.close()
    image = np.asarray(Image.open(path))
    assert image.shape == (68, 95, 3)
    np.testing.assert_array_equal(image[0, 0], (0, 188, 255))
    found = recorded_in(path)
    np.testing.assert_allclose(found["transfer"].extinction, LOOK.extinction, rtol=1e-6)
    options = parser_of_all().parse_args(["render", "volume.raw", *found["options"]])
    assert (options.size, options.shade, options.clip_box) == ([95, 68], False, None)
    place = [*state.orbit.position, *state.orbit.focal_point]
    np.testing.assert_allclose([*options.camera, options.step], [*place, 0.4], rtol=1e-6)


def until(condition):
    end = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.001)


def test_another_program_is_compiled_beside_the_old_image(monkeypatch):
    """By a renderer that notes what it is asked for, and waits when it compiles."""
    gate, drawn = threading.Semaphore(1), []

    class Renderer(TileRenderer):
        def overview(self):
            assert gate.acquire(timeout=60)
            gate.release()
            return np.zeros((2, 2, 3))

        def draw(self, pixels, grid, column, row):
            drawn.append(self.state)
            pixels[:] = 7

    monkeypatch.setattr("jaxvol.app.viewer.model.TileRenderer", Renderer)
    told: list[str] = []
    model = Model(*begun(), lambda *_: None, told.append)
    model.idle_delay = 0
    model.ask(model.state)
    assert model.wait(60)
    gate.acquire()
    count, first = len(drawn), model.state
    model.change(enabled=first.enabled | {"Jitter"}, lit=True)
    until(lambda: "compiling for Jitter, light" in told[-1])
    assert not model.wait(0.1)
    assert len(drawn) == count  # the old image stays
    model.change(orbit=first.orbit.turned(0.1, 0))
    until(lambda: len(drawn) > count)
    assert (drawn[-1].enabled, drawn[-1].lit) == (first.enabled, False)  # and follows by the old program
    assert drawn[-1].orbit is model.state.orbit
    gate.release()
    assert model.wait(60)
    assert drawn[-1] is model.state
    assert "compiling" not in told[-1]
    model.close()


def test_a_view_has_2048_pixels_on_a_side_at_most(shown, monkeypatch):
    monkeypatch.setattr(Model, "ask", lambda *_: None)
    state = shown.model.state
    shown.model.resize(4096, 1000.2)
    assert shown.model.state.size == (2048, 500)
    shown.model.state = state


def test_the_error_is_about_that_of_the_image(side):
    """Compared with steps a sixteenth as long."""
    scene, state = begun(march=jv.March(0.8, MARCH.transforms, "midpoint"))
    image, doubled, truth = (TileRenderer(scene, state, factor).overview() for factor in (1, 2, 1 / 16))
    assert estimated_error(image, doubled, "midpoint") == pytest.approx(float(rmse(image, truth)), rel=0.5)


def test_grids_cover_the_view_without_gaps(side):
    for size, most in ((SIZE, 1), (SIZE, 4), ((160, 90), 6), ((13, 113), 5)):
        for grid in (Grid.fine(size), Grid.coarse(size, most)):
            aspect = size[0] / size[1]
            tiles = sorted(grid.tiles())
            assert len(set(tiles)) == len(tiles) == grid.columns * grid.rows
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
    assert Grid.fine((3 * side + 5, 2 * side + 9)).tiles()[0] == (1, 1)


def test_the_coarse_level_settles_on_what_is_fast_enough():
    def settled(seconds_per_tile):
        level, seconds = 2, 0.0
        for _ in range(20):
            tiles, step_factor = LEVELS[level]
            seconds = tiles * seconds_per_tile * (0.4 + 0.6 / step_factor)
            level = adapted(level, seconds, 100)
        return level, seconds

    level, seconds = settled(0.02)
    assert BUDGET / 2.5 <= seconds <= BUDGET
    assert LEVELS[level][0] > 1
    assert settled(0.3)[0] == 0
    assert settled(1e-6)[0] == len(LEVELS) - 1
    assert LEVELS[adapted(5, 1e-6, 2)][0] == 1


def equal_arrays(one, other):
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.allclose(a, b, rtol=1e-6) for a, b in pairs)


@pytest.fixture
def controlled(monkeypatch):
    """A function that makes a model that draws nothing, and its controls by their labels."""
    monkeypatch.setattr(Model, "ask", lambda *_: None)
    models = []

    def made(*scene, **more):
        models.append(Model(*begun(*scene, **more), lambda *_: None, lambda _: None))
        controls = [control for group in controls_of(models[-1]).values() for control in group]
        return models[-1], {control.label or control.kind: control for control in controls}

    yield made
    for model in models:
        model.close()


def test_the_controls_change_the_points_that_they_show(controlled):
    """By presses on the curve, of values from 22 to 200 and heights that are square roots of opacities."""
    model, controls = controlled()
    data = np.asarray(BALL.data)
    low, high = float(data.min()), float(data.max())

    def press(gesture, part, value, opacity, *, twice="false"):
        x, y = (value - low) / (high - low), 1 - math.sqrt(opacity) * 108 / 110
        controls["curve"].set(f"{gesture},curve,{part},{twice},{x:.5f},{y:.5f}")

    def values():
        return model.state.transfer.values.tolist()

    given = values()
    press(1, "1", 95, 0.3)
    assert values() == given  # it is only chosen
    press(1, "1", 110.04, 0.3)
    assert values() == [60, 110, 200]
    assert controls["value"].get() == 110
    assert controls["opacity"].get() == pytest.approx(0.3, abs=1e-3)
    controls["color"].set("#ff0000")
    np.testing.assert_allclose(np.asarray(model.state.transfer.colors)[1], (1, 0, 0))
    press(2, "", 150, 0.9)
    assert values() == [60, 110, 150, 200]
    np.testing.assert_allclose(np.asarray(model.state.transfer.colors)[2], (1, 4 / 9, 4 / 9), atol=1e-6)
    press(2, "", 160, 0.6)  # what was added is dragged on
    assert values() == [60, 110, 160, 200]
    for value in (160, 170):
        press(3, "2", value, 0.6, twice="true")
    assert values() == [60, 110, 200]
    for message in ("", "4,curve,x,false,0,0", "4,curve,,false,nan,0"):
        with suppress(ValueError):
            controls["curve"].set(message)
    assert values()[0] == 60
    controls["level"].set(150.0)
    assert values() == [80, 130, 220]
    controls["preset"].set("as given")
    assert values() == given
    full, controls = controlled(BALL, jv.colormap("gray", (0, 150), n_colors=16))
    press(4, "", 190, 0.5)  # past the last point, where there is no room for another
    press(4, "", 170, 0.7)
    assert len(full.state.transfer.values) == 16
    assert equal_arrays(full.state.transfer, full.first.transfer)
    assert controls["value"].get() == 150
    many, controls = controlled(BALL, jv.colormap("gray", (0, 200), n_colors=40))
    assert "value" not in controls
    for opacity in (0.5, 0.7):
        press(5, "", 100, opacity)
    assert equal_arrays(many.state.transfer, many.first.transfer)
    controls["window"].set(100.0)
    assert float(np.asarray(many.state.transfer.values)[0]) == pytest.approx(50)


def test_a_face_that_fails_does_not_end_the_thread(shown, monkeypatch, caplog):
    def fails(*_):
        raise RuntimeError("the page was closed")

    monkeypatch.setattr(shown.model, "_face", (fails, fails))
    shown.model.change(step=1.3 * shown.model.state.step)
    assert shown.model.wait()
    assert "a viewer's page or widget failed" in caplog.text
    monkeypatch.undo()
    shown.after(lambda s: s)


def test_an_orthographic_view_stands_before_all_that_it_shows(controlled):
    """Of a long volume along its axis, from as near as its narrow side allows."""
    long = jv.Volume(np.full((4, 4, 100), 200, np.uint8))
    model, controls = controlled(long, jv.colormap("gray", (0, 255)), None)
    controls["orthographic"].set(True)
    controls["look from"].set("+z")
    camera = model.scene.camera(model.state, (8, 8))
    assert float(camera.position[2]) > 99
    assert float(camera.parallel_scale) < 4
    options = model.scene.settings(model.state)
    assert options["camera"][2] > 99
    height = np.tan(np.deg2rad(options["view_angle"]) / 2) * (options["camera"][2] - options["camera"][5])
    assert height == pytest.approx(float(camera.parallel_scale), rel=1e-3)


def test_the_controls_change_march_and_light(controlled):
    model, controls = controlled(lit=True)
    controls["Jitter"].set(True)
    controls["SpaceLeaping"].set(False)
    controls["light"].set(False)
    assert model.state.enabled == {"Jitter", "AlphaCorrection"}
    assert controls["Jitter"].get()
    assert not model.state.lit
    for step, expected in ((0.5, 0.5), (0.0, 1 / 16), (1e9, 16)):
        controls["step (voxels)"].set(step)
        assert model.state.step == expected
    controls["look from"].set("+z")
    np.testing.assert_allclose(model.state.orbit.toward, (0, 0, 1), atol=2e-3)
    head = jv.Volume(BALL.data, BALL.spacing, origin=(0, 0, 1))  # of a patient, whose front, at -y, is up
    for side, up in (("+z", -1), ("-z", -1)):
        lying, its = controlled(head)
        its["look from"].set(side)
        assert lying.state.orbit.axes()[1][1] == pytest.approx(up, abs=1e-3)
    controls["background"].set("#ffffff")
    for mode, background, lit in (("maximum", (0, 0, 0), False), ("isosurface", (1, 1, 1), True)):
        controls["mode"].set(mode)
        assert (model.state.background, model.state.lit) == (background, lit)
    assert model.scene.settings(model.state)["isovalue"] == model.state.isovalue != 0
    controls["background"].set("#ff0000")
    controls["mode"].set("maximum")  # keeps a colour that was chosen
    assert model.state.background == (1, 0, 0)
    labels, controls = controlled(LABELS, None)
    controls["mode"].set("average")  # which labels cannot be shown by
    assert labels.state.mode == "over"


def test_a_box_and_a_plane_clip_what_is_shown(controlled):
    model, controls = controlled()
    assert not model.state.clip
    controls["depth"].set(0.5)
    assert model.state.clip
    controls["x"].set((3.0, 9.0))
    controls["cut from"].set("view")
    orbit = model.state.orbit
    clip = model.scene.march(model.state).transforms[0]
    assert isinstance(clip, jv.Clip)
    assert clip.box is not None
    np.testing.assert_allclose(clip.box, (3, 9, *np.asarray(BALL.bounds)[2:]))
    plane = np.concatenate([clip.origins, clip.normals])
    np.testing.assert_allclose(plane, (BALL.center, -orbit.toward), rtol=1e-5)
    for depth in (-1.0, 1.0):  # from nothing to all
        controls["depth"].set(depth)
        origin, normal = model.scene.plane(model.state)
        heights = (np.array(list(product(*np.asarray(BALL.bounds).reshape(3, 2)))) - origin) @ normal
        assert np.all(np.sign(heights) == -depth)
    options = model.scene.settings(model.state)
    assert options["clip_box"] == model.state.box
    np.testing.assert_array_equal(options["clip_plane"], [[*origin, *normal]])


def test_slices_pass_through_the_point_and_move_it(controlled):
    data = np.tensordot((1, 2, 4), np.indices((24, 24, 24)), 1).astype(np.uint8)
    turned = jv.Volume(data, (1, 1.2, 0.8), (5, 6, 7), direction=[(0, 1, 0), (-1, 0, 0), (0, 0, 1)])
    model, controls = controlled(turned)
    pad = controls["slices"]

    def at(*index):
        return np.add((5, 6, 7), (1.2 * index[1], -index[0], 0.8 * index[2]))

    pad.set("1,2,,false,0.25,1")  # across z: x of the data runs along -y of the world, and y along x
    np.testing.assert_allclose(model.state.point, at(0.75 * 23, 0, 11.5), rtol=1e-6)
    pad.set("2,0,,false,1,0")
    with pytest.raises(ValueError, match="the position of a press must be two numbers"):
        pad.set("2,0,,false,nan,0")
    np.testing.assert_allclose(model.state.point, at(0.75 * 23, 23, 23), rtol=1e-6)
    told = re.search(r"at \((.*)\): (.*)</div>", pad.get())
    assert told is not None
    assert [float(each) for each in told[1].split(", ")] == pytest.approx(model.state.point, rel=1e-3)
    assert float(told[2]) == float(data[17, 23, 23])
    pictures = [Image.open(io.BytesIO(base64.b64decode(p))) for p in re.findall('base64,(.*?)"', pad.get())]
    # x of the data is drawn to the right, and against the world's y; y upwards, as the world's x
    for picture, expected in zip(
        pictures, (data[17, :, ::-1], data[::-1, 23, ::-1], data[::-1, ::-1, 23]), strict=True
    ):
        seen, whole = np.asarray(picture), Image.fromarray(np.ascontiguousarray(expected.T))
        grey = np.ptp(seen, axis=-1) == 0  # not the lines through the point
        assert np.corrcoef(seen[grey][:, 0], np.asarray(whole.resize(picture.size))[grey])[0, 1] > 0.99


def test_labels_are_shown_and_changed_by_their_controls(controlled):
    model, controls = controlled(LABELS, None)
    given = model.state.transfer
    assert controls["label"].choices == ["1", "2"]
    assert "#1f77b4" in controls["labels"].get()
    middle = tuple(np.array(model.scene.volume.shape) // 2)
    model.state = replace(model.state, point=np.asarray(model.scene.volume.origin) + middle)
    assert controls["slices"].get().endswith(f", label {np.asarray(model.scene.volume.labels)[middle]}</div>")
    controls["shown"].set(False)
    assert not controls["shown"].get()
    controls["labels"].set("1,labels,9,false,0.5,0.5")  # which there is not
    controls["labels"].set("1,labels,1,false,0.5,0.5")
    assert controls["label"].get() == "2"
    assert controls["shown"].get()
    controls["opacity"].set(0.02)
    expected = given.with_visibility({1: False}).with_opacity({2: 0.02})
    assert equal_arrays(model.state.transfer, expected)
    controls["opacity"].set(math.nan)
    assert equal_arrays(model.state.transfer, expected)
    data = np.asarray(LABELS.data)
    unseen, one = (
        jv.LabelTransferFunction({1: jv.TransferFunction([0, 100, 255], np.ones((3, 3)), [0, top, 2 * top])})
        for top in (0, 1)
    )
    assert "label" not in controlled(LABELS_OF_ONES, unseen)[1]
    assert "label" in controlled(jv.Volume(data, labels=data), one)[1]["slices"].get()  # of 2 there is none
    _, controls = controlled(jv.Volume(np.where(data == 2, np.uint8(9), data)), None)
    assert controls["label"].choices == ["1", "9"]  # as in the file


def test_a_table_is_shown_and_not_edited(controlled):
    given = jv.TransferFunction2D((0, 1), (2, 18), np.ones((2, 2, 3)), np.ones((2, 2)))
    model, controls = controlled(BALL, given)
    assert model.state.transfer is given
    assert not {"window", "level", "point"} & controls.keys()
    assert "not edited" in controls["pad"].get()


def test_a_transfer_function_is_found_where_none_is_given():
    _, state = begun(transfer=None, camera=None, march=None)
    assert equal_arrays(state.transfer, jv.automatic_transfer(BALL))


def test_what_the_viewer_does_not_show_is_refused():
    bad = [
        ({"volume": np.zeros((3, 3, 3)), "transfer": None}, "volume must be a jaxvol Volume"),
        ({"transfer": MARCH}, "transfer must be"),
        ({"camera": MARCH}, "camera must be"),
        ({"march": jv.March(20.0)}, r"march must .* from 0\.05 to 12\.8, 0\.0625 to 16 voxels, .* got one"),
        ({"lighting": PHONG, "compositing": "average"}, "lighting must be None under Average"),
        ({"volume": LABELS, "transfer": None, "compositing": "average"}, "LabelTransferFunction reads more"),
    ]
    bad += [({"background": each}, "background must") for each in ((1, 2), None, "whit", (0, 0, math.inf))]
    for camera in (None, jv.Camera.looking_at(BALL)):
        bad += [({"size": size, "camera": camera}, "size must") for size in (None, (3,), (0, 5))]
    for given, message in bad:
        with pytest.raises(ValueError, match=message):
            begun(**given)


PHONG = jv.lighting.Phong()
MODES = ["over", "maximum", "minimum", "average", jv.FirstVisible(), jv.Isosurface(90.0)]


def test_every_mode_is_shown_as_it_begins_and_lit_where_it_can_be(side):
    for mode in MODES:
        scene, state = begun(march=None, lit=True, compositing=mode)
        renderer = TileRenderer(scene, state)
        if mode in MODES[-3::2]:
            grid = Grid(1, 1, (side, side))
            tile = jax.eval_shape(lambda r=renderer, g=grid: r.rgba(g, 0, 0))  # compiles nothing
            assert tile.shape == (side, side, 4)
        assert (scene.light(state) is not None) == (mode != "average")
    for given in (None, PHONG):
        for lit in (True, False):
            scene, state = begun(lighting=given, lit=lit)
            assert state.lit is lit
            assert isinstance(scene.lighting, jv.lighting.Phong)
            assert (scene.light(state) is not None) is lit


def test_another_volume_is_in_the_image(side):
    small = jv.Volume(np.full((5, 5, 5), 9, np.uint8), (0.5,) * 3, np.asarray(BALL.center) - (1, 14, 1))
    other = small, jv.TransferFunction([0, 9], np.array([[1.0, 0, 0]] * 2), [2.0, 2.0])
    scene, state = begun(march=None, lit=True, others=[other])
    assert set(scene.modes) == {"over", "integral"}
    assert scene.light(state) is None
    assert state.step * scene.voxel == pytest.approx(0.25)
    red = np.asarray(TileRenderer(scene, state).rgba(Grid(1, 1, (side, side)), 0, 0))[..., 0]
    volumes, transfers = zip((BALL, LOOK), other, strict=True)
    camera = state.orbit.camera((side, side), (-SIZE[0] / SIZE[1], SIZE[0] / SIZE[1], -1, 1))
    expected = np.asarray(jv.render(volumes, transfers, camera, scene.march(state)).rgba)[..., 0]
    np.testing.assert_allclose(red, expected, atol=1e-5)
    bad: list[tuple[dict[str, Any], str]] = [
        ({"others": [small]}, "others must be pairs"),
        ({"others": other}, "others must be pairs"),
        ({"others": [other], "compositing": "maximum"}, 'must be "over" or "integral"'),
    ]
    for given, message in bad:
        with pytest.raises(ValueError, match=message):
            begun(**given)


def test_without_a_march_the_defaults_are_on_and_all_others_are_offered():
    scene, state = begun(transfer=None, march=None, lit=True)
    assert state.enabled == {"AlphaCorrection", "SpaceLeaping", "EarlyTermination"}
    assert state.lit
    assert {jv.Jitter, jv.EmptySpaceJitter} <= set(map(type, scene.transforms))
    clip = jv.Clip(box=(0, 5, 0, 5, 0, 5))
    scene, state = begun(march=jv.March(0.2, (clip,)))
    assert isinstance(scene.transforms[0], jv.Clip)
    assert state.enabled == {"Clip"}
    assert scene.voxel == pytest.approx(0.8)
    assert state.step == pytest.approx(0.25)
    march = scene.march(replace(state, enabled=frozenset({"Jitter"})))
    assert [type(t).__name__ for t in march.transforms] == ["Jitter"]
