"""Does a scan-converted volume hold at each node what the probe acquired there, and nothing outside?"""

from typing import Any

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

import jaxvol as jv


HALF = np.pi / 2
SHAPE = (9, 11, 13)
GRID: dict[str, Any] = {"spacing": (4.0, 5.0, 3.0), "shape": (24, 20, 22), "origin": (-45.0, -50.0, 22.0)}
PROBES = {
    "across the middle": (20.0, 30.0, (0.9, 2.3), (0.8, 2.4), (0.0, 60.0)),
    "apex behind the axis": (-15.0, 40.0, (HALF - 0.5, HALF + 0.6), (HALF - 0.6, HALF + 0.4), (5.0, 55.0)),
}
PROBE = PROBES["across the middle"]


def acquired(dtype, seed=0):
    rng = np.random.default_rng(seed)
    if np.dtype(dtype).kind == "f":
        return rng.normal(size=SHAPE).astype(dtype)
    limits = np.iinfo(dtype)
    return rng.integers(limits.min, limits.max, SHAPE, dtype, endpoint=True)


def nodes(grid):
    spacing = np.broadcast_to(grid["spacing"], 3)
    axes = [o + s * np.arange(n) for o, s, n in zip(grid["origin"], spacing, grid["shape"], strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1)


def toroidal(points, probe):
    """(β, σ, γ) by the paper's equation 1 in float64, which holds where z > 0 and R > 0; NaN elsewhere."""
    a, b, *_ = probe
    x, y, z = np.moveaxis(points, -1, 0)
    away = np.sqrt(y**2 + z**2) - a
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.stack([HALF + np.arctan(y / z), HALF + np.arctan(x / away), np.hypot(x, away) - b], -1)
    return np.where(((z > 0) & (away > 0))[..., None], found, np.nan)


def coordinates(probe, grid=GRID):
    """Of the nodes in the acquired grid; and how far they are outside of it."""
    ends, last = np.array(probe[2:]), np.array(SHAPE) - 1
    at = (toroidal(nodes(grid), probe) - ends[:, 0]) / (ends[:, 1] - ends[:, 0]) * last
    return at, np.max(np.maximum(-at, at - last), -1)


@pytest.mark.parametrize("name", PROBES)
@pytest.mark.parametrize("kind", ["uint8", "int16", "float32"])
def test_nodes_hold_what_scipy_interpolates_in_float64(name, kind):
    """Outside, the fill value. Integers are rounded, not cut."""
    data, probe = acquired(kind), PROBES[name]
    found = jv.scan_convert(jv.Volume(data), jv.ToroidalMap(*probe), fill_value=7, **GRID)
    assert found.data.dtype == kind
    np.testing.assert_allclose(found.spacing, GRID["spacing"])
    np.testing.assert_allclose(found.origin, GRID["origin"])
    at, outside = coordinates(probe)
    inside = outside <= 0
    sure = np.abs(np.nan_to_num(outside, nan=1)) > 1e-3  # rounding decides on those nearer to a face
    assert 0.1 < inside.mean() < 0.9
    assert sure.mean() > 0.99
    values = np.asarray(found.data, np.float64)
    assert np.all(values[~inside & sure] == 7)
    expected = map_coordinates(data.astype(np.float64), np.nan_to_num(np.moveaxis(at, -1, 0)), order=1)
    # half a unit for rounding to integers; 2e-5 of the range for the coordinates' rounding
    tolerance = 2e-5 * float(np.ptp(data.astype(np.float64))) + (0 if kind == "float32" else 0.5)
    assert np.abs(values - expected)[inside & sure].max() < tolerance


def of_nines(grid, probe=PROBE):
    """Voxels of 9, and 7 outside."""
    volume = jv.Volume(np.full(SHAPE, 9, np.uint8))
    return jv.scan_convert(volume, jv.ToroidalMap(*probe), fill_value=7, **GRID | dict(grid))


def test_nodes_on_the_faces_are_inside():
    """The middle beam begins at depth 0 and ends at 60: z from 50 to 110."""
    found = of_nines((("spacing", 6.0), ("origin", (0.0, 0.0, 44.0))))
    np.testing.assert_array_equal(np.asarray(found.data)[0, 0], [7, *[9] * 11, *[7] * 10])


def test_behind_the_apex_and_the_axis_there_is_nothing():
    """The torus that continues the sector's faces comes back there."""
    probe = (20.0, 30.0, (0.0, np.pi), (0.0, np.pi), (0.0, 60.0))
    grid = (("spacing", 10.0), ("origin", (-117.0, -98.0, -107.0)))
    x, y, z = np.moveaxis(nodes(GRID | dict(grid)), -1, 0)
    away = np.hypot(y, z) - 20
    depth = np.hypot(x, away)
    expected = (z >= 0) & (away >= 0) & (depth >= 30) & (depth <= 90)
    np.testing.assert_array_equal(np.asarray(of_nines(grid, probe).data) == 9, expected)
    assert 0.05 < expected.mean() < 0.5


def test_the_grid_encloses_the_sector_and_is_centred_on_it():
    probe, volume = jv.ToroidalMap(*PROBE), jv.Volume(np.full(SHAPE, 200, np.uint8))
    found = jv.scan_convert(volume, probe)
    np.testing.assert_allclose(found.spacing, [5.0] * 3, rtol=1e-6)  # that of samples along a beam
    np.testing.assert_allclose(found.center, probe.center, atol=1e-4)
    assert set(np.unique(found.data)) == {0, 200}
    for wide in ([5.0] * 3, [3.0] * 3, [3.0, 4.0, 7.0]):
        found = jv.scan_convert(volume, probe, wide)
        first = np.asarray(found.origin)
        last = first + (np.array(found.shape) - 1) * wide
        excess = np.stack([np.asarray(probe.corners[0]) - first, last - np.asarray(probe.corners[1])])
        assert np.all(excess > -1e-3)
        assert np.all(excess < np.array(wide) / 2)


BAD = [
    ({"volume": np.zeros(SHAPE)}, "volume must be a Volume"),
    ({"probe": jv.March(1.0)}, "probe must be a ToroidalMap; got a March"),
    ({"spacing": 0.0}, "spacing must be positive"),
    ({"spacing": (1, -1, 1)}, "spacing must be positive"),
    ({"spacing": (1, 1)}, r"spacing must have shape \(3,\)"),
    ({"spacing": 1e-30}, r"fewer than 2\*\*31 nodes; got \("),
    ({"shape": 64}, "shape must be three numbers of nodes"),
    ({"shape": (64, 1, 64)}, "shape must be an integer of at least 2; got 1"),
    ({"shape": (2000, 2000, 2000)}, r"fewer than 2\*\*31 nodes"),
    ({"shape": (4, 4, 4), "origin": (0, 0, np.nan)}, "origin must be finite"),
    ({"fill_value": "black"}, "fill_value must be .* uint8; got 'black'"),
    ({"fill_value": -1}, "fill_value must be .* uint8; got -1"),
    ({"fill_value": 0.5}, "fill_value must be .* uint8; got 0.5"),
    ({"fill_value": np.nan}, "fill_value must be .* uint8; got nan"),
    ({"spacing": 1.0, "shape": (200,) * 3}, r"200 x 200 x 200 nodes \(spacing, shape\): asks for"),
]


@pytest.mark.parametrize(("changes", "message"), BAD)
def test_bad_arguments_are_named_before_a_grid_is_made(changes, message, monkeypatch):
    monkeypatch.setattr("jaxvol._util.memory.memory_of_device", lambda: 2**20)
    good: dict[str, Any] = {"volume": jv.Volume(acquired("uint8")), "probe": jv.ToroidalMap(*PROBE)}
    with pytest.raises(ValueError, match=message):
        jv.scan_convert(**(good | changes))
