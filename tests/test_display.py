"""From linear light to a picture file, and over a background."""

import jax.numpy as jnp
import numpy as np
import pytest
from skimage.io import imread

import jaxvol as jv


def test_srgb_and_back():
    ramp = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(jv.from_srgb(jv.to_srgb(ramp)), ramp, atol=1e-6)
    # the standard's own numbers: mid grey, and where its straight part ends
    np.testing.assert_allclose(
        jv.to_srgb(jnp.array([0.0, 0.0031308, 0.21404, 1.0])), [0, 0.04045, 0.5, 1], atol=1e-5
    )


def test_png_holds_srgb_and_clips(tmp_path):
    image = np.zeros((2, 3, 3), np.float32)
    image[0, 1], image[1, 2] = 0.2158605, 7.0
    path = jv.save_png(tmp_path / "deep" / "x.png", image)
    found = imread(path)
    np.testing.assert_array_equal(found[0, 1], 128)
    np.testing.assert_array_equal(found[1, 2], 255)
    np.testing.assert_array_equal(found[0, 0], 0)


@pytest.mark.parametrize("bad", [np.zeros((4, 4)), np.zeros((4, 4, 4)), np.full((4, 4, 3), np.nan)])
def test_bad_images_are_named(bad, tmp_path):
    with pytest.raises(ValueError, match="image must"):
        jv.save_png(tmp_path / "x.png", bad)
    assert not (tmp_path / "x.png").exists()


def test_image_over_a_background():
    rgba = jnp.array([[[0.2, 0.1, 0.0, 0.5], [0.0, 0.0, 0.0, 0.0]]])
    rendering = jv.Picture(rgba, exhausted=jnp.zeros(rgba.shape[:2], bool))
    np.testing.assert_allclose(rendering.image((1, 1, 1)), [[[0.7, 0.6, 0.5], [1, 1, 1]]])
    np.testing.assert_allclose(
        rendering.image(jnp.full((1, 2, 3), 0.5)), [[[0.45, 0.35, 0.25], [0.5, 0.5, 0.5]]]
    )
    with pytest.raises(ValueError, match="background must be one colour"):
        rendering.image(jnp.zeros((5, 3)))
