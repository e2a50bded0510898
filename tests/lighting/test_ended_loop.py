"""Ending the loop over photons shows neither in an image nor in its gradient, at default settings: 8-bit
voxels, empty space, more than one tile."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.engine import shading_gradient
from jaxvol.engine.driver import render_scene
from jaxvol.engine.scene import Scene
from jaxvol.engine.tiling import Tiling
from jaxvol.lighting import ConstantLight, DirectionalLight, Material, ScattererTemplates, shading


LIGHTS = DirectionalLight((0.9, 0.7, -0.6), (50.0, 50.0, 50.0)), ConstantLight((1.3, 1.3, 1.3))
SKIN = [(40, (0.1, 0.04, 0.03), 0.0), (78, (0.85, 0.5, 0.35), 0.9), (255, (1.0, 1.0, 1.0), 0.95)]
WEIGHTS = np.random.default_rng(0).normal(size=(18, 24, 4))
TILING = Tiling(tile=4, batch=20, chunk=256)


def scene_of(lighting):
    volume = jv.phantom("head", 32)
    assert volume.data.dtype == np.uint8
    transfer = jv.TransferFunction.from_points(SKIN, unit_distance=0.05)
    camera = jv.Camera.looking_at(volume, (0.65, -1, 0.15), size=(24, 18)).zoom(1.5)
    transforms = jv.EmptySpaceJitter(0), jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination()
    return Scene(volume, transfer, camera, jv.March(0.03, transforms), lighting=lighting)


def image_and_gradient(lighting, adjoint="replay"):
    """The image, and the gradients of a loss by material, lights, transfer function and camera."""
    scene = scene_of(lighting)

    def loss(leaves):
        lighting, transfer, camera = leaves
        moved = scene._replace(lighting=lighting, transfer=transfer, source=camera)
        rgba = render_scene(moved, "all", adjoint, TILING).rgba
        return jnp.sum(rgba * WEIGHTS), rgba

    program = eqx.filter_jit(eqx.filter_value_and_grad(loss, has_aux=True))
    (_, image), gradient = program((lighting, scene.transfer, scene.source))
    return np.asarray(image), gradient


def same(found, expected, error):
    """Gradients agree within this fraction of each one's norm."""
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=error * np.linalg.norm(b) + 1e-12)


def all_terms(thresholds, transmittance):
    return jnp.asarray(thresholds.shape[0], jnp.int32)


@pytest.mark.slow
@pytest.mark.parametrize("how", [{"occlusion": "hard"}, {"cutoff": 0.02, "choice": "material"}])
def test_the_end_of_the_loop_over_photons_does_not_show(how, monkeypatch):
    lighting = ScattererTemplates(Material(0.5, 0.05, 1.4), LIGHTS, **how)
    ended = image_and_gradient(lighting)
    for module in (shading, shading_gradient):
        monkeypatch.setattr(module, "terms_above", all_terms)
    jax.clear_caches()
    whole = image_and_gradient(lighting)
    assert whole[0][..., :3].max() > 0.1
    np.testing.assert_allclose(ended[0], whole[0], atol=1e-6)
    same(ended[1], whole[1], 1e-5)


@pytest.mark.slow
def test_the_gradient_of_an_image_by_templates_is_that_of_the_reference():
    """But for the extinction that is 0: what is invisible is not lit, and its gradient lacks the light."""
    lighting = ScattererTemplates(Material(0.5, 0.05, 1.4), LIGHTS)
    (image, gradient), (expected_image, expected) = (
        image_and_gradient(lighting, adjoint) for adjoint in ("replay", "direct")
    )
    np.testing.assert_allclose(image, expected_image, atol=2e-5)
    visible = jnp.asarray([False, True, True])
    found, expected = (
        eqx.tree_at(lambda g: g[1].extinction, g, replace_fn=lambda e: jnp.where(visible, e, 0))
        for g in (gradient, expected)
    )
    same(found, expected, 1e-3)
