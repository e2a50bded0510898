"""Does a picture hold what made it, and is it made again from that?"""

import contextlib
import json
import os
import shutil
import zlib
from typing import Any

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from skimage.io import imread

import jaxvol as jv
from jaxvol.app.cli import main, parser_of_all
from jaxvol.app.commands.options import parsed
from jaxvol.app.recorded import KEYWORD, checksum, text_of_options

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


def recorded(file):
    return {"name": file.name, "bytes": file.stat().st_size, "sha256": checksum(file)}


def options(*words):
    return parsed(parser_of_all(), words)


def like(name, *words):
    return main(["render", "--like", "a.png", *words, "-o", name])


def test_a_picture_is_made_again_bit_by_bit(picture, volume_file, tmp_path, drawn):
    said = text_in(picture)
    assert said["file"] == recorded(volume_file)
    assert str(tmp_path) not in json.dumps(said)  # nobody gave an absolute path
    flags = [word.partition("=")[0] for word in said["options"] if word.startswith("--")]
    assert sorted(flags) == ["--background", "--direction", "--no-shade", "--preset", "--size", "--step"]
    assert like("b.png") == 0
    assert same_trees(*drawn.scenes)
    assert drawn.how[0] == drawn.how[1]
    np.testing.assert_array_equal(imread("b.png"), imread(picture))
    assert text_in("b.png") == said
    assert like("c.png", "--background", "1", "1", "1") == 0
    assert (imread("c.png") != imread(picture)).any()
    np.save("other.npy", np.asarray(jv.phantom("engine", 24).data)[::-1])  # another volume, alike
    assert main(["render", "other.npy", "--like", "a.png", "-o", "d.png"]) == 0
    assert text_in("d.png")["file"]["name"] == "other.npy"
    assert not same_trees(drawn.scenes[0][0], drawn.scenes[-1][0])
    # other commands take its settings, too
    assert options("plan", "--like", "a.png").direction == [1, -0.3, 0.7]
    found = options("animate", "--like", "a.png", "--frames", "3")
    assert (found.preset, found.frames) == ("engine", 3)


def test_a_transfer_function_from_a_file_is_in_the_picture(volume_file, tmp_path, monkeypatch, drawn, capsys):
    monkeypatch.chdir(tmp_path)
    jv.write_transfer("t.json", jv.preset("engine"))
    words = ["--size", "16", "16", "--step", "0.4", "--no-shade", "--transfer", "t.json"]
    assert main(["render", volume_file.name, *words, "-o", "a.png"]) == 0
    (tmp_path / "t.json").unlink()
    assert like("b.png") == 0
    assert same_trees(*drawn.scenes)
    assert text_in("b.png") == text_in("a.png")
    assert like("c.png", "--preset", "engine") == 0
    assert "transfer" not in text_in("c.png")
    assert like("d.png", "--clim", "0", "1") == 2
    assert "the transfer function in the picture and clim exclude each other" in capsys.readouterr().err


def test_the_command_line_overrides_the_picture(volume_file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def found(words_of_picture, *words):
        png(tmp_path / "a.png", said(*words_of_picture.split(), file=recorded(volume_file)))
        return options("render", "--like", "a.png", *words)

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
    assert not hasattr(options("plan", "--like", "a.png"), "transparent")
    with pytest.raises(ValueError, match="cmap and preset exclude each other"):
        found("--preset=head --cmap=hot")


def test_every_option_is_recorded(volume_file, tmp_path):
    words = "--size 40 30 --step 1 --view-up 0 -1.5e-05 0 --cmap #ff0000 --compositing maximum --no-shade "
    words += "--parallel --clip-plane 1 2 3 0 0 1 --clip-plane 4 5 6 1 0 0 --memory 2M --zoom 1.25"
    given = options("render", str(volume_file), *words.split())
    transfer = jv.colormap("red", (0, 1))
    png(tmp_path / "a.png", text_of_options(given, transfer)[KEYWORD])
    again = vars(options("render", "--like", str(tmp_path / "a.png")))
    assert again.pop("like") == tmp_path / "a.png"
    assert again == {name: value for name, value in vars(given).items() if name != "like"}


def test_the_volume_may_lie_beside_the_picture_and_must_be_the_same(picture, volume_file, tmp_path, capsys):
    (tmp_path / "there").mkdir()
    for file in (picture, volume_file):
        shutil.copy(file, tmp_path / "there" / file.name)
    volume_file.write_bytes(volume_file.read_bytes()[::-1])
    assert like("b.png") == 2
    changed = f"{volume_file.name} is not the volume that a.png shows: its SHA-256 differs"
    assert changed in capsys.readouterr().err
    volume_file.unlink()
    assert like("b.png") == 2
    assert "which is not there" in capsys.readouterr().err
    capsys.readouterr()
    assert options("render", "--like", "there/a.png").file.parent.name == "there"
    assert f"names the volume 'there/{volume_file.name}'" in capsys.readouterr().out  # which is read then


def different(path, file, *contents):
    """Whether a volume's checksum is another for each of these contents of one of its files."""
    found = set()
    for content in contents:
        file.write_bytes(content)
        found.add(checksum(path))
    return len(found) == len(contents)


def test_a_checksum_tells_all_files_of_a_volume_and_nothing_else(tmp_path):
    slices, first = tmp_path / "slices", tmp_path / "slices" / "a.dcm"
    slices.mkdir()
    (slices / "b.dcm").write_bytes(bytes(128) + b"DICM" + b"0")
    assert different(slices, first, bytes(128) + b"DICM1", bytes(128) + b"DICM2")
    one = checksum(slices)
    (slices / "picture.png").write_bytes(b"drawn meanwhile")
    assert checksum(slices) == one
    first.rename(slices / "c.dcm")
    assert checksum(slices) != one
    # the voxels that a header names, and the header
    voxels = tmp_path / "my scan.raw"
    (tmp_path / "a.mhd").write_text("NDims = 3\nElementDataFile = my scan.raw\n")
    (tmp_path / "a.nrrd").write_text("NRRD0004\ndata file: my scan.raw\n\n")
    (tmp_path / "a.raw").write_bytes(b"1")
    bare = checksum(tmp_path / "a.raw")
    for name in ("a.mhd", "a.nrrd"):
        assert different(tmp_path / name, voxels, b"1", b"2")
    assert different(tmp_path / "a.raw", tmp_path / "a.raw.json", b"{}", b'{"spacing": [1, 1, 2]}')
    assert checksum(tmp_path / "a.raw") != bare
    zarr = tmp_path / "zarr"
    (zarr / "1").mkdir(parents=True)
    (zarr / "zarr.json").write_text("{}")
    assert different(zarr, zarr / "1" / "c", b"2", b"3")


def test_the_checksum_of_one_slice_is_that_of_its_series(tmp_path):
    pytest.importorskip("SimpleITK", reason="SimpleITK is not installed: pip install jaxvol[io]")
    from ...io.formats.test_dicom import write_series

    paths = write_series(tmp_path / "a")
    one = checksum(paths[0])
    assert checksum(paths[1]) == one
    content = paths[1].read_bytes()
    paths[1].write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    assert checksum(paths[0]) != one


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


def said(*words, **changed):
    file = {"name": "v.raw", "bytes": 6, "sha256": "0" * 64}
    return json.dumps({"options": words, "file": file} | changed)


def volume(name, size: Any = 6):
    return said(file={"name": name, "bytes": size, "sha256": "0" * 64})


BAD = {
    "no object": ("[]", "damaged"),
    "checksum": (said(file={"name": "a", "sha256": "b"}), "damaged"),
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
    "another volume": (said("--size", "9", "9", "/dev/zero"), "a picture names its volume elsewhere"),
    "the end of flags": (said("--", "/dev/zero"), "takes no '--'"),
    "help": (said("--help"), "takes no '--help'"),
    "a flag as a value": (said("--preset=--depth=a.npy"), "which is not there"),
    "no words": (said(1), "damaged"),
    "a value of another kind": (said("--step=much"), "argument --step: invalid float value: 'much'"),
    "a long value": (said("--step=" + "9a" * 5000), "argument --step: invalid float value"),
    "keys": (said(file={"name": "a", "bytes": 6, "sha256": "0" * 64, "path": "b"}), "which is not there"),
    "no size": (said(file={"name": "a", "sha256": "0" * 64}), "damaged"),
    "text for a size": (volume("a", "6"), "damaged"),
    "file": (said(file="/etc/passwd"), "damaged"),
    "no file": (said(), "which is not there"),
    "a device": (volume("/dev/zero"), "/dev/zero is no volume"),
    "a file without an end": (volume("/proc/self/pagemap", 0), "/proc/self/pagemap is no volume"),
    "what blocks": (volume("/proc/kmsg", 0), "/proc/kmsg is no volume"),
    "a link to it": (volume("link.raw", 0), "link.raw is no volume"),
    "header": (volume("a.mhd", 60), "a.mhd is no volume"),
    "a pipe": (volume("pipe.raw", 0), "pipe.raw is no volume"),
    "another size": (volume("six.raw", 5), "is not the volume that a.png shows: that has 5 bytes"),
    "a file that is another": (volume("six.raw"), "its SHA-256 differs"),
    "a folder": (volume("folder"), "folder is no volume"),
    "transfer": (said(transfer={"values": []}), "the transfer function in it: "),
    "transfer's numbers": (
        said(transfer={"values": ["a"], "colors": 1, "extinction": None}),
        "the transfer function in it: ",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_settings_that_others_may_have_made_are_checked(case, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    os.mkfifo("pipe.raw")
    os.symlink("/proc/kmsg", "link.raw")
    (tmp_path / "six.raw").write_bytes(b"123456")
    (tmp_path / "a.mhd").write_text("NDims = 3\nElementDataFile = /proc/self/pagemap\n")
    made, message = BAD[case]
    png(tmp_path / "a.png", made) if isinstance(made, str) else made(tmp_path / "a.png")
    assert like("b.png") == 2
    printed = capsys.readouterr().err
    assert printed.startswith("jaxvol render: error: --like: ")
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
                options("render", "--like", "d.png")  # pixels may be damaged: they are not read
