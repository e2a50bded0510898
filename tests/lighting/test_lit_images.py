"""Are images by scatterer templates those of the reference engine, and their gradients right? All slow: in
fast tests, templates light samples without an image, and images are lit in a way that compiles in less
time."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.engine.image import render_scene
from jaxvol.engine.tiling import Tiling
from jaxvol.lighting import (
    ConstantLight,
    DirectionalLight,
    Material,
    PointLight,
    ScattererTemplates,
)
from jaxvol.ray import Scene

from ..scenes import anisotropic_noise, in_float64, soft_transfer
from .samples import check_gradient, in_double


pytestmark = pytest.mark.slow

LIGHTS = (
    DirectionalLight((0.6, 0.8, -1.0), (14.0, 13.0, 11.0)),
    PointLight((0.9, -1.2, 1.4), (16.0, 16.0, 32.0)),
    ConstantLight((1.6, 2.4, 3.2)),
)
MATERIALS = Material(0.5, 0.15, 1.4, values=(0.0, 0.5)), Material(0.8, 0.1, 1.5, values=(0.5, 2.0))


LABELLED = Material(0.5, 0.15, 1.4, label=1), Material(0.8, 0.1, 1.5, label=2)


LEAVES = {
    "opacity": lambda s: s[4].materials[0].opacity,
    "mean free path": lambda s: s[4].materials[0].mean_free_path,
    "other refractive index": lambda s: s[4].materials[1].refractive_index,
    "direction": lambda s: s[4].lights[0].direction,
    "light's position": lambda s: s[4].lights[1].position,
    "radiance": lambda s: s[4].lights[2].radiance,
    "colors": lambda s: s[1].colors,
    "extinction": lambda s: s[1].extinction,
    "voxels": lambda s: s[0].data,
    "spacing": lambda s: s[0].spacing,
    "position": lambda s: s[2].position,
    "step": lambda s: s[3].step,
}


@pytest.mark.parametrize("colors", [False, True])
def test_gradients_match_central_differences(colors):
    """Of all inputs, through the growth of the templates; of a small volume, since a piecewise linear field
    has many kinks. Of a volume of values, and of one of colours with labels."""
    with in_float64():
        noise, transfer = anisotropic_noise(), soft_transfer()
        volume = jv.Volume(np.asarray(noise.data)[:6, :5, :7], (0.3, 0.4, 0.25), (-0.5, 0.2, 0.1))
        transfer = jv.TransferFunction(
            transfer.values, transfer.colors, np.asarray(transfer.extinction) + 0.1
        )
        camera = jv.Camera((1.9, -1.3, 1.7), np.asarray(volume.center), (0.1, 0, 1), 40.0, size=(6, 5))
        march = jv.March(0.21, (jv.AlphaCorrection(),), "midpoint")
        how: Any = {"templates": 2, "packets": 2, "photons": 4, "reach": (2.0,), "seed": 5}
        materials, leaves = MATERIALS, LEAVES
        if colors:
            data = np.random.default_rng(2).uniform(0.2, 0.9, (*volume.shape, 4))
            labels = np.random.default_rng(3).integers(0, 3, volume.shape, np.uint8)
            volume = jv.Volume(data, volume.spacing, volume.origin, labels=labels)
            materials, transfer = LABELLED, jv.RadianceField(2.0)
            leaves = {name: of for name, of in LEAVES.items() if name not in ("colors", "extinction")}
            leaves["scale"] = lambda s: s[1].scale
        scene = in_double((volume, transfer, camera, march, ScattererTemplates(materials, LIGHTS, **how)))
        weights = jnp.asarray(np.random.default_rng(5).normal(size=(5, 6, 4)))

        def loss(scene):
            return jnp.sum(jv.render(*scene[:4], lighting=scene[4]).rgba * weights)

        program = eqx.filter_jit(eqx.filter_value_and_grad(loss))
        check_gradient(program, scene, leaves, step=2e-8, rtol=1e-5, atol=1e-6, least=1e-5)


def test_the_gradient_at_default_settings_is_that_of_the_reference():
    """8-bit voxels, empty space, more than one tile, and all photons of the default templates."""
    volume = jv.phantom("head", 32)
    assert volume.data.dtype == np.uint8
    skin = [(40, (0.1, 0.04, 0.03), 0.0), (78, (0.85, 0.5, 0.35), 0.9), (255, (1.0, 1.0, 1.0), 0.95)]
    transfer = jv.TransferFunction.from_points(skin, unit_distance=0.05)
    camera = jv.Camera.looking_at(volume, (0.65, -1, 0.15), size=(20, 16)).zoom(1.5)
    transforms = jv.EmptySpaceJitter(0), jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination()
    lights = DirectionalLight((0.9, 0.7, -0.6), (50.0, 50.0, 50.0)), ConstantLight((1.3, 1.3, 1.3))
    lighting = ScattererTemplates(Material(0.5, 0.05, 1.4), lights)
    weights = np.random.default_rng(0).normal(size=(16, 20, 4))

    def loss(leaves, adjoint):
        lighting, transfer, camera = leaves
        scene = Scene(volume, transfer, camera, jv.March(0.03, transforms), lighting=lighting)
        rgba = render_scene(scene, "all", adjoint, Tiling(tile=4, batch=20, chunk=256)).rgba
        return jnp.sum(rgba * weights), rgba

    (gradient, image), (expected, expected_image) = (
        eqx.filter_jit(eqx.filter_grad(loss, has_aux=True))((lighting, transfer, camera), adjoint)
        for adjoint in ("replay", "direct")
    )
    np.testing.assert_allclose(image, expected_image, atol=2e-5)
    # what is invisible is not lit, so that the gradient by an extinction of 0 lacks the light
    visible = jnp.asarray([False, True, True])
    gradient, expected = (
        eqx.tree_at(lambda g: g[1].extinction, g, replace_fn=lambda e: jnp.where(visible, e, 0))
        for g in (gradient, expected)
    )
    for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-3 * float(np.linalg.norm(b)) + 1e-12)
