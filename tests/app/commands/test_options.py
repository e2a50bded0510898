"""Are the words of a command line, and the options of a TOML file, read as they are meant?"""

import pytest

from jaxvol.app.cli import main, parser_of_all
from jaxvol.app.commands.options import parsed


def options(*words):
    return parsed(parser_of_all(), words)


def test_small_negative_numbers_are_no_flags():
    assert options("render", "a.raw", "--direction", "-1e-5", "-.5", "-1").direction == [-1e-5, -0.5, -1]


def test_a_file_is_needed_unless_a_picture_names_one(capsys):
    for command in ("render", "plan", "animate", "info", "view"):
        assert main([command]) == 2
        assert "the following arguments are required: " in capsys.readouterr().err


def test_memory_is_a_number_of_bytes():
    for text, count in (("1000", 1000), ("256M", 2**28), ("2g", 2**31), ("0.5K", 512)):
        assert options("plan", "a.raw", "--memory", text).memory == count
    for text in ("much", "", "-1", "0", "nan", "inf", "1e999", "9" * 400, "5T"):
        with pytest.raises(ValueError, match="argument --memory: must be a number of bytes"):
            options("plan", "a.raw", f"--memory={text}")


@pytest.fixture
def config(tmp_path):
    def written(text):
        path = tmp_path / "settings.toml"
        path.write_text(text)
        return str(path)

    return written


def test_every_kind_of_option_is_taken_from_a_file(config):
    path = config(
        """
        file = "a.raw"
        size = [40, 30]
        step = 1
        view-up = [0, 1.5, 0]
        preset = "engine"
        shade = false
        parallel = true
        clip-plane = [[1, 2, 3, 0, 0, 1], [4, 5, 6, 1, 0, 0]]
        memory = "2M"
        output = "b.png"
        """
    )
    flags = "a.raw --size 40 30 --step 1 --view-up 0 1.5 0 --preset engine --no-shade --parallel "
    flags += "--clip-plane 1 2 3 0 0 1 --clip-plane 4 5 6 1 0 0 --memory 2M -o b.png"
    found, expected = vars(options("render", "--config", path)), vars(options("render", *flags.split()))
    assert str(found.pop("config")) == path
    assert expected.pop("config") is None
    assert found == expected
    found = options("render", "--config", config('file = "a.raw"\nsize = 40\nbackground = "red"'))
    assert (found.size, found.background) == ([40, 40], [1, 0, 0])


def test_the_command_line_stands_above_the_file(config):
    path = config('file = "a.raw"\npreset = "engine"\nsize = [8, 8]\nstep = 2.0\nparallel = true')
    words = ["--cmap", "gray", "--size", "9", "9", "--tolerance", "0.1", "--no-parallel"]
    found = options("render", "b.raw", "--config", path, *words)
    assert str(found.file) == "b.raw"
    assert (found.cmap, found.preset) == ("gray", None)  # one stands in the place of the other
    assert (found.tolerance, found.step, found.parallel) == (0.1, None, False)
    assert list(found.size) == [9, 9]


BAD = {
    "unknown": ("sise = [1, 2]", "settings.toml: jaxvol render has no option 'sise'"),
    "itself": ('config = "a.toml"', "has no option 'config'"),
    "text": ('step = "long"', "argument --step: invalid float value: 'long'"),
    "no list": ("view-up = 3", "argument --view-up: expected 3 arguments"),
    "choice": ('compositing = "under"', "argument --compositing: invalid choice: 'under'"),
    "excluded": ('preset = "engine"\ncmap = "gray"', "cmap and preset exclude each other"),
    "no TOML": ("step = ", "settings.toml cannot be read as TOML"),
}


@pytest.mark.parametrize("case", BAD)
def test_faults_name_the_file_or_the_option(case, config, capsys):
    text, message = BAD[case]
    assert main(["render", "a.raw", "--config", config(text)]) == 2
    printed = capsys.readouterr().err
    assert printed.startswith("jaxvol render: error: ")
    assert printed.count("\n") == 1
    assert message in printed
