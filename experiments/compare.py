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
from functools import partial
from pathlib import Path
from typing import Any

from . import timing
from .harness import data, experiment, geometric_mean, some_of
from .scenes import PHANTOM, SCENES, UNTUNED


KINDS = "image", "gradient", "shaded"
ROOT = Path(__file__).parent.parent


class Worker:
    """The process of a commit."""

    def __init__(self, tree: Path, *given: Any):
        script = str(Path(__file__).with_name("compare_worker.py"))
        command = [sys.executable, "-W", "ignore", script, str(tree), *map(json.dumps, given)]
        how: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        # without a folder of programs, which would not be compiled
        environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
        self.process = subprocess.Popen(command, bufsize=1, cwd=tree, env=environment, **how)
        self.programs: list[str] = json.loads(self._line())

    def run(self, program: str) -> None:
        """Renders a frame."""
        assert self.process.stdin is not None
        self.process.stdin.write(program + "\n")
        self._line()

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


def measure(workers: dict[str, Worker], base: str, repetitions: int) -> dict[str, dict[str, dict[str, Any]]]:
    """By program and commit, its time and its ratio to the baseline's, of the programs that this has."""
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for program in workers[base].programs:
        having = {c: partial(w.run, program) for c, w in workers.items() if program in w.programs}
        seconds = timing.interleaved(having, repetitions)
        found[program] = {
            commit: {"seconds": timing.median(taken), **timing.ratio(taken, seconds[base])}
            for commit, taken in seconds.items()
        }
    return found


def means(found: dict[str, dict[str, dict[str, Any]]], kinds: list[str]) -> dict[str, dict[str, float]]:
    """By kind and commit, the geometric mean of the scenes' ratios."""
    mean = {}
    for kind in kinds:
        rows = [row for name, row in found.items() if name.endswith(kind)]
        mean[kind] = {c: geometric_mean(row[c]["median"] for row in rows if c in row) for c in rows[0]}
    return mean


@experiment(
    commits={"nargs": "+", "metavar": "COMMIT", "help": "the baseline first; WORKTREE: files as they are"},
    size=512,
    repetitions=11,
    kinds=some_of(KINDS, "KIND"),
    only=some_of([*SCENES, *UNTUNED], "VOLUME") | {"default": list(SCENES)},
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
            found = measure(workers, chosen.commits[0], chosen.repetitions)
        finally:
            for worker in workers.values():
                worker.process.kill()
    return {"geometric means": means(found, chosen.kinds), "programs": found}
