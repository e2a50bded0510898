"""Does a volume turn?"""

import itertools

import numpy as np
import pytest
from PIL import Image

import jaxvol as jv
from jaxvol.app.cli import main
from jaxvol.app.commands.animate import angles_of, turned


SEEN = ["--preset", "engine", "--no-shade", "--size", "16", "16", "--step", "0.4"]


def test_each_frame_is_seen_from_a_camera_that_turns(volume_file, tmp_path, monkeypatch, drawn):
    monkeypatch.chdir(tmp_path)
    words = ["--frames", "5", "--degrees", "100", "--axis", "0", "1", "1"]
    assert main(["animate", volume_file.name, *SEEN, *words, "-o", "orbit.gif"]) == 0
    camera = drawn.scenes[0][2]
    assert len(drawn.scenes) == 5
    for number, (_, _, seen, march) in enumerate(drawn.scenes):
        np.testing.assert_allclose(
            seen.position, turned(camera, 25.0 * number, (0, 1, 1)).position, rtol=1e-5
        )
        assert float(march.step) == np.float32(0.4)


def test_a_camera_turns_about_its_focal_point():
    camera = jv.Camera((3, 0, 1), (1, 0, 1), (0, 0, 1), parallel_scale=2.0).zoom(2)
    quarter = turned(camera, 90, (0, 0, 1))
    np.testing.assert_allclose(quarter.position, (1, 2, 1), atol=1e-6)
    np.testing.assert_allclose(quarter.view_up, (0, 0, 1), atol=1e-6)
    np.testing.assert_allclose(turned(camera, 90, (1, 0, 0)).view_up, (0, -1, 0), atol=1e-6)
    np.testing.assert_array_equal(quarter.window, camera.window)
    assert np.asarray(quarter.parallel_scale) == 2
    with pytest.raises(ValueError, match="--axis must not be 0"):
        turned(camera, 1, (0, 0, 0))


def test_a_closed_orbit_does_not_show_its_first_frame_twice():
    assert angles_of(360, 4) == [0, 90, 180, 270]
    assert angles_of(-720, 4) == [0, -180, -360, -540]
    assert angles_of(90, 4) == [0, 30, 60, 90]
    assert angles_of(90, 1) == [0]


def frames_in(path):
    """The frames of a GIF, and how long each lasts."""
    with Image.open(path) as picture:
        for number in range(getattr(picture, "n_frames", 1)):
            picture.seek(number)
            yield np.asarray(picture.convert("RGB")), picture.info["duration"]


def test_a_gif_holds_all_frames_and_lasts_as_long_as_it_should(volume_file, tmp_path, drawn):
    output = tmp_path / "deep" / "a.gif"
    assert main(["animate", str(volume_file), *SEEN, "--frames", "6", "--fps", "5", "-o", str(output)]) == 0
    assert len(drawn.scenes) == 6
    assert [path.name for path in output.parent.iterdir()] == ["a.gif"]
    found, lasting = zip(*frames_in(output), strict=True)
    assert lasting == (200,) * 6
    assert all((one != other).any() for one, other in itertools.pairwise(found))
    assert Image.open(output).info["loop"] == 0


def test_an_mp4_holds_all_frames(volume_file, tmp_path, drawn):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg, of jaxvol[video]")
    output = tmp_path / "a.mp4"
    assert main(["animate", str(volume_file), *SEEN, "--frames", "6", "-o", str(output)]) == 0
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(output))
    assert frames == 6
    assert seconds == pytest.approx(0.5, abs=0.1)
    reader = imageio_ffmpeg.read_frames(str(output))
    assert tuple(next(reader)["size"]) == (16, 16)
    assert np.frombuffer(next(reader), np.uint8).std() > 5
