"""Scatterer templates: where does the energy of packets go, is it conserved, and what is its gradient?"""

import math
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from experiments.printed_templates import PrintedTree
from jaxvol.lighting import (
    DirectionalLight,
    Material,
    ScattererTemplate,
    ScattererTemplates,
    mean_free_path,
    scatterer_template,
    scatterer_templates,
)
from jaxvol.lighting.packet_tree import FADES, PacketTree

from ..scenes import in_float64


OPACITIES = (0.05, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99)
INDEX = 1.4
TEMPLATES = 256

# one compiled program, with the material's parameters as arguments
grow = eqx.filter_jit(scatterer_template)
KEY = jax.random.key(0)


@eqx.filter_jit
def several(material, count, **how):
    """Many templates of a material, one after the other, which compiles in half the time of `jax.vmap`."""
    return jax.lax.map(lambda key: scatterer_template(material, key, **how), jax.random.split(KEY, count))


def capacity(material, **how):
    """How many photons a template has room for."""
    return jax.eval_shape(lambda: scatterer_template(material, 0, **how)).intensity.shape[-1]


def totals(template):
    """The energy of each template."""
    return np.asarray(template.intensity, np.float64).sum(axis=-1)


# ---------------------------------------------------------------- energy


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
    levels = max(map(PacketTree().levels, OPACITIES))

    @jax.jit
    def all_(opacities):
        def of_key(opacity, key):
            return scatterer_template(Material(opacity, 1.0, INDEX), key, merge=0, levels=levels)

        keys = jax.random.split(jax.random.key(3), (len(OPACITIES), TEMPLATES))
        return jax.lax.map(lambda a: jax.lax.map(lambda key: of_key(a[0], key), a[1]), (opacities, keys))

    return jax.tree.map(np.asarray, all_(np.float32(OPACITIES)))


def test_a_conserving_template_holds_what_the_threshold_leaves(grown):
    for opacity, found in zip(OPACITIES, totals(grown), strict=True):
        allowed = simulated_total(opacity, packets=4, threshold=0.01, index=INDEX)
        assert 0.02 < allowed < 1
        np.testing.assert_allclose(found.mean(), allowed, rtol=0.02, err_msg=str(opacity))
        assert found.max() <= 1 + 1e-6


def test_photons_are_sorted_and_there_are_no_more_than_room_is_made_for(grown):
    assert np.all(np.diff(grown.intensity, axis=-1) <= 0)
    tree = PacketTree()
    for opacity, intensity in zip(OPACITIES, grown.intensity, strict=True):
        most = tree.capacity(tree.levels(opacity), opacity)
        assert np.sum(intensity > 0, axis=-1).max() <= most
    assert grown.intensity.shape[-1] <= capacity(Material(0.05, 1.0))


def test_the_brightest_photons_keep_the_energy_of_all(grown):
    few, most = jax.jit(lambda t: (t.brightest(7), t.brightest(10**6)))(grown)
    assert few.intensity.shape == (len(OPACITIES), TEMPLATES, 7)
    np.testing.assert_allclose(totals(few), totals(grown), rtol=1e-5)
    np.testing.assert_array_equal(few.offset, grown.offset[:, :, :7])
    ratio = np.asarray(few.intensity)[3] / grown.intensity[3, :, :7]
    np.testing.assert_allclose(ratio, np.broadcast_to(ratio[:, :1], ratio.shape), rtol=1e-5)
    assert ratio.min() > 1
    np.testing.assert_allclose(most.intensity, grown.intensity, rtol=1e-5)


def test_a_blend_holds_the_mean_energy_and_all_photons(grown):
    blend = jax.jit(lambda t: t.blended())(grown)
    assert blend.intensity.shape == (len(OPACITIES), TEMPLATES * grown.intensity.shape[-1])
    np.testing.assert_allclose(totals(blend), totals(grown).mean(axis=1), rtol=1e-5)
    assert np.all(np.diff(blend.intensity, axis=-1) <= 0)
    where = np.einsum("mn,mnx->mx", blend.intensity, blend.offset)
    each = np.einsum("mtn,mtnx->mx", grown.intensity, grown.offset)
    np.testing.assert_allclose(where, each / TEMPLATES, atol=1e-4)


def test_the_printed_form_makes_and_loses_energy():
    """At a high index nearly all light is refracted, so that little of it falls below the threshold."""
    tree = PrintedTree(packets=1, threshold=3e-3, flights=False)
    template = jax.jit(lambda opacity: tree.template(Material(opacity, 1.0, 30.0).optics, KEY, 68, 0))
    for opacity in (0.3, 0.5, 0.7, 0.9):
        np.testing.assert_allclose(totals(template(opacity)), opacity / (1 - opacity), rtol=0.02)


# ---------------------------------------------------------------- where packets go

TWO_LEVELS = {"packets": 1, "threshold": 1e-4, "merge": 0, "levels": 2}
"""Photons of such a template at an opacity of a half: the first one, the refracted one, the reflected one."""


def test_first_flights_are_exponential_with_the_mean_free_path():
    """The fraction of flights longer than x is exp(-x/λ)."""
    path, number = 0.7, 200_000

    @jax.jit
    def flown():
        keys, how = jax.random.split(jax.random.key(1), number), {"packets": 1, "levels": 1, "merge": 0}
        return jax.vmap(lambda key: scatterer_template(Material(1.0, path), key, **how).offset)(keys)

    offset = np.asarray(flown())[:, 0]
    length = np.linalg.norm(offset, axis=-1)
    np.testing.assert_allclose(length.mean(), path, rtol=0.01)
    part = (np.arange(number) + 0.5) / number
    assert np.abs(1 - np.exp(-np.sort(length) / path) - part).max() < 2 / np.sqrt(number)
    # and directions are isotropic: each coordinate is uniform
    direction = np.sort(offset / length[:, None], axis=0)
    assert np.abs((direction + 1) / 2 - part[:, None]).max() < 2 / np.sqrt(number)


def test_a_packet_is_refracted_in_the_critical_cone_and_reflected_to_where_it_came_from():
    """Each part's energy is told by the angle of refraction."""
    for index in (INDEX, 1 / INDEX, 10.0):
        found = several(Material(0.5, 2.0, index), 512, **TWO_LEVELS)
        first, second, third = np.asarray(found.offset).transpose(1, 0, 2)
        energy = np.asarray(found.intensity)[:, :3].T
        cone = math.sqrt(1 - min(index, 1 / index) ** 2)

        def cosine(u, v):
            return np.sum(u * v, axis=-1) / np.linalg.norm(u, axis=-1) / np.linalg.norm(v, axis=-1)

        refracted = cosine(first, second - first)
        assert cone - 1e-5 < refracted.min() < cone + 0.01 * (1 - cone) + 1e-3
        assert np.all(cosine(first, third - first) <= 1e-5)
        np.testing.assert_allclose(
            energy, 0.5 * np.array([np.ones(512), refracted / 2, (1 - refracted) / 2]), atol=1e-4
        )


def test_offsets_scale_with_the_mean_free_path_and_intensities_do_not_change():
    one, other = (several(Material(0.5, path, INDEX), 512, **TWO_LEVELS) for path in (1.0, 4.0))
    np.testing.assert_allclose(other.offset, 4 * np.asarray(one.offset), rtol=1e-6)
    np.testing.assert_array_equal(other.intensity, one.intensity)
    assert np.abs(np.diff(np.asarray(one.offset)[:, 0], axis=0)).min() > 0  # each key draws another template


def test_many_templates_are_those_grown_one_by_one():
    both, key = [Material(0.5, 1.0, 1.4), Material(0.8, 0.3, 1.2)], jax.random.key(7)
    how = {"packets": 2, "threshold": 0.02, "levels": 1}
    grown = jax.device_get(eqx.filter_jit(scatterer_templates)(both, key, count=2, **how))
    for m, one in enumerate(both):
        for number in range(2):
            alone = grow(one, jax.random.fold_in(jax.random.fold_in(key, m), number), **how)
            np.testing.assert_allclose(grown.offset[m, number], alone.offset, atol=1e-5)
            np.testing.assert_allclose(grown.intensity[m, number], alone.intensity, atol=1e-6)


# ---------------------------------------------------------------- thresholds, and the paper's numbers


def test_a_threshold_on_levels_gives_the_papers_count():
    """Six levels, of which the last one's brightest possible photon holds 0.5^6: a full tree of 63 photons,
    the most that the paper counts. Merging leaves 56 to 63. Four packets have four levels each, 60 photons:
    at 4 bytes each, the paper's 240 bytes."""
    half, tree = Material(0.5, 1.0, INDEX), PacketTree(packets=1, threshold_on="level")

    @partial(jax.jit, static_argnums=1)
    def grown(number, merge):
        return tree.template(half.optics, jax.random.fold_in(KEY, number), 6, merge).intensity

    whole = np.asarray(grown(0, 0))
    assert np.sum(whole > 0) == 63
    assert whole.min() < 0.01 < 0.5**6
    np.testing.assert_allclose(whole.sum(), 1 - 0.5**6, rtol=1e-5)  # the rest goes on
    counts = np.array([np.sum(np.asarray(grown(number, 0.01)) > 0) for number in range(8)])
    assert 56 <= counts.min() < 63
    assert counts.max() <= 63
    # at a threshold just above a level's brightest possible photon, that level is left out
    for threshold, photons in ((0.01, 63), (0.0157, 31)):
        tree = PacketTree(1, threshold, "level")
        assert tree.capacity(tree.levels(0.5)) == photons
    assert capacity(half, packets=1) == 63
    assert capacity(half, threshold_on="level") == 60


def test_whole_levels_are_those_of_each_material_and_depend_on_nothing_traced():
    """Each level k holds α (1 - α)^k, whatever is refracted."""
    opacities, levels = (0.5, 0.7), (4, 3)

    def totals_of(opacities):
        materials = [Material(opacity, 1.0, INDEX) for opacity in opacities]
        return scatterer_templates(materials, 0, count=1, threshold_on="level", levels=levels).intensity.sum(
            -1
        )

    assert PacketTree(threshold_on="level").levels_of([Material(a, 1.0) for a in opacities], None) == levels
    found, slopes = jax.device_get(
        jax.jit(lambda a: (totals_of(a), jax.jacfwd(totals_of)(a)))(np.float32(opacities))
    )
    for i, (opacity, number) in enumerate(zip(opacities, levels, strict=True)):
        np.testing.assert_allclose(found[i, 0], 1 - (1 - opacity) ** number, rtol=1e-5)
        np.testing.assert_allclose(slopes[i, 0, i], number * (1 - opacity) ** (number - 1), rtol=1e-4)


def test_merging_makes_the_papers_brightest_photon():
    """Table 1: 0.72760 = 0.5 + 0.2276, a photon of the first level, of α, and the refracted one of the second
    that landed near it, of α (1 - α) cos θ'. The cosines in the paper's tables are 0.88 to 0.92."""
    half = Material(0.5, 1.0, INDEX)
    apart = several(half, 512, **TWO_LEVELS).intensity
    near = np.asarray(several(half, 512, **TWO_LEVELS | {"merge": 0.1}).intensity)
    np.testing.assert_allclose(near.sum(-1), np.asarray(apart).sum(-1), rtol=1e-5)
    merged = near[:, 0] > 1.01 * 0.5
    assert 0.05 < merged.mean() < 0.5
    cosines = (near[merged, 0] - 0.5) / 0.25
    paper = (0.72760 - 0.5) / 0.25
    assert np.any(np.abs(cosines - paper) < 0.01)
    assert 0.88 < paper < 0.92


def photons(*each):
    """A template of photons (offset, intensity)."""
    offset, intensity = zip(*each, strict=True)
    return ScattererTemplate(jax.device_put(np.float32(offset)), jax.device_put(np.float32(intensity)))


def test_photons_that_coincide_add_also_by_way_of_others():
    add = jax.jit(lambda each: each.clustered(0.01).intensity)
    two = photons(((1, 0, 0), 0.4), ((0, 2, 0), 0.3), ((1, 0, 0.005), 0.2), ((1, 0, 0), 0.05))
    np.testing.assert_allclose(add(two), [0.65, 0.3, 0, 0], atol=1e-7)
    chain = photons(((0, 0, 0), 0.4), ((0.008, 0, 0), 0.3), ((0.016, 0, 0), 0.2), ((0, 1, 0), 0.1))
    np.testing.assert_allclose(add(chain), [0.9, 0.1, 0, 0], atol=1e-7)


def test_lighting_scales_templates_to_the_energy_of_all():
    sun = DirectionalLight((0, 0, 1))
    lighting = ScattererTemplates(Material(0.5, 1.0, INDEX), sun, photons=7, packets=1, templates=1)
    found = jax.jit(lambda: lighting.simulated())().intensity
    assert found.shape == (1, 1, 7)
    np.testing.assert_allclose(np.sum(np.asarray(found)), 1, rtol=1e-5)


def test_where_an_opacity_is_traced_a_template_that_keeps_nothing_is_nan():
    for opacity, nothing in ((0.0, True), (0.031, True), (0.05, False)):
        found = np.isnan(grow(Material(opacity, 1.0), KEY, levels=1).intensity)
        assert found.all() == found.any() == nothing


# ---------------------------------------------------------------- gradients


def test_gradients_match_central_differences_and_photons_do_not_appear_at_once():
    """Photons fade out at the threshold, so that sums over them are smooth; at least one fades here."""
    with in_float64():

        @jax.jit
        @jax.value_and_grad
        def seen(numbers):
            template = scatterer_template(Material(*numbers), 0, packets=2, threshold=0.11, levels=2, merge=0)
            waves = jnp.sin(template.offset @ jnp.asarray([0.7, -1.1, 0.4]) + 0.3)
            return jnp.sum(template.intensity * waves)

        at = np.array([0.4, 0.8, 1.3])
        slope = np.asarray(seen(at)[1])
        for i, name in enumerate(("opacity", "mean_free_path", "refractive_index")):
            h = 1e-6 * np.eye(3)[i]
            difference = (float(seen(at + h)[0]) - float(seen(at - h)[0])) / 2e-6
            assert abs(difference) > 1e-4, name
            np.testing.assert_allclose(slope[i], difference, rtol=1e-6, err_msg=name)

        # over a range of opacities in which photons appear: were it at once, a slope would be missing
        way = np.linspace(0.2, 0.6, 401)
        ends = [float(seen(np.array([way[i], *at[1:]]))[0]) for i in (0, -1)]
        slopes = [np.asarray(seen(np.array([a, *at[1:]]))[1])[0] for a in (way[1:] + way[:-1]) / 2]
        np.testing.assert_allclose(np.mean(slopes) * 0.4, ends[1] - ends[0], rtol=1e-3)
        # where the critical angle has no derivative, it is 0
        assert np.asarray(seen(np.array([0.4, 0.8, 1.0]))[1])[2] == 0


def test_a_material_that_takes_its_opacity_from_the_transfer_function_has_its_gradient():
    """The paper's T(d), as the docstring of `Material` has it; against central differences."""
    with in_float64():

        @jax.jit
        @jax.value_and_grad
        def seen(extinction):
            transfer, path = jv.TransferFunction((0.0, 1.0, 2.0), np.ones((3, 3)), extinction), 0.8
            material = Material(-jnp.expm1(-transfer(jnp.asarray(0.7))[1] * path), path, 1.3)
            template = scatterer_template(material, 0, packets=2, threshold=0.11, levels=2, merge=0)
            waves = jnp.sin(template.offset @ jnp.asarray([0.7, -1.1, 0.4]) + 0.3)
            return material.optics.reflectance * jnp.sum(template.intensity * waves)

        at, step = np.array([0.4, 0.9, 3.0]), 1e-6
        slope = np.asarray(seen(at)[1])
        for h in step * np.eye(3):
            difference = (float(seen(at + h)[0]) - float(seen(at - h)[0])) / (2 * step)
            np.testing.assert_allclose(slope @ h / step, difference, rtol=1e-5, atol=1e-9)
        assert np.abs(slope[:2]).min() > 1e-3
        assert slope[2] == 0  # 0.7 lies between the first two points


# ---------------------------------------------------------------- materials


def test_a_mean_free_path_follows_from_how_many_scatterers_there_are():
    """Maxwell's: air at 0 °C, 2.69e25 molecules a cubic metre of 0.37 nm diameter, has 61 nm."""
    section = math.pi * 0.37e-9**2
    np.testing.assert_allclose(mean_free_path(2.69e25, section), 61e-9, rtol=0.01)
    for density, section in ((-1.0, 1.0), (1.0, 0.0), (np.nan, 1.0)):
        with pytest.raises(ValueError, match="must be"):
            mean_free_path(density, section)


def test_templates_take_no_memory_to_speak_of():
    several = [Material(opacity, 1.0) for opacity in (0.5, 0.6, 0.8, 0.5)]
    grown = jax.eval_shape(lambda: scatterer_templates(several, 0, count=8))
    assert grown.intensity.shape[:2] == (4, 8)
    assert sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(grown)) < 64 * 1024
