"""What does accuracy cost, for every setting of every method? Time against error, with the Pareto fronts.

Each scene of `pareto_scenes` is rendered under each setting of `pareto_points`: steps and quadratures,
adaptive sampling, jitter, alignment, leaping, termination, tables, types of voxels, and the light of lit
scenes, beside VTK and Dr.Jit. Settings are timed in turn with the scene's base; a point's time is its median
ratio to the base, times the base's median time over the whole scene. Errors are those of linear RGB over
white against a converged image, whose own error is estimated (`pareto_measure`).

`--scene` measures some scenes again and keeps what the record says of the others, with the commit that they
are of. `--point` renders one point of one scene again, times it and saves its picture beside its error. The
record is `pareto.json`, the chart `pareto.png`, the page `pareto.html` (see `pareto_page`), the pictures
that it shows are in the folder `pareto/`.

Where VTK shades, it lights nodes and interpolates what that gives, along the camera's axis: a part of its
distance to our image, up to 3 / 255, is that and not an error.

Peers that are not installed are left out, and the record says why. Scenes whose volume is not in the folder
JAXVOL_DATA are left out, too.
"""

import shlex
from argparse import Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

import jaxvol as jv

from . import charts, harness, pareto_measure, pareto_page, pareto_points, programs, record
from .harness import experiment, recorded, show, some_of
from .pareto_measure import Sizes, slug
from .pareto_scenes import ROWS
from .programs import DRJIT, THREADS, VTK
from .scenes import PHANTOM


PEERS = (VTK, DRJIT)
QUICK = (PHANTOM, f"{PHANTOM}, lit")
"""The scenes of `--quick`."""
SAME = 0.01
"""Errors that differ by less count as equal."""

Point: TypeAlias = tuple[float, float]
"""Error and time; less is better in both."""


def front(points: Sequence[Point]) -> list[int]:
    """Numbers of the points of which none other is better in one and as good in both, by growing error. Of
    points that are equal in both, all are kept."""
    found: list[int] = []
    for i in sorted(range(len(points)), key=lambda i: points[i]):
        if not found or points[i][1] < points[found[-1]][1] or points[i] == points[found[-1]]:
            found.append(i)
    return found


def behind(
    ours: Sequence[Point], theirs: Mapping[str, Point], same: float = 0.0
) -> dict[str, dict[str, float | None]]:
    """The points of other programs that no point of ours is as good as, in error and in time.

    For each, by what factor we miss it: `time`: that of our fastest point at its error, over its own;
    `error`: that of our best point in its time, over its own. None where we have no such point. Errors that
    differ by the part `same` count as equal, since programs that take the same samples differ by rounding.
    """
    found: dict[str, dict[str, float | None]] = {}
    for name, (error, seconds) in theirs.items():
        enough = error * (1 + same)
        if any(e <= enough and s <= seconds for e, s in ours):
            continue
        fastest = min((s for e, s in ours if e <= enough), default=None)
        best = min((e for e, s in ours if s <= seconds), default=None)
        found[name] = {
            "time": None if fastest is None else fastest / seconds,
            "error": None if best is None else best / error if error else None,
        }
    return found


def concluded(name: str, found: dict[str, Any], options: list[str]) -> dict[str, Any]:
    """A scene's entry in the record: times by the base, fronts, commands, and what peers do better."""
    row, points = ROWS[name], {}
    base = float(np.median(found["base seconds"]))
    for point, measured in found["points"].items():
        line = ["python", "-m", "experiments.pareto", "--scene", name, "--point", point, *options]
        points[point] = {**measured, "time": base * measured["ratio"]["median"], "command": shlex.join(line)}
    pairs = {n: (p["rmse"], p["time"]) for n, p in points.items()}
    ours = {n: pair for n, pair in pairs.items() if points[n]["family"] not in PEERS}
    theirs = {n: pair for n, pair in pairs.items() if n not in ours}
    ahead = behind(list(ours.values()), theirs, SAME)
    return {
        "pixels": found["pixels"],
        "reference": found["reference"],
        "base": pareto_points.base_of(row),
        "base seconds": round(base, 5),
        "front of jaxvol": [list(ours)[i] for i in front(list(ours.values()))],
        "front of all": [list(pairs)[i] for i in front(list(pairs.values()))],
        "peers left out": row.peers,
        "jaxvol's front is left of and below all points of VTK and Dr.Jit": not ahead if theirs else None,
        "their points that it is not": ahead,
        "points": points,
    }


def summary(scenes: dict[str, Any]) -> dict[str, Any]:
    """What the record says in short, of scenes with peers."""
    compared = {n: s for n, s in scenes.items() if any(p["family"] in PEERS for p in s["points"].values())}
    ahead = {n: s["their points that it is not"] for n, s in compared.items()}
    return {
        "points": sum(len(s["points"]) for s in scenes.values()),
        "scenes with peers": len(compared),
        "scenes in which jaxvol's front is left of and below all points of VTK and Dr.Jit": [
            n for n, points in ahead.items() if not points
        ],
        "points that it is not left of and below, by scene": {n: p for n, p in ahead.items() if p},
        "largest error of a reference": max(s["reference"]["rmse"] for s in scenes.values()),
    }


def again(name: str, point: str, output: Path, sizes: Sizes, present: dict[str, str]) -> dict[str, Any]:
    """Renders and times a point, in turn with the base, and saves its picture; nothing else is changed."""
    row = ROWS[name]
    settings = pareto_points.of(row, present)
    if point not in settings:
        raise ValueError(
            f"--point must be one of the settings of {name!r}, {', '.join(settings)}; got {point!r}."
        )
    case, base = pareto_measure.case_of(row, sizes), pareto_points.base_of(row)
    truth = pareto_measure.converged(case, row, sizes.templates)
    made = {"": settings[base].make(case), point: settings[point].make(case)}
    rows = programs.measured(made, truth, sizes.repetitions)
    output.mkdir(exist_ok=True)
    file = output / f"{slug(name)}, {slug(point)}.png"
    jv.save_png(file, pareto_measure.beside(made[point], truth))
    return {**rows[point], f"picture, and its error times {pareto_measure.AMPLIFIED}": str(file)}


def draw(result: dict[str, Any], path: Path) -> None:
    """The chart, and the page beside it, with the pictures that the experiment left there."""
    charts.save(pareto_page.chart(result), path)
    file = path.with_suffix(".json")
    file = file if file.is_file() else record.RESULTS / "pareto.json"
    pareto_page.write(file, file.parent / "pareto", path.with_suffix(".html"))


@experiment(
    draw,
    repetitions=5,
    size=256,
    resolution=192,
    templates={"type": int, "default": pareto_measure.TEMPLATES, "help": "of a lit scene's reference"},
    scene=some_of(ROWS, "SCENE"),
    point={"metavar": "SETTING", "help": "render, time and save this point of one scene again"},
    quick={"size": 32, "repetitions": 2, "resolution": 32, "templates": 4},
)
def main(chosen: Namespace) -> dict[str, Any] | None:
    folder = harness.data() or Path("/none")
    names = [n for n in chosen.scene if (file := ROWS[n].file) is None or (folder / file).is_file()]
    if chosen.quick and chosen.scene == list(ROWS):
        names = list(QUICK)
    if not names or (chosen.point is not None and len(names) != 1):
        raise ValueError(f"--point is of one scene: give one --scene that is there; got {', '.join(names)}.")
    sizes = Sizes(chosen.size, chosen.resolution, chosen.repetitions, chosen.templates)
    folder, present = chosen.output / "pareto", programs.peers()
    if chosen.point is not None:
        show(again(names[0], chosen.point, folder, sizes, present), names[0], chosen.point)
        return None

    options = [f"--{n}={getattr(chosen, n)}" for n in ("size", "resolution", "repetitions", "seed")]
    made = {"commit": record.commit(), "command": shlex.join(["python", "-m", *chosen.command])}
    scenes: dict[str, Any] = {}
    for name in names:
        settings = pareto_points.of(ROWS[name], present)
        if chosen.quick:  # the first two of each family
            of_family = {
                s.family: [n for n in settings if settings[n].family == s.family] for s in settings.values()
            }
            settings = {n: settings[n] for names_ in of_family.values() for n in names_[:2]}
        found = pareto_measure.scene(name, folder / slug(name), sizes, settings)
        scenes[name] = {"measured": made, **concluded(name, found, ["--quick"] if chosen.quick else options)}
    same = {"repetitions": chosen.repetitions, "voxels along an axis of phantoms": chosen.resolution}
    scenes |= recorded(chosen, "scenes", [name for name in ROWS if name not in scenes], same)
    scenes = {name: scenes[name] for name in ROWS if name in scenes}
    show(summary(scenes))
    return {**same, "threads": THREADS, "peers": present, "summary": summary(scenes), "scenes": scenes}
