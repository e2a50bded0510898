"""What do bricks cost in an ultrasound scan, by how it is split, and does overlap save time?

The scan of Kim, Kwon and Shin 2008 scaled down to a quarter along each axis, in float32, on disk: a phantom
of a fetus, sampled by a probe of the paper's proportions (`bricks_paper.probe`). `render_bricks` renders it
under each split of the paper's Table 1 by each of its methods: `"overlap"`, `"reload"`, and `"naive"`, which
is wrong. They run in turn, and so does `render` of the whole volume. Beside the times stand the numbers of
loads, and the voxels read over those of the volume. These include what is read around each brick for
interpolation, and for the cells of a ray that are taken at a time. The best split of the paper is measured
from several sides: whether a ray comes back to a brick depends on where it comes from.

Before each frame the file is dropped from the system's page cache, where the system can do that, so that
frames read from the disk. A split into many bricks is timed once. `--only` measures some splits again and
keeps what the record says of the others, with the commit that they are of.
"""

import os
import tempfile
from argparse import Namespace
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.ticker import NullFormatter

import jaxvol as jv
from jaxvol.bricks import VoxelSource, overlap_of, share, source_of

from . import bricks_paper, charts, record, timing
from .bricks_paper import BEST, TABLE, Split
from .harness import experiment, recorded, show, some_of
from .naive_bricks import each_at_once
from .scan_conversion import BODY


METHODS: dict[str, Any] = {"overlap": "overlap", "reload": "reload", "naive": each_at_once}
SCALE = 0.17
"""Of the probe, so that the fetus lies within the scan."""
MANY = 100
"""From so many bricks on, a split is timed once, after a warm frame."""

EYES: dict[str, tuple[float, float, float]] = {
    "across": (0, -290, 40),
    "along": (290, 0, 100),
    "from below": (0, -20, 410),
    "from the probe": (0, -20, -200),
}
"""Where the camera is, mm. Across and along the fan, rays pass the curved faces at small angles."""
VIEW = "across"
FROM = f"{','.join(map(str, BEST))} from"
WHOLE = "whole"


class Scan(NamedTuple):
    """A scan on disk."""

    path: Path
    source: VoxelSource
    probe: jv.ToroidalMap
    transfer: jv.TransferFunction

    @property
    def step(self) -> float:
        """Of rays, in mm: two samples of a beam."""
        first, last = self.probe.gamma_range
        return 2 * float(last - first) / (self.source.shape[2] - 1)

    @property
    def march(self) -> jv.March:
        return jv.March(self.step, (self.probe,))


def phantom(
    resolution: int, dtype: str = "float32", *, speckle: bool = True
) -> tuple[jv.Volume, jv.ToroidalMap]:
    """The fetus as the paper's probe would see it, with so many samples along a beam."""
    x, y, z = (max(8, n * resolution // bricks_paper.SHAPE[2]) for n in bricks_paper.SHAPE)
    volume, probe = jv.toroidal_phantom("fetus", (x, y, z), probe=bricks_paper.probe(SCALE), speckle=speckle)
    return jv.Volume(np.asarray(volume.data).astype(dtype)), probe


def camera(view: str, size: int) -> jv.Camera:
    return jv.Camera(
        EYES[view], (0, 0, 110), (0, 0, 1) if view == "along" else (1, 0, 0), 36.0, size=(size,) * 2
    )


def stored(folder: Path, resolution: int) -> Scan:
    volume, probe = phantom(resolution)
    path = folder / "fetus.npy"
    np.save(path, np.asarray(volume.data))
    return Scan(path, source_of(path), probe, jv.TransferFunction.from_points(BODY))


def forget(path: Path) -> None:
    """Drops a file from the system's page cache, where that is possible."""
    if not hasattr(os, "posix_fadvise"):
        return
    with path.open("rb") as file:
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def frame(scan: Scan, view: jv.Camera, split: Split, method: str) -> jv.Rendering:
    forget(scan.path)
    how = {"bricks": split, "method": METHODS[method], "outputs": "rgba"}
    return jv.render_bricks(scan.source, scan.transfer, view, scan.march, **how)


def whole(scan: Scan, view: jv.Camera) -> jv.Rendering:
    forget(scan.path)
    volume = jv.Volume(np.load(scan.path))
    return jv.render(volume, scan.transfer, view, scan.march, outputs="rgba")


def compared(
    scan: Scan, view: jv.Camera, split: Split, repetitions: int, truth: np.ndarray
) -> dict[str, dict[str, Any]]:
    """Time, reads and error of each method, and time of the volume rendered whole."""
    found: dict[str, jv.Rendering] = {}

    def run(method: str) -> Any:
        found[method] = frame(scan, view, split, method)
        return found[method].rgba

    programs: dict[str, Callable[[], Any]] = {method: partial(run, method) for method in METHODS}
    programs[WHOLE] = lambda: whole(scan, view).rgba
    seconds = timing.interleaved(programs, repetitions)
    voxels = np.prod(scan.source.shape) * np.dtype(np.float32).itemsize
    rows: dict[str, dict[str, Any]] = {WHOLE: {"seconds": timing.median(seconds[WHOLE])}}
    for method in METHODS:
        report = found[method].bricks
        assert report is not None
        rows[method] = {
            "seconds": timing.median(seconds[method]),
            "ratio to overlap": timing.ratio(seconds[method], seconds["overlap"]),
            "needed": report.needed,
            "loads": report.loads,
            "read, times the volume": round(float(report.bytes_read / voxels), 4),
            "stored": report.stored,
            "held, MiB": round(report.bytes_held / 2**20, 3),
            "largest error": float(np.max(np.abs(np.asarray(found[method].rgba) - truth))),
        }
    return rows


def named(split: Split) -> str:
    return ",".join(map(str, split))


def draw(result: dict[str, Any], path: Path) -> None:
    """The paper's rates and ours, against overlap and against loads."""
    figure, axes = charts.panels(2, 2, 10, 7)
    rows = result["splits"]
    styles = {"overlap": "C0o", "reload": "C1s", "naive": "C3x"}
    paper = {name: row["paper"] for name, row in rows.items() if "paper" in row}
    for column, key in enumerate(("overlap", "loads")):
        theirs, ours = axes[:, column]
        for method, of in (("overlap", "proposed"), ("reload", "reload")):
            at = [p["overlap"] if key == "overlap" else rows[n]["bricks"] for n, p in paper.items()]
            theirs.plot(at, [p[of] for p in paper.values()], styles[method], label=f"paper, {of}", alpha=0.7)
        theirs.margins(x=0.12)  # room for names
        for name, p in paper.items():
            if p["overlap"] < 3 and p["proposed"] < 10:
                x = p["overlap"] if key == "overlap" else rows[name]["bricks"]
                theirs.annotate(name, (x, p["proposed"]), (4, 3), textcoords="offset points", fontsize=7)
        for method, style in styles.items():
            at = [row["formula"] if key == "overlap" else row[method]["loads"] for row in rows.values()]
            rates = [1 / row[method]["seconds"] for row in rows.values()]
            ours.plot(at, rates, style, label=method, alpha=0.7)
        whole_ = [1 / row[WHOLE]["seconds"] for row in rows.values()]
        ours.axhline(float(np.median(whole_)), color="0.5", linestyle="--", label="the whole volume at once")
        for panel in (theirs, ours):
            panel.set_yscale("log")
            panel.set_ylabel("frames per second", fontsize=8)
            panel.legend(fontsize=7)
            panel.yaxis.set_major_formatter("{x:g}")
            panel.yaxis.set_minor_formatter(NullFormatter())
            if key == "loads":
                panel.set_xscale("log", base=2)
                panel.xaxis.set_major_formatter("{x:g}")
        of_paper = "printed overlap, %" if key == "overlap" else "number of bricks"
        theirs.set_xlabel(f"{of_paper} (names: bricks along β, σ and γ)", fontsize=8)
        ours.set_xlabel("overlap by the formula, %" if key == "overlap" else "bricks read", fontsize=8)
        if key == "overlap":
            for panel in (theirs, ours):
                panel.axvline(3, color="0.7", linewidth=0.8)
    axes[0, 0].set_title("the paper's rates; its rule: overlap below 3 % (grey line)", fontsize=9)
    axes[0, 1].set_title("the paper's rates; named: slow although below 3 %", fontsize=9)
    for panel in axes[1]:
        panel.set_title("measured here", fontsize=9)
    charts.save(figure, path)


@experiment(
    draw,
    repetitions=5,
    size=64,
    resolution=320,
    only=some_of([named(split) for split in TABLE], "SPLIT"),
    quick={"size": 16, "resolution": 48, "repetitions": 1, "only": ["2,1,2"]},
)
def main(chosen: Namespace) -> dict[str, Any]:
    splits = {name: split for split in TABLE if (name := named(split)) in chosen.only}
    rows: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        scan = stored(Path(folder), chosen.resolution)

        def measure(split: Split, view: str) -> dict[str, Any]:
            repetitions = chosen.repetitions if np.prod(split) < MANY else 1
            seen = camera(view, chosen.size)
            found = compared(scan, seen, split, repetitions, np.asarray(whole(scan, seen).rgba))
            show(found, named(split), view)
            return {"bricks": int(np.prod(split)), "repetitions": repetitions, **found}

        for name, split in splits.items():
            overlap = overlap_of(scan.probe, bricks_paper.grid(scan.source.shape, split))
            rows[name] = {
                "paper": TABLE[split]._asdict(),
                "formula": round(bricks_paper.overlap(split), 3),
                "formula, of these voxels": round(100 * share(overlap, scan.source.shape[2]), 3),
                **measure(split, VIEW),
            }
        views = {view: measure(BEST, view) for view in EYES if view != VIEW and BEST in splits.values()}
        about = {
            "image": [chosen.size] * 2,
            "voxels": list(scan.source.shape),
            "step, mm": round(scan.step, 5),
        }
    others = [name for name in map(named, TABLE) if name not in rows]
    rows |= recorded(chosen, "splits", others, about)
    if not views and not chosen.quick and (path := chosen.output / "bricks.json").is_file():
        views = record.read(path)["result"][FROM]
    return {
        **about,
        "view": VIEW,
        "splits": {name: rows[name] for name in map(named, TABLE) if name in rows},
        FROM: views,
    }


if __name__ == "__main__":
    main()
