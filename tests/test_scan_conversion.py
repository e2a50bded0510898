"""Does a scan-converted volume hold at each node what the probe acquired there, and nothing outside?"""

from functools import partial
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

import jaxvol as jv
from jaxvol import scan_conversion
from jaxvol.metrics import rmse

from .scenes import in_float64


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
    axes = [
        o + s * np.arange(n) for o, s, n in zip(grid["origin"], grid["spacing"], grid["shape"], strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1)


def toroidal(points, probe):
    """(β, σ, γ) by the paper's equation 1 in float64, which holds where z > 0 and R > 0; NaN elsewhere."""
    a, b, *_ = probe
    x, y, z = np.moveaxis(points, -1, 0)
    away = np.sqrt(y**2 + z**2) - a
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.stack([HALF + np.arctan(y / z), HALF + np.arctan(x / away), np.hypot(x, away) - b], -1)
    return np.where(((z > 0) & (away > 0))[..., None], found, np.nan)


def resampled(data, probe, grid):
    """Trilinear interpolation by SciPy in float64, NaN outside; and nodes so near to a face that rounding
    decides."""
    ends = np.array(probe[2:])
    at = (toroidal(nodes(grid), probe) - ends[:, 0]) / (ends[:, 1] - ends[:, 0]) * (np.array(SHAPE) - 1)
    outside = np.max(np.maximum(-at, at - (np.array(SHAPE) - 1)), -1)
    value = map_coordinates(data.astype(np.float64), np.nan_to_num(np.moveaxis(at, -1, 0)), order=1)
    return np.where(outside <= 0, value, np.nan), np.abs(outside) < 1e-3


def test_values_beyond_an_integer_type_become_its_ends():
    data = np.broadcast_to(np.linspace(-3000, 3000, SHAPE[2]), SHAPE).astype(np.int16)
    volume = jv.scan_convert(jv.Volume(data), jv.ToroidalMap(*PROBE), fill_value=7, dtype="uint8", **GRID)
    expected, unsure = resampled(data, PROBE, GRID)
    sure = np.isfinite(expected) & ~unsure
    assert np.min(expected[sure]) < -1000
    assert np.max(expected[sure]) > 1000
    np.testing.assert_allclose(
        np.asarray(volume.data, float)[sure], np.clip(expected[sure], 0, 255), rtol=0, atol=0.51
    )


@pytest.mark.parametrize("name", PROBES)
@pytest.mark.parametrize("dtype", ["uint8", "int16", "float16", "float32"])
def test_nodes_hold_what_scipy_interpolates_in_float64(name, dtype):
    data, probe = acquired(dtype), PROBES[name]
    volume = jv.scan_convert(jv.Volume(data), jv.ToroidalMap(*probe), fill_value=7, **GRID)
    assert volume.data.dtype == dtype
    np.testing.assert_allclose(volume.spacing, GRID["spacing"])
    np.testing.assert_allclose(volume.origin, GRID["origin"])
    expected, unsure = resampled(data, probe, GRID)
    inside = np.isfinite(expected)
    assert 0.1 < inside.mean() < 0.9
    assert unsure.mean() < 0.01
    found = np.asarray(volume.data, np.float64)
    assert np.all(found[~inside & ~unsure] == 7)
    # half a unit for rounding to integers; 2e-5 of the range for the coordinates' rounding
    spread = float(np.ptp(data.astype(np.float64)))
    tolerance = 2e-5 * spread + {"uint8": 0.5, "int16": 0.5, "float16": 1e-3 * spread}.get(dtype, 0)
    assert np.abs(found - expected)[inside & ~unsure].max() < tolerance


def test_what_is_linear_in_depth_and_angles_is_exact():
    """value = β + 10 σ + γ at the samples, so that it is that everywhere."""
    ends = [np.linspace(*e, num=n) for e, n in zip(PROBE[2:], SHAPE, strict=True)]
    beta, sigma, gamma = np.meshgrid(*ends, indexing="ij")
    volume = jv.Volume((beta + 10 * sigma + gamma).astype(np.float32))
    found = jv.scan_convert(volume, jv.ToroidalMap(*PROBE), fill_value=-1e3, **GRID)
    beta, sigma, gamma = np.moveaxis(toroidal(nodes(GRID), PROBE), -1, 0)
    inside = np.asarray(found.data) > -999
    np.testing.assert_allclose(found.data[inside], (beta + 10 * sigma + gamma)[inside], atol=1e-4)


def test_the_grid_encloses_the_sector_and_is_centred_on_it():
    probe = jv.ToroidalMap(*PROBE)
    volume = jv.Volume(np.full(SHAPE, 200, np.uint8))
    for spacing, wide in ((None, [5.0] * 3), (3.0, [3.0] * 3), ((3, 4, 7), [3.0, 4.0, 7.0])):
        found = jv.scan_convert(volume, probe, spacing)
        np.testing.assert_allclose(found.spacing, wide, rtol=1e-6)
        np.testing.assert_allclose(found.center, probe.center, atol=1e-4)
        excess = np.stack(found.corners) * [[-1], [1]] - np.stack(probe.corners) * [[-1], [1]]
        assert np.all(excess > -1e-3)
        assert np.all(excess < np.array(wide) / 2)
        assert set(np.unique(found.data)) == {0, 200}


def test_nodes_on_the_faces_are_inside():
    """The middle beam begins at depth 0 and ends at 60: z from 50 to 110."""
    volume = jv.Volume(np.full(SHAPE, 9, np.uint8))
    grid: dict[str, Any] = {"spacing": 6.0, "shape": (2, 2, 13), "origin": (0.0, 0.0, 44.0)}
    found = np.asarray(jv.scan_convert(volume, jv.ToroidalMap(*PROBE), **grid).data)[0, 0]
    np.testing.assert_array_equal(found, [0, *[9] * 11, 0])


def test_behind_the_apex_and_the_axis_there_is_nothing():
    """The torus that continues the sector's faces comes back there."""
    probe = jv.ToroidalMap(20.0, 30.0, (0.0, np.pi), (0.0, np.pi), (0.0, 60.0))
    grid: dict[str, Any] = {"spacing": 4.0, "shape": (61, 61, 61), "origin": (-120.0,) * 3}
    found = np.asarray(jv.scan_convert(jv.Volume(np.full(SHAPE, 9, np.uint8)), probe, **grid).data)
    x, y, z = np.moveaxis(nodes(grid | {"spacing": (4.0,) * 3}), -1, 0)
    away = np.hypot(y, z) - 20
    depth = np.hypot(x, away)
    expected = (z >= 0) & (away >= 0) & (depth >= 30) & (depth <= 90)
    sure = (np.abs(depth - 30) > 1e-3) & (np.abs(depth - 90) > 1e-3) & (z != 0) & (np.abs(away) > 1e-3)
    np.testing.assert_array_equal((found == 9)[sure], expected[sure])
    assert 0.05 < expected[sure].mean() < 0.5


def test_the_type_may_be_another_and_integers_are_rounded_not_cut():
    volume = jv.Volume(np.tile(np.array([0, 1], np.uint8), (9, 11, 7))[:, :, :13])
    probe = jv.ToroidalMap(*PROBE)
    exact = jv.scan_convert(volume, probe, dtype="float32", **GRID).data
    rounded = jv.scan_convert(volume, probe, **GRID).data
    assert exact.dtype == jnp.float32
    sure = np.abs(np.asarray(exact) % 1 - 0.5) > 1e-4
    np.testing.assert_array_equal(np.asarray(rounded)[sure], np.rint(np.asarray(exact))[sure])
    assert np.mean(np.asarray(rounded) != np.floor(np.asarray(exact))) > 0.05
    assert jv.scan_convert(volume, probe, dtype=jnp.bfloat16, **GRID).data.dtype == jnp.bfloat16


def test_labels_are_those_of_the_nearest_sample():
    labels = np.random.default_rng(1).integers(1, 5, SHAPE).astype(np.int16)
    probe = jv.ToroidalMap(*PROBE)
    found = jv.scan_convert(jv.Volume(acquired("uint8"), labels=labels), probe, **GRID).labels
    ends = np.array(PROBE[2:])
    at = (toroidal(nodes(GRID), PROBE) - ends[:, 0]) / (ends[:, 1] - ends[:, 0]) * (np.array(SHAPE) - 1)
    inside = np.all((at > 1e-3) & (at < np.array(SHAPE) - 1 - 1e-3), -1)
    sure = inside & np.all(np.abs(at % 1 - 0.5) > 1e-3, -1)
    i, j, k = np.moveaxis(np.rint(at[sure]).astype(int), -1, 0)
    assert found is not None
    assert found.dtype == jnp.int16
    np.testing.assert_array_equal(np.asarray(found)[sure], labels[i, j, k])
    assert np.all(np.asarray(found)[np.isnan(at[..., 0])] == 0)


def test_gradients_are_central_differences():
    with in_float64():
        rng = np.random.default_rng(0)
        data, weights = (jnp.asarray(rng.normal(size=shape)) for shape in (SHAPE, GRID["shape"]))
        space = jv.March(1.0, (jv.ToroidalMap(*PROBE),)).locate(jv.Volume(data))
        # a node that crosses a face or a plane of samples has no derivative there
        at = np.stack(jax.vmap(space.coordinate)(tuple(jnp.asarray(nodes(GRID).reshape(-1, 3).T))), -1)
        smooth = np.all(np.abs(at - np.rint(at)) > 1e-4, -1).reshape(GRID["shape"])
        weights = jnp.where(smooth, weights, 0)

        def total(data, probe):
            return jnp.sum(weights * jv.scan_convert(jv.Volume(data), probe, **GRID).data)

        probe = jv.ToroidalMap(*PROBE)
        leaves, rebuild = jax.tree.flatten((data, probe))
        of_leaves = jax.jit(lambda leaves: total(*jax.tree.unflatten(rebuild, leaves)))
        gradient = jax.grad(of_leaves)(leaves)
        for i, leaf in enumerate(leaves):
            change = [jnp.zeros_like(other) for other in leaves]
            change[i] = jnp.asarray(rng.normal(size=leaf.shape))
            ends = [
                of_leaves([p + h * d for p, d in zip(leaves, change, strict=True)]) for h in (1e-6, -1e-6)
            ]
            slope = float(jnp.vdot(gradient[i], change[i]))
            assert slope == pytest.approx(float(ends[0] - ends[1]) / 2e-6, rel=1e-6)
            assert abs(slope) > 1e-3


@pytest.mark.slow
def test_images_of_finer_grids_come_nearer_to_direct_rendering():
    volume, probe = jv.toroidal_phantom("spheres", (24, 32, 64), speckle=False)
    transfer = jv.colormap("gray", (20, 200), (0.0, 0.3))
    camera = jv.Camera((60, -150, -110), (0, 0, 95), (1, 0, 0), 30.0, size=(40, 40))
    cut = jv.AlphaCorrection()
    truth = jv.render(volume, transfer, camera, jv.March(0.25, (probe, cut), "midpoint")).rgba
    errors = []
    for spacing in (8.0, 4.0, 2.0, 1.0):
        grid = jv.scan_convert(volume, probe, spacing, dtype="float32")
        errors.append(rmse(jv.render(grid, transfer, camera, jv.March(0.25, (cut,), "midpoint")).rgba, truth))
    assert all(fine < 0.75 * coarse for coarse, fine in pairwise(errors))
    assert errors[-1] < 0.01


def test_memory_beside_the_result_is_that_of_a_plane():
    volume, probe = jv.Volume(np.zeros(SHAPE, np.uint8)), jv.ToroidalMap(*PROBE)
    shape = (256, 64, 64)
    arguments = volume, probe, jnp.zeros(3), jnp.ones(3), shape, np.dtype("uint8"), 0.0
    resampled: Any = scan_conversion._resampled
    compiled = resampled.lower(*arguments).compile().compiled
    assert compiled.memory_analysis().temp_size_in_bytes < 16 * 4 * shape[1] * shape[2]


BAD = {
    "no volume": ({"volume": np.zeros(SHAPE)}, "volume must be a Volume"),
    "no probe": ({"probe": jv.March(1.0)}, "probe must be a ToroidalMap; got a March"),
    "no spacing": ({"spacing": 0.0}, "spacing must be positive"),
    "a negative spacing": ({"spacing": (1, -1, 1)}, "spacing must be positive"),
    "a spacing of two": ({"spacing": (1, 1)}, r"spacing must have shape \(3,\)"),
    "a spacing too fine": ({"spacing": 1e-3}, r"fewer than 2\*\*31 nodes; got \("),
    "an infinitesimal spacing": ({"spacing": 1e-30}, r"fewer than 2\*\*31 nodes"),
    "a shape of one number": ({"shape": 64}, "shape must be three numbers of nodes"),
    "a shape of one node": ({"shape": (64, 1, 64)}, "shape must be an integer of at least 2; got 1"),
    "a shape too large": ({"shape": (2000, 2000, 2000)}, r"fewer than 2\*\*31 nodes"),
    "an origin of NaN": ({"shape": (4, 4, 4), "origin": (0, 0, np.nan)}, "origin must be finite"),
    "a fill of text": ({"fill_value": "black"}, "fill_value must be a number; got 'black'"),
    "a fill beyond the type": ({"fill_value": -1}, r"fill_value must be .* uint8; got -1\. .*float32"),
    "a fill between": ({"fill_value": 0.5}, "fill_value must be .* uint8; got 0.5"),
    "a fill of NaN": ({"fill_value": np.nan, "dtype": "float32"}, "fill_value must be .* float32; got nan"),
    "a type that voxels cannot have": ({"dtype": "int32"}, "dtype must be one of uint8, .*got 'int32'"),
    "no type": ({"dtype": "rgb"}, "dtype must be one of uint8"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_arguments_are_named(case):
    changes, message = BAD[case]
    good: dict[str, Any] = {"volume": jv.Volume(acquired("uint8")), "probe": jv.ToroidalMap(*PROBE)}
    with pytest.raises(ValueError, match=message):
        jv.scan_convert(**(good | changes))


def test_a_grid_larger_than_memory_is_refused_before_it_is_made(monkeypatch):
    monkeypatch.setattr("jaxvol._util.memory.memory_of_device", lambda: 2**20)
    probe, volume = jv.ToroidalMap(*PROBE), jv.Volume(acquired("uint8"))
    with pytest.raises(ValueError, match=r"200 x 200 x 200 nodes \(spacing, shape\): asks for"):
        jv.scan_convert(volume, probe, 1.0, shape=(200, 200, 200))


def test_a_traced_probe_needs_a_grid():
    volume = jv.Volume(acquired("uint8"))
    with pytest.raises(ValueError, match="shape, spacing and origin must be given where the probe is traced"):
        jax.jit(partial(jv.scan_convert, volume))(jv.ToroidalMap(*PROBE))
