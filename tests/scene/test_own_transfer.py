"""Has a transfer function that a user writes the gradient of all that it reads?"""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv

from ..scenes import in_float64, slow


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


class Spectrum(jv.Transfer):
    """Nine colours and an extinction, proportional to the value."""

    hues: jax.Array
    scale: jax.Array

    def classifier(self) -> Any:
        return lambda measured: (tuple(hue * measured[0] for hue in self.hues), self.scale * measured[0])

    def integrator(self) -> Any:
        return self.classifier()  # exact where values are constant along rays


DEEP = [0.3, 0.9, 1.7]


def of_nine(dtype: Any) -> tuple[jv.Volume, Spectrum]:
    """A volume of side 2, whose value is 1 + z/2."""
    voxels = np.broadcast_to(np.linspace(1, 2, 5, dtype=dtype), (5, 5, 5))
    return jv.Volume(voxels, (0.5,) * 3), Spectrum(
        np.linspace(0.1, 0.9, 9, dtype=dtype), np.asarray(0.7, dtype)
    )


def closed_form(mode: str, transfer: Spectrum) -> jax.Array:
    """What rays along x see at these depths."""
    value = 1 + jnp.array(DEEP)[:, None] / 2
    numbers = jnp.concatenate([transfer.hues[None] * value, jnp.ones_like(value)], axis=1)
    depth = transfer.scale * value * (2 if mode in ("over", "integral") else 1)
    opacity = -jnp.expm1(-depth)
    factor = jnp.concatenate([jnp.tile(depth, (1, 9)), opacity], axis=1) if mode == "integral" else opacity
    return numbers * factor


@pytest.mark.parametrize(
    ("mode", "quadrature"),
    [
        ("over", "preintegrated"),
        ("integral", "midpoint"),
        *slow(("over", "midpoint"), ("maximum", "midpoint"), ("average", "midpoint")),
        *slow(("minimum", "preintegrated"), ("integral", "preintegrated")),
    ],
)
def test_nine_colours_are_those_of_closed_forms_in_both_engines_and_so_is_their_gradient(mode, quadrature):
    with in_float64():
        volume, transfer = of_nine(np.float64)
        march = jv.March(0.3, (jv.AlphaCorrection(),), quadrature, max_samples=16)
        origins = np.array([(-1.0, 1.0, depth) for depth in DEEP])
        directions, weights = np.tile([1.0, 0, 0], (3, 1)), np.cos(np.arange(30.0)).reshape(3, 10)

        @jax.jit
        def computed(transfer):
            def loss(transfer):
                seen = jv.render_rays(volume, transfer, origins, directions, march, compositing=mode).rgba
                return jnp.sum(weights * seen), seen

            def exact(transfer):
                expected = closed_form(mode, transfer)
                return jnp.sum(weights * expected), expected

            def reference(origin, direction):
                return jv.render_ray_reference(
                    volume, transfer, origin, direction, march, compositing=mode
                ).rgba

            ours, exactly = jax.grad(loss, has_aux=True)(transfer), jax.grad(exact, has_aux=True)(transfer)
            return ours, exactly, jax.vmap(reference)(origins, directions)

        (gradient, image), (expected, exact), reference = computed(transfer)
        for found in (image, reference):
            np.testing.assert_allclose(found, exact, rtol=1e-12)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10), gradient, expected)


@pytest.mark.slow
def test_nine_colours_of_surfaces_bricks_several_volumes_and_finer_rays():
    volume, transfer = of_nine(np.float32)
    camera = jv.Camera.looking_at(volume, (1, 0.2, 0.9), size=(16, 16))
    march = jv.March(0.1, (jv.AlphaCorrection(), jv.SpaceLeaping()))
    surface = jv.render(volume, transfer, camera, march, compositing=jv.Isosurface(1.4)).rgba
    seen = np.asarray(surface[..., 9] > 0)
    assert 30 < seen.sum() < 256
    np.testing.assert_allclose(surface[seen][:, :9], np.tile(1.4 * transfer.hues, (seen.sum(), 1)), rtol=1e-5)
    one = jv.render(volume, transfer, camera, march)
    for mode in ("over", "maximum"):
        whole = jv.render(volume, transfer, camera, march, compositing=mode).rgba
        bricks = jv.render_bricks(volume, transfer, camera, march, bricks=(2, 1, 2), compositing=mode).rgba
        np.testing.assert_allclose(bricks, whole, atol=2e-5)
    halves = [eqx.tree_at(lambda t: t.scale, transfer, transfer.scale / 2)] * 2
    both = jv.render([volume] * 2, halves, camera, jv.March(0.1, (jv.AlphaCorrection(),)))
    np.testing.assert_allclose(both.rgba, one.rgba, atol=5e-5)
    finer = jv.render(volume, transfer, replace(camera, size=(32, 32)), march)
    pooled = jv.render(volume, transfer, camera, march, antialias=2).rgba
    np.testing.assert_allclose(pooled, finer.rgba.reshape(16, 2, 16, 2, 10).mean((1, 3)), atol=5e-5)


class Odd(jv.Transfer):
    """A classifier that returns what it is given."""

    answer: Any = eqx.field(static=True)

    def classifier(self) -> Any:
        return lambda measured: jax.tree.map(lambda n: n * measured[0], self.answer)


def refused() -> dict[str, tuple[Any, str]]:
    volume, transfer = of_nine(np.float32)
    camera, march = jv.Camera.looking_at(volume, size=(4, 4)), jv.March(0.5)
    light, of_three = jv.lighting.Phong(), jv.TransferFunction((0, 1), np.ones((2, 3)), (0, 1))
    image = jv.Rendering(*jax.device_put((np.ones((4, 4, 10), np.float32), np.zeros((4, 4), bool))))
    returns = r"Odd.classifier must return \(\(c1, c2, \.\.\.\), extinction\).* got "
    return {
        "no colours": (lambda: jv.render(volume, Odd(((), 1.0)), camera, march), returns),
        "one number": (lambda: jv.render(volume, Odd((1.0, 2.0)), camera, march), returns),
        "no extinction": (lambda: jv.render(volume, Odd((1.0, 2.0, 3.0)), camera, march), returns),
        "light": (
            lambda: jv.render(volume, transfer, camera, march, lighting=light),
            "lighting: a Phong shades three colours; Spectrum.classifier returns 9",
        ),
        "light in bricks": (
            lambda: jv.render_bricks(volume, transfer, camera, march, lighting=light),
            "lighting: a Phong shades three colours; Spectrum.classifier returns 9",
        ),
        "paths": (
            lambda: jv.path_trace(volume, transfer, camera, jv.lighting.ConstantLight(), paths=1),
            "three colours to path_trace; got 9 of a Spectrum",
        ),
        "several": (
            lambda: jv.render([volume] * 2, [transfer, of_three], camera, march),
            r"transfer functions must have equally many colours; got \[9, 3\]",
        ),
        "a background": (image.image, "image needs a rendering of three colours; this one has 9"),
        "a window": (image.show, "three colours; this one has 9"),
        "a file": (lambda: jv.save_png("a.png", image.rgba), "linear must"),
    }


CASES = (
    *("no colours", "one number", "no extinction", "light", "light in bricks", "paths", "several"),
    *("a background", "a window", "a file"),
)


@pytest.mark.parametrize("case", CASES)
def test_what_is_of_three_colours_says_so(case):
    cases = refused()
    assert set(cases) == set(CASES)
    make, message = cases[case]
    with pytest.raises(ValueError, match=message):
        make()
