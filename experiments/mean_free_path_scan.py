"""At which mean free path do templates come nearest to path-traced views, under the paper's parameters?

Published templates as in Lee, Kwon and Shin 2016: an opacity of 50 %, four packets, a threshold of 0.01 on
whole levels, hence up to 60 photons a template; 8 templates, blended; occlusion also tested at 2 and 4 times
the distance; hard occlusion with a cut-off of 0.02 as published, or soft occlusion, which is ours. Beside
them templates by transport, under the same march of eight steps a voxel. The extinction that the camera's
rays meet is known (of published templates alone), or follows from the mean free path, 1/λ.

Nothing is fitted by derivatives (the image under hard occlusion has none): λ is scanned over a factor of 256,
in octaves, and ever closer around the least loss, down to steps of 2 %. The true λ is none of the steps. The
paper gives no scale, so at each λ the brightness is the one that brings the image nearest. Scenes are the
ball of `mean_free_path`, and CT of a head as one material, read from the folder JAXVOL_DATA and left out
without it.
"""

from argparse import Namespace
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

import jaxvol as jv
from jaxvol.path_tracing import PathTraced

from . import charts, harness
from .harness import experiment
from .mean_free_path import KNOWN, OPTIONS, QUICK, THICKNESSES, TIED, Scene, balls_of, scene_of, times
from .scenes import CT_HEAD, on_cube


CT = "CT of a head"
FACTORS = 2.0 ** (np.arange(-5, 4) + 0.1)
"""Scanned mean free paths, over the true one."""
FLAT = 1.1
"""Errors up to so many times the least are told as a range of λ."""
PAPER: dict[str, Any] = {"templates": 8, "blend": True, "threshold_on": "level"}
FORMS: dict[str, dict[str, Any]] = {"hard": {**PAPER, "occlusion": "hard"}, "soft": PAPER}
WAYS = ("hard", 0.0), ("hard", 1.0), ("soft", 0.0), ("soft", 1.0), ("transport", 1.0)
"""Forms of templates, and whether the extinction is 1/λ."""
MARKS = {"hard": "C3s", "soft": "C1D", "transport": "C0^"}


def nearest(images: Sequence[Any], views: Sequence[PathTraced]) -> dict[str, float]:
    """Brightness that brings images nearest to views; error after it, root mean square over the mean and
    without the noise of the views; and reduced χ²."""
    image, view = np.ravel(images).astype(float), np.ravel([each.radiance for each in views]).astype(float)
    variance = np.ravel([np.square(each.standard_error) for each in views]).astype(float)
    brightness = np.sum(image * view) / np.sum(image**2)
    squares, noisy = np.sum((brightness * image - view) ** 2), np.count_nonzero(variance)
    return {
        "brightness": float(brightness),
        "error": float(np.sqrt(max(0.0, squares - variance.sum()) / view.size) / view.mean()),
        "reduced chi-squared": float(squares / variance.sum() * noisy / (noisy - 2)),
    }


def scan(measured: Callable[[float], dict[str, float]]) -> dict[str, Any]:
    """Where the reduced χ² is least among the scanned factors, and how it depends on the factor."""
    rows = {factor: measured(factor) for factor in FACTORS.tolist()}
    chi = [row["reduced chi-squared"] for row in rows.values()]
    padded = np.array([np.inf, *chi, np.inf])
    minima = int(np.sum((padded[1:-1] < padded[:-2]) & (padded[1:-1] <= padded[2:])))
    for octaves in (1 / 2, 1 / 8, 1 / 32):  # around the least so far
        middle = min(rows, key=lambda factor: rows[factor]["reduced chi-squared"])
        for step in (-3, -2, -1, 1, 2, 3) if octaves < 1 / 2 else (-1, 1):
            factor = middle * 2.0 ** (step * octaves)
            if FACTORS[0] <= factor <= FACTORS[-1]:
                rows[factor] = measured(factor)
    rows = dict(sorted(rows.items()))
    best = min(rows, key=lambda factor: rows[factor]["reduced chi-squared"])
    alike = [factor for factor, row in rows.items() if row["error"] <= FLAT * rows[best]["error"]]
    return {
        "ratio": best,
        "at an end of the scan": best in (FACTORS[0], FACTORS[-1]),
        **rows[best],
        "minima": minima,
        "alike": [alike[0], alike[-1]],
        "profile": [[round(factor, 4), round(row["error"], 4)] for factor, row in rows.items()],
    }


def scans(scene: Scene, truth: dict[str, Any], chosen: Namespace) -> dict[str, dict[str, Any]]:
    views, rows = scene.views(truth, chosen.size, chosen.paths), {}
    for form, tied in WAYS:
        options = FORMS.get(form, {"form": "transport", "nodes": scene.nodes, "levels": scene.levels})

        def measured(factor: float, tied: float = tied, options: dict[str, Any] = options) -> Any:
            given, images = times(factor, truth) | {"tied": np.float32(tied)}, []
            for camera, _ in views:
                *plain, lighting = scene.templates(given, camera, **options)
                images.append(jv.render(*plain, lighting=lighting, outputs="rgba").image((0, 0, 0)))
            return nearest(images, [view for _, view in views])

        name = form + (TIED if tied else KNOWN)
        rows[name] = scan(measured)
        print(name, {key: value for key, value in rows[name].items() if key != "profile"}, flush=True)
    return rows


def ct_head() -> jv.Volume:
    """Every fourth voxel along x and y, and every second along z, which is turned up: 4 mm, on a cube."""
    folder = harness.data()
    assert folder is not None
    return on_cube(np.asarray(jv.load(folder / CT_HEAD).data)[::4, ::4, ::-2])


def draw(result: dict[str, Any]) -> Any:
    rows = result["scans"]
    figure, (axes,) = charts.panels(1, 2, 10, 4.4)
    names = list(rows)
    for n, (form, tied) in enumerate(WAYS):
        way = form + (TIED if tied else KNOWN)
        fits = [(x, each[way]) for x, name in enumerate(names) for each in rows[name].values()]
        points = [(x + 0.13 * (n - 2), fit["ratio"]) for x, fit in fits]
        how: dict[str, Any] = {"linestyle": "none", "fillstyle": "full" if tied else "none"}
        axes[0].plot(*zip(*points, strict=True), MARKS[form], label=way, alpha=0.8, **how)
    profiles = dict.fromkeys((names[min(1, len(names) - 1)], names[-1]))
    for name, style in zip(profiles, ("-", "--"), strict=False):
        for form, mark in MARKS.items():
            profile = np.transpose(next(iter(rows[name].values()))[form + TIED]["profile"])
            about = name if name == CT else f"{name} thick"
            axes[1].loglog(*profile, mark[:-1] + style, label=f"{form}, {about}")
    axes[0].set(ylabel="λ of the least error / λ true", yscale="log")
    axes[0].set_xticks(range(len(names)), [name.replace(" of", "\nof") for name in names])
    axes[0].set_xlabel("diameter of the ball / λ, and a head")
    axes[1].set(xlabel="λ / λ true", ylabel="rms error / mean, extinction 1/λ")
    axes[1].legend(fontsize=8)
    for panel, line in zip(axes, (axes[0].axhline, axes[1].axvline), strict=True):
        line(1, color="k", linewidth=0.8)
        charts.plain_numbers(panel)
    charts.legend_below(figure, axes[0], 3)
    return figure


@experiment(
    **{name: option for name, option in OPTIONS.items() if name != "steps"},
    thicknesses=harness.some_of(THICKNESSES, "THICKNESS"),
    quick=QUICK | {"thicknesses": ["2"]},
)
def main(chosen: Namespace) -> dict[str, Any]:
    rows: dict[str, dict[str, Any]] = {}
    head = ct_head() if harness.data() and not chosen.quick else None
    for seed in range(chosen.seed, chosen.seed + chosen.seeds):
        scenes = balls_of("ball, opacity 50 %", chosen, seed)
        if head is not None:
            scenes[CT] = scene_of(head, [CT], chosen.nodes, seed)
        for name, (scene, truth) in scenes.items():
            print(f"{name}, seed {seed}", flush=True)
            rows.setdefault(name, {})[str(seed)] = scans(scene, truth, chosen)
    return {"scans": rows}
