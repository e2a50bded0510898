"""From which share of visible samples on does it take longer to gather them than to shade all samples?

A head and an engine, lit by `Phong`, which shades all samples where they are, and by the same rule with the
visible samples gathered first (`kisti.VisiblePhong`), in turn, without leaps: transfer functions show the
densest part of the voxels, of growing size. The share is that of the samples' length in which anything is
visible, from the opacity of the same image under an extinction so small that nothing hides.

Then the share among the samples that are taken where rays leap over empty space, in the cases of the KISTI
report: on which side of that share do they lie?
"""

from argparse import Namespace
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

import jaxvol as jv
from jaxvol.lighting import Lighting, Phong

from . import harness, timing
from .harness import experiment
from .kisti import PHANTOMS, REAL, VisiblePhong, opaque
from .scenes import Scene


ALL, GATHERED = "all shaded", "visible gathered"
SHARES = (0.002, 0.01, 0.03, 0.06, 0.12, 0.25, 0.5)
"""Of the voxels, that are shown."""
THIN = 1e-5
"""Opacity of a voxel in which nothing hides."""


def showing(scene: Scene, share: float) -> Scene:
    """The scene, of which the densest voxels are shown."""
    data = np.asarray(scene.volume.data, float)
    top = data.max()
    begin = float(np.clip(np.quantile(data, 1 - share), 1e-3 * top, 0.99 * top))
    values, extinction = [begin, begin + 1e-3 * top, 1.001 * top], 1 / (30 * scene.step)
    return scene._replace(transfer=jv.TransferFunction(values, np.ones((3, 3)), [0, extinction, extinction]))


def visible_share(scene: Scene, *transforms: jv.Transform) -> float:
    """The part of the samples taken in which anything is visible."""
    given, extinction = scene.transfer, THIN / scene.step
    taken = jv.render(*scene[:3], jv.March(scene.step, transforms)).samples
    fine = np.linspace(float(given.values[0]), float(given.values[-1]), 2**12)
    shown = np.interp(fine, given.values, given.extinction) > 0
    thin = jv.TransferFunction(fine, np.ones((len(fine), 3)), np.where(shown, extinction, 0))
    opacity = jv.render(scene.volume, thin, scene.camera, jv.March(scene.step)).rgba[..., 3]
    length = -np.log1p(-np.asarray(opacity, float)) / extinction
    return float(np.sum(length) / (np.sum(np.asarray(taken, float)) * scene.step))


def measure(scene: Scene, shares: Sequence[float], repetitions: int) -> dict[str, dict[str, Any]]:
    """For each share of the voxels, that of the samples, and the times of both."""

    def frame(shown: Scene, lighting: Lighting) -> Any:
        return jv.render(*shown[:3], jv.March(shown.step), lighting=lighting, outputs="rgba").rgba

    rows = {}
    for share in shares:
        shown = showing(scene, share)
        drawn = {ALL: partial(frame, shown, Phong()), GATHERED: partial(frame, shown, VisiblePhong())}
        seconds = timing.interleaved(drawn, repetitions)
        rows[str(share)] = {
            "of the samples": round(visible_share(shown), 4),
            "seconds": {name: timing.median(all_) for name, all_ in seconds.items()},
            f"{ALL} / {GATHERED}": timing.ratio(seconds[ALL], seconds[GATHERED]),
        }
    return rows


@experiment(
    repetitions=15,
    size=256,
    resolution=192,
    shares=SHARES,
    quick={"size": 32, "repetitions": 2, "resolution": 32, "shares": (0.01, 0.25)},
)
def main(chosen: Namespace) -> dict[str, Any]:
    folder = harness.data()
    makers = PHANTOMS if folder is None or chosen.quick else REAL
    scenes, leaping = {}, {}
    for name, make in makers.items():
        scene = make(folder, chosen.size, chosen.resolution)
        scenes[name] = measure(scene, chosen.shares, chosen.repetitions)
        for tf, seen in (("tf 1", scene), ("tf 2", opaque(scene))):
            leaping[f"{name}, {tf}"] = round(visible_share(seen, jv.SpaceLeaping()), 4)
    return {
        "volumes": "phantoms" if makers is PHANTOMS else "cthead and engine",
        "image": [chosen.size] * 2,
        "scenes": scenes,
        "visible of the samples taken under leaps": leaping,
    }
