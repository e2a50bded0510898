"""Are blocks called empty really empty? Ranges of blocks, visibility, box queries, distances."""

import gc
import weakref
from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.ndimage import distance_transform_cdt, map_coordinates

import jaxvol as jv
from jaxvol._util.piecewise_linear import positive_between
from jaxvol.scene.occupancy import BLOCK, Blocks, Occupancy, Sums
from jaxvol.xla import platform
from jaxvol.xla.memo import memoized


def blocks_of_ranges(low, high):
    """One block per range."""
    low, high = (jax.device_put(np.reshape(np.float32(side), (-1, 1, 1))) for side in (low, high))
    return Blocks(low, high, None)


# ---- ranges ----


def voxels(dtype, shape, rng):
    if dtype == "float32":
        return (rng.normal(size=shape) * 10.0 ** rng.integers(-3, 4, shape)).astype(np.float32)
    limits = np.iinfo(dtype)
    return rng.integers(limits.min, limits.max, shape, dtype, endpoint=True)


@pytest.mark.parametrize(
    ("dtype", "shape"),
    # integers are taken layer by layer: with and without a rest along the axes, and smaller than a block
    [("uint8", (24, 20, 28)), ("int16", (5, 9, 13)), ("uint16", (2, 2, 3)), ("float32", (6, 3, 18))],
)
def test_blocks_hold_every_value_between_their_nodes_and_little_more(dtype, shape):
    rng = np.random.default_rng(0)
    data = voxels(dtype, shape, rng)
    blocks = Blocks.of(jv.Volume(data))
    low, high = (np.asarray(side, np.float64) for side in (blocks.low, blocks.high))
    assert low.shape == tuple(-(-(n - 1) // BLOCK) for n in shape)
    assert blocks.labels is None
    points = rng.random((20_000, 3)) * (np.array(shape) - 1)
    points[:5000] = np.round(points[:5000])  # nodes, which belong to all adjacent blocks
    values = map_coordinates(data.astype(np.float64), points.T, order=1)
    for toward in (1e-9, -1e-9):
        block = np.clip(np.floor(points / BLOCK + toward).astype(int), 0, np.array(low.shape) - 1)
        place = tuple(block.T)
        assert np.all(low[place] <= values)
        assert np.all(values <= high[place])
    for block in np.ndindex(low.shape):
        nodes = data[tuple(slice(i * BLOCK, i * BLOCK + BLOCK + 1) for i in block)].astype(float)
        slack = 2e-6 * np.abs(nodes).max()
        np.testing.assert_allclose([low[block], high[block]], [nodes.min(), nodes.max()], rtol=0, atol=slack)


def test_blocks_know_their_labels():
    rng = np.random.default_rng(1)
    labels = rng.choice([0, 1, 2, 31, 34, 63, 200], (24, 20, 28)) * (rng.random((24, 20, 28)) < 0.01)
    blocks = Blocks.of(jv.Volume(np.zeros(labels.shape, np.uint8), labels=labels.astype(np.uint8)))
    asked = 0, 1, 2, 3, 31, 34, 63, 200
    without = blocks_of_ranges([0.0], [1.0])
    found, any_label = jax.jit(lambda: ([blocks.may_hold(each) for each in asked], without.may_hold(3)))()
    for label, may in zip(asked, map(np.asarray, found), strict=True):
        for block in np.ndindex(may.shape):
            part = labels[tuple(slice(i * BLOCK, i * BLOCK + BLOCK + 1) for i in block)]
            assert may[block] == np.any(part % 32 == label % 32)  # labels equal mod 32 share a bit
    assert np.asarray(any_label).all()  # without labels, any may be there


# ---- visibility under a transfer function ----


def drawn_table(rng, points):
    values = np.float32(np.cumsum(rng.uniform(0.01, 30, points)) - 50)
    extinction = rng.uniform(1e-6, 5, points) * (rng.random(points) < rng.choice([0.1, 0.4, 0.9]))
    extinction[rng.integers(2) - 1] = 0  # an invisible end must be exactly transparent
    return jv.TransferFunction(values, np.ones((points, 3)), extinction)


@eqx.filter_jit
def visible(transfer, blocks):
    return transfer.visible(blocks), transfer.majorant(blocks)


@eqx.filter_jit
def extinction_at(transfer, value):
    return transfer(value)[1]


def drawn_ranges(rng, values, count=200):
    """Narrow and wide ranges, some between control points, some beyond the ends."""
    low, width = rng.uniform(values[0] - 20, values[-1] + 20, count), rng.exponential(20, count)
    high = low + width * (rng.random(count) < 0.8)
    at_points = rng.integers(0, len(values), (2, count))
    exact = rng.random((2, count)) < 0.3
    low = np.where(exact[0], values[at_points[0]], low)
    high = np.maximum(low, np.where(exact[1], values[at_points[1]], high))
    return low.astype(np.float32), high.astype(np.float32)


@pytest.mark.parametrize("points", [8, 40])
def test_what_is_called_invisible_has_no_extinction(points):
    """Nor what lies beyond an end that has none. Nowhere is the extinction negative."""

    @settings(max_examples=40, deadline=None)
    @given(seed=st.integers(0, 10**6))
    def check(seed):
        rng = np.random.default_rng(seed)
        transfer = drawn_table(rng, points)
        x, y = np.asarray(transfer.values), np.asarray(transfer.extinction)
        low, high = drawn_ranges(rng, x)
        ends, infinity = np.array([x[0] - 9, x[0], x[-1], x[-1] + 9]), np.float32(np.inf)
        near = np.concatenate([x, np.nextafter(x, -infinity), np.nextafter(x, infinity)])
        between = np.clip(np.float32(low + np.linspace(0, 1, 64)[:, None] * (high - low)), low, high)
        given = np.concatenate([between.ravel(), ends, near]).astype(np.float32)
        extinction = np.asarray(extinction_at(transfer, given))
        assert extinction.min() >= 0
        extinction, beyond = extinction[: between.size].reshape(between.shape), extinction[between.size :][:4]
        np.testing.assert_allclose(beyond, y[[0, 0, -1, -1]], rtol=1e-6, atol=0)
        shown, bound = (
            np.asarray(found)[:, 0, 0] for found in visible(transfer, blocks_of_ranges(low, high))
        )
        assert not np.any(extinction.max(axis=0)[~shown] > 0)
        assert np.all(extinction.max(axis=0) <= bound)
        np.testing.assert_array_equal(bound > 0, shown)
        # and, for ranges that do not end at a control point, nothing else is called visible
        clear = ~(np.isin(low, x) | np.isin(high, x))
        inner = (x > low[:, None]) & (x < high[:, None])
        most = np.maximum(np.interp(low, x, y), np.interp(high, x, y))
        most = np.maximum(most, np.max(np.where(inner, y, 0), axis=1))
        np.testing.assert_array_equal(shown[clear], most[clear] > 0)

    check()


def test_ranges_that_only_touch_visible_values_are_invisible():
    values, extinction = np.array([[0, 1, 2, 3, 4, 5], [0, 0, 0, 1, 0, 0]], np.float32)
    invisible, shown = [(-5, 0), (0, 2), (4, 9), (7, 9)], [(0, 2.001), (2.2, 2.3), (3.9, 9), (-9, 9), (3, 3)]
    low, high = np.array([*invisible, *shown], np.float32).T
    seen = jax.jit(positive_between)(values, extinction, low, high)
    np.testing.assert_array_equal(seen, [False] * 4 + [True] * 5)


# ---- boxes and distances ----


@pytest.mark.parametrize("name", ["cpu", "gpu"])
def test_box_queries_agree_with_direct_inspection(name, monkeypatch):
    monkeypatch.setattr(platform, "platform", lambda: name)
    any_between = jax.jit(lambda occupied, first, last: Sums.of(occupied).any_between(first, last))
    rng = np.random.default_rng(3)
    for density in (0.0, 0.003, 0.1, 1.0):
        occupied = rng.random((7, 5, 11)) < density
        ends = np.sort(rng.integers(0, occupied.shape, (2, 500, 3)), axis=0).astype(np.int32)
        ends[:, 0] = [[0, 0, 0], [6, 4, 10]]
        looked = [
            occupied[tuple(slice(a, b + 1) for a, b in zip(*box, strict=True))].any()
            for box in ends.transpose(1, 0, 2)
        ]
        np.testing.assert_array_equal(any_between(occupied, *(tuple(side.T) for side in ends)), looked)


@jax.jit
def distance_of(occupied):
    return Occupancy(occupied, (jnp.float32(0),) * 3, (jnp.float32(1),) * 3).distance()


def distances(occupied):
    return np.asarray(distance_of(occupied), int)


def test_distances_of_voxels_are_those_to_the_nearest_cell_that_shows_anything():
    """Two small bright things, one of them at a corner."""
    data = np.zeros((14, 11, 9), np.float32)
    data[0, 0, 0], data[9:11, 5, 6] = 1, 0.4
    transfer = jv.TransferFunction(np.array([0.1, 1]), np.ones((2, 3)), np.array([0.0, 2]))
    found = jax.jit(lambda v: distance_of(transfer.visible(Blocks.of(v, side=1))))(jv.Volume(data))
    cells = list(product(*(range(n - 1) for n in data.shape)))
    shown = [c for c in cells if data[tuple(slice(i, i + 2) for i in c)].max() > 0.1]
    nearest = [np.abs(np.asarray(c) - shown).max(axis=1).min() for c in cells]
    np.testing.assert_array_equal(found, nearest)


def test_distances_are_those_of_a_chessboard():
    rng = np.random.default_rng(1)
    for count in (1, 1, 3, 3, 40, 40):
        occupied = np.zeros((12, 9, 15), bool)
        occupied.reshape(-1)[rng.integers(0, occupied.size, count)] = True
        expected = np.asarray(distance_transform_cdt(~occupied, metric="chessboard"))
        np.testing.assert_array_equal(distances(occupied), expected.reshape(-1))
    np.testing.assert_array_equal(distances(np.ones((12, 9, 15), bool)), 0)


def test_distances_end_at_255_and_nothing_is_that_far_from_everything():
    """255 proves that nothing is occupied anywhere; distances of 250 and more may be reported as smaller."""
    line = np.zeros((300, 1, 2), bool)
    np.testing.assert_array_equal(distances(line), 255)
    line[0] = True
    distance = distances(line).reshape(300, 2)[:, 0]
    np.testing.assert_array_equal(distance[:250], np.arange(250))
    assert np.all(distance[250:] <= np.arange(250, 300))
    assert np.all(distance[250:] >= 250)


# ---- memoization ----


def test_memoized_results_are_freed_with_their_array():
    calls = []

    def double(array):
        calls.append(array.shape)
        return jax.device_put(2 * np.asarray(array))

    array, other = (jax.device_put(np.arange(5.0, dtype=np.float32)) for _ in range(2))
    first = memoized(array, double)
    assert memoized(array, double) is first
    assert memoized(other, double) is not first
    assert len(calls) == 2
    alive = weakref.ref(first)
    del first
    assert alive() is not None
    del array
    gc.collect()
    assert alive() is None
    mutable = np.zeros(3)  # nothing is memoized for these
    assert float(memoized(mutable, lambda a: a.sum())) == 0
    mutable[:] = 1
    assert float(memoized(mutable, lambda a: a.sum())) == 3


def test_blocks_are_made_once_for_an_array_and_go_with_it():
    volume = jv.Volume(np.zeros((24, 20, 28), np.uint8))
    first = Blocks.of(volume).low
    assert Blocks.of(jv.Volume(volume.data, spacing=(1, 2, 3))).low is first
    alive = weakref.ref(first)
    del first, volume
    gc.collect()
    assert alive() is None
