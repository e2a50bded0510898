"""How is a volume divided into bricks: in which order, of which sizes, and how much is read around them?"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from experiments import bricks as paper
from jaxvol.bricks import BrickGrid, overlap_of, source_of
from jaxvol.bricks.grid import EDGE, Margin, nodes_within, split
from jaxvol.bricks.render import scene_of
from jaxvol.bricks.summary import Summary
from jaxvol.bricks.traversal import _curved
from jaxvol.engine.brick_march import begin_image
from jaxvol.engine.tiling import RenderOptions, Tiling

from ..scenes import in_float64, to_float64
from .scenes import CAMERA, CURVED, FROM_THE_SIDE, PLAIN, SHEETS, TRANSFER, fog


# ---- grid and order ----


def test_bricks_are_numbered_along_the_axes():
    grid = BrickGrid((9, 17, 5), (4, 8, 3))
    assert grid.counts == (2, 2, 2)
    assert grid.cells(7) == ((4, 8, 3), (8, 16, 4))
    at = np.asarray([[0.0, 4.0, 8.0, -1], [7.9, 8.0, 16.0, 99], [2.9, 3.0, 4.0, 0]], np.float32)
    assert jax.jit(lambda at: grid.brick_of((at[0], at[1], at[2])))(at).tolist() == [0, 7, 7, 2]


DIRECTIONS = [(-1, 0, -1), (0.3, 0, 0.95), (-0.3, 0, -0.95), (0.2, -0.7, 0.4), (1e-3, 1, -1e-3), (0, 0, 1)]


@pytest.mark.parametrize(
    ("spacing", "distance", "parallel"),
    [(1.0, 0.4, False), (1e-6, 100.0, False), (1.0, 3e7, False), (1e7, 100.0, True), (1e-6, 3e7, True)],
)
def test_no_ray_meets_a_brick_after_one_that_is_behind_it(spacing, distance, parallel):
    """`distance` of the eye from the middle, in voxels. Rays of a parallel camera all run along its axis; of
    the others, one to each corner of a brick is followed by its brick at 400 points."""
    volume = jv.Volume(np.zeros((33, 33, 33), np.uint8), (spacing, spacing, 2 * spacing))
    grid, space = BrickGrid(volume.shape, (16, 11, 20)), jv.March(1.0).locate(volume)
    middle, steps = np.asarray(volume.center, float), spacing * np.array([1, 1, 2])
    nodes = np.stack(np.meshgrid(*np.linspace(0.5, 31.5, 4)[None].repeat(3, 0)), -1).reshape(-1, 3)
    for direction in DIRECTIONS:
        forward = np.asarray(direction) / np.linalg.norm(direction)
        eye = middle - distance * spacing * forward
        scale = {"parallel_scale": 20.0 * spacing} if parallel else {}
        camera = jv.Camera(eye, middle, (0.1, 1, 0.2), size=(8, 8), **scale)
        place = np.array(grid.order(space, camera)).argsort()
        assert sorted(place) == list(range(grid.number))
        toward = np.broadcast_to(forward / (1, 1, 2), nodes.shape) if parallel else nodes - eye / steps
        along = np.linspace(-40, 40, 400)[:, None, None] * toward / np.linalg.norm(toward, axis=-1)[:, None]
        points = nodes + along
        ahead = np.sum((points - eye / steps) * toward, -1) > 0
        inside = np.all((points > 0) & (points < 32), -1) & (ahead | parallel)
        index = np.clip((points // grid.size).astype(int), 0, np.array(grid.counts) - 1)
        bricks = np.asarray(np.ravel_multi_index(tuple(np.moveaxis(index, -1, 0)), grid.counts))
        for ray in range(len(nodes)):
            assert np.all(np.diff(place[bricks[inside[:, ray], ray]]) >= 0)


# ---- sizes ----

MARGIN = Margin((4, 4, 4), 3, 3.0, 0.0, 1, False)
CELL = 16
UINT8 = np.dtype(np.uint8)
CUBE = (257, 257, 257)


def nothing(shape):
    return source_of(np.broadcast_to(np.uint8(0), shape))


def above_100(blocks):
    return blocks.high > 100


@pytest.mark.parametrize("size", [(16, 32, 48), (32, 127, 16), (48, 64, 99)])
def test_a_brick_is_visible_if_any_of_its_blocks_is(size):
    shape = (97, 128, 100)
    most = np.zeros([-(-(n - 1) // CELL) for n in shape], np.uint8)
    most[2:4, 5:6, :3] = 200
    grid = BrickGrid(shape, size)
    found = Summary(CELL, np.zeros_like(most), most).bricks_where(eqx.Partial(above_100), grid)
    for brick in range(grid.number):
        low, high = grid.cells(brick)
        part = tuple(slice(a // CELL, -(-b // CELL)) for a, b in zip(low, high, strict=True))
        assert found[brick] == (most[part] > 100).any()


@pytest.mark.parametrize("memory", [2**22, 2**20, 2**18])
def test_the_largest_bricks_of_about_cubic_shape_are_taken_that_fit(memory):
    grid = split(CUBE, UINT8, memory, MARGIN)
    assert MARGIN.fits(MARGIN.stored(grid), UINT8, memory)
    assert max(grid.size) - min(grid.size) <= 2 * EDGE
    side = min(grid.size) + EDGE
    assert not MARGIN.fits(MARGIN.stored(BrickGrid(CUBE, (side, side, side))), UINT8, memory)


def test_devices_that_share_bricks_have_one_each():
    assert split(CUBE, UINT8, 2**30, MARGIN).number == 1
    assert split(CUBE, UINT8, 2**30, MARGIN, 8).number >= 8


def test_a_brick_has_fewer_voxels_than_a_volume_may_have():
    shape, margin = (1600, 1600, 1600), Margin((11, 11, 11), 11, 11.0, 0.0, 1, False)
    grid = split(shape, UINT8, 20 * 2**30, margin)
    stored = margin.stored(grid)
    assert math.prod(stored) < 2**31
    assert grid.counts == (2, 1, 1)  # and no more than that takes
    with pytest.raises(
        ValueError,
        match=r"bricks must have fewer than 2\*\*31 voxels each; got \(1600, 1600",
    ):
        jv.render_bricks(nothing(shape), TRANSFER, CAMERA, PLAIN, bricks=(1, 1, 1))
    # no axis is split along which bricks would be read whole
    grid = split((65, 49, 65), UINT8, 125_000, Margin((1, 20, 2), 1, 1.0, 0.0, 1, False))
    assert grid.counts[1] == 1


# ---- what is read around bricks ----

HALF = math.pi / 2
SHAPE = (40, 48, 64)
PROBES = {
    "straight": None,
    "far": jv.ToroidalMap(10.0, 20.0, (HALF - 0.6, HALF + 0.6), (HALF - 0.9, HALF + 0.9), (0, 60)),
    # whose nodes lie ten times as densely at the apex as in the middle
    "near apex": jv.ToroidalMap(1.0, 2.0, (HALF - 0.6, HALF + 0.6), (HALF - 0.9, HALF + 0.9), (0, 60)),
}


def space_of(name):
    transforms = () if PROBES[name] is None else (PROBES[name],)
    return jv.March(1.0, transforms).locate(jv.Volume(np.zeros(SHAPE, np.uint8), (1, 2, 3)))


@eqx.filter_jit
def points_of(space, coordinates):
    return jax.vmap(lambda p: jnp.stack(space.point((p[0], p[1], p[2]))))(coordinates)


@eqx.filter_jit
def coordinates_of(space, points):
    return jax.vmap(lambda p: jnp.stack(space.coordinate((p[0], p[1], p[2]))))(points)


@pytest.mark.parametrize("length", [0.3, 2.0, 12.0])
@pytest.mark.parametrize("kind", PROBES)
def test_nothing_within_a_length_of_a_box_lies_outside_of_its_nodes(kind, length):
    """Found by walking from points in random boxes, in random directions of the world."""
    space, rng, last = space_of(kind), np.random.default_rng(0), np.array(SHAPE) - 1
    for _ in range(20):
        low = rng.uniform(0, last)
        high = np.minimum(low + rng.uniform(0, 12, 3), last)
        nodes = nodes_within(space, SHAPE, low, high, length)
        begin = points_of(space, np.float32(rng.uniform(low, high, (400, 3))))
        toward = rng.normal(size=(400, 3))
        toward *= length * rng.uniform(0, 1, (400, 1)) / np.linalg.norm(toward, axis=-1)[:, None]
        found = np.asarray(coordinates_of(space, np.asarray(begin) + np.float32(toward)))
        inside = np.all((found >= 0) & (found <= last), axis=-1)
        assert np.all(found[inside] >= low - nodes - 1e-2)
        assert np.all(found[inside] <= high + nodes + 1e-2)
        assert np.any(nodes < SHAPE)


def test_nodes_that_lie_nearer_to_the_apex_than_a_box_are_closer_to_each_other():
    """From a node 13.4 mm from the apex, in random directions: 12 mm are an angle of asin(12 / 13.4), and not
    12 / 13.4."""
    space, length, at = space_of("near apex"), 12.0, np.array([20.0, 2.0, 12.0])
    toward = np.random.default_rng(0).normal(size=(50, 400, 3))
    toward *= length / np.linalg.norm(toward, axis=-1)[..., None]
    begin = np.asarray(points_of(space, np.float32(at[None].repeat(400, 0))))
    reached = np.stack([coordinates_of(space, begin + np.float32(way)) for way in toward])[..., 1]
    assert 28 < np.max(reached) - at[1] <= nodes_within(space, SHAPE, at, at, length)[1]


def test_cells_of_curved_rays_are_found_under_64_bits():
    """Traced only: a loop whose state changes its type is an error then."""
    scene = scene_of(source_of(fog()), SHEETS, FROM_THE_SIDE, CURVED, "over", None)

    def cells_of(scene):
        underway = begin_image(scene, RenderOptions("all", Tiling.of_backend()))
        grid, empty = BrickGrid(fog().shape, (24, 16, 16)), jnp.zeros(5, bool).at[4].set(True)
        visit = jnp.asarray(0, jnp.int32), empty.at[0].set(True), empty
        reached = jnp.zeros(underway.rays.length.shape, jnp.int32)
        return _curved(1, grid, 11, scene.march, (underway.rays, underway.at, reached), visit)

    with in_float64():
        found = eqx.filter_eval_shape(cells_of, to_float64(scene))
    assert found.cells.until.dtype == np.int32
    assert found.low.dtype == np.float64


# ---- the paper's overlap ----


def test_the_printed_overlap_is_that_of_the_formula_with_three_changes():
    """The paper does not print the range of depths. With the one that is fitted, `overlap_of` gives 12 rows
    of Table 1 to 0.1 points if K, found in a unit of which the scan is 349 deep, counts as voxels, of which
    it has 1280 (a factor of 3.7 that nothing explains), both planes count from one centre (a = 0), and K is
    that of the near face of each brick. In voxels, the overlap is larger."""
    off = [abs(paper.printed_overlap(split) - row.overlap) for split, row in paper.TABLE.items()]
    assert len(off) == 17
    assert max(off) <= 0.4
    assert np.sum(np.array(off) <= 0.1) == 12
    grid = paper.grid(paper.SHAPE, paper.BEST)
    assert paper.share(overlap_of(paper.probe(), grid), 1280) == pytest.approx(4.22, abs=0.01)
