"""What do early ray termination and empty-space skipping save, apart and together?

The table of the KISTI report (2005): a head and an engine under two transfer functions (1: low values
translucent and high ones opaque; 2: all visible values opaque). It gives the speed-up over neither method, as
the median of paired ratios, and beside each time the image's RMSE against a converged one. The goal is 4.55
times for both methods everywhere, the report's best.

The two tables compare ratios of different work, each relative to its own renderer without either method. The
report draws slices on a graphics card and shades each sample by Phong's model; its empty-space skipping
fetches every sample and skips the shading of those that the transfer function hides. Here nothing is shaded,
and skipped samples are not fetched either. A shaded comparison is not measured. The head is another one, and
the report gives neither its transfer functions nor its views.

Steps are one voxel long. Rays end at 1 % of transmittance. Volumes are read from the folder that JAXVOL_DATA
names; without one, the phantoms of a head and an engine stand in.
"""

from argparse import Namespace
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp

import jaxvol as jv

from . import common, timing
from .common import plt
from .scenes import PHANTOM, SCENES, Scene


LEFT = 0.01
NEITHER, ERT, ESS, BOTH = "neither", "ERT", "ESS", "ERT + ESS"
METHODS: dict[str, tuple[jv.Transform, ...]] = {
    NEITHER: (),
    ERT: (jv.EarlyTermination(LEFT),),
    ESS: (jv.SpaceLeaping(),),
    BOTH: (jv.SpaceLeaping(), jv.EarlyTermination(LEFT)),
}
SIZES = (256, 512)
GOAL = 4.55
OPAQUE = 0.95  # opacity of a voxel under the second transfer function
REPORT = {  # speed-ups at 256², 512²
    "head, tf 1": {ERT: (1.25, 1.28), ESS: (1.90, 2.24), BOTH: (2.60, 3.48)},
    "head, tf 2": {ERT: (1.58, 1.66), ESS: (1.90, 2.24), BOTH: (3.14, 4.55)},
    "engine, tf 1": {ERT: (1.01, 1.02), ESS: (2.57, 3.50), BOTH: (2.38, 3.22)},
    "engine, tf 2": {ERT: (1.25, 1.26), ESS: (2.57, 3.50), BOTH: (2.78, 4.08)},
}


def cthead(folder: Path, size: int) -> Scene:
    volume = jv.load(folder / "cthead_256x256x113_uint16le.raw.gz", spacing=(1, 1, 2))
    camera = jv.Camera.looking_at(volume, (-0.5, -1, -0.3), (0, 0, -1), size=(size, size)).zoom(1.4)
    return Scene(volume, jv.preset("ct_skin_bone", clim=(0, 4000)), camera, 1.0)


def engine_phantom(folder: Path | None, size: int, resolution: int = 192) -> Scene:
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


def measure(scene: Scene, repetitions: int) -> dict[str, dict[str, Any]]:
    """Time, speed-up over neither method, and error of a scene's frame under every method."""
    under = {name: jv.March(scene.step, transforms) for name, transforms in METHODS.items()}
    rows = common.compare(scene, under, repetitions)
    for row in rows.values():
        row["speed-up"] = timing.ratio(rows[NEITHER]["all seconds"], row["all seconds"])
    return rows


def draw(result: dict[str, Any], path: Path) -> None:
    """Measured speed-ups as bars, the report's as crosses."""
    figure, axes = plt.subplots(1, len(result["sizes"]), figsize=(11, 3.6), sharey=True, layout="constrained")
    for at, (panel, size) in enumerate(zip(axes, result["sizes"], strict=True)):
        for shift, (method, color) in enumerate(((ERT, "C3"), (ESS, "C0"), (BOTH, "C2"))):
            for number, scene in enumerate(REPORT):
                gain, x = result["scenes"][scene][str(size)][method]["speed-up"], number + 0.26 * (shift - 1)
                first = number == 0
                panel.bar(x, gain["median"], 0.24, color=color, label=method if first else None)
                panel.plot((x, x), (gain["low"], gain["high"]), "k-", linewidth=1)
                reported = REPORT[scene][method][at]
                panel.plot(x, reported, "kx", label="the report" if first and method == BOTH else None)
        panel.axhline(1, color="k", linewidth=0.8)
        panel.axhline(GOAL, color="k", linewidth=0.8, linestyle=":")
        panel.set_xticks(range(len(REPORT)), list(REPORT), fontsize=8)
        panel.set_title(f"{size} x {size} pixels", fontsize=9)
    axes[0].set_ylabel("speed-up over neither", fontsize=9)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    common.save(figure, path)


@common.experiment(
    "kisti",
    "What do early ray termination and empty-space skipping save, apart and together?",
    __doc__,
    repetitions=15,
)
def main(chosen: Namespace) -> common.Answer:
    folder, sizes, more = common.data(), SIZES, {}
    makers = PHANTOMS if folder is None or chosen.quick else REAL
    if chosen.quick:
        sizes, chosen.repetitions, more = (32, 48), 2, {"resolution": 32}

    scenes: dict[str, dict[str, Any]] = {name: {} for name in REPORT}
    for name, make in makers.items():
        for size in sizes:
            scene = make(folder, size, **more)
            for tf, look in (("tf 1", scene), ("tf 2", opaque(scene))):
                rows = scenes[f"{name}, {tf}"][str(size)] = measure(look, chosen.repetitions)
                for method, row in rows.items():
                    gain = row["speed-up"]
                    print(
                        f"{name}, {tf}, {size} x {size}  {method:9} {row['seconds'] * 1e3:7.1f} ms"
                        f"  speed-up {gain['median']:5.2f} [{gain['low']:.2f}, {gain['high']:.2f}]"
                        f"  RMSE {row['rmse']:.5f}",
                        flush=True,
                    )
    gains = [rows[BOTH]["speed-up"]["median"] for of_size in scenes.values() for rows in of_size.values()]
    mean = common.geometric_mean(gains)
    print(f"both over neither: least {min(gains):.2f}, geometric mean {mean:.2f}; the goal is {GOAL}")
    result = {
        "volumes": "phantoms" if makers is PHANTOMS else "cthead and engine",
        "sizes": sizes,
        "repetitions": chosen.repetitions,
        "opacity left": LEFT,
        "goal": GOAL,
        "both, geometric mean": mean,
        "scenes": scenes,
    }
    return result, partial(draw, result)


if __name__ == "__main__":
    main()
