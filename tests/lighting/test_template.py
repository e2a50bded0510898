"""Scatterer templates: where the energy of simulated packets goes, and whether it is conserved."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.lighting import (
    ConstantLight,
    DirectionalLight,
    Material,
    PointLight,
    ScattererTemplate,
    material,
    scatterer_template,
    scatterer_templates,
    template_capacity,
)
from jaxvol.lighting.lights import lights_of
from jaxvol.lighting.materials import PRESETS, materials_of
from jaxvol.lighting.merging import merged
from jaxvol.lighting.threshold import FADES, Threshold

from ..scenes import in_float64


slow = pytest.mark.slow

OPACITIES = (0.05, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99)
INDEX = 1.4
TEMPLATES = 256

# one compiled program, with the material's parameters as arguments
grow = eqx.filter_jit(scatterer_template)
KEY = jax.random.key(0)


def in_turn(function):
    """Map `function` by `jax.lax.map`, which compiles in half the time of `jax.vmap`."""
    return jax.jit(lambda each: jax.lax.map(function, each))


def totals(template):
    """The energy of each template."""
    return np.asarray(template.intensity, np.float64).sum(axis=-1)


def simulated_total(opacity, *, packets, threshold, index, templates=20_000):
    """Mean energy of templates, by following all their packets at once until none is left. Positions do not
    matter."""
    random, cone = np.random.default_rng(0), math.sqrt(1 - 1 / index**2)
    light, total = np.full(templates * packets, 1 / packets), 0.0
    while light.size:
        x = np.clip((opacity * light / threshold - FADES) / (1 - FADES), 0, 1)
        light = light * x**2 * (3 - 2 * x)
        light = light[light > 0]
        cosine = random.uniform(cone, 1, light.size)
        total += opacity * light.sum()
        passed = (1 - opacity) * light
        light = np.concatenate([passed * cosine, passed * (1 - cosine)])
    return total / templates


@pytest.fixture(scope="module")
def grown():
    """Energy-conserving templates: (opacities, templates, photons)."""
    levels = max(Threshold().levels(Material(a, 1.0)) for a in OPACITIES)

    def one(opacity, key):
        return scatterer_template(Material(opacity, 1.0, INDEX), key, merge=0, levels=levels)

    keys = jax.random.split(jax.random.key(3), (len(OPACITIES), TEMPLATES))
    return in_turn(lambda a: jax.lax.map(lambda key: one(a[0], key), a[1]))((jnp.asarray(OPACITIES), keys))


def test_a_conserving_template_holds_what_the_threshold_leaves(grown):
    for opacity, found in zip(OPACITIES, totals(grown), strict=True):
        allowed = simulated_total(opacity, packets=4, threshold=0.01, index=INDEX)
        assert 0.02 < allowed < 1
        np.testing.assert_allclose(found.mean(), allowed, rtol=0.02, err_msg=str(opacity))


def test_a_conserving_template_never_holds_more_than_the_light_it_began_with(grown):
    assert totals(grown).max() <= 1 + 1e-6


def test_photons_are_sorted_brightest_first(grown):
    assert np.all(jnp.diff(grown.intensity, axis=-1) <= 0)


def test_no_template_has_more_photons_than_room_is_made_for(grown):
    for opacity, intensity in zip(OPACITIES, grown.intensity, strict=True):
        most = Threshold().photons(Material(opacity, 1.0))
        assert np.sum(np.asarray(intensity) > 0, axis=-1).max() <= most
    assert grown.intensity.shape[-1] <= template_capacity(Material(0.05, 1.0))


def test_the_capacity_is_that_of_the_paper():
    """Six levels of a binary tree at an opacity of a half."""
    assert template_capacity(Material(0.5, 1.0), packets=1, threshold=0.01) == 63


@pytest.mark.parametrize("opacity", [0.5, 0.9, *(pytest.param(a, marks=slow) for a in (0.3, 0.7))])
def test_the_printed_form_makes_and_loses_energy(opacity):
    """In a narrow cone nearly all light is refracted, so that little of it falls below the threshold."""
    template = grow(
        Material(opacity, 1.0),
        KEY,
        packets=1,
        threshold=3e-3,
        levels=68,
        energy="printed",
        flights=False,
        critical_angle=2.0,
        merge=0,
    )
    np.testing.assert_allclose(totals(template), opacity / (1 - opacity), rtol=0.02)
    assert (totals(template) > 1.5) == (opacity > 0.5)


def test_the_printed_form_loses_most_light_on_its_flights():
    """Each of three flights leaves exp(-Δx/λ) cos θ, a quarter on average, and passes on α of that."""
    printed = in_turn(
        lambda key: scatterer_template(
            Material(0.9, 1.0),
            key,
            packets=1,
            threshold=1e-3,
            energy="printed",
            critical_angle=2.0,
            merge=0,
            levels=3,
        )
    )
    found = totals(printed(jax.random.split(jax.random.key(0), 8192)))
    factor = 0.9 / 4
    np.testing.assert_allclose(found.mean(), factor + factor**2 + factor**3, rtol=0.03)


def test_first_flights_are_exponential_with_the_mean_free_path():
    """The fraction of flights longer than x is exp(-x/λ)."""
    path, number = 0.7, 200_000
    flown = jax.jit(
        jax.vmap(lambda key: scatterer_template(Material(1.0, path), key, packets=1, levels=1, merge=0))
    )
    offset = np.asarray(flown(jax.random.split(jax.random.key(1), number)).offset[:, 0])
    length = np.linalg.norm(offset, axis=-1)
    np.testing.assert_allclose(length.mean(), path, rtol=0.01)
    part = (np.arange(number) + 0.5) / number
    assert np.abs(1 - np.exp(-np.sort(length) / path) - part).max() < 2 / np.sqrt(number)
    # and directions are isotropic: each coordinate is uniform
    direction = np.sort(offset / length[:, None], axis=0)
    assert np.abs((direction + 1) / 2 - part[:, None]).max() < 2 / np.sqrt(number)


def test_four_packets_are_half_as_lopsided_as_one(grown):
    """Lopsidedness is the mean distance of the energy's centroid from the origin."""
    one = in_turn(
        lambda key: scatterer_template(Material(0.5, 1.0, INDEX), key, packets=1, merge=0, levels=3)
    )
    four = jax.tree.map(lambda leaf: leaf[OPACITIES.index(0.5)], grown)

    def lopsided(template):
        centroid = np.einsum("tn,tnx->tx", template.intensity, template.offset) / totals(template)[:, None]
        return np.linalg.norm(centroid, axis=-1).mean()

    assert lopsided(four) <= 0.5 * lopsided(one(jax.random.split(KEY, 512)))


def test_offsets_scale_with_the_mean_free_path_and_intensities_do_not_change():
    one, other = (grow(Material(0.5, path, INDEX), KEY, levels=2) for path in (1.0, 4.0))
    np.testing.assert_array_equal(other.offset, 4 * np.asarray(one.offset))
    np.testing.assert_array_equal(other.intensity, one.intensity)


def test_another_key_draws_another_template():
    one, other = (grow(Material(0.5, 1.0, INDEX), jax.random.key(seed), levels=2) for seed in (1, 2))
    assert np.abs(np.asarray(one.offset[:4] - other.offset[:4])).min() > 1e-4


def test_light_is_refracted_within_the_critical_angle():
    """In a narrow cone, the brighter of a packet's two successors continues within the cone."""
    angle = 5.0
    template = grow(
        Material(0.3, 1.0), KEY, packets=1, critical_angle=angle, threshold=1e-3, merge=0, levels=3
    )
    first, second, third = np.asarray(template.offset[:3])

    def between(u, v):
        return np.degrees(np.arccos(u @ v / np.linalg.norm(u) / np.linalg.norm(v)))

    assert between(first, second - first) <= angle
    assert between(second - first, third - second) <= angle


def test_by_default_the_cone_is_that_of_total_reflection():
    for index in (1.4, 1 / 1.4):
        default, given = (
            grow(Material(0.5, 1.0, index), KEY, levels=2, critical_angle=angle)
            for angle in (None, math.degrees(math.asin(1 / 1.4)))
        )
        np.testing.assert_allclose(default.offset, given.offset, atol=1e-4)


def photons(*each):
    """A template of photons (offset, intensity)."""
    offset, intensity = zip(*each, strict=True)
    return ScattererTemplate(jnp.asarray(offset), jnp.asarray(intensity))


def test_photons_that_coincide_add():
    found = merged(
        photons(
            ((1.0, 0.0, 0.0), 0.4), ((0.0, 2.0, 0.0), 0.3), ((1.0, 0.0, 0.005), 0.2), ((1.0, 0.0, 0.0), 0.05)
        ),
        0.01,
    )
    np.testing.assert_allclose(found.intensity, [0.65, 0.3, 0, 0], atol=1e-7)


def test_a_photon_that_joins_one_that_joins_another_is_not_lost():
    found = merged(photons(((0.0, 0.0, 0.0), 0.4), ((0.008, 0.0, 0.0), 0.3), ((0.016, 0.0, 0.0), 0.2)), 0.01)
    np.testing.assert_allclose(found.intensity, [0.9, 0, 0], atol=1e-7)


def test_merging_keeps_the_total():
    apart, some, one = (
        grow(Material(0.5, 1.0, INDEX), KEY, levels=2, merge=merge) for merge in (0, 0.3, 1e3)
    )
    filled = [int(np.sum(np.asarray(each.intensity) > 0)) for each in (apart, some, one)]
    assert filled[0] > filled[1] > filled[2] == 1
    np.testing.assert_allclose([totals(some), totals(one)], totals(apart), rtol=1e-6)


@pytest.mark.parametrize(("energy", "lowest"), [("conserving", 0.11), ("printed", 6e-3)])
def test_gradients_match_central_differences(energy, lowest):
    """Photons fade out at the threshold, so that sums over them are smooth; at least one fades here."""
    with in_float64():

        @jax.jit
        def seen(numbers):
            opacity, path, index = numbers
            template = scatterer_template(
                Material(opacity, path, index),
                0,
                energy=energy,
                packets=2,
                threshold=lowest,
                levels=2,
                merge=0,
            )
            waves = jnp.sin(template.offset @ jnp.asarray([0.7, -1.1, 0.4]) + 0.3)
            return jnp.sum(template.intensity * waves)

        at = jnp.asarray([0.4, 0.8, 1.3])
        found = jax.jit(jax.grad(seen))(at)
        for i, name in enumerate(("opacity", "mean_free_path", "refractive_index")):
            h = 1e-6 * jnp.eye(3)[i]
            difference = (seen(at + h) - seen(at - h)) / 2e-6
            assert abs(difference) > 1e-4, name
            np.testing.assert_allclose(found[i], difference, rtol=1e-6, err_msg=name)


def test_the_total_is_continuous_where_a_photon_fades():
    """As the opacity passes values at which photons appear or vanish, the total does not jump."""
    with in_float64():
        opacities = jnp.linspace(0.2, 0.4, 4001)
        several = in_turn(
            lambda a: scatterer_template(
                Material(a, 1.0, INDEX), 0, packets=1, threshold=0.05, levels=3, merge=0
            )
        )
        grown = several(opacities)
        assert len(set(np.sum(np.asarray(grown.intensity) > 0, axis=-1))) > 1
        # if photons vanished abruptly, the total would jump by a threshold
        assert np.abs(np.diff(totals(grown))).max() < 0.05 / 50


def test_the_gradient_is_0_where_the_critical_angle_has_none():
    def total(index):
        return jnp.sum(scatterer_template(Material(0.5, 1.0, index), 0, levels=2, merge=0).intensity ** 2)

    slope = jax.jit(jax.grad(total))
    assert slope(1.0) == 0
    assert abs(slope(1.01)) > 0


def test_many_templates_are_those_grown_one_by_one():
    several, key = [Material(0.5, 1.0, 1.4), Material(0.8, 0.3, 1.2)], jax.random.key(7)
    how = {"packets": 2, "threshold": 0.02, "levels": 1}
    grown = eqx.filter_jit(scatterer_templates)(several, key, count=2, **how)
    for m, one in enumerate(several):
        for number in range(2):
            alone = grow(one, jax.random.fold_in(jax.random.fold_in(key, m), number), **how)
            np.testing.assert_allclose(grown.offset[m, number], alone.offset, atol=1e-5)
            np.testing.assert_allclose(grown.intensity[m, number], alone.intensity, atol=1e-6)


def test_the_brightest_photons_keep_the_energy_of_all(grown):
    few = grown.brightest(7)
    assert few.intensity.shape == (len(OPACITIES), TEMPLATES, 7)
    np.testing.assert_allclose(totals(few), totals(grown), rtol=1e-5)
    np.testing.assert_array_equal(few.offset, grown.offset[:, :, :7])
    ratio = np.asarray(few.intensity[3] / grown.intensity[3, :, :7])
    np.testing.assert_allclose(ratio, np.broadcast_to(ratio[:, :1], ratio.shape), rtol=1e-5)
    assert ratio.min() > 1
    np.testing.assert_allclose(grown.brightest(10**6).intensity, grown.intensity, rtol=1e-5)


def test_the_threshold_that_is_advised_keeps_something():
    faint, threshold = Material(0.031, 1.0), 0.00775
    assert Threshold(value=threshold).levels(faint) > 1
    assert totals(grow(faint, KEY, threshold=threshold, levels=1)) > 0.02


def test_where_an_opacity_is_traced_a_template_that_keeps_nothing_is_nan():
    grow_traced = in_turn(lambda a: scatterer_template(Material(a, 1.0), KEY, levels=1))
    found = grow_traced(jnp.asarray([0.0, 0.031, 0.05]))
    np.testing.assert_array_equal(np.isnan(found.intensity).all(axis=-1), [True, True, False])
    np.testing.assert_array_equal(np.isnan(found.intensity).any(axis=-1), [True, True, False])


def test_no_energy_is_made_where_there_is_none():
    dark = photons(((0.0, 0.0, 1.0), 0.0), ((0.0, 1.0, 0.0), 0.0)).brightest(1)
    np.testing.assert_array_equal(dark.intensity, [0.0])


def test_a_blend_holds_the_mean_energy_and_all_photons(grown):
    blend = grown.blended()
    assert blend.intensity.shape == (len(OPACITIES), TEMPLATES * grown.intensity.shape[-1])
    np.testing.assert_allclose(totals(blend), totals(grown).mean(axis=1), rtol=1e-5)
    assert np.all(jnp.diff(blend.intensity, axis=-1) <= 0)
    where = np.einsum("mn,mnx->mx", blend.intensity, blend.offset)
    np.testing.assert_allclose(
        where, np.einsum("mtn,mtnx->mx", grown.intensity, grown.offset) / TEMPLATES, atol=1e-4
    )


def test_templates_take_no_memory_to_speak_of():
    several = [material(name) for name in PRESETS] + [Material(0.5, 1.0)]
    grown = jax.eval_shape(lambda: scatterer_templates(several, 0, count=8))
    assert grown.intensity.shape[:2] == (4, 8)
    assert sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(grown)) < 64 * 1024


def test_what_is_saved_is_loaded(tmp_path, grown):
    grown.save(tmp_path / "skin.npz")
    found = ScattererTemplate.load(tmp_path / "skin.npz")
    np.testing.assert_array_equal(found.offset, grown.offset)
    np.testing.assert_array_equal(found.intensity, grown.intensity)


GOOD = {"offset": np.zeros((4, 3), np.float32), "intensity": np.full(4, 0.1, np.float32)}
CORRUPT = {
    "an array is missing": ({"offset": GOOD["offset"]}, "intensity.*missing"),
    "shapes differ": ({**GOOD, "intensity": np.zeros(5)}, r"must hold offset .*got \(4, 3\) and \(5,\)"),
    "no vectors": ({**GOOD, "offset": np.zeros((4, 2))}, "must hold offset"),
    "a single number": ({"offset": np.zeros(3), "intensity": np.zeros(())}, "must hold offset"),
    "an infinite offset": ({**GOOD, "offset": np.full((4, 3), np.inf)}, "finite offsets"),
    "an intensity that is not a number": ({**GOOD, "intensity": np.full(4, np.nan)}, "finite intensities"),
    "a negative intensity": ({**GOOD, "intensity": -GOOD["intensity"]}, "at least 0"),
    "a pickle": ({**GOOD, "intensity": np.array([None] * 4, object)}, "expected integers or floats"),
}


@pytest.mark.parametrize("case", CORRUPT)
def test_what_is_wrong_with_a_file_is_named(tmp_path, case):
    arrays, message = CORRUPT[case]
    path = tmp_path / "bad.npz"
    np.savez(path, **arrays)
    with pytest.raises(ValueError, match=message) as fault:
        ScattererTemplate.load(path)
    assert str(path) in str(fault.value)


def test_files_that_are_no_archives_are_refused(tmp_path):
    (tmp_path / "text.npz").write_text("no archive")
    for name in ("text.npz", "none.npz"):
        with pytest.raises(ValueError, match=name):
            ScattererTemplate.load(tmp_path / name)
    with pytest.raises(ValueError, match=r"must end in \.npz"):
        photons(((0.0, 0.0, 0.0), 1.0)).save(tmp_path / "template.npy")


HALF = Material(0.5, 1.0)


def traced_opacity():
    return jax.jit(lambda a: scatterer_template(Material(a, 1.0), 0).intensity)(0.5)


BAD = {
    "packets": (lambda: scatterer_template(HALF, 0, packets=0), "packets must be an integer of at least 1"),
    "threshold 0": (lambda: scatterer_template(HALF, 0, threshold=0.0), "threshold must be"),
    "threshold 1": (lambda: scatterer_template(HALF, 0, threshold=1.0), "threshold must be"),
    "energy": (lambda: scatterer_template(HALF, 0, energy="lost"), "energy must be one of conserving, print"),
    "flights": (lambda: scatterer_template(HALF, 0, flights=False), 'flights=False requires energy="print'),
    "no angle": (lambda: scatterer_template(HALF, 0, critical_angle=0.0), "critical_angle must be"),
    "wide angle": (lambda: scatterer_template(HALF, 0, critical_angle=91.0), "critical_angle must be"),
    "opacity too low": (
        lambda: scatterer_template(Material(0.031, 1.0), 0),
        "opacity 0.031 leaves no photon above threshold=0.01.*packets=4.*a threshold of at most 0.00775",
    ),
    "opacity too low, levels given": (
        lambda: scatterer_template(Material(0.031, 1.0), 0, levels=3),
        "opacity 0.031 leaves no photon",
    ),
    "one opacity too low": (
        lambda: scatterer_templates([HALF, Material(0.2, 1.0)], 0, threshold=0.1, levels=2),
        "opacity 0.2 leaves no photon above threshold=0.1",
    ),
    "opacity 0": (lambda: scatterer_template(Material(0.0, 1.0), 0), "opacity must be above 0"),
    "a tree too large": (
        lambda: scatterer_template(HALF, 0, threshold=1e-9, levels=40),
        "templates.*levels=40.*threshold.*asks for .* GiB of memory, and the device has",
    ),
    "too many templates": (
        lambda: scatterer_templates(HALF, 0, count=10**9),
        "1000000000 templates.*asks for",
    ),
    "traced": (traced_opacity, "levels must be given where opacity is traced"),
    "endless": (
        lambda: scatterer_template(Material(1.0, 1.0), 0, energy="printed"),
        "opacity must be below 1",
    ),
    "count": (lambda: scatterer_templates(HALF, 0, count=0), "count must be an integer of at least 1"),
    "photons": (lambda: photons(((0.0, 0.0, 0.0), 1.0)).brightest(0), "photons must be an integer"),
    "opacity below 0": (lambda: Material(-0.1, 1.0), r"opacity must be in \[0, 1\]; got -0.1"),
    "opacity above 1": (lambda: Material(1.1, 1.0), r"opacity must be in \[0, 1\]"),
    "no path": (lambda: Material(0.5, 0.0), "mean_free_path must be greater than 0"),
    "an endless path": (lambda: Material(0.5, np.inf), "mean_free_path must be finite"),
    "no index": (lambda: Material(0.5, 1.0, 0.0), "refractive_index must be greater than 0"),
    "values": (lambda: Material(0.5, 1.0, values=(2, 2)), "values must be .* low < high"),
    "label": (lambda: Material(0.5, 1.0, label=-1), "label must be an integer of at least 0"),
    "both": (lambda: Material(0.5, 1.0, values=(0, 1), label=1), "values and label must not both be given"),
    "density": (lambda: Material.from_scatterers(0.5, 0.0, 1.0), "density must be greater than 0"),
    "cross_section": (lambda: Material.from_scatterers(0.5, 1.0, 0.0), "cross_section must be greater than"),
    "preset": (lambda: material("fat"), "name must be one of skin, muscle, bone; got 'fat'"),
    "millimetre": (lambda: material("skin", millimetre=0.0), "millimetre must be greater than 0"),
    "no materials": (lambda: materials_of([]), "materials must hold at least one Material"),
    "no material": (lambda: materials_of([HALF, "skin"]), "materials must hold jaxvol materials; got 'skin'"),
    "direction": (lambda: DirectionalLight((0, 0, 0)), "direction must not have length 0"),
    "direction's shape": (lambda: DirectionalLight((0, 1)), "direction must have shape"),
    "irradiance": (lambda: DirectionalLight((0, 0, 1), (1, 1, -1)), "irradiance must not be negative"),
    "position": (lambda: PointLight((0, 0, np.nan)), "position must be finite"),
    "intensity": (lambda: PointLight((0, 0, 0), (-1, 1, 1)), "intensity must not be negative"),
    "radiance": (lambda: ConstantLight((1, 1)), "radiance must have shape"),
    "dark radiance": (lambda: ConstantLight((1, -1, 1)), "radiance must not be negative"),
    "no lights": (lambda: lights_of(()), "lights must be a light or a tuple"),
    "no light": (lambda: lights_of((ConstantLight(), 3)), "lights must hold jaxvol lights.*got 3"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    make, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        make()


def test_scatterers_have_the_free_path_of_a_gas():
    found = Material.from_scatterers(0.5, 3.0, 0.25, 1.2, values=(1.0, 2.0))
    np.testing.assert_allclose(found.mean_free_path, 1 / (np.sqrt(2) * 3.0 * 0.25), rtol=1e-6)
    assert (float(found.opacity), float(found.refractive_index)) == (0.5, np.float32(1.2))
    np.testing.assert_array_equal(found.values, [1, 2])


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_materials_in_units_of_ones_own(name):
    one, other = material(name), material(name, millimetre=0.1, label=3)
    np.testing.assert_allclose(other.mean_free_path, 0.1 * one.mean_free_path, rtol=1e-6)
    assert other.label == 3
    assert other.opacity == one.opacity
    assert eqx.tree_equal(jv.Material(*PRESETS[name]), one)
