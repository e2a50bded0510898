"""`jaxvol demo`: what the toolkit does, on one page. It runs the code that stands on the page."""

import argparse
import contextlib
import time
import warnings
from typing import Any

from ..._util.checks import integer, output_file
from ..._util.whole_files import whole_folder
from .demo_page import SECTIONS, page
from .options import add_output, add_size
from .progress import working


def add_demo(commands: Any, shared: argparse.ArgumentParser) -> None:
    """Add the subcommand. `commands`: what `add_subparsers` returned."""
    text = "Render a shaded head, wood grain before and after, and a fit by gradients, and a page of them."
    parser = commands.add_parser(
        "demo", parents=[shared], help="show what the toolkit does", description=text
    )
    add_output(parser, "jaxvol-demo", "where to write", "FOLDER")
    add_size(parser)
    parser.add_argument("--resolution", type=int, default=320, help="voxels per axis of the head")
    parser.add_argument(
        "--only", nargs="+", choices=SECTIONS, default=list(SECTIONS), help="some of the pictures"
    )
    parser.set_defaults(run=_demo)


def _demo(options: argparse.Namespace) -> None:
    output_file("--output", options.output / "index.html")
    size = tuple(integer("--size", side, 1) for side in options.size)
    chosen = {
        name: SECTIONS[name].with_numbers(integer("--resolution", options.resolution, 8), size)
        for name in options.only
    }
    took: dict[str, float] = {}
    with whole_folder(options.output) as folder:
        for name, section in chosen.items():
            begun = time.perf_counter()
            with (
                working(f"compiling and rendering {name}"),
                contextlib.chdir(folder),
                warnings.catch_warnings(),
            ):
                warnings.simplefilter("ignore")  # two images leave open what no image shows
                exec(compile(section.code, f"{name}.py", "exec"), {"__name__": name})
            took[name] = time.perf_counter() - begun
            print(f"{options.output}: {', '.join(section.pictures)} in {took[name]:.1f} s")
        (folder / "index.html").write_text(page(chosen, took), encoding="utf-8")
    print(f"open {options.output / 'index.html'}")
