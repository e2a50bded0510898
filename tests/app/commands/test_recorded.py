"""Does a picture hold what made it, and is it made again from that?"""

import contextlib
import json
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from skimage.io import imread

import jaxvol as jv
from jaxvol.app.cli import main, parser_of_all
from jaxvol.app.commands.options import parsed
from jaxvol.app.recorded import KEYWORD, text_of_options

from ...scenes import same_trees


SEEN = ["--preset", "engine", "--no-shade", "--size", "16", "16", "--step", "0.4"]


def text_in(path):
    return json.loads(Image.open(path).info[KEYWORD])


@pytest.fixture
def picture(volume_file, tmp_path, monkeypatch, drawn):
    monkeypatch.chdir(tmp_path)
    look = ["--direction", "1", "-0.3", "0.7", "--background", "0", "0.1", "1"]
    assert main(["render", volume_file.name, *SEEN, *look, "-o", "a.png"]) == 0
    return tmp_path / "a.png"


def options(*words):
    return parsed(parser_of_all(), words)


def like(file, name, *words):
    return main(["render", file.name, "--like", "a.png", *words, "-o", name])


def test_a_picture_is_made_again_bit_by_bit(picture, volume_file, tmp_path, drawn):
    said = text_in(picture)
    assert said["file"] == volume_file.name
    assert str(tmp_path) not in json.dumps(said)  # nobody gave an absolute path
    flags = [word.partition("=")[0] for word in said["options"] if word.startswith("--")]
    assert sorted(flags) == ["--background", "--direction", "--no-shade", "--preset", "--size", "--step"]
    assert like(volume_file, "b.png") == 0
    assert same_trees(*drawn.scenes)
    assert drawn.how[0] == drawn.how[1]
    np.testing.assert_array_equal(imread("b.png"), imread(picture))
    assert text_in("b.png") == said
    assert like(volume_file, "c.png", "--background", "1", "1", "1") == 0
    assert (imread("c.png") != imread(picture)).any()
    np.save("other.npy", np.asarray(jv.phantom("engine", 24).data)[::-1])  # another volume, alike
    assert main(["render", "other.npy", "--like", "a.png", "-o", "d.png"]) == 0
    assert text_in("d.png")["file"] == "other.npy"
    assert not same_trees(drawn.scenes[0][0], drawn.scenes[-1][0])
    # other commands take its settings, too
    assert options("plan", "v.raw", "--like", "a.png").direction == [1, -0.3, 0.7]
    found = options("animate", "v.raw", "--like", "a.png", "--frames", "3")
    assert (found.preset, found.frames) == ("engine", 3)


def test_a_transfer_function_from_a_file_is_in_the_picture(volume_file, tmp_path, monkeypatch, drawn, capsys):
    monkeypatch.chdir(tmp_path)
    jv.write_transfer("t.json", jv.preset("engine"))
    words = ["--size", "16", "16", "--step", "0.4", "--no-shade", "--transfer", "t.json"]
    assert main(["render", volume_file.name, *words, "-o", "a.png"]) == 0
    (tmp_path / "t.json").unlink()
    assert like(volume_file, "b.png") == 0
    assert same_trees(*drawn.scenes)
    assert text_in("b.png") == text_in("a.png")
    assert like(volume_file, "c.png", "--preset", "engine") == 0
    assert "transfer" not in text_in("c.png")
    assert like(volume_file, "d.png", "--clim", "0", "1") == 2
    assert "the transfer function in the picture and clim exclude each other" in capsys.readouterr().err


def test_the_command_line_overrides_the_picture(volume_file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def found(words_of_picture, *words):
        png(tmp_path / "a.png", said(*words_of_picture.split()))
        return options("render", volume_file.name, "--like", "a.png", *words)

    words = "--preset=engine --clim 1 2 --unit-distance=3 --step=2 --size 8 8 --clip-plane 1 2 3 0 0 1"
    assert found(words).clim == [1, 2]
    given = found(words, "--transfer", "t.json", "--tolerance", "0.1", "--size", "9", "9")
    assert (given.preset, given.clim, given.unit_distance) == (None, None, None)
    assert (given.step, given.tolerance, given.size) == (None, 0.1, [9, 9])
    given = found(words, "--cmap", "hot", "--clip-plane", *"000100")
    assert (given.preset, given.clim, given.clip_plane) == (None, [1, 2], [[0, 0, 0, 1, 0, 0]])
    surface = "--compositing=isosurface --isovalue=5"
    assert found(surface, "--compositing", "maximum").isovalue is None
    assert found(surface, "--compositing", "isosurface").isovalue == 5
    flags = ("parallel", "transparent", "clip_inside_out")
    words = " ".join(f"--{flag.replace('_', '-')}" for flag in flags)
    off = [f"--no-{flag.replace('_', '-')}" for flag in flags]
    assert all(getattr(found(words), flag) for flag in flags)
    assert not any(getattr(found(words, *off), flag) for flag in flags)
    assert not hasattr(options("plan", "v.raw", "--like", "a.png"), "transparent")
    with pytest.raises(ValueError, match="cmap and preset exclude each other"):
        found("--preset=head --cmap=hot")


def test_every_option_is_recorded(volume_file, tmp_path):
    words = "--size 40 30 --step 1 --view-up 0 -1.5e-05 0 --cmap #ff0000 --compositing maximum --no-shade "
    words += "--parallel --clip-plane 1 2 3 0 0 1 --clip-plane 4 5 6 1 0 0 --zoom 1.25"
    given = options("render", str(volume_file), *words.split())
    transfer = jv.colormap("red", (0, 1))
    png(tmp_path / "a.png", text_of_options(given, transfer)[KEYWORD])
    again = vars(options("render", str(volume_file), "--like", str(tmp_path / "a.png")))
    assert again.pop("like") == tmp_path / "a.png"
    assert again == {name: value for name, value in vars(given).items() if name != "like"}


def png(path, text, keyword=KEYWORD):
    chunks = PngInfo()
    chunks.add_text(keyword, text, zip=True)
    Image.new("RGB", (8, 8)).save(path, pnginfo=chunks)


def unpacks_to_much(path):
    """A text of 64 MB of zeros in 64 kB."""
    Image.new("RGB", (8, 8)).save(path)
    whole = path.read_bytes()
    body = b"zTXt" + KEYWORD.encode() + b"\0\0" + zlib.compress(bytes(2**26))
    chunk = (len(body) - 4).to_bytes(4, "big") + body + zlib.crc32(body).to_bytes(4, "big")
    path.write_bytes(whole[:33] + chunk + whole[33:])


def said(*words, **more):
    return json.dumps({"options": words, "file": "/dev/zero"} | more)


BAD = {
    "no object": ("[]", "damaged"),
    "foreign": (lambda p: Image.new("RGB", (8, 8)).save(p), "holds no settings of jaxvol"),
    "a JPEG": (lambda p: Image.new("RGB", (8, 8)).save(p, "JPEG"), "cannot be read as a PNG"),
    "unpacks to much": (unpacks_to_much, "a.png"),
    "of another program": (lambda p: png(p, "x", "Software"), "holds no settings of jaxvol"),
    "no JSON": ("import os; os.remove('x')", "damaged"),
    "long number": ("9" * 5000, "damaged"),
    "long": ('"' + "x" * 2**20 + '"', "PNG"),
    "option": (said("--evil=1"), "jaxvol render takes no '--evil=1' from a picture"),
    "a file to read": (said("--transfer=/dev/zero"), "takes no '--transfer=/dev/zero'"),
    "a file to write": (said("--size", "9", "9", "--depth", "a.npy"), "takes no '--depth'"),
    "a file in short": (said("-oa.npy"), "takes no '-oa.npy'"),
    "the beginning of a flag": (said("--dep=a.npy"), "takes no '--dep=a.npy'"),
    "another picture": (said("--like=a.png"), "takes no '--like=a.png'"),
    "another volume": (said("--size", "9", "9", "/dev/zero"), "unrecognized arguments: /dev/zero"),
    "the end of flags": (said("--", "/dev/zero"), "takes no '--'"),
    "help": (said("--help"), "takes no '--help'"),
    "a flag as a value": (said("--preset=--depth=a.npy"), "preset must be one of"),
    "no words": (said(1), "damaged"),
    "a value of another kind": (said("--step=much"), "argument --step: invalid float value: 'much'"),
    "a long value": (said("--step=" + "9a" * 5000), "argument --step: invalid float value"),
    "transfer": (said(transfer={"values": []}), "the transfer function in it: "),
    "transfer's numbers": (
        said(transfer={"values": ["a"], "colors": 1, "extinction": None}),
        "the transfer function in it: ",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_settings_that_others_may_have_made_are_checked(case, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made, message = BAD[case]
    png(tmp_path / "a.png", made) if isinstance(made, str) else made(tmp_path / "a.png")
    np.save("v.npy", np.zeros((2, 2, 2), np.uint8))
    assert like(Path("v.npy"), "b.png") == 2
    printed = capsys.readouterr().err
    assert printed.startswith("jaxvol render: error: ")
    assert printed.count("\n") == 1
    assert len(printed) < 700
    assert message in printed
    assert not (tmp_path / "b.png").exists()


def test_a_damaged_picture_raises_nothing_but_value_errors(picture, tmp_path):
    whole = picture.read_bytes()
    for number in range(8, len(whole), 97):
        for content in (whole[:number], whole[:number] + bytes([whole[number] ^ 255]) + whole[number + 1 :]):
            (tmp_path / "d.png").write_bytes(content)
            with contextlib.suppress(ValueError):
                options("render", "v.raw", "--like", "d.png")  # pixels may be damaged: they are not read
