"""An independent marcher: float64 NumPy, values by scipy, loops over samples in the open.

It shares no code with jaxvol, takes plain arrays, and is written from the definition: samples at
t_in + i d while t < t_out, each standing for the cell behind it.
"""

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


def march(
    data,
    spacing,
    origin,
    points,
    origins,
    directions,
    d,
    *,
    midpoint=False,
    align=False,
    opacity_left=None,
):
    """(n, 4) premultiplied colour and opacity, and (n,) numbers of samples.

    `points`: (values, colors, extinction), each a NumPy array.
    """
    data, spacing, origin = (np.asarray(a, np.float64) for a in (data, spacing, origin))
    origins, directions = (np.asarray(a, np.float64).reshape(-1, 3) for a in (origins, directions))
    values, colors, extinction = (np.asarray(a, np.float64) for a in points)
    t_in, t_out = box_interval(origins, directions, origin, origin + (np.array(data.shape) - 1) * spacing)

    n = len(origins)
    color, transmittance, samples = np.zeros((n, 3)), np.ones(n), np.zeros(n, int)
    ended = t_out <= t_in
    for i in range(1_000_000):
        front = t_in + i * d
        width = np.full(n, float(d))
        if align:
            width = np.clip(np.where(np.isfinite(t_out), t_out, 0) - front, 0, d)
        t = front + width / 2 if midpoint else front
        ended = ended | (t >= t_out)
        if ended.all():
            return np.concatenate([color, 1 - transmittance[:, None]], axis=1), samples
        where = (origins + np.where(ended, 0, t)[:, None] * directions - origin) / spacing
        value = map_coordinates(data, where.T, order=1, mode="nearest")
        sigma = np.interp(value, values, extinction)
        alpha = np.where(ended, 0, 1 - np.exp(-sigma * width))
        rgb = np.stack([np.interp(value, values, c) for c in colors.T], axis=1)
        color += (transmittance * alpha)[:, None] * rgb
        transmittance *= 1 - alpha
        samples += ~ended
        if opacity_left is not None:
            ended = ended | (transmittance <= opacity_left)
    raise AssertionError("the march never ended")
