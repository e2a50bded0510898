"""Do the options of `jaxvol render` mean what they say? Which scene is rendered, and what is written?"""

import re

import jax
import numpy as np
import pytest
from skimage.io import imread

import jaxvol as jv
from jaxvol.app.automatic import brightest_mean, range_of_object, xray_transfer
from jaxvol.app.cli import main
from jaxvol.app.picture import PictureRequest
from jaxvol.app.show import why_empty
from jaxvol.compositing.blending import Over
from jaxvol.compositing.modes import compositing_of
from jaxvol.lighting import Phong
from jaxvol.planning import Part, Plan

from ...scenes import same_trees


ENGINE = np.asarray(jv.phantom("engine", 24).data)
OBJECT = range_of_object(jv.Volume(ENGINE))
RANGE = float(ENGINE.min()), float(ENGINE.max())


def of_voxel(cmap, clim=RANGE):
    """The command's own: opacities are those of a voxel, whose size is 1 here."""
    return jv.colormap(cmap, clim, unit_distance=1.0)


FAST = jv.EmptySpaceJitter(seed=0), jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination()


def render(file, *words, step: str | None = "0.4"):
    """The command with a given step, which need not be planned."""
    given = [] if step is None else ["--step", step]
    return main(["render", str(file), "--size", "16", "16", *given, *map(str, words)])


def same(found, expected):
    return jax.tree.all(
        jax.tree.map(lambda a, b: bool(np.allclose(a, b, rtol=1e-5, atol=1e-6)), found, expected)
    )


def test_render_writes_what_the_library_renders(volume_file, tmp_path, capsys):
    """The picture, its opacity, and distances, of one image."""
    files = {name: tmp_path / name for name in ("a/x.png", "b/depth.tif", "x.npy")}
    view = ["--camera", 40, -30, 20, *[11.5] * 3, "--view-up", 0, 0, 1, "--zoom", 1.5]
    look = ["--preset", "engine", "--no-shade", *view]
    png, depth, npy = files.values()
    assert render(volume_file, *look, "--transparent", "-o", png, "--depth", depth) == 0
    printed = capsys.readouterr().out
    assert str(depth) in printed
    told = re.search(r"in (\S+) s \(reading (\S+) s, compiling and rendering (\S+) s\)", printed)
    assert told is not None
    assert float(told[1]) == pytest.approx(float(told[2]) + float(told[3]), abs=0.02)
    assert "cpu" in printed.lower() or "gpu" in printed.lower()

    camera = jv.Camera((40, -30, 20), (11.5,) * 3, (0, 0, 1), size=(16, 16)).zoom(1.5)
    rendering = jv.render(jv.load(volume_file), jv.preset("engine"), camera, jv.March(0.4, FAST, "midpoint"))
    opacity = np.asarray(rendering.rgba)[..., 3]
    assert opacity.std() > 0.1
    np.testing.assert_array_equal(imread(png)[..., 3], (opacity * 255).round())
    np.testing.assert_array_equal(imread(depth), rendering.depth)
    assert np.isinf(imread(depth)).any()
    assert render(volume_file, *look, "--background", 0, 0, 0, "-o", npy) == 0
    assert np.load(npy).dtype == np.float32
    np.testing.assert_array_equal(np.load(npy), rendering.image((0, 0, 0)))
    assert render(volume_file, *look, "-o", png) == 0
    linear = rendering.image((1, 1, 1))
    assert np.abs(imread(png) - np.asarray(jv.to_srgb(linear)) * 255).max() <= 1


GRAY = ["--cmap", "gray", "--clim", "-100", "255"]
SURFACE = ["--compositing", "isosurface", "--isovalue", "30"]
SCENES = {
    "a preset that shows surfaces": (["--preset", "engine"], jv.preset("engine"), "over", Phong(), 1),
    "a preset, unlit": (["--preset", "engine", "--no-shade"], jv.preset("engine"), "over", None, 1),
    "a range": (
        ["--preset", "ct_bone", "--clim", "20", "90", "--unit-distance", "3"],
        jv.preset("ct_bone", (20, 90), 3.0),
        *("over", Phong(), 1),
    ),
    # values of a ray are light on dark
    "a projection": (
        [*GRAY, "--compositing", "maximum", "--unit-distance", "20"],
        jv.colormap("gray", (-100, 255), unit_distance=20),
        *("maximum", None, 0),
    ),
    "a colormap": (["--cmap", "hot"], of_voxel("hot", OBJECT), "over", None, 1),
    "of all values": (
        ["--compositing", "average"],
        of_voxel("gray", (float(ENGINE.min()), brightest_mean(jv.Volume(ENGINE), 0.0))),
        "average",
        None,
        0,
    ),
    "X-rays": (
        ["--compositing", "integral"],
        xray_transfer(jv.Volume(ENGINE), "gray", RANGE),
        "integral",
        None,
        0,
    ),
    "an isosurface": (
        SURFACE,
        of_voxel("white"),
        jv.Isosurface(30.0),
        Phong(),
        1,
    ),
    "a red one": (
        [*SURFACE, "--cmap", "red"],
        of_voxel("red"),
        jv.Isosurface(30.0),
        Phong(),
        1,
    ),
    "a file": (["--transfer", "t.json"], jv.preset("head"), "over", None, 1),
}
"""Options, and the transfer function, the mode, the light and the background that they mean."""


@pytest.mark.parametrize("case", SCENES)
def test_options_of_the_look_make_the_scene(case, volume_file, tmp_path, monkeypatch, drawn):
    monkeypatch.chdir(tmp_path)
    jv.write_transfer("t.json", jv.preset("head"))
    words, transfer, mode, lighting, behind = SCENES[case]
    assert render(volume_file, *words, "-o", "x.npy") == 0
    ((volume, found, camera, march),), (how,) = drawn.scenes, drawn.how
    assert same_trees(volume, jv.load(volume_file))
    assert same(found, transfer)
    assert same(how["compositing"], compositing_of(mode))
    assert type(how["lighting"]) is type(lighting)
    assert same(how["lighting"], lighting)
    # of an isosurface, what lies within is seen
    seen = jv.TransferFunction([30, 30], np.ones((2, 3)), [0, 9]) if "isosurface" in words else found
    assert same(camera, jv.automatic_camera(volume, seen, size=(16, 16), least=0.01))
    assert same(march, jv.March(0.4, FAST, "midpoint"))
    rgba = np.asarray(drawn(volume, found, camera, march).rgba)
    np.testing.assert_allclose(np.load("x.npy"), rgba[..., :3] + (1 - rgba[..., 3:]) * behind, atol=1e-6)


def test_x_rays_are_as_bright_as_white_where_most_is_passed(volume_file):
    volume = jv.load(volume_file)
    found = xray_transfer(volume, "gray", RANGE)
    along = [
        np.interp(
            np.asarray(volume.data),
            found.values,
            np.asarray(found.extinction) * np.asarray(found.colors)[:, 0],
        ).sum(axis)
        for axis in range(3)
    ]
    assert max(np.percentile(each, 99.9) for each in along) == pytest.approx(1, rel=1e-4)


def test_averages_are_as_bright_as_white_where_they_are_greatest(volume_file):
    volume = jv.load(volume_file)
    along = [np.percentile(np.asarray(volume.data).mean(axis), 99.9) for axis in range(3)]
    assert brightest_mean(volume, 0.0) == pytest.approx(max(along))
    assert brightest_mean(jv.Volume(np.full((3, 3, 3), 5.0)), 5.0) == 6


def test_opacities_of_a_colormap_are_those_of_a_voxel_whatever_its_unit(volume_file, tmp_path, drawn):
    place = ["--spacing", "1e-4", "1e-4", "8e-4", "-o", tmp_path / "x.npy"]
    expected = jv.colormap("gray", (-100, 255), unit_distance=2e-4)
    assert render(volume_file, *GRAY, *place, step="4e-5") == 0
    assert same(drawn.scenes[0][1], expected)
    volume = jv.load(volume_file, spacing=(1e-4, 1e-4, 8e-4))
    assert same(jv.colormap("gray", (-100, 255), unit_distance=volume), expected)


def test_a_scene_of_which_nothing_is_told_is_shown_by_its_values(volume_file, tmp_path, drawn):
    volume = jv.load(volume_file)
    assert render(volume_file, "-o", tmp_path / "x.png") == 0
    assert same(drawn.scenes[0][1], jv.automatic_transfer(volume))
    assert isinstance(drawn.how[0]["lighting"], Phong)
    labels = np.zeros((24, 24, 24), np.uint8)
    labels[4:12, 4:-4, 4:-4], labels[12:-4, 4:-4, 4:-4] = 2, 5
    np.save(tmp_path / "labels.npy", labels)
    assert render(tmp_path / "labels.npy", "-o", tmp_path / "x.png") == 0
    assert isinstance(drawn.scenes[1][1], jv.LabelTransferFunction)


def test_options_of_the_view_make_the_camera(volume_file, tmp_path, drawn):
    output = tmp_path / "x.npy"
    assert render(volume_file, "--parallel", "--direction", 0, 0, 1, "-o", output) == 0
    camera = drawn.scenes[-1][2]
    assert camera.parallel_scale is not None
    assert render(volume_file, "--parallel", "--camera", 100, *[0] * 5, "-o", output) == 0
    assert float(drawn.scenes[-1][2].parallel_scale) == pytest.approx(100 * np.tan(np.pi / 12))
    away = np.asarray(camera.focal_point - camera.position)
    np.testing.assert_allclose(away / np.linalg.norm(away), (0, 0, -1), atol=1e-6)


CLIP = [5, 30, -1, 20, -1, 30]
PLANES = [((12, 0, 0), (1, 0.5, 0)), ((0, 0, 4), (0, 0, 1))]
CUT = ["--clip-box", *CLIP, "--clip-inside-out"]
for origin, normal in PLANES:
    CUT += ["--clip-plane", *origin, *normal]


def test_a_clip_is_that_of_the_library(volume_file, tmp_path, drawn):
    clip = jv.Clip(CLIP, PLANES, inside_out=True)
    assert render(volume_file, "--preset", "engine", *CUT, "-o", tmp_path / "x.npy") == 0
    transforms = drawn.scenes[0][3].transforms
    assert same(transforms, (clip, *FAST))


@pytest.fixture
def plans(monkeypatch):
    """What was planned: plans of a step of 0.7, with an error of 0.02 less what is asked for."""
    made = []

    def plan(volume, transfer, camera, tolerance, **how):
        # of several views, one is integrated at a longer step
        longer = not how["once"] and len(made) % 2
        step = (0.9, how["transforms"], "preintegrated") if longer else (0.7, how["transforms"])
        march, parts = jv.March(*step), (Part("leaps", False, "nothing is empty"),)
        found = Plan(march, tolerance, 0.02 - tolerance, 9.0, parts, 1.0)
        made.append((volume, transfer, camera, tolerance, how))
        return found

    monkeypatch.setattr("jaxvol.app.picture.plan", plan)
    return made


def test_without_a_step_one_is_planned(volume_file, tmp_path, capsys, drawn, plans):
    words = ["--preset", "engine", *CUT]
    assert render(volume_file, *words, "-o", tmp_path / "x.png", step=None) == 0
    assert float(drawn.scenes[0][3].step) == np.float32(0.7)
    printed = capsys.readouterr()
    assert "(reading and planning " in printed.out
    assert "not proven to be within an RMSE of 0.0039; jaxvol plan tells more" in printed.err
    assert render(volume_file, *words, "--tolerance", "0.01", "-o", tmp_path / "x.png", step=None) == 0
    assert "not proven" not in capsys.readouterr().err
    assert main(["plan", str(volume_file), *map(str, words), "--tolerance", "0.01"]) == 0
    assert "step 0.7, left, Clip" in capsys.readouterr().out
    assert [tolerance for *_, tolerance, _ in plans] == [1 / 255, 0.01, 0.01]
    for *_, how in plans:
        assert same(how["transforms"], (jv.Clip(CLIP, PLANES, inside_out=True), FAST[0]))
        assert isinstance(how["lighting"], Phong)
        assert how["once"]
    for bad in (["--tolerance", "0.1", "--step", "1"], ["--step", "1"]):
        assert main(["plan", str(volume_file), *bad]) == 2
        assert "step" in capsys.readouterr().err
    # of an orbit, for four views, by the shortest step, and integrated if one of them is
    assert (
        main(
            ["animate", str(volume_file), "--frames", "2", "--size", "8", "8", "-o", str(tmp_path / "a.gif")]
        )
        == 0
    )
    assert len(plans) == 3 + 4
    assert not plans[-1][-1]["once"]
    march = drawn.scenes[-1][3]
    assert (float(march.step), march.quadrature) == (np.float32(0.7), "preintegrated")


@pytest.mark.slow
def test_render_needs_nothing_but_a_file_and_plan_says_how(volume_file, tmp_path, capsys):
    output = tmp_path / "out.png"
    assert main(["render", str(volume_file), "-o", str(output), "--size", "16", "16"]) == 0
    assert imread(output).std() > 5
    assert "(reading and planning " in capsys.readouterr().out
    assert main(["plan", str(volume_file), "--size", "16", "16", "--tolerance", str(1 / 255)]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"step [\d.e-]+, (midpoint|preintegrated)", printed)
    for word in ("RMSE", "0.0039 asked for", "AlphaCorrection", "SpaceLeaping"):
        assert word in printed
    for bad in ("0", "nan", "2"):
        assert main(["plan", str(volume_file), "--tolerance", bad]) == 2
        assert "tolerance must be" in capsys.readouterr().err


def test_a_picture_in_which_nothing_is_seen_says_why(tmp_path, capsys, drawn):
    np.save(tmp_path / "v.npy", np.linspace(20, 90, 1000).reshape(10, 10, 10).astype(np.float32))
    bone = ["--preset", "ct_bone", "-o", str(tmp_path / "x.png")]
    assert render(tmp_path / "v.npy", *bone) == 0
    assert "visible" not in capsys.readouterr().out
    drawn.level = 0.0
    assert render(tmp_path / "v.npy", *bone) == 0
    why = "nothing is visible: .* from 20 to 90, .* shows values between 130 and inf. A clim from"
    assert re.search(why, capsys.readouterr().out)
    away = ["--camera", *["90"] * 3, *["200"] * 3]
    for words, why in (
        (["--clip-plane", *["20"] * 3, *"100"], "or what the clip leaves of it"),
        (away, "nothing is visible: no ray of the camera meets the volume"),
        (["--compositing", "isosurface", "--isovalue", "999"], "and no ray crosses .* 999"),
    ):
        assert render(tmp_path / "v.npy", *bone, *words) == 0
        assert re.search(why, capsys.readouterr().out), why
    drawn.level = 1e-4
    assert render(tmp_path / "v.npy", *bone) == 0
    told = capsys.readouterr().out
    assert "hardly anything is visible: the opacity is at most" in told
    assert "a shorter unit_distance (voxels have the size 1)" in told


DARK = np.full((3, 3), 0.5)
NEVER = jv.TransferFunction([0, 1, 2], DARK, [0, 0, 0])
HIDING = {
    "below": (jv.TransferFunction([99, 110, 120], DARK, [0, 0, 1]), "shows values between 110 and inf. A"),
    "above": (jv.TransferFunction([1, 2, 3], DARK, [1, 0, 0]), "shows values between -inf and 2. A clim fr"),
    "between": (jv.TransferFunction([1, 2, 3], DARK, [0, 1, 0]), "shows values between 1 and 3. A clim"),
    "no value": (NEVER, "the transfer function's opacity is 0 everywhere"),
    "labels": (jv.LabelTransferFunction([NEVER]), "shows none of those"),
}
"""Where what a transfer function shows lies to the values of a volume."""


@pytest.mark.parametrize("case", HIDING)
def test_the_values_that_are_shown_are_compared_with_those_there_are(case):
    transfer, expected = HIDING[case]
    volume = jv.Volume(np.linspace(20, 90, 8, dtype=np.float32).reshape(2, 2, 2))
    camera, march = jv.Camera.looking_at(volume, size=(8, 8)), jv.March(0.1)
    scene = PictureRequest(volume, transfer, camera, Over(), None, (1, 1, 1), (), march)
    empty = jv.Rendering(*jax.device_put((np.zeros((8, 8, 4), np.float32), np.zeros((8, 8), bool))))
    said = why_empty(scene, empty)
    assert said is not None
    assert said.startswith(
        "nothing is visible: the volume's values run from 20 to 90, and the transfer function"
    )
    assert expected in said


def test_the_volume_is_not_replaced_by_a_picture_of_it(volume_file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    before = volume_file.read_bytes()
    (tmp_path / "link.npy").symlink_to(volume_file)
    (tmp_path / "other.npy").write_bytes(before)
    (tmp_path / "stack").mkdir()
    (tmp_path / "stack" / "1.tif").write_bytes(b"a slice")
    there, name = sorted(tmp_path.iterdir()), volume_file.name
    for words, message in (
        ([name, "-o", "link.npy"], "--output: link.npy is read"),
        ([name, "-o", "a.png", "--depth", name], f"--depth: {name} is read"),
        (
            [name, "-o", "a.npy", "--depth", "./a.npy"],
            "--depth: a.npy is read, or written by another option",
        ),
        ([name, "--with", "other.npy", "-o", "other.npy"], "--output: other.npy is read"),
        ([name, "--labels", "other.npy", "-o", "other.npy"], "--output: other.npy is read"),
        (["stack", "-o", "stack/1.tif"], "--output: stack/1.tif is read, or"),
    ):
        assert main(["render", *words]) == 2
        assert message in capsys.readouterr().err
    assert volume_file.read_bytes() == before
    assert sorted(tmp_path.iterdir()) == there
