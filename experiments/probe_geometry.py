"""Is the geometry of a swept probe found from images, and what do the images leave open?

A phantom of spheres and wires, with speckle, is acquired by a known probe. Reference images show it in the
world, from two cameras whose places are known; the fit starts with every number of the probe 20 % off (`a`,
`b`, the last depth; each end of both ranges of angles by 20 % of half the range, in random directions), and
images are compared blurred at first. The goal is every number within 0.5 % (angles: of half their range).
References are images of the same voxels by the same march; converged images of them; and images of the
phantom as drawn, without speckle, as of a test object whose drawing is known. All have noise of 1 %.

What images do not determine is measured in three variants of the problem: all eight numbers of the map free;
cameras known only up to scale; and shells, which are alike at all angles, seen through a window.

A real scan, `us_aplio_convex`, has an elevation angle whose meaning is not documented: half the range or all
of it. Both readings are taken as the truth of reference images, and a fit starts from the other; and
`elevation_angle` measures what the voxels alone say. It is read from the folder that JAXVOL_DATA names.
"""

import time
import warnings
from argparse import Namespace
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxvol as jv

from . import common, elevation_angle
from .common import plt


OFF, GOAL, NOISE = 0.2, 0.005, 0.01
BLURS = (1 / 8, 1 / 32)
"""Standard deviations, in parts of the image's height, from coarse to fine."""
STEPS = 100
NAMES = ("a", "b", "first β", "last β", "first σ", "last σ", "last γ")
PLACES = ((60, -250, -110), (0, 0, 85), (1, 0, 0)), ((-220, 120, 40), (0, 0, 85), (0, 0, 1))
"""Position, focal point and up of the cameras, mm."""
SCAN = "us_aplio_convex_239x128x91_uint8.raw.gz"
TISSUE = [
    (20, (0.1, 0.1, 0.3), 0.0),
    (80, (0.6, 0.4, 0.3), 0.02),
    (140, (0.9, 0.7, 0.5), 0.15),
    (255, (1.0, 1.0, 0.9), 0.5),
]

CONCLUSION = (
    "The voxels alone do not settle the reading. Shells bow towards the probe, alike on both sides, and more "
    "with each echo, as reverberation between two surfaces would whose distance falls off to both sides. A "
    "shell with its centre off the motor axis explains the bow under either reading, and the two windows "
    "prefer different ones; only a plane under the reading as half an angle is ruled out (it leaves more "
    "than twice as much). Planes would be about as far apart at the probe's face as beams under the reading "
    "as half an angle, and half as far under the other, which proves nothing. What would settle it: "
    "an image of an "
    "object of known size and place across the sweep, or the manufacturer's field of view of the probe."
)


class Scene(eqx.Module):
    """What a probe shows: the scene of an `ImageResidual`."""

    volume: jv.Volume
    transfer: jv.TransferFunction
    step: float

    def __call__(self, probe: jv.ToroidalMap, camera: jv.Camera) -> Any:
        return self.volume, self.transfer, camera, self.march(probe, self.step)

    def march(self, probe: jv.ToroidalMap, step: float) -> jv.March:
        return jv.March(step, (probe, jv.AlphaCorrection()), "midpoint")

    def reference(self, probe: jv.ToroidalMap, camera: jv.Camera, finer: int = 1) -> jv.Rendering:
        """The image at steps so many times finer."""
        march = self.march(probe, self.step / finer)
        return jv.render(self.volume, self.transfer, camera, march, outputs="rgba")


def phantom(resolution: int, name: str = "wires", *, speckle: bool = True) -> tuple[Scene, jv.ToroidalMap]:
    shape = 2 * resolution // 5, resolution // 2, resolution
    volume, probe = jv.toroidal_phantom(name, shape, speckle=speckle)
    transfer = jv.TransferFunction.from_points(TISSUE)
    return Scene(volume, transfer, 2 * 100 / (resolution - 1)), probe


def cameras(size: int) -> list[jv.Camera]:
    return [jv.Camera(*place, 35.0, size=(size, size)) for place in PLACES]


def views(
    scene: Scene, probe: jv.ToroidalMap, size: int, noise: float, seed: int, finer: int = 1
) -> list[Any]:
    """References with their cameras."""
    rng = np.random.default_rng(seed)
    images = [(camera, scene.reference(probe, camera, finer).image()) for camera in cameras(size)]
    return [(camera, image + noise * rng.normal(size=image.shape)) for camera, image in images]


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


def found_from(scene: Scene, targets: list[Any], start: jv.ToroidalMap) -> tuple[jv.Fit, int]:
    """The last fit of those from coarse to fine, and the number of steps of all."""
    fits: list[jv.Fit] = []
    for blur in BLURS:
        residual = jv.ImageResidual(scene, targets, blur=blur)
        fits.append(jv.fit(residual, start, max_steps=STEPS, rtol=1e-5))
        start = fits[-1].parameters
    return fits[-1], sum(len(fit.losses) for fit in fits)


def recovered(
    scene: Scene, targets: list[Any], truth: jv.ToroidalMap, starts: list[jv.ToroidalMap]
) -> list[dict[str, Any]]:
    """For each start, errors of all numbers and their standard errors, relative to `scales`."""
    rows = []
    for start in starts:
        begun = time.perf_counter()
        fit, steps = found_from(scene, targets, start)
        assert fit.uncertainty is not None
        errors = (numbers(fit.parameters) - numbers(truth)) / scales(truth)
        deviations = np.sqrt(np.diag(fit.uncertainty.covariance)) / scales(truth)
        rows.append(
            {
                "errors": dict(zip(NAMES, errors.tolist(), strict=True)),
                "standard errors": dict(zip(NAMES, deviations.tolist(), strict=True)),
                "worst": float(np.abs(errors).max()),
                "undetermined": fit.uncertainty.undetermined,
                "steps": steps,
                "seconds": round(time.perf_counter() - begun, 2),
                "message": fit.message,
            }
        )
    return rows


def determined(residual: Any, at: Any, **options: Any) -> dict[str, Any]:
    """Which parameters a residual leaves open, at the truth."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that directions are not determined is what is asked here
        fit = jv.fit(residual, at, max_steps=1, **options)
    assert fit.uncertainty is not None
    return {"undetermined": fit.uncertainty.undetermined, "standard errors": fit.uncertainty.standard_errors}


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


def observable(resolution: int, size: int, seed: int) -> dict[str, Any]:
    """What three variants of the problem leave open."""
    scene, probe = phantom(resolution)
    targets = views(scene, probe, size, NOISE, seed)
    free = jax.tree.map(lambda _: jv.Unconstrained(), probe)
    shells, _ = phantom(resolution, "shells", speckle=False)
    inside = jv.Camera((20, 12, 350), (5, 3, 85), (1, 0, 0), 8.0, size=(size, size))
    seen = [(inside, shells.reference(probe, inside).image())]
    return {
        "all eight numbers": determined(jv.ImageResidual(scene, targets), probe, constraints=free),
        "cameras up to scale": determined(
            jv.ImageResidual(UpToScale(scene), targets), (probe, jnp.float32(1.0))
        ),
        "shells through a window": determined(jv.ImageResidual(shells, seen), probe),
    }


def real_probe(half: float) -> jv.ToroidalMap:
    """The real scan's, with this half of the range of elevation, degrees."""
    azimuth, elevation = np.deg2rad(elevation_angle.AZIMUTH), np.deg2rad(half)
    beta, sigma = ((np.pi / 2 - angle, np.pi / 2 + angle) for angle in (elevation, azimuth))
    start = elevation_angle.START
    return jv.ToroidalMap(elevation_angle.MOTOR_RADIUS - start, start, beta, sigma, (0, elevation_angle.SPAN))


def real(folder: Path, size: int, seed: int) -> dict[str, Any]:
    """What references in the world, and the voxels alone, say about the scan's elevation angle."""
    data = np.asarray(jv.load(folder / SCAN).data).transpose(2, 1, 0)
    scene = Scene(jv.Volume(np.ascontiguousarray(data)), jv.colormap("gray", (60, 200), (0.0, 0.1)), 2.0)
    readings = {name: real_probe(half) for name, half in elevation_angle.READINGS.items()}
    fits = {}
    for name, truth in readings.items():
        other = next(probe for key, probe in readings.items() if key != name)
        fits[name] = recovered(scene, views(scene, truth, size, NOISE, seed), truth, [other])[0]
    return {
        "references under one reading, start from the other": fits,
        "voxels alone": elevation_angle.measure(data.astype(np.float64)),
        "conclusion": CONCLUSION,
    }


def draw(result: dict[str, Any], path: Path) -> None:
    """Errors of each number beside their standard errors, and the bows of the real scan's shells."""
    figure, axes = plt.subplots(1, 2, figsize=(11, 3.8), layout="constrained")
    for number, (case, rows) in enumerate(result["recovered"].items()):
        at = np.arange(len(NAMES)) + 0.25 * number
        worst = [100 * max(abs(row["errors"][name]) for row in rows) for name in NAMES]
        likely = [100 * max(row["standard errors"][name] for row in rows) for name in NAMES]
        axes[0].bar(at, worst, 0.22, label=f"{case}: worst error of {len(rows)} starts")
        axes[0].plot(at, likely, "k_", markersize=9, label=None if number else "standard error")
    axes[0].axhline(100 * GOAL, color="k", linestyle="--", linewidth=1, label="goal")
    axes[0].set_yscale("log")
    axes[0].set_xticks(np.arange(len(NAMES)) + 0.12, NAMES)
    axes[0].set_title("probe found from 20 % off: error, %", fontsize=9)
    axes[0].legend(fontsize=7)
    if "real scan" in result:
        bows = result["real scan"]["voxels alone"]["bow of the shells, samples"]
        for window, bow in bows.items():
            axes[1].plot(np.linspace(-1, 1, len(bow)), bow, label=f"samples {window}")
        axes[1].set_xlabel("plane of the sweep, from its first to its last", fontsize=8)
        axes[1].legend(fontsize=7)
        axes[1].set_title("us_aplio_convex: shells come later by, samples", fontsize=9)
    else:
        axes[1].axis("off")
    common.save(figure, path)


@common.experiment(
    "probe_geometry",
    "Is the geometry of a swept probe found from images, and what do the images leave open?",
    __doc__,
    size=32,
    resolution=80,
    starts=8,
)
def main(chosen: Namespace) -> common.Answer:
    if chosen.quick:
        chosen.size, chosen.resolution, chosen.starts = 16, 24, 1
    rng = np.random.default_rng(chosen.seed)
    scene, truth = phantom(chosen.resolution)
    drawn, _ = phantom(chosen.resolution, speckle=False)
    starts = [moved(truth, rng.choice([-1.0, 1.0], len(NAMES))) for _ in range(chosen.starts)]
    found = {}
    cases = {"same voxels": (scene, 1), "converged": (scene, common.FINER), "as drawn": (drawn, 1)}
    for case, (source, finer) in cases.items():
        targets = views(source, truth, chosen.size, NOISE, chosen.seed, finer)
        found[case] = recovered(scene, targets, truth, starts)
        share = np.mean([row["worst"] < GOAL for row in found[case]])
        print(f"{case}: {share:.0%} of starts lead back to within {GOAL:.1%}")
        for row in found[case]:
            print(f"{case:14} worst error {row['worst']:8.3%} after {row['steps']} steps: {row['message']}")
    result = {
        "image": [chosen.size, chosen.size],
        "off": OFF,
        "noise": NOISE,
        "goal": GOAL,
        "blurs": BLURS,
        "recovered": found,
        "left open": observable(chosen.resolution, chosen.size, chosen.seed),
    }
    for case, row in result["left open"].items():
        print(f"{case}: {row['undetermined'] or 'everything is determined'}")
    folder = common.data()
    if folder is not None and not chosen.quick:
        result["real scan"] = real(folder, chosen.size, chosen.seed)
        for name, row in result["real scan"]["references under one reading, start from the other"].items():
            print(f"real scan, {name}: worst error {row['worst']:.3%} after {row['steps']} steps")
    return result, partial(draw, result)


if __name__ == "__main__":
    main()
