"""Is the picture of one line that of the command, and what is said where it shows nothing?"""

import inspect
import io

import numpy as np
import pytest
from PIL import Image
from skimage.io import imread

import jaxvol as jv
from jaxvol.app.cli import main, parser_of_all
from jaxvol.app.commands.options import parsed
from jaxvol.app.framing import framed, visible_points
from jaxvol.app.settings import DEFAULTS

from .test_render import render, same


CASES = {
    "nothing is said": ({}, []),
    "a preset": ({"preset": "ct aaa", "shade": False}, ["--preset", "CT_AAA", "--no-shade"]),
    "window and level": ({"window": 100, "level": 80}, ["--clim", 30, 130]),
    "a range as an array": ({"clim": np.array([30, 130])}, ["--clim", 30, 130]),
    "a view": ({"direction": (0, 0, 1), "zoom": 2}, ["--direction", 0, 0, 1, "--zoom", 2]),
    "a projection": ({"compositing": "maximum"}, ["--compositing", "maximum"]),
    "names of colours": ({"background": "#336699"}, ["--background", "#336699"]),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.filterwarnings("ignore:CT-AAA is for Hounsfield units")
def test_one_line_makes_the_picture_of_the_command(case, volume_file, tmp_path, drawn, capsys):
    options, words = CASES[case]
    rendering = jv.show(volume_file, size=16, step=0.4, **options)
    assert render(volume_file, *words, "-o", tmp_path / "x.png") == 0
    assert ("jaxvol render: CT-AAA is for Hounsfield" in capsys.readouterr().err) == (case == "a preset")
    here, there = drawn.scenes
    assert same(here, there)
    assert same(drawn.how[0], drawn.how[1])
    assert len(here[3].transforms) == 4  # with jitter and alignment
    png = rendering._repr_png_()
    assert png is not None
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(png))), imread(tmp_path / "x.png"))


def test_without_a_display_it_writes_a_file_and_says_where(volume_file, tmp_path, drawn, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MPLBACKEND", raising=False)
    for number in range(2):
        with pytest.warns(UserWarning, match=rf"opens no window .*: the image is in .*jaxvol-{number}\.png"):
            jv.show(volume_file, size=16, step=0.4)
        assert imread(tmp_path / f"jaxvol-{number}.png").shape == (16, 16, 3)


def test_it_has_the_options_of_the_command_and_editors_complete_them():
    found = parsed(parser_of_all(), ["render", "x.raw"]).defaults
    own = {"file", "like", "output", "transparent", "depth"}
    assert {name: found[name] for name in found.keys() - own} == DEFAULTS
    assert {*inspect.signature(jv.show).parameters} == {"volume", *DEFAULTS}


def test_labels_are_shown_in_what_is_around_them(volume_file, tmp_path, drawn):
    labels = np.zeros((24, 24, 24), np.uint8)
    labels[4:12, 4:-4, 4:-4], labels[12:-4, 4:-4, 4:-4] = 2, 5
    np.save(tmp_path / "labels.npy", labels)
    assert render(volume_file, "--labels", tmp_path / "labels.npy", "-o", tmp_path / "x.png") == 0
    volume, transfer, _, _ = drawn.scenes[0]
    given = jv.load(volume_file, labels=tmp_path / "labels.npy")
    assert isinstance(transfer, jv.LabelTransferFunction)
    automatic = jv.automatic_transfer(given)
    around = np.asarray(transfer.stacked.extinction)[0, : automatic.values.shape[0]]
    np.testing.assert_allclose(around, automatic.extinction, rtol=1e-5)
    data, kinds = np.asarray(volume.data), np.asarray(volume.labels)
    assert data[8, 12, 12] == data[16, 12, 12] == np.max(given.data)
    assert kinds[[8, 16], 12, 12].tolist() == [1, 2]
    np.testing.assert_array_equal(data[kinds == 0], np.asarray(given.data)[kinds == 0])
    like = ["render", str(volume_file), "--like", str(tmp_path / "x.png"), "-o", str(tmp_path / "y.png")]
    assert main(like) == 2  # it may name no other file
    assert main([*like, "--labels", str(tmp_path / "labels.npy")]) == 0
    np.testing.assert_array_equal(imread(tmp_path / "x.png"), imread(tmp_path / "y.png"))


def test_several_volumes_are_in_one_picture(volume_file, tmp_path, drawn):
    pair = ["--with", volume_file, "viridis", 20, 90, "--with", volume_file]
    assert render(volume_file, *pair, "-o", tmp_path / "x.npy", step=None) == 0
    volumes, transfers, _, march = drawn.scenes[0]
    assert len(volumes) == len(transfers) == 3
    assert drawn.how[0]["lighting"] is None
    assert float(march.step) == 0.5
    assert same(transfers[1], jv.colormap("viridis", (20, 90)))
    jv.show(volume_file, others=[(jv.load(volume_file), transfers[1])], size=16)
    assert same(drawn.scenes[1][1], transfers[:2])
    assert same(drawn.scenes[1][2], jv.automatic_camera(*drawn.scenes[1][:2], size=16))
    jv.show(volume_file, size=16, step=0.4, others=volume_file, clip_plane=(0, 0, 5, 0, 0, 1))
    assert len(drawn.scenes[2][0]) == 2
    assert drawn.scenes[2][3].transforms[0].origins.tolist() == [[0, 0, 5]]
    far = jv.Volume(jv.load(volume_file).data, origin=(300, 0, 0))
    with pytest.warns(UserWarning, match=r"others\[0\], from \(300.* does not meet the volume, from \(0"):
        jv.show(volume_file, size=16, step=0.4, others=far)
    turned = jv.Volume(far.data, direction=np.diag([-1.0, -1.0, 1.0]))  # as in many files
    jv.show(turned, size=16, step=0.4, others=turned)


def test_what_is_wrong_is_said_in_words_of_python(volume_file, drawn, monkeypatch):
    volume = jv.load(volume_file)
    camera = jv.Camera.looking_at(volume, size=8)
    for what, options, message in (
        (volume_file, {"presets": "engine"}, "show has no option 'presets'. Did you mean preset"),
        (volume_file, {"clim": (0, 1), "window": 3, "level": 2}, "^clim and (window|level) exclude"),
        (volume, {"dtype": "uint8"}, "dtype is of files; volume is a Volume"),
        (5, {}, "volume must be a jaxvol Volume; got 5"),
        (volume, {"transfer": "hot"}, "transfer must be .*; got 'hot'"),
        (volume, {"camera": (1, 2, 3)}, r"camera must have shape \(6,\)"),
        (volume, {"size": "big"}, r"size must be \(width, height\) in whole pixels"),
        (volume, {"camera": camera, "size": 9}, "camera is a Camera, which has its own size; leave size out"),
        (volume, {"shade": "no"}, "shade must be True or False; got 'no'"),
        (volume, {"compositing": jv.lighting.Phong()}, "compositing must be a name; got a Phong"),
        (volume, {"opacity": 0.3}, "show has no option 'opacity'. Did you mean transfer"),
        (volume, {"labels": [1]}, r"labels must be a file; got .* jv.Volume\(data, labels="),
        (volume, {"others": [volume], "shade": True}, "shade: several volumes are shown without light"),
        (volume, {"others": [volume], "tolerance": 0.1, "step": None}, "tolerance is for one volume"),
        (volume, {"window": -3, "level": 2}, "window must be greater than 0; got -3"),
        (volume, {"others": [(volume, "hot", (1, 10))]}, r"others are FILE, .*; got hot \(1, 10\)"),
    ):
        with pytest.raises(ValueError, match=message):
            jv.show(what, **{"step": 0.4} | options)
    jv.show(volume, camera=camera, step=0.4)
    assert same(drawn.scenes[-1][2], camera)
    jv.show(volume, compositing=jv.Isosurface(30.0), step=0.4)
    assert same(drawn.how[-1]["compositing"], jv.Isosurface(30.0))
    box = (0, 9, 2, 20, 1, 20)
    jv.show(volume, step=0.4, clip_box=box)
    whole, left = jv.automatic_camera(volume, seen := jv.automatic_transfer(volume)), volume.crop(box)
    assert same(drawn.scenes[-1][2], framed(whole, visible_points(left, seen)))
    jv.show(volume, step=0.4, clip_box=(90, 99, 90, 99, 90, 99))  # which holds nothing
    assert same(drawn.scenes[-1][2], whole)
    for odd, message in (
        (jv.Volume(np.full((4, 4, 4), 7.0)), "all voxels have the value 7"),
        (
            jv.Volume(volume.data, labels=np.zeros(volume.shape, np.uint8)),
            "labels: all voxels have the label 0",
        ),
    ):
        with pytest.warns(UserWarning, match=message):
            jv.show(odd, step=0.4, size=8)
    drawn.level = 0.0
    with pytest.warns(UserWarning, match="nothing is visible: the volume's values run .* A clim from"):
        jv.show(volume, jv.preset("engine", (500, 900)), size=8, step=0.4)
