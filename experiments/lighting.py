"""What do photons, templates and occlusion cost, and what do they gain?

The head phantom under opaque skin, lit from the side. Each frame is rendered in turn with the unlit head, and
with one that `lighting.Phong` shades; its time is the median of their ratios. Beside it stands the image's
RMSE against one that blends many templates under soft occlusion and lights all samples.

Times are multiples of the unlit frame. The paper's own, 2.2 (Lee, Kwon and Shin 2016: 20-24 frames per
second in place of 42-56), is of several materials and 56-63 photons a template, where there are one and 16-19
here: `published_light.json` is under its conditions. Rows of the record of light that was baked, or deferred,
are by an earlier commit, which had these.
"""

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
from matplotlib.ticker import LogLocator, NullFormatter

import jaxvol as jv
from jaxvol.lighting import ConstantLight, DirectionalLight, Lighting, Phong, ScattererTemplates
from jaxvol.metrics import rmse

from . import charts, harness, timing
from .harness import experiment
from .scenes import SKIN, Scene, skin_head


GOALS = {"templates": 2.2, "baked": 1.2}
FLESH = jv.Material(0.5, 0.05, 1.4)
LIGHTS = DirectionalLight((0.9, 0.7, -0.6), (50.0, 50.0, 50.0)), ConstantLight((1.3, 1.3, 1.3))
"""Bright, since flesh that absorbs half at each scattering reflects a sixth of white light from all sides."""
UNLIT, PHONG = "unlit", "Phong"
STYLES = {
    PHONG: "kx",
    "photons": "C0o-",
    "one for each material": "C0*",
    "templates blended": "C1s-",
    "hard occlusion": "C3D",
    "hard, one for each material": "C3*",
    "baked": "C2^-",
    "photons, deferred": "C4o--",
    "templates blended, deferred": "C6s--",
    "baked, deferred": "C5^--",
}


def march(scene: Scene, seed: int = 0) -> jv.March:
    """A march that renders opaque skin smoothly and takes few samples behind it."""
    how = jv.EmptySpaceJitter(seed), jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination()
    return jv.March(scene.step, how)


def variants(photons: Sequence[int], blended: Sequence[int]) -> dict[str, list[Any]]:
    """Lightings grouped by the setting that is varied, each with its number."""
    of = partial(ScattererTemplates, FLESH, LIGHTS)
    whole = of().photons
    photons = (*(n for n in photons if n < whole), whole)
    found = [
        [(0, Phong())],
        [(n, of(photons=n)) for n in photons],
        [(whole, of(templates=1))],
        [(n, of(templates=n, blend=True)) for n in blended],
        [(whole, of(occlusion="hard"))],
        [(whole, of(occlusion="hard", templates=1))],
    ]
    return dict(zip(STYLES, found, strict=False))


def frame(scene: Scene, lighting: Lighting | None, seed: int) -> jv.Rendering:
    return jv.render(*scene[:3], march(scene, seed), lighting=lighting, outputs="rgba")


def measure(scene: Scene, lightings: dict[str, list[Any]], chosen: Namespace) -> dict[str, list[Any]]:
    """Time and error of each lighting, one at a time."""
    seed, many = chosen.seed, ScattererTemplates(FLESH, LIGHTS, templates=chosen.many, blend=True)
    truth = frame(scene, many, seed).rgba
    found: dict[str, list[dict[str, Any]]] = {kind: [] for kind in lightings}
    for kind, each in lightings.items():
        for number, lighting in each:
            programs = {UNLIT: None, PHONG: Phong(), kind: lighting}
            drawn = {n: partial(frame, scene, how, seed) for n, how in programs.items()}
            seconds = timing.interleaved(drawn, chosen.repetitions)
            error = rmse(frame(scene, lighting, seed).rgba, truth)
            row = {"number": number, **harness.row(seconds[kind], seconds[UNLIT], error)}
            row["ratio to Phong"] = timing.ratio(seconds[kind], seconds[PHONG])
            found[kind].append(row)
    return found


def picture(templates: int, seed: int, path: Path, size: int, resolution: int) -> None:
    """Save the head without light and with it, side by side, under skin that nothing shows through: where
    bone lies just below the surface, it has the colour of skin, too."""
    scene = skin_head(size, resolution)
    foot, skin = scene.transfer.colors[0], scene.transfer.colors[1]
    colors = jnp.stack([(foot + skin) / 2, *[skin] * (len(SKIN) - 1)])  # the foot draws the outlines
    opaque = replace(scene.transfer, colors=colors, extinction=10 * scene.transfer.extinction)
    scene = scene._replace(transfer=opaque, step=scene.step / 4)
    lit = ScattererTemplates(FLESH, LIGHTS, templates=templates, blend=True)
    titles = "unlit: colours of the transfer function", "lit from the left, by scatterer templates"
    figure, (axes,) = charts.panels(1, 2, 2 * size / 90, size / 90 + 0.4)
    for panel, title, lighting in zip(axes, titles, (None, lit), strict=True):
        panel.imshow(jv.to_srgb(frame(scene, lighting, seed).image((0.0, 0.0, 0.0))))
        panel.set_title(title)
        panel.axis("off")
    charts.save(figure, path)


def draw(result: dict[str, Any]) -> Any:
    figure, ((cost,),) = charts.panels(1, 1, 7, 5)
    for kind, rows in result["frames"].items():
        error, ratio = [row["rmse"] for row in rows], [row["ratio"]["median"] for row in rows]
        cost.plot(error, ratio, STYLES[kind], label=kind, markersize=6)
        for row, x, y in zip(rows, error, ratio, strict=True):
            if row["number"]:
                cost.annotate(str(row["number"]), (x, y), (4, 4), textcoords="offset points", fontsize=8)
    for name, goal in GOALS.items():
        cost.axhline(goal, color="k", linewidth=0.8, linestyle=":")
        how = {"ha": "right", "va": "bottom", "transform": cost.get_yaxis_transform()}
        cost.text(1, goal, f"goal, {name}", **how)
    cost.set(xscale="log", yscale="log", xlabel="RMSE against many templates blended")
    cost.set_ylabel("time / that of an unlit frame")
    cost.set_title("numbers: photons of a template, templates blended, or nodes baked")
    for axis, digits in ((cost.xaxis, (1, 3)), (cost.yaxis, (1, 2, 5))):
        axis.set_major_locator(LogLocator(subs=digits))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    figure.legend(*cost.get_legend_handles_labels(), loc="outside upper center", ncols=5)
    return figure


@experiment(
    repetitions=5,
    size=256,
    resolution=96,
    photons=(1, 4, 8, 16),
    blended=(1, 2, 4, 8),
    many={"type": int, "default": 32, "help": "templates blended in the reference"},
    picture=(512, 192),
    quick={
        "size": 24,
        "resolution": 24,
        "repetitions": 2,
        "photons": (2,),
        "blended": (2,),
        "many": 4,
        "picture": (48, 24),
    },
)
def main(chosen: Namespace) -> dict[str, Any]:
    scene = skin_head(chosen.size, chosen.resolution)
    result = {
        "goals": GOALS,
        "frames": measure(scene, variants(chosen.photons, chosen.blended), chosen),
    }
    picture(chosen.many // 2, chosen.seed, chosen.output / "lit.png", *chosen.picture)
    return result
