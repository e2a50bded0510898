"""Does `jaxvol fit` find a transfer function for pictures, and say what is wrong with bad ones?"""

import json
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from skimage.io import imread

import jaxvol as jv
from jaxvol.app.cli import main


CAMERAS = [
    {"position": position, "focal_point": [11.5] * 3, "view_up": [0, 0, 1], "view_angle": 35}
    for position in ([40, -30, 20], [-30, 5, 45])
]


@pytest.fixture
def seen(tmp_path, monkeypatch):
    """Two pictures and their cameras, in the working directory."""
    monkeypatch.chdir(tmp_path)
    for number in range(2):
        jv.save_png(f"{number}.png", np.random.default_rng(number).random((16, 16, 3)))
    (tmp_path / "cameras.json").write_text(json.dumps(CAMERAS))
    return ["0.png", "1.png"]


INTERRUPTIBLE = """
import signal, sys, jaxvol.app.cli
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.exit(jaxvol.app.cli.main(sys.argv[1:]))
"""


@pytest.mark.slow
def test_an_interrupted_fit_resumes_and_finds_what_makes_the_pictures(volume_file, seen, tmp_path, capsys):
    march = jv.March(0.5, (jv.AlphaCorrection(), jv.EarlyTermination()), "midpoint")
    for name, fields in zip(seen, CAMERAS, strict=True):
        camera = jv.Camera(**fields, size=(16, 16))
        jv.save_png(name, jv.render(jv.load(volume_file), jv.preset("engine"), camera, march).image())
    kept = tmp_path / "fit.ckpt"
    words = ["fit", str(volume_file), "--images", *seen, "--cameras", "cameras.json", "--max-steps", "30"]
    words += ["--checkpoint", str(kept), "-o", "folder/t.json"]
    command = [sys.executable, "-c", INTERRUPTIBLE, *words]
    run = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    while not kept.exists() and run.poll() is None:
        time.sleep(0.1)
    run.send_signal(signal.SIGINT)
    begun = time.monotonic()
    printed = run.communicate(timeout=60)[1]
    assert time.monotonic() - begun < 2
    assert run.returncode == 130
    assert printed.splitlines()[-1] == f"jaxvol fit: interrupted; the same command resumes from {kept}"
    assert not (tmp_path / "folder").exists()
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert re.search(r"\d+ of \d+ directions are not determined by the residual; .*: \S", printed)
    assert float(printed.partition("RMSE ")[2].split()[0]) < 0.01
    assert jv.read_transfer("folder/t.json").values.shape == (8,)


def test_pictures_cameras_and_transfer_functions_are_read_as_they_were_written(seen, tmp_path):
    views = jv.read_views(seen, tmp_path / "cameras.json")
    assert [camera.size for camera, _ in views] == [(16, 16)] * 2
    assert np.array_equal((np.asarray(jv.to_srgb(views[1][1])) * 255).round(), imread(seen[1]))
    np.testing.assert_array_equal(views[0][0].position, (40, -30, 20))
    for cameras, message in (
        (
            [{"position": [1, 2, 3], "focus": [0, 0, 0]}] * 2,
            "camera 0 must be an object with fields of position",
        ),
        ([{"position": [1, 2, 3]}] * 2, "camera 0: "),
        ([{"position": [1, 2], "focal_point": [0, 0, 0]}] * 2, "camera 0: position must have shape (3,)"),
        ({"position": [1, 2, 3]}, "must hold a list with a camera for each of 2 images; got a dict"),
    ):
        (tmp_path / "bad.json").write_text(json.dumps(cameras))
        with pytest.raises(ValueError, match=re.escape(message)):
            jv.read_views(seen, tmp_path / "bad.json")
    transfer = jv.preset("engine")
    again = jv.read_transfer(jv.write_transfer(tmp_path / "a" / "t.json", transfer))
    for name in ("values", "colors", "extinction"):
        np.testing.assert_array_equal(getattr(again, name), getattr(transfer, name))
