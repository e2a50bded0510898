"""Exactness, order, continuity: what a march is worth, by closed forms. (`test_agreement` has energy, and
what each transform means.)"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.special import erf

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.scene.space import Affine, enter

from . import oracle
from .scenes import around, in_float64, scaled_phantom, slow, uniform_transfer


@pytest.mark.parametrize("quadrature", ["midpoint", *slow("left", "preintegrated")])
@settings(max_examples=40)
@given(step=st.floats(0.004, 5), extinction=st.one_of(st.just(0.0), st.floats(1e-3, 100)))
def test_a_constant_volume_is_exact_at_any_step_under_alpha_correction(quadrature, step, extinction):
    volume = scaled_phantom("constant")
    march = jv.March(step, (jv.AlphaCorrection(),), quadrature)
    camera = around(volume)
    color = (0.25, 0.5, 1.0)
    rgba = jv.render(volume, uniform_transfer(extinction, color), camera, march).rgba
    exact = -np.expm1(-extinction * lengths_inside(volume, camera))
    # 1e-6, the effect of the length's last bits (the renderer is another program and rounds differently), and
    # the rounding of a sum over the samples
    samples = lengths_inside(volume, camera) / step
    tolerance = 1e-6 + extinction * (1 - exact) * 8e-7 + 2.0**-24 * np.sqrt(samples)
    error = np.abs(rgba - exact[..., None] * np.array([*color, 1.0])).max(axis=-1)
    assert (error <= tolerance).all()


@eqx.filter_jit
def rounded_lengths(volume, camera):
    """Length of each ray inside the volume, computed in float32; `test_space` checks it."""
    space = Affine(volume)
    enter_all = jax.vmap(
        jax.vmap(lambda o, d: enter(space, apart(o), apart(d), (jnp.int32(0), jnp.int32(0))).length)
    )
    return enter_all(*camera.rays())


def lengths_inside(volume, camera):
    return np.asarray(rounded_lengths(volume, camera), np.float64)


def true_interval(camera):
    """Entry and exit distances of every pixel's ray into [-1, 1]³, by the independent marcher's clipping."""
    origins, directions = (np.asarray(part, np.float64).reshape(-1, 3) for part in camera.rays())
    return oracle.box_interval(origins, directions, [-1] * 3, [1] * 3)


def gaussian_opacity(camera, extinction):
    """Opacity of the Gaussian blob exp(-r²/(2 w²)), w = 0.3, from its line integral in closed form."""
    width = 0.3
    origins, directions = (np.asarray(part, np.float64).reshape(-1, 3) for part in camera.rays())
    t_in, t_out = true_interval(camera)
    middle = -np.sum(origins * directions, axis=1)
    nearest = np.sum((origins + middle[:, None] * directions) ** 2, axis=1)
    ends = [erf((t - middle) / (np.sqrt(2) * width)) for t in (t_in, np.maximum(t_in, t_out))]
    depth = extinction * np.exp(-nearest / (2 * width**2)) * width * np.sqrt(np.pi / 2) * (ends[1] - ends[0])
    return 1 - np.exp(-depth)


class Gaussian(jv.Field):
    """The Gaussian evaluated exactly instead of from voxels, so that the step is the only approximation."""

    def value(self, volume, coordinate):
        x, y, z = (c * volume.spacing[i] + volume.origin[i] for i, c in enumerate(coordinate))
        return jnp.exp(-(x**2 + y**2 + z**2) / (2 * 0.3**2))


@pytest.mark.parametrize(("quadrature", "order"), [("left", 1), ("midpoint", 2), ("preintegrated", 2)])
def test_the_error_falls_with_the_order_claimed_for_image_and_gradient(quadrature, order):
    """By the reference, whose image the fast engine's is (`test_agreement`)."""
    steps, h = np.array([0.16, 0.08, 0.04, 0.02]), 1e-6
    with in_float64():
        volume = jv.Volume(np.zeros((24, 24, 24), np.float32), [2 / 23] * 3, [-1.0] * 3, field=Gaussian())
        # off centre, so that the entry face cuts the blob and the first-order error shows
        camera = jv.Camera((0.2, -0.35, 0.1), (0.0, 1.0, 0.0), (0, 0, 1), 60.0, size=(12, 10))
        origins, directions = (rays.reshape(-1, 3) for rays in camera.rays())
        exact = gaussian_opacity(camera, 2.0)
        exact_slope = (gaussian_opacity(camera, 2 + h) - gaussian_opacity(camera, 2 - h)) / (2 * h)

        @jax.jit
        def both(step):
            def opacity(extinction):
                density = jnp.stack([0 * extinction, extinction])
                transfer = jv.TransferFunction([0.0, 1.0], np.ones((2, 3)), density)
                march = jv.March(step, (jv.AlphaCorrection(),), quadrature, max_samples=200)

                def one(origin, direction):
                    return jv.render_ray_reference(volume, transfer, origin, direction, march).rgba[3]

                return jax.vmap(one)(origins, directions)

            return jax.jvp(opacity, (jnp.float64(2.0),), (jnp.float64(1.0),))

        errors = [
            [
                np.sqrt(np.mean((found - true) ** 2))
                for found, true in zip(both(step), (exact, exact_slope), strict=True)
            ]
            for step in steps
        ]
    fitted = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    np.testing.assert_allclose(fitted, order, atol=0.15)


@pytest.mark.slow
def test_alpha_correction_makes_the_image_continuous_in_the_camera():
    """Without it the image jumps when a sample crosses the exit, which finite differences see and derivatives
    do not."""
    volume = jv.Volume(np.ones((5, 5, 5), np.float32), spacing=[0.5] * 3)
    directions = [[1.0, 0.0, 0.0]]

    def slopes(transforms):
        def opacity(x):
            origin = jnp.stack([x, jnp.ones_like(x), jnp.ones_like(x)])[None]
            march = jv.March(0.3, transforms)
            return jv.render_rays(
                volume, uniform_transfer(1.0), origin, directions, march, adjoint="forward"
            ).rgba[0, 3]

        def value_and_slope(x):
            x = jnp.float32(x)
            return map(float, jax.jvp(opacity, (x,), (jnp.ones_like(x),)))

        # the camera is inside the volume: moving it forward shortens the ray
        (_, derivative), (near, _), (far, _) = map(value_and_slope, (0.25, 0.55, 0.1))
        return derivative, (near - far) / 0.45

    derivative, difference = slopes((jv.AlphaCorrection(),))
    assert derivative == pytest.approx(-np.exp(-1.75), rel=1e-4)
    assert difference == pytest.approx(-(np.exp(-1.45) - np.exp(-1.9)) / 0.45, rel=1e-3)
    derivative, difference = slopes(())
    assert derivative == 0
    assert difference < -0.1


@pytest.mark.slow
def test_reference_has_second_derivatives():
    volume = scaled_phantom("constant")
    march = jv.March(0.1, (jv.AlphaCorrection(),))

    def opacity(extinction):
        transfer = jv.TransferFunction(np.linspace(0, 1, 8), np.ones((8, 3)), jnp.full(8, extinction))
        origin, direction = jnp.asarray([-3.0, 0.1, 0.2]), jnp.asarray([1.0, 0.0, 0.0])
        return jv.render_ray_reference(volume, transfer, origin, direction, march).rgba[3]

    second = jax.grad(jax.grad(opacity))(jnp.float32(0.5))
    np.testing.assert_allclose(second, -4 * np.exp(-1.0), rtol=1e-4)
