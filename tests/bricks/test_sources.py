"""Does a source return the voxels that the file holds, without holding the file?"""

import os
import subprocess
import sys
import textwrap
import tracemalloc

import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest

import jaxvol as jv
from experiments.peak_memory import STATUS
from jaxvol.bricks import files, sources
from jaxvol.bricks.files import FileSource
from jaxvol.bricks.opening import levels_of, source_of
from jaxvol.bricks.sources import ArraySource

from ..scenes import in_float64


SHAPE = (23, 17, 31)
DTYPES = ["uint8", "int8", "uint16", "int16", "float16", "float32", "bfloat16"]


def voxels(dtype, shape=SHAPE):
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
    assert source.shape == data.shape
    assert source.dtype == data.dtype
    for low, high in boxes(data.shape):
        for found in (source.read(low, high), source.read_async(low, high).result()):
            assert found.flags.c_contiguous
            assert found.dtype == data.dtype
            assert found.dtype.isnative
            np.testing.assert_array_equal(found, data[tuple(map(slice, low, high))])


def x_fastest(path, data):
    data.ravel(order="F").tofile(path)
    return path


# ---- what is read ----


@pytest.mark.parametrize("dtype", DTYPES)
def test_arrays(dtype):
    data = voxels(dtype)
    assert_reads(source_of(data), data)
    assert_reads(source_of(np.asfortranarray(data)), data)
    assert_reads(source_of(jnp.asarray(data)), data)
    assert_reads(source_of(jv.Volume(data)), data)
    assert_reads(source_of(data[::-1, ::2]), data[::-1, ::2])


@pytest.mark.parametrize("together", [1, 2000, files.AT_ONCE])
@pytest.mark.parametrize("gap", [0, 10, files.GAP])
@pytest.mark.parametrize("dtype", ["uint8", "int16", "float32"])
def test_raw_files_are_read_in_rows_and_in_planes(dtype, gap, together, tmp_path, monkeypatch):
    monkeypatch.setattr(files, "GAP", gap)
    monkeypatch.setattr(files, "AT_ONCE", together)
    data = voxels(dtype)
    path = x_fastest(tmp_path / "data.raw", data)
    assert_reads(source_of(path, shape=SHAPE, dtype=dtype), data)


def test_raw_files_of_the_other_byte_order(tmp_path):
    data = voxels("uint16")
    path = x_fastest(tmp_path / "data.raw", data.astype(">u2"))
    assert_reads(source_of(path, shape=SHAPE, dtype="uint16be"), data)


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", ["uint8", "int16", "float16", "float32"])
def test_npy_files_and_memory_maps_of_them(dtype, order, tmp_path):
    data = voxels(dtype)
    path = tmp_path / "data.npy"
    np.save(path, np.asarray(data, order=order))
    assert_reads(source_of(path), data)
    source = source_of(np.load(path, mmap_mode="r"))
    assert isinstance(source, FileSource)
    assert_reads(source, data)


def test_views_of_memory_maps_are_read_from_the_file(tmp_path):
    data = voxels("int16")
    with (tmp_path / "data").open("wb") as file:
        file.write(b"header")
        file.write(data.tobytes())
    mapped = np.memmap(tmp_path / "data", np.int16, "r", 6, SHAPE)
    for view in (
        lambda a: a,
        lambda a: a.T,
        lambda a: a[3:, 2:9],
        lambda a: a[2:].transpose(1, 0, 2),
        np.asarray,
    ):
        source = source_of(view(mapped))
        assert isinstance(source, FileSource)
        assert_reads(source, view(data))
    for view in (lambda a: a[:, :, ::2], lambda a: a[::-1]):
        source = source_of(view(mapped))
        assert isinstance(source, ArraySource)
        assert_reads(source, view(data))


@pytest.mark.parametrize("mode", ["r", "r+"])
def test_a_memory_map_keeps_its_voxels_when_its_file_is_replaced(mode, tmp_path):
    path, new = tmp_path / "data", tmp_path / "new"
    path.write_bytes(b"\1" * np.prod(SHAPE))
    mapped = np.memmap(path, np.uint8, mode, shape=SHAPE)
    assert isinstance(source_of(mapped), FileSource)
    new.write_bytes(b"\7" * np.prod(SHAPE))
    new.replace(path)
    source = source_of(mapped)
    np.testing.assert_array_equal(source.read((0, 0, 0), SHAPE), 1)
    assert source.fingerprint() is None


def test_a_memory_map_keeps_its_voxels_when_its_file_is_deleted(tmp_path):
    path = tmp_path / "data"
    path.write_bytes(b"\1" * np.prod(SHAPE))
    mapped = np.memmap(path, np.uint8, "r", shape=SHAPE)
    path.unlink()
    source = source_of(mapped)
    np.testing.assert_array_equal(source.read((0, 0, 0), SHAPE), 1)
    assert source.fingerprint() is None


def test_what_is_written_to_a_memory_map_is_read(tmp_path):
    data = voxels("uint8")
    mapped = np.memmap(tmp_path / "data", np.uint8, "w+", shape=SHAPE)
    source = source_of(mapped)
    mapped[:] = data
    assert_reads(source, data)
    assert source.fingerprint() is None
    copy = np.memmap(tmp_path / "data", np.uint8, "c", shape=SHAPE)
    copy[0] = 7  # in memory alone
    assert_reads(source_of(copy), np.asarray(copy))


def test_real_volumes(real_volume, tmp_path):
    for name in ("nucleon_41x41x41_uint8.raw", "tooth_103x94x161_uint8.raw"):
        path = real_volume(name)
        data = np.asarray(jv.load(path).data)
        assert_reads(source_of(path), data)
        assert_reads(source_of(str(path)), data)
    volume = jv.load(real_volume("lidc0314_airway_256x192x200_int16le.raw.gz"))
    data = np.asarray(volume.data)
    path = x_fastest(tmp_path / "lidc_256x192x200_int16le.raw", data)
    assert_reads(source_of(path), data)


# ---- types ----


@pytest.mark.parametrize(
    ("stored", "read"),
    [("bool", "uint8"), ("int32", "float32"), ("uint64", "float32"), ("float64", "float32")],
)
def test_types_that_no_volume_has_are_converted_as_in_a_volume(stored, read):
    data = np.random.default_rng(0).integers(0, 2, SHAPE).astype(stored)
    source = source_of(data)
    assert source.dtype == read
    assert_reads(source, np.asarray(jv.Volume(data).data).astype(read))


def test_doubles_stay_doubles_where_jax_has_them():
    data = np.random.default_rng(0).random(SHAPE)
    with in_float64():
        assert source_of(data).read((0, 0, 0), SHAPE).dtype == np.float64


@pytest.mark.parametrize("dtype", ["complex64", "complex128", "datetime64[s]", "U3", "longdouble"])
def test_types_that_nothing_can_render_are_refused(dtype):
    with pytest.raises(ValueError, match=r"data must be of type uint8.*; got"):
        source_of(np.zeros(SHAPE, dtype))


def test_integers_that_float32_does_not_hold_are_refused_with_the_box():
    data = np.zeros(SHAPE, np.int64)
    data[20, 3, 4] = 2**24 + 1
    source = source_of(data)
    source.read((0, 0, 0), (20, 17, 31))
    with pytest.raises(ValueError, match=r"from -2\*\*24 to 2\*\*24.*from 0 to 16777217.*\(19, 0, 0\)"):
        source.read((19, 0, 0), SHAPE)


@pytest.mark.parametrize("dtype", ["float16", "float32", "float64", "bfloat16"])
@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_a_voxel_that_is_not_finite_is_refused_with_its_place(dtype, wrong):
    data = np.zeros(SHAPE, ml_dtypes.bfloat16 if dtype == "bfloat16" else dtype)
    data[20, 3, 4] = wrong
    source = source_of(data)
    source.read((0, 0, 0), (20, 17, 31))
    with pytest.raises(ValueError, match=r"must be finite.*got 1 .*the first at \(20, 3, 4\)"):
        source.read((19, 2, 0), SHAPE)


def test_doubles_beyond_float32_are_refused():
    with pytest.raises(ValueError, match="must be finite in float32"):
        source_of(np.full(SHAPE, 1e39)).read((0, 0, 0), SHAPE)


# ---- faults ----


@pytest.mark.parametrize("shape", [(4, 4), (2, 3, 4, 5), (1, 4, 4)], ids=str)
def test_shapes_that_no_volume_has_are_refused(shape, tmp_path):
    np.save(tmp_path / "data.npy", np.zeros(shape))
    for thing in (np.zeros(shape), tmp_path / "data.npy", np.load(tmp_path / "data.npy", mmap_mode="r")):
        with pytest.raises(ValueError, match=r"data must be data\[x, y, z\] with at least 2 voxels"):
            source_of(thing)


@pytest.mark.parametrize(
    ("low", "high"),
    [((0, 0, 0), (24, 17, 31)), ((-1, 0, 0), (2, 2, 2)), ((3, 3, 3), (3, 4, 4)), ((5, 0, 0), (4, 1, 1))],
    ids=str,
)
def test_boxes_outside_are_refused(low, high):
    with pytest.raises(ValueError, match="low and high must be the corners of a box"):
        source_of(voxels("uint8")).read(low, high)


@pytest.mark.parametrize("low", [(0, 0), 0, (0.5, 0, 0), None])
def test_corners_that_are_no_indices_are_refused(low):
    with pytest.raises(ValueError, match="low and high must be three voxel indices"):
        source_of(voxels("uint8")).read(low, (1, 1, 1))


def test_sizes_are_checked_before_anything_is_read(tmp_path):
    (tmp_path / "data.raw").write_bytes(bytes(99))
    with pytest.raises(ValueError, match="cut short: it holds 99 bytes"):
        source_of(tmp_path / "data.raw", shape=(10**4, 10**5, 10**5), dtype="uint8")
    with pytest.raises(ValueError, match="oversized"):
        source_of(tmp_path / "data.raw", shape=(4, 4, 4), dtype="uint8")
    np.save(tmp_path / "data.npy", np.zeros((4, 5, 6)))
    os.truncate(tmp_path / "data.npy", 300)
    with pytest.raises(ValueError, match="cut short"):
        source_of(tmp_path / "data.npy")


@pytest.mark.parametrize("mapped", [False, True])
def test_a_file_that_is_cut_or_changed_after_opening_is_an_error(mapped, tmp_path):
    data = voxels("uint8")
    path = tmp_path / "data.raw"

    def opened():
        x_fastest(path, data)
        if mapped:
            return source_of(np.memmap(path, np.uint8, "r", shape=SHAPE, order="F"))
        return source_of(path, shape=SHAPE, dtype="uint8")

    source = opened()
    os.truncate(path, 100)
    with pytest.raises(ValueError, match="changed after it was opened"):
        source.read((0, 0, 0), (1, 1, 1))
    with pytest.raises(ValueError, match="changed after it was opened"):
        source.read_async((0, 0, 0), (1, 1, 1)).result()
    source = opened()
    os.utime(path, ns=(0, 0))
    with pytest.raises(ValueError, match="changed after it was opened"):
        source.read((0, 0, 0), (1, 1, 1))
    source = opened()
    path.unlink()
    with pytest.raises(ValueError, match="cannot be read any more"):
        source.read((0, 0, 0), (1, 1, 1))


def test_a_map_longer_than_its_file_is_an_error_not_the_end_of_the_process(tmp_path):
    x_fastest(tmp_path / "data", voxels("uint8"))
    mapped = np.memmap(tmp_path / "data", np.uint8, "r", shape=SHAPE)
    os.truncate(tmp_path / "data", 100)
    with pytest.raises(ValueError, match="is cut short: it holds 100 bytes"):
        source_of(mapped)


def test_what_cannot_be_read_in_parts_is_refused_with_what_to_do(tmp_path):
    (tmp_path / "data.raw.gz").write_bytes(b"1")
    (tmp_path / "data.nii").write_bytes(b"1")
    (tmp_path / "folder").mkdir()
    for name, message in (
        ("data.raw.gz", "is compressed.*gunzip"),
        ("data.nii", r"not of a kind that is read in parts.*jv\.load"),
        ("folder", r"is a folder without Zarr in it.*jv\.load"),
        ("nothing.raw", "there is no file"),
    ):
        with pytest.raises(ValueError, match=message):
            source_of(tmp_path / name, **({"shape": (2, 2, 2), "dtype": "uint8"} if "raw" in name else {}))
    with pytest.raises(ValueError, match="source must be an array, a Volume, a VoxelSource, or the path"):
        source_of("")
    with pytest.raises(ValueError, match="a Volume with labels"):
        source_of(jv.Volume(np.zeros(SHAPE), labels=np.zeros(SHAPE, np.uint8)))


def test_options_that_do_not_belong_are_refused(tmp_path):
    np.save(tmp_path / "data.npy", np.zeros(SHAPE))
    for thing in (tmp_path / "data.npy", np.zeros(SHAPE), source_of(np.zeros(SHAPE))):
        for options in ({"shape": SHAPE}, {"dtype": "uint8"}, {"axes": "xyz"}, {"index": {"c": 0}}):
            with pytest.raises(ValueError, match=f"^{next(iter(options))}: .* takes no such option"):
                source_of(thing, **options)


def test_spacing_and_origin(tmp_path):
    path = x_fastest(tmp_path / "data_23x17x31_uint8.raw", voxels("uint8"))
    assert source_of(path).spacing is None
    (tmp_path / "data_23x17x31_uint8.raw.json").write_text('{"spacing": [1, 2, 3], "origin": [4, 5, 6]}')
    source = source_of(path)
    assert (source.spacing, source.origin) == ((1, 2, 3), (4, 5, 6))
    source = source_of(path, spacing=(0.1, 0.2, 0.3))
    assert (source.spacing, source.origin) == ((0.1, 0.2, 0.3), (4, 5, 6))
    assert source_of(jv.Volume(voxels("uint8"), (1, 2, 3), (4, 5, 6))).spacing == (1, 2, 3)
    for wrong in ((1, 2), (1, 0, 1), "abc", (1, np.nan, 1)):
        with pytest.raises(ValueError, match=r"^spacing must (be|have)"):
            source_of(path, spacing=wrong)
    assert len(levels_of(path)) == 1


# ---- identity ----


def test_a_fingerprint_changes_with_the_file_and_with_what_is_read_of_it(tmp_path):
    path = tmp_path / "data.raw"
    data = voxels("uint8")

    def fingerprint(shape=SHAPE):
        return source_of(path, shape=shape, dtype="uint8").fingerprint()

    x_fastest(path, data)
    first = fingerprint()
    assert first == fingerprint()
    assert first != fingerprint(SHAPE[::-1])
    times = os.stat(path).st_atime_ns, os.stat(path).st_mtime_ns
    data[3, 4, 5] ^= 1
    with path.open("r+b") as file:  # in place, of the same size and time
        file.write(data.ravel(order="F").tobytes())
    os.utime(path, ns=times)
    second = fingerprint()
    assert first is not None
    assert second is not None
    assert second["pieces"] != first["pieces"]
    assert second != first
    assert source_of(data).fingerprint() is None


def test_pieces_of_large_files_are_read_from_end_to_end(tmp_path):
    path, size = tmp_path / "data.raw", 2**24
    path.touch()
    os.truncate(path, size)
    shape = (256, 256, 256)

    def pieces():
        return (source_of(path, shape=shape, dtype="uint8").fingerprint() or {})["pieces"]

    seen = {pieces()}
    for number, at in enumerate((0, size - 1)):
        with path.open("r+b") as file:
            file.seek(at)
            file.write(b"1")
        seen.add(pieces())
        assert len(seen) == number + 2


# ---- memory ----


@pytest.mark.parametrize(
    ("kind", "dtype"),
    [("array", "float64"), ("array", "int64"), ("npy", "int64"), ("npy", "uint32"), ("raw", "float64")],
)
def test_voxels_that_are_converted_take_little_more_than_what_they_become(kind, dtype, tmp_path, monkeypatch):
    """What is counted of a brick while it is read (`split.COPIES`): itself, and a layer of what is stored."""
    monkeypatch.setattr(sources, "AT_ONCE", 2**15)
    data = np.random.default_rng(0).integers(0, 1000, (50, 60, 70)).astype(dtype)
    np.save(tmp_path / "a.npy", data)
    source = {
        "array": lambda: source_of(data),
        "npy": lambda: source_of(tmp_path / "a.npy"),
        "raw": lambda: source_of(x_fastest(tmp_path / "a.raw", data), shape=data.shape, dtype=dtype),
    }[kind]()
    low, high = (3, 2, 1), (50, 60, 70)
    tracemalloc.start()
    found = source.read(low, high, source.order)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < found.nbytes + 6 * 2**15
    np.testing.assert_array_equal(found, data[3:, 2:, 1:].transpose(source.order))
    np.testing.assert_array_equal(source.read(low, high, (1, 2, 0)), data[3:, 2:, 1:].transpose(1, 2, 0))


@pytest.mark.skipif(not STATUS.exists(), reason="needs Linux's /proc")
@pytest.mark.parametrize("kind", ["raw", "memmap"])
def test_memory_is_bounded_by_the_box_whatever_is_read(kind, tmp_path):
    """In a process of its own: all of a sparse file of 500 MiB is read, in boxes of 1 MiB."""
    program = f"""
        import numpy as np
        from experiments.peak_memory import peak
        from jaxvol.bricks.opening import source_of
        path, n = {str(tmp_path / "data.raw")!r}, 800
        with open(path, "wb") as file:
            file.truncate(n**3)
        if {kind!r} == "raw":
            source = source_of(path, shape=(n, n, n), dtype="uint8")
        else:
            source = source_of(np.memmap(path, np.uint8, "r", shape=(n, n, n)))
        source.read((0, 0, 0), (100, 100, 100))
        before = peak()
        for x in range(0, n, 100):
            for y in range(0, n, 100):
                for z in range(0, n, 100):
                    source.read((x, y, z), (x + 100, y + 100, z + 100))
        print(peak() - before)
    """
    run = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True, check=True
    )
    assert float(run.stdout) < 20  # MiB
