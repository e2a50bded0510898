"""Does a plan hold its tolerance, and is anything faster within it?

Random scenes: real volumes (nuclear, dental, CT and MR data) and phantoms, two volumes of float32;
random transfer functions of three to eight points, some opaque, some with narrow peaks; random cameras, a
quarter of them inside. (What a sample costs was fitted to five other scenes, one of the head phantom.) Each
is planned for three tolerances. The image under the plan is compared with a converged one, over black or
white, whichever differs more; the converged image is integrated between cells' ends, at a step of an eighth
of a voxel, or less until it differs by at most 1e-4 from that of twice the step.

Of some scenes, a table of marches is searched: three quadratures and adaptive sampling, at steps from a
thirty-second of a voxel to four, with leaps and without. Of each kind, the two with the longest steps (or the
largest tolerances of their own) within the tolerance are timed; the fastest of all, in turn with the planned
one.

Last, what planning itself takes, programs being compiled, in images of 512 x 512 pixels under the plan. Where
programs are not compiled yet, it takes the most of a volume's `planning seconds`.
"""

import math
from argparse import Namespace
from collections.abc import Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import jaxvol as jv
from jaxvol.metrics import rmse

from . import charts, timing
from .harness import data, experiment, show


TOLERANCES = (1e-2, 3e-3, 1e-3)
FILES = {
    "fuel": ("fuel_64x64x64_uint8.raw", 1.0),
    "nucleon": ("nucleon_41x41x41_uint8.raw", 1.0),
    "tooth": ("tooth_103x94x161_uint8.raw", 1.0),
    "cthead": ("cthead_256x256x113_uint16le.raw.gz", (1.0, 1.0, 2.0)),
    "T1": ("studyforrest_t1_137x192x192_int16le.raw.gz", 1.0),
}
PHANTOMS = {"head phantom": ("head", 96), "vessels phantom": ("vessels", 96)}
NORMALIZED = {"nucleon", "head phantom"}
"""Volumes of float32, of values up to 1."""
CONVERGED, FINEST, KNOWN = 1 / 8, 1 / 256, 1e-4
"""Voxels of the converged image's step, or less until its own error is known to be this small."""
STEPS = tuple(2.0 ** (k / 2) for k in range(-10, 5))
"""Voxels."""
POINTS = 8
"""Most points of a transfer function."""
OWN = tuple(10.0 ** (k / 2) for k in range(-6, -1))
"""Tolerances of adaptive sampling."""


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
        values = np.quantile(np.asarray(volume.data, np.float32), np.linspace(0, 1, 1001))
        for number in range(place, count, len(all_)):
            random = np.random.default_rng((seed, number))
            transfer = transfer_of(random, values, float(volume.spacing.min()))
            yield Scene(name, volume, transfer, camera_of(random, volume, size))


def transfer_of(random: np.random.Generator, values: np.ndarray, voxel: float) -> jv.TransferFunction:
    """Points anywhere in the range of values, opacities of any kind; below them all is transparent."""
    n = int(random.integers(3, POINTS + 1))
    low, high = float(values[0]), float(values[-1])
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
        widest = int(np.argmax(np.diff(points)))
        middle = widest + 1
        points, colors, extinction = (
            np.insert(each, middle, (each[widest] + each[middle]) / 2, axis=0)
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
    _, volume, transfer, camera = scene
    return np.asarray(jv.render(volume, transfer, camera, march, outputs="rgba").rgba, np.float64)


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


def table(scene: Scene, tolerance: float) -> dict[str, list[jv.March]]:
    """All marches that a search tries, by kind, the cheapest of each first."""
    transforms = jv.AlphaCorrection(), jv.EarlyTermination(tolerance / 8), jv.SpaceLeaping()
    found = {
        quadrature: [jv.March(step * scene.voxel, transforms, quadrature) for step in reversed(STEPS)]
        for quadrature in ("left", "midpoint", "preintegrated")
    }
    for step in (1 / 8, 1 / 4, 1 / 2):
        found[f"adaptive, shortest step {step:g}"] = [
            jv.March(step * scene.voxel, (jv.AdaptiveSampling(own, 8), *transforms), "midpoint")
            for own in reversed(OWN)
        ]
    return found


def searched(
    scene: Scene, found: jv.Plan, truth: np.ndarray, tolerance: float, repetitions: int
) -> dict[str, Any]:
    """How much longer the planned image takes than the fastest of the table within the tolerance: of each
    kind the first two, with leaps and without, which render the same image."""
    within: dict[str, jv.March] = {}
    for kind, marches in table(scene, tolerance).items():
        accurate = (march for march in marches if distance(image(scene, march), truth) <= tolerance)
        for number, march in enumerate(islice(accurate, 2)):
            name = f"{kind}, step {float(march.step) / scene.voxel:.3g}, {number}"
            within[f"{name}, leaps"] = march
            within[f"{name}, no leaps"] = jv.March(march.step, march.transforms[:-1], march.quadrature)
    if not within:
        return {"fastest": None}
    programs: dict[str, Any] = {name: partial(image, scene, march) for name, march in within.items()}
    once = {name: min(times) for name, times in timing.interleaved(programs, 2).items()}
    best = sorted(once, key=lambda name: once[name])[:3]
    programs = {name: programs[name] for name in best}
    programs["plan"] = partial(image, scene, found.march)
    times = timing.interleaved(programs, repetitions)
    fastest = min(best, key=lambda name: float(np.median(times[name])))
    ratio = timing.ratio(times["plan"], times[fastest])["median"]
    return {"fastest": fastest, "ratio": ratio, "planned": str(found).splitlines()[0]}


def measure(scene: Scene, number: int, search: bool, repetitions: int) -> dict[str, Any]:
    truth, own = converged(scene)
    row: dict[str, Any] = {"volume": scene.name, "own error of the converged image": own, "plans": {}}
    for tolerance in TOLERANCES:
        found = jv.plan(scene.volume, scene.transfer, scene.camera, tolerance, seed=number)
        error = distance(image(scene, found.march), truth)
        each: dict[str, Any] = {
            "error": error,
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


def cost(scene: Scene, size: int) -> dict[str, dict[str, float]]:
    """What planning takes, in images under the plan."""
    c = scene.camera
    camera = jv.Camera(c.position, c.focal_point, c.view_up, c.view_angle, size=(size, size), window=c.window)
    scene = scene._replace(camera=camera)
    found = {}
    for tolerance in TOLERANCES:
        planned = jv.plan(scene.volume, scene.transfer, camera, tolerance)
        programs = {
            "plan": lambda t=tolerance: jv.plan(scene.volume, scene.transfer, camera, t).march.step,
            "image": lambda p=planned: image(scene, p.march),
        }
        times = timing.interleaved(programs, 3)
        taken = float(np.median(times["image"]))
        found[f"{tolerance:g}"] = {"images": float(np.median(times["plan"])) / taken}
    return found


def summary(rows: list[dict[str, Any]], costs: dict[str, dict[str, dict[str, float]]]) -> dict[str, Any]:
    by_tolerance = {}
    for tolerance in TOLERANCES:
        plans = [row["plans"][f"{tolerance:g}"] for row in rows]
        held = np.array([each["error"] <= tolerance for each in plans])
        said = np.array([each["within"] for each in plans])
        ratios = [each["ratio"] for each in plans if each.get("fastest")]
        by_tolerance[f"{tolerance:g}"] = {
            "scenes": len(plans),
            "held": int(held.sum()),
            "not held though said to be within": int((~held & said).sum()),
            "error at most what was predicted": sum(each["error"] <= each["predicted"] for each in plans),
            "share": float(held.mean()),
            "largest error over tolerance": max(each["error"] for each in plans) / tolerance,
            "said not to be within": int((~said).sum()),
            "time over the fastest: median": float(np.median(ratios)) if ratios else None,
            "largest": max(ratios, default=None),
            "within 1.5 times": sum(ratio <= 1.5 for ratio in ratios),
            "searched": len(ratios),
            "searched, nothing found within": sum(each.get("fastest", "") is None for each in plans),
        }
    each = [one for of in costs.values() for one in of.values()]
    cold: dict[str, float] = {}
    for row in rows:
        most = max(plan["planning seconds"] for plan in row["plans"].values())
        cold[row["volume"]] = max(most, cold.get(row["volume"], 0))
    return {
        "by tolerance": by_tolerance,
        "planning, in images: largest": max((one["images"] for one in each), default=None),
        "planning seconds, programs not compiled": cold,
    }


def draw(result: dict[str, Any], path: Path) -> None:
    """Error over tolerance, scene by scene; and time over that of the fastest march found."""
    figure, ((errors, times),) = charts.panels(1, 2, 9, 3.6)
    for column, tolerance in enumerate(TOLERANCES):
        plans = [row["plans"][f"{tolerance:g}"] for row in result["scenes"]]
        spread = np.random.default_rng(0).uniform(-0.3, 0.3, len(plans))
        ratio = [max(each["error"] / tolerance, 1e-3) for each in plans]
        errors.scatter(column + spread, ratio, s=6, color=f"C{column}")
        searched_ = [each["ratio"] for each in plans if each.get("fastest")]
        spread = np.random.default_rng(1).uniform(-0.3, 0.3, len(searched_))
        times.scatter(column + spread, searched_, s=10, color=f"C{column}")
    errors.axhline(1, color="0.4", linewidth=0.8)
    errors.set_yscale("log")
    errors.set_ylabel("true RMSE / tolerance (0.001: or less)", fontsize=9)
    errors.yaxis.set_major_formatter("{x:g}")
    times.axhline(1.5, color="0.4", linewidth=0.8, linestyle=":")
    times.set_ylabel("time / that of the fastest march found", fontsize=9)
    times.text(2.45, 1.52, "goal", fontsize=8, color="0.4", ha="right")
    for panel in (errors, times):
        panel.set_xticks(range(len(TOLERANCES)), [f"{t:g}" for t in TOLERANCES])
        panel.set_xlabel("tolerance (RMSE of the image)", fontsize=9)
        panel.set_xlim(-0.5, len(TOLERANCES) - 0.5)
    errors.set_title(f"{len(result['scenes'])} random scenes; below 1: within the tolerance", fontsize=9)
    times.set_title("some of them; below 1: faster than a search found", fontsize=9)
    charts.save(figure, path)


@experiment(
    draw,
    scenes=200,
    size=192,
    every={"type": int, "default": 10, "help": "search every so many scenes exhaustively"},
    repetitions=5,
    large={
        "type": int,
        "default": 512,
        "help": "pixels along a side of the images that plans are timed with",
    },
    quick={"scenes": 2, "size": 24, "every": 2, "repetitions": 1, "large": 32},
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
            costs[scene.name] = cost(scene, chosen.large)
        show(rows[-1]["plans"], number, scene.name)
    jax.clear_caches()
    return {"pixels": chosen.size, "summary": summary(rows, costs), "planning": costs, "scenes": rows}
