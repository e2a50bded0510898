"""`jaxvol view`: a volume file on a page of the browser, to be turned and changed."""

import argparse
import threading
import webbrowser

from ..viewer import serve
from .data import volume_of
from .options import DATA, TRANSFER, Command, Option
from .scene import is_automatic, transfer_of


def _view(options: argparse.Namespace) -> None:
    volume = volume_of(options)
    transfer = None if is_automatic(options) else transfer_of(options, volume)
    page = serve(volume, transfer, lit=options.shade, port=options.port, title=options.file.name)
    print(f"{options.file}: {page.url} (Ctrl-C ends it)", flush=True)
    if options.browser:
        webbrowser.open(page.url)
    threading.Event().wait()


VIEW = Command(
    "view",
    "look at a volume file in the browser; only this machine can connect, and Ctrl-C ends it",
    (
        *DATA,
        *TRANSFER,
        Option("shade", "with light at first", bool, default=True),
        Option("port", "of the page, or the next free one", int, default=8080),
        Option("browser", "open it", bool, default=True),
    ),
    _view,
)
