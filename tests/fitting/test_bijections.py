"""Constraints on parameters, and poses of a camera."""

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


@pytest.mark.parametrize("case", BOUNDED)
def test_forward_undoes_inverse(case):
    bijection, values = BOUNDED[case]
    free = bijection.inverse(values)
    assert np.all(np.isfinite(free))
    np.testing.assert_allclose(bijection.forward(free), values, rtol=2e-6)


@pytest.mark.parametrize("case", BOUNDED)
def test_all_real_numbers_are_allowed_and_differentiable(case):
    bijection, _ = BOUNDED[case]
    free = jnp.linspace(-80, 80, 33)
    value, slope = jax.vmap(jax.value_and_grad(bijection.forward))(free)
    assert np.all(np.isfinite(value))
    assert np.all(np.isfinite(slope) & (slope >= 0))
    if case != "unconstrained":
        assert np.all(value >= 0)
    if case == "unit interval":
        assert np.all(value <= 1)


def test_starts_on_the_edge_begin_a_margin_away_from_it():
    for bijection, edge, begun in (
        (jv.Positive(20.0), 0.0, 20 * MARGIN),
        (jv.UnitInterval(), 0.0, MARGIN),
        (jv.UnitInterval(), 1.0, 1 - MARGIN),
    ):
        np.testing.assert_allclose(bijection.forward(bijection.inverse([edge])), [begun], rtol=1e-4)


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


def test_scale_must_be_positive():
    with pytest.raises(ValueError, match="scale must be greater than 0; got 0"):
        jv.Positive(0)


@pytest.mark.parametrize("angle", [0.0, 1e-5, 9e-4, 1.1e-3, 0.3, 3.0])
def test_rotation_is_that_of_scipy_and_its_slope_that_of_differences(angle):
    with in_float64():
        turn = angle * jnp.asarray([0.6, -0.64, 0.48])
        vector = jnp.asarray([0.3, -2.0, 1.1])
        turned = Rotation.from_rotvec(np.array(turn)).apply(np.array(vector))
        np.testing.assert_allclose(rotate(turn, vector), turned, rtol=0, atol=1e-12)
        slope = jax.jacfwd(rotate)(turn, vector)
        for axis, step in enumerate(1e-5 * jnp.eye(3)):
            difference = (rotate(turn + step, vector) - rotate(turn - step, vector)) / 2e-5
            np.testing.assert_allclose(slope[:, axis], difference, rtol=0, atol=1e-8)


@pytest.fixture
def camera():
    return jv.Camera((1.0, -3.0, 0.5), (0.1, 0.2, -0.1), (0.1, 0.0, 1.0), 40.0, size=(12, 8))


def test_a_pose_is_a_rigid_motion_that_can_be_undone(camera):
    pose = jv.Pose(camera)
    free = {"rotation": jnp.asarray([0.2, -0.5, 0.9]), "translation": jnp.asarray([0.1, 0.3, -0.2])}
    moved = pose.forward(free)
    lengths = [float(jnp.linalg.norm(c.position - c.focal_point)) for c in (camera, moved)]
    assert lengths[1] == pytest.approx(lengths[0], rel=1e-6)
    assert (moved.size, float(moved.view_angle)) == (camera.size, 40)
    back = pose.inverse(moved)
    for name, value in free.items():
        np.testing.assert_allclose(back[name], value, atol=2e-6)
    again = pose.forward(back)
    for rays, same in zip(again.rays(), moved.rays(), strict=True):
        np.testing.assert_allclose(rays, same, atol=2e-6)


def test_a_pose_starts_at_its_camera(camera):
    pose = jv.Pose(camera)
    assert all(np.all(abs(leaf) < 1e-6) for leaf in jax.tree.leaves(pose.inverse(camera)))
    for a, b in zip(
        jax.tree.leaves(pose.forward(pose.inverse(camera))), jax.tree.leaves(camera), strict=True
    ):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7)


def test_a_camera_that_no_motion_yields_is_refused(camera):
    with pytest.raises(ValueError, match="view must be a camera that differs from the pose's start"):
        jv.Pose(camera).inverse(jv.Camera((9.0, 0, 0), (0, 0, 0), (0, 0, 1), 40.0, size=(12, 8)), "view")
