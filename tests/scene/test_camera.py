"""Which ray does a camera give to which pixel?"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.engine.rays import RayTiles
from jaxvol.engine.tiling import Tiling
from jaxvol.scene.camera import axes_of
from jaxvol.scene.space import Affine

from ..scenes import in_float64, same_trees


POSITION, FOCUS = (3.0, -4.0, 2.0), (0.5, 1.0, 0.0)
BOX = jv.Volume(np.zeros((4, 5, 6), np.uint8), spacing=(10, 3, 1), origin=(7, -5, 2))
SIZE = (40, 20)


def unit(v):
    return np.asarray(v) / np.linalg.norm(v)


def between(directions, *pixels):
    """The direction in the middle of some pixels."""
    return unit(sum(np.asarray(directions)[pixel] for pixel in pixels))


def middle(directions):
    """The direction in the middle of the image."""
    return between(directions, (9, 19), (10, 19), (9, 20), (10, 20))


def test_perspective_rays_lie_where_their_angles_say():
    origins, directions = jv.Camera(POSITION, FOCUS, (0, 0, 1), size=SIZE).rays()
    assert origins.shape == directions.shape == (20, 40, 3)
    np.testing.assert_allclose(middle(directions), unit(np.subtract(FOCUS, POSITION)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-6)
    np.testing.assert_allclose(origins, np.broadcast_to(POSITION, origins.shape), atol=1e-7)
    # pixel (0, 0) is the top left, the angle spans the height, and pixels are square
    _, directions = map(np.asarray, jv.Camera((0, 0, 1), (0, 0, 0), size=SIZE, view_angle=50).rays())
    plane = directions / -directions[..., 2:]
    pixel = 2 * np.tan(np.radians(25)) / 20
    np.testing.assert_allclose(plane[0, 0, :2], (-19.5 * pixel, 9.5 * pixel), rtol=1e-5)
    np.testing.assert_allclose(np.diff(plane[:, :, 0], axis=1), pixel, rtol=1e-4)
    np.testing.assert_allclose(np.diff(plane[:, :, 1], axis=0), -pixel, rtol=1e-4)


def test_parallel_scale_is_half_the_height():
    camera = jv.Camera((0, 0, 1), (0, 0, 0), size=SIZE, parallel_scale=3)
    for wrong in (0.0, -3.0):  # as an optimiser may put in its place
        broken = eqx.tree_at(lambda c: c.parallel_scale, camera, jax.device_put(np.float32(wrong)))
        assert np.isnan(broken.rays()[0]).all()
    origins, directions = camera.rays()
    np.testing.assert_allclose(directions, np.broadcast_to((0, 0, -1), directions.shape), atol=1e-7)
    np.testing.assert_allclose(np.asarray(origins)[0, 0], (-5.85, 2.85, 1), rtol=1e-6)
    np.testing.assert_allclose(np.asarray(origins)[-1, -1], (5.85, -2.85, 1), rtol=1e-6)


@pytest.mark.parametrize("parallel_scale", [None, 2.0])
def test_crop_gives_the_same_rays(parallel_scale):
    camera = jv.Camera(POSITION, FOCUS, (0, 0, 1), size=SIZE, parallel_scale=parallel_scale)
    crop = camera.crop(17, 3, 12, 9)
    assert crop.size == (12, 9)
    whole = [np.asarray(part) for part in camera.rays()]
    for part, full in zip(crop.rays(), whole, strict=True):
        np.testing.assert_allclose(part, full[3:12, 17:29], atol=1e-6)
    twice = camera.crop(10, 1, 25, 15).crop(7, 2, 12, 9)
    for part, full in zip(twice.rays(), whole, strict=True):
        np.testing.assert_allclose(part, full[3:12, 17:29], atol=1e-6)
    # another field replaced
    other = replace(crop, view_angle=20)
    assert float(other.view_angle) == 20
    np.testing.assert_array_equal(other.corner, (17, 3))
    assert same_trees(replace(other, view_angle=crop.view_angle), crop)


def test_crops_at_traced_corners_are_one_program():
    camera, crops = jv.Camera(POSITION, FOCUS, (0, 0, 1), size=SIZE), []
    rays = jax.jit(lambda left: crops.append(left) or camera.crop(left, 3, 12, 9).rays()[1])
    for left in (17, 0):
        np.testing.assert_allclose(
            rays(left), np.asarray(camera.rays()[1])[3:12, left : left + 12], atol=1e-6
        )
    assert len(crops) == 1


def test_zoom_magnifies_around_a_point():
    camera = jv.Camera(POSITION, FOCUS, (0, 0, 1), size=SIZE)
    _, whole = camera.rays()
    _, zoomed = map(np.asarray, camera.zoom(4).rays())
    # the middle quarter at four times the resolution: average blocks of 4 x 4 pixels
    blocks = zoomed.reshape(5, 4, 10, 4, 3).sum((1, 3))
    np.testing.assert_allclose(unit(blocks[2, 5]), between(whole, (9, 20), (10, 20)), atol=2e-2)
    _, corner = camera.zoom(2, center=(0.25, 0.25)).rays()
    found = between(corner, (0, 0), (0, 1), (1, 0), (1, 1))
    np.testing.assert_allclose(found, np.asarray(whole)[0, 0], atol=1e-4)


@pytest.mark.parametrize("size", [SIZE, (20, 40)])
def test_looking_at_sees_every_corner_of_the_volume(size):
    low, high = (np.asarray(end) for end in BOX.corners)
    camera = jv.Camera.looking_at(BOX, (1, 2, 0.5), size=size)
    right, up, forward = (np.asarray(axis) for axis in axes_of(camera))
    for corner in np.stack(np.meshgrid(*zip(low, high, strict=True)), -1).reshape(-1, 3):
        view = corner - np.asarray(camera.position)
        height = np.tan(np.radians(15)) * (view @ forward)
        assert abs(view @ up) <= height
        assert abs(view @ right) <= height * size[0] / size[1]
    # parallel rays just hold the sphere around the volume
    camera = jv.Camera.looking_at(BOX, (1, 2, 0.5), parallel=True, size=size)
    radius = np.linalg.norm(high - low) / 2
    origins, directions = map(np.asarray, camera.rays())
    assert np.ptp(directions, axis=(0, 1)).max() < 1e-6
    width, height = (np.linalg.norm(origins[i] - origins[0, 0]) for i in ((0, -1), (-1, 0)))
    shorter = min(width * size[0] / (size[0] - 1), height * size[1] / (size[1] - 1))
    assert shorter == pytest.approx(2 * radius, rel=1e-4)
    assert np.linalg.norm(np.asarray(camera.position) - np.asarray(BOX.center)) > radius


def test_looking_at_from_above_and_below_picks_another_up():
    for up in ((0, 0, 1), (0, 1, 0), (1, 0, 0)):
        for sign in (1, -1):
            camera = jv.Camera.looking_at(BOX, sign * np.array(up), up)
            right, upward, forward = (np.asarray(axis) for axis in axes_of(camera))
            np.testing.assert_allclose(forward, -sign * np.array(up), atol=1e-6)
            np.testing.assert_allclose(upward, (0, 0, -1) if up == (0, 1, 0) else (0, 1, 0), atol=1e-6)
            if sign > 0 and up != (1, 0, 0):
                np.testing.assert_allclose(right, (1, 0, 0), atol=1e-6)
    traced = jax.jit(lambda d: jv.Camera.looking_at(BOX, d))
    for direction in ((0.0, 0.0, 2.0), (0.5, -1.0, 0.4)):
        leaves = jax.tree.leaves(traced(np.array(direction, np.float32)))
        for one, other in zip(leaves, jax.tree.leaves(jv.Camera.looking_at(BOX, direction)), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-4)


def test_rays_are_differentiable_in_the_camera():
    def middle(position):
        return jnp.stack(jv.Camera(position, FOCUS, (0, 0, 1), size=(3, 3)).ray(1, 1)[1])

    jacobian = jax.jit(jax.jacfwd(middle))(np.array(POSITION, np.float32))
    view = np.subtract(FOCUS, POSITION)
    expected = -(np.eye(3) - np.outer(unit(view), unit(view))) / np.linalg.norm(view)
    np.testing.assert_allclose(jacobian, expected, atol=1e-6)


@pytest.mark.slow  # the fast tests compile other programs than users do
def test_rays_round_alike_whether_or_not_they_are_differentiated():
    """Otherwise image, replay and forward mode would sample different positions, 1e-4 voxels apart."""
    # numbers that are not exact in float32
    place = (5.1, -6.2, 4.3), (0.53, 1.07, 0.9), (0.1, 0.2, 1.0)
    camera = jv.Camera(*place, 33.3, size=(64, 64), parallel_scale=None)
    volume = jv.Volume(np.ones((9, 9, 9), np.float32), (0.31, 0.37, 0.29))
    tiles = RayTiles.of(camera, Tiling())

    def floats(given):
        camera, volume = given
        rays = tiles.rays(camera, Affine(volume), jnp.int32(0), jnp.zeros((), bool))
        return eqx.filter(rays, eqx.is_inexact_array)

    @jax.jit
    def pulled(given):
        found, pull = jax.vjp(floats, given)
        return found, pull(found)

    given = camera, volume
    plain = jax.jit(floats)(given)
    assert np.asarray(plain.length).max() > 1
    change = jax.tree.map(np.ones_like, given)
    forward, _ = jax.jit(lambda given: jax.jvp(floats, (given,), (change,)))(given)
    for other in (forward, pulled(given)[0]):
        for one, two in zip(jax.tree.leaves(plain), jax.tree.leaves(other), strict=True):
            np.testing.assert_array_equal(one, two)


K = np.array([[210.0, 0, 61], [0, 205, 50], [0, 0, 1]])
R = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
R = R * np.linalg.det(R)
T = np.array([0.4, -0.3, 5.0])


def test_a_calibrated_camera_sees_points_where_opencv_projects_them():
    """And its derivatives are those of OpenCV's formula."""

    def unprojected(K, R, t, u, depth):
        way = np.append((u - K[:2, 2]) / np.diag(K)[:2], 1)
        return R.T @ (depth * way / np.linalg.norm(way) - t)

    def point(K, R, t, u, depth):
        return jv.Camera.from_intrinsics(K, R, t, (128, 96)).point(u[0] - 0.5, u[1] - 0.5, depth)

    with in_float64():
        found = jax.jit(lambda *given: (point(*given), jax.jacrev(point, argnums=(0, 1, 2))(*given)))
        for world in np.random.default_rng(1).normal(size=(5, 3)):
            there = R @ world + T
            u, depth = ((K @ there) / there[2])[:2], np.linalg.norm(there)
            seen, slopes = jax.device_get(found(*jax.device_put((K, R, T, u, depth))))
            np.testing.assert_allclose(seen, world, atol=1e-12)
            turn = np.cross(np.eye(3), (0.3, -0.5, 0.8)) @ R  # of rotations
            for i, way in enumerate((np.where(K > 1, 1.0, 0), turn, np.array([0.5, 1, -1]))):
                ends: list = []
                for step in (1e-6, -1e-6):
                    k, r, t = (part + step * way if i == n else part for n, part in enumerate((K, R, T)))
                    ends.append(unprojected(k, r, t, u, depth))
                expected = (ends[0] - ends[1]) / 2e-6
                np.testing.assert_allclose(np.tensordot(slopes[i], way, way.ndim), expected, atol=1e-8)
        assert np.isnan(jax.device_get(found(*jax.device_put((K, R, T, K[:2, 2], np.inf)))[0])).all()


def test_a_detector_is_seen_pixel_by_pixel():
    """From in front, from behind, and by parallel rays."""
    source, center, right = np.array([300.0, -400, 90]), np.array([-20.0, 150, 10]), np.array([0, 0.1, 2.0])
    pitch, size = np.array([0.7, 0.4]), (12, 9)
    row, column = np.mgrid[: size[1], : size[0]] * 1.0

    @jax.jit
    def points(source, center, right, down, pitch, far):
        places = source, center, right, down, pitch, size
        cameras = (jv.Camera.from_detector(*places, parallel=parallel) for parallel in (False, True))
        return [camera.point(column, row, away) for camera, away in zip(cameras, far, strict=True)]

    with in_float64():
        for down in (np.array([1.0, 2.0, -0.1]), -np.array([1.0, 2.0, -0.1])):
            x, y = ((n + 0.5 - m / 2) * p for n, m, p in zip((column, row), size, pitch, strict=True))
            pixels = center + x[..., None] * unit(right) + y[..., None] * unit(down)
            height = abs((center - source) @ unit(np.cross(right, down)))
            far = np.linalg.norm(pixels - source, axis=-1), np.full(row.shape, height)
            for seen in points(*jax.device_put((source, center, right, down, pitch, far))):
                np.testing.assert_allclose(seen, pixels, atol=1e-9)


def camera(**how):
    return jv.Camera(POSITION, FOCUS, **how)


BAD = {
    "at its focal point": (lambda: jv.Camera(FOCUS, FOCUS), "position must differ from focal_point"),
    "up along the view": (
        lambda: jv.Camera((0, 5, 0), (0, 0, 0), (0, 1, 0)),
        "view_up must not be zero or point along",
    ),
    "lengths whose squares overflow": (
        lambda: jv.Camera((1.5e20, 0, 0), (0, 0, 0)),
        r"position must have coordinates below 1.2e\+18, .* greater unit of length. Got \[1.5e\+20",
    ),
    "a volume of such lengths": (
        lambda: jv.Camera.looking_at(jv.Volume(np.zeros((2, 2, 2), np.uint8), (3e19,) * 3)),
        r"volume, as seen from the camera, must have coordinates below 1.2e\+18",
    ),
    "more pixels than counted": (lambda: camera(size=(2**16, 2**15)), "size must be .* fewer than 2\\*\\*31"),
    "size 0": (lambda: camera(size=(0, 5)), r"size must be .* at least 1; got \(0, 5\)"),
    "size of text": (lambda: camera(size="512x512"), "size must be .*got '512x512'"),
    "crop by halves": (
        lambda: camera(size=(9, 9)).crop(1.5, 0, 5, 2),
        "left must be an integer of at least 0; got 1.5",
    ),
    "crop outside": (lambda: camera(size=(9, 9)).crop(5, 5, 5, 2), "crop must be a rectangle inside"),
    "crop by traced halves": (
        lambda: jax.jit(lambda left: camera(size=(9, 9)).crop(left, 0, 5, 2).rays())(1.5),
        r"left and top must be integers; got a traced array .* and 0",
    ),
    "skew": (lambda: jv.Camera.from_intrinsics(K + np.eye(3, k=1), R, T, SIZE), "K must be .*without skew"),
    "a mirror": (lambda: jv.Camera.from_intrinsics(K, -R, T, SIZE), "R must be a rotation"),
    "a slanted detector": (
        lambda: jv.Camera.from_detector(POSITION, FOCUS, (1, 0, 0), (1, 1, 0), 0.1, SIZE),
        "right must be perpendicular to down",
    ),
    "pitch 0": (
        lambda: jv.Camera.from_detector(POSITION, FOCUS, (1, 0, 0), (0, 1, 0), (0.1, 0), SIZE),
        "pixel_pitch must be greater than 0",
    ),
    "angle 180": (lambda: camera(view_angle=180), "view_angle must be .* less than 180 degrees"),
    "NaN": (lambda: jv.Camera((0, np.nan, 0), FOCUS), "position must be finite"),
    "scale 0": (lambda: camera(parallel_scale=0), "parallel_scale must be greater than 0"),
    "an array": (
        lambda: jv.Camera.looking_at(np.zeros((4, 4, 4))),
        "volume must be a jaxvol Volume; got a NumPy",
    ),
    "no direction": (lambda: jv.Camera.looking_at(BOX, (0, 0, 0)), "direction must not be zero"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    make, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        make()


def test_texts_can_be_pasted():
    for made in (
        jv.Camera((1, 2, 0.1), (0, 0, 0), size=16),
        jv.Camera((1, 2, 3), (0, 0, 1), (0, 0, 1), 45, size=(8, 4), parallel_scale=2, window=(-1, 0, 0, 1)),
        jv.TransferFunction([0, 0.1], [[1, 0, 0.3], [1, 1, 1]], [0, 3], per_voxel=True),
    ):
        again = eval(repr(made), {name: getattr(jv, name) for name in dir(jv)})
        assert all(map(np.array_equal, jax.tree.leaves(again), jax.tree.leaves(made)))
    long = jv.TransferFunction(np.arange(20), np.ones((20, 3)), np.arange(20))
    assert "values=f32[20]" in repr(long)
    with pytest.warns(UserWarning, match="colors must be linear RGB, where white is 1; got up to 255"):
        jv.TransferFunction([0, 0.1], [[255, 0, 0]] * 2, [0, 3])
