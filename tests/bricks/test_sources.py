"""Does a source return the voxels of an array or a file, of any type and order, and notice if they change?"""

import inspect
import itertools
import os
from functools import partial
from typing import Any

import jax
import ml_dtypes
import numpy as np
import pytest
import tensorstore
import zarr

import jaxvol as jv
from jaxvol.bricks import VoxelSource, source_of, sources

from ..scenes import in_float64


SHAPE = (23, 17, 31)
ORDERS: Any = list(itertools.permutations(range(3)))


def voxels(dtype: Any = "uint8", shape=SHAPE):
    rng = np.random.default_rng(0)
    if dtype == "bfloat16":
        return rng.normal(size=shape).astype(ml_dtypes.bfloat16)
    if np.dtype(dtype).kind == "f":
        return rng.normal(size=shape).astype(dtype)
    limits = np.iinfo(dtype)
    return rng.integers(limits.min, limits.max, shape, dtype, endpoint=True)


def boxes(shape, count=12):
    """The whole volume, single voxels at its ends, and boxes anywhere."""
    rng = np.random.default_rng(1)
    yield (0, 0, 0), shape
    yield (0, 0, 0), (1, 1, 1)
    yield tuple(n - 1 for n in shape), shape
    for _ in range(count):
        low = rng.integers(0, shape)
        yield tuple(low), tuple(rng.integers(low + 1, np.array(shape) + 1))


def assert_reads(source, data):
    """In any order of axes."""
    assert (source.shape, source.dtype) == (data.shape, data.dtype)
    for (low, high), axes in zip(boxes(data.shape), itertools.cycle(ORDERS), strict=False):
        box = data[tuple(map(slice, low, high))]
        plain = source.read(low, high)
        for found, expected in ((source.read(low, high, axes), box.transpose(axes)), (plain, box)):
            assert found.flags.c_contiguous
            assert found.dtype == data.dtype
            assert found.dtype.isnative
            np.testing.assert_array_equal(found, expected)


def x_fastest(path, data):
    data.ravel(order="F").tofile(path)
    return path


# ---- files and arrays ----


@pytest.mark.parametrize("dtype", ["uint8", "int16", "float32", "bfloat16"])
def test_arrays_and_files_of_every_type(dtype, tmp_path):
    data = voxels(dtype)
    for given in (np.asfortranarray(data), data[::-1, ::2], jax.device_put(data), jv.Volume(data)):
        assert_reads(source_of(given), np.asarray(given.data if isinstance(given, jv.Volume) else given))
    for axes in ORDERS:
        stored = np.ascontiguousarray(data.transpose(axes)).transpose(np.argsort(axes))
        source = source_of(stored)
        assert source.order == axes
        assert np.shares_memory(source.read((0, 0, 0), SHAPE, axes), stored)  # no voxel is moved
    if dtype == "bfloat16":
        return
    assert_reads(source_of(x_fastest(tmp_path / "a.raw", data), shape=SHAPE, dtype=dtype), data)
    swapped = x_fastest(tmp_path / "b.raw", data.astype(data.dtype.newbyteorder(">")))
    if data.itemsize > 1:
        assert_reads(source_of(swapped, shape=SHAPE, dtype=f"{dtype}be"), data)
    for order in ("C", "F"):
        np.save(tmp_path / "data.npy", np.asarray(data, order=order))
        assert_reads(source_of(str(tmp_path / "data.npy")), data)


class OfOurOwn:
    """What has a shape, a type and boxes."""

    chunks: Any = None

    def __init__(self, data):
        self.data, self.shape, self.dtype = data, data.shape, data.dtype
        self.asked = []

    def __getitem__(self, box):
        self.asked.append(box)
        return self.data[box].tolist() if self.dtype == bool else self.data[box]


def kinds_of_arrays(data, folder):
    """Arrays of the libraries that there are, some of which transpose what lies in another order."""
    turned = np.ascontiguousarray(data.transpose(2, 0, 1))
    yield OfOurOwn(data)
    yield zarr.create_array({}, data=data, chunks=(8, 9, 10))
    yield tensorstore.array(turned).transpose((1, 2, 0))
    yield tensorstore.array(np.pad(data, ((2, 0), (1, 0), (0, 0))))[2:, 1:]  # whose domain begins at 2 and 1
    dask, h5py = pytest.importorskip("dask.array"), pytest.importorskip("h5py")
    yield dask.from_array(turned, chunks=(8, 9, 10)).transpose(1, 2, 0)
    with h5py.File(folder / "a.h5", "w") as file:
        yield file.create_dataset("a", data=data, chunks=(8, 9, 10))
        yield (contiguous := file.create_dataset("b", data=data))
    with pytest.raises(ValueError, match=r"source must be an array that can be read; .*Keep its file open"):
        source_of(contiguous)


def test_anything_with_a_shape_a_type_and_boxes_is_a_source(tmp_path, monkeypatch):
    monkeypatch.setattr(sources, "AT_ONCE", 3000)
    data = voxels("int16")
    for array in kinds_of_arrays(data, tmp_path):
        assert_reads(source_of(array), data)
    ours = OfOurOwn(data)
    source_of(ours).read((1, 2, 3), (9, 10, 11))
    assert len(ours.asked) == 4  # in layers of 3000 bytes, whole planes
    assert ours.asked[0][0] == slice(1, 3)

    def fails(box):
        raise RuntimeError("no disk")

    monkeypatch.setattr(OfOurOwn, "__getitem__", lambda _, box: fails(box))
    with pytest.raises(ValueError, match=r"array: the voxels from \(0, 0, 0\) .* cannot be read \(no disk\)"):
        source_of(ours).read((0, 0, 0), SHAPE)


def test_axes_beside_space_are_not_what_is_read_in_layers(monkeypatch):
    """A stack of channels, of which one is read plane by plane."""
    stack = OfOurOwn(voxels("uint8", (3, 40, 30, 20)))
    source = VoxelSource(stack, space=(3, 2, 1), index=(1, *3 * (slice(None),)))
    assert source.chunks == (20, 1, 1)
    monkeypatch.setattr(sources, "AT_ONCE", 2000)
    assert_reads(source, stack.data[1].T)


def test_what_an_array_returns_is_checked_and_xarray_is_taken_by_its_names():
    data = voxels("uint8", (8, 8, 8))

    class Clipped(OfOurOwn):
        def __getitem__(self, box):
            return self.data[box][:1]

    with pytest.raises(ValueError, match=r"must have the shape \(4, 4, 4\).*its array returns \(1, 4, 4\)"):
        source_of(Clipped(data)).read((0, 0, 0), (4, 4, 4))
    masked = OfOurOwn(np.ma.masked_equal(data, data[1, 2, 3]))
    with pytest.raises(ValueError, match=r"from \(0, 0, 0\) to \(8, 8, 8\) are masked"):
        source_of(masked).read((0, 0, 0), (8, 8, 8))
    with pytest.raises(ValueError, match="source must be an array"):
        VoxelSource(source_of(data))
    xarray = pytest.importorskip("xarray")
    at = {"xyz"[i]: 5.0 - i + (i + 0.5) * np.arange(8) for i in range(3)}
    named = xarray.DataArray(data, dims=("x", "y", "z"), coords=at).transpose("z", "x", "y")
    source = source_of(named)
    assert_reads(source, data)
    assert (source.spacing, source.origin) == ((0.5, 1.5, 2.5), (5, 4, 3))
    with pytest.raises(ValueError, match=r"channel: .* has no such axis; it holds x 8, y 8, z 8"):
        source_of(named, channel=1)


def test_memory_maps_are_read_and_not_held(tmp_path):
    data, path = voxels("int16"), tmp_path / "data"
    path.write_bytes(b"header" + data.tobytes())
    mapped = np.memmap(path, np.int16, "r", 6, SHAPE)
    for view in (
        lambda a: a.T,
        lambda a: a[3:, 2:9],
        lambda a: a[2:].transpose(1, 0, 2),
        lambda a: a[:, :, ::2],
    ):
        source = source_of(view(mapped))
        assert_reads(source, view(data))
        found = source.read((0, 0, 0), source.shape, source.order)
        assert not np.shares_memory(found, mapped)
        assert found.ctypes.data % 64 == 0  # as JAX uses it in place
    source = source_of(mapped)
    path.unlink()
    assert_reads(source, data)  # the map has the old voxels
    written = np.memmap(tmp_path / "other", np.int16, "w+", shape=SHAPE)
    source = source_of(written)
    written[:] = data
    assert_reads(source, data)
    os.truncate(tmp_path / "other", 100)  # to read it would end the process
    with pytest.raises(ValueError, match="changed after it was opened"):
        source.read((0, 0, 0), (1, 1, 1))


def test_spacing_and_origin(tmp_path):
    path = x_fastest(tmp_path / "data_23x17x31_uint8.raw", voxels())
    assert (source_of(path).spacing, source_of(path).origin) == ((1, 1, 1), (0, 0, 0))
    path.with_name(f"{path.name}.json").write_text('{"spacing": [1, 2, 3], "origin": [4, 5, 6]}')
    assert (source_of(path).spacing, source_of(path).origin) == ((1, 2, 3), (4, 5, 6))
    source = source_of(path, spacing=(0.1, 0.2, 0.3))
    assert (source.spacing, source.origin) == ((0.1, 0.2, 0.3), (4, 5, 6))
    assert source_of(jv.Volume(voxels(), (1, 2, 3), (4, 5, 6))).spacing == (1, 2, 3)
    for wrong in ((1, 2), (1, 0, 1), "abc", (1, np.nan, 1)):
        with pytest.raises(ValueError, match=r"^spacing must (be|have)"):
            source_of(path, spacing=wrong)


# ---- types ----


def test_types_that_no_volume_has_are_converted_or_refused():
    for stored in ("bool", "int32", "uint64", "float64"):
        read = "uint8" if stored == "bool" else "float32"
        data = np.random.default_rng(0).integers(0, 2, SHAPE).astype(stored)
        assert_reads(source_of(data), data.astype(read))
    with in_float64():
        assert source_of(voxels("float64")).read((0, 0, 0), SHAPE).dtype == np.float64
    for refused in ("complex64", "datetime64[s]", "U3", "longdouble"):
        with pytest.raises(ValueError, match=r"data must be of type uint8.*; got"):
            source_of(np.zeros(SHAPE, refused))


@pytest.mark.parametrize(
    ("dtype", "wrong", "message"),
    [
        (np.int64, 2**24 + 1, r"from -2\*\*24 to 2\*\*24.*from 0 to 16777217 from \(19, 2, 0\)"),
        (np.float16, np.nan, r"must be finite.* from \(19, 2, 0\)"),
        (ml_dtypes.bfloat16, -np.inf, r"must be finite.* from \(19, 2, 0\)"),
        (np.float64, 1e39, "must be finite in float32"),
    ],
)
def test_voxels_that_cannot_be_shown_are_refused_with_their_place(dtype, wrong, message):
    data = np.zeros(SHAPE, dtype)
    data[20, 3, 4] = wrong
    source = source_of(data)
    source.read((0, 0, 0), (20, 17, 31))
    with pytest.raises(ValueError, match=message):
        source.read((19, 2, 0), SHAPE)
    if np.isfinite(wrong):
        return
    read = source_of(data, nan=-3).read((0, 0, 0), SHAPE)
    np.testing.assert_array_equal(read, np.where(data == 0, data, np.array(-3, dtype)))


# ---- faults ----


def test_what_is_no_box_is_refused():
    source = source_of(voxels())
    for low, high in (((0, 0, 0), (24, 17, 31)), ((-1, 0, 0), (2, 2, 2)), ((3, 3, 3), (3, 4, 4))):
        with pytest.raises(ValueError, match="low and high must be the corners of a box"):
            source.read(low, high)
    for low in ((0, 0), 0, (0.5, 0, 0), None):
        with pytest.raises(ValueError, match=r"corners of a box .* three integers each"):
            inspect.unwrap(VoxelSource.read)(source, low, (1, 1, 1))  # without the types' checks


def test_files_and_things_that_are_no_source_are_refused_with_what_to_do(tmp_path):
    (tmp_path / "folder").mkdir()
    for name, content in (
        ("data.raw", bytes(99)),
        ("data.raw.gz", b"1"),
        ("data.h5", b"1"),
    ):
        (tmp_path / name).write_bytes(content)
    np.save(tmp_path / "cut.npy", np.zeros((4, 5, 6)))
    os.truncate(tmp_path / "cut.npy", 300)
    np.save(tmp_path / "flat.npy", np.zeros((4, 4)))
    np.save(tmp_path / "data.npy", np.zeros(SHAPE))
    bad: list[tuple[Any, dict[str, Any], str]] = [
        ("data.raw", {"shape": (10**4, 10**5, 10**5)}, "cut short: it holds 99 bytes"),
        ("cut.npy", {}, r"is cut short"),
        ("flat.npy", {}, r"data must be data\[x, y, z\] with at least 2 voxels"),
        ("data.raw.gz", {"shape": (2, 2, 2)}, r"not of a kind that is read box by box.*gunzip"),
        ("folder", {}, r"not of a kind that is read box by box.*DICOM slices"),
        (3, {}, "source must be an array, a Volume, a VoxelSource or a path"),
        (jv.Volume(np.zeros(SHAPE), labels=np.zeros(SHAPE, np.uint8)), {}, "a Volume without labels"),
        ("data.npy", {"shape": SHAPE}, "shape and dtype are for raw files"),
        ("data.h5", {}, "data.h5 cannot be read"),
        (np.zeros((*SHAPE, 2)), {}, r"array must be data\[x, y, z\]; .* Choose a channel first"),
        (np.zeros(SHAPE), {"channel": 1}, "unexpected keyword argument 'channel'"),
        (source_of(np.zeros(SHAPE)), {"channel": 0}, "^channel: a VoxelSource takes no options"),
    ]
    for thing, options, message in bad:
        given = tmp_path / thing if isinstance(thing, str) else thing
        of_raw = {"dtype": "uint8"} if isinstance(thing, str) and "raw" in thing else {}
        with pytest.raises((TypeError, ValueError), match=message):
            source_of(given, **options, **of_raw)


@pytest.mark.parametrize("change", [partial(os.truncate, length=100), partial(os.utime, ns=(0, 0))])
def test_a_file_that_is_cut_or_written_to_after_opening_is_an_error(change, tmp_path):
    """To read a map of a file that was cut would end the process."""
    path = x_fastest(tmp_path / "data.raw", voxels())
    mapped = np.memmap(path, np.uint8, "r", shape=SHAPE, order="F")
    sources_ = source_of(mapped), source_of(path, shape=SHAPE, dtype="uint8")
    change(path)
    for source in sources_:
        with pytest.raises(ValueError, match="changed after it was opened as a source"):
            source.read((0, 0, 0), (1, 1, 1))
