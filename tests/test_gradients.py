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

WAYS = {
    "position": 0.04,
    "focal_point": 0.04,
    "view_up": 0.2,
    "view_angle": 4.0,
    "window": 0.1,
    "spacing": 0.02,
    "origin": 0.04,
    "step": 0.01,
}
"""What moves the samples, or the exit, and by how much, so that many cross it."""

JUMPS = {("plain", leaf) for leaf in WAYS}
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


def test_jax_grad_takes_a_camera_as_it_is():
    volume, transfer, camera, march = scene_of("leapt")
    cropped, loss = camera.crop(2, 1, 3, 4), lambda image: jnp.sum(image.rgba**2)
    found = jax.grad(lambda camera: loss(jv.render(volume, transfer, camera, march)))(cropped)
    np.testing.assert_array_equal(found.corner, 0)
    assert np.all([np.any(part != 0) for part in (found.position, found.view_angle, found.window)])


def summed_and_true(name):
    """How a loss changes along the way of each leaf in `WAYS`: by its gradients, summed up, and in truth."""
    scene, background, loss = scene_of(name), jnp.zeros(3), loss_of("replay", depths=0.0)
    volume = jv.Volume(jnp.full((6, 5, 7), 0.2), (0.3, 0.4, 0.25), (-0.5, 0.2, 0.1))
    # all rays hit: those that graze an edge change too steeply to be summed up
    scene = (volume, scene[1], scene[2].zoom(3), scene[3])
    gradient = eqx.filter_jit(eqx.filter_grad(lambda scene: loss(scene, background)))
    found = {}
    for leaf, length in WAYS.items():
        where = LEAVES[leaf]
        way = jnp.full(where(scene).shape, length)

        def at(part, where=where, way=way):
            return eqx.tree_at(where, scene, where(scene) + part * way)

        slopes = [jnp.vdot(where(gradient(at((i + 0.5) / 40))), way) for i in range(40)]
        found[leaf] = float(np.mean(slopes)), float(loss(at(1.0), background) - loss(at(0.0), background))
    return found


@pytest.mark.slow
def test_gradients_that_are_wrong_by_nature_are():
    """Over a distance at which samples cross the exit, the image changes by more than its gradient says;
    and does not, once cells end at the exit."""
    found = {name: summed_and_true(name) for name in ("plain", "aligned")}
    for leaf in WAYS:
        change = abs(found["plain"][leaf][1])
        for name, (told, true) in ((name, leaves[leaf]) for name, leaves in found.items()):
            error = abs(told - true) / change
            assert error > 0.5 if (name, leaf) in JUMPS else error < 0.02, (name, leaf)


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


# the extremes

BOX = (-2.0, -2.0, -2.0)
"""Where a box of width 2 begins: it ends at 0, near which float32 resolves the thinnest cells."""

RAYS = {
    "along an axis": ((-3, -1, -1), (1, 0, 0)),
    "oblique": ((-3, -2.7, -1.9), (0.8, 0.55, 0.3)),
    "misses": ((-3, 5, -1), (1, 0, 0)),
    "looks away": ((-3, -1, -1), (-1, 0, 0)),
    "starts inside": ((-1, -1, -1), (0.6, 0.8, 0)),
    "starts at the exit": ((0, -1, -1), (1, 0, 0)),
    "in a face": ((-3, -2, -1.3), (1, 0, 0)),
    "along an edge": ((-3, -2, -2), (1, 0, 0)),
    "through two corners": ((-3, -3, -3), (1, 1, 1)),
    "touches a corner": ((-3, -2, 1), (1, 0, -1)),
    "leaves after 1e-7": ((-1e-7, -1, -1), (1, 0, 0)),
}

TABLE = np.linspace(0, 1, 8)
RAMP = np.where(TABLE > 0.2, TABLE, 0)
CLEAR, SPECK, NOISE = np.zeros((5, 5, 5)), np.zeros((5, 5, 5)), np.random.default_rng(0).random((5, 5, 5))
SPECK[2, 2, 2] = 0.9

EXTREMES = {
    **{f"{e:g} everywhere": (NOISE, np.full(8, e), 0.3) for e in (0, 1e-20, 1e-6, 1, 1e6, 1e30)},
    **{f"up to {e:g}": (NOISE, e * RAMP, 0.3) for e in (1, 1e6)},
    "an opacity of 1": (NOISE, jv.transfer.extinction_of(np.round(TABLE), 1e-3), 0.3),
    "nothing": (CLEAR, RAMP, 0.3),
    "one voxel": (SPECK, RAMP, 0.3),
    "one opaque voxel": (SPECK, 1e6 * RAMP, 0.3),
    "values beyond the table": (3 * NOISE + 1, RAMP, 0.3),
    "steps of 1e-7": (NOISE, np.ones(8), 1e-7),
    "a step through everything": (NOISE, np.ones(8), 1e3),
}
"""Voxels, extinction, and step."""

OF_RAYS = {
    **{leaf: LEAVES[leaf] for leaf in ("data", "spacing", "origin", "colors", "extinction")},
    "origins": lambda s: s[2],
    "directions": lambda s: s[3],
    "step": lambda s: s[4].step,
}


@pytest.mark.parametrize(
    "name", [n if n == "leapt" else pytest.param(n, marks=pytest.mark.slow) for n in SETS]
)
def test_values_and_gradients_are_finite_and_agree_at_the_extremes(name):
    quadrature, transforms = SETS[name]
    origins, directions = (jnp.asarray(ends, jnp.float32) for ends in zip(*RAYS.values(), strict=True))
    colors = np.random.default_rng(1).random((8, 3))

    def loss_of(adjoint):
        def loss(scene):
            rendering = jv.render_rays(*scene, adjoint=adjoint)
            depth = jnp.where(rendering.rgba[:, 3] > 0, rendering.depth, 0)
            return jnp.sum(rendering.rgba**2) + 0.1 * jnp.sum(depth)

        return loss

    def pushed(scene, tangent):
        return eqx.filter_jvp(loss_of("forward"), (scene,), (tangent,))

    pulled, pushed = eqx.filter_jit(eqx.filter_value_and_grad(loss_of("replay"))), eqx.filter_jit(pushed)
    for case, (data, extinction, step) in EXTREMES.items():
        volume = jv.Volume(np.asarray(data, np.float32), (0.5, 0.5, 0.5), BOX)
        march = jv.March(step, transforms, quadrature, max_samples=128)
        scene = (volume, jv.TransferFunction(TABLE, colors, extinction), origins, directions, march)
        value, gradient = pulled(scene)
        assert np.isfinite(value), case
        for leaf, where in OF_RAYS.items():
            of_leaf, random = where(gradient), np.random.default_rng(2)
            assert np.isfinite(of_leaf).all(), (case, leaf)
            along = jnp.asarray(random.normal(size=of_leaf.shape), jnp.float32)
            if march.leaps and leaf == "extinction":  # one of 0 has no gradient there to agree on
                along = jnp.where(scene[1].extinction > 0, along, 0)
            still = jax.tree.map(lambda x: jnp.zeros_like(x) if eqx.is_inexact_array(x) else None, scene)
            again, slope = pushed(scene, eqx.tree_at(where, still, along))
            np.testing.assert_allclose(again, value, rtol=1e-6, err_msg=case)
            # steps of 1e-7 leave a depth few digits past its entry
            largest = float(jnp.sum(jnp.abs(of_leaf * along)))
            np.testing.assert_allclose(
                slope, jnp.vdot(of_leaf, along), rtol=0, atol=1e-2 * largest + 1e-6, err_msg=f"{case}, {leaf}"
            )


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

    def loss(given):
        data, transfer, camera = given
        volume = eqx.tree_at(lambda v: v.data, small, data)
        return jnp.sum(jv.render(volume, transfer, camera, march).rgba ** 2)

    compiled = jax.jit(jax.grad(loss)).lower((data, soft_transfer(), camera)).compile()
    return compiled.memory_analysis().temp_size_in_bytes


@pytest.mark.slow
def test_memory_of_the_gradient():
    few, many = workspace(128), workspace(2048)
    assert many <= 1.05 * few
    assert many <= 2**30
