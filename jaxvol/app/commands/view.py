"""`jaxvol view`: a volume file on a page of the browser, to be turned and changed."""

import argparse
import threading
import webbrowser
from typing import Any

from ..viewer import serve
from .data import add_data_options, volume_of
from .options import transfer_options
from .scene import is_automatic, transfer_given, transfer_of


def add_view(commands: Any, shared: argparse.ArgumentParser) -> None:
    """Add the subcommand. `commands`: what `add_subparsers` returned."""
    parser = commands.add_parser(
        "view",
        parents=[shared, transfer_options()],
        help="look at a volume file in the browser",
        description="Look at a volume file in the browser: drag to orbit, with the right button to move, and "
        "turn the wheel to come nearer. Only this machine can connect. Ctrl-C ends it.",
    )
    add_data_options(parser)
    parser.add_argument(
        "--shade", action=argparse.BooleanOptionalAction, default=True, help="with light at first (default)"
    )
    parser.add_argument("--port", type=int, default=8080, help="default: %(default)s, or the next free one")
    parser.add_argument(
        "--browser", action=argparse.BooleanOptionalAction, default=True, help="open it (default)"
    )
    parser.set_defaults(run=_view)


def _view(options: argparse.Namespace) -> None:
    transfer = transfer_given(options)
    volume = volume_of(options)
    if transfer is None and not is_automatic(options):
        transfer = transfer_of(options, volume)
    page = serve(volume, transfer, lit=options.shade, port=options.port, title=options.file.name)
    print(f"{options.file}: {page.url} (Ctrl-C ends it)", flush=True)
    if options.browser:
        webbrowser.open(page.url)
    threading.Event().wait()
