"""Records of experiments: JSON files with the result, device, versions, seed and command."""

import json
import os
import platform
import shlex
import subprocess
import time
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax

from jaxvol._util.whole_files import whole_file


RESULTS = Path(__file__).parent / "results"
BEGUN = time.monotonic()
"""When this was imported: at the start of the process."""

PACKAGES = ("jaxvol", "jax", "jaxlib", "equinox", "numpy", "scikit-image", "matplotlib")


def write(
    path: Path, question: str, result: Any, *, seed: int, command: list[str], options: Mapping[str, Any] = {}
) -> Path:
    """Write a result as JSON, with the question that it answers and all that is needed to run the experiment
    again. `command`: module and arguments, as after `python -m`; `options`: these, and those by default."""
    record = {
        "question": question,
        "command": shlex.join(["python", "-m", *command]),
        "seed": seed,
        "options": options,
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


def _device() -> dict[str, Any]:
    device = jax.devices()[0]
    return {
        "platform": device.platform,
        "kind": device.device_kind,
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
    }


def _processor() -> str:
    information = Path("/proc/cpuinfo")
    lines = information.read_text(encoding="utf-8").splitlines() if information.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def commit() -> str | None:
    """The checkout's commit, with + if files other than results differ from it; None outside a checkout."""

    def git(*words: str) -> str:
        return subprocess.check_output(
            ["git", "-C", str(RESULTS), *words], text=True, stderr=subprocess.DEVNULL
        )

    try:
        changed = git("status", "--porcelain", "--", ":/", ":(top,exclude)experiments/results")
        return git("rev-parse", "--short", "HEAD").strip() + "+" * bool(changed)
    except (OSError, subprocess.CalledProcessError):
        return None
