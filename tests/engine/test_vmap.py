"""Does `jax.vmap` agree with a loop? Values and gradients, over every part of a scene."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv

from ..scenes import CAMERAS, RESOLUTION, inside, scaled_phantom, soft_transfer


SIZE = (20, 18)
COUNT = 3
slow = pytest.mark.slow


def voxels(i, dtype):
    """Sparse random blocks, different for each `i`."""
    data = np.zeros((RESOLUTION,) * 3)
    random = np.random.default_rng(i)
    for low in random.integers(0, RESOLUTION - 6, (5, 3)):
        x, y, z = low
        data[x : x + 6, y : y + 6, z : z + 6] = random.uniform(0.2, 1)
    return (255 * data).astype(np.uint8) if dtype == "uint8" else data.astype(dtype)


def scene(i, dtype="uint8", camera="around"):
    """The i-th scene; scenes differ in every part."""
    volume = jv.Volume(voxels(i, dtype), (0.05 + 0.01 * i, 0.06, 0.05), (0.1 * i, 0, 0))
    transfer = soft_transfer(0.2 + 0.1 * i)
    if dtype == "uint8":
        transfer = jv.TransferFunction(255 * transfer.values, transfer.colors, transfer.extinction)
    march = jv.March(0.03 + 0.01 * i, (jv.Jitter(i), jv.AlphaCorrection(), jv.SpaceLeaping()))
    return volume, transfer, CAMERAS[camera](volume, SIZE), march


def stack(items):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *items)


def image(scene, adjoint="replay", lighting=None):
    return jv.render(*scene, adjoint=adjoint, lighting=lighting).rgba


def loss(scene, adjoint="replay", lighting=None):
    rgba = image(scene, adjoint, lighting)
    return jnp.sum(rgba * jnp.asarray(np.random.default_rng(5).normal(size=rgba.shape), rgba.dtype))


def assert_each(batch, singles, tolerance):
    """Each leaf of the batch agrees with the single results, to `tolerance` times its norm."""
    for (path, many), *each in zip(
        jax.tree_util.tree_leaves_with_path(batch), *map(jax.tree.leaves, singles), strict=True
    ):
        want, name = np.stack(each), jax.tree_util.keystr(path)
        assert many.shape == want.shape, name
        error = np.linalg.norm(np.asarray(many) - want)
        assert error <= tolerance * np.linalg.norm(want), f"{name}: off by {error:.1e}"


def assert_images(batch, singles):
    for many, one in zip(batch, singles, strict=True):
        assert float(one[..., 3].max()) > 0.1
        np.testing.assert_allclose(many, one, atol=1e-6, rtol=0)


grad = eqx.filter_grad(loss)


@slow
@pytest.mark.parametrize("dtype", ["float32", "uint8"])
def test_over_whole_scenes(dtype):
    """Images, `vmap` of `grad`, and `grad` of `vmap`, over volumes, transfer functions, cameras, steps and
    seeds together."""
    scenes = [scene(i, dtype) for i in range(COUNT)]
    batch, gradients = stack(scenes), [grad(s) for s in scenes]
    assert_images(eqx.filter_vmap(image)(batch), [image(s) for s in scenes])
    assert_each(eqx.filter_vmap(grad)(batch), gradients, 1e-5)
    of_sum = eqx.filter_grad(lambda batch: jnp.sum(eqx.filter_vmap(loss)(batch)))(batch)
    assert_each(of_sum, gradients, 1e-5)


PARTS = {
    "volumes": lambda s: s[0].data,
    "transfer functions": lambda s: s[1],
    "cameras": lambda s: s[2],
    "steps": lambda s: s[3].step,
    "seeds": lambda s: s[3].transforms[0].noise.seed,
}


def over(part, dtype="uint8"):
    """A scene as a function of one of its parts, and several values of this part."""
    where, scenes = PARTS[part], [scene(i, dtype) for i in range(COUNT)]
    parts = [where(s) for s in scenes]
    first = scene(0, dtype)
    return lambda part: eqx.tree_at(where, first, part), parts


@pytest.mark.parametrize(
    ("part", "dtype"),
    [
        ("cameras", "uint8"),
        *(pytest.param(part, "uint8", marks=slow) for part in PARTS if part != "cameras"),
        pytest.param("volumes", "float32", marks=slow),
    ],
)
def test_over_one_part(part, dtype):
    """The other parts are closed over, as usual: their voxels are concrete and therefore packed."""
    made, parts = over(part, dtype)

    def both(part):
        """The image, and the gradient with respect to transfer function and camera."""
        volume, transfer, camera, march = made(part)

        def weighed(given):
            rgba = image((volume, *given, march))
            return jnp.sum(rgba * weights), rgba

        found, rgba = eqx.filter_grad(weighed, has_aux=True)((transfer, camera))
        return rgba, found

    weights = jnp.asarray(np.random.default_rng(5).normal(size=(*SIZE[::-1], 4)), jnp.float32)
    images, gradients = zip(*(both(p) for p in parts), strict=True)
    assert np.abs(images[0] - images[1]).max() > 1e-3
    many, found = eqx.filter_vmap(both)(stack(parts))
    assert_images(many, images)
    assert_each(found, gradients, 1e-5)


@slow
@pytest.mark.parametrize("adjoint", ["forward", "direct"])
@pytest.mark.parametrize("part", ["transfer functions", "cameras"])
def test_other_adjoints(part, adjoint):
    made, parts = over(part)

    def seen(part):
        return image(made(part), adjoint)

    assert_images(eqx.filter_vmap(seen)(stack(parts)), [seen(p) for p in parts])
    leaf, floats = (
        ("extinction", [p.extinction for p in parts])
        if part == "transfer functions"
        else (
            "position",
            [p.position for p in parts],
        )
    )

    def jacobian(value):
        return jax.jacfwd(lambda v: seen(eqx.tree_at(lambda p: getattr(p, leaf), parts[0], v)))(value)

    def along(value):
        def changed(v):
            return loss(made(eqx.tree_at(lambda p: getattr(p, leaf), parts[0], v)), adjoint)

        return jax.jvp(changed, (value,), (jnp.ones_like(value),))

    for derivative in (jacobian, along):
        assert_each(jax.vmap(derivative)(jnp.stack(floats)), [derivative(v) for v in floats], 1e-5)


@slow
def test_forward_is_linearized():
    """`jax.linearize`, as optimistix's solvers use it."""
    made, parts = over("transfer functions")

    def seen(extinction):
        return image(made(eqx.tree_at(lambda t: t.extinction, parts[0], extinction)), "forward")

    value, linear = jax.linearize(seen, parts[0].extinction)
    tangent = jnp.asarray(np.random.default_rng(0).normal(size=parts[0].extinction.shape), jnp.float32)
    again, slope = jax.jvp(seen, (parts[0].extinction,), (tangent,))
    np.testing.assert_allclose(value, again, atol=1e-6)
    assert np.abs(slope).max() > 1e-3
    np.testing.assert_allclose(linear(tangent), slope, atol=1e-5 * float(np.abs(slope).max()))
    np.testing.assert_allclose(jax.jit(linear)(tangent), slope, atol=1e-5 * float(np.abs(slope).max()))


@slow
@pytest.mark.parametrize("wrapped", ["jit of vmap", "vmap of jit", "nested"])
def test_combinations_of_jit_and_vmap(wrapped):
    _, cameras = over("cameras")
    _, transfers = over("transfer functions")
    volume, _, _, march = scene(0)

    def both(transfer, camera):
        return jax.value_and_grad(lambda t: loss((volume, t, camera, march)))(transfer)

    expected = [[both(t, c) for c in cameras] for t in transfers]
    if wrapped == "nested":
        many = jax.vmap(jax.vmap(both, in_axes=(None, 0)), in_axes=(0, None))
        assert_each(many(stack(transfers), stack(cameras)), [stack(row) for row in expected], 1e-5)
        return
    if wrapped == "jit of vmap":
        many = jax.jit(jax.vmap(functools.partial(both, transfers[0])))
    else:
        many = jax.vmap(jax.jit(functools.partial(both, transfers[0])))
    assert_each(many(stack(cameras)), expected[0], 1e-5)


@slow
def test_over_lights():
    volume = scaled_phantom("sphere")
    transfer, march = soft_transfer(), jv.March(0.07, (jv.AlphaCorrection(), jv.SpaceLeaping()))
    material = jv.Material(0.5, 0.1)
    lights = [
        jv.lighting.DirectionalLight(direction, (1.0, 1.0, 1.0))
        for direction in ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.3, -0.5, 0.2))
    ]

    def lit(light):
        lighting = jv.lighting.ScattererTemplates(material, light, templates=1)
        seen = volume, transfer, inside(volume, SIZE), march
        return jax.value_and_grad(lambda t: loss((seen[0], t, *seen[2:]), lighting=lighting))(transfer)

    assert_each(jax.vmap(lit)(stack(lights)), [lit(light) for light in lights], 1e-5)
