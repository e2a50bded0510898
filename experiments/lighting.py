"""What do photons, templates, occlusion, baking and deferring cost, and what do they gain?

The head phantom under opaque skin, lit from the side: with different numbers of photons per template and of
blended templates, by one template for each pixel or for each material, under hard and soft occlusion, by
baked light, and by deferred light, evaluated once per ray. Each frame is rendered in turn with the unlit
head, and its time is the median of their ratios; beside it stands the image's RMSE against one that blends
many templates under soft occlusion and lights all samples.

The published form is hard occlusion, with all photons that templates hold, on all samples. Lee, Kwon and Shin
report 20-24 frames per second with it and 42-56 without light, which is 2.2 times the time; the goal for
baked light is 1.2 times. Times are also relative to a frame that `lighting.Phong` shades.

Also measured: the error of deferred light under skin that is more and more translucent.
"""

import time
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.ticker import LogLocator, NullFormatter

import jaxvol as jv
from jaxvol.lighting import ConstantLight, Deferred, DirectionalLight, Lighting, Phong, ScattererTemplates
from jaxvol.metrics import rmse

from . import charts, harness, timing
from .harness import experiment, show
from .scenes import SKIN, Scene, skin_head


GOALS = {"templates": 2.2, "baked": 1.2}
FEW = 8  # photons per template, where several are blended and deferred
FLESH = jv.Material(0.5, 0.05, 1.4)
LIGHTS = DirectionalLight((0.9, 0.7, -0.6), (50.0, 50.0, 50.0)), ConstantLight((1.3, 1.3, 1.3))
"""Bright, since flesh that absorbs half at each scattering reflects a sixth of white light from all sides."""
UNLIT = "unlit"
PHOTONS, BLENDED, BAKED = "photons", "templates blended", "baked"
MATERIAL, HARD, HARD_MATERIAL = "one for each material", "hard occlusion", "hard, one for each material"
PHONG = "Phong"
ONCE, BLENDED_ONCE, BAKED_ONCE = "photons, deferred", "templates blended, deferred", "baked, deferred"
STYLES = {
    PHONG: "kx",
    PHOTONS: "C0o-",
    MATERIAL: "C0*",
    BLENDED: "C1s-",
    HARD: "C3D",
    HARD_MATERIAL: "C3*",
    BAKED: "C2^-",
    ONCE: "C4o--",
    BLENDED_ONCE: "C6s--",
    BAKED_ONCE: "C5^--",
}


def march(scene: Scene, seed: int = 0) -> jv.March:
    """A march that renders opaque skin smoothly and takes few samples behind it."""
    how = jv.EmptySpaceJitter(seed), jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination()
    return jv.March(scene.step, how)


def variants(photons: Sequence[int], blended: Sequence[int], baked: Sequence[int]) -> dict[str, list[Any]]:
    """Lightings grouped by the setting that is varied, each with its number."""
    of = partial(ScattererTemplates, FLESH, LIGHTS)
    whole = of().photons
    photons = (*(n for n in photons if n < whole), whole)
    return {
        PHONG: [(0, Phong())],
        PHOTONS: [(n, of(photons=n)) for n in photons],
        MATERIAL: [(whole, of(templates=1))],
        BLENDED: [(n, of(templates=n, blend=True)) for n in blended],
        HARD: [(whole, of(occlusion="hard"))],
        HARD_MATERIAL: [(whole, of(occlusion="hard", templates=1))],
        BAKED: [(n, of(baked=n)) for n in baked],
        ONCE: [(n, Deferred(of(photons=n))) for n in photons],
        BLENDED_ONCE: [(n, Deferred(of(templates=n, blend=True, photons=FEW))) for n in blended],
        BAKED_ONCE: [(n, Deferred(of(baked=n))) for n in baked],
    }


def frame(scene: Scene, lighting: Lighting | None, seed: int) -> jv.Rendering:
    how = march(scene, seed)
    return jv.render(scene.volume, scene.transfer, scene.camera, how, lighting=lighting, outputs="rgba")


def measure(scene: Scene, lightings: dict[str, list[Any]], many: int, repetitions: int, seed: int) -> Any:
    """Time and error of each lighting, one at a time, since a volume keeps the light of one baking only."""
    truth = frame(scene, ScattererTemplates(FLESH, LIGHTS, templates=many, blend=True), seed).rgba
    beside = {UNLIT: None, PHONG: Phong()}
    found: dict[str, list[dict[str, Any]]] = {}
    for kind, each in lightings.items():
        found[kind] = []
        for number, lighting in each:
            programs = {**beside, kind: lighting}
            seconds = timing.interleaved(
                {n: lambda how=how: frame(scene, how, seed).rgba for n, how in programs.items()}, repetitions
            )
            image = frame(scene, lighting, seed).rgba
            row = {"number": number, **harness.row(seconds[kind], seconds[UNLIT], rmse(image, truth))}
            row["ratio to Phong"] = timing.ratio(seconds[kind], seconds[PHONG])
            if kind == BAKED:
                row["seconds to bake"] = round(baking(scene, lighting, seed) - row["seconds"], 4)
            found[kind].append(row)
            show(row, kind)
    return found


def held() -> dict[str, Any]:
    """Number of photons that the templates hold, and that their arrays have room for."""
    lighting = ScattererTemplates(FLESH, LIGHTS)
    intensity = np.asarray(jax.jit(lambda: lighting.simulated(blend=False))().intensity)
    each = np.sum(intensity > 0, axis=-1)
    return {"fewest": int(each.min()), "most": int(each.max()), "room": intensity.shape[-1]}


def baking(scene: Scene, lighting: ScattererTemplates, seed: int) -> float:
    """Seconds of a frame that must bake its light: dimmer than before, so that only the program is reused."""
    dimmed = eqx.tree_at(lambda how: how.lights[0].irradiance, lighting, replace_fn=lambda e: e * 0.99)
    start = time.perf_counter()
    jax.block_until_ready(frame(scene, dimmed, seed).rgba)
    return time.perf_counter() - start


def deferring(scene: Scene, thinned: Sequence[float], seed: int) -> list[dict[str, float]]:
    """Errors of deferred light, and of no light, against light on all samples, with every extinction
    multiplied by each of the factors in `thinned`."""
    each, rows = ScattererTemplates(FLESH, LIGHTS, photons=8), []
    for times in thinned:
        thin = replace(scene.transfer, extinction=times * scene.transfer.extinction)
        under = scene._replace(transfer=thin)
        truth, once, unlit = (frame(under, how, seed).rgba for how in (each, Deferred(each), None))
        errors = {"rmse": float(rmse(once, truth)), "rmse of no light": float(rmse(unlit, truth))}
        rows.append({"extinction": times, "opacity": float(np.mean(truth[..., 3])), **errors})
    return rows


def pictures(templates: int, seed: int, path: Path, size: int, resolution: int) -> None:
    """Save the head without light and with it, side by side, under skin that nothing shows through: where
    bone lies just below the surface, it has the colour of skin, too."""
    scene = skin_head(size, resolution)
    foot, skin = scene.transfer.colors[0], scene.transfer.colors[1]
    colors = jnp.stack([(foot + skin) / 2, *[skin] * (len(SKIN) - 1)])  # the foot draws the outlines
    opaque = replace(scene.transfer, colors=colors, extinction=OPAQUE * scene.transfer.extinction)
    scene = scene._replace(transfer=opaque, step=scene.step / 4)
    lit = ScattererTemplates(FLESH, LIGHTS, templates=templates, blend=True)
    figure, (axes,) = charts.panels(1, 2, 2 * size / 90, size / 90 + 0.4)
    titles = {
        "unlit: colours of the transfer function": None,
        "lit from the left, by scatterer templates": lit,
    }
    for panel, (title, lighting) in zip(axes, titles.items(), strict=True):
        panel.imshow(jv.to_srgb(frame(scene, lighting, seed).image((0.0, 0.0, 0.0))))
        panel.set_title(title, fontsize=11)
        panel.axis("off")
    charts.save(figure, path)


OPAQUE = 10.0
"""Times the extinction of the skin that is measured, through which bones shine, in the picture."""


ASIDE = {
    ("photons, deferred", 4): (-9, -9),
    ("photons, deferred", 8): (5, 1),
    ("baked, deferred", 128): (-18, 3),
    ("one for each material", 34): (-16, -9),
}
"""Where numbers would overlap."""


def draw(result: dict[str, Any], path: Path) -> None:
    figure, ((cost, deferred),) = charts.panels(1, 2, 11, 5)
    for kind, rows in result["frames"].items():
        style = STYLES[kind]
        error, ratio = [row["rmse"] for row in rows], [row["ratio"]["median"] for row in rows]
        cost.plot(error, ratio, style, label=kind)
        for row, x, y in zip(rows, error, ratio, strict=True):
            if row["number"]:
                shift = ASIDE.get((kind, row["number"]), (4, 4))
                cost.annotate(str(row["number"]), (x, y), shift, textcoords="offset points", fontsize=7)
    for name, goal in GOALS.items():
        cost.axhline(goal, color="k", linewidth=0.8, linestyle=":")
        how = {"fontsize": 7, "ha": "right", "va": "bottom", "transform": cost.get_yaxis_transform()}
        cost.text(1, goal, f"goal, {name}", **how)
    cost.set(xscale="log", yscale="log", xlabel="RMSE against many templates blended")
    cost.set_ylabel("time / that of an unlit frame")
    cost.set_title("numbers: photons of a template, templates blended, or nodes baked", fontsize=9)
    for axis, digits in ((cost.xaxis, (1, 3)), (cost.yaxis, (1, 2, 5))):
        axis.set_major_locator(LogLocator(subs=digits))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    figure.legend(*cost.get_legend_handles_labels(), loc="outside upper center", ncols=5, fontsize=8)

    rows = result["deferring"]
    for key, label, style in (("rmse", "deferred", "C4o--"), ("rmse of no light", "no light", "ko-")):
        deferred.plot([row["extinction"] for row in rows], [row[key] for row in rows], style, label=label)
    charts.logarithmic(deferred, x=10, y=10)
    deferred.set(xlabel="extinction, times that of opaque skin", ylabel="RMSE against light on all samples")
    deferred.set_title("light once for each ray, from translucent to opaque skin", fontsize=9)
    deferred.legend(fontsize=8)
    charts.save(figure, path)


@experiment(
    draw,
    repetitions=5,
    size=256,
    resolution=96,
    photons=(1, 4, 8, 16),
    blended=(1, 2, 4, 8),
    baked=(32, 64, 128),
    many={"type": int, "default": 32, "help": "templates blended in the reference"},
    thinned=(1.0, 0.3, 0.1, 0.03, 0.01),
    picture=(512, 192),
    quick={
        "size": 24,
        "resolution": 24,
        "repetitions": 2,
        "photons": (2,),
        "blended": (2,),
        "baked": (16,),
        "many": 4,
        "thinned": (1.0, 0.1),
        "picture": (48, 24),
    },
)
def main(chosen: Namespace) -> dict[str, Any]:
    scene = skin_head(chosen.size, chosen.resolution)
    lightings = variants(chosen.photons, chosen.blended, chosen.baked)
    result = {
        "goals": GOALS,
        "image": [chosen.size, chosen.size],
        "resolution": chosen.resolution,
        "repetitions": chosen.repetitions,
        "templates blended in the reference": chosen.many,
        "photons of a template": held(),
        "frames": measure(scene, lightings, chosen.many, chosen.repetitions, chosen.seed),
        "deferring": deferring(scene, chosen.thinned, chosen.seed),
    }
    pictures(chosen.many // 2, chosen.seed, chosen.output / "lit.png", *chosen.picture)
    return result
