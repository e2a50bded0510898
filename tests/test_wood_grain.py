"""Does jitter break wood grain, keep cut faces smooth and leave the error unchanged? Kye 2013, measured."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.metrics import (
    boundary_noise,
    comb_frequency,
    low_frequency_energy,
    rmse,
    wood_grain_energy,
)
from jaxvol.transforms.jitter import Noise

from .scenes import slow


JITTERS = {"jitter": jv.Jitter, "empty space": jv.EmptySpaceJitter}
SEEDS = range(5)


def rendered(scene, *transforms):
    """Colour over black. All images use alpha correction, so that exits make no difference."""
    volume, transfer, camera, step = scene
    march = jv.March(step, (*transforms, jv.AlphaCorrection()))
    rgba = jv.render(volume, transfer, camera, march, adjoint="forward").rgba  # compiles fastest
    return np.asarray(rgba[..., :3], np.float64)


def converged(scene, refined):
    """A converged image, by the midpoint rule, whose error is of second order in the step."""
    volume, transfer, camera, step = scene
    march = jv.March(step / refined, (jv.AlphaCorrection(), jv.EarlyTermination(1e-6)), "midpoint")
    rgba = jv.render(volume, transfer, camera, march, adjoint="forward").rgba
    return np.asarray(rgba[..., :3], np.float64)


# -- inclined plane ---------------------------------------------------------------------------------------
# The scene is stated for the unit cube and rendered as [-1, 1]³, so that a step of 1/128 becomes 2/128 and an
# extinction of 60 value becomes 30 value.

SLOPE = 0.35


class Plane(jv.Field):
    """The field of `jv.phantom("plane")`, evaluated exactly instead of from voxels."""

    def value(self, volume, coordinate):
        x, _, z = (c * volume.spacing[i] + volume.origin[i] for i, c in enumerate(coordinate))
        return jax.nn.sigmoid(((z + 1) / 2 - 0.25 - SLOPE * (x + 1) / 2) / 0.004)


class Sphere(jv.Field):
    """The field of `jv.phantom("sphere")`, evaluated exactly instead of from voxels."""

    def value(self, volume, coordinate):
        x, y, z = (c * volume.spacing[i] + volume.origin[i] for i, c in enumerate(coordinate))
        return jax.nn.sigmoid((0.5 - jnp.sqrt(x * x + y * y + z * z)) / 0.008)


def surface_transfer():
    """Transparent below 0.05; above it, colour 0.3 + 0.6 value and extinction 30 value."""
    values = np.array([0, 0.04999, 0.05, 1])
    colors = np.tile((0.3 + 0.6 * values)[:, None], 3)
    return jv.TransferFunction(values, colors, [0, 0, 1.5, 30])


def seen_along_z(field, scale, size=256):
    volume = jv.Volume(np.zeros((8, 8, 8), np.float32), [2 / 7] * 3, [-1.0] * 3, field=field())
    camera = jv.Camera((0, 0, -3), (0, 0, 0), (0, 1, 0), size=(size, size), parallel_scale=scale)
    return volume, surface_transfer(), camera, 2 / 128


@cache
def plane(scale=0.5):
    scene = seen_along_z(Plane, scale)
    return scene, converged(scene, 16)


def comb_of(error, scale=0.5):
    # x falls along the columns in this view, and so does the depth
    return wood_grain_energy(error, comb_frequency(2 / 128, (-SLOPE, 0), 2 * scale / 256))


@pytest.mark.parametrize("name", ["empty space", *slow("jitter")])
def test_jitter_breaks_the_comb_of_an_inclined_plane_and_leaves_the_error(name):
    scene, reference = plane()
    plain = rendered(scene)
    comb = comb_of(plain - reference)
    # the rings are more than half of the error's variance
    assert comb > 0.5 * np.sum(np.var(plain - reference, axis=(0, 1)))
    for seed in SEEDS:
        image = rendered(scene, JITTERS[name](seed))
        assert comb_of(image - reference) <= comb / 500, seed
        assert abs(wood_grain_energy(image - reference)) <= wood_grain_energy(plain - reference) / 10, seed
        assert rmse(image, reference) == pytest.approx(rmse(plain, reference), rel=0.05), seed


def test_one_shift_for_all_pixels_moves_the_comb_and_does_not_break_it():
    """The metric responds to jitter, not to a common shift: here all rays begin half a step later."""
    (volume, transfer, camera, step), reference = plane()
    later = jv.Camera((0, 0, -1 + step / 2), (0, 0, 1), (0, 1, 0), size=camera.size, parallel_scale=0.5)
    combs = [comb_of(rendered((volume, transfer, c, step)) - reference) for c in (camera, later)]
    assert combs[1] == pytest.approx(combs[0], rel=0.05)


# -- blue noise -----------------------------------------------------------------------------------------


def test_the_blue_pattern_holds_a_fifth_of_the_slow_energy_of_the_white():
    pixel = tuple(jnp.asarray(axis.ravel()) for axis in np.meshgrid(*[np.arange(256, dtype=np.int32)] * 2))
    for seed in SEEDS:
        energy = {}
        for pattern in ("white", "blue"):
            noise = Noise(seed, pattern, stream=0)
            drawn = np.asarray(jax.vmap(lambda x, y, *, noise=noise: noise((x, y), jnp.float32))(*pixel))
            energy[pattern] = low_frequency_energy(drawn.reshape(256, 256))
        assert energy["blue"] <= energy["white"] / 5, seed


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "bound"), [(0.125, 1 / 5), (0.5, 1 / 2.5)])
@pytest.mark.parametrize("name", ["jitter", "empty space"])
def test_blue_jitter_leaves_less_slow_error_where_the_rings_are_wide(name, scale, bound):
    """The error is a function of ξ + φ, where φ runs from 0 to 1 once per ring. This shifts the spectrum of
    the noise by the comb's frequency, so that narrow rings (scale 0.5: 11 pixels) move high frequencies to
    low ones. With rings of 46 pixels (scale 0.125) the error is as blue as expected."""
    scene, reference = plane(scale)
    energy = {
        pattern: np.mean(
            [low_frequency_energy(rendered(scene, JITTERS[name](s, pattern)) - reference) for s in SEEDS]
        )
        for pattern in ("white", "blue")
    }
    assert energy["blue"] <= bound * energy["white"]


# -- any scene ------------------------------------------------------------------------------------------

SIZE = (128, 128)


@cache
def head():
    return jv.phantom("head", 128)


def skin():
    """Opaque head surface, with as many control points as the preset, so that they share programs."""
    values = np.array([0, 40, 90, 120, 150, 180, 210, 230, 255])
    colors = np.tile(np.interp(values, [0, 40, 90, 255], [0.1, 0.2, 0.8, 1.0])[:, None], 3)
    return jv.TransferFunction(values, colors, np.where(values > 40, 60, 0))


def sphere_scene(_):
    return seen_along_z(Sphere, 0.55, SIZE[0])


def head_scene(_, transfer=None):
    camera = jv.Camera((1.0, -3.2, 0.8), (0, 0, 0), (0, 0, 1), 30.0, size=SIZE)
    return head(), transfer or jv.preset("head", unit_distance=0.01), camera, 2 / 64


def skin_scene(_):
    return head_scene(_, skin())


AIRWAY = "lidc0314_airway_256x192x200_int16le.raw.gz"


def airway(real_volume):
    return jv.load(real_volume(AIRWAY), spacing=(0.78125, 0.78125, 1.0))


def airway_scene(real_volume):
    """A magnified view down the trachea, from inside."""
    camera = jv.Camera((99.5, 43.7, 182), (99.0, 73.7, 150), (0, 1, 0), 70.0, size=SIZE).zoom(2)
    return airway(real_volume), jv.preset("ct_airway"), camera, 0.5


def engine_scene(real_volume):
    volume = jv.load(real_volume("engine_256x256x128_uint8.raw.gz"))
    return volume, jv.preset("engine"), jv.Camera.looking_at(volume, size=SIZE).zoom(2), 2.0


@pytest.mark.slow
@pytest.mark.parametrize("make", [engine_scene, sphere_scene, head_scene, skin_scene, airway_scene])
def test_jitter_breaks_wood_grain_in_any_scene(make, real_volume):
    scene = make(real_volume)
    reference = converged(scene, 8)
    plain = rendered(scene)
    structure = wood_grain_energy(plain - reference)
    # there is wood grain: more than a tenth of the error's variance
    assert structure > 0.1 * np.sum(np.var(plain - reference, axis=(0, 1)))
    for kind in JITTERS.values():
        for seed in (0, 1):
            image = rendered(scene, kind(seed))
            assert abs(wood_grain_energy(image - reference)) <= structure / 10, (kind, seed)


def chest_scene(real_volume):
    """Rays enter through tissue and meet bone before any transparent sample."""
    volume = airway(real_volume)
    return volume, jv.preset("ct_chest"), jv.Camera.looking_at(volume, size=SIZE).zoom(4), 2.0


def cut_head_volume():
    """The head with its face cut off, so that the boundary cuts skin, bone and brain."""
    first = 40
    data = np.asarray(head().data)[:, first:, :]
    return jv.Volume(data, head().spacing, head().origin + np.array([0, first * 2 / 127, 0], np.float32))


def cut_skull_scene(_):
    return cut_head(jv.preset("head", unit_distance=0.01))[0]


@pytest.mark.slow
@pytest.mark.parametrize("make", [cut_skull_scene, chest_scene])
def test_empty_space_jitter_leaves_wood_grain_behind_material_alone(make, real_volume):
    """Its limitation: a ray that meets no transparent sample is not jittered."""
    scene = make(real_volume)
    reference = converged(scene, 8)
    plain, jitter, empty_space = (
        wood_grain_energy(rendered(scene, *transforms) - reference)
        for transforms in ((), (jv.Jitter(0),), (jv.EmptySpaceJitter(0),))
    )
    assert abs(jitter) <= plain / 10
    assert 0.5 * plain < empty_space < 1.1 * plain


# -- cut faces ------------------------------------------------------------------------------------------


def cut_block():
    camera = jv.Camera((0, 0, -3), (0, 0, 0), (0, 1, 0), size=SIZE, parallel_scale=0.5)
    origins, _ = camera.rays()
    return (jv.phantom("cut_block", 128), surface_transfer(), camera, 2 / 128), np.asarray(origins)[
        ..., 0
    ] < -0.05


def cut_head(transfer):
    volume = cut_head_volume()
    # fine enough for the anatomy on the cut face to be smooth from pixel to pixel
    camera = jv.Camera((0, -3.2, 0.1), (0, 0, 0.1), (0, 0, 1), size=(192, 192), parallel_scale=0.6)
    origins, _ = (np.asarray(part, np.float64) for part in camera.rays())
    x, z = (np.round((origins[..., axis] + 1) / (2 / 127)).astype(int) for axis in (0, 2))
    inside = (x >= 0) & (x <= 127) & (z >= 0) & (z <= 127)
    face = np.asarray(volume.data)[np.clip(x, 0, 127), 0, np.clip(z, 0, 127)]
    return (volume, transfer, camera, 2 / 128), inside & (face > 60)


CUTS = {
    "block": cut_block,
    "head": lambda: cut_head(jv.preset("head", unit_distance=0.01)),
    "skin": lambda: cut_head(skin()),
}

# mean square error of colours up to 1, rounded to float32
ROUNDING = 3 * (2.0**-23) ** 2


@pytest.mark.parametrize(
    "name", [name if name == "block" else pytest.param(name, marks=pytest.mark.slow) for name in CUTS]
)
def test_a_cut_face_is_smooth_under_empty_space_jitter_and_noisy_under_jitter(name):
    scene, face = CUTS[name]()
    assert face.mean() > 0.25
    plain = boundary_noise(rendered(scene), face)
    for seed in (0, 1):
        jitter = boundary_noise(rendered(scene, jv.Jitter(seed)), face)
        residual = boundary_noise(rendered(scene, jv.Jitter(seed, front_residual=True)), face)
        assert boundary_noise(rendered(scene, jv.EmptySpaceJitter(seed)), face) <= 1.05 * plain + ROUNDING, (
            seed
        )
        assert jitter >= 5 * plain + 1e-6, seed
        assert residual <= jitter / 2, seed
