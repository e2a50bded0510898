"""What does the published form of scatterer templates cost, as a multiple of the frame without illumination?

Lee, Kwon and Shin 2016 report 20 to 24 frames per second, and 42 to 56 by "ray casting without illumination":
2.2 times the time. These are their conditions: skin, muscle and bone as materials, each with 8 templates of
56 to 63 photons (a threshold of 0.01 on whole levels, opacities of about 50 %); a photon is hidden, or not,
and moved and scaled in another material (step 5); photons below 0.02 are not looked at; rays end early. What
the paper does not tell is measured both ways: whether rays leap over empty space, and whether each pixel
uses one of the 8 templates, or all of them the same one.
"""

from argparse import Namespace
from functools import partial
from typing import Any

import numpy as np
from matplotlib.ticker import MultipleLocator

import jaxvol as jv
from jaxvol.lighting import DirectionalLight, ScattererTemplates
from jaxvol.metrics import rmse

from . import charts, harness, timing
from .harness import experiment
from .lighting import UNLIT
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
EACH, ALIKE = "interpolated", "one template a material"
MARCHES: dict[str, tuple[Any, ...]] = {
    "early ends": (jv.EmptySpaceJitter(0), jv.AlphaCorrection(), jv.EarlyTermination()),
    "early ends and leaps": (
        *(jv.EmptySpaceJitter(0), jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination()),
    ),
}


def lightings(seed: int) -> dict[str, ScattererTemplates | None]:
    published = partial(
        ScattererTemplates, (SKIN, MUSCLE, BONE), SUN, occlusion="hard", threshold_on="level", seed=seed
    )
    return {
        UNLIT: None,
        EACH: published(),
        ALIKE: published(templates=1),
    }


def measure(chosen: Namespace) -> dict[str, Any]:
    """Times, as multiples of the unlit frame of the same march, and RMSE against the interpolated form."""
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
        truth = drawn[EACH]().rgba
        found[name] = {
            how: harness.row(seconds[how], seconds[UNLIT], rmse(drawn[how]().rgba, truth)) for how in drawn
        }
    return found


def draw(result: dict[str, Any]) -> Any:
    figure, ((panel,),) = charts.panels(1, 1, 8, 3)
    ticks = []
    for name, rows in result["marches"].items():
        for how, row in rows.items():
            if how != UNLIT:
                charts.interval(panel, row["ratio"], -len(ticks), "C1" if how == EACH else "C0")
                ticks.append(f"{how}; {name}")
    panel.axvline(PAPER, color="k", linewidth=0.8, linestyle=":", label="the paper, on its GPU")
    panel.set_yticks(-np.arange(len(ticks)), ticks)
    panel.set(xlim=(1, None), xlabel="time / that of the unlit frame")
    panel.xaxis.set_major_locator(MultipleLocator(1))
    panel.legend(loc="center right")
    return figure


@experiment(
    repetitions=15,
    size=256,
    resolution=96,
    quick={"size": 16, "resolution": 16, "repetitions": 1},
)
def main(chosen: Namespace) -> dict[str, Any]:
    published = lightings(chosen.seed)[EACH]
    assert published is not None
    counts = np.sum(np.asarray(published.simulated().intensity) > 0, axis=-1)
    return {
        "paper": PAPER,
        "photons of a template": {"fewest": int(counts.min()), "most": int(counts.max())},
        "marches": measure(chosen),
    }
