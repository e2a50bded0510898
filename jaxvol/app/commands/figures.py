"""`jaxvol figures`: the figures of the papers. Their scripts, and the records from which they are drawn, are
in a checkout of the repository, not in an installed package."""

import argparse
import importlib
import sys
from pathlib import Path

from ..._util.checks import output_file
from ..._util.whole_files import whole_folder
from .options import SHARED, Command, Option, output


NEEDED = "paper_figs/index.py", "experiments/record.py"


def _figures(options: argparse.Namespace) -> None:
    if options.quick and not options.run:
        raise ValueError("--quick goes with --run.")
    folder = output_file("--output", options.output / "index.html").parent
    sys.path.insert(0, str(checkout()))
    index = importlib.import_module("paper_figs.index")
    if options.run:  # takes hours: each result stays as soon as there is one
        index.make(folder, run=True, only=options.only, quick=options.quick)
    else:
        with whole_folder(folder) as part:
            index.make(part, only=options.only)
    print(f"open {folder / 'index.html'}")


def checkout() -> Path:
    """The checkout of the repository: the one that this package is part of, else the working directory.

    **Raises:** `ValueError` if neither holds the figures.
    """
    for folder in (Path(__file__).parents[3], Path.cwd()):
        if all((folder / name).is_file() for name in NEEDED):
            return folder
    raise ValueError(
        f"the figures are drawn by scripts of the repository (paper_figs/, experiments/), which neither the "
        f"installed package nor the working directory {Path.cwd()} holds. Run this in a checkout of the "
        "repository."
    )


_RUN = "measure and render everything again, into FOLDER, with the volumes of JAXVOL_DATA: takes hours"

FIGURES = Command(
    "figures",
    "make the figures and tables of the source papers, and a page of them, from recorded results",
    (
        *SHARED,
        output("jaxvol-figures", "where to write", "FOLDER"),
        Option("only", "some of them, such as fig09", values="NAME...", default=()),
        Option("run", _RUN, bool, default=False),
        Option("quick", "with --run: tiny sizes, as a trial", bool, default=False),
    ),
    _figures,
)
