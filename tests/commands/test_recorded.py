"""Does a picture hold what made it, and is it made again from that?"""

import contextlib
import json
import shutil
import zlib

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from skimage.io import imread

import jaxvol as jv
from jaxvol.cli import _parser, main
from jaxvol.commands.checksum import checksum
from jaxvol.commands.recorded import KEYWORD, MOST
from jaxvol.commands.settings import parsed


SEEN = ["--size", "16", "16", "--step", "0.4"]


def text_in(path):
    return json.loads(Image.open(path).info[KEYWORD])


@pytest.fixture
def picture(volume_file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    look = [
        "--preset",
        "engine",
        "--no-shade",
        "--direction",
        "1",
        "-0.3",
        "0.7",
        "--background",
        "0",
        "0.1",
        "1",
    ]
    assert main(["render", volume_file.name, *SEEN, *look, "-o", "a.png"]) == 0
    return tmp_path / "a.png"


def test_a_picture_is_made_again_bit_by_bit(picture, volume_file, tmp_path):
    said = text_in(picture)
    assert said["command"] == "render"
    assert said["file"] == {"name": volume_file.name, "sha256": checksum(volume_file)}
    assert str(tmp_path) not in json.dumps(said)  # nobody gave an absolute path
    assert "programs" not in said["settings"]
    assert main(["render", "--like", "a.png", "-o", "b.png"]) == 0
    again = tmp_path / "b.png"
    np.testing.assert_array_equal(imread(again), imread(picture))
    assert text_in(again) == said
    assert imread(picture).std() > 5
    assert main(["render", "--like", "a.png", "--background", "1", "1", "1", "-o", "c.png"]) == 0
    assert (imread(tmp_path / "c.png") != imread(picture)).any()


def test_a_transfer_function_from_a_file_is_in_the_picture(volume_file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    jv.write_transfer("t.json", jv.preset("engine"))
    words = [volume_file.name, *SEEN, "--no-shade"]
    assert main(["render", *words, "--transfer", "t.json", "-o", "a.png"]) == 0
    (tmp_path / "t.json").unlink()
    assert main(["render", "--like", "a.png", "-o", "b.png"]) == 0
    np.testing.assert_array_equal(imread("a.png"), imread("b.png"))
    assert text_in(tmp_path / "b.png") == text_in(tmp_path / "a.png")
    assert main(["render", "--like", "a.png", "--preset", "engine", "-o", "c.png"]) == 0
    assert "transfer" not in text_in(tmp_path / "c.png")


def test_another_volume_may_be_rendered_alike(picture, tmp_path, capsys):
    np.save(tmp_path / "other.npy", np.asarray(jv.phantom("engine", 24).data)[::-1])
    assert main(["render", "other.npy", "--like", "a.png", "-o", "b.png"]) == 0
    assert text_in(tmp_path / "b.png")["file"]["name"] == "other.npy"
    assert (imread("b.png") != imread(picture)).any()


def test_the_volume_may_lie_beside_the_picture(picture, volume_file, tmp_path, monkeypatch):
    (tmp_path / "there").mkdir()
    for file in (picture, volume_file):
        shutil.move(file, tmp_path / "there" / file.name)
    found = parsed(_parser, ["render", "--like", "there/a.png"])
    assert found.file.parent.name == "there"


def test_a_volume_that_has_changed_is_not_taken_for_the_same(picture, volume_file, capsys):
    volume_file.write_bytes(volume_file.read_bytes()[::-1])
    assert main(["render", "--like", "a.png", "-o", "b.png"]) == 2
    assert (
        f"{volume_file.name} is not the volume that a.png shows: its SHA-256 differs"
        in capsys.readouterr().err
    )
    volume_file.unlink()
    assert main(["render", "--like", "a.png", "-o", "b.png"]) == 2
    assert "which is not there" in capsys.readouterr().err


def test_other_commands_take_its_settings_too(picture):
    assert parsed(_parser, ["plan", "--like", str(picture)]).direction == [1, -0.3, 0.7]
    found = parsed(_parser, ["animate", "--like", str(picture), "--frames", "3"])
    assert (found.preset, found.frames) == ("engine", 3)


def checksums(path, file, *contents):
    """Of a volume, with each of these contents in one of its files."""
    found = []
    for content in contents:
        file.write_bytes(content)
        found.append(checksum(path))
    return found


def test_the_checksum_of_a_folder_tells_its_slices_and_nothing_else(tmp_path):
    first, other = tmp_path / "a.dcm", tmp_path / "b.dcm"
    other.write_bytes(bytes(128) + b"DICM" + b"0")
    one, two = checksums(tmp_path, first, bytes(128) + b"DICM1", bytes(128) + b"DICM2")
    assert one != two
    (tmp_path / "picture.png").write_bytes(b"drawn meanwhile")
    assert checksum(tmp_path) == two
    first.rename(tmp_path / "c.dcm")
    assert checksum(tmp_path) != two


def test_the_checksum_of_a_header_tells_the_voxels_that_it_names(tmp_path):
    path, voxels = tmp_path / "a.mhd", tmp_path / "my scan.raw"
    path.write_text("NDims = 3\nElementDataFile = my scan.raw\n")
    assert len(set(checksums(path, voxels, b"1", b"2"))) == 2
    path = tmp_path / "a.nrrd"
    path.write_text("NRRD0004\ndata file: my scan.raw\n\n")
    assert len(set(checksums(path, voxels, b"1", b"2"))) == 2
    path = tmp_path / "a.raw"
    path.write_bytes(b"1")
    assert (
        len({checksum(path), *checksums(path, tmp_path / "a.raw.json", b"{}", b'{"spacing": [1, 1, 2]}')})
        == 3
    )


def test_the_checksum_of_one_slice_is_that_of_its_series(tmp_path):
    pytest.importorskip("SimpleITK", reason="SimpleITK is not installed: pip install jaxvol[io]")
    from ..formats.test_dicom import write_series

    paths = write_series(tmp_path / "a")
    one = checksum(paths[0])
    assert checksum(paths[1]) == one
    content = paths[1].read_bytes()
    paths[1].write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    assert checksum(paths[0]) != one


def test_the_checksum_of_zarr_tells_all_its_files(tmp_path):
    (tmp_path / "0").mkdir()
    (tmp_path / "1").mkdir()
    (tmp_path / "zarr.json").write_text("{}")
    (tmp_path / "0" / "c").write_bytes(b"1")
    one, two = checksums(tmp_path, tmp_path / "1" / "c", b"2", b"3")
    assert one != two


@pytest.mark.parametrize("name", ["/dev/zero", "/", "empty"])
def test_what_is_no_volume_is_not_read(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "text").write_text("no volume")
    said = {"jaxvol": "1", "command": "render", "settings": {}, "file": {"name": name, "sha256": "0" * 64}}
    png(tmp_path / "a.png", json.dumps(said))
    assert main(["render", "--like", "a.png", "-o", "b.png"]) == 2
    assert f"{name} is no volume" in capsys.readouterr().err


def png(path, text, keyword=KEYWORD):
    chunks = PngInfo()
    chunks.add_text(keyword, text, zip=True)
    Image.new("RGB", (8, 8)).save(path, pnginfo=chunks)


def settings(**changed):
    return json.dumps({"jaxvol": "1", "command": "render", "settings": {}} | changed)


BAD = {
    "foreign": (lambda p: Image.new("RGB", (8, 8)).save(p), "holds no settings of jaxvol"),
    "of another program": (lambda p: png(p, "x", "Software"), "holds no settings of jaxvol"),
    "no picture": (lambda p: p.write_bytes(b"GIF89a"), "cannot be read as a PNG"),
    "a JPEG": (lambda p: Image.new("RGB", (8, 8)).save(p, "JPEG"), "cannot be read as a PNG"),
    "no JSON": (lambda p: png(p, "import os; os.remove('x')"), "damaged: they are not JSON"),
    "deep": (lambda p: png(p, "[" * 100_000), "damaged: they are not JSON"),
    "long number": (lambda p: png(p, "9" * 5000), "damaged"),
    "no object": (lambda p: png(p, "[]"), "jaxvol, command, settings are needed"),
    "no settings": (lambda p: png(p, '{"jaxvol": "1", "command": "render"}'), "are needed"),
    "long": (lambda p: png(p, '"' + "x" * MOST + '"'), "PNG"),
    "command": (
        lambda p: png(p, settings(command="demo", settings={"size": [9, 9]})),
        "was not made by jaxvol render, but, as it says, by jaxvol 'demo --size 9 9'",
    ),
    "option": (
        lambda p: png(p, settings(settings={"evil": 1})),
        "the settings in it: jaxvol render has no option",
    ),
    "output": (lambda p: png(p, settings(settings={"output": "/etc/passwd"})), "has no option 'output'"),
    "a file": (lambda p: png(p, settings(settings={"transfer": "/dev/zero"})), "has no option 'transfer'"),
    "rivals": (
        lambda p: png(p, settings(settings={"preset": "head", "cmap": "hot"})),
        "one of preset and cmap excludes the other",
    ),
    "programs": (lambda p: png(p, settings(settings={"programs": "/"})), "has no option 'programs'"),
    "kind": (lambda p: png(p, settings(settings={"step": "1"})), "step must be a number; got '1'"),
    "huge": (lambda p: png(p, settings(settings={"step": 10**400})), "step must be a number"),
    "file": (lambda p: png(p, settings(file="/etc/passwd")), "file must have a name and a SHA-256"),
    "checksum": (lambda p: png(p, settings(file={"name": "a", "sha256": "b"})), "file must have a name"),
    "no file": (lambda p: png(p, settings()), "does not say which volume it shows"),
    "transfer": (
        lambda p: png(p, settings(transfer={"values": []})),
        "the transfer function in it must be an object",
    ),
    "transfer's numbers": (
        lambda p: png(p, settings(transfer={"values": ["a"], "colors": 1, "extinction": None})),
        "the transfer function in it: ",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_settings_that_others_may_have_made_are_checked(case, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make, message = BAD[case]
    make(tmp_path / "a.png")
    assert main(["render", "--like", "a.png", "-o", "b.png"]) == 2
    printed = capsys.readouterr().err
    assert printed.startswith("jaxvol render: error: --like: ")
    assert printed.count("\n") == 1
    assert len(printed) < 700
    assert message in printed
    assert not (tmp_path / "b.png").exists()


def test_a_text_that_unpacks_to_more_than_it_should_is_refused(tmp_path, capsys):
    """64 MB of zeros in 64 kB."""
    Image.new("RGB", (8, 8)).save(tmp_path / "a.png")
    whole = (tmp_path / "a.png").read_bytes()
    body = b"zTXt" + KEYWORD.encode() + b"\0\0" + zlib.compress(bytes(2**26))
    chunk = (len(body) - 4).to_bytes(4, "big") + body + zlib.crc32(body).to_bytes(4, "big")
    (tmp_path / "a.png").write_bytes(whole[:33] + chunk + whole[33:])
    assert main(["render", "--like", str(tmp_path / "a.png")]) == 2
    assert "a.png" in capsys.readouterr().err


def test_a_damaged_picture_raises_nothing_but_value_errors(picture, tmp_path):
    whole = picture.read_bytes()
    for number in range(8, len(whole), 41):
        for content in (whole[:number], whole[:number] + bytes([whole[number] ^ 255]) + whole[number + 1 :]):
            (tmp_path / "d.png").write_bytes(content)
            with contextlib.suppress(ValueError):
                parsed(_parser, ["render", "--like", "d.png"])  # pixels may be damaged: they are not read
