"""Do options come from a TOML file, with those of the command line above them?"""

import re

import pytest

from jaxvol.app.cli import main, parser_of_all
from jaxvol.app.commands.parsing import parsed


def options(*words):
    return parsed(parser_of_all(), [str(word) for word in words])


@pytest.fixture
def config(tmp_path):
    def written(text):
        path = tmp_path / "settings.toml"
        path.write_text(text)
        return path

    return written


def test_every_kind_of_option_is_taken_from_a_file(config):
    path = config(
        """
        file = "a.raw"
        size = [40, 30]
        step = 1
        view-up = [0, 1.5, 0]
        preset = "engine"
        compositing = "maximum"
        shade = false
        parallel = true
        clip-plane = [[1, 2, 3, 0, 0, 1], [4, 5, 6, 1, 0, 0]]
        memory = "2M"
        output = "b.png"
        """
    )
    found = vars(options("render", "--config", path))
    flags = "a.raw --size 40 30 --step 1 --view-up 0 1.5 0 --preset engine --compositing maximum --no-shade "
    flags += "--parallel --clip-plane 1 2 3 0 0 1 --clip-plane 4 5 6 1 0 0 --memory 2M -o b.png"
    expected = vars(options("render", *flags.split()))
    assert found.pop("config") == path
    assert expected.pop("config") is None
    assert found == expected
    assert found["memory"] == 2 * 2**20


def test_the_command_line_stands_above_the_file(config):
    path = config(
        'file = "a.raw"\npreset = "engine"\nsize = [8, 8]\nclip-plane = [[1, 2, 3, 0, 0, 1]]\nstep = 2.0'
    )
    words = ["--cmap", "gray", "--size", 9, 9, "--clip-plane", 0, 0, 0, 1, 0, 0, "--tolerance", 0.1]
    found = options("render", "b.raw", "--config", path, *words)
    assert str(found.file) == "b.raw"
    assert (found.cmap, found.preset) == ("gray", None)  # one stands in the place of the other
    assert (found.tolerance, found.step) == (0.1, None)
    assert list(found.size) == [9, 9]
    assert found.clip_plane == [[0, 0, 0, 1, 0, 0]]


def test_small_negative_numbers_are_no_flags():
    assert options("render", "a.raw", "--direction", "-1e-5", "-.5", "-1").direction == [-1e-5, -0.5, -1]


def test_what_a_command_needs_may_stand_in_the_file(config):
    path = config('file = "a.raw"\nimages = ["a.png"]\ncameras = "c.json"')
    found = options("fit", "--config", path)
    assert [str(each) for each in (found.file, *found.images, found.cameras)] == ["a.raw", "a.png", "c.json"]
    with pytest.raises(ValueError, match="arguments are required: cameras"):
        options("fit", "a.raw", "--config", config('images = ["a.png"]'))


def test_the_viewer_takes_its_options_from_a_file(config):
    path = config('file = "a.raw"\nclim = [0, 9]\ncmap = "bone"\nshade = false\nport = 9000')
    found = options("view", "--config", path, "--port", 9001)
    flags = "a.raw --clim 0 9 --cmap bone --no-shade --port 9001"
    assert vars(found) | {"config": None} == vars(options("view", *flags.split()))
    with pytest.raises(ValueError, match="jaxvol view has no option 'size'"):
        options("view", "--config", config("size = [1, 2]"))


def test_what_another_option_makes_void_does_not_count(config):
    path = config('file = "a.raw"\npreset = "engine"\nclim = [1, 2]\nunit-distance = 3')
    found = options("render", "--config", path, "--transfer", "t.json")
    assert (found.preset, found.clim, found.unit_distance) == (None, None, None)
    found = options("render", "--config", path, "--cmap", "hot")
    assert (found.preset, found.clim, found.unit_distance) == (None, [1, 2], 3)
    path = config('file = "a.raw"\ncompositing = "isosurface"\nisovalue = 5')
    assert options("render", "--config", path, "--compositing", "maximum").isovalue is None
    assert options("render", "--config", path, "--compositing", "isosurface").isovalue == 5
    assert options("render", "--config", path, "--size", 9, 9).isovalue == 5


def test_flags_of_a_file_can_be_turned_off(config):
    path = config('file = "a.raw"\nparallel = true\ntransparent = true\nclip-inside-out = true')
    names = ("parallel", "transparent", "clip_inside_out")
    assert all(getattr(options("render", "--config", path), name) for name in names)
    off = [f"--no-{name.replace('_', '-')}" for name in names]
    assert not any(getattr(options("render", "--config", path, *off), name) for name in names)


BAD = {
    "no list of lists": ("clip-plane = 1", "argument --clip-plane: expected 6 arguments"),
    "unknown": ("sise = [1, 2]", "settings.toml: jaxvol render has no option 'sise'"),
    "of another command": ('solver = "adam"', "jaxvol render has no option 'solver'"),
    "itself": ('config = "a.toml"', "has no option 'config'"),
    "text": ('step = "long"', "settings.toml: argument --step: invalid float value: 'long'"),
    "truth": ("step = true", "argument --step: expected one argument"),
    "fraction": ("size = [1.5, 2]", "argument --size: invalid int value: '1.5'"),
    "no list": ("view-up = 3", "argument --view-up: expected 3 arguments"),
    "too many": ('view-up = [1, 2, 3, "other.raw"]', "too many values"),
    "a flag": ('view-up = [1, 2, 3, "--depth", "a.npy"]', "view-up must not hold"),
    "choice": ('compositing = "under"', "argument --compositing: invalid choice: 'under'"),
    "bytes": (
        'memory = "much"',
        "argument --memory: must be a number of bytes, such as 256M or 2G; got 'much'",
    ),
    "no TOML": ("step = ", "settings.toml is not TOML"),
}


@pytest.mark.parametrize("case", BAD)
def test_faults_name_the_file_and_the_option(case, config, capsys):
    text, message = BAD[case]
    assert main(["render", "a.raw", "--config", str(config(text))]) == 2
    printed = capsys.readouterr().err
    assert printed.startswith("jaxvol render: error: ")
    assert printed.count("\n") == 1
    assert message in printed


def test_a_file_that_is_not_there_is_named(tmp_path, capsys):
    assert main(["render", "a.raw", "--config", str(tmp_path / "no.toml")]) == 2
    assert re.search(r"--config: \S*no\.toml cannot be read", capsys.readouterr().err)


def test_memory_is_a_number_of_bytes():
    for text, count in (("1000", 1000), ("256M", 2**28), ("2g", 2**31), ("0.5K", 512)):
        assert options("plan", "a.raw", "--memory", text).memory == count
    for text in ("much", "", "-1", "0", "nan", "inf", "1e999", "9" * 400, "5T"):
        with pytest.raises(ValueError, match="argument --memory: must be a number of bytes"):
            options("plan", "a.raw", f"--memory={text}")
