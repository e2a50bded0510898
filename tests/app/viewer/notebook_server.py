"""Runs a notebook in a JupyterLab of its own, in headless Chromium."""

import json
import os
import secrets
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.request import urlopen

from ...browser import Page, opened


LAB = "window.jupyterapp"


@contextmanager
def notebook(cells: list[str], folder: Path, width: int = 1300, height: int = 1000) -> Iterator[Page]:
    """The page of a notebook of these cells, which are being run."""
    path = folder / "viewer.ipynb"
    path.write_text(json.dumps(_notebook(cells)), encoding="utf-8")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    token = secrets.token_hex(16)
    settings = {f"JUPYTER_{kind}_DIR": str(folder / kind) for kind in ("CONFIG", "RUNTIME")}
    options = {
        "ServerApp.ip": "127.0.0.1",
        "ServerApp.port": port,
        "ServerApp.root_dir": folder,
        "IdentityProvider.token": token,
        "LabApp.expose_app_in_browser": True,
        "LabApp.news_url": None,
    }
    server = subprocess.Popen(
        [sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root"]
        + [f"--{name}={value}" for name, value in options.items()],
        env=os.environ | settings,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        address = f"http://127.0.0.1:{port}"
        _wait_until_served(f"{address}/api?token={token}")
        with opened(f"{address}/doc/tree/{path.name}?token={token}&reset", width, height) as page:
            page.wait_for(f"{LAB} && document.querySelector('.jp-Cell .cm-content') && true")
            page.point_at(".jp-Cell .cm-content", click=True)  # or no notebook is the current one
            page.wait_for(
                f"{LAB}.shell.currentWidget?.context?.sessionContext?.session?.kernel?.connectionStatus"
                " == 'connected'"
            )
            page.call("Runtime.evaluate", expression=f"{LAB}.commands.execute('notebook:run-all-cells')")
            yield page
    finally:
        server.terminate()  # and its kernel with it
        server.wait(60)


def _notebook(cells: list[str]) -> dict[str, object]:
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    made = [
        {
            "cell_type": "code",
            "execution_count": None,
            "id": f"cell{number}",
            "metadata": {},
            "outputs": [],
            "source": source,
        }
        for number, source in enumerate(cells)
    ]
    return {"cells": made, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}


def _wait_until_served(url: str) -> None:
    end = time.monotonic() + 180
    while True:
        try:
            urlopen(url).close()
            return
        except OSError:
            assert time.monotonic() < end, "JupyterLab does not start"
            time.sleep(0.2)
