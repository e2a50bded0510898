"""Does `experiments.pareto` find the right fronts, and measure each setting beside the base?"""

from argparse import Namespace

import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from experiments import charts, pareto, pareto_measure, pareto_points
from experiments.pareto import behind, front
from experiments.pareto_page import GRAIN, grain_chart
from experiments.pareto_points import BASE, SETTINGS, Setting
from experiments.pareto_scenes import ROWS
from experiments.programs import Case, Program
from experiments.scenes import PHANTOM, Scene


SIZES = Namespace(size=32, resolution=16, repetitions=2, templates=4)
OPAQUE = f"{PHANTOM}, opaque"
FRONTS = [
    ([], []),
    ([(1, 3), (2, 2), (3, 1)], [0, 1, 2]),
    ([(1, 3), (2, 4), (3, 1), (2, 2)], [0, 3, 2]),
    ([(1, 2), (1, 1), (2, 1)], [1]),  # as good in one, better in the other
    ([(1, 1), (1, 1)], [0, 1]),
    ([(float("inf"), 1), (1, 2)], [1, 0]),
]


def test_front_of_few_points():
    for points, expected in FRONTS:
        assert front(points) == expected


def test_points_of_peers_ahead_of_ours_are_found_with_what_we_miss():
    ours = [(0.01, 2.0), (0.1, 1.0)]
    theirs = {"worse": (0.02, 3.0), "equal": (0.01, 2.0), "faster": (0.02, 1.0), "best": (0.001, 0.1)}
    found = behind(ours, theirs)
    assert found == {"faster": {"time": 2.0, "error": 5.0}, "best": {"time": None, "error": None}}
    rounding = {"rounded": (0.00999, 2.0)}
    assert behind(ours, rounding) == {"rounded": {"time": None, "error": pytest.approx(1.001, rel=1e-4)}}
    assert behind(ours, rounding, same=0.01) == {}


def test_names_are_unique_as_files_and_settings_begin_with_the_base():
    assert SETTINGS["uniform"].keys() <= SETTINGS["unlit"].keys()
    others = [settings for kind, settings in SETTINGS.items() if kind != "uniform"]
    for names in (ROWS, [name for settings in others for name in settings]):
        assert len({pareto_measure.slug(name) for name in names}) == len(names)
    for row in ROWS.values():
        settings = pareto_points.of(row, {"VTK": "9", "Dr.Jit": "not here: no LLVM"})
        assert next(iter(settings)) == pareto_points.base_of(row)
        families = {setting.family for setting in settings.values()}
        assert ("VTK" in families) == (row.peers is None)
        assert "Dr.Jit" not in families


def test_each_setting_is_measured_beside_the_base_and_has_a_picture(monkeypatch, tmp_path):
    """Settings that render nothing; the reference is all grey."""

    def setting(family, error):
        return Setting(
            family, lambda case: Program(lambda: jnp.zeros(()), lambda: np.full((32, 32, 3), 0.5 + error))
        )

    settings = {BASE: setting("midpoint", 0.25), "a": setting("left", 0.125), "b": setting("left", 0.0625)}
    volume = jv.Volume(np.zeros((4, 4, 4), np.uint8))
    camera = jv.Camera.looking_at(volume, size=(32, 32))
    case = Case(Scene(volume, jv.preset("engine"), camera, 1.0))
    monkeypatch.setattr(pareto_measure, "case_of", lambda row, chosen: case)
    monkeypatch.setattr(pareto_measure, "converged", lambda case, *_: np.full((32, 32, 3), 0.5))
    monkeypatch.setattr(pareto_measure, "own_error", lambda *_: {"rmse": 1e-3})
    found = pareto_measure.scene(OPAQUE, tmp_path, SIZES, settings)
    assert {n: p["rmse"] for n, p in found["points"].items()} == {BASE: 0.25, "a": 0.125, "b": 0.0625}
    assert found["points"][BASE]["ratio"]["median"] == 1
    assert len(found["base seconds"]) == 2 * SIZES.repetitions  # beside each family
    pictures = {file.stem for file in tmp_path.iterdir()}
    assert pictures == {"reference", *map(pareto_measure.slug, settings)}
    entry = pareto.concluded(OPAQUE, found, ["--quick"])
    assert set(entry["points"]) == set(settings)
    assert entry["points"]["a"]["command"].endswith("--point a --quick")


def test_bad_options_are_named(tmp_path):
    for words, message in (
        (["--scene", OPAQUE, "--point", "no such"], "--point must be one of"),
        (["--scene", PHANTOM, OPAQUE, "--point", BASE], "--point is of one scene"),
    ):
        with pytest.raises(ValueError, match=message):
            pareto.main(["--quick", *words, "--output", str(tmp_path)])


def test_energies_below_what_chance_gives_are_drawn_at_one_place_of_the_chart_of_wood_grain():
    energies = dict(zip(GRAIN["equidistant"], (2e-9, 2e-6, 4e-6, 5e-5, 1e-3), strict=True))
    energies |= {"jittered, step 1": -3e-6, "jittered, step 2": 2.9e-6}
    points = {name: {"wood grain": energy, "time": 1.0} for name, energy in energies.items()}
    figure = grain_chart({"scenes": {"engine": {"pixels": 256, "points": points}}})
    equidistant, jittered = (line.get_xdata() for line in figure.axes[0].lines[:2])
    assert list(equidistant[2:]) == [4e-6, 5e-5, 1e-3]
    assert {*equidistant[:2], *jittered} == {1.5e-6}  # half of the largest below 0
    charts.plt.close(figure)
