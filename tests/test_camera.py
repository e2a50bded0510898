"""Which ray does a camera give to which pixel?"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.camera import axes_of
from jaxvol.engine.rays import RayTiles
from jaxvol.engine.tiling import Tiling
from jaxvol.space import Affine

from .scenes import slow


POSITION, FOCUS = (3.0, -4.0, 2.0), (0.5, 1.0, 0.0)
BOX = jv.Volume(np.zeros((4, 5, 6), np.uint8), spacing=(10, 3, 1), origin=(7, -5, 2))


def unit(v):
    return np.asarray(v) / np.linalg.norm(v)


def test_the_middle_of_the_image_looks_at_the_focal_point():
    origins, directions = jv.Camera(POSITION, FOCUS, (0, 0, 1), size=(5, 3)).rays()
    assert origins.shape == directions.shape == (3, 5, 3)
    np.testing.assert_allclose(directions[1, 2], unit(np.subtract(FOCUS, POSITION)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-6)
    np.testing.assert_allclose(origins, np.broadcast_to(POSITION, origins.shape), atol=1e-7)


@pytest.mark.parametrize("parallel_scale", [None, 2.0])
def test_pixel_0_0_is_the_top_left(parallel_scale):
    camera = jv.Camera((0, 0, 5), (0, 0, 0), (0, 1, 0), size=(8, 6), parallel_scale=parallel_scale)
    origins, directions = camera.rays()
    seen = origins + 5 * directions
    assert seen[0, 0, 0] < 0 < seen[0, -1, 0]  # x to the right, looking along -z with y up
    assert seen[0, 0, 1] > 0 > seen[-1, 0, 1]


def test_view_angle_spans_the_height_and_pixels_are_square():
    _, directions = jv.Camera((0, 0, 1), (0, 0, 0), size=(40, 20), view_angle=50).rays()
    plane = np.asarray(directions / -directions[..., 2:])
    pixel = 2 * np.tan(np.radians(25)) / 20
    np.testing.assert_allclose(plane[0, 0, :2], (-19.5 * pixel, 9.5 * pixel), rtol=1e-5)
    np.testing.assert_allclose(np.diff(plane[:, :, 0], axis=1), pixel, rtol=1e-4)
    np.testing.assert_allclose(np.diff(plane[:, :, 1], axis=0), -pixel, rtol=1e-4)


def test_parallel_scale_is_half_the_height():
    origins, directions = jv.Camera((0, 0, 1), (0, 0, 0), size=(40, 20), parallel_scale=3).rays()
    np.testing.assert_allclose(directions, np.broadcast_to((0, 0, -1), directions.shape), atol=1e-7)
    np.testing.assert_allclose(origins[0, 0], (-5.85, 2.85, 1), rtol=1e-6)


@pytest.mark.parametrize("parallel_scale", [None, 2.0])
def test_crop_gives_the_same_rays(parallel_scale):
    camera = jv.Camera(POSITION, FOCUS, (0, 0, 1), size=(30, 20), parallel_scale=parallel_scale)
    crop = camera.crop(7, 3, 12, 9)
    assert crop.size == (12, 9)
    for part, whole in zip(crop.rays(), camera.rays(), strict=True):
        np.testing.assert_allclose(part, whole[3:12, 7:19], atol=1e-6)
    for part, whole in zip(crop.crop(2, 1, 4, 5).rays(), camera.rays(), strict=True):
        np.testing.assert_allclose(part, whole[4:9, 9:13], atol=1e-6)


def test_zoom_magnifies_around_a_point():
    camera = jv.Camera(POSITION, FOCUS, (0, 0, 1), size=(40, 20))
    _, whole = camera.rays()
    _, zoomed = camera.zoom(4).rays()
    # the middle quarter at four times the resolution: average blocks of 4 x 4 pixels
    coarse = unit_each(zoomed.reshape(5, 4, 10, 4, 3).sum((1, 3)))
    np.testing.assert_allclose(coarse[2, 5], unit(whole[9:11, 20:21].sum((0, 1))), atol=2e-2)
    _, corner = camera.zoom(2, center=(0.25, 0.25)).rays()
    np.testing.assert_allclose(unit(corner[0:2, 0:2].sum((0, 1))), whole[0, 0], atol=1e-4)


def unit_each(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def test_one_field_can_be_replaced():
    crop = jv.Camera(POSITION, FOCUS, (0, 0, 1), size=(8, 6)).crop(2, 1, 4, 3)
    other = replace(crop, view_angle=20)
    assert float(other.view_angle) == 20
    np.testing.assert_array_equal(other.corner, (2, 1))
    same = replace(other, view_angle=crop.view_angle)
    for one, two in zip(jax.tree.leaves(same), jax.tree.leaves(crop), strict=True):
        np.testing.assert_array_equal(one, two)


def test_looking_at_sees_every_corner_of_the_volume():
    low, high = (np.asarray(end) for end in BOX.corners)
    for size in ((40, 20), (20, 40)):
        camera = jv.Camera.looking_at(BOX, (1, 2, 0.5), size=size)
        right, up, forward = (np.asarray(axis) for axis in axes_of(camera))
        for corner in np.stack(np.meshgrid(*zip(low, high, strict=True)), -1).reshape(-1, 3):
            view = corner - np.asarray(camera.position)
            height = np.tan(np.radians(15)) * (view @ forward)
            assert abs(view @ up) <= height
            assert abs(view @ right) <= height * size[0] / size[1]


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (1, 0, 0)])
@pytest.mark.parametrize("sign", [1, -1])
def test_looking_at_from_above_and_below_picks_another_up(up, sign):
    right, upward, forward = (
        np.asarray(axis) for axis in axes_of(jv.Camera.looking_at(BOX, sign * np.array(up), up))
    )
    np.testing.assert_allclose(forward, -sign * np.array(up), atol=1e-6)
    np.testing.assert_allclose(upward, (0, 0, -1) if up == (0, 1, 0) else (0, 1, 0), atol=1e-6)
    if sign > 0 and up != (1, 0, 0):
        np.testing.assert_allclose(right, (1, 0, 0), atol=1e-6)


def test_looking_at_under_jit_from_above_and_aside_is_the_same():
    for direction in ((0.0, 0.0, 2.0), (0.5, -1.0, 0.4)):
        traced = jax.jit(lambda d: jv.Camera.looking_at(BOX, d))(jnp.asarray(direction))
        for one, other in zip(
            jax.tree.leaves(traced), jax.tree.leaves(jv.Camera.looking_at(BOX, direction)), strict=True
        ):
            np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("size", [(40, 20), (20, 40)])
def test_an_orthographic_view_just_holds_the_sphere_around_the_volume(size):
    camera = jv.Camera.looking_at(BOX, (1, 2, 0.5), parallel=True, size=size)
    low, high = (np.asarray(corner) for corner in BOX.corners)
    radius = np.linalg.norm(high - low) / 2
    origins, directions = camera.rays()
    assert np.ptp(directions, axis=(0, 1)).max() < 1e-6
    width, height = (np.linalg.norm(np.asarray(origins[i] - origins[0, 0])) for i in ((0, -1), (-1, 0)))
    shorter = min(width * size[0] / (size[0] - 1), height * size[1] / (size[1] - 1))
    assert shorter == pytest.approx(2 * radius, rel=1e-4)
    assert np.linalg.norm(np.asarray(camera.position - BOX.center)) > radius


def test_rays_are_differentiable_in_the_camera():
    def middle(position):
        return jv.Camera(position, FOCUS, (0, 0, 1), size=(3, 3)).rays()[1][1, 1]

    jacobian = jax.jacfwd(middle)(jnp.asarray(POSITION))
    view = np.subtract(FOCUS, POSITION)
    expected = -(np.eye(3) - np.outer(unit(view), unit(view))) / np.linalg.norm(view)
    np.testing.assert_allclose(jacobian, expected, atol=1e-6)


@pytest.mark.parametrize("parallel_scale", [None, *slow(2.1)])
def test_rays_round_alike_whether_or_not_they_are_differentiated(parallel_scale):
    """Otherwise image, replay and forward mode would sample different positions, 1e-4 voxels apart."""
    # numbers that are not exact in float32
    place = (5.1, -6.2, 4.3), (0.53, 1.07, 0.9), (0.1, 0.2, 1.0)
    camera = jv.Camera(*place, 33.3, size=(64, 64), parallel_scale=parallel_scale)
    volume = jv.Volume(np.ones((9, 9, 9), np.float32), (0.31, 0.37, 0.29))
    tiles = RayTiles.of(camera, Tiling())

    def floats(given):
        camera, volume = given
        return eqx.filter(tiles.rays(camera, Affine(volume), jnp.int32(0)), eqx.is_inexact_array)

    @jax.jit
    def pulled(given):
        found, pull = jax.vjp(floats, given)
        return found, pull(found)

    given = camera, volume
    plain = jax.jit(floats)(given)
    assert float(plain.length.max()) > 1
    change = jax.tree.map(jnp.ones_like, given)
    forward, _ = jax.jit(lambda given: jax.jvp(floats, (given,), (change,)))(given)
    for other in (forward, pulled(given)[0]):
        for one, two in zip(jax.tree.leaves(plain), jax.tree.leaves(other), strict=True):
            np.testing.assert_array_equal(one, two)


BAD = {
    "at its focal point": (lambda: jv.Camera(FOCUS, FOCUS), "position must differ from focal_point"),
    "up along the view": (
        lambda: jv.Camera((0, 5, 0), (0, 0, 0), (0, 1, 0)),
        "view_up must not be zero or point along",
    ),
    "up zero": (lambda: jv.Camera((0, 5, 0), (0, 0, 0), (0, 0, 0)), "view_up must not be zero"),
    "size 0": (lambda: jv.Camera(POSITION, FOCUS, size=(0, 5)), r"size must be .* at least 1; got \(0, 5\)"),
    "half a pixel": (lambda: jv.Camera(POSITION, FOCUS, size=(4.5, 5)), "size must be"),
    "size of text": (lambda: jv.Camera(POSITION, FOCUS, size="512x512"), "size must be .*got '512x512'"),
    "crop by halves": (
        lambda: jv.Camera(POSITION, FOCUS, size=(9, 9)).crop(1.5, 0, 5, 2),
        "left must be an integer of at least 0; got 1.5",
    ),
    "an array": (
        lambda: jv.Camera.looking_at(np.zeros((4, 4, 4))),
        "volume must be a jaxvol Volume; got a NumPy",
    ),
    "no up": (lambda: jv.Camera.looking_at(BOX, view_up=(0, 0, 0)), "view_up must not be zero"),
    "one size": (lambda: jv.Camera(POSITION, FOCUS, size=5), "size must be"),
    "angle 180": (
        lambda: jv.Camera(POSITION, FOCUS, view_angle=180),
        "view_angle must be .* less than 180 degrees",
    ),
    "NaN": (lambda: jv.Camera((0, np.nan, 0), FOCUS), "position must be finite"),
    "scale 0": (
        lambda: jv.Camera(POSITION, FOCUS, parallel_scale=0),
        "parallel_scale must be greater than 0",
    ),
    "crop outside": (
        lambda: jv.Camera(POSITION, FOCUS, size=(9, 9)).crop(5, 5, 5, 2),
        "crop must be a rectangle inside",
    ),
    "zoom 0": (lambda: jv.Camera(POSITION, FOCUS).zoom(0), "zoom factor must be greater than 0"),
    "no direction": (
        lambda: jv.Camera.looking_at(jv.Volume(np.zeros((2, 2, 2), np.uint8)), (0, 0, 0)),
        "direction must not be zero",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    make, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        make()
