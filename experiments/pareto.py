"""What does accuracy cost, for every setting of every method? Time against error, with the Pareto fronts.

Each scene of `pareto_scenes` is rendered under each setting of `pareto_points`: steps and quadratures,
jitter, alignment, leaping, termination, tables, types of voxels, and the light of lit scenes, beside VTK and
Dr.Jit. Settings are timed in turn with the scene's base; a point's time is its median ratio to the base,
times the base's median time over the whole scene. Errors are those of linear RGB over
white against a converged image, whose own error is estimated (`pareto_measure`).

`--scene` measures some scenes again and keeps what the record says of the others, with the commit that they
are of. `--point` renders one point of one scene again, times it and saves its picture beside its error. The
record is `pareto.json`, the charts are `pareto.png` and `pareto_grain.png`, the page is `pareto.html` (see
`pareto_page`), and the pictures that it shows are in the folder `pareto/`.

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

from . import harness, pareto_measure, pareto_page, pareto_points, programs, record
from .harness import experiment, recorded, show, some_of
from .pareto_measure import slug
from .pareto_scenes import ROWS
from .programs import DRJIT, VTK
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
    return {
        "pixels": found["pixels"],
        "reference": found["reference"],
        "front of jaxvol": [list(ours)[i] for i in front(list(ours.values()))],
        "peers left out": row.peers,
        "their points that it is not": behind(list(ours.values()), theirs, SAME),
        "points": points,
    }


def again(name: str, chosen: Namespace, output: Path, present: dict[str, str]) -> dict[str, Any]:
    """Renders and times a point, in turn with the base, and saves its picture; nothing else is changed."""
    row, point = ROWS[name], chosen.point
    settings, base = pareto_points.of(row, present), pareto_points.base_of(row)
    if point not in settings:
        raise ValueError(f"--point must be one of {', '.join(settings)}; got {point!r}.")
    case = pareto_measure.case_of(row, chosen)
    truth = pareto_measure.converged(case, row, chosen.templates)
    made = {"": settings[base].make(case), point: settings[point].make(case)}
    file = output / f"{slug(name)}, {slug(point)}.png"
    jv.save_png(file, pareto_measure.beside(made[point], truth))
    return programs.measured(made, truth, chosen.repetitions)[point]


draw, page = pareto_page.chart, pareto_page.write
more = {"pareto_grain": pareto_page.grain_chart}


@experiment(
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
    present = programs.peers()
    if chosen.point is not None:
        show(again(names[0], chosen, chosen.output, present), names[0], chosen.point)
        return None

    options = [f"--{n}={getattr(chosen, n)}" for n in ("size", "resolution", "repetitions", "seed")]
    made = {"commit": record.commit(), "command": shlex.join(["python", "-m", *chosen.command])}
    scenes: dict[str, Any] = {}
    for name in names:
        settings = pareto_points.of(ROWS[name], present)
        settings = dict(list(settings.items())[:: 6 if chosen.quick else 1])
        found = pareto_measure.scene(name, chosen.output / "pareto" / slug(name), chosen, settings)
        scenes[name] = {"measured": made, **concluded(name, found, ["--quick"] if chosen.quick else options)}
    same = {"repetitions": chosen.repetitions, "voxels along an axis of phantoms": chosen.resolution}
    scenes |= recorded(chosen, "scenes", [name for name in ROWS if name not in scenes], same)
    scenes = {name: scenes[name] for name in ROWS if name in scenes}
    return {**same, "peers": present, "scenes": scenes}
