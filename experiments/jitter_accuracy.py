"""What do jitter and alignment do to the error, at different step lengths, lit and pre-integrated?

*By step*: five marches on two scenes, a block whose left half is cut by the box's faces and whose right half
is an inclined plane (its comb of rings has a known frequency), and the head phantom, its crown cut off, in
perspective. Measured against a converged image are wood grain, noise on cut faces and the whole error (RMSE);
also, samples over those of ray casting (`overhead` has times). The head's wood grain is measured off its cut
face, where empty-space jitter must not act, and again off where rays leave it, which alignment changes.

*Conditions*: the same on skin, of the phantom and of CT as in the pictures of Kye's Fig. 9, unlit, by Phong's
shading (the paper's base method shades), pre-integrated, and lit with leaps and early ends.

*Alignment*: which part of the pixels of the pictures of Kye's Figs. 9 to 12 it changes, with and without
early ends and leaps; and by which quadrature it lowers what it raises by the left rule.
"""

import textwrap
from argparse import Namespace
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

import jaxvol as jv
from jaxvol.metrics import boundary_noise, comb_frequency, wood_grain_energy

from . import charts, harness, marches
from .harness import entered, experiment, frame, grain_off, left
from .pictures import kye
from .scenes import Scene, cropped


METHODS = dict(zip(marches.NAMES, ("k-", "C3--", "C0-", "C2:", "C1-."), strict=True))
"""With their styles in the chart."""
STEPS = (4.3, 2.3, 1.3, 0.7)
"""In voxels. Not whole or half ones: in the orthographic view the samples of all rays would then lie alike on
nodes, or between them, which has an error of its own that jitter would seem to lower."""
SLOPE = 0.35  # depth that the inclined plane gains per world length to the right
NOTE = "Jitter turns structure into noise; the size of the error stays about what it was."
ENDS = jv.SpaceLeaping(), jv.EarlyTermination(kye.ENDED)
CONDITIONS: dict[str, tuple[Any, ...]] = {name: (*how, ()) for name, how in kye.CONDITIONS.items()}
CONDITIONS["lit, leaps and early ends"] = (*kye.CONDITIONS["lit"], ENDS)
"""Lighting, quadrature, and transforms of all marches."""
ROUNDING = 1e-12
LEAST = 1e-7
"""Energy at which the chart of conditions begins."""
PANELS = {
    "wood grain": "wood grain off the face (above 0)",
    "boundary noise": "noise on the cut face (above 0)",
    "rmse off the face": "RMSE off the cut face",
    "samples / ray casting": "samples / ray casting",
}


class Faced(NamedTuple):
    """A scene whose step is a voxel. `grain` measures the wood grain of an error at a step, by names; `face`
    is where the box cuts material."""

    scene: Scene
    grain: Callable[[np.ndarray, float], dict[str, float]]
    face: np.ndarray


def cut_block(resolution: int, size: int) -> Faced:
    volume = jv.phantom("cut_block", resolution)
    points = [(0.05, (0.33, 0.33, 0.33), 0.0), (1.0, (0.9, 0.9, 0.9), 0.45)]
    transfer = jv.TransferFunction.from_points(points, unit_distance=0.05)
    position = volume.center - np.array([0.0, 0.0, 3.0], np.float32)
    scale = 0.8
    camera = jv.Camera(position, volume.center, (0, 1, 0), size=(size, size), parallel_scale=scale)
    x = np.asarray(camera.rays()[0])[..., 0]
    rightwards = float(np.sign(x[0, -1] - x[0, 0]))
    plane = x > 0.1  # columns that do not see the step between the halves

    def grain(error: np.ndarray, step: float) -> dict[str, float]:
        frequency = comb_frequency(step, (rightwards * SLOPE, 0.0), 2 * scale / size)
        return {"wood grain": wood_grain_energy(error[:, plane[0]], frequency)}

    return Faced(Scene(volume, transfer, camera, float(volume.spacing[0])), grain, x < -0.1)


def head(resolution: int, size: int) -> Faced:
    volume = cropped(jv.phantom("head", resolution), (0, 0, 0), (1, 1, 0.62))
    camera = jv.Camera.looking_at(volume, (0.5, -1, 0.75), size=(size, size)).zoom(1.7, (0.52, 0.46))
    scene = Scene(volume, jv.preset("head", unit_distance=0.01), camera, float(volume.spacing[0]))
    return skin(scene)


def skin(scene: Scene) -> Faced:
    """A scene whose wood grain is that off where rays enter, and off where they leave, within material."""
    face, exits = entered(scene), left(scene)

    def grain(error: np.ndarray, _: float) -> dict[str, float]:
        both = grain_off(error, face | exits)
        return {"wood grain": grain_off(error, face), "wood grain off both faces": both}

    return Faced(scene, grain, face)


def colors(rendering: jv.Rendering) -> np.ndarray:
    return np.asarray(rendering.rgba[..., :3], np.float64)


def by_march(
    of: Faced, step: float, truth: np.ndarray, how: tuple[Any, ...], seed: int, exits: Any = None
) -> dict[str, dict[str, Any]]:
    """Measures of the image of every march, at a step in voxels; the mean error of pixels at `exits`."""
    (scene, grain, face), (lighting, quadrature, more) = of, how
    length, rows, plain = step * scene.step, {}, 0
    for name in METHODS:
        march = jv.March(length, (*marches.transforms(name, seed), *more), quadrature)
        rendering = frame(scene, march, lighting)
        error = colors(rendering) - truth
        samples = int(np.sum(np.asarray(rendering.samples), dtype=np.int64))
        plain = plain or samples
        rows[name] = grain(error, length) | {
            "boundary noise": boundary_noise(error, face),
            "rmse": float(np.sqrt(np.mean(error**2))),
            "rmse off the face": float(np.sqrt(np.mean(error[~face] ** 2))),
            "samples / ray casting": samples / plain,
        }
        if exits is not None:
            rows[name]["mean error where rays leave through material"] = float(error[exits].mean())
    return rows


def by_step(of: Faced, chosen: Namespace) -> list[dict[str, Any]]:
    """A row for each step and march."""
    truth, rows = colors(frame(of.scene, marches.converged(min(chosen.steps) * of.scene.step))), []
    for step in chosen.steps:
        found = by_march(of, step, truth, CONDITIONS["unlit"], chosen.seed)
        rows += [{"step": step, "march": name, **row} for name, row in found.items()]
    return rows


def pictured(chosen: Namespace) -> Namespace:
    """The options of the pictures."""
    data = None if chosen.quick else harness.data()
    return Namespace(data=data, size=chosen.size, resolution=chosen.resolution)


def under_conditions(chosen: Namespace) -> dict[str, Any]:
    """A row for each march, by scene and condition."""
    found: dict[str, Any] = {}
    for said, view in kye.views("head", pictured(chosen)).items():
        scene = view.scenes(pictured(chosen))["zoomed"]
        of, rows = skin(scene), found.setdefault(said.rstrip(", ") or "phantom head", {})
        for condition, how in CONDITIONS.items():
            truth = colors(frame(scene, marches.converged(scene.step), how[0]))
            rows[condition] = by_march(of, 1.0, truth, how, chosen.seed)
    return found


def aligned_shares(chosen: Namespace) -> dict[str, Any]:
    """Which part of the pixels alignment changes, and in which part anything is visible."""
    found: dict[str, Any] = {}
    more: dict[str, tuple[jv.Transform, ...]] = {"all samples": ()}
    more |= {"leaps": ENDS[:1], "early ends": ENDS[1:], "leaps and early ends": ENDS}
    for name in kye.VIEWS:
        for said, view in kye.views(name, pictured(chosen)).items():
            for part, scene in view.scenes(pictured(chosen)).items():
                shares = {n: float(left(scene, *transforms).mean()) for n, transforms in more.items()}
                seen = frame(scene, jv.March(scene.step)).rgba[..., 3] > 0
                shares["visible"] = float(np.mean(seen))
                found[f"{said.rstrip(', ') or f'phantom, {name}'}, {part}"] = shares
    return found


def alignment_by_quadrature(of: Faced, chosen: Namespace) -> dict[str, Any]:
    """At the shortest step: the measures, with the mean error of the pixels that alignment changes."""
    step = min(chosen.steps)
    truth, exits = colors(frame(of.scene, marches.converged(step * of.scene.step))), left(of.scene)
    rules = ("left", "midpoint")
    return {rule: by_march(of, step, truth, (None, rule, ()), chosen.seed, exits) for rule in rules}


def draw(result: dict[str, Any]) -> Any:
    scenes = result["by step"]
    figure, axes = charts.panels(len(scenes), len(PANELS), 12, 2.9 * len(scenes))
    for line, (scene, rows) in zip(axes, scenes.items(), strict=True):
        for panel, (key, label) in zip(line, PANELS.items(), strict=True):
            for name, style in METHODS.items():
                found = {row["step"]: row[key] for row in rows if row["march"] == name}
                # what is below is rounding
                shown = [value if value > ROUNDING else np.nan for value in found.values()]
                panel.plot(list(found), shown, style, marker=".", markersize=6, label=name)
            panel.set(title=label, xlabel="step, voxels", xscale="log")
            if key != "samples / ray casting":
                panel.set_yscale("log", nonpositive="mask")
                charts.plain_numbers(panel)
            charts.numbered(panel, STEPS, [f"{step:g}" for step in STEPS])
        line[0].set_ylabel(scene)
    figure.suptitle(textwrap.fill(result["note"], 120))
    charts.legend_below(figure, axes[0, 0], 5)
    return figure


def draw_conditions(result: dict[str, Any]) -> Any:
    """Wood grain on skin, a panel for each scene, a group of bars for each condition."""
    scenes: Mapping[str, Any] = result["conditions"]
    figure, axes = charts.panels(1, len(scenes), 5.5 * len(scenes), 4, sharey=True)
    width = 0.8 / len(METHODS)
    for panel, (scene, conditions) in zip(axes.flat, scenes.items(), strict=True):
        for number, (name, style) in enumerate(METHODS.items()):
            energies = [max(rows[name]["wood grain"], LEAST) for rows in conditions.values()]
            places = np.arange(len(conditions)) + width * (number - (len(METHODS) - 1) / 2)
            panel.bar(places, energies, width, color=style.rstrip("-.:") or "k", label=name)
        panel.set(yscale="log", title=scene, ylim=(LEAST, None))
        panel.set_xticks(range(len(conditions)), [textwrap.fill(each, 14) for each in conditions])
    axes[0, 0].set_ylabel(f"wood grain on skin (at least {LEAST:g})")
    charts.legend_below(figure, axes[0, 0], 3)
    return figure


more = {"jitter_conditions": draw_conditions}


@experiment(
    size=256,
    resolution=160,
    steps=STEPS,
    quick={"size": 96, "resolution": 48, "steps": (2.3, 1.9)},
)
def main(chosen: Namespace) -> dict[str, Any]:
    faced = {
        "cut block, orthographic": cut_block(chosen.resolution, chosen.size),
        "head, perspective": head(chosen.resolution, chosen.size),
    }
    return {
        "note": NOTE,
        "by step": {name: by_step(of, chosen) for name, of in faced.items()},
        "conditions": under_conditions(chosen),
        "aligned pixels": aligned_shares(chosen),
        "alignment by quadrature": alignment_by_quadrature(faced["head, perspective"], chosen),
    }
