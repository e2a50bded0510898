"""Where are the figures of the papers? The command `jaxvol figures` makes them; their scripts and the records
from which they are drawn are in a checkout of the repository, not in an installed package."""

import argparse
import importlib
import sys
from pathlib import Path
from typing import Any

from .._util.checks import output_file
from .._util.whole_files import whole_folder


NEEDED = "paper_figs/index.py", "experiments/record.py"


def add_figures(commands: "argparse._SubParsersAction[Any]", shared: argparse.ArgumentParser) -> None:
    """Add the command `figures` to the command line."""
    text = "Make every figure and table of the source papers, and a page of them, from recorded results."
    command = commands.add_parser(
        "figures", parents=[shared], help="make the figures and tables of the papers", description=text
    )
    command.add_argument("-o", "--output", type=Path, default=Path("jaxvol-figures"), metavar="FOLDER")
    command.add_argument("--only", nargs="+", default=(), metavar="NAME", help="some of them, such as fig09")
    command.add_argument(
        "--run",
        action="store_true",
        dest="anew",
        help="measure and render everything anew, into FOLDER, with the volumes of JAXVOL_DATA: takes hours",
    )
    command.add_argument("--quick", action="store_true", help="with --run: tiny sizes, as a trial")
    command.set_defaults(run=_figures)


def _figures(options: argparse.Namespace) -> None:
    if options.quick and not options.anew:
        raise ValueError("--quick goes with --run.")
    folder = output_file("--output", options.output / "index.html").parent
    sys.path.insert(0, str(checkout()))
    index = importlib.import_module("paper_figs.index")
    if options.anew:  # takes hours: each result stays as soon as there is one
        index.make(folder, run=True, only=options.only, quick=options.quick)
    else:
        with whole_folder(folder) as part:
            index.make(part, only=options.only)
    print(f"open {folder / 'index.html'}")


def checkout() -> Path:
    """The checkout of the repository: the one that this package is part of, else the working directory.

    **Raises:** `ValueError` if neither holds the figures.
    """
    for folder in (Path(__file__).parents[2], Path.cwd()):
        if all((folder / name).is_file() for name in NEEDED):
            return folder
    raise ValueError(
        f"the figures are drawn by scripts of the repository (paper_figs/, experiments/), which neither the "
        f"installed package nor the working directory {Path.cwd()} holds. Run this in a checkout of the "
        "repository."
    )
