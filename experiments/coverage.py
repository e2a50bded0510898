"""Do reported standard errors cover the truth?

A model that can make the references is fitted to them, with other noise for each of 40 seeds. The truth
should lie within two standard errors in some 95 % of the fits. Two models: opacities and colours of three
materials of the head phantom (twelve numbers), by their transfer function; and the mean free path of a ball
lit by scatterer templates. Three kinds of noise: equal in all pixels; growing with brightness, tenfold from
black to the brightest pixel, in each colour of its own; and as that of a path tracer, proportional to the
brightness and the same in all three colours, so that the background has none. Then, the same mean free path
is fitted by the path tracer, to images by it.

Two standard errors are compared: that of `standard_errors` (the sandwich), and that for equal noise. The
reduced χ² is recorded, too: with well-specified models, a warning of a misfit is a false alarm.
"""

import warnings
from argparse import Namespace
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol.fitting.uncertainty import MISFIT

from . import charts
from .harness import experiment
from .mean_free_path import balls, cameras, lights, marching, templates


SIGMA = 0.02
"""Largest standard deviation of noise, relative to the brightest pixel."""
RANGE = 10.0
"""Largest standard deviation over that in black pixels, where it isn't equal."""
GOAL = (0.85, 1.0)
ROBUST, EQUAL = "standard_errors", "covariance_of_equal_noise"
BACKGROUND = (0.0, 0.0, 0.0)


class Model(NamedTuple):
    """A scene, its true parameters, where fits start, and the views' cameras."""

    scene: Callable[[Any, jv.Camera], tuple]
    truth: Any
    start: Any
    cameras: list[jv.Camera]

    def clean(self, camera: jv.Camera) -> np.ndarray:
        volume, transfer, camera, march, *lighting = self.scene(self.truth, camera)
        lit = lighting[0] if lighting else None
        return np.asarray(jv.render(volume, transfer, camera, march, lighting=lit).image(BACKGROUND))


def three_opacities(size: int, resolution: int) -> Model:
    """The head phantom, whose air is transparent: skin, muscle and bone are seen through each other."""
    volume = jv.phantom("head", resolution)
    march = jv.March(2 / resolution, (jv.AlphaCorrection(),), "midpoint")
    values = np.array([0.0, 40.0, 78.0, 130.0, 225.0])
    colors = [(0, 0, 0), (0, 0, 0), (0.85, 0.5, 0.35), (0.7, 0.3, 0.3), (0.9, 0.9, 0.8)]
    truth = jv.TransferFunction(values, colors, [0, 0, 0.4, 0.8, 4])
    start = jv.TransferFunction(values, 0.25 + 0.5 * np.array(colors), [0, 0, 0.6, 0.6, 3])
    views = [jv.Camera.looking_at(volume, at, size=(size, size)) for at in ((0.5, -1, 0.4), (-1, 0.2, 0.1))]

    def scene(free: dict[str, Any], camera: jv.Camera) -> tuple:
        fixed = start.colors[:2], start.extinction[:2]
        both = (
            jnp.concatenate(pair) for pair in zip(fixed, (free["color"], free["extinction"]), strict=True)
        )
        return volume, jv.TransferFunction(values, *both), camera, march

    def free(transfer: jv.TransferFunction) -> dict[str, Any]:
        return {"color": transfer.colors[2:], "extinction": transfer.extinction[2:]}

    return Model(scene, free(truth), free(start), views)


def mean_free_path(size: int, resolution: int) -> Model:
    """A ball five mean free paths thick, lit by templates."""
    volume = balls(resolution, [(200, (0, 0, 0), 0.7)])
    march = marching(volume)
    transfer = jv.TransferFunction((60, 140, 255), np.tile((0.8, 0.6, 0.5), (3, 1)), (0.0, 3.5, 3.5))

    def scene(material: Any, camera: jv.Camera) -> tuple:
        return volume, transfer, camera, march, templates(material)

    truth, start = (jv.Material(0.5, path, 1.0, values=(60, 256)) for path in (0.28, 0.4))
    return Model(scene, truth, start, cameras(size))


MODELS = {"three opacities": three_opacities, "mean free path": mean_free_path}


def equal(image: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations relative to the largest one, and noise of unit variance."""
    return np.ones_like(image), rng.normal(size=image.shape)


def bright(image: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return (1 + (RANGE - 1) * image / image.max()) / RANGE, rng.normal(size=image.shape)


def traced(image: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return image / image.max(), np.tile(rng.normal(size=(*image.shape[:2], 1)), 3)


NOISES = {"equal": equal, "tenfold with brightness": bright, "of colours together": traced}


def coverage(model: Model, noise: Callable[..., tuple], seeds: int, first: int = 0) -> dict[str, Any]:
    """Fits to references with other noise each: how far from the truth, in standard errors of both kinds."""
    clean = [model.clean(camera) for camera in model.cameras]

    def fitted(seed: int) -> jv.Fit:
        rng = np.random.default_rng(seed)
        pairs = [noise(image, rng) for image in clean]
        sigmas = [SIGMA * image.max() * sigma for image, (sigma, _) in zip(clean, pairs, strict=True)]
        images = [i + sigma * unit for i, sigma, (_, unit) in zip(clean, sigmas, pairs, strict=True)]
        views = list(zip(model.cameras, images, strict=True))
        return jv.fit(jv.ImageResidual(model.scene, views, BACKGROUND, noise=sigmas), model.start, patience=4)

    return covered(fitted, model.truth, range(first, first + seeds))


def of_path_tracing(size: int, resolution: int, seeds: int, first: int = 0) -> dict[str, Any]:
    """Fits by the path tracer to images by it, of other paths each, and with others in each step."""
    ball = mean_free_path(size, resolution)
    volume, transfer, *_ = ball.scene(ball.truth, ball.cameras[0])
    dark = jv.Material(0.5, 0.28, 1.0, values=(60, 256))

    def scene(material: jv.Material, camera: jv.Camera) -> tuple:
        return volume, transfer, camera, lights(), material

    def fitted(seed: int) -> jv.Fit:
        views = [
            (camera, jv.path_trace(*scene(dark, camera)[:4], materials=dark, paths=128, key=2 * seed + at))
            for at, camera in enumerate(ball.cameras)
        ]
        residual = jv.PathTracedResidual(scene, views, BACKGROUND, key=1000 + seed)
        return jv.fit(residual, ball.start, max_steps=48)

    return covered(fitted, ball.truth, range(first, first + seeds))


def covered(fitted: Callable[[int], jv.Fit], truth: Any, seeds: range) -> dict[str, Any]:
    """How far the fits of these seeds are from the truth."""
    off: dict[str, list[np.ndarray]] = {ROBUST: [], EQUAL: []}
    chi_squared, alarms, steps, names = [], 0, [], []
    for seed in seeds:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            found = fitted(seed)
        alarms += any(str(warning.message).startswith(MISFIT) for warning in caught)
        told = found.uncertainty
        assert told is not None
        names = told.names
        error = numbers(found.parameters) - numbers(truth)
        for name, covariance in ((ROBUST, told.covariance), (EQUAL, told.covariance_of_equal_noise)):
            off[name].append(error / np.sqrt(np.diag(covariance)))
        chi_squared.append(told.reduced_chi_squared)
        steps.append(len(found.losses))
    within = {name: np.mean(np.abs(each) < 2, axis=0) for name, each in off.items()}
    return {
        "fits": len(seeds),
        "within two standard errors": {
            n: dict(zip(names, w.tolist(), strict=True)) for n, w in within.items()
        },
        "all": {name: float(np.mean(each)) for name, each in within.items()},
        "error in standard errors, rms": {n: float(np.sqrt(np.mean(np.square(e)))) for n, e in off.items()},
        "reduced chi-squared": [min(chi_squared), float(np.mean(chi_squared)), max(chi_squared)],
        "false alarms": alarms,
        "steps, median": float(np.median(steps)),
    }


def numbers(parameters: Any) -> np.ndarray:
    """The free numbers of a model's parameters, in the order of `Uncertainty.names`."""
    if isinstance(parameters, jv.Material):
        return np.ravel(parameters.mean_free_path)
    return np.concatenate([np.ravel(parameters["color"]), np.ravel(parameters["extinction"])])


def draw(result: dict[str, Any]) -> Any:
    models = result["coverage"]
    figure, (axes,) = charts.panels(1, len(models), 4.5 * len(models), 3.6)
    for panel, (model, rows) in zip(axes, models.items(), strict=True):
        for at, row in enumerate(rows.values()):
            for shift, (name, color) in enumerate(((ROBUST, "C0"), (EQUAL, "C3"))):
                found = list(row["within two standard errors"][name].values())
                label = name if at == 0 else None
                x = np.full(len(found), at + 0.2 * (shift - 0.5))
                panel.plot(x, found, "o", color=color, alpha=0.5, label=label)
        panel.axhspan(*result["goal"], color="0.9", zorder=0)
        panel.axhline(0.954, color="k", linewidth=0.8, linestyle=":")
        panel.set_xticks(range(len(rows)), [name.replace(" ", "\n", 1) for name in rows])
        panel.set(ylabel="fits with the truth within\ntwo standard errors", ylim=(0, 1.03), title=model)
        panel.legend(loc="lower left")
    return figure


@experiment(
    size=24,
    resolution=24,
    fits={"type": int, "default": 40, "help": "fits of each model with each noise"},
    quick={"size": 10, "resolution": 12, "fits": 2},
)
def main(chosen: Namespace) -> dict[str, Any]:
    rows = {
        name: {
            kind: coverage(model(chosen.size, chosen.resolution), noise, chosen.fits, chosen.seed)
            for kind, noise in NOISES.items()
        }
        for name, model in MODELS.items()
    }
    own = of_path_tracing(chosen.size, chosen.resolution, chosen.fits, chosen.seed)
    rows["mean free path, by the path tracer"] = {"of paths": own}
    return {"goal": GOAL, "coverage": rows}
