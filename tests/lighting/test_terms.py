"""The loop over the terms of many samples: it ends early, and this does not show."""

from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.lighting import (
    ConstantLight,
    DirectionalLight,
    Material,
    ScattererTemplate,
    ScattererTemplates,
)
from jaxvol.lighting.shading import (
    TOGETHER,
    Sample,
    Shader,
    Shading,
    Surroundings,
    shade_sample,
    terms_above,
)
from jaxvol.space import Affine

from ..scenes import scaled_phantom, slow, soft_transfer


FLESH = Material(0.5, 0.15, 1.4)
LIGHTS = DirectionalLight((0.6, 0.8, -1.0)), ConstantLight()
INTENSITY = [[0.2, 0.5, 0.1, 0.0, 0.0], [0.3, 0.4, 0.15, 0.05, 0.0]]
"""Of two templates, which are not sorted, and have room for a photon that neither holds."""
TEMPLATES = ScattererTemplate(
    jnp.asarray(np.random.default_rng(0).normal(0, 0.15, (1, 2, 5, 3)), jnp.float32),
    jnp.asarray([INTENSITY], jnp.float32),
)


def templates(**how):
    return ScattererTemplates(FLESH, LIGHTS, reach=(2.0,), **{"given": TEMPLATES, **how})


@cache
def surroundings():
    volume = scaled_phantom("sphere", 12)
    return Surroundings(volume, soft_transfer(0.1), Affine(volume))


def shader_of(lighting):
    around = surroundings()
    return Shader(lighting.shading(around), around)


def samples_in(around, transmittance):
    """Samples in the sphere, one for each transmittance."""
    count = len(transmittance)
    low, high = (np.asarray(end) for end in around.volume.corners)
    points = np.random.default_rng(1).uniform(0.3, 0.7, (count, 3)) * (high - low) + low
    classification = around.transfer.classification(around.volume)

    def one(point, transmittance, number):
        point = apart(point)
        measured = classification.at(around.space.coordinate(point))
        direction = apart(jnp.asarray([0.0, 0.0, 1.0]))
        color, extinction = classification.classify(measured)
        return Sample(point, direction, measured, color, extinction, transmittance, (number, 3 * number))

    numbers = jnp.arange(count)
    return jax.vmap(one)(jnp.asarray(points, jnp.float32), jnp.asarray(transmittance, jnp.float32), numbers)


class Counting(Shading):
    """Terms of 1 each, one more than are computed together, of which samples behind less than half of the
    light need two."""

    @property
    def terms(self):
        return TOGETHER + 1

    def thresholds(self, *, derivative=False):
        return jnp.where(jnp.arange(self.terms) < 2, 0, 0.5)

    def about(self, around, sample):
        return None

    def term(self, around, sample, shared, number):
        return jnp.ones_like(sample.extinction)

    def color(self, sample, shared, sums):
        return sums, sums, sums


@pytest.mark.parametrize(("transmittance", "expected"), [((0.1, 0.4), 5), ((0.1, 0.6), 9)])
def test_the_loop_ends_where_none_of_the_samples_needs_more(transmittance, expected):
    """After a whole group of terms, the first 5; the other group has 4, and is not filled up with a term that
    there is not."""
    assert Counting().terms == 9
    around = surroundings()
    found = jax.jit(lambda samples: Shader(Counting(), around)(samples))(samples_in(around, transmittance))
    np.testing.assert_array_equal(found[0], [expected] * 2)


def test_the_photons_that_are_needed_are_those_above_the_cutoff():
    """The last one is needed that is bright enough in any template, and all before it."""
    cut, all_ = (shader_of(templates(cutoff=cutoff)).shading for cutoff in (0.03, 0.0))
    for transmittance, expected in ((1, 4), (0.5, 3), (0.1, 2), (0.05, 0)):
        several = jnp.asarray([0, transmittance], jnp.float32)
        assert terms_above(cut.thresholds(), several) == expected, transmittance
        assert terms_above(all_.thresholds(), several) == 4
        # as these intensities may be differentiated
        assert terms_above(all_.thresholds(derivative=True), several) == 5
    assert terms_above(cut.thresholds(), jnp.asarray([0, jnp.nan])) == 5
    blend = shader_of(templates(cutoff=0.03, blend=True)).shading
    # blended, each holds half of its intensity, and is skipped as it would be alone
    needed = [int(terms_above(blend.thresholds(), jnp.asarray([float(t)]))) for t in (1, 0.5, 0.1, 0.05)]
    assert needed == [7, 6, 3, 0]


@pytest.mark.parametrize("occlusion", ["hard", *slow("soft")])
def test_samples_shaded_together_are_shaded_as_each_alone(occlusion):
    """In groups that need all photons, some of them, and none."""
    for bright in (1.0, 0.3, 0.1, 0.05):
        shader = shader_of(templates(occlusion=occlusion, cutoff=0.03))
        samples = samples_in(shader.around, bright * np.linspace(0.2, 1, 32))
        together = jax.jit(lambda s, of=shader: of(s))(samples)
        alone = jax.jit(jax.vmap(lambda s, of=shader: shade_sample(of.shading, of.around, s)))(samples)
        np.testing.assert_allclose(together, alone, atol=1e-6)
        assert (np.max(together) > 0.01) == (bright > 0.05)


def test_derivatives_of_samples_shaded_together_are_those_of_each_alone():
    """Those by intensities of 0, too: the loop leaves such photons out, the derivative does not."""
    samples = samples_in(surroundings(), np.linspace(0.2, 1, 32))

    def seen(intensity, samples, *, together):
        given = eqx.tree_at(lambda t: t.intensity, TEMPLATES, intensity)
        shader = shader_of(templates(given=given))
        each = jax.vmap(lambda s: shade_sample(shader.shading, shader.around, s))
        return jnp.sum(jnp.stack((shader if together else each)(samples)) ** 2)

    def derivatives(together):
        of = partial(seen, together=together)
        reverse = jax.jit(jax.grad(of))(TEMPLATES.intensity, samples)
        ahead = jax.jit(lambda t: jax.jvp(lambda i: of(i, samples), (TEMPLATES.intensity,), (t,))[1])
        return reverse, ahead(jnp.ones_like(TEMPLATES.intensity))

    (reverse, ahead), (expected, expected_ahead) = derivatives(True), derivatives(False)
    np.testing.assert_allclose(reverse, expected, rtol=1e-5)
    np.testing.assert_allclose(ahead, expected_ahead, rtol=1e-5)
    assert np.all(reverse[..., -1] != 0)


# ---------------------------------------------------------------- which template


def lit(lighting, points=64):
    shader = shader_of(lighting)
    return np.stack(jax.jit(lambda s: shader(s))(samples_in(shader.around, np.ones(points))), axis=-1)


@pytest.mark.slow
def test_one_template_for_a_material_is_the_first_for_all_pixels():
    first = jax.tree.map(lambda leaf: leaf[:, :1], TEMPLATES)
    for_material, alone, for_pixel = (
        lit(templates(**how)) for how in ({"choice": "material"}, {"given": first}, {})
    )
    np.testing.assert_array_equal(for_material, alone)
    same = np.isclose(for_pixel, alone, rtol=1e-5).all(-1)
    assert 0.2 < same.mean() < 0.8  # the other one is as likely


def test_the_template_of_a_material_does_not_depend_on_their_number():
    def grown(**how):
        lighting = ScattererTemplates(FLESH, LIGHTS, packets=2, levels=2, **how)
        return jax.jit(lambda: lighting.grown(blend=lighting.blend))()

    one, chosen, blended = (
        grown(**how)
        for how in ({"templates": 1}, {"choice": "material"}, {"choice": "material", "blend": True})
    )
    np.testing.assert_array_equal(one.offset, chosen.offset)
    assert blended.intensity.shape[-1] == 8 * one.intensity.shape[-1]


def test_a_choice_that_is_none_is_named():
    with pytest.raises(ValueError, match="choice must be one of pixel, material; got 'sample'"):
        ScattererTemplates(FLESH, LIGHTS, choice="sample")


def test_an_image_by_one_template_for_a_material_is_not_noisy():
    """On the flat face of a cube."""
    volume = jv.phantom("constant", 8)
    transfer = jv.TransferFunction([0.0, 1.0], [[0.7, 0.5, 0.4]] * 2, [40.0, 40.0])
    camera = jv.Camera.looking_at(volume, (0, -1, 0), size=(12, 12)).zoom(6)
    march = jv.March(0.02, (jv.AlphaCorrection(), jv.EarlyTermination()))
    deviations = []
    for choice in ("pixel", "material"):
        lighting = templates(choice=choice)
        image = np.asarray(jv.render(volume, transfer, camera, march, lighting=lighting).rgba[..., 0])
        deviations.append(image.std() / image.mean())
    assert deviations[1] < 0.01 < 0.1 < deviations[0]
