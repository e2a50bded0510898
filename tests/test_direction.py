"""Is a volume's direction honoured everywhere? A turned volume under a turned camera looks the same.

Where it is not turned back, it is compared with nodes placed in NumPy, and with central differences.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.lighting import ConstantLight, DirectionalLight, Phong, PointLight
from jaxvol.path_tracing.walks import WalkScene
from jaxvol.space import Affine, world_gradient
from jaxvol.volume import part_of, with_voxels

from .scenes import SIZE, anisotropic_noise, in_float64, slow, soft_transfer, to_float64


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


R = np.asarray(turn(np.array(ANGLES)))


def pair():
    """A volume along the axes, and the same one turned about its first node."""
    straight = anisotropic_noise()
    return straight, jv.Volume(straight.data, straight.spacing, straight.origin, direction=R)


def moved(point, volume):
    """A world point that is turned with a volume, about its first node."""
    origin = np.asarray(volume.origin, np.float64)
    return origin + R.astype(np.float64) @ (np.asarray(point, np.float64) - origin)


def views(volume, inside=False):
    """A camera for the volume along the axes, and the one that sees the turned volume in the same way."""
    low, high = (np.asarray(corner) for corner in volume.corners)
    center = (low + high) / 2
    position = low + 0.4 * (high - low) if inside else center + np.array([1.5, -2.5, 1.6])
    focus, up, how = center + np.array([0.1, 0.2, 0]), np.array([0.1, 0.2, 1]), {"size": SIZE}
    return (
        jv.Camera(position, focus, up, 50.0, **how),
        jv.Camera(moved(position, volume), moved(focus, volume), R @ up, 50.0, **how),
    )


PLANE = (np.array([1.0, -0.2, 1.3]), np.array([-0.6, 0.8, -0.3]))

MARCHES = {
    "hierarchy": lambda cut: (jv.SpaceLeaping(), jv.EmptySpaceJitter(4), jv.AlphaCorrection()),
    "clipped, distance": lambda cut: (
        jv.Clip(planes=[cut]),
        jv.SpaceLeaping("distance"),
        jv.AlphaCorrection(),
        jv.EarlyTermination(0.01),
    ),
    "hollowed": lambda cut: (jv.Clip(planes=[cut], inside_out=True), jv.SpaceLeaping(), jv.AlphaCorrection()),
    "beam": lambda cut: (jv.SpaceLeaping("beam"), jv.AdaptiveSampling(0.01), jv.AlphaCorrection()),
}


def march_pair(name, volume):
    """The march for the volume along the axes, and for the turned one, whose cut is turned with it."""
    cuts = PLANE, (moved(PLANE[0], volume), R @ PLANE[1])
    return tuple(jv.March(0.03, MARCHES[name](cut), "midpoint") for cut in cuts)


SPARSE = jv.TransferFunction.from_points(
    [(0.0, (0, 0, 0), 0.0), (0.6, (0.9, 0.4, 0.1), 0.0), (0.8, (0.2, 0.9, 0.3), 0.5), (1.0, (1, 1, 1), 0.8)],
    0.2,
)


@pytest.mark.parametrize(
    ("name", "inside"),
    [("hierarchy", False), *slow(("clipped, distance", False), ("hollowed", True), ("beam", True))],
)
def test_a_turned_volume_under_a_turned_camera_looks_the_same(name, inside):
    straight, turned = pair()
    first, second = views(straight, inside)
    scenes = zip(march_pair(name, straight), (straight, turned), (first, second), strict=True)
    expected, rendering = (
        jv.render(volume, SPARSE, camera, march, lighting=Phong()) for march, volume, camera in scenes
    )
    assert np.asarray(expected.rgba)[..., 3].max() > 0.5
    assert (np.asarray(expected.rgba)[..., 3] == 0).any() or inside
    different = np.abs(np.asarray(rendering.rgba) - np.asarray(expected.rgba))
    assert np.mean(different > 2e-5) < 2e-3  # positions are rounded otherwise: one in 1280 by jax 0.11
    assert different.max() < 4e-5
    seen = np.asarray(expected.rgba)[..., 3] > 0.5
    np.testing.assert_allclose(np.asarray(rendering.depth)[seen], np.asarray(expected.depth)[seen], rtol=1e-4)


def test_what_is_leapt_over_does_not_show():
    straight, turned = pair()
    _, camera = views(straight)
    leaping = march_pair("hierarchy", straight)[1]
    plain = jv.March(0.03, leaping.transforms[1:], "midpoint")
    images = [
        np.asarray(jv.render(turned, SPARSE, camera, m, lighting=Phong()).rgba) for m in (leaping, plain)
    ]
    np.testing.assert_allclose(*images, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_gradients_are_those_of_the_volume_along_the_axes():
    straight, turned = pair()
    march, _ = march_pair("hierarchy", straight)
    weights = np.random.default_rng(1).normal(size=(*SIZE[::-1], 4)).astype(np.float32)

    def loss(parts, volume, camera):
        data, spacing, extinction = parts
        volume = eqx.tree_at(lambda v: (v.data, v.spacing), volume, (data, spacing))
        transfer = eqx.tree_at(lambda t: t.extinction, SPARSE, extinction)
        return jnp.sum(jv.render(volume, transfer, camera, march, lighting=Phong()).rgba * weights)

    found = []
    for volume, camera in zip((straight, turned), views(straight), strict=True):
        found.append(jax.grad(loss)((volume.data, volume.spacing, SPARSE.extinction), volume, camera))
    for one, other in zip(*found, strict=True):
        assert np.linalg.norm(one) > 0
        np.testing.assert_allclose(other, one, rtol=0, atol=2e-4 * float(np.linalg.norm(one)))


def test_the_reference_in_float64_and_the_derivative_along_a_turn():
    """In float64, by `jax.vmap` over the angles of a turn and `jax.jit`, to central differences."""
    march = jv.March(0.05, (jv.AlphaCorrection(),), "midpoint", max_samples=80)
    straight = anisotropic_noise()
    target = moved(np.asarray(straight.center) + np.array([0.1, 0.05, -0.1]), straight)
    toward = np.array([[1.0, 1.4, -1.9]]) / np.linalg.norm((1.0, 1.4, -1.9))
    rays = target[None] - 3 * toward, toward
    with in_float64():
        volume, transfer, marched = to_float64((straight, soft_transfer(0.5), march))

        @jax.jit
        def color(angles):
            turned = jv.Volume(volume.data, volume.spacing, volume.origin, direction=turn(angles))
            return jv.render_rays(turned, transfer, rays[0], rays[1], marched, adjoint="direct").rgba[0]

        angles = np.array(ANGLES)
        derivative = np.asarray(jax.jacrev(color)(angles))
        assert np.abs(derivative).max() > 1e-3
        steps = 1e-6 * np.eye(3)
        ends = np.asarray(jax.vmap(color)(np.concatenate([angles + steps, angles - steps])))
        np.testing.assert_allclose(derivative.T, (ends[:3] - ends[3:]) / 2e-6, rtol=1e-5, atol=1e-7)
        whole = np.asarray(color(angles))
    _, turned = pair()
    fast = jv.render_rays(turned, soft_transfer(0.5), rays[0], rays[1], march)
    np.testing.assert_allclose(fast.rgba[0], whole, rtol=0, atol=2e-5)


def test_nodes_lie_where_numpy_puts_them():
    _, volume = pair()
    space = Affine(volume)
    nodes = np.array([(0, 0, 0), (23, 23, 23), (5, 17, 2)], np.float64)
    points = np.asarray(volume.origin) + (nodes * np.asarray(volume.spacing)) @ R.astype(np.float64).T
    for node, point in zip(nodes, points, strict=True):
        at = space.coordinate(tuple(jnp.float32(p) for p in point))
        np.testing.assert_allclose(np.array(at), node, atol=1e-4)
        np.testing.assert_allclose(np.array(space.point(at)), point, atol=1e-5)
    corners = np.array([[(i >> a & 1) * 23 for a in range(3)] for i in range(8)]) * np.asarray(volume.spacing)
    corners = np.asarray(volume.origin) + corners @ R.T
    bounds = np.stack([corners.min(0), corners.max(0)], axis=-1).ravel()
    np.testing.assert_allclose(volume.bounds, bounds, atol=1e-5)
    np.testing.assert_allclose(volume.center, corners.mean(0), atol=1e-5)
    np.testing.assert_allclose(volume.corners[1], points[1], atol=1e-5)


def test_the_world_gradient_is_that_of_the_world():
    """A linear field, whose gradient is known."""
    slope = np.array([0.3, -0.8, 0.5])
    index = np.stack(np.meshgrid(*(np.arange(6),) * 3, indexing="ij"), axis=-1)
    spacing = np.array([0.5, 1.0, 2.0])
    values = ((index * spacing) @ R.T.astype(np.float64)) @ slope
    volume = jv.Volume(values.astype(np.float32), spacing, direction=R)
    point = R @ (np.array([2.3, 1.7, 3.1]) * spacing)
    found = world_gradient(volume, Affine(volume), tuple(jnp.float32(p) for p in point))
    np.testing.assert_allclose(np.array(found), slope, atol=1e-5)


def test_a_camera_frames_a_turned_volume():
    straight, turned = pair()
    first = jv.Camera.looking_at(straight, (0.5, -0.9, 0.4), (0, 0, 1), size=SIZE)
    second = jv.Camera.looking_at(turned, R @ (0.5, -0.9, 0.4), R @ (0, 0, 1), size=SIZE)
    np.testing.assert_allclose(second.position, moved(first.position, straight), atol=1e-4)
    np.testing.assert_allclose(second.focal_point, moved(first.focal_point, straight), atol=1e-5)


def test_a_clip_box_is_one_of_the_world():
    """An opaque box: the depth along a ray is where the ray enters the box, not the volume."""
    volume = jv.Volume(np.ones((9, 9, 9), np.float32), direction=R, origin=(1, 2, 3))
    center = np.asarray(volume.center)
    box = np.stack([center - 1, center + 1], axis=-1).ravel()
    opaque = jv.TransferFunction([0.0, 1.0], np.ones((2, 3)), [1e4, 1e4])
    march = jv.March(0.5, (jv.Clip(box), jv.SpaceLeaping(), jv.AlphaCorrection()))
    origins = center + np.array([[0.3, -0.2, -20], [-20, 0.5, 0.4], [1.1, 0, -20]])
    rays = origins, np.array([(0.0, 0, 1), (1, 0, 0), (0, 0, 1)])
    rendering = jv.render_rays(volume, opaque, rays[0], rays[1], march)
    np.testing.assert_allclose(rendering.rgba[:, 3], (1, 1, 0), atol=1e-6)
    np.testing.assert_allclose(rendering.depth[:2], (19, 19), atol=1e-2)


def test_paths_are_traced_in_the_world():
    """Up to the first collision, walks are the same. What scatters, to other sides, is so on average."""
    straight, turned = pair()
    sun = np.array([0.5, 1.0, -0.7])
    images = []
    for volume, camera, toward in zip((straight, turned), views(straight), (sun, R @ sun), strict=True):
        lights = DirectionalLight(toward, (2.0, 1.0, 3.0)), ConstantLight((0.5, 0.5, 0.5))
        images.append(jv.path_trace(volume, soft_transfer(0.3), camera, lights, paths=64))
    # a path of 64 more or less, where rounding decides
    np.testing.assert_allclose(images[1].opacity, images[0].opacity, atol=1.5 / 64)
    assert np.mean(np.asarray(images[1].opacity) == np.asarray(images[0].opacity)) > 0.9
    means = [np.asarray(image.radiance).mean((0, 1)) for image in images]
    errors = [np.sqrt((np.asarray(i.standard_error) ** 2).sum((0, 1))) / np.prod(SIZE) for i in images]
    assert np.all(abs(means[1] - means[0]) < 4 * np.hypot(*errors)), (means, errors)
    assert np.all(np.hypot(*errors) < 0.05 * means[0])


def test_light_arrives_at_the_world_point():
    """A lamp's irradiance by the distance from where NumPy puts the node."""
    _, volume = pair()
    lamp = PointLight((1.5, -2.0, 2.0), (1.0, 4.0, 2.0))
    scene = WalkScene(volume, None, None, (lamp,), jnp.float32(0), jnp.int32(1))  # pyright: ignore
    node = np.array([5.0, 17.0, 2.0])
    point = np.asarray(volume.origin) + R @ (node * np.asarray(volume.spacing))
    arriving = scene.light(tuple(jnp.float32(c) for c in node), jnp.float32(0.5))
    away = np.array([1.5, -2.0, 2.0]) - point
    assert float(arriving.distance) == pytest.approx(np.linalg.norm(away), rel=1e-5)
    np.testing.assert_allclose(np.array(arriving.toward), away / np.linalg.norm(away), atol=1e-5)


def test_bricks_keep_the_direction():
    straight, turned = pair()
    _, camera = views(straight)
    march = jv.March(0.03, (jv.AlphaCorrection(),), "midpoint")
    whole = jv.render(turned, SPARSE, camera, march)
    parts = jv.render_bricks(turned, SPARSE, camera, march, bricks=(2, 1, 2))
    np.testing.assert_allclose(parts.rgba, whole.rgba, rtol=0, atol=2e-6)
    # the whole as a part of itself, with its voxels in another order in memory
    stored = with_voxels(turned, jnp.asarray(turned.data).transpose(1, 2, 0))
    moved = part_of(stored, jnp.zeros(3, jnp.int32), turned.shape, (1, 2, 0))
    found = jv.render(moved, SPARSE, camera, march)
    np.testing.assert_allclose(found.rgba, whole.rgba, rtol=0, atol=2e-6)


def test_the_identity_is_no_direction():
    volume = jv.Volume(np.zeros((2, 2, 2)), direction=np.eye(3))
    assert volume.direction is None
    straight = jv.Volume(np.zeros((2, 2, 2)))
    assert jax.tree.structure(volume) == jax.tree.structure(straight)
    # a mirror image is allowed: some files are left-handed
    assert jv.Volume(np.zeros((2, 2, 2)), direction=np.diag([1, 1, -1])).direction is not None


@pytest.mark.parametrize(
    "direction", [np.ones((3, 3)), 2 * np.eye(3), np.eye(3)[:2], "eye", [[1, 0.01, 0], [0, 1, 0], [0, 0, 1]]]
)
def test_what_is_no_turn_is_refused(direction):
    with pytest.raises(ValueError, match="direction must"):
        jv.Volume(np.zeros((2, 2, 2)), direction=direction)


def test_a_traced_direction_is_checked_when_the_program_runs():
    def bounds(direction):
        return jv.Volume(np.zeros((2, 2, 2), np.float32), direction=direction).bounds

    np.testing.assert_allclose(jax.jit(bounds)(jnp.eye(3)), (0, 1, 0, 1, 0, 1))
    with pytest.raises(eqx.EquinoxRuntimeError, match="direction must be a 3 x 3 matrix"):
        eqx.filter_jit(bounds)(2 * jnp.eye(3))


def test_a_swept_sector_takes_no_direction():
    probe = jv.ToroidalMap(10.0, 20.0, (1.0, 2.0), (1.0, 2.0), (0.0, 30.0))
    volume = jv.Volume(np.zeros((4, 4, 4), np.float32), direction=R)
    for use in (
        lambda: jv.March(1.0, (probe,)).locate(volume),
        lambda: jv.scan_convert(volume, probe, shape=(4, 4, 4), spacing=5.0),
    ):
        with pytest.raises(ValueError, match="volume has a direction, and ToroidalMap places"):
            use()
