"""Values, gradients and labels between the nodes of a grid, and invalid volumes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.engine.acceleration import unshaped, with_words, words_of
from jaxvol.scene import voxel_fetch

from ..scenes import in_float64


DTYPES = ["uint8", "int8", "uint16", "int16", "float16", "bfloat16", "float32"]
SHAPE = (5, 7, 6)
NODES = np.argwhere(np.ones(SHAPE, bool)).astype(np.float32)
SPACING = np.array([0.5, 2.0, 3.0])
LABELS = np.arange(210).reshape(SHAPE).astype(np.uint8)


def random_data(dtype: str, seed: int = 0) -> np.ndarray:
    """Random values over an integer type's whole range, or normal ones for floats."""
    random = np.random.default_rng(seed)
    if dtype in ("float16", "bfloat16", "float32"):
        return random.normal(0, 100, SHAPE).astype(ml_dtypes.bfloat16 if dtype == "bfloat16" else dtype)
    limits = np.iinfo(dtype)
    return random.integers(limits.min, limits.max, SHAPE, dtype=dtype, endpoint=True)


def random_coordinates(margin: float = 1.0) -> np.ndarray:
    """As many points as nodes, in the grid and up to so far outside (inside, if negative)."""
    far = np.array(SHAPE) - 1 + margin
    return np.random.default_rng(1).uniform(-margin, far, NODES.shape).astype(np.float32)


@eqx.filter_jit
def looked_up(data, coordinates):
    """Values, labels and gradients at each coordinate."""
    volume = jv.Volume(data, SPACING, labels=LABELS)

    def at(c):
        point = apart(c)
        return volume.value(point), volume.label(point), jnp.stack(volume.gradient(point))

    return jax.vmap(at)(coordinates)


@pytest.mark.parametrize("dtype", DTYPES)
def test_values_are_trilinear_and_voxels_keep_their_type(dtype):
    data = random_data(dtype)
    assert str(jv.Volume(data).data.dtype) == dtype
    scale = np.abs(data.astype(np.float64)).max()
    coordinates = random_coordinates()
    expected = map_coordinates(data.astype(np.float64), coordinates.T, order=1, mode="nearest")
    values, labels, *_ = looked_up(data, coordinates)
    np.testing.assert_allclose(values, expected, atol=1e-6 * scale, rtol=0)
    nearest = np.clip(np.floor(coordinates + 0.5).astype(int), 0, np.array(SHAPE) - 1)
    np.testing.assert_array_equal(labels, LABELS[tuple(nearest.T)])
    # the voxel itself at a node; nothing outside memory where a coordinate is not a number
    values, *_ = looked_up(data, NODES)
    np.testing.assert_array_equal(values, data.reshape(-1).astype(np.float32))
    assert np.isnan(looked_up(data, np.full_like(NODES, np.nan))[0]).all()


@pytest.mark.parametrize(("dtype", "fast"), [("uint8", True), ("int16", True), ("int16", False)])
def test_a_packed_copy_whose_shape_is_data_gives_the_values_between_voxels(dtype, fast, monkeypatch):
    monkeypatch.setattr(voxel_fetch, "gathers_are_fast", lambda: fast)
    data = random_data(dtype)
    volume = jv.Volume(data)
    packed = unshaped(with_words(volume, [words_of(volume)])).fetch
    apart_from_nodes = random_coordinates()
    coordinates = np.concatenate(
        [apart_from_nodes, NODES, [[np.nan, 1, 1], [1, np.inf, 1]]], dtype=np.float32
    )

    @jax.jit
    def values(packed, coordinates):
        return jax.vmap(lambda c: packed.interpolated(None, (c[0], c[1], c[2])))(coordinates)

    *found, nowhere, far = np.asarray(values(packed, coordinates))
    inside = np.clip(coordinates[:-2].T, 0, np.array(SHAPE)[:, None] - 1)
    true = map_coordinates(data.astype(np.float64), inside, order=1)
    np.testing.assert_allclose(found, true, atol=1e-6 * np.ptp(true))
    assert np.isnan(nowhere)
    np.testing.assert_allclose(far, data[1, -1, 1], rtol=1e-6)


def test_an_array_that_changes_afterwards_does_not_change_the_volume():
    """JAX shares the memory of an array that lies at a multiple of 64 bytes."""
    memory = np.zeros(210 + 64, np.uint8)
    data = memory[-memory.ctypes.data % 64 :][:210].reshape(SHAPE)
    volume = jv.Volume(data, labels=data)
    data[:] = 7
    assert not np.asarray(volume.data).any()
    assert not np.asarray(volume.labels).any()


def test_gradients_are_slopes_up_to_the_faces():
    slope = np.array([3.0, -1.0, 0.25])
    linear = (NODES * SPACING) @ slope
    _, _, found = looked_up(linear.reshape(SHAPE).astype(np.float32), random_coordinates(0.0))
    np.testing.assert_allclose(found, np.broadcast_to(slope, found.shape), rtol=1e-4, atol=1e-4)


def test_central_gradient_falls_to_the_true_one_with_the_square_of_the_spacing():
    def error(step: float) -> float:
        """Of a product of functions, sampled around (0.25, 0.25, 0.25), per grid step."""
        x, y, z = np.moveaxis(((NODES - 2) * step + 0.25).reshape(*SHAPE, 3), -1, 0)
        data = np.sin(3 * x) * np.cos(2 * y) * np.exp(z)
        found = looked_up(data.astype(np.float32), np.full_like(NODES, 2.0))[2]
        found = np.asarray(found)[0] * SPACING / step
        p = 0.25
        true = (
            np.array([3 / np.tan(3 * p), -2 * np.tan(2 * p), 1]) * np.sin(3 * p) * np.cos(2 * p) * np.exp(p)
        )
        return float(np.abs(found - true).max())

    assert 1.8 < np.log2(error(1 / 8) / error(1 / 16)) < 2.2


def test_bounds_span_from_the_first_node_to_the_last():
    volume = jv.Volume(np.zeros(SHAPE, np.uint8), spacing=(1, 2, 3), origin=(10, 20, 30))
    np.testing.assert_allclose(volume.bounds, (10, 14, 20, 32, 30, 45))
    np.testing.assert_allclose(volume.center, (12, 26, 37.5))
    assert volume.shape == SHAPE


def test_float64_data_follow_jax():
    assert jv.Volume(np.zeros(SHAPE)).data.dtype == jnp.float32
    with in_float64():
        assert jv.Volume(np.zeros(SHAPE)).data.dtype == jnp.float64


COUNT = np.arange(210).reshape(SHAPE)
WIDE = {
    "bool": (COUNT % 2 == 0, "uint8"),
    "int64 of 9 bits, signed": (COUNT - 200, "int16"),
    "uint32 of 16 bits": (COUNT.astype(np.uint32) * 300, "uint16"),
    "int64 of 25 bits": (COUNT * -(2**16), "float32"),
    "big-endian int32": (COUNT.astype(">i4"), "uint8"),
    "big-endian float32": (COUNT.astype(">f4"), "float32"),
    "int32 of JAX": (jax.device_put(COUNT.astype(np.int32)), "uint8"),
    "lists": (COUNT.tolist(), "uint8"),
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
    np.save(tmp_path / "a.npy", COUNT.astype(np.int16))
    mapped = np.load(tmp_path / "a.npy", mmap_mode="r")
    np.testing.assert_array_equal(jv.Volume(mapped).data, mapped)


ZEROS = np.zeros(SHAPE, np.uint8)
BAD = {
    "a mask": ((np.ma.zeros(SHAPE),), {}, "data must be an array without a mask"),
    "ragged": (([[[1, 2], [3]]],), {}, "data must be an array; got a list"),
    "2-D": ((np.zeros((4, 4), np.uint8),), {}, r"data\[x, y, z\].*shape \(4, 4\).*stack"),
    "objects": ((np.full(SHAPE, None),), {}, "data must be of type.*got object"),
    "beyond 2**24": (
        (COUNT + 2**24,),
        {},
        r"data must be whole numbers from -2\*\*24 to 2\*\*24.*; got int64 from 16777216 to 16777425",
    ),
    "1e300": (
        (np.where(np.arange(6) == 2, 1e300, np.zeros(SHAPE)),),
        {},
        "data must be finite in float32, .*; got 35 of 210 voxels",
    ),
    "complex": ((np.zeros(SHAPE, complex),), {}, "got complex128"),
    "text": (("engine.raw",), {}, r"data must be an array; got 'engine\.raw'\. jv\.load\(path\) reads files"),
    "zero spacing": ((ZEROS, (1, 0, 1)), {}, "spacing must be positive"),
    "NaN spacing": ((ZEROS, (1, np.nan, 1)), {}, "spacing must be finite"),
    "infinite origin": ((ZEROS,), {"origin": (0, 0, np.inf)}, "origin must be finite"),
    "labels of another shape": (
        (ZEROS,),
        {"labels": np.zeros((5, 7, 5), np.uint8)},
        r"labels must have the shape of data, \(5, 7, 6\); got shape \(5, 7, 5\)",
    ),
    "labels that are no integers": (
        (ZEROS,),
        {"labels": np.zeros(SHAPE)},
        "labels must be integers; got float64.*astype",
    ),
    "labels of 32 bits beyond int32": (
        (ZEROS,),
        {"labels": np.full(SHAPE, 2**31, np.uint32)},
        "labels must lie within int32; got uint32",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    given, more, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        jv.Volume(*given, **more)


def test_voxels_that_are_not_finite_are_counted():
    for dtype in ("float16", "bfloat16", "float32"):
        data = random_data(dtype)
        data[0, 0, 0], data[1, 2, 3], data[4, 6, 5] = np.nan, np.inf, -np.inf
        with pytest.raises(ValueError, match="data must be finite; got 3 of 210 voxels"):
            jv.Volume(data)


def test_traced_integers_must_be_of_a_voxels_type():
    with pytest.raises(
        ValueError, match=r"data must be of type .* if traced; got int32.*astype\(jnp\.float32"
    ):
        jax.eval_shape(jv.Volume, np.zeros(SHAPE, np.int32))


def test_parts_and_crops_stay_where_they_are():
    """Their nodes lie where those of the whole do, with the same values and labels."""
    turn = np.array([[0, -1, 0], [0.6, 0, 0.8], [-0.8, 0, 0.6]])
    data = np.arange(8 * 7 * 6, dtype=np.uint16).reshape(8, 7, 6)
    whole = jv.Volume(data, (1, 2, 0.5), (10, -3, 4), data % 5, direction=turn)

    def place(volume, index):
        along = np.asarray(volume.spacing, np.float64) * index
        return np.asarray(volume.origin, np.float64) + np.asarray(volume.direction, np.float64) @ along

    part = whole[2:7, ::3, 1:]
    np.testing.assert_array_equal(part.data, data[2:7, ::3, 1:])
    np.testing.assert_array_equal(part.labels, (data % 5)[2:7, ::3, 1:])
    np.testing.assert_allclose(place(part, (4, 2, 3)), place(whole, (6, 6, 4)), atol=1e-5)
    box = np.sort([place(whole, (2, 1, 2)), place(whole, (4, 3, 3))], axis=0).T.ravel()
    crop = whole.crop(box)
    assert data[2, 1, 2] in np.asarray(crop.data)
    assert data[4, 3, 3] in np.asarray(crop.data)
    np.testing.assert_array_equal(whole[2:7, ..., 1:].data, data[2:7, ..., 1:])
    np.testing.assert_array_equal(whole[..., :4].data, data[..., :4])
    for wrong, said in (
        (3, "takes up to three slices"),
        (slice(0.5, 3), "takes up to three slices of integers"),
        ((slice(None),) * 4, "takes up to three"),
        (slice(1, 2), r"must leave 2 voxels .* leaves \(1, "),
        (slice(None, None, -1), r"leaves \(0, "),
    ):
        with pytest.raises(ValueError, match=said):
            whole[wrong]
    with pytest.raises(ValueError, match=r"box must be .* that meets the volume"):
        whole.crop((0, 1, 90, 91, 0, 1))
    assert repr(part) == (
        "<Volume shape=(5, 3, 5), dtype=uint16, spacing=(1.0, 6.0, 0.5), origin=(10.0, -1.4, 2.7), "
        "direction=((0.0, -1.0, 0.0), (0.6, 0.0, 0.8), (-0.8, 0.0, 0.6)), labels to 4, values 85 to 293>"
    )
    jax.jit(lambda volume: repr(volume) and volume.data)(whole)  # of traced ones, their shapes
