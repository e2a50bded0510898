"""What does the real ultrasound scan say about its own elevation angle? Measured without any map: how the
shells of reverberation bow over the planes of the sweep.

A shell whose centre lies off the motor axis bows by the cosine of the angle from its middle, one that is flat
by the secant. The nearer the angles, the more both look like a parabola; so if one knew which of them the
shells are, their shape would tell the angle.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d
from scipy.optimize import least_squares


AZIMUTH, ELEVATION = 38.55, 54.45
"""Degrees, from the scan's header: `ApexAngleAzimuthHalf`, `ApexAngleElevationHalf`."""
START, MOTOR_RADIUS, SPAN = 52.70, 22.70, 69.58
"""mm: of the first sample from the fan's apex and from the motor axis, and the length of a beam."""
READINGS = {"half angle": ELEVATION, "whole angle": ELEVATION / 2}
"""Half of the range of elevation under both readings of the header, degrees."""
WINDOWS = ((15, 60), (60, 110))
"""Samples of a beam with two or three shells each."""
MOST = 12
"""The largest shift of a shell that is looked for, samples."""
SHAPES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "centre off the axis (cosine)": np.cos,
    "plane (secant)": lambda angle: 1 / np.cos(angle),
}


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


def explained(bowed: np.ndarray, half: float, shape: Callable[[np.ndarray], np.ndarray]) -> dict[str, float]:
    """The best bow of a shape over a range of `half` degrees to either side: what it leaves (RMS), in
    samples, and its height at the end of the range."""
    angle = np.deg2rad(np.linspace(-half, half, len(bowed)))

    def model(parameters: np.ndarray) -> np.ndarray:
        level, height, middle = parameters
        return level + height * (shape(angle - middle) - 1)

    found = least_squares(lambda parameters: model(parameters) - bowed, (0.0, 1.0, 0.0)).x
    left = model(found) - bowed
    return {"left": float(np.sqrt(np.mean(left**2))), "bow": float(np.ptp(model(found)))}


def measure(echo: np.ndarray) -> dict[str, Any]:
    """Bows, and what each shape explains of them under each reading; `echo`: [β, σ, γ]. The first plane is
    empty."""
    bows = {f"{first} to {last}": bow(echo[1:], (first, last)) for first, last in WINDOWS}
    apart = {"beams": np.deg2rad(2 * AZIMUTH) / (echo.shape[1] - 1) * START}
    for name, half in READINGS.items():
        apart[f"planes, {name}"] = np.deg2rad(2 * half) / (echo.shape[0] - 1) * MOTOR_RADIUS
    return {
        "distance at the probe's face, mm": {name: round(float(mm), 3) for name, mm in apart.items()},
        "bow of the shells, samples": {name: np.round(each, 2).tolist() for name, each in bows.items()},
        "left by shapes, samples (RMS)": {
            window: {
                f"{shape}, {name}": explained(each, half, function)
                for shape, function in SHAPES.items()
                for name, half in READINGS.items()
            }
            for window, each in bows.items()
        },
    }
