"""Compositing modes with parameters: gradients against central differences, a fit, and what is refused."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

import jaxvol as jv
from jaxvol.compositing.modes import compositing_of

from ..scenes import in_float64


class Veiled(jv.Weighting):
    """As "over", of opacities raised to a power; at most `most` is shown, and what is left out is bright."""

    power: jax.Array = eqx.field(converter=jnp.asarray)
    most: jax.Array = eqx.field(converter=jnp.asarray)
    glow: jax.Array = eqx.field(converter=jnp.asarray)

    def weight(self, alpha, before):
        return (self.most - before) * alpha**self.power

    def transmittance(self, state):
        return 1 - state.opacity / self.most

    def resolved(self, classification, sums):
        return sums * jnp.exp(self.glow)


class Curve(jv.Weighting):
    """Weights that a curve over the opacity gives; nothing hides what lies behind it."""

    knots: jax.Array = eqx.field(converter=jnp.asarray)

    def weight(self, alpha, before):
        return 0.01 * jnp.interp(alpha, jnp.linspace(0, 1, len(self.knots)), self.knots) * alpha


class Own(Curve):
    """The same with a slope of its own, that of the bare opacity, whose parameters are not its."""

    def slope(self, alpha, after, weight_bar, sum_behind):
        _, slope = jax.jvp(lambda a: self.weight(a, after), (alpha,), (jnp.ones_like(alpha),))
        return weight_bar * slope * (1 - alpha)


class Nonlinear(jv.Weighting):
    """Neither of the two forms."""

    power: jax.Array = eqx.field(converter=jnp.asarray)

    def weight(self, alpha, before):
        return (1 - before) ** self.power * alpha


MODES = {
    "veiled": lambda: Veiled(1.3, 0.9, 0.1),
    "curve": lambda: Curve([0.2, 0.9, 0.4, 0.8]),
    "own slope": lambda: Own([0.2, 0.9, 0.4, 0.8]),
    "nonlinear": lambda: Nonlinear(2.0),
}


def scene() -> tuple[jv.Volume, jv.TransferFunction, jv.Camera]:
    """Opaque and thin matter, and empty blocks."""
    random = np.random.default_rng(0)
    data = random.uniform(0.2, 1, (9, 9, 13))
    data[:, :, 6:] = 0
    extinction = np.array([0, 0, 0.5, 1, 2, 3, 40, 90])
    transfer = jv.TransferFunction(np.linspace(0, 1, 8), random.uniform(size=(8, 3)), extinction)
    volume = jv.Volume(data, (0.25, 0.25, 0.2))
    return volume, transfer, jv.Camera.looking_at(volume, (0.5, -0.9, 0.4), size=(6, 5))


def loss_of(mode: Any, extinction: Any, adjoint: Any) -> Any:
    volume, transfer, camera = scene()
    transfer = eqx.tree_at(lambda t: t.extinction, transfer, extinction)
    march = jv.March(
        0.21, (jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination(1e-12)), max_samples=64
    )
    found = jv.render(volume, transfer, camera, march, compositing=mode, adjoint=adjoint)
    weights = jnp.asarray(np.random.default_rng(3).normal(size=(5, 6, 5)))
    seen = found.opacity > 0
    depth = jnp.where(seen, jnp.where(seen, found.depth, 0), 0)
    return jnp.sum(weights[..., :4] * found.rgba) + jnp.sum(weights[..., 4] * depth)


@pytest.mark.parametrize("name", MODES)
def test_parameters_have_the_gradient_of_differences(name):
    with in_float64():
        mode, extinction = MODES[name](), jnp.asarray(scene()[1].extinction)
        adjoints = ("direct",) if name == "nonlinear" else ("replay", "forward")

        @eqx.filter_jit
        def slopes(mode, extinction, way, adjoint):
            """Loss, and its slope along `way`."""

            def loss(given):
                return loss_of(*given, adjoint)

            if adjoint == "forward":
                return jax.jvp(loss, ((mode, extinction),), (way,))
            value, gradient = jax.value_and_grad(loss)((mode, extinction))
            pairs = zip(jax.tree.leaves(gradient), jax.tree.leaves(way), strict=True)
            return value, sum(jnp.vdot(a, b) for a, b in pairs)

        at = jax.tree.map(np.asarray, (mode, extinction))
        none = jax.tree.map(np.zeros_like, at)
        leaves, structure = jax.tree.flatten(at)
        for i, leaf in enumerate(leaves):
            way = np.where(leaf > 0, np.cos(np.arange(leaf.size)).reshape(leaf.shape), 0)
            ways = jax.tree.leaves(none)
            ways[i] = way
            ahead, behind = (
                slopes(
                    *jax.tree.unflatten(structure, [*leaves[:i], leaf + h * way, *leaves[i + 1 :]]), none, a
                )
                for a, h in ((adjoints[0], 1e-5), (adjoints[0], -1e-5))
            )
            expected = (float(ahead[0]) - float(behind[0])) / 2e-5
            assert abs(expected) > 1e-4
            for adjoint in adjoints:
                found = slopes(*at, jax.tree.unflatten(structure, ways), adjoint)[1]
                assert float(found) == pytest.approx(expected, rel=1e-6, abs=1e-8), (i, adjoint)


def test_weights_of_another_form_have_no_gradient_by_replay():
    gradient = eqx.filter_jit(jax.grad(lambda mode: loss_of(mode, scene()[1].extinction, "replay")))
    assert np.isnan(gradient(Nonlinear(2.0)).power)


def test_a_parameter_is_recovered_from_an_image():
    volume, transfer, camera = scene()

    def image(power, _=None):
        mode = eqx.tree_at(lambda m: m.power, Veiled(1.0, 0.9, 0.0), power)
        return jv.render(volume, transfer, camera, jv.March(0.21), compositing=mode).rgba

    target = jax.jit(image)(jnp.float32(1.6))
    solver = optimistix.LevenbergMarquardt(1e-4, 1e-4)
    found = optimistix.least_squares(lambda power, _: image(power) - target, solver, jnp.float32(1.0))
    assert float(found.value) == pytest.approx(1.6, abs=1e-3)


class Dense(jv.Over):
    """An `Over` whose slope is that of another weight."""

    def weight(self, alpha, before):
        return (1 - before) * alpha**2


def test_an_over_of_another_weight_is_refused():
    with pytest.raises(ValueError, match=r"Dense is an Over with another weight.*Subclass jaxvol\.Weighting"):
        compositing_of(Dense())
