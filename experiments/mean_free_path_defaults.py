"""Are mean free paths found with default settings, on scenes that nothing was tuned to?

Balls with edges several voxels wide, and two bars of two materials: one view of 400 paths, lit by one lamp
far away, marched by steps of one voxel. A bar's second half lies in a coat of the first material, its soft
edge, where materials are ranges of values; and has no coat where they are labels. Fits start three times too
short. Two ways, all options at their defaults: by the path tracer (`PathTracedResidual`); and, of one ball,
by templates by transport (`ImageResidual`). The time is that of the whole call, with what it compiles.
"""

import time
import warnings
from argparse import Namespace
from itertools import chain
from typing import Any, cast

import numpy as np

import jaxvol as jv
from jaxvol.fitting.uncertainty import MISFIT
from jaxvol.lighting import DirectionalLight, Material, ScattererTemplates

from . import charts
from .harness import experiment
from .scenes import grid, on_cube


BALLS = {
    "ball of 24³": (24, 0.8, 0.1, 4.0),
    "ball of 40³": (40, 0.62, 0.3, 3.0),
    "ball of 56³": (56, 0.5, 0.6, 2.0),
}
"""Voxels along an axis, radius, opacity of the material, and width of the edge in voxels."""
BARS = {"bar by values": False, "bar by labels": True}
"""Whether materials are labels."""
TEMPLATES = ("ball of 40³",)
"""Scenes whose fits by templates are measured, too."""
HALF = 0.5
"""Half of the bar's width."""
THICKNESSES = 0.5, 2.0, 8.0, 16.0
"""Mean free paths across a ball, or across the thinner of the bar's materials."""
COLORS = (0.9, 0.8, 0.7), (0.6, 0.7, 0.9)
LIGHT = DirectionalLight((0.8, 0.5, -0.6), (2.0, 2.0, 2.0))
OFF = 1 / 3
MARKS = {"path tracer": "C2o", "templates by transport": "C0^"}


def ball(n: int, radius: float, opacity: float, edge: float) -> tuple[jv.Volume, Any, list[float], float]:
    """Volume, function from mean free paths to materials, their shares of the thickness, and the size."""
    distance = np.linalg.norm(np.stack(grid(n)), axis=0)
    data = np.clip((radius - distance) / (edge * 2 / (n - 1)) + 0.5, 0, 1).astype(np.float32)
    return on_cube(data), lambda paths: (Material(opacity, paths[0]),), [1.0], 2 * radius


def bar(labels: bool) -> tuple[jv.Volume, Any, list[float], float]:
    x, y, z = grid(32)
    inside = np.clip((HALF - np.maximum(abs(y), abs(z))) * 8 + 0.5, 0, 1) * (abs(x) < 0.8)
    data = inside * np.where(x < 0, 0.5, 1.0)
    parts = [np.where(x < 0, 1, 2) * np.ones(data.shape, int)] if labels else []
    ranges = [{"values": (0.0, 0.75)}, {"values": (0.75, 1.0)}]
    first, second = cast(Any, [{"label": 1}, {"label": 2}] if labels else ranges)

    def materials(paths: Any) -> tuple[Material, ...]:
        return Material(0.2, paths[0], **first), Material(0.4, paths[1], **second)

    return on_cube(data.astype(np.float32), *parts), materials, [1.0, 2.0], 2 * HALF


def fits(scene: Any, thickness: float, chosen: Namespace, seed: int, ways: int) -> dict[str, Any]:
    """Mean free paths found over true, in the first one or two ways."""
    volume, materials_of, shares, size = scene
    colors = [COLORS[0], COLORS[0], COLORS[-1] if len(shares) > 1 else COLORS[0]]
    transfer = jv.TransferFunction([0.0, 0.5, 1.0], colors, [0.0, 3.0, 6.0])
    truth = np.array([size / thickness / share for share in shares], np.float32)
    camera = jv.Camera((0.0, -4.0, 1.0), (0, 0, 0), (0, 0, 1), 32, size=(chosen.size, chosen.size))
    march = jv.March(float(volume.spacing.min()), (jv.AlphaCorrection(),), "midpoint")
    how: dict[str, Any] = {"paths": chosen.paths, "key": 1000 + seed, "materials": materials_of(truth)}
    views = [(camera, jv.path_trace(volume, transfer, camera, LIGHT, **how))]

    def traced(paths: Any, view: jv.Camera) -> tuple[Any, ...]:
        return volume, transfer, view, LIGHT, materials_of(paths["mean free path"])

    def lit(paths: Any, view: jv.Camera) -> tuple[Any, ...]:
        lighting = ScattererTemplates(materials_of(paths["mean free path"]), LIGHT, form="transport")
        return volume, transfer, view, march, lighting

    black = (0.0, 0.0, 0.0)
    residuals = jv.PathTracedResidual(traced, views, black), jv.ImageResidual(lit, views, black)
    rows = {}
    for name, residual in list(zip(MARKS, residuals, strict=True))[:ways]:
        begun = time.perf_counter()
        constraints = {"mean free path": jv.Positive()}
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            fit = jv.fit(residual, {"mean free path": truth * OFF}, constraints=constraints)
        assert fit.uncertainty is not None
        errors = np.ravel(list(fit.uncertainty.standard_errors.values())) / truth
        rows[name] = {
            "ratio": (np.asarray(fit.parameters["mean free path"]) / truth).tolist(),
            "standard error": [error if np.isfinite(error) else None for error in errors.tolist()],
            "not determined": list(chain(*fit.uncertainty.undetermined)),
            "converged": fit.success,
            "reduced chi-squared": float(fit.uncertainty.reduced_chi_squared or 0),
            "warned of a misfit": any(str(each.message).startswith(MISFIT) for each in caught),
            "steps": len(fit.losses),
            "seconds": round(time.perf_counter() - begun, 1),
        }
        print(thickness, name, rows[name], flush=True)
    return rows


def draw(result: dict[str, Any]) -> Any:
    figure, axes = charts.panels(1, len(result), 4.2 * len(result), 4)
    for panel, (name, rows) in zip(axes[0], result.items(), strict=True):
        for shift, (way, mark) in zip((0.97, 1.03), MARKS.items(), strict=True):
            for thickness, seeds in rows.items():
                for row in (row for row in seeds.values() if way in row):
                    for ratio, error in zip(row[way]["ratio"], row[way]["standard error"], strict=True):
                        at, how = float(thickness) * shift, {"fmt": mark, "capsize": 2, "alpha": 0.8}
                        if error is None:
                            panel.errorbar(at, ratio, label="not determined", **how, fillstyle="none")
                        else:
                            panel.errorbar(at, ratio, 2 * error, label=way, **how)
        panel.axhspan(0.9, 1.1, color="0.92", zorder=0)
        panel.axhline(1, color="k", linewidth=0.8)
        panel.set(xscale="log", title=name, xlabel="mean free paths across", ylabel="λ found / λ true")
        handles, names = panel.get_legend_handles_labels()
        labels = dict(zip(names, handles, strict=True))
        panel.legend(labels.values(), labels, fontsize=8)
        charts.plain_numbers(panel)
    return figure


@experiment(
    size=32,
    paths=400,
    seeds={"type": int, "default": 1, "help": "number of references of each scene"},
    quick={"size": 8, "paths": 4, "seeds": 1},
)
def main(chosen: Namespace) -> dict[str, Any]:
    scenes: dict[str, Any] = {name: ball(*numbers) for name, numbers in BALLS.items()}
    scenes |= {name: bar(labels) for name, labels in BARS.items()}
    thicknesses = THICKNESSES
    if chosen.quick:
        scenes, thicknesses = {"ball of 8³": ball(8, 0.7, 0.3, 2.0)}, (2.0,)
    return {
        name: {
            f"{thickness:g}": {
                str(seed): fits(scene, thickness, chosen, seed, 2 if name in TEMPLATES else 1)
                for seed in range(chosen.seed, chosen.seed + chosen.seeds)
            }
            for thickness in thicknesses
        }
        for name, scene in scenes.items()
    }
