"""Which way of leaping over empty space is the fastest in a scene? Measured, since it depends on the view."""

import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from .._util.checks import integer, number
from ..compositing.blending import Compositing
from ..compositing.modes import Mode, compositing_of
from ..compositing.selection import FirstVisible
from ..engine.image import render_scene
from ..lighting.shading import Lighting
from ..march.march import March
from ..march.transforms import SpaceLeaping
from ..ray import Scene, check_arguments
from ..scene.camera import Camera
from ..scene.rendering import Rendering
from ..scene.transfer import Transfer, sized
from ..scene.volume import Volume
from ..xla.platform import is_traced
from .search import Part


LEAPS = (
    SpaceLeaping(),
    SpaceLeaping("distance", block=1),
    *(SpaceLeaping("min_distance", cell, block=1) for cell in (4, 8, 16)),
)
"""What is tried if nothing else is given: outside of a body, the first is as a rule the fastest; in a cavity,
one of the others (`experiments/minimum_distance.py`)."""


class FastestLeaping(NamedTuple):
    """What `fastest_leaping` found. `print` shows it.

    Attributes:
        leaping: the fastest of those whose images are right.
        march: the march that was given, with it.
        parts: for each that was tried, whether its image is right, and its time.
    """

    leaping: SpaceLeaping
    march: March
    parts: tuple[Part, ...]

    def __str__(self) -> str:
        chosen = _named(self.leaping)
        rows = (
            f"  {'*' if p.name == chosen else ' ' if p.kept else '-'} {p.name}: {p.why}" for p in self.parts
        )
        return "\n".join(["Leaps (*: the fastest, -: wrong)", *rows])


def fastest_leaping(
    volume: Volume | Any,
    transfer: Transfer | Any,
    camera: Camera | Any,
    march: March | Any,
    *,
    compositing: Compositing[Any] | Mode | Any = "over",
    lighting: Lighting | Any = None,
    leaps: Sequence[SpaceLeaping] | Any = None,
    tolerance: float | Any = 1 / 255,
    repetitions: int | Any = 5,
) -> FastestLeaping:
    """Renders the image by each way of leaping, in turn, and chooses the fastest whose image is right.

    This is how to choose the cells of `SpaceLeaping("min_distance")`, which may miss what is thin: larger
    cells cost fewer rays at their corners, start the others earlier, and miss more. The choice holds for
    views like this one. It takes as many compilations as there are ways.

    Args:
        volume: a single one.
        transfer: its transfer function.
        camera: as for `render`.
        march: without `SpaceLeaping`.
        compositing: as for `render`.
        lighting: as for `render`.
        leaps: what is tried; by default `"hierarchy"`, and with maps of voxels (`block=1`), `"distance"` and,
            where the compositing mode allows it, `"min_distance"` with cells of 4, 8 and 16 pixels. The first
            gives the image that is right, and is not by `"min_distance"`.
        tolerance: largest difference of a colour or an opacity from that image.
        repetitions: images by each, after one that is not counted.

    Returns:
        The fastest, by the median of its times.

    Raises:
        ValueError: for a march that leaps, other `leaps`, a tolerance that is not above 0, no repetition, or
            where the scene is traced; and as `render` does.
    """
    transfer = sized(transfer, volume)
    check_arguments(
        "fastest_leaping(volume, transfer, camera, march)",
        volume=volume,
        transfer=transfer,
        camera=camera,
        march=march,
    )
    number("tolerance", tolerance, above=0)
    integer("repetitions", repetitions, 1)
    if is_traced(jax.tree.leaves((volume, transfer, camera, march, lighting))):
        raise ValueError("fastest_leaping measures times: call it outside of jax.jit, jax.vmap and jax.grad.")
    if any(isinstance(each, SpaceLeaping) for each in march.transforms):
        raise ValueError("march must have no SpaceLeaping; which one is to be found out.")
    mode = compositing_of(compositing)
    if leaps is None:
        starts = not mode.resolves or isinstance(mode, FirstVisible)
        leaps = tuple(each for each in LEAPS if starts or each.method != "min_distance")
    leaps = tuple(leaps) if isinstance(leaps, Sequence) else (leaps,)
    if not leaps or not all(isinstance(each, SpaceLeaping) for each in leaps):
        raise ValueError(f"leaps must hold SpaceLeaping, one or more; got {leaps}.")
    if leaps[0].method == "min_distance":
        raise ValueError('leaps must begin with a method that misses nothing; got "min_distance".')

    def leaping(leap: SpaceLeaping) -> March:
        every = (*march.transforms, leap)
        return March(march.step, every, march.quadrature, max_samples=march.max_samples)

    marches = [leaping(each) for each in leaps]

    def image(march: March) -> Rendering:
        scene = Scene(volume, transfer, camera, march, mode, lighting)
        return jax.block_until_ready(render_scene(scene, "rgba", "replay"))

    images = [np.asarray(image(each).rgba) for each in marches]
    seconds: list[list[float]] = [[] for _ in leaps]
    for _ in range(repetitions):
        for each, own in zip(marches, seconds, strict=True):
            begun = time.perf_counter()
            image(each)
            own.append(time.perf_counter() - begun)
    times = [float(np.median(own)) for own in seconds]
    apart = [np.max(np.abs(rgba - images[0]), axis=-1) for rgba in images]
    right = [not np.any(each > tolerance) for each in apart]  # NaN of all is NaN of the scene
    parts = tuple(
        Part(
            _named(leap),
            ok,
            f"{1e3 * median:.1f} ms" + ("" if ok else f", {np.mean(far > tolerance):.2%} wrong"),
        )
        for leap, ok, median, far in zip(leaps, right, times, apart, strict=True)
    )
    best = min((i for i in range(len(leaps)) if right[i]), key=lambda i: times[i])
    return FastestLeaping(leaps[best], marches[best], parts)


def _named(leap: SpaceLeaping) -> str:
    cell = f", cell={leap.cell}" if leap.method in ("min_distance", "beam") else ""
    block = f", block={leap.block}" if leap.method in ("distance", "min_distance") else ""
    return f'SpaceLeaping("{leap.method}"{cell}{block})'
