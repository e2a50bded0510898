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
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from . import common
from .common import plt
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
    return float(np.median(row["seconds"]))


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
                "difference": float(np.max(np.abs(np.subtract(of_kind[name]["mean"], whole["mean"])))),
            }
    return found


def draw(result: dict[str, Any], path: Path) -> None:
    """Time and memory against the size."""
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
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
        panel.set_xscale("log", base=2)
        panel.set_yscale("log", base=2)
        panel.set_xlabel("voxels, MiB", fontsize=8)
        panel.xaxis.set_major_formatter("{x:g}")
        panel.yaxis.set_major_formatter("{x:g}")
    axes[0].legend(fontsize=8)
    common.save(figure, path)


@common.experiment(
    "out_of_core",
    "How much memory and time does an image take of a volume that does not fit into the memory given?",
    __doc__,
    pixels={"type": int, "default": 512, "help": "pixels along a side"},
    sizes={"nargs": "+", "type": int, "default": SIZES, "help": "MiB of voxels"},
    volumes={"type": Path, "metavar": "FOLDER", "help": "keep the volumes here (default: delete them)"},
)
def main(chosen: Namespace) -> common.Answer:
    sizes, memory, resident = list(chosen.sizes), MEMORY, RESIDENT
    if chosen.quick:
        chosen.pixels, sizes, memory, resident = 32, [2], 4, (2, 2)
    result: dict[str, Any] = {"pixels": chosen.pixels, "sizes": sizes, "memory": memory}
    bricks: dict[str, dict[str, Any]] = {kind: {} for kind in FORMATS}
    constant, whole = {}, {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = chosen.volumes or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for kind in FORMATS:
            small = image(volume(folder, SMALL, kind, chosen.seed), SMALL, chosen.pixels, 8)
            constant[kind] = small
            said(f"constant, {kind}", small)
        for size in sizes:
            voxels = side(size)
            for kind in FORMATS:
                path = volume(folder, voxels, kind, chosen.seed)
                bricks[kind][str(size)] = image(path, voxels, chosen.pixels, memory)
                said(f"{size} MiB, {kind}", bricks[kind][str(size)])
            if size in resident:
                raw = volume(folder, voxels, "raw", chosen.seed)
                whole[str(size)] = image(raw, voxels, chosen.pixels, None)
                said(f"{size} MiB, in memory", whole[str(size)])
    result |= {"constant": constant, "bricks": bricks, "resident": whole}
    result["compared"] = compared(result, str(resident[1]), str(resident[0]))
    print(json.dumps(result["compared"], indent=1))
    return result, partial(draw, result)


def said(what: str, found: dict[str, Any]) -> None:
    for name in SCENES:
        row = found[name]
        print(
            f"{what:28} {name:12} {row['seconds']} s, first {row['first seconds']} s, {row['peak']} MiB",
            flush=True,
        )


if __name__ == "__main__":
    main()
