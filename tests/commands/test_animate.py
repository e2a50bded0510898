"""Does a volume turn?"""

import itertools
import json
import sys

import jax
import numpy as np
import pytest
from PIL import Image
from skimage.io import imread

import jaxvol as jv
from jaxvol.cli import main
from jaxvol.commands.animate import _write_gif
from jaxvol.commands.orbit import angles_of, turned


SEEN = ["--preset", "engine", "--no-shade", "--size", "16", "16", "--step", "0.4"]


@pytest.fixture
def folder(volume_file, tmp_path, monkeypatch):
    """A folder of five frames."""
    monkeypatch.chdir(tmp_path)
    words = ["--frames", "5", "--degrees", "100", "--axis", "0", "1", "1"]
    assert main(["animate", volume_file.name, *SEEN, *words, "-o", "orbit"]) == 0
    return tmp_path / "orbit"


def test_each_frame_is_an_image_of_the_library_and_is_made_again_by_render(folder, volume_file, tmp_path):
    files = sorted(folder.iterdir())
    assert [file.name for file in files] == [f"frame_{number:04d}.png" for number in range(5)]
    camera = jv.Camera.looking_at(jv.load(volume_file), size=(16, 16))
    march = jv.March(0.4, (jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination()), "midpoint")
    for number in (0, 3):
        image = jv.render(
            jv.load(volume_file), jv.preset("engine"), turned(camera, 25.0 * number, (0, 1, 1)), march
        ).image((1, 1, 1))
        found = imread(files[number])
        assert np.abs(found - np.asarray(jv.to_srgb(image)) * 255).max() <= 1
        assert main(["render", "--like", str(files[number]), "-o", "again.png"]) == 0
        np.testing.assert_array_equal(imread(tmp_path / "again.png"), found)
    assert (imread(files[0]) != imread(files[3])).any()
    said = json.loads(Image.open(files[3]).info["jaxvol"])
    assert said["command"] == "render"
    assert said["settings"]["turn"] == 75


def test_a_camera_turns_about_its_focal_point():
    camera = jv.Camera((3, 0, 1), (1, 0, 1), (0, 0, 1), parallel_scale=2.0).zoom(2)
    quarter = turned(camera, 90, (0, 0, 1))
    np.testing.assert_allclose(quarter.position, (1, 2, 1), atol=1e-6)
    np.testing.assert_allclose(quarter.view_up, (0, 0, 1), atol=1e-6)
    np.testing.assert_allclose(turned(camera, 90, (1, 0, 0)).view_up, (0, -1, 0), atol=1e-6)
    np.testing.assert_array_equal(quarter.window, camera.window)
    assert quarter.parallel_scale == 2
    assert turned(camera, 0, (0, 0, 0)) is camera
    with pytest.raises(ValueError, match="--axis must not be 0"):
        turned(camera, 1, (0, 0, 0))


def test_a_closed_orbit_does_not_show_its_first_frame_twice():
    assert angles_of(360, 4) == [0, 90, 180, 270]
    assert angles_of(-720, 4) == [0, -180, -360, -540]
    assert angles_of(90, 4) == [0, 30, 60, 90]
    assert angles_of(90, 1) == [0]


def test_a_gif_holds_all_frames(volume_file, tmp_path, monkeypatch):
    output = tmp_path / "deep" / "a.gif"
    traced = []
    render = jv.render
    monkeypatch.setattr(
        "jaxvol.commands.frames.render", lambda *a, **how: traced.append(a) or render(*a, **how)
    )
    count = programs()
    assert main(["animate", str(volume_file), *SEEN, "--frames", "2", "-o", str(output)]) == 0
    first = programs() - count
    assert main(["animate", str(volume_file), *SEEN, "--frames", "6", "--fps", "5", "-o", str(output)]) == 0
    assert len(traced) == 8
    assert programs() - count == first  # one program for all frames
    with Image.open(output) as picture:
        assert getattr(picture, "n_frames") == 6  # noqa: B009  (of GIFs alone)
        assert picture.info["duration"] == 200
        assert picture.info["loop"] == 0
        frames = []
        for number in range(6):
            picture.seek(number)
            frames.append(np.asarray(picture.convert("RGB")).astype(int))
    assert frames[0].shape == (16, 16, 3)
    expected = np.asarray(jv.to_srgb(render(*traced[-1]).image((1, 1, 1)))) * 255
    assert np.abs(frames[5] - expected).mean() < 3  # of 256 colours
    assert all((a != b).any() for a, b in itertools.pairwise(frames))
    assert [path.name for path in output.parent.iterdir()] == ["a.gif"]


def test_a_gif_lasts_as_long_as_it_should(tmp_path):
    images = [np.full((8, 8, 3), 20 * number, np.uint8) for number in range(12)]
    _write_gif(tmp_path / "a.gif", iter(images), 12, 12)  # 8 and 1/3 hundredths of a second each
    with Image.open(tmp_path / "a.gif") as picture:
        lasting = []
        for number in range(12):
            picture.seek(number)
            lasting.append(picture.info["duration"])
    assert sum(lasting) == 1000
    assert set(lasting) == {80, 90}


COMPILED: list[str] = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, *_, **__: COMPILED.append(event) if "backend_compile" in event else None
)


def programs():
    """How many programs were compiled, or taken from the cache, up to now."""
    return len(COMPILED)


def test_an_mp4_holds_all_frames(volume_file, tmp_path):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg, of jaxvol[video]")
    output = tmp_path / "a.mp4"
    assert main(["animate", str(volume_file), *SEEN, "--frames", "6", "-o", str(output)]) == 0
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(output))
    assert frames == 6
    assert seconds == pytest.approx(0.5, abs=0.1)
    reader = imageio_ffmpeg.read_frames(str(output))
    assert tuple(next(reader)["size"]) == (16, 16)
    assert np.frombuffer(next(reader), np.uint8).std() > 5


BAD = {
    "ending": (["-o", "a.avi"], "--output: must end in .gif or .mp4, or be a folder; got a.avi"),
    "frames": (["--frames", "0"], "--frames must be an integer of at least 1"),
    "fps": (["--fps", "0"], "--fps must be above 0"),
    "fps of a gif": (["--fps", "60"], "--fps: a .gif has 50 frames a second at most; got 60"),
    "axis": (["--axis", "0", "0", "0"], "--axis must not be 0"),
    "step and tolerance": (["--tolerance", "0.1"], "--tolerance finds a step"),
}


@pytest.mark.parametrize("case", BAD)
def test_errors_are_one_line(case, volume_file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words, message = BAD[case]
    assert main(["animate", str(volume_file), *SEEN, *words]) == 2
    printed = capsys.readouterr().err
    assert printed.startswith("jaxvol animate: error: ")
    assert printed.count("\n") == 1
    assert message in printed
    assert [path.name for path in tmp_path.iterdir()] == [volume_file.name]


def test_without_ffmpeg_the_extra_is_named(volume_file, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert main(["animate", str(volume_file), *SEEN, "-o", "a.mp4"]) == 2
    assert 'pip install "jaxvol[video]"' in capsys.readouterr().err
