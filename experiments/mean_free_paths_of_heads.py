"""Are the mean free paths of two and three materials of a head recovered from path-traced views?

The head phantom, of flesh and bone, or of skin, muscle and bone, in two views whose noise is known. All fits
start three times too short; the extinction that the camera's rays meet follows from the mean free path, 1/λ.
Three of the ways of `mean_free_path`: by templates by transport; by the path tracer; and by the path tracer
from where templates by transport end.
At 32 voxels along an axis, bone is a shell thinner than a voxel.
"""

from argparse import Namespace
from typing import Any

import numpy as np

import jaxvol as jv

from . import charts
from .harness import experiment
from .mean_free_path import MARKS, OPTIONS, QUICK, from_paths, scene_of


HEADS = {"two materials": ("flesh", "bone"), "three materials": ("skin", "muscle", "bone")}


def draw(result: dict[str, Any]) -> Any:
    rows = result["path-traced views"]
    figure, ((panel,),) = charts.panels(1, 1, 6, 4.2)
    parts = [(scene, at) for scene, names in HEADS.items() for at in range(len(names))]
    ways = [name for name in MARKS if name in rows["two materials"]["0"]]
    for n, name in enumerate(ways):
        how: dict[str, Any] = {"linestyle": "none", "alpha": 0.7, "label": name}
        for x, (scene, at) in enumerate(parts):
            found = [fits[name]["ratio"][at] for fits in rows[scene].values()]
            panel.plot(np.full(len(found), x + 0.12 * (n - 1)), found, MARKS[name], **how)
            how["label"] = None
    panel.axhspan(0.95, 1.05, color="0.9", zorder=0)
    panel.axhline(1, color="k", linewidth=0.8)
    panel.set(ylabel="λ found / λ true")
    told = [f"{HEADS[scene][at]}\nof {len(HEADS[scene])}" for scene, at in parts]
    panel.set_xticks(range(len(parts)), told)
    charts.legend_below(figure, panel, 1)
    return figure


@experiment(**OPTIONS, quick=QUICK)
def main(chosen: Namespace) -> dict[str, Any]:
    volume, rows = jv.phantom("head", chosen.resolution), {name: {} for name in HEADS}
    for seed in range(chosen.seed, chosen.seed + chosen.seeds):
        for name, materials in HEADS.items():
            print(f"{name}, seed {seed}", flush=True)
            scene, truth = scene_of(volume, materials, chosen.nodes, seed)
            rows[name][str(seed)] = from_paths(scene, truth, chosen, known=False)
    return {"path-traced views": rows}
