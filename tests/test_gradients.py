"""The gradient: every leaf, transform and adjoint against central differences in float64; where a gradient is
wrong by nature, that it is; and what it takes in memory."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv

from .scenes import anisotropic_noise, doubled, in_float64, inside, orthographic, soft_transfer


SIZE = (6, 5)
STEP = 0.11

LEAPT = (jv.EmptySpaceJitter(4), jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination(0.05))
SETS = {
    "plain": ("left", ()),
    "aligned": ("midpoint", (jv.AlphaCorrection(),)),
    "leapt": ("left", LEAPT),
    "jittered": ("left", (jv.Jitter(3), jv.AlphaCorrection(), jv.EarlyTermination(0.2))),
    "front residual": ("midpoint", (jv.Jitter(3, "blue", front_residual=True), jv.AlphaCorrection())),
}
FAST = {"leapt", "aligned"}
"""The other sets' programs are compiled by the slow run."""

MOVED = ("position", "focal_point", "view_up", "view_angle", "window", "spacing", "origin", "step")
"""What moves the samples, or the exit."""

JUMPS = {("plain", leaf) for leaf in MOVED}
"""Where the gradient is wrong by nature: the image jumps whenever a sample crosses the exit."""


def scene_of(set_name, camera=None):
    """A small scene in the float type of the day, and its differentiable leaves."""
    quadrature, transforms = SETS[set_name]
    noise = anisotropic_noise()
    data = np.asarray(noise.data[:6, :5, :7], float)
    volume = jv.Volume(jnp.asarray(data), (0.3, 0.4, 0.25), (-0.5, 0.2, 0.1))
    transfer = soft_transfer()
    if jax.config.read("jax_enable_x64"):
        transfer, transforms = doubled((transfer, transforms))
    transfer = eqx.tree_at(lambda t: t.extinction, transfer, transfer.extinction + 0.1)
    camera = (
        jv.Camera((1.9, -1.3, 1.7), tuple(map(float, volume.center)), (0.1, 0, 1), 40.0, size=SIZE)
        if camera is None
        else camera(volume, SIZE)
    )
    march = jv.March(STEP, transforms, quadrature, max_samples=64)
    return volume, transfer, camera, march


LEAVES = {
    "data": lambda s: s[0].data,
    "spacing": lambda s: s[0].spacing,
    "origin": lambda s: s[0].origin,
    "colors": lambda s: s[1].colors,
    "extinction": lambda s: s[1].extinction,
    "position": lambda s: s[2].position,
    "focal_point": lambda s: s[2].focal_point,
    "view_up": lambda s: s[2].view_up,
    "view_angle": lambda s: s[2].view_angle,
    "window": lambda s: s[2].window,
    "step": lambda s: s[3].step,
}


def loss_of(adjoint, depths=0.1):
    """A scalar of the image, its depths and a background, as a function of the scene."""
    random = np.random.default_rng(5)
    weights, of_depth = random.normal(size=(SIZE[1], SIZE[0], 3)), random.normal(size=(SIZE[1], SIZE[0]))

    @eqx.filter_jit
    def loss(scene, background):
        rendering = jv.render(*scene, adjoint=adjoint)
        color, opacity = rendering.rgba[..., :3], rendering.rgba[..., 3:]
        image = color + (1 - opacity) * background[None, None]
        depth = jnp.where(opacity[..., 0] > 0, rendering.depth, 0)
        return jnp.sum(image * jnp.asarray(weights, image.dtype)) + depths * jnp.sum(
            depth * jnp.asarray(of_depth, depth.dtype)
        )

    return loss


def central(loss, scene, background, where, direction, h=1e-6):
    """The slope of the loss along a direction of one leaf."""
    ends = [eqx.tree_at(where, scene, where(scene) + sign * h * direction) for sign in (1, -1)]
    return (loss(ends[0], background) - loss(ends[1], background)) / (2 * h)


CASES = [
    pytest.param(name, adjoint, marks=[] if name in FAST and adjoint == "replay" else pytest.mark.slow)
    for name in SETS
    for adjoint in ("replay", "forward", "direct")
]


@pytest.mark.parametrize(("name", "adjoint"), CASES)
def test_every_leaf_matches_central_differences(name, adjoint):
    with in_float64():
        scene, background = scene_of(name), jnp.asarray([0.2, 0.5, 0.9])
        loss, random = loss_of(adjoint), np.random.default_rng(0)
        backwards = (
            None if adjoint == "forward" else eqx.filter_grad(lambda both: loss(*both))((scene, background))
        )
        for leaf, where in LEAVES.items():
            direction = jnp.asarray(random.normal(size=where(scene).shape))
            difference = central(loss, scene, background, where, direction)
            if backwards is None:
                still = jax.tree.map(lambda x: jnp.zeros_like(x) if eqx.is_inexact_array(x) else None, scene)
                tangent = eqx.tree_at(where, still, direction)
                slope = eqx.filter_jvp(lambda s: loss(s, background), (scene,), (tangent,))[1]
            else:
                slope = jnp.vdot(where(backwards[0]), direction)
            np.testing.assert_allclose(slope, difference, rtol=1e-5, atol=1e-7, err_msg=leaf)
        if backwards is not None:
            random = jnp.asarray(np.random.default_rng(1).normal(size=3))
            ends = [loss(scene, background + sign * 1e-6 * random) for sign in (1, -1)]
            np.testing.assert_allclose(jnp.vdot(backwards[1], random), (ends[0] - ends[1]) / 2e-6, rtol=1e-5)


@pytest.mark.parametrize(
    "name", [n if n == "leapt" else pytest.param(n, marks=pytest.mark.slow) for n in SETS]
)
def test_float32_gradients_are_those_of_float64(name):
    def gradient():
        scene, background = scene_of(name), jnp.asarray([0.2, 0.5, 0.9], float)
        loss = loss_of("replay")
        found = eqx.filter_grad(lambda scene: loss(scene, background))(scene)
        return {leaf: np.asarray(where(found)) for leaf, where in LEAVES.items()}

    single = gradient()
    with in_float64():
        double = gradient()
    for leaf, exact in double.items():
        np.testing.assert_allclose(single[leaf], exact, atol=1e-3 * np.abs(exact).max(), rtol=0, err_msg=leaf)


@pytest.mark.slow
@pytest.mark.parametrize("leaf", ["position", "step"])
def test_gradients_that_are_wrong_by_nature_are(leaf):
    """Over a distance at which samples cross the exit, the image changes by more than its gradient says;
    and does not, once cells end at the exit."""

    def off(name):
        """How far the mean of many derivatives is from the difference that they add up to; and that one."""
        scene, background = scene_of(name), jnp.zeros(3)
        scene = (jv.Volume(jnp.ones((6, 5, 7)), (0.3, 0.4, 0.25), (-0.5, 0.2, 0.1)), *scene[1:])
        loss, where = loss_of("forward", depths=0.0), LEAVES[leaf]  # a depth jumps where a ray first hits
        direction = jnp.full(where(scene).shape, 0.04)
        still = jax.tree.map(lambda x: jnp.zeros_like(x) if eqx.is_inexact_array(x) else None, scene)
        tangent = eqx.tree_at(where, still, direction)

        def at(part):
            return eqx.tree_at(where, scene, where(scene) + part * direction)

        slopes = [
            eqx.filter_jvp(lambda s: loss(s, background), (at((i + 0.5) / 40),), (tangent,))[1]
            for i in range(40)
        ]
        change = loss(at(1.0), background) - loss(at(0.0), background)
        return abs(float(np.mean(slopes) - change)), abs(float(change))

    assert ("plain", leaf) in JUMPS
    wrong, change = off("plain")
    assert wrong > 0.1 * change
    assert off("aligned")[0] < 0.02 * change


@pytest.mark.slow
@pytest.mark.parametrize("camera", [inside, orthographic])
def test_replay_is_direct_for_other_cameras(camera):
    with in_float64():
        scene, background = scene_of("aligned", camera), jnp.zeros(3)
        found, expected = (
            eqx.filter_grad(lambda scene, a=a: loss_of(a)(scene, background))(scene)
            for a in ("replay", "direct")
        )
        for got, want in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(got, want, rtol=1e-7, atol=1e-9 * np.abs(want).max() + 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", ["replay", "forward", "direct"])
def test_rays_of_ones_own_match_central_differences(adjoint):
    with in_float64():
        volume, transfer, camera, march = scene_of("leapt")
        origins, directions = (part.reshape(-1, 3)[::3] for part in camera.rays())
        random = np.random.default_rng(2)
        weights = jnp.asarray(random.normal(size=(origins.shape[0], 4)))

        @jax.jit
        def loss(rays):
            return jnp.sum(jv.render_rays(volume, transfer, *rays, march, adjoint=adjoint).rgba * weights)

        rays = (origins, directions)
        for i in range(2):
            along = tuple(
                jnp.asarray(random.normal(size=r.shape)) if i == j else jnp.zeros_like(r)
                for j, r in enumerate(rays)
            )
            ends = [loss(jax.tree.map(lambda r, d, h=h: r + h * d, rays, along)) for h in (1e-6, -1e-6)]
            difference = (ends[0] - ends[1]) / 2e-6
            if adjoint == "forward":
                slope = jax.jvp(loss, (rays,), (along,))[1]
            else:
                slope = sum(jnp.vdot(g, d) for g, d in zip(jax.grad(loss)(rays), along, strict=True))
            np.testing.assert_allclose(slope, difference, rtol=1e-5, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", ["replay", "forward", "direct"])
def test_functions_by_label_match_central_differences(adjoint):
    with in_float64():
        volume, transfer, camera, march = scene_of("leapt")
        labels = (np.indices(volume.shape).sum(axis=0) // 4 % 3).astype(np.uint8)
        volume = jv.Volume(volume.data, volume.spacing, volume.origin, labels)
        march = jv.March(march.step, (*march.transforms[:1], jv.AlphaCorrection(labels=True)), max_samples=64)
        random = np.random.default_rng(3)
        functions = doubled(
            jv.LabelTransferFunction(
                [
                    None,
                    transfer,
                    jv.TransferFunction(transfer.values, 1 - transfer.colors, 2 * transfer.extinction),
                ]
            )
        )
        weights = jnp.asarray(random.normal(size=(SIZE[1], SIZE[0], 4)))

        @eqx.filter_jit
        def loss(functions):
            rendering = jv.render(volume, functions, camera, march, adjoint=adjoint)
            return jnp.sum(rendering.rgba * weights)

        for where in (lambda f: f.stacked.colors, lambda f: f.stacked.extinction):
            leaf = where(functions)
            # the functions of labels that are not seen stay dark
            along = jnp.asarray(random.normal(size=leaf.shape))
            along = along.at[jnp.asarray([0, -1])].set(0)
            ends = [loss(eqx.tree_at(where, functions, leaf + h * along)) for h in (1e-6, -1e-6)]
            difference = (ends[0] - ends[1]) / 2e-6
            if adjoint == "forward":
                still = jax.tree.map(
                    lambda x: jnp.zeros_like(x) if eqx.is_inexact_array(x) else None, functions
                )
                slope = eqx.filter_jvp(loss, (functions,), (eqx.tree_at(where, still, along),))[1]
            else:
                slope = jnp.vdot(where(eqx.filter_grad(loss)(functions)), along)
            np.testing.assert_allclose(slope, difference, rtol=1e-5, atol=1e-8)


def test_tables_pull_as_jax_does():
    """Their scatter of whole rows, against what JAX makes of the look-up."""
    random = np.random.default_rng(0)
    value = jnp.asarray(random.uniform(-0.2, 1.2, 500), jnp.float32)
    color = tuple(jnp.asarray(random.normal(size=500), jnp.float32) for _ in range(3))
    extinction = jnp.asarray(random.normal(size=500), jnp.float32)
    uneven = np.sort(random.uniform(0, 1, 40))
    for values in (np.linspace(0, 1, 2), np.linspace(0, 1, 9), np.linspace(0, 1, 40), uneven):
        n = len(values)
        transfer = jv.TransferFunction(values, random.uniform(size=(n, 3)), random.uniform(0, 5, n))

        def classified(transfer, value):
            search, measured = transfer.search(), (value,)
            found = measured if search is None else (*measured, *search(measured))
            return jax.vmap(transfer.classifier())(found), found

        (_, found), pull = jax.vjp(classified, transfer, value)
        nothing = jax.tree.map(lambda leaf: np.zeros(leaf.shape, jax.dtypes.float0), found[1:2])
        unseen = (jnp.zeros_like(value), *nothing, *map(jnp.zeros_like, found[2:]))
        want, want_value = pull(((color, extinction), unseen))
        got, (got_value,) = transfer.pull(found, color, extinction)
        np.testing.assert_allclose(got.colors, want.colors, atol=2e-5)
        np.testing.assert_allclose(got.extinction, want.extinction, atol=2e-5)
        np.testing.assert_allclose(got_value, want_value, rtol=1e-4, atol=1e-3)


def workspace(samples, size=512, resolution=256):
    """Bytes that the compiled gradient needs beside its inputs and outputs."""
    data = jnp.zeros((resolution,) * 3)
    small = jv.Volume(jnp.zeros((2, 2, 2)), (2 / (resolution - 1),) * 3, (-1.0,) * 3)
    camera = jv.Camera((3, 2, 2.5), (0, 0, 0), size=(size, size))
    march = jv.March(3.4 / samples, (jv.AlphaCorrection(), jv.EarlyTermination(0.01)))

    def loss(data, transfer, camera):
        volume = eqx.tree_at(lambda v: v.data, small, data)
        return jnp.sum(jv.render(volume, transfer, camera, march).rgba ** 2)

    program = eqx.filter_jit(jax.grad(loss, argnums=(0, 1, 2)), donate="none")
    compiled = program.lower(data, soft_transfer(), camera).compile()
    return compiled.compiled.memory_analysis().temp_size_in_bytes


@pytest.mark.slow
def test_memory_of_the_gradient():
    few, many = workspace(128), workspace(2048)
    assert many <= 1.05 * few
    assert many <= 2**30
