"""Is one commit slower than another? Each renders in a process of its own; frames are taken in turn.

    python -m experiments.compare 77f9c25 HEAD
    python -m experiments.compare HEAD~3 HEAD~2 HEAD~1 HEAD --kinds image --only engine bonsai

The first commit is the baseline; WORKTREE stands for the files as they are. Printed are, for each scene, kind
of frame and commit, the median of the paired ratios to the baseline, with its 95 % interval; and their
geometric means. Kinds: "image" (leaps, alignment and early termination, by the midpoint rule, at steps of a
voxel), "gradient" (of a loss by the transfer function, with the image), and "shaded" (Phong).

Run it on a machine that does nothing else, before anything lands in the hot path: `engine/`, `march`,
`reference`, `transfer`, `compositing`, `occupancy`. Real volumes are read from the folder that JAXVOL_DATA
names; without one, only the phantom is measured.
"""

import json
import os
import subprocess
import sys
import tempfile
from argparse import Namespace
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from . import timing
from .harness import data, experiment, geometric_mean, show, some_of
from .scenes import PHANTOM, SCENES


KINDS = "image", "gradient", "shaded"
ROOT = Path(__file__).parent.parent


class Worker:
    """The process of a commit, which compiles all programs first."""

    def __init__(self, tree: Path, *given: Any):
        script = str(Path(__file__).with_name("compare_worker.py"))
        command = [sys.executable, "-W", "ignore", script, str(tree), *map(json.dumps, given)]
        how: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        # without a folder of programs, which would not be compiled
        environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
        self.process = subprocess.Popen(command, bufsize=1, cwd=tree, env=environment, **how)
        self.programs: list[str] = json.loads(self._line())

    def seconds(self, program: str) -> float:
        """Of one frame."""
        assert self.process.stdin is not None
        self.process.stdin.write(program + "\n")
        return float(self._line())

    def _line(self) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError("the process of a commit ended; its error stands above.")
        return line


def checked_out(commit: str, folder: Path) -> Path:
    """A folder with the files of a commit."""
    if commit == "WORKTREE":
        return ROOT
    tree = folder / commit.replace("/", "_")
    found = subprocess.check_output(["git", "-C", str(ROOT), "rev-parse", commit], text=True)
    subprocess.run(["git", "clone", "-q", "--shared", str(ROOT), str(tree)], check=True)
    subprocess.run(["git", "-C", str(tree), "checkout", "-q", found.strip()], check=True)
    return tree


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
    return {kind: {commit: geometric_mean(each) for commit, each in of.items()} for kind, of in kinds.items()}


@experiment(
    commits={"nargs": "+", "metavar": "COMMIT", "help": "the baseline first; WORKTREE: files as they are"},
    size=512,
    repetitions=11,
    kinds=some_of(KINDS, "KIND"),
    only=some_of(SCENES, "VOLUME"),
    quick={"size": 32, "repetitions": 2},
)
def main(chosen: Namespace) -> dict[str, Any]:
    folder = data()
    names = [PHANTOM] if folder is None or chosen.quick else chosen.only
    workers: dict[str, Worker] = {}
    with tempfile.TemporaryDirectory(prefix="compare-") as temporary, ThreadPoolExecutor(2) as pool:
        trees = {commit: checked_out(commit, Path(temporary)) for commit in chosen.commits}
        given = folder and str(folder), names, chosen.kinds, chosen.size
        try:
            started = pool.map(lambda tree: Worker(tree, *given), trees.values())
            workers |= dict(zip(trees, started, strict=True))
            found = ratios(frames(workers, chosen.repetitions), chosen.commits[0])
        finally:
            for worker in workers.values():
                worker.process.kill()
    show(found)
    show(means(found), "geometric means")
    sizes = {"size": chosen.size, "repetitions": chosen.repetitions}
    return {**sizes, "geometric means": means(found), "programs": found}
