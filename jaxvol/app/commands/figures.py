"""`jaxvol figures`: the figures of the papers. Their scripts, and the records from which they are drawn, are
in a checkout of the repository, not in an installed package."""

import argparse
import importlib
import sys
from pathlib import Path
from typing import Any

from ..._util.checks import output_file
from .options import SWITCH, add_command, add_output


def _figures(options: argparse.Namespace) -> None:
    folder = output_file("--output", options.output / "index.html").parent
    sys.path.insert(0, str(checkout()))
    index = importlib.import_module("paper_figs.index")
    print(f"open {index.make(folder, run=options.run, only=options.only)}")


def checkout() -> Path:
    """The checkout of the repository: the one that this package is part of, else the working directory.

    **Raises:** `ValueError` if neither holds the figures."""
    for folder in (Path(__file__).parents[3], Path.cwd()):
        if (folder / "paper_figs" / "index.py").is_file():
            return folder
    raise ValueError(
        "the figures are drawn by scripts of the repository (paper_figs/, experiments/). Run this in a "
        "checkout of the repository."
    )


def add_figures(commands: Any) -> None:
    text = "make the figures and tables of the source papers, and a page of them, from recorded results"
    parser = add_command(commands, "figures", text, _figures)
    add_output(parser, "jaxvol-figures", "folder to write")
    text = "some of them, such as fig09"
    parser.add_argument("--only", nargs="+", default=(), metavar="NAME", help=text)
    text = "measure and render everything again, with the volumes of JAXVOL_DATA: takes hours"
    parser.add_argument("--run", action=SWITCH, default=False, help=text)
