"""Are the ranges of values those of the voxels, found in one pass that is never repeated nor out of date?"""

from typing import Any

import numpy as np
import pytest

from jaxvol.bricks import VoxelSource, source_of, summary
from jaxvol.bricks.summary import scan, summary_of

from .test_sources import voxels, x_fastest
from .test_zarr import written


SHAPE = (23, 18, 33)


def assert_ranges(found, data):
    """Of each block with the nodes on its faces, by looking at them."""
    cell, data = found.cell, data.astype(np.float64)
    for block in np.ndindex(*(-(-(n - 1) // cell) for n in data.shape)):
        part = data[tuple(slice(i * cell, (i + 1) * cell + 1) for i in block)]
        assert (found.low[block], found.high[block]) == (part.min(), part.max())


@pytest.mark.parametrize("shape", [SHAPE, (2, 2, 2), (71, 5, 9)], ids=str)
@pytest.mark.parametrize("dtype", ["uint8", "int16", "float16", "bfloat16"])
def test_ranges_are_those_of_the_voxels_in_each_block(dtype, shape):
    data = voxels(dtype, shape)
    for given, cell, memory in ((data, 4, 10_000), (np.asfortranarray(data), 8, 10_000), (data, 12, 10**7)):
        assert_ranges(scan(source_of(given), cell, memory=memory), data)


def test_faults_of_a_pass():
    data = np.zeros(SHAPE, np.float32)
    data[22, 17, 32] = np.nan
    with pytest.raises(ValueError, match=r"must be finite.* to \(23, 18, 33\)"):
        scan(source_of(data), 4, memory=10_000)


# ---- kept ----


def test_the_pass_is_kept_by_its_source(tmp_path, monkeypatch):
    data = voxels("int16", SHAPE)
    passes = []
    monkeypatch.setattr(summary, "scan", lambda *given, **more: passes.append(1) or scan(*given, **more))
    of_file = source_of(x_fastest(tmp_path / "data.raw", data), shape=SHAPE, dtype="int16")
    for _ in range(3):
        assert_ranges(summary_of(of_file), data)
    assert len(passes) == 1
    x_fastest(tmp_path / "data.raw", data + 1)
    with pytest.raises(ValueError, match="changed after it was opened"):
        summary_of(of_file)


@pytest.mark.parametrize("dtype", ["uint8", "float16"])
def test_chunks_of_any_size_are_read_once(dtype, tmp_path, monkeypatch):
    """Also where they end within blocks."""
    data, read = voxels(dtype, (40, 37, 33)), VoxelSource.read
    for number, chunks in enumerate([(7, 5, 33), (40, 3, 4), (13, 13, 13)]):
        source = source_of(written(tmp_path / f"{number}.zarr", data, chunks))
        boxes: list[Any] = []
        monkeypatch.setattr(VoxelSource, "read", lambda *box, to=boxes: to.append(box[1:]) or read(*box))
        assert_ranges(scan(source, 8, memory=10_000), data)
        held = np.zeros(data.shape, int)
        for low, high, _ in boxes:
            assert all(a % c == 0 for a, c in zip(low, chunks, strict=True))
            held[tuple(map(slice, low, high))] += 1
        assert np.all(held == 1)
        assert len(boxes) > 2
        monkeypatch.undo()


def test_a_plane_that_exceeds_the_memory_is_read_in_rows():
    data = voxels("uint8", (3, 40, 500))
    assert_ranges(scan(source_of(data), 4, memory=8 * 2000), data)
    boxes = source_of(data).boxes(((0, 0, 0), data.shape), 2000)
    assert max(np.prod(np.subtract(high, low)) for low, high in boxes) <= 2000
