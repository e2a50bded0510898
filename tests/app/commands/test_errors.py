"""Is every wrong command line refused in one line, before anything is rendered, fitted or written?"""

import json
import sys

import numpy as np
import pytest

import jaxvol as jv
from jaxvol.app.cli import main


RENDER = "render FILE -o x.png"
FIT = "fit FILE -o x.json --images 0.png 1.png --cameras cameras.json"
ANIMATE = "animate FILE -o x.gif --size 16 16 --step 0.4"
BAD = {
    "paint": "argument COMMAND: invalid choice: 'paint' (choose from",
    "rendr": "'view'). Did you mean render? (jaxvol --help lists the options",
    "render": "the following arguments are required: FILE",
    "info FILE y.raw": "unrecognized arguments: y.raw (jaxvol info --help lists the options",
    "datasets": "the following arguments are required: action",
    "datasets fetch": "fetch needs a NAME",
    "datasets fetch engin": "Did you mean engine",
    f"{RENDER} --sise 9 9": "unrecognized arguments: --sise 9 9. Did you mean --size or",
    f"{RENDER} --size many few": "argument --size: invalid int value: 'many'",
    f"{RENDER} --size 0x5": "size must be",
    f"{RENDER} --size 40000 40000": "size 40000 x 40000: asks for",
    f"{RENDER} --step long": "argument --step: invalid float value: 'long'",
    f"{RENDER} --step 0": "step must be greater than 0; got 0",
    f"{RENDER} --tolerance 0.1 --step 1": "step and tolerance exclude each other",
    f"{RENDER} --view-up 3": "argument --view-up: expected 3 arguments",
    f"{RENDER} --camera 1 2 3 4 5 6 --direction 1 2 3": "camera and direction exclude",
    f"{RENDER} --compositing under": "argument --compositing: invalid choice: 'under' (choose from",
    f"{RENDER} --compositing mip": "'isosurface'). Did you mean maximum?",
    f"{RENDER} --compositing isosurface": "isosurface and isovalue go together; one is missing",
    f"{RENDER} --isovalue 9": "isosurface and isovalue go together; one is missing",
    f"{RENDER} --preset engine --cmap gray": "cmap and preset exclude each other",
    f"{RENDER} --preset CT-Bnes": "got 'CT-Bnes'. Did you mean CT-Bones",
    f"{RENDER} --cmap moon": "cmap must be",
    f"{RENDER} --transfer t.json --clim 0 1": "transfer and clim exclude",
    f"{RENDER} --window 3": "window and level go together; one is missing",
    f"{RENDER} --window 3 --clim 0 1": "clim and window exclude each other",
    f"{RENDER} --background 200 0 0": "three numbers from 0 to 1 (linear RGB); got 200 0 0. 8-bit",
    f"{RENDER} --background whit": "--background must be a colour's name, such",
    f"{RENDER} --spacing 1 1 -1": "spacing must be positive",
    f"{RENDER} --dtype uint7": "dtype must be",
    f"{RENDER} --clip-box 0 1 0 1 0 0": "box must be (x_min, x_max, y_min, y_max, z_min,",
    f"{RENDER} --clip-inside-out": "clip_inside_out goes with clip_box or",
    f"{RENDER} --with FILE hot 1": "others are FILE, FILE CMAP or FILE CMAP LOW HIGH",
    f"{RENDER} --depth y.png": "--depth: a file of one channel must end in one of .tif",
    "render FILE -o x.exr": "--output: a file of colours must end in one of .png, .jpg",
    "render FILE -o FILE/x.png": "x.png cannot be written",
    "render nowhere.raw": "there is no file",
    "render headless.raw": "are not known. Give --shape nx ny nz and --dtype uint8, or name it",
    "render rgb.npy": "3 values in each voxel: choose one by channel, 0 to 2",
    "animate FILE -o a.avi": "--output: must end in .gif or .mp4; got a.avi",
    f"{ANIMATE} --frames 0": "--frames must be an integer from 1 to",
    f"{ANIMATE} --fps 0": "--fps of a .gif must be from 0.01 to 50",
    f"{ANIMATE} --fps 60": "--fps of a .gif must be from 0.01 to 50; got 60",
    f"{ANIMATE} -o a.mp4 --size 15 16": "--size of an .mp4 must be even; got 15 x 16",
    f"{ANIMATE} -o a.mp4": 'pip install "jaxvol[video]"',
    "fit FILE --images 0.png": "the following arguments are required: --cameras (jaxvol fit --help",
    f"{FIT} --cameras nowhere.json": "nowhere.json",
    f"{FIT} --cameras deep.json": "deep.json is not JSON",
    f"{FIT} --cameras 0.png": "0.png is not JSON",
    f"{FIT} --images nowhere.png 1.png": "there is no file nowhere.png",
    f"{FIT} --images cameras.json cameras.json": "cannot be read as a picture",
    f"{FIT} --images 0.png 1.png 1.png": "a camera for each of 3 images; got 2",
    f"{FIT} --points 1": "points must be an integer of at least 2",
    f"{FIT} --checkpoint 0.png/x": "checkpoint: 0.png/x cannot be written",
}
"""Command lines, and a part of what is said."""


@pytest.mark.parametrize("words", BAD)
def test_errors_are_one_line_and_exit_code_2(words, volume_file, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for number in range(2):
        jv.save_png(f"{number}.png", np.full((16, 16, 3), 0.5))
    camera = {"position": [40, -30, 20], "focal_point": [11.5] * 3}
    (tmp_path / "cameras.json").write_text(json.dumps([camera] * 2))
    (tmp_path / "deep.json").write_text("[" * 5000)
    (tmp_path / "headless.raw").write_bytes(bytes(8))
    np.save("rgb.npy", np.zeros((3, 4, 5, 3), np.uint8))
    before = sorted(tmp_path.iterdir())
    for name in ("jaxvol.app.picture.render", "jaxvol.fitting.driver._Run"):
        monkeypatch.setattr(name, None)  # fails if it is called
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert main([word.replace("FILE", volume_file.name) for word in words.split()]) == 2
    printed = capsys.readouterr().err
    assert printed.startswith(f"jaxvol {words.split()[0]}: error: ")
    assert printed.count("\n") == 1
    assert BAD[words] in printed
    assert sorted(tmp_path.iterdir()) == before
