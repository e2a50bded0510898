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


BAD = {
    "text": ("--step long", "argument --step: invalid float value: 'long'"),
    "too few": ("--view-up 3", "argument --view-up: expected 3 arguments"),
    "choice": ("--compositing under", "argument --compositing: invalid choice: 'under'"),
    "excluded": ("--preset engine --cmap gray", "cmap and preset exclude each other"),
}


@pytest.mark.parametrize("case", BAD)
def test_faults_name_the_option(case, capsys):
    words, message = BAD[case]
    assert main(["render", "a.raw", *words.split()]) == 2
    printed = capsys.readouterr().err
    assert printed.startswith("jaxvol render: error: ")
    assert printed.count("\n") == 1
    assert message in printed


def test_a_square_and_a_name_of_a_colour_are_words_in_short():
    found = options("render", "a.raw", "--size", "40", "--background", "red")
    assert (found.size, found.background) == ([40, 40], [1, 0, 0])
