"""Are the ranges of values those of the voxels, found in one pass that is never repeated nor out of date?"""

import os

import numpy as np
import pytest

from jaxvol.bricks import summary_files
from jaxvol.bricks.files import FileSource
from jaxvol.bricks.opening import source_of
from jaxvol.bricks.summary import LAYERS, scan
from jaxvol.bricks.summary_files import summary_of
from jaxvol.occupancy import BLOCK

from .test_sources import voxels, x_fastest
from .test_zarr import written


SHAPE = (23, 18, 33)


@pytest.fixture
def reads(monkeypatch):
    """The boxes that are read of files."""
    boxes, stored = [], FileSource._stored
    monkeypatch.setattr(FileSource, "_stored", lambda *box: boxes.append(box) or stored(*box))
    return boxes


def assert_ranges(summary, data):
    """Of each block with the nodes on its faces, by looking at them."""
    cell, data = summary.cell, data.astype(np.float64)
    for block in np.ndindex(*(-(-(n - 1) // cell) for n in data.shape)):
        part = data[tuple(slice(i * cell, (i + 1) * cell + 1) for i in block)]
        assert (summary.ranges["low"][block], summary.ranges["high"][block]) == (part.min(), part.max())


@pytest.mark.parametrize("shape", [SHAPE, (2, 2, 2), (2 * LAYERS * BLOCK + 7, 5, 9)], ids=str)
@pytest.mark.parametrize("dtype", ["uint8", "int16", "float16", "bfloat16"])
def test_ranges_are_those_of_the_voxels_in_each_block(dtype, shape):
    data = voxels(dtype, shape)
    for given, cell, memory in ((data, 4, 10_000), (np.asfortranarray(data), 8, 10_000), (data, 12, 10**7)):
        assert_ranges(scan(source_of(given), cell, memory=memory), data)


def test_the_range_of_a_box_holds_its_voxels_and_no_more_than_its_blocks():
    data, rng = np.random.default_rng(0).normal(size=SHAPE).astype(np.float32), np.random.default_rng(1)
    for cell in (4, 12):
        summary = scan(source_of(data), cell)
        for _ in range(200):
            low = rng.integers(0, SHAPE)
            high = rng.integers(low + 1, np.array(SHAPE) + 1)
            least, most = summary.range_of(low, high)
            part = data[tuple(map(slice, low, high))]
            assert least <= part.min() <= part.max() <= most
            wider = data[tuple(slice(max(0, a - cell), b + cell) for a, b in zip(low, high, strict=True))]
            assert wider.min() <= least <= most <= wider.max()
        corner = summary.range_of((0, 0, 0), (cell + 1,) * 3)
        part = data[: cell + 1, : cell + 1, : cell + 1]
        assert corner == (part.min(), part.max())


def test_faults_of_a_pass():
    data = np.zeros(SHAPE, np.float32)
    data[22, 17, 32] = np.nan
    with pytest.raises(ValueError, match=r"must be finite.*\(22, 17, 32\)"):
        scan(source_of(data), memory=10_000)
    for cell in (0, 2, 6, 4.0, None):
        with pytest.raises(ValueError, match="cell must be"):
            scan(source_of(data), cell)


# ---- files ----


def opened(folder, data):
    return source_of(x_fastest(folder / "data.raw", data), shape=SHAPE, dtype=data.dtype.name)


def summary_files_in(folder):
    return sorted(file.name for file in folder.iterdir() if "summary" in file.name)


def test_a_finished_pass_is_not_repeated_until_the_data_change_or_the_file_is_damaged(tmp_path, reads):
    data = voxels("int16", SHAPE)
    summary_of(opened(tmp_path, data))
    assert summary_files_in(tmp_path) == ["data.raw.jaxvol-summary-4.npz"]
    for _ in range(3):  # in quick succession: times may be the same
        times = os.stat(tmp_path / "data.raw")
        data[5, 6, 7] += 1
        x_fastest(tmp_path / "data.raw", data)
        os.utime(tmp_path / "data.raw", ns=(times.st_atime_ns, times.st_mtime_ns))
        source = source_of(tmp_path / "data.raw", shape=SHAPE, dtype="int16")
        assert_ranges(summary_of(source), data)
        reads.clear()
        assert_ranges(summary_of(source), data)
        assert reads == []
    (file,), source = tmp_path.glob("*.npz"), source_of(tmp_path / "data.raw", shape=SHAPE, dtype="int16")
    whole = file.read_bytes()
    for content in (b"", whole[: len(whole) // 2], whole.replace(b'"version"', b'"revision'), whole[10:]):
        file.write_bytes(content)
        assert_ranges(summary_of(source), data)
        assert reads != []
        reads.clear()
        summary_of(source)
        assert reads == []


def test_changed_chunks_get_a_new_summary(tmp_path):
    data = voxels("uint8", SHAPE)
    for change in (0, 1):
        data[20:] = change
        source = source_of(written(tmp_path / "a.zarr", data, overwrite=True))
        assert_ranges(summary_of(source), data)
        assert summary_files_in(tmp_path) == ["a.zarr.jaxvol-summary-4.npz"]
    with pytest.raises(ValueError, match="changed while it was read"):
        summary_of(source, 8, progress=lambda *_: (tmp_path / "a.zarr" / "zarr.json").touch())


def test_where_files_lie(tmp_path, monkeypatch):
    source = opened(tmp_path, voxels("uint8", SHAPE))
    summary_of(source, cache=None)
    assert summary_files_in(tmp_path) == []
    summary_of(source, cache=str(tmp_path / "new"))
    assert summary_files_in(tmp_path / "new")[0].endswith("-data.raw.jaxvol-summary-4.npz")
    with pytest.raises(ValueError, match=r"cache: there is no folder .*missing in which folder"):
        summary_of(source, cache=tmp_path / "missing" / "folder")
    with pytest.raises(ValueError, match="cache must be"):  # of arrays, too, which have no files
        summary_of(source_of(voxels("uint8", SHAPE)), cache=3)

    def refused(path):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(summary_files, "whole_file", refused)
    with pytest.warns(UserWarning, match=r"cannot be written \(Permission denied\).* Pass cache="):
        summary_of(source)
