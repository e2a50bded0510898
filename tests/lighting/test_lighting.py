"""Lighting: shading steps against hand calculations, agreement of the engines, gradients by differences."""

import functools
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol import selection
from jaxvol._util.vec3 import apart
from jaxvol.engine import visible_samples
from jaxvol.engine.resolve import of_visible
from jaxvol.engine.tiling import Tiling
from jaxvol.lighting import (
    ConstantLight,
    Deferred,
    DirectionalLight,
    Lighting,
    Material,
    PointLight,
    ScattererTemplate,
    ScattererTemplates,
    scatterers,
    shading as lighting_shading,
)
from jaxvol.lighting.baked import BakedLighting
from jaxvol.lighting.shading import Sample, Shading, Surroundings, shade_sample
from jaxvol.space import Affine, Line

from ..half_space import chandrasekhar, reflected, under_sky
from ..scenes import anisotropic_noise, around, in_float64, scaled_phantom, slow, soft_transfer, to_float64


# ---------------------------------------------------------------- samples lit one by one


def look_around(volume, transfer):
    return Surroundings(volume, transfer, Affine(volume))


def sample_at(around, point, pixel, transmittance):
    """The sample of a ray at a world point."""
    classification, point = around.transfer.classification(around.volume), apart(point)
    measured = classification.measure(around.space.coordinate(point))
    color, extinction = classification.classify(measured)
    none, one = jnp.zeros_like(extinction), jnp.ones_like(extinction)
    return Sample(
        point, (none, none, one), measured, color, extinction, one * transmittance, (pixel[0], pixel[1])
    )


def shaded_pixels(lighting, classification, space, line, rgba, depth):
    """Pixels as shaded by a lighting that shades pixels."""

    def one(rgba, depth):
        return jnp.append(lighting.shade_pixel(classification, space, line, rgba, depth), depth)

    def some(places, rgba, depth, selected):
        return jax.vmap(one)(rgba, depth)

    return of_visible(some, Tiling(), (rgba, depth, None))[:, :4]


@eqx.filter_jit
def lit_points(lighting, volume, transfer, points, pixels, transmittance):
    around = look_around(volume, transfer)
    shading = lighting.shading(around)

    def one(point, pixel):
        return jnp.stack(shade_sample(shading, around, sample_at(around, point, pixel, transmittance)))

    return jax.vmap(one)(points, pixels)


def shade(lighting, volume, transfer, points, *, pixels=None, transmittance=1.0):
    """The lit colours of some points."""
    points = jnp.asarray(points, float)
    pixels = jnp.zeros((len(points), 2), jnp.int32) if pixels is None else pixels
    return np.asarray(lit_points(lighting, volume, transfer, points, pixels, jnp.asarray(transmittance)))


# ---------------------------------------------------------------- the steps, by hand
#
# A grid of nodes with spacing 1, centred at the origin, is air except for single nodes, where the sample and
# its photons lie. A wall is visible but has no material. In each scene, one of three lights shines.

SKIN, OTHER_SKIN, BONE, OTHER_BONE, WALL = 1.0, 1.2, 2.0, 2.2, 3.0
SEEN = {
    0.0: ((0.0, 0.0, 0.0), 0.0),
    0.5: ((0.0, 0.0, 0.0), 0.0),
    SKIN: ((0.8, 0.5, 0.4), 0.6),
    OTHER_SKIN: ((0.2, 0.6, 0.9), 0.6),
    BONE: ((0.9, 0.9, 0.1), 0.9),
    OTHER_BONE: ((0.3, 0.1, 0.7), 0.9),
    WALL: ((0.5, 0.4, 0.3), 1.5),
}
TRANSFER = jv.TransferFunction(list(SEEN), [c for c, _ in SEEN.values()], [e for _, e in SEEN.values()])
COLOR = {value: np.asarray(color) for value, (color, _) in SEEN.items()}
MATERIALS = (
    Material(0.5, 0.7, 1.2, values=(0.9, 1.3)),
    Material(0.8, 0.4, 0.8, values=(1.9, 2.3)),
)
IRRADIANCE = np.array([1.0, 2.0, 3.0])


def radiance_of(opacity, irradiance: float | np.ndarray = 1.0):
    """Factor of E b (c + s) in a sample's radiance: 4 / (3π) times the reflectance of a half-space."""
    gamma = np.sqrt(opacity)
    return 4 / (3 * np.pi) * (1 - gamma) / (1 + gamma) * (1 - gamma / (3 * (1 + gamma))) * irradiance


POWER = radiance_of(0.5, IRRADIANCE)
PAIR = (((2, 0, 0), 0.3), ((-2, 0, 0), 0.6))


def nodes(places):
    """A volume with these values at these nodes, and skin at the origin."""
    data = np.zeros((9, 9, 9), np.float32)
    for (x, y, z), value in {(0, 0, 0): SKIN, **places}.items():
        data[x + 4, y + 4, z + 4] = value
    return jv.Volume(data, origin=(-4, -4, -4))


def given(*of_materials):
    """Handmade templates of photons (offset, intensity), one for each material."""
    offset, intensity = zip(*(zip(*each, strict=True) for each in of_materials), strict=True)
    return ScattererTemplate(jnp.asarray(offset, float)[:, None], jnp.asarray(intensity, float)[:, None])


def lights(*, sun=None, lamp=None, sky=False):
    """A sun, a lamp and a sky, one of which shines."""
    dark = np.zeros(3)
    return (
        DirectionalLight(
            (0, 0, 1) if sun is None else -np.asarray(sun, float), dark if sun is None else IRRADIANCE
        ),
        PointLight((9, 9, 9) if lamp is None else lamp, dark if lamp is None else IRRADIANCE),
        ConstantLight(IRRADIANCE if sky else dark),
    )


def middle(occlusion, places, photons, *, reach=(2.0,), transmittance=1.0, cutoff=1e-6, **of_lights):
    """The lit colour of the node at the origin."""
    lighting = ScattererTemplates(
        MATERIALS,
        lights(**of_lights),
        occlusion=occlusion,
        reach=reach,
        cutoff=cutoff,
        given=given(photons, photons),
    )
    return shade(lighting, nodes(places), TRANSFER, [(0, 0, 0)], transmittance=transmittance)[0]


def smooth(x):
    """Smooth ramp of the lit side under soft occlusion, from 0 at 0 to 1 at 1."""
    x = np.clip(x, 0, 1)
    return x**2 * (3 - 2 * x)


FORMS = pytest.mark.parametrize("occlusion", ["hard", "soft"])


def same(found, expected):
    np.testing.assert_allclose(found, expected, rtol=2e-5, atol=1e-6)


@FORMS
def test_step_1_photons_toward_the_sun_are_lit(occlusion):
    for toward, intensity in (((1, 0, 0), 0.3), ((-1, 0, 0), 0.6)):
        same(middle(occlusion, {}, PAIR, sun=toward), COLOR[SKIN] * POWER * intensity)


def test_step_1_the_lit_side_ends_softly():
    cosine = 0.1
    sun = (cosine, np.sqrt(1 - cosine**2), 0)
    part = 0.3 * smooth(0.5 + cosine / 0.5) + 0.6 * smooth(0.5 - cosine / 0.5)
    same(middle("soft", {}, PAIR, sun=sun), COLOR[SKIN] * POWER * part)
    same(middle("hard", {}, PAIR, sun=sun), COLOR[SKIN] * POWER * 0.3)


def test_step_1_photons_nearer_to_the_lamp_are_lit_and_those_behind_it_are_not():
    photons, r = (((3, 0, 0), 0.3), ((2, 0, 0), 0.6)), 1.2
    arriving = COLOR[SKIN] * POWER / r**2
    same(middle("hard", {}, photons, lamp=(r, 0, 0)), arriving * 0.6)
    # (r - |r d - p|) / |p|, to second order in p / r
    parts = [smooth(0.5 + (1 - length / (2 * r)) / 0.5) for length in (3, 2)]
    assert parts[0] == 0
    same(middle("soft", {}, photons, lamp=(r, 0, 0)), arriving * 0.6 * parts[1])


def test_step_1_the_lamp_lights_by_distance_exactly():
    """A photon is lit by the lamp if its distance to the lamp is smaller than the sample's."""
    random = np.random.default_rng(0)
    for _ in range(20):
        lamp, photon = random.normal(size=3) * 2, random.normal(size=3)
        nearer = np.linalg.norm(lamp - photon) < np.linalg.norm(lamp)
        found = middle("hard", {}, ((photon, 0.4), (photon, 0.0)), lamp=lamp, reach=())
        clear = np.abs(photon).max() > 1.01  # not in the cells around the sample, which hold its own material
        if clear:
            same(found, COLOR[SKIN] * POWER / (lamp @ lamp) * 0.4 * nearer)


@FORMS
def test_step_1_the_sky_lights_all_photons(occlusion):
    same(middle(occlusion, {}, PAIR, sky=True), COLOR[SKIN] * np.pi * POWER * 0.9)


@FORMS
def test_step_2_a_photon_in_a_wall_is_hidden(occlusion):
    hidden = {"hard": 0, "soft": np.exp(-2 * 1.5)}
    part = 0.3 * hidden[occlusion] + 0.6
    same(middle(occlusion, {(2, 0, 0): WALL}, PAIR, sky=True), COLOR[SKIN] * np.pi * POWER * part)


@FORMS
def test_step_2_a_wall_behind_a_photon_hides_it_within_reach(occlusion):
    places = {(4, 0, 0): WALL}
    hidden = {"hard": 0, "soft": np.exp(-2 * 1.5)}
    part = 0.3 * hidden[occlusion] + 0.6
    same(middle(occlusion, places, PAIR, sky=True), COLOR[SKIN] * np.pi * POWER * part)
    out = COLOR[SKIN] * np.pi * POWER * 0.9
    same(middle(occlusion, places, PAIR, sky=True, reach=()), out)


@FORMS
def test_step_3_brightness_grows_with_the_intensity_of_each_photon_that_is_seen(occlusion):
    for first, second in ((0.3, 0.6), (0.6, 0.6), (0.3, 0.9)):
        photons = ((2, 0, 0), first), ((-2, 0, 0), second)
        expected = COLOR[SKIN] * np.pi * POWER * (first + second)
        same(middle(occlusion, {}, photons, sky=True), expected)


@FORMS
def test_step_4_a_photon_in_the_same_material_adds_its_colour(occlusion):
    hidden = {"hard": 0, "soft": np.exp(-2 * 0.6)}
    dense = {"hard": 1, "soft": 1 - np.exp(-0.6 * 0.7)}
    brightness = 0.3 * hidden[occlusion] + 0.6
    expected = np.pi * POWER * brightness * (COLOR[SKIN] + 0.3 * dense[occlusion] * COLOR[OTHER_SKIN])
    same(middle(occlusion, {(2, 0, 0): OTHER_SKIN}, PAIR, sky=True), expected)


@FORMS
def test_step_4_inner_colour_comes_from_all_sides(occlusion):
    """A photon in material adds its colour even if it is not on the lit side."""
    dense = {"hard": 1, "soft": 1 - np.exp(-0.6 * 0.7)}
    inner = 0.3 * dense[occlusion] * COLOR[OTHER_SKIN]
    expected = POWER * 0.6 * (COLOR[SKIN] + inner)
    same(middle(occlusion, {(2, 0, 0): OTHER_SKIN}, PAIR, sun=(-1, 0, 0)), expected)


@FORMS
def test_step_5_a_photon_in_another_material_is_moved_and_scaled(occlusion):
    """The refractive indices are 1.2 and 0.8, which moves it to distance 3; the opacities are 0.5 and 0.8."""
    places = {(2, 0, 0): BONE, (3, 0, 0): OTHER_BONE}
    hidden = {"hard": 0, "soft": np.exp(-3 * 0.9)}
    dense = {"hard": 1, "soft": 1 - np.exp(-0.9 * 0.4)}
    brightness = 0.3 * hidden[occlusion] + 0.6
    inner = 0.3 * 0.8 / 0.5 * dense[occlusion] * COLOR[OTHER_BONE]
    same(middle(occlusion, places, PAIR, sky=True), np.pi * POWER * brightness * (COLOR[SKIN] + inner))


@FORMS
def test_step_5_a_photon_moved_out_of_matter_adds_no_colour(occlusion):
    same(middle(occlusion, {(2, 0, 0): BONE}, PAIR, sky=True), np.pi * POWER * 0.9 * COLOR[SKIN])


@FORMS
def test_step_6_faint_photons_are_left_out(occlusion):
    full = COLOR[SKIN] * np.pi * POWER
    for transmittance, part in ((1.0, 0.9), (0.1, 0.6), (0.05, 0.0)):
        found = middle(occlusion, {}, PAIR, sky=True, cutoff=0.05, transmittance=transmittance)
        same(found, full * part)


def test_by_default_faint_photons_are_left_out_under_hard_occlusion_alone():
    assert ScattererTemplates(MATERIALS, lights(sky=True), occlusion="hard").cutoff == np.float32(0.02)
    assert ScattererTemplates(MATERIALS, lights(sky=True)).cutoff is None


@FORMS
def test_what_belongs_to_no_material_keeps_its_colour(occlusion):
    same(middle(occlusion, {(0, 0, 0): WALL}, PAIR, sky=True), COLOR[WALL])


@FORMS
def test_nothing_of_a_material_shines_by_itself(occlusion):
    """Over the material's whole range of values; under soft occlusion its edges are soft."""
    low, high = 0.9, 1.3
    lighting = ScattererTemplates(
        MATERIALS, lights(sky=True), occlusion=occlusion, reach=(2.0,), cutoff=1e-6, given=given(PAIR, PAIR)
    )
    dark = eqx.tree_at(lambda made: made.lights, lighting, lights())
    volume = nodes({(1, 0, 0): high, (-1, 0, 0): low})
    line = [(x, 0, 0) for x in (-1, -0.9, -0.5, 0, 0.5, 0.9, 1)]
    assert (shade(lighting, volume, TRANSFER, line) > 0.01).all()
    same(shade(dark, volume, TRANSFER, line), 0)


@FORMS
def test_where_a_place_belongs_to_two_materials_the_first_counts(occlusion):
    """The materials have different templates, one twice as bright as the other."""
    brighter = tuple((offset, 2 * intensity) for offset, intensity in PAIR)
    everywhere = [Material(0.5, 0.7, 1.2, values=(0.0, 4.0)), MATERIALS[0]]
    for materials, part in ((everywhere, 0.9), (everywhere[::-1], 0.9), ([MATERIALS[1], everywhere[0]], 1.8)):
        lighting = ScattererTemplates(
            materials,
            lights(sky=True),
            occlusion=occlusion,
            reach=(2.0,),
            cutoff=1e-6,
            given=given(PAIR, brighter),
        )
        found = shade(lighting, nodes({}), TRANSFER, [(0, 0, 0)])[0]
        same(found, COLOR[SKIN] * np.pi * POWER * part)


@pytest.mark.parametrize("occlusion", ["soft", *slow("hard")])
def test_materials_by_label_are_where_the_label_is(occlusion):
    """Nodes have label 1 for x < 0, and elsewhere label 2, which belongs to no material."""
    data = np.full((9, 9, 9), SKIN, np.float32)
    labels = np.where(np.arange(9) < 4, 1, 2).astype(np.uint8)[:, None, None] * np.ones((1, 9, 9), np.uint8)
    volume = jv.Volume(data, origin=(-4, -4, -4), labels=labels)
    skin = Material(0.5, 0.7, label=1)
    photons = ((8, 0, 0), 0.3), ((0, 8, 0), 0.6)  # outside the volume, where they are not occluded
    points = [(-2, 0, 0), (-0.75, 0, 0), (-0.4, 0, 0), (1, 0, 0)]
    lighting = ScattererTemplates(
        skin, ConstantLight(IRRADIANCE), occlusion=occlusion, reach=(2.0,), given=given(photons)
    )
    # between the nodes, the material's share is 0.75 and 0.4; from a half on, the whole sample is lit
    parts = {"hard": (1, 1, 0, 0), "soft": (1, 1, 0.8, 0)}[occlusion]
    expected = [COLOR[SKIN] * (part * np.pi * POWER * 0.9 + 1 - part) for part in parts]
    same(shade(lighting, volume, TRANSFER, points), expected)


def test_a_blend_is_the_mean_over_the_templates():
    """Photons lie in air, where the colour is linear in the template."""
    random = np.random.default_rng(1)
    offset = jnp.asarray(random.normal(size=(2, 2, 2, 3)) + 2.2, float)
    templates = ScattererTemplate(offset, jnp.asarray(random.uniform(0.1, 0.3, (2, 2, 2)), float))

    def seen(templates, **how):
        how = {"reach": (2.0,), "cutoff": 1e-6, "given": templates, **how}
        return shade(ScattererTemplates(MATERIALS, lights(sky=True), **how), nodes({}), TRANSFER, [(0, 0, 0)])

    each = [seen(jax.tree.map(lambda leaf, i=i: leaf[:, i : i + 1], templates)) for i in (0, 1)]
    assert np.abs(each[0] - each[1]).max() > 1e-2
    same(seen(templates, blend=True), (each[0] + each[1]) / 2)


# ---------------------------------------------------------------- appearance

PLAIN = jv.TransferFunction([0.0, 0.5, 1.0], np.full((3, 3), 0.7), [0.0, 0.0, 4.0])
DENSE = jv.TransferFunction(PLAIN.values, PLAIN.colors, 10 * PLAIN.extinction)
FLESH = Material(0.5, 0.12, 1.3)
NODES, SPACING = 25, 1 / 12  # from -1 to 1


def solid(inside):
    """A volume of 1 where `inside(x, y, z)` is true, else 0."""
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, NODES)] * 3, indexing="ij")
    return jv.Volume(inside(x, y, z).astype(np.float32), (SPACING,) * 3, (-1, -1, -1))


@functools.cache
def pool():
    """256 templates, (1, 256, photons), simulated in NumPy, since growing them takes long to compile."""
    random = np.random.default_rng(1)

    def anywhere(n):
        direction = random.normal(size=(256, n, 3))
        return direction / np.linalg.norm(direction, axis=-1, keepdims=True)

    even = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
    direction = even @ np.linalg.qr(random.normal(size=(256, 3, 3)))[0]
    place, light = np.zeros((256, 4, 3)), np.full((256, 4), 0.25)
    offset, intensity = [], []
    for _ in range(3):
        place = place + random.exponential(0.12, (*light.shape, 1)) * direction
        offset.append(place)
        intensity.append(light / 2)
        turned = direction + 0.5 * anywhere(light.shape[1])
        turned = turned / np.linalg.norm(turned, axis=-1, keepdims=True)
        direction = np.concatenate([turned, anywhere(light.shape[1])], axis=1)
        place = np.concatenate([place] * 2, axis=1)
        light = np.concatenate([0.4 * light, 0.1 * light], axis=1)
    offset, intensity = np.concatenate(offset, axis=1), np.concatenate(intensity, axis=1)
    order = np.argsort(-intensity, axis=1)
    offset, intensity = (
        np.take_along_axis(offset, order[..., None], 1),
        np.take_along_axis(intensity, order, 1),
    )
    return ScattererTemplate(jnp.asarray(offset[None], float), jnp.asarray(intensity[None], float))


def few():
    """Four of these templates, of six photons each."""
    return jax.tree.map(lambda leaf: leaf[:, :4], pool()).brightest(6)


def as_one(templates):
    return jax.tree.map(lambda leaf: leaf[:, None], templates.blended())


def brightness(volume, points, light, *, reach=(2.0,)):
    """Mean lit colour of 64 points."""
    lighting = ScattererTemplates(FLESH, light, reach=reach, given=as_one(few()))
    assert len(points) == 64
    return shade(lighting, volume, DENSE, points).mean()


def grid(center, u, v, size):
    """64 points on a square."""
    s = (np.arange(8) + 0.5) / 8 - 0.5
    a, b = (part.reshape(-1, 1) for part in np.meshgrid(s, s))
    return np.asarray(center) + size * (a * np.asarray(u) + b * np.asarray(v))


BLOCK = solid(lambda x, y, z: np.maximum(np.maximum(abs(x), abs(y)), abs(z)) < 0.5)
SUN = DirectionalLight((0, 0, -1.0))
DAY = SUN, ConstantLight((0, 0, 0))
TOP, BOTTOM = (grid((0, 0, z), (1, 0, 0), (0, 1, 0), 0.5) for z in (0.46, -0.46))


def test_the_lit_side_is_brighter():
    assert brightness(BLOCK, TOP, DAY) > 3 * brightness(BLOCK, BOTTOM, DAY)
    ball = solid(lambda x, y, z: x**2 + y**2 + z**2 < 0.7**2)
    random = np.random.default_rng(0)
    z, around = random.uniform(0.5, 1, 64), random.uniform(0, 2 * np.pi, 64)
    ring = np.sqrt(1 - z**2)
    cap = 0.7 * np.stack([ring * np.cos(around), ring * np.sin(around), z], axis=-1)
    assert brightness(ball, cap, DAY) > 1.5 * brightness(ball, -cap, DAY)


def test_cavities_are_darker_than_open_faces():
    """The floor of a pit two voxels deep, against the face around it, under a sky."""
    sky = DirectionalLight((0, 0, -1.0), (0, 0, 0)), ConstantLight()
    pit = solid(
        lambda x, y, z: (
            (np.maximum(abs(x), abs(y)) < 0.7)
            & (abs(z) < 0.5)
            & ~((np.maximum(abs(x), abs(y)) < 0.1) & (z > 0.1))
        )
    )
    floor = grid((0, 0, 0.05), (1, 0, 0), (0, 1, 0), 0.1)
    face = grid((0.4, 0.4, 0.46), (1, 0, 0), (0, 1, 0), 0.1)
    assert brightness(pit, floor, sky) < 0.7 * brightness(pit, face, sky)


def test_a_thin_plate_shades_what_is_behind_it_within_reach():
    """As an ear in front of the head: photons lie between the two, and beyond the plate."""
    plate = solid(
        lambda x, y, z: (np.maximum(np.maximum(abs(x), abs(y)), abs(z)) < 0.5) | (abs(z - 0.67) < 0.05)
    )
    behind, far = (
        brightness(plate, TOP, DAY, reach=reach) / brightness(BLOCK, TOP, DAY, reach=reach)
        for reach in ((2.0,), ())
    )
    assert behind < 0.97 * far


@pytest.mark.slow
def test_noise_falls_as_templates_are_blended():
    """Pixels of a flat face differ only in their template; noise falls as 1 / sqrt(number of templates)."""
    n = pool().intensity.shape[-1]
    pixels = jnp.asarray(np.indices((20, 20)).reshape(2, -1).T, jnp.int32)
    points = np.tile((0.03, 0.02, 0.46), (len(pixels), 1))
    noise = []
    for count in (1, 2, 4, 8):
        sets = jax.tree.map(lambda leaf, c=count: leaf.reshape(256 // c, c, *leaf.shape[2:]), pool())
        blended = sets.blended().brightest(8 * n)
        missing = 8 * n - blended.intensity.shape[-1]
        blended = ScattererTemplate(
            jnp.pad(jnp.tile(blended.offset, (count, 1, 1)), ((0, 0), (0, missing), (0, 0))),
            jnp.pad(jnp.tile(blended.intensity, (count, 1)), ((0, 0), (0, missing))),
        )
        given = jax.tree.map(lambda leaf: leaf[None], blended)
        lighting = ScattererTemplates(FLESH, SUN, reach=(2.0,), given=given)
        noise.append(shade(lighting, BLOCK, DENSE, points, pixels=pixels).std())
    ratios = np.array(noise) * np.sqrt([1, 2, 4, 8]) / noise[0]
    assert np.all(np.diff(noise) < 0)
    assert np.all(np.abs(ratios - 1) < 0.35), ratios


# ---------------------------------------------------------------- gradients of single samples


def loss_of_points(lighting, scene):
    """A weighted mean over lit points of a smooth volume."""
    volume, transfer, points = scene
    pixels = jnp.zeros((len(points), 2), jnp.int32)
    found = lit_points(lighting, volume, transfer, points, pixels, jnp.ones(()))
    return jnp.mean(found @ jnp.asarray([1.0, 0.6, -0.3]))


def smooth_scene():
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, 9)] * 3, indexing="ij")
    data = 1 / (1 + np.exp(6 * (x**2 + 0.5 * y**2 + z**2 + 0.4 * x * y - 0.5)))
    volume = jv.Volume(jnp.asarray(data, float), (0.25,) * 3, (-1, -1, -1))
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (256, 3))
    return (
        volume,
        to_float64(jv.TransferFunction(PLAIN.values, PLAIN.colors, PLAIN.extinction)),
        jnp.asarray(points),
    )


def slopes_in_the_path(occlusion, *steps):
    """For each step h: the derivative with respect to λ, averaged from λ - h to λ + h, and the central
    difference between these ends."""
    with in_float64():
        scene = smooth_scene()
        lighting = ScattererTemplates(
            Material(0.5, 0.3, 1.2),
            (DirectionalLight((0.2, 0.4, -1)), ConstantLight((0.3, 0.3, 0.3))),
            occlusion=occlusion,
            templates=1,
            packets=2,
            levels=2,
            reach=(2.0,),
            cutoff=0.0,
        )

        @jax.jit
        @jax.value_and_grad
        def loss(path):
            moved = eqx.tree_at(lambda light: light.materials[0].mean_free_path, lighting, path)
            return loss_of_points(moved, scene)

        for h in steps:
            way = 0.3 + h * jnp.linspace(-1, 1, 65)
            inside = np.mean([float(loss(at)[1]) for at in (way[1:] + way[:-1]) / 2])
            yield inside, float(loss(way[-1])[0] - loss(way[0])[0]) / (2 * h)


@pytest.mark.slow
def test_the_soft_gradient_in_the_path_is_the_difference_at_any_step():
    """A jump would show only in the difference."""
    for (adjoint, difference), error in zip(
        slopes_in_the_path("soft", 2e-8, 1e-2), (1e-5, 0.01), strict=True
    ):
        np.testing.assert_allclose(adjoint, difference, rtol=error)


@pytest.mark.slow
def test_the_hard_gradient_in_the_path_is_wrong():
    """It misses photons that become occluded, which are most of the change."""
    [(adjoint, difference)] = slopes_in_the_path("hard", 1e-2)
    assert abs(adjoint - difference) > 0.5 * abs(difference)


# ---------------------------------------------------------------- at extremes

EXTREMES = {
    "as it is": {},
    "nothing is seen": {"extinction": 0.0},
    "all is opaque": {"extinction": 1e6},
    "hardly anything is absorbed": {"opacity": 0.02},
    "all is absorbed": {"opacity": 1.0},
    "a short path": {"path": 1e-6},
    "a long path": {"path": 1e6},
    "an empty volume": {"data": 0.0},
    "as air": {"index": 1.0},
}


@pytest.mark.slow
@pytest.mark.parametrize("occlusion", ["soft", "hard"])
def test_values_and_gradients_are_finite_at_extremes(occlusion):
    """One of the samples coincides with a lamp."""
    volume, transfer, points = jax.tree.map(
        lambda leaf: jnp.asarray(leaf, jnp.float32) if eqx.is_array(leaf) else leaf, smooth_scene()
    )
    lighting = ScattererTemplates(
        (Material(0.5, 0.3, 1.2, values=(0.4, 2.0)), Material(0.7, 0.2, 1.5)),
        (DirectionalLight((0.2, 0.4, -1)), PointLight(tuple(map(float, points[0]))), ConstantLight()),
        occlusion=occlusion,
        templates=1,
        packets=2,
        photons=6,
        reach=(2.0,),
    )

    @eqx.filter_jit
    def slopes(scene):
        return eqx.filter_value_and_grad(lambda scene: loss_of_points(scene[0], scene[1]))(scene)

    for name, change in EXTREMES.items():
        moved, data, function = lighting, volume, transfer
        of_materials = {
            "opacity": lambda light: [m.opacity for m in light.materials],
            "path": lambda light: [m.mean_free_path for m in light.materials],
            "index": lambda light: [m.refractive_index for m in light.materials],
        }
        for what, where in of_materials.items():
            if what in change:
                moved = eqx.tree_at(where, moved, [jnp.asarray(change[what])] * 2)
        if "extinction" in change:
            function = eqx.tree_at(
                lambda t: t.extinction, function, jnp.full_like(function.extinction, change["extinction"])
            )
        if "data" in change:
            data = eqx.tree_at(lambda v: v.data, data, jnp.full_like(data.data, change["data"]))
        value, gradient = slopes((moved, (data, function, points)))
        assert np.isfinite(value), name
        for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
            assert np.all(np.isfinite(leaf)), (name, jax.tree_util.keystr(path))


# ---------------------------------------------------------------- absolute brightness


def half_space(opacity, light):
    """Radiance along the normal of a white half-space: the lit colours of points along one ray, weighted by
    their opacity and transmittance."""
    volume = jv.Volume(np.full((4, 4, 101), 0.5, np.float32), (20.0, 20.0, 0.2))
    x, y, _ = volume.center
    transfer = jv.TransferFunction([0.0, 1.0], np.ones((2, 3)), [1.0, 1.0])
    lighting = ScattererTemplates(Material(opacity, 1.0, 1.4), light, templates=2, blend=True, photons=40)
    depth = 0.1 * (np.arange(80) + 0.5)
    points = np.stack([np.full(80, x), np.full(80, y), depth], axis=-1)
    seen = -np.expm1(-0.1) * np.exp(-(depth - 0.05))
    return seen @ shade(lighting, volume, transfer, points).mean(axis=-1)


@pytest.mark.parametrize(
    "opacity", [pytest.param(0.1, marks=pytest.mark.slow), pytest.param(0.3, marks=pytest.mark.slow), 0.6]
)
def test_templates_are_as_bright_as_path_tracing(opacity):
    """Compared with closed forms for half-spaces under uniform and under parallel light."""
    albedo = np.array([1 - opacity])
    sky = half_space(opacity, (DirectionalLight((0, 0, 1), (0, 0, 0)), ConstantLight((2, 2, 2))))
    sun = half_space(opacity, (DirectionalLight((0, 0, 1), (2, 2, 2)), ConstantLight((0, 0, 0))))
    np.testing.assert_allclose(sky / 2, 0.95 * under_sky(albedo, 1.0), rtol=0.08)
    np.testing.assert_allclose(sun / 2, 0.98 * reflected(albedo, 1.0, 1.0), rtol=0.12)


def test_the_reflectance_of_a_material_is_that_of_multiple_scattering():
    """Chandrasekhar's solution for a half-space, integrated over the outgoing directions."""
    nodes, weights = np.polynomial.legendre.leggauss(32)
    for opacity in (0.001, 0.05, 0.3, 0.7, 0.99):
        cosines = (nodes + 1) / 2
        h = np.array([chandrasekhar(np.array([1 - opacity]), mu)[0] for mu in cosines])
        exact = 1 - np.sqrt(opacity) * np.sum(weights * cosines * h)
        np.testing.assert_allclose(Material(opacity, 1.0).optics.reflectance, exact, atol=0.0015)


def test_the_threshold_does_not_show_in_the_brightness():
    """The energy that it cuts off is added back."""

    def templates(threshold):
        how = ScattererTemplates(Material(0.5, 1.0), SUN, threshold=threshold, templates=1, packets=1)
        return jax.jit(lambda: how.grown(blend=False))()

    coarse, fine = templates(0.2), templates(0.1)
    assert fine.intensity.shape[-1] > coarse.intensity.shape[-1]
    for found in (coarse, fine, fine.brightest(2)):
        np.testing.assert_allclose(found.intensity.sum(-1), 1, rtol=1e-5)


# ---------------------------------------------------------------- NaN


def grown_in_the_program(occlusion="soft", **of_lights):
    """Lighting by templates of a single photon, which compile quickly."""
    how = {"templates": 1, "packets": 1, "levels": 1, "cutoff": 1e-6}
    return ScattererTemplates(MATERIALS, lights(**of_lights), occlusion=occlusion, **how)


@pytest.mark.parametrize("occlusion", ["soft", *slow("hard")])
def test_nan_in_light_or_material_reaches_the_sample(occlusion):
    """Inserted by `tree_at`, as an optimiser does."""
    lighting = grown_in_the_program(occlusion, sun=(1, 0, 0))
    volume, point = nodes({}), [(0, 0, 0)]
    assert np.isfinite(shade(lighting, volume, TRANSFER, point)).all()
    for where in (
        lambda how: how.lights[0].direction,
        lambda how: how.lights[0].irradiance,
        lambda how: how.lights[1].position,
        lambda how: how.lights[2].radiance,
        lambda how: how.materials[0].opacity,
        lambda how: how.materials[0].mean_free_path,
        lambda how: how.materials[0].refractive_index,
        lambda how: how.materials[0].values,
    ):
        broken = eqx.tree_at(where, lighting, jnp.full_like(where(lighting), jnp.nan))
        assert np.isnan(shade(broken, volume, TRANSFER, point)).all()


def test_a_traced_opacity_that_leaves_no_photon_makes_nan():
    lighting = grown_in_the_program(sky=True)
    faint = eqx.tree_at(lambda how: how.materials[0].opacity, lighting, jnp.float32(0.007))
    assert np.isnan(shade(faint, nodes({}), TRANSFER, [(0, 0, 0)])).all()


@pytest.mark.slow
def test_nan_in_what_is_baked_reaches_all_of_it():
    volume, points, how = baked_scene()
    broken = eqx.tree_at(lambda lights: lights[0].irradiance, DAY, jnp.full(3, jnp.nan))
    lighting = ScattererTemplates(FLESH, broken, baked=5, **how)
    assert np.isnan(shade(lighting, volume, PLAIN, points)).all()


@pytest.mark.slow
def test_a_ray_that_has_seen_nan_stays_nan_where_light_is_deferred():
    volume, space = nodes({}), Affine(nodes({}))
    lighting = ScattererTemplates(MATERIALS, lights(sky=True), given=given(PAIR, PAIR), reach=(2.0,))
    seen = lighting_shading.lit_classification(volume, TRANSFER, space, lighting)
    zero = jnp.zeros((), jnp.int32)
    line = Line(apart(jnp.zeros(3)), apart(jnp.asarray([0.0, 0.0, 1.0])), (zero, zero))
    rgba = jnp.asarray([[jnp.nan] * 4, [0.5] * 4, [0.0] * 4])
    depth = jnp.asarray([jnp.nan, 0.0, jnp.inf])
    found = jax.jit(partial(shaded_pixels, Deferred(lighting), seen, space, line))(rgba, depth)
    np.testing.assert_array_equal(np.isnan(found), [[True] * 4, [False] * 4, [False] * 4])


# ---------------------------------------------------------------- baked


def baked_scene():
    volume = solid(lambda x, y, z: x**2 + y**2 + z**2 < 0.6**2)
    random = np.random.default_rng(0).normal(size=(64, 3))
    points = 0.57 * random / np.linalg.norm(random, axis=1, keepdims=True)
    return volume, points, {"given": few(), "reach": (2.0,)}


@pytest.mark.slow
def test_baked_light_comes_closer_to_the_blended_one_as_its_grid_gets_finer():
    volume, points, how = baked_scene()
    blended = ScattererTemplates(FLESH, DAY, reach=(2.0,), given=as_one(few()))
    exact = shade(blended, volume, PLAIN, points)
    errors = []
    for resolution in (5, 37):
        lighting = ScattererTemplates(FLESH, DAY, baked=resolution, **how)
        ready = lighting.prepared(volume, PLAIN, jv.March(0.1))
        assert isinstance(ready, BakedLighting)
        assert ready.shape == (resolution,) * 3
        errors.append(np.abs(shade(ready, volume, PLAIN, points) - exact).mean())
    assert errors[1] < errors[0]
    assert errors[1] < 0.05 * exact.mean()


def test_light_is_baked_once_for_what_stays_the_same(monkeypatch):
    volume, _, how = baked_scene()
    calls = []

    def baked(lighting, around):
        calls.append(lighting)
        return BakedLighting(jnp.zeros(8, jnp.uint32), jnp.zeros(3), (2, 2, 2))

    monkeypatch.setattr(scatterers, "_baked", baked)

    def prepared(volume=volume, transfer=PLAIN, light=SUN, path=0.12, step=0.1):
        lighting = ScattererTemplates(Material(0.5, path, 1.3), light, baked=9, **how)
        return lighting.prepared(volume, transfer, jv.March(step))

    first = prepared()
    assert prepared() is first
    assert prepared(step=0.2) is first
    assert len(calls) == 1
    changes: list[dict[str, Any]] = [
        {"light": DirectionalLight((0, 1.0, -1))},
        {"path": 0.2},
        {"transfer": eqx.tree_at(lambda t: t.colors, PLAIN, PLAIN.colors / 2)},
        {"volume": jv.Volume(volume.data + 0.1, volume.spacing, volume.origin)},
        {"volume": jv.Volume(volume.data, 2 * volume.spacing, volume.origin)},
    ]
    for number, changed in enumerate(changes):
        assert prepared(**changed) is prepared(**changed)
        assert len(calls) == number + 2, changed


def test_light_that_was_baked_inside_a_program_serves_outside():
    volume, _, how = baked_scene()
    lighting = ScattererTemplates(FLESH, DAY, baked=5, **how)

    def prepared():
        return jax.tree.leaves(lighting.prepared(volume, PLAIN, jv.March(0.1)))

    jax.eval_shape(lambda x: (prepared(), x)[1], 0.0)
    assert not any(isinstance(leaf, jax.core.Tracer) for leaf in prepared())


def test_baked_light_is_computed_in_a_traced_program_and_has_no_gradient():
    volume, points, how = baked_scene()
    lighting = ScattererTemplates(FLESH, DAY, baked=5, **how)
    ready = lighting.prepared(volume, PLAIN, jv.March(0.1))
    expected = shade(ready, volume, PLAIN, points)
    # under jit, where light is not prepared in advance
    np.testing.assert_allclose(shade(lighting, volume, PLAIN, points), expected, atol=2e-3)
    slope = eqx.filter_jit(eqx.filter_grad(lambda light: jnp.sum(shade_traced(light, volume, points))))(
        lighting
    )
    assert all(not np.any(leaf) for leaf in jax.tree.leaves(slope))


def loss_of_an_image(kind, lighting, points=8):
    """A loss of (volume, transfer function, camera), with voxels of this type, and these arguments; and with
    so many control points, of which more than 16 are looked up by a search."""
    sphere, transfer = scaled_phantom("sphere", 12), soft_transfer(0.1)
    if points != 8:
        at = jax.vmap(transfer)(values := jnp.linspace(0, 1, points))
        transfer = jv.TransferFunction(values, jnp.stack(at[0], axis=1), at[1])
    data = np.asarray(sphere.data * (255 if kind == "uint8" else 1)).astype(kind)
    volume = jv.Volume(data, sphere.spacing, sphere.origin)
    if kind == "uint8":
        transfer = eqx.tree_at(lambda t: t.values, transfer, 255 * transfer.values)
    march, camera = jv.March(0.2, (jv.AlphaCorrection(),), max_samples=32), around(volume, (9, 7))

    def loss(scene, adjoint):
        return jnp.sum(jv.render(*scene, march=march, lighting=lighting, adjoint=adjoint).rgba ** 2)

    return loss, (volume, transfer, camera)


@pytest.mark.parametrize(("kind", "points"), [("uint8", 8), *slow(("float32", 40), ("float32", 8))])
def test_there_is_a_gradient_of_an_image_by_baked_light(kind, points):
    """A slow test below checks its values, which take minutes to compile."""
    loss, scene = loss_of_an_image(kind, by_hand(baked=8), points)
    gradient = eqx.filter_eval_shape(eqx.filter_grad(loss), scene, "replay")
    expected = eqx.filter(scene, eqx.is_inexact_array)
    assert jax.tree.map(jnp.shape, gradient) == jax.tree.map(jnp.shape, expected)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "points"), [("float32", 8), ("uint8", 8), ("float32", 40)])
def test_an_image_by_baked_light_has_the_gradient_of_all_but_the_light(kind, points):
    """Compare replay, the default, with JAX's derivative of the reference engine."""
    lighting = templates(materials=Material(0.5, 0.15, 1.4), baked=8)
    loss, scene = loss_of_an_image(kind, lighting, points)
    replay, direct = (
        eqx.filter_jit(eqx.filter_grad(loss))(scene, adjoint) for adjoint in ("replay", "direct")
    )
    for where in (
        *(() if kind == "uint8" else (lambda s: s[0].data,)),
        lambda s: s[1].colors,
        lambda s: s[1].extinction[points // 4 :],  # samples with an extinction of 0 are not lit
        lambda s: s[2].position,
        lambda s: s[2].view_angle,
    ):
        size = float(np.abs(where(direct)).max())
        assert size > 0
        np.testing.assert_allclose(where(replay), where(direct), rtol=1e-3, atol=1e-4 * size)


def shade_traced(lighting, volume, points):
    pixels = jnp.zeros((len(points), 2), jnp.int32)
    return lit_points(lighting, volume, PLAIN, jnp.asarray(points, float), pixels, jnp.ones(()))


# ---------------------------------------------------------------- images

SIZE = (16, 12)
MANY = (
    DirectionalLight((0.6, 0.8, -1.0), (14.0, 13.0, 11.0)),
    PointLight((0.9, -1.2, 1.4), (16.0, 16.0, 32.0)),
    ConstantLight((1.6, 2.4, 3.2)),
)
PARTS = (Material(0.5, 0.15, 1.4, values=(0.0, 0.5)), Material(0.8, 0.1, 1.5, values=(0.5, 2.0)))
SETS = {
    "leaping": (jv.EmptySpaceJitter(4), jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination(0.05)),
    "not leaping": (jv.EmptySpaceJitter(4), jv.AlphaCorrection(), jv.EarlyTermination(0.05)),
    "plain": (),
    "aligned": (jv.AlphaCorrection(),),
    "jittered": (jv.Jitter(3, "blue", front_residual=True), jv.AlphaCorrection()),
}


def templates(occlusion="soft", materials=PARTS, light=MANY, **how):
    how = {"templates": 2, "packets": 2, "photons": 4, "reach": (2.0,), "seed": 5, **how}
    return ScattererTemplates(materials, light, occlusion=occlusion, **how)


def by_hand(**how):
    """Lighting with one light, one material and given templates, which compiles quickly."""
    random = np.random.default_rng(5)
    offset = jnp.asarray(random.normal(0, 0.1, (1, 2, 4, 3)), jnp.float32)
    pair = ScattererTemplate(offset, jnp.asarray(random.uniform(0.1, 0.4, (1, 2, 4)), jnp.float32))
    return ScattererTemplates(Material(0.5, 0.15, 1.4), MANY[0], reach=(2.0,), seed=5, given=pair, **how)


def both(volume, transfer, camera, march, lighting):
    """Images by the fast engine and by the reference engine."""
    fast, slow = (
        jv.render(volume, transfer, camera, march, lighting=lighting, adjoint=adjoint)
        for adjoint in ("replay", "direct")
    )
    assert fast.rgba[..., :3].max() > 0.1
    np.testing.assert_array_equal(fast.samples, slow.samples)
    return np.asarray(fast.rgba), np.asarray(slow.rgba)


ALL = [(name, occlusion) for occlusion in ("soft", "hard") for name in SETS]


def image_of_the_reference(volume, transfer, camera, march, lighting):
    """Render every pixel with the reference engine."""
    origins, directions = camera.rays()

    @jax.jit
    @partial(jax.vmap, in_axes=(None, 0))
    @partial(jax.vmap, in_axes=(0, None))
    def image(column, row):
        line = volume, transfer, origins[row, column], directions[row, column], march
        return jv.render_ray_reference(*line, pixel=(column, row), lighting=lighting)

    return image(jnp.arange(SIZE[0]), jnp.arange(SIZE[1]))


def farthest(fast, slow, occlusion):
    """Largest difference of two images. Under hard occlusion it ignores a few pixels, in which rounding may
    occlude a photon."""
    off = np.sort(np.abs(np.asarray(fast) - np.asarray(slow)).max(axis=-1).reshape(-1))
    return off[-5] if occlusion == "hard" else off[-1]


def test_the_fast_engine_is_the_reference():
    volume = scaled_phantom("sphere", 12)
    march = jv.March(0.07, SETS["leaping"], max_samples=80)
    fast, slow = both(volume, soft_transfer(0.1), around(volume, SIZE), march, by_hand())
    assert farthest(fast, slow, "soft") <= 2e-5


def test_deferred_light_is_that_of_one_sample_at_the_mean_depth():
    """The sample has the ray's mean colour and is not attenuated."""
    volume, transfer, lighting = scaled_phantom("sphere", 12), soft_transfer(0.1), by_hand()
    camera, march = around(volume, SIZE), jv.March(0.07, SETS["leaping"], max_samples=80)
    unlit, found = (
        jv.render(volume, transfer, camera, march, lighting=how) for how in (None, Deferred(lighting))
    )
    opacity = np.asarray(unlit.rgba[..., 3:])
    rows, columns = np.nonzero(opacity[..., 0])
    origins, directions = (ends[rows, columns] for ends in camera.rays())

    @jax.jit
    def expected(points, colors, pixels):
        around = look_around(volume, transfer)
        shading = lighting.shading(around)

        def one(point, color, pixel):
            sample = sample_at(around, point, pixel, 1.0)._replace(color=apart(color))
            return jnp.stack(shade_sample(shading, around, sample))

        return jax.vmap(one)(points, colors, pixels)

    points = origins + unlit.depth[rows, columns][:, None] * directions
    colors = np.asarray(unlit.rgba[..., :3])[rows, columns] / opacity[rows, columns]
    pixels = jnp.asarray(np.stack([columns, rows], axis=-1), jnp.int32)
    once = np.asarray(unlit.rgba).copy()
    once[rows, columns, :3] = opacity[rows, columns] * expected(points, jnp.asarray(colors), pixels)
    assert 0 < len(rows) < opacity.size
    assert np.abs(once - unlit.rgba).max() > 0.1
    np.testing.assert_allclose(found.rgba, once, atol=5e-5)


class Dimmed(Lighting):
    """Halves all colours."""

    class Half(Shading):
        def about(self, around, sample):
            return None

        def color(self, sample, shared, sums):
            r, g, b = (part / 2 for part in sample.color)
            return r, g, b

    def shading(self, around):
        return Dimmed.Half()


@pytest.mark.parametrize("outputs", ["all", pytest.param("rgba", marks=pytest.mark.slow)])
def test_where_all_samples_are_lit_alike_deferring_does_not_show(outputs):
    volume = scaled_phantom("sphere", 12)
    camera, transfer = around(volume, SIZE), soft_transfer(0.1)
    march = jv.March(0.07, SETS["leaping"], max_samples=80)
    unlit, each, once = (
        jv.render(volume, transfer, camera, march, lighting=lighting, outputs=outputs, adjoint=adjoint)
        for lighting, adjoint in (
            (None, "replay"),
            (Dimmed(), "direct"),  # other tests compare the engines
            (Deferred(Dimmed()), "replay"),
        )
    )
    assert np.any(unlit.rgba[..., 3] == 0)
    half = np.asarray(unlit.rgba) * np.array([0.5, 0.5, 0.5, 1.0], np.float32)
    for image in (each, once):
        np.testing.assert_allclose(image.rgba, half, atol=1e-6)
        assert type(image) is type(unlit)
    if outputs == "all":
        np.testing.assert_array_equal(once.depth, unlit.depth)
        np.testing.assert_array_equal(once.samples, unlit.samples)


@pytest.mark.slow
@pytest.mark.parametrize(("transforms", "occlusion"), ALL)
def test_the_fast_engine_is_the_reference_where_templates_grow(transforms, occlusion):
    volume = scaled_phantom("sphere", 12)
    march = jv.March(0.07, SETS[transforms], max_samples=80)
    fast, slow = both(volume, soft_transfer(0.1), around(volume, SIZE), march, templates(occlusion))
    assert farthest(fast, slow, occlusion) <= 2e-5


@pytest.mark.slow
@pytest.mark.parametrize(("transforms", "occlusion"), ALL)
def test_deferred_light_is_that_of_the_reference(transforms, occlusion):
    volume = scaled_phantom("sphere", 12)
    march = jv.March(0.07, SETS[transforms], max_samples=80)
    scene = volume, soft_transfer(0.1), around(volume, SIZE), march
    lighting = Deferred(templates(occlusion))
    fast, slow = jv.render(*scene, lighting=lighting), image_of_the_reference(*scene, lighting)
    assert fast.rgba[..., :3].max() > 0.1
    assert farthest(fast.rgba, slow.rgba, occlusion) <= 5e-5


@pytest.mark.slow
def test_leaping_over_empty_space_changes_no_lit_pixel():
    volume = scaled_phantom("sphere", 12)
    camera, transfer = around(volume, SIZE), soft_transfer(0.1)
    leapt, other = (
        jv.render(volume, transfer, camera, jv.March(0.07, SETS[name], max_samples=80), lighting=templates())
        for name in ("leaping", "not leaping")
    )
    np.testing.assert_allclose(leapt.rgba, other.rgba, atol=2e-5)


@pytest.mark.slow
def test_a_curved_grid_and_labels_are_lit_alike():
    volume, probe = jv.toroidal_phantom("spheres", (12, 16, 24), speckle=False)
    data = np.asarray(volume.data, np.float32) / float(np.max(volume.data))
    volume = jv.Volume(data, volume.spacing, volume.origin)
    march = jv.March(4.0, (probe, jv.AlphaCorrection()), max_samples=128)
    space = march.locate(volume)
    center = np.array([float(m) for m in space.middle])
    far = center + 1.5 * float(space.diagonal) * np.array([0.5, -0.7, 0.5])
    camera = jv.Camera(far, center, (0, 0, 1), 30.0, size=SIZE)
    flesh = Material(0.5, 8.0, 1.4)
    fast, slow = both(volume, soft_transfer(10.0), camera, march, templates(materials=flesh, light=MANY[0]))
    np.testing.assert_allclose(fast, slow, atol=2e-5)

    noise = anisotropic_noise()
    labels = (np.indices(noise.shape).sum(axis=0) // 9 % 3).astype(np.uint8)
    volume = jv.Volume(noise.data, noise.spacing, noise.origin, labels)
    one = soft_transfer(0.3)
    other = jv.TransferFunction(one.values, 1 - one.colors, 2 * one.extinction)
    march = jv.March(0.07, (jv.AlphaCorrection(labels=True),), max_samples=80)
    materials = Material(0.5, 0.15, 1.4, label=1), Material(0.8, 0.1, 1.5, label=2)
    fast, slow = both(
        volume,
        jv.LabelTransferFunction([None, one, other]),
        around(volume, SIZE),
        march,
        templates(materials=materials),
    )
    np.testing.assert_allclose(fast, slow, atol=2e-5)


@pytest.mark.slow
def test_a_baked_image_is_like_the_blended_one():
    """The difference falls with a finer grid."""
    volume = scaled_phantom("sphere", 24)
    camera, transfer = around(volume, SIZE), soft_transfer(0.1)
    march = jv.March(0.05, (jv.AlphaCorrection(),), max_samples=128)
    exact, baked, finer, unlit = (
        np.asarray(jv.render(volume, transfer, camera, march, lighting=lighting).rgba)
        for lighting in (templates(blend=True), templates(baked=48), templates(baked=96), None)
    )
    coarse, fine, whole = (np.abs(image - exact).mean() for image in (baked, finer, unlit))
    assert fine < 0.6 * coarse
    assert fine < 0.1 * whole

    @jax.jit
    def image(position):
        moved = eqx.tree_at(lambda c: c.position, camera, position)
        return jv.render(volume, transfer, moved, march, lighting=templates(baked=48)).rgba

    np.testing.assert_allclose(image(camera.position), baked, atol=2e-3)


@pytest.mark.slow
def test_deferred_light_falls_on_rays_of_ones_own():
    """As on a camera's rays, with a single template for all pixels."""
    volume = scaled_phantom("sphere", 12)
    camera, march, lighting = around(volume, SIZE), jv.March(0.1), Deferred(templates(templates=1))
    expected = jv.render(volume, soft_transfer(0.1), camera, march, lighting=lighting)
    found = jv.render_rays(volume, soft_transfer(0.1), *camera.rays(), march, lighting=lighting)
    np.testing.assert_allclose(found.rgba, expected.rgba, atol=2e-5)


@pytest.mark.slow
def test_one_opaque_surface_is_lit_as_its_samples_are():
    """The difference falls with higher opacity and shorter steps."""
    volume = jv.phantom("constant", 8)
    lighting = templates(blend=True, materials=Material(0.5, 0.5, 1.4))

    def off(extinction):
        """Difference relative to the effect of lighting on the image."""
        transfer = jv.TransferFunction([0.0, 1.0], [[0.7, 0.5, 0.4]] * 2, [extinction] * 2)
        march = jv.March(0.25 / extinction, (jv.AlphaCorrection(), jv.EarlyTermination()))
        each, once, unlit = (
            np.asarray(jv.render(volume, transfer, around(volume, SIZE), march, lighting=how).rgba)
            for how in (lighting, Deferred(lighting), None)
        )
        return np.abs(once - each).mean() / np.abs(unlit - each).mean()

    veil, solid, wall = (off(extinction) for extinction in (20.0, 80.0, 320.0))
    assert solid < veil / 2
    assert wall < solid / 2
    assert wall < 0.005


def test_without_lighting_nothing_of_it_is_in_the_program(monkeypatch):
    """All lighting goes through these names, which the programs of lit images call."""
    called = []
    for module in (lighting_shading, selection, visible_samples):
        for name in ("shade_sample", "shaded_colors", "Chosen", "Sample"):
            if hasattr(module, name):
                original = getattr(module, name)

                def recorded(*args, name=name, original=original, **how):
                    called.append(name)
                    return original(*args, **how)

                monkeypatch.setattr(module, name, recorded)
    volume = scaled_phantom("sphere", 12)
    transfer, camera, march = soft_transfer(0.1), around(volume, (9, 7)), jv.March(0.2, max_samples=32)

    def loss(camera, lighting, adjoint):
        return jnp.sum(jv.render(volume, transfer, camera, march, lighting=lighting, adjoint=adjoint).rgba)

    for adjoint in ("replay", "direct"):
        eqx.filter_eval_shape(eqx.filter_grad(loss), camera, None, adjoint)
    assert not called
    eqx.filter_eval_shape(loss, camera, by_hand(), "direct")
    assert "Sample" in called
    assert "shade_sample" in called


# ---------------------------------------------------------------- gradients of images

IMAGE_STEP = 2e-8
"""Step of central differences in float64, small since a piecewise linear field has many kinks."""

LEAVES = {
    "opacity": lambda s: s[4].materials[0].opacity,
    "mean_free_path": lambda s: s[4].materials[0].mean_free_path,
    "refractive_index": lambda s: s[4].materials[0].refractive_index,
    "other opacity": lambda s: s[4].materials[1].opacity,
    "other mean_free_path": lambda s: s[4].materials[1].mean_free_path,
    "other refractive_index": lambda s: s[4].materials[1].refractive_index,
    "direction": lambda s: s[4].lights[0].direction,
    "irradiance": lambda s: s[4].lights[0].irradiance,
    "light's position": lambda s: s[4].lights[1].position,
    "intensity": lambda s: s[4].lights[1].intensity,
    "radiance": lambda s: s[4].lights[2].radiance,
    "colors": lambda s: s[1].colors,
    "extinction": lambda s: s[1].extinction,
    "data": lambda s: s[0].data,
    "spacing": lambda s: s[0].spacing,
    "origin": lambda s: s[0].origin,
    "position": lambda s: s[2].position,
    "focal_point": lambda s: s[2].focal_point,
    "view_up": lambda s: s[2].view_up,
    "view_angle": lambda s: s[2].view_angle,
    "step": lambda s: s[3].step,
}


def image_scene():
    """A small scene in float64, with two materials that meet in the middle of its values."""
    noise = anisotropic_noise()
    volume = jv.Volume(
        jnp.asarray(np.asarray(noise.data[:6, :5, :7], float)), (0.3, 0.4, 0.25), (-0.5, 0.2, 0.1)
    )
    transfer = to_float64(soft_transfer())
    transfer = eqx.tree_at(lambda t: t.extinction, transfer, transfer.extinction + 0.1)
    camera = jv.Camera((1.9, -1.3, 1.7), tuple(map(float, volume.center)), (0.1, 0, 1), 40.0, size=(6, 5))
    march = jv.March(0.21, (jv.AlphaCorrection(),), "midpoint", max_samples=32)
    materials = Material(0.5, 0.15, 1.4, values=(0.0, 0.5)), Material(0.7, 0.1, 1.2, values=(0.5, 2.0))
    return volume, transfer, camera, march, templates(materials=materials, light=to_float64(MANY))


def deferred(scene):
    return (*scene[:4], Deferred(scene[4]))


def image_loss(adjoint):
    random = np.random.default_rng(5)
    weights = random.normal(size=(5, 6, 4))

    def loss(scene):
        rendering = jv.render(*scene[:4], lighting=scene[4], adjoint=adjoint)
        return jnp.sum(rendering.rgba * jnp.asarray(weights))

    return loss


def directions(scene):
    random = np.random.default_rng(0)
    return {leaf: jnp.asarray(random.normal(size=where(scene).shape)) for leaf, where in LEAVES.items()}


def differences(value, scene, names):
    """Slopes of the loss along a direction of each leaf, by central differences."""
    along, found = directions(scene), {}
    for leaf in names:
        where = LEAVES[leaf]
        ends = [
            value(eqx.tree_at(where, scene, where(scene) + sign * IMAGE_STEP * along[leaf]))
            for sign in (1, -1)
        ]
        found[leaf] = float(ends[0] - ends[1]) / (2 * IMAGE_STEP)
    return found


def check_slopes(gradient, scene, expected):
    along = directions(scene)
    for leaf, difference in expected.items():
        slope = jnp.vdot(LEAVES[leaf](gradient), along[leaf])
        np.testing.assert_allclose(slope, difference, rtol=1e-5, atol=1e-6, err_msg=leaf)


@pytest.mark.slow
def test_gradients_of_an_image_match_central_differences():
    """One program gives the value and the gradient."""
    with in_float64():
        scene = image_scene()
        program = eqx.filter_jit(eqx.filter_value_and_grad(image_loss("replay")))
        expected = differences(lambda s: program(s)[0], scene, LEAVES)
        assert min(map(abs, expected.values())) > 1e-5
        check_slopes(program(scene)[1], scene, expected)


@pytest.mark.slow
def test_gradients_of_deferred_light_match_central_differences():
    with in_float64():
        scene = image_scene()
        program = eqx.filter_jit(eqx.filter_value_and_grad(lambda s: image_loss("replay")(deferred(s))))
        expected = differences(lambda s: program(s)[0], scene, LEAVES)
        assert min(map(abs, expected.values())) > 1e-6
        check_slopes(program(scene)[1], scene, expected)


@pytest.mark.slow
def test_rays_that_see_nothing_leave_the_gradient_of_deferred_light_finite():
    """Here only the shading of pixels; a slow test below renders an image."""
    volume, space, zero = nodes({}), Affine(nodes({})), jnp.zeros((), jnp.int32)
    lighting = ScattererTemplates(MATERIALS[0], SUN, given=given(PAIR), reach=(2.0,))

    def loss(direction, rgba, depth):
        turned = eqx.tree_at(lambda how: how.lights[0].direction, lighting, direction)
        seen = lighting_shading.lit_classification(volume, TRANSFER, space, turned)
        line = Line(apart(jnp.zeros(3)), apart(jnp.asarray([0.0, 0.0, 1.0])), (zero, zero))
        return jnp.sum(shaded_pixels(Deferred(turned), seen, space, line, rgba, depth) ** 2)

    # one ray ends at the skin's soft edge, lit by a sun from the side; the other sees nothing
    rgba, depth = jnp.asarray([[0.3, 0.2, 0.1, 0.5], [0.0] * 4]), jnp.asarray([0.11, jnp.inf])
    found = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))(jnp.asarray([-0.1, -1.0, 0.0]), rgba, depth)
    assert all(np.all(np.isfinite(leaf)) for leaf in found)
    assert all(np.any(leaf != 0) for leaf in found)


@pytest.mark.slow
def test_pixels_that_see_nothing_leave_the_gradient_of_deferred_light_finite():
    volume, transfer = scaled_phantom("sphere", 12), soft_transfer(0.1)
    march, lighting = jv.March(0.2, (jv.AlphaCorrection(),), max_samples=32), Deferred(templates())

    def loss(camera, path):
        changed = eqx.tree_at(lambda how: how.lighting.materials[0].mean_free_path, lighting, path)
        image = jv.render(volume, transfer, camera, march, lighting=changed, outputs="rgba")
        return jnp.sum(image.rgba**2), image.rgba[..., 3]

    gradient = jax.jit(jax.grad(loss, argnums=(0, 1), has_aux=True))
    (of_camera, of_path), opacity = gradient(around(volume, (9, 7)), jnp.asarray(0.15))
    assert np.any(opacity == 0)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves((of_camera, of_path)))
    assert np.any(of_camera.position != 0)
    assert of_path != 0


def test_there_is_a_gradient_of_an_image_by_deferred_light():
    """Slow tests above check its values."""
    loss, scene = loss_of_an_image("float32", Deferred(by_hand()))
    gradient = eqx.filter_eval_shape(eqx.filter_grad(loss), scene, "replay")
    expected = eqx.filter(scene, eqx.is_inexact_array)
    assert jax.tree.map(jnp.shape, gradient) == jax.tree.map(jnp.shape, expected)


@pytest.mark.slow
@pytest.mark.parametrize("how", [lambda scene: scene, deferred])
def test_replay_direct_and_forward_agree(how):
    with in_float64():
        scene = image_scene()
        replay, direct = (
            eqx.filter_jit(eqx.filter_grad(lambda s, a=a: image_loss(a)(how(s))))(scene)
            for a in ("replay", "direct")
        )
        for leaf, where in LEAVES.items():
            size = float(np.abs(where(direct)).max())
            np.testing.assert_allclose(
                where(replay), where(direct), rtol=1e-7, atol=1e-9 * size, err_msg=leaf
            )
        forward = eqx.filter_jit(
            lambda s, t: eqx.filter_jvp(lambda s: image_loss("forward")(how(s)), (s,), (t,))[1]
        )
        for leaf, along in directions(scene).items():
            still = jax.tree.map(lambda x: jnp.zeros_like(x) if eqx.is_inexact_array(x) else None, scene)
            slope = forward(scene, eqx.tree_at(LEAVES[leaf], still, along))
            np.testing.assert_allclose(slope, jnp.vdot(LEAVES[leaf](direct), along), rtol=1e-7, atol=1e-9)


# ---------------------------------------------------------------- bad input

HALF = Material(0.5, 1.0)
BAD = {
    "templates": (lambda: ScattererTemplates(HALF, SUN, templates=0), "templates must be an integer"),
    "photons": (lambda: ScattererTemplates(HALF, SUN, photons=0), "photons must be an integer"),
    "occlusion": (
        lambda: ScattererTemplates(HALF, SUN, occlusion="some"),
        "occlusion must be one of soft, h",
    ),
    "reach": (lambda: ScattererTemplates(HALF, SUN, reach=(1.0, 2.0)), "reach must be multiples above 1"),
    "reach's order": (lambda: ScattererTemplates(HALF, SUN, reach=(4.0, 2.0)), "reach must be multiples"),
    "cutoff": (lambda: ScattererTemplates(HALF, SUN, cutoff=1.0), "cutoff must be"),
    "seed": (lambda: ScattererTemplates(HALF, SUN, seed=-1), "seed must be an integer"),
    "baked": (lambda: ScattererTemplates(HALF, SUN, baked=1), "baked must be an integer of at least 2"),
    "an opacity too low": (
        lambda: ScattererTemplates(Material(0.03, 1.0), SUN),
        "opacity 0.03 leaves no photon .*threshold=0.01.*packets=4.*a threshold of at most 0.0075",
    ),
    "no opacity": (lambda: ScattererTemplates([HALF, Material(0, 1.0)], SUN), "opacity must be above 0"),
    "many templates": (
        lambda: ScattererTemplates(HALF, SUN, templates=10**9).grown(blend=False),
        "1000000000 templates.*asks for .* GiB of memory, and the device has",
    ),
    "a fine grid": (
        lambda: ScattererTemplates(HALF, SUN, baked=10**5).prepared(nodes({}), TRANSFER, jv.March(0.1)),
        "nodes for baked=100000.*asks for .* GiB",
    ),
    "threshold": (lambda: ScattererTemplates(HALF, SUN, threshold=0.0), "threshold must be"),
    "packets": (lambda: ScattererTemplates(HALF, SUN, packets=0), "packets must be an integer"),
    "energy": (lambda: ScattererTemplates(HALF, SUN, energy="lost"), "energy must be one of"),
    "critical_angle": (lambda: ScattererTemplates(HALF, SUN, critical_angle=0.0), "critical_angle must be"),
    "given": (lambda: ScattererTemplates([HALF, HALF], SUN, given=given(PAIR)), "templates of 2 materials"),
    "lights": (lambda: ScattererTemplates(HALF, ()), "lights must be a light"),
    "materials": (lambda: ScattererTemplates((), SUN), "materials must hold at least one Material"),
    "lighting": (
        lambda: jv.render(nodes({}), TRANSFER, around(nodes({})), jv.March(0.1), lighting=3),
        "lighting must be None or a Lighting; got 3",
    ),
    "deferred": (lambda: Deferred(3), "lighting must be a Lighting, such as ScattererTemplates; got 3"),
    "labels": (
        lambda: shade(
            ScattererTemplates(Material(0.5, 1.0, label=1), SUN, given=given(PAIR)),
            nodes({}),
            TRANSFER,
            [(0, 0, 0)],
        ),
        "labels are needed here",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    make, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        make()


def test_levels_are_asked_for_where_an_opacity_is_traced():
    def photons(opacity, **how):
        return ScattererTemplates(Material(opacity, 1.0), SUN, **how).grown(blend=False).intensity

    with pytest.raises(ValueError, match="levels must be given where opacity is traced"):
        jax.eval_shape(photons, 0.5)
    assert jax.eval_shape(lambda a: photons(a, levels=3, packets=2), 0.5).shape == (1, 8, 14)
