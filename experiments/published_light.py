"""What does the published form of scatterer templates cost, as a multiple of the frame without illumination?

Lee, Kwon and Shin 2016 report 20 to 24 frames per second, and 42 to 56 by "ray casting without illumination":
2.2 times the time. These are their conditions: skin, muscle and bone as materials, each with 8 templates of
56 to 63 photons (a threshold of 0.01 on whole levels, opacities of about 50 %); a photon is hidden, or not,
and moved and scaled in another material (step 5); photons below 0.02 are not looked at; rays end early, and
have no other transform, lit or unlit. What the paper does not tell is measured in all ways: whether rays leap
over empty space, and whether the 8 templates are blended, its remedy against noise, or each pixel uses one of
them, or all use the same one. Steps 4 and 5 as printed are measured blended. Noise is `boundary_noise` of the
opaque pixels, as a standard deviation over their mean; that of the unlit frame is shape, not noise.
"""

from argparse import Namespace
from functools import partial
from typing import Any

import numpy as np

import jaxvol as jv
from jaxvol.lighting import DirectionalLight, ScattererTemplates
from jaxvol.metrics import boundary_noise, rmse

from . import charts, harness, timing
from .harness import experiment
from .lighting import UNLIT
from .printed_templates import PrintedSteps
from .scenes import skin_head


PAPER = 2.2
SKIN, MUSCLE, BONE = (
    jv.Material(opacity, length, index, values=values)
    for opacity, length, index, values in (
        (0.5, 0.035, 1.39, (40, 90)),
        (0.55, 0.07, 1.37, (90, 150)),
        (0.58, 0.03, 1.55, (150, 256)),
    )
)
"""Values of the head phantom, which is 2 wide. An opacity of 46 to 59 % gives four levels, 60 photons of four
packets."""
SUN = DirectionalLight((0.9, 0.7, -0.6), (60.0, 60.0, 60.0))
BLENDED, EACH, ALIKE = "8 templates blended", "one of 8 for each pixel", "one template a material"
PRINTED = "8 blended, steps 4 and 5 as printed"
MARCHES: dict[str, tuple[Any, ...]] = {
    "early ends": (jv.EarlyTermination(),),
    "early ends and leaps": (jv.SpaceLeaping(), jv.EarlyTermination()),
}


def lightings(seed: int) -> dict[str, ScattererTemplates | None]:
    conditions: dict[str, Any] = {"occlusion": "hard", "threshold_on": "level", "seed": seed}
    kinds = {BLENDED: (ScattererTemplates, {"blend": True}), EACH: (ScattererTemplates, {})}
    kinds |= {ALIKE: (ScattererTemplates, {"templates": 1}), PRINTED: (PrintedSteps, {"blend": True})}
    lit = {name: kind((SKIN, MUSCLE, BONE), SUN, **conditions, **how) for name, (kind, how) in kinds.items()}
    return {UNLIT: None, **lit}


def noise(rgba: np.ndarray) -> float:
    """Standard deviation of the noise of what is mostly opaque, over its mean."""
    color, opaque = rgba[..., :3], rgba[..., 3] > 0.5
    return float(np.sqrt(boundary_noise(color, opaque) / 3) / color[opaque].mean())


def measure(chosen: Namespace) -> dict[str, Any]:
    """Times, as multiples of the unlit frame of the same march; RMSE against the blended form; and noise."""
    scene, found = skin_head(chosen.size, chosen.resolution), {}
    for name, transforms in MARCHES.items():
        march = jv.March(scene.step, transforms)
        drawn = {
            how: partial(jv.render, *scene[:3], march, lighting=lighting, outputs="rgba")
            for how, lighting in lightings(chosen.seed).items()
        }
        seconds = timing.interleaved(
            {how: lambda d=d: d().rgba for how, d in drawn.items()}, chosen.repetitions
        )
        images = {how: np.asarray(draw().rgba) for how, draw in drawn.items()}
        found[name] = {
            how: harness.row(seconds[how], seconds[UNLIT], rmse(image, images[BLENDED]))
            | {"noise / mean": noise(image)}
            for how, image in images.items()
        }
    return found


def photons(lighting: ScattererTemplates) -> dict[str, int]:
    """Fewest and most photons of a template, and most that the cut-off leaves to a frontmost sample."""
    intensity = np.asarray(lighting.simulated().intensity) * (lighting.templates if lighting.blend else 1)
    counts = np.sum(intensity > 0, axis=-1)
    left = np.sum(intensity >= float(lighting.cutoff or 0), axis=-1)
    return {"fewest": int(counts.min()), "most": int(counts.max()), "above the cut-off": int(left.max())}


def draw(result: dict[str, Any]) -> Any:
    figure, ((panel,),) = charts.panels(1, 1, 8, 3.6)
    ticks = []
    for name, rows in result["marches"].items():
        for how, row in rows.items():
            if how != UNLIT:
                charts.interval(panel, row["ratio"], -len(ticks), "C1" if how == BLENDED else "C0")
                ticks.append(f"{how}; {name}")
    panel.axvline(PAPER, color="k", linewidth=0.8, linestyle=":")
    panel.set_title("dotted: the paper, on its GPU")
    panel.set_yticks(-np.arange(len(ticks)), ticks)
    panel.set(xlim=(1, None), xscale="log", xlabel="time / plain, unlit frame")
    panel.set_xticks([1, 2, 5, 10, 20, 50], [1, 2, 5, 10, 20, 50])
    panel.set_xticks([], minor=True)
    return figure


@experiment(
    repetitions=9,
    size=256,
    resolution=96,
    quick={"size": 16, "resolution": 16, "repetitions": 1},
)
def main(chosen: Namespace) -> dict[str, Any]:
    lit = {name: each for name, each in lightings(chosen.seed).items() if each is not None}
    counts = {name: photons(each) for name, each in lit.items()}
    return {"paper": PAPER, "photons": counts, "marches": measure(chosen)}
