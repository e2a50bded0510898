"""Opens a page in headless Chromium, and points and clicks at it.

Chromium is driven by its own protocol (JSON messages that end in a zero byte) over two pipes, its file
descriptors 3 and 4, so that no driver and no port is needed.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


NAMES = "chromium", "chromium-browser", "google-chrome"
CHROMIUM = next((found for name in NAMES if (found := shutil.which(name))), None)
"""The program, or None where it is not installed."""

START = """
import fcntl, os, sys
reading, writing = (fcntl.fcntl(int(fd), fcntl.F_DUPFD, 10) for fd in sys.argv[1:3])
os.dup2(reading, 3)
os.dup2(writing, 4)
os.execv(sys.argv[3], sys.argv[3:])
"""


class Page:
    """A page that is open."""

    def __init__(self, reading: int, writing: int):
        self.reading, self.writing, self.rest, self.number = reading, writing, b"", 0
        self.session: str | None = None
        self.faults: list[str] = []

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol, and wait for its answer. Errors of the page go into `faults`."""
        self.number += 1
        message: dict[str, Any] = {"id": self.number, "method": method, "params": parameters}
        if self.session is not None:
            message["sessionId"] = self.session
        os.write(self.writing, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("method") == "Runtime.exceptionThrown":
                self.faults.append(json.dumps(answer["params"]))
            if answer.get("id") == self.number:
                assert "error" not in answer, answer
                return answer["result"]

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self.rest:
            got = os.read(self.reading, 1 << 16)
            assert got, "Chromium has ended"
            self.rest += got
        message, self.rest = self.rest.split(b"\0", 1)
        return json.loads(message)

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression, awaited if it is a promise."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def point_at(self, selector: str, *, click: bool = False) -> None:
        """Move the mouse to the middle of the first element that matches, and click if asked to."""
        self.evaluate(f"document.querySelector({json.dumps(selector)}).scrollIntoView({{block: 'center'}})")
        box = f"(r => [r.x + r.width / 2, r.y + r.height / 2])(document.querySelector({json.dumps(selector)})"
        x, y = self.evaluate(f"{box}.getBoundingClientRect())")
        kinds = ["mouseMoved", *(["mousePressed", "mouseReleased"] if click else [])]
        for kind in kinds:
            how = {} if kind == "mouseMoved" else {"button": "left", "clickCount": 1}
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **how)


@contextmanager
def opened(page: Path, width: int = 1400, height: int = 1000) -> Iterator[Page]:
    """The page, loaded, without a network."""
    assert CHROMIUM is not None
    to_browser, writing = os.pipe()
    reading, from_browser = os.pipe()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        switches = ["--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe"]
        switches += [f"--user-data-dir={profile}", f"--window-size={width},{height}"]
        ends = to_browser, from_browser
        program = subprocess.Popen(
            [sys.executable, "-c", START, *map(str, ends), CHROMIUM, *switches, "about:blank"],
            pass_fds=ends,
            stderr=subprocess.DEVNULL,
        )
        for fd in ends:
            os.close(fd)
        try:
            browser = Page(reading, writing)
            targets = browser.call("Target.getTargets")["targetInfos"]
            target = next(t["targetId"] for t in targets if t["type"] == "page")
            attached = browser.call("Target.attachToTarget", targetId=target, flatten=True)
            browser.session = attached["sessionId"]
            browser.call("Runtime.enable")
            browser.call("Network.enable")
            offline = {"offline": True, "latency": 0, "downloadThroughput": 0, "uploadThroughput": 0}
            browser.call("Network.emulateNetworkConditions", **offline)
            browser.call("Page.navigate", url=page.resolve().as_uri())
            while browser.evaluate("location.protocol + document.readyState") != "file:complete":
                pass
            yield browser
        finally:
            program.kill()
            program.wait()
            os.close(reading)
            os.close(writing)
