"""Is as much read around a brick as its rays, light and strides reach, and does that fit into memory?"""

import math
from functools import cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.bricks import BrickGrid, Summary, source_of
from jaxvol.bricks.files import FileSource
from jaxvol.bricks.ranges import Turn
from jaxvol.bricks.render import _scene_of, bricks_of
from jaxvol.bricks.split import COPIES, Margin, nodes_within, split, stored_of
from jaxvol.bricks.stream import Stream, _curved
from jaxvol.engine.image import RenderOptions
from jaxvol.engine.parts import set_out
from jaxvol.engine.tiling import Tiling
from jaxvol.lighting import ScattererTemplates

from ..scenes import in_float64, to_float64
from .test_render_bricks import SIDE, SUN, TRANSFER, assert_same, fog


HALF = math.pi / 2
SHAPE = (40, 48, 64)


def near_apex():
    """A probe whose nodes lie ten times as densely at the apex as in the middle."""
    return jv.ToroidalMap(1.0, 2.0, (HALF - 0.6, HALF + 0.6), (HALF - 0.9, HALF + 0.9), (0, 60))


def space_of(probe, shape=SHAPE):
    return jv.March(1.0, () if probe is None else (probe,)).locate(
        jv.Volume(np.zeros(shape, np.uint8), (1, 2, 3))
    )


# ---- as far as rays and light reach ----


@pytest.mark.parametrize("length", [0.3, 2.0, 12.0])
@pytest.mark.parametrize("kind", ["straight", "far", "near apex", "behind the axis"])
def test_nothing_within_a_length_of_a_box_lies_outside_of_its_nodes(kind, length):
    """Found by walking from points in random boxes, in random directions of the world."""
    probes = {
        "straight": None,
        "far": fog()[1],
        "near apex": near_apex(),
        "behind the axis": jv.ToroidalMap(-4.0, 3.0, (0.6, 2.5), (0.4, 2.7), (0, 30)),
    }
    space, rng = space_of(probes[kind]), np.random.default_rng(0)
    coordinate, point = (
        jnp.vectorize(lambda p, f=f: jnp.stack(f(tuple(p))), signature="(k)->(k)")
        for f in (space.coordinate, space.point)
    )
    limited = 0
    for _ in range(20):
        low = rng.uniform(0, np.array(SHAPE) - 1)
        high = np.minimum(low + rng.uniform(0, 12, 3), np.array(SHAPE) - 1)
        nodes = nodes_within(space, SHAPE, low, high, length)
        begin = np.asarray(point(jnp.asarray(rng.uniform(low, high, (400, 3)))))
        toward = rng.normal(size=(400, 3))
        toward *= length * rng.uniform(0, 1, (400, 1)) / np.linalg.norm(toward, axis=-1)[:, None]
        found = np.asarray(coordinate(jnp.asarray(begin + toward)))
        inside = np.all((found >= 0) & (found <= np.array(SHAPE) - 1), axis=-1)
        if kind == "behind the axis":  # what lies there has no place in the world
            inside &= np.linalg.norm(np.asarray(point(jnp.asarray(found))) - (begin + toward), axis=-1) < 1e-3
            from_there = np.linalg.norm(
                np.asarray(coordinate(jnp.asarray(begin)))[:, None] - found[:, None], axis=-1
            )
            assert np.all(np.isfinite(from_there))
        own = np.asarray(coordinate(jnp.asarray(begin)))
        inside &= np.all((own >= low - 1e-2) & (own <= high + 1e-2), axis=-1)
        assert np.all(found[inside] >= low - nodes - 1e-2)
        assert np.all(found[inside] <= high + nodes + 1e-2)
        limited += np.any(nodes < SHAPE)
    assert limited == 20 or kind == "behind the axis"


def test_nodes_that_lie_nearer_to_the_apex_than_a_box_are_closer_to_each_other():
    """From a node 13.4 mm from the apex, in random directions: 12 mm are an angle of asin(12 / 13.4), and not
    12 / 13.4."""
    space, length, at = space_of(near_apex()), 12.0, (20.0, 2.0, 12.0)
    i, j, k = map(jnp.asarray, at)
    node = np.asarray(space.point((i, j, k)))
    toward = np.random.default_rng(0).normal(size=(20_000, 3))
    toward *= length / np.linalg.norm(toward, axis=-1)[:, None]
    x, y, z = jnp.asarray(node + toward).T
    reached = np.asarray(space.coordinate((x, y, z))[1])
    assert 28 < np.max(reached) - at[1] <= nodes_within(space, SHAPE, np.array(at), np.array(at), length)[1]


def test_light_is_looked_for_among_more_nodes_near_the_apex():
    """Across beams they are the whole scan there, and few far from it."""
    probe = near_apex()
    space = space_of(probe)
    lighting = ScattererTemplates(jv.Material(0.5, 1.0, 1.4), SUN)
    source = source_of(np.zeros(SHAPE, np.uint8))
    march = jv.March(0.5, (probe,))
    scene = _scene_of(source, ((1, 1, 1), (0, 0, 0)), TRANSFER, SIDE, march, "over", lighting)
    margin = Margin.of(march, space, SHAPE, 8, scene)
    assert margin.light == lighting.farthest_read
    assert margin.light > 0
    apex, far = (
        margin.of_points(space, SHAPE, np.array(at), np.array(at)) for at in ((20, 24, 0), (20, 24, 60))
    )
    assert apex[0] >= SHAPE[0]
    assert apex[1] >= SHAPE[1]
    depth = 2 + 60 * 60 / 63 - margin.light  # of what is read nearest to the apex, up to a node
    assert far[1] <= math.ceil(margin.light / (1.8 / 47 * (depth - 1))) + margin.around < SHAPE[1]


# ---- within memory ----


def test_a_brick_has_fewer_voxels_than_a_volume_may_have():
    shape = (1600, 1600, 1600)
    margin = Margin((11, 11, 11), 11, 11.0, 0.0, 1, False)
    grid = split(shape, np.uint8, 20 * 2**30, margin, None)
    stored = stored_of(grid, margin, None)
    assert math.prod(stored) < 2**31
    assert np.any(np.less(stored, shape))
    assert grid.counts == (2, 1, 1)  # and no more than that takes


def test_no_axis_is_split_along_which_bricks_would_be_read_whole():
    margin = Margin((1, 20, 2), 1, 1.0, 0.0, 1, False)
    grid = split((65, 49, 65), np.uint8, 125_000, margin, None)
    assert stored_of(grid, margin, None)[1] == 49
    assert grid.counts[1] == 1
    assert math.prod(stored_of(grid, margin, None)) * COPIES <= 125_000


def test_bricks_that_are_too_large_for_a_volume_are_named():
    source = source_of(np.broadcast_to(np.uint8(0), (1600, 1600, 1600)))
    nothing = np.zeros((1, 1, 1), np.uint8)
    summary = Summary(source.shape, 1600, {"low": nothing, "high": nothing})
    scene = _scene_of(source, ((1, 1, 1), (0, 0, 0)), TRANSFER, SIDE, jv.March(1.0), "over", None)
    given = source, lambda: summary, scene, scene, RenderOptions("all", Tiling.of_backend(None)), 2**35
    with pytest.raises(
        ValueError, match=r"bricks must be so many.*fewer than 2\*\*31 voxels; got 1600 x 1600"
    ):
        Stream.of(*given, (1, 1, 1), "overlap", None)
    assert math.prod(Stream.of(*given, (2, 1, 1), "overlap", None).stored) < 2**31


@cache
def whole_near_apex():
    volume, _, transfer = fog()
    return jv.render(volume, transfer, SIDE, jv.March(0.5, (near_apex(), jv.Jitter(0))))


@pytest.mark.parametrize("method", ["overlap", "reload"])
def test_a_toroidal_volume_is_rendered_within_its_memory(method):
    """Where a step covers many more nodes at the apex than in the middle."""
    volume, _, transfer = fog()
    march, memory = jv.March(0.5, (near_apex(), jv.Jitter(0))), 254_000
    found = jv.render_bricks(np.asarray(volume.data), transfer, SIDE, march, memory=memory, method=method)
    assert_same(whole_near_apex(), found)
    assert np.prod(found.bricks.counts) > 1
    assert found.bricks.bytes_held <= memory
    assert np.any(np.less(found.bricks.stored, volume.shape))


def test_less_memory_than_a_brick_at_the_apex_takes_is_named():
    volume, _, transfer = fog()
    march = jv.March(1.0, (near_apex(), jv.Jitter(0)))
    with pytest.raises(ValueError, match=r"memory must be at least \d+ bytes.*got 150000"):
        jv.render_bricks(np.asarray(volume.data), transfer, SIDE, march, memory=150_000)


# ---- what is read ----


@pytest.mark.parametrize("value", [0, 250])
def test_voxels_outside_of_the_ranges_found_before_are_refused(value, tmp_path, monkeypatch):
    """As where a file changes within a tick of the clock: its fingerprint is the same."""
    data = np.full((41, 35, 50), 100, np.uint8)
    monkeypatch.setattr(FileSource, "fingerprint", lambda _: {"same": 1})
    path, march = tmp_path / "a.npy", jv.March(1.0)

    def read():
        stream = bricks_of(source_of(path), TRANSFER, SIDE, march, memory=10**6)
        return stream.read(0, *stream.around(0))[1].result()

    np.save(path, data)
    np.testing.assert_array_equal(read(), data)
    data[20, 20, 20] = value
    np.save(path, data)
    with pytest.raises(ValueError, match=rf"a.npy changed since the ranges.* 100\.0 to 100\.0 .*{value}"):
        read()


# ---- cells of curved rays ----


def scene_of_fog(march):
    volume, _, transfer = fog()
    place = np.ones(3, np.float32), np.zeros(3, np.float32)
    return _scene_of(source_of(np.asarray(volume.data)), place, transfer, SIDE, march, "over", None)


def cells_of(scene, brick=0):
    """The cells of an image's rays in a brick of the fog, at the beginning of a march."""
    underway = set_out(scene, RenderOptions("all", Tiling.of_backend(None)))
    grid, empty = BrickGrid(SHAPE, (39, 47, 16)), jnp.zeros(5, bool).at[4].set(True)
    turn = Turn(jnp.asarray(brick, jnp.int32), empty, empty.at[brick].set(True), empty)
    reached = jnp.zeros(underway.rays.length.shape, jnp.int32)
    return _curved(None, grid, 11, scene.march, underway.rays, underway.at, reached, turn)


def test_cells_of_curved_rays_are_found_under_64_bits():
    """Traced only: a loop whose state changes its type is an error then."""
    scene = scene_of_fog(jv.March(1.0, (fog()[1],)))
    with in_float64():
        found = eqx.filter_eval_shape(cells_of, to_float64(scene))
    assert found.cells.until.dtype == np.int32
    assert found.low.dtype == np.float64


def test_no_cells_are_looked_for_behind_the_last_sample_of_a_ray():
    """A ray of some 10**5 steps has 16 samples at the most, which end in the first few bricks."""
    found = cells_of(scene_of_fog(jv.March(1e-3, (fog()[1],), max_samples=16)), brick=3)
    assert bool(found.any)
    assert 1 <= int(jnp.max(found.cells.until)) <= 16
