"""Find the fastest way of leaping over empty space that leaves the image of a scene right.

A function for scripts and notebooks, not an experiment: the answer depends on the view. `interleaved` times
the images in turn, and an image is right if no colour or opacity is farther than `tolerance` from that of the
first way.
"""

from typing import Any

import numpy as np

import jaxvol as jv

from .timing import interleaved


LEAPS = (
    jv.SpaceLeaping(),
    jv.SpaceLeaping("distance", block=1),
    *(jv.SpaceLeaping("min_distance", cell, block=1) for cell in (4, 8, 16)),
)


def fastest_leaping(
    volume: Any,
    transfer: Any,
    camera: jv.Camera,
    march: jv.March,
    leaps: tuple[jv.SpaceLeaping, ...] = LEAPS,
    *,
    tolerance: float = 1 / 255,
    repetitions: int = 5,
    **options: Any,
) -> tuple[jv.SpaceLeaping, list[tuple[jv.SpaceLeaping, float, float]]]:
    """Find the fastest way, and the median time in seconds and the share of wrong pixels of each. `march`:
    without leaps. `options`: of `render`."""

    def image(leap: jv.SpaceLeaping) -> Any:
        leaping = jv.March(march.step, (*march.transforms, leap), march.quadrature)
        return jv.render(volume, transfer, camera, leaping, outputs="rgba", **options).rgba

    images = [np.asarray(image(leap)) for leap in leaps]
    seconds = interleaved({n: lambda leap=leap: image(leap) for n, leap in enumerate(leaps)}, repetitions)
    wrong = [float(np.mean(np.max(np.abs(rgba - images[0]), -1) > tolerance)) for rgba in images]
    rows = [(leap, float(np.median(seconds[n])), wrong[n]) for n, leap in enumerate(leaps)]
    return min((row for row in rows if row[2] == 0), key=lambda row: row[1])[0], rows
