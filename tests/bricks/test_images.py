"""Are bricks seen? Images by bricks are those of the whole volume, and so are gradients; little is read."""

import inspect
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from experiments.bricks_once import EachOnce
from jaxvol.bricks import BrickGrid, VoxelSource, overlap_of
from jaxvol.lighting import DirectionalLight, Phong, ScattererTemplates

from .scenes import (
    CAMERA,
    CURVED,
    FROM_THE_SIDE,
    LEAPING,
    PLACE,
    PLAIN,
    SHAPE,
    SHEETS,
    TRANSFER,
    WIDE,
    assert_same,
    balls,
    fog,
    raw_file,
    whole,
    whole_fog,
)


MEMORY = 75_000
"""Bytes in which twelve bricks of the balls are rendered, read as two thirds of an axis."""


# ---- straight rays ----


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return raw_file(tmp_path_factory.mktemp("balls"))


def rendered(file, camera=CAMERA, transfer=TRANSFER, **options):
    return jv.render_bricks(file, transfer, camera, LEAPING, **PLACE, **({"memory": MEMORY} | options))


@pytest.fixture(scope="module")
def image(file):
    """The image of a file, and what was told of its progress."""
    told = []
    return rendered(file, progress=lambda *numbers: told.append(numbers)), told


def test_bricks_of_a_file_look_like_the_whole_within_the_budget_of_memory(image):
    found, told = image
    assert_same(found, whole(), fields=("exhausted", "aligned"))
    bricks = found.bricks
    assert bricks.bytes_held <= MEMORY < 2.5 * balls().nbytes
    assert np.all(np.less(bricks.stored, SHAPE) | np.equal(bricks.counts, 1))
    assert 4 < bricks.loads <= bricks.needed < math.prod(bricks.counts)
    assert bricks.bytes_read == bricks.loads * math.prod(bricks.stored)
    assert bricks.reloads == 0
    assert told == [(done + 1, bricks.needed) for done in range(bricks.loads)]


def test_an_interrupted_image_may_be_begun_anew(image, file):
    def stop(done, of):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rendered(file, progress=stop)
    np.testing.assert_array_equal(rendered(file).rgba, image[0].rgba)


def test_what_nobody_sees_is_not_read(image, file):
    counts = image[0].bricks.counts
    through = eqx.tree_at(
        lambda c: (c.position, c.focal_point, c.view_angle),
        CAMERA,
        jax.device_put((np.float32([50, 7, 96.5]), np.float32([12, 5.7, 23.2]), np.float32(4))),
    )
    opaque = rendered(file, through, bricks=counts)
    thin = jax.device_put(np.asarray(TRANSFER.extinction) / 1000)
    clear = eqx.tree_at(lambda t: t.extinction, TRANSFER, thin)
    assert np.asarray(opaque.rgba)[..., 3].min() > 0.99  # the nearer ball hides the other one
    assert opaque.bricks.loads < rendered(file, through, clear, bricks=counts).bricks.loads
    away = eqx.tree_at(lambda c: c.focal_point, CAMERA, jax.device_put(np.float32([400, 200, 400])))
    assert rendered(file, away, bricks=counts).bricks.loads == 0
    empty = rendered(np.zeros(SHAPE, np.uint8, order="F"), bricks=counts)
    assert empty.bricks.needed == empty.bricks.loads == 0
    assert not np.asarray(empty.rgba).any()
    assert np.all(np.isinf(empty.depth))


def test_what_is_traced_is_refused():
    def image(extinction):
        transfer = jv.TransferFunction(TRANSFER.values, TRANSFER.colors, extinction)
        return jnp.sum(jv.render_bricks(ARRAY, transfer, WIDE, PLAIN).rgba)

    at = TRANSFER.extinction
    for traced in (lambda: jax.grad(image)(at), lambda: jax.jit(image)(at)):
        with pytest.raises(ValueError, match=r"not inside jax\.jit.*Gradients are those of jv\.render"):
            traced()
    with pytest.raises(ValueError, match=r"source must not be traced: bricks have no gradients"):
        jax.grad(lambda data: jv.render_bricks(data, TRANSFER, WIDE, PLAIN).rgba.sum())(
            jax.device_put(balls().astype(np.float32))
        )


# ---- curved rays ----


@pytest.mark.parametrize("method", ["overlap", "reload"])
def test_bricks_look_like_the_whole_where_rays_leave_them_and_come_back(method):
    found = jv.render_bricks(fog(), SHEETS, FROM_THE_SIDE, CURVED, bricks=(1, 1, 4), method=method)
    assert_same(found, whole_fog())
    bricks = found.bricks
    assert bricks.stored[2] < 64
    assert bricks.reloads == bricks.loads - bricks.needed
    assert (bricks.reloads == 0) == (method == "overlap")


# ---- arguments ----

ARRAY = np.ascontiguousarray(balls())
BAD: list[tuple[dict[str, Any], str]] = [
    ({"memory": 1000}, "memory must be at least .* got 1000"),
    ({"memory": "512M"}, "memory must be an integer of at least 1, a number of bytes; got '512M'"),
    ({"bricks": (2, 1.5, 2)}, "bricks must be three numbers, .* got .*1.5"),
    (
        {"bricks": (1000, 1000, 1000), "source": np.broadcast_to(np.uint8(0), (41, 42, 43))},
        r"bricks must be no more than 65536 in all; got \(1000, 1000, 1000\), 68880",
    ),
    ({"method": "fast"}, "method must be one of overlap, reload; got 'fast'"),
    ({"level": 1}, 'level must be an integer from 0 to 0, or "auto"; got 1'),
    ({"outputs": "depth"}, "outputs must be one of all, rgba"),
    ({"source": "no_such.raw"}, "no_such.raw"),
    ({"source": None}, "source must be an array, a Volume, .* got None"),
    ({"transfer": 3}, "transfer must be a transfer function"),
    ({"transfer": jv.LabelTransferFunction({1: TRANSFER})}, "bricks have no labels"),
    ({"march": jv.March(1.0, (jv.SpaceLeaping("min_distance"),))}, "min_distance"),
    ({"march": jv.March(1.0, (jv.SpaceLeaping("distance", block=1),))}, "block=1. needs the whole volume"),
    (
        {
            "lighting": ScattererTemplates(
                jv.Material(0.5, 1.0, 1.4), DirectionalLight((1, 0, 0)), form="transport"
            )
        },
        "farthest_read",
    ),
    ({"compositing": "over!"}, "compositing must be one of"),
    ({"progress": 5}, "progress must be a function"),
]


class Unread(VoxelSource):
    def _read_at_once(self, box, axes):
        raise AssertionError("read")


@pytest.mark.parametrize(("changes", "message"), BAD)
def test_bad_arguments_are_named_before_anything_is_read(changes, message):
    given = {"source": ARRAY, "transfer": TRANSFER, "camera": CAMERA, "march": PLAIN} | changes
    if given["source"] is ARRAY:
        given["source"] = Unread(ARRAY)
    with pytest.raises((ValueError, OSError), match=message):
        inspect.unwrap(jv.render_bricks)(**given)  # without the types' checks
    with pytest.raises(TypeError, match="beside"):
        jv.render_bricks(ARRAY, TRANSFER, CAMERA, PLAIN, beside=3)


# ---- what users run ----


@pytest.fixture
def engine(real_volume):
    return jv.Volume(jv.load(real_volume("engine_256x256x128_uint8.raw.gz")).data, (1, 0.7, 1.3))


SUN = DirectionalLight((0.9, 0.7, 0.6), (9, 9, 9))
OBLIQUE = ((128, 90, 80), (0.6, -0.9, -0.5))
WAYS: dict[str, tuple[jv.March, dict[str, Any]]] = {
    "as in the paper": (
        jv.March(
            1.0,
            (jv.EmptySpaceJitter(0), jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination(1 / 255)),
        ),
        {},
    ),
    "residual, clipped": (
        jv.March(2.5, (jv.Jitter(0, front_residual=True), jv.Clip(planes=[OBLIQUE])), "midpoint"),
        {},
    ),
    "jittered, by beams": (
        jv.March(0.5, (jv.Jitter(1), jv.SpaceLeaping("beam")), "preintegrated"),
        {},
    ),
    "templates": (
        jv.March(0.5, (jv.SpaceLeaping("distance"),)),
        {"lighting": ScattererTemplates(jv.Material(0.5, 1.0, 1.4), SUN, templates=1, photons=4)},
    ),
    "isosurface": (
        jv.March(0.5, (jv.SpaceLeaping(),)),
        {"compositing": jv.Isosurface(100), "lighting": Phong()},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_bricks_of_a_real_volume_look_like_the_whole_in_every_way(engine, way):
    march, options = WAYS[way]
    options = {"transfer": TRANSFER} | options
    camera = jv.Camera((400, 300, 500), engine.center, (0, 1, 0), 30.0, size=(48, 48))
    if way == "jittered, by beams":
        camera = jv.Camera((133, 80, 90), engine.center, (0, 1, 0.1), 60.0, size=(48, 48))  # from within
    elif way == "residual, clipped":
        camera = jv.Camera((400, 300, 500), engine.center, (0, 1, 0), parallel_scale=100.0, size=(48, 48))
    one = jv.render(engine, camera=camera, march=march, **options)
    # kept in memory in another order than the whole
    data = np.asarray(engine.data).transpose(1, 2, 0).copy().transpose(2, 0, 1)
    found = jv.render_bricks(
        data, camera=camera, march=march, spacing=engine.spacing, bricks=(2, 3, 2), **options
    )
    assert_same(found, one)
    assert np.all(np.less(found.bricks.stored, engine.shape)[:2])  # or no margin would be seen
    if way == "isosurface":
        np.testing.assert_allclose(found.normal, one.normal, rtol=0, atol=2e-5)


HALF = math.pi / 2
SCAN = (40, 48, 64)


def probe_fog(a, b):
    """A toroidal volume, red near the probe and blue behind, and its probe. At a small one's apex, nodes lie
    densely."""
    probe = jv.ToroidalMap(a, b, (HALF - 0.6, HALF + 0.6), (HALF - 0.9, HALF + 0.9), (0, 60))
    points = [
        (v, color, 0.02)
        for v, color in ((0, (1, 0, 0)), (120, (1, 0, 0)), (135, (0, 0, 1)), (255, (0, 0, 1)))
    ]
    return (
        np.broadcast_to(np.linspace(20, 250, 64), SCAN).astype(np.uint8),
        jv.TransferFunction.from_points(points),
        probe,
    )


@pytest.mark.slow
def test_a_toroidal_volume_is_rendered_within_its_memory():
    """Where a step covers many more nodes at the apex than in the middle."""
    data, transfer, probe = probe_fog(1.0, 2.0)
    camera = jv.Camera((300, 10, 55), (0, 0, 55), (0, 0, 1), 25.0, size=(24, 24))
    march, memory = jv.March(0.5, (probe, jv.Jitter(0))), 254_000
    one = jv.render(jv.Volume(data), transfer, camera, march)
    for method in ("overlap", "reload"):
        found = jv.render_bricks(data, transfer, camera, march, memory=memory, method=method)
        assert_same(found, one)
        assert np.prod(found.bricks.counts) > 1
        assert found.bricks.bytes_held <= memory
        assert np.any(np.less(found.bricks.stored, SCAN))
    with pytest.raises(ValueError, match=r"memory must be at least \d+ bytes.*got 150000"):
        jv.render_bricks(data, transfer, camera, jv.March(1.0, (probe,)), memory=150_000)


@pytest.mark.slow
def test_bricks_read_once_miss_rays_that_come_back_fewer_with_overlap():
    """As published. Without overlap a ray is complete if it meets bricks in the order of their centres."""
    data, transfer, probe = probe_fog(10.0, 20.0)
    camera = jv.Camera((300, 10, 55), (0, 0, 55), (0, 0, 1), 25.0, size=(24, 24))
    march, grid = jv.March(0.5, (probe,)), BrickGrid(SCAN, (39, 47, 16))
    one = jv.render(jv.Volume(data), transfer, camera, march, outputs="rgba")

    def image(extension):
        method = EachOnce(extension)
        found = jv.render_bricks(
            data, transfer, camera, march, bricks=(1, 1, 4), method=method, outputs="rgba"
        )
        return method.incomplete, float(np.mean(np.abs(found.rgba - one.rgba).max(-1) > 1 / 255))

    origin, direction = (np.asarray(part).reshape(-1, 1, 3) for part in camera.rays())
    points = probe.to_toroidal(origin + np.linspace(200, 400, 4001)[:, None] * direction)
    ranges = np.array([probe.beta_range, probe.sigma_range, probe.gamma_range])
    part = (np.asarray(points) - ranges[:, 0]) / np.ptp(ranges, axis=1)
    inside = np.all((part >= 0) & (part <= 1), axis=-1)
    middles = ranges.mean(1) + np.outer((np.arange(4) + 0.5) * 16 / 63 - 0.5, [0, 0, np.ptp(ranges[2])])
    distances = np.linalg.norm(np.asarray(probe.to_world(middles)) - (300, 10, 55), axis=-1)
    rank = np.argsort(np.argsort(distances))[np.clip(part[..., 2] * 63 // 16, 0, 3).astype(int)]
    paths = [ranks[within] for ranks, within in zip(rank, inside, strict=True) if within.any()]
    expected = np.mean([np.any(np.diff(path) < 0) for path in paths])
    incomplete, wrong = image([0.0] * 3)
    assert expected > 0.1
    assert incomplete == pytest.approx(expected, abs=3 / len(paths))
    assert wrong > 0.05
    with_overlap = image(overlap_of(probe, grid))
    assert with_overlap[0] < incomplete / 2
    assert with_overlap[1] < wrong / 2


@pytest.mark.slow
def test_a_stretch_behind_a_gap_that_is_shorter_than_a_step_is_seen():
    """No sample of equal steps lies in such a stretch; its cell is cut at its two ends."""
    data, transfer, probe = probe_fog(10.0, 20.0)
    camera = jv.Camera((84, 68, 61), probe.center, (0, 0.3, 1), 40, size=(24, 24))
    march = jv.March(6.0, (probe, jv.AlphaCorrection()))
    one = jv.render(jv.Volume(data), transfer, camera, march)
    assert_same(jv.render_bricks(data, transfer, camera, march, bricks=(1, 1, 2)), one)
