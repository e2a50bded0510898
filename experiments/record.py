"""Records of experiments: JSON files with the result, device, versions, seed and command."""

import json
import os
import platform
import shlex
import subprocess
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax

from jaxvol._util.whole_files import whole_file


RESULTS = Path(__file__).parent / "results"
BEGUN = time.monotonic()
"""When this was imported: at the start of the process."""

PACKAGES = ("jaxvol", "jax", "jaxlib", "equinox", "numpy", "scikit-image", "matplotlib")


def write(path: Path, question: str, result: Any, *, seed: int, command: list[str]) -> Path:
    """Write a result as JSON, with all that is needed to run the experiment again.

    - `question`: the question that the result answers.
    - `result`: anything that JSON can hold.
    - `command`: module and arguments, as after `python -m`.
    """
    record = {
        "question": question,
        "command": shlex.join(["python", "-m", *command]),
        "seed": seed,
        "versions": {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}},
        "commit": commit(),
        "seconds": round(time.monotonic() - BEGUN),
        "device": _device(),
        "result": result,
    }
    with whole_file(path) as part:
        part.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return path


def read(path: Path) -> dict[str, Any]:
    """A record that `write` wrote."""
    return json.loads(path.read_text(encoding="utf-8"))


OTHERS = ":(top,exclude)experiments/results"
"""All files but results, in Git's words."""


def _device() -> dict[str, Any]:
    device = jax.devices()[0]
    return {
        "platform": device.platform,
        "kind": device.device_kind,
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load when written": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
    }


def _processor() -> str:
    information = Path("/proc/cpuinfo")
    lines = information.read_text(encoding="utf-8").splitlines() if information.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def commit() -> str | None:
    """The checkout's commit, with + if files other than results differ from it; None outside a checkout."""
    here = Path(__file__).parent

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", "-C", str(here), *words], capture_output=True, text=True, check=True
        ).stdout.strip()

    try:
        return git("rev-parse", "--short", "HEAD") + (
            "+" if git("status", "--porcelain", "--", ":/", OTHERS) else ""
        )
    except (OSError, subprocess.CalledProcessError):
        return None
