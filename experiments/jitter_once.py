"""Is it enough to jitter once a ray, and how many samples would it take to jitter at every empty stretch?

Kye 2013, section 3.1: to jitter in all empty space changes nothing in the image, but shortens steps, so that
rays take more of them; therefore *do once*. No option of jaxvol does otherwise, so this is the paper's
program (its Fig. 7) in NumPy, one sample of all rays after another: without jitter, at a ray's first
transparent sample, at the first of every empty stretch behind material, and at every transparent one. All
end rays early and are aligned at the exit, and none leaps, as leaps do not take the samples that are counted.
Scenes are those of the pictures of Kye's Figs. 9 to 12, magnified. The image of the first two is jaxvol's.
"""

from argparse import Namespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import map_coordinates

import jaxvol as jv
from jaxvol.metrics import rmse

from . import charts, marches
from .harness import entered, experiment, frame, grain_off
from .jitter_accuracy import pictured
from .pictures import kye
from .scenes import Scene


PLAIN, ONCE, STRETCHES, ALL = "ray casting", "once", "every empty stretch", "every transparent sample"
METHODS = {PLAIN: "k", ONCE: "C0", STRETCHES: "C1", ALL: "C3"}
"""With their colours in the chart."""


def numbers(size: tuple[int, int], seed: int) -> np.ndarray:
    """The numbers by which `EmptySpaceJitter` shifts the rays of an image."""
    noise = jv.EmptySpaceJitter(seed).noise
    row, column = (jnp.asarray(axis) for axis in np.indices(size[::-1], np.int32))
    drawn = jax.jit(jnp.vectorize(lambda x, y: noise((x, y), jnp.float32)))(column, row)
    return np.asarray(drawn, np.float64).ravel()


def marched(scene: Scene, method: str, seed: int) -> tuple[np.ndarray, int, float]:
    """The image over black, the number of samples, and how often a ray is jittered."""
    volume, transfer, camera, step = scene
    data, step = np.asarray(volume.data, np.float32), float(step)
    low, spacing = (np.asarray(part, np.float64) for part in (volume.origin, volume.spacing))
    entry, direction = (np.asarray(part, np.float64).reshape(-1, 3) for part in camera.rays())
    with np.errstate(divide="ignore"):
        faces = np.stack(
            [(corner - entry) / direction for corner in (low, low + spacing * np.subtract(data.shape, 1))]
        )
    depth, exits = np.maximum(faces.min(axis=0).max(axis=1), 0), faces.max(axis=0).min(axis=1)
    values, extinctions, colors = (
        np.asarray(part, np.float64) for part in (transfer.values, transfer.extinction, transfer.colors)
    )
    image, left = np.zeros((len(depth), 3)), np.ones(len(depth))
    first, later = numbers(camera.size, seed), np.random.default_rng(seed)
    may, shifts, samples = np.full(len(depth), method != PLAIN), np.zeros(len(depth), int), 0
    rays = np.flatnonzero(depth < exits)
    while rays.size:
        samples += rays.size
        places = (entry[rays] + depth[rays, None] * direction[rays] - low) / spacing
        value = map_coordinates(data, places.T, order=1, mode="nearest")
        extinction = np.interp(value, values, extinctions)
        color = np.stack([np.interp(value, values, channel) for channel in colors.T], axis=1)
        width = np.minimum(step, exits[rays] - depth[rays])
        alpha = -np.expm1(-extinction * width)
        image[rays] += (left[rays] * alpha)[:, None] * color
        left[rays] *= 1 - alpha
        clear = extinction == 0
        jumps = clear & may[rays]
        part = np.where(shifts[rays] == 0, first[rays], later.random(rays.size))
        depth[rays] += step * np.where(jumps, part, 1)
        shifts[rays] += jumps
        if method == ONCE:
            may[rays] &= ~jumps
        elif method == STRETCHES:
            may[rays] = ~clear | (may[rays] & ~jumps)
        rays = rays[(depth[rays] < exits[rays]) & (left[rays] > kye.ENDED)]
    return image.reshape(*camera.size[::-1], 3), samples, float(shifts.mean())


def measure(scene: Scene, chosen: Namespace) -> dict[str, Any]:
    """A row for each method, and how far the first two are from jaxvol's image."""

    def by_jaxvol(march: jv.March) -> np.ndarray:
        return np.asarray(frame(scene, march).image(kye.BLACK), np.float64)

    truth, face = by_jaxvol(marches.converged(scene.step)), entered(scene)
    drawn = {name: marched(scene, name, chosen.seed) for name in METHODS}
    rows: dict[str, Any] = {}
    for name, (image, samples, shifts) in drawn.items():
        error = image - truth
        rows[name] = {
            "wood grain": grain_off(error, face),
            "rmse": rmse(image, truth),
            "samples": samples,
            "samples / ray casting": samples / drawn[PLAIN][1],
            "shifts of a ray": shifts,
        }
    ends = jv.EarlyTermination(kye.ENDED)
    for name, shared in ((PLAIN, marches.ALIGNED), (ONCE, marches.BOTH)):
        march = jv.March(scene.step, (*marches.transforms(shared, chosen.seed), ends))
        rows[name]["rmse to jaxvol's image"] = rmse(drawn[name][0], by_jaxvol(march))
    return rows


def draw(result: dict[str, Any]) -> Any:
    """Samples against wood grain, over those of ray casting: a mark for each scene."""
    figure, ((panel,),) = charts.panels(1, 1, 7, 4)
    for name, color in METHODS.items():
        rows = [scene[name] for scene in result["scenes"].values()]
        plain = [scene[PLAIN] for scene in result["scenes"].values()]
        grains = [row["wood grain"] / base["wood grain"] for row, base in zip(rows, plain, strict=True)]
        samples = [row["samples / ray casting"] for row in rows]
        ring = {"markersize": 9, "fillstyle": "none"} if name == ONCE else {}  # others lie on it
        panel.plot(grains, samples, "o", color=color, label=name, **ring)
    panel.set(xlabel="wood grain / ray casting", ylabel="samples / ray casting")
    panel.legend()
    return figure


@experiment(size=256, resolution=160, quick={"size": 64, "resolution": 40})
def main(chosen: Namespace) -> dict[str, Any]:
    scenes = {
        said.rstrip(", ") or f"phantom, {name}": measure(view.scenes(pictured(chosen))["zoomed"], chosen)
        for name in kye.VIEWS
        for said, view in kye.views(name, pictured(chosen)).items()
    }
    return {"scenes": scenes}
