"""What all experiments share: options and quick mode, scenes, timed frames with their errors, and records.

An experiment is a question, a function from its options to its result, and a function that draws the result:
`experiment` makes a script of these, which writes `NAME.json` and `NAME.png`.
"""

import argparse
import math
import os
import sys
import tempfile
from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

import jaxvol as jv
from jaxvol.metrics import BLOCK, rmse, wood_grain_energy

from . import charts, marches, record, timing
from .scenes import Scene


Main: TypeAlias = Callable[..., None]
"""`main(argv)`; without `argv`, it takes the arguments of the command line."""

FINER = 8
"""How many times finer the converged image's step is. By the midpoint rule, its error is some hundred times
smaller."""

QUICK = {"action": "store_true", "help": "tiny sizes, to check that the script runs"}
HELP = {"size": "pixels along a side", "sizes": "pixels along a side", "output": "default: %(default)s"}
HELP |= {"resolution": "voxels along an axis of phantoms", "paths": "paths through each pixel"}


def command(about: str | None, output: Path, **options: Any) -> Callable[[Callable[[Namespace], None]], Main]:
    """Decorator that makes a script's `main` of a function of its options.

    Args:
        about: what the script does, its docstring.
        output: default of `--output`, the folder to write into, which is made. Under `--quick` the default is
            a new temporary folder, so that nothing that is kept is overwritten.
        options: the other options, by name: the default of an integer, what `add_argument` takes (a dict), or
            a tuple, which is handed on and cannot be given. `commits` is given without its name.

    Returns:
        The decorator. The arguments as they were given, but for the output, are `argv` among the options.
    """
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    options["output"] = {"type": Path, "default": output, "metavar": "FOLDER"}
    constants = {name: option for name, option in options.items() if isinstance(option, tuple)}
    for name, option in options.items():
        if name not in constants:
            how = option if isinstance(option, dict) else {"type": int, "default": option}
            flag = name if name == "commits" else "--" + name.replace("_", "-")
            parser.add_argument(flag, **{"help": HELP.get(name), **how})

    def made(run: Callable[[Namespace], None]) -> Main:
        def main(argv: Sequence[str] | None = None) -> None:
            given = sys.argv[1:] if argv is None else list(argv)
            pairs = zip(["", *given], given, strict=False)
            kept = [word for last, word in pairs if "--output" not in (last, word.partition("=")[0])]
            chosen = parser.parse_args(given, Namespace(argv=kept, **constants))
            if getattr(chosen, "quick", False) and chosen.output is output:
                chosen.output = Path(tempfile.mkdtemp(prefix="jaxvol-quick-"))
                print(f"--quick without --output writes into {chosen.output}", flush=True)
            chosen.output.mkdir(parents=True, exist_ok=True)
            run(chosen)

        return main

    return made


def experiment(
    *, quick: Mapping[str, Any] | None = None, **options: Any
) -> Callable[[Callable[[Namespace], Any]], Main]:
    """Decorator that makes an experiment's `main` of a function from its options to its result: it prints the
    result, writes the record and draws the chart, by the module's `draw(result)`. A result of None writes
    nothing. Both files have the module's name, and the question is how its docstring begins. Stands last in
    its file: as `python -m MODULE`, it runs at once.

    Args:
        quick: options and constants under `--quick`.
        options: its own, besides `--output`, `--seed` and `--quick`, as for `command`.
    """

    def made(measure: Callable[[Namespace], Any]) -> Main:
        module = sys.modules[measure.__module__]
        about, spec = module.__doc__ or "", module.__spec__
        assert spec is not None

        @command(about, record.RESULTS, seed=0, quick=QUICK, **options)
        def main(chosen: Namespace) -> None:
            chosen.path = chosen.output / f"{spec.name.split('.')[-1]}.json"
            chosen.command = [spec.name, *chosen.argv]
            if chosen.quick:
                vars(chosen).update(quick or {})
            result = measure(chosen)
            if result is None:
                return
            show(result)
            question = " ".join(about.partition("?")[0].split()) + "?"
            how = {"seed": chosen.seed, "command": chosen.command}
            used = {name: getattr(chosen, name) for name in options}
            record.write(chosen.path, question, result, options=used, **how)
            charts.draw_record(chosen.path, chosen.path.with_suffix(".png"))

        if measure.__module__ == "__main__":
            main()
        return main

    return made


def recorded(
    chosen: Namespace, part: str, others: Iterable[str], same: Mapping[str, Any] = {}
) -> dict[str, Any]:
    """Of the record in the output, the rows of `part` with these names, with the commit and the command that
    measured them; nothing if quick, or if what it says of `same` is something else."""
    if chosen.quick or not chosen.path.is_file():
        return {}
    found = record.read(chosen.path)
    if any(found["result"][key] != value for key, value in same.items()):
        return {}
    made = {"commit": found["commit"], "command": found["command"]}
    rows = found["result"][part]
    return {each: {"measured": made, **rows[each]} for each in others if each in rows}


def some_of(names: Iterable[str], metavar: str) -> dict[str, Any]:
    """An option that takes some of the names, by default all."""
    return {"nargs": "+", "choices": list(names), "default": list(names), "metavar": metavar}


def show(found: Mapping[str, Any], *where: Any) -> None:
    """Print a result, a line for each of its rows: the numbers of a row, ratios with their intervals."""
    rows = {name: row for name, row in found.items() if isinstance(row, Mapping) and "median" not in row}
    numbers = {n: v for n, v in found.items() if n not in rows and not isinstance(v, list | tuple)}
    if numbers:
        told = (f"{name} {_number(value)}" for name, value in numbers.items())
        print(", ".join(map(str, where)) + ": " + "  ".join(told), flush=True)
    for name, row in rows.items():
        show(row, *where, name)


def _number(value: Any) -> str:
    if isinstance(value, Mapping):
        between = f" [{value['low']:.3f}, {value['high']:.3f}]" if "low" in value else ""
        return f"{value['median']:.3f}{between}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def data() -> Path | None:
    """The folder of real volumes that JAXVOL_DATA names, or None."""
    folder = os.environ.get("JAXVOL_DATA")
    return Path(folder) if folder else None


def chosen_scenes(
    chosen: Namespace, makers: Mapping[str, Callable[..., Any]], phantom: str, size: int
) -> Iterator[tuple[str, Any]]:
    """The scenes of `--only`, of this size; without the folder of real volumes, or if quick, the phantom's
    alone, of `--resolution`."""
    folder = data()
    for name in [phantom] if folder is None or chosen.quick else chosen.only:
        print(name, flush=True)
        yield name, makers[name](folder, size, chosen.resolution)


def frame(scene: Scene, march: jv.March, lighting: Any = None) -> jv.Rendering:
    """The image with all its outputs."""
    return jv.render(*scene[:3], march, lighting=lighting)


def image(scene: Scene, march: jv.March) -> jv.Rendering:
    """The image alone, as it is timed."""
    return jv.render(*scene[:3], march, outputs="rgba")


def entered(scene: Scene) -> np.ndarray:
    """Pixels whose rays enter the volume within visible material: cut faces, seen from the front."""
    return np.asarray(frame(scene, jv.March(scene.step, max_samples=1)).rgba[..., 3] > 0)


def left(scene: Scene, *more: jv.Transform) -> np.ndarray:
    """Pixels that alignment changes: their rays leave the volume within visible material."""
    march = jv.March(scene.step, (*marches.transforms(marches.BOTH), *more))
    return np.asarray(frame(scene, march).aligned)


def grain_off(error: np.ndarray, faces: np.ndarray) -> float:
    """Energy of wood grain in the blocks without a pixel of `faces`; NaN if all have one."""
    height, width = faces.shape
    corners = [
        (y, x)
        for y in range(0, height - BLOCK + 1, BLOCK // 2)
        for x in range(0, width - BLOCK + 1, BLOCK // 2)
    ]
    blocks = [np.s_[y : y + BLOCK, x : x + BLOCK] for y, x in corners]
    energies = [wood_grain_energy(error[block]) for block in blocks if not faces[block].any()]
    return float(np.mean(energies)) if energies else math.nan


def compare(scene: Scene, under: dict[str, jv.March], repetitions: int) -> dict[str, dict[str, Any]]:
    """Time and error of a scene's frame under every march, and the part of its pixels that alignment changes.
    Ratios are relative to the first march."""
    seconds = timing.interleaved({n: lambda m=m: image(scene, m) for n, m in under.items()}, repetitions)
    truth = frame(scene, marches.converged(scene.step, FINER)).rgba
    rows = {}
    for name, march in under.items():
        rendering = frame(scene, march)
        assert not np.any(rendering.exhausted)
        rows[name] = row(seconds[name], seconds[next(iter(under))], rmse(rendering.rgba, truth))
        rows[name]["samples"] = int(np.sum(np.asarray(rendering.samples), dtype=np.int64))
        rows[name]["aligned"] = float(np.mean(np.asarray(rendering.aligned)))
    return rows


def row(seconds: list[float], base: list[float], error: Any) -> dict[str, Any]:
    """A program's time, its ratio to that of another program, and the error of its image."""
    return {
        "seconds": timing.median(seconds),
        "ratio": timing.ratio(seconds, base),
        "rmse": float(error),
        "all seconds": [round(s, 5) for s in seconds],
    }


def geometric_mean(values: Iterable[float]) -> float:
    return round(math.exp(np.mean(np.log(list(values)))), 4)
