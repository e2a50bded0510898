"""What does accuracy cost, for every setting of every method? Time against error, with the Pareto fronts.

Each scene of `pareto_scenes` is rendered under each setting of `pareto_points`: steps and quadratures,
adaptive sampling, jitter, alignment, leaping, termination, tables, types of voxels, and the light of lit
scenes, beside VTK and Dr.Jit. Settings are timed in turn with the scene's base; a point's time is its median
ratio to the base, times the base's median time over the whole scene. Errors are those of linear RGB over
white against a converged image, whose own error is estimated (`pareto_reference`).

What is finished is kept in the folder `pareto/` of the output, and is not measured again by the same command
unless commit, sources or options differ; Ctrl-C loses one method of one scene. `--scene` measures some
scenes anew and keeps what the record says of the others, with the commit that they are of. `--point` renders
one point of one scene again, times it and saves its picture beside its error. The record is `pareto.json`,
the chart `pareto.png`, the page `pareto.html` (see `pareto_page`).

Where VTK shades, it lights nodes and interpolates what that gives, along the camera's axis: a part of its
distance to our image, up to 3 / 255, is that and not an error.

Peers that are not installed are left out, and the record says why. Real volumes are read from the folder that
JAXVOL_DATA names; scenes whose volume is not there are left out, too.
"""

import json
import shlex
from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np

import jaxvol as jv

from . import common, pareto_chart, pareto_measure, pareto_page, pareto_points, record
from .accuracy import DRJIT, VTK
from .pareto_front import behind, front
from .pareto_measure import Sizes, Store, slug
from .pareto_points import Setting
from .pareto_reference import TEMPLATES
from .pareto_scenes import ROWS
from .scenes import PHANTOM
from .speed import THREADS, peers


PEERS = (VTK, DRJIT)
QUICK = (PHANTOM, f"{PHANTOM}, lit")
"""The scenes of `--quick`."""
SAME = 0.01
"""Errors that differ by less count as equal."""
FEW = 2
"""Settings of each family under `--quick`."""


def there(file: str | None) -> bool:
    """Whether a scene's volume is there."""
    folder = common.data()
    return file is None or (folder is not None and (folder / file).is_file())


def few(settings: dict[str, Setting]) -> dict[str, Setting]:
    """The first settings of each family."""
    families: dict[str, list[str]] = {}
    for name, setting in settings.items():
        families.setdefault(setting.family, []).append(name)
    return {n: settings[n] for names in families.values() for n in names[:FEW]}


def concluded(name: str, kept: dict[str, Any], options: list[str]) -> dict[str, Any]:
    """A scene's entry in the record: times by the base, fronts, commands, and what peers do better."""
    row = ROWS[name]
    base = float(np.median([s for each in kept["base"].values() for s in each]))
    points = {}
    for point, found in kept["points"].items():
        line = ["python", "-m", "experiments.pareto", "--scene", name, "--point", point, *options]
        left = {k: v for k, v in found.items() if k != "all seconds"}
        points[point] = {**left, "time": base * found["ratio"]["median"], "command": shlex.join(line)}
    pairs = {n: (p["rmse"], p["time"]) for n, p in points.items()}
    ours = {n: pair for n, pair in pairs.items() if points[n]["family"] not in PEERS}
    theirs = {n: pair for n, pair in pairs.items() if n not in ours}
    ahead = behind(list(ours.values()), theirs, SAME)
    return {
        "view": row.view,
        "look": row.look,
        "lit": row.lit,
        "toroidal": row.toroidal,
        "volume": row.file or "phantom",
        "pixels": kept["pixels"],
        "reference": kept["reference"],
        "base": pareto_points.base_of(row),
        "base seconds": round(base, 5),
        "front of jaxvol": [list(ours)[i] for i in front(list(ours.values()))],
        "front of all": [list(pairs)[i] for i in front(list(pairs.values()))],
        "peers left out": row.peers,
        "jaxvol's front is left of and below all points of VTK and Dr.Jit": not ahead if theirs else None,
        "their points that it is not": ahead,
        "points": points,
        **({"gradients": kept["gradients"]} if "gradients" in kept else {}),
    }


def summary(scenes: dict[str, Any]) -> dict[str, Any]:
    """What the record says in short, of scenes with peers."""
    compared = {n: s for n, s in scenes.items() if any(p["family"] in PEERS for p in s["points"].values())}
    return {
        "points": sum(len(s["points"]) for s in scenes.values()),
        "scenes with peers": len(compared),
        "scenes in which jaxvol's front is left of and below all points of VTK and Dr.Jit": [
            n for n, s in compared.items() if not s["their points that it is not"]
        ],
        "points that it is not left of and below, by scene": {
            n: s["their points that it is not"]
            for n, s in compared.items()
            if s["their points that it is not"]
        },
        "largest error of a reference": max(s["reference"]["rmse"] for s in scenes.values()),
    }


def recorded(chosen: Namespace) -> dict[str, Any]:
    """What the record at the output says of the scenes that are not chosen, with the commit and the command
    that measured them; nothing if its sizes are others."""
    path = chosen.output / "pareto.json"
    if chosen.quick or not path.is_file():
        return {}
    found = record.read(path)
    result, made = found["result"], {"commit": found["commit"], "command": found["command"]}
    sizes = {"repetitions": chosen.repetitions, "voxels along an axis of phantoms": chosen.resolution}
    if any(result[name] != size for name, size in sizes.items()) or found["seed"] != chosen.seed:
        return {}
    return {n: {"measured": made, **scene} for n, scene in result["scenes"].items() if n not in chosen.scene}


def again(name: str, point: str, output: Path, sizes: Sizes, present: dict[str, str]) -> dict[str, Any]:
    """Renders and times a point, in turn with the base, and saves its picture; nothing else is changed."""
    row = ROWS[name]
    settings = pareto_points.of(row, present)
    if point not in settings:
        raise ValueError(
            f"--point must be one of the settings of {name!r}, {', '.join(settings)}; got {point!r}."
        )
    case, base = pareto_measure.case_of(row, sizes), pareto_points.base_of(row)
    store = Store(output / slug(name), pareto_measure.key_of(name, sizes, present))
    truth = pareto_measure.truth_of(case, row, sizes, store)
    program, against = settings[point].make(case), settings[base].make(case)
    rows, _ = pareto_measure.timed({point: program}, base, against, truth, sizes.repetitions)
    file = output / f"{slug(name)}, {slug(point)}.png"
    jv.save_png(file, pareto_measure.beside(program, truth))
    return {**rows[point], "picture, and its error times " + str(pareto_measure.AMPLIFIED): str(file)}


@common.experiment(
    "pareto",
    "What does accuracy cost, for every setting of every method, and where are the Pareto fronts?",
    __doc__,
    repetitions=5,
    size=256,
    resolution=192,
    scene=common.some_of(ROWS, "SCENE"),
    point={
        "metavar": "SETTING",
        "default": None,
        "help": "render, time and save this point of one scene again",
    },
)
def main(chosen: Namespace) -> common.Answer | None:
    templates, names = TEMPLATES, [name for name in chosen.scene if there(ROWS[name].file)]
    given = any(word.split("=")[0] == "--scene" for word in chosen.argv)
    for name in chosen.scene:
        if name not in names:
            print(f"{name}: left out, {ROWS[name].file} is not in the folder JAXVOL_DATA")
    if chosen.quick:
        chosen.size, chosen.repetitions, chosen.resolution, templates = 32, 2, 32, 4
        names = names if given else list(QUICK)
    if chosen.point is not None and (len(names) != 1 or not given):
        raise ValueError(f"--point is of one scene: give one --scene that is there; got {', '.join(names)}.")
    sizes = Sizes(chosen.size, chosen.resolution, chosen.repetitions, templates, chosen.seed)
    folder, present = chosen.output / "pareto", peers()
    print(present, flush=True)
    if chosen.point is not None:
        print(json.dumps(again(names[0], chosen.point, folder, sizes, present), indent=1))
        return None
    if not names:
        raise ValueError("--scene must name a scene whose volume is there; got none.")

    scenes: dict[str, Any] = {}
    for number, name in enumerate(names, 1):
        say = lambda text, n=number: print(f"[{n}/{len(names)}] {text}", flush=True)  # noqa: E731
        kept = pareto_measure.scene(
            name, folder / slug(name), sizes, present, few if chosen.quick else dict, say
        )
        command = shlex.join(["python", "-m", "experiments.pareto", *chosen.argv])
        measured = {"commit": record.commit(), "command": command}
        scenes[name] = {"measured": measured, **concluded(name, kept, repeated(chosen))}
    scenes |= recorded(chosen)
    scenes = {name: scenes[name] for name in ROWS if name in scenes}
    result = {
        "repetitions": chosen.repetitions,
        "voxels along an axis of phantoms": chosen.resolution,
        "threads": THREADS,
        "peers": present,
        "summary": summary(scenes),
        "scenes": scenes,
    }
    print(json.dumps(result["summary"], indent=1))

    def charts(path: Path) -> None:
        pareto_chart.draw(result, path)
        page = pareto_page.write(path.with_suffix(".json"), folder, path.with_suffix(".html"))
        print(f"{page}: {page.stat().st_size / 1e6:.1f} MB")

    return result, charts


def repeated(chosen: Namespace) -> list[str]:
    """The options with which a point is made again: those of the run."""
    if chosen.quick:
        return ["--quick"]
    return [f"--{n}={getattr(chosen, n)}" for n in ("size", "resolution", "repetitions", "seed")]


if __name__ == "__main__":
    main()
