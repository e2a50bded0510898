"""`jaxvol view`: a volume file on a page of the browser, to be turned and changed."""

import argparse
import threading
import webbrowser
from typing import Any

from ..viewer import serve
from .data import volume_of
from .options import SWITCH, add_command, add_transfer, add_volume
from .scene import is_automatic, transfer_of


def _view(options: argparse.Namespace) -> None:
    volume = volume_of(options)
    transfer = None if is_automatic(options) else transfer_of(options, volume)
    page = serve(volume, transfer, lit=options.shade, port=options.port, title=options.file.name)
    print(f"{options.file}: {page.url} (Ctrl-C ends it)", flush=True)
    if options.browser:
        webbrowser.open(page.url)
    threading.Event().wait()


def add_view(commands: Any) -> None:
    text = "look at a volume file in the browser; only this machine can connect, and Ctrl-C ends it"
    parser = add_command(commands, "view", text, _view)
    add_volume(parser)
    add_transfer(parser)
    parser.add_argument("--shade", action=SWITCH, default=True, help="with light at first")
    parser.add_argument(
        "--port", type=int, default=8080, help="of the page (default: 8080, or the next free)"
    )
    parser.add_argument("--browser", action=SWITCH, default=True, help="open it")
