"""How much longer does one program take than another? Both run in turn, and each pair of runs gives a ratio.

The speed of a machine drifts, but consecutive runs see the same one: their ratio is stable where their times
are not, and the median of the ratios ignores runs that something else disturbed.
"""

import time
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

import jax
import numpy as np


Name = TypeVar("Name", bound=Hashable)


def interleaved(
    programs: dict[Name, Callable[[], Any]],
    repetitions: int,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[Name, list[float]]:
    """Seconds of every run of every program, warm: one run of each to compile it, then rounds of one run
    each, in an order that is reversed from one round to the next. By `time.process_time`, CPU seconds, which
    other programs on the machine disturb less."""
    for program in programs.values():
        jax.block_until_ready(program())
    seconds: dict[Name, list[float]] = {name: [] for name in programs}
    for repetition in range(repetitions):
        for name in list(programs)[:: 1 if repetition % 2 == 0 else -1]:
            start = clock()
            jax.block_until_ready(programs[name]())
            seconds[name].append(clock() - start)
    return seconds


def first(program: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of a program's first run, without those in which JAX traces and compiles, and what it returns.
    It is for what takes too long to be run twice."""
    spans: list[tuple[float, float]] = []

    def note(event: str, duration_secs: float, **_: Any) -> None:
        if event.startswith("/jax/core/compile/"):
            spans.append((time.perf_counter() - duration_secs, time.perf_counter()))

    jax.monitoring.register_event_duration_secs_listener(note)
    start = time.perf_counter()
    found = jax.block_until_ready(program())
    taken, until = time.perf_counter() - start, start
    jax.monitoring.unregister_event_duration_listener(note)
    for begin, end in sorted(spans):  # one may lie within another
        taken -= max(end - max(begin, until), 0)
        until = max(until, end)
    return taken, found


def ratio(seconds: list[float], base: list[float], seed: int = 0) -> dict[str, float]:
    """Median of the paired ratios, and its 95 % interval by bootstrap."""
    ratios = np.array(seconds) / np.array(base)
    drawn = np.random.default_rng(seed).choice(ratios, (2000, len(ratios)))
    low, high = np.quantile(np.median(drawn, axis=1), (0.025, 0.975))
    found = {"median": np.median(ratios), "low": low, "high": high}
    return {k: round(float(v), 4) for k, v in found.items()}


def median(seconds: list[float]) -> float:
    """Of one program's runs."""
    return round(float(np.median(seconds)), 5)
