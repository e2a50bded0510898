"""Gradients by an extinction of 0 under Phong: an invisible sample has its light, which it would show.

In float64, against one-sided differences, since extinction is never negative.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.lighting import HeadLight, Phong, PointLight

from ..scenes import in_float64, slow, to_float64


SIZE = (4, 3)
STEP = 2e-5
PROBE = jv.ToroidalMap(20.0, 30.0, (0.9, 2.3), (0.8, 2.4), (0.0, 60.0))
ALIGNED, JITTER = jv.AlphaCorrection(), jv.Jitter(3)

CASES: dict[str, tuple[Any, tuple[jv.Transform, ...]]] = {
    "left": ("left", (ALIGNED,)),
    "unaligned": ("left", (jv.EarlyTermination(0.6),)),
    "midpoint": ("midpoint", (JITTER, ALIGNED)),
    "preintegrated": ("preintegrated", (JITTER, ALIGNED)),
    "toroidal": ("midpoint", (PROBE, JITTER, ALIGNED)),
}
"""Quadrature and transforms."""


def scene_of(name: str) -> Any:
    """Volume, transfer function, camera, march and lighting: values rise with z, from what is invisible to
    what is visible and on to what is invisible. Its arrays are made in float64."""
    quadrature, transforms = CASES[name]
    x, y, z = np.meshgrid(*(np.arange(6.0),) * 3, indexing="ij")
    data = 0.14 * z + 0.03 * np.sin(x) + 0.04 * np.cos(0.7 * y + 0.3 * z)
    transfer = jv.TransferFunction(
        (-0.2, 0.2, 0.5, 0.8),
        ((0.9, 0.5, 0.2), (0.2, 0.8, 0.4), (0.8, 0.3, 0.7), (0.5, 0.6, 0.9)),
        (0.0, 0.0, 0.9, 0.0),
    )
    if name == "toroidal":
        volume = jv.Volume(data)
        transfer = eqx.tree_at(lambda t: t.extinction, transfer, transfer.extinction / 20)
        camera = jv.Camera((70.0, -90.0, 160.0), (2.0, 1.0, 75.0), (0, 0, 1), 25.0, size=SIZE)
        lamp, step = PointLight((40.0, -50.0, 150.0), (6000.0, 5000.0, 4000.0)), 4.3
    else:
        volume = jv.Volume(data, (0.3, 0.4, 0.5), (-0.9, -1.2, -1.5))
        camera = jv.Camera((0.7, -0.6, 7.0), (0.1, 0.05, 0.0), (0, 1, 0), 20.0, size=SIZE)
        lamp, step = PointLight((0.5, 0.4, 6.0), (20.0, 18.0, 16.0)), 0.23
    march = jv.March(step, transforms, quadrature, max_samples=48)
    scene = to_float64((volume, transfer, camera, march, Phong((HeadLight(), lamp))))
    return eqx.tree_at(lambda s: s[0].data, scene, jnp.asarray(data))


def leaves_of(name: str) -> dict[str, Any]:
    """What the gradient is taken by. Without cuts at the exit, the image jumps with what moves it."""
    leaves = {
        "extinction": lambda s: s[1].extinction,
        "colors": lambda s: s[1].colors,
        "voxels": lambda s: s[0].data,
        "specular power": lambda s: s[4].specular_power,
        "position of the lamp": lambda s: s[4].lights[1].position,
        "position": lambda s: s[2].position,
    }
    if ALIGNED in CASES[name][1]:
        leaves["step"] = lambda s: s[3].step
    if name == "toroidal":
        leaves["radius"] = lambda s: s[3].transforms[0].b
    return leaves


@pytest.mark.parametrize("name", ["midpoint", *slow("left", "unaligned", "preintegrated", "toroidal")])
def test_gradients_match_one_sided_differences(name):
    with in_float64():
        scene, leaves = scene_of(name), leaves_of(name)
        weights = jnp.asarray(np.random.default_rng(3).uniform(0.2, 1, (*SIZE[::-1], 4)))

        @eqx.filter_jit
        def loss(scene: Any) -> Any:
            *parts, lighting = scene
            return jnp.sum(weights * jv.render(*parts, lighting=lighting, outputs="rgba").rgba)

        slopes, random = eqx.filter_jit(eqx.filter_grad(loss))(scene), np.random.default_rng(4)
        for leaf, where in leaves.items():
            direction = jnp.asarray(random.uniform(0.2, 1, where(scene).shape))
            here, one, two = (
                float(loss(eqx.tree_at(where, scene, where(scene) + n * STEP * direction))) for n in range(3)
            )
            expected = (4 * one - two - 3 * here) / (2 * STEP)
            assert abs(expected) > 1e-4, leaf
            found = float(jnp.sum(where(slopes) * direction))
            assert abs(found - expected) <= 1e-5 * abs(expected), (leaf, found, expected)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_adjoints_agree(name):
    """Entry by entry, of which the first of the transfer function only counts where samples are invisible."""
    with in_float64():
        scene = scene_of(name)

        def image(extinction: Any, adjoint: str) -> Any:
            volume, transfer, camera, march, lighting = scene
            transfer = eqx.tree_at(lambda t: t.extinction, transfer, extinction)
            how = {"lighting": lighting, "adjoint": adjoint, "outputs": "rgba"}
            return jnp.sum(jv.render(volume, transfer, camera, march, **how).rgba[..., :3])

        at = scene[1].extinction
        replay, direct = (jax.jit(jax.grad(image), static_argnums=1)(at, how) for how in ("replay", "direct"))
        forward = jax.jit(jax.jacfwd(image), static_argnums=1)(at, "forward")
        assert np.abs(direct[0]) > 1e-3
        np.testing.assert_allclose(replay, direct, rtol=1e-9)
        np.testing.assert_allclose(replay, forward, rtol=1e-9)
