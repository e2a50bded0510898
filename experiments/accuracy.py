"""What does accuracy cost? Time against error, for steps and quadratures, compared with VTK and Dr.Jit.

Five scenes, steps of a quarter of a voxel to four, three quadratures, and adaptive sampling at five
tolerances. Ours skips empty space, cuts the last cell at the exit, and ends rays early. Error is the RMSE
over white against one converged image of ours; VTK's image is compared with that image as its display would
show it. Adaptive sampling, and peers, are compared with ours at their own error, which lies between those of
two settings: samples and time are interpolated between them, as powers of the error.

A second part looks at a transfer function whose peak is 1 % as wide as the range of values: the error of both
second-order quadratures, by step.
"""

from argparse import Namespace
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from jaxvol.metrics import rmse

from . import charts, programs
from .harness import chosen_scenes, experiment, geometric_mean, show, some_of
from .programs import DRJIT, FINEST_OF, LEFT, QUADRATURES, THREADS, VTK, Case, Program, is_here
from .scenes import PHANTOM, SCENES, Scene, peaked


STEPS = (0.5, 1.0, 2.0, 4.0)
FINEST = 0.25
ADAPTIVE = "adaptive"
FINER = 16
ERRORS = (1e-2, 5e-3, 2e-3)
"""At which Dr.Jit is compared."""
STYLES = {
    ADAPTIVE: "C4*-",
    "left": "C0o-",
    "midpoint": "C2s-",
    "preintegrated": "C3D-",
    VTK: "C7^--",
    f"{DRJIT}, left": "C1v--",
    f"{DRJIT}, midpoint": "C1v:",
}
BASE = "midpoint", 1.0

Rows = dict[str, dict[str, dict[str, Any]]]
"""By program and step, in voxels, or tolerance: time and error."""


def settings(there: dict[str, str]) -> dict[tuple[str, float], Any]:
    """By program, and step or tolerance: makes the program of a case. The base first."""
    found: dict[tuple[str, float], Any] = {BASE: programs.ours()}
    found |= {(ADAPTIVE, tolerance): programs.adaptive(tolerance) for tolerance in FINEST_OF}
    found |= {
        (q, step): programs.ours(step=step, quadrature=q) for step in (FINEST, *STEPS) for q in QUADRATURES
    }
    for step in STEPS:
        if is_here(there, VTK):
            found[VTK, step] = partial(programs.by_vtk, step)
        if is_here(there, DRJIT):
            for q in ("left", "midpoint"):
                found[f"{DRJIT}, {q}", step] = partial(programs.by_drjit, q, step)
    return found


def measure(scene: Scene, there: dict[str, str], repetitions: int) -> Rows:
    made: dict[Any, Program] = {key: make(Case(scene)) for key, make in settings(there).items()}
    rows = programs.measured(made, programs.converged(scene, FINER), repetitions)
    for key, each in made.items():
        if each.samples is not None:
            rows[key]["samples"] = round(each.samples(), 2)
    found = {name: {str(s): rows[of, s] for of, s in sorted(rows) if of == name} for name in STYLES}
    return {name: by_setting for name, by_setting in found.items() if by_setting}


def at_error(rows: dict[str, dict[str, Any]], error: float, what: str) -> float | None:
    """What these settings take for this error, as a power of it between two of them; None beyond all."""
    known = sorted((row["rmse"], row[what]) for row in rows.values())
    errors, taken = np.log(np.array(known)).T
    inside = errors[0] <= np.log(error) <= errors[-1]
    return float(np.exp(np.interp(np.log(error), errors, taken))) if inside else None


def least(rows: Rows, names: Sequence[str], error: float, what: str) -> Any:
    """What the best of these programs takes for this error; None where none has it between its settings."""
    taken = (at_error(rows[name], error, what) for name in names if name in rows)
    return min((t for t in taken if t is not None), default=None)


def against_uniform(rows: Rows) -> dict[str, dict[str, float | None]]:
    """By tolerance: error over tolerance; and how many times more samples and time uniform steps take for the
    same error, by the quadrature that is best at it."""
    found: dict[str, dict[str, float | None]] = {}
    for tolerance, row in rows[ADAPTIVE].items():
        found[tolerance] = {"error over tolerance": row["rmse"] / float(tolerance)}
        for what in ("samples", "seconds"):
            taken = least(rows, QUADRATURES, row["rmse"], what)
            found[tolerance][what] = None if taken is None else round(taken / row[what], 3)
    return found


def time_to_accuracy(rows: Rows) -> dict[str, dict[str, float]]:
    """By peer and error, how many times longer than ours the peer takes to an image of this error, each by
    its best setting: VTK at its own error at one voxel; Dr.Jit at three errors, where both reach them."""
    compared = [(DRJIT, f"{error:g}", error) for error in ERRORS]
    if VTK in rows:
        error = rows[VTK]["1.0"]["rmse"]
        compared.append((VTK, f"{error:.4f}", error))
    found: dict[str, dict[str, float]] = {VTK: {}, DRJIT: {}}
    for peer, name, error in compared:
        theirs = (VTK,) if peer == VTK else (f"{DRJIT}, left", f"{DRJIT}, midpoint")
        our, their = (least(rows, n, error, "seconds") for n in ((ADAPTIVE, *QUADRATURES), theirs))
        if our is not None and their is not None:
            found[peer][name] = their / our
    return found


def measure_peak(scene: Scene) -> dict[str, dict[str, float]]:
    """By quadrature and step, in voxels: the error under a narrow peak."""
    case = Case(peaked(scene))
    truth = programs.converged(case.scene, FINER)
    return {
        q: {str(s): rmse(programs.ours(step=s, quadrature=q)(case).image(), truth) for s in STEPS}
        for q in QUADRATURES[1:]
    }


def summary(scenes: dict[str, Rows], peaks: dict[str, Any]) -> dict[str, Any]:
    """What the record says in short: ratios of errors at one step, and of a peak's at four and one."""
    ratios = {
        s: rows["preintegrated"]["1.0"]["rmse"] / rows["midpoint"]["1.0"]["rmse"]
        for s, rows in scenes.items()
    }
    uniform = {s: against_uniform(rows) for s, rows in scenes.items()}
    gains = {
        what: [gain for of in uniform.values() for row in of.values() if (gain := row[what]) is not None]
        for what in ("samples", "seconds")
    }
    faster = {s: time_to_accuracy(rows) for s, rows in scenes.items()}
    peers = {peer: [r for of in faster.values() for r in of[peer].values()] for peer in (VTK, DRJIT)}
    return {
        "time of peers over ours, at the same error": faster,
        "its geometric means": {p: geometric_mean(each) for p, each in peers.items() if each},
        "uniform steps over adaptive sampling, at its error": uniform,
        "geometric means": {what: geometric_mean(each) for what, each in gains.items() if each},
        "preintegrated over midpoint, one voxel": ratios,
        "mean": float(np.mean(list(ratios.values()))),
        "peak: preintegrated at 4 over midpoint at 1": {
            s: rows["preintegrated"]["4.0"] / rows["midpoint"]["1.0"] for s, rows in peaks.items()
        },
        "time, preintegrated over midpoint, one voxel": {
            s: rows["preintegrated"]["1.0"]["ratio"]["median"] for s, rows in scenes.items()
        },
    }


def draw(result: dict[str, Any], path: Path) -> None:
    """Time against error, a panel for each scene; and errors under a narrow peak."""
    scenes = result["scenes"]
    figure, axes = charts.panels(2, len(scenes), 3.4 * len(scenes), 6.4)
    for (times, errors), (name, rows) in zip(axes.T, scenes.items(), strict=True):
        for of, by_step in rows.items():
            error = [row["rmse"] for row in by_step.values()]
            taken = [row["seconds"] * 1e3 for row in by_step.values()]
            times.plot(error, taken, STYLES[of], label=of, markersize=4)
        for quadrature, by_step in result["peaks"][name].items():
            errors.plot([float(s) for s in by_step], list(by_step.values()), STYLES[quadrature], markersize=4)
        for panel in (times, errors):
            panel.set(xscale="log", yscale="log")
            panel.tick_params(labelsize=8, which="both")
        times.set_title(name, fontsize=9)
        times.set_xlabel("RMSE of the image", fontsize=8)
        errors.set_xscale("log", base=2)
        errors.set_xticks(STEPS, [f"{s:g}" for s in STEPS])
        errors.set_xlabel("step, voxels", fontsize=8)
        errors.set_title(f"{name}, narrow peak", fontsize=9)
        charts.plain_numbers(times)
        charts.plain_numbers(errors)
    figure.suptitle(
        "Above: each point is a length of steps, the shorter the slower; below and to the left is better. "
        "Below: a transfer function whose peak is 1 % of the range of values",
        fontsize=9,
    )
    axes[0, 0].set_ylabel(f"time of a frame of {result['pixels']}² pixels, ms", fontsize=8)
    axes[1, 0].set_ylabel("RMSE of the image", fontsize=8)
    charts.legend_below(figure, axes[0, 0], min(6, 2 * len(scenes)))
    charts.save(figure, path)


@experiment(
    draw,
    repetitions=9,
    size=512,
    resolution=256,
    only=some_of(SCENES, "VOLUME"),
    quick={"size": 32, "repetitions": 2, "resolution": 32},
)
def main(chosen: Namespace) -> dict[str, Any]:
    there = programs.peers()
    scenes: dict[str, Rows] = {}
    peaks: dict[str, Any] = {}
    for name, scene in chosen_scenes(chosen, SCENES, PHANTOM, chosen.size):
        scenes[name], peaks[name] = measure(scene, there, chosen.repetitions), measure_peak(scene)
        show(scenes[name], name)
        show(peaks[name], name, "narrow peak")
    return {
        "pixels": chosen.size,
        "steps": (FINEST, *STEPS),
        "opacity left": LEFT,
        "threads": THREADS,
        "peers": there,
        "summary": summary(scenes, peaks),
        "scenes": scenes,
        "peaks": peaks,
    }
