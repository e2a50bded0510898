"""Are blocks called empty really empty? Ranges of blocks, visibility, box queries, distances."""

import gc
import weakref

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.ndimage import distance_transform_cdt, map_coordinates

import jaxvol as jv
from jaxvol._util import platform
from jaxvol._util.memo import memoized
from jaxvol._util.piecewise_linear import positive_between
from jaxvol.occupancy import BLOCK, Blocks, Occupancy, Sums


SHAPES = [(24, 20, 28), (5, 9, 13), (2, 2, 2), (6, 3, 18)]


def blocks_of_ranges(low, high):
    """One block per range."""
    low, high = (jnp.asarray(side, jnp.float32).reshape(-1, 1, 1) for side in (low, high))
    return Blocks(low, high, None)


# ---- ranges ----


def voxels(dtype, shape, rng):
    if dtype == "float32":
        return np.float32(rng.normal(size=shape) * 10.0 ** rng.integers(-3, 4, shape))
    limits = np.iinfo(dtype)
    return rng.integers(limits.min, limits.max, shape, dtype, endpoint=True)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("dtype", ["uint8", "int8", "uint16", "int16", "float32"])
def test_blocks_hold_every_value_between_their_nodes(dtype, shape):
    rng = np.random.default_rng(0)
    data = voxels(dtype, shape, rng)
    blocks = Blocks.of(jv.Volume(data))
    assert blocks.low.shape == tuple(-(-(n - 1) // BLOCK) for n in shape)
    assert blocks.labels is None
    points = rng.random((20_000, 3)) * (np.array(shape) - 1)
    points[:5000] = np.round(points[:5000])  # nodes, which belong to all adjacent blocks
    values = map_coordinates(data.astype(np.float64), points.T, order=1)
    for toward in (1e-9, -1e-9):
        block = np.clip(np.floor(points / BLOCK + toward).astype(int), 0, np.array(blocks.low.shape) - 1)
        place = tuple(block.T)
        assert np.all(np.asarray(blocks.low, np.float64)[place] <= values)
        assert np.all(values <= np.asarray(blocks.high, np.float64)[place])


def test_ranges_are_no_wider_than_their_nodes():
    data = np.arange(9 * 9 * 9, dtype=np.float32).reshape(9, 9, 9)
    blocks = Blocks.of(jv.Volume(data))
    np.testing.assert_allclose(blocks.low[1, 0, 1], data[4, 0, 4], rtol=2e-6)
    np.testing.assert_allclose(blocks.high[1, 0, 1], data[8, 4, 8], rtol=2e-6)


def test_blocks_know_their_labels():
    rng = np.random.default_rng(1)
    labels = rng.choice([0, 1, 2, 31, 34, 63, 200], (24, 20, 28)) * (rng.random((24, 20, 28)) < 0.01)
    blocks = Blocks.of(jv.Volume(np.zeros(labels.shape, np.uint8), labels=labels.astype(np.uint8)))
    shape = blocks.low.shape
    for label in (0, 1, 2, 3, 31, 34, 63, 200):
        may = np.asarray(blocks.may_hold(label))
        for block in np.ndindex(shape):
            part = labels[tuple(slice(i * BLOCK, i * BLOCK + BLOCK + 1) for i in block)]
            assert may[block] == np.any(part % 32 == label % 32)  # labels equal mod 32 share a bit


def test_without_labels_any_may_be_there():
    assert np.all(Blocks.of(jv.Volume(np.zeros((6, 6, 6), np.uint8))).may_hold(3))


# ---- visibility under a transfer function ----


def drawn_table(rng, points):
    values = np.float32(np.cumsum(rng.uniform(0.01, 30, points)) - 50)
    extinction = rng.uniform(1e-6, 5, points) * (rng.random(points) < rng.choice([0.1, 0.4, 0.9]))
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


@pytest.mark.parametrize("points", [2, 8, 40])
def test_what_is_called_invisible_has_no_extinction(points):
    @settings(max_examples=40, deadline=None)
    @given(seed=st.integers(0, 10**6))
    def check(seed):
        rng = np.random.default_rng(seed)
        transfer = drawn_table(rng, points)
        low, high = drawn_ranges(rng, np.asarray(transfer.values))
        blocks = blocks_of_ranges(low, high)
        shown, bound = (np.asarray(found)[:, 0, 0] for found in visible(transfer, blocks))
        between = np.clip(np.float32(low + np.linspace(0, 1, 64)[:, None] * (high - low)), low, high)
        extinction = np.asarray(extinction_at(transfer, jnp.asarray(between)))
        assert not np.any(extinction.max(axis=0)[~shown] > 0)
        assert np.all(extinction.max(axis=0) <= bound)
        np.testing.assert_array_equal(bound > 0, shown)
        # and, for ranges that do not end at a control point, nothing else is called visible
        x, y = np.asarray(transfer.values), np.asarray(transfer.extinction)
        clear = ~(np.isin(low, x) | np.isin(high, x))
        inner = (x > low[:, None]) & (x < high[:, None])
        most = np.maximum(np.interp(low, x, y), np.interp(high, x, y))
        most = np.maximum(most, np.max(np.where(inner, y, 0), axis=1))
        np.testing.assert_array_equal(shown[clear], most[clear] > 0)

    check()


def test_ranges_that_only_touch_visible_values_are_invisible():
    values, extinction = jnp.asarray([0.0, 1, 2, 3, 4, 5]), jnp.asarray([0.0, 0, 0, 1, 0, 0])
    cases = [
        ((-5, 0), False),
        ((0, 2), False),
        ((0, 2.001), True),
        ((2.2, 2.3), True),
        ((3.9, 9), True),
        ((4, 9), False),
        ((7, 9), False),
        ((-9, 9), True),
        ((3, 3), True),
    ]
    low, high = np.array([ends for ends, _ in cases], np.float32).T
    seen = positive_between(values, extinction, jnp.asarray(low), jnp.asarray(high))
    np.testing.assert_array_equal(seen, [expected for _, expected in cases])


@pytest.mark.parametrize("points", [2, 8, 40])
def test_extinction_is_exactly_that_of_the_end_beyond_it_and_never_negative(points):
    for seed in range(40):
        rng = np.random.default_rng(seed)
        drawn = drawn_table(rng, points)
        x, y = np.asarray(drawn.values), np.array(drawn.extinction)
        y[rng.integers(2) - 1] = 0  # an invisible end must be exactly transparent
        transfer = jv.TransferFunction(x, np.ones((points, 3)), y)
        ends = np.array([x[0] - 9, x[0], x[-1], x[-1] + 9])
        extinction = extinction_at(transfer, jnp.asarray(ends))
        np.testing.assert_allclose(extinction, y[[0, 0, -1, -1]], rtol=1e-6, atol=0)
        near = np.concatenate([x, np.nextafter(x, np.float32(-np.inf)), np.nextafter(x, np.float32(np.inf))])
        assert float(extinction_at(transfer, jnp.asarray(near)).min()) >= 0


def test_beyond_the_ends_the_end_is_seen():
    transfer = jv.TransferFunction([0.0, 1, 2], np.ones((3, 3)), [1.0, 0, 2])
    visible = transfer.visible(blocks_of_ranges([-9, 5, 1], [-8, 6, 1]))
    np.testing.assert_array_equal(visible[:, 0, 0], [True, True, False])


def test_hidden_labels_are_not_seen():
    labels = np.zeros((9, 5, 5), np.uint8)
    labels[6:] = 1
    volume = jv.Volume(np.full(labels.shape, 100, np.uint8), labels=labels)
    see = jv.TransferFunction([0.0, 50, 200], np.ones((3, 3)), [0.0, 0, 1])
    for functions, expected in (
        ([see, None], [True, True]),
        ([None, see], [False, True]),
        ([None, None, see], [False, False]),
    ):
        transfer, blocks = jv.LabelTransferFunction(functions), Blocks.of(volume)
        np.testing.assert_array_equal(transfer.visible(blocks)[:, 0, 0], expected)
        np.testing.assert_array_equal(transfer.majorant(blocks)[:, 0, 0] >= 1 / 3, expected)
        np.testing.assert_array_equal(transfer.majorant(blocks)[:, 0, 0] > 0, expected)


# ---- boxes and distances ----


@pytest.mark.parametrize("name", ["cpu", "gpu"])
@pytest.mark.parametrize("density", [0.0, 0.003, 0.1, 1.0])
def test_box_queries_agree_with_direct_inspection(density, name, monkeypatch):
    monkeypatch.setattr(platform, "platform", lambda: name)
    rng = np.random.default_rng(3)
    occupied = rng.random((7, 5, 11)) < density
    ends = np.sort(rng.integers(0, occupied.shape, (2, 500, 3)), axis=0)
    ends[:, 0] = [[0, 0, 0], [6, 4, 10]]
    first, last = (tuple(jnp.asarray(side.T, jnp.int32)) for side in ends)
    answers = Sums.of(jnp.asarray(occupied)).any_between(first, last)
    looked = [
        occupied[tuple(slice(a, b + 1) for a, b in zip(*box, strict=True))].any()
        for box in ends.transpose(1, 0, 2)
    ]
    np.testing.assert_array_equal(answers, looked)


def distances(occupied):
    point = (jnp.float32(0),) * 3
    return np.asarray(Occupancy(jnp.asarray(occupied), point, (jnp.float32(1),) * 3).distance(), int)


@pytest.mark.parametrize("count", [1, 3, 40])
def test_distances_are_those_of_a_chessboard(count):
    rng = np.random.default_rng(count)
    for _ in range(4):
        occupied = np.zeros((12, 9, 15), bool)
        occupied.reshape(-1)[rng.integers(0, occupied.size, count)] = True
        expected = np.asarray(distance_transform_cdt(~occupied, metric="chessboard"))
        np.testing.assert_array_equal(distances(occupied), expected.reshape(-1))


def test_distances_end_at_255_and_nothing_is_that_far_from_everything():
    """255 proves that nothing is occupied anywhere; distances of 250 and more may be reported as smaller."""
    line = np.zeros((300, 1, 2), bool)
    np.testing.assert_array_equal(distances(line), 255)
    line[0] = True
    distance = distances(line).reshape(300, 2)[:, 0]
    np.testing.assert_array_equal(distance[:250], np.arange(250))
    assert np.all(distance[250:] <= np.arange(250, 300))
    assert np.all(distance[250:] >= 250)
    np.testing.assert_array_equal(distances(np.ones((3, 4, 5), bool)), 0)


# ---- memoization ----


def test_memoized_results_are_freed_with_their_array():
    calls = []

    def double(array):
        calls.append(array.shape)
        return array * 2

    array = jnp.arange(5.0)
    first = memoized(array, double)
    assert memoized(array, double) is first
    assert memoized(jnp.arange(5.0), double) is not first
    assert len(calls) == 2
    alive = weakref.ref(first)
    del first
    assert alive() is not None
    del array
    gc.collect()
    assert alive() is None


def test_blocks_are_made_once_for_an_array_and_go_with_it():
    volume = jv.Volume(np.zeros((6, 7, 8), np.uint8))
    first = Blocks.of(volume).low
    assert Blocks.of(jv.Volume(volume.data, spacing=(1, 2, 3))).low is first
    alive = weakref.ref(first)
    del first, volume
    gc.collect()
    assert alive() is None


def test_nothing_is_memoized_for_mutable_numpy_arrays():
    array = np.zeros(3)
    assert float(memoized(array, lambda a: a.sum())) == 0
    array[:] = 1
    assert float(memoized(array, lambda a: a.sum())) == 3
