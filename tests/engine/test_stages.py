"""Is an image in stages that of one program? Does one march serve all images that differ by numbers alone?"""

import gc
import weakref

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.engine import stages
from jaxvol.scene.voxel_fetch import split
from jaxvol.xla.packing import Layout

from ..scenes import SIZE, around, slow


ALL = (
    jv.Jitter(3),
    jv.EmptySpaceJitter(4),
    jv.AlphaCorrection(),
    jv.SpaceLeaping(),
    jv.EarlyTermination(0.02),
)


def ball(shape=(20, 18, 16), dtype=np.uint8):
    """A volume with empty space around a soft ball."""
    place = np.stack(np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij"))
    values = np.clip(1.2 - 1.5 * np.sqrt((place**2).sum(0)), 0, 1)
    return jv.Volume((255 * values).astype(dtype), [2 / n for n in shape])


def function(points):
    """A transfer function with this number of points, transparent below a fifth."""
    values = np.linspace(0, 255, points)
    return jv.TransferFunction(
        values, np.linspace([1, 0, 0], [0, 0.5, 1], points), np.maximum(values / 50 - 1, 0)
    )


def test_one_march_serves_all_images_whose_differences_are_numbers(monkeypatch):
    marched, march_rays = [], stages.march_rays
    monkeypatch.setattr(stages, "march_rays", lambda *a, **k: marched.append(1) or march_rays(*a, **k))

    def image(volume, size=SIZE, points=5, transforms=ALL, step=0.05, quadrature="left", **how):
        camera = jv.Camera.looking_at(volume, (0.3, -1, 0.4), size=size)
        rendering = jv.render(volume, function(points), camera, jv.March(step, transforms, quadrature), **how)
        assert np.asarray(rendering.rgba)[..., 3].max() > 0.3
        return rendering

    image(ball())
    marched.clear()
    image(ball(), (31, 47), 8, ALL[2:], 0.08, "midpoint")
    image(ball((22, 17, 19)), points=2, transforms=(), step=0.03)
    image(ball(), transforms=ALL[:1] + ALL[3:])
    image(ball(), antialias=2, until=np.full(SIZE[::-1], 99.0))
    image(ball(), transforms=(*ALL[1:4], jv.Clip((-9, 9, -9, 1, -9, 9))))
    assert not marched
    image(ball(), quadrature="preintegrated")
    assert len(marched) <= 1  # none where another test has marched so

    def floats(shape):
        whole = ball(shape)
        return jv.Volume(np.asarray(whole.data, np.float32), whole.spacing)

    of_floats = image(floats((20, 18, 16)))
    traced = len(marched)
    image(floats((22, 17, 19)))
    assert len(marched) == traced
    np.testing.assert_allclose(of_floats.rgba, image(ball()).rgba, atol=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, *slow(np.int16, np.float32)])
def test_an_image_of_several_tiles_is_that_of_one_program(dtype):
    volume, camera = ball(dtype=dtype), around(ball(), (160, 150))
    march = jv.March(0.06, ALL, "midpoint")
    staged = jv.render(volume, function(5), camera, march)
    whole = jax.jit(lambda v, t, c: jv.render(v, t, c, march))(volume, function(5), camera)
    assert stages.RayTiles.shared(camera, stages.Tiling()) == (256, 2)
    assert np.asarray(whole.rgba)[..., 3].max() > 0.9
    for name in ("rgba", "depth", "aligned", "exhausted"):
        np.testing.assert_allclose(getattr(staged, name), getattr(whole, name), atol=1e-6)


def test_a_node_read_from_the_bits_of_a_float_is_the_one_below():
    at = np.array([-3, -0.0, 0.3, 1, 6.9999995, 7, 8.5, 9, 9.2, 1e9, np.inf, np.nan], np.float32)
    found = jax.jit(jax.vmap(lambda c: split((c, c, c), (10, 10, 10))))(at)
    (node, *_), (fraction, *_) = jax.device_get(found)
    inside = np.clip(at, 0, 9)
    known = np.minimum(np.floor(inside[:-1]), 8)
    np.testing.assert_array_equal(node[:-1], known)
    np.testing.assert_array_equal(fraction[:-1], inside[:-1] - known)
    assert 0 <= node[-1] <= 8
    assert np.isnan(fraction[-1])


def test_what_is_packed_is_unpacked_taken_and_put():
    rng = np.random.default_rng(0)
    tree = {
        "float": rng.normal(size=(6, 4)).astype(np.float32),
        "vector": rng.normal(size=(6, 4, 3)).astype(np.float32),
        "integer": rng.integers(-(2**31), 2**31 - 1, (6, 4)).astype(np.int32),
        "truth": rng.random((6, 4)) < 0.5,
        "none": None,
    }

    @jax.jit
    def turned(tree):
        packed = Layout.of(tree).pack(tree)
        rows = jnp.array([4, 1, 6])  # the last one is none
        taken = packed.take(jnp.minimum(rows, 5)).tree
        return packed.tree, taken, packed.put(rows, jax.tree.map(lambda leaf: leaf[::-1], taken)).tree

    same, taken, put = turned(tree)
    jax.tree.map(np.testing.assert_array_equal, same, tree)
    for name in ("float", "vector", "integer", "truth"):
        whole, rows = tree[name].copy(), tree[name][[4, 1, 5]].reshape(12, *tree[name].shape[2:])
        np.testing.assert_array_equal(taken[name], rows)
        whole[[4, 1]] = rows[::-1].reshape(3, 4, *rows.shape[1:])[:2]
        np.testing.assert_array_equal(put[name], whole)


def test_what_is_kept_of_a_scene_goes_with_its_parts():
    volume, march = ball(), jv.March(0.05, ALL)
    for points in (5, 8):
        transfer = function(points)
        jv.render(volume, transfer, around(volume, (8, 8)), march)
        kept, dead = len(stages._STAGINGS), weakref.ref(transfer)
        del transfer
        gc.collect()
        assert dead() is None
        assert len(stages._STAGINGS) == kept - 1


def test_numbers_that_change_in_place_are_seen():
    extinction = np.ones(2, np.float32)
    transfer = eqx.tree_at(
        lambda t: t.extinction, jv.TransferFunction([0.0, 255.0], np.ones((2, 3)), [1.0, 1.0]), extinction
    )
    volume = jv.Volume(np.full((4, 4, 4), 100, np.uint8))
    camera, march = jv.Camera.looking_at(volume, size=(8, 8)), jv.March(0.5, (jv.SpaceLeaping(),))

    def image():
        return np.asarray(jv.render(volume, transfer, camera, march).rgba)

    assert image()[4, 4, 3] > 0.5
    extinction[:] = 0
    assert not image().any()
    extinction[:] = np.nan
    assert np.isnan(image()).all()
