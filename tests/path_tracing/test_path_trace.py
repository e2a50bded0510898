"""Does path tracing give the right radiance, and the right standard error?

Results are compared with closed forms (absorption, a white furnace, Chandrasekhar's diffuse reflection), with
quadrature in NumPy, and with what reciprocity says, by z-scores of pixels and of means over regions. Seeds
are fixed, so that results are repeatable. All tests of images share one compiled program.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

import jaxvol as jv
from jaxvol.lighting import ConstantLight, DirectionalLight, Light, Material, PointLight

from ..half_space import cube, far, reflected, under_sky
from ..scenes import anisotropic_noise, around, in_float64, inside, slow, soft_transfer, uniform_transfer


EXTINCTION = np.array([0.0, 0.0, 1.0, 4.0, 0.5, 0.0, 7.0, 7.0])
POINTS = np.array([0.0, 0.3, 0.35, 0.5, 0.55, 0.6, 0.9, 1.0])
COLORS = np.linspace((0.9, 0.2, 0.6), (0.3, 1.0, 0.5), 8)
BLACK = (0.0, 0.0, 0.0)
SUN = DirectionalLight((0.5, 1.0, -0.7), (2.0, 1.0, 3.0))
LAMP = PointLight((1.5, -2.0, 2.0), (1.0, 4.0, 2.0))
SKY = ConstantLight((0.5, 1.0, 0.7))
NIGHT = DirectionalLight((0.0, 0.0, 1.0), BLACK), PointLight((5.0, 0.0, 0.0), BLACK), ConstantLight(BLACK)
PATHS = 128


def lit(*lights: Light) -> tuple[Light, ...]:
    """These lights, and a dark one of every other kind, so that all tests share one compiled program."""
    return tuple(next((one for one in lights if type(one) is type(out)), out) for out in NIGHT)


FURNACE = lit(ConstantLight())
NOISE = anisotropic_noise()


def trace(volume, transfer, camera, lights, **how: Any) -> jv.PathTraced:
    how.setdefault("paths", PATHS)
    return jv.path_trace(volume, transfer, camera, lights, **how)


def often(times: int, *scene: Any, traced: Any = None, **how: Any) -> jv.PathTraced:
    """Trace `times` · PATHS more paths, in successive calls, of another key each."""
    for _ in range(times):
        more = trace(*scene, **how, key=0 if traced is None else traced.paths // PATHS)
        traced = more if traced is None else traced.joined(more)
    assert traced is not None
    return traced


def spiky(factor: float = 1.0, colors: Any = COLORS) -> jv.TransferFunction:
    """Alternately transparent, thin and dense."""
    return jv.TransferFunction(POINTS, colors, factor * EXTINCTION)


def regions(image) -> np.ndarray:
    """Sums over blocks of 4 x 4 pixels."""
    height, width, *rest = np.shape(image)
    return np.asarray(image, float).reshape(height // 4, 4, width // 4, 4, *rest).sum(axis=(1, 3))


def z_of_regions(difference, variance) -> np.ndarray:
    """Regions' differences in standard errors; 0 where both are 0."""
    return regions(difference) / np.sqrt(np.maximum(regions(variance), 1e-30))


def mean_and_error(traced: jv.PathTraced) -> tuple[np.ndarray, np.ndarray]:
    """Of the radiance of the whole image."""
    radiance, error = (np.asarray(each, float) for each in (traced.radiance, traced.standard_error))
    return radiance.mean(axis=(0, 1)), np.sqrt((error**2).sum(axis=(0, 1))) / (error.size / 3)


# ---------------------------------------------------------------- quadrature in NumPy


def matter(volume, transfer):
    """NumPy functions for the value and the extinction at points, and for the entry and exit of rays."""
    data, spacing, origin = (np.asarray(a, float) for a in (volume.data, volume.spacing, volume.origin))
    low, high = (np.asarray(corner, float) for corner in volume.corners)
    values, table = np.asarray(transfer.values, float), np.asarray(transfer.extinction, float)

    def value(points):
        grid = (np.clip(points, low, high) - origin) / spacing
        return map_coordinates(data, grid.T.reshape(3, -1), order=1).reshape(points.shape[:-1][::-1]).T

    def extinction(points):
        return np.interp(value(points), values, table)

    def exits(origins, directions):
        with np.errstate(divide="ignore"):
            walls = np.stack([(low - origins) / directions, (high - origins) / directions])
        return np.maximum(walls.min(axis=0).max(axis=-1), 0), walls.max(axis=0).min(axis=-1)

    return value, extinction, exits


def middles_of(camera, exits, samples):
    """Midpoints of equal intervals along each ray, the rays' directions, and the intervals' lengths."""
    origins, directions = (np.asarray(a, float).reshape(-1, 3) for a in camera.rays())
    near, far = exits(origins, directions)
    width = np.maximum(far - near, 0) / samples
    depths = near[:, None] + (np.arange(samples) + 0.5) * width[:, None]
    return origins[:, None] + depths[..., None] * directions[:, None], directions, width


def once_scattered(volume, transfer, camera, lights, anisotropy, samples=256, toward=64) -> np.ndarray:
    """Singly scattered light, by the midpoint rule along the ray and along the path to each light."""
    value, extinction, exits = matter(volume, transfer)
    values, colors, table = (
        np.asarray(a, float) for a in (transfer.values, transfer.colors, transfer.extinction)
    )
    points, directions, width = middles_of(camera, exits, samples)
    here = value(points)
    density = np.interp(here, values, table)
    albedo = np.stack([np.interp(here, values, colors[:, i]) for i in range(3)], axis=-1)
    depth = np.cumsum(density, axis=1) * width[:, None] - density * width[:, None] / 2
    gathered = np.zeros((len(points), 3))
    for light in lights:
        if isinstance(light, DirectionalLight):
            way = np.broadcast_to(-np.asarray(light.direction, float), points.shape)
            irradiance = np.asarray(light.irradiance, float)
            end = np.inf
        else:
            way = np.asarray(light.position, float) - points
            end = np.linalg.norm(way, axis=-1)
            irradiance = np.asarray(light.intensity, float) / end[..., None] ** 2
        way = way / np.linalg.norm(way, axis=-1, keepdims=True)
        step = np.minimum(exits(points, way)[1], end) / toward
        shade = np.zeros(step.shape)
        for i in range(toward):
            shade += step * extinction(points + ((i + 0.5) * step)[..., None] * way)
        cosine = np.sum(way * directions[:, None], axis=-1)
        g = anisotropy
        phase = (1 - g**2) / (4 * np.pi * (1 + g**2 - 2 * g * cosine) ** 1.5)
        weight = (density * width[:, None] * phase * np.exp(-depth - shade))[..., None]
        gathered += np.sum(weight * albedo * irradiance, axis=1)
    return gathered.reshape(*np.asarray(camera.rays()[0]).shape)


def test_opacity_is_that_of_absorption():
    camera = inside(NOISE)
    traced = np.asarray(trace(NOISE, spiky(), camera, FURNACE).opacity)
    _, extinction, exits = matter(NOISE, spiky())
    points, _, width = middles_of(camera, exits, samples=2048)
    opacity = -np.expm1(-extinction(points).sum(axis=1) * width).reshape(traced.shape)
    assert np.ptp(opacity) > 0.3
    assert np.all(traced[opacity == 0] == 0)
    z = z_of_regions(traced - opacity, opacity * (1 - opacity) / PATHS)
    assert abs(z).max() < 3.5
    assert 0.5 < np.mean(z**2) < 1.7


def test_light_scattered_once_is_that_of_quadrature_and_its_error_is_the_one_told():
    anisotropy, camera = 0.4, around(NOISE)
    how: Any = {"anisotropy": anisotropy, "max_scatterings": 1}
    traced = often(2, NOISE, spiky(), camera, lit(SUN, LAMP), **how)
    assert np.asarray(traced.exhausted).any()  # paths are cut off after one scattering
    expected = once_scattered(NOISE, spiky(), camera, (SUN, LAMP), anisotropy)
    difference, error = np.asarray(traced.radiance) - expected, np.asarray(traced.standard_error)
    assert abs(z_of_regions(difference, error**2)).max() < 4
    assert np.all(abs(difference.sum(axis=(0, 1))) < 3 * np.sqrt((error**2).sum(axis=(0, 1))))
    bright = expected > 0.3 * expected.max(axis=(0, 1))
    assert 0.85 < np.std((difference / np.maximum(error, 1e-30))[bright]) < 1.15

    more = often(6, NOISE, spiky(), camera, lit(SUN, LAMP), traced=traced, **how)
    assert more.paths == 4 * traced.paths
    more_error = np.asarray(more.standard_error)
    assert abs(more_error.mean() / error.mean() - 0.5) < 0.02
    assert abs(z_of_regions(np.asarray(more.radiance) - expected, more_error**2)).max() < 4


# ---------------------------------------------------------------- closed forms


def test_the_opacity_of_a_constant_volume_is_its_closed_form():
    volume, extinction = cube(), 0.9
    traced = trace(volume, uniform_transfer(extinction, BLACK), far(volume, 0.6), FURNACE)
    expected, opacity = -np.expm1(-extinction), np.asarray(traced.opacity)
    error = np.sqrt(expected * (1 - expected) / (PATHS * opacity.size))
    assert abs(opacity.mean() - expected) < 3 * error
    # nothing is scattered, and the background is attenuated by the transmittance
    assert not np.asarray(traced.radiance).any()
    behind = np.array([2.0, 1.0, 0.5], np.float32)
    np.testing.assert_allclose(traced.image(behind), (1 - opacity)[..., None] * behind, rtol=1e-6)
    nothing = trace(volume, uniform_transfer(0.0), far(volume, 0.6), lit(SUN, LAMP, SKY))
    for part in (nothing.opacity, nothing.radiance, nothing.standard_error):
        assert not np.asarray(part).any()


@pytest.mark.parametrize("anisotropy", [0.8, *slow(-0.5)])
def test_in_a_white_furnace_nothing_is_to_be_seen(anisotropy):
    white = spiky(10, np.ones((8, 3)))
    traced = trace(NOISE, white, around(NOISE), FURNACE, anisotropy=anisotropy)
    np.testing.assert_allclose(traced.image(), 1, atol=1e-5)
    assert not np.asarray(traced.exhausted).any()


@pytest.mark.parametrize("light", ["sun", *slow("sky")])
def test_light_scattered_many_times_is_reflected_as_by_chandrasekhar(light):
    albedo, cosine, volume = np.array([0.5, 0.8, 0.95]), 0.6, cube()
    sun = DirectionalLight((0.8, 0.0, 0.6), np.ones(3) * np.pi)
    lights = lit(sun) if light == "sun" else lit(ConstantLight((2.0, 2.0, 2.0)))
    traced = often(4, volume, uniform_transfer(60.0, albedo), far(volume, 0.01), lights)
    expected = np.pi * reflected(albedo, 1.0, cosine) if light == "sun" else 2 * under_sky(albedo, 1.0)
    mean, error = mean_and_error(traced)
    assert np.all(error < 0.01 * expected)
    assert np.all(abs(mean - expected) < 3 * error)


# ---------------------------------------------------------------- symmetries


@pytest.mark.slow
def test_light_and_view_may_change_places():
    """Helmholtz's reciprocity: what a volume scatters from one direction into another one is what it would
    scatter the other way round. Nothing is at its faces, so that pixels are enough to integrate over."""
    x = np.linspace(-1, 1, 24) ** 2
    window = np.clip(2 - 2 * (x[:, None, None] + x[:, None] + x), 0, 1)
    volume = jv.Volume(np.asarray(NOISE.data) * window, NOISE.spacing, NOISE.origin)
    views, height, size = (np.array([0.3, 0.2, 1.0]), np.array([0.7, 0.4, -0.5])), 3.2, (20, 16)
    fluxes, errors = [], []
    for view, light in (views, views[::-1]):
        camera, sun = far(volume, height, size, view), lit(DirectionalLight(light))
        right = np.cross(view, (0, 1, 0)) / np.linalg.norm(np.cross(view, (0, 1, 0)))
        up = np.cross(right, view) / np.linalg.norm(view)
        means = []
        for i in range(16):  # at 4 x 4 points of each pixel
            shift = height / size[1] * ((i % 4 - 1.5) * right + (i // 4 - 1.5) * up) / 4
            position, focus = (np.asarray(end) + shift for end in (camera.position, camera.focal_point))
            moved = jv.Camera(position, focus, (0, 1, 0), camera.view_angle, size=size)
            traced = trace(volume, spiky(), moved, sun, anisotropy=0.4, key=i)
            means.append(mean_and_error(traced))
        fluxes.append(np.mean([mean for mean, _ in means], axis=0))
        errors.append(np.sqrt(np.sum([error**2 for _, error in means], axis=0)) / 16)
    assert np.all(np.array(errors) < 0.01 * fluxes[0])
    assert np.all(abs(fluxes[0] - fluxes[1]) < 3.5 * np.hypot(*errors))


@pytest.mark.slow
def test_lights_add_up():
    camera, transfer = around(NOISE), spiky(3)
    each = [trace(NOISE, transfer, camera, lights, key=7) for lights in (lit(SUN, LAMP), lit(SKY))]
    all_ = trace(NOISE, transfer, camera, lit(SUN, LAMP, SKY), key=8)
    difference = all_.radiance - each[0].radiance - each[1].radiance
    variance = sum(np.asarray(image.standard_error) ** 2 for image in (*each, all_))
    assert abs(z_of_regions(difference, variance)).max() < 4
    np.testing.assert_array_equal(each[0].opacity, each[1].opacity)  # the primary rays are the same


# ---------------------------------------------------------------- materials


@pytest.mark.slow
def test_a_material_found_by_its_label_has_its_mean_free_path_and_opacity():
    nowhere, labelled = Material(0.5, 1.0, values=(5.0, 6.0)), 2
    labels = np.zeros((24,) * 3, np.uint8)
    labels[12:] = labelled
    volume, materials = cube(labels), (nowhere, nowhere, Material(0.9, 0.5, label=labelled))
    traced = trace(volume, uniform_transfer(0.5), far(volume, 0.6), FURNACE, materials=materials)
    right, left = np.s_[:, :8], np.s_[:, 12:]  # in a view along +z, x increases to the left
    for half, extinction in ((left, 0.5), (right, 2.0)):
        opacity = np.asarray(traced.opacity)[half]
        expected = -np.expm1(-extinction)
        error = np.sqrt(expected * (1 - expected) / (PATHS * opacity.size))
        assert abs(opacity.mean() - expected) < 3.5 * error
    # the albedo is a tenth in the material, and 1 elsewhere
    seen = np.asarray(traced.radiance)[..., 0] / np.asarray(traced.opacity)
    assert seen[right].mean() < 0.1
    assert seen[left].mean() > 0.6


# ---------------------------------------------------------------- derivatives, NaN

SCENE = {
    "volume": NOISE,
    "transfer": spiky(),
    "camera": around(NOISE),
    "lights": lit(SUN, LAMP, SKY),
    "anisotropy": np.float32(0.0),
}


def image_of(scene, **how):
    given = [scene[name] for name in ("volume", "transfer", "camera", "lights")]
    return trace(*given, anisotropy=scene["anisotropy"], **how).radiance


def test_it_may_stand_in_what_is_differentiated_with_respect_to_something_else():
    expected = np.asarray(image_of(SCENE)).mean()

    def loss(gain):
        tinted = ConstantLight(jax.lax.stop_gradient(gain) * SKY.radiance)
        return gain * image_of(SCENE | {"lights": lit(SUN, LAMP, tinted)}).mean()

    np.testing.assert_allclose(jax.jit(jax.grad(loss))(1.0), expected, rtol=1e-5)


def test_matter_far_denser_than_a_voxel_is_opaque_and_takes_no_longer():
    """Also where a fit leads: flights beside it would stop once a mean free path."""
    found = [np.asarray(image_of(SCENE, materials=(Material(0.9, path),))) for path in (1e-6, 1e-30)]
    np.testing.assert_array_equal(*found)
    assert found[0].max() > 0


def test_nan_and_infinity_make_the_image_nan():
    for where in (
        lambda scene: scene["transfer"].extinction,
        lambda scene: scene["transfer"].colors,
        lambda scene: scene["lights"][0].direction,
        lambda scene: scene["lights"][2].radiance,
        lambda scene: scene["camera"].position,
        lambda scene: scene["volume"].spacing,
        lambda scene: scene["volume"].data,
    ):
        for number in (np.nan, np.inf):
            leaf = np.array(where(SCENE))
            leaf.flat[-1] = number
            broken = eqx.tree_at(where, SCENE, jax.device_put(leaf))
            assert np.isnan(image_of(broken)).all()
    for where, wrong in (
        (lambda scene: scene["camera"].view_angle, np.float32(180)),
        (lambda scene: scene["transfer"].values, np.array(SCENE["transfer"].values)[::-1]),
    ):
        assert np.isnan(image_of(eqx.tree_at(where, SCENE, jax.device_put(wrong)))).all()


# ---------------------------------------------------------------- what does not show


@pytest.mark.slow
def test_how_many_paths_go_on_side_by_side_does_not_show():
    """Many images at once are those one by one."""
    volume, camera, lights = NOISE, inside(NOISE), lit(SUN, LAMP, SKY)
    some = trace(volume, spiky(), camera, lights, key=3)
    # in two waves of pixels
    other = trace(volume, spiky(), camera, lights, key=jax.random.key(3), lanes=125)
    assert some.paths == other.paths
    for name in ("radiance", "opacity", "standard_error"):
        np.testing.assert_allclose(getattr(some, name), getattr(other, name), rtol=1e-3, atol=1e-5)
    # another key gives another image
    assert float(abs(trace(volume, spiky(), camera, lights, key=4).radiance - some.radiance).max()) > 1e-3

    def image(radiance):
        return image_of(SCENE | {"lights": lit(SUN, LAMP, ConstantLight(radiance))})

    skies = jnp.asarray([[0.5, 1.0, 0.7], [2.0, 0.1, 0.0]])
    np.testing.assert_allclose(jax.vmap(image)(skies), [image(sky) for sky in skies], rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_the_type_of_voxels_does_not_show():
    whole = np.random.default_rng(0).integers(0, 100, (24,) * 3)
    transfer = jv.TransferFunction(np.linspace(0, 100, 40), np.full((40, 3), 0.8), np.linspace(0, 9, 40) ** 2)
    single, other = (
        trace(jv.Volume(whole.astype(dtype), (1 / 23,) * 3), transfer, far(cube(), 1.2), lit(SUN, LAMP, SKY))
        for dtype in ("float32", "uint8")
    )
    np.testing.assert_allclose(single.radiance, other.radiance, rtol=1e-3, atol=1e-4)
    with in_float64():
        volume = jv.Volume(whole.astype("uint8"), (1 / 23,) * 3)
        double = trace(volume, transfer, far(cube(), 1.2), lit(SUN, LAMP, SKY))
    assert double.radiance.dtype == jnp.float32
    np.testing.assert_allclose(single.radiance.mean(), double.radiance.mean(), rtol=0.01)


def test_bad_arguments_are_named():
    camera, transfer = around(NOISE), soft_transfer()

    def fails(word: str, *args, **how):
        with pytest.raises(ValueError, match=word):
            jv.path_trace(*(args or (NOISE, transfer, camera, FURNACE)), **how)

    fails("lights", NOISE, transfer, camera, ())
    fails("paths", paths=0)
    fails("paths", paths=1.5)
    fails("key", key="seed")
    fails("key", key=-1)
    with pytest.raises(ValueError, match=r"key must be an integer, or a key of jax.random; got"):
        jax.eval_shape(lambda key: jv.path_trace(NOISE, transfer, camera, FURNACE, key=key).radiance, 0.5)
    for key in (jnp.int32(3), jax.random.key(3)):  # traced
        traced = jax.eval_shape(lambda key: jv.path_trace(NOISE, transfer, camera, FURNACE, key=key), key)
        assert traced.radiance.shape == (*camera.size[::-1], 3)
    fails("anisotropy", anisotropy=1.0)
    fails("max_scatterings", max_scatterings=0)
    fails("lanes", lanes=0)
    fails("materials", materials=())
    fails("materials", materials=Material(0.5, 1.0, label=1))
    fails("labels", NOISE, jv.LabelTransferFunction([transfer] * 2), camera, FURNACE)
    flat, rgb = np.zeros((4, 4), np.float32), np.zeros((4, 4, 3), np.float32)
    flat, rgb, none, seed = jax.device_put((flat, rgb, flat > 0, np.uint32(0)))
    image = jv.PathTraced(rgb, flat, rgb, none, 2, seed)
    with pytest.raises(ValueError, match="background"):
        image.image((1.0, 2.0))
    with pytest.raises(ValueError, match="other must be of another key"):
        image.joined(image)
