"""What does accuracy cost? Time against error, for steps and quadratures, compared with VTK and Dr.Jit.

Five scenes, steps of a quarter of a voxel to four, and three quadratures: at the front of a cell ("left"),
in its middle ("midpoint"), and integrated between the values at its ends ("preintegrated"). Adaptive
sampling, at tolerances of 0.1 to 0.001: cells of a quarter of a voxel to four (at 0.001, of an eighth on),
sampled in their middle. Ours skips empty space, cuts the last cell at the exit, and ends rays early. The
peers are those of `speed`, at steps of half a voxel to four; Dr.Jit takes samples at the front of cells, or
in the middle. Error is the RMSE over white against one converged image of ours, by the midpoint rule; VTK's
image is compared with that image as VTK's display would show it.

Programs are run in turn. Times are those of one machine; ratios are what counts. Adaptive sampling is
compared with uniform steps at its own error, which lies between those of two steps: number of samples and
time are interpolated between them, as powers of the error.

A second part looks at a transfer function whose peak is 1 % as wide as the range of values, which lies at the
middle of what each scene shows: the error of both second-order quadratures, by step.
"""

from argparse import Namespace
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

import jaxvol as jv
from jaxvol.metrics import rmse

from . import common, peer_vtk, timing
from .common import plt
from .scenes import PHANTOM, SCENES, Scene
from .speed import THREADS, peer_drjit, peers


QUADRATURES = ("left", "midpoint", "preintegrated")
STEPS = (0.5, 1.0, 2.0, 4.0)
LEFT = 1e-4
"""Rays end where so little is left: 1/255, as in `speed`, would be the error of the most accurate images."""
FINEST, LONGEST = 0.25, 4
FINEST_OF = {1e-1: 4, 3e-2: 4, 1e-2: 4, 3e-3: 4, 1e-3: 8}
"""By tolerance, into how many parts of a voxel the shortest cells divide it; `LONGEST` counts voxels."""
ADAPTIVE = "adaptive"
FINER = 16
ERRORS = (1e-2, 5e-3, 2e-3)
"""At which Dr.Jit is compared."""
VTK, DRJIT = "VTK", "Dr.Jit"
STYLES = {
    ADAPTIVE: "C4*-",
    "left": "C0o-",
    "midpoint": "C2s-",
    "preintegrated": "C3D-",
    VTK: "C7^--",
    DRJIT: "C1v--",
}


def march(scene: Scene, quadrature: str, step: float) -> jv.March:
    transforms = jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination(LEFT)
    return jv.March(step * scene.step, transforms, quadrature)


def adaptive(scene: Scene, tolerance: float) -> jv.March:
    plain = march(scene, "midpoint", 1)
    sampling = jv.AdaptiveSampling(tolerance, LONGEST * FINEST_OF[tolerance])
    return jv.March(plain.step / FINEST_OF[tolerance], (*plain.transforms, sampling), plain.quadrature)


def samples(scene: Scene, under: jv.March) -> float:
    """Mean number of samples of a ray."""
    return float(np.mean(jv.render(*scene[:3], under, outputs="all").samples))


def converged(scene: Scene) -> np.ndarray:
    """Over white; rays do not end early."""
    fine = jv.March(scene.step / FINER, (jv.AlphaCorrection(), jv.SpaceLeaping()), "midpoint")
    return np.asarray(common.image(scene, fine).image())


def drjit(scene: Scene, quadrature: Literal["left", "midpoint"], step: float) -> Any:
    assert peer_drjit is not None
    scene = scene._replace(step=float(step * scene.step))
    return peer_drjit.prepare(*scene, quadrature=quadrature, opacity_left=LEFT, threads=THREADS)


def measure(scene: Scene, there: dict[str, str], repetitions: int) -> dict[str, dict[str, dict[str, Any]]]:
    """By program and step, in voxels: time and error."""
    truth, programs, errors = converged(scene), {}, {}
    marches = {(ADAPTIVE, tolerance): adaptive(scene, tolerance) for tolerance in FINEST_OF}
    marches |= {(q, step): march(scene, q, step) for step in (FINEST, *STEPS) for q in QUADRATURES}
    for key, under in marches.items():
        programs[key] = lambda m=under: common.image(scene, m)
        errors[key] = rmse(common.image(scene, under).image(), truth)
    for step in STEPS:
        if there[VTK][0].isdigit():
            size = step * scene.step
            drawn = peer_vtk.prepare(scene.volume, scene.transfer, scene.camera, size, THREADS)
            programs[VTK, step] = drawn.draw
            errors[VTK, step] = rmse(drawn.image(), peer_vtk.as_displayed(truth, drawn.mapper))
        if peer_drjit:
            for quadrature in ("left", "midpoint"):
                marcher = drjit(scene, quadrature, step)
                programs[f"{DRJIT}, {quadrature}", step] = marcher.draw
                rgba = marcher.rgba()
                errors[f"{DRJIT}, {quadrature}", step] = rmse(rgba[..., :3] + 1 - rgba[..., 3:], truth)
    seconds = timing.interleaved({f"{n} {step}": p for (n, step), p in programs.items()}, repetitions)
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for (name, step), error in errors.items():
        times = seconds[f"{name} {step}"]
        row = found.setdefault(name, {})[str(step)] = common.row(times, seconds["midpoint 1.0"], error)
        if (name, step) in marches:
            row["samples"] = round(samples(scene, marches[name, step]), 2)
    return found


def at_error(rows: dict[str, dict[str, Any]], error: float, what: str) -> float | None:
    """What uniform steps take for this error, as a power of it between two steps; None beyond all."""
    known = sorted((row["rmse"], row[what]) for row in rows.values())
    errors, taken = np.log(np.array(known)).T
    inside = errors[0] <= np.log(error) <= errors[-1]
    return float(np.exp(np.interp(np.log(error), errors, taken))) if inside else None


def against_uniform(rows: dict[str, dict[str, dict[str, Any]]]) -> dict[str, dict[str, float | None]]:
    """By tolerance: error over tolerance; and how many times more samples and time uniform steps take for the
    same error, by the quadrature that is best at it."""
    found: dict[str, dict[str, float | None]] = {}
    for tolerance, row in rows[ADAPTIVE].items():
        found[tolerance] = {"error over tolerance": row["rmse"] / float(tolerance)}
        for what in ("samples", "seconds"):
            taken = least(rows, QUADRATURES, row["rmse"], what)
            found[tolerance][what] = None if taken is None else round(taken / row[what], 3)
    return found


def least(
    rows: dict[str, dict[str, dict[str, Any]]], programs: Sequence[str], error: float, what: str
) -> Any:
    """What the best of these programs takes for this error; None where none has it between its settings."""
    taken = (at_error(rows[name], error, what) for name in programs if name in rows)
    return min((t for t in taken if t is not None), default=None)


def time_to_accuracy(rows: dict[str, dict[str, dict[str, Any]]]) -> dict[str, dict[str, float]]:
    """By peer and error, how many times longer than ours the peer takes to an image of this error, each by
    its best setting: VTK at its own error at one voxel; Dr.Jit at three errors, where both reach them."""
    ours, theirs = (ADAPTIVE, *QUADRATURES), (f"{DRJIT}, left", f"{DRJIT}, midpoint")
    found: dict[str, dict[str, float]] = {VTK: {}, DRJIT: {}}
    if VTK in rows:
        drawn = rows[VTK]["1.0"]
        found[VTK][f"{drawn['rmse']:.4f}"] = drawn["seconds"] / least(rows, ours, drawn["rmse"], "seconds")
    for error in ERRORS:
        our, their = (least(rows, programs, error, "seconds") for programs in (ours, theirs))
        if our is not None and their is not None:
            found[DRJIT][f"{error:g}"] = their / our
    return found


def peaked(scene: Scene) -> Scene:
    """The scene under a peak 1 % as wide as the range of its voxels, where it becomes opaque."""
    extinction, values = np.asarray(scene.transfer.extinction), np.asarray(scene.transfer.values)
    data = np.asarray(scene.volume.data)
    spread = float(data.max()) - float(data.min())
    first = int(np.argmax(extinction >= extinction.max() / 2))
    middle, half = float(values[first]), 0.005 * spread
    colors = np.full((5, 3), (0.9, 0.6, 0.3))
    points = [middle - 2 * half, middle - half, middle, middle + half, middle + 2 * half]
    # a layer of one voxel at the peak lets through 2 %
    dense = [0, 0, 4 / scene.step, 0, 0]
    return scene._replace(transfer=jv.TransferFunction(points, colors, dense))


def measure_peak(scene: Scene) -> dict[str, dict[str, float]]:
    """By quadrature and step, in voxels: the error under a narrow peak."""
    scene = peaked(scene)
    truth = converged(scene)
    return {
        quadrature: {
            str(step): rmse(common.image(scene, march(scene, quadrature, step)).image(), truth)
            for step in STEPS
        }
        for quadrature in QUADRATURES[1:]
    }


def summary(scenes: dict[str, Any], peaks: dict[str, Any]) -> dict[str, Any]:
    """What the record says in short: ratios of errors at one step, and of a peak's at four and one."""
    at = {s: {n: rows[n]["1.0"]["rmse"] for n in QUADRATURES} for s, rows in scenes.items()}
    ratios = {s: e["preintegrated"] / e["midpoint"] for s, e in at.items()}
    uniform = {s: against_uniform(rows) for s, rows in scenes.items()}
    gains = {
        what: [gain for of in uniform.values() for row in of.values() if (gain := row[what]) is not None]
        for what in ("samples", "seconds")
    }
    faster = {s: time_to_accuracy(rows) for s, rows in scenes.items()}
    peers = {peer: [r for of in faster.values() for r in of[peer].values()] for peer in (VTK, DRJIT)}
    return {
        "time of peers over ours, at the same error": faster,
        "its geometric means": {p: common.geometric_mean(each) for p, each in peers.items() if each},
        "uniform steps over adaptive sampling, at its error": uniform,
        "geometric means": {what: common.geometric_mean(each) for what, each in gains.items() if each},
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
    figure, axes = plt.subplots(
        2, len(scenes), figsize=(3.4 * len(scenes), 6.4), squeeze=False, layout="constrained"
    )
    for (times, errors), (name, rows) in zip(axes.T, scenes.items(), strict=True):
        for program, by_step in rows.items():
            style = STYLES[program.split(",")[0]]
            style = style.replace("--", ":") if program.endswith("midpoint") and "," in program else style
            times.plot(
                [row["rmse"] for row in by_step.values()],
                [row["seconds"] * 1e3 for row in by_step.values()],
                style,
                label=program,
                markersize=4,
            )
        for quadrature, by_step in result["peaks"][name].items():
            errors.plot([float(s) for s in by_step], list(by_step.values()), STYLES[quadrature], markersize=4)
        for panel in (times, errors):
            panel.set_xscale("log")
            panel.set_yscale("log")
            panel.tick_params(labelsize=8, which="both")
        times.set_title(name, fontsize=9)
        times.set_xlabel("RMSE of the image", fontsize=8)
        errors.set_xscale("log", base=2)
        errors.set_xticks(STEPS, [f"{s:g}" for s in STEPS])
        errors.set_xlabel("step, voxels", fontsize=8)
        errors.set_title(f"{name}, narrow peak", fontsize=9)
        common.plain_numbers(times)
        common.plain_numbers(errors)
    figure.suptitle(
        "Above: each point is a length of steps, the shorter the slower; below and to the left is better. "
        "Below: a transfer function whose peak is 1 % of the range of values",
        fontsize=9,
    )
    axes[0, 0].set_ylabel(f"time of a frame of {result['pixels']}² pixels, ms", fontsize=8)
    axes[1, 0].set_ylabel("RMSE of the image", fontsize=8)
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=min(6, 2 * len(scenes)),
        fontsize=8,
    )
    common.save(figure, path)


@common.experiment(
    "accuracy",
    "What does accuracy cost, by step and quadrature, beside VTK and Dr.Jit?",
    __doc__,
    repetitions=9,
    size=512,
    only=common.some_of(SCENES, "VOLUME"),
)
def main(chosen: Namespace) -> common.Answer:
    folder, names = common.available(chosen, PHANTOM)
    more: dict[str, Any] = {"resolution": 256}
    if chosen.quick:
        chosen.size, chosen.repetitions, more = 32, 2, {"resolution": 32}

    there = peers()
    print(there, flush=True)
    scenes: dict[str, Any] = {}
    peaks: dict[str, Any] = {}
    make: Callable[..., Scene]
    for name in names:
        make = SCENES[name]
        scene = make(folder, chosen.size, **(more if name == PHANTOM else {}))
        scenes[name], peaks[name] = measure(scene, there, chosen.repetitions), measure_peak(scene)
        for program, by_step in scenes[name].items():
            line = "  ".join(
                f"{step}: {row['rmse']:.5f} {row['seconds'] * 1e3:6.1f} ms" for step, row in by_step.items()
            )
            print(f"{name:16} {program:18} {line}", flush=True)
        print(f"{name:16} narrow peak {peaks[name]}", flush=True)
    result = {
        "pixels": chosen.size,
        "steps": (FINEST, *STEPS),
        "opacity left": LEFT,
        "threads": THREADS,
        "peers": there,
        "summary": summary(scenes, peaks),
        "scenes": scenes,
        "peaks": peaks,
    }
    print(result["summary"])
    return result, partial(draw, result)


if __name__ == "__main__":
    main()
