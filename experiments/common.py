"""Shared by all experiments: their one `main`, timed frames with their errors, and saving of charts."""

import math
import os
from argparse import Namespace
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import matplotlib
import numpy as np

import jaxvol as jv
from jaxvol._util.whole_files import whole_file
from jaxvol.metrics import rmse

from . import marches, record, timing
from .command import QUICK, Main, command
from .scenes import Scene


matplotlib.use("Agg")
import matplotlib.pyplot as plt


FINER = 8
"""How many times finer the converged image's step is. By the midpoint rule, its error is some hundred times
smaller."""


Answer: TypeAlias = tuple[Any, Callable[[Path], None]]
"""Result of an experiment, and the function that draws its chart into a file."""


def experiment(
    name: str, question: str, about: str | None, **options: Any
) -> Callable[[Callable[[Namespace], Answer | None]], Main]:
    """Decorator that makes an experiment's `main` of a function from its options to its answer: it measures,
    writes the record and draws the chart. An answer of None writes nothing.

    - `name`: of the module, and of the two files.
    - `about`: the module's docstring.
    - `options`: its own, besides `--output`, `--seed` and `--quick`, as for `command`.
    """

    def made(answer: Callable[[Namespace], Answer | None]) -> Main:
        @command(about, record.RESULTS, seed=0, quick=QUICK, **options)
        def main(chosen: Namespace) -> None:
            found = answer(chosen)
            if found is None:
                return
            result, draw = found
            path, ran = chosen.output / f"{name}.json", [f"experiments.{name}", *chosen.argv]
            record.write(path, question, result, seed=chosen.seed, command=ran)
            draw(path.with_suffix(".png"))

        return main

    return made


def some_of(names: Iterable[str], metavar: str) -> dict[str, Any]:
    """An option that takes some of the names, by default all."""
    return {"nargs": "+", "choices": list(names), "default": list(names), "metavar": metavar}


def data() -> Path | None:
    """The folder of real volumes that JAXVOL_DATA names, or None."""
    folder = os.environ.get("JAXVOL_DATA")
    return Path(folder) if folder else None


def available(chosen: Namespace, phantom: str) -> tuple[Path | None, list[str]]:
    """The folder of real volumes, and the names of `--only`; without a folder, or if quick, the phantom's."""
    folder = data()
    return folder, [phantom] if folder is None or chosen.quick else chosen.only


def frame(scene: Scene, march: jv.March) -> jv.Rendering:
    """The image with all its outputs."""
    return jv.render(scene.volume, scene.transfer, scene.camera, march)


def image(scene: Scene, march: jv.March) -> jv.Rendering:
    """The image alone, as it is timed."""
    return jv.render(scene.volume, scene.transfer, scene.camera, march, outputs="rgba")


def compare(scene: Scene, under: dict[str, jv.March], repetitions: int) -> dict[str, dict[str, Any]]:
    """Time and error of a scene's frame under every march. Ratios are relative to the first march."""
    seconds = timing.interleaved({n: lambda m=m: image(scene, m) for n, m in under.items()}, repetitions)
    truth = frame(scene, marches.converged(scene.step, FINER)).rgba
    rows = {}
    for name, march in under.items():
        rendering = frame(scene, march)
        assert not np.any(rendering.exhausted)
        rows[name] = row(seconds[name], seconds[next(iter(under))], rmse(rendering.rgba, truth))
        rows[name]["samples"] = int(np.sum(np.asarray(rendering.samples), dtype=np.int64))
    return rows


def row(seconds: list[float], base: list[float], error: float) -> dict[str, Any]:
    """A program's time, its ratio to that of another program, and the error of its image."""
    return {
        "seconds": round(float(np.median(seconds)), 5),
        "ratio": timing.ratio(seconds, base),
        "rmse": error,
        "all seconds": [round(s, 5) for s in seconds],
    }


def geometric_mean(values: Iterable[float]) -> float:
    return round(math.exp(np.mean(np.log(list(values)))), 4)


def plain_numbers(panel: Any) -> None:
    """Label logarithmic axes by numbers such as 0.002 and 20, not by powers of ten; on axes of few decades
    also between these."""
    for axis, (low, high) in ((panel.xaxis, panel.get_xlim()), (panel.yaxis, panel.get_ylim())):
        if axis.get_scale() == "log" and low > 0:
            axis.set_major_formatter("{x:g}")
            leads = (2, 3, 5, 7) if high / low < 6 else (2, 5) if high / low < 30 else ()
            axis.set_minor_formatter(partial(_labelled, leads))


def _labelled(leads: tuple[int, ...], value: float, _: Any) -> str:
    """The label of a value that is one of these digits times a power of ten; of others, none."""
    lead = value / 10 ** math.floor(math.log10(value))
    return f"{value:g}" if round(lead, 6) in leads else ""


def save(figure: Any, path: Path) -> None:
    """Write a chart. Equal results give equal files."""
    with whole_file(path) as part:
        exactly: dict[str, Any] = {"pil_kwargs": {"lossless": True}}
        how = exactly if path.suffix == ".webp" else {"metadata": {"Software": None}}
        figure.savefig(part, dpi=90, **how)
    plt.close(figure)
