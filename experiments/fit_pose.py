"""Is a camera's pose recovered from one image?

The camera starts turned by 10° about the volume and shifted by 5 % of its distance, in random directions. The
result is the share of starts from which a fit of its six degrees of freedom by Levenberg–Marquardt leads back
to 0.05° and 0.1 %. Images are compared as they are, and from coarse to fine, with their difference blurred at
first, since a derivative describes only features that move by less than their own size.
"""

from argparse import Namespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxvol as jv

from . import charts, fit_transfer
from .harness import experiment


ANGLE, SHIFT = 10.0, 0.05
GOALS = {"degrees": 0.05, "shift": 1e-3}
SIGMAS = {"from coarse to fine": (1 / 16, 1 / 48, 0.0), "as they are": (0.0,)}
"""Standard deviations of the blurs in the stages of a fit, as a part of the image's height."""


def coarse_to_fine(residual: jv.ImageResidual, start: Any, blurs: Any, **options: Any) -> list[jv.Fit]:
    """Fits to images blurred less and less, each from where the last one ended."""
    fits: list[jv.Fit] = []
    for blur in blurs:
        start = fits[-1].parameters if fits else start
        fits.append(jv.fit(residual.blurred(blur), start, **options))
    return fits


def measure(sigmas: tuple[float, ...], chosen: Namespace) -> list[dict[str, Any]]:
    """How far from the truth each start ends, for a sequence of blurs."""
    volume, transfer, march = fit_transfer.head(None, chosen.resolution)
    truth = jv.Camera.looking_at(volume, (0.65, -1, 0.15), size=(chosen.size,) * 2).zoom(1.3)
    pose, target = jv.Pose(truth), jv.render(volume, transfer, truth, march).image()
    residual = jv.ImageResidual(lambda camera, _: (volume, transfer, camera, march), [(truth, target)])
    rng, rows = np.random.default_rng(chosen.seed), []
    for _ in range(chosen.starts):
        turn, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        off = {"rotation": np.deg2rad(ANGLE) * turn, "translation": SHIFT * shift}
        camera = pose.forward(jax.tree.map(jnp.float32, off))
        fits = coarse_to_fine(residual, camera, sigmas, max_steps=40)
        left = pose.inverse(fits[-1].parameters)
        rows.append(
            {
                "degrees": float(np.rad2deg(np.linalg.norm(left["rotation"]))),
                "shift": float(np.linalg.norm(left["translation"])),
                "message": fits[-1].message,
                "losses": np.concatenate([found.losses for found in fits]).tolist(),
            }
        )
    return rows


def reached(rows: list[dict[str, Any]]) -> float:
    """The share of starts that lead back to within the goals."""
    return float(np.mean([all(row[key] < goal for key, goal in GOALS.items()) for row in rows]))


def draw(result: dict[str, Any]) -> Any:
    figure, ((left, right),) = charts.panels(1, 2, 9, 3.8)
    for (name, rows), color in zip(result["starts"].items(), ("C0", "C3"), strict=True):
        left.plot([], [], color=color, label=f"{name}: {reached(rows):.0%} of starts lead back")
        for row in rows:
            left.semilogy(range(1, len(row["losses"]) + 1), row["losses"], color=color, alpha=0.5)
        right.loglog(*([row[key] for row in rows] for key in GOALS), "o", color=color, alpha=0.6)
    left.set(xlabel="step, those of all stages together", ylabel="mean squared difference of the images")
    left.set_title("a line for each of the starts")
    charts.legend_below(figure, left, 2)
    right.plot(ANGLE, SHIFT, "k*", markersize=10)
    right.axvline(GOALS["degrees"], color="k", linestyle=":", linewidth=0.8)
    right.axhline(GOALS["shift"], color="k", linestyle=":", linewidth=0.8)
    right.set(xlabel="rotation left, degrees", ylabel="shift left / distance to focal point")
    right.set_title("after the last step; star: the start,\ndotted: what counts as led back")
    return figure


@experiment(size=96, resolution=96, starts=10, quick={"size": 32, "resolution": 24, "starts": 2})
def main(chosen: Namespace) -> dict[str, Any]:
    starts = {name: measure(sigmas, chosen) for name, sigmas in SIGMAS.items()}
    found = {name: reached(rows) for name, rows in starts.items()}
    return {"goals": GOALS, "reached": found, "starts": starts}
