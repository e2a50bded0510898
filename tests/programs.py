"""How many programs does a session compile, which tests need them, and how long does that take?

The number does not depend on how fast the machine is, so that it can be a budget: `pytest --most-programs N`
fails above it. Counted are the new entries of the compilation cache that all processes of a session share,
those of kernels and subprocesses among them.
"""

from collections import Counter, defaultdict
from pathlib import Path

import jax
import pytest


SHOWN = 12
"""Files that are listed, of those that compile the most."""


class Programs:
    """A plugin for pytest. Each worker of pytest-xdist counts, and tells the first process."""

    def __init__(self, folder: Path, most: int | None):
        self.folder, self.most = folder, most
        self.before = self.in_folder()
        self.compiled, self.seconds, self.file = Counter[str](), defaultdict[str, float](float), "collection"
        jax.monitoring.register_event_listener(self.on_event)
        jax.monitoring.register_event_duration_secs_listener(self.on_duration)

    def in_folder(self) -> int:
        return sum(1 for entry in self.folder.glob("*-cache"))

    def on_event(self, event: str, **_) -> None:
        if event == "/jax/compilation_cache/cache_misses":
            self.compiled[self.file] += 1

    def on_duration(self, event: str, duration_secs: float, **_) -> None:
        # also the time to find a program in the cache folder
        if event == "/jax/core/compile/backend_compile_duration":
            self.seconds[self.file] += duration_secs

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        self.file = item.nodeid.partition("::")[0]
        return (yield)

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session):
        if hasattr(session.config, "workeroutput"):
            session.config.workeroutput["programs"] = dict(self.compiled), dict(self.seconds)
        elif self.most is not None and self.total > self.most and session.exitstatus == 0:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node):
        compiled, seconds = getattr(node, "workeroutput", {}).get("programs", ({}, {}))
        self.compiled.update(compiled)
        for file, each in seconds.items():
            self.seconds[file] += each

    @property
    def total(self) -> int:
        return self.in_folder() - self.before

    def pytest_terminal_summary(self, terminalreporter):
        write = terminalreporter.write_line
        terminalreporter.section(f"{self.total} programs compiled in {sum(self.seconds.values()):.0f} s")
        for file, count in self.compiled.most_common(SHOWN):
            write(f"{count:5} {self.seconds[file]:6.0f} s  {file}")
        rest = self.compiled.most_common()[SHOWN:]
        if rest:
            write(f"{sum(n for _, n in rest):5}           in {len(rest)} other files")
        others = self.total - sum(self.compiled.values())  # less those that two workers compiled at once
        if others > 0:
            write(f"{others:5}           in kernels and subprocesses")
        if self.most is not None and self.total > self.most:
            write(
                f"More than --most-programs={self.most}: CONTRIBUTING.md says how tests share programs.",
                red=True,
            )
