"""Cells of several steps: the fast engine against the reference, leaping against none, and gradients."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv

from ..scenes import in_float64, slow
from ..test_agreement import compare, reference_image
from .test_gradient_matrix import assert_same, assert_slopes, central, gradient, scene_of, slopes


class Patchy(jv.Transform):
    """Cells whose length changes all over the volume: 1, 2, 4 or 8 steps."""

    longest: int = eqx.field(static=True, default=8)

    @property
    def longest_stride(self):
        return self.longest

    def stride(self, ray, depth, step):
        x, y, z = ray.path(depth)
        return 2 ** (jnp.floor(x / 3 + y / 2 + z / 5).astype(jnp.int32) % 5)


def with_strides(scene):
    volume, transfer, camera, march = scene
    return volume, transfer, camera, jv.March(march.step, (*march.transforms, Patchy()), march.quadrature)


@pytest.mark.parametrize("name", ["moving", *slow("aligned", "jittered")])
def test_strides_are_those_of_the_reference(name):
    scene = with_strides(scene_of(name, "distance"))  # which leaps nearest to what is visible
    volume, transfer, camera, march = scene
    rendering, plain = jv.render(*scene), jv.render(*scene_of(name, "distance"))
    assert int(rendering.samples.sum()) < 0.7 * int(plain.samples.sum())
    without = [t for t in march.transforms if not isinstance(t, jv.SpaceLeaping)]
    counted = jv.March(march.step, tuple(without), march.quadrature, max_samples=128)
    reference = reference_image(volume, transfer, camera, counted)
    unleapt = jv.render(volume, transfer, camera, jv.March(march.step, tuple(without), march.quadrature))
    left = 0.05 if name == "jittered" else 0.0
    compare(unleapt, reference.rgba, np.asarray(reference.samples), tolerance=2e-5, left=left)
    np.testing.assert_allclose(rendering.rgba, unleapt.rgba, atol=1e-6)


@pytest.mark.parametrize("method", ["hierarchy", *slow("distance", "beam")])
@pytest.mark.parametrize("name", ["aligned", *slow("moving")])
def test_leaping_does_not_change_gradients_under_strides(name, method):
    leapt, plain = (with_strides(scene_of(name, m, "float32")) for m in (method, None))
    assert_same(gradient(leapt), gradient(plain), 1e-4)


@pytest.mark.slow
def test_forward_and_replay_gradients_agree_under_strides():
    leapt = with_strides(scene_of("moving", "hierarchy", "float32"))
    assert_slopes(slopes(leapt), gradient(leapt), leapt, 1e-4)


@pytest.mark.slow
def test_gradients_under_strides_are_central_differences():
    """A cell's length is a constant to derivatives; here it changes nowhere between the differences."""
    with in_float64():
        scene = with_strides(scene_of("aligned", None, "float64", "inside"))
        assert_slopes(central(scene), gradient(scene), scene, 1e-5)
