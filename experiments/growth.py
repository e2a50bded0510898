"""How does the time of a frame grow with pixels, voxels and samples per ray, with leaping and without?

The head phantom, 8 bit, from 128² to 2048² pixels, 64³ to 512³ voxels, and 64 to 4096 samples across the
volume; other sizes stay at 512², 256³ and 256. All frames of a sweep run in turn, and the slope of log time
over log size is fitted to the upper three sizes, where the fixed cost of a frame no longer counts. No ray
ends early. Beside each time stands the image's RMSE against a converged one.
"""

from argparse import Namespace
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

import jaxvol as jv
from jaxvol.metrics import rmse

from . import charts, harness, timing
from .harness import experiment, some_of
from .scenes import seen_head


OFF, ON = "no leaping", "leaping"
METHODS: dict[str, tuple[jv.Transform, ...]] = {OFF: (), ON: (jv.SpaceLeaping(),)}
USUAL = {"pixels": 512, "voxels": 256, "samples": 256}
SWEEPS = {
    "pixels": (128, 256, 512, 1024, 2048),
    "voxels": (64, 128, 256, 512),
    "samples": (64, 256, 1024, 4096),
}
TINY = {"pixels": (16, 32, 64), "voxels": (16, 32, 48), "samples": (16, 32, 64)}
LABELS = {
    "pixels": "pixels along a side of the image",
    "voxels": "voxels along a side of the volume",
    "samples": "samples across the volume",
}
SIDE = 2.0  # of the phantom's cube, world length


def measure(along: str, sizes: Sequence[int], usual: dict[str, int], repetitions: int) -> dict[str, Any]:
    """Times, errors and slopes along one axis; the other sizes are as in `usual`."""
    scenes = {}
    volumes = {n: jv.phantom("head", n) for n in (sizes if along == "voxels" else [usual["voxels"]])}
    for size in sizes:
        at = usual | {along: size}
        scenes[size] = seen_head(volumes[at["voxels"]], at["pixels"])._replace(step=SIDE / at["samples"])
    drawn = {
        (size, method): partial(harness.image, scene, jv.March(scene.step, transforms))
        for size, scene in scenes.items()
        for method, transforms in METHODS.items()
    }
    seconds = timing.interleaved(drawn, repetitions)
    finest = min(min(scene.step for scene in scenes.values()) / 2, SIDE / usual["samples"] / harness.FINER)
    # It may leap: if leaps skipped anything visible, the errors with and without leaping would differ.
    converged = jv.March(finest, (jv.SpaceLeaping(), jv.AlphaCorrection()), "midpoint")
    found: dict[str, Any] = {method: {} for method in METHODS}
    for size, scene in scenes.items():
        truth = harness.frame(scene, converged).rgba
        for method in METHODS:
            error = rmse(drawn[size, method]().rgba, truth)
            found[method][str(size)] = harness.row(seconds[size, method], seconds[size, OFF], error)
    return {method: {"slope": slope(sizes, rows), "sizes": rows} for method, rows in found.items()}


def slope(sizes: Sequence[int], rows: dict[str, Any]) -> float:
    """The power of a side with which the time grows, over the three largest sizes."""
    times = [rows[str(size)]["seconds"] for size in sizes]
    return round(float(np.polyfit(np.log(sizes[-3:]), np.log(times[-3:]), 1)[0]), 3)


def draw(result: dict[str, Any]) -> Any:
    sweeps = result["sweeps"]
    figure, (axes,) = charts.panels(1, len(sweeps), 3 * len(sweeps), 3.8, sharey=True)
    for panel, (along, methods) in zip(axes, sweeps.items(), strict=True):
        for (method, found), style in zip(methods.items(), ("C7o-", "C0s-"), strict=True):
            sizes = np.array([int(size) for size in found["sizes"]], float)
            times = np.array([row["seconds"] for row in found["sizes"].values()])
            spread = np.array([np.quantile(row["all seconds"], (0, 1)) for row in found["sizes"].values()])
            label = f"{method}: time as size$^{{{found['slope']:.2f}}}$"
            panel.errorbar(sizes, times, np.abs(spread.T - times), fmt=style, capsize=2, label=label)
            upper, middle = sizes[-3:], np.exp(np.mean(np.log(times[-3:])))
            fitted = middle * (upper / np.exp(np.mean(np.log(upper)))) ** found["slope"]
            panel.plot(upper, fitted, "k:", linewidth=1)
            charts.numbered(panel, sizes, [f"{size:g}" for size in sizes])
        panel.set(yscale="log", xlabel=LABELS[along])
        panel.legend(loc="upper left")
        panel.grid(alpha=0.3)
    axes[0].set(ylabel="time of a frame, seconds", ylim=(None, 8 * axes[0].get_ylim()[1]))
    axes[0].yaxis.set_major_formatter("{x:g}")
    figure.suptitle("Medians; bars: least to most. Dotted: the power of the last three sizes")
    return figure


@experiment(repetitions=5, only=some_of(SWEEPS, "AXIS"), quick={"repetitions": 1})
def main(chosen: Namespace) -> dict[str, Any]:
    sweeps, usual = (TINY, dict.fromkeys(USUAL, 32)) if chosen.quick else (SWEEPS, USUAL)
    found = {along: measure(along, sweeps[along], usual, chosen.repetitions) for along in chosen.only}
    return {"usual": usual, "sweeps": found}
