"""Values, gradients and labels between the nodes of a grid, and invalid volumes."""

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

import jaxvol as jv
from jaxvol._util.vec3 import apart

from .scenes import in_float64


DTYPES = ["uint8", "int8", "uint16", "int16", "float16", "bfloat16", "float32"]
SHAPE = (5, 7, 6)


def random_data(dtype: str, seed: int = 0) -> np.ndarray:
    """Random values over an integer type's whole range, or normal ones for floats."""
    random = np.random.default_rng(seed)
    if dtype in ("float16", "bfloat16", "float32"):
        return random.normal(0, 100, SHAPE).astype(ml_dtypes.bfloat16 if dtype == "bfloat16" else dtype)
    limits = np.iinfo(dtype)
    return random.integers(limits.min, limits.max, SHAPE, dtype=dtype, endpoint=True)


def random_coordinates(n: int = 200) -> np.ndarray:
    """Points in the grid and up to one node outside, including the grid's corners."""
    corners = np.array([(x, y, z) for x in (0, 4) for y in (0, 6) for z in (0, 5)], float)
    inside = np.random.default_rng(1).uniform(-1, np.array(SHAPE), (n, 3))
    return np.concatenate([corners, inside]).astype(np.float32)


def at(function, coordinates):
    return jax.vmap(lambda c: function(apart(c)))(jnp.asarray(coordinates))


@pytest.mark.parametrize("dtype", DTYPES)
def test_values_are_trilinear_and_voxels_keep_their_type(dtype):
    data = random_data(dtype)
    volume = jv.Volume(data)
    assert str(volume.data.dtype) == dtype
    coordinates = random_coordinates()
    expected = map_coordinates(data.astype(np.float64), coordinates.T, order=1, mode="nearest")
    scale = np.abs(data.astype(np.float64)).max()
    np.testing.assert_allclose(at(volume.value, coordinates), expected, atol=1e-6 * scale, rtol=0)


def test_value_at_a_node_is_the_voxel_exactly():
    data = random_data("float32")
    nodes = np.argwhere(np.ones(SHAPE, bool)).astype(np.float32)
    np.testing.assert_array_equal(at(jv.Volume(data).value, nodes), data.reshape(-1))


def test_a_coordinate_that_is_not_a_number_reads_no_memory_outside():
    nan = jnp.nan * jnp.ones(())
    assert jnp.isnan(jv.Volume(random_data("float32")).value((nan, nan, nan)))


def test_trilinear_gradient_is_the_derivative_of_the_value():
    volume = jv.Volume(random_data("float32"), spacing=(0.5, 2.0, 3.0))
    coordinates = np.random.default_rng(2).uniform(0.1, np.array(SHAPE) - 1.1, (50, 3)).astype(np.float32)
    slopes = jax.vmap(jax.grad(lambda c: volume.value(apart(c))))(jnp.asarray(coordinates))
    found = jnp.stack(at(lambda c: volume.gradient(c, "trilinear"), coordinates), axis=-1)
    np.testing.assert_allclose(found, np.asarray(slopes) / np.asarray(volume.spacing), rtol=1e-4, atol=1e-2)


@pytest.mark.parametrize("method", ["trilinear", "central"])
def test_gradient_of_a_linear_field_is_its_slope_up_to_the_faces(method):
    x, y, z = np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij")
    spacing = np.array([0.5, 2.0, 3.0])
    slope = np.array([3.0, -1.0, 0.25])
    data = np.asarray(sum(s * h * axis for s, h, axis in zip(slope, spacing, (x, y, z), strict=True)))
    volume = jv.Volume(data.astype(np.float32), spacing)
    inside = np.random.default_rng(3).uniform(0, np.array(SHAPE) - 1, (100, 3)).astype(np.float32)
    found = np.stack(at(lambda c: volume.gradient(c, method), inside), axis=-1)
    np.testing.assert_allclose(found, np.broadcast_to(slope, found.shape), rtol=1e-4, atol=1e-4)


def test_central_gradient_falls_to_the_true_one_with_the_square_of_the_spacing():
    def error(n: int) -> float:
        axis = np.linspace(-1, 1, n, dtype=np.float32)
        x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
        volume = jv.Volume(np.sin(3 * x) * np.cos(2 * y) * np.exp(z), spacing=[2 / (n - 1)] * 3)
        middle = (n - 1) // 2 + (n - 1) // 8
        p = axis[middle]
        found = np.stack(volume.gradient(tuple(jnp.full(3, float(middle)))))
        true = [
            3 * np.cos(3 * p) * np.cos(2 * p) * np.exp(p),
            -2 * np.sin(3 * p) * np.sin(2 * p) * np.exp(p),
            np.sin(3 * p) * np.cos(2 * p) * np.exp(p),
        ]
        return float(np.abs(found - true).max())

    order = np.log2(error(17) / error(33))
    assert 1.8 < order < 2.2


def test_label_is_that_of_the_nearest_node():
    labels = np.arange(np.prod(SHAPE)).reshape(SHAPE).astype(np.uint8)
    volume = jv.Volume(random_data("uint8"), labels=labels)
    coordinates = random_coordinates()
    nearest = np.clip(np.floor(coordinates + 0.5).astype(int), 0, np.array(SHAPE) - 1)
    np.testing.assert_array_equal(at(volume.label, coordinates), labels[tuple(nearest.T)])


def test_bounds_span_from_the_first_node_to_the_last():
    volume = jv.Volume(np.zeros(SHAPE, np.uint8), spacing=(1, 2, 3), origin=(10, 20, 30))
    np.testing.assert_allclose(volume.bounds, (10, 14, 20, 32, 30, 45))
    np.testing.assert_allclose(volume.center, (12, 26, 37.5))
    assert volume.shape == SHAPE


def test_float64_data_follow_jax():
    assert jv.Volume(np.zeros(SHAPE)).data.dtype == jnp.float32
    with in_float64():
        assert jv.Volume(np.zeros(SHAPE)).data.dtype == jnp.float64


WIDE = {
    "bool": (np.arange(210).reshape(SHAPE) % 2 == 0, "uint8"),
    "int64 of 8 bits": (np.arange(210).reshape(SHAPE), "uint8"),
    "int64 of 9 bits, signed": (np.arange(210).reshape(SHAPE) - 200, "int16"),
    "int32 of 7 bits, signed": (np.arange(210).reshape(SHAPE).astype(np.int32) // 2 - 50, "int8"),
    "uint32 of 16 bits": (np.arange(210).reshape(SHAPE).astype(np.uint32) * 300, "uint16"),
    "int64 of 25 bits": (np.arange(210).reshape(SHAPE) * -(2**16), "float32"),
    "big-endian int32": (np.arange(210).reshape(SHAPE).astype(">i4"), "uint8"),
    "big-endian uint16": (np.arange(210).reshape(SHAPE).astype(">u2"), "uint16"),
    "big-endian float32": (np.arange(210).reshape(SHAPE).astype(">f4"), "float32"),
    "int32 of JAX": (jnp.arange(210).reshape(SHAPE), "uint8"),
    "lists": (np.arange(210).reshape(SHAPE).tolist(), "uint8"),
    "every other, turned": (np.arange(840, dtype=np.uint16).reshape(6, 7, 20)[:, :, ::-4].T, "uint16"),
}


@pytest.mark.parametrize("case", WIDE)
def test_arrays_of_any_type_and_layout_become_one_that_holds_them_exactly(case):
    data, becomes = WIDE[case]
    labels = np.asarray(data).astype(np.int64) if np.asarray(data).dtype.kind == "f" else data
    volume = jv.Volume(data, labels=labels)
    assert str(volume.data.dtype) == becomes
    np.testing.assert_array_equal(np.asarray(volume.data, np.float64), np.asarray(data, np.float64))
    np.testing.assert_array_equal(volume.labels, np.asarray(data).astype(np.int64))


def test_a_file_that_is_mapped_and_read_only_is_taken(tmp_path):
    np.save(tmp_path / "a.npy", np.arange(210, dtype=np.int16).reshape(SHAPE))
    mapped = np.load(tmp_path / "a.npy", mmap_mode="r")
    np.testing.assert_array_equal(jv.Volume(mapped).data, mapped)


BAD = {
    "2-D": (lambda: jv.Volume(np.zeros((4, 4), np.uint8)), r"data\[x, y, z\].*shape \(4, 4\).*stack"),
    "an axis of one voxel": (
        lambda: jv.Volume(np.zeros((4, 1, 4), np.uint8)),
        r"at least 2 voxels.*\(4, 1, 4\)",
    ),
    "a mask": (lambda: jv.Volume(np.ma.zeros(SHAPE)), r"data must be an array without a mask"),
    "objects": (lambda: jv.Volume(np.full(SHAPE, None)), r"data must be of type.*got object"),
    "beyond 2**24": (
        lambda: jv.Volume(np.arange(210).reshape(SHAPE) + 2**24),
        r"data must be whole numbers from -2\*\*24 to 2\*\*24.*; got int64 from 16777216 to 16777425",
    ),
    "traced int32": (
        lambda: jax.jit(lambda data: jv.Volume(data).data)(np.zeros(SHAPE, np.int32)),
        r"data must be of type .* if traced; got int32.*astype\(jnp\.float32\)",
    ),
    "1e300": (
        lambda: jv.Volume(np.where(np.arange(6) == 2, 1e300, np.zeros(SHAPE))),
        r"data must be finite in float32, .*; got 35 of 210 voxels",
    ),
    "ragged": (lambda: jv.Volume([[[1, 2], [3]]]), "data must be an array; got a list"),
    "complex": (lambda: jv.Volume(np.zeros(SHAPE, complex)), r"got complex128"),
    "text": (
        lambda: jv.Volume("engine.raw"),
        r"data must be an array; got 'engine\.raw'\. jv\.load\(path\) reads files",
    ),
    "zero spacing": (
        lambda: jv.Volume(np.zeros(SHAPE, np.uint8), spacing=(1, 0, 1)),
        r"spacing must be positive",
    ),
    "negative spacing": (
        lambda: jv.Volume(np.zeros(SHAPE, np.uint8), spacing=(1, -1, 1)),
        r"spacing must be positive",
    ),
    "NaN spacing": (
        lambda: jv.Volume(np.zeros(SHAPE, np.uint8), spacing=(1, np.nan, 1)),
        r"spacing must be finite",
    ),
    "one spacing": (
        lambda: jv.Volume(np.zeros(SHAPE, np.uint8), spacing=1.0),
        r"spacing must have shape \(3,\)",
    ),
    "infinite origin": (
        lambda: jv.Volume(np.zeros(SHAPE, np.uint8), origin=(0, 0, np.inf)),
        r"origin must be finite",
    ),
    "labels of another shape": (
        lambda: jv.Volume(np.zeros(SHAPE, np.uint8), labels=np.zeros((5, 7, 5), np.uint8)),
        r"labels must have the shape of data, \(5, 7, 6\); got shape \(5, 7, 5\)",
    ),
    "labels that are no integers": (
        lambda: jv.Volume(np.zeros(SHAPE, np.uint8), labels=np.zeros(SHAPE)),
        r"labels must be integers; got float64.*astype",
    ),
    "labels beyond int32": (
        lambda: jv.Volume(np.zeros(SHAPE, np.uint8), labels=np.full(SHAPE, 2**40)),
        r"labels must lie within int32; got int64 from 1099511627776 to 1099511627776",
    ),
    "labels of 32 bits beyond int32": (
        lambda: jv.Volume(np.zeros(SHAPE, np.uint8), labels=np.full(SHAPE, 2**31, np.uint32)),
        r"labels must lie within int32; got uint32",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    make, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("dtype", ["float16", "bfloat16", "float32"])
def test_voxels_that_are_not_finite_are_counted(dtype):
    data = random_data(dtype)
    data[0, 0, 0], data[1, 2, 3], data[4, 6, 5] = np.nan, np.inf, -np.inf
    with pytest.raises(ValueError, match=r"data must be finite; got 3 of 210 voxels"):
        jv.Volume(data)


def test_traced_voxels_that_are_not_finite_fail_when_the_program_runs():
    build = jax.jit(lambda data: jv.Volume(data).data.sum())
    assert build(jnp.ones(SHAPE)) == 210
    with pytest.raises(Exception, match="data must be finite"):
        jax.block_until_ready(build(jnp.full(SHAPE, jnp.nan)))
