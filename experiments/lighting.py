"""What do photons, templates, occlusion, baking and deferring cost, and what do they gain?

The head phantom under opaque skin, lit from the side: with different numbers of photons per template and of
blended templates, by one template for each pixel or for each material, under hard and soft occlusion, by
baked light, and by deferred light, evaluated once per ray. Each frame is rendered in turn with the unlit
head, and its time is the median of their ratios; beside it stands the image's RMSE against one that blends
many templates under soft occlusion and lights all samples. Images by one template for each pixel are also
filtered against their noise (`light_filter`), with the time that this takes.

The published form is hard occlusion, with all photons that templates hold, on all samples. Lee, Kwon and Shin
report 20-24 frames per second with it and 42-56 without light, which is 2.2 times the time; the goal for
baked light is 1.2 times. Times are also relative to a frame that `lighting.Phong` shades.

Also measured: the error of deferred light under skin that is more and more translucent; the noise of a flat
face, seen and lit obliquely, against the number of templates blended; and the energy of a template against
the material's opacity, for the conserving form and the printed one.
"""

import time
from argparse import Namespace
from collections.abc import Callable, Sequence
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
from jaxvol.lighting import (
    ConstantLight,
    Deferred,
    DirectionalLight,
    Lighting,
    Phong,
    ScattererTemplate,
    ScattererTemplates,
    scatterer_templates,
)
from jaxvol.metrics import rmse

from . import common, timing
from .common import plt
from .light_filter import filtered
from .printed_templates import printed_templates
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
ENERGIES: dict[str, Callable[..., ScattererTemplate]] = {
    "conserving": scatterer_templates,
    "printed": printed_templates,
    "printed, without its factors of flight": partial(printed_templates, flights=False),
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
    beside = {UNLIT: None}
    if PHONG in lightings:
        [(_, beside[PHONG])] = lightings[PHONG]
    found: dict[str, list[dict[str, Any]]] = {}
    for kind, each in lightings.items():
        found[kind] = []
        for number, lighting in each:
            programs = {**beside, kind: lighting}
            seconds = timing.interleaved(
                {n: lambda how=how: frame(scene, how, seed).rgba for n, how in programs.items()}, repetitions
            )
            image = frame(scene, lighting, seed).rgba
            row = {"number": number, **common.row(seconds[kind], seconds[UNLIT], rmse(image, truth))}
            if PHONG in beside:
                row["ratio to Phong"] = timing.ratio(seconds[kind], seconds[PHONG])
            if kind == BAKED:
                row["seconds to bake"] = round(baking(scene, lighting, seed) - row["seconds"], 4)
            if kind in (PHOTONS, HARD):
                row["filtered"] = filtering(scene, image, truth, seed)
            found[kind].append(row)
            print(
                f"{kind:27} {number:4} {row['seconds']:8.3f} s  {row['ratio']['median']:7.2f} x unlit"
                f"  RMSE {row['rmse']:.5f} {row.get('filtered', '')}",
                flush=True,
            )
    return found


def filtering(scene: Scene, image: Any, truth: Any, seed: int) -> dict[str, float]:
    """Error of the image after it is filtered, and the time that this takes, without the unlit frame."""
    how = march(scene, seed)
    unlit = jv.render(scene.volume, scene.transfer, scene.camera, how)
    start = time.perf_counter()
    smooth = filtered(np.asarray(image), unlit, float(scene.volume.spacing[0]))
    return {"rmse": float(rmse(smooth, truth)), "seconds": round(time.perf_counter() - start, 4)}


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
    each = ScattererTemplates(FLESH, LIGHTS, photons=8)
    rows = []
    for times in thinned:
        thin = eqx.tree_at(lambda t: t.extinction, scene.transfer, replace_fn=lambda e, by=times: e * by)
        under = scene._replace(transfer=thin)
        truth, once, unlit = (frame(under, how, seed).rgba for how in (each, Deferred(each), None))
        errors = {"rmse": float(rmse(once, truth)), "rmse of no light": float(rmse(unlit, truth))}
        rows.append({"extinction": times, "opacity": float(np.mean(truth[..., 3])), **errors})
    return rows


def noise(counts: Sequence[int], trials: int, seed: int) -> dict[str, Any]:
    """Standard deviation of brightness between sets of templates, over its mean, on the face of a cube."""
    volume = jv.phantom("constant", 16)
    transfer = jv.TransferFunction([0.0, 1.0], [[0.7, 0.5, 0.4]] * 2, [40.0, 40.0])
    step = 0.01
    size = 16
    camera = jv.Camera.looking_at(volume, (0, -1, 0), size=(size, size)).zoom(6)
    most = max(counts)
    ways = jv.March(step, (jv.AlphaCorrection(), jv.EarlyTermination()))

    def face(templates: ScattererTemplate, blend: bool) -> np.ndarray:
        lighting = ScattererTemplates(FLESH, LIGHTS, given=templates, blend=blend)
        return np.asarray(jv.render(volume, transfer, camera, ways, lighting=lighting).rgba[..., 0])

    drawn = [scatterer_templates(FLESH, seed + trial, count=most) for trial in range(trials)]
    rows = []
    for count in counts:
        # the others are dark, so that one program serves any number of templates
        some = jnp.where(jnp.arange(most)[None, :, None] < count, most / count, 0.0)
        means = [face(replace(t, intensity=t.intensity * some), True).mean() for t in drawn]
        rows.append({"templates": count, "deviation": float(np.std(means, ddof=1) / np.mean(means))})
    chosen = face(drawn[0], False)
    return {"blended": rows, "one for each pixel": float(chosen.std() / chosen.mean()), "trials": trials}


def energies(opacities: Sequence[float], seed: int, count: int = 8) -> dict[str, list[float]]:
    """Mean energy of templates, for each form and opacity."""
    found: dict[str, list[float]] = {}
    for name, simulate in ENERGIES.items():
        several = (simulate(jv.Material(a, 1.0, 1.4), seed, count=count) for a in opacities)
        found[name] = [float(t.intensity.sum(-1).mean()) for t in several]
    return found


def pictures(templates: int, seed: int, path: Path, size: int, resolution: int) -> None:
    """Save the head without light and with it, side by side, under skin that nothing shows through: where
    bone lies just below the surface, it has the colour of skin, too."""
    scene = skin_head(size, resolution)
    foot, skin = scene.transfer.colors[0], scene.transfer.colors[1]
    colors = jnp.stack([(foot + skin) / 2, *[skin] * (len(SKIN) - 1)])  # the foot draws the outlines
    opaque = replace(scene.transfer, colors=colors, extinction=OPAQUE * scene.transfer.extinction)
    scene = scene._replace(transfer=opaque, step=scene.step / 4)
    lit = ScattererTemplates(FLESH, LIGHTS, templates=templates, blend=True)
    figure, axes = plt.subplots(1, 2, figsize=(2 * size / 90, size / 90 + 0.4), layout="constrained")
    titles = {
        "unlit: colours of the transfer function": None,
        "lit from the left, by scatterer templates": lit,
    }
    for panel, (title, lighting) in zip(axes, titles.items(), strict=True):
        panel.imshow(jv.to_srgb(frame(scene, lighting, seed).image((0.0, 0.0, 0.0))))
        panel.set_title(title, fontsize=11)
        panel.axis("off")
    common.save(figure, path)


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
    figure, axes = plt.subplots(2, 2, figsize=(11, 9), layout="constrained")
    cost, deferred, spread, energy = axes.flat
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
        cost.text(
            1,
            goal,
            f"goal, {name}",
            fontsize=7,
            ha="right",
            va="bottom",
            transform=cost.get_yaxis_transform(),
        )
    cost.set(
        xscale="log",
        yscale="log",
        xlabel="RMSE against many templates blended",
        ylabel="time / that of an unlit frame",
    )
    cost.set_title("numbers: photons of a template, templates blended, or nodes baked", fontsize=9)
    cost.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    cost.yaxis.set_major_formatter("{x:g}")
    cost.yaxis.set_minor_formatter(NullFormatter())
    cost.xaxis.set_major_locator(LogLocator(subs=(1, 3)))
    cost.xaxis.set_major_formatter("{x:g}")
    cost.xaxis.set_minor_formatter(NullFormatter())
    figure.legend(*cost.get_legend_handles_labels(), loc="outside upper center", ncols=5, fontsize=8)

    rows = result["deferring"]
    for key, label, style in (("rmse", "deferred", "C4o--"), ("rmse of no light", "no light", "ko-")):
        deferred.plot([row["extinction"] for row in rows], [row[key] for row in rows], style, label=label)
    deferred.set(xscale="log", yscale="log", xlabel="extinction, times that of opaque skin")
    deferred.set(ylabel="RMSE against light on all samples")
    for axis in (deferred.xaxis, deferred.yaxis):
        axis.set_major_formatter("{x:g}")
    deferred.set_title("light once for each ray, from translucent to opaque skin", fontsize=9)
    deferred.legend(fontsize=8)

    rows = result["noise"]["blended"]
    count, deviation = [row["templates"] for row in rows], [row["deviation"] for row in rows]
    spread.plot(count, deviation, "C1s-", label="blended, between sets")
    spread.plot(count, deviation[0] / np.sqrt(count), "k:", label="1 / √templates")
    spread.axhline(
        result["noise"]["one for each pixel"], color="C0", label="one for each pixel, between pixels"
    )
    spread.set_xscale("log", base=2)
    spread.xaxis.set_major_formatter("{x:g}")
    spread.set_title("noise on a flat face", fontsize=9)
    spread.set(yscale="log", xlabel="templates blended", ylabel="standard deviation / mean of the brightness")
    spread.yaxis.set_major_formatter("{x:g}")
    spread.yaxis.set_minor_formatter("{x:g}")
    spread.legend(fontsize=8)

    alpha = np.array(result["energy"]["opacity"])
    for (name, found), style in zip(result["energy"]["forms"].items(), ("C0o-", "C3s-", "C1^-"), strict=True):
        energy.plot(alpha, found, style, label=name)
    energy.plot(alpha, alpha / (1 - alpha), "k:", label="α / (1 - α)")
    energy.axhline(1, color="k", linewidth=0.8)
    energy.set(yscale="log", xlabel="opacity α of the material", ylabel="energy of a template (of 1)")
    energy.set_title("sum of a template's intensities, by the form of the equations", fontsize=9)
    energy.yaxis.set_major_formatter("{x:g}")
    energy.legend(fontsize=8)
    common.save(figure, path)


@common.experiment(
    "lighting",
    "What do photons, templates, occlusion, baking and deferring cost, and what do they buy?",
    __doc__,
    repetitions=5,
    size=256,
    resolution=96,
)
def main(chosen: Namespace) -> common.Answer:
    photons, blended, baked, many, trials = (1, 4, 8, 16), (1, 2, 4, 8), (32, 64, 128), 32, 24
    opacities, thinned = [round(0.1 * i, 1) for i in range(1, 10)], (1.0, 0.3, 0.1, 0.03, 0.01)
    if chosen.quick:
        chosen.size, chosen.resolution, chosen.repetitions = 24, 24, 2
        photons, blended, baked, many, trials, opacities = (2,), (2,), (16,), 4, 3, [0.3, 0.7]
        thinned = (1.0, 0.1)

    scene = skin_head(chosen.size, chosen.resolution)
    result = {
        "goals": GOALS,
        "image": [chosen.size, chosen.size],
        "resolution": chosen.resolution,
        "repetitions": chosen.repetitions,
        "templates blended in the reference": many,
        "photons of a template": held(),
        "frames": measure(scene, variants(photons, blended, baked), many, chosen.repetitions, chosen.seed),
        "deferring": deferring(scene, thinned, chosen.seed),
        "noise": noise(blended, trials, chosen.seed),
        "energy": {"opacity": opacities, "forms": energies(opacities, chosen.seed)},
    }
    for row in result["deferring"]:
        print("deferred, " + ", ".join(f"{name} {value:.4g}" for name, value in row.items()))
    for row in result["noise"]["blended"]:
        print(f"{row['templates']} templates blended: {row['deviation']:.2%} between sets")
    print(f"one template for each pixel: {result['noise']['one for each pixel']:.2%} between pixels")
    for name, found in result["energy"]["forms"].items():
        print(f"energy, {name}: " + ", ".join(f"{a} {e:.3f}" for a, e in zip(opacities, found, strict=True)))

    def charts(path: Path) -> None:
        draw(result, path)
        lit = (48, 24) if chosen.quick else (512, 192)
        pictures(many // 2, chosen.seed, path.with_name("lit.png"), *lit)

    return result, charts


if __name__ == "__main__":
    main()
