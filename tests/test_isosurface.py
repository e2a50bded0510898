"""Isosurfaces: compared with exact roots, with a sphere, with the reference, and with differences."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

import jaxvol as jv
from jaxvol.engine.driver import render_scene
from jaxvol.engine.scene import Scene
from jaxvol.engine.tiling import Tiling
from jaxvol.lighting import DirectionalLight, Material, ScattererTemplates

from .modes import ball_in_a_corner, check_gradients, reference_image, same_images
from .oracle import box_interval
from .scenes import CAMERAS, anisotropic_noise, around, in_float64, slow, soft_transfer


NOISE = anisotropic_noise()
TRANSFORMS = jv.EmptySpaceJitter(4), jv.AlphaCorrection(), jv.EarlyTermination(0.05)
SURFACE = jv.Isosurface(0.45)
STRAIGHT, STEEP = [1.0, 0.0, 0.0], [0.8, 0.0, 0.6]


def ramp(values, spacing=0.1):
    """A volume whose value depends on x alone."""
    values = np.asarray(values, np.float32)
    return jv.Volume(np.broadcast_to(values[:, None, None], (len(values), 5, 5)).copy(), [spacing] * 3)


def crossings(volume, origin, direction, value):
    """All depths at which the interpolated field has the value: it is cubic between two grid planes."""
    data, spacing, start = (np.asarray(p, np.float64) for p in (volume.data, volume.spacing, volume.origin))
    first, rate = (origin - start) / spacing, direction / spacing
    ((enters, leaves),) = zip(
        *box_interval(first[None], rate[None], np.zeros(3), np.array(data.shape) - 1.0), strict=True
    )
    if leaves <= enters:
        return np.zeros(0)
    planes = [(np.arange(n) - f) / r for n, f, r in zip(data.shape, first, rate, strict=True) if r != 0]
    ends = np.unique(np.clip(np.concatenate([[enters, leaves], *planes]), enters, leaves))
    found, part = [], np.linspace(0, 1, 4)
    for a, b in itertools.pairwise(ends):
        points = first[:, None] + rate[:, None] * (a + (b - a) * part)
        cubic = np.polyfit(part, map_coordinates(data, points, order=1, mode="nearest") - value, 3)
        roots = np.roots(cubic)
        real = roots.real[(abs(roots.imag) < 1e-9) & (roots.real >= 0) & (roots.real < 1)]
        found.extend(a + (b - a) * np.sort(real))
    return np.array(found)


@pytest.mark.parametrize("voxels", ["float32", *slow("uint8")])
def test_depths_are_exact_roots(voxels):
    """Of all rays whose first two crossings do not lie within one step: within 1e-3 of a voxel."""
    data = np.asarray(NOISE.data)
    if voxels == "uint8":
        data = np.round(255 * data).astype(np.uint8)
    volume, value = jv.Volume(data, NOISE.spacing, NOISE.origin), 0.45 * float(data.max())
    camera, step = around(volume), 0.02
    found = jv.render(
        volume,
        soft_transfer(),
        camera,
        jv.March(step, (jv.SpaceLeaping(),)),
        compositing=jv.Isosurface(value),
    )
    origins, directions = (np.asarray(part, np.float64).reshape(-1, 3) for part in camera.rays())
    checked = passed = 0
    for depth, origin, direction in zip(np.ravel(found.depth), origins, directions, strict=True):
        roots = crossings(volume, origin, direction, value)
        if not len(roots):
            passed += 1
            assert np.isinf(depth)
        elif len(roots) == 1 or roots[1] - roots[0] > step:
            checked += 1
            assert abs(depth - roots[0]) < 1e-3 * 0.05
    assert passed > 0.1 * len(origins)
    assert checked > 0.7 * (len(origins) - passed)


def sphere_errors(nodes):
    """Root mean square errors of depth and normal of a sphere of radius 0.6, where values are distances from
    its center, for rays towards points inside it."""
    line = np.linspace(-1, 1, nodes)
    data = np.sqrt(sum(axis**2 for axis in np.meshgrid(line, line, line, indexing="ij")))
    volume = jv.Volume(data.astype(np.float32), [2 / (nodes - 1)] * 3, [-1.0] * 3)
    random = np.random.default_rng(0)
    origins = random.normal(size=(400, 3))
    origins *= 3 / np.linalg.norm(origins, axis=-1, keepdims=True)
    directions = random.uniform(-0.2, 0.2, (400, 3)) - origins
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    found = jv.render_rays(
        *(volume, soft_transfer(), origins, directions, jv.March(0.03)), compositing=jv.Isosurface(0.6)
    )
    toward = -np.sum(origins * directions, axis=-1)
    depth = toward - np.sqrt(toward**2 - (9 - 0.36))
    # values grow outwards, so that normals point inwards
    normal = -(origins + depth[:, None] * directions) / 0.6
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=-1), 1, atol=1e-5)
    return [
        np.sqrt(np.mean((np.asarray(a, np.float64) - b) ** 2))
        for a, b in ((found.depth, depth), (found.normal, normal))
    ]


def test_a_sphere_is_met_to_second_order():
    nodes = np.array([9, 17, 33])
    errors = np.array([sphere_errors(n) for n in nodes])
    for of in errors.T:
        order = -np.polyfit(np.log(nodes - 1), np.log(of), 1)[0]
        assert 1.7 < order < 2.5, errors


@pytest.mark.parametrize("quadrature", ["left", *slow("midpoint", "preintegrated")])
def test_a_plane_is_exact_up_to_the_exit(quadrature):
    """The last values lie in the last part of a step, which is cut off without being asked for."""
    volume = ramp(np.linspace(0.0, 1.0, 11))
    transfer = jv.colormap("gray", (0.0, 1.0))
    origins, directions = [[-1.0, 0.2, 0.21]] * 2, [STRAIGHT, STEEP]  # the second one misses
    for value in (0.004, 0.33, 0.777, 0.985, 0.9999):
        found = jv.render_rays(
            *(volume, transfer, origins, directions, jv.March(0.07, quadrature=quadrature)),
            compositing=jv.Isosurface(value),
        )
        np.testing.assert_allclose(found.depth, [1 + value, np.inf], rtol=1e-6)
        color, _ = transfer(jnp.asarray(value))
        np.testing.assert_allclose(found.rgba, [[*color, 1.0], [0.0] * 4], atol=1e-6)
        np.testing.assert_allclose(found.normal, [[-1.0, 0, 0], [0, 0, 0]], atol=1e-6)
        np.testing.assert_array_equal(found.samples, [int(value / 0.07) + 1, 0])


def test_normals_are_those_of_the_world():
    """Of values that are linear in it, on a grid of three spacings."""
    spacing, slope = np.array([0.05, 0.08, 0.11]), np.array([0.5, -0.3, 0.4])
    grid = np.stack(np.meshgrid(*(s * np.arange(24) for s in spacing), indexing="ij"), -1)
    volume = jv.Volume((grid @ slope + 0.4).astype(np.float32), spacing)
    found = jv.render(volume, soft_transfer(), around(volume), jv.March(0.11), compositing=SURFACE)
    hit = np.isfinite(found.depth)
    assert hit.mean() > 0.05
    expected = np.broadcast_to(-slope / np.linalg.norm(slope), found.normal.shape)
    np.testing.assert_allclose(found.normal[hit], expected[hit], atol=1e-4)
    np.testing.assert_array_equal(found.normal[~hit], 0)


def test_there_is_a_normal_only_where_it_is_asked_for():
    scene = NOISE, soft_transfer(), around(NOISE), jv.March(0.11)
    with pytest.raises(AttributeError, match="normal is not part of this rendering: composite by an Isosurf"):
        _ = jv.render(*scene, compositing=SURFACE, outputs="rgba").normal
    with pytest.raises(AttributeError, match="normal is not part"):
        _ = jv.render(*scene).normal


def test_what_lies_on_the_value_is_not_below_it():
    """Values that reach 1 and stay there, or leave 1; and the volume's faces are no surface."""
    for values, expected in (
        ([0, 0, 0.5, 1, 1, 1, 1], 1 + 0.3),
        ([1, 1, 1, 0.5, 0, 0, 0], 1 + 0.2),
        ([1, 1, 1, 1, 1, 1, 1], np.inf),
        ([2, 2, 2, 2, 2, 2, 2], np.inf),
    ):
        found = jv.render_rays(
            *(ramp(values), soft_transfer(), [[-1.0, 0.2, 0.2]], [STRAIGHT], jv.March(0.07)),
            compositing=jv.Isosurface(1.0),
        )
        np.testing.assert_allclose(found.depth, expected, rtol=1e-6)


def test_a_plateau_on_the_value_leaves_its_gradient():
    """Values that rise to 1 by 5 for each unit of length, and stay there."""

    def depth(value):
        found = jv.render_rays(
            *(ramp([0, 0, 0.5, 1, 1, 1, 1]), soft_transfer(), [[-1.0, 0.2, 0.2]], [STRAIGHT], jv.March(0.07)),
            compositing=jv.Isosurface(value),
        )
        return found.depth[0]

    np.testing.assert_allclose(jax.grad(depth)(jnp.asarray(1.0)), 1 / 5, rtol=1e-4)


@pytest.mark.parametrize("camera", ["around", *slow("inside", "orthographic")])
def test_an_isosurface_is_that_of_the_reference(camera):
    """Where rays leap, samples shift and cells are cut; and that is a root."""
    camera = CAMERAS[camera](NOISE)
    plain, leaping = (jv.March(0.11, (*TRANSFORMS, *more)) for more in ((), (jv.SpaceLeaping(),)))
    rgba, depth = reference_image(NOISE, soft_transfer(), camera, plain, SURFACE)
    finite = np.isfinite(depth)
    assert finite.mean() > 0.1
    for march in (plain, leaping):
        found = jv.render(NOISE, soft_transfer(), camera, march, compositing=SURFACE)
        np.testing.assert_allclose(found.rgba, rgba, atol=2e-5)
        np.testing.assert_array_equal(np.isfinite(found.depth), finite)
        np.testing.assert_allclose(found.depth[finite], depth[finite], rtol=1e-5)


@pytest.mark.parametrize("method", ["hierarchy", *slow("distance", "beam")])
@pytest.mark.parametrize(
    "jitter", [jv.EmptySpaceJitter(4), *slow(jv.Jitter(3))], ids=lambda j: type(j).__name__
)
def test_leaps_do_not_show(method, jitter):
    """Around a ball of 8 bits in empty space."""
    volume = ball_in_a_corner()
    scene = volume, soft_transfer(), around(volume).zoom(2.0)
    plain, leaping = (
        jv.render(*scene, jv.March(0.05, (jitter, *more)), compositing=jv.Isosurface(60.3))
        for more in ((), (jv.SpaceLeaping(method),))
    )
    assert 0.05 < np.isfinite(plain.depth).mean() < 0.9
    same_images(leaping, plain)
    np.testing.assert_allclose(leaping.normal, plain.normal, atol=1e-5)
    assert float(np.sum(leaping.samples)) < 0.7 * float(np.sum(plain.samples))


@pytest.mark.slow
def test_rays_shift_where_nothing_is_crossed():
    """A plane behind empty space: jitter moves the cells, and not the root."""
    volume = ramp(np.append(np.zeros(20), np.linspace(0.0, 1.0, 21)))
    y, z = np.meshgrid(np.linspace(0.05, 0.35, 8), np.linspace(0.05, 0.35, 8))
    origins = np.stack([np.full_like(y, -1.0), y, z], -1)
    rays = origins, np.broadcast_to(STRAIGHT, origins.shape)
    for transforms in ((jv.EmptySpaceJitter(4),), (jv.EmptySpaceJitter(4), jv.SpaceLeaping())):
        found = jv.render_rays(
            *(volume, soft_transfer(), *rays, jv.March(0.11, transforms)), compositing=jv.Isosurface(0.93)
        )
        np.testing.assert_allclose(found.depth, 1 + 2.0 + 0.93 * 2.0, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("labels", [False, True])
def test_cells_that_labels_divide_hold_the_same_surface(labels):
    colors = np.random.default_rng(2).integers(0, 3, NOISE.shape)
    volume = jv.Volume(NOISE.data, NOISE.spacing, NOISE.origin, labels=colors)
    look = soft_transfer()
    transfer = jv.LabelTransferFunction({0: look, 1: look, 2: look})
    march = jv.March(0.02, (jv.AlphaCorrection(labels=labels),))
    found = jv.render(volume, transfer, around(volume), march, compositing=SURFACE)
    expected = jv.render(NOISE, look, around(volume), jv.March(0.02), compositing=SURFACE)
    # cells that are divided miss less
    same = np.isclose(found.depth, expected.depth, rtol=1e-5)
    assert same.mean() > (0.95 if labels else 0.999)
    np.testing.assert_allclose(found.rgba[same], expected.rgba[same], atol=1e-5)


@pytest.mark.slow
def test_rays_that_a_map_bends_meet_the_surface():
    """At each depth that is found, the volume has the value."""
    volume, probe = jv.toroidal_phantom("shells", (24, 24, 48), speckle=False)
    march = jv.March(0.5, (probe, jv.AlphaCorrection(), jv.SpaceLeaping()))
    value = 0.5 * float(np.max(volume.data))
    space = march.locate(volume)
    low, high = (np.asarray(space.middle) + side * float(space.diagonal) / 4 for side in (-1, 1))
    camera = jv.Camera(low - 2 * (high - low), np.asarray(space.middle), (0, 0, 1), size=(40, 32))
    found = jv.render(volume, soft_transfer(), camera, march, compositing=jv.Isosurface(value))
    hit = np.isfinite(found.depth)
    assert hit.mean() > 0.02
    origins, directions = (np.asarray(part)[hit] for part in camera.rays())
    points = origins + directions * np.asarray(found.depth)[hit][:, None]
    values = jax.vmap(lambda p: volume.value(space.coordinate(tuple(p))))(jnp.asarray(points))
    np.testing.assert_allclose(values, value, rtol=1e-3)


@pytest.mark.parametrize("adjoint", ["replay", *slow("forward", "direct")])
def test_gradients_are_central_differences(adjoint):
    """Of depths, normals and colours. The surface is opaque, and its root that of any step."""
    with in_float64():
        volume = jv.Volume(np.asarray(NOISE.data, np.float64), NOISE.spacing)
        value = {"value": lambda mode: mode.value}
        constant = {"extinction", "step"}
        check_gradients(volume, jv.Isosurface(0.45), value, adjoint, constant=constant, normals=True)


@pytest.mark.slow
def test_an_image_of_nothing_has_the_gradient_0():
    """Of a value that the volume does not have, and of rays that miss among others that do not."""

    def loss(scene):
        value, camera, march, volume = scene
        image = jv.render(volume, soft_transfer(), camera, march, compositing=jv.Isosurface(value))
        depth = jnp.where(jnp.isfinite(image.depth), image.depth, 0)
        return jnp.sum(image.rgba) + jnp.sum(depth) + jnp.sum(image.normal)

    for value, shows in ((7.0, False), (0.45, True)):
        scene = jnp.asarray(value), around(NOISE, (12, 10)), jv.March(0.11, (jv.SpaceLeaping(),)), NOISE
        gradient = eqx.filter_grad(loss)(scene)
        for leaf in jax.tree.leaves(gradient):
            assert np.isfinite(leaf).all()
            assert shows or not leaf.any()
        assert bool(gradient[0] != 0) == shows


def test_nan_is_passed_on():
    volume = eqx.tree_at(lambda v: v.data, NOISE, NOISE.data.at[10:14, 10:14, 10:14].set(jnp.nan))
    high = eqx.tree_at(lambda v: v.data, volume, volume.data.at[:].add(2.0))  # nothing is crossed in front
    for transforms in ((), (jv.SpaceLeaping(),)):
        hurt = jv.render(
            high, soft_transfer(), around(NOISE), jv.March(0.11, transforms), compositing=SURFACE
        )
        lost = np.isnan(hurt.rgba).all(axis=-1)
        assert 0 < lost.mean() < 0.3
        np.testing.assert_array_equal(np.isnan(hurt.depth), lost)
        np.testing.assert_array_equal(hurt.rgba[~lost], 0)
    image = jv.render(
        *(NOISE, soft_transfer(), around(NOISE), jv.March(0.11)),
        compositing=eqx.tree_at(lambda mode: mode.value, SURFACE, jnp.asarray(jnp.nan)),
    )
    assert np.isnan(image.rgba).all()


@pytest.mark.slow
def test_more_tiles_than_one_show_nothing():
    scene = NOISE, soft_transfer(), around(NOISE, (37, 50)), jv.March(0.11, (jv.SpaceLeaping(),))
    whole = jv.render(*scene, compositing=SURFACE)
    small = render_scene(Scene(*scene, SURFACE), "all", "replay", Tiling(tile=6, batch=5))
    for part in ("rgba", "depth", "normal"):
        np.testing.assert_array_equal(getattr(whole, part), getattr(small, part))


@pytest.mark.slow
def test_a_surface_is_lit():
    """By the same light in both engines."""
    lighting = ScattererTemplates(
        Material(0.8, 0.1, 1.4), DirectionalLight((0.3, -1.0, 0.2)), templates=1, photons=2
    )
    camera, march = around(NOISE, (12, 10)), jv.March(0.11)
    found = jv.render(NOISE, soft_transfer(), camera, march, compositing=SURFACE, lighting=lighting)
    rgba, _ = reference_image(NOISE, soft_transfer(), camera, march, SURFACE, lighting)
    unlit = jv.render(NOISE, soft_transfer(), camera, march, compositing=SURFACE)
    assert np.abs(found.rgba - unlit.rgba).max() > 0.1
    np.testing.assert_allclose(found.rgba, rgba, atol=2e-4)


@pytest.mark.parametrize("value", [np.nan, np.inf, "high", [0.1, 0.2], None])
def test_a_bad_value_is_named(value):
    with pytest.raises(ValueError, match="value must "):
        jv.Isosurface(value)


def test_first_hits_are_refused():
    march = jv.March(0.11, (jv.SpaceLeaping("min_distance"),))
    with pytest.raises(ValueError, match="first; Isosurface may show what lies before"):
        jv.render(NOISE, soft_transfer(), around(NOISE), march, compositing=SURFACE)
