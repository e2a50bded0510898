"""How many CPU seconds does a first picture take, from the start of its process, at one commit and another?

    python -m experiments.first_picture --repetitions 5
    python -m experiments.first_picture --base HEAD~1 --head HEAD --only show render

The commands of a row run in turn, each in a process of its own, and share a folder of kept programs, which is
empty before the first one. Both commits take turns, row by row, so that the ratio of a pair is that of one
machine. Counted are the CPU seconds of all threads, and the programs that were compiled, rather than found in
that folder. A command that a commit does not know has no numbers there. Files are the engine and a tooth in
the folder that JAXVOL_DATA names, or else phantoms; WORKTREE stands for the files as they are.
"""

import math
import os
import resource
import subprocess
import sys
import tempfile
from argparse import Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import jaxvol as jv

from . import charts, timing
from .compare import checked_out
from .harness import data, experiment, geometric_mean, some_of


class Command(NamedTuple):
    """A command's words after `python`, in which {file}, {other} and {output} are replaced, and the ratio of
    its CPU seconds that is asked for."""

    words: tuple[str, ...]
    goal: float | None = None


SHOW = """
import jaxvol as jv
jv.show(jv.phantom("head", 96))
"""

GRADIENT = """
import jax
import jaxvol as jv

volume = jv.phantom("head", 64)
points = [(60, (0.8, 0.4, 0.3), 0.0), (90, (0.8, 0.4, 0.3), 0.02), (255, (1.0, 0.95, 0.85), 0.9)]
transfer = jv.TransferFunction.from_points(points, unit_distance=0.02)
camera = jv.Camera.looking_at(volume, (0.6, -0.8, 0.3), size=(64, 64))
march = jv.March(0.03, (jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination(1e-4)), "midpoint")
loss = lambda transfer: jv.render(volume, transfer, camera, march).image().mean()
jax.block_until_ready({jit}(jax.value_and_grad(loss))(transfer))
"""

DOZEN = """
import jax
import jaxvol as jv

head = jv.phantom("head", 64)
points = [(60, (0.8, 0.4, 0.3), 0.0), (90, (0.8, 0.4, 0.3), 0.02), (255, (1.0, 0.95, 0.85), 0.9)]
plain = jv.TransferFunction.from_points(points, unit_distance=0.02)
points.insert(2, (150, (0.9, 0.8, 0.6), 0.1))
more = jv.TransferFunction.from_points(points, unit_distance=0.02)
leap, align, end = jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination(1e-4)


def draw(transfer=plain, size=(128, 128), transforms=(leap, align, end), rule="midpoint", volume=head, **how):
    camera = jv.Camera.looking_at(volume, (0.6, -0.8, 0.3), size=size, **how.pop("camera", {}))
    rendering = jv.render(volume, transfer, camera, jv.March(0.03, transforms, rule), **how)
    jax.block_until_ready(rendering.rgba)


draw()
draw(size=(200, 120))
draw(size=(256, 256))
draw(more)
draw(jv.colormap("gray", (0, 255), unit_distance=0.2))
draw(transforms=(leap, end))
draw(transforms=(align,), rule="left")
draw(camera={"parallel": True})
draw(volume=head.crop((-0.8, 0.7, -0.9, 0.9, -0.7, 0.8)))
draw(compositing="maximum")
draw(lighting=jv.lighting.Phong())
draw(transforms=(jv.Clip((-0.5, 1, -1, 1, -1, 1)), leap, align, end))
"""

JAXVOL = "-m", "jaxvol"
RENDER = *JAXVOL, "render"
TO = "-o", "{output}/out.png"
ROWS: dict[str, dict[str, Command]] = {
    "version": {"--version": Command((*JAXVOL, "--version")), "--help": Command((*JAXVOL, "--help"))},
    "info": {"info": Command((*JAXVOL, "info", "{file}"))},
    "show": {"show": Command(("-c", SHOW), 0.3), "show again": Command(("-c", SHOW))},
    "render": {
        "render FILE": Command((*RENDER, "{file}", *TO), 0.25),
        "then OTHER": Command((*RENDER, "{other}", *TO), 0.15),
        "then FILE again": Command((*RENDER, "{file}", *TO), 0.25),
    },
    "demo": {"demo": Command((*JAXVOL, "demo", "-o", "{output}/demo"), 0.35)},
    "gradient": {"gradient": Command(("-c", GRADIENT.replace("{jit}", "")), 0.4)},
    "jit": {"gradient, jit": Command(("-c", GRADIENT.replace("{jit}", "jax.jit")), 0.4)},
    "dozen": {"a dozen kinds": Command(("-c", DOZEN), 0.2)},
}
"""Commands by the name of their row and their own."""

FILES = "engine_256x256x128_uint8.raw.gz", "tooth_103x94x161_uint8.raw"


def files(folder: Path) -> tuple[Path, Path]:
    """Two volumes of different shapes."""
    if (found := data()) is not None:
        return found / FILES[0], found / FILES[1]
    shapes = {"engine": (96, 96, 96), "head": (64, 88, 96)}
    paths = [folder / f"{name}_{'x'.join(map(str, shape))}_uint8.raw" for name, shape in shapes.items()]
    for path, (name, (nx, ny, nz)) in zip(paths, shapes.items(), strict=True):
        path.write_bytes(np.asarray(jv.phantom(name, 96).data)[:nx, :ny, :nz].tobytes("F"))
    return paths[0], paths[1]


def measured(words: list[str], tree: Path, programs: Path, temporary: Path) -> tuple[float, int] | None:
    """CPU seconds of a command, and how many programs it compiled; None if it fails."""
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    environment |= {"XDG_CACHE_HOME": str(programs), "MPLCONFIGDIR": str(temporary), "MPLBACKEND": "Agg"}
    environment |= {"JAX_LOG_COMPILES": "1"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-W", "ignore", *words]
    ended = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if ended.returncode:
        print(f"{' '.join(words[:4])}: {ended.stderr.strip().splitlines()[-1:]}", file=sys.stderr)
        return None
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    found = ended.stderr.count("Persistent compilation cache hit")
    return seconds, ended.stderr.count("Finished XLA compilation") - found


def prepare(tree: Path, temporary: Path) -> None:
    """Compiles what any first process compiles: Python's bytecode, and matplotlib's list of fonts."""
    subprocess.run([sys.executable, "-m", "compileall", "-q", "jaxvol"], cwd=tree, check=True)
    measured(["-c", "import jaxvol, matplotlib.pyplot"], tree, temporary, temporary)


def draw(result: dict[str, Any]) -> Any:
    rows = {name: row for name, row in result["commands"].items() if "ratio" in row}
    figure, ((panel,),) = charts.panels(1, 1, 7, 0.4 * len(rows) + 1.2)
    for y, row in enumerate(rows.values()):
        charts.interval(panel, row["ratio"], y, "C0")
        if row["goal"] is not None:
            panel.plot(row["goal"], y, "|", color="k", markersize=14)
        seconds = f"{row['base']:.3g} → {row['head']:.3g} s"
        panel.text(1.02, y, seconds, va="center", transform=panel.get_yaxis_transform())
    panel.axvline(1, color="k", linewidth=0.8)
    panel.set_yticks(range(len(rows)), list(rows))
    panel.set_xscale("log")
    charts.plain_numbers(panel)
    panel.invert_yaxis()
    panel.set_xlabel(f"CPU seconds / those at {result['base']}; bars: goals")
    return figure


def _filled(word: str, known: Mapping[str, str]) -> str:
    for name, value in known.items():
        word = word.replace(name, value)
    return word


def _row(goal: float | None, **sides: list[tuple[float, int] | None]) -> dict[str, Any]:
    """Medians of both commits, and the ratio of the pairs in which both have numbers."""
    row: dict[str, Any] = {"goal": goal}
    for side, found in sides.items():
        known = [each for each in found if each is not None]
        if known:
            row[side] = timing.median([seconds for seconds, _ in known])
            row[f"{side} programs"] = int(np.median([programs for _, programs in known]))
    pairs = [(b[0], h[0]) for b, h in zip(sides["base"], sides["head"], strict=True) if b and h]
    if pairs:
        row["ratio"] = timing.ratio([h for _, h in pairs], [b for b, _ in pairs])
    return row


@experiment(
    base={"default": "96ca327e", "metavar": "COMMIT", "help": "baseline (default: %(default)s)"},
    head={"default": "WORKTREE", "metavar": "COMMIT", "help": "compared with it (default: %(default)s)"},
    repetitions=3,
    only=some_of(ROWS, "ROW"),
    quick={"repetitions": 1, "only": ["version"]},
)
def main(chosen: Namespace) -> dict[str, Any]:
    taken: dict[str, dict[str, list[tuple[float, int] | None]]] = {}
    with tempfile.TemporaryDirectory(prefix="first-picture-") as made:
        temporary = Path(made)
        trees = {side: checked_out(getattr(chosen, side), temporary / side) for side in ("base", "head")}
        known = dict(zip(("{file}", "{other}"), map(str, files(temporary)), strict=True))
        for tree in trees.values():
            prepare(tree, temporary)
        for repetition in range(chosen.repetitions):
            for row in chosen.only:
                for side in list(trees)[:: 1 if repetition % 2 == 0 else -1]:
                    with tempfile.TemporaryDirectory(dir=temporary) as folder:
                        for name, command in ROWS[row].items():
                            output = known | {"{output}": folder}
                            words = [_filled(word, output) for word in command.words]
                            found = measured(words, trees[side], Path(folder), temporary)
                            taken.setdefault(name, {}).setdefault(side, []).append(found)
                            print(f"{side} {name}: {found}", file=sys.stderr, flush=True)
    goals = {name: command.goal for row in ROWS.values() for name, command in row.items()}
    rows = {name: _row(goals[name], **sides) for name, sides in taken.items()}
    ratios = [row["ratio"]["median"] for row in rows.values() if "ratio" in row]
    mean = geometric_mean(ratios) if ratios else math.nan
    return {"base": chosen.base, "head": chosen.head, "geometric mean": mean, "commands": rows}
