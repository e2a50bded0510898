"""Are only voxels read that may be seen? An image does not depend on the others, whatever they are."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.bricks import stream
from jaxvol.bricks.shown import READ, Shown, _kinds
from jaxvol.bricks.sources import ArraySource
from jaxvol.bricks.summary import scan
from jaxvol.engine.scene import Scene
from jaxvol.modes import compositing_of

from .test_render_bricks import assert_same


SHAPE = 163, 154, 171
MARCH = jv.March(1.0, (jv.SpaceLeaping(),), "midpoint")
CAMERA = jv.Camera((500, -370, 350), (81, 77, 85), (0, 0, 1), 22.0, size=(32, 32))
BETWEEN = jv.TransferFunction(
    [90, 100, 140, 150], [(1, 0.2, 0), (0, 1, 0.3), (0.2, 0, 1), (1, 1, 0)], [0, 0.2, 0.2, 0]
)
"""Values below 90 and above 150 are invisible: two ranges with what is visible between them."""


def nested(dtype=np.uint8):
    """A ball of high values in low ones, with a grain in both; where one turns into the other, it is seen."""
    x, y, z = np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij")
    radius = np.sqrt((x - 79) ** 2 + (y - 75) ** 2 + (z - 86) ** 2)
    grain = np.random.default_rng(0).uniform(0, 20, SHAPE)
    return (np.clip(1380 - 20 * radius, 20, 220) + grain).astype(dtype)


def shown(source, transfer=BETWEEN, march=MARCH, margin=(3, 4, 5), mode="over"):
    scene = Scene(jv.Volume(nested()), transfer, CAMERA, march, compositing_of(mode), None)
    return Shown.of(scene, scan(source, 16), margin)


class Recorded(ArraySource):
    """Remembers which voxels were read."""

    def __init__(self, data, chunks):
        super().__init__(data)
        self.chunks, self.boxes, self.asked = chunks, [], np.zeros(data.shape, int)

    def _stored(self, low, high):
        self.boxes.append((low, high))
        self.asked[tuple(map(slice, low, high))] += 1
        return super()._stored(low, high)


@pytest.mark.parametrize("chunks", [(1, 154, 171), (163, 154, 1), (20, 16, 30), (163, 9, 171)])
def test_boxes_hold_what_is_read_once_and_share_no_chunk(chunks):
    found = shown(ArraySource(nested()))
    low, high = np.array([5, 0, 7]), np.array([163, 154, 150])
    boxes = found.boxes(low, high, chunks)
    count = np.zeros(SHAPE, int)
    for box in boxes:
        count[tuple(map(slice, *box))] += 1
    assert count.max() == 1
    inside = np.zeros(SHAPE, bool)
    inside[tuple(map(slice, low, high))] = True
    assert not np.any(count[~inside])
    read = np.repeat(np.repeat(np.repeat(found.kind == READ, 16, 0), 16, 1), 16, 2)
    read = np.pad(read, [(0, max(n - have, 0)) for n, have in zip(SHAPE, read.shape, strict=True)], "edge")
    read = read[tuple(map(slice, SHAPE))]
    assert np.all(count[read & inside] == 1)
    assert 0.2 < np.mean(count[inside]) < 0.98
    touched = [
        {*product(*(range(a // c, (b - 1) // c + 1) for a, b, c in zip(*box, chunks, strict=True)))}
        for box in boxes
    ]
    assert sum(map(len, touched)) == len(set().union(*touched))


def test_what_stands_in_place_of_voxels_is_as_invisible():
    """Also between it and what was read, and between two that stand for different values."""
    data = nested()
    found = shown(ArraySource(data))
    assert len(found.values) == 2
    assert found.values[0] == 0
    assert 150 < found.values[1] < 255
    low, high = np.array([0, 0, 0]), np.array(SHAPE)
    voxels = found.unread(low, high)
    part = found.unread(np.array([13, 20, 33]), np.array([90, 80, 100]))
    np.testing.assert_array_equal(part, voxels[13:90, 20:80, 33:100])
    for box in found.boxes(low, high, (1, 154, 171)):
        place = tuple(map(slice, *box))
        voxels[place] = data[place]
    assert np.mean(voxels == data) < 0.95
    extinction = np.interp(np.arange(256), BETWEEN.values, BETWEEN.extinction)
    visible = np.concatenate([[0], np.cumsum(extinction > 0)])

    def seen(voxels):
        """Cells in which some value between their least and greatest is visible."""
        cubes = np.lib.stride_tricks.sliding_window_view(voxels, (2, 2, 2))
        low, high = (of(cubes, axis=(3, 4, 5)).astype(int) for of in (np.min, np.max))
        return visible[high + 1] > visible[low]

    np.testing.assert_array_equal(seen(voxels), seen(data))


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_an_image_does_not_depend_on_what_is_not_read(dtype):
    source = Recorded(nested(dtype), (16, 16, 16))
    whole = jv.render(jv.Volume(nested(dtype)), BETWEEN, CAMERA, MARCH)
    found = jv.render_bricks(source, BETWEEN, CAMERA, MARCH, bricks=(2, 2, 2))
    assert_same(whole, found)
    assert float(whole.rgba[..., 3].max()) > 0.5
    source.asked[:] = 0
    jv.render_bricks(source, BETWEEN, CAMERA, MARCH, bricks=(1, 1, 1))
    # once in the pass that finds ranges, and once for the image
    assert set(np.unique(source.asked)) == {1, 2}
    assert 0.02 < np.mean(source.asked == 1) < 0.95


def test_gradients_do_not_depend_on_what_is_not_read(monkeypatch):
    """Nor does that of the extinction outside of the points, which all invisible samples take part in that
    are not leapt over."""

    def loss(extinction):
        transfer = jv.TransferFunction(BETWEEN.values, BETWEEN.colors, extinction)
        return jnp.sum(jv.render_bricks(nested(), transfer, CAMERA, MARCH, bricks=(2, 1, 2)).rgba[..., 1])

    some = jax.grad(loss)(BETWEEN.extinction)
    monkeypatch.setattr(stream.Shown, "of", lambda *_: None)
    np.testing.assert_allclose(some, jax.grad(loss)(BETWEEN.extinction), rtol=1e-6)
    assert abs(some[0]) > 1


def test_all_is_read_where_what_is_invisible_may_count():
    source = ArraySource(nested())
    assert shown(source) is not None
    assert shown(source, march=jv.March(1.0)) is None
    assert shown(source, march=jv.March(1.0, (jv.SpaceLeaping(), jv.AdaptiveSampling(0.01)))) is None
    assert shown(source, mode="maximum") is None
    everywhere = jv.TransferFunction([0, 255], [(1, 1, 1)] * 2, [0.1, 0.2])
    assert shown(source, everywhere) is None


def test_ranges_that_nothing_visible_parts_are_of_one_kind():
    def visible(low, high):
        """Whole numbers are visible."""
        return np.floor(high) >= low

    low = np.array([0.2, 1.3, 0.5, 2.1, 1.1, 0.4, 0.1], np.float32)
    kind, values = _kinds(low, low + np.float32(0.2), visible)
    np.testing.assert_array_equal(kind, [0, 1, 0, 2, 1, 0, 0])
    np.testing.assert_array_equal(values, np.array([0.1, 1.1, 2.1], np.float32))
    many = np.arange(0.1, 500, 0.01)[None].T + 0 * np.arange(1)
    assert _kinds(np.arange(20) + np.float32(0.5), np.arange(20) + np.float32(0.6), visible) is None
    assert _kinds(many[:0, 0], many[:0, 0], visible) is None
    close = np.linspace(0.1, 0.9, 9999, dtype=np.float32)
    kind, values = _kinds(np.append(close, close + 1), np.append(close, close + 1), visible)
    assert np.all(kind[:9999] == kind[0])
    assert np.all(kind[9999:] == 1 - kind[0])
