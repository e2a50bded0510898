"""Line integrals: X-ray images of a box and of a ball against closed forms, at any optical depth."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv

from ..scenes import SIZE, in_float64, rendered


MARCH = jv.March(0.21, (jv.AlphaCorrection(), jv.SpaceLeaping(cell=2)), "midpoint")
WATER = 0.02


def box():
    """Values that are linear in the place, so that their integral along a chord is that in its middle times
    its length; and a transfer function of that slope."""
    x, y, z = np.indices((9, 8, 10))
    volume = jv.Volume((1 + 0.3 * x + 0.1 * y + 0.2 * z).astype(np.float32), (1.0, 1.1, 0.9))
    return volume, jv.TransferFunction([0, 20], np.ones((2, 3)), [0, 20])


def expected(volume, camera, attenuation):
    """The integrals, and 0 where a ray misses."""
    origin, way = (np.asarray(part, np.float64) for part in camera.rays())
    spacing = np.asarray(volume.spacing, np.float64)
    far = (np.asarray(volume.shape) - 1) * spacing
    ends = np.sort([-origin / way, (far - origin) / way], axis=0)
    enters, leaves = ends[0].max(axis=-1), ends[1].min(axis=-1)
    middle = (origin + way * ((enters + leaves) / 2)[..., None]) / spacing
    values = 1 + middle @ [0.3, 0.1, 0.2]
    return np.where(leaves > enters, attenuation * values * (leaves - enters), 0)


def test_a_box_is_as_deep_as_its_chords_and_its_derivative_at_any_depth():
    """The integral is linear in the voxels, and in the attenuation."""
    volume, transfer = box()
    camera = jv.Camera((30, -20, 9), volume.center, (0, 0, 1), 20, size=SIZE)

    @jax.jit
    def found(attenuation):
        def total(data, attenuation):
            seen = eqx.tree_at(lambda v: v.data, volume, data)
            shown = eqx.tree_at(lambda t: t.extinction, transfer, transfer.extinction * attenuation)
            rgba = jv.render(seen, shown, camera, MARCH, compositing="integral").rgba
            return jnp.sum(rgba[..., 0]), rgba

        return jax.value_and_grad(total, (0, 1), has_aux=True)(volume.data, attenuation)

    for attenuation in np.array([1e-4, 0.1, 1, 1e4], np.float32):
        (value, rgba), (of_data, of_attenuation) = jax.device_get(found(attenuation))
        truth = expected(volume, camera, attenuation)
        assert 0.2 < np.mean(truth > 0) < 0.9
        for channel in range(3):
            np.testing.assert_allclose(rgba[..., channel], truth, rtol=2e-4, atol=1e-5 * attenuation)
        np.testing.assert_allclose(rgba[..., 3], -np.expm1(-truth), rtol=2e-4, atol=1e-6)
        np.testing.assert_allclose(np.sum(np.asarray(of_data) * np.asarray(volume.data)), value, rtol=1e-5)
        np.testing.assert_allclose(of_attenuation * attenuation, value, rtol=1e-5)


def test_a_head_in_hounsfield_units_is_attenuated_as_water_is():
    """A ball of water in air; dense bone has twice its extinction."""
    at = np.linalg.norm(np.indices((32, 32, 32)) - 15.5, axis=0)
    ball = jv.Volume(np.clip(1000 * (12 - at), -1000, 0).astype(np.int16), (2.0, 2.0, 2.0))
    transfer = jv.attenuation(WATER)
    bone = np.interp(1000, transfer.values, transfer.extinction)
    np.testing.assert_allclose(bone, 2 * WATER, rtol=1e-6)
    camera = jv.Camera((31, -400, 31), (31, 31, 31), (0, 0, 1), 1, size=(2, 2))
    march = jv.March(0.5, (jv.AlphaCorrection(),))
    found = np.asarray(rendered(ball, transfer, camera, march, compositing="integral").rgba)
    # the surface is a ramp of a voxel, whose middle is at a radius of 12.5 voxels less half
    np.testing.assert_allclose(found[..., 0], WATER * 2 * 2 * 12.5, rtol=0.03)
    with pytest.raises(ValueError, match="water must be"):
        jv.attenuation(0.0)


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", ["replay", "direct", "forward"])
def test_gradients_are_central_differences(adjoint):
    """By camera, step, and a transfer function that reads more than the value, in every adjoint."""
    volume, _ = box()
    with in_float64():
        camera = jv.Camera((30, -20, 9), np.asarray(volume.center, float), (0, 0, 1), 20, size=(6, 5))
        volume = jv.Volume(np.sin(np.asarray(volume.data, np.float64)) + 1, (1.0, 1.1, 0.9))
        shown = jv.TransferFunction2D([0.0, 2.0], [0.0, 1.0], np.ones((2, 2, 3)), [[0.2, 0.5], [0.9, 3.0]])

        def total(given):
            position, step, extinction, data = given
            seen = eqx.tree_at(lambda c: c.position, camera, position)
            of = eqx.tree_at(lambda t: t.extinction, shown, extinction)
            inside = eqx.tree_at(lambda v: v.data, volume, data)
            march = jv.March(step, (jv.AlphaCorrection(),), "midpoint", max_samples=96)
            image = jv.render(inside, of, seen, march, compositing="integral", adjoint=adjoint)
            depth = jnp.where(jnp.isfinite(image.depth), image.depth, 0)
            return jnp.sum(image.rgba) + jnp.sum(depth)

        start = [jnp.asarray(leaf) for leaf in (camera.position, 0.2, shown.extinction, volume.data)]
        random = np.random.default_rng(0)
        value = jax.jit(total)
        for at, leaf in enumerate(start):
            way = [jnp.zeros_like(other) for other in start]
            way[at] = jnp.asarray(random.normal(size=leaf.shape))
            if adjoint == "forward":
                _, slope = jax.jvp(total, (start,), (way,))
            else:
                slope = np.sum(jax.grad(total)(start)[at] * way[at])
            ends = [value([a + h * b for a, b in zip(start, way, strict=True)]) for h in (1e-6, -1e-6)]
            np.testing.assert_allclose(slope, (ends[0] - ends[1]) / 2e-6, rtol=1e-5, atol=1e-6)
