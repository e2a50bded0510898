"""Do NaN and infinity reach the image and the gradient? A diverged fit must not look like a good one.

Constructors check their arguments. Here leaves are replaced afterwards, as optimisers do, and traced.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv

from ..scenes import LEAVES, around


SIZE = (9, 7)

WHOLE = {
    **{name: where for name, where in LEAVES.items() if name != "voxels"},
    "values": lambda s: s[1].values,
    "opacity_left": lambda s: s[3].transforms[1].opacity_left,
}
"""Leaves on which every pixel depends."""


def scene(transforms=(), max_samples=None):
    """A volume with a visible block at its near end and empty space behind it."""
    data = np.zeros((12, 40, 11), np.float32)
    data[2:5, 3:7, 3:8] = 0.8
    volume = jv.Volume(data, (0.1, 0.1, 0.1))
    transfer = jv.TransferFunction([0.0, 0.2, 1.0], np.full((3, 3), 0.5), [0.0, 0.0, 9.0])
    transforms = (jv.AlphaCorrection(), jv.EarlyTermination(0.01), *transforms)
    march = jv.March(0.05, transforms, max_samples=max_samples)
    return volume, transfer, around(volume, SIZE), march


def seen(transforms):
    """The scene's float leaves, and a jit-compiled function of them: ((loss, image), gradient)."""
    floats, rest = eqx.partition(scene(transforms), eqx.is_inexact_array)

    @jax.jit
    def both(floats):
        def loss(floats):
            rgba = jv.render(*eqx.combine(floats, rest)).rgba
            return jnp.sum(rgba**2), rgba

        return jax.value_and_grad(loss, has_aux=True)(floats)

    return floats, both


@pytest.mark.parametrize(
    "transforms",
    [(jv.SpaceLeaping(),), pytest.param((), marks=pytest.mark.slow)],
    ids=["leaping", "not leaping"],
)
def test_nan_and_infinity_reach_image_and_gradient(transforms):
    floats, both = seen(transforms)
    (_, whole), gradient = both(floats)
    assert 0.2 < float(whole[..., 3].max()) <= 1
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert float(jnp.abs(gradient[1].colors).max()) > 0

    for name, where in WHOLE.items():
        for fault in (np.nan, np.inf):
            leaf = where(floats)
            bad = eqx.tree_at(where, floats, leaf.at[(0,) * leaf.ndim].set(fault))
            (value, image), gradient = both(bad)
            assert np.isnan(value), (name, fault)
            assert np.isnan(image).all(), (name, fault)
            assert np.isnan(gradient[1].colors).any(), (name, fault)
            assert np.isnan(where(gradient)).any(), (name, fault)

    for step in (0.0, -0.05):
        (value, image), gradient = both(eqx.tree_at(WHOLE["step"], floats, jnp.float32(step)))
        assert np.isnan(image).all(), step
        assert np.isnan(gradient[1].colors).any(), step

    # visible voxels, and some in the space that is leapt over; several each, since rays are few
    for place in (np.s_[2:5, 3:7, 3:8], np.s_[7:11, 28:38, 2:9]):
        bad = eqx.tree_at(lambda f: f[0].data, floats, floats[0].data.at[place].set(np.nan))
        (value, image), gradient = both(bad)
        assert np.isnan(value), place
        assert np.isnan(image).any(), place
        # colour alone may be NaN where a ray leaves the volume: samples past the exit weigh 0
        assert np.isnan(image[..., :3])[np.isnan(image[..., 3])].all()
        assert np.isnan(image[..., 3]).any(), place
        assert not np.isnan(image).all(), "rays that do not meet the NaN keep their pixels"
        assert np.isnan(gradient[1].colors).any(), place
        assert np.isnan(gradient[0].data).any(), place


@pytest.mark.parametrize("adjoint", ["direct", pytest.param("forward", marks=pytest.mark.slow)])
def test_nan_reaches_image_and_derivative_of_other_adjoints(adjoint):
    floats, rest = eqx.partition(scene(max_samples=16), eqx.is_inexact_array)

    def image(floats):
        return jv.render(*eqx.combine(floats, rest), adjoint=adjoint).rgba

    @jax.jit
    def derivative(floats):
        """Derivative with respect to the colours, as in a fit."""

        def loss(colors):
            return jnp.sum(image(eqx.tree_at(WHOLE["colors"], floats, colors)) ** 2)

        colors = WHOLE["colors"](floats)
        if adjoint == "direct":
            return jax.value_and_grad(loss)(colors)
        return jax.jvp(loss, (colors,), (jnp.ones_like(colors),))

    value, found = derivative(floats)
    assert np.isfinite(value)
    assert np.isfinite(found).all()
    assert np.any(found != 0)
    for name, where in WHOLE.items():
        leaf = where(floats)
        value, found = derivative(eqx.tree_at(where, floats, leaf.at[(0,) * leaf.ndim].set(np.nan)))
        assert np.isnan(value), name
        assert np.isnan(found).any(), name
    # without max_samples
    broken = eqx.tree_at(WHOLE["step"], scene(), jnp.float32(np.nan))
    assert np.isnan(jv.render(*broken, adjoint=adjoint).rgba).all()


def test_the_gradient_does_not_march_with_a_nan_step():
    """Without leaping, each ray would take the maximum of 131 072 cells, which takes several minutes."""
    calls = []

    def count():
        calls.append(1)
        if len(calls) > 1000:
            raise RuntimeError("the march does not end")

    class Counted(jv.Transform):
        def stop(self, stopped, transmittance):
            jax.debug.callback(count)
            return stopped

    floats, both = seen((Counted(),))
    jax.block_until_ready(both(floats))
    jax.effects_barrier()
    assert len(calls) > 1
    calls.clear()
    (value, _), gradient = both(eqx.tree_at(WHOLE["step"], floats, jnp.float32(np.nan)))
    assert np.isnan(value)
    assert np.isnan(gradient[0].data).any()
    jax.effects_barrier()
    assert not calls


def test_rays_that_are_not_finite_fail_when_the_program_runs():
    volume, transfer, camera, march = scene()
    origins, directions = camera.rays()
    image = jax.jit(lambda *rays: jv.render_rays(volume, transfer, *rays, march=march, outputs="rgba").rgba)
    assert np.isfinite(image(origins, directions)).all()
    for fault in (np.nan, np.inf):
        with pytest.raises(Exception, match="origins must be finite"):
            image(origins.at[0, 0, 0].set(fault), directions).block_until_ready()
        with pytest.raises(Exception, match="directions must be finite"):
            image(origins, directions.at[2, 1, 0].set(fault)).block_until_ready()
