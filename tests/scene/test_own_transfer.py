"""Has a transfer function that a user writes the gradient of all that it reads?"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxvol as jv


class Coloured(jv.Transfer):
    """The value is the extinction; colours are read from a grid of their own."""

    hue: jv.Volume
    gain: jax.Array

    def attributes(self, volume: jv.Volume, coordinate: Any) -> tuple[Any, ...]:
        x, y, z = coordinate
        return (self.hue.interpolated((x / 2, y / 2, z / 2)), self.gain)

    def classifier(self) -> Any:
        return lambda measured: ((measured[1], measured[2], measured[1] * measured[2]), measured[0])


def test_what_is_read_beside_the_value_has_its_gradient():
    random = np.random.default_rng(0)
    volume, hue = (jv.Volume(random.uniform(size=(n, n, n)).astype(np.float32)) for n in (9, 5))
    camera = jv.Camera.looking_at(volume, size=(8, 8))
    march = jv.March(0.5, (jv.AlphaCorrection(),), "midpoint", max_samples=64)
    scene = volume, Coloured(hue, jnp.float32(0.7))

    @eqx.filter_jit
    def gradient(scene: Any, adjoint: Any) -> Any:
        def loss(scene: Any) -> Any:
            volume, transfer = scene
            return jnp.sum(jv.render(volume, transfer, camera, march, adjoint=adjoint).rgba ** 2)

        return eqx.filter_grad(loss)(scene)

    found, expected = (gradient(scene, adjoint) for adjoint in ("replay", "direct"))
    (voxels, own), near = expected, np.testing.assert_allclose
    assert all(np.linalg.norm(leaf) > 0.1 for leaf in (voxels.data, own.hue.data, own.gain))
    jax.tree.map(lambda a, b: near(a, b, atol=1e-5 * np.max(np.abs(b)) + 1e-6), found, expected)
