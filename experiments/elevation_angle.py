"""Is the elevation angle of a real ultrasound scan half of its sweep, or all of it? What the data settle.

The header of `us_aplio_convex` gives an elevation angle of 54.45°, and it is not documented whether that is
half of the range or all of it. Two kinds of data could tell.

*The voxels alone*, which show shells of reverberation: how these bow over the planes of the sweep is measured
without any map. A shell whose centre lies off the motor axis bows by the cosine of the angle from its middle,
one that is flat by the secant. The nearer the angles, the more both look like a parabola; so if one knew
which of them the shells are, their shape would tell the angle. Each shape is fitted under both readings.
The readings are told apart if, under the shape that leaves least, all windows of depth agree on one of them,
and what it leaves is less than what its shells differ by from the best ones under the other reading.
As a control, the same is done for perfect shells, made under either reading.

*Images with known cameras*, with `--references`: each reading is taken as the truth of reference images, and
a fit starts from the other one.

The scan is read from the folder that JAXVOL_DATA names; without one, only the control is measured.
"""

from argparse import Namespace
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d
from scipy.optimize import least_squares

import jaxvol as jv

from . import common, probe_geometry
from .common import plt


SCAN = "us_aplio_convex_239x128x91_uint8.raw.gz"
AZIMUTH, ELEVATION = 38.55, 54.45
"""Degrees, from the scan's header: `ApexAngleAzimuthHalf`, `ApexAngleElevationHalf`."""
START, MOTOR_RADIUS, SPAN = 52.70, 22.70, 69.58
"""mm: of the first sample from the fan's apex and from the motor axis, and the length of a beam."""
READINGS = {"half angle": ELEVATION, "whole angle": ELEVATION / 2}
"""Half of the range of elevation under both readings of the header, degrees."""
SHAPE = (91, 128, 239)
"""Of the scan: planes, beams, samples."""
WINDOWS = ((15, 60), (60, 110))
"""Samples of a beam with two or three shells each."""
MOST = 12
"""The largest shift of a shell that is looked for, samples."""
COSINE = "centre off the axis (cosine)"
SHAPES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    COSINE: np.cos,
    "plane (secant)": lambda angle: 1 / np.cos(angle),
}


def probe_of(half: float) -> jv.ToroidalMap:
    """The scan's probe, with this half of the range of elevation, degrees."""
    beta, sigma = ((90 - angle, 90 + angle) for angle in (half, AZIMUTH))
    return jv.ToroidalMap(MOTOR_RADIUS - START, START, np.deg2rad(beta), np.deg2rad(sigma), (0, SPAN))


def scan(folder: Path) -> np.ndarray:
    """Echoes [β, σ, γ]; the file has them by range, azimuth and elevation."""
    return np.ascontiguousarray(np.asarray(jv.load(folder / SCAN).data).transpose(2, 1, 0))


def made(half: float, shape: tuple[int, int, int]) -> np.ndarray:
    """Echoes [β, σ, γ] of perfect shells 18 samples apart, whose centres lie off the axis, under a range of
    `half` degrees to either side. The first plane is empty, as in the scan."""
    late = np.cos(np.deg2rad(np.linspace(-half, half, shape[0] - 1)))
    late = (late - late.max()) / np.ptp(late)
    sample = np.arange(shape[2]) - 2.5 * late[:, None]
    echo = 40 + 150 * np.exp(-((np.mod(sample + 9, 18) - 9) ** 2) / 8)
    planes = np.concatenate([np.zeros((1, shape[2])), echo])
    return np.repeat(planes[:, None], shape[1], axis=1)


def bow(echo: np.ndarray, window: tuple[int, int]) -> np.ndarray:
    """By plane of the sweep, by how many samples its shells come later than in the middle plane: the peak of
    the correlation along the beams, which are averaged over the middle of the fan."""
    planes, beams, _ = echo.shape
    middle = slice(beams // 2 - beams // 16, beams // 2 + beams // 16)
    smooth = np.asarray(gaussian_filter(echo, (1, 0, 0)))[:, middle].mean(axis=1)
    profile = np.asarray(gaussian_filter1d(smooth, 1))
    first, last = window
    reference = profile[planes // 2, first:last] - profile[planes // 2, first:last].mean()
    shifts = np.arange(-MOST, MOST + 1)
    found: list[float] = []
    for plane in profile:
        moved = np.array([plane[first + s : last + s] for s in shifts])
        moved = moved - moved.mean(axis=1, keepdims=True)
        score = moved @ reference / np.linalg.norm(moved, axis=1)
        at = int(np.clip(np.argmax(score), 1, len(shifts) - 2))
        before, here, after = (float(score[at + side]) for side in (-1, 0, 1))
        found.append(int(shifts[at]) + (before - after) / 2 / (before - 2 * here + after))
    return np.array(found)


def best(bowed: np.ndarray, half: float, shape: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """The bow of a shape over a range of `half` degrees to either side that is nearest, in samples: of any
    height, wherever its middle is."""
    angle = np.deg2rad(np.linspace(-half, half, len(bowed)))

    def model(parameters: np.ndarray) -> np.ndarray:
        level, height, middle = parameters
        return level + height * (shape(angle - middle) - 1)

    return model(least_squares(lambda parameters: model(parameters) - bowed, (0.0, 1.0, 0.0)).x)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def explained(bowed: np.ndarray) -> dict[str, dict[str, Any]]:
    """For every shape, what it leaves of a bow under each reading, and by how much the nearest bows under the
    two readings differ: both RMS, in samples."""
    rows = {}
    for name, shape in SHAPES.items():
        nearest = {reading: best(bowed, half, shape) for reading, half in READINGS.items()}
        left = {reading: rms(each - bowed) for reading, each in nearest.items()}
        apart = rms(nearest["half angle"] - nearest["whole angle"])
        rows[name] = {"left": left, "apart": apart, "prefers": min(left, key=lambda each: left[each])}
    return rows


def measure(echo: np.ndarray) -> dict[str, Any]:
    """Bows by window, what each shape explains of them, and the reading they tell, if any. `echo`:
    [β, σ, γ], whose first plane is empty."""
    bows = {f"{first} to {last}": bow(echo[1:], (first, last)) for first, last in WINDOWS}
    rows = {window: explained(each) for window, each in bows.items()}
    leaves = {name: sum(min(row[name]["left"].values()) for row in rows.values()) for name in SHAPES}
    shape = min(leaves, key=lambda name: leaves[name])
    preferred = {row[shape]["prefers"] for row in rows.values()}
    clear = all(min(row[shape]["left"].values()) < row[shape]["apart"] for row in rows.values())
    return {
        "bow of the shells, samples": {name: np.round(each, 3).tolist() for name, each in bows.items()},
        "explained, samples (RMS)": rows,
        "shape that leaves least": shape,
        "reading": preferred.pop() if len(preferred) == 1 and clear else "not settled",
    }


def references(echo: np.ndarray, size: int, noise: float, seed: int) -> dict[str, Any]:
    """Images of the scan under either reading, and what a fit finds that starts from the other."""
    step = probe_geometry.VOXELS * SPAN / (SHAPE[2] - 1)
    scene = probe_geometry.Scene(jv.Volume(echo), jv.colormap("gray", (60, 200), (0.0, 0.1)), step)
    probes = {name: probe_of(half) for name, half in READINGS.items()}
    found = {}
    for name, truth in probes.items():
        start = next(probe for other, probe in probes.items() if other != name)
        targets = probe_geometry.views(scene, truth, size, noise, seed, common.FINER)
        found[name] = probe_geometry.recovered(scene, targets, truth, start)
    return found


def draw(result: dict[str, Any], slices: dict[str, np.ndarray], path: Path) -> None:
    """The plane across the fan as either reading places it; the bows, and what the best shells leave."""
    measured = result.get("voxels alone", result["control"]["half angle"])
    figure, axes = plt.subplots(1, 4, figsize=(14, 3.8), layout="constrained")
    for axis, (name, plane) in zip(axes, slices.items(), strict=False):
        half = READINGS[name]
        _, _, y0, y1, z0, z1 = np.asarray(probe_of(half).bounds)
        axis.imshow(plane.T, cmap="gray", extent=(y0, y1, z1, z0), interpolation="bilinear")
        axis.set(xlim=(-80, 80), ylim=(98, 0), facecolor="k", xlabel="y, mm", ylabel="z, mm")
        axis.set_title(f"as {name}: {2 * half:.1f}° in all", fontsize=9)
    for number, (window, bowed) in enumerate(measured["bow of the shells, samples"].items()):
        plane = np.linspace(-1, 1, len(bowed))
        axes[2].plot(plane, bowed, f"C{number}", label=f"samples {window}")
        for style, (name, half) in zip(("-", "--"), READINGS.items(), strict=True):
            left = np.asarray(bowed) - best(np.asarray(bowed), half, SHAPES[COSINE])
            axes[3].plot(plane, left, f"C{number}{style}", label=f"samples {window}, {name}")
    axes[2].set_title("depth of the shells over that in the middle plane,\nsamples", fontsize=9)
    axes[3].set_title("what the best cosine under each reading leaves of it,\nsamples", fontsize=9)
    for axis in axes[2:]:
        axis.set_xlabel("plane of the sweep, from first to last", fontsize=8)
        axis.legend(fontsize=7)
    common.save(figure, path)


def slices_of(echo: np.ndarray) -> dict[str, np.ndarray]:
    """The plane x = 0 under both readings."""
    volume, planes = jv.Volume(echo.astype(np.uint8)), {}
    for name, half in READINGS.items():
        probe = probe_of(half)
        _, _, y0, y1, z0, z1 = (float(each) for each in probe.bounds)
        spacing = (1.0, (y1 - y0) / 399, (z1 - z0) / 399)
        grid = jv.scan_convert(volume, probe, spacing, shape=(2, 400, 400), origin=(0.0, y0, z0))
        planes[name] = np.asarray(grid.data[0])
    return planes


@common.experiment(
    "elevation_angle",
    "Is the elevation angle of a real scan half of its sweep or all of it, and do the data settle that?",
    __doc__,
    size=32,
    references={"action": "store_true", "help": "fits to images, too, which take minutes"},
)
def main(chosen: Namespace) -> common.Answer:
    control = {name: made(half, SHAPE) for name, half in READINGS.items()}
    result: dict[str, Any] = {
        "half of the range, degrees": READINGS,
        "control": {name: measure(echo) for name, echo in control.items()},
    }
    for name, row in result["control"].items():
        print(f"control, made as {name}: {row['reading']}")
    folder, shown = common.data(), control["half angle"]
    if folder is not None and not chosen.quick:
        shown = scan(folder)
        result["voxels alone"] = measure(shown.astype(np.float64))
        print(f"voxels alone: {result['voxels alone']['reading']}")
        if chosen.references:
            found = references(shown, chosen.size, probe_geometry.NOISE, chosen.seed)
            result["references under one reading, start from the other"] = found
            for name, row in found.items():
                print(f"references as {name}: worst error {row['worst']:.3%} after {row['steps']} steps")
    return result, partial(draw, result, slices_of(shown))


if __name__ == "__main__":
    main()
