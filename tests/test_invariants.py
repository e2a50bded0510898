"""Properties that hold for every combination of transforms: energy, exactness, order, gradients."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.special import erf

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.space import Affine, enter

from . import oracle
from .scenes import (
    CAMERAS,
    FEW,
    QUADRATURES,
    TRANSFORMS,
    VOLUMES,
    around,
    in_float64,
    scaled_phantom,
    soft_transfer,
    to_float64,
    uniform_transfer,
)


def whitened(transfer):
    """The same extinction with all colours white, so that each colour channel is the sum of the weights."""
    return jv.TransferFunction(transfer.values, np.ones((8, 3)), transfer.extinction)


@pytest.mark.parametrize(
    ("transforms", "quadrature"),
    [
        # shares its program with `test_agreement`
        pytest.param(*case, marks=[] if case == (FEW[2], "midpoint") else pytest.mark.slow)
        for case in itertools.product(FEW, QUADRATURES)
    ],
)
def test_weights_and_transmittance_sum_to_one(transforms, quadrature):
    march = jv.March(0.07, TRANSFORMS[transforms], quadrature)
    for make in VOLUMES.values():
        volume = make()
        for view in CAMERAS.values():
            rgba = jv.render(volume, whitened(soft_transfer(0.2)), view(volume), march).rgba
            transmittance = 1 - rgba[..., 3]
            np.testing.assert_allclose(rgba[..., 0] + transmittance, 1, atol=1e-6)
            assert float(transmittance.min()) >= 0


@settings(max_examples=40, deadline=None)
@given(
    step=st.floats(0.004, 5),
    extinction=st.one_of(st.just(0.0), st.floats(1e-3, 100)),
    quadrature=st.sampled_from(QUADRATURES),
)
def test_a_constant_volume_is_exact_at_any_step_under_alpha_correction(step, extinction, quadrature):
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


@pytest.mark.parametrize("quadrature", QUADRATURES)
def test_a_constant_volume_is_exact_to_rounding_in_float64(quadrature):
    with in_float64():
        volume = to_float64(scaled_phantom("constant"))
        camera = to_float64(around(volume))
        for step in (0.013, 0.4, 5.0):
            march = jv.March(step, (jv.AlphaCorrection(),), quadrature)
            opacity = jv.render(volume, uniform_transfer(3.0), camera, march).rgba[..., 3]
            t_in, t_out = true_interval(camera)
            exact = -np.expm1(-3.0 * np.maximum(t_out - t_in, 0)).reshape(opacity.shape)
            np.testing.assert_allclose(opacity, exact, atol=1e-12)


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
    steps = np.array([0.16, 0.08, 0.04, 0.02])
    with in_float64():
        volume = jv.Volume(np.zeros((24, 24, 24), np.float32), [2 / 23] * 3, [-1.0] * 3, field=Gaussian())
        # off centre, so that the entry face cuts the blob and the first-order error shows
        camera = jv.Camera((0.2, -0.35, 0.1), (0.0, 1.0, 0.0), (0, 0, 1), 60.0, size=(12, 10))
        exact = gaussian_opacity(camera, 2.0).reshape(10, 12)

        def image(extinction, step):
            transfer = jv.TransferFunction(
                [0.0, 1.0], np.ones((2, 3)), jnp.stack([0 * extinction, extinction])
            )
            march = jv.March(step, (jv.AlphaCorrection(),), quadrature)
            return jv.render(volume, transfer, camera, march, adjoint="forward").rgba[..., 3]

        h = 1e-6
        exact_slope = (gaussian_opacity(camera, 2 + h) - gaussian_opacity(camera, 2 - h)).reshape(10, 12) / (
            2 * h
        )
        errors = []
        for step in steps:
            value, slope = jax.jvp(
                lambda e, step=step: image(e, step), (jnp.float64(2.0),), (jnp.float64(1.0),)
            )
            errors.append(
                [np.sqrt(np.mean((value - exact) ** 2)), np.sqrt(np.mean((slope - exact_slope) ** 2))]
            )
    fitted = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    np.testing.assert_allclose(fitted, order, atol=0.15)


@pytest.mark.parametrize("extinction", [0.0, 1e-6, 1.0, 1e6])
def test_values_and_gradients_are_finite_at_the_extremes(extinction):
    """With `adjoint="direct"`; `test_gradients` covers the others."""
    volume = jv.Volume(np.ones((5, 5, 5), np.float32), spacing=[0.5] * 3)
    origins = jnp.asarray(
        [[-1, 1, 1], [-1, 5, 1], [1, 1, 1], [-1, 0, 0], [-1, -1, -1], [1, 1, 9]], jnp.float32
    )
    directions = jnp.asarray([[1, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 1], [0, 0, 1]], jnp.float32)

    def loss(leaves):
        transfer = jv.TransferFunction(np.linspace(0, 1, 8), leaves["colors"], leaves["extinction"])
        scene = jv.Volume(leaves["data"], volume.spacing)
        march = jv.March(0.3, (jv.AlphaCorrection(), jv.EarlyTermination(1e-3)))
        rendering = jv.render_rays(
            scene, transfer, leaves["origins"], leaves["directions"], march, adjoint="direct"
        )
        return jnp.sum(rendering.rgba**2)

    leaves = {
        "colors": jnp.ones((8, 3)),
        "extinction": jnp.full(8, extinction),
        "data": volume.data,
        "origins": origins,
        "directions": directions,
    }
    value, gradient = jax.value_and_grad(loss)(leaves)
    assert np.isfinite(value)
    for name, leaf in gradient.items():
        assert np.isfinite(leaf).all(), name


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
