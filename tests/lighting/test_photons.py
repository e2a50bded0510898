"""What light does a sample get from the photons around it? By hand, against closed forms, and its gradient.

A grid of nodes with spacing 1, centred at the origin, is air except for single nodes, where the sample and
its photons lie. A wall is visible but has no material. In each scene, one of three lights shines. All scenes
are of one structure, so that each occlusion has one program. The grid is deep enough for a half-space.
"""

from contextlib import nullcontext
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from experiments.printed_templates import PrintedSteps
from jaxvol.lighting import (
    ConstantLight,
    DirectionalLight,
    Material,
    PointLight,
    ScattererTemplate,
    ScattererTemplates,
    scatterer_templates,
)

from ..half_space import chandrasekhar, reflected, under_sky
from ..scenes import in_float64, slow
from .samples import check_gradient, colors_of, in_double, shaded


AIR, SKIN, OTHER_SKIN, BONE, OTHER_BONE, WALL = 0.0, 1.0, 1.2, 2.0, 2.2, 3.0
SEEN = {
    AIR: ((0.0, 0.0, 0.0), 0.0),
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
    Material(0.5, 0.7, label=1),
)
SHAPE = (9, 9, 41)
IRRADIANCE = np.array([1.0, 2.0, 3.0])
PHOTONS = 800
"""Of each template, most of them empty."""
PAIR = (((2, 0, 0), 0.3), ((-2, 0, 0), 0.6))
FORMS = pytest.mark.parametrize("occlusion", ["hard", "soft"])


def radiance_of(opacity):
    """Factor of E b (c + s) in a sample's radiance: 4 / (3π) times the reflectance of a half-space."""
    gamma = np.sqrt(opacity)
    return 4 / (3 * np.pi) * (1 - gamma) / (1 + gamma) * (1 - gamma / (3 * (1 + gamma)))


POWER = radiance_of(0.5) * IRRADIANCE


def nodes(places, labels: Any = 0):
    """A volume with these values at these nodes, and skin at the origin."""
    data = np.zeros(SHAPE, np.float32)
    for (x, y, z), value in {(0, 0, 0): SKIN, **places}.items():
        data[x + 4, y + 4, z + 20] = value
    labels = np.broadcast_to(np.asarray(labels, np.uint8), SHAPE)
    return jv.Volume(data, origin=(-4, -4, -20), labels=labels)


def given(photons):
    """A template of these photons (offset, intensity) for each material."""
    offset, intensity = np.zeros((3, 1, PHOTONS, 3), np.float32), np.zeros((3, 1, PHOTONS), np.float32)
    for i, (place, light) in enumerate(photons):
        offset[:, 0, i], intensity[:, 0, i] = place, light
    return ScattererTemplate(jax.device_put(offset), jax.device_put(intensity))


def lights(*, sun=None, lamp=None, sky=False):
    """A sun, a lamp and a sky, of which those named shine."""
    dark = np.zeros(3)
    return (
        DirectionalLight((0, 0, 1) if sun is None else -np.asarray(sun), dark if sun is None else IRRADIANCE),
        PointLight((9, 9, 9) if lamp is None else lamp, dark if lamp is None else IRRADIANCE),
        ConstantLight(IRRADIANCE if sky else dark),
    )


def lighting_of(occlusion, photons=PAIR, *, cutoff=1e-6, materials=MATERIALS, **of_lights):
    templates = photons if isinstance(photons, ScattererTemplate) else given(photons)
    how: Any = {"occlusion": occlusion, "cutoff": cutoff, "given": templates}
    return ScattererTemplates(materials, lights(**of_lights), **how)


LABELLED = tuple(
    Material(each.opacity, each.mean_free_path, each.refractive_index, label=label)
    for label, each in enumerate(MATERIALS, 1)
)
"""The materials by labels, as volumes of colours need them."""


def colored_middle(lighting, places):
    """The lit colour of the node at the origin of a volume that stores the colours and extinctions of `nodes`
    and the labels of `LABELLED`."""
    plain, points = nodes(dict(places)), np.asarray(list(SEEN), np.float32)
    values, stored = np.asarray(plain.data), np.asarray([(*c, e) for c, e in SEEN.values()], np.float32)
    data = stored[np.argmin(abs(values[..., None] - points), axis=-1)]
    labels = np.select([(values > 0.9) & (values < 1.3), (values > 1.9) & (values < 2.3)], [1, 2])
    volume = jv.Volume(data, origin=plain.origin, labels=labels.astype(np.uint8))
    return colors_of(lighting, volume, jv.RadianceField(), [(0, 0, 0)])[0]


def middle(lighting, places=(), transmittance=1.0):
    """The lit colour of the node at the origin."""
    return colors_of(lighting, nodes(dict(places)), TRANSFER, [(0, 0, 0)], transmittance)[0]


def smooth(x):
    """Smooth ramp from 0 at 0 to 1 at 1."""
    x = np.clip(x, 0, 1)
    return x**2 * (3 - 2 * x)


def same(found, expected, what=""):
    np.testing.assert_allclose(found, expected, rtol=2e-5, atol=1e-6, err_msg=what)


SKY: dict[str, Any] = {"sky": True}
GRAZING: dict[str, Any] = {"sun": (0.1, np.sqrt(0.99), 0)}
INNER, MOVED = 0.3 * COLOR[OTHER_SKIN], 0.3 * 0.8 / 0.5 * COLOR[OTHER_BONE]
STEPS: dict[str, tuple[Any, ...]] = {
    # name: values of nodes, light, (brightness, inner colour) where hard, the same where soft
    "1: photons toward the sun are lit": ({}, {"sun": (1, 0, 0)}, (0.3, 0), (0.3, 0)),
    "1: on the other side the other one": ({}, {"sun": (-1, 0, 0)}, (0.6, 0), (0.6, 0)),
    "1: the lit side ends softly": ({}, GRAZING, (0.3, 0), (0.3 * smooth(0.7) + 0.6 * smooth(0.3), 0)),
    "1: the sky lights all": ({}, SKY, (0.9, 0), (0.9, 0)),
    "2: one in a wall is hidden": ({(2, 0, 0): WALL}, SKY, (0.6, 0), (0.3 * np.exp(-3) + 0.6, 0)),
    "2: so is one before a wall": ({(4, 0, 0): WALL}, SKY, (0.6, 0), (0.3 * np.exp(-3) + 0.6, 0)),
    "2: only at multiples of its offset": ({(3, 0, 0): WALL}, SKY, (0.9, 0), (0.9, 0)),
    "4: one in the same material adds its colour": (
        *({(2, 0, 0): OTHER_SKIN}, SKY, (0.6, INNER)),
        (0.3 * np.exp(-2 * 0.6) + 0.6, INNER * (1 - np.exp(-0.6 * 0.7))),
    ),
    "4: also from the dark side": (
        *({(2, 0, 0): OTHER_SKIN}, {"sun": (-1, 0, 0)}, (0.6, INNER)),
        (0.6, INNER * (1 - np.exp(-0.6 * 0.7))),
    ),
    # refractive indices of 1.2 and 0.8 move it to distance 3; opacities are 0.5 and 0.8
    "5: one in another material is moved and scaled": (
        *({(2, 0, 0): BONE, (3, 0, 0): OTHER_BONE}, SKY, (0.6, MOVED)),
        (0.3 * np.exp(-3 * 0.9) + 0.6, MOVED * (1 - np.exp(-0.9 * 0.4))),
    ),
    "5: one that is moved out of matter adds none": ({(2, 0, 0): BONE}, SKY, (0.9, 0), (0.9, 0)),
}


@pytest.mark.parametrize("colors", [False, True])
@FORMS
def test_each_step_is_that_of_the_paper(occlusion, colors):
    """In a volume of values, and in one of colours with labels, such as the paper's photographs of a body."""
    seen, materials = (colored_middle, LABELLED) if colors else (middle, MATERIALS)
    for name, (places, light, hard, soft) in STEPS.items():
        brightness, inner = hard if occlusion == "hard" else soft
        arriving = POWER * (np.pi if "sky" in light else 1)
        found = seen(lighting_of(occlusion, materials=materials, **light), places)
        same(found, arriving * brightness * (COLOR[SKIN] + inner), name)


def test_steps_4_and_5_as_printed():
    """Inner colours under the light's full irradiance; in another material also the brightness is scaled."""
    for name, (places, light, (brightness, inner), _) in STEPS.items():
        if name == "5: one that is moved out of matter adds none":
            brightness = 0.3 * 0.8 / 0.5 + 0.6
        how: Any = {"occlusion": "hard", "cutoff": 1e-6, "given": given(PAIR)}
        found = middle(PrintedSteps(MATERIALS, lights(**light), **how), places)
        arriving = POWER * (np.pi if "sky" in light else 1)
        same(found, arriving * (brightness * COLOR[SKIN] + inner), name)


@FORMS
def test_6_faint_photons_are_left_out(occlusion):
    for transmittance, part in ((1.0, 0.9), (0.1, 0.6), (0.05, 0.0)):
        found = middle(lighting_of(occlusion, sky=True, cutoff=0.05), transmittance=transmittance)
        same(found, COLOR[SKIN] * np.pi * POWER * part)


def test_the_lamp_lights_photons_that_are_nearer_to_it():
    """Whether a photon is lit is decided by distances, exactly or, where soft, to second order."""
    random = np.random.default_rng(0)
    for _ in range(20):
        lamp, photon = random.normal(size=3) * 2, random.normal(size=3)
        if np.abs(photon).max() < 1.01:  # in the cells around the sample, which hold its own material
            continue
        nearer = np.linalg.norm(lamp - photon) < np.linalg.norm(lamp)
        found = middle(lighting_of("hard", ((photon, 0.4), (photon, 0.0)), lamp=lamp))
        same(found, COLOR[SKIN] * POWER / (lamp @ lamp) * 0.4 * nearer)
    photons, r = (((3, 0, 0), 0.3), ((2, 0, 0), 0.6)), 1.2
    parts = [smooth(0.5 + (1 - length / (2 * r)) / 0.5) for length in (3, 2)]
    assert parts[0] == 0 < parts[1] < 1
    found = middle(lighting_of("soft", photons, lamp=(r, 0, 0)))
    same(found, COLOR[SKIN] * POWER / r**2 * 0.6 * parts[1])


@FORMS
def test_what_is_no_material_keeps_its_colour_and_materials_do_not_shine_by_themselves(occlusion):
    """Over the material's whole range of values; where soft, its edges are soft."""
    low, high = 0.9, 1.3
    volume = nodes({(1, 0, 0): high, (-1, 0, 0): low})
    line = [(x, 0, 0) for x in (-1, -0.9, -0.5, 0, 0.5, 0.9, 1)]
    assert (colors_of(lighting_of(occlusion, sky=True), volume, TRANSFER, line) > 0.01).all()
    same(colors_of(lighting_of(occlusion), volume, TRANSFER, line), 0)
    for of_lights in ({}, SKY):
        same(middle(lighting_of(occlusion, **of_lights), {(0, 0, 0): WALL}), COLOR[WALL])


@FORMS
def test_materials_are_where_their_values_or_labels_are_and_the_first_counts(occlusion):
    everywhere = Material(0.8, 0.7, 1.2, values=(0.0, 4.0))
    for first, second, opacity in ((MATERIALS[0], everywhere, 0.5), (everywhere, MATERIALS[0], 0.8)):
        found = middle(lighting_of(occlusion, materials=(first, second, MATERIALS[2]), sky=True))
        same(found, COLOR[SKIN] * np.pi * radiance_of(opacity) * IRRADIANCE * 0.9)
    # Nodes have the label for x < 0. Between nodes, the label's share is 0.75 and 0.4, and where soft, a
    # sample is lit as a whole from a half on. Photons lie outside the volume, where nothing occludes them.
    photons, walls = (((8, 0, 0), 0.3), ((0, 8, 0), 0.6)), np.full(SHAPE, WALL, np.float32)
    labelled = nodes({}, np.where(np.arange(9) < 4, 1, 2)[:, None, None])
    volume = eqx.tree_at(lambda v: v.data, labelled, jax.device_put(walls))
    line = [(x, 0, 0) for x in (-2, -0.75, -0.4, 1)]
    parts = {"hard": (1, 1, 0, 0), "soft": (1, 1, 0.8, 0)}[occlusion]
    expected = [COLOR[WALL] * (part * np.pi * POWER * 0.9 + 1 - part) for part in parts]
    same(colors_of(lighting_of(occlusion, photons, sky=True), volume, TRANSFER, line), expected)


def test_a_pixel_uses_one_of_a_materials_templates_and_a_blend_all():
    random = np.random.default_rng(1)
    offset, intensity = random.normal(size=(1, 2, 2, 3)) + 2.2, random.uniform(0.1, 0.3, (1, 2, 2))
    templates = ScattererTemplate(*jax.device_put((np.float32(offset), np.float32(intensity))))

    def seen(templates):
        lighting = ScattererTemplates(MATERIALS[0], ConstantLight(), reach=(), given=templates)
        pixels = np.indices((8, 8)).reshape(2, -1).T
        return colors_of(lighting, nodes({}), TRANSFER, np.zeros((64, 3)), pixels=pixels)

    first, second = (
        seen(jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[:, i : i + 1], templates)) for i in (0, 1)
    )
    assert np.abs(first - second).max() > 1e-2
    is_first, is_second = (
        np.isclose(seen(templates), one, rtol=1e-4).all(axis=-1) for one in (first, second)
    )
    assert np.all(is_first ^ is_second)
    assert 0.25 < is_first.mean() < 0.75
    blend = ScattererTemplates(MATERIALS[0], ConstantLight(), given=templates, blend=True)
    half = np.sort(np.asarray(templates.intensity).reshape(-1))[::-1] / 2
    found = eqx.filter_jit(ScattererTemplates.simulated)(blend).intensity
    np.testing.assert_allclose(found, half[None, None], rtol=1e-6)


def test_nan_in_light_or_material_reaches_the_sample():
    """Inserted by `tree_at`, as an optimiser does."""
    lighting = lighting_of("soft", sun=(1, 0, 0))
    assert np.isfinite(middle(lighting)).all()
    for where in (
        lambda how: how.lights[0].direction,
        lambda how: how.lights[0].irradiance,
        lambda how: how.lights[1].position,
        lambda how: how.lights[2].radiance,
        lambda how: how.materials[0].opacity,
        lambda how: how.materials[0].mean_free_path,
        lambda how: how.materials[0].refractive_index,
        lambda how: how.materials[0].values,
        lambda how: how.given.intensity,
    ):
        nan = np.full(where(lighting).shape, np.nan, np.float32)
        assert np.isnan(middle(eqx.tree_at(where, lighting, nan))).all()


# ---------------------------------------------------------------- brightness


@pytest.mark.slow
def test_a_half_space_is_about_as_bright_as_by_multiple_scattering():
    """Samples along its normal, weighted by what each shows, under uniform and under parallel light, relative
    to the closed forms: what many templates are known to give, whatever their seed. Nodes are close
    together, since the volume goes on for a part of a voxel beyond its faces."""

    @jax.jit
    def grown(opacities):
        how: Any = {"count": 32, "levels": 11}  # enough for the lowest opacity
        materials = [Material(opacity, 1.0, 1.4) for opacity in opacities]
        return scatterer_templates(materials, 0, **how).normalized().blended().brightest(PHOTONS)

    opacities = np.array([0.1, 0.3, 0.6], np.float32)
    templates = jax.tree.map(np.asarray, grown(jnp.asarray(opacities)))
    volume = jv.Volume(np.full(SHAPE, 3.5, np.float32), (20, 20, 0.2), (-80, -80, 0), nodes({}).labels)
    depth = 0.125 * (np.arange(64) + 0.5)
    points = np.stack([np.zeros(64), np.zeros(64), depth], axis=-1)
    weight = -np.expm1(-0.125) * np.exp(-(depth - 0.0625))
    white = jv.TransferFunction(list(SEEN), np.ones((7, 3)), np.ones(7))
    known = zip(opacities, (0.73, 0.78, 0.86), (0.68, 0.75, 0.81), strict=True)
    for i, (opacity, of_sky, of_sun) in enumerate(known):
        here = Material(opacity, 1.0, 1.4, values=(3.0, 4.0)), *MATERIALS[1:]
        photons = jax.tree.map(lambda leaf, i=i: jnp.asarray(np.stack([leaf[i, None]] * 3)), templates)

        def seen(here=here, photons=photons, **light):
            lighting = lighting_of("soft", photons, materials=here, **light)
            return weight @ colors_of(lighting, volume, white, points) / IRRADIANCE

        albedo = np.array([1 - opacity])
        np.testing.assert_allclose(seen(sky=True) / under_sky(albedo, 1.0), of_sky, rtol=0.08)
        np.testing.assert_allclose(seen(sun=(0, 0, -1)) / reflected(albedo, 1.0, 1.0), of_sun, rtol=0.12)


def test_the_reflectance_of_a_material_is_that_of_multiple_scattering():
    """Chandrasekhar's solution for a half-space, integrated over the outgoing directions."""
    nodes, weights = np.polynomial.legendre.leggauss(32)
    cosines, opacities = (nodes + 1) / 2, np.array([0.001, 0.05, 0.3, 0.7, 0.99])
    h = np.stack([chandrasekhar(1 - opacities, mu) for mu in cosines], axis=-1)
    exact = 1 - np.sqrt(opacities) * (h @ (weights * cosines))
    found = jax.jit(lambda each: Material(0.5, 1.0).optics._replace(opacity=each).reflectance)
    np.testing.assert_allclose(found(np.float32(opacities)), exact, atol=0.0015)


# ---------------------------------------------------------------- gradients

LEAVES = {
    "opacity": lambda s: s[0].materials[0].opacity,
    "mean free path": lambda s: s[0].materials[0].mean_free_path,
    "refractive index": lambda s: s[0].materials[0].refractive_index,
    "other opacity": lambda s: s[0].materials[1].opacity,
    "other mean free path": lambda s: s[0].materials[1].mean_free_path,
    "other refractive index": lambda s: s[0].materials[1].refractive_index,
    "direction": lambda s: s[0].lights[0].direction,
    "irradiance": lambda s: s[0].lights[0].irradiance,
    "light's position": lambda s: s[0].lights[1].position,
    "intensity": lambda s: s[0].lights[1].intensity,
    "radiance": lambda s: s[0].lights[2].radiance,
    "photons' offsets": lambda s: s[0].given.offset,
    "photons' intensities": lambda s: s[0].given.intensity,
    "voxels": lambda s: s[1].data,
    "spacing": lambda s: s[1].spacing,
    "origin": lambda s: s[1].origin,
    "colors": lambda s: s[2].colors,
    "extinction": lambda s: s[2].extinction,
    "points": lambda s: s[3],
}


def smooth_scene():
    """Lighting, volume, transfer function and points in a blob, where two materials meet."""
    random, x = np.random.default_rng(0), np.linspace(-1, 1, 9)
    x, y, z = np.meshgrid(x, x, x, indexing="ij")
    data = 1 / (1 + np.exp(6 * (x**2 + 0.5 * y**2 + z**2 + 0.4 * x * y - 0.5)))
    volume = jv.Volume(data.astype(np.float32), (0.25,) * 3, (-1, -1, -1))
    transfer = jv.TransferFunction(
        [0.0, 0.5, 1.0], [(0.7, 0.6, 0.5), (0.5, 0.7, 0.6), (0.4, 0.5, 0.9)], [0.1, 0.3, 4.0]
    )
    points = random.uniform(-0.7, 0.7, (64, 3))
    intensity = random.uniform(0, 0.4, (2, 2, 6)) * (np.arange(6) < 5)  # one of 0 has a derivative, too
    offset = random.normal(0, 0.3, (2, 2, 6, 3))
    photons = ScattererTemplate(*jax.device_put((np.float32(offset), np.float32(intensity))))
    materials = Material(0.5, 0.3, 1.2, values=(0.4, 2.0)), Material(0.7, 0.2, 1.5, values=(-1.0, 0.5))
    several = DirectionalLight((0.2, 0.4, -1)), PointLight(points[0] + 0.3), ConstantLight((0.3, 0.3, 0.3))
    lighting = ScattererTemplates(materials, several, reach=(), given=photons)
    return lighting, volume, transfer, jax.device_put(np.float32(points))


@eqx.filter_jit
@eqx.filter_value_and_grad
def loss(scene):
    pixels = jnp.stack([jnp.arange(64, dtype=jnp.int32)] * 2, axis=-1)
    return jnp.mean(shaded(*scene, pixels=pixels) @ jnp.asarray([1.0, 0.6, -0.3]))


def test_gradients_of_samples_match_central_differences():
    """A small step, since a piecewise linear field has many kinks."""
    with in_float64():
        scene = in_double(smooth_scene())
        check_gradient(loss, scene, LEAVES, step=2e-8, rtol=1e-5, atol=1e-7, least=1e-4)

        # Longer free paths move photons away. Their slope, averaged over a stretch, is the difference of its
        # ends, so that nothing jumps.
        h, offset = 0.03, np.asarray(scene[0].given.offset)

        def longer(factor):
            return eqx.tree_at(lambda s: s[0].given.offset, scene, jax.device_put(offset * factor))

        way = 1 + h * np.linspace(-1, 1, 65)
        slopes = [np.asarray(loss(longer(at))[1][0].given.offset) for at in (way[1:] + way[:-1]) / 2]
        slopes = [np.sum(slope * offset) for slope in slopes]
        difference = (float(loss(longer(1 + h))[0]) - float(loss(longer(1 - h))[0])) / (2 * h)
        np.testing.assert_allclose(np.mean(slopes), difference, rtol=0.01)


EXTREMES = {
    "nothing is seen": {"extinction": 0.0},
    "all is opaque": {"extinction": 1e6},
    "hardly anything is absorbed": {"opacity": 0.02},
    "all is absorbed": {"opacity": 1.0},
    "nothing is absorbed": {"opacity": 0.0},
    "a short path": {"mean free path": 1e-6},
    "a long path": {"mean free path": 1e6},
    "photons at the sample": {"photons' offsets": 0.0},
    "an empty volume": {"voxels": 0.0},
    "as air": {"refractive index": 1.0},
    "a sample at the lamp": {},
}


@pytest.mark.parametrize("double", [True, *slow(False)])
def test_values_and_gradients_are_finite_at_extremes(double):
    with in_float64() if double else nullcontext():
        scene = in_double(smooth_scene()) if double else smooth_scene()
        for name, change in EXTREMES.items():
            lamp = LEAVES["light's position"]
            moved = scene if change else eqx.tree_at(lamp, scene, jax.device_put(np.asarray(scene[3])[0]))
            for leaf, number in change.items():
                old = LEAVES[leaf](moved)
                moved = eqx.tree_at(
                    LEAVES[leaf], moved, jax.device_put(np.full(old.shape, number, old.dtype))
                )
            value, gradient = loss(moved)
            assert np.isfinite(value), name
            for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
                assert np.all(np.isfinite(leaf)), (name, jax.tree_util.keystr(path))
