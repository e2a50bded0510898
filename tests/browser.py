"""Opens a page in headless Chromium, points, clicks and drags, and looks at it.

Chromium is driven by its own protocol (JSON messages that end in a zero byte) over two pipes, its file
descriptors 3 and 4, so that no driver and no port is needed.
"""

import base64
import io
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from skimage.io import imread


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

    def wait_for(self, expression: str, seconds: float = 120) -> Any:
        """Wait until a JavaScript expression is true. Returns its value."""
        end = time.monotonic() + seconds
        while not (value := self.evaluate(expression)):
            assert time.monotonic() < end, f"not within {seconds} s: {expression}"
            time.sleep(0.05)
        return value

    def mouse(self, kind: str, x: float, y: float, **how: Any) -> None:
        """A mouse event: `"Moved"`, `"Pressed"`, `"Released"` or `"Wheel"`."""
        self.call("Input.dispatchMouseEvent", type=f"mouse{kind}", x=x, y=y, **how)

    def drag(self, start: tuple[float, float], by: tuple[float, float], steps: int = 10) -> None:
        """Drag with the left button, in equal steps of 20 ms."""
        (x, y), (dx, dy) = start, by
        self.mouse("Moved", x, y)
        self.mouse("Pressed", x, y, button="left", buttons=1, clickCount=1)
        for step in range(1, steps + 1):
            self.mouse("Moved", x + dx * step / steps, y + dy * step / steps, button="left", buttons=1)
            time.sleep(0.02)
        self.mouse("Released", x + dx, y + dy, button="left", clickCount=1)

    def write(self, selector: str, text: str) -> None:
        """Write text in the first element that matches, in place of what is there, and press Enter."""
        select = "e => {e.focus(); e.select ? e.select() : getSelection().selectAllChildren(e)}"
        self.evaluate(f"({select})(document.querySelector({json.dumps(selector)}))")
        self.call("Input.insertText", text=text)
        enter = {"key": "Enter", "code": "Enter", "windowsVirtualKeyCode": 13}
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent", type=kind, **enter, **({"text": "\r"} if kind == "keyDown" else {})
            )

    def screenshot(self, path: Path | None = None) -> Any:
        """The window as an array (height, width, 3) of 8 bits; written to `path` if given."""
        png = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        if path is not None:
            path.write_bytes(png)
        return imread(io.BytesIO(png))[..., :3]


@contextmanager
def opened(page: Path | str, width: int = 1400, height: int = 1000, script: str = "") -> Iterator[Page]:
    """The page, loaded: a file, without a network; or the address of a server. `script`: JavaScript that runs
    before its own."""
    assert CHROMIUM is not None
    to_browser, writing = os.pipe()
    reading, from_browser = os.pipe()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        switches = ["--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe"]
        switches += ["--enable-unsafe-swiftshader"]  # WebGL without a GPU
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
            if isinstance(page, Path):
                offline = {"offline": True, "latency": 0, "downloadThroughput": 0, "uploadThroughput": 0}
                browser.call("Network.emulateNetworkConditions", **offline)
            browser.call("Page.enable")
            browser.call("Page.addScriptToEvaluateOnNewDocument", source=script)
            url = page.resolve().as_uri() if isinstance(page, Path) else page
            browser.call("Page.navigate", url=url)
            loaded = f"{url.partition(':')[0]}:complete"
            while browser.evaluate("location.protocol + document.readyState") != loaded:
                pass
            yield browser
        finally:
            program.kill()
            program.wait()
            os.close(reading)
            os.close(writing)
