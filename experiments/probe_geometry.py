"""Is the geometry of a swept probe found from images, and what do the images leave open?

A phantom of spheres and wires, with speckle, is acquired by a known probe. Reference images show it in the
world, from two cameras whose places are known, with noise of 1 %. A fit starts 20 % off (`a`, `b`, the last
depth; each end of both ranges of angles by 20 % of half the range): in all numbers or in one of them, in
random directions, each time with speckle and noise of its own. Images are compared blurred at first, and as
they are at last. The goal is every number within 0.5 % (angles: of half their range). References are
converged: their steps are shorter than those of the fit, which are half a voxel.

The covariance says how well each number is determined, if at all. It is compared with the errors, and
measured in variants of the problem that leave something open: all eight numbers of the map free; cameras
known only up to scale; and shells, which are alike at all angles, seen through a window.
"""

import warnings
from argparse import Namespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxvol as jv

from . import harness
from .harness import experiment


OFF, GOAL, NOISE = 0.2, 0.005, 0.01
VOXELS = 0.5
"""Step of the fit, in voxels along a beam. At two voxels, speckle is sampled so sparsely that a derivative
does not tell how blurred images change."""
BLURS = (1 / 8, 1 / 32, None)
"""From coarse to fine. The last one is without blur, since neighbouring pixels of blurred noise are not
independent, as the covariance supposes."""
HOW = {"max_steps": 100, "rtol": 1e-5, "patience": 4}
NAMES = ("a", "b", "first β", "last β", "first σ", "last σ", "last γ")
ENDINGS: Any = (
    *(".a", ".b", ".beta_range[0]", ".beta_range[1]", ".sigma_range[0]", ".sigma_range[1]"),
    (".gamma_range", ".gamma_range[1]"),
)
"""How `Uncertainty.standard_errors` calls them."""
PLACES = ((60, -250, -110), (0, 0, 85), (1, 0, 0)), ((-220, 120, 40), (0, 0, 85), (0, 0, 1))
"""Position, focal point and up of the cameras, mm."""
TISSUE = [
    (20, (0.1, 0.1, 0.3), 0.0),
    (80, (0.6, 0.4, 0.3), 0.02),
    (140, (0.9, 0.7, 0.5), 0.15),
    (255, (1.0, 1.0, 0.9), 0.5),
]


class Scene(eqx.Module):
    """What a probe shows: the scene of an `ImageResidual`."""

    volume: jv.Volume
    transfer: jv.TransferFunction
    step: float

    def __call__(self, probe: jv.ToroidalMap, camera: jv.Camera) -> Any:
        march = jv.March(self.step, (probe, jv.AlphaCorrection()), "midpoint")
        return self.volume, self.transfer, camera, march


def coarse_to_fine(residual: jv.ImageResidual, start: Any, blurs: Any, **options: Any) -> list[jv.Fit]:
    """Fits to images blurred less and less, each from where the last one ended."""
    fits: list[jv.Fit] = []
    for blur in blurs:
        start = fits[-1].parameters if fits else start
        fits.append(jv.fit(residual.blurred(blur), start, **options))
    return fits


def phantom(
    resolution: int, name: str = "wires", *, speckle: bool = True, seed: int = 0
) -> tuple[Scene, jv.ToroidalMap]:
    shape = 2 * resolution // 5, resolution // 2, resolution
    volume, probe = jv.toroidal_phantom(name, shape, speckle=speckle, seed=seed)
    transfer = jv.TransferFunction.from_points(TISSUE)
    return Scene(volume, transfer, VOXELS * 100 / (resolution - 1)), probe


def cameras(size: int) -> list[jv.Camera]:
    return [jv.Camera(*place, 35.0, size=(size, size)) for place in PLACES]


def views(
    scene: Scene, probe: jv.ToroidalMap, seen: list[jv.Camera], noise: float, seed: int, finer: int = 1
) -> list[Any]:
    """References with their cameras, at steps so many times finer."""
    rng, found = np.random.default_rng(seed), []
    fine = Scene(scene.volume, scene.transfer, scene.step / finer)
    for camera in seen:
        image = jv.render(*fine(probe, camera), outputs="rgba").image()
        found.append((camera, image + noise * rng.normal(size=image.shape)))
    return found


def numbers(probe: jv.ToroidalMap) -> np.ndarray:
    """The seven numbers, named in `NAMES`."""
    ranges = probe.beta_range, probe.sigma_range, probe.gamma_range[1:]
    return np.concatenate([np.atleast_1d(np.asarray(n, np.float64)) for n in (probe.a, probe.b, *ranges)])


def scales(probe: jv.ToroidalMap) -> np.ndarray:
    """What errors are relative to: lengths themselves, and half of each range of angles."""
    found = np.abs(numbers(probe))
    for ends in (slice(2, 4), slice(4, 6)):
        found[ends] = np.ptp(numbers(probe)[ends]) / 2
    return found


def moved(probe: jv.ToroidalMap, signs: np.ndarray) -> jv.ToroidalMap:
    """The probe with each number `OFF` away, in these directions."""
    a, b, b0, b1, s0, s1, last = numbers(probe) + OFF * signs * scales(probe)
    return jv.ToroidalMap(a, b, (b0, b1), (s0, s1), (probe.gamma_range[0], last))


def recovered(
    scene: Scene, targets: list[Any], truth: jv.ToroidalMap, start: jv.ToroidalMap
) -> dict[str, Any]:
    """Errors of all numbers and their standard errors, relative to `scales`, of the fit from this start."""
    *_, fit = fits = coarse_to_fine(jv.ImageResidual(scene, targets), start, BLURS, **HOW)
    assert fit.uncertainty is not None
    errors = (numbers(fit.parameters) - numbers(truth)) / scales(truth)
    deviations = np.sqrt(np.diag(fit.uncertainty.covariance)) / scales(truth)
    return {
        "errors": dict(zip(NAMES, errors.tolist(), strict=True)),
        "standard errors": dict(zip(NAMES, deviations.tolist(), strict=True)),
        "worst": float(np.abs(errors).max()),
        "undetermined": fit.uncertainty.undetermined,
        "steps": sum(len(each.losses) for each in fits),
        "message": fit.message,
    }


def directions(rng: np.random.Generator, all_off: int) -> dict[str, np.ndarray]:
    """Starts, by name: which numbers are off, and to which side."""
    together = {f"all, {n}": rng.choice([-1.0, 1.0], len(NAMES)) for n in range(all_off)}
    one = np.diag(rng.choice([-1.0, 1.0], len(NAMES)))
    return together | dict(zip(NAMES, one, strict=True))


def determined(residual: Any, at: Any, truth: jv.ToroidalMap, **options: Any) -> dict[str, Any]:
    """What a residual leaves open at the truth: the directions, and the standard error of each of the seven
    numbers, relative to `scales`: infinite where it is not determined."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that directions are not determined is what is asked here
        found = jv.fit(residual, at, **HOW | {"max_steps": 1}, **options).uncertainty
    assert found is not None
    errors = [next(e for n, e in found.standard_errors.items() if n.endswith(ends)) for ends in ENDINGS]
    relative = dict(zip(NAMES, np.divide(errors, scales(truth)).tolist(), strict=True))
    return {"undetermined": found.undetermined, "standard errors": relative}


class UpToScale(eqx.Module):
    """A scene from cameras whose positions are known but for a factor about the probe's origin."""

    scene: Scene

    def __call__(self, parameters: Any, camera: jv.Camera) -> Any:
        probe, factor = parameters
        places = factor * camera.position, factor * camera.focal_point
        scaled = eqx.tree_at(lambda c: (c.position, c.focal_point), camera, places)
        volume, transfer, scaled, march = self.scene(probe, scaled)
        # extinction per length: an object twice the size is as opaque as before
        transfer = eqx.tree_at(lambda t: t.extinction, transfer, transfer.extinction / factor)
        march = eqx.tree_at(lambda m: m.step, march, march.step * factor)
        return volume, transfer, scaled, march


VARIANTS = "all eight numbers", "cameras up to scale", "shells through a window", "spheres and wires"


def left_open(variant: str, resolution: int, size: int, seed: int) -> dict[str, Any]:
    """What a variant of the problem leaves open."""
    seen, options = cameras(size), {}
    if variant == "shells through a window":  # of equal depth, their ends out of view
        scene, probe = phantom(resolution, "shells", speckle=False)
        seen = [jv.Camera((20, 12, 350), (5, 3, 85), (1, 0, 0), 8.0, size=(size, size))]
    else:
        scene, probe = phantom(resolution)
    targets = views(scene, probe, seen, NOISE, seed)
    if variant == "cameras up to scale":
        residual = jv.ImageResidual(UpToScale(scene), targets)
        return determined(residual, (probe, jnp.float32(1.0)), probe)
    if variant == "all eight numbers":
        options["constraints"] = jax.tree.map(lambda _: jv.Unconstrained(), probe)
    return determined(jv.ImageResidual(scene, targets), probe, probe, **options)


@experiment(size=32, resolution=64, starts=5, quick={"size": 12, "resolution": 24, "starts": 1})
def main(chosen: Namespace) -> dict[str, Any]:
    starts, variants = directions(np.random.default_rng(chosen.seed), chosen.starts), VARIANTS
    if chosen.quick:  # each of the other variants takes a program of its own
        starts, variants = dict(list(starts.items())[:1]), ("spheres and wires",)

    rows: dict[str, Any] = {}
    for number, (name, signs) in enumerate(starts.items()):
        scene, truth = phantom(chosen.resolution, seed=chosen.seed + number)
        targets = views(scene, truth, cameras(chosen.size), NOISE, chosen.seed + number, harness.FINER)
        rows[name] = recovered(scene, targets, truth, moved(truth, signs))
    answers = {name: left_open(name, chosen.resolution, chosen.size, chosen.seed) for name in variants}
    return {"goal": GOAL, "recovered": rows, "left open": answers}
