"""Shared by all experiments: command-line options, timed frames with their errors, and saving of charts."""

import argparse
import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

import jaxvol as jv
from jaxvol.metrics import rmse

from . import marches, record, timing
from .scenes import Scene


matplotlib.use("Agg")
import matplotlib.pyplot as plt


FINER = 8
"""How many times finer the converged image's step is. By the midpoint rule, its error is some hundred times
smaller."""


def options(about: str | None, repetitions: int) -> argparse.ArgumentParser:
    """Parser of the options that all experiments have; scripts add their own."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=record.RESULTS, metavar="FOLDER")
    parser.add_argument("--repetitions", type=int, default=repetitions)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true", help="tiny sizes, to check that the script runs")
    return parser


def data() -> Path | None:
    """The folder of real volumes that JAXVOL_DATA names, or None."""
    folder = os.environ.get("JAXVOL_DATA")
    return Path(folder) if folder else None


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


def save(figure: Any, path: Path) -> None:
    """Write a chart. Equal results give equal files."""
    figure.savefig(path, dpi=90, metadata={"Software": None})
    plt.close(figure)
