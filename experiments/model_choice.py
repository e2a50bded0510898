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
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxvol as jv

from . import charts
from .choice import Candidate, choose, nested_points, refined
from .harness import experiment
from .scenes import grid, on_cube


NOISE = 0.02
"""Standard deviation of the noise of each pixel and channel; white is 1."""
CENTERS = ((-0.45, 0, -0.2), (0.4, 0.2, -0.3), (0, 0, 0.5), (0.3, -0.5, 0.2))
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
RULES = ("chosen", "bic", "least")
"""Of each trial: what is chosen by `choose`, by BIC, and by the least held-out loss."""


class Problem(NamedTuple):
    """What is to be chosen: candidates, and parameters drawn from one of them, as a scene takes them."""

    scene: Callable[[Any, jv.Camera], tuple[Any, ...]]
    candidates: list[Candidate]
    draw: Callable[[np.random.Generator, int], Any]
    """`draw(generator, candidate)`: a truth."""
    labels: list[str]


def marching(volume: jv.Volume, *, labels: bool = False) -> jv.March:
    return jv.March(float(volume.spacing.min()), (jv.AlphaCorrection(labels=labels),), "midpoint")


def materials(resolution: int) -> Problem:
    """How many mean free paths?"""
    points = np.stack(grid(resolution), axis=-1)
    distance = np.stack([np.linalg.norm(points - center, axis=-1) for center in CENTERS])
    labels = np.where(distance.min(axis=0) < 0.4, 1 + distance.argmin(axis=0), 0)
    volume = on_cube(labels.astype(np.float32), labels.astype(np.uint8))
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

    candidates = nested_materials(of_paths([START] * len(CENTERS)), CLASSES)
    return Problem(scene, candidates, draw, [str(max(classes) + 1) for classes in CLASSES])


def nested_materials(parts: Sequence[jv.Material], partitions: Sequence[Sequence[int]]) -> list[Candidate]:
    """Candidates in which more and more materials have a mean free path of their own. `partitions`: for each
    the class of each material, numbered from 0 on, which divide those of the one before."""

    def first_of_each(materials: Sequence[Any], classes: Sequence[int]) -> tuple[Any, ...]:
        return tuple(materials[classes.index(number)] for number in range(max(classes) + 1))

    def expand(classes: Sequence[int], found: Sequence[Any]) -> tuple[Any, ...]:
        paths = [found[number].mean_free_path for number in classes]
        return tuple(
            eqx.tree_at(lambda m: m.mean_free_path, each, path)
            for each, path in zip(parts, paths, strict=True)
        )

    def grow(before: Sequence[int], classes: Sequence[int], found: Sequence[Any]) -> tuple[Any, ...]:
        return first_of_each(expand(before, found), classes)

    made = []
    for before, classes in zip([None, *partitions], partitions, strict=False):
        start: dict[str, Any] = {"start": first_of_each(parts, classes)}
        start = start if before is None else {"grow": partial(grow, before, classes)}
        made.append(Candidate(f"{max(classes) + 1} classes", expand=partial(expand, classes), **start))
    return made


def control_points(resolution: int, numbers: Sequence[int]) -> Problem:
    """How many control points?"""
    x, y, z = grid(resolution)
    waves = 0.5 + 0.25 * (np.sin(3 * x + y) + np.sin(2 * y - 3 * z + 1))
    volume = on_cube(waves.astype(np.float32))
    march = marching(volume)
    functions = [jv.flat_grey(volume, 2, (0, 1))]
    for number in numbers[1:]:
        functions.append(refined(functions[-1], number))

    def scene(transfer: Any, camera: jv.Camera) -> tuple[Any, ...]:
        return volume, transfer, camera, march

    def draw(generator: np.random.Generator, candidate: int) -> jv.TransferFunction:
        values = functions[candidate].values
        colors = generator.uniform(0.1, 0.9, (len(values), 3))
        return jv.TransferFunction(values, colors, np.exp(generator.uniform(-2, 1, len(values))))

    return Problem(scene, nested_points(functions[0], numbers), draw, list(map(str, numbers)))


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

    def residual(some: list[Any]) -> jv.ImageResidual:
        return jv.ImageResidual(problem.scene, some)

    how: dict[str, Any] = {"views": views[:SEEN], "block": 1, "max_steps": 40}
    choice = choose(residual, problem.candidates, views[SEEN:], **how)
    print(f"seed {seed}, noise {noise}, truth {problem.candidates[truth].name}\n{choice}", flush=True)
    # of independent Gaussian residuals of one unknown variance; losses below -80 dB count as equal
    references = residual(views[:SEEN]).references
    count, least = references.count, (1e-4 * references.scale()) ** 2
    rows = [
        {
            "name": row.name,
            "held_out_loss": row.held_out_loss,
            "bic": float(count * np.log(max(2 * row.fit.loss, least)) + row.numbers * np.log(count)),
        }
        for row in choice.candidates
    ]
    return {
        "seed": seed,
        "truth": truth,
        "chosen": choice.chosen,
        "bic": int(np.argmin([row["bic"] for row in rows])),
        "least": int(np.argmin([row["held_out_loss"] for row in rows])),
        "candidates": rows,
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


def draw(result: dict[str, Any]) -> Any:
    """Held-out losses of all candidates, relative to the truth's, and how often each rule chose the truth."""
    problems = result["problems"]
    figure, axes = charts.panels(len(problems), 3, 11, 3.2 * len(problems))
    for (left, middle, right), (name, problem) in zip(axes, problems.items(), strict=True):
        labels = problem["labels"]
        for panel, (noise, trials) in zip((left, middle), problem["trials"].items(), strict=True):
            for trial in trials:
                losses = [max(row["held_out_loss"], 1e-16) for row in trial["candidates"]]  # 0: an exact fit
                color, at = f"C{trial['truth']}", trial["chosen"]
                panel.plot(losses, f"{color}-", linewidth=0.8, alpha=0.6)
                panel.plot(at, losses[at], f"{color}o" if at == trial["truth"] else f"{color}X", markersize=6)
            seen = "without noise" if float(noise) == 0 else f"with noise of {noise}"
            panel.set(yscale="log", xticks=range(len(labels)), xticklabels=labels, title=f"images {seen}")
            panel.set(xlabel=f"{name} of the fitted model", ylabel="loss in held-out views")
        for truth, label in enumerate(labels[:TRUTHS]):
            left.plot([], [], f"C{truth}o-", label=f"truth {label}")
        left.legend(title="marker: chosen\n(a cross: not the truth)")
        width = 0.35
        for number, (noise, counts) in enumerate(problem["summary"].items()):
            at, color = np.arange(len(RULES)) + (number - 0.5) * width, f"C{number + 4}"
            right_, more = ([count[key] for count in counts.values()] for key in ("truth", "more"))
            right.bar(at, right_, width, color=color, label=noise)
            right.bar(at, more, width, right_, color="none", edgecolor=color, hatch="////")
        right.set(xticks=range(len(RULES)), xticklabels=["choose", "BIC", "least\nheld-out loss"])
        right.set(ylabel="trials", title="filled: truth chosen; hatched: too many")
        right.set_ylim(0, 1.5 * right.get_ylim()[1])
        right.legend(title="noise", loc="upper center", ncols=2)
    return figure


@experiment(
    size=10,
    resolution=10,
    trials={"type": int, "default": 10, "help": "truths of each kind"},
    points=POINTS,
    quick={"size": 8, "resolution": 8, "trials": 1, "points": POINTS[:2]},
)
def main(chosen: Namespace) -> dict[str, Any]:
    found: dict[str, Any] = {}
    seeds = range(chosen.seed, chosen.seed + chosen.trials)
    problems = {"mean free paths": materials(chosen.resolution)}
    problems["control points"] = control_points(chosen.resolution, chosen.points)
    for name, problem in problems.items():
        trials = {f"{n:g}": [trial(problem, chosen.size, seed, n) for seed in seeds] for n in (NOISE, 0.0)}
        counts = {noise: summary(of_noise) for noise, of_noise in trials.items()}
        found[name] = {"labels": problem.labels, "summary": counts, "trials": trials}
    return {"goal": "the truth in 9 of 10 trials with noise, and never more without", "problems": found}
