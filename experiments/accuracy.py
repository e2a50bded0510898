"""What does accuracy cost? Time against error, for steps and quadratures, compared with VTK and Dr.Jit.

Five scenes, steps of a quarter of a voxel to four, three quadratures. Ours skips empty space, cuts the last
cell at the exit, and ends rays early. Error is the RMSE over white against one converged image of ours.

A second part looks at a transfer function whose peak is 1 % as wide as the range of values: the error of both
second-order quadratures, by step.
"""

from argparse import Namespace
from functools import partial
from typing import Any

from jaxvol.metrics import rmse

from . import charts, programs
from .harness import chosen_scenes, experiment, some_of
from .programs import DRJIT, QUADRATURES, VTK, Case, Program, is_here
from .scenes import PHANTOM, SCENES, Scene, peaked


STEPS = (0.5, 1.0, 2.0, 4.0)
FINEST = 0.25
FINER = 16
OF_DRJIT = f"{DRJIT}, left", f"{DRJIT}, midpoint"
STYLES = {
    "left": "C0o-",
    "midpoint": "C2s-",
    "preintegrated": "C3D-",
    VTK: "C7^--",
    OF_DRJIT[0]: "C1v--",
    OF_DRJIT[1]: "C1v:",
}
BASE = "midpoint", 1.0

Rows = dict[str, dict[str, dict[str, Any]]]
"""By program and step, in voxels: time and error."""


def measure(scene: Scene, there: dict[str, str], repetitions: int) -> Rows:
    made: dict[Any, Any] = {BASE: programs.ours()}  # the base first
    made |= {
        (q, step): programs.ours(step=step, quadrature=q) for step in (FINEST, *STEPS) for q in QUADRATURES
    }
    for step in STEPS:
        if is_here(there, VTK):
            made[VTK, step] = partial(programs.by_vtk, step)
        if is_here(there, DRJIT):
            for name in OF_DRJIT:
                made[name, step] = partial(programs.by_drjit, name.split()[-1], step)
    ready: dict[Any, Program] = {key: make(Case(scene)) for key, make in made.items()}
    rows = programs.measured(ready, programs.converged(scene, FINER), repetitions)
    for key, each in ready.items():
        if each.samples is not None:
            rows[key]["samples"] = round(each.samples(), 2)
    found = {name: {str(s): rows[of, s] for of, s in sorted(rows) if of == name} for name in STYLES}
    return {name: by_setting for name, by_setting in found.items() if by_setting}


def draw(result: dict[str, Any]) -> Any:
    """Time against error, a panel for each scene; and errors under a narrow peak."""
    scenes = result["scenes"]
    figure, axes = charts.panels(len(scenes), 2, 8.8, 2.9 * len(scenes) + 0.6)
    for (times, errors), (name, rows) in zip(axes, scenes.items(), strict=True):
        for of, by_step in rows.items():
            error = [row["rmse"] for row in by_step.values()]
            times.plot(error, [row["seconds"] * 1e3 for row in by_step.values()], STYLES[of], label=of)
        for quadrature, by_step in result["peaks"][name].items():
            errors.plot([float(s) for s in by_step], list(by_step.values()), STYLES[quadrature])
        times.set(xscale="log", yscale="log", title=name, xlabel="RMSE of the image")
        times.set_ylabel(f"time of {result['pixels']}² pixels, ms")
        errors.set(yscale="log", title=f"{name}, narrow peak", xlabel="step, voxels")
        errors.set_ylabel("RMSE of the image")
        charts.plain_numbers(times)
        charts.plain_numbers(errors)
        charts.numbered(errors, STEPS, [f"{s:g}" for s in STEPS])
    figure.suptitle(
        "Left: each point is a length of steps, the shorter the slower; below and to the left is better.\n"
        "Right: a transfer function whose peak is 1 % of the range of values"
    )
    charts.legend_below(figure, axes[0, 0], 3)
    return figure


@experiment(
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
        scenes[name] = measure(scene, there, chosen.repetitions)
        case = Case(peaked(scene))
        truth = programs.converged(case.scene, FINER)
        peaks[name] = {
            q: {str(s): rmse(programs.ours(step=s, quadrature=q)(case).image(), truth) for s in STEPS}
            for q in QUADRATURES[1:]
        }
    return {"pixels": chosen.size, "peers": there, "scenes": scenes, "peaks": peaks}
