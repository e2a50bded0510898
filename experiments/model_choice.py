"""Does `choose` find the true number of materials, and of control points, with noise and without?

Materials: four labelled balls whose extinction is 1 / λ, of one, two or three different mean free paths λ.
Candidates have one to four of them. Control points: a field in which all values occur, under a random
transfer function of two, four or eight control points. Candidates have 2 to 16, and start from flat grey.

Each trial has its own truth, and is repeated with Gaussian noise on all pixels and with none. Chosen are the
fewest parameters that held-out views support; beside it is what BIC would choose, from the training views
alone, and the candidate of the least held-out loss.
"""

from argparse import Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxvol as jv

from . import charts
from .harness import experiment, show


STEPS = 40
NOISE = 0.02
"""Standard deviation of the noise of each pixel and channel; white is 1."""
GOAL = 9
"""Trials of ten in which the truth is to be chosen with noise; without, never more than the truth."""

CENTERS = ((-0.45, 0, -0.2), (0.4, 0.2, -0.3), (0, 0, 0.5), (0.3, -0.5, 0.2))
RADIUS = 0.4
COLORS = ((0.8, 0.4, 0.3), (0.5, 0.6, 0.3), (0.8, 0.8, 0.75), (0.4, 0.6, 0.8))
CLASSES = [(0, 0, 0, 0), (0, 0, 1, 1), (0, 1, 2, 2), (0, 1, 2, 3)]
START, PATHS = 0.4, (0.2, 1.5)
APART = 1.3
"""Least ratio of two mean free paths of the truth."""

POINTS = (2, 4, 8, 16)
POSITIONS = ((0.0, -4.0, 1.0), (3.0, 2.5, 1.0), (-3.0, 2.0, -1.5), (1.0, 1.0, 4.0), (-2.5, -3.0, 0.5))
TRUTHS = 3
"""So many of the first candidates are the truth, in turn."""
SEEN = 3
"""Number of training views; the others are held out."""


LEAST = 1e-16
"""Smallest loss that the chart shows: where a fit is exact, the loss is 0."""

RULES = ("chosen", "bic", "least")
"""Of each trial: what is chosen by `choose`, by BIC, and by the least held-out loss."""


class Problem(NamedTuple):
    """What is to be chosen: candidates, and parameters drawn from one of them, as a scene takes them."""

    scene: Callable[[Any, jv.Camera], tuple[Any, ...]]
    candidates: list[jv.Candidate]
    draw: Callable[[np.random.Generator, int], Any]
    """`draw(generator, candidate)`: a truth."""
    labels: list[str]


def grid(resolution: int) -> tuple[np.ndarray, dict[str, Any]]:
    """Points of [-1, 1]³, (n, n, n, 3), and the spacing and origin of a volume of them."""
    line = np.linspace(-1, 1, resolution)
    points = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1)
    return points, {"spacing": (2 / (resolution - 1),) * 3, "origin": (-1.0,) * 3}


def marching(volume: jv.Volume, *, labels: bool = False) -> jv.March:
    return jv.March(float(volume.spacing.min()), (jv.AlphaCorrection(labels=labels),), "midpoint")


def materials(resolution: int) -> Problem:
    """How many mean free paths?"""
    points, where = grid(resolution)
    distance = np.stack([np.linalg.norm(points - center, axis=-1) for center in CENTERS])
    labels = np.where(distance.min(axis=0) < RADIUS, 1 + distance.argmin(axis=0), 0)
    volume = jv.Volume(labels.astype(np.float32), labels=labels.astype(np.uint8), **where)
    march = marching(volume, labels=True)

    def of_paths(paths: Sequence[Any]) -> tuple[jv.Material, ...]:
        return tuple(jv.Material(0.5, path, label=at + 1) for at, path in enumerate(paths))

    def scene(given: Any, camera: jv.Camera) -> tuple[Any, ...]:
        functions = {
            each.label: jv.TransferFunction((0, 4), (color, color), jnp.ones(2) / each.mean_free_path)
            for each, color in zip(given, COLORS, strict=True)
        }
        return volume, jv.LabelTransferFunction(functions), camera, march

    def draw(generator: np.random.Generator, candidate: int) -> tuple[jv.Material, ...]:
        classes, (low, high) = CLASSES[candidate], np.log(PATHS)
        while True:
            paths = np.exp(generator.uniform(low, high, max(classes) + 1))
            if np.all(np.diff(np.sort(np.log(paths))) >= np.log(APART)):
                return of_paths(list(paths[list(classes)]))

    candidates = jv.nested_materials(of_paths([START] * len(CENTERS)), CLASSES)
    return Problem(scene, candidates, draw, [str(max(classes) + 1) for classes in CLASSES])


def control_points(resolution: int, numbers: Sequence[int]) -> Problem:
    """How many control points?"""
    points, where = grid(resolution)
    x, y, z = np.moveaxis(points, -1, 0)
    waves = 0.5 + 0.25 * (np.sin(3 * x + y) + np.sin(2 * y - 3 * z + 1))
    volume = jv.Volume(waves.astype(np.float32), **where)
    march = marching(volume)
    start = jv.flat_grey(volume, 2, (0, 1))
    functions = [start]
    for number in numbers[1:]:
        functions.append(jv.refined(functions[-1], number))

    def scene(transfer: Any, camera: jv.Camera) -> tuple[Any, ...]:
        return volume, transfer, camera, march

    def draw(generator: np.random.Generator, candidate: int) -> jv.TransferFunction:
        values = functions[candidate].values
        colors = generator.uniform(0.1, 0.9, (len(values), 3))
        return jv.TransferFunction(values, colors, np.exp(generator.uniform(-2, 1, len(values))))

    return Problem(scene, jv.nested_points(start, numbers), draw, list(map(str, numbers)))


def trial(problem: Problem, size: int, seed: int, noise: float) -> dict[str, Any]:
    """One choice, and its evidence."""
    truth = seed % min(TRUTHS, len(problem.candidates))
    generator = np.random.default_rng([seed, truth])
    parameters = problem.draw(generator, truth)
    views = []
    for position in POSITIONS:
        camera = jv.Camera(position, (0, 0, 0), (0, 0, 1), 32, size=(size, size))
        image = jv.render(*problem.scene(parameters, camera)).image()
        views.append((camera, np.asarray(image) + noise * generator.normal(size=image.shape)))
    residual = jv.ImageResidual(problem.scene, views[:SEEN])
    choice = jv.choose(residual, problem.candidates, views[SEEN:], block=1, max_steps=STEPS)
    print(f"seed {seed}, noise {noise}, truth {problem.candidates[truth].name}\n{choice}", flush=True)
    names = [row.name for row in choice.candidates]
    held_out = [row.held_out_loss for row in choice.candidates]
    keys = "name", "numbers", "determined", "held_out_loss", "standard_error", "bic"
    return {
        "seed": seed,
        "truth": truth,
        "chosen": choice.chosen,
        "bic": names.index(choice.by_bic),
        "least": int(np.argmin(held_out)),
        "candidates": [
            {key: getattr(row, key) for key in keys} | {"training_loss": row.fit.loss}
            for row in choice.candidates
        ],
    }


def summary(trials: list[dict[str, Any]]) -> dict[str, dict[str, int]]:
    """By each rule: in how many trials the truth was chosen, and a model with more parameters."""
    return {
        rule: {
            "truth": sum(trial[rule] == trial["truth"] for trial in trials),
            "more": sum(trial[rule] > trial["truth"] for trial in trials),
        }
        for rule in RULES
    }


def draw(result: dict[str, Any], path: Path) -> None:
    """Held-out losses of all candidates, relative to the truth's, and how often each rule chose the truth."""
    problems = result["problems"]
    figure, axes = charts.panels(len(problems), 3, 11, 3.2 * len(problems))
    for (left, middle, right), (name, problem) in zip(axes, problems.items(), strict=True):
        numbers = [row["numbers"] for row in next(iter(problem["trials"].values()))[0]["candidates"]]
        for axis, (noise, trials) in zip((left, middle), problem["trials"].items(), strict=True):
            seen = "images without noise" if float(noise) == 0 else f"images with noise of {noise}"
            for trial in trials:
                losses = [max(row["held_out_loss"], LEAST) for row in trial["candidates"]]
                color, at = f"C{trial['truth']}", trial["chosen"]
                axis.plot(losses, f"{color}-", linewidth=0.8, alpha=0.6)
                axis.plot(at, losses[at], f"{color}o" if at == trial["truth"] else f"{color}X", markersize=6)
            axis.set(yscale="log", xticks=range(len(numbers)), xticklabels=problem["labels"])
            axis.set(xlabel=f"{name} of the fitted model", ylabel="loss in held-out views", title=seen)
        for truth, label in enumerate(problem["labels"][:TRUTHS]):
            left.plot([], [], f"C{truth}o-", label=f"truth {label}")
        left.legend(fontsize=7, title="marker: chosen\n(a cross: not the truth)", title_fontsize=7)
        width = 0.35
        for shift, (noise, counts) in enumerate(problem["summary"].items()):
            places = np.arange(len(RULES)) + (shift - 0.5) * width
            right.bar(
                places, [c["truth"] for c in counts.values()], width, color=f"C{shift + 4}", label=noise
            )
            more = [c["more"] for c in counts.values()]
            truths = [c["truth"] for c in counts.values()]
            right.bar(places, more, width, truths, color="none", edgecolor=f"C{shift + 4}", hatch="////")
        right.set(xticks=range(len(RULES)), ylabel="trials")
        right.set_title("filled: truth chosen; hatched: too many", fontsize=9)
        right.set_xticklabels(["choose", "BIC", "least held-out loss"], fontsize=8)
        right.set_ylim(0, 1.25 * right.get_ylim()[1])
        right.legend(fontsize=7, title="noise", title_fontsize=7, loc="upper center", ncols=2)
    charts.save(figure, path)


@experiment(
    draw,
    size=10,
    resolution=10,
    trials={"type": int, "default": 10, "help": "truths of each kind"},
    points=POINTS,
    quick={"size": 8, "resolution": 8, "trials": 1, "points": POINTS[:2]},
)
def main(chosen: Namespace) -> dict[str, Any]:
    problems: dict[str, Any] = {}
    seeds = range(chosen.seed, chosen.seed + chosen.trials)
    for name, problem in (
        ("mean free paths", materials(chosen.resolution)),
        ("control points", control_points(chosen.resolution, chosen.points)),
    ):
        trials = {
            f"{noise:g}": [trial(problem, chosen.size, seed, noise) for seed in seeds]
            for noise in (NOISE, 0.0)
        }
        counts = {noise: summary(of_noise) for noise, of_noise in trials.items()}
        problems[name] = {"labels": problem.labels, "summary": counts, "trials": trials}
        show(counts, name, "noise")
    return {
        "image": [chosen.size] * 2,
        "resolution": chosen.resolution,
        "training views": SEEN,
        "held-out views": len(POSITIONS) - SEEN,
        "goal": f"the truth in {GOAL} of 10 trials with noise, and never more without",
        "problems": problems,
    }
