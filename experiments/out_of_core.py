"""How much memory and time does an image take of a volume that does not fit into the memory given?

The head phantom with a grain of its own in each voxel, of 64 MiB to 2 GiB, is written to a temporary folder
as a raw file and as Zarr, and rendered by `render_bricks` with 256 MiB for voxels, at 512 x 512 pixels and
steps of one voxel: under a transfer function whose bones hide what is behind them, and under one of 1/50 of
its extinction, through which everything is seen. Each file is rendered in a process of its own, which tells
its greatest resident memory over what it had before the first image.

Beside it, `render` of the whole volume in memory: at 2 GiB, and at 64 MiB, scaled by the number of samples.
The goals: a peak of at most the budget and 30 % over what an image of a volume of 2 MiB takes (the rays of
the image, and compiled programs), and 1.5 times the time in memory.
"""

import json
import subprocess
import sys
import tempfile
from argparse import Namespace
from pathlib import Path
from typing import Any

from . import charts, timing
from .harness import experiment, show
from .large_volume import write_raw, zarr_of_raw


SIZES = 64, 256, 2048
"""MiB of voxels."""
LARGE = 2048
"""The size that the goals are for."""
RESIDENT = 64, LARGE
MEMORY = 256
"""MiB, the budget."""
SMALL = 128
"""Voxels along a side of the volume whose images take little but what all images take; and MiB for it."""
OVER = 1.3
RATIO = 1.5
FORMATS = "raw", "zarr"
SCENES = "opaque", "translucent"


def side(size: float) -> int:
    """Voxels along a side of a volume of so many MiB."""
    return int((size * 2**20) ** (1 / 3))


def volume(folder: Path, voxels: int, kind: str, seed: int) -> Path:
    """The file of a volume. It is made if it is not there."""
    raw = folder / f"head_{voxels}.raw"
    path = raw.with_suffix(f".{kind}")
    if kind == "raw" and not raw.exists():
        write_raw(raw, voxels, seed)
    if kind == "zarr" and not path.exists():
        zarr_of_raw(path, raw, voxels)
    return path


def image(path: Path, voxels: int, pixels: int, memory: int | None) -> dict[str, Any]:
    """What `experiments.out_of_core_image` tells of a file. `memory`: MiB; None for all."""
    given = "resident" if memory is None else str(memory * 2**20)
    words = ["-m", "experiments.out_of_core_image", str(path), str(voxels), str(pixels), given]
    ran = subprocess.run(
        [sys.executable, *words], cwd=Path(__file__).parent.parent, capture_output=True, text=True, check=True
    )
    return json.loads(ran.stdout.splitlines()[-1])


def seconds(row: dict[str, Any]) -> float:
    return timing.median(row["seconds"])


def peak(row: dict[str, Any]) -> float:
    return max(row[name]["peak"] for name in SCENES)


def allowed(result: dict[str, Any], kind: str) -> float:
    """The peak that is allowed, MiB."""
    return OVER * result["memory"] + peak(result["constant"][kind])


def compared(result: dict[str, Any], large: str, fitting: str) -> dict[str, Any]:
    """The largest size of both kinds, against the goals. `fitting`: the size in memory that is scaled."""
    found: dict[str, Any] = {}
    for kind in FORMATS:
        of_kind = result["bricks"][kind][large]
        found[kind] = {"peak": peak(of_kind), "allowed": round(allowed(result, kind), 1)}
        for name in SCENES:
            small, whole = (result["resident"][size][name] for size in (fitting, large))
            scaled = seconds(small) * whole["samples"] / small["samples"]
            found[kind][name] = {
                "seconds": seconds(of_kind[name]),
                "in memory": seconds(whole),
                "ratio": round(seconds(of_kind[name]) / seconds(whole), 3),
                "scaled": round(scaled, 4),
                "ratio, scaled": round(seconds(of_kind[name]) / scaled, 3),
                "difference": max(
                    abs(a - b) for a, b in zip(of_kind[name]["mean"], whole["mean"], strict=True)
                ),
            }
    return found


def draw(result: dict[str, Any], path: Path) -> None:
    """Time and memory against the size."""
    figure, (axes,) = charts.panels(1, 3, 12, 3.6)
    sizes, at = result["sizes"], [int(size) for size in result["resident"]]
    for kind, color in zip(FORMATS, ("C0", "C1"), strict=True):
        rows = [result["bricks"][kind][str(size)] for size in sizes]
        for panel, name in zip(axes, SCENES, strict=False):
            panel.plot(sizes, [seconds(row[name]) for row in rows], f"{color}o-", label=f"bricks, {kind}")
        axes[2].plot(sizes, [peak(row) for row in rows], f"{color}o-")
        axes[2].axhline(allowed(result, kind), color=color, linestyle=":")
    for panel, name in zip(axes, SCENES, strict=False):
        panel.plot(at, [seconds(row[name]) for row in result["resident"].values()], "ks--", label="in memory")
        panel.set_title(f"{name}: seconds for an image", fontsize=9)
    axes[2].plot(at, [peak(row) for row in result["resident"].values()], "ks--")
    axes[2].set_title(f"peak memory, MiB; dotted: allowed for {result['memory']} MiB", fontsize=9)
    for panel in axes:
        charts.logarithmic(panel, x=2, y=2)
        panel.set_xlabel("voxels, MiB", fontsize=8)
    axes[0].legend(fontsize=8)
    charts.save(figure, path)


@experiment(
    draw,
    pixels={"type": int, "default": 512, "help": "pixels along a side"},
    sizes={"nargs": "+", "type": int, "default": SIZES, "help": "MiB of voxels"},
    volumes={"type": Path, "metavar": "FOLDER", "help": "keep the volumes here (default: delete them)"},
    memory={"type": int, "default": MEMORY, "help": "MiB, the budget"},
    resident=RESIDENT,
    quick={"pixels": 32, "sizes": [2], "memory": 4, "resident": (2, 2)},
)
def main(chosen: Namespace) -> dict[str, Any]:
    result: dict[str, Any] = {"pixels": chosen.pixels, "sizes": chosen.sizes, "memory": chosen.memory}
    result |= {"constant": {}, "bricks": {kind: {} for kind in FORMATS}, "resident": {}}
    with tempfile.TemporaryDirectory() as temporary:
        folder = chosen.volumes or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)

        def measured(voxels: int, kind: str, memory: int | None) -> dict[str, Any]:
            found = image(volume(folder, voxels, kind, chosen.seed), voxels, chosen.pixels, memory)
            show(found, f"{voxels}³", kind, "in memory" if memory is None else f"{memory} MiB")
            return found

        for kind in FORMATS:
            result["constant"][kind] = measured(SMALL, kind, 8)
        for size in chosen.sizes:
            for kind in FORMATS:
                result["bricks"][kind][str(size)] = measured(side(size), kind, chosen.memory)
            if size in chosen.resident:
                result["resident"][str(size)] = measured(side(size), "raw", None)
    fitting, large = map(str, chosen.resident)
    result["compared"] = compared(result, large, fitting)
    show(result["compared"])
    return result


if __name__ == "__main__":
    main()
