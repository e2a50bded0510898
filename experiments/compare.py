"""Is one commit slower than another? Each renders in a process of its own; frames are taken in turn.

    python -m experiments.compare 77f9c25 HEAD
    python -m experiments.compare HEAD~3 HEAD~2 HEAD~1 HEAD --kinds image --only engine bonsai

The first commit is the baseline. Frames are taken in turn, so that a machine that becomes slower
meanwhile slows all commits alike. Printed are, for each scene, each kind of frame and each commit, the
median of the paired ratios to the baseline, with its 95 % interval; and their geometric means. Kinds:
"image" (leaps, alignment and early termination, by the midpoint rule, at steps of a voxel), "gradient" (of a
loss by the transfer function, with the image), "shaded" (Phong), and "first": seconds from the start of a
process to its first image, compiled anew, three of them in turn.

A commit is checked out into a temporary folder; WORKTREE stands for the files as they are. Run it on a
machine that does nothing else, before anything lands in the hot path: `engine/`, `march`, `reference`,
`transfer`, `compositing`, `occupancy`. Real volumes are read from the folder that JAXVOL_DATA names; without
one, only the phantom is measured.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from . import charts, timing
from .harness import data, experiment, geometric_mean, show, some_of
from .scenes import PHANTOM, SCENES


KINDS = "image", "gradient", "shaded", "first"
ROOT = Path(__file__).parent.parent
HERE = "WORKTREE"
FIRST = 3
"""First images of each commit, of the first scene."""


class Worker:
    """The process of a commit."""

    def __init__(self, tree: Path, folder: Path | None, names: list[str], kinds: list[str], size: int):
        given = [None if folder is None else str(folder), names, kinds, size]
        script = str(Path(__file__).with_name("compare_worker.py"))
        self.command = [sys.executable, "-W", "ignore", script, str(tree), *map(json.dumps, given)]
        self.tree = tree
        self.process: subprocess.Popen[str] | None = None

    def start(self) -> "Worker":
        """Compiles all programs, and waits until they have run."""
        # without a folder of programs, which would not be compiled
        environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
        self.process = subprocess.Popen(
            self.command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
            cwd=self.tree,
            env=environment,
        )
        self.programs: list[str] = json.loads(self._line())
        return self

    def seconds(self, program: str) -> float:
        """Of one frame."""
        assert self.process is not None
        assert self.process.stdin is not None
        self.process.stdin.write(program + "\n")
        return float(self._line())

    def _line(self) -> str:
        assert self.process is not None
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"the process of {self.tree.name} ended; its error stands above.")
        return line

    def stop(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()


def checked_out(commit: str, folder: Path) -> Path:
    """A folder with the files of a commit."""
    if commit == HERE:
        return ROOT
    tree = folder / commit.replace("/", "_")
    found = subprocess.run(
        ["git", "-C", str(ROOT), "rev-parse", commit], check=True, capture_output=True, text=True
    )
    subprocess.run(["git", "clone", "-q", "--shared", str(ROOT), str(tree)], check=True)
    subprocess.run(["git", "-C", str(tree), "checkout", "-q", found.stdout.strip()], check=True)
    return tree


def first_images(trees: dict[str, Path], folder: Path | None, name: str, size: int) -> dict[str, list[float]]:
    """Seconds from the start of a process of each commit to its first image."""
    taken: dict[str, list[float]] = {commit: [] for commit in trees}
    for _ in range(FIRST):
        for commit, tree in trees.items():
            begun = time.perf_counter()
            worker = Worker(tree, folder, [name], ["image"], size).start()
            taken[commit].append(time.perf_counter() - begun)
            worker.stop()
    return taken


def frames(workers: dict[str, Worker], repetitions: int) -> dict[str, dict[str, list[float]]]:
    """By program and commit, the seconds of every frame: rounds of one frame each, in an order that is
    reversed from one round to the next."""
    programs = list(dict.fromkeys(name for worker in workers.values() for name in worker.programs))
    taken: dict[str, dict[str, list[float]]] = {name: {} for name in programs}
    for repetition in range(repetitions):
        for name in programs:
            having = [commit for commit, worker in workers.items() if name in worker.programs]
            for commit in having[:: 1 if repetition % 2 == 0 else -1]:
                taken[name].setdefault(commit, []).append(workers[commit].seconds(name))
    return taken


def ratios(taken: dict[str, dict[str, list[float]]], base: str) -> dict[str, dict[str, dict[str, float]]]:
    """By program and commit, its time and its ratio to the baseline's, where that has the program."""
    return {
        program: {
            commit: {"seconds": timing.median(seconds), **timing.ratio(seconds, of[base])}
            for commit, seconds in of.items()
        }
        for program, of in taken.items()
        if base in of
    }


def means(found: dict[str, dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """By kind and commit, the geometric mean of the scenes' ratios."""
    kinds: dict[str, dict[str, list[float]]] = {}
    for program, of in found.items():
        for commit, row in of.items():
            kind = kinds.setdefault(program.rpartition(": ")[2], {})
            kind.setdefault(commit, []).append(row["median"])
    return {
        kind: {commit: geometric_mean(ratios) for commit, ratios in of.items()} for kind, of in kinds.items()
    }


def draw(result: dict[str, Any], path: Path) -> None:
    found = result["programs"]
    figure, ((panel,),) = charts.panels(1, 1, 7, 0.28 * len(found) + 1.2)
    base, *others = next(iter(found.values()))
    for y, of in enumerate(found.values()):
        for number, commit in enumerate(others):
            if commit in of:
                place = y + 0.15 * (number - (len(others) - 1) / 2)
                charts.interval(panel, of[commit], place, f"C{number}", commit if y == 0 else None)
    panel.axvline(1, color="k", linewidth=0.8)
    panel.set_yticks(range(len(found)), list(found), fontsize=8)
    panel.invert_yaxis()
    panel.set_xlabel(f"time / that of {base}: median of paired ratios, 95 % interval", fontsize=9)
    figure.legend(loc="outside upper center", ncols=3, fontsize=8)
    charts.save(figure, path)


@experiment(
    draw,
    commits={"nargs": "+", "metavar": "COMMIT", "help": "the baseline first; WORKTREE: files as they are"},
    size=512,
    repetitions=11,
    kinds={"nargs": "+", "choices": KINDS, "default": list(KINDS[:3]), "help": "default: all but first"},
    only=some_of(SCENES, "VOLUME"),
    quick={"size": 32, "repetitions": 2},
)
def main(chosen: Namespace) -> dict[str, Any]:
    folder = data()
    names = [PHANTOM] if folder is None or chosen.quick else chosen.only
    with tempfile.TemporaryDirectory(prefix="compare-") as temporary:
        trees = {commit: checked_out(commit, Path(temporary)) for commit in chosen.commits}
        taken: dict[str, dict[str, list[float]]] = {}
        if kinds := [kind for kind in chosen.kinds if kind != "first"]:
            made = {c: Worker(tree, folder, names, kinds, chosen.size) for c, tree in trees.items()}
            try:
                with ThreadPoolExecutor(2) as pool:
                    workers = dict(zip(made, pool.map(Worker.start, made.values()), strict=True))
                print("all programs are compiled", flush=True)
                taken |= frames(workers, chosen.repetitions)
            finally:
                for worker in made.values():
                    worker.stop()
        if "first" in chosen.kinds:
            taken[f"{names[0]}: first"] = first_images(trees, folder, names[0], chosen.size)
    found = ratios(taken, chosen.commits[0])
    mean = means(found)
    show(found)
    show(mean, "geometric means")
    sizes = {"size": chosen.size, "repetitions": chosen.repetitions}
    return {**sizes, "geometric means": mean, "programs": found}
