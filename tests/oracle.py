"""An independent ray marcher: float64 NumPy, values interpolated by scipy, one explicit loop over samples.

It shares no code with jaxvol, takes plain arrays, and follows the definition: samples at t_in + i d while
t < t_out, each representing the cell behind it.
"""

import itertools

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


def march(
    data,
    spacing,
    origin,
    points,
    origins,
    directions,
    d,
    *,
    quadrature="left",
    align=False,
    opacity_left=None,
    start: float | np.ndarray = 0.0,
    front_residual=False,
    empty_jump=None,
    planes=(),
    inside_out=False,
):
    """(n, 4) premultiplied colour and opacity, and the (n,) numbers of samples.

    - `quadrature`: a sample stands for its cell at the front of it ("left"), in the middle ("midpoint"), or
      cells are integrated as if the value were linear along them ("preintegrated").
    - `points`: control points (values, colors, extinction), each a NumPy array.
    - `align`: cut the last cell at the exit.
    - `opacity_left`: end a ray once its transmittance is this low.
    - `start`: (n,) offsets of the first samples, in steps. With `front_residual`, the part before the first
      sample is a cell of its own.
    - `empty_jump`: (n,) distance from the first transparent sample to the next one, in steps.
    - `planes`: pairs (origin, normal). Only what lies on the sides of all their normals is seen; or, with
      `inside_out`, only what does not. A ray begins with the first point of it that is seen, and ends with
      the last one. `align` also cuts cells at the ends of what is not seen in between.
    """
    data, spacing, origin = (np.asarray(a, np.float64) for a in (data, spacing, origin))
    origins, directions = (np.asarray(a, np.float64).reshape(-1, 3) for a in (origins, directions))
    values, colors, extinction = (np.asarray(a, np.float64) for a in points)
    t_in, t_out = box_interval(origins, directions, origin, origin + (np.array(data.shape) - 1) * spacing)

    n = len(origins)
    gap = np.full((2, n), np.inf)
    if planes:
        first, last = side_interval(origins, directions, planes)
        if not inside_out:
            t_in, t_out = np.maximum(t_in, first), np.minimum(t_out, last)
        else:
            crosses = (first < last) & (first < t_out) & (last > t_in)
            gap = np.where(crosses & (first > t_in) & (last < t_out), (first, last), np.inf)
            starts, stops = crosses & (first <= t_in), crosses & (last >= t_out)
            t_in, t_out = np.where(starts, last, t_in), np.where(stops, first, t_out)
    color, transmittance, samples = np.zeros((n, 3)), np.ones(n), np.zeros(n, int)
    ended = t_out <= t_in
    t_in, t_out = (np.where(ended, 0, t) for t in (t_in, t_out))
    front = t_in + (np.asarray(start, np.float64) - front_residual) * d
    jumps = np.zeros(n, bool) if empty_jump is None else np.ones(n, bool)

    def sampled(begin, end):
        return begin if quadrature == "left" else begin + np.maximum(end - begin, 0) / 2

    for _ in range(1_000_000):
        begin = np.maximum(front, t_in) if front_residual else front
        end = front + d
        if align:
            end = np.minimum(end, t_out)
        parts = [(begin, end)]
        if align and planes and inside_out:
            first, last = (np.clip(each, begin, np.maximum(begin, end)) for each in gap)
            parts = [(begin, first), (first, last), (last, end)]
        whole, empty = ended | (sampled(begin, end) >= t_out), np.ones(n, bool)
        if whole.all():
            return np.concatenate([color, 1 - transmittance[:, None]], axis=1), samples
        for begin, end in parts:
            width, t = np.maximum(end - begin, 0), sampled(begin, end)
            past = ended | (t >= t_out)

            def value(t, past=past):
                where = (origins + np.where(past, 0, t)[:, None] * directions - origin) / spacing
                return map_coordinates(data, where.T, order=1, mode="nearest")

            if quadrature == "preintegrated":
                rgb, sigma = mean_between(
                    value(begin), value(np.minimum(end, t_out)), values, colors, extinction
                )
            else:
                rgb = np.stack([np.interp(value(t), values, c) for c in colors.T], axis=1)
                sigma = np.interp(value(t), values, extinction)
            alpha = np.where(past | ((gap[0] <= t) & (t < gap[1])), 0, 1 - np.exp(-sigma * width))
            color += (transmittance * alpha)[:, None] * rgb
            transmittance *= 1 - alpha
            samples += ~past & ((width > 0) | (len(parts) == 1))
            empty &= alpha == 0
        ended = whole
        jump = jumps & empty
        front = front + d * np.where(jump, 0 if empty_jump is None else empty_jump, 1)
        jumps &= ~jump
        if opacity_left is not None:
            ended = ended | (transmittance <= opacity_left)
    raise AssertionError("the march never ended")
