"""Do speed-ups change the image? Leaping over empty space, tile sizes and packed voxels must not."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol._util.voxel_fetch import Packed
from jaxvol.engine import packing
from jaxvol.engine.driver import render_scene
from jaxvol.engine.scene import Scene
from jaxvol.engine.tiling import Tiling
from jaxvol.phantoms import toroidal_phantom

from ..scenes import (
    CAMERAS,
    QUADRATURES,
    around,
    counting,
    in_float64,
    inside,
    orthographic,
    scaled_phantom,
    slow,
    to_float64,
)


SHAPE = (24, 20, 28)
SPACING = (0.05, 0.06, 0.04)
SIZE = (20, 16)
METHODS = ["hierarchy", "distance", "beam"]
SLOWLY = slow(*METHODS[1:])

PLAIN = ()
MOVING = (jv.EmptySpaceJitter(4), jv.AlphaCorrection(), jv.EarlyTermination(0.05))
RESIDUAL = (jv.Jitter(3, "blue", front_residual=True), jv.AlphaCorrection())
JITTERED = (jv.Jitter(3), jv.EmptySpaceJitter(4), jv.EarlyTermination(0.05))
SETS = {"plain": PLAIN, "moving": MOVING, "residual": RESIDUAL, "jittered": JITTERED}

Counting = counting()


def leaping(transforms, method, cell=4):
    return transforms if method is None else (*transforms, jv.SpaceLeaping(method, cell))


def assert_same(leapt, whole, tolerance=1e-6, fewer=True):
    """Assert the same image, from at most as many samples."""
    np.testing.assert_allclose(leapt.rgba, whole.rgba, atol=tolerance, rtol=0)
    np.testing.assert_allclose(leapt.depth, whole.depth, rtol=1e-5)
    np.testing.assert_array_equal(leapt.aligned, whole.aligned)
    np.testing.assert_array_equal(leapt.exhausted, whole.exhausted)
    assert not fewer or np.all(np.asarray(leapt.samples) <= np.asarray(whole.samples))


# ---- scenes of different contents and equal shapes ----


def places(shape=SHAPE):
    return np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1).astype(float)


def contents(kind, seed, shape=SHAPE):
    """Values in [0, 1]."""
    rng = np.random.default_rng(seed)
    if kind == "noise":
        return rng.random(shape)
    if kind == "sparse":
        return rng.random(shape) * (rng.random(shape) < 0.002)
    if kind == "half":
        return rng.random(shape) * (places(shape)[..., seed % 3] > 11)
    blobs = np.zeros(shape)
    for _ in range(rng.integers(1, 4)):
        away = np.linalg.norm(places(shape) - rng.random(3) * shape, axis=-1)
        blobs = np.maximum(blobs, np.clip(1.2 - away / rng.uniform(2, 9), 0, 1))
    return blobs


def bytes_of(values):
    return np.round(255 * np.asarray(values)).astype(np.uint8)


def table(seed, top):
    """Eight control points, some runs of them transparent, and none at a likely voxel value."""
    rng = np.random.default_rng(seed)
    values = np.sort(rng.choice(254, 8, replace=False)) + 0.37
    extinction = rng.uniform(0.2, 6, 8) * (rng.random(8) < rng.choice([0.2, 0.5, 1]))
    extinction[0] *= rng.integers(2)
    return Counting(values * (top / 255), rng.random((8, 3)), extinction)


def far(volume, size):
    """A camera at 300 times the volume's diagonal."""
    low, high = volume.corners
    position = volume.center + 300 * jnp.linalg.norm(high - low) * jnp.asarray([0.48, -0.6, 0.64])
    return jv.Camera(position, volume.center, (0, 0, 1), 0.15, size=size)


PERSPECTIVE = {"around": around, "inside": inside, "far": far}


def drawn_camera(view, volume, seed):
    """A view, zoomed at random, so that beams differ in size."""
    rng = np.random.default_rng(seed)
    return view(volume, SIZE).zoom(rng.uniform(0.7, 5), tuple(rng.uniform(0.3, 0.7, 2)))


KINDS = st.sampled_from(["noise", "sparse", "half", "blobs"])
SEEDS = st.integers(0, 10**6)
EVERY = {"max_examples": 25, "deadline": None, "derandomize": True}


def compare_methods(volume, transfer, camera, step, transforms, methods, quadrature="left"):
    whole = jv.render(volume, transfer, camera, jv.March(step, transforms, quadrature))
    for method in methods:
        march = jv.March(step, leaping(transforms, method), quadrature)
        assert_same(jv.render(volume, transfer, camera, march), whole)
    return whole


# ---- invariant 2 ----


@pytest.mark.parametrize("method", ["hierarchy", *SLOWLY])
def test_leaping_does_not_show(method):
    @settings(**EVERY)
    @given(kind=KINDS, seed=SEEDS, view=st.sampled_from(list(PERSPECTIVE)), step=st.floats(0.01, 0.3))
    def check(kind, seed, view, step):
        volume = jv.Volume(bytes_of(contents(kind, seed)), SPACING, origin=(0.3, -0.2, 0.1))
        camera = drawn_camera(PERSPECTIVE[view], volume, seed)
        compare_methods(volume, table(seed, 255), camera, step, MOVING, [method])

    check()


@pytest.mark.slow
@settings(**EVERY)
@given(kind=KINDS, seed=SEEDS, step=st.floats(0.01, 0.3))
def test_leaping_does_not_show_in_parallel_views_of_floats(kind, seed, step):
    volume = jv.Volume(contents(kind, seed).astype(np.float32), SPACING)
    camera = drawn_camera(orthographic, volume, seed)
    compare_methods(volume, table(seed, 1.0), camera, step, PLAIN, ["hierarchy"])


@pytest.mark.slow
@pytest.mark.parametrize("quadrature", QUADRATURES)
@pytest.mark.parametrize("transforms", SETS)
@pytest.mark.parametrize("view", CAMERAS)
def test_leaping_does_not_show_whatever_the_transforms(view, transforms, quadrature):
    @settings(**EVERY)
    @given(kind=KINDS, seed=SEEDS, step=st.floats(0.01, 0.3))
    def check(kind, seed, step):
        volume = jv.Volume(bytes_of(contents(kind, seed)), SPACING)
        camera = drawn_camera(CAMERAS[view], volume, seed)
        compare_methods(volume, table(seed, 255), camera, step, SETS[transforms], METHODS, quadrature)

    check()


@pytest.mark.parametrize("method", ["hierarchy", *SLOWLY])
def test_leaping_takes_fewer_samples(method):
    volume = jv.Volume(bytes_of(contents("blobs", 3)), SPACING)
    camera, step = around(volume, SIZE).zoom(2), 0.01
    transfer = Counting(np.arange(8) * 30 + 0.5, np.ones((8, 3)), [0, 0, 0, 0, 1, 2, 3, 4])
    whole = compare_methods(volume, transfer, camera, step, MOVING, [method])
    leapt = jv.render(volume, transfer, camera, jv.March(step, leaping(MOVING, method)))
    assert np.asarray(leapt.samples).sum() < 0.85 * np.asarray(whole.samples).sum()


@pytest.mark.parametrize("method", ["hierarchy", *SLOWLY])
@pytest.mark.parametrize("name", ["sphere", "head"])
def test_the_jitter_happens_at_the_same_sample(name, method):
    """A head has air in front, inside and behind; the first transparent sample is mostly in front."""
    data = np.asarray(jv.phantom(name, 28).data)[2:26, 4:24].astype(float)
    volume = jv.Volume(bytes_of((data - data.min()) / np.ptp(data)), SPACING)
    transfer = Counting(np.arange(8) * 35 + 0.5, np.ones((8, 3)), [0, 0, 1, 2, 2, 4, 5, 9])
    for seed in range(3):
        transforms = (jv.EmptySpaceJitter(seed), *MOVING[1:])
        for view in PERSPECTIVE.values():
            for step in (0.013, 0.07):
                whole = compare_methods(volume, transfer, view(volume, SIZE), step, transforms, [method])
                assert float(whole.rgba[..., 3].max()) > 0.5


@pytest.mark.parametrize("method", ["hierarchy", *SLOWLY])
def test_the_jitter_happens_at_the_same_sample_where_air_lies_beyond_the_last_point(method):
    """Beyond the last point, the extinction must be exactly 0: a rounded one would not be transparent."""
    volume = jv.Volume(bytes_of(1 - contents("blobs", 3)), SPACING)
    for last in np.linspace(150, 250, 7):
        values = np.linspace(0, last, 8) + 0.3
        transfer = Counting(values, np.ones((8, 3)), [0.3, 0.7, 1.7, 2.1, 3.3, 4.9, 5.7, 0])
        whole = compare_methods(volume, transfer, around(volume, SIZE), 0.05, MOVING, [method])
        assert float(whole.rgba[..., 3].max()) > 0.3


@pytest.mark.parametrize(
    "tiling",
    [
        Tiling(cells=4, batch=4, tile=2),
        pytest.param(Tiling(cells=16, group=4, batch=64, tile=4, min_alive=0.5), marks=pytest.mark.slow),
    ],
)
def test_tilings_do_not_show(tiling):
    volume = jv.Volume(contents("blobs", 1).astype(np.float32), SPACING)
    march, camera = jv.March(0.013, leaping(PLAIN, "hierarchy")), orthographic(volume, SIZE)
    whole = jv.render(volume, table(1, 1.0), camera, march)
    assert float(whole.rgba[..., 3].max()) > 0.1
    before = Counting.traces
    other = render_scene(Scene(volume, table(1, 1.0), camera, march), "all", "replay", tiling)
    assert Counting.traces > before
    assert_same(other, whole, fewer=False)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("name", "size"), [("cells", 4), ("cells", 16), ("batch", 4), ("batch", 64), ("tile", 2), ("tile", 16)]
)
def test_tiling_does_not_show_under_jitter_and_termination(name, size, method):
    volume = jv.Volume(bytes_of(contents("blobs", 1)), SPACING)
    camera = around(volume, (70, 66))
    march = jv.March(0.013, leaping(MOVING, method))
    whole = jv.render(volume, table(1, 255), camera, march)
    tiling = Tiling()._replace(**{name: size})
    other = render_scene(Scene(volume, table(1, 255), camera, march), "all", "replay", tiling)
    assert_same(other, whole, fewer=False)


# ---- nothing visible is missed ----


BRIGHT = Counting(np.array([0, 10, 40, 80, 120, 160, 200, 250]) + 0.5, np.ones((8, 3)), [0, 0, *[3.0] * 6])
BETWEEN = Counting(
    np.array([0, 60, 100, 120, 140, 160, 200, 250]) + 0.5, np.ones((8, 3)), [0, 0, 0, 9, 0, 0, 0, 0]
)


def voxel(*place):
    data = np.zeros(SHAPE, np.uint8)
    data[place] = 255
    return data


def where(condition):
    return (255 * condition).astype(np.uint8)


def vessel(first, last):
    """A vessel one voxel wide, from corner to corner."""
    data, places = np.zeros(SHAPE, np.uint8), np.linspace(first, last, 200).round().astype(int)
    data[tuple(places.T)] = 255
    return data


X, Y, Z = np.moveaxis(places(), -1, 0)
CORNERS = [(0, 0, 0), (23, 19, 27), (0, 19, 0), (23, 0, 27)]
FACES = [(12, 0, 14), (23, 9, 13), (7, 19, 21), (11, 10, 27)]
BORDERS = [(4, 4, 4), (8, 7, 12), (3, 3, 3), (5, 8, 11), (20, 16, 24), (19, 17, 25)]
ADVERSARIAL = {
    **{f"voxel {place}": (voxel(*place), BRIGHT) for place in CORNERS + FACES + BORDERS},
    **{
        f"voxel {place}, only slopes visible": (voxel(*place), BETWEEN) for place in CORNERS[:1] + BORDERS[:2]
    },
    **{f"sheet x = {x}": (where(x == X), BRIGHT) for x in (0, 4, 7, 23)},
    **{f"sheet y = {y}": (where(y == Y), BRIGHT) for y in (4, 19)},
    **{f"sheet z = {z}": (where(z == Z), BRIGHT) for z in (8, 27)},
    "sheet, diagonal in xy": (where(X + Y == 20), BRIGHT),
    "sheet, diagonal in xyz": (where(X + Y + Z == 32), BRIGHT),
    "edge of a block between voxels": (where(X > 3), BETWEEN),
    "edge at a block's nodes": (where(Y > 4), BETWEEN),
    "diagonal edge": (where(X + Y - Z > 8), BETWEEN),
    "vessel": (vessel((0, 1, 2), (23, 17, 26)), BRIGHT),
    "vessel, only slopes visible": (vessel((23, 0, 27), (1, 19, 3)), BETWEEN),
}
SPACINGS = [(1.0, 1.0, 1.0), (0.5, 1.3, 2.0)]


def visible_places(data, transfer, count, rng):
    """Random nodes next to something visible."""
    low, high = (10, 255) if transfer is BRIGHT else (0, 255)
    differing = (data > low) & (data <= high)
    return np.argwhere(differing)[rng.integers(0, differing.sum(), count)]


def random_rays(volume, data, transfer, seed):
    """10 000 rays: toward visible voxels, anywhere, and along axes and block boundaries."""
    rng = np.random.default_rng(seed)
    spacing = np.asarray(volume.spacing)
    diagonal = np.linalg.norm(spacing * SHAPE)
    target = rng.random((10_000, 3)) * (np.array(SHAPE) - 1)
    target[:6000] = visible_places(data, transfer, 6000, rng) + rng.uniform(-1, 1, (6000, 3))
    direction = rng.normal(size=(10_000, 3))
    straight = slice(5000, 6500)
    direction[straight] = np.eye(3)[rng.integers(0, 3, 1500)] * rng.choice([-1, 1], (1500, 1))
    target[5500:6500] = np.round(target[5500:6500])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    away = rng.uniform(0, 2, (10_000, 1)) * diagonal
    return (target * spacing - away * direction).astype(np.float32), direction.astype(np.float32)


@pytest.mark.parametrize("method", ["hierarchy", SLOWLY[0]])
@pytest.mark.parametrize("case", ADVERSARIAL)
def test_no_ray_misses_what_is_seen(case, method):
    data, transfer = ADVERSARIAL[case]
    for seed, spacing in enumerate(SPACINGS):
        volume = jv.Volume(data, spacing)
        rays = random_rays(volume, data, transfer, seed)
        whole = jv.render_rays(volume, transfer, *rays, jv.March(0.23))
        assert np.sum(whole.rgba[:, 3] > 0.05) > 100
        leapt = jv.render_rays(volume, transfer, *rays, jv.March(0.23, leaping(PLAIN, method)))
        assert_same(leapt, whole)


@pytest.mark.slow
@pytest.mark.parametrize("cell", [5, 32])
@pytest.mark.parametrize("view", ["around", "inside", "far"])
def test_no_beam_misses_what_is_seen(view, cell):
    seen = 0
    for data, transfer in ADVERSARIAL.values():
        for spacing in SPACINGS:
            volume = jv.Volume(data, spacing)
            camera = PERSPECTIVE[view](volume, (100, 100))
            whole = jv.render(volume, transfer, camera, jv.March(0.23))
            leapt = jv.render(volume, transfer, camera, jv.March(0.23, leaping(PLAIN, "beam", cell)))
            assert_same(leapt, whole)
            seen += float(whole.rgba[..., 3].max()) > 0.05
    assert seen > len(ADVERSARIAL)


@pytest.mark.slow
@pytest.mark.parametrize("view", PERSPECTIVE)
def test_no_pixel_of_a_hierarchy_misses_what_is_seen(view):
    for data, transfer in ADVERSARIAL.values():
        for spacing in SPACINGS:
            volume = jv.Volume(data, spacing)
            camera = PERSPECTIVE[view](volume, (100, 100))
            whole = jv.render(volume, transfer, camera, jv.March(0.23))
            leapt = jv.render(volume, transfer, camera, jv.March(0.23, leaping(PLAIN, "hierarchy")))
            assert_same(leapt, whole)


# ---- what the published method misses, and invalid arguments ----


@pytest.mark.slow
def test_min_distance_misses_what_is_thin_and_a_beam_does_not():
    """A single voxel in front of a wall, between the corners of a cell of 32 x 32 pixels."""
    data = where(Z == 3)
    data[12, 10, 24] = 255
    volume = jv.Volume(data)
    camera = jv.Camera((12.0, 10.0, 90.0), (12.0, 10.0, 3.0), (0, 1, 0), 18.0, size=(100, 100))

    def depth(method):
        return np.asarray(jv.render(volume, BRIGHT, camera, jv.March(0.23, leaping((), method, 32))).depth)

    whole, published, proven = (depth(method) for method in (None, "min_distance", "beam"))
    assert whole[49, 49] < 70  # the voxel
    assert whole[40, 40] > 80  # the wall
    assert published[49, 49] > 80
    np.testing.assert_allclose(published[40, 40], whole[40, 40], rtol=1e-5)
    np.testing.assert_allclose(proven, whole, rtol=1e-5)


@pytest.mark.parametrize("method", ["beam", "min_distance"])
def test_rays_of_ones_own_have_no_neighbours(method):
    march = jv.March(0.2, (jv.SpaceLeaping(method),))
    with pytest.raises(ValueError, match=rf'SpaceLeaping\("{method}"\) needs .* "hierarchy" or "distance"'):
        jv.render_rays(jv.Volume(voxel(3, 3, 3)), BRIGHT, [[-1.0, 0, 0]], [[1.0, 0, 0]], march)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("octree",), "method must be one of hierarchy, distance, min_distance, beam; got 'octree'"),
        (("beam", 1), "cell .* 1"),
        (("beam", 0), "cell .* 0"),
        (("beam", 2.5), "cell .* 2.5"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        jv.SpaceLeaping(*arguments)


# ---- other spaces, other transfer functions ----


@pytest.mark.slow
@pytest.mark.parametrize("transforms", ["plain", "moving"])
@pytest.mark.parametrize("method", METHODS)
def test_leaping_does_not_show_under_a_toroidal_map(method, transforms):
    transforms, seen = SETS[transforms], 0
    for name in ("spheres", "shells"):
        volume, probe = toroidal_phantom(name, (17, 21, 33), speckle=False)
        transfer = jv.TransferFunction(
            np.arange(8) * 30 + 40.5, np.ones((8, 3)), np.array([0, 0, 0, 1, 2, 2, 3, 4]) / 20
        )
        low, high = (np.asarray(corner) for corner in probe.corners)
        for position in (low - 1.5 * (high - low), (0.0, 5.0, 60.0), (160.0, 90.0, 20.0)):
            camera = jv.Camera(position, (low + high) / 2, (1.0, 0, 0), 35.0, size=SIZE).zoom(1.5)
            whole = jv.render(volume, transfer, camera, jv.March(1.3, (probe, *transforms)))
            march = jv.March(1.3, (probe, *leaping(transforms, method)))
            assert_same(jv.render(volume, transfer, camera, march), whole)
            seen += float(whole.rgba[..., 3].max()) > 0.05
    assert seen >= 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "cut"),
    [
        *((method, False) for method in METHODS),
        ("hierarchy", True),
    ],
)
def test_leaping_does_not_show_with_labels_and_leaps_over_hidden_ones(method, cut):
    transforms = (jv.AlphaCorrection(labels=True),) if cut else PLAIN
    rng = np.random.default_rng(0)
    data = rng.integers(60, 200, SHAPE).astype(np.uint8)
    labels = (X > 3).astype(int) + (X > 8) + 34 * (X + Y > 35)  # includes 35 and 36, which are invisible
    volume = jv.Volume(data, SPACING, labels=labels.astype(np.int32))
    see = jv.TransferFunction(np.linspace(0.5, 250, 8), np.ones((8, 3)), [0, 1, 1, 2, 2, 3, 3, 3])
    for shown in ([see, None, None], [None, see, None], [None, None, see]):
        transfer = jv.LabelTransferFunction(shown)
        camera = around(volume, SIZE).zoom(2)
        whole = jv.render(volume, transfer, camera, jv.March(0.017, transforms))
        leapt = jv.render(volume, transfer, camera, jv.March(0.017, leaping(transforms, method)))
        assert_same(leapt, whole)
        assert np.asarray(leapt.samples).sum() < np.asarray(whole.samples).sum()
        assert float(whole.rgba[..., 3].max()) > 0.01


# ---- never stale ----


def test_other_voxels_in_the_same_volume_are_seen():
    volume, step = jv.Volume(bytes_of(contents("blobs", 1)), SPACING), 0.02
    march = jv.March(step, leaping(MOVING, "hierarchy"))
    camera = around(volume, SIZE)
    for seed in (1, 2, 3, 1):
        data = bytes_of(contents("blobs", seed))
        updated = eqx.tree_at(lambda v: v.data, volume, jnp.asarray(data))
        whole = jv.render(jv.Volume(data, SPACING), table(7, 255), camera, jv.March(step, MOVING))
        assert_same(jv.render(updated, table(7, 255), camera, march), whole)
        volume = updated


def test_an_optimisers_updates_are_seen():
    volume = jv.Volume(contents("blobs", 5).astype(np.float32), SPACING)
    camera, step = orthographic(volume, SIZE), 0.02
    march = jv.March(step, leaping(PLAIN, "hierarchy"))
    for i in range(4):
        gradient = np.float32(contents("blobs", 50 + i))
        volume = eqx.tree_at(lambda v: v.data, volume, volume.data - 0.5 * gradient + 0.2)
        fresh = jv.Volume(np.array(volume.data), SPACING)
        whole = jv.render(fresh, table(3, 1.0), camera, jv.March(step, PLAIN))
        assert_same(jv.render(volume, table(3, 1.0), camera, march), whole)


@pytest.mark.parametrize("method", ["hierarchy", *SLOWLY])
def test_inside_jit_data_and_transfer_function_are_those_of_the_call(method):
    volume = jv.Volume(contents("blobs", 5).astype(np.float32), SPACING)
    camera, step = orthographic(volume, SIZE), 0.02
    march = jv.March(step, leaping(PLAIN, method))
    jax.block_until_ready(jv.render(volume, table(0, 1.0), camera, march))

    @eqx.filter_jit
    def image(data, transfer):
        updated = eqx.tree_at(lambda v: v.data, volume, data)
        return jv.render(updated, transfer, camera, march)

    for seed in range(4):
        fresh, transfer = contents("blobs", 70 + seed).astype(np.float32), table(seed, 1.0)
        whole = jv.render(jv.Volume(fresh, SPACING), transfer, camera, jv.March(step, PLAIN))
        # a different program from `whole`, which rounds differently; stale blocks would show as holes
        assert_same(image(jnp.asarray(fresh), transfer), whole, 1e-5)


# ---- gradients ----


VALUES = np.array([0.05, 0.2, 0.3, 0.4, 0.5, 0.7, 0.9, 1.0])


def scene_of(leaves):
    transfer = Counting(VALUES, leaves["colors"], leaves["extinction"])
    camera = jv.Camera(leaves["position"], (0.5, 0.5, 0.5), (0, 0, 1), 40.0, size=(12, 10))
    return jv.Volume(leaves["data"], SPACING), transfer, camera


def leaves_of():
    rng = np.random.default_rng(2)
    return {
        "colors": jnp.asarray(rng.random((8, 3)), jnp.float32),
        "extinction": jnp.asarray([0, 0, 0, 1, 2, 1, 3, 3], jnp.float32),
        "position": jnp.asarray([2.1, 1.4, 1.7], jnp.float32),
        "data": jnp.asarray(contents("blobs", 5), jnp.float32),
    }


def assert_same_gradients(leapt, whole):
    """Compare all gradients except those of extinctions of 0, which leaping omits."""
    shown = np.asarray(leaves_of()["extinction"]) > 0
    for name in whole:
        a, b = (np.asarray(tree[name]) for tree in (leapt, whole))
        a, b = (a[shown], b[shown]) if name == "extinction" else (a, b)
        assert np.abs(b).max() > 1e-3, name
        np.testing.assert_allclose(a, b, atol=1e-5 * np.abs(b).max(), rtol=1e-5, err_msg=name)


@pytest.mark.slow
def test_gradients_do_not_see_the_leaps():
    weights = jnp.asarray(np.random.default_rng(5).normal(size=(10, 12, 4)), jnp.float32)

    def gradients(transforms):
        @jax.jit
        @jax.grad
        def loss(leaves):
            march = jv.March(0.031, (jv.AlphaCorrection(), *transforms))
            return jnp.sum(weights * jv.render(*scene_of(leaves), march).rgba)

        return loss(leaves_of())

    assert_same_gradients(gradients((jv.SpaceLeaping(),)), gradients(()))


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_forward_gradients_do_not_see_the_leaps(method):
    rng = np.random.default_rng(6)
    leaves = leaves_of()
    tangents = []
    for name in leaves:
        tangent = jax.tree.map(jnp.zeros_like, leaves)
        tangent[name] = jnp.asarray(rng.normal(size=leaves[name].shape), jnp.float32)
        tangents.append(tangent)
        if name == "extinction":
            tangent[name] = jnp.where(leaves[name] > 0, tangent[name], 0)

    def slopes(transforms):
        @jax.jit
        def slope(leaves, tangent):
            march = jv.March(0.031, (jv.AlphaCorrection(), *transforms))

            def image(leaves):
                return jv.render(*scene_of(leaves), march, adjoint="forward").rgba

            return jax.jvp(image, (leaves,), (tangent,))[1]

        return [np.asarray(slope(leaves, tangent)) for tangent in tangents]

    for a, b in zip(slopes((jv.SpaceLeaping(method),)), slopes(()), strict=True):
        assert np.abs(b).max() > 1e-3
        np.testing.assert_allclose(a, b, atol=1e-5 * np.abs(b).max(), rtol=1e-5)


# ---- long marches ----


@pytest.mark.slow
def test_ten_thousand_samples_in_float32_lose_nothing_that_is_seen():
    haze, thin = scaled_phantom("constant"), scaled_phantom("sphere")
    rng = np.random.default_rng(0)
    aim = rng.uniform(-0.4, 0.4, (8, 3))
    direction = rng.normal(size=(8, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = np.float32(aim - 3 * direction)
    march = jv.March(2e-4, (jv.AlphaCorrection(), jv.SpaceLeaping()))
    for volume, extinction in ((haze, 0.6), (thin, 0.3), (thin, 0.01)):
        values = np.linspace(0.02, 1, 8)
        transfer = Counting(values, rng.random((8, 3)), extinction * np.array([0, 1, 1, 1, 1, 1, 1, 1]))
        rendering = jv.render_rays(volume, transfer, origin, np.float32(direction), march)
        with in_float64():
            exact = to_float64(jv.March(march.step, march.transforms[:1], max_samples=18_000))
            truth = reference_rays(to_float64(volume), to_float64(transfer), *unit(origin, direction), exact)
        assert int(np.asarray(truth.samples).max()) > 8000
        np.testing.assert_allclose(rendering.rgba, truth.rgba, atol=2e-5, rtol=0)


def unit(origin, direction):
    """The same rays in float64."""
    direction = np.float64(np.float32(direction))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return jnp.asarray(np.float64(origin)), jnp.asarray(direction)


@eqx.filter_jit
def reference_rays(volume, transfer, origin, direction, march):
    def see(origin, direction):
        return jv.render_ray_reference(volume, transfer, origin, direction, march)

    return jax.vmap(see)(origin, direction)


# ---- one program ----


def test_one_program_serves_a_session():
    """New cameras, transfer functions, seeds and voxels on every frame."""
    before = None
    for i in range(11):
        volume = jv.Volume(bytes_of(contents("blobs", i)), SPACING)
        transforms = (jv.EmptySpaceJitter(i), jv.AlphaCorrection(), jv.EarlyTermination(0.01 + 0.01 * i))
        march = jv.March(0.02 + 0.003 * i, leaping(transforms, "hierarchy"))
        camera = drawn_camera(around if i % 2 else inside, volume, i)
        jax.block_until_ready(jv.render(volume, table(i, 255), camera, march))
        if i == 0:
            before = Counting.traces
    assert Counting.traces == before


def stack(items):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *items)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("over", ["cameras", "transfer functions"])
def test_under_vmap_each_is_as_it_is_alone(over, method):
    volume = jv.Volume(contents("blobs", 5).astype(np.float32), SPACING)
    march = jv.March(0.02, leaping(PLAIN, method))
    cameras = [drawn_camera(orthographic, volume, i) for i in range(3)]
    transfers = [table(20 + i, 1.0) for i in range(3)]

    def image(camera, transfer):
        return jv.render(volume, transfer, camera, march)

    if over == "cameras":
        transfers = transfers[:1] * 3
        images = eqx.filter_jit(eqx.filter_vmap(lambda c: image(c, transfers[0])))(stack(cameras))
    else:
        cameras = cameras[:1] * 3
        images = eqx.filter_jit(eqx.filter_vmap(lambda t: image(cameras[0], t)))(stack(transfers))
    for i, (camera, transfer) in enumerate(zip(cameras, transfers, strict=True)):
        one = jax.tree.map(lambda leaf, i=i: leaf[i], images)
        whole = jv.render(volume, transfer, camera, jv.March(0.02, PLAIN))
        assert_same(one, whole, 5e-6)  # another program, which rounds rays differently


# ---- packed voxels ----


INTEGERS = ["uint8", "int8", "uint16", "int16"]


@eqx.filter_jit
def values_at(volume, points):
    return jax.vmap(lambda point: volume.value(apart(point)))(points)


def whole_range(dtype, shape, seed=0):
    limits = np.iinfo(dtype)
    data = np.random.default_rng(seed).integers(limits.min, limits.max, shape, dtype, endpoint=True)
    data.reshape(-1)[[0, -1]] = limits.min, limits.max
    return data


@pytest.mark.parametrize("shape", [(2, 2, 2), (5, 3, 7), (2, 9, 4), (6, 2, 3), (3, 4, 2)], ids=str)
@pytest.mark.parametrize("dtype", INTEGERS)
def test_packed_voxels_are_the_same_values(dtype, shape):
    volume = jv.Volume(whole_range(dtype, shape))
    fast = packing.with_words(volume, packing.words_of(volume))
    assert isinstance(fast.fetch, Packed)
    plain = jv.Volume(np.asarray(volume.data, np.float32))
    last = np.array(shape) - 1
    inside = np.random.default_rng(1).uniform(-0.2, 1.2, (500, 3)) * last
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1).reshape(-1, 3)
    points = jnp.asarray(np.concatenate([nodes, nodes + 0.5, inside]), jnp.float32)
    fetched, expected = (np.asarray(values_at(v, points)) for v in (fast, plain))
    np.testing.assert_array_equal(fetched[: len(nodes)], plain.data.reshape(-1))
    np.testing.assert_allclose(fetched, expected, rtol=0, atol=1e-6 * np.ptp(plain.data))


@pytest.mark.slow
@pytest.mark.parametrize("shape", [SHAPE, (5, 7, 3), (2, 6, 2)], ids=str)
@pytest.mark.parametrize("dtype", INTEGERS)
def test_images_of_integers_are_those_of_the_same_floats(dtype, shape):
    data, limits = whole_range(dtype, shape), np.iinfo(dtype)
    values = np.linspace(limits.min, limits.max, 8)
    transfer = Counting(values, np.random.default_rng(0).random((8, 3)), [0, 0, 0.3, 0.1, 0, 1, 0, 2])
    volume, floats = jv.Volume(data), jv.Volume(data.astype(np.float32))
    march = jv.March(0.11, (jv.AlphaCorrection(), jv.SpaceLeaping()))
    for view in (around, inside):
        camera = view(volume, SIZE)
        rendering = jv.render(volume, transfer, camera, march)
        whole = jv.render(floats, transfer, camera, march)
        assert_same(rendering, whole, 2e-6, fewer=False)
        assert float(whole.rgba[..., 3].max()) > 0.1


# ---- cropped cameras ----


def test_a_part_of_an_image_leaps_as_the_whole():
    """Start distances are looked up by the pixel's position in the crop, not in the whole image."""
    volume, transfer = jv.Volume(contents("blobs", 1).astype(np.float32), SPACING), table(1, 1.0)
    # nothing is visible in the far corner of the crop
    camera = orthographic(volume, (44, 40)).zoom(0.6).crop(23, 19, *SIZE)
    whole = compare_methods(volume, transfer, camera, 0.05, PLAIN, ["beam"])
    assert float(whole.rgba[..., 3].max()) > 0.1
