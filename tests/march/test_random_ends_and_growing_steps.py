"""Roulettes and steps that grow, by the transforms of `docs/add_a_transform.md`."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv

from ..scenes import (
    QUADRATURES,
    around,
    in_float64,
    rendered as rendered_image,
    scaled_phantom,
    slow,
    soft_transfer,
    to_float64,
)
from ..switch import switch
from ..test_documents import examples


PAGE: dict[str, Any] = {}
for block in examples("docs/add_a_transform.md"):
    if "class Roulette" in block or "class Growing" in block:
        exec(block.partition("\nvolume = ")[0], PAGE)
Roulette, Growing = PAGE["Roulette"], PAGE["Growing"]

LENGTH, NODES, RAYS, STEP, NEAR = 4.0, 17, 512, 0.11, 2.5
FAR = 1e6  # steps are equal up to there
VALUES, COLORS = np.linspace(0, 1, 8), np.random.default_rng(1).random((8, 3))
EXTINCTION = np.array([0.0, 0.0, 0.0, 3.0, 0.0, 0.0, 3.0, 1.0])
"""Extinction along the slab, which begins with empty blocks, and is empty between two layers."""


def slab_of(extinction, quadrature="left", step=STEP, *, on=(), near=FAR, survival=1.0, below=0.6, seed=0):
    """Rays through a slab whose value rises from 0 to 1 along x. The names in `on` turn transforms on."""
    value = np.linspace(0, 1, NODES)[:, None, None] * np.ones((1, 5, 5))
    volume = jv.Volume(value, (LENGTH / (NODES - 1), 1.0, 1.0))
    transfer = jv.TransferFunction(VALUES, COLORS, extinction)
    random = np.random.default_rng(2)
    # sorted, so that neighbours leap together
    origins = np.sort(random.uniform((-3, 1.5, 1.5), (-0.5, 2.5, 2.5), (RAYS, 3)), axis=0)
    directions = np.sort(random.uniform((1, -0.2, -0.2), (1, 0.2, 0.2), (RAYS, 3)), axis=0)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    every = {
        "jitter": jv.Jitter(3),
        "shift": jv.EmptySpaceJitter(5),
        "alignment": jv.AlphaCorrection(),
        "leaping": jv.SpaceLeaping(),
        "termination": jv.EarlyTermination(0.05),
    }
    others = [switch(each, name in on) for name, each in every.items()]
    transforms = Growing(near), Roulette(seed, below, survival), *others
    march = jv.March(step, transforms, quadrature, max_samples=64)
    return to_float64((volume, transfer, origins, directions, march))


def loss_of(rendering):
    """A linear function of colours, opacities, and depths times opacities."""
    weights = np.random.default_rng(5).normal(size=(RAYS, 5))
    rgba, depth = rendering.rgba, rendering.depth
    moment = jnp.where(rgba[:, 3] > 0, depth, 0) * rgba[:, 3]
    return (rgba * weights[:, :4]).sum() + (moment * weights[:, 4]).sum()


@eqx.filter_jit
def by_both_engines(scene):
    renderings = [jv.render_rays(*scene, adjoint=adjoint) for adjoint in ("forward", "direct")]
    return [(each.rgba, each.depth, each.samples, each.exhausted, loss_of(each)) for each in renderings]


def rendered(scene):
    """Colour and opacity, numbers of samples, and the loss by the engine, equal to those by the reference."""
    (rgba, depth, samples, exhausted, loss), reference = jax.device_get(by_both_engines(scene))
    np.testing.assert_allclose(rgba, reference[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(depth, reference[1], rtol=0, atol=1e-11)
    assert not exhausted.any()
    assert not reference[3].any()
    return rgba, samples, float(loss)


def pcg4d(a, b, c, d):
    """The first of the four numbers of Jarzynski and Olano, as fractions of 2³²."""
    words = [(np.asarray(word, np.uint64) * 1664525 + 1013904223) % 2**32 for word in (a, b, c, d)]
    for turn in range(2):
        a, b, c, d = words
        a = (a + b * d) % 2**32
        b = (b + c * a) % 2**32
        c = (c + a * b) % 2**32
        d = (d + b * c) % 2**32
        words = [a, b, c, d] if turn else [word ^ (word >> 16) for word in (a, b, c, d)]
    return (words[0] >> 8) / 2.0**24


@eqx.filter_jit
def jittered(*noises):
    return [jax.vmap(lambda i, n=noise: n((i, 0 * i), jnp.float64))(jnp.arange(RAYS)) for noise in noises]


def marched(scene, on=()):
    """Colour and opacity by a loop over the samples of each ray, and the numbers of samples."""
    _, transfer, origins, directions, march = scene
    growing, roulette, jitter, shift, *_ = march.transforms
    extinctions, step = np.asarray(transfer.extinction), float(march.step)
    near, seed, below, survival = (
        part.item() for part in (growing.near, roulette.seed, roulette.below, roulette.survival)
    )
    rgba, samples = np.zeros((RAYS, 4)), np.zeros(RAYS, int)
    offsets, jumps = jax.device_get(jittered(jitter.inner.noise, shift.inner.noise))
    for ray, (x, dx) in enumerate(zip(np.asarray(origins)[:, 0], np.asarray(directions)[:, 0], strict=True)):
        t_in, length, left = -x / dx, LENGTH / dx, 1.0
        offset = offsets[ray] if "jitter" in on else 0.0
        jump = jumps[ray] - 1 if "shift" in on else 0.0
        equal, start = max(near - t_in, 0.0), max(near, t_in)

        def depth(distance, equal=equal, start=start):
            return distance if distance < equal else equal + start * np.expm1((distance - equal) / near)

        moved = False
        for k in range(1000):
            front, back = (depth((offset + jump * moved + k + end) * step) for end in (0, 1))
            if front >= length:
                break
            back = min(back, length) if "alignment" in on else back
            value = front / length
            extinction = np.interp(value, VALUES, extinctions)
            alpha = -np.expm1(-extinction * (back - front))
            color = np.array([np.interp(value, VALUES, channel) for channel in COLORS.T])
            rgba[ray] += left * alpha * np.append(color, 1)
            samples[ray] += 1
            left *= 1 - alpha
            if alpha > 0 and left < below:
                left = left / survival if pcg4d(ray, 0, k, seed) < survival else 0
            moved |= alpha == 0
            if left == 0 or ("termination" in on and left <= 0.05):
                break
    return rgba, samples


CASES = (
    ((), {}),
    ((), {"near": NEAR}),
    (("leaping", "alignment"), {"near": NEAR}),
    (("leaping", "shift"), {"near": NEAR, "survival": 0.4, "seed": 7}),
    (("leaping", "jitter", "alignment", "termination"), {"near": NEAR, "survival": 0.7}),
)


def test_images_are_those_of_another_marcher_in_both_engines():
    with in_float64():
        for on, values in CASES:
            scene = slab_of(EXTINCTION, on=on, **values)
            (found, evaluated, _), (rgba, samples) = rendered(scene), marched(scene, on)
            np.testing.assert_allclose(found, rgba, rtol=0, atol=1e-12)
            if "leaping" in on:
                assert evaluated.sum() < samples.sum() - RAYS
            else:
                np.testing.assert_array_equal(evaluated, samples)


def test_a_roulette_leaves_the_mean_of_a_homogeneous_slab():
    with in_float64():
        fog, some = partial(slab_of, np.full(8, 0.7), on=("alignment",), near=NEAR), {"survival": 0.5}
        whole, most, _ = rendered(fog())
        exact = -np.expm1(-0.7 * LENGTH / np.asarray(fog()[3])[:, 0])
        np.testing.assert_allclose(whole[:, 3], exact, rtol=0, atol=1e-12)
        (first, samples, _), (second, _, _) = rendered(fog(**some)), rendered(fog(**some, seed=1))
        off, other = first - whole, second - whole
        assert (np.abs(off.mean(axis=0)) < 3 * off.std(axis=0) / np.sqrt(RAYS)).all()
        assert off[:, 3].std() > 0.1
        assert abs(np.corrcoef(off[:, 3], other[:, 3])[0, 1]) < 3 / np.sqrt(RAYS)
        assert samples.mean() < 0.8 * most.mean()


@eqx.filter_jit
def gradient(scene):
    return eqx.filter_grad(lambda scene: loss_of(jv.render_rays(*scene)))(scene)


@eqx.filter_jit
def slope(scene, way):
    return eqx.filter_jvp(lambda scene: loss_of(jv.render_rays(*scene, adjoint="forward")), (scene,), (way,))[
        1
    ]


@pytest.mark.parametrize("quadrature", ["left", *slow(*QUADRATURES[1:])])
def test_gradients_are_central_differences(quadrature):
    with in_float64():
        on = "leaping", "jitter", "shift", "alignment"
        scene = slab_of(EXTINCTION, quadrature, on=on, near=NEAR, survival=0.6)
        found, random = gradient(scene), np.random.default_rng(6)
        leaves = {
            "voxels": lambda scene: scene[0].data,
            "spacing": lambda scene: scene[0].spacing,
            "colors": lambda scene: scene[1].colors,
            "extinction": lambda scene: scene[1].extinction,
            "origins": lambda scene: scene[2],
            "step": lambda scene: scene[4].step,
            "near": lambda scene: scene[4].transforms[0].near,
        }
        zero, total = jax.tree.map(np.zeros_like, eqx.filter(scene, eqx.is_inexact_array)), 0.0
        ways = zero
        for name, leaf in leaves.items():
            way = random.choice([-1.0, 1.0], np.shape(leaf(scene)))
            way = way * (EXTINCTION > 0) if name == "extinction" else way

            def moved(h, leaf=leaf, way=way):
                changed = eqx.tree_at(leaf, scene, jax.device_put(np.asarray(leaf(scene)) + h * way))
                return rendered(changed)[2]

            expected = (moved(1e-7) - moved(-1e-7)) / 2e-7  # few samples cross a control point
            along = float(np.vdot(leaf(found), way))
            assert along == pytest.approx(expected, rel=1e-6, abs=1e-6), name
            assert abs(along) > 1e-3, name
            ways, total = eqx.tree_at(leaf, ways, way), total + along
        assert float(slope(scene, ways)) == pytest.approx(total, rel=1e-9, abs=1e-9)
        assert float(found[4].transforms[1].survival) == 0


class Darkened(jv.lighting.Shading):
    """Darker colours where the extinction is high, computed for visible samples alone."""

    def color(self, sample, shared, sums):
        r, g, b = (channel * jnp.exp(-sample.extinction) for channel in sample.color)
        return r, g, b


def camera_scene(voxels=np.float32, **values):
    """A phantom, seen by a camera, with both transforms and others."""
    head = scaled_phantom("head", 16)
    volume = jv.Volume(np.asarray(head.data, voxels), head.spacing, head.origin)
    transforms = (
        Growing(1.5),
        Roulette(below=0.8, survival=0.6),
        jv.EmptySpaceJitter(),
        jv.SpaceLeaping(),
        jv.AlphaCorrection(),
    )
    return volume, soft_transfer(0.3), around(volume), jv.March(0.05, transforms, max_samples=128)


def test_images_of_a_camera_in_float32_are_those_of_the_reference():
    scene = camera_scene()
    fast, reference = jv.render(*scene), rendered_image(*scene, adjoint="direct")
    np.testing.assert_allclose(fast.rgba, reference.rgba, rtol=0, atol=5e-6)
    assert np.asarray(fast.rgba)[..., 3].max() > 1  # of single pixels, not of their mean


@pytest.mark.slow
@pytest.mark.parametrize("light", [jv.lighting.Phong(), Darkened()], ids=["inline", "chunks"])
def test_lit_gradients_are_those_of_the_reference(light):
    with in_float64():
        scene, lighting = to_float64((camera_scene(np.float64), light))

        @eqx.filter_jit
        def gradient(scene, adjoint):
            def loss(scene):
                return (jv.render(*scene, lighting=lighting, adjoint=adjoint).rgba ** 2).sum()

            return eqx.filter_grad(loss)(scene)

        found, expected = (jax.device_get(gradient(scene, adjoint)) for adjoint in ("replay", "direct"))
        visible = np.asarray(scene[1].extinction) > 0  # leaps leave out the others
        for leaf in (
            lambda scene: scene[1].colors,
            lambda scene: scene[1].extinction[visible],
            lambda scene: scene[2].position,
            lambda scene: scene[3].step,
            lambda scene: scene[3].transforms[0].near,
        ):
            np.testing.assert_allclose(leaf(found), leaf(expected), rtol=1e-9, atol=1e-9)
            assert np.abs(leaf(expected)).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["maximum", "isosurface"])
def test_selected_depths_move_with_steps_that_grow(mode):
    with in_float64():
        volume, transfer, origins, directions, march = slab_of(np.full(8, 0.7), near=NEAR)
        mode = jv.Isosurface(0.4) if mode == "isosurface" else mode
        march = jv.March(march.step, march.transforms[:1], max_samples=64)

        @eqx.filter_jit
        def depth(step, near, adjoint="forward"):
            moved = eqx.tree_at(lambda m: (m.step, m.transforms[0].near), march, (step, near))
            found = jv.render_rays(
                volume, transfer, origins, directions, moved, compositing=mode, adjoint=adjoint
            )
            return found.depth.sum()

        at = march.step, getattr(march.transforms[0], "near")  # noqa: B009
        np.testing.assert_allclose(depth(*at), depth(*at, "direct"), rtol=1e-12)
        found = eqx.filter_jit(jax.grad(lambda at: depth(*at, "replay")))(at)
        for i, slope in enumerate(found):
            ends = [depth(*(x + sign * 1e-7 * (i == j) for j, x in enumerate(at))) for sign in (1, -1)]
            assert float(slope) == pytest.approx(float(ends[0] - ends[1]) / 2e-7, rel=1e-5, abs=1e-5)


class OneWay(jv.Transform):
    """Steps that grow, without the way back."""

    def depth(self, distance, ray):
        return 2 * distance


def test_errors_name_what_does_not_go_together():
    with pytest.raises(ValueError, match=r"OneWay must override both depth and its inverse, distance\."):
        jv.March(0.1, (OneWay(),))
    volume, transfer, camera, march = camera_scene()
    with pytest.raises(ValueError, match=r"Roulette\.roulette weights the cells .* compositing by Maximum"):
        jv.render(volume, transfer, camera, march, compositing="maximum")
    with pytest.raises(ValueError, match=r"march: Growing\.depth: .* equal steps\. Use jv\.render\."):
        jv.render_bricks(volume.data, transfer, camera, march, spacing=volume.spacing, memory=2**30)


@pytest.mark.slow
def test_bricks_continue_a_roulette():
    volume, transfer, camera, march = camera_scene()
    march = jv.March(march.step, march.transforms[1:])
    whole = jv.render(volume, transfer, camera, march).rgba
    place = {"spacing": np.asarray(volume.spacing), "origin": np.asarray(volume.origin)}
    bricks = jv.render_bricks(np.asarray(volume.data), transfer, camera, march, bricks=(2, 2, 2), **place)
    assert bricks.bricks.loads > 1
    np.testing.assert_allclose(bricks.rgba, whole, rtol=0, atol=2e-6)
