"""Are the words of a command line read as they are meant?"""

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
