"""What is compared of every compositing mode: both engines, and gradients with central differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxvol as jv

from .scenes import around, soft_transfer


def reference_image(volume, transfer, camera, march, mode, lighting=None):
    """rgba and depth of every pixel, ray by ray."""
    column, row = jnp.meshgrid(*(jnp.arange(n) for n in camera.size))
    rays = jnp.vectorize(lambda x, y: tuple(part for end in camera.ray(x, y) for part in end))
    x, y, z, *direction = rays(column, row)

    @jax.jit
    @jax.vmap
    @jax.vmap
    def one(origin, direction, column, row):
        rendering = jv.render_ray_reference(
            *(volume, transfer, origin, direction, march),
            pixel=(column, row),
            compositing=mode,
            lighting=lighting,
        )
        return rendering.rgba, rendering.depth

    return one(jnp.stack([x, y, z], -1), jnp.stack(direction, -1), column, row)


def same_images(found, expected, *, atol=1e-6):
    """Asserts that two renderings show the same, at the same depths."""
    np.testing.assert_allclose(found.rgba, expected.rgba, atol=atol)
    finite = np.isfinite(expected.depth)
    np.testing.assert_array_equal(np.isfinite(found.depth), finite)
    np.testing.assert_allclose(found.depth[finite], expected.depth[finite], rtol=max(atol, 1e-6))


def ball_in_a_corner():
    """A ball of 8-bit values, greatest in its middle, with much empty space around it."""
    ball = jv.phantom("sphere", 12)
    return jv.Volume((255 * np.pad(np.asarray(ball.data), ((2, 10),) * 3)).astype(np.uint8), ball.spacing)


LEAVES = {
    "voxels": lambda scene: scene[0].data,
    "spacing": lambda scene: scene[0].spacing,
    "colors": lambda scene: scene[1].colors,
    "extinction": lambda scene: scene[1].extinction,
    "position": lambda scene: scene[2].position,
    "step": lambda scene: scene[3].step,
}
"""Differentiable leaves of a scene (volume, transfer function, camera, march, mode)."""


def check_gradients(volume, mode, parameters, adjoint, *, constant=(), normals=False, quadrature="left"):
    """Asserts that the gradient of a loss of colours and depths (and normals) is that of central differences,
    in float64: of each leaf alone under replay, and of all of them together.

    `parameters`: leaves of the mode, by name. `constant`: those on which the loss does not depend."""
    march = jv.March(0.11, (jv.AlphaCorrection(), jv.SpaceLeaping()), quadrature, max_samples=64)
    scene = volume, soft_transfer(), around(volume, (9, 8)), march, mode
    named = {**LEAVES, **{name: lambda s, of=of: of(s[4]) for name, of in parameters.items()}}

    def leaves(scene):
        return tuple(of(scene) for of in named.values())

    hit = np.isfinite(jv.render(*scene[:4], compositing=mode).depth)
    assert hit.mean() > 0.2
    random = np.random.default_rng(3)
    weights = random.normal(size=(8, 9, 8))
    ways = {name: jnp.asarray(random.choice([-1.0, 1.0], of(scene).shape)) for name, of in named.items()}
    # extinctions of 0 stay 0, since none is negative
    ways["extinction"] = jnp.where(scene[1].extinction > 0, ways["extinction"], 0)
    ways = tuple(ways.values())

    def loss(given, adjoint="replay"):
        moved = eqx.tree_at(leaves, scene, given)
        image = jv.render(*moved[:4], compositing=moved[4], adjoint=adjoint)
        parts = [image.rgba, jnp.where(hit, image.depth, 0)[..., None]]
        shown = jnp.concatenate([*parts, *([image.normal] if normals else [])], axis=-1)
        return jnp.sum(shown * weights[..., : shown.shape[-1]])

    def difference(part, h=1e-7):
        ends = [
            loss(
                tuple(
                    leaf + sign * h * way if name in part else leaf
                    for name, leaf, way in zip(named, leaves(scene), ways, strict=True)
                )
            )
            for sign in (1, -1)
        ]
        return float(ends[0] - ends[1]) / (2 * h)

    if adjoint == "forward":
        slope = jax.jvp(lambda given: loss(given, "forward"), (leaves(scene),), (ways,))[1]
    else:
        gradient = jax.grad(lambda given: loss(given, adjoint))(leaves(scene))
        slopes = {
            name: float(jnp.vdot(part, way)) for name, part, way in zip(named, gradient, ways, strict=True)
        }
        slope = sum(slopes.values())
        if adjoint == "replay":
            found = [difference({name}) for name in named]
            np.testing.assert_allclose(list(slopes.values()), found, rtol=1e-5, atol=1e-5)
            assert {name for name in named if abs(slopes[name]) < 1e-9} == set(constant)
    np.testing.assert_allclose(slope, difference(set(named)), rtol=1e-5)
