"""Are bricks seen? Images by bricks are those of the whole volume, whatever the bricks; so are gradients."""

from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.bricks import BrickGrid, VoxelSource, source_of, stream, summary_files
from jaxvol.bricks.sources import ArraySource
from jaxvol.bricks.stream import Stream
from jaxvol.lighting import DirectionalLight, Phong, ScattererTemplates
from jaxvol.occupancy import BLOCK


TRANSFER = jv.TransferFunction.from_points(
    [(60, (0, 0, 0), 0.0), (90, (0.8, 0.7, 0.5), 0.02), (255, (1, 1, 1), 0.9)]
)
SUN = DirectionalLight((0.9, 0.7, 0.6), (9, 9, 9))
PAPER = (jv.EmptySpaceJitter(0), jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination(1 / 255))


ENGINE = "engine_256x256x128_uint8.raw.gz"


@pytest.fixture
def engine(real_volume):
    return jv.Volume(jv.load(real_volume(ENGINE)).data, (1, 0.7, 1.3))


@cache
def balls():
    """Two balls in empty space, 8 bits, of an odd shape."""
    x, y, z = np.meshgrid(*(np.arange(n) for n in (41, 35, 50)), indexing="ij")
    inside = ((x - 9) ** 2 + (y - 9) ** 2 + (z - 9) ** 2 < 49) | (
        (x - 30) ** 2 + (y - 25) ** 2 + (z - 40) ** 2 < 64
    )
    return np.where(inside, 100 + 3 * z, 0).astype(np.uint8)


@cache
def fog():
    """A toroidal volume whose values grow with the depth γ, its probe, and a transfer function under which
    the near part is red and the far part blue, both translucent."""
    shape = 40, 48, 64
    values = np.broadcast_to(np.linspace(20, 250, shape[2]), shape).astype(np.uint8)
    half = np.pi / 2
    probe = jv.ToroidalMap(10.0, 20.0, (half - 0.6, half + 0.6), (half - 0.9, half + 0.9), (0, 60))
    red, blue = (1, 0, 0), (0, 0, 1)
    points = [(0, red, 0.02), (120, red, 0.02), (135, blue, 0.02), (255, blue, 0.02)]
    return jv.Volume(values), probe, jv.TransferFunction.from_points(points)


def slow(*names):
    return [pytest.param(name, marks=pytest.mark.slow) for name in names]


def outside(volume, size=48):
    return jv.Camera((400, 300, 500), volume.center, (0, 1, 0), 30.0, size=(size, size))


SIDE = jv.Camera((300, 10, 55), (0, 0, 55), (0, 0, 1), 25.0, size=(48, 48))


def assert_same(whole, found, tolerance=2e-5):
    np.testing.assert_allclose(found.rgba, whole.rgba, rtol=0, atol=tolerance)
    visible = np.isfinite(np.asarray(whole.depth))
    np.testing.assert_array_equal(np.isfinite(np.asarray(found.depth)), visible)
    np.testing.assert_allclose(
        np.where(visible, found.depth, 0), np.where(visible, whole.depth, 0), rtol=1e-6
    )
    np.testing.assert_array_equal(found.exhausted, whole.exhausted)


@pytest.mark.parametrize("bricks", [(2, 2, 2), pytest.param((3, 1, 4), marks=pytest.mark.slow)])
def test_bricks_of_a_real_volume_look_like_the_whole(engine, bricks):
    volume = engine
    march, camera = jv.March(1.0, PAPER), outside(volume)
    whole = jv.render(volume, TRANSFER, camera, march)
    found = jv.render_bricks(volume, TRANSFER, camera, march, bricks=bricks)
    assert_same(whole, found)
    assert found.bricks.counts == bricks
    assert np.any(np.less(found.bricks.stored, volume.shape))
    assert found.bricks.loads <= found.bricks.needed
    assert found.bricks.reloads == 0
    np.testing.assert_array_equal(found.aligned, whole.aligned)


WAYS = {
    "plain": (jv.March(0.7), {}),
    "jittered": (jv.March(0.7, (jv.Jitter(1), jv.AlphaCorrection())), {}),
    "residual": (jv.March(2.5, (jv.Jitter(0, front_residual=True),), "midpoint"), {}),
    "distance": (jv.March(0.5, (jv.SpaceLeaping("distance"),)), {}),
    "beam": (jv.March(0.5, (jv.SpaceLeaping("beam"), jv.EmptySpaceJitter(2))), {}),
    "pre-integrated": (jv.March(0.5, (jv.SpaceLeaping(),), "preintegrated"), {}),
    "adaptive": (jv.March(0.5, (jv.Jitter(1), jv.AdaptiveSampling(0.01), jv.SpaceLeaping())), {}),
    "clipped": (
        jv.March(0.5, (jv.SpaceLeaping(), jv.Clip(planes=[((128, 90, 80), (0.6, -0.9, -0.5))]))),
        {},
    ),
    "Phong": (jv.March(0.5, (jv.SpaceLeaping(), jv.Jitter(1))), {"lighting": Phong()}),
    "templates": (
        jv.March(0.5, (jv.SpaceLeaping(),)),
        {"lighting": ScattererTemplates(jv.Material(0.5, 1.0, 1.4), SUN)},
    ),
    "maximum": (jv.March(0.5, (jv.SpaceLeaping(),)), {"compositing": "maximum"}),
    "minimum": (jv.March(0.5), {"compositing": "minimum"}),
    "average": (jv.March(0.5), {"compositing": "average"}),
    "isosurface": (
        jv.March(0.5, (jv.SpaceLeaping(),)),
        {"compositing": jv.Isosurface(100), "lighting": Phong()},
    ),
    "gradient": (jv.March(0.5, (jv.SpaceLeaping(),)), {"transfer": "2-D"}),
}


@pytest.mark.parametrize("way", ["residual", *slow(*(way for way in WAYS if way != "residual"))])
def test_every_way_to_render_bricks_looks_like_the_whole(engine, way):
    march, options = WAYS[way]
    options, transfer = dict(options), TRANSFER
    if options.pop("transfer", None):
        transfer = jv.TransferFunction2D.from_transfer(TRANSFER, (0.0, 60.0))
    volume = engine
    camera = outside(volume)
    whole = jv.render(volume, transfer, camera, march, **options)
    found = jv.render_bricks(volume, transfer, camera, march, bricks=(2, 3, 2), **options)
    assert_same(whole, found)
    assert np.all(np.less(found.bricks.stored, volume.shape)[:2])  # or no margin would be seen
    if way == "isosurface":
        np.testing.assert_allclose(found.normal, whole.normal, rtol=0, atol=2e-5)


@pytest.mark.slow
def test_random_splits_and_cameras_look_like_the_whole(engine):
    rng, volume = np.random.default_rng(0), engine
    center = np.asarray(volume.center)
    march = jv.March(0.9, (jv.SpaceLeaping(), jv.EmptySpaceJitter(3)))
    for _ in range(4):
        position = center + rng.normal(size=3) * rng.choice([5, 60, 400])
        camera = jv.Camera(position, center + rng.normal(size=3), (0, 1, 0.1), 60.0, size=(32, 32))
        bricks = tuple(int(n) for n in rng.integers(1, 5, 3))
        whole = jv.render(volume, TRANSFER, camera, march)
        assert_same(whole, jv.render_bricks(volume, TRANSFER, camera, march, bricks=bricks))
    parallel = jv.Camera((400, 300, 500), center, (0, 1, 0), parallel_scale=100.0, size=(32, 32))
    whole = jv.render(volume, TRANSFER, parallel, march)
    assert_same(whole, jv.render_bricks(volume, TRANSFER, parallel, march, bricks=(3, 3, 3)))


@cache
def of_fog(method, bricks, order: Any = "C"):
    volume, probe, transfer = fog()
    march, data = jv.March(1.0, (probe, jv.Jitter(0))), np.asarray(volume.data, order=order)
    return jv.render_bricks(data, transfer, SIDE, march, bricks=bricks, method=method)


@cache
def whole_fog():
    volume, probe, transfer = fog()
    return jv.render(volume, transfer, SIDE, jv.March(1.0, (probe, jv.Jitter(0))))


@pytest.mark.parametrize(("bricks", "order"), [((1, 1, 4), "C"), ((2, 3, 2), "F")])
def test_bricks_of_a_curved_grid_are_read_once_each(bricks, order):
    found = of_fog("overlap", bricks, order)
    assert_same(whole_fog(), found)
    assert found.bricks.loads == found.bricks.needed == np.prod(bricks)
    assert found.bricks.reloads == 0


def test_a_stretch_behind_a_gap_that_is_shorter_than_a_step_is_seen():
    """No sample of equal steps lies in such a stretch; its cell is cut at its two ends."""
    volume, probe, transfer = fog()
    camera = jv.Camera((84, 68, 61), probe.center, (0, 0.3, 1), 40, size=(48, 48))
    march = jv.March(6.0, (probe, jv.AlphaCorrection()))
    whole = jv.render(volume, transfer, camera, march)
    found = jv.render_bricks(volume, transfer, camera, march, bricks=(1, 1, 2))
    assert_same(whole, found)


@pytest.mark.parametrize("bricks", [(1, 1, 4), (2, 3, 2)])
def test_without_overlap_bricks_are_read_again(bricks):
    found = of_fog("reload", bricks)
    assert_same(whole_fog(), found)
    assert bricks != (1, 1, 4) or found.bricks.stored[2] < 64  # or no margin would be seen
    assert found.bricks.loads > found.bricks.needed
    assert found.bricks.reloads == found.bricks.loads - found.bricks.needed


def test_no_more_is_read_at_a_time_than_the_largest_brick_takes(monkeypatch):
    """Each new shape of what is read compiles a program, so that it must not grow from brick to brick."""
    volume, probe, transfer = fog()
    needed, found = [], Stream._box

    def recorded(stream, cells):
        low, high = found(stream, cells)
        if not needed:
            needed.append(stream.stored)  # by the distances between nodes in the middle of the scan
        needed.append(np.minimum(high, np.array(volume.shape) - 1) - np.maximum(low, 0) + 2 * BLOCK - 1)
        return low, high

    monkeypatch.setattr(Stream, "_box", recorded)
    march = jv.March(1.0, (probe,))
    bricks = jv.render_bricks(volume, transfer, SIDE, march, bricks=(4, 3, 2), method="reload").bricks
    assert bricks.loads > 24
    assert np.all(np.array(bricks.stored) <= np.max(needed, axis=0))


def test_the_naive_order_is_visibly_wrong(monkeypatch):
    turns, cells_of = [], stream._cells_of_curved

    def counted(*given):
        turns.append(given)
        return cells_of(*given)

    monkeypatch.setattr(stream, "_cells_of_curved", counted)
    found = of_fog("naive", (1, 1, 4))
    assert found.bricks.loads == 4
    assert len(turns) <= 16  # stretches of rays, not single cells: at most three of a brick, and none
    wrong = np.abs(np.asarray(found.rgba - whole_fog().rgba))[..., :3].max(-1)
    assert wrong.max() > 0.1
    assert np.mean(wrong > 0.02) > 0.01
    # only the order is wrong: what is hidden behind what, not how much is
    np.testing.assert_allclose(found.rgba[..., 3], whole_fog().rgba[..., 3], atol=2e-5)


def test_in_a_straight_grid_the_naive_order_is_right():
    data = balls()
    march, camera = jv.March(0.5, (jv.Jitter(0),)), outside(jv.Volume(data), 24)
    whole = jv.render(jv.Volume(data), TRANSFER, camera, march)
    found = jv.render_bricks(data, TRANSFER, camera, march, bricks=(2, 1, 3), method="naive")
    np.testing.assert_allclose(found.rgba, whole.rgba, atol=2e-5)


class Counting(VoxelSource):
    """A source that counts what is read of it."""

    def __init__(self, data):
        self._of = source_of(data)
        self.reads = []
        for name in ("name", "shape", "dtype", "spacing", "origin", "chunks", "beside"):
            setattr(self, name, getattr(self._of, name))

    def fingerprint(self):
        return None

    def _stored(self, low, high, axes):
        self.reads.append((low, high))
        return self._of._stored(low, high, axes)


def test_only_bricks_that_are_needed_are_read():
    """One ball behind the other, with a brick of nothing between them."""
    x, y, z = np.meshgrid(*(np.arange(n) - 10 for n in (21, 21, 121)), indexing="ij")
    data = np.where(x**2 + y**2 + np.minimum(z**2, (z - 100) ** 2) < 49, 120, 0).astype(np.uint8)
    camera, source = jv.Camera((10, 10, -300), (10, 10, 60), (0, 1, 0), 4.0, size=(24, 24)), Counting(data)
    faint = jv.TransferFunction.from_points([(60, (1, 1, 1), 0.0), (90, (1, 0, 1), 0.02)])
    march = jv.March(0.5, (jv.SpaceLeaping(),))
    whole = jv.render(jv.Volume(data), faint, camera, march)
    found = jv.render_bricks(source, faint, camera, march, bricks=(1, 1, 3))
    assert_same(whole, found)
    assert np.max(whole.rgba[..., 3]) > 0.3  # of both
    assert found.bricks.needed == found.bricks.loads == 2
    read = [tuple(np.subtract(high, low)) for low, high in source.reads[-2:]]
    assert set(read) == {found.bricks.stored}
    assert found.bricks.bytes_read == 2 * np.prod(found.bricks.stored)
    # nothing is read where nobody looks
    away = jv.Camera((400, 300, 500), (800, 600, 1000), (0, 1, 0), 30.0, size=(24, 24))
    assert jv.render_bricks(data, faint, away, march, bricks=(1, 1, 3)).bricks.loads == 0


def test_an_empty_volume_is_never_read():
    empty = np.zeros((40, 40, 40), np.uint8)
    found = jv.render_bricks(
        empty, TRANSFER, outside(jv.Volume(empty), 24), jv.March(0.5, (jv.SpaceLeaping(),)), bricks=(2, 2, 2)
    )
    assert found.bricks.needed == found.bricks.loads == 0
    np.testing.assert_array_equal(found.rgba, 0)
    assert np.all(np.isinf(found.depth))


def pulled(volume, render, parameters, size):
    weights = jax.random.normal(jax.random.key(0), (size, size, 4))

    @eqx.filter_grad
    def gradient(parameters):
        rendering = render(*parameters)
        seen = jnp.where(jnp.isfinite(rendering.depth), rendering.depth, 0)
        return jnp.sum(weights * rendering.rgba) + 1e-2 * jnp.sum(weights[..., 0] * seen)

    return gradient(parameters)


@pytest.mark.parametrize(
    ("transforms", "lighting"),
    [
        ((jv.AlphaCorrection(),), None),
        pytest.param((jv.SpaceLeaping(), jv.EmptySpaceJitter(1)), Phong(), marks=pytest.mark.slow),
    ],
)
def test_gradients_through_bricks_are_those_of_the_whole(transforms, lighting):
    data, size = balls(), 24
    transfer = TRANSFER
    if lighting is not None:  # a leap counts as empty what has no extinction
        least = jnp.maximum(TRANSFER.extinction, 1e-3)
        transfer = jv.TransferFunction(TRANSFER.values, TRANSFER.colors, least)
    volume, march = jv.Volume(data, (1, 1.5, 0.8)), jv.March(0.5, transforms)
    parameters = transfer, outside(volume, size), march, lighting, volume.spacing

    def whole(transfer, camera, march, lighting, spacing):
        return jv.render(jv.Volume(data, spacing), transfer, camera, march, lighting=lighting)

    def bricks(transfer, camera, march, lighting, spacing):
        return jv.render_bricks(
            data, transfer, camera, march, spacing=spacing, lighting=lighting, bricks=(2, 2, 3)
        )

    expected, found = (pulled(volume, f, parameters, size) for f in (whole, bricks))
    leaves = jax.tree.leaves(expected)
    assert len(leaves) > 5
    for a, b in zip(leaves, jax.tree.leaves(found), strict=True):
        assert np.linalg.norm(a - b) <= 1e-5 * max(np.linalg.norm(a), 1e-3)


def test_the_second_march_of_a_gradient_has_the_ranges_of_the_first(monkeypatch):
    data, size, passes = balls(), 16, []
    camera, march = outside(jv.Volume(data), size), jv.March(1.0, (jv.SpaceLeaping(),))
    scan = summary_files.scan

    def counted(*given, **more):
        passes.append(given)
        return scan(*given, **more)

    monkeypatch.setattr(summary_files, "scan", counted)

    def loss(extinction):
        transfer = jv.TransferFunction(TRANSFER.values, TRANSFER.colors, extinction)
        return jnp.sum(jv.render_bricks(data, transfer, camera, march, bricks=(2, 1, 2)).rgba[..., 3])

    assert np.any(jax.grad(loss)(jnp.asarray([0.0, 0.02, 0.5])))
    assert len(passes) == 1


def test_the_gradient_by_an_extinction_agrees_with_differences():
    data, size = balls(), 16
    camera, march = outside(jv.Volume(data), size), jv.March(1.0, (jv.SpaceLeaping(),))

    def loss(extinction):
        transfer = jv.TransferFunction(TRANSFER.values, TRANSFER.colors, extinction)
        return jnp.sum(jv.render_bricks(data, transfer, camera, march, bricks=(2, 1, 2)).rgba[..., 3])

    at = jnp.asarray([0.0, 0.02, 0.5])
    gradient, step = jax.grad(loss)(at), 1e-3
    for i in (1, 2):
        rise = (loss(at.at[i].add(step)) - loss(at.at[i].add(-step))) / (2 * step)
        np.testing.assert_allclose(gradient[i], rise, rtol=2e-3)


def test_a_file_is_rendered_within_its_budget(tmp_path):
    data = balls()
    path = tmp_path / "balls_41x35x50_uint8.raw"
    path.write_bytes(data.tobytes(order="F"))
    march, camera = jv.March(0.5, (jv.SpaceLeaping(),)), outside(jv.Volume(data), 24)
    steps = []
    found = jv.render_bricks(
        path, TRANSFER, camera, march, memory=150_000, progress=lambda done, of: steps.append((done, of))
    )
    assert_same(jv.render(jv.Volume(data), TRANSFER, camera, march), found)
    assert found.bricks.bytes_held <= 150_000
    assert np.prod(found.bricks.counts) > 1
    assert np.any(np.less(found.bricks.stored, data.shape))
    assert steps == [(done + 1, found.bricks.needed) for done in range(found.bricks.loads)]
    [kept] = tmp_path.glob("*.npz")
    before = kept.stat().st_mtime_ns
    jv.render_bricks(path, TRANSFER, camera, march, memory=200_000)
    assert kept.stat().st_mtime_ns == before  # the pass over all voxels is not repeated


def test_an_interrupted_image_damages_nothing(tmp_path):
    path = tmp_path / "balls_41x35x50_uint8.raw"
    path.write_bytes(balls().tobytes(order="F"))
    march, camera = jv.March(0.5, (jv.SpaceLeaping(),)), outside(jv.Volume(balls()), 24)

    def stop(done, of):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        jv.render_bricks(path, TRANSFER, camera, march, bricks=(2, 2, 3), progress=stop)
    assert path.read_bytes() == balls().tobytes(order="F")
    assert {file.suffix for file in tmp_path.iterdir()} == {".raw", ".npz"}
    assert jv.render_bricks(path, TRANSFER, camera, march, bricks=(2, 2, 3)).bricks.loads > 0


LABELLED = jv.LabelTransferFunction({1: TRANSFER})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"memory": 1000}, "memory must be at least .* got 1000"),
        ({"memory": -1}, "memory must be an integer of at least 1; got -1"),
        ({"bricks": (2, 2)}, "bricks must be three numbers"),
        ({"bricks": (0, 1, 1)}, r"bricks must be three numbers .*, each .* at least 1.*; got \(0, 1, 1\)"),
        ({"bricks": (2, 1.5, 2)}, "bricks must be three numbers .* got .*1.5"),
        (
            {"bricks": (1000, 1000, 1000)},
            r"bricks must be no more than 65536 .* got .*1000, 1000\), .* 41 x 35 x 50 voxels into 66640",
        ),
        ({"method": np.array(["overlap", "reload"])}, "method must be one of overlap, reload, naive"),
        ({"tolerance": "x"}, "tolerance must be"),
        ({"tolerance": -5.0, "level": 0}, "tolerance must be"),
        ({"method": "fast"}, "method must be one of overlap, reload, naive; got 'fast'"),
        ({"outputs": "depth"}, "outputs must be one of all, rgba"),
        ({"source": "no_such.raw"}, "no_such.raw"),
        ({"source": None}, "source must be an array, a Volume, .* got None"),
        ({"source": {}}, "source must be an array, a Volume, "),
        ({"cache": ""}, "cache must be .* got ''"),
        ({"cache": __file__}, "cache must be .* is a file"),
        ({"transfer": 3}, "transfer must be a transfer function"),
        ({"transfer": LABELLED}, "bricks have no labels"),
        ({"march": jv.March(1.0, (jv.SpaceLeaping("min_distance"),))}, "min_distance"),
        ({"lighting": ScattererTemplates(jv.Material(0.5, 1.0, 1.4), SUN, baked=True)}, "farthest_read"),
        ({"compositing": "over!"}, "compositing must be one of"),
        ({"level": 1}, 'level must be an integer from 0 to 0, or "auto"; got 1'),
        ({"progress": 5}, "progress must be a function"),
        ({"own": "bricks"}, "devices="),
    ],
)
def test_bad_arguments_are_named(changes, message):
    given = {"source": balls(), "transfer": TRANSFER, "march": jv.March(1.0)} | changes
    with pytest.raises((ValueError, OSError), match=message):
        jv.render_bricks(
            given.pop("source"),
            given.pop("transfer"),
            outside(jv.Volume(balls()), 16),
            given.pop("march"),
            **given,
        )


class Unread(ArraySource):
    def read(self, *args, **kwargs):
        raise AssertionError("read")


def test_bricks_that_are_too_large_with_their_overlap_are_named_before_anything_is_read():
    """Two bricks of a scan, of which the one is read beyond its curved face: by 300 million voxels."""
    data, probe = np.broadcast_to(np.uint8(0), (1200, 1200, 2400)), fog()[1]
    given = Unread(data), fog()[2], SIDE, jv.March(0.05, (probe,))
    with pytest.raises(
        ValueError, match=r"fewer than 2\*\*31 voxels; got 1200 x 1200 x \d+ along x, y and z"
    ):
        jv.render_bricks(*given, bricks=(1, 1, 2))


def test_too_little_memory_is_named_before_anything_is_read():
    camera = outside(jv.Volume(balls()), 16)
    with pytest.raises(ValueError, match="memory must be at least"):
        jv.render_bricks(Unread(balls()), TRANSFER, camera, jv.March(1.0), memory=1000)


def test_under_jit_it_says_what_to_do():
    data, camera = balls(), outside(jv.Volume(balls()), 16)

    def image(extinction):
        transfer = jv.TransferFunction(TRANSFER.values, TRANSFER.colors, extinction)
        return jv.render_bricks(data, transfer, camera, jv.March(1.0)).rgba

    with pytest.raises(ValueError, match=r"not inside jax\.jit"):
        jax.jit(image)(TRANSFER.extinction)
    with pytest.raises(ValueError, match=r"not inside jax\.jit, jax\.vmap"):
        jax.vmap(image)(TRANSFER.extinction[None])
    found, pull = jax.vjp(image, TRANSFER.extinction)
    for pulled in (lambda: jax.jit(pull)(found), lambda: jax.vmap(pull)(found[None])):
        with pytest.raises(ValueError, match="the gradient by bricks reads its source"):
            pulled()


def test_forward_mode_and_second_order_say_what_to_do():
    data, camera = balls(), outside(jv.Volume(balls()), 16)

    def brightness(extinction):
        transfer = jv.TransferFunction(TRANSFER.values, TRANSFER.colors, extinction)
        return jnp.sum(jv.render_bricks(data, transfer, camera, jv.March(1.0)).rgba)

    at = TRANSFER.extinction
    for given in (
        lambda: jax.jvp(brightness, (at,), (at,)),
        lambda: jax.jacfwd(brightness)(at),
        lambda: jax.hessian(brightness)(at),
    ):
        with pytest.raises(ValueError, match=r"gradients in reverse mode.*none in forward mode \(jax\.jvp"):
            given()


def test_a_gradient_to_the_source_says_what_to_do():
    data, camera = balls().astype(np.float32), outside(jv.Volume(balls()), 16)

    def image(source):
        return jnp.sum(jv.render_bricks(source, TRANSFER, camera, jv.March(1.0)).rgba)

    for given in (image, lambda data: image(jv.Volume(data))):
        with pytest.raises(ValueError, match=r"source must not be traced.*no gradients to voxels"):
            jax.grad(given)(jnp.asarray(data))
    with pytest.raises(ValueError, match=r"source must not be traced.*gradients to spacing"):
        jax.grad(lambda spacing: image(jv.Volume(data, spacing)))(jnp.ones(3))


def test_bricks_are_numbered_along_the_axes():
    grid = BrickGrid((9, 17, 5), (4, 8, 3))
    assert grid.counts == (2, 2, 2)
    assert grid.cells(7) == ((4, 8, 3), (8, 16, 4))
    x, y, z = (jnp.asarray(c) for c in ([0.0, 4.0, 8.0, -1], [7.9, 8.0, 16.0, 99], [2.9, 3.0, 4.0, 0]))
    assert grid.brick_of((x, y, z)).tolist() == [0, 7, 7, 2]


DIRECTIONS = [(-1, 0, -1), (0.3, 0, 0.95), (-0.3, 0, -0.95), (0.2, -0.7, 0.4), (1e-3, 1, -1e-3), (0, 0, 1)]


@pytest.mark.parametrize("parallel", [True, False])
@pytest.mark.parametrize("distance", [0.4, 100.0, 3e7])
@pytest.mark.parametrize("spacing", [1e-6, 1.0, 1e7])
def test_no_ray_meets_a_brick_after_one_that_is_behind_it(spacing, distance, parallel):
    """`distance` of the eye from the middle, in voxels. Rays of a parallel camera all run along its axis; of
    the others, one to each corner of a brick is followed by its brick at 400 points."""
    volume = jv.Volume(np.zeros((33, 33, 33), np.uint8), (spacing, spacing, 2 * spacing))
    grid, space = BrickGrid(volume.shape, (16, 11, 20)), jv.March(1.0).locate(volume)
    middle = np.asarray(volume.center, float)
    for direction in DIRECTIONS:
        forward = np.asarray(direction) / np.linalg.norm(direction)
        eye = middle - distance * spacing * forward
        scale = {"parallel_scale": 20.0 * spacing} if parallel else {}
        camera = jv.Camera(eye, middle, (0.1, 1, 0.2), size=(8, 8), **scale)
        place = np.argsort(grid.order(space, camera))
        assert sorted(place) == list(range(grid.number))
        nodes = np.stack(np.meshgrid(*np.linspace(0.5, 31.5, 4)[None].repeat(3, 0)), -1).reshape(-1, 3)
        if parallel:
            toward = np.broadcast_to(forward / (1, 1, 2), nodes.shape)
        else:
            toward = nodes - eye / (spacing, spacing, 2 * spacing)
        along = np.linspace(-40, 40, 400)[:, None, None] * toward / np.linalg.norm(toward, axis=-1)[:, None]
        points = nodes + along
        ahead = np.sum((points - eye / (spacing, spacing, 2 * spacing)) * toward, -1) > 0
        inside = np.all((points > 0) & (points < 32), -1) & (ahead | parallel)
        x, y, z = jnp.moveaxis(jnp.asarray(points), -1, 0)
        bricks = np.asarray(grid.brick_of((x, y, z)))
        for ray in range(len(nodes)):
            met = place[bricks[inside[:, ray], ray]]
            assert np.all(np.diff(met) >= 0)
