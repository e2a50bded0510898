"""Are constrained parameters, and poses of a camera, free variables without bounds?"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxvol as jv
from jaxvol.fitting.bijections import MARGIN, rotate

from ..scenes import in_float64


BOUNDED = {
    "unconstrained": (jv.Unconstrained(), [-1e3, -0.5, 0.0, 2.0, 1e3]),
    "positive": (jv.Positive(), [0.01, 0.5, 1.0, 30.0, 1e4]),
    "positive, scaled": (jv.Positive(50.0), [0.06, 0.5, 1.0, 30.0, 1e5]),
    "unit interval": (jv.UnitInterval(), [MARGIN, 0.1, 0.5, 0.9, 1 - MARGIN]),
}


@eqx.filter_jit
def inverse(bijection, value):
    return bijection.inverse(value)


@eqx.filter_jit
def with_slopes(bijection, free):
    return jax.vmap(jax.value_and_grad(bijection.forward))(free)


@pytest.mark.parametrize("case", BOUNDED)
def test_any_real_number_is_allowed_and_forward_undoes_inverse(case):
    bijection, values = BOUNDED[case]
    known = inverse(bijection, np.float32(values))
    assert np.all(np.isfinite(known))
    free = np.concatenate([known, np.linspace(-80, 80, 27, dtype=np.float32)])
    value, slope = map(np.asarray, with_slopes(bijection, free))
    np.testing.assert_allclose(value[:5], values, rtol=2e-6)
    assert np.all(np.isfinite(value))
    assert np.all(np.isfinite(slope) & (slope >= 0))
    if case != "unconstrained":
        assert np.all(value >= 0)
    if case == "unit interval":
        assert np.all(value <= 1)


def test_starts_on_the_edge_begin_a_margin_away_from_it():
    for bijection, edges, begun in (
        (jv.Positive(20.0), [0, 0, 0, 0, 0], 20 * MARGIN),
        (jv.UnitInterval(), [0, 1, 0, 1, 0], MARGIN),
    ):
        free = np.resize(inverse(bijection, np.array(edges, np.float32)), 32)
        value = with_slopes(bijection, free)[0][:5]
        np.testing.assert_allclose(np.abs(np.asarray(value) - edges), begun, rtol=1e-4)


def test_any_step_of_an_optimiser_keeps_parameters_within_bounds():
    """By Optax, in one program; the slope is that of the softplus, and what is fixed is there as it was."""
    optax = pytest.importorskip("optax", reason="pip install -e '.[fit]'")
    optimizer, bounds = optax.sgd(10.0), {"glow": jv.Positive(2.0), "parts": None}

    @jax.jit
    def stepped(glow):
        start = {"glow": glow, "parts": ("x", 3)}
        free, constrain = jv.unconstrain(start, constraints=bounds)
        slope = jax.grad(lambda free: jnp.sum(constrain(free)["glow"]))(free)
        updates, _ = optimizer.update(slope, optimizer.init(free))
        after = constrain(optax.apply_updates(free, updates))
        assert after["parts"] == ("x", 3)
        return constrain(free)["glow"], jax.tree.leaves(slope)[0], after["glow"]

    start = np.array([0.2, 3.0], np.float32)
    begun, slope, after = map(np.asarray, stepped(start))
    np.testing.assert_allclose(begun, start, rtol=1e-5)
    # of a value v = scale · softplus(free), it is scale · (1 - exp(-v / scale))
    np.testing.assert_allclose(slope, 2 * (1 - np.exp(-start / 2)), rtol=1e-5)
    assert np.all((after > 0) & (after < start))


BAD = {
    "negative": (jv.Positive(), [0.5, -0.1], r"glow must not be negative to be fitted; got \[ *0.5 *-0.1"),
    "above 1": (jv.UnitInterval(), [0.5, 1.1], r"glow must be in \[0, 1\] to be fitted"),
    "NaN": (jv.Unconstrained(), [np.nan], "glow must be finite"),
    "infinite": (jv.Positive(), [np.inf], "glow must be finite"),
}


@pytest.mark.parametrize("case", BAD)
def test_values_out_of_bounds_are_named(case):
    bijection, value, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        bijection.inverse(value, "glow")


def test_reach_is_a_factor_near_0_and_relative_far_away():
    free = jnp.array([-8.0, 0.5, 8.0])
    assert jv.Positive().reach(free).tolist() == [1, 1, 4]  # below 0, free is a logarithm
    assert jv.Unconstrained().reach(free).tolist() == [4, 1, 4]
    assert jv.UnitInterval().reach(free).tolist() == [1, 1, 1]


def test_scale_must_be_positive():
    with pytest.raises(ValueError, match="scale must be greater than 0; got 0"):
        jv.Positive(0)


def test_rotation_is_that_of_scipy_and_its_slope_that_of_differences():
    angles = np.array([0.0, 1e-5, 9e-4, 1.1e-3, 0.3, 3.0])  # 1e-3 is where its series begins
    turns, vector = angles[:, None] * [0.6, -0.64, 0.48], np.array([0.3, -2.0, 1.1])

    @jax.jit
    @jax.vmap
    def turned(turn):
        of_turn = partial(rotate, vector=jnp.asarray(vector))
        ahead, behind = (jax.vmap(of_turn)(turn[None] + step * jnp.eye(3)) for step in (1e-5, -1e-5))
        return of_turn(turn), jax.jacfwd(of_turn)(turn), (ahead - behind).T / 2e-5

    with in_float64():
        found, slope, difference = turned(turns)
    np.testing.assert_allclose(found, Rotation.from_rotvec(turns).apply(vector), rtol=0, atol=1e-12)
    np.testing.assert_allclose(slope, difference, rtol=0, atol=1e-8)


# -- poses ------------------------------------------------------------------------------------------------


@eqx.filter_jit
def moved(pose, free):
    camera = pose.forward(free)
    return camera, camera.rays()


@pytest.fixture
def camera():
    return jv.Camera((1.0, -3.0, 0.5), (0.1, 0.2, -0.1), (0.1, 0.0, 1.0), 40.0, size=(12, 8))


def test_a_pose_is_a_rigid_motion_that_can_be_undone(camera):
    pose = jv.Pose(camera)
    free = {"rotation": np.float32([0.2, -0.5, 0.9]), "translation": np.float32([0.1, 0.3, -0.2])}
    there, rays = moved(pose, free)
    arms = [np.asarray(c.position) - np.asarray(c.focal_point) for c in (camera, there)]
    assert np.linalg.norm(arms[1]) == pytest.approx(np.linalg.norm(arms[0]), rel=1e-6)
    assert (there.size, float(there.view_angle)) == (camera.size, 40)
    back = pose.inverse(there)
    for name, value in free.items():
        np.testing.assert_allclose(back[name], value, atol=2e-6)
    for again, same in zip(moved(pose, back)[1], rays, strict=True):
        np.testing.assert_allclose(again, same, atol=2e-6)


def test_a_pose_starts_at_its_camera(camera):
    start = jv.Pose(camera).inverse(camera)
    assert all(np.all(np.abs(leaf) < 1e-6) for leaf in jax.tree.leaves(start))
    here = moved(jv.Pose(camera), start)[0]
    for a, b in zip(jax.tree.leaves(here), jax.tree.leaves(camera), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7)


def test_a_camera_that_no_motion_yields_is_refused(camera):
    with pytest.raises(ValueError, match="view must be a camera that differs from the pose's start"):
        jv.Pose(camera).inverse(jv.Camera((9.0, 0, 0), (0, 0, 0), (0, 0, 1), 40.0, size=(12, 8)), "view")
