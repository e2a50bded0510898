"""Is light on a grid that of the samples, computed once for what stays the same, and without a gradient?"""

from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.lighting import (
    ConstantLight,
    DirectionalLight,
    Material,
    ScattererTemplate,
    ScattererTemplates,
    template_lighting,
)
from jaxvol.lighting.baked import BakedLighting
from jaxvol.lighting.template_lighting import with_baked_light

from ..scenes import around, scaled_phantom, soft_transfer
from .samples import colors_of, program


NODES = 37
SUN = DirectionalLight((0, 0, -1.0))
MARCH = jv.March(0.1, (jv.AlphaCorrection(),))
TRANSFER = jv.TransferFunction([0.0, 0.5, 1.0], np.full((3, 3), 0.7), [0.0, 0.0, 4.0])
RANDOM = np.random.default_rng(0)
PHOTONS = ScattererTemplate(
    jnp.asarray(RANDOM.normal(0, 0.12, (1, 2, 4, 3)), jnp.float32),
    jnp.asarray(RANDOM.uniform(0.1, 0.4, (1, 2, 4)), jnp.float32),
)


def ball():
    x = np.linspace(-1, 1, 24)
    x, y, z = np.meshgrid(x, x, x, indexing="ij")
    return jv.Volume((x**2 + y**2 + z**2 < 0.6**2).astype(np.float32), (2 / 23,) * 3, (-1, -1, -1))


DAY = SUN, ConstantLight((0.3, 0.3, 0.3))


def templates(light: Any = DAY, path=0.12, **how):
    return ScattererTemplates(Material(0.5, path, 1.3), light, **{"given": PHOTONS, "reach": (), **how})


def on_the_ball():
    toward = RANDOM.normal(size=(64, 3))
    return 0.57 * toward / np.linalg.norm(toward, axis=1, keepdims=True)


def test_baked_light_is_that_of_all_templates_blended_and_has_no_gradient():
    volume, points = ball(), on_the_ball()
    exact = colors_of(templates(blend=True), volume, TRANSFER, points)
    ready = with_baked_light(templates(baked=NODES), volume, TRANSFER, MARCH)
    assert isinstance(ready, BakedLighting)
    assert ready.shape == (NODES,) * 3
    assert np.abs(colors_of(ready, volume, TRANSFER, points) - exact).mean() < 0.05 * exact.mean()
    at = jnp.asarray(points, jnp.float32)
    slope = eqx.filter_grad(lambda light: jnp.sum(program(light, volume, TRANSFER, at)))(ready)
    assert np.all(slope.highest == 0)


def test_light_that_was_baked_inside_a_program_serves_outside():
    volume, lighting = ball(), templates(baked=NODES)

    def prepared():
        return jax.tree.leaves(with_baked_light(lighting, volume, TRANSFER, MARCH))

    jax.eval_shape(lambda x: (prepared(), x)[1], 0.0)
    assert not any(isinstance(leaf, jax.core.Tracer) for leaf in prepared())


def test_light_is_baked_once_for_what_stays_the_same(monkeypatch):
    volume, calls = ball(), []

    def baked(lighting, around):
        calls.append(lighting)
        return BakedLighting(jnp.zeros(8, jnp.uint32), jnp.zeros(3), (2, 2, 2))

    monkeypatch.setattr(template_lighting, "_baked", baked)

    def prepared(volume=volume, transfer=TRANSFER, light=SUN, path=0.12, step=0.1):
        return with_baked_light(templates(light, path, baked=9), volume, transfer, jv.March(step))

    first = prepared()
    assert prepared() is first
    assert prepared(step=0.2) is first
    assert len(calls) == 1
    darker = jv.TransferFunction(TRANSFER.values, np.full((3, 3), 0.3), TRANSFER.extinction)
    changes: list[dict[str, Any]] = [
        {"light": DirectionalLight((0, 1.0, -1))},
        {"path": 0.2},
        {"transfer": darker},
        {"volume": jv.Volume(np.asarray(volume.data) + 0.1, volume.spacing, volume.origin)},
        {"volume": jv.Volume(volume.data, 2 * np.asarray(volume.spacing), volume.origin)},
    ]
    for number, changed in enumerate(changes):
        assert prepared(**changed) is prepared(**changed)
        assert len(calls) == number + 2, changed


@pytest.mark.slow
def test_nan_in_what_is_baked_reaches_all_of_it():
    broken = eqx.tree_at(lambda lights: lights[0].irradiance, DAY, jnp.full(3, jnp.nan))
    assert np.isnan(colors_of(templates(broken, baked=NODES), ball(), TRANSFER, on_the_ball())).all()


@pytest.mark.slow
def test_an_image_by_baked_light_has_the_gradient_of_all_but_the_light():
    """Replay, the default, against JAX's derivative of the reference engine; the light is computed in the
    program. Samples with an extinction of 0 are not lit."""
    volume, transfer = scaled_phantom("sphere"), soft_transfer(0.1)

    def loss(scene, adjoint):
        march = jv.March(0.1, MARCH.transforms, max_samples=64)  # a limit that the reference engine needs
        image = jv.render(*scene, march=march, lighting=templates(baked=8), adjoint=adjoint)
        return jnp.sum(image.rgba**2)

    replay, direct = (
        eqx.filter_jit(eqx.filter_grad(loss))((volume, transfer, around(volume)), adjoint)
        for adjoint in ("replay", "direct")
    )
    for where in (
        lambda s: s[0].data,
        lambda s: s[1].colors,
        lambda s: s[1].extinction[2:],
        lambda s: s[2].position,
    ):
        size = float(np.abs(where(direct)).max())
        assert size > 0
        np.testing.assert_allclose(where(replay), where(direct), rtol=1e-3, atol=1e-4 * size)
