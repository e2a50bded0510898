"""Back faces: uneven if the last cell reaches past the exit, smooth if it is cut there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv

from ..scenes import around, scaled_phantom, soft_transfer, uniform_transfer


def translucent_cube():
    """A cube whose value rises along x, so that rays enter and leave it through material."""
    return scaled_phantom("linear"), jv.TransferFunction.from_points(
        [(0, (0.9, 0.3, 0.1), 0.2), (1, (0.1, 0.3, 0.9), 0.6)]
    )


def images(transforms, quadrature, camera, step=0.11):
    volume, transfer = translucent_cube()
    exact = jv.render(volume, transfer, camera, jv.March(0.001, (jv.AlphaCorrection(),), "midpoint"))
    rendering = jv.render(volume, transfer, camera, jv.March(step, transforms, quadrature))
    return rendering, np.asarray(rendering.rgba - exact.rgba)


@pytest.mark.parametrize("fast", [True, False])
def test_the_gradient_by_an_exit_at_the_end_of_a_cell(fast):
    """A ray of eight whole steps, or of a little more or less, through a constant cube."""
    march = jv.March(0.25, (jv.AlphaCorrection(),), max_samples=16)
    origin, direction = np.array([0.1, 0.2, -3], np.float32), np.array([0, 0, 1], np.float32)

    @jax.jit
    def slope(spacing):
        def opacity(spacing):
            along = jnp.stack([jnp.float32(0.25), jnp.float32(0.25), spacing])
            volume = jv.Volume(np.ones((9, 9, 9), np.float32), along, [-1.0] * 3)
            if fast:
                return jv.render_rays(
                    volume, uniform_transfer(1.0), origin[None], direction[None], march
                ).rgba[0, 3]
            return jv.render_ray_reference(volume, uniform_transfer(1.0), origin, direction, march).rgba[3]

        return jax.grad(opacity)(spacing)

    for spacing in np.array([0.25, 0.2501, 0.2499], np.float32):
        assert slope(spacing) == pytest.approx(8 * np.exp(-8 * float(spacing)), rel=1e-5)


# along z the value is constant on each ray, so that the exit is the only source of error
ALONG_Z = jv.Camera((0.3, 0.2, -4.0), (0.3, 0.2, 0.0), (0, 1, 0), size=(40, 32), parallel_scale=0.5)
OBLIQUE = around(scaled_phantom("linear"), (40, 32))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("quadrature", "camera"),
    [pytest.param("left", ALONG_Z, marks=pytest.mark.slow), ("midpoint", OBLIQUE)],
)
def test_the_error_of_the_exit_falls_by_more_than_twenty(quadrature, camera):
    _, bumpy = images((), quadrature, camera)
    rendering, smooth = images((jv.AlphaCorrection(),), quadrature, camera)
    touched = np.asarray(rendering.aligned)
    assert touched.mean() > 0.2
    errors = [np.sqrt(np.mean(error[touched] ** 2)) for error in (bumpy, smooth)]
    assert errors[1] < errors[0] / 20


def test_without_it_the_exit_is_bumpy():
    """The error is a sawtooth over the image: it jumps between neighbours by up to the weight of a cell."""
    _, bumpy = images((), "midpoint", OBLIQUE)
    _, smooth = images((jv.AlphaCorrection(),), "midpoint", OBLIQUE)
    jumps = [np.abs(np.diff(error[..., 3], axis=1)).max() for error in (bumpy, smooth)]
    assert jumps[0] > 0.02
    assert jumps[1] < jumps[0] / 20


@pytest.mark.parametrize(
    ("pattern", "quadrature"),
    [
        ("blue", "midpoint"),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (("white", "left"), ("white", "midpoint"), ("blue", "left"))
        ),
    ],
)
def test_a_constant_volume_is_exact_under_jitter(pattern, quadrature):
    volume = scaled_phantom("constant")
    camera = jv.Camera((0.3, 0.2, -4.0), (0.3, 0.2, 0.0), (0, 1, 0), size=(40, 32), parallel_scale=0.5)
    for jitter in (jv.EmptySpaceJitter(1, pattern), jv.Jitter(1, pattern, front_residual=True)):
        march = jv.March(0.13, (jitter, jv.AlphaCorrection()), quadrature)
        opacity = jv.render(volume, uniform_transfer(0.8), camera, march).rgba[..., 3]
        np.testing.assert_allclose(opacity, 1 - np.exp(-0.8 * 2), atol=1e-6)


def test_aligned_marks_rays_that_reach_a_last_cell_with_something_in_it():
    """Not rays that end earlier, nor those whose last cell is transparent (Kye 2013, Fig. 13)."""
    volume = scaled_phantom("head")
    camera = around(volume)
    opaque = jv.render(volume, soft_transfer(0.01), camera, jv.March(0.05, (jv.AlphaCorrection(),)))
    ended = jv.render(
        volume, soft_transfer(0.01), camera, jv.March(0.05, (jv.AlphaCorrection(), jv.EarlyTermination(0.01)))
    )
    assert opaque.aligned.sum() > 0  # the neck reaches the box
    assert ended.aligned.sum() < opaque.aligned.sum()
    assert not np.any(np.asarray(ended.aligned) & (np.asarray(ended.rgba[..., 3]) > 0.999))
    clear = jv.TransferFunction(soft_transfer().values, np.ones((8, 3)), np.zeros(8))
    assert not np.any(jv.render(volume, clear, camera, jv.March(0.05, (jv.AlphaCorrection(),))).aligned)
    assert not np.any(jv.render(volume, soft_transfer(), camera, jv.March(0.05)).aligned)
