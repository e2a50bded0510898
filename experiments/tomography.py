"""Is a density recovered from a few X-ray views, compared with filtered back projection and SART?

With a black transfer function whose extinction is the value itself, a volume renders to an X-ray image:
-log(1 - opacity) is the line integral of its values. The head phantom, as a density of 64³ voxels, is
rendered this way by parallel rays from 24 directions around its axis, without noise and as photon counts. It
is recovered by scikit-image's filtered back projection, with the filter that comes nearest to the truth; by
its SART; and by `jv.fit` with L-BFGS and the renderer's gradient with respect to every voxel, whose rays
could come from any cameras.

The views are marched at a sixth of a voxel, the fit at a half. Truth and results share a grid on which values
are trilinear, for the fit as for SART. Under noise both iterations first come near the truth and then fit the
noise, so the nearest and the last error are recorded.
"""

import time
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float
from skimage.transform import iradon, iradon_sart

import jaxvol as jv
from jaxvol.metrics import psnr

from . import charts
from .harness import experiment


DENSEST = 0.1
"""Density of the greatest value, 1/voxel: where the head is thickest, one photon in 14 passes."""
THIN = 0.1
"""Part of the mean density below which the bijection bends. With 1, low densities change too slowly."""
FILTERS = ("ramp", "shepp-logan", "cosine", "hamming", "hann")
METHODS = FBP, SART, OURS = "FBP", "SART", "jaxvol"
STEP, STEP_OF_VIEWS = 0.5, 1 / 6
"""Of the fit, and of the views, in voxels."""

Rays = tuple[Float[Array, "views columns slices 3"], Float[Array, "views columns slices 3"]]
Sinogram = Float[Array, "views columns slices"]
Density = Float[np.ndarray, "n n n"]


def angles(views: int) -> np.ndarray:
    """Directions over half a turn, degrees."""
    return np.linspace(0, 180, views, endpoint=False)


def rays(n: int, views: int) -> Rays:
    """Origins and directions of parallel rays, one through each node of the plane across them. As in
    scikit-image, x points down and y to the right, and the axis runs through node n // 2."""
    turn, across = np.deg2rad(angles(views)), np.arange(n) - n // 2
    ahead = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=-1)[:, None, None]
    aside = np.stack([-np.sin(turn), np.cos(turn), 0 * turn], axis=-1)[:, None, None]
    height = np.arange(n)[:, None] * np.array([0.0, 0.0, 1.0])
    origins = np.array([n // 2, n // 2, 0]) + n * ahead + across[:, None, None] * aside + height
    return jnp.asarray(origins, jnp.float32), jnp.asarray(np.broadcast_to(-ahead, origins.shape), jnp.float32)


def line_integrals(density: Any, rays: Rays, step: float) -> Sinogram:
    """Line integrals of a density, 1/voxel, by rendering it."""
    absorbing = jv.TransferFunction([0.0, 1.0], np.zeros((2, 3)), [0.0, 1.0])
    march = jv.March(step, (jv.AlphaCorrection(),), "midpoint")
    return -jnp.log1p(-jv.render_rays(jv.Volume(density), absorbing, *rays, march).rgba[..., 3])


def counted(sinogram: np.ndarray, photons: float | None, seed: int) -> np.ndarray:
    """Line integrals estimated from photon counts, with `photons` sent along each ray; None for infinitely
    many."""
    if photons is None:
        return sinogram
    counts = np.random.default_rng(seed).poisson(photons * np.exp(-sinogram.astype(float)))
    return np.log(photons / np.maximum(counts, 1)).astype(np.float32)


class Difference(eqx.Module):
    """Line integrals of a density minus the measured ones, over `unit`."""

    rays: Rays
    measured: Sinogram
    unit: Float[Array, ""]

    def __call__(self, density: Array) -> Array:
        return (line_integrals(density, self.rays, STEP) - self.measured) / self.unit


class Progress:
    """Records the error after each iteration, and the seconds of the iterations without the recording."""

    def __init__(self, truth: Density):
        self.truth, self.spent, self.begun = truth, 0.0, time.perf_counter()
        self.rows: list[dict[str, float]] = []
        self.nearest = truth

    def look(self, density: Any) -> None:
        self.spent += time.perf_counter() - self.begun
        density = np.asarray(density)
        error = float(np.sqrt(np.mean((density - self.truth) ** 2)))
        if error < min((row["rmse"] for row in self.rows), default=np.inf):
            self.nearest = density
        self.rows.append({"seconds": round(self.spent, 3), "rmse": error})
        self.begun = time.perf_counter()


def filtered(sinogram: np.ndarray, progress: Progress) -> None:
    """FBP with each filter."""
    for name in FILTERS:
        slices = [iradon(one.T, angles(len(one)), filter_name=name) for one in np.moveaxis(sinogram, 2, 0)]
        progress.look(np.maximum(np.stack(slices, axis=-1), 0))


def algebraic(sinogram: np.ndarray, progress: Progress, sweeps: int) -> None:
    """SART, one sweep over all views after the other."""
    slices = [None] * sinogram.shape[2]
    for _ in range(sweeps):
        slices = [
            iradon_sart(one.T, angles(len(one)), image=image, clip=(0, np.inf))
            for one, image in zip(np.moveaxis(sinogram, 2, 0), slices, strict=True)
        ]
        progress.look(np.stack(slices, axis=-1))


def fitted(sinogram: np.ndarray, progress: Progress, evaluations: int) -> None:
    """L-BFGS from a flat and thin density: `THIN` times the mean density, estimated from the views."""
    views, n, _ = sinogram.shape
    thin = THIN * float(sinogram.mean()) / n
    # the loss has a curvature of about 1 where all densities change alike: a first step has the right length
    unit = jnp.float32(thin * np.sqrt(views * n))
    residual = Difference(rays(n, views), jnp.asarray(sinogram), unit)
    how: dict[str, Any] = {"solver": optx.LBFGS(0.0, 0.0), "constraints": jv.Positive(thin)}

    def fit(evaluations: int, look: Callable[[Any], None]) -> None:
        start = jnp.full((n, n, n), thin, jnp.float32)
        how["callback"] = lambda step, density, loss: look(density)
        jv.fit(residual, start, max_steps=evaluations, patience=evaluations, **how)

    fit(2, lambda density: None)  # compiles before the clock starts
    progress.begun = time.perf_counter()
    fit(evaluations, progress.look)


def measure(truth: Density, photons: float | None, chosen: Namespace) -> dict[str, Any]:
    """The error of each method; the slice to be drawn is kept under `"slice"`."""
    exact = np.array(line_integrals(truth, rays(len(truth), chosen.views), STEP_OF_VIEWS))
    sinogram, rows = counted(exact, photons, chosen.seed), {}
    for name in METHODS:
        progress = Progress(truth)
        if name == FBP:
            filtered(sinogram, progress)
        elif name == SART:
            algebraic(sinogram, progress, chosen.sweeps)
        else:
            fitted(sinogram, progress, chosen.evaluations)
        nearest = min(progress.rows, key=lambda row: row["rmse"])
        rows[name] = {
            "rmse": nearest["rmse"],
            "psnr": psnr(progress.nearest, truth, truth.max()),
            "at": progress.rows.index(nearest) + 1,
            "rmse at the end": progress.rows[-1]["rmse"],
            "all": progress.rows,
            "slice": progress.nearest[:, :, truth.shape[2] // 2],
        }
    return rows


def pictures(result: dict[str, dict[str, Any]], truth: Density, path: Path) -> None:
    """A slice by each method and number of photons; below, the whole volume's error over the iterations."""
    figure, axes = charts.panels(len(result) + 1, 1 + len(METHODS), 13.4, 3.5 * len(result) + 3.2)
    white = 0.8 * truth.max()
    figure.suptitle(
        f"The middle slice of {truth.shape[2]}; grey: density, from 0 to {white:.2g} / voxel. "
        "The errors are of the whole volume; beside RMSE stands PSNR."
    )
    for line, (photons, rows) in zip(axes, result.items(), strict=False):
        slices = {"truth": truth[:, :, truth.shape[2] // 2], **{n: rows[n]["slice"] for n in METHODS}}
        for panel, (name, picture) in zip(line, slices.items(), strict=True):
            panel.imshow(picture, cmap="gray", vmin=0, vmax=white)
            caption = f"RMSE {rows[name]['rmse']:.5f}, {rows[name]['psnr']:.1f} dB" if name in rows else ""
            panel.set(xticks=[], yticks=[], title=name, xlabel=caption)
        line[0].set_ylabel(photons)
    by_count, by_time, *others = axes[-1]
    for panel in others:
        panel.set_axis_off()
    for (photons, rows), line in zip(result.items(), ("-", "--"), strict=False):
        for name, color in ((SART, "C1"), (OURS, "C0")):
            errors = [row["rmse"] for row in rows[name]["all"]]
            by_count.loglog(range(1, len(errors) + 1), errors, color + line, label=f"{name}, {photons}")
            by_time.loglog([row["seconds"] for row in rows[name]["all"]], errors, color + line)
        for panel in (by_count, by_time):
            panel.axhline(rows[FBP]["rmse"], color="0.5", linestyle=line, label=f"{FBP}, {photons}")
    by_count.set(xlabel="sweep (SART), evaluation (jaxvol)", ylabel="RMSE of the density, 1/voxel")
    by_time.set(xlabel="seconds, compilation left out")
    by_count.legend()
    charts.save(figure, path)


@experiment(
    resolution=64,
    views=24,
    photons={"nargs": "*", "type": float, "default": [1e4], "help": "photons per ray; also without noise"},
    sweeps={"type": int, "default": 30, "help": "sweeps of SART"},
    evaluations={"type": int, "default": 45, "help": "of the fit's loss and its gradient"},
    quick={"resolution": 16, "views": 8, "sweeps": 5, "evaluations": 25},
)
def main(chosen: Namespace) -> dict[str, Any]:
    truth = np.asarray(jv.phantom("head", chosen.resolution).data, np.float32) / 255 * DENSEST
    found: dict[str, Any] = {}
    for photons in (None, *chosen.photons):
        name = "no noise" if photons is None else f"{photons:g} photons a ray"
        found[name] = measure(truth, photons, chosen)
    pictures(found, truth, chosen.output / "tomography.png")
    for row in (row for rows in found.values() for row in rows.values()):
        del row["slice"]
    return {"photons": found}
