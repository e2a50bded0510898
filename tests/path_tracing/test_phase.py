"""Are directions sampled from the phase function?"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol.path_tracing.phase import phase, sample_phase, scattered, scattered_cosine


ANISOTROPIES = [-0.95, -0.5, -1e-4, 0.0, 1e-6, 0.3, 0.9, 0.99]


@pytest.mark.parametrize("g", ANISOTROPIES)
def test_the_phase_function_is_a_density_of_mean_cosine_g(g):
    angle = (np.arange(200_000) + 0.5) * np.pi / 200_000
    cosine, ring = np.cos(angle), 2 * np.pi * np.sin(angle) * np.pi / 200_000
    density = np.asarray(phase(jnp.asarray(cosine, jnp.float32), jnp.float32(g)), float)
    np.testing.assert_allclose(np.sum(density * ring), 1, atol=1e-4)
    np.testing.assert_allclose(np.sum(density * ring * cosine), g, atol=1e-4)


@pytest.mark.parametrize("g", ANISOTROPIES)
def test_cosines_are_sampled_from_the_phase_function(g):
    """The cumulative distribution at the sampled cosine is the uniform number that it was sampled with."""
    uniform = np.linspace(0.005, 0.995, 199)
    drawn = np.asarray(scattered_cosine(jnp.float32(g), jnp.asarray(uniform, jnp.float32)), float)
    # cumulative distribution of the Henyey–Greenstein phase function, in closed form, float64
    g64 = float(np.float32(g))
    if abs(g64) > 1e-3:
        below = (1 - g64**2) / (2 * g64) * (1 / np.sqrt(1 + g64**2 - 2 * g64 * drawn) - 1 / (1 + g64))
    else:
        below = (1 + drawn) / 2 + g64 * (drawn**2 - 1) * 3 / 4
    # a sharp peak amplifies the rounding of a float32 cosine
    slope = (1 + abs(g)) / (2 * (1 - abs(g)) ** 2)
    np.testing.assert_allclose(below, uniform, atol=5e-6 + 2 * slope * 1.2e-7)


@pytest.mark.parametrize("axis", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0.6, -0.64, 0.48)])
def test_directions_turn_around_the_one_before(axis):
    axis = np.asarray(axis, np.float32)
    first, second = jax.random.uniform(jax.random.key(0), (2, 40_000))
    around = sample_phase(jnp.float32(0.4), first, second)
    x, y, z = (jnp.full(40_000, a) for a in axis)
    x, y, z = scattered(around, (x, y, z))
    direction = np.stack([x, y, z], axis=-1).astype(float)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1, atol=1e-6)
    np.testing.assert_allclose(direction @ axis, around[2], atol=1e-6)
    # the mean of the 40 000 is g times the axis, within 4 standard errors
    np.testing.assert_allclose(direction.mean(axis=0), 0.4 * axis, atol=4 / np.sqrt(40_000))
