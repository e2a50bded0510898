"""How cells become a pixel: "over", and a mode of one's own in both engines and all adjoints."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

import jaxvol as jv
from jaxvol.modes import compositing_of

from . import oracle
from .engine.test_gradient_matrix import scene_of
from .scenes import around, in_float64, scaled_phantom, soft_transfer, uniform_transfer


class Additive(jv.Weighting):
    """A part of all opacities is summed; nothing hides what lies behind it."""

    part: float = eqx.field(static=True, default=0.01)

    def weight(self, alpha, before):
        return self.part * alpha

    def slope(self, alpha, after, worth, behind):
        return self.part * (1 - alpha) * worth


class Scaled(Additive):
    """With a parameter that is not static."""

    by: float = 1.0


BOX = jv.Volume(np.ones((5, 5, 5), np.float32), spacing=[0.5] * 3)  # 2 long
RAY = ([[-1.0, 1.0, 1.0]], [[1.0, 0.0, 0.0]])


def composited(mode, alphas, colors):
    """Opacity, colour and mean depth of cells at depths 0, 1, 2, …"""
    composite = mode.begin(jnp.zeros(()), "all")
    for depth, (alpha, color) in enumerate(zip(alphas, colors, strict=True)):
        weight = mode.weight(jnp.asarray(alpha), composite.opacity)
        composite = composite.add(weight, tuple(map(jnp.asarray, color)), jnp.asarray(float(depth)))
    return np.asarray(composite.rgba()), float(composite.mean_depth())


def test_over_is_the_same_back_to_front():
    """C ← α c + (1 - α) C, from the last cell to the first, is a second derivation."""
    random = np.random.default_rng(0)
    alphas, colors = random.random(9, np.float32), random.random((9, 3), np.float32)
    rgba, depth = composited(jv.Over(), alphas, colors)
    behind, moment = np.zeros(4), 0.0
    for number in range(8, -1, -1):
        own = np.append(colors[number], 1.0)
        behind = alphas[number] * own + (1 - alphas[number]) * behind
        moment = alphas[number] * number + (1 - alphas[number]) * moment
    np.testing.assert_allclose(rgba, behind, atol=1e-6)
    np.testing.assert_allclose(depth, moment / behind[3], rtol=1e-5)


def test_an_image_is_the_same_back_to_front():
    """A head, sample by sample from the back: C' = α c + (1 - α) C, in float64."""
    volume, transfer, step = scaled_phantom("head"), soft_transfer(0.2), 0.07
    camera = around(volume).zoom(2.0)
    origins, directions = (np.asarray(part, np.float64).reshape(-1, 3) for part in camera.rays())
    low, spacing, values = (
        np.asarray(p, np.float64) for p in (volume.origin, volume.spacing, transfer.values)
    )
    t_in, t_out = oracle.box_interval(origins, directions, low, low + (np.array(volume.shape) - 1) * spacing)
    image = np.zeros((len(origins), 4))
    for k in reversed(range(int(np.max(t_out - t_in) / step) + 1)):
        t = t_in + k * step
        width = np.clip(t_out - t, 0, step)  # of a cell that is cut at the exit
        where = (origins + np.where(width > 0, t, 0)[:, None] * directions - low) / spacing
        value = map_coordinates(np.asarray(volume.data, np.float64), where.T, order=1, mode="nearest")
        looks = [np.interp(value, values, np.asarray(c, np.float64)) for c in transfer.colors.T]
        alpha = 1 - np.exp(-np.interp(value, values, np.asarray(transfer.extinction, np.float64)) * width)
        own = np.stack([*looks, np.ones_like(value)], axis=-1)
        image = alpha[:, None] * own + (1 - alpha)[:, None] * image
    rendering = jv.render(volume, transfer, camera, jv.March(step, (jv.AlphaCorrection(),)))
    assert 0.1 < np.mean(image[:, 3] > 0.5) < 0.9
    assert np.mean((image[:, 3] > 0.01) & (image[:, 3] < 0.5)) > 0.02
    np.testing.assert_allclose(np.asarray(rendering.rgba).reshape(-1, 4), image, atol=2e-5)


def test_nothing_visible_is_infinitely_far():
    rgba, depth = composited(jv.Over(), [0.0, 0.0], np.ones((2, 3), np.float32))
    np.testing.assert_array_equal(rgba, 0)
    assert depth == np.inf


@pytest.mark.parametrize("mode", [jv.Over(), Additive()], ids=lambda mode: type(mode).__name__)
def test_slopes_are_those_of_jax(mode):
    """The derivative of Σ w q by the optical depth of every cell, against JAX's own."""
    random = np.random.default_rng(1)
    with in_float64():
        depths, worths = (jnp.asarray(random.uniform(0.1, 2, 7)) for _ in range(2))

        def total(depths):
            opacity, total = jnp.zeros(()), 0.0
            for alpha, worth in zip(1 - jnp.exp(-depths), worths, strict=True):
                weight = mode.weight(alpha, opacity)
                opacity, total = opacity + weight, total + weight * worth
            return total

        expected, whole = jax.grad(total)(depths), total(depths)
        opacity, front = jnp.zeros(()), 0.0
        for k, alpha in enumerate(1 - jnp.exp(-depths)):
            weight = mode.weight(alpha, opacity)
            opacity, front = opacity + weight, front + weight * worths[k]
            slope = mode.slope(alpha, opacity, worths[k], whole - front)
            np.testing.assert_allclose(slope, expected[k], rtol=1e-12)


def test_a_mode_of_ones_own_composites():
    """Seven equal cells, in the fast engine and the reference; early termination never ends the ray."""
    march = jv.March(0.3, (jv.EarlyTermination(0.5),))
    transfer, expected = uniform_transfer(1.0), 0.07 * (1 - np.exp(-0.3))
    rendering = jv.render_rays(BOX, transfer, *RAY, march, compositing=Additive())
    reference = jv.render_ray_reference(
        BOX, transfer, jnp.asarray(RAY[0][0]), jnp.asarray(RAY[1][0]), march, compositing=Additive()
    )
    for found in (rendering.rgba[0], reference.rgba):
        np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert int(rendering.samples[0]) == int(reference.samples) == 7


def losses(mode, method):
    """A loss of an image of a scene with empty space, as a function of extinction, camera position and
    step."""
    volume, transfer, camera, march = scene_of("moving", method, "float64", "inside")
    weights = np.random.default_rng(5).normal(size=(*camera.size[::-1], 4))

    def loss(given, adjoint="replay"):
        extinction, position, step = given
        changed = eqx.tree_at(lambda t: t.extinction, transfer, extinction)
        moved = eqx.tree_at(lambda c: c.position, camera, position)
        stepped = eqx.tree_at(lambda m: m.step, march, step)
        rendering = jv.render(volume, changed, moved, stepped, compositing=mode, adjoint=adjoint)
        return jnp.sum(rendering.rgba * weights)

    return loss, (transfer.extinction, camera.position, march.step)


@pytest.mark.slow
def test_gradients_of_a_mode_of_ones_own_are_central_differences():
    """Extinctions of 0 stay 0."""
    with in_float64():
        loss, given = losses(Additive(), "hierarchy")
        random = np.random.default_rng(0)
        ways = [jnp.asarray(random.choice([-1.0, 1.0], leaf.shape)) for leaf in given]
        ways[0] = jnp.where(given[0] > 0, ways[0], 0)
        gradient = jax.grad(loss)(given)
        for i, (leaf, way) in enumerate(zip(given, ways, strict=True)):
            ends = [loss((*given[:i], leaf + h * way, *given[i + 1 :])) for h in (1e-8, -1e-8)]
            norm = float(jnp.linalg.norm(gradient[i]))
            assert norm > 0
            error = abs(float(ends[0] - ends[1]) / 2e-8 - float(jnp.vdot(gradient[i], way)))
            assert error <= 1e-5 * norm


@pytest.mark.slow
@pytest.mark.parametrize("method", [None, "hierarchy", "distance", "beam"])
def test_adjoints_of_a_mode_of_ones_own_agree(method):
    with in_float64():
        loss, given = losses(Additive(), method)
        gradient = jax.grad(loss)(given)
        random = np.random.default_rng(0)
        ways = tuple(jnp.asarray(random.choice([-1.0, 1.0], leaf.shape)) for leaf in given)
        ways = (jnp.where(given[0] > 0, ways[0], 0), *ways[1:])
        forward = jax.jvp(lambda g: loss(g, "forward"), (given,), (ways,))[1]
        slope = sum(jnp.vdot(part, way) for part, way in zip(gradient, ways, strict=True))
        norm = sum(float(jnp.linalg.norm(part)) for part in gradient)
        assert abs(float(forward - slope)) <= 1e-9 * norm


def test_bad_modes_are_named():
    with pytest.raises(
        ValueError, match=r'compositing must be one of "over", "maximum", .* or Selection; got \'under\''
    ):
        compositing_of("under")
    with pytest.raises(ValueError, match="got the class Over"):
        compositing_of(jv.Over)
    with pytest.raises(ValueError, match=r"must be a Weighting with static fields only.*a Scaled has"):
        compositing_of(Scaled(0.1, 2.0))
    assert isinstance(compositing_of("over"), jv.Over)
