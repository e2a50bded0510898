"""Are the ranges found in one pass those of the volume in memory? Are they found again, and never stale?"""

import json
import os
import signal
import subprocess
import sys
import textwrap
import zipfile

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest

import jaxvol as jv
from experiments.peak_memory import STATUS
from jaxvol.bricks import streaming, summary as summaries, summary_files
from jaxvol.bricks.dtypes import range_of
from jaxvol.bricks.opening import source_of
from jaxvol.bricks.sources import ArraySource
from jaxvol.bricks.streaming import slabs
from jaxvol.bricks.summary import LAYERS, scan
from jaxvol.bricks.summary_files import summary_of
from jaxvol.occupancy import BLOCK, Blocks

from ..scenes import in_float64
from .test_sources import voxels, x_fastest
from .test_zarr import written


SHAPE = (23, 18, 33)


def assert_equal(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


class Counting:
    """Counts the boxes that are read of a source."""

    def __init__(self, monkeypatch):
        self.boxes = []
        for kind in (ArraySource, source_kind("file"), source_kind("zarr")):
            monkeypatch.setattr(kind, "_stored", self._counted(kind._stored))

    def _counted(self, stored):
        def counted(source, low, high, axes):
            self.boxes.append((low, high))
            return stored(source, low, high, axes)

        return counted


def source_kind(name):
    from jaxvol.bricks.files import FileSource
    from jaxvol.bricks.zarr import ZarrSource

    return {"file": FileSource, "zarr": ZarrSource}[name]


@pytest.fixture
def reads(monkeypatch):
    return Counting(monkeypatch).boxes


# ---- slabs ----


@pytest.mark.parametrize("chunks", [(23, 18, 1), (1, 18, 33), (8, 8, 8), (5, 18, 7), (64, 64, 64)], ids=str)
@pytest.mark.parametrize("memory", [1, 20_000, 60_000, 10**7])
def test_each_block_is_in_one_slab_with_its_voxels(memory, chunks):
    data = voxels("uint16", SHAPE)
    source = ArraySource(data)
    x, y, z = (min(c, n) for c, n in zip(chunks, SHAPE, strict=True))
    source.chunks = (x, y, z)
    seen = np.zeros([-(-(n - 1) // BLOCK) for n in SHAPE], int)
    for slab in slabs(source, memory):
        seen[tuple(slice(i, i + n) for i, n in zip(slab.first, slab.blocks, strict=True))] += 1
        start = [BLOCK * i for i in slab.first]
        place = tuple(slice(at, at + n) for at, n in zip(start, slab.voxels.shape, strict=True))
        np.testing.assert_array_equal(slab.voxels, data[place])
        for axis, n in enumerate(SHAPE):
            last = slab.first[axis] + slab.blocks[axis]
            assert start[axis] + slab.voxels.shape[axis] == min(n, BLOCK * last + 1)
    assert np.all(seen == 1)


def test_memory_that_holds_the_volume_reads_it_at_once_and_less_in_many_slabs(reads):
    source = ArraySource(voxels("uint16", SHAPE))
    list(slabs(source, 10**7))
    assert reads == [((0, 0, 0), SHAPE)]
    del reads[:]
    sizes = [slab.voxels.nbytes for slab in slabs(source, 100_000)]
    assert len(sizes) > 1
    assert streaming.COPIES * max(sizes) <= 100_000


def test_chunks_are_read_once(reads, tmp_path):
    source = source_of(written(tmp_path / "a.zarr", voxels("uint8", (96, 32, 32)), (16, 16, 16)))
    list(slabs(source, 500_000))
    assert len(reads) > 1
    assert all(low[0] % 16 == 0 and low[1:] == (0, 0) and high[1:] == (32, 32) for low, high in reads)
    assert sum(high[0] - low[0] for low, high in reads) == 96


# ---- ranges ----


@pytest.mark.parametrize("shape", [SHAPE, (5, 9, 13), (2, 2, 2), (6, 3, 18)], ids=str)
@pytest.mark.parametrize("dtype", ["uint8", "int8", "uint16", "int16", "float16", "float32", "bfloat16"])
def test_blocks_equal_those_of_the_volume_in_memory(dtype, shape):
    data = voxels(dtype, shape)
    for memory in (10_000, 10**7):
        assert_equal(scan(source_of(data), memory=memory).blocks(), Blocks.of(jv.Volume(data)))


@pytest.mark.parametrize("dtype", ["float16", "bfloat16"])
def test_layers_of_16_bit_floats_are_compared_as_float32(dtype):
    """Of more layers than are converted at a time, the last ones shorter."""
    data = voxels(dtype, (2 * LAYERS * BLOCK + 7, 5, 9))
    assert_equal(scan(source_of(data)).blocks(), Blocks.of(jv.Volume(data)))
    assert range_of(data) == (float(data.min()), float(data.max()))
    data[70, 3, 8] = np.nan
    assert np.all(np.isnan(range_of(data)))


def test_blocks_are_looked_through_in_parts(monkeypatch):
    transfer = jv.TransferFunction2D.from_transfer(
        jv.TransferFunction.from_points([(0, (0, 0, 0), 0.0), (90, (1, 1, 1), 0.5)]), (0.0, 9.0)
    )
    summary, asked = scan(source_of(voxels("int8", SHAPE))), []
    expected = np.asarray(transfer.visible(summary.blocks()))

    def visible(blocks):
        asked.append(blocks.low.shape)
        return transfer.visible(blocks)

    np.testing.assert_array_equal(summary.where(visible), expected)
    assert asked == [expected.shape]
    monkeypatch.setattr(summaries, "AT_ONCE", 2 * expected[0].size)
    asked.clear()
    np.testing.assert_array_equal(summary.where(visible), expected)
    assert asked == [(2, *expected.shape[1:])] * 3


def test_a_real_volume(real_volume):
    path = real_volume("tooth_103x94x161_uint8.raw")
    volume = jv.load(path)
    summary = summary_of(source_of(path), memory=2 * 10**7, cache=None)
    assert_equal(summary.blocks(), Blocks.of(volume))
    for cell in (8, 20):
        coarse = scan(source_of(path), cell, memory=10**6)
        assert coarse.ranges["low"].shape == tuple(-(-(n - 1) // cell) for n in volume.shape)
        for block in np.ndindex(coarse.ranges["low"].shape):
            part = np.asarray(volume.data)[tuple(slice(i * cell, i * cell + cell + 1) for i in block)]
            assert (coarse.ranges["low"][block], coarse.ranges["high"][block]) == (part.min(), part.max())


def test_ranges_of_doubles():
    with in_float64():
        data = np.random.default_rng(0).normal(size=SHAPE)
        assert_equal(scan(source_of(data)).blocks(), Blocks.of(jv.Volume(data)))


@pytest.mark.parametrize("cell", [4, 8, 12])
def test_range_of_a_box_holds_its_voxels_and_no_more_than_its_blocks(cell):
    data = np.random.default_rng(0).normal(size=SHAPE).astype(np.float32)
    summary = scan(source_of(data), cell)
    rng = np.random.default_rng(1)
    boxes = [((0, 0, 0), SHAPE), ((0, 0, 0), (1, 1, 1)), (tuple(n - 1 for n in SHAPE), SHAPE)]
    for _ in range(200):
        low = rng.integers(0, SHAPE)
        boxes.append((tuple(low), tuple(rng.integers(low + 1, np.array(SHAPE) + 1))))
    for low, high in boxes:
        least, most = summary.range_of(low, high)
        part = data[tuple(map(slice, low, high))]
        assert least <= part.min() <= part.max() <= most
        wider = data[tuple(slice(max(0, a - cell), b + cell) for a, b in zip(low, high, strict=True))]
        assert wider.min() <= least <= most <= wider.max()
    aligned = summary.range_of((cell, 0, cell), (2 * cell + 1, cell + 1, 2 * cell + 1))
    part = data[cell : 2 * cell + 1, : cell + 1, cell : 2 * cell + 1]
    assert aligned == (part.min(), part.max())


@pytest.mark.parametrize(("low", "cell"), [((4, 8, 12), 4), ((3, 5, 6), 4), ((3, 5, 6), 8)], ids=str)
def test_blocks_of_a_brick_hold_those_of_the_brick_in_memory(low, cell):
    data = voxels("int16", SHAPE)
    high = (21, 17, 29)
    summary = scan(source_of(data), cell)
    brick = jv.Volume(data[tuple(map(slice, low, high))])
    found, own = summary.blocks(low, high), Blocks.of(brick)
    assert found.low.shape == own.low.shape
    assert jnp.all(found.low <= own.low)
    assert jnp.all(found.high >= own.high)
    if cell == BLOCK and low[0] % 4 == 0:  # except at the brick's end, where blocks reach beyond it
        exact = Blocks.of(jv.Volume(data))
        place = tuple(slice(i // 4, i // 4 + n) for i, n in zip(low, found.low.shape, strict=True))
        np.testing.assert_array_equal(found.low, exact.low[place])
        np.testing.assert_array_equal(found.high, exact.high[place])


@pytest.mark.parametrize("cell", [0, 2, 6, 4.0, None])
def test_cells_of_odd_sizes_are_refused(cell):
    with pytest.raises(ValueError, match="cell must be"):
        scan(source_of(voxels("uint8", SHAPE)), cell)


def test_nan_anywhere_is_found():
    data = np.zeros(SHAPE, np.float32)
    data[22, 17, 32] = np.nan
    with pytest.raises(ValueError, match=r"must be finite.*\(22, 17, 32\)"):
        scan(source_of(data), memory=10_000)


def test_progress_is_told_and_may_end_the_pass():
    told = []
    source = source_of(voxels("uint8", SHAPE))
    scan(source, memory=20_000, progress=lambda done, whole: told.append((done, whole)))
    assert len(told) > 2
    assert told == sorted(told)
    assert told[-1] == (np.prod(SHAPE), np.prod(SHAPE))

    def stop(done, whole):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        scan(source, memory=20_000, progress=stop)


# ---- files ----


def data_file(tmp_path, data):
    return source_of(x_fastest(tmp_path / "data.raw", data), shape=SHAPE, dtype=data.dtype.name)


def summary_files_in(folder):
    return sorted(file.name for file in folder.iterdir() if "summary" in file.name)


def assert_same(one, other):
    assert one.ranges.keys() == other.ranges.keys()
    for name, part in one.ranges.items():
        assert part.dtype == other.ranges[name].dtype
        np.testing.assert_array_equal(part, other.ranges[name])


@pytest.mark.parametrize("dtype", ["uint8", "int16", "float16", "float32"])
def test_a_finished_pass_is_not_repeated(dtype, tmp_path, reads):
    source = data_file(tmp_path, voxels(dtype, SHAPE))
    first = summary_of(source)
    assert summary_files_in(tmp_path) == ["data.raw.jaxvol-summary-4.npz"]
    del reads[:]
    for again in (source, source_of(tmp_path / "data.raw", shape=SHAPE, dtype=dtype)):
        assert_same(summary_of(again), first)
    assert reads == []
    summary_of(source, 8)
    assert reads != []
    assert len(summary_files_in(tmp_path)) == 2


@pytest.mark.parametrize("mask", [0o022, 0o077])
def test_others_may_read_the_file_as_far_as_they_may_read_new_files(mask, tmp_path):
    before = os.umask(mask)
    try:
        summary_of(data_file(tmp_path, voxels("uint8", SHAPE)))
    finally:
        os.umask(before)
    [path] = tmp_path.glob("*.npz")
    assert path.stat().st_mode & 0o777 == 0o666 & ~mask


def test_bfloat16_survives_the_file(tmp_path, reads):
    data = voxels("bfloat16", SHAPE)
    import tensorstore

    spec = {"driver": "zarr3", "kvstore": {"driver": "file", "path": f"{tmp_path / 'a.zarr'}/"}}
    tensorstore.open(spec, create=True, dtype=tensorstore.bfloat16, shape=SHAPE).result()[...] = data
    source = source_of(tmp_path / "a.zarr", missing="fill")
    first = summary_of(source)
    del reads[:]
    assert_same(summary_of(source), first)
    assert first.ranges["low"].dtype == ml_dtypes.bfloat16
    assert reads == []


def test_changed_data_get_a_new_summary(tmp_path):
    data = voxels("uint8", SHAPE)
    for change in (0, 1, 2, 3):  # in quick succession: times may be the same
        data[5, 6, 7] = change
        times = None if change == 0 else os.stat(tmp_path / "data.raw")
        source = data_file(tmp_path, data)
        if times is not None:
            os.utime(tmp_path / "data.raw", ns=(times.st_atime_ns, times.st_mtime_ns))
            source = source_of(tmp_path / "data.raw", shape=SHAPE, dtype="uint8")
        assert_same(summary_of(source), scan(source_of(data)))
    other = source_of(tmp_path / "data.raw", shape=SHAPE[::-1], dtype="uint8")
    assert_same(summary_of(other), scan(other))


def test_changed_chunks_get_a_new_summary(tmp_path, reads):
    data = voxels("uint8", SHAPE)
    path = written(tmp_path / "a.zarr", data)
    summary_of(source_of(path))
    assert summary_files_in(tmp_path) == ["a.zarr.jaxvol-summary-4.npz"]
    del reads[:]
    summary_of(source_of(path))
    assert reads == []
    data[20:] = 3
    written(path, data, overwrite=True)
    assert_same(summary_of(source_of(path)), scan(source_of(data)))


def test_a_damaged_file_is_made_anew(tmp_path, reads):
    source = data_file(tmp_path, voxels("int16", SHAPE))
    first = summary_of(source)
    (file,) = tmp_path.glob("*.npz")
    whole = file.read_bytes()
    middle = len(whole) // 2
    changed = bytearray(whole)
    changed[middle] ^= 255
    for content in (b"", b"PK", whole[:middle], bytes(changed), bytes(len(whole)), whole[10:]):
        file.write_bytes(content)
        del reads[:]
        assert_same(summary_of(source), first)
        assert reads != []
        assert file.read_bytes()[:2] == b"PK"
        del reads[:]
        summary_of(source)
        assert reads == []


@pytest.mark.parametrize(
    "change",
    [{"version": 0}, {"ranges": ["low"]}, {"cell": 8}, {"dtype": "uint16"}, {"data": {}}],
    ids=str,
)
def test_a_file_that_says_something_else_is_made_anew(change, tmp_path, reads):
    source = data_file(tmp_path, voxels("int16", SHAPE))
    first = summary_of(source)
    (file,) = tmp_path.glob("*.npz")
    with zipfile.ZipFile(file) as archive, archive.open("about.npy") as member:
        about = json.loads(np.lib.format.read_array(member).tobytes())
    summary_files._write(file, first.ranges, about)
    with zipfile.ZipFile(file) as archive:
        arrays = {
            n: np.lib.format.read_array(archive.open(n)) for n in archive.namelist() if n != "about.npy"
        }
    arrays["about.npy"] = np.frombuffer(json.dumps(about | change).encode(), np.uint8)
    with zipfile.ZipFile(file, "w") as archive:
        for name, part in arrays.items():
            with archive.open(name, "w") as member:
                np.lib.format.write_array(member, part)
    del reads[:]
    assert_same(summary_of(source), first)
    assert reads != []


def test_arrays_of_objects_are_never_unpickled(tmp_path):
    source = data_file(tmp_path, voxels("int16", SHAPE))
    first = summary_of(source)
    (file,) = tmp_path.glob("*.npz")

    class Trap:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "trapped"),)

    trap = np.empty(1, object)
    trap[0] = Trap()
    np.savez(file, about=trap)
    assert_same(summary_of(source), first)
    assert not (tmp_path / "trapped").exists()


def test_where_files_lie(tmp_path, reads):
    source = data_file(tmp_path, voxels("uint8", SHAPE))
    summary_of(source, cache=None)
    assert summary_files_in(tmp_path) == []
    summary_of(source, cache=tmp_path / "new")
    (name,) = summary_files_in(tmp_path / "new")
    assert name.endswith("-data.raw.jaxvol-summary-4.npz")
    del reads[:]
    summary_of(source, cache=str(tmp_path / "new"))
    assert reads == []
    with pytest.raises(ValueError, match=r"cache: there is no folder .*missing in which folder"):
        summary_of(source, cache=tmp_path / "missing" / "folder")
    assert reads == []
    assert not (tmp_path / "missing").exists()
    with pytest.raises(ValueError, match="cache must be"):
        summary_of(source, cache=3)
    with pytest.raises(ValueError, match="cache must be"):  # of arrays, too, which have no files
        summary_of(source_of(voxels("uint8", SHAPE)), cache=3)
    summary_of(source_of(voxels("uint8", SHAPE)))
    assert summary_files_in(tmp_path) == []


def test_a_folder_that_cannot_be_written_is_a_warning(tmp_path, monkeypatch):
    def refused(path):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("jaxvol.bricks.summary_files.whole_file", refused)
    source = data_file(tmp_path, voxels("uint8", SHAPE))
    with pytest.warns(UserWarning, match=r"cannot be written \(Permission denied\).* Pass cache="):
        found = summary_of(source)
    assert_same(found, scan(source))


def test_data_that_change_during_the_pass_are_an_error(tmp_path):
    data = voxels("uint8", SHAPE)
    source = source_of(written(tmp_path / "a.zarr", data))

    def change(done, whole):
        (tmp_path / "a.zarr" / "zarr.json").touch()

    with pytest.raises(ValueError, match="changed while it was read"):
        summary_of(source, progress=change)
    assert summary_files_in(tmp_path) == []


def test_an_interrupted_pass_leaves_no_file_and_the_old_one_as_it_was(tmp_path, monkeypatch):
    source = data_file(tmp_path, voxels("uint8", SHAPE))

    def interrupt(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        summary_of(source, progress=interrupt)
    assert summary_files_in(tmp_path) == []
    summary_of(source)
    (file,) = tmp_path.glob("*.npz")
    before = file.read_bytes()
    monkeypatch.setattr(os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        summary_of(data_file(tmp_path, voxels("uint8", SHAPE)[::-1]))
    assert summary_files_in(tmp_path) == [file.name]
    assert file.read_bytes() == before


PASS = """
    from experiments.peak_memory import peak
    from jaxvol.bricks.opening import source_of
    from jaxvol.bricks.summary_files import summary_of
    path, n = {path!r}, {n}
    with open(path, "wb") as file:
        file.truncate(n**3)
    source = source_of(path, shape=(n, n, n), dtype="uint8")

    def told(done, whole):
        peaks.append(peak())
        print(done, flush=True)

    peaks = [peak()]
    summary_of(source, 32, memory={memory}, progress=told)
    print("peak", peaks[-1] - peaks[0])
"""


def program(path, n, memory):
    text = PASS.format(path=str(path), n=n, memory=memory)
    return [sys.executable, "-c", textwrap.dedent(text)]


@pytest.mark.skipif(not STATUS.exists(), reason="needs Linux's /proc")
def test_a_pass_that_is_killed_damages_nothing(tmp_path):
    path = tmp_path / "data.raw"
    process = subprocess.Popen(program(path, 320, 2**21), stdout=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.readline()
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert summary_files_in(tmp_path) == []
    source = source_of(path, shape=(320, 320, 320), dtype="uint8")
    assert summary_of(source, 32).range_of((0, 0, 0), (320, 320, 320)) == (0, 0)


@pytest.mark.skipif(not STATUS.exists(), reason="needs Linux's /proc")
def test_memory_of_a_pass_is_bounded(tmp_path):
    """In a process of its own, over a sparse file of 250 MiB: 16 MiB are allowed; compiling takes more."""
    run = subprocess.run(
        program(tmp_path / "data.raw", 640, 2**24), capture_output=True, text=True, check=True
    )
    assert float(run.stdout.split()[-1]) < 100  # MiB
