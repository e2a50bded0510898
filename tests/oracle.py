"""An independent ray marcher: float64 NumPy, values interpolated by scipy, one explicit loop over samples.

It shares no code with jaxvol, takes plain arrays, and follows the definition: samples at t_in + i d while
t < t_out, each representing the cell behind it.
"""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates


def box_interval(origins, directions, low, high):
    """Entry and exit distances of (n, 3) rays, by clipping against one pair of planes at a time."""
    t_in, t_out = np.zeros(len(origins)), np.full(len(origins), np.inf)
    for axis in range(3):
        for i, (o, d) in enumerate(zip(origins[:, axis], directions[:, axis], strict=True)):
            if d == 0:
                if not low[axis] <= o <= high[axis]:
                    t_out[i] = -np.inf
                continue
            first, last = sorted(((low[axis] - o) / d, (high[axis] - o) / d))
            t_in[i], t_out[i] = max(t_in[i], first), min(t_out[i], last)
    return t_in, t_out


def side_interval(origins, directions, planes):
    """Entry and exit distances of (n, 3) rays, on the side of all planes (origin, normal) to which normals
    point: of each ray, what is left of the line as one plane after the other cuts it."""
    ends = []
    for origin, direction in zip(origins, directions, strict=True):
        first, last = -np.inf, np.inf
        for point, normal in planes:
            rate, height = np.dot(direction, normal), np.dot(origin - point, normal)
            if rate > 0:
                first = max(first, -height / rate)
            elif rate < 0:
                last = min(last, -height / rate)
            elif height < 0:
                first = np.inf
        ends.append((first, last))
    return np.array(ends).reshape(-1, 2).T


def planes_of(box, planes=()):
    """Planes as (origin, normal): the six of a box (x_min, x_max, y_min, …), if there is one, and others."""
    found = [(np.asarray(p, float), np.asarray(n, float)) for p, n in planes]
    for i, end in enumerate([] if box is None else np.asarray(box, float)):
        axis = np.eye(3)[i // 2]
        found.append((end * axis, axis if i % 2 == 0 else -axis))
    return found


def mean_between(first, second, values, colors, extinction):
    """Mean colour, weighted by the extinction, and mean extinction over all values between two: by Gauss's
    rule of two points on each stretch on which both are linear, where it is exact."""
    low, high = np.minimum(first, second), np.maximum(first, second)
    whole, emission, total = high - low, np.zeros((len(low), 3)), np.zeros(len(low))

    def at(value):
        rgb = np.stack([np.interp(value, values, c) for c in colors.T], axis=1)
        return rgb, np.interp(value, values, extinction)

    ends = [-np.inf, *values, np.inf]
    for start, stop in itertools.pairwise(ends):
        a, b = np.clip(low, start, stop), np.clip(high, start, stop)
        for side in (-1, 1):
            rgb, sigma = at((a + b) / 2 + side * (b - a) / np.sqrt(12))
            emission += ((b - a) / 2 * sigma)[:, None] * rgb
            total += (b - a) / 2 * sigma
    here = at((low + high) / 2)
    seen = total > 0
    return (
        np.where(seen[:, None], emission / np.where(seen, total, 1)[:, None], here[0]),
        np.where(whole > 0, total / np.where(whole > 0, whole, 1), here[1]),
    )


class Rays(NamedTuple):
    """Entry and exit of (n,) rays, and the ends of the gap of each, (2, n), in which nothing is seen."""

    t_in: np.ndarray
    t_out: np.ndarray
    gap: np.ndarray | None = None


def whole_cell(begin, end, rays):
    """The pieces of a cell that nothing cuts."""
    return [(begin, end)]


class Meaning(NamedTuple):
    """What a transform does to a march, for all rays at once; by default nothing.

    Attributes:
        clip: the part of each ray that is seen, from (n, 3) origins and directions and the `Rays` before.
        start: (n,) offsets of the first samples, in steps.
        jump: (n,) distance from the first transparent sample to the next one, in steps; None for one step.
        cut: the pieces of a cell, front to back, from its ends and the `Rays`. One of width 0 is no sample.
        stop: which rays end at a transmittance.
    """

    clip: Callable[..., Rays] = lambda origins, directions, rays: rays
    start: float | np.ndarray = 0.0
    jump: np.ndarray | None = None
    cut: Callable[..., list[tuple[np.ndarray, np.ndarray]]] = whole_cell
    stop: Callable[[np.ndarray], Any] = lambda transmittance: False


def march(data, spacing, origin, points, origins, directions, d, *, quadrature="left", meanings=()):
    """(n, 4) premultiplied colour and opacity, and the (n,) numbers of samples.

    - `quadrature`: a sample stands for its cell at the front of it ("left"), in the middle ("midpoint"), or
      cells are integrated as if the value were linear along them ("preintegrated").
    - `points`: control points (values, colors, extinction), each a NumPy array.
    - `meanings`: of the transforms, in their order.
    """
    data, spacing, origin = (np.asarray(a, np.float64) for a in (data, spacing, origin))
    origins, directions = (np.asarray(a, np.float64).reshape(-1, 3) for a in (origins, directions))
    values, colors, extinction = (np.asarray(a, np.float64) for a in points)
    corner = origin + (np.array(data.shape) - 1) * spacing
    rays, n = Rays(*box_interval(origins, directions, origin, corner)), len(origins)
    for meaning in meanings:
        rays = meaning.clip(origins, directions, rays)
    ended = rays.t_out <= rays.t_in
    rays = Rays(np.where(ended, 0, rays.t_in), np.where(ended, 0, rays.t_out), rays.gap)
    color, transmittance, samples = np.zeros((n, 3)), np.ones(n), np.zeros(n, int)
    front = rays.t_in + sum(np.asarray(meaning.start, np.float64) for meaning in meanings) * d
    (jump,) = [meaning.jump for meaning in meanings if meaning.jump is not None] or [1.0]
    jumps = np.ones(n, bool)

    def sampled(begin: np.ndarray, end: np.ndarray) -> np.ndarray:
        return begin if quadrature == "left" else begin + np.maximum(end - begin, 0) / 2

    def value(t: np.ndarray, past: np.ndarray) -> np.ndarray:
        where = (origins + np.where(past, 0, t)[:, None] * directions - origin) / spacing
        return map_coordinates(data, where.T, order=1, mode="nearest")

    for _ in range(1_000_000):
        parts = [(front, front + d)]
        for meaning in meanings:
            parts = [piece for part in parts for piece in meaning.cut(*part, rays)]
        whole, empty = ended | (sampled(parts[0][0], parts[-1][1]) >= rays.t_out), np.ones(n, bool)
        if whole.all():
            return np.concatenate([color, 1 - transmittance[:, None]], axis=1), samples
        for begin, end in parts:
            width, t = np.maximum(end - begin, 0), sampled(begin, end)
            past = ended | (t >= rays.t_out)

            if quadrature == "preintegrated":
                rgb, sigma = mean_between(
                    value(begin, past), value(np.minimum(end, rays.t_out), past), values, colors, extinction
                )
            else:
                rgb = np.stack([np.interp(value(t, past), values, c) for c in colors.T], axis=1)
                sigma = np.interp(value(t, past), values, extinction)
            unseen = past if rays.gap is None else past | ((rays.gap[0] <= t) & (t < rays.gap[1]))
            alpha = np.where(unseen, 0, 1 - np.exp(-sigma * width))
            color += (transmittance * alpha)[:, None] * rgb
            transmittance *= 1 - alpha
            samples += ~past & ((width > 0) | (len(parts) == 1))
            empty &= alpha == 0
        front = front + d * np.where(jumps & empty, jump, 1)
        jumps &= ~empty
        ended = whole
        for meaning in meanings:
            ended = ended | meaning.stop(transmittance)
    raise AssertionError("the march never ended")
