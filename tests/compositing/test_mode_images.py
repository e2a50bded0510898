"""Are images of every compositing mode, in both engines, those of NumPy? And their gradients right?"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.engine.image import render_scene
from jaxvol.engine.tiling import Tiling
from jaxvol.lighting import DirectionalLight, Material, ScattererTemplates
from jaxvol.ray import Scene

from .. import oracle
from ..modes import (
    KNOWN,
    MODES,
    VALUE,
    Additive,
    FoggedSurface,
    ball_in_a_corner,
    check_gradients,
    same_image,
    scaled_transfer,
    shown,
)
from ..scenes import (
    SIZE,
    anisotropic_noise,
    around,
    in_float64,
    inside,
    orthographic,
    rendered,
    slow,
    soft_transfer,
    with_voxels,
)


STEP = 0.11
JITTER = jv.EmptySpaceJitter(4)
SIMILAR = "minimum", "first visible"
"""To the maximum, and to the isosurface."""
TOPS = {"uint8": 255, "uint16": 60_000, "int16": 4000, "float32": 1}


def scene_of(name, volume, dtype):
    """A volume of values from 0 to 1 in another type, with a transfer function and the mode for it."""
    top, transfer = TOPS[dtype], soft_transfer()
    data = np.asarray(volume.data)
    if name == "minimum":  # what is invisible are the greatest values
        data = 1 - data
        transfer = jv.TransferFunction(
            1 - transfer.values[::-1], transfer.colors[::-1], transfer.extinction[::-1]
        )
    data = data * top if dtype == "float32" else np.round(data * top)
    mode = jv.Isosurface(VALUE * top) if name == "isosurface" else MODES[name]
    return jv.Volume(data.astype(dtype), volume.spacing, volume.origin), scaled_transfer(top, transfer), mode


def march_of(name, *transforms, step=STEP):
    ending = () if name == "over" else (jv.EarlyTermination(0.05),)  # under which other rays never end
    return jv.March(
        step,
        (JITTER, jv.AlphaCorrection(), *ending, *transforms),
        KNOWN[name].quadrature,
    )


def test_of_equal_values_the_nearest_is_the_greatest():
    """In a saturated half of a volume, where interpolation rounds its value to either side."""
    data = np.zeros((32, 32, 32), np.float32)
    data[10:] = 0.7
    volume, step = jv.Volume(data, (0.37, 0.41, 0.53)), 0.1
    camera = jv.Camera.looking_at(volume, (-1, 0.23, 0.17), size=SIZE)
    transfer = jv.TransferFunction([0, 0.7], [[0, 0, 0], [1, 1, 1]], [0, 5.0])
    found = rendered(volume, transfer, camera, jv.March(step), compositing="maximum").depth
    origins, directions = (np.asarray(part, float).reshape(-1, 3) for part in camera.rays())
    near, far = oracle.box_interval(origins, directions, [0] * 3, 31 * np.array([0.37, 0.41, 0.53]))
    saturated = (10 * 0.37 - origins[:, 0]) / directions[:, 0]
    first = near + step * np.ceil((np.maximum(saturated, near) - near) / step)
    some = (far > near) & (first < far - 0.01)
    off = np.abs(np.asarray(found).ravel() - first)[some]
    assert some.sum() > 80
    assert np.mean(off > 1e-4) < 0.02  # the first sample may be at 255 by rounding alone
    assert off.max() < 1.01 * step


PLAIN = [name for name in MODES if name not in SIMILAR]
IN_ONE = "additive", "integral"
"""Whose images are of one program, since another mode's by stages stand for theirs."""
MAPS = {"average": "voxels"}
"""A mode whose march is told another transfer function, by a map that is made before the image."""


@pytest.mark.parametrize(
    ("name", "method", "dtype"),
    [
        *((name, MAPS.get(name, "blocks"), KNOWN[name].dtype) for name in PLAIN),
        *slow(*((name, "blocks", KNOWN[name].dtype) for name in SIMILAR)),
        *slow(("maximum", "distance", "float32"), ("isosurface", "beam", "uint8")),
    ],
)
def test_an_image_is_that_of_numpy(name, method, dtype):
    """Where rays leap, samples shift and cells are cut: of noise and, in empty space, of a ball."""
    render = rendered if name in IN_ONE else jv.render
    for each, step, most in ((anisotropic_noise(), STEP, 1.001), (ball_in_a_corner(), 0.05, 0.7)):
        leaps = jv.SpaceLeaping("distance", block=1) if method == "voxels" else jv.SpaceLeaping(method)
        march = march_of(name, leaps, step=step)
        volume, transfer, mode = scene_of(name, each, dtype)
        for camera, rest in ((around(volume).zoom(2.0), 0), (inside(volume), 0.2)):
            found = render(volume, transfer, camera, march, compositing=mode)
            value = float(mode.value) if isinstance(mode, jv.Isosurface) else 0
            rgba, depth, samples = shown(name, volume, transfer, camera, step, JITTER, value)
            assert np.mean(rgba[..., 3] > 0) > 0.05
            same_image(found, rgba, depth)
            taken = np.sum(np.asarray(found.samples)) / samples
            assert taken == 1 if name == "average" else taken < most + rest


def test_the_reference_shows_the_same():
    """Modes of each kind in one program, of rays that shift."""
    names = "additive", "average", "maximum", "isosurface"
    volume, camera = anisotropic_noise(), around(anisotropic_noise())
    width, height = camera.size
    row, column = np.mgrid[:height, :width].astype(np.int32)

    @jax.jit
    @jax.vmap
    @jax.vmap
    def reference(origin, direction, column, row):
        return {
            name: jv.render_ray_reference(
                *(volume, soft_transfer(), origin, direction, march_of(name)),
                pixel=(column, row),
                compositing=MODES[name],
            )
            for name in names
        }

    found = reference(*camera.rays(), column, row)
    for name in names:
        same_image(found[name], *shown(name, volume, soft_transfer(), camera, STEP, JITTER)[:2])


def test_nan_is_passed_on():
    """From voxels into the pixels whose rays meet them, and from a parameter into all."""
    volume = anisotropic_noise()
    camera = around(volume)
    higher = jv.Volume(np.asarray(volume.data) + 2, volume.spacing, volume.origin)  # no surface is in front
    hurt, high = (with_voxels(each, np.s_[10:14, 10:14, 10:14], np.nan) for each in (volume, higher))
    nan = jax.device_put(np.full(8, np.nan, np.float32))
    lost = eqx.tree_at(lambda t: t.extinction, soft_transfer(), nan)
    nowhere = eqx.tree_at(lambda m: m.value, MODES["isosurface"], jax.device_put(np.float32(np.nan)))
    for name, data, transfer, mode in (
        ("average", hurt, lost, MODES["average"]),
        ("isosurface", high, soft_transfer(), nowhere),
    ):
        march = march_of(name, jv.SpaceLeaping())
        found = jv.render(data, soft_transfer(), camera, march, compositing=MODES[name])
        seen = np.isnan(found.rgba).any(axis=-1)
        assert 0 < seen.mean() < 0.3
        if name == "isosurface":
            np.testing.assert_array_equal(np.isnan(found.depth), seen)
            np.testing.assert_array_equal(np.asarray(found.rgba)[~seen], 0)
        assert np.isnan(jv.render(volume, transfer, camera, march, compositing=mode).rgba).all()


# ---- gradients ----


THICKNESS, LEVEL = {"thickness": lambda scene: scene[4].thickness}, {"value": lambda scene: scene[4].value}
GRADIENTS = {
    "isosurface": (FoggedSurface, LEVEL, {"normals": True}),
    "average": (jv.Average, THICKNESS, {}),
    "additive": (lambda part: Additive(part), {}, {}),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "adjoint"),
    [("isosurface", "replay"), ("isosurface", "forward"), ("average", "replay"), ("additive", "direct")],
)
def test_gradients_are_central_differences(name, adjoint):
    """And 0 of an image of nothing."""
    make, parameters, options = GRADIENTS[name]
    with in_float64():
        noise = anisotropic_noise()
        volume = jv.Volume(np.asarray(noise.data, np.float64), noise.spacing, noise.origin)
        transforms = jv.AlphaCorrection(), jv.SpaceLeaping()
        march = jv.March(STEP, transforms, KNOWN[name].quadrature, max_samples=64)
        scene = volume, soft_transfer(), around(volume), march, make(VALUE)
        check_gradients(scene, parameters, adjoint, **options)


def test_a_selected_sample_moves_with_the_face_that_cuts_its_cell():
    """Values grow towards the exit, and are cut by a plane inside, as those of tissue are; half of the rays
    end in front of it."""
    x, y, z = np.indices((8, 8, 8)) / 7
    with in_float64():
        volume = jv.Volume(10 * (x + 0.5 * y + 0.2 * z))
        transfer = jv.TransferFunction([0, 20], [(0, 0, 0), (1, 1, 1)], [0.1, 0.1])
        camera = jv.Camera((-30, -20, 9), (3.5, 3.5, 3.5), (0, 0, 1), size=(8, 8))
        plane = (5.0, 3.5, 3.5), (-0.8, -0.3, 0.5)
        weights = np.random.default_rng(0).uniform(0.5, 1.5, (8, 8))

        def shown(given):
            step, shift, origin, until = given
            seen = eqx.tree_at(lambda c: c.position, camera, camera.position + shift)
            cut = eqx.tree_at(lambda c: c.origins, jv.Clip(planes=[plane]), origin[None])
            march = jv.March(step, (jv.Jitter(1), cut, jv.AlphaCorrection()), "midpoint")
            seen = jv.render(volume, transfer, seen, march, compositing="maximum", until=until)
            depth = jnp.where(seen.rgba[..., 3] > 0, seen.depth, 0)
            return jnp.sum(weights * (seen.rgba[..., 0] + depth / 10))

        until = np.where(np.indices((8, 8))[1] < 4, 40.0, np.inf)
        given = [np.asarray(0.6), np.zeros(3), np.asarray(plane[0]), until]
        both = jax.jit(jax.value_and_grad(shown))
        gradient = jax.device_get(both(given)[1])
        for at, along in enumerate((1.0, (0.5, 0.3, -0.8), (1.0, 0.0, 0.0), np.ones((8, 8)))):
            ends = []
            for step in (1e-6, -1e-6):
                moved = list(given)
                moved[at] = given[at] + step * np.asarray(along)
                ends.append(float(both(moved)[0]))
            expected = (ends[0] - ends[1]) / 2e-6
            assert abs(expected) > 0.01
            np.testing.assert_allclose(np.sum(gradient[at] * np.asarray(along)), expected, rtol=1e-5)


# ---- with light, labels, tiles ----


@pytest.mark.slow
def test_what_is_selected_is_lit():
    """By the same light in both engines; through a parallel camera."""
    lighting = ScattererTemplates(
        Material(0.8, 0.1, 1.4), DirectionalLight((0.3, -1.0, 0.2)), templates=1, photons=2
    )
    volume = anisotropic_noise()
    camera, march, mode = orthographic(volume), jv.March(STEP), MODES["isosurface"]
    found = jv.render(volume, soft_transfer(), camera, march, compositing=mode, lighting=lighting)
    unlit = jv.render(volume, soft_transfer(), camera, march, compositing=mode)
    assert np.abs(found.rgba - unlit.rgba).max() > 0.1

    @jax.jit
    @jax.vmap
    def reference(origin, direction):
        options = {"compositing": mode, "lighting": lighting}
        return jv.render_ray_reference(volume, soft_transfer(), origin, direction, march, **options).rgba

    np.testing.assert_allclose(found.rgba[8], reference(*(part[8] for part in camera.rays())), atol=2e-4)


@pytest.mark.slow
def test_more_tiles_than_one_show_nothing():
    volume, mode = anisotropic_noise(), MODES["isosurface"]
    scene = volume, soft_transfer(), around(volume, (37, 50)), jv.March(STEP, (jv.SpaceLeaping(),))
    whole = jv.render(*scene, compositing=mode)
    small = render_scene(Scene(*scene, mode), "all", "replay", Tiling(tile=6, batch=5))
    for part in ("rgba", "depth", "normal"):
        np.testing.assert_array_equal(getattr(whole, part), getattr(small, part))
