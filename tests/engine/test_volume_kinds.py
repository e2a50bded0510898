"""Images and gradients of volumes with custom fields, or with 16-bit voxels."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.scene.occupancy import Blocks

from ..scenes import around, soft_transfer


class Inverted(jv.Field):
    """Dense where voxels are 0, so that ranges computed from the voxels are wrong for it."""

    def value(self, volume, coordinate):
        return 1 - volume.interpolated(coordinate) / 255


def inverted(dtype):
    """A visible object with blocks of zeros inside, voxels that the transfer function would hide."""
    data = np.full((14, 14, 14), 255)
    data[3:11, 3:11, 3:11] = np.random.default_rng(0).integers(0, 60, (8, 8, 8))
    data[4:9, 4:9, 4:9] = 0
    return jv.Volume(data.astype(dtype), (0.1, 0.12, 0.08), field=Inverted())


@pytest.mark.slow
def test_a_custom_field_is_used_for_image_and_gradient():
    """Compare the fast engine and its gradient with the reference on a volume of the field's values."""
    volume = inverted("uint8")
    plain = jv.Volume(1 - np.asarray(volume.data, np.float32) / 255, volume.spacing)
    camera, transfer = around(volume), soft_transfer(1.0)
    # method "distance", since the beams of such a small image are as wide as the volume
    march = jv.March(0.07, (jv.AlphaCorrection(), jv.SpaceLeaping("distance")))
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(16, 20, 4)), jnp.float32)

    def of(volume, adjoint):
        def loss(moving):
            data, position = eqx.combine(moving, (volume.data, camera.position))
            scene = eqx.tree_at(lambda s: (s[0].data, s[1].position), (volume, camera), (data, position))
            rgba = jv.render(scene[0], transfer, scene[1], march, adjoint=adjoint).rgba
            return jnp.sum(rgba * weights), rgba

        moving = eqx.filter((volume.data, camera.position), eqx.is_inexact_array)
        (_, image), gradient = jax.value_and_grad(loss, has_aux=True)(moving)
        return image, gradient

    (image, (_, of_position)), (truth, (_, expected)) = (
        of(volume, "replay"),
        of(plain, "direct"),
    )
    assert float(truth[..., 3].max()) > 0.3
    np.testing.assert_allclose(image, truth, atol=2e-5, rtol=0)
    np.testing.assert_allclose(of_position, expected, atol=2e-4 * float(np.linalg.norm(expected)), rtol=0)


@pytest.mark.slow
def test_gradients_of_voxels_in_16_bits_are_summed_in_32():
    """Each voxel sums the gradients of thousands of samples, which 16 bits cannot hold."""
    data = jnp.asarray(np.random.default_rng(0).uniform(0.2, 0.9, (4, 4, 4)), "bfloat16")
    transfer, whole = soft_transfer(0.2), jv.Volume(data.astype(jnp.float32))
    camera, march = around(whole, (48, 48)), jv.March(0.07, (jv.AlphaCorrection(),))

    def gradient(data):
        def loss(data):
            return jnp.sum(jv.render(jv.Volume(data), transfer, camera, march).rgba)

        return np.asarray(jax.grad(loss)(data), np.float64)

    expected = gradient(data.astype(jnp.float32))
    error = np.abs(gradient(data) - expected).max() / np.abs(expected).max()
    assert error < 2 * float(jnp.finfo("bfloat16").eps)


class Nearest(jv.Field):
    """Reads the voxels directly instead of interpolating them."""

    def value(self, volume, coordinate):
        i, j, k = (jnp.round(c).astype(jnp.int32) for c in coordinate)
        return volume.data[i, j, k]


class Both(jv.Field):
    """Reads a volume that it holds in both ways."""

    inner: jv.Volume

    def value(self, volume, coordinate):
        return self.inner.value(coordinate) + self.inner.data[0, 0, 0]


class Looped(jv.Field):
    inner: jv.Volume

    def value(self, volume, coordinate):
        return jax.lax.map(lambda c: self.inner.value((c, *coordinate[1:])), jnp.stack([coordinate[0]]))[0]


class Of(jv.Field):
    """A function of the coordinate."""

    function: Any

    def value(self, volume, coordinate):
        return self.function(coordinate)


BOX = np.zeros((5, 5, 5), np.float32)


@pytest.mark.parametrize(
    ("volume", "message"),
    [
        (lambda data: jv.Volume(data, field=Nearest()), 'field: Nearest reads .* Pass adjoint="direct"'),
        (
            lambda data: jv.Volume(BOX, field=Both(jv.Volume(data))),
            "field: Both reads voxels without interpolation",
        ),
        (
            lambda data: jv.Volume(BOX, field=Looped(jv.Volume(data))),
            "Field.value reads a Volume inside vmap, scan or cond",
        ),
        (
            lambda data: jv.Volume(BOX, field=Of(lambda c: c[0] * data[0, 0, 0])),
            "a function of the volume's field captures a value that is differentiated",
        ),
        (lambda data: jv.Volume(BOX, field=Of(jnp.stack)), "Of.value must return a number, or a tuple"),
    ],
)
def test_what_a_field_reads_by_itself_has_no_gradient_by_replay(volume, message):
    data = np.random.default_rng(0).random((5, 5, 5), np.float32)

    def loss(data):
        image = jv.render(volume(data), soft_transfer(), around(jv.Volume(BOX)), jv.March(0.3))
        return jnp.sum(image.rgba)

    with pytest.raises(ValueError, match=message):
        jax.eval_shape(jax.grad(loss), data)


def test_blocks_of_a_custom_field_count_as_visible():
    data = np.full((9, 9, 9), 0.5, np.float32)
    clear = jv.TransferFunction([0.0, 0.7, 1.0], np.ones((3, 3)), [0.0, 0.0, 1.0])
    seen = jax.jit(
        lambda: [clear.visible(Blocks.of(jv.Volume(data, field=field))) for field in (None, Inverted())]
    )
    for found, visible in zip(seen(), (False, True), strict=True):
        np.testing.assert_array_equal(found, visible)


def test_what_is_no_field_is_named():
    with pytest.raises(ValueError, match="field must be a jaxvol Field, or None; got"):
        jv.Volume(np.zeros((2, 2, 2)), field=lambda volume, coordinate: 0.0)
