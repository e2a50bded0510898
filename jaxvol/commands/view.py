"""`jaxvol view`: a volume file on a page of the browser, to be turned and changed."""

import argparse
import threading
import webbrowser
from typing import Any

from ..fitting import read_transfer
from ..presets import PRESETS, preset
from ..viewer import serve
from .data import add_data_options, volume_of


def add_view(commands: Any, shared: argparse.ArgumentParser) -> None:
    """Add the subcommand. `commands`: what `add_subparsers` returned."""
    parser = commands.add_parser(
        "view",
        parents=[shared],
        help="look at a volume file in the browser",
        description="Look at a volume file in the browser: drag to orbit, with the right button to move, and "
        "turn the wheel to come nearer. Only this machine can connect. Ctrl-C ends it.",
    )
    add_data_options(parser)
    look = parser.add_mutually_exclusive_group()
    look.add_argument("--preset", metavar="NAME", help=f"transfer function: {', '.join(PRESETS)}")
    look.add_argument("--transfer", metavar="JSON", help="a transfer function written by jaxvol fit")
    parser.add_argument(
        "--clim", type=float, nargs=2, metavar=("LOW", "HIGH"), help="range of values that the preset covers"
    )
    parser.add_argument(
        "--shade", action=argparse.BooleanOptionalAction, default=True, help="with light at first (default)"
    )
    parser.add_argument("--port", type=int, default=8080, help="default: %(default)s, or the next free one")
    parser.add_argument(
        "--browser", action=argparse.BooleanOptionalAction, default=True, help="open it (default)"
    )
    parser.set_defaults(run=_view)


def _view(options: argparse.Namespace) -> None:
    if options.clim and not options.preset:
        raise ValueError("--clim goes with --preset.")
    transfer = None
    if options.preset:
        transfer = preset(options.preset, options.clim)
    elif options.transfer:
        transfer = read_transfer(options.transfer)
    volume = volume_of(options)
    page = serve(volume, transfer, lit=options.shade, port=options.port, title=options.file.name)
    print(f"{options.file}: {page.url} (Ctrl-C ends it)", flush=True)
    if options.browser:
        webbrowser.open(page.url)
    threading.Event().wait()
