"""Is a volume's direction honoured everywhere? A turned volume under a turned camera looks the same.

Where it is not turned back, it is compared with nodes placed in NumPy, and with central differences.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.lighting import Phong, PointLight
from jaxvol.path_tracing.walks import WalkScene
from jaxvol.scene.space import Affine, world_gradient
from jaxvol.scene.volume import part_of, with_voxels

from ..scenes import SIZE, anisotropic_noise, in_float64, slow, soft_transfer, to_float64
from ..switch import switch


ANGLES = (0.4, -0.7, 1.1)


def turn(angles):
    """A matrix that turns about x, then y, then z."""
    matrix = jnp.eye(3)
    for axis in range(3):
        i, j = ((1, 2), (2, 0), (0, 1))[axis]
        c, s = jnp.cos(angles[axis]), jnp.sin(angles[axis])
        one = jnp.eye(3).at[i, i].set(c).at[j, j].set(c).at[i, j].set(-s).at[j, i].set(s)
        matrix = jnp.matmul(one, matrix, precision="highest")
    return matrix


R = np.asarray(jax.jit(turn)(np.array(ANGLES, np.float32)))
STRAIGHT = anisotropic_noise()
TURNED = jv.Volume(STRAIGHT.data, STRAIGHT.spacing, STRAIGHT.origin, direction=R)
"""The same volume, turned about its first node."""


def moved(point, volume=STRAIGHT):
    """A world point that is turned with a volume, about its first node."""
    origin = np.asarray(volume.origin, np.float64)
    return origin + R.astype(np.float64) @ (np.asarray(point, np.float64) - origin)


def views(inside=False):
    """A camera for the volume along the axes, and the one that sees the turned volume in the same way."""
    low, high = (np.asarray(corner) for corner in STRAIGHT.corners)
    center = (low + high) / 2
    position = low + 0.4 * (high - low) if inside else center + np.array([1.5, -2.5, 1.6])
    focus, up = center + np.array([0.1, 0.2, 0]), np.array([0.1, 0.2, 1])
    first = jv.Camera(position, focus, up, 50.0, size=SIZE)
    return first, jv.Camera(moved(position), moved(focus), R @ up, 50.0, size=SIZE)


PLANE = (np.array([1.0, -0.2, 1.3]), np.array([-0.6, 0.8, -0.3]))

MARCHES = {
    "blocks": lambda cut, leaps: (switch(jv.SpaceLeaping(), leaps), jv.AlphaCorrection()),
    "jittered": lambda cut, leaps: (jv.SpaceLeaping(), jv.EmptySpaceJitter(4), jv.AlphaCorrection()),
    "clipped, distance": lambda cut, leaps: (
        *(jv.Clip(planes=[cut]), jv.SpaceLeaping("distance")),
        *(jv.AlphaCorrection(), jv.EarlyTermination(0.01)),
    ),
    "hollowed": lambda cut, leaps: (
        *(jv.Clip(planes=[cut], inside_out=True), jv.SpaceLeaping()),
        jv.AlphaCorrection(),
    ),
    "beam": lambda cut, leaps: (jv.SpaceLeaping("beam"), jv.AlphaCorrection()),
}


def march_pair(name, leaps=True):
    """The march for the volume along the axes, and for the turned one, whose cut is turned with it."""
    cuts = PLANE, (moved(PLANE[0]), R @ PLANE[1])
    return tuple(jv.March(0.03, MARCHES[name](cut, leaps), "midpoint") for cut in cuts)


SPARSE = jv.TransferFunction.from_points(
    [(0.0, (0, 0, 0), 0.0), (0.6, (0.9, 0.4, 0.1), 0.0), (0.8, (0.2, 0.9, 0.3), 0.5), (1.0, (1, 1, 1), 0.8)],
    0.2,
)


@pytest.mark.parametrize(
    ("name", "inside"),
    [
        ("blocks", False),
        *slow(("clipped, distance", False), ("hollowed", True)),
    ],
)
def test_a_turned_volume_under_a_turned_camera_looks_the_same(name, inside):
    scenes = zip(march_pair(name), (STRAIGHT, TURNED), views(inside), strict=True)
    lit = None if name == "blocks" else Phong()
    expected, rendering = (
        jv.render(volume, SPARSE, camera, march, lighting=lit) for march, volume, camera in scenes
    )
    assert np.asarray(expected.rgba)[..., 3].max() > 0.5
    assert (np.asarray(expected.rgba)[..., 3] == 0).any() or inside
    different = np.abs(np.asarray(rendering.rgba) - np.asarray(expected.rgba))
    assert np.mean(different > 2e-5) < 2e-3  # positions are rounded otherwise: one in 1280 by jax 0.11
    assert different.max() < 4e-5
    seen = np.asarray(expected.rgba)[..., 3] > 0.5
    np.testing.assert_allclose(np.asarray(rendering.depth)[seen], np.asarray(expected.depth)[seen], rtol=1e-4)
    if name == "blocks":  # what is leapt over does not show
        plain = jv.render(TURNED, SPARSE, views()[1], march_pair(name, leaps=False)[1])
        np.testing.assert_allclose(rendering.rgba, plain.rgba, rtol=0, atol=1e-6)
        # an optimiser passes by the constructor: axes in a plane place nothing
        flat = eqx.tree_at(
            lambda volume: volume.direction,
            TURNED,
            jax.device_put(np.diag(np.array([1, 1, 0], np.float32)) @ R),
        )
        assert np.isnan(jv.render(flat, SPARSE, views()[1], march_pair(name)[1]).rgba).all()


def test_the_derivative_along_a_turn_is_that_of_central_differences():
    """In float64, of a ray, with respect to the angles of a turn."""
    march = jv.March(0.05, (jv.AlphaCorrection(),), "midpoint", max_samples=80)
    target = moved(np.asarray(STRAIGHT.center) + np.array([0.1, 0.05, -0.1]))
    toward = np.array([[1.0, 1.4, -1.9]]) / np.linalg.norm((1.0, 1.4, -1.9))
    with in_float64():
        volume, transfer, marched = to_float64((STRAIGHT, soft_transfer(0.5), march))

        def color(angles):
            turned = jv.Volume(volume.data, volume.spacing, volume.origin, direction=turn(angles))
            rays = target[None] - 3 * toward, toward
            return jv.render_rays(turned, transfer, *rays, marched, adjoint="direct").rgba[0]

        both = jax.jit(lambda angles: (color(angles), jax.jacfwd(color)(angles)))
        angles, derivative = np.array(ANGLES), np.asarray(both(np.array(ANGLES))[1])
        assert np.abs(derivative).max() > 1e-3
        for axis, step in enumerate(1e-6 * np.eye(3)):
            after, before = (np.asarray(both(angles + sign * step)[0]) for sign in (1, -1))
            np.testing.assert_allclose(derivative[:, axis], (after - before) / 2e-6, rtol=1e-5, atol=1e-7)


def vector(point):
    return tuple(jnp.float32(c) for c in point)


def test_nodes_lie_where_numpy_puts_them():
    nodes = np.array([(0, 0, 0), (23, 23, 23), (5, 17, 2)], np.float64)
    points = np.asarray(TURNED.origin) + (nodes * np.asarray(TURNED.spacing)) @ R.astype(np.float64).T

    @jax.jit
    def there_and_back(point):
        space = Affine(TURNED)
        return jnp.stack(at := space.coordinate(tuple(point))), jnp.stack(space.point(at))

    for node, point in zip(nodes, points, strict=True):
        at, again = there_and_back(point.astype(np.float32))
        np.testing.assert_allclose(at, node, atol=1e-4)
        np.testing.assert_allclose(again, point, atol=1e-5)
    corners = np.array([[(i >> a & 1) * 23 for a in range(3)] for i in range(8)]) * np.asarray(TURNED.spacing)
    corners = np.asarray(TURNED.origin) + corners @ R.T
    bounds = np.stack([corners.min(0), corners.max(0)], axis=-1).ravel()
    np.testing.assert_allclose(TURNED.bounds, bounds, atol=1e-5)
    np.testing.assert_allclose(TURNED.center, corners.mean(0), atol=1e-5)
    np.testing.assert_allclose(TURNED.corners[1], points[1], atol=1e-5)
    # a camera frames the turned volume as it does the other
    first = jv.Camera.looking_at(STRAIGHT, (0.5, -0.9, 0.4), (0, 0, 1), size=SIZE)
    second = jv.Camera.looking_at(TURNED, R @ (0.5, -0.9, 0.4), R @ (0, 0, 1), size=SIZE)
    np.testing.assert_allclose(second.position, moved(first.position), atol=1e-4)
    np.testing.assert_allclose(second.focal_point, moved(first.focal_point), atol=1e-5)


def test_the_world_gradient_is_that_of_the_world():
    """A linear field, whose gradient is known."""
    slope = np.array([0.3, -0.8, 0.5])
    index = np.stack(np.meshgrid(*(np.arange(6),) * 3, indexing="ij"), axis=-1)
    spacing = np.array([0.5, 1.0, 2.0])
    values = ((index * spacing) @ R.T.astype(np.float64)) @ slope
    volume = jv.Volume(values.astype(np.float32), spacing, direction=R)
    point = R @ (np.array([2.3, 1.7, 3.1]) * spacing)
    found = jax.jit(lambda point: world_gradient(volume, Affine(volume), point))(vector(point))
    np.testing.assert_allclose(np.array(found), slope, atol=1e-5)


def test_light_arrives_at_the_world_point():
    """A lamp's irradiance by the distance from where NumPy puts the node."""
    lamp = PointLight((1.5, -2.0, 2.0), (1.0, 4.0, 2.0))
    scene = WalkScene(TURNED, None, (lamp,), jnp.float32(0), jnp.int32(1), None)  # pyright: ignore
    node = np.array([5.0, 17.0, 2.0])
    point = np.asarray(TURNED.origin) + R @ (node * np.asarray(TURNED.spacing))

    @jax.jit
    def light(node):
        arriving = scene.light(node, vector((0, 0, 1)), jnp.float32(0.5))
        assert arriving.toward is not None
        return arriving.distance, jnp.stack(arriving.toward)

    distance, toward = light(vector(node))
    away = np.array([1.5, -2.0, 2.0]) - point
    assert float(distance) == pytest.approx(np.linalg.norm(away), rel=1e-5)
    np.testing.assert_allclose(toward, away / np.linalg.norm(away), atol=1e-5)


def test_a_clip_box_is_one_of_the_world():
    """Rays enter where the box is, not the volume, and one passes it."""
    volume = jv.Volume(np.ones((9, 9, 9), np.float32), direction=R, origin=(1, 2, 3))
    center = np.asarray(volume.center)

    @jax.jit
    def interval(origin, direction):
        clip = jv.Clip(np.stack([center - 1, center + 1], axis=-1).ravel())
        return jv.March(0.5, (clip,)).locate(volume).interval(tuple(origin), tuple(direction))

    for past, direction in (((0.3, -0.2, -20), (0, 0, 1)), ((-20, 0.5, 0.4), (1, 0, 0))):
        ends = interval((center + past).astype(np.float32), np.array(direction, np.float32))
        np.testing.assert_allclose(ends, (19, 21), rtol=1e-5)
    passing = (center + np.array([1.1, 0, -20])).astype(np.float32)
    enters, leaves = interval(passing, np.array([0, 0, 1], np.float32))
    assert float(enters) > float(leaves)


@pytest.mark.slow
def test_bricks_and_parts_keep_the_direction():
    """Of sheared axes."""
    volume = jv.Volume(STRAIGHT.data, STRAIGHT.spacing, STRAIGHT.origin, direction=SHEARED)
    _, camera = views()
    march = jv.March(0.03, (jv.AlphaCorrection(),), "midpoint")
    whole = jv.render(volume, SPARSE, camera, march)
    parts = jv.render_bricks(volume, SPARSE, camera, march, bricks=(2, 1, 2))
    np.testing.assert_allclose(parts.rgba, whole.rgba, rtol=0, atol=2e-6)
    # the whole as a part of itself, with its voxels in another order in memory
    stored = with_voxels(volume, [jnp.asarray(volume.data).transpose(1, 2, 0)])
    part = part_of(stored, jnp.zeros(3, jnp.int32), volume.shape, (1, 2, 0))
    found = jv.render(part, SPARSE, camera, march)
    np.testing.assert_allclose(found.rgba, whole.rgba, rtol=0, atol=2e-6)


def test_what_is_a_direction():
    volume = jv.Volume(np.zeros((2, 2, 2)), direction=np.eye(3))
    assert volume.direction is None
    assert jax.tree.structure(volume) == jax.tree.structure(jv.Volume(np.zeros((2, 2, 2))))
    # a mirror image is allowed: some files are left-handed
    assert jv.Volume(np.zeros((2, 2, 2)), direction=np.diag([1, 1, -1])).direction is not None
    long, flat = [[1, 0.1, 0], [0, 1, 0], [0, 0, 1]], [[1, 0.6, 0], [0, 0.8, 1], [0, 0, 0]]
    for wrong in (np.ones((3, 3)), 2 * np.eye(3), np.eye(3)[:2], "eye", long, flat):
        with pytest.raises(ValueError, match="direction must"):
            jv.Volume(np.zeros((2, 2, 2)), direction=wrong)
    bounds = jax.jit(lambda turn: jv.Volume(np.zeros((2, 2, 2), np.float32), direction=turn).bounds)
    np.testing.assert_allclose(bounds(np.eye(3, dtype=np.float32)), (0, 1, 0, 1, 0, 1))
    assert np.isnan(bounds(2 * np.eye(3, dtype=np.float32))).all()


SLOPE, CENTER, BOX = np.array([0.3, -0.5, 0.4]), np.array([3.0, -2.0, 5.0]), np.array([1.0, 0.8, 0.9])
SHEARED = R @ np.array([[1, 0.6, 0.28], [0, 0.8, -0.6], [0, 0, np.sqrt(1 - 0.36 - 0.28**2)]])


def linear(direction, spacing):
    """A grid around the box whose values, linear in the world, are interpolated exactly; 1 in the center."""
    index = np.moveaxis(np.indices((14, 13, 12)), 0, -1) - np.array([13, 12, 11]) / 2
    places = (index * spacing) @ direction.T
    origin = CENTER + places[0, 0, 0]
    return jv.Volume(1 + places @ SLOPE, spacing, origin, direction=direction)


@jax.jit
def boxed(volume, camera, box, cut):
    """Of what is in the box, and on one side of a plane: an image lit by normals whose extinction depends on
    the gradient's magnitude, its derivative by the camera, and the depth of a surface."""
    clip = jv.Clip(box, planes=[cut])
    march = jv.March(0.1, (clip, jv.SpaceLeaping(), jv.AlphaCorrection()), "midpoint", max_samples=64)
    steep = jv.TransferFunction2D(
        [0.9, 1.4, 2], [0.6, 0.8], np.eye(3)[:, None].repeat(2, axis=1), [[0, 0], [1, 6], [2, 8]]
    )

    def bright(camera):
        rgba = jv.render(volume, steep, camera, march, lighting=Phong(), outputs="rgba").rgba
        return jnp.sum(rgba**2), rgba

    surface = jv.render(volume, soft_transfer(1.0), camera, march, compositing=jv.Isosurface(1.1))
    return jax.value_and_grad(bright, has_aux=True)(camera), surface.depth


def test_a_sheared_grid_shows_what_an_orthogonal_one_does():
    """In float64. Voxels are a linear function of the world, which both interpolate exactly."""
    with in_float64():
        camera = jv.Camera(CENTER + np.array([2, -5, 3]), CENTER, (0, 0, 1), 30.0, size=(9, 8))
        cut = CENTER, np.array([-0.2, 0.9, -0.3])
        given = camera, np.stack([CENTER - BOX, CENTER + BOX], axis=-1).ravel(), cut
        expected = jax.device_get(boxed(linear(np.asarray(R, float), (0.3, 0.32, 0.35)), *given))
        found = jax.device_get(boxed(linear(SHEARED, (0.45, 0.5, 0.6)), *given))
    assert 0.1 < np.mean(expected[0][0][1][..., 3] > 0.1) < 0.9
    assert 0.05 < np.mean(np.isfinite(expected[1])) < 0.9
    for one, other in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-7)


DOTS = np.zeros((24, 24, 24), np.float32)
DOTS[3::9, 3::9, 3::9] = 1
DENSE = jv.TransferFunction(np.array([0.1, 1]), np.ones((2, 3)), np.array([0.0, 90]))


@jax.jit
def far_off(away):
    """A lit image, and its derivative by the camera, of a clipped scene that lies so far off in the world."""
    volume = jv.Volume(STRAIGHT.data, (0.25, 0.25, 0.25), away + jnp.asarray([-1.0, 0.5, 2.0]))
    clip = jv.Clip(planes=[(away + jnp.asarray([1.0, 3.0, 4.0]), (-0.6, 0.8, -0.3))])
    march = jv.March(0.2, (clip, jv.SpaceLeaping("beam"), jv.AlphaCorrection()), "midpoint")
    ends = away + jnp.asarray([10.0, -9.5, 12.0]), away + jnp.asarray([2.0, 3.5, 4.5])
    camera = jv.Camera(*ends, (0, 0, 1), 30.0, size=SIZE)
    # parallel rays begin beside the camera, and beams leap; voxels are an eighth of float32's steps
    dots = jv.Volume(DOTS, (1 / 16,) * 3, away + jnp.asarray([0, 0.5, 2.0]))
    ends = away + jnp.asarray([4.0, -3.0, 5.0]), away + jnp.asarray([0.75, 1.0, 2.75])
    parallel = jv.Camera(*ends, (0, 0, 1), parallel_scale=0.6, size=(64, 64))

    def bright(camera):
        rgba = jv.render(volume, SPARSE, camera, march, lighting=Phong(), outputs="rgba").rgba
        return jnp.sum(rgba**2), rgba

    (_, rgba), change = jax.value_and_grad(bright, has_aux=True)(camera)
    beams = jv.March(0.02, (jv.SpaceLeaping(), jv.AlphaCorrection()), "midpoint")
    return (rgba, jv.render(dots, DENSE, parallel, beams, outputs="rgba").rgba), change.position


def test_a_scene_far_from_the_worlds_zero_is_resolved_as_well():
    """Eastings and northings, where float32 has steps of twice a voxel; all places are multiples of these."""
    images, by_camera = jax.device_get(far_off(np.zeros(3, np.float32)))
    far, found = jax.device_get(far_off(np.array([615_840.0, 5_846_926.0, 758.0], np.float32)))
    for here, there, some in zip(images, far, (0.1, 0.02), strict=True):
        assert some < np.mean(here[..., 3] > 0.1) < 0.9
        np.testing.assert_allclose(there, here, atol=1e-6)
    np.testing.assert_allclose(found, by_camera, rtol=1e-4)


def test_a_swept_sector_takes_no_direction():
    probe = jv.ToroidalMap(10.0, 20.0, (1.0, 2.0), (1.0, 2.0), (0.0, 30.0))
    volume = jv.Volume(np.zeros((4, 4, 4), np.float32), direction=R)
    for use in (
        lambda: jv.March(1.0, (probe,)).locate(volume),
        lambda: jv.scan_convert(volume, probe, shape=(4, 4, 4), spacing=5.0, origin=(0, 0, 0)),
    ):
        with pytest.raises(ValueError, match="volume must have no direction: ToroidalMap places"):
            use()
