"""The command line, run as users run it."""

import contextlib
import html
import json
import math
import re
import signal
import subprocess
import sys
import time
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage.io import imread

import jaxvol as jv
from jaxvol.automatic import front_of, transfer_by_copy, upright
from jaxvol.automatic.sampling import SAMPLED
from jaxvol.bricks import source_of
from jaxvol.cli import main
from jaxvol.commands.data import copy_of, middle_of
from jaxvol.lighting import Phong
from jaxvol.metrics import rmse

from .scenes import slow


def scene_of(volume_file):
    """The scene that the command renders. All images of this file share its shapes, and so one program."""
    view = jv.Camera((40, -30, 20), (11.5,) * 3, (0, 0, 1), size=(16, 16)).zoom(1.5)
    march = jv.March(0.4, (jv.AlphaCorrection(), jv.EarlyTermination()), "midpoint")
    return jv.load(volume_file), jv.preset("engine"), view, march


SMALL = ["--size", "40", "30", "--resolution", "24"]


def test_demo_writes_pictures_and_says_what_it_took(tmp_path, capsys, monkeypatch):
    assert main(["demo", "-o", str(tmp_path / "demo"), *SMALL, "--only", "head", "grain"]) == 0
    printed = capsys.readouterr().out
    for name in ("head.png", "before.png", "after.png"):
        image = imread(tmp_path / "demo" / name)
        assert image.shape == (30, 40, 3)
        assert image.std() > 5
        assert str(tmp_path / "demo" / name) in printed
    assert "compiling and rendering" in printed
    assert "cpu" in printed.lower() or "gpu" in printed.lower()
    page = (tmp_path / "demo" / "index.html").read_text(encoding="utf-8")
    assert sorted(re.findall(r'src="([^"]+)"', page)) == ["after.png", "before.png", "head.png"]
    assert "http" not in page  # no network
    shown = [html.unescape(code) for code in re.findall("<pre>(.*?)</pre>", page, re.DOTALL)]
    assert len(shown) == 2
    monkeypatch.chdir(tmp_path)
    for code in shown:  # makes the same pictures
        exec(code, {})
    for name in ("head.png", "before.png", "after.png"):
        np.testing.assert_array_equal(imread(tmp_path / name), imread(tmp_path / "demo" / name))
    assert main(["render", "--like", str(tmp_path / "demo" / "head.png")]) == 2
    made = "by jaxvol 'demo --only head grain --resolution 24 --size 40 30'"
    assert f"not made by jaxvol render, but, as it says, {made}" in capsys.readouterr().err


@pytest.mark.slow
def test_demo_fits_a_transfer_function(tmp_path, capsys):
    assert main(["demo", "-o", str(tmp_path), *SMALL, "--only", "fit"]) == 0
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    (code,) = re.findall("<pre>(.*?)</pre>", page, re.DOTALL)
    compile(html.unescape(code), "page", "exec")
    true, found, start = (
        imread(tmp_path / f"fit_{name}.png").astype(float) for name in ("true", "found", "start")
    )
    assert np.abs(found - true).mean() < np.abs(start - true).mean() / 5
    assert "RMSE of this view" in capsys.readouterr().out


def test_render_writes_what_the_library_renders(volume_file, tmp_path, capsys):
    output = tmp_path / "folder" / "engine.png"
    camera = [
        "--camera",
        "40",
        "-30",
        "20",
        "11.5",
        "11.5",
        "11.5",
        "--view-up",
        "0",
        "0",
        "1",
        "--zoom",
        "1.5",
    ]
    look = ["--preset", "engine", "--size", "16", "16", "--step", "0.4", "--background", "0", "0", "0"]
    for words, lighting in ((["--no-shade"], None), ([], Phong())):  # the preset shows surfaces
        assert main(["render", str(volume_file), *camera, *look, *words, "-o", str(output)]) == 0
        told = re.search(
            r"million samples in ([\d.]+) s \(reading ([\d.]+) s, compiling and rendering ([\d.]+) s\)",
            capsys.readouterr().out,
        )
        assert told is not None
        assert float(told[1]) == pytest.approx(float(told[2]) + float(told[3]), abs=0.02)
        linear = jv.render(*scene_of(volume_file), lighting=lighting).image((0, 0, 0))
        assert np.abs(imread(output) - np.asarray(jv.to_srgb(linear)) * 255).max() <= 1


def test_render_needs_nothing_but_a_file_and_plan_says_how(volume_file, tmp_path, capsys):
    output = tmp_path / "out.png"
    assert main(["render", str(volume_file), "-o", str(output), "--size", "16", "16"]) == 0
    assert imread(output).std() > 5
    assert "(reading and planning " in capsys.readouterr().out
    assert main(["plan", str(volume_file), "--size", "16", "16", "--tolerance", str(1 / 255)]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"step [\d.e-]+, (midpoint|preintegrated)", printed)
    for word in ("RMSE", "0.0039 asked for", "AlphaCorrection", "SpaceLeaping", "voxels as uint8"):
        assert word in printed
    for bad in ("0", "nan", "2"):
        assert main(["plan", str(volume_file), "--tolerance", bad]) == 2
        assert "tolerance must be" in capsys.readouterr().err


def render_file(volume_file, *words, size=("16", "16")):
    """The command with a given step, which need not be planned: all that a file needs beside it is above."""
    return main(["render", str(volume_file), "--size", *size, "--step", "0.4", *map(str, words)])


def test_render_renders_once_and_writes_opacity_and_depth(volume_file, tmp_path, monkeypatch, capsys):
    calls = []
    monkeypatch.setattr(
        "jaxvol.commands.frames.render", lambda *a, **how: calls.append(a) or jv.render(*a, **how)
    )
    output, depth = tmp_path / "a" / "x.png", tmp_path / "b" / "depth.tif"
    assert (
        render_file(volume_file, "--preset", "engine", "--transparent", "-o", output, "--depth", depth) == 0
    )
    (scene,) = calls
    rendering = jv.render(*scene)
    assert str(depth) in capsys.readouterr().out
    found = imread(output)
    assert found.shape == (16, 16, 4)
    opacity = np.asarray(rendering.rgba[..., 3])
    np.testing.assert_array_equal(found[..., 3], (opacity * 255).round())
    np.testing.assert_array_equal(imread(depth), rendering.depth)
    assert np.isinf(imread(depth)).any()


@pytest.mark.parametrize("name", ["maximum", *slow("minimum", "average", "isosurface")])
def test_render_composites_as_asked_for(name, volume_file, tmp_path):
    output = tmp_path / "x.npy"
    own = ["--isovalue", "120"] if name == "isosurface" else []
    look = ["--cmap", "gray", "--clim", "-100", "255", "--unit-distance", "20"]  # shows 0, too
    look += ["--compositing", name, *own, "-o", output]
    assert render_file(volume_file, *look, "--transparent") == 0
    volume = jv.load(volume_file)
    transfer, camera = (
        jv.colormap("gray", (-100, 255), unit_distance=20),
        jv.Camera.looking_at(volume, size=(16, 16)),
    )
    mode = jv.Isosurface(120.0) if own else name
    march = jv.March(0.4, (jv.AlphaCorrection(),), "midpoint")
    lighting = Phong() if own else None
    expected = jv.render(volume, transfer, camera, march, compositing=mode, lighting=lighting)
    assert np.std(expected.rgba[..., 3]) > 1e-3
    np.testing.assert_allclose(np.load(output), expected.rgba, atol=2e-5)
    assert render_file(volume_file, *look) == 0
    behind = (1, 1, 1) if own else (0, 0, 0)  # values of a ray are light on dark
    np.testing.assert_allclose(np.load(output), expected.image(behind), atol=2e-5)


def test_what_one_face_cuts_stands_on_it_also_in_colours_of_ones_own(tmp_path):
    file, output = tmp_path / "block.npy", tmp_path / "x.npy"
    data = np.zeros((12, 12, 12), np.uint8)
    data[5:, 4:9, 3:8] = 200
    np.save(file, data)
    up = upright(jv.load(file))
    assert up is not None
    np.testing.assert_array_equal(up, (-1, 0, 0))
    images = []
    for view in ([], ["--view-up", *up, "--direction", *front_of(up)], ["--view-up", 0, 0, 1]):
        assert render_file(file, "--cmap", "gray", "--transparent", "-o", output, *view) == 0
        images.append(np.load(output))
    np.testing.assert_array_equal(images[0], images[1])
    assert np.abs(images[0] - images[2]).max() > 0.1


def test_an_isosurface_that_no_ray_meets_says_why(volume_file, tmp_path, capsys):
    words = ["--compositing", "isosurface", "--isovalue", "999", "-o", tmp_path / "x.png"]
    assert render_file(volume_file, *words) == 0
    assert re.search(
        r"nothing is seen: .* from 0 to \d+.*, and none crosses .* 999\.", capsys.readouterr().out
    )


def test_an_isosurface_is_white_unless_a_look_is_asked_for(volume_file, tmp_path):
    output = tmp_path / "x.npy"
    words = ["--compositing", "isosurface", "--isovalue", "30", "--transparent", "-o", output]
    for look, of_white in (([], (1, 1, 1)), (["--cmap", "red"], (1, 0, 0))):
        assert render_file(volume_file, *words, *look) == 0
        rgba = np.load(output)
        seen = rgba[rgba[..., 3] > 0.5][:, :3]
        assert seen[:, 0].mean() > 0.4
        np.testing.assert_allclose(seen.mean(axis=0) > 0.4, of_white)


def test_render_takes_what_fit_writes_and_writes_linear_floats(volume_file, tmp_path):
    transfer = jv.write_transfer(tmp_path / "t.json", jv.preset("engine"))
    images = []
    for number, look in enumerate((["--transfer", transfer], ["--preset", "engine", "--no-shade"])):
        output = tmp_path / f"{number}.npy"
        assert render_file(volume_file, *look, "-o", output) == 0
        images.append(np.load(output))
    assert images[0].dtype == np.float32
    assert images[0].std() > 0.02
    np.testing.assert_array_equal(*images)


def test_parallel_rays_are_asked_for_by_an_option(volume_file, tmp_path, monkeypatch):
    rendering = jv.render(*scene_of(volume_file))
    cameras = []
    monkeypatch.setattr(
        "jaxvol.commands.frames.render", lambda *scene, **how: cameras.append(scene[2]) or rendering
    )
    output = tmp_path / "x.png"
    assert render_file(volume_file, "--parallel", "--direction", 0, 0, 1, "-o", output) == 0
    (camera,) = cameras
    assert camera.parallel_scale is not None
    away = np.asarray(camera.focal_point - camera.position)
    np.testing.assert_allclose(away / np.linalg.norm(away), (0, 0, -1), atol=1e-6)


def test_clips_are_those_of_the_library(volume_file, tmp_path, monkeypatch):
    """A box and two planes, inside out, at a given step and in a plan."""
    volume, transfer, _, march = scene_of(volume_file)
    planes = [((12, 0, 0), (1, 0.5, 0)), ((0, 0, 4), (0, 0, 1))]
    words = ["--clip-box", 5, 30, -1, 20, -1, 30, "--clip-inside-out"]
    for origin, normal in planes:
        words += ["--clip-plane", *origin, *normal]
    view = ["--preset", "engine", "--no-shade", "--camera", 40, -30, 20, *[11.5] * 3, "--zoom", 1.5]
    output = tmp_path / "x.npy"
    clip = jv.Clip((5, 30, -1, 20, -1, 30), planes, inside_out=True)
    camera = scene_of(volume_file)[2]
    images = {}
    for name, transforms in {"clipped": (clip,), "whole": ()}.items():
        leaps = jv.SpaceLeaping(), *march.transforms
        images[name] = jv.render(volume, transfer, camera, jv.March(0.4, (*transforms, *leaps), "midpoint"))
    expected = images["clipped"].image((1, 1, 1))
    assert render_file(volume_file, *view, *words, "-o", output) == 0
    np.testing.assert_allclose(np.load(output), expected, atol=1e-5)
    assert rmse(expected, images["whole"].image((1, 1, 1))) > 0.05
    planned = []
    monkeypatch.setattr(
        "jaxvol.commands.frames.plan", lambda *scene, transforms, **how: planned.append(transforms)
    )
    for command in ("plan", "render"):
        monkeypatch.setattr("jaxvol.commands.render.rendered", None)  # not called
        with contextlib.suppress(TypeError, AttributeError):  # there is no plan to print or render
            main([command, str(volume_file), *map(str, view), *map(str, words)])
    for (given,) in planned:
        assert jax.tree.all(jax.tree.map(lambda a, b: bool(jnp.all(a == b)), given, clip))
    assert len(planned) == 2


def test_a_picture_in_which_nothing_is_seen_says_why(tmp_path, capsys):
    np.save(tmp_path / "v.npy", np.linspace(20, 90, 1000).reshape(10, 10, 10).astype(np.float32))
    shown = (["--preset", "ct_bone", "--clim", "20", "90"], None)
    for words, message in [
        (
            ["--preset", "ct_bone"],
            r"nothing is seen: .* from 2\d\.?\d* to 8\d\.?\d*, .* shows values from 130 on\. A clim from",
        ),
        (
            ["--preset", "ct_bone", "--camera", *["90"] * 3, *["200"] * 3],
            "nothing is seen: no ray of the camera meets",
        ),
        (
            ["--preset", "ct_bone", "--clim", "20", "90", "--unit-distance", "1e6"],
            r"nothing is seen: the opacity is at most .*\. Use a shorter unit distance",
        ),
        (
            ["--preset", "ct_bone", "--clim", "20", "90", "--clip-box", *"050505", "--clip-inside-out"],
            None,
        ),
        (
            ["--preset", "ct_bone", "--clim", "20", "90", "--clip-plane", *["20"] * 3, *"100"],
            "nothing is seen: no ray of the camera meets what the clip leaves of the volume",
        ),
        shown,
    ]:
        assert render_file(tmp_path / "v.npy", *words, "-o", tmp_path / "x.png") == 0
        printed = capsys.readouterr().out
        assert re.search(message, printed) if message else "nothing" not in printed, printed


STARTED = """
import signal
import sys
import jaxvol.cli
from jaxvol.commands import frames

signal.signal(signal.SIGINT, signal.default_int_handler)  # as in a terminal, however the tests are run
render = frames.render
def announced(*scene, **how):
    print("under way", flush=True)
    return render(*scene, **how)
frames.render = announced
sys.exit(jaxvol.cli.main(sys.argv[1:]))
"""


def test_ctrl_c_ends_a_command_at_once_with_one_line(volume_file, tmp_path):
    words = [
        "render",
        str(volume_file),
        "--size",
        "6000",
        "6000",
        "--step",
        "0.001",
        "-o",
        str(tmp_path / "deep" / "x.png"),
    ]
    run = subprocess.Popen(
        [sys.executable, "-c", STARTED, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert run.stdout is not None
    assert run.stdout.readline() == "under way\n"
    time.sleep(0.3)
    run.send_signal(signal.SIGINT)
    begun = time.monotonic()
    printed = run.communicate(timeout=60)[1]
    assert time.monotonic() - begun < 2
    assert run.returncode == 130
    assert printed.endswith("\njaxvol render: interrupted\n")  # after what it was doing, if that took long
    assert [path.name for path in tmp_path.iterdir()] == [volume_file.name]


HALF = """
import signal
import sys
import time
import jaxvol.cli
from jaxvol.commands import {module}

signal.signal(signal.SIGINT, signal.default_int_handler)
made = {module}.{name}
calls = []
def slow(*given, **how):
    calls.append(given)
    if len(calls) == 2:
        print("under way", flush=True)
        time.sleep(60)
    return made(*given, **how)
{module}.{name} = slow
sys.exit(jaxvol.cli.main(sys.argv[1:]))
"""


@pytest.mark.parametrize(
    ("command", "module", "name"),
    [
        ("animate", "animate", "save_image"),
        ("animate", "animate", "displayed"),
        ("demo", "demo", "save_image"),
    ],
)
def test_ctrl_c_leaves_no_half_written_file(command, module, name, volume_file, tmp_path):
    """At the second frame of an orbit, into a folder and into a GIF; at the second picture of the demo."""
    folder = tmp_path / "there"
    folder.mkdir()
    (folder / "mine").write_text("kept")
    output = folder / "orbit.gif" if name == "displayed" else folder
    words = ["demo", "--only", "grain"] if command == "demo" else [command, str(volume_file), "--step", "1"]
    words += ["--size", "16", "16"]
    run = subprocess.Popen(
        [sys.executable, "-c", HALF.format(module=module, name=name), *words, "-o", str(output)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert run.stdout is not None
    while "under way" not in run.stdout.readline():
        assert run.poll() is None
    run.send_signal(signal.SIGINT)
    printed = run.communicate(timeout=60)[1]
    assert run.returncode == 130
    assert printed.endswith(f"\njaxvol {command}: interrupted\n")
    assert [path.name for path in folder.iterdir()] == ["mine"]
    assert {path.name for path in tmp_path.iterdir()} == {"there", volume_file.name}


def test_a_reader_that_ends_early_leaves_no_traceback():
    run = subprocess.Popen(
        [sys.executable, "-m", "jaxvol", "datasets", "list"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert run.stdout is not None
    assert run.stderr is not None
    run.stdout.close()
    assert run.stderr.read() == b""
    assert run.wait(timeout=60) == 1


def test_a_volume_is_rendered_brick_by_brick(volume_file, tmp_path, capsys):
    look = ["--preset", "engine", "--no-shade"]
    images = []
    for words in ([], ["--memory", "200K"]):
        assert render_file(volume_file, *look, *words, "-o", tmp_path / "x.npy") == 0
        images.append(np.load(tmp_path / "x.npy"))
    assert re.search(r"\d+ of \d x \d x \d bricks read", capsys.readouterr().out)
    np.testing.assert_allclose(*images, atol=2e-5)
    assert images[0].std() > 0.02
    assert render_file(volume_file, "--memory", "10", "-o", tmp_path / "y.npy") == 2
    assert "memory must" in capsys.readouterr().err


def test_what_is_chosen_by_a_copy_is_chosen_by_the_voxels_that_count_for_the_whole():
    data = np.asarray(jv.phantom("head", 160).data, np.float32)[:, :140, :130]
    waves = 20 * np.sin(np.pi / 3 * np.add.outer(np.arange(160), np.arange(140)))[..., None]
    volume = jv.Volume(np.where(data > 60, data + waves, data), (1, 1, 2))
    assert math.prod(volume.shape) > SAMPLED
    source = source_of(volume)
    copy = copy_of(source, 2**28)
    assert max(copy.shape) <= 80
    whole, found = jv.automatic_transfer(volume), transfer_by_copy(copy, middle_of(source))
    for name in ("values", "colors", "extinction"):
        np.testing.assert_allclose(getattr(found, name), getattr(whole, name), rtol=1e-5)
    # waves of six voxels are grain to those who see every second voxel alone
    assert jv.automatic_transfer(copy).values.shape != whole.values.shape


@pytest.mark.slow
def test_a_plan_with_memory_is_by_bricks_where_the_volume_does_not_fit(tmp_path, capsys):
    np.save(tmp_path / "engine.npy", np.asarray(jv.phantom("engine", 64).data))
    words = [str(tmp_path / "engine.npy"), "--size", "16", "16", "--preset", "engine", "--memory"]
    assert main(["plan", *words, "1M"]) == 0
    assert "bricks:" in capsys.readouterr().out
    assert main(["plan", *words, "1G"]) == 0
    assert "in memory:" in capsys.readouterr().out
    assert main(["render", *words, "1M", "-o", str(tmp_path / "x.png")]) == 0
    assert "bricks read" in capsys.readouterr().out
    assert main(["render", "--like", str(tmp_path / "x.png"), "-o", str(tmp_path / "y.png")]) == 0
    np.testing.assert_array_equal(imread(tmp_path / "x.png"), imread(tmp_path / "y.png"))


def test_files_that_are_not_read_in_parts_are_named(tmp_path, capsys):
    jv.save(jv.phantom("linear", 8), tmp_path / "v.npz")
    assert main(["render", str(tmp_path / "v.npz"), "--memory", "1M"]) == 2
    assert "is not of a kind that is read in parts" in capsys.readouterr().err


@pytest.mark.slow
def test_a_fit_that_is_interrupted_goes_on_from_its_checkpoint(volume_file, seen, tmp_path):
    kept, cameras = tmp_path / "fit.ckpt", str(tmp_path / "cameras.json")
    words = ["fit", str(volume_file), "--images", *seen, "--cameras", cameras, "--checkpoint", str(kept)]
    command = [sys.executable, "-c", STARTED, *words, "-o", str(tmp_path / "t.json")]
    run = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    while not kept.exists() and run.poll() is None:
        time.sleep(0.1)
    run.send_signal(signal.SIGINT)
    begun = time.monotonic()
    printed = run.communicate(timeout=60)[1]
    assert time.monotonic() - begun < 2
    assert run.returncode == 130
    assert printed.splitlines()[-1] == f"jaxvol fit: interrupted; the same command resumes from {kept}"
    assert not (tmp_path / "t.json").exists()
    steps = len(json.loads(kept.read_bytes().splitlines()[1])["losses"])
    assert main([*words, "--max-steps", str(steps), "-o", str(tmp_path / "t.json")]) == 0
    assert jv.read_transfer(tmp_path / "t.json").values.shape == (8,)


def test_version_is_told(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0
    assert re.fullmatch(r"jaxvol \d+\.\d+\S* \(jax \d+\.\S+\)\n", capsys.readouterr().out)


BAD = {
    "EXR": (["FILE", "-o", "x.exr"], "--output: a file of colours must end in one of .png, .jpg"),
    "transparent JPEG": (
        ["FILE", "--transparent", "-o", "x.jpg"],
        "colours and opacity must end in one of .png",
    ),
    "depth in PNG": (["FILE", "--depth", "x.png"], "--depth: a file of one channel must end in one of .tif"),
    "no folder": (["FILE", "-o", "FILE/x.png"], "x.png cannot be written"),
    "clim of a file": (["FILE", "--transfer", "t.json", "--clim", "0", "1"], "--clim is for presets"),
    "no transfer": (["FILE", "--transfer", "nowhere.json"], "nowhere.json cannot be read"),
    "parallel": (["FILE", "--parallel", "--camera", *"123456"], "--parallel goes with --direction"),
    "no file": (["nowhere.raw"], "error: there is no file"),
    "preset": (["nowhere.raw", "--preset", "moon"], "preset must be one of"),
    "cmap": (["nowhere.raw", "--cmap", "moon"], "cmap must be"),
    "background": (
        ["nowhere.raw", "--background", "200", "0", "nan"],
        "--background must be three numbers from 0 to 1 (linear RGB); got 200 0 nan.",
    ),
    "step": (["FILE", "--step", "0"], "step must be greater than 0; got 0"),
    "size": (["FILE", "--size", "0", "5"], "size must be"),
    "camera": (["FILE", "--camera", "1", "1", "1", "1", "1", "1"], "position must differ from focal_point"),
    "spacing": (["FILE", "--spacing", "1", "1", "-1"], "spacing must be positive"),
    "a flat box": (["FILE", "--clip-box", *"010100"], "box must be (x_min, x_max, y_min, y_max, z_min,"),
    "no normal": (["FILE", "--clip-plane", *"111000"], "the normal of planes[0] must not be 0"),
    "nothing to turn": (["FILE", "--clip-inside-out"], "--clip-inside-out goes with --clip-box or"),
    "shape": (["FILE", "--shape", "24", "24", "25"], "cut short"),
    "dtype": (["FILE", "--dtype", "uint7"], "dtype must be"),
    "clim": (["FILE", "--preset", "engine", "--clim", "5", "4"], "clim must be"),
    "shaded average": (
        ["FILE", "--shade", "--compositing", "average"],
        "--shade needs a place that is shaded",
    ),
    "no isovalue": (["FILE", "--compositing", "isosurface"], "--compositing isosurface needs the value"),
    "isovalue": (["FILE", "--isovalue", "9"], "--isovalue goes with --compositing isosurface; got --comp"),
    "infinite isovalue": (
        ["FILE", "--compositing", "isosurface", "--isovalue", "inf"],
        "value must be finite",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_errors_are_one_line_and_exit_code_2(case, volume_file, tmp_path, capsys, monkeypatch):
    arguments, message = BAD[case]
    arguments = [a.replace("FILE", str(volume_file)) for a in arguments]
    output = tmp_path / "x.png"
    monkeypatch.setattr("jaxvol.commands.frames.render", None)  # fails if it is called
    assert main(["render", "-o", str(output), *arguments]) == 2
    printed = capsys.readouterr()
    assert printed.err.count("\n") == 1
    assert printed.err.startswith("jaxvol render: error: ")
    assert message in printed.err
    assert not output.exists()


@pytest.fixture
def seen(volume_file, tmp_path):
    """Files of two images of the engine, and a file of their cameras."""
    volume, pictures, cameras = jv.load(volume_file), [], []
    march = scene_of(volume_file)[-1]
    for number, position in enumerate([(40, -30, 20), (-30, 5, 45)]):
        fields = {"position": position, "focal_point": [11.5] * 3, "view_up": [0, 0, 1], "view_angle": 35}
        image = jv.render(volume, jv.preset("engine"), jv.Camera(**fields, size=(16, 16)), march).image()
        pictures.append(str(jv.save_png(tmp_path / f"{number}.png", image)))
        cameras.append(fields)
    (tmp_path / "cameras.json").write_text(json.dumps(cameras))
    return pictures


@pytest.mark.slow
def test_fit_finds_a_transfer_function_that_makes_the_pictures(volume_file, seen, tmp_path, capsys):
    output = tmp_path / "folder" / "transfer.json"
    cameras = ["--cameras", str(tmp_path / "cameras.json")]
    command = ["fit", str(volume_file), "--images", *seen, *cameras, "-o", str(output)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert main([*command, "--max-steps", "20"]) == 0
    printed = capsys.readouterr().out
    assert re.search(
        r"not determine is arbitrary: colours or extinction of \d of 8 points, those of the values 0\b",
        printed,
    )
    assert float(printed.partition("RMSE ")[2].split()[0]) < 0.01
    transfer = jv.read_transfer(output)
    assert transfer.values.shape == (8,)
    assert float(transfer.extinction.max()) > 0


BAD_FIT = {
    "no picture": ({"--images": ["nowhere.png", "1.png"]}, "there is no file nowhere.png"),
    "no cameras": ({"--cameras": ["nowhere.json"]}, "nowhere.json"),
    "no picture's file": ({"--images": ["CAMERAS", "CAMERAS"]}, "cannot be read as a picture"),
    "no JSON": ({"--cameras": ["0.png"]}, "0.png is not JSON"),
    "too deep": ({"--cameras": ["deep.json"]}, "deep.json is not JSON"),
    "one camera short": ({"--images": ["0.png", "1.png", "1.png"]}, "each of the 3 images; got 2"),
    "points": ({"--points": ["1"]}, "points must be an integer of at least 2"),
    "start": ({"--start": ["CAMERAS"]}, "must be an object with values, colors, extinction; got a list"),
    "clim": ({"--clim": ["5", "4"]}, "clim must be (low, high)"),
    "checkpoint": ({"--checkpoint": ["0.png/x"]}, "checkpoint: 0.png/x cannot be written"),
}


@pytest.mark.parametrize("case", BAD_FIT)
def test_errors_of_fit_are_one_line_and_exit_code_2(case, volume_file, seen, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "deep.json").write_text("[" * 100_000)
    changed, message = BAD_FIT[case]
    options = {"--images": ["0.png", "1.png"], "--cameras": ["cameras.json"], **changed}
    words = [w for name, values in options.items() for w in (name, *values)]
    words = ["cameras.json" if w == "CAMERAS" else w for w in words]
    monkeypatch.setattr("jaxvol.fitting.driver._Run", None)  # fails if the fit begins
    assert main(["fit", str(volume_file), *words, "-o", "x.json"]) == 2
    printed = capsys.readouterr().err
    assert printed.startswith("jaxvol fit: error: ")
    assert printed.count("\n") == 1
    assert message in printed
    assert not (tmp_path / "x.json").exists()


BAD_CAMERAS = {
    "field": ([{"position": [1, 2, 3], "focus": [0, 0, 0]}] * 2, "camera 0 must be an object with position"),
    "value": (
        [{"position": [1, 2], "focal_point": [0, 0, 0]}] * 2,
        "camera 0: position must have shape (3,)",
    ),
    "no list": ({"position": [1, 2, 3]}, "must hold a list of cameras; got dict"),
}


@pytest.mark.parametrize("case", BAD_CAMERAS)
def test_bad_cameras_are_named(case, seen, tmp_path):
    cameras, message = BAD_CAMERAS[case]
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(cameras))
    with pytest.raises(ValueError, match=re.escape(message)):
        jv.read_views(seen, path)


def test_a_picture_s_values_are_read_as_they_were_written(seen, tmp_path):
    views = jv.read_views(seen, tmp_path / "cameras.json")
    assert [camera.size for camera, _ in views] == [(16, 16)] * 2
    assert np.array_equal(np.asarray(jv.to_srgb(views[1][1]) * 255).round(), imread(seen[1]))
    np.testing.assert_array_equal(views[0][0].position, (40, -30, 20))


def test_a_transfer_function_is_read_as_it_was_written(tmp_path):
    transfer = jv.preset("engine")
    again = jv.read_transfer(jv.write_transfer(tmp_path / "a" / "t.json", transfer))
    for name in ("values", "colors", "extinction"):
        np.testing.assert_array_equal(getattr(again, name), getattr(transfer, name))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["render", "x.raw", "--size", "many", "few"],
            "render: error: argument --size: invalid int value: 'm",
        ),
        (
            ["render", "x.raw", "--memory", "lots"],
            "render: error: argument --memory: must be a number of bytes, such as 256M or 2G; got 'lots'",
        ),
        (["render", "x.raw", "--memory", "0"], "argument --memory: must be at least 1 byte; got '0'"),
        (
            ["fit", "x.raw", "--images", "a.png", "--cameras", "c.json", "--solver", "newton"],
            "fit: error: argument --solver: invalid choice: 'newton'",
        ),
        (
            ["render", "x.raw", "--sise", "9", "9"],
            "jaxvol render: error: unrecognized arguments: --sise 9 9. Did you mean --size? (jaxvol render -",
        ),
        (["info", "x.raw", "y.raw"], "jaxvol info: error: unrecognized arguments: y.raw (jaxvol info --help"),
        (["datasets", "fetch"], "datasets fetch: error: the following arguments are required: NAME"),
        (["paint"], "jaxvol: error: argument COMMAND: invalid choice: 'paint' (choose from"),
    ],
)
def test_invalid_options_are_named_in_one_line(words, message, capsys):
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert printed.count("\n") == 1
    assert "--help lists the options" in printed


def test_help_names_commands_presets_and_examples():
    printed = subprocess.run(
        [sys.executable, "-m", "jaxvol", "--help"], capture_output=True, text=True, check=True
    ).stdout
    for word in ("demo", "render", "fit", "examples:"):
        assert word in printed
    printed = subprocess.run(
        [sys.executable, "-m", "jaxvol", "render", "--help"], capture_output=True, text=True, check=True
    ).stdout
    for word in ("--preset", "ct_skin_bone", "--camera", "--step", "--view-angle"):
        assert word in printed


def test_as_a_program_a_fault_leaves_no_traceback(tmp_path):
    run = subprocess.run(
        [sys.executable, "-m", "jaxvol", "render", "nowhere.raw"], capture_output=True, text=True, check=False
    )
    assert run.returncode == 2
    assert "Traceback" not in run.stderr


def test_the_volume_is_not_replaced_by_a_picture_of_it(volume_file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    before = volume_file.read_bytes()
    (tmp_path / "link.npy").symlink_to(volume_file)
    name = volume_file.name
    for words, message in (
        (["-o", "link.npy"], "--output: link.npy is the volume"),
        (["-o", "a.png", "--depth", name], f"--depth: {name} is the volume"),
        (["-o", "a.npy", "--depth", "./a.npy"], "--depth: a.npy is what --output writes"),
    ):
        assert main(["render", name, *words]) == 2
        assert message in capsys.readouterr().err
    assert volume_file.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["link.npy", name])
    (tmp_path / "stack").mkdir()
    (tmp_path / "stack" / "1.tif").write_bytes(b"a slice")
    assert main(["render", "stack", "-o", "stack/1.tif"]) == 2
    assert "--output: stack/1.tif is a slice of the volume" in capsys.readouterr().err


def test_too_little_memory_is_told_in_one_line(volume_file, tmp_path, monkeypatch, capsys):
    def full(*_):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 16 bytes.")

    monkeypatch.setattr("jaxvol.commands.render.frames_of", full)
    assert main(["render", str(volume_file), "-o", str(tmp_path / "a.png")]) == 2
    printed = capsys.readouterr().err
    assert printed.startswith("jaxvol render: error: there is not enough memory (RESOURCE_EXHAUSTED")
    assert printed.count("\n") == 1
