"""Is little read of a volume? Splits that follow what is visible, and how it is stored."""

import itertools
import math

import numpy as np
import pytest

import jaxvol as jv
from jaxvol.bricks import BrickGrid, Summary, raw, source_of
from jaxvol.bricks.choice import _others, cheapest, counts, visible
from jaxvol.bricks.split import Margin, fits, split, stored_of


MARGIN = Margin((4, 4, 4), 3, 3.0, 0.0, 1, False)
CELL = 16


def summary_with(shape, box):
    """Ranges of a volume in which something lies in a box of blocks, and these blocks."""
    blocks = tuple(-(-(n - 1) // CELL) for n in shape)
    high = np.zeros(blocks, np.uint8)
    high[box] = 200
    return Summary(shape, CELL, {"low": np.zeros_like(high), "high": high}), high > 0


@pytest.mark.parametrize("size", [(16, 32, 48), (32, 127, 16), (48, 64, 99)])
def test_a_brick_is_visible_if_any_of_its_blocks_is(size):
    shape = (97, 128, 100)
    summary, occupied = summary_with(shape, np.s_[2:4, 5:6, :3])
    grid = BrickGrid(shape, size)
    found = visible(grid, summary, counts(occupied))
    for brick in range(grid.number):
        low, high = grid.cells(brick)
        part = tuple(slice(a // CELL, -(-b // CELL)) for a, b in zip(low, high, strict=True))
        assert found[brick] == occupied[part].any()


def read_of(grid, summary, occupied):
    return visible(grid, summary, counts(occupied)).sum() * math.prod(stored_of(grid, MARGIN, None))


def test_bricks_follow_what_is_visible():
    """A rod along each axis in turn: bricks along it leave out what is beside it."""
    shape, memory = (257, 257, 257), 2**22
    for axis in range(3):
        box = tuple(slice(None) if a == axis else slice(4, 7) for a in range(3))
        summary, occupied = summary_with(shape, box)
        source = source_of(np.broadcast_to(np.uint8(0), shape))
        first = split(shape, np.uint8, memory, MARGIN, None)
        best = cheapest(first, source, summary, counts(occupied), MARGIN, memory, 0)
        assert fits(stored_of(best, MARGIN, None), np.dtype(np.uint8), MARGIN, memory)
        assert read_of(best, summary, occupied) < 0.7 * read_of(first, summary, occupied)
        # nothing that fits into as many bricks reads less
        for parts in itertools.product(range(1, 9), repeat=3):
            x, y, z = (-(-256 // p // 16) * 16 for p in parts)
            other = BrickGrid(shape, (x, y, z))
            fitting = fits(stored_of(other, MARGIN, None), np.dtype(np.uint8), MARGIN, memory)
            if fitting and other.number <= 2 * first.number:
                assert read_of(best, summary, occupied) <= read_of(other, summary, occupied)


def test_rows_of_a_file_are_not_cut_for_nothing(tmp_path):
    """Where all is visible, those bricks are taken whose rows lie in one piece."""
    shape, memory = (257, 257, 257), 2**23
    path = tmp_path / "dark.raw"
    with path.open("wb") as file:
        file.truncate(math.prod(shape))
    source = raw(path, shape, "uint8")
    summary, occupied = summary_with(shape, np.s_[:])
    first = split(shape, np.uint8, memory, MARGIN, None)
    best = cheapest(first, source, summary, counts(occupied), MARGIN, memory, 0)
    assert first.counts[0] > 1
    assert best.counts[0] == 1  # rows run along x
    assert best.counts[2] > 1


def test_many_rays_want_few_bricks():
    """Each brick takes time for all rays: more than a little reading saves."""
    shape, memory = (257, 257, 257), 2**22
    summary, occupied = summary_with(shape, np.s_[:])
    occupied = np.random.default_rng(0).random(occupied.shape) < 0.01
    source = source_of(np.broadcast_to(np.uint8(0), shape))
    first = split(shape, np.uint8, memory, MARGIN, None)
    given = first, source, summary, counts(occupied), MARGIN, memory
    few, many = (cheapest(*given, rays) for rays in (0, 2**24))
    assert visible(many, summary, counts(occupied)).sum() < visible(few, summary, counts(occupied)).sum()


def test_the_choice_takes_little_time_for_large_volumes():
    """As many splits are tried as an axis has sizes, and not as it has numbers of parts."""
    shape, memory = (4097, 4097, 4097), 2**28
    source = source_of(np.broadcast_to(np.uint8(0), shape))
    first, tried = split(shape, np.uint8, memory, MARGIN, None), []
    for other in _others(first, source, MARGIN, memory):
        tried.append(other.size)
        assert other.number <= 2 * first.number
    assert 50 < len(tried) == len({*tried}) < 2000


def test_devices_that_own_bricks_take_one_each_at_a_time():
    """A rod, of which a single long brick would do, and leave seven devices idle."""
    shape, memory = (257, 257, 257), 2**26
    summary, occupied = summary_with(shape, np.s_[4:6, 4:6, :])
    source = source_of(np.broadcast_to(np.uint8(0), shape))
    given = source, summary, counts(occupied), MARGIN, memory, 0
    one = cheapest(split(shape, np.uint8, memory, MARGIN, None), *given)
    eight = cheapest(split(shape, np.uint8, memory, MARGIN, None, 8), *given, 8)
    assert visible(eight, summary, counts(occupied)).sum() > visible(one, summary, counts(occupied)).sum()


@pytest.mark.parametrize("order", ["C", "F"])
def test_an_image_reads_what_the_choice_says(order):
    """A rod of 3 x 3 blocks in a corner: what lies beside it is not read."""
    data = np.zeros((129, 129, 129), np.uint8, order)
    data[3:40, 3:40, :] = 200
    transfer = jv.TransferFunction.from_points([(60, (1, 1, 1), 0.0), (250, (1, 0, 1), 0.2)])
    camera = jv.Camera((64, 64, -300), (64, 64, 64), (0, 1, 0), 30.0, size=(16, 16))
    march = jv.March(0.25, (jv.SpaceLeaping(),))
    whole = jv.render(jv.Volume(data), transfer, camera, march)
    found = jv.render_bricks(data, transfer, camera, march, memory=10**6)
    np.testing.assert_allclose(found.rgba, whole.rgba, atol=2e-5)
    assert found.bricks.bytes_held <= 10**6
    assert found.bricks.bytes_read < 0.4 * data.size
