"""Does a plan hold its tolerance, and is anything faster within it?

Random scenes: real volumes and phantoms, random transfer functions of three to eight points, some opaque,
some with narrow peaks; random cameras, a quarter of them inside. (What a sample costs was fitted to five
other scenes.) Each is planned for three tolerances. The image under the plan is compared with a converged
one, over black or white, whichever differs more.

Of some scenes, a table of marches is searched: three quadratures, at steps from a thirty-second of a voxel to
four, with leaps and without. Of each kind, the two with the longest steps within
the tolerance are timed; the fastest of all, in turn with the planned one. Last, what planning itself takes,
programs being compiled, in images of several sizes under the plan.
"""

import math
from argparse import Namespace
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import jaxvol as jv
from jaxvol.metrics import rmse

from . import charts, timing
from .harness import data, experiment
from .programs import QUADRATURES
from .scenes import CT_HEAD


TOLERANCES = (1e-2, 3e-3, 1e-3)
FILES = {
    "fuel": ("fuel_64x64x64_uint8.raw", 1.0),
    "nucleon": ("nucleon_41x41x41_uint8.raw", 1.0),
    "tooth": ("tooth_103x94x161_uint8.raw", 1.0),
    "cthead": (CT_HEAD, (1.0, 1.0, 2.0)),
    "T1": ("studyforrest_t1_137x192x192_int16le.raw.gz", 1.0),
}
PHANTOMS = {"head phantom": ("head", 96), "vessels phantom": ("vessels", 96)}
NORMALIZED = {"nucleon", "head phantom"}
"""Volumes of float32, of values up to 1."""
CONVERGED, FINEST, KNOWN = 1 / 8, 1 / 256, 1e-4
"""Voxels of the converged image's step, or less until its own error is known to be this small."""
STEPS = tuple(2.0 ** (k / 2) for k in range(4, -11, -1))
"""Voxels."""
POINTS = 8
"""Most points of a transfer function."""


class Scene(NamedTuple):
    name: str
    volume: jv.Volume
    transfer: jv.TransferFunction
    camera: jv.Camera

    @property
    def voxel(self) -> float:
        return float(self.volume.spacing.min())


def volumes(folder: Path | None) -> dict[str, jv.Volume]:
    found = {name: jv.phantom(*which) for name, which in PHANTOMS.items()}
    for name, (file, spacing) in FILES.items():
        if folder is not None and (folder / file).is_file():
            found[name] = jv.load(folder / file, spacing=np.broadcast_to(spacing, 3))
    for name in found.keys() & NORMALIZED:
        whole = found[name]
        data = np.asarray(whole.data, np.float32)
        found[name] = jv.Volume(data / data.max(), whole.spacing, whole.origin)
    return found


def scenes(folder: Path | None, count: int, size: int, seed: int) -> Iterator[Scene]:
    """Random scenes, each volume's in a row."""
    all_ = volumes(folder)
    for place, (name, volume) in enumerate(all_.items()):
        low, high = np.quantile(np.asarray(volume.data, np.float32), (0, 1)).tolist()
        for number in range(place, count, len(all_)):
            random = np.random.default_rng((seed, number))
            transfer = transfer_of(random, low, high, float(volume.spacing.min()))
            yield Scene(name, volume, transfer, camera_of(random, volume, size))


def transfer_of(random: np.random.Generator, low: float, high: float, voxel: float) -> jv.TransferFunction:
    """Points anywhere in the range of values, opacities of any kind; below them all is transparent."""
    n = int(random.integers(3, POINTS + 1))
    points = np.sort(random.uniform(0.05, 1, n))
    extinction = 10 ** random.uniform(-2.5, 0.7, n) / voxel * (random.random(n) < 0.8)
    kind = random.random()
    if kind < 0.2:  # opaque from some value on
        extinction[n // 2 :] = 5 / voxel
    elif kind < 0.4:  # a peak, 0.5 to 5 % of the range wide
        wide = 10 ** random.uniform(-2.3, -1.3)
        points = points[0] + wide * np.linspace(-0.5, 0.5, n)
        extinction[:] = 0
        extinction[n // 2] = 10 ** random.uniform(-0.5, 0.7) / voxel
    extinction[0] = 0
    if not extinction.any():
        extinction[-1] = 0.1 / voxel
    colors = random.random((n, 3))
    while len(points) < POINTS:  # the same function with more points: programs are compiled for their number
        middle = int(np.argmax(np.diff(points))) + 1
        points, colors, extinction = (
            np.insert(each, middle, (each[middle - 1] + each[middle]) / 2, axis=0)
            for each in (points, colors, extinction)
        )
    return jv.TransferFunction(low + (high - low) * points, colors, extinction)


def camera_of(random: np.random.Generator, volume: jv.Volume, size: int) -> jv.Camera:
    """From any side, at any distance; or, one in four, from inside."""
    direction = random.normal(size=3)
    if random.random() < 0.25:
        low, high = (np.asarray(corner) for corner in volume.corners)
        position = low + (high - low) * random.uniform(0.25, 0.75, 3)
        view_angle = random.uniform(40, 90)
        return jv.Camera(position, position + direction, random.normal(size=3), view_angle, size=(size, size))
    camera = jv.Camera.looking_at(volume, direction, random.normal(size=3), size=(size, size))
    return camera.zoom(2 ** random.uniform(-0.5, 2))


def image(scene: Scene, march: jv.March) -> np.ndarray:
    return np.asarray(jv.render(*scene[1:], march, outputs="rgba").rgba, np.float64)


def distance(a: np.ndarray, b: np.ndarray) -> float:
    """RMSE over black or white, whichever is greater."""
    over = [(c[..., :3], c[..., :3] + 1 - c[..., 3:]) for c in (a, b)]
    return max(rmse(*pair) for pair in zip(*over, strict=True))


def converged(scene: Scene) -> tuple[np.ndarray, float]:
    """The image, and its own error: at most its difference from that with twice the step, of which it is all
    where the order is 1. Steps are halved until that is small."""
    step, before = 2 * CONVERGED, None
    while True:
        transforms = jv.AlphaCorrection(), jv.SpaceLeaping()
        found = image(scene, jv.March(step * scene.voxel, transforms, "preintegrated"))
        own = math.inf if before is None else distance(found, before)
        if own <= KNOWN or step <= FINEST:
            return found, own
        step, before = step / 2, found


def searched(
    scene: Scene, found: jv.Plan, truth: np.ndarray, tolerance: float, repetitions: int
) -> dict[str, Any]:
    """How much longer the planned image takes than the fastest of the table within the tolerance: of each
    kind the first two, with leaps and without, which render the same image."""
    leaps, transforms = jv.SpaceLeaping(), (jv.AlphaCorrection(), jv.EarlyTermination(tolerance / 8))
    programs: dict[str, Any] = {}
    for kind in QUADRATURES:
        both = (*transforms, leaps), transforms
        marches = ((s, [jv.March(s * scene.voxel, each, kind) for each in both]) for s in STEPS)
        accurate = (each for each in marches if distance(image(scene, each[1][0]), truth) <= tolerance)
        for number, (step, pair) in enumerate(islice(accurate, 2)):
            for march, words in zip(pair, ("leaps", "no leaps"), strict=True):
                programs[f"{kind}, step {step:.3g}, {number}, {words}"] = partial(image, scene, march)
    if not programs:
        return {"fastest": None}
    once = {name: min(times) for name, times in timing.interleaved(programs, 2).items()}
    best = sorted(once, key=lambda name: once[name])[:3]
    planned = {"plan": partial(image, scene, found.march)}
    times = timing.interleaved({name: programs[name] for name in best} | planned, repetitions)
    fastest = min(best, key=lambda name: float(np.median(times[name])))
    return {"fastest": fastest, "ratio": timing.ratio(times["plan"], times[fastest])["median"]}


def measure(scene: Scene, number: int, search: bool, repetitions: int) -> dict[str, Any]:
    truth, own = converged(scene)
    row: dict[str, Any] = {"volume": scene.name, "own error of the converged image": own, "plans": {}}
    for tolerance in TOLERANCES:
        found = jv.plan(*scene[1:], tolerance, seed=number)
        each: dict[str, Any] = {
            "error": distance(image(scene, found.march), truth),
            "predicted": found.error,
            "within": found.within,
            "planning seconds": round(found.probed, 2),
            "samples": round(found.samples, 2),
            "march": str(found).splitlines()[0],
        }
        if search:
            each |= searched(scene, found, truth, tolerance, repetitions)
        row["plans"][f"{tolerance:g}"] = each
    return row


def cost(scene: Scene, size: int) -> dict[str, float]:
    """What planning takes, in images of this size under the plan."""
    scene = scene._replace(camera=replace(scene.camera, size=(size, size)))
    found = {}
    for tolerance in TOLERANCES:
        plan = partial(jv.plan, *scene[1:], tolerance)
        programs = {"plan": lambda p=plan: p().march.step, "image": partial(image, scene, plan().march)}
        times = {name: float(np.median(each)) for name, each in timing.interleaved(programs, 3).items()}
        found[f"{tolerance:g}"] = times["plan"] / times["image"]
    return found


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """By tolerance: how many plans hold it, and how many of those searched take at most 1.3 times as long as
    the fastest march found."""
    found = {}
    for tolerance in TOLERANCES:
        plans = [row["plans"][f"{tolerance:g}"] for row in rows]
        ratios = [each["ratio"] for each in plans if each.get("fastest")]
        found[f"{tolerance:g}"] = {
            "scenes": len(plans),
            "held": sum(each["error"] <= tolerance for each in plans),
            "largest error over tolerance": max(each["error"] for each in plans) / tolerance,
            "within 1.3 times": sum(ratio <= 1.3 for ratio in ratios),
            "searched": len(ratios),
        }
    return {"by tolerance": found}


def draw(result: dict[str, Any]) -> Any:
    """Error over tolerance, scene by scene; and time over that of the fastest march found."""
    figure, ((errors, times),) = charts.panels(1, 2, 9, 3.6)
    random = np.random.default_rng(0)
    for column, tolerance in enumerate(TOLERANCES):
        plans = [row["plans"][f"{tolerance:g}"] for row in result["scenes"]]
        over = [max(each["error"] / tolerance, 1e-3) for each in plans]
        longer = [each["ratio"] for each in plans if each.get("fastest")]
        for panel, found, size in ((errors, over, 6), (times, longer, 10)):
            at = column + random.uniform(-0.3, 0.3, len(found))
            panel.scatter(at, found, s=size, color=f"C{column}")
    errors.axhline(1, color="0.4", linewidth=0.8)
    errors.set(yscale="log", ylabel="true RMSE / tolerance (0.001: or less)")
    errors.yaxis.set_major_formatter("{x:g}")
    times.axhline(1.3, color="0.4", linewidth=0.8, linestyle=":")
    times.set_ylabel("time / that of the fastest march found")
    times.text(2.45, 1.29, "goal", color="0.4", ha="right", va="top")
    for panel in (errors, times):
        panel.set_xticks(range(len(TOLERANCES)), [f"{t:g}" for t in TOLERANCES])
        panel.set(xlabel="tolerance (RMSE of the image)", xlim=(-0.5, len(TOLERANCES) - 0.5))
    errors.set_title(f"{len(result['scenes'])} random scenes; below 1: within the tolerance")
    times.set_title("some of them; below 1: faster than a search found")
    return figure


@experiment(
    scenes=200,
    size=192,
    every={"type": int, "default": 10, "help": "search every so many scenes exhaustively"},
    repetitions=5,
    sizes={
        "type": int,
        "nargs": "+",
        "default": [64, 128, 256, 512],
        "help": "pixels along a side of what plans are timed with",
    },
    quick={"scenes": 2, "size": 24, "every": 2, "repetitions": 1, "sizes": [32]},
)
def main(chosen: Namespace) -> dict[str, Any]:
    rows, costs, shape = [], {}, None
    folder = None if chosen.quick else data()
    for number, scene in enumerate(scenes(folder, chosen.scenes, chosen.size, chosen.seed)):
        if scene.volume.shape != shape:
            jax.clear_caches()  # a process cannot hold the programs of all volumes
            shape = scene.volume.shape
        rows.append(measure(scene, number, number % chosen.every == 0, chosen.repetitions))
        if scene.name not in costs:
            costs[scene.name] = {f"{size}": cost(scene, size) for size in chosen.sizes}
    return {"summary": summary(rows), "planning": costs, "scenes": rows}
