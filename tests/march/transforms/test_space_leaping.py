"""Do leaps over empty space miss anything? No leap of an exact method shows in an image; what
`"min_distance"` misses is known. (`test_gradients` compares gradients.)"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import jaxvol as jv

from ... import oracle
from ...scenes import around, in_float64, inside, orthographic, scaled_phantom, slow, to_float64
from ...switch import switch


EXAMPLES = {"leaping": lambda values: jv.SpaceLeaping()}
MEANINGS = {jv.SpaceLeaping: lambda leaping, camera: oracle.Meaning()}
SHAPE = (24, 20, 28)
SPACING = (0.05, 0.06, 0.04)
SIZE = (20, 16)
MOVING = (jv.EmptySpaceJitter(4), jv.AlphaCorrection(), jv.EarlyTermination(0.05))


def leaping(transforms, method, on=True, cell=4):
    """The transforms, and leaps that share a program with none."""
    leaps = jv.SpaceLeaping("distance", block=1) if method == "voxels" else jv.SpaceLeaping(method, cell)
    return (*transforms, switch(leaps, on))


def assert_same(leapt, whole, tolerance=1e-6):
    """Assert the same image, from at most as many samples."""
    np.testing.assert_allclose(leapt.rgba, whole.rgba, atol=tolerance, rtol=0)
    np.testing.assert_allclose(leapt.depth, whole.depth, rtol=1e-5)
    np.testing.assert_array_equal(leapt.aligned, whole.aligned)
    np.testing.assert_array_equal(leapt.exhausted, whole.exhausted)
    assert np.all(np.asarray(leapt.samples) <= np.asarray(whole.samples))


# ---- scenes of different contents and equal shapes ----


PLACES = np.stack(np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij"), -1).astype(float)


def contents(kind, seed):
    """Values in [0, 1]."""
    rng = np.random.default_rng(seed)
    if kind == "noise":
        return rng.random(SHAPE)
    if kind == "sparse":
        return rng.random(SHAPE) * (rng.random(SHAPE) < 0.002)
    if kind == "half":
        return rng.random(SHAPE) * (PLACES[..., seed % 3] > 11)
    blobs = np.zeros(SHAPE)
    for _ in range(rng.integers(1, 4)):
        away = np.linalg.norm(PLACES - rng.random(3) * SHAPE, axis=-1)
        blobs = np.maximum(blobs, np.clip(1.2 - away / rng.uniform(2, 9), 0, 1))
    return blobs


def bytes_of(values):
    return np.round(255 * np.asarray(values)).astype(np.uint8)


def table(seed, top=255.0):
    """Eight control points, some runs of them transparent, and none at a likely voxel value. Where the last
    one is, too, air may lie beyond it: there, the extinction must be exactly 0."""
    rng = np.random.default_rng(seed)
    values = np.sort(rng.choice(254, 8, replace=False)) + 0.37
    extinction = rng.uniform(0.2, 6, 8) * (rng.random(8) < rng.choice([0.2, 0.5, 1]))
    extinction[0 if seed % 2 else -1] *= rng.integers(2)
    return jv.TransferFunction(values * (top / 255), rng.random((8, 3)), extinction)


def far(volume, size):
    """A camera at 300 times the volume's diagonal."""
    low, high = map(np.asarray, volume.corners)
    center = (low + high) / 2
    position = center + 300 * np.linalg.norm(high - low) * np.array([0.48, -0.6, 0.64])
    return jv.Camera(position, center, (0, 0, 1), 0.15, size=size)


PERSPECTIVE = {"around": around, "inside": inside, "far": far}


def drawn_camera(view, volume, seed):
    """A view, zoomed at random, so that beams differ in size."""
    rng = np.random.default_rng(seed)
    return view(volume, SIZE).zoom(rng.uniform(0.7, 5), tuple(rng.uniform(0.3, 0.7, 2)))


KINDS = st.sampled_from(["noise", "sparse", "half", "blobs"])
SEEDS = st.integers(0, 10**6)


@pytest.mark.parametrize("method", ["blocks", "voxels", *slow("beam", "distance")])
def test_leaping_does_not_show(method):
    """In random scenes, each volume after another one, so that nothing stale is used; and saves samples."""
    transforms = MOVING if method == "blocks" else MOVING[:1]

    def compared(volume, transfer, camera, step):
        """The numbers of samples, without leaps and with them."""
        whole, leapt = (
            jv.render(volume, transfer, camera, jv.March(step, leaping(transforms, method, on)))
            for on in (False, True)
        )
        assert_same(leapt, whole)
        return np.asarray(whole.samples).sum(), np.asarray(leapt.samples).sum()

    @settings(max_examples=15)
    @given(kind=KINDS, seed=SEEDS, view=st.sampled_from(list(PERSPECTIVE)), step=st.floats(0.01, 0.3))
    def check(kind, seed, view, step):
        volume = jv.Volume(bytes_of(contents(kind, seed)), SPACING, origin=(0.3, -0.2, 0.1))
        compared(volume, table(seed), drawn_camera(PERSPECTIVE[view], volume, seed), step)

    check()
    volume = jv.Volume(bytes_of(contents("blobs", 3)), SPACING)
    transfer = jv.TransferFunction(np.arange(8) * 30 + 0.5, np.ones((8, 3)), [0, 0, 0, 0, 1, 2, 3, 4])
    whole, leapt = compared(volume, transfer, around(volume, SIZE).zoom(2), 0.01)
    assert leapt < 0.85 * whole


@pytest.mark.slow
@pytest.mark.parametrize(("quadrature", "method"), [("midpoint", "distance"), ("preintegrated", "beam")])
@settings(max_examples=25)
@given(kind=KINDS, seed=SEEDS, step=st.floats(0.01, 0.3))
def test_leaping_does_not_show_in_parallel_views_of_floats(quadrature, method, kind, seed, step):
    volume = jv.Volume(contents(kind, seed).astype(np.float32), SPACING)
    camera = drawn_camera(orthographic, volume, seed)
    whole, leapt = (
        jv.render(volume, table(seed, 1.0), camera, jv.March(step, leaping(MOVING, method, on), quadrature))
        for on in (False, True)
    )
    assert_same(leapt, whole)


# ---- nothing visible is missed ----


BRIGHT = jv.TransferFunction(
    np.array([0, 10, 40, 80, 120, 160, 200, 250]) + 0.5, np.ones((8, 3)), [0, 0, *[3.0] * 6]
)
BETWEEN = jv.TransferFunction(
    np.array([0, 60, 100, 120, 140, 160, 200, 250]) + 0.5, np.ones((8, 3)), [0, 0, 0, 9, 0, 0, 0, 0]
)
"""Shows the slopes between voxels of 0 and 255 alone."""


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


X, Y, Z = np.moveaxis(PLACES, -1, 0)
SINGLE = [(0, 0, 0), (23, 19, 27), (23, 0, 27), (12, 0, 14), (7, 19, 21), (4, 4, 4), (8, 7, 12), (19, 17, 25)]
ADVERSARIAL = {
    **{f"voxel {place}": (voxel(*place), BRIGHT) for place in SINGLE},
    **{f"voxel {place}, only slopes visible": (voxel(*place), BETWEEN) for place in SINGLE[::3]},
    "sheet x = 7": (where(X == 7), BRIGHT),
    "sheet y = 4": (where(Y == 4), BRIGHT),
    "sheet z = 27": (where(Z == 27), BRIGHT),
    "sheet, diagonal in xyz": (where(X + Y + Z == 32), BRIGHT),
    "edge of a block between voxels": (where(X > 3), BETWEEN),
    "edge at a block's nodes": (where(Y > 4), BETWEEN),
    "diagonal edge": (where(X + Y - Z > 8), BETWEEN),
    "vessel": (vessel((0, 1, 2), (23, 17, 26)), BRIGHT),
    "vessel, only slopes visible": (vessel((23, 0, 27), (1, 19, 3)), BETWEEN),
}
SPACINGS = [(1.0, 1.0, 1.0), (0.5, 1.3, 2.0)]
RAYS = 2048


def visible_places(data, transfer, count, rng):
    """Random nodes next to something visible."""
    low, high = (10, 255) if transfer is BRIGHT else (0, 255)
    differing = (data > low) & (data <= high)
    return np.argwhere(differing)[rng.integers(0, differing.sum(), count)]


def random_rays(spacing, data, transfer, seed):
    """Rays toward visible voxels, anywhere, and along axes and block boundaries."""
    rng, part = np.random.default_rng(seed), RAYS // 8
    target = rng.random((RAYS, 3)) * (np.array(SHAPE) - 1)
    target[: 5 * part] = visible_places(data, transfer, 5 * part, rng) + rng.uniform(-1, 1, (5 * part, 3))
    direction = rng.normal(size=(RAYS, 3))
    straight = slice(4 * part, 6 * part)
    direction[straight] = np.eye(3)[rng.integers(0, 3, 2 * part)] * rng.choice([-1, 1], (2 * part, 1))
    target[5 * part : 6 * part] = np.round(target[5 * part : 6 * part])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    away = rng.uniform(0, 2, (RAYS, 1)) * np.linalg.norm(np.asarray(spacing) * SHAPE)
    return (target * spacing - away * direction).astype(np.float32), direction.astype(np.float32)


@pytest.mark.parametrize("method", ["blocks", *slow("distance")])
def test_no_ray_misses_what_is_seen(method):
    for seed, (case, (data, transfer)) in enumerate(ADVERSARIAL.items()):
        spacing = SPACINGS[seed % 2]
        volume, rays = jv.Volume(data, spacing), random_rays(spacing, data, transfer, seed)
        whole, leapt = (
            jv.render_rays(volume, transfer, *rays, jv.March(0.23, leaping((), method, on)))
            for on in (False, True)
        )
        assert np.sum(np.asarray(whole.rgba)[:, 3] > 0.05) > 20, case
        assert_same(leapt, whole)


@pytest.mark.slow
@pytest.mark.parametrize(("method", "cell"), [("blocks", 8), ("beam", 5), ("beam", 32)])
def test_no_beam_misses_what_is_seen(cell, method):
    for number, (data, transfer) in enumerate(ADVERSARIAL.values()):
        volume = jv.Volume(data, SPACINGS[number % 2])
        for view in PERSPECTIVE.values():
            camera = view(volume, (100, 100))
            whole, leapt = (
                jv.render(volume, transfer, camera, jv.March(0.23, leaping((), method, on, cell)))
                for on in (False, True)
            )
            assert_same(leapt, whole)


# ---- what the published method misses, and invalid arguments ----


def test_min_distance_misses_a_voxel_between_the_corners_of_a_cell():
    """A single voxel in front of a wall, between the corners of a cell of 32 x 32 pixels."""
    data = where(Z == 3)
    data[12, 10, 24] = 255
    volume = jv.Volume(data)
    camera = jv.Camera((12.0, 10.0, 90.0), (12.0, 10.0, 3.0), (0, 1, 0), 18.0, size=(100, 100))

    proven, published = jv.SpaceLeaping("distance"), jv.SpaceLeaping("min_distance", 32)
    seen, missed = (
        np.asarray(jv.render(volume, BRIGHT, camera, jv.March(0.23, (leap,)), outputs="rgba").rgba)
        for leap in (proven, published)
    )
    wrong = np.argwhere(np.max(np.abs(seen - missed), axis=-1) > 1 / 255)
    assert len(wrong)
    radius = (
        50 * (1 / 65) / np.tan(np.radians(9))
    )  # of the sphere around the voxel that interpolation reaches
    assert np.max(np.linalg.norm(wrong - 49.5, axis=-1)) < radius


@pytest.mark.parametrize("method", ["beam", "min_distance"])
def test_rays_of_ones_own_have_no_neighbours(method):
    march = jv.March(0.2, (jv.SpaceLeaping(method),))
    with pytest.raises(ValueError, match=rf'SpaceLeaping\("{method}"\) needs .* "blocks" or "distance"'):
        jv.render_rays(jv.Volume(voxel(3, 3, 3)), BRIGHT, [[-1.0, 0, 0]], [[1.0, 0, 0]], march)


def test_bad_arguments_are_named():
    for arguments, message in {
        ("octree",): "method must be one of blocks, distance, min_distance, beam; got 'octree'",
        ("beam", 1): "cell .* 1",
        ("beam", 2.5): "cell .* 2.5",
    }.items():
        with pytest.raises(ValueError, match=message):
            jv.SpaceLeaping(*arguments)
    for method, block, message in (
        ("distance", 3, "block must be 1, 2 or 4; got 3"),
        ("beam", 1, "block=1 needs method"),
    ):
        with pytest.raises(ValueError, match=message):
            jv.SpaceLeaping(method, block=block)
    with pytest.warns(UserWarning, match='is called SpaceLeaping."blocks".'):
        assert jv.SpaceLeaping("hierarchy") == jv.SpaceLeaping()


# ---- other spaces, other transfer functions ----


@pytest.mark.slow
@pytest.mark.parametrize("method", ["blocks", "beam"])
def test_leaping_does_not_show_under_a_toroidal_map(method):
    seen = 0
    for name in ("spheres", "shells"):
        volume, probe = jv.toroidal_phantom(name, (17, 21, 33), speckle=False)
        transfer = jv.TransferFunction(
            np.arange(8) * 30 + 40.5, np.ones((8, 3)), np.array([0, 0, 0, 1, 2, 2, 3, 4]) / 20
        )
        low, high = (np.asarray(corner) for corner in probe.corners)
        for position in (low - 1.5 * (high - low), (0.0, 5.0, 60.0), (160.0, 90.0, 20.0)):
            camera = jv.Camera(position, (low + high) / 2, (1.0, 0, 0), 35.0, size=SIZE).zoom(1.5)
            whole, leapt = (
                jv.render(volume, transfer, camera, jv.March(1.3, (probe, *leaping(MOVING, method, on))))
                for on in (False, True)
            )
            assert_same(leapt, whole)
            seen += float(whole.rgba[..., 3].max()) > 0.05
    assert seen >= 3


@pytest.mark.slow
def test_labels_that_are_hidden_are_leapt_over():
    transforms = (jv.AlphaCorrection(labels=True),)
    data = np.random.default_rng(0).integers(60, 200, SHAPE).astype(np.uint8)
    labels = (X > 3).astype(int) + (X > 8) + 34 * (X + Y > 35)  # includes 35 and 36, which are invisible
    volume = jv.Volume(data, SPACING, labels=labels.astype(np.int32))
    see = jv.TransferFunction(np.linspace(0.5, 250, 8), np.ones((8, 3)), [0, 1, 1, 2, 2, 3, 3, 3])
    camera = around(volume, SIZE).zoom(2)
    for shown in ([see, None, None], [None, see, None], [None, None, see]):
        transfer = jv.LabelTransferFunction(shown)
        whole, leapt = (
            jv.render(volume, transfer, camera, jv.March(0.017, leaping(transforms, "blocks", on)))
            for on in (False, True)
        )
        assert_same(leapt, whole)
        assert np.asarray(leapt.samples).sum() < np.asarray(whole.samples).sum()
        assert float(whole.rgba[..., 3].max()) > 0.01


def test_inside_jit_data_and_transfer_function_are_those_of_the_call():
    """As where an optimiser's step replaces them: nothing that was derived of others is used."""
    volume = jv.Volume(contents("blobs", 5).astype(np.float32), SPACING)
    camera = around(volume, SIZE)

    @eqx.filter_jit
    def image(data, transfer, on):
        updated = eqx.tree_at(lambda v: v.data, volume, data)
        return jv.render(updated, transfer, camera, jv.March(0.02, leaping((), "blocks", on)))

    for seed in range(4):
        arguments = np.float32(contents("blobs", 70 + seed)), table(seed, 1.0)
        whole, leapt = (image(*arguments, np.asarray(on)) for on in (False, True))
        assert_same(leapt, whole)
        assert np.asarray(whole.rgba)[..., 3].max() > 0.05


# ---- long marches ----


@eqx.filter_jit
def reference_rays(volume, transfer, origin, direction, march):
    def see(origin, direction):
        return jv.render_ray_reference(volume, transfer, origin, direction, march)

    return jax.vmap(see)(origin, direction)


@pytest.mark.slow
def test_ten_thousand_samples_in_float32_lose_nothing_that_is_seen():
    haze, thin = scaled_phantom("constant"), scaled_phantom("sphere")
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(8, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin, direction = np.float32(rng.uniform(-0.4, 0.4, (8, 3)) - 3 * direction), np.float32(direction)
    march = jv.March(2e-4, (jv.AlphaCorrection(), jv.SpaceLeaping()))
    for volume, extinction in ((haze, 0.6), (thin, 0.3), (thin, 0.01)):
        values = np.linspace(0.02, 1, 8)
        transfer = jv.TransferFunction(values, rng.random((8, 3)), extinction * np.array([0, *[1] * 7]))
        rendering = jv.render_rays(volume, transfer, origin, direction, march)
        with in_float64():
            exact = to_float64(jv.March(march.step, march.transforms[:1], max_samples=18_000))
            unit = np.float64(direction) / np.linalg.norm(np.float64(direction), axis=1, keepdims=True)
            rays = jnp.asarray(np.float64(origin)), jnp.asarray(unit)
            truth = reference_rays(to_float64(volume), to_float64(transfer), *rays, exact)
        assert int(np.asarray(truth.samples).max()) > 8000
        np.testing.assert_allclose(rendering.rgba, truth.rgba, atol=2e-5, rtol=0)


def test_a_beam_holds_all_pixels_of_its_cell():
    """Small cubes under pixels as large as blocks: each is seen by a few pixels, often those at the end of a
    cell of the image alone."""
    transfer = jv.TransferFunction([0, 0.2, 1], np.ones((3, 3)), [0, 0, 5.0])
    seen = 0
    for seed in range(30):
        data = np.zeros((96, 96, 96), np.float32)
        x, y, z = np.random.default_rng(seed).integers(2, 91, 3)
        data[x : x + 3, y : y + 3, z : z + 3] = 1
        volume = jv.Volume(data)
        camera = jv.Camera.looking_at(volume, (0.5, -1, 0.4), size=(40, 32))
        found, expected = (
            np.asarray(jv.render(volume, transfer, camera, jv.March(0.5, (jv.Jitter(0), *leaps))).rgba)
            for leaps in ((jv.SpaceLeaping("beam", cell=8),), ())
        )
        np.testing.assert_allclose(found, expected, atol=1e-4, err_msg=f"seed {seed}")
        seen += np.sum(expected[..., 3] > 0)
    assert seen > 10


@pytest.mark.parametrize("method", ["blocks", *slow("distance", "beam")])
def test_leaps_show_in_no_image_of_a_turned_and_sheared_volume(method):
    """In float32, as users render, by a function of many points."""
    rng = np.random.default_rng(5)
    data = np.sum([np.roll(rng.random((24, 24, 24)), k, k % 3) for k in range(9)], axis=0)
    axes = np.array([[0.8, -0.36, 0], [0.6, 0.8, 0.28], [0, 0.48, 0.96]])
    volume = jv.Volume(data.astype(np.float32) / 9, (1.3, 1.1, 0.9), direction=axes)
    values, seen = np.linspace(0.2, 0.8, 40), np.arange(40) > 22
    transfer = jv.TransferFunction(values, rng.random((40, 3)), rng.random(40) * seen)
    camera = around(volume, (40, 32))
    plain, leapt = (
        np.asarray(jv.render(volume, transfer, camera, jv.March(0.5, leaps, "midpoint")).rgba)
        for leaps in ((), (jv.SpaceLeaping(method),))
    )
    assert np.mean(plain[..., 3] > 0) > 0.1
    np.testing.assert_allclose(leapt, plain, atol=1e-6, rtol=1e-6)
