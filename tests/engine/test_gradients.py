"""Is a gradient right, and the same however it is computed? For every leaf of a scene, subset of transforms,
adjoint, and type of voxels.

The scene resembles users' scenes: it has empty space between visible objects, rays that miss the volume,
rays that see nothing in it, and several beams of rays, the last one incomplete. Gradients in float32 are
computed as users compute them, by `jax.grad` of `render` outside `jax.jit`, where small voxel types are
fetched from their packed copy; those in float64 inside, by one program for all subsets of transforms.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

import jaxvol as jv
from experiments import scenes as real_scenes

from .. import transforms as every
from ..scenes import LEAVES, in_float64, to_float64, with_voxels
from ..switch import switch


SHAPE = (26, 21, 31)
SIZE = (37, 21)
"""More than one beam of 16 x 16 pixels along each axis."""

BOX, PLANE = (0.5, 1.8, -0.2, 1.2, 0.3, 1.6), ((0.6, 0.5, 0.6), (0.5, -0.2, 0.6))
"""A clip that leaves a part of each blob, on either side of it."""

TOPS = {"uint8": 255, "uint16": 60_000, "int16": 4000, "float32": 1, "float64": 1}
"""Largest value of a volume of each type."""

CAMERAS = {
    "outside": ((3.1, -3.9, 2.4), (1.1, 0.5, 1.0), 30.0),
    "inside": ((1.15, 0.45, 1.0), (0.7, 0.6, 0.6), 70.0),
    "past it": ((3.1, -3.9, 2.4), (1.9, 0.9, 1.6), 30.0),
}
"""Position, focal point and view angle."""


def blobs(dtype, seed=0):
    """Two blobs far from each other, and a third one cut by a corner of the volume."""
    random = np.random.default_rng(seed)
    x, y, z = np.meshgrid(*(np.linspace(-1, 1, n) for n in SHAPE), indexing="ij")
    value = np.zeros(SHAPE)
    for center, radius in (((-0.5, 0.1, -0.4), 0.45), ((0.4, -0.3, 0.5), 0.4), ((0.9, 0.9, -0.9), 0.5)):
        a, b, c = center + random.uniform(-0.05, 0.05, 3)
        value = np.maximum(value, 1 - np.sqrt((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2) / radius)
    value = np.where(value > 0, value + 0.1 * random.random(SHAPE), 0)
    return (np.clip(value, 0, 1) * TOPS[dtype]).astype(dtype)


def scene_of(
    transforms, dtype="uint8", camera="outside", *, quadrature="left", step=0.043, seed=0, most=None
):
    """A scene of blobs, in JAX's current float type."""
    volume = jv.Volume(blobs(dtype, seed), (0.07, 0.09, 0.06), (0.2, -0.4, 0.1))
    values, extinction = np.array([0.0, 0.1, 0.3, 0.5, 0.7, 1.0]), np.array([0.0, 0.0, 4.0, 12.0, 0.0, 36.0])
    colors = np.random.default_rng(2).random((6, 3))
    transfer = jv.TransferFunction(values * TOPS[dtype], colors, extinction)
    position, target, angle = CAMERAS[camera]
    camera = jv.Camera(position, target, (0.1, 0.2, 1), angle, size=SIZE)
    if jax.config.read("jax_enable_x64"):
        transforms = to_float64(transforms)
    return volume, transfer, camera, jv.March(step, transforms, quadrature, max_samples=most)


def switched(on, **values):
    """All but a clip that is inside out, which divides each cell and doubles the time to compile."""
    return every.switched(on, box=BOX, planes=(PLANE,), without=("hollow",), **values)


def loss(scene, adjoint="replay"):
    """A scalar function of image and depths, without cancellation; and the image."""
    rendering = jv.render(*scene, adjoint=adjoint)
    return weighed(rendering.rgba, rendering.depth), rendering.rgba


@jax.jit
def weighed(rgba, depth):
    opacity = rgba[..., 3]
    weights = np.random.default_rng(5).normal(size=(*opacity.shape, 5))
    depth = jnp.where(opacity > 0, depth, 0) * opacity
    seen = jnp.concatenate([rgba, depth[..., None]], axis=-1)
    return jnp.sum(seen * jnp.asarray(weights, seen.dtype))


def differentiated(scene, adjoint):
    """Loss and image, and the gradient by all leaves."""
    return eqx.filter_value_and_grad(functools.partial(loss, adjoint=adjoint), has_aux=True)(scene)


in_one_program = eqx.filter_jit(differentiated)


def gradient(scene, adjoint="replay"):
    """The image, and the gradients of all leaves by their paths, but for what is constant to `"replay"`: the
    random numbers of jitters. Derivatives by extinctions of 0 are set to 0: marches that leap do not compute
    them."""
    double = jax.config.read("jax_enable_x64")
    (_, image), found = (in_one_program if double else differentiated)(scene, adjoint)
    return np.asarray(image), by_path(found, scene)


def by_path(tree, scene):
    extinction, of_it = (np.asarray(LEAVES["extinction"](each)) for each in (scene, tree))
    tree = eqx.tree_at(LEAVES["extinction"], tree, np.where(extinction > 0, of_it, 0))
    named = {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree.leaves_with_path(tree)}
    return {name: np.asarray(leaf) for name, leaf in named.items() if not name.endswith(".tile")}


def along(scene, seed=0):
    """For every leaf, a random direction that changes only this leaf: (path, tangent of the scene).
    Extinctions of 0 do not change, nor do the positions of control points."""
    random = np.random.default_rng(seed)
    floats, _ = eqx.partition(scene, eqx.is_inexact_array)
    paths = jax.tree.leaves_with_path(floats)
    for number, (path, leaf) in enumerate(paths):
        way = random.choice([-1.0, 1.0], leaf.shape)
        name = jax.tree_util.keystr(path)
        if name.endswith(".extinction"):
            way = np.where(np.asarray(leaf) > 0, way, 0)
        if not name.endswith((".values", ".tile")):
            ways = [
                way.astype(leaf.dtype) if i == number else np.zeros(each.shape, each.dtype)
                for i, (_, each) in enumerate(paths)
            ]
            yield name, jax.tree.unflatten(jax.tree.structure(floats), ways)


def at(tree, name):
    """The leaf of a tree at this path."""
    return next(leaf for path, leaf in jax.tree.leaves_with_path(tree) if jax.tree_util.keystr(path) == name)


def assert_same_forward(scene, found, tolerance):
    """Forward mode has the derivative by a direction in which every leaf moves, by 1 over the norm of its
    gradient, that these gradients have."""
    way, dot = None, 0.0
    for name, only in along(scene):
        norm = np.linalg.norm(found[name])
        moved = jax.tree.map(
            lambda leaf, norm=norm: (np.asarray(leaf) / norm if norm else 0 * leaf).astype(leaf.dtype), only
        )
        way = moved if way is None else jax.tree.map(np.add, way, moved)
        dot += np.vdot(found[name], at(moved, name))
    double = jax.config.read("jax_enable_x64")
    slope = (slope_in_one_program if double else slope_along)(scene, way)
    assert abs(float(slope) - dot) <= tolerance * len(found)


def slope_along(scene, way):
    """In forward mode."""
    return eqx.filter_jvp(lambda scene: loss(scene, "forward")[0], (scene,), (way,))[1]


slope_in_one_program = eqx.filter_jit(slope_along)


def chosen(found, names):
    return {name: found[name] for name in names}


def assert_same(found, expected, tolerance, context="", rounding=0.0):
    """Each leaf's gradient agrees to `tolerance` times its norm."""
    assert found.keys() == expected.keys()
    for name, want in expected.items():
        assert np.isfinite(found[name]).all(), (context, name)
        error, norm = np.linalg.norm(found[name] - want), np.linalg.norm(want)
        assert error <= tolerance * norm + rounding, f"{context} {name}: off by {error:.1e}, norm {norm:.3g}"


RANDOM = {
    "on": every.SUBSETS.map(lambda on: on - {"hollow"}),
    "seed": st.integers(0, 2**32 - 1),
    "camera": st.sampled_from(sorted(CAMERAS)),
}


@settings(max_examples=4)
@given(**RANDOM, step=st.floats(0.02, 0.2), dense=st.floats(0.5, 2), left=st.floats(0.01, 0.3))
def test_leaps_show_in_no_image_and_no_gradient(on, seed, camera, step, dense, left):
    """Of 8-bit voxels, in float32."""
    found = {}
    for leaping in (True, False):
        now = on | {"leaping"} if leaping else on - {"leaping"}
        scene = scene_of(switched(now, seed=seed, left=left), camera=camera, step=step, seed=seed % 1000)
        denser = np.float32(dense) * np.asarray(LEAVES["extinction"](scene))
        scene = eqx.tree_at(LEAVES["extinction"], scene, jax.device_put(denser))
        found[leaping] = gradient(scene)
    np.testing.assert_allclose(found[True][0], found[False][0], atol=1e-6)
    # rounding in float32 of sums with strong cancellation
    rounding = 1e-6 * float(np.linalg.norm(found[False][1]["[2].focal_point"]))
    assert_same(found[True][1], found[False][1], 1e-4, rounding=rounding)


def test_the_usual_march_is_that_of_switches_and_float32_that_of_an_independent_marcher_in_float64():
    on = {"shift", "alignment", "leaping", "termination"}
    scene = scene_of(switched(on))
    image, found = gradient(scene)
    assert 0.05 < np.mean(image[..., 3] > 0) < 0.95
    assert image[..., 3].max() > 0.95
    given = scene_of(every.plain(on))
    usual, expected = gradient(given)
    np.testing.assert_allclose(image, usual, atol=1e-6)
    shared = {name for name in expected if "transforms" not in name}
    assert_same(chosen(found, shared), chosen(expected, shared), 1e-5)
    rgba, _ = every.oracle_image(*given)
    # where rounding decides of a sample, a ray ends or shifts at another one
    off = np.abs(image - rgba).max(axis=-1) > 2e-5
    assert np.mean(off) < 0.01


def double_scene(on, camera="inside", **values):
    return scene_of(switched(on, **values), "float64", camera, most=128)


@settings(max_examples=1)
@given(**RANDOM, left=st.floats(0.01, 0.3))
@example(on=every.MOST, seed=1, camera="outside", left=0.05)
@example(on=every.OTHERS - {"hollow"}, seed=2, camera="inside", left=0.05)
def test_every_adjoint_has_the_same_derivatives(on, seed, camera, left):
    """Of every leaf in float64: replay and forward mode of the fast engine, JAX's own of the reference."""
    with in_float64():
        scene = double_scene(on, camera, seed=seed, left=left)
        image, found = gradient(scene)
        other, expected = gradient(scene, "direct")
        np.testing.assert_allclose(image, other, atol=1e-12)
        assert_same(found, expected, 1e-9, rounding=1e-12)
        assert_same_forward(scene, found, 1e-9)


@settings(max_examples=1)
@given(on=RANDOM["on"], seed=st.integers(0, 2**32 - 1))
@example(on=every.MOST, seed=1)
@example(on=every.OTHERS - {"hollow"}, seed=2)
def test_gradients_are_central_differences(on, seed):
    """In a scene without jumps: the last cell is cut at the exit, no ray ends early, and the camera is in
    empty space, so that the first transparent sample of each ray stays the same. Every leaf by itself."""
    with in_float64():
        scene = double_scene((on | {"alignment"}) - {"termination", "clip"}, seed=seed)
        _, found = gradient(scene)
        for name, way in along(scene):
            # With 1e-7, a few of the 40 000 samples cross a voxel face or a control point, where the slope
            # changes; with 1e-9, rounding is visible.
            h = 1e-8

            def moved(by, way=way):
                return jax.tree.map(
                    lambda leaf, each: leaf if each is None else jax.device_put(np.asarray(leaf) + by * each),
                    scene,
                    way,
                    is_leaf=lambda leaf: leaf is None,
                )

            more, less = (in_one_program(moved(by), "replay")[0][0] for by in (h, -h))
            difference = (float(more) - float(less)) / (2 * h)
            dot = np.vdot(found[name], at(way, name))
            assert abs(difference - dot) <= 1e-5 * np.linalg.norm(found[name]) + 1e-6, name


# A diverged fit must not look like a good one. Constructors check their arguments; optimisers replace leaves.


def some_finite(found):
    """Names of leaves whose gradient is not NaN everywhere, but for those that have none by `"direct"`;
    `by_path` set some of `extinction` to 0."""
    none = ".values", ".corner", ".opacity_left"
    moving = {name: leaf for name, leaf in found.items() if not name.endswith(none)}
    return [name for name, leaf in moving.items() if not np.any(leaf) or not np.isnan(leaf[leaf != 0]).all()]


def test_nan_and_infinity_reach_image_and_gradient():
    with in_float64():
        scene = double_scene({"alignment", "leaping", "termination"}, "outside")
        whole = {name: where for name, where in LEAVES.items() if name != "voxels"}
        whole["values"] = lambda scene: scene[1].values
        inner = [getattr(each, "inner", None) for each in scene[3].transforms]
        ends = [isinstance(each, jv.EarlyTermination) for each in inner].index(True)
        whole["opacity_left"] = lambda scene: scene[3].transforms[ends].inner.opacity_left
        for number, (name, where) in enumerate(whole.items()):
            # in the reference, of which each image takes as long as ten others, every third
            direct = [(np.nan, "direct")] if number % 3 == 0 else []
            for fault, adjoint in ((np.nan, "replay"), (np.inf, "replay"), *direct):
                leaf = np.array(where(scene))
                leaf.flat[0] = fault
                image, found = gradient(eqx.tree_at(where, scene, jax.device_put(leaf)), adjoint)
                assert np.isnan(image).all(), (name, fault)
                assert not some_finite(found), (name, fault, adjoint)
        position, focal_point = map(np.asarray, (scene[2].position, scene[2].focal_point))
        for name, wrong in (
            *(("step", np.array(step)) for step in (0.0, -0.1)),
            *(("view_angle", np.array(angle)) for angle in (180.0, 270.0, 0.0, -1.0)),
            ("view_up", 2 * (focal_point - position)),
            ("values", np.array(scene[1].values)[::-1]),
            ("spacing", np.array((0.1, -0.1, 0.1))),
        ):
            image, found = gradient(eqx.tree_at(whole[name], scene, jax.device_put(wrong)))
            assert np.isnan(image).all(), (name, wrong)
            assert not some_finite(found), (name, wrong)
        volume, transfer, _, march = scene
        ray = position, (focal_point - position) / np.linalg.norm(focal_point - position)
        seen = lambda t, v, m: jv.render_ray_reference(v, t, *ray, m).rgba.sum()  # noqa: E731
        lost = eqx.tree_at(lambda t: t.colors, transfer, jax.device_put(np.full((6, 3), np.nan)))
        of_ray = eqx.filter_jit(eqx.filter_grad(seen))(lost, volume, march)
        assert np.isnan(of_ray.extinction).all()
        # voxels that are seen, and some in the space that is leapt over: rays that do not meet them keep
        # their pixels
        for place in (np.s_[5:8, 9:13, 7:11], np.s_[2:5, 2:5, 22:27]):
            image, found = gradient((with_voxels(scene[0], place, np.nan), *scene[1:]))
            assert np.isnan(image[..., 3]).any()
            assert not np.isnan(image[..., 3]).all()
            assert np.isnan(found["[1].colors"]).any()
            assert np.isnan(found["[0].data"]).any()


@pytest.mark.slow
def test_the_gradient_does_not_march_with_a_nan_step():
    """Without leaping, each ray would take the maximum of 131 072 cells, which takes several minutes."""
    calls = []

    def count():
        calls.append(1)
        if len(calls) > 1000:
            raise RuntimeError("the march does not end")

    class Counted(jv.Transform):
        def stop(self, stopped, transmittance):
            jax.debug.callback(count)
            return stopped

    scene = scene_of((Counted(),), "float32")
    value = eqx.filter_jit(eqx.filter_value_and_grad(loss, has_aux=True))
    jax.block_until_ready(value(scene))
    jax.effects_barrier()
    assert len(calls) > 1
    calls.clear()
    (found, _), _ = value(eqx.tree_at(LEAVES["step"], scene, jnp.float32(np.nan)))
    assert np.isnan(found)
    jax.effects_barrier()
    assert not calls


def test_rays_that_are_not_finite_are_nan_in_a_program_and_no_others():
    volume, transfer, camera, march = scene_of((), "float32")
    origins, directions = (np.asarray(rays)[::7, ::7] for rays in camera.rays())
    image = jax.jit(lambda *rays: jv.render_rays(volume, transfer, *rays, march=march, outputs="rgba").rgba)
    whole = np.array(image(origins, directions))
    assert np.isfinite(whole).all()
    whole[2, 1] = np.nan
    for number, fault in ((0, np.nan), (0, np.inf), (1, np.nan), (1, np.inf), (1, np.zeros(3))):
        broken = origins.copy(), directions.copy()
        broken[number][2, 1, slice(None) if np.ndim(fault) else 0] = fault
        np.testing.assert_allclose(image(*broken), whole, rtol=0, atol=1e-6)


# Other ways to ask.


USUAL = (jv.EmptySpaceJitter(4), jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination(0.05))


def with_and_without_leaps(*transforms, method=("blocks", 8)):
    """These transforms and leaps, and these alone, by one program."""
    return tuple((*transforms, switch(jv.SpaceLeaping(*method), on)) for on in (True, False))


def test_a_gradient_of_some_leaves_is_that_of_all():
    """Which is another program."""
    scene = scene_of(switched({"shift", "alignment", "leaping"}))
    colors = LEAVES["colors"]
    found = np.asarray(jax.grad(lambda leaf: loss(eqx.tree_at(colors, scene, leaf))[0])(colors(scene)))
    expected = gradient(scene)[1]["[1].colors"]
    assert np.linalg.norm(found - expected) <= 1e-6 * np.linalg.norm(expected)


WRONG_WAYS = {
    "grad of grad": ("replay", lambda loss, x: jax.grad(lambda x: jax.grad(loss)(x) ** 2)(x), '"direct"'),
    "grad of jvp": (
        "replay",
        lambda loss, x: jax.grad(lambda x: jax.jvp(loss, (x,), (x,))[1])(x),
        'pass adjoint="direct"',
    ),
    "grad": ("forward", lambda loss, x: jax.grad(loss)(x), 'pass adjoint="replay"'),
    "grad of jit": ("forward", lambda loss, x: jax.grad(jax.jit(loss))(x), 'pass adjoint="replay"'),
}


@pytest.mark.parametrize("way", WRONG_WAYS)
def test_the_wrong_way_to_differentiate_is_named_with_what_to_pass(way):
    adjoint, differentiate, message = WRONG_WAYS[way]
    volume, transfer, camera, _ = scene_of(())

    def total(step):
        return jv.render(volume, transfer, camera, jv.March(step), adjoint=adjoint).rgba.sum()

    with pytest.raises(ValueError, match=message):
        jax.eval_shape(lambda step: differentiate(total, step), jnp.asarray(0.07))


def test_vmap_is_a_loop_for_image_and_gradient():
    """Over cameras, steps and seeds; the rest is closed over. In float64, where the loop needs no program."""
    with in_float64():
        on = {"jitter", "alignment", "leaping"}
        scenes = [double_scene(on, "outside", seed=i) for i in range(3)]
        moved = [
            (s[2].zoom(1 + 0.2 * i), jv.March(0.03 + 0.01 * i, s[3].transforms, "left", max_samples=128))
            for i, s in enumerate(scenes)
        ]
        volume, transfer = scenes[0][:2]

        def both(part, program=in_one_program):
            (_, image), found = program((volume, transfer, *part), "replay")
            return image, found

        together = jax.tree.map(lambda *leaves: np.stack(leaves), *moved)
        images, gradients = jax.device_get(eqx.filter_jit(eqx.filter_vmap(both))(together))
        assert np.abs(images[0] - images[1]).max() > 1e-3
        for i, part in enumerate(moved):
            image, found = jax.device_get(both(part))
            np.testing.assert_allclose(images[i], image, atol=1e-12)
            own, scene = jax.tree.map(lambda leaf, i=i: leaf[i], gradients), (volume, transfer, *part)
            assert_same(by_path(own, scene), by_path(found, scene), 1e-9, rounding=1e-12)


@pytest.mark.slow
def test_vmap_of_forward_mode():
    volume, transfer, camera, march = scene_of(USUAL, most=128)

    def along_(view_angle):
        def of(angle):
            moved = eqx.tree_at(LEAVES["view_angle"], (volume, transfer, camera, march), angle)
            return loss(moved, "forward")[0]

        return jax.jvp(of, (view_angle,), (jnp.ones_like(view_angle),))

    angles = jnp.asarray([25.0, 30.0, 35.0])
    for many, *each in zip(jax.vmap(along_)(angles), *map(along_, angles), strict=True):
        np.testing.assert_allclose(many, each, rtol=1e-5, atol=1e-3)


# Other types of voxels, methods, sizes and scenes.


@pytest.mark.slow
def test_leaps_do_not_show_in_gradients_by_voxels():
    leapt, whole = (gradient(scene_of(t, "float32"))[1] for t in with_and_without_leaps(*USUAL[:2], USUAL[3]))
    assert_same(leapt, whole, 1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["beam", "min_distance"])
def test_forward_and_replay_gradients_agree_under_every_method(method):
    """Also for `"min_distance"`, whose image differs from that of the other methods."""
    transforms, unleapt = with_and_without_leaps(*USUAL[:2], method=(method, 4))
    whole = gradient(scene_of(unleapt))[1]
    for camera in CAMERAS:
        scene = scene_of(transforms, camera=camera)
        _, found = gradient(scene)
        assert_same_forward(scene, found, 1e-4)
        if camera == "outside" and method != "min_distance":
            assert_same(found, whole, 1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("quadrature", "more"),
    [
        ("preintegrated", ()),
        ("midpoint", (jv.Clip(BOX, [PLANE], inside_out=True),)),
    ],
    ids=["preintegrated", "hollowed"],
)
def test_other_quadratures_and_gaps(quadrature, more):
    both = with_and_without_leaps(jv.EmptySpaceJitter(4), jv.AlphaCorrection(), *more)
    leapt, whole = (gradient(scene_of(transforms, quadrature=quadrature))[1] for transforms in both)
    assert_same(leapt, whole, 1e-4)


@pytest.mark.slow
def test_float32_gradients_are_those_of_float64():
    single = gradient(scene_of(USUAL[:3]))[1]
    with in_float64():
        assert_same(single, gradient(scene_of(USUAL[:3]))[1], 1e-3)


@pytest.mark.slow
def test_tiles_and_batches_of_rays_do_not_show():
    """1.07 million pixels: two tiles, and tens of batches."""
    found = []
    for transforms in with_and_without_leaps(*USUAL[:2]):
        volume, transfer, camera, march = scene_of(transforms)
        large = jv.Camera(camera.position, camera.focal_point, camera.view_up, 30.0, size=(1040, 1030))
        found.append(gradient((volume, transfer, large, march))[1])
    leapt, whole = found
    assert_same(leapt, whole, 1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("by_label", [True, False])
def test_functions_by_label_and_rays_of_ones_own(by_label):
    """Replay with and without leaps, forward mode and differences."""
    labels = (np.indices(SHAPE).sum(axis=0) // 9 % 3).astype(np.uint8)
    with in_float64():

        def of(given, leaps, adjoint):
            jitter, aligned = jv.Jitter(3), jv.AlphaCorrection(labels=by_label)
            volume, transfer, camera, march = scene_of((jitter, aligned, *leaps), "float64")
            if not by_label:
                rgba = jv.render_rays(volume, transfer, *given, march=march, adjoint=adjoint).rgba
                return jnp.sum(rgba * np.random.default_rng(5).normal(size=rgba.shape))
            volume = jv.Volume(volume.data, volume.spacing, volume.origin, labels)
            first, last = (jv.TransferFunction(transfer.values, *leaves) for leaves in given)
            return loss((volume, jv.LabelTransferFunction([first, None, last]), camera, march), adjoint)[0]

        _, transfer, camera, _ = scene_of(())
        given = (transfer.colors, transfer.extinction), (1 - transfer.colors, 2 * transfer.extinction)
        if not by_label:
            # directions that are not normalized, and rays that are no rectangular image
            origins, directions = camera.rays()
            given = origins.reshape(-1, 3)[:500], 3 * directions.reshape(-1, 3)[:500]
        signs = jax.tree.map(lambda leaf: jnp.where(leaf == 0, 0, jnp.ones_like(leaf)), given)
        leaps, none = with_and_without_leaps()
        whole, found = (
            jax.tree.map(
                lambda a, b: np.asarray(a * b), jax.grad(lambda g, w=w: of(g, w, "replay"))(given), signs
            )
            for w in (none, leaps)
        )
        norm = np.sqrt(sum(np.sum(leaf**2) for leaf in jax.tree.leaves(whole)))
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(whole), strict=True):
            assert np.linalg.norm(a - b) <= 1e-9 * norm
        slope = sum(np.sum(leaf) for leaf in jax.tree.leaves(found))
        forward = jax.jvp(lambda g: of(g, leaps, "forward"), (given,), (signs,))[1]
        assert abs(forward - slope) <= 1e-9 * norm
        ends = [
            of(jax.tree.map(lambda leaf, sign, h=h: leaf + h * sign, given, signs), leaps, "replay")
            for h in (1e-6, -1e-6)
        ]
        assert abs((ends[0] - ends[1]) / 2e-6 - slope) <= 1e-5 * norm


FILES = {
    "engine": "engine_256x256x128_uint8.raw.gz",
    "bonsai": "bonsai_256x256x256_uint8.raw.gz",
    "lidc0314_airway": "lidc0314_airway_256x192x200_int16le.raw.gz",
    "aneurism": "aneurism_256x256x256_uint8.raw.gz",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", [real_scenes.PHANTOM, "lidc0314_airway"])
def test_leaps_do_not_show_in_gradients_of_the_scenes_of_the_experiments(name, real_volume):
    folder = None if name == real_scenes.PHANTOM else real_volume(FILES[name]).parent
    scene = real_scenes.SCENES[name](folder, 128)
    found = [
        gradient(
            (*scene[:3], jv.March(scene.step, (jv.AlphaCorrection(), *leaps, jv.EarlyTermination(1 / 255))))
        )[1]
        for leaps in ((jv.SpaceLeaping(),), ())
    ]
    shared = {path for path in found[1] if "transforms" not in path}
    assert_same(chosen(found[0], shared), chosen(found[1], shared), 1e-4)


def workspace(samples, size=512, resolution=256):
    """Bytes of temporary memory of the compiled gradient."""
    data = jnp.zeros((resolution,) * 3)
    small = jv.Volume(jnp.zeros((2, 2, 2)), (2 / (resolution - 1),) * 3, (-1.0,) * 3)
    camera = jv.Camera((3, 2, 2.5), (0, 0, 0), size=(size, size))
    march = jv.March(3.4 / samples, (jv.AlphaCorrection(), jv.EarlyTermination(0.01)))
    transfer = scene_of((), "float32")[1]

    def total(given):
        data, transfer, camera = given
        volume = eqx.tree_at(lambda v: v.data, small, data)
        return jnp.sum(jv.render(volume, transfer, camera, march).rgba ** 2)

    analysis = jax.jit(jax.grad(total)).lower((data, transfer, camera)).compile().memory_analysis()
    assert analysis is not None
    return analysis.temp_size_in_bytes


@pytest.mark.slow
def test_memory_of_the_gradient_does_not_grow_with_the_number_of_samples():
    few, many = workspace(128), workspace(2048)
    assert many <= 1.05 * few
    assert many <= 2**30


@pytest.mark.slow
@pytest.mark.parametrize("quadrature", ["midpoint", "preintegrated"])
def test_hessians_of_integrated_cells_have_the_bends_of_the_transfer_function(quadrature):
    """By finite changes of the voxels that pass control points: of sampled cells, most of it is missing."""
    with in_float64():
        random, (x, y, z) = np.random.default_rng(1), np.meshgrid(*[np.linspace(-1, 1, 8)] * 3, indexing="ij")
        voxels = jnp.asarray(np.exp(-2 * (x**2 + y**2 + z**2)) + 0.2 * np.sin(5 * x) * np.cos(4 * y))
        volume = jv.Volume(voxels, (2 / 7,) * 3, (-1, -1, -1))
        camera = jv.Camera.looking_at(volume, (1, 0.2, 0.1), size=(8, 8))
        wanted, along = jnp.asarray(random.random((8, 8, 4))), random.normal(size=voxels.shape)
        along = jnp.asarray(along / np.linalg.norm(along))
        points = np.linspace(-0.5, 1.5, 16), random.random((16, 3)), np.tile([0.1, 3.0], 8)
        transfer, march = jv.TransferFunction(*points), jv.March(0.2, (jv.AlphaCorrection(),), quadrature)

        @jax.jit
        def gradient_and_product(voxels):
            def loss(voxels):
                seen = eqx.tree_at(lambda volume: volume.data, volume, voxels)
                return jnp.sum((jv.render(seen, transfer, camera, march, outputs="rgba").rgba - wanted) ** 2)

            return jax.jvp(jax.grad(loss), (voxels,), (along,))

        _, product = gradient_and_product(voxels)
        after, before = (gradient_and_product(voxels + e * along)[0] for e in (0.03, -0.03))
        change = (after - before) / 0.06
        missing = float(jnp.linalg.norm(product - change) / jnp.linalg.norm(change))
        assert missing < 0.01 if quadrature == "preintegrated" else missing > 0.5, missing
