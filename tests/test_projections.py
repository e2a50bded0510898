"""Maximum, minimum and average of a ray: compared with NumPy, with the reference, and with differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.engine.driver import render_scene
from jaxvol.engine.scene import Scene
from jaxvol.engine.tiling import Tiling
from jaxvol.lighting import ConstantLight, Deferred, DirectionalLight, Material, ScattererTemplates

from .modes import ball_in_a_corner, check_gradients, reference_image, same_images
from .scenes import (
    CAMERAS,
    anisotropic_noise,
    around,
    in_float64,
    slow,
    soft_transfer,
    uniform_transfer,
)


NOISE = anisotropic_noise()
TRANSFORMS = jv.EmptySpaceJitter(4), jv.AlphaCorrection(), jv.EarlyTermination(0.05)
MODES = {"maximum": jv.Maximum(0.5), "minimum": jv.Minimum(0.5), "average": jv.Average(0.5)}
METHODS = "hierarchy", "distance", "beam"


def along_x(data):
    """Rays along x through the middles of all voxels (y, z) but those at the faces."""
    _, ny, nz = data.shape
    y, z = np.meshgrid(np.arange(1.0, ny - 1), np.arange(1.0, nz - 1), indexing="ij")
    origins = np.stack([np.full_like(y, -3.0), y, z], -1)
    return origins, np.broadcast_to([1.0, 0.0, 0.0], origins.shape)


def layers(transfer, values, thickness):
    """Premultiplied colours and opacities of layers of these values."""
    points = np.asarray(transfer.values, np.float64)
    color = np.stack([np.interp(values, points, c) for c in np.asarray(transfer.colors, np.float64).T], -1)
    opacity = 1 - np.exp(-thickness * np.interp(values, points, np.asarray(transfer.extinction, np.float64)))
    return np.concatenate([color, np.ones_like(opacity)[..., None]], -1) * opacity[..., None]


def data_of(name, real_volume):
    """Voxels and a transfer function of their range."""
    if name == "random":
        return np.random.default_rng(0).random((9, 6, 7), np.float32), soft_transfer()
    data = np.asarray(jv.load(real_volume("fuel_64x64x64_uint8.raw")).data)
    return data, jv.TransferFunction.from_points(
        [(0.0, (0.2, 0.1, 0.9), 0.05), (20.0, (0.9, 0.8, 0.1), 0.1), (255.0, (1.0, 1.0, 1.0), 0.9)]
    )


@pytest.mark.parametrize("name", ["random", "fuel"])
@pytest.mark.parametrize("mode", ["maximum", "minimum", "average"])
def test_they_are_those_of_numpy(name, mode, real_volume):
    """Along rays through the middles of voxels, samples are voxels; the mean is the trapezoidal rule's."""
    data, transfer = data_of(name, real_volume)
    rays, inner = along_x(data), data[:, 1:-1, 1:-1].astype(np.float64)
    if mode == "average":
        shown, march = np.trapezoid(inner, axis=0) / (len(data) - 1), jv.March(1.0, (), "midpoint")
        depth = np.full(shown.shape, 3 + (len(data) - 1) / 2)
    else:
        inner = inner[:-1]  # the exit is no sample
        shown, march = getattr(inner, mode[:3])(axis=0), jv.March(1.0)
        depth = 3.0 + getattr(inner, f"arg{mode[:3]}")(axis=0)
    found = jv.render_rays(jv.Volume(data), transfer, *rays, march, compositing=MODES[mode])
    expected = layers(transfer, shown, 0.5)
    np.testing.assert_allclose(found.rgba, expected, atol=2e-5)
    seen = expected[..., 3] > 0
    assert seen.mean() > 0.1
    np.testing.assert_allclose(found.depth[seen], depth[seen], rtol=1e-5)
    assert np.isinf(found.depth[~seen]).all()


@pytest.mark.parametrize("mode", ["maximum", "minimum", "average"])
def test_gradients_go_to_the_voxels_that_are_shown(mode):
    data = np.random.default_rng(0).random((9, 6, 7), np.float32)
    transfer, rays = jv.TransferFunction([0.0, 1.0], np.ones((2, 3)), [0.2, 1.2]), along_x(data)
    march = jv.March(1.0, (), "midpoint" if mode == "average" else "left")

    def total(data):
        volume = eqx.tree_at(lambda v: v.data, jv.Volume(np.zeros(data.shape, np.float32)), data)
        image = jv.render_rays(volume, transfer, *rays, march, compositing=MODES[mode])
        return -jnp.sum(jnp.log(1 - image.rgba[..., 3])) / 0.5  # of the extinction

    gradient = np.asarray(jax.grad(total)(jnp.asarray(data)))
    share = np.zeros(data.shape)
    inner = share[:, 1:-1, 1:-1]
    if mode == "average":
        inner[:] = 1 / 8
        inner[[0, -1]] = 1 / 16
    else:
        shown = getattr(data[:-1, 1:-1, 1:-1], f"arg{mode[:3]}")(axis=0)
        np.put_along_axis(inner, shown[None], 1.0, axis=0)
    np.testing.assert_allclose(gradient, share, atol=1e-4)


@pytest.mark.parametrize("quadrature", ["midpoint", *slow("preintegrated")])
@pytest.mark.parametrize("camera", ["around", *slow("inside")])
def test_a_mean_of_linear_values_is_exact(camera, quadrature):
    """It is the value in the middle of the ray, for any step, with the exit cut."""
    shape = (9, 8, 7)
    x, y, z = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    volume = jv.Volume((0.2 + 0.3 * x + 0.25 * y - 0.15 * z).astype(np.float32), (0.1, 0.15, 0.2))
    transfer = jv.TransferFunction([0.0, 1.0], [[0.0] * 3, [1.0] * 3], [0.5, 0.5])
    camera = CAMERAS[camera](volume)
    march = jv.March(0.27, (jv.AlphaCorrection(), jv.EmptySpaceJitter(1)), quadrature)
    found = jv.render(volume, transfer, camera, march, compositing="average")
    origins, directions = (np.asarray(part, np.float64) for part in camera.rays())
    hit = np.asarray(found.rgba[..., 3]) > 0
    assert hit.mean() > 0.3
    middle = (origins + directions * np.where(hit, found.depth, 0)[..., None])[hit]
    part = middle / ((np.array(shape) - 1) * [0.1, 0.15, 0.2])
    expected = 0.2 + part @ [0.3, 0.25, -0.15]
    np.testing.assert_allclose(found.rgba[hit], layers(transfer, expected, 1.0), atol=2e-6)
    np.testing.assert_array_equal(found.rgba[~hit], 0)


@pytest.mark.parametrize("mode", ["average", *slow("maximum", "minimum")])
@pytest.mark.parametrize("camera", ["around", *slow("inside")])
def test_they_are_those_of_the_reference(mode, camera):
    """Where rays leap, samples shift and cells are cut."""
    camera = CAMERAS[camera](NOISE)
    plain, leaping = (jv.March(0.11, (*TRANSFORMS, *more)) for more in ((), (jv.SpaceLeaping(),)))
    rgba, depth = reference_image(NOISE, soft_transfer(), camera, plain, MODES[mode])
    finite = np.isfinite(depth)
    assert finite.mean() > 0.1
    for march in (plain, leaping):
        found = jv.render(NOISE, soft_transfer(), camera, march, compositing=MODES[mode])
        np.testing.assert_allclose(found.rgba, rgba, atol=2e-5 if mode == "average" else 2e-4)
        np.testing.assert_array_equal(np.isfinite(found.depth), finite)
        np.testing.assert_allclose(found.depth[finite], depth[finite], rtol=1e-4)


@pytest.mark.parametrize("mode", ["maximum", *slow("minimum", "average")])
@pytest.mark.parametrize("method", ["hierarchy", *slow("distance", "beam")])
def test_leaps_do_not_show(mode, method):
    """Over a ball in empty space, of 8 bits: under a minimum, the greatest values are the invisible ones."""
    volume = ball_in_a_corner()
    if mode == "minimum":
        volume = eqx.tree_at(lambda v: v.data, volume, 255 - volume.data)
    dim = 0.3 if mode == "average" else 0.0
    points = [(0.0, (0.2, 0.3, 0.8), dim), (60.0, (0.9, 0.4, 0.1), dim), (255.0, (1.0, 1.0, 1.0), 0.9)]
    if mode == "minimum":
        points = [(255 - value, *look) for value, *look in reversed(points)]
    transfer, camera = jv.TransferFunction.from_points(points, 0.5), around(volume).zoom(2.0)
    for jitter in ((), (jv.EmptySpaceJitter(4),)):
        plain, leaping = (
            jv.render(volume, transfer, camera, jv.March(0.05, (*jitter, *more)), compositing=MODES[mode])
            for more in ((), (jv.SpaceLeaping(method),))
        )
        assert np.mean(np.asarray(plain.rgba[..., 3]) > 0) > 0.05
        same_images(leaping, plain)
        fewer = float(np.sum(leaping.samples)) / float(np.sum(plain.samples))
        assert fewer == 1 if mode == "average" else fewer < 0.7


def test_what_is_invisible_of_one_label_may_hide_another():
    """The greatest value is of a label that shows nothing: leaping over it would show what lies before."""
    labels = np.zeros((24, 9, 9), np.uint8)
    labels[12:] = 1
    data = np.where(labels == 1, 0.8, 0.3).astype(np.float32)
    volume = jv.Volume(data, labels=labels)
    transfer = jv.LabelTransferFunction({0: uniform_transfer(0.5), 1: uniform_transfer(0.0)})
    rays = along_x(data)
    plain, leaping = (
        jv.render_rays(volume, transfer, *rays, jv.March(0.5, more), compositing="maximum")
        for more in ((), (jv.SpaceLeaping(),))
    )
    np.testing.assert_array_equal(plain.rgba, 0)
    same_images(leaping, plain)


@pytest.mark.parametrize("adjoint", ["replay", *slow("forward", "direct")])
@pytest.mark.parametrize("mode", ["average", *slow("maximum", "minimum")])
def test_gradients_are_central_differences(mode, adjoint):
    with in_float64():
        volume = jv.Volume(np.asarray(NOISE.data, np.float64), NOISE.spacing)
        shown, own = type(MODES[mode])(0.5), {"thickness": lambda mode: mode.thickness}
        check_gradients(volume, shown, own, adjoint, quadrature="midpoint" if mode == "average" else "left")


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["maximum", "average"])
def test_more_tiles_than_one_show_nothing(mode):
    camera = around(NOISE, (37, 50))
    scene = NOISE, soft_transfer(), camera, jv.March(0.11, (jv.SpaceLeaping(),))
    whole = jv.render(*scene, compositing=MODES[mode])
    small = render_scene(Scene(*scene, MODES[mode]), "all", "replay", Tiling(tile=6, batch=5))
    np.testing.assert_array_equal(whole.rgba, small.rgba)
    np.testing.assert_array_equal(whole.depth, small.depth)


@pytest.mark.parametrize("mode", ["average", *slow("maximum", "minimum")])
def test_nan_is_passed_on(mode):
    """From voxels into the pixels whose rays meet them, and from the transfer function into all."""
    volume = eqx.tree_at(lambda v: v.data, NOISE, NOISE.data.at[10:14, 10:14, 10:14].set(jnp.nan))
    camera, march = around(NOISE), jv.March(0.11, (jv.SpaceLeaping(),))
    hurt = jv.render(volume, soft_transfer(), camera, march, compositing=MODES[mode])
    assert 0 < np.isnan(hurt.rgba).any(axis=-1).mean() < 0.3
    broken = eqx.tree_at(lambda t: t.extinction, soft_transfer(), jnp.full(8, jnp.nan))
    image = jv.render(NOISE, broken, camera, march, compositing=MODES[mode])
    assert np.isnan(image.rgba).all()


@pytest.mark.parametrize("mode", ["average", *slow("maximum")])
def test_an_image_of_nothing_has_the_gradient_0(mode):
    """Rays that miss, and then, among others, rays whose values are invisible."""
    camera = jv.Camera.looking_at(NOISE, size=(12, 10))
    away = eqx.tree_at(lambda c: c.focal_point, camera, 2 * camera.position - camera.focal_point)

    def loss(scene):
        camera, march, volume = scene
        image = jv.render(volume, soft_transfer(), camera, march, compositing=MODES[mode])
        return jnp.sum(image.rgba) + jnp.sum(jnp.where(jnp.isfinite(image.depth), image.depth, 0))

    gradient = eqx.filter_grad(loss)((away, jv.March(0.11), NOISE))
    for leaf in jax.tree.leaves(gradient):
        np.testing.assert_array_equal(leaf, 0)
    dim = eqx.tree_at(lambda v: v.data, NOISE, NOISE.data.at[:, :12].multiply(0.01))
    gradient = eqx.filter_grad(loss)((around(NOISE, (12, 10)), jv.March(0.11), dim))
    for leaf in jax.tree.leaves(gradient):
        assert np.isfinite(leaf).all()


@pytest.mark.slow
def test_a_maximum_is_lit():
    """By the same light in both engines."""
    lighting = ScattererTemplates(
        Material(0.8, 0.1, 1.4), DirectionalLight((0.3, -1.0, 0.2)), templates=1, photons=2
    )
    camera, march = around(NOISE, (12, 10)), jv.March(0.11)
    found = jv.render(NOISE, soft_transfer(), camera, march, compositing="maximum", lighting=lighting)
    rgba, _ = reference_image(NOISE, soft_transfer(), camera, march, jv.Maximum(), lighting)
    np.testing.assert_allclose(found.rgba, rgba, atol=2e-4)


def test_names_stand_for_modes():
    camera, march = around(NOISE), jv.March(0.11)
    for name, mode in (("maximum", jv.Maximum(1.0)), ("average", jv.Average(1.0))):
        found, expected = (
            jv.render(NOISE, soft_transfer(), camera, march, compositing=each) for each in (name, mode)
        )
        np.testing.assert_array_equal(found.rgba, expected.rgba)


@pytest.mark.parametrize("mode", [jv.Maximum, jv.Minimum, jv.Average])
@pytest.mark.parametrize("thickness", [0.0, -1.0, np.nan, "thin"])
def test_a_bad_thickness_is_named(mode, thickness):
    with pytest.raises(ValueError, match="thickness must be "):
        mode(thickness)


def test_what_an_average_cannot_have_is_refused():
    camera, march = around(NOISE), jv.March(0.11)
    labelled = jv.Volume(NOISE.data, NOISE.spacing, labels=np.zeros(NOISE.shape, np.uint8))
    with pytest.raises(ValueError, match="value alone; LabelTransferFunction reads more"):
        jv.render(
            *(labelled, jv.LabelTransferFunction({0: soft_transfer()}), camera, march), compositing="average"
        )
    light = ScattererTemplates(
        Material(0.8, 0.1, 1.4), ConstantLight((1.0, 1.0, 1.0)), templates=1, photons=2
    )
    with pytest.raises(ValueError, match="lighting must be None"):
        jv.render(NOISE, soft_transfer(), camera, march, compositing="average", lighting=Deferred(light))


@pytest.mark.parametrize("name", ["maximum", "minimum", "average"])
def test_first_hits_are_refused(name):
    march = jv.March(0.11, (jv.SpaceLeaping("min_distance"),))
    with pytest.raises(ValueError, match=rf"first; {name.capitalize()} may show what lies before"):
        jv.render(NOISE, soft_transfer(), around(NOISE), march, compositing=name)
