"""Does `experiments.pareto` find the right fronts, resume, make points again, and write a page that works?"""

import json
import re
import shlex
import shutil
from argparse import Namespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from experiments import (
    pareto,
    pareto_chart,
    pareto_measure,
    pareto_page,
    pareto_points,
    pareto_programs,
    pareto_reference,
    pareto_scenes,
    record,
)
from experiments.pareto_front import behind, front
from experiments.pareto_points import BASE, SETTINGS, Setting
from experiments.pareto_programs import Program
from experiments.pareto_scenes import ROWS, Case
from experiments.scenes import PHANTOM, Scene

from .browser import CHROMIUM, opened


SIZES = pareto_measure.Sizes(32, 16, 2, 4)
OPAQUE = f"{PHANTOM}, opaque"


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        ([], []),
        ([(1, 1)], [0]),
        ([(1, 3), (2, 2), (3, 1)], [0, 1, 2]),
        ([(3, 1), (2, 2), (1, 3)], [2, 1, 0]),
        ([(1, 3), (2, 4), (3, 1), (2, 2)], [0, 3, 2]),
        ([(1, 2), (1, 1), (2, 1)], [1]),  # as good in one, better in the other
        ([(1, 1), (1, 1)], [0, 1]),
        ([(float("inf"), 1), (1, 2)], [1, 0]),
    ],
)
def test_front_of_few_points(points, expected):
    assert front(points) == expected


def test_no_point_is_better_than_one_of_the_front():
    points = np.random.default_rng(0).integers(0, 12, (60, 2)).astype(float)
    better = (points[:, None] <= points[None]).all(-1) & (points[:, None] < points[None]).any(-1)
    assert sorted(front([(x, y) for x, y in points])) == np.flatnonzero(~better.any(0)).tolist()


@pytest.mark.parametrize("points", [[(1, float("nan"))], [(1, 2, 3)], [1, 2]])
def test_bad_points_are_named(points):
    with pytest.raises(ValueError, match="points must be pairs"):
        front(points)


def test_points_of_peers_ahead_of_ours_are_found_with_what_we_miss():
    ours = [(0.01, 2.0), (0.1, 1.0)]
    theirs = {"worse": (0.02, 3.0), "equal": (0.01, 2.0), "faster": (0.02, 1.0), "best": (0.001, 0.1)}
    found = behind(ours, theirs)
    assert found == {"faster": {"time": 2.0, "error": 5.0}, "best": {"time": None, "error": None}}
    rounding = {"rounded": (0.00999, 2.0)}
    assert behind(ours, rounding) == {"rounded": {"time": None, "error": pytest.approx(1.001, rel=1e-4)}}
    assert behind(ours, rounding, same=0.01) == {}


def test_tables_cover_every_kind_and_names_are_unique_as_files():
    rows = ROWS.values()
    assert {row.view for row in rows} == {"outside", "inside"}
    assert {row.look for row in rows} == {"translucent", "opaque", "thin peak"}
    assert {(row.toroidal, row.file is None) for row in rows} >= {(True, True), (True, False), (False, False)}
    assert {(row.lit, row.file is None) for row in rows} >= {(True, True), (True, False)}
    for names in (ROWS, SETTINGS):
        assert len({pareto_measure.slug(name) for name in names}) == len(names)
    assert {setting.family for setting in SETTINGS.values()} == set(pareto_chart.COLORS)
    assert len(set(pareto_chart.COLORS.values())) == len(pareto_chart.COLORS)
    assert set(pareto_points.GRADIENTS) <= set(pareto_points.UNLIT)
    for row in rows:
        settings = pareto_points.of(row, {"VTK": "9", "Dr.Jit": "not here: no LLVM"})
        assert next(iter(settings)) == pareto_points.base_of(row)
        families = {setting.family for setting in settings.values()}
        assert ("VTK" in families) == (row.peers is None)
        assert "Dr.Jit" not in families


def ct():
    data = np.linspace(-1000, 3000, 64).astype(np.int16).reshape(4, 4, 4)
    volume = jv.Volume(data)
    camera = jv.Camera.looking_at(volume, size=(32, 32))
    return Case(Scene(volume, jv.preset("ct_chest"), camera, 1.0))


@pytest.mark.parametrize("kind", ["uint8", "uint16", "float16", "float32"])
def test_voxels_of_another_type_look_the_same_up_to_rounding(kind):
    case = ct()
    other = pareto_programs.stored(kind, case).scene
    assert other.volume.data.dtype == kind
    at = (jnp.asarray(s.volume.data, jnp.float32).ravel() for s in (case.scene, other))
    (_, before), (_, after) = (
        jax.vmap(s.transfer)(values) for s, values in zip((case.scene, other), at, strict=True)
    )
    # half a level times the steepest slope of the extinction
    slope = np.abs(np.diff(case.scene.transfer.extinction) / np.diff(case.scene.transfer.values)).max()
    level = {"uint8": 4000 / 255, "uint16": 4000 / 65535, "float16": 2, "float32": 0}[kind]
    assert np.abs(np.asarray(before - after)).max() <= slope * level / 2 + 1e-5
    assert (kind == "uint8") == bool(np.abs(np.asarray(before - after)).max() > 1e-3)


def test_a_table_has_the_values_of_its_transfer_function():
    case = ct()
    table = pareto_programs.tabulated(64, case).scene.transfer
    assert table.values.shape == (64,)
    assert table.values[0] == case.scene.transfer.values[0]
    assert table.values[-1] == case.scene.transfer.values[-1]
    _, exact = jax.vmap(case.scene.transfer)(table.values)
    np.testing.assert_allclose(table.extinction, exact, rtol=1e-6)


@pytest.fixture
def counted(monkeypatch):
    """Settings that render nothing and count how often they are made; the reference is all grey."""
    made = []

    def setting(name, family, error):
        def make(case):
            made.append(name)
            if made.count("stop") == 1 and name == "stop":
                raise KeyboardInterrupt
            size = case.scene.camera.size[0]
            return Program(lambda: jnp.zeros(()), lambda: np.full((size, size, 3), 0.5 + error))

        return Setting(family, make)

    settings = {
        BASE: setting(BASE, "midpoint", 0.25),
        "a": setting("a", "left", 0.125),
        "stop": setting("stop", "adaptive", 0.0625),
    }
    monkeypatch.setattr(pareto_points, "of", lambda row, there: settings)
    monkeypatch.setattr(pareto_measure, "case_of", lambda row, sizes: ct())
    monkeypatch.setattr(pareto_reference, "converged", lambda case, *_: np.full((32, 32, 3), 0.5))
    monkeypatch.setattr(pareto_reference, "own_error", lambda *_: {"rmse": 1e-3})
    return made


def test_what_is_finished_is_not_measured_again(counted, tmp_path, monkeypatch):
    def measured(sizes=SIZES):
        counted[:] = [name for name in counted if name == "stop"]
        return pareto_measure.scene(OPAQUE, tmp_path, sizes, {}, say=lambda _: None)

    with pytest.raises(KeyboardInterrupt):
        measured()
    assert counted == [BASE, BASE, "a", "stop"]
    kept = measured()
    assert counted == ["stop", BASE, "stop"]  # what was not finished, beside the base
    assert {n: p["rmse"] for n, p in kept["points"].items()} == {BASE: 0.25, "a": 0.125, "stop": 0.0625}
    assert measured() == kept
    assert counted == ["stop", "stop"]
    measured(SIZES._replace(repetitions=3))
    assert counted == ["stop", "stop", BASE, BASE, "a", "stop"]
    monkeypatch.setattr(pareto_measure, "state", lambda: "another")
    measured(SIZES._replace(repetitions=3))
    assert counted == ["stop"] * 3 + [BASE, BASE, "a", "stop"]
    assert {file.suffix for file in tmp_path.iterdir()} == {".json", ".npy", ".webp"}


@pytest.fixture
def page(tmp_path):
    """A page of two scenes, one of them lit, from a record that was not measured."""
    errors = {BASE: 0.01, "left, step 1": 0.02, "VTK, step 1": 0.015, "adaptive, tolerance 0.01": 0.002}
    scenes = {}
    for name, factor in ((PHANTOM, 1.0), (f"{PHANTOM}, lit", 3.0)):
        folder = tmp_path / "pareto" / pareto_measure.slug(name)
        folder.mkdir(parents=True)
        points = {}
        for number, (point, error) in enumerate(errors.items()):
            ratio = {"median": factor * (1 + number)}
            points[point] = {"family": SETTINGS[point].family, "seconds": 0.1, "ratio": ratio, "rmse": error}
            points[point] |= {"psnr": 40.0, "ssim": 0.9 + error, "wood grain": 1e-6}
            color = np.random.default_rng(number).random((32, 64, 3), np.float32)
            pareto_measure.small(color).save(folder / f"{pareto_measure.slug(point)}.webp")
        kept = {"points": points, "base": {"midpoint": [0.1, 0.2, 0.3]}, "pixels": 32}
        scenes[name] = pareto.concluded(name, {**kept, "reference": {"rmse": 1e-4}}, ["--quick"])
    result = {"repetitions": 3, "peers": {"VTK": "9"}, "summary": pareto.summary(scenes), "scenes": scenes}
    file = record.write(tmp_path / "pareto.json", "?", result, seed=0, command=["experiments.pareto"])
    return pareto_page.write(file, tmp_path / "pareto", tmp_path / "pareto.html")


def test_a_record_says_where_peers_are_ahead_and_how_to_make_a_point_again(page):
    scene = record.read(page.with_suffix(".json"))["result"]["scenes"][PHANTOM]
    assert scene["front of jaxvol"] == ["adaptive, tolerance 0.01", BASE]
    assert scene["base seconds"] == 0.2
    assert scene["points"]["left, step 1"]["time"] == pytest.approx(0.4)
    assert scene["jaxvol's front is left of and below all points of VTK and Dr.Jit"]
    module, *words = shlex.split(scene["points"]["left, step 1"]["command"])[2:]
    assert module == "experiments.pareto"
    assert words == ["--scene", PHANTOM, "--point", "left, step 1", "--quick"]


def test_the_page_needs_no_network(page):
    text = page.read_text(encoding="utf-8")
    assert not re.findall(r"https?:|src=\"(?!\$)|<link|@import|url\(", text)
    assert "/*DATA*/" not in text


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed: apt-get install chromium")
def test_the_page_shows_what_is_pointed_at_and_what_is_chosen(page):
    with opened(page) as browser:
        count = "document.querySelectorAll('.point').length"
        assert browser.evaluate(count) == 8
        browser.point_at('.point[data-s="0"][data-p="1"]')
        text = browser.evaluate("document.querySelector('#detail').innerText")
        for shown in ("left, step 1", PHANTOM, "400 ms", "0.02", "40 dB", "0.92", "--point 'left, step 1'"):
            assert shown in text
        width = "(i => i.decode().then(() => i.naturalWidth))(document.querySelector('#detail img'))"
        assert browser.evaluate(width) == 2 * pareto_measure.SIDE
        assert browser.evaluate("document.querySelectorAll('.point.same').length") == 2
        # a click keeps the point while the mouse moves on
        browser.point_at('.point[data-s="1"][data-p="0"]', click=True)
        browser.point_at('.point[data-s="0"][data-p="1"]')
        assert BASE in browser.evaluate("document.querySelector('#detail h3').innerText")

        browser.point_at("#families input", click=True)  # left
        assert browser.evaluate(count) == 6
        browser.point_at("#none", click=True)
        assert browser.evaluate(count) == 0
        browser.point_at("#all", click=True)
        choose = (
            "(s => {{s.value = '{}'; s.dispatchEvent(new Event('change'))}})(document.querySelector('{}'))"
        )
        for value, selector, left in (("lit", "#kind", 4), ("all", "#kind", 8), (PHANTOM, "#scene", 4)):
            browser.evaluate(choose.format(value, selector))
            assert browser.evaluate(count) == left
            assert browser.evaluate("document.querySelectorAll('figure').length") == left / 4
        assert browser.faults == []


@pytest.mark.slow
def test_the_reference_of_a_homogeneous_cube_is_its_closed_form():
    volume = jv.phantom("constant", 8)
    transfer = jv.TransferFunction([0.0, 1.0], [[0.5, 0.25, 0.0]] * 2, [1.5, 1.5])
    camera = jv.Camera.looking_at(volume, (0, -1, 0), size=(32, 32), parallel=True)
    case = Case(Scene(volume, transfer, camera, 0.1))
    row = pareto_scenes.Row(lambda *_: case, finer=4)
    truth = pareto_reference.converged(case, row)
    left = np.exp(-1.5 * float(volume.corners[1][1] - volume.corners[0][1]))
    np.testing.assert_allclose(truth[16, 16], left + (1 - left) * np.array([0.5, 0.25, 0]), rtol=1e-5)
    own = pareto_reference.own_error(case, row, truth)
    assert 0 < own["rmse"] < 1e-5


@pytest.mark.slow
def test_a_point_is_made_again_by_its_command(tmp_path, capsys):
    pareto.main(["--quick", "--output", str(tmp_path), "--scene", OPAQUE])
    result = record.read(tmp_path / "pareto.json")["result"]["scenes"][OPAQUE]
    written = (tmp_path / "pareto.json").read_bytes()
    for name in (BASE, "jittered, step 1", "stored as uint16"):
        point = result["points"][name]
        capsys.readouterr()
        pareto.main([*shlex.split(point["command"])[3:], "--output", str(tmp_path)])
        again = json.loads(capsys.readouterr().out.partition("\n")[2])
        assert again["rmse"] == point["rmse"]
        assert again["ssim"] == point["ssim"]
        assert again["seconds"] > 0
        assert (tmp_path / "pareto" / f"head-phantom-opaque, {pareto_measure.slug(name)}.png").is_file()
    assert (tmp_path / "pareto.json").read_bytes() == written
    pareto.main(["--quick", "--output", str(tmp_path), "--scene", OPAQUE])
    assert "kept, " in capsys.readouterr().out
    assert record.read(tmp_path / "pareto.json")["result"]["scenes"][OPAQUE] == result


@pytest.mark.slow
def test_a_lit_scene_s_error_falls_with_more_photons(tmp_path):
    name = f"{PHANTOM}, lit"
    asked = ("lit, midpoint, step 1", "photons 1", "all photons", "baked 32")
    kept = pareto_measure.scene(
        name, tmp_path, SIZES._replace(templates=64), {}, lambda of: {n: of[n] for n in asked}
    )
    points = kept["points"]
    assert set(points) == set(asked)
    assert points["all photons"]["rmse"] < points["photons 1"]["rmse"]
    assert kept["reference"]["error by the number of templates"] < points["all photons"]["rmse"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--point", "no such"], "--point must be one of"),
        (["--point", BASE, "--scene", PHANTOM, OPAQUE], "--point is of one scene"),
    ],
)
def test_bad_options_are_named(words, message, tmp_path):
    scene = [] if "--scene" in words else ["--scene", OPAQUE]
    with pytest.raises(ValueError, match=message):
        pareto.main(["--quick", *words, *scene, "--output", str(tmp_path)])


def test_a_scene_whose_volume_is_missing_is_left_out(monkeypatch):
    monkeypatch.delenv("JAXVOL_DATA", raising=False)
    assert pareto.there(None)
    assert not pareto.there(pareto_scenes.ENGINE)


def test_scenes_that_are_not_chosen_keep_what_was_recorded_and_their_pictures(page, tmp_path):
    path, pictures = page.with_suffix(".json"), pareto_page.pictures_of(page)
    assert all(pictures[PHANTOM][name] for name in (BASE, "VTK, step 1"))
    found = record.read(path)
    sizes = {"repetitions": 3, "resolution": 192, "seed": 0, "quick": False, "output": tmp_path}
    found["result"]["voxels along an axis of phantoms"] = 192
    path.write_text(json.dumps(found))
    kept = pareto.recorded(Namespace(scene=[PHANTOM], **sizes))
    assert list(kept) == [f"{PHANTOM}, lit"]
    assert kept[f"{PHANTOM}, lit"]["measured"]["command"] == found["command"]
    assert not pareto.recorded(Namespace(scene=[PHANTOM], **{**sizes, "repetitions": 5}))
    shutil.rmtree(tmp_path / "pareto")
    assert pareto_page.pictures_of(pareto_page.write(path, tmp_path / "pareto", page)) == pictures
