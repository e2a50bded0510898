"""Entry and exit of rays: misses, grazing rays, rays along axes, origins inside, rays that look away."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.space import Affine, enter

from . import oracle
from .scenes import uniform_transfer


LOW, HIGH = np.array([0.0, -1.0, 2.0]), np.array([2.0, 0.0, 5.0])
BOX = jv.Volume(np.ones((5, 3, 4), np.float32), spacing=(0.5, 0.5, 1.0), origin=LOW)
SIGMA = 0.7
EXACT = jv.March(0.3, (jv.AlphaCorrection(),))


@jax.jit
def part_inside(origin, direction):
    ray = enter(Affine(BOX), apart(origin), apart(direction), (jnp.int32(0), jnp.int32(0)))
    return ray.t_in, ray.length, jnp.stack(ray.entry)


def see(origins, directions):
    """Render rays through the box, filled with a constant extinction."""
    rendering = jv.render_rays(
        BOX, uniform_transfer(SIGMA), np.array(origins, float), np.array(directions, float), EXACT
    )
    assert not np.any(rendering.exhausted)
    return rendering


CASES = {
    "through the middle along x": ((-3, -0.5, 3), (1, 0, 0), 2.0),
    "through the middle against z": ((1, -0.5, 9), (0, 0, -1), 3.0),
    "along y from inside": ((1, -0.25, 3), (0, -1, 0), 0.75),
    "from the centre, oblique": ((1, -0.5, 3.5), (3, 0, 4), 5 / 3),
    "misses": ((-3, 5, 3), (1, 0, 0), 0.0),
    "parallel to a face, just outside": ((-3, 0.001, 3), (1, 0, 0), 0.0),
    "looks away": ((-3, -0.5, 3), (-1, 0, 0), 0.0),
    "starts at the exit, looking out": ((2, -0.5, 3), (1, 0, 0), 0.0),
    "starts at the entry, looking in": ((0, -0.5, 3), (1, 0, 0), 2.0),
    "in a face": ((-3, 0, 3), (1, 0, 0), 2.0),
    "along an edge": ((-3, 0, 5), (1, 0, 0), 2.0),
    "touches a corner": ((-1, 0, 4), (1, 0, 1), 0.0),
    "through two opposite corners": ((-2, -2, -1), (2, 1, 3), np.sqrt(14.0)),
    "a direction of length 10": ((-3, -0.5, 3), (10, 0, 0), 2.0),
}


@pytest.mark.parametrize("case", CASES)
def test_the_length_inside_is_right(case):
    origin, direction, length = CASES[case]
    rendering = see([origin], [direction])
    opacity = 1 - np.exp(-SIGMA * length)
    np.testing.assert_allclose(rendering.rgba[0], np.full(4, opacity), atol=1e-6)
    assert (rendering.samples[0] == 0) == (length == 0)
    assert np.isinf(rendering.depth[0]) == (length == 0)


def test_a_ray_that_sees_nothing_is_all_zero():
    rendering = see([(-3, 5, 3)], [(1, 0, 0)])
    np.testing.assert_array_equal(rendering.rgba[0], 0)
    assert not rendering.aligned[0]


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31))
def test_entry_and_exit_agree_with_an_independent_clip(seed):
    random = np.random.default_rng(seed)
    origin = random.uniform(-4, 6, 3).astype(np.float32)
    direction = random.normal(size=3) * random.choice([0, 1e-3, 1], 3) + 1e-12
    direction = (direction / np.linalg.norm(direction)).astype(np.float32)
    t_in, length, entry = part_inside(origin, direction)
    (near,), (far,) = oracle.box_interval(
        origin[None].astype(float), direction[None].astype(float), LOW, HIGH
    )
    expected = max(far - near, 0)
    if expected > 1e-4:
        np.testing.assert_allclose(t_in, near, atol=1e-4)
        np.testing.assert_allclose(length, expected, atol=1e-4)
        assert (np.asarray(entry) > LOW - 1e-5).all()
        assert (np.asarray(entry) < HIGH + 1e-5).all()
    else:
        assert length < 2e-4


@pytest.mark.parametrize("case", CASES)
def test_gradients_of_entry_and_exit_are_finite(case):
    origin, direction, _ = CASES[case]
    direction = np.array(direction, np.float32) / np.linalg.norm(direction).astype(np.float32)
    for part in (0, 1):
        gradient = jax.grad(lambda o, d, part=part: part_inside(o, d)[part], argnums=(0, 1))(
            jnp.asarray(origin, jnp.float32), jnp.asarray(direction)
        )
        assert all(np.isfinite(g).all() for g in gradient)


def test_entry_and_exit_carry_gradients():
    origin, direction = jnp.asarray([-1.0, -0.6, 2.9]), jnp.asarray([0.8, 0.3, 0.5]) / jnp.sqrt(0.98)
    for part in (0, 1):
        gradient = jax.grad(lambda d, part=part: part_inside(origin, d)[part])(direction)
        for axis in range(3):
            nudge = np.zeros(3)
            nudge[axis] = 1e-5
            ends = [
                oracle.box_interval(np.array([origin], float), np.array([direction], float) + e, LOW, HIGH)
                for e in (nudge, -nudge)
            ]
            value = [(near if part == 0 else far - near)[0] for near, far in ends]
            np.testing.assert_allclose(gradient[axis], (value[0] - value[1]) / 2e-5, rtol=1e-3, atol=1e-3)


def test_depth_is_the_mean_distance_of_what_is_seen():
    opaque = jv.render_rays(BOX, uniform_transfer(1e6), [[-3, -0.5, 3]], [[1, 0, 0]], EXACT)
    np.testing.assert_allclose(opaque.depth, 3, atol=1e-6)  # the left rule samples a cell at its front
    fine = jv.March(0.002, (jv.AlphaCorrection(),), "midpoint")
    clear = jv.render_rays(BOX, uniform_transfer(SIGMA), [[-3, -0.5, 3]], [[1, 0, 0]], fine)
    t = np.linspace(0, 2, 20001)
    weight = np.exp(-SIGMA * t)
    np.testing.assert_allclose(clear.depth, 3 + np.average(t, weights=weight), atol=1e-4)


BAD = {
    "shapes differ": (np.zeros((4, 3)), np.ones((5, 3)), r"agree in shape; got \(4, 3\) and \(5, 3\)"),
    "not triples": (np.zeros((4, 2)), np.ones((4, 2)), r"origins must have shape \(\*rays, 3\)"),
    "no direction": (np.zeros((1, 3)), np.zeros((1, 3)), "directions must not have length 0"),
    "NaN": (np.full((1, 3), np.nan), np.ones((1, 3)), "origins must be finite"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_rays_are_named(case):
    origins, directions, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        jv.render_rays(BOX, uniform_transfer(1.0), origins, directions, EXACT)
