"""What do early ray termination and empty-space skipping save, apart and together, without shading and with?

The table of the KISTI report (2005): a head and an engine under two transfer functions (1: low values
translucent and high ones opaque; 2: all visible values opaque). It gives the speed-up over neither method, as
the median of paired ratios, and beside each time the image's RMSE against a converged one. The goal is the
report's best, 4.55, everywhere without shading, and the report's own speed-up in each case with it.

The report's empty-space skipping fetches every sample and skips the shading of those that are transparent:
"shading skipped" here; ours does not fetch them either. It tests early termination every 16 slices; so
segments of 1, 4, 8 and 16 samples, between which ended rays are looked for, are measured, too. Its transfer
functions are of value and gradient, and not printed: ours are by value, and once by both. Steps are one voxel
long. Without the folder JAXVOL_DATA of real volumes, phantoms stand in.
"""

import math
from argparse import Namespace
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol.engine.image import render_scene
from jaxvol.engine.tiling import Tiling
from jaxvol.lighting import Lighting, Phong
from jaxvol.metrics import rmse
from jaxvol.ray import Scene as EngineScene

from . import charts, harness, marches, timing
from .harness import experiment
from .scenes import CT_HEAD, PHANTOM, SCENES, Scene


LEFT = 0.01
NEITHER, ERT, ESS, BOTH = "neither", "ERT", "ESS", "ERT + ESS"
METHODS: dict[str, tuple[jv.Transform, ...]] = {
    NEITHER: (),
    ERT: (jv.EarlyTermination(LEFT),),
    ESS: (jv.SpaceLeaping(),),
    BOTH: (jv.SpaceLeaping(), jv.EarlyTermination(LEFT)),
}
SKIPPED, BOTH_SKIPPED = "ESS, shading skipped", "ERT + ESS, shading skipped"
GOAL = 4.55
OPAQUE = 0.95  # opacity of a voxel under the second transfer function
REPORT = {  # speed-ups at 256², 512²
    "head, tf 1": {ERT: (1.25, 1.28), ESS: (1.90, 2.24), BOTH: (2.60, 3.48)},
    "head, tf 2": {ERT: (1.58, 1.66), ESS: (1.90, 2.24), BOTH: (3.14, 4.55)},
    "engine, tf 1": {ERT: (1.01, 1.02), ESS: (2.57, 3.50), BOTH: (2.38, 3.22)},
    "engine, tf 2": {ERT: (1.25, 1.26), ESS: (2.57, 3.50), BOTH: (2.78, 4.08)},
}


def cthead(folder: Path, size: int, resolution: int) -> Scene:
    volume = jv.load(folder / CT_HEAD, spacing=(1, 1, 2))
    camera = jv.Camera.looking_at(volume, (-0.5, -1, -0.3), (0, 0, -1), size=(size, size)).zoom(1.4)
    return Scene(volume, jv.preset("ct_skin_bone", clim=(0, 4000)), camera, 1.0)


def engine_phantom(folder: Path | None, size: int, resolution: int) -> Scene:
    volume = jv.phantom("engine", resolution)
    camera = jv.Camera.looking_at(volume, (0.5, -1, 0.6), size=(size, size)).zoom(1.4)
    return Scene(volume, jv.preset("engine", unit_distance=0.01), camera, float(volume.spacing[0]))


REAL: dict[str, Callable[..., Scene]] = {"head": cthead, "engine": SCENES["engine"]}
PHANTOMS: dict[str, Callable[..., Scene]] = {"head": SCENES[PHANTOM], "engine": engine_phantom}


def opaque(scene: Scene) -> Scene:
    """The scene with everything that is visible made opaque."""
    values, colors, extinction = scene.transfer.values, scene.transfer.colors, scene.transfer.extinction
    solid = -jnp.log1p(-OPAQUE) / scene.step
    return scene._replace(transfer=jv.TransferFunction(values, colors, jnp.where(extinction > 0, solid, 0)))


def by_gradient(scene: Scene) -> Scene:
    """The scene under a transfer function of two dimensions, like the report's: what does not change shows
    nothing, and what changes by a tenth of all values from voxel to voxel as much as before."""
    given, count = scene.transfer, len(scene.transfer.values)
    steep = float(np.ptp(np.asarray(given.values))) / 10 / float(jnp.min(scene.volume.spacing))
    extinction = jnp.stack([jnp.zeros(count), given.extinction], axis=1)
    colors = jnp.repeat(given.colors[:, None], 2, axis=1)
    return scene._replace(transfer=jv.TransferFunction2D(given.values, [0, steep], colors, extinction))


class VisiblePhong(Phong):
    """Gathers visible samples to shade them, as lightings do that cost more: the report's empty-space
    skipping."""

    def __init__(self):
        super().__init__()

    @property
    def farthest_read(self) -> float:
        return math.inf


SHADED: dict[str, tuple[tuple[jv.Transform, ...], Lighting]] = {
    **{name: (transforms, Phong()) for name, transforms in METHODS.items()},
    SKIPPED: (METHODS[NEITHER], VisiblePhong()),
    BOTH_SKIPPED: (METHODS[ERT], VisiblePhong()),
}
UNSHADED = {name: (transforms, None) for name, transforms in METHODS.items()}
BY_GRADIENT = "shaded, by value and gradient"
PARTS: dict[str, dict[str, Any]] = {"scenes": UNSHADED, "shaded": SHADED, BY_GRADIENT: SHADED}
"""Of the record: without shading, with it, and with it under transfer functions of two dimensions."""


def measure(scene: Scene, under: dict[str, Any], repetitions: int) -> dict[str, dict[str, Any]]:
    """Time, speed-up over neither method, and error of a scene's frame under every method."""

    def frame(march: jv.March, lighting: Lighting | None) -> Any:
        return jv.render(*scene[:3], march, lighting=lighting, outputs="rgba").rgba

    drawn = {n: partial(frame, jv.March(scene.step, how), light) for n, (how, light) in under.items()}
    seconds = timing.interleaved(drawn, repetitions)
    truth = frame(marches.converged(scene.step, harness.FINER), under[NEITHER][1])
    rows = {n: harness.row(seconds[n], seconds[NEITHER], rmse(drawn[n](), truth)) for n in drawn}
    for name, row in rows.items():
        row["speed-up"] = timing.ratio(seconds[NEITHER], seconds[name])
    return rows


def tested_every(scene: Scene, samples: int, repetitions: int) -> dict[str, Any]:
    """Time of a shaded frame whose rays are looked at between segments of so many samples, with and without
    early termination, and what this gains."""

    def frame(method: str) -> Any:
        whole = EngineScene(*scene[:3], jv.March(scene.step, METHODS[method]), lighting=Phong())
        return render_scene(whole, "rgba", "replay", Tiling(cells=samples)).rgba

    seconds = timing.interleaved({name: partial(frame, name) for name in (NEITHER, ERT)}, repetitions)
    medians = {name: timing.median(all_) for name, all_ in seconds.items()}
    return {"seconds": medians, "speed-up": timing.ratio(seconds[NEITHER], seconds[ERT])}


def draw(result: dict[str, Any]) -> Any:
    """Measured speed-ups as bars, the report's as crosses: without shading above, with it below."""
    sizes = result["sizes"]
    figure, axes = charts.panels(2, len(sizes), 11, 6.4, sharex=True, sharey="row")
    bars = {ERT: "C3", SKIPPED: "C9", ESS: "C0", BOTH_SKIPPED: "C8", BOTH: "C2"}
    reported = {SKIPPED: ESS, BOTH_SKIPPED: BOTH}
    for row, (part, what) in zip(axes, (("scenes", "unshaded"), ("shaded", "shaded")), strict=True):
        for at, (panel, size) in enumerate(zip(row, sizes, strict=True)):
            cases = [result[part][case][str(size)] for case in REPORT]
            shown = [method for method in bars if method in cases[0]]
            width = 0.8 / len(shown)
            for shift, method in enumerate(shown):
                x = [number + width * (shift - (len(shown) - 1) / 2) for number in range(len(REPORT))]
                gains = [rows[method]["speed-up"] for rows in cases]
                panel.bar(x, [g["median"] for g in gains], 0.92 * width, color=bars[method], label=method)
                panel.vlines(x, [g["low"] for g in gains], [g["high"] for g in gains], "k", linewidth=1)
                best = [report[reported.get(method, method)][at] for report in REPORT.values()]
                panel.plot(x, best, "kx", label="the report" if method == BOTH else None)
            panel.axhline(1, color="k", linewidth=0.8)
            panel.set_xticks(range(len(REPORT)), list(REPORT))
            panel.set_title(f"{size} x {size} pixels, {what}")
        row[0].set_ylabel("speed-up over neither")
    for panel in axes[0]:
        panel.axhline(GOAL, color="k", linewidth=0.8, linestyle=":")
    figure.suptitle(
        "Early ray termination (ERT) and empty-space skipping (ESS) under two transfer functions (tf); "
        "thin bars: 95 % intervals; dotted: the goal"
    )
    charts.legend_below(figure, axes[1, 0], 6)
    return figure


@experiment(
    repetitions=9,
    resolution=192,
    sizes=(256, 512),
    every=(1, 4, 8, 16),
    quick={"sizes": (32,), "every": (1, 8), "repetitions": 2, "resolution": 32},
)
def main(chosen: Namespace) -> dict[str, Any]:
    folder = harness.data()
    makers = PHANTOMS if folder is None or chosen.quick else REAL
    measured: dict[str, dict[str, Any]] = {part: {name: {} for name in REPORT} for part in PARTS}
    every: dict[str, dict[str, Any]] = {}
    for name, make in makers.items():
        for size in chosen.sizes:
            scene = make(folder, size, chosen.resolution)
            for tf, seen in (("tf 1", scene), ("tf 2", opaque(scene))):
                case = f"{name}, {tf}"
                for part, under in PARTS.items():
                    shown = by_gradient(seen) if part == BY_GRADIENT else seen
                    measured[part][case][str(size)] = measure(shown, under, chosen.repetitions)
                if size == chosen.sizes[-1]:
                    every[case] = {str(n): tested_every(seen, n, chosen.repetitions) for n in chosen.every}
    return {
        "volumes": "phantoms" if makers is PHANTOMS else "cthead and engine",
        "sizes": chosen.sizes,
        "goal": GOAL,
        **measured,
        "ended rays are looked for every so many samples": every,
    }
