"""Are directions sampled from the phase function?"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxvol.lighting.phase import phase, sample_phase, scattered


ANISOTROPIES = np.array([-0.95, -0.5, -1e-4, 0.0, 1e-6, 0.3, 0.9, 0.99], np.float32)


def for_each(function, numbers):
    """Values of a function of numbers and an anisotropy: (anisotropies, numbers)."""
    program = jax.jit(jax.vmap(function, in_axes=(None, 0)))
    return np.asarray(program(jnp.asarray(numbers, jnp.float32), jnp.asarray(ANISOTROPIES)), float)


def test_the_phase_function_is_a_density_of_mean_cosine_g():
    angle = (np.arange(200_000) + 0.5) * np.pi / 200_000
    cosine, ring = np.cos(angle), 2 * np.pi * np.sin(angle) * np.pi / 200_000
    density = for_each(phase, cosine)
    np.testing.assert_allclose(density @ ring, 1, atol=1e-4)
    np.testing.assert_allclose(density @ (ring * cosine), ANISOTROPIES, atol=1e-4)


def test_cosines_are_sampled_from_the_phase_function():
    """The cumulative distribution at the sampled cosine is the uniform number that it was sampled with."""
    uniform = np.linspace(0.005, 0.995, 199)
    drawn = for_each(lambda u, g: sample_phase(g, u, 0 * u)[2], uniform)
    for g, cosine in zip(ANISOTROPIES.astype(float), drawn, strict=True):
        # cumulative distribution of the Henyey–Greenstein phase function, in closed form, float64
        if abs(g) > 1e-3:
            below = (1 - g**2) / (2 * g) * (1 / np.sqrt(1 + g**2 - 2 * g * cosine) - 1 / (1 + g))
        else:
            below = (1 + cosine) / 2 + g * (cosine**2 - 1) * 3 / 4
        # a sharp peak amplifies the rounding of a float32 cosine
        slope = (1 + abs(g)) / (2 * (1 - abs(g)) ** 2)
        np.testing.assert_allclose(below, uniform, atol=5e-6 + 2 * slope * 1.2e-7)


def test_directions_turn_around_the_one_before():
    random = np.random.default_rng(0)
    first, second = jnp.asarray(random.random((2, 40_000)), jnp.float32)

    @jax.jit
    def turned(axis):
        around = sample_phase(jnp.float32(0.4), first, second)
        return jnp.stack(scattered(around, tuple(axis[:, None])), axis=-1), around[2]

    for axis in np.array([(0, 0, 1), (0, 0, -1), (1, 0, 0), (0.6, -0.64, 0.48)], np.float32):
        direction, cosine = (np.asarray(each, float) for each in turned(axis))
        np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1, atol=1e-6)
        np.testing.assert_allclose(direction @ axis, cosine, atol=1e-6)
        # the mean of the 40 000 is g times the axis, within 4 standard errors
        np.testing.assert_allclose(direction.mean(axis=0), 0.4 * axis, atol=4 / np.sqrt(40_000))
