"""Are samples shaded as a lighting says: in groups, in images, once per ray; and with which gradient?

By a lighting with all that the interface has, which compiles in less time than those that users have.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol._util.vec3 import along, apart, plus, scaled
from jaxvol.lighting import (
    ConstantLight,
    DirectionalLight,
    Material,
    ScattererTemplate,
    ScattererTemplates,
    Shading,
)
from jaxvol.lighting.shading import TERMS_AT_ONCE, Shader, terms_needed

from ..scenes import around, scaled_phantom, slow, soft_transfer
from .samples import image_of_reference, program, sample_at, shaded, surroundings


class Fog(Shading):
    """What lies at nine places toward the light weakens it, and adds its colour, the less of it the less is
    seen of the sample."""

    toward: Any
    density: Any

    @property
    def terms(self):
        return TERMS_AT_ONCE + 1

    @property
    def skips_hidden(self):
        return True

    def thresholds(self):
        return 0.05 + jnp.arange(self.terms) / 20

    def begin(self, around, sample):
        return plus(apart(self.toward), scaled(sample.direction, -0.02 * jnp.ones_like(sample.extinction)))

    def term(self, around, sample, shared, number) -> Any:
        weight = jnp.maximum(sample.transmittance - self.thresholds()[number], 0) ** 2
        point = along(sample.point, shared, 1 + number.astype(weight.dtype))
        read = around.measured(point)
        color, _ = around.classification.classify(read)
        return weight * around.classified(point, read).extinction, scaled(color, weight)

    def color(self, sample, shared, sums):
        depth, inner = sums
        return plus(scaled(sample.color, jnp.exp(-self.density * depth)), scaled(inner, depth / 5))


# ---------------------------------------------------------------- images

LEAPING = jv.EmptySpaceJitter(4), jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination(0.05)
FOG = Fog(*jax.device_put((np.float32([0.03, 0.06, 0.05]), np.float32(0.7))))


def scene_of():
    """With empty space that is leapt over, and samples behind little transmittance."""
    volume = scaled_phantom("sphere")
    return volume, soft_transfer(0.1), around(volume), jv.March(0.07, LEAPING)


@pytest.mark.slow
def test_images_are_those_of_the_reference():
    scene = scene_of()
    found = np.asarray(jv.render(*scene, lighting=FOG).rgba)
    opacity = found[..., 3]
    assert np.mean(opacity == 0) > 0.2
    assert np.sum(opacity > 0.9) > 5  # their last samples are dark
    np.testing.assert_allclose(found, image_of_reference(*scene, FOG), atol=2e-5)


def test_there_is_a_gradient_of_a_lit_image():
    """Its values are checked by slow tests, here and of templates, since it takes a minute to compile."""

    def loss(scene):
        return jnp.sum(jv.render(*scene[:4], lighting=scene[4]).rgba)

    scene = (*scene_of(), FOG)
    gradient = eqx.filter_eval_shape(eqx.filter_grad(loss), scene)
    expected = eqx.filter(scene, eqx.is_inexact_array)
    assert jax.tree.map(jnp.shape, gradient) == jax.tree.map(jnp.shape, expected)


LEAVES = {
    "direction of the light": lambda s: s[4].lighting.toward,
    "density": lambda s: s[4].lighting.density,
    "colors": lambda s: s[1].colors,
    "extinction": lambda s: s[1].extinction,
    "voxels": lambda s: s[0].data,
    "position": lambda s: s[2].position,
    "step": lambda s: s[3].step,
}


# ---------------------------------------------------------------- many samples together

RANDOM = np.random.default_rng(0)
OFFSETS = RANDOM.normal(0, 0.15, (1, 2, 11, 3))
INTENSITIES = np.append(RANDOM.uniform(0.02, 0.5, (1, 2, 10)), np.zeros((1, 2, 1)), axis=-1)
PHOTONS = ScattererTemplate(*jax.device_put((np.float32(OFFSETS), np.float32(INTENSITIES))))
"""Two templates, which are not sorted, with room for a photon that neither holds."""


def templates(cutoff, **how):
    lights = DirectionalLight((0.6, 0.8, -1.0)), ConstantLight()
    how = {"reach": (), "given": PHOTONS, **how}
    return ScattererTemplates(Material(0.5, 0.15, 1.4), lights, cutoff=cutoff, **how)


def inside(volume, count=32):
    """Points inside the sphere, and a pixel for each."""
    low, high = (np.asarray(end) for end in volume.corners)
    points = np.random.default_rng(1).uniform(0.3, 0.7, (count, 3)) * (high - low) + low
    return points.astype(np.float32), np.arange(2 * count, dtype=np.int32).reshape(-1, 2)


@pytest.mark.parametrize("occlusion", ["hard", *slow("soft")])
def test_samples_shaded_together_are_shaded_as_each_alone(occlusion):
    """In groups that need all photons, some of them, and none."""
    volume, lighting = scaled_phantom("sphere"), templates(0.03, occlusion=occlusion)
    points, pixels = inside(volume)

    @jax.jit
    def both(transmittance):
        rest = volume, soft_transfer(0.1), points, transmittance, pixels
        return [shaded(lighting, *rest, together=together) for together in (True, False)]

    for bright in (1.0, 0.3, 0.1, 0.05):
        found, expected = map(np.asarray, both(np.float32(bright * np.linspace(0.2, 1, 32))))
        np.testing.assert_allclose(found, expected, atol=1e-6)
        assert (np.max(found) > 0.01) == (bright > 0.05)


class InPlace(Shading):
    """Shades all samples in place, so that it is not told their extinction, which it uses."""

    @property
    def terms(self):
        return 1

    @property
    def reads_gradient(self):
        return True

    @property
    def farthest_read(self):
        return 0.0

    def term(self, around, sample, shared, number):
        return sample.extinction

    def color(self, sample, shared, sums) -> Any:
        return scaled(sample.color, sums)


class Stacked(InPlace):
    """Answers with what is no colour."""

    def color(self, sample, shared, sums) -> Any:
        return jnp.stack(sample.color)


def test_wrong_answers_are_named_and_what_is_not_told_is_nan():
    volume, transfer, camera, march = scene_of()
    with pytest.raises(ValueError, match=r"Stacked.color must return .*; got "):
        jax.eval_shape(lambda: jv.render(volume, transfer, camera, march, lighting=Stacked()))

    def alone(lighting):
        shader = Shader.of(lighting, surroundings(volume, transfer))
        pixel = jnp.zeros(2, jnp.int32)
        return shader(sample_at(shader.around, jnp.asarray(volume.center), jnp.ones(()), pixel))

    with pytest.raises(ValueError, match=r"Stacked.color must return .*; got "):
        jax.eval_shape(lambda: alone(Stacked()))
    assert np.isnan(jax.jit(lambda: alone(InPlace()))()).all()


class CountedTerms(Shading):
    """Terms of 1 each, as many as of a fog."""

    @property
    def terms(self):
        return FOG.terms

    def thresholds(self):
        return FOG.thresholds()

    def term(self, around, sample, shared, number):
        return jnp.ones_like(sample.extinction)

    def color(self, sample, shared, sums):
        return sums, sums, sums


def test_the_loop_ends_where_none_of_the_samples_needs_more():
    """Of nine terms, which are computed by five and four: the second group is not filled up."""
    volume, transfer = scaled_phantom("sphere"), soft_transfer(0.1)
    points, pixels = inside(volume)
    for most, expected in ((0.04, 0), (0.06, 5), (0.24, 5), (0.33, 9), (np.nan, 9)):
        transmittance = np.linspace(0, most, 32, dtype=np.float32)
        found = program(CountedTerms(), volume, transfer, points, transmittance, pixels, together=True)
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("blend", [False, True])
def test_the_photons_that_are_needed_are_those_above_the_cutoff(blend):
    """The last one that is bright enough in any template, and all before it. Blended, each holds half of its
    intensity, and is skipped as it would be alone."""
    volume = scaled_phantom("sphere")

    @eqx.filter_jit
    def needed(lighting, transmittance):
        shading = lighting.for_image(surroundings(volume, soft_transfer()))
        return terms_needed(shading, transmittance), shading.templates.intensity

    for transmittance in (1.0, 0.5, 0.1, 0.05):
        several = np.float32([0, transmittance])
        count, intensity = needed(templates(0.03, blend=blend), several)
        shown = transmittance * np.asarray(intensity) * (2 if blend else 1) >= 0.03
        assert int(count) == max(np.nonzero(shown)[-1], default=-1) + 1
    every = PHOTONS.intensity.size if blend else 11
    assert int(needed(templates(0.03, blend=blend), np.float32([0, np.nan]))[0]) == every
    if not blend:  # not the one of intensity 0
        assert int(needed(templates(0.0), several)[0]) == 10
