"""Is a gradient the same however it is computed? For every leaf of a scene, each adjoint, each method of
space leaping and each type of voxel.

The scene resembles users' scenes: it has empty space between visible objects, rays that miss the volume, rays
that see nothing in it, and several beams of rays, the last one incomplete. All options have their defaults.
Most gradients are computed as users compute them, by `jax.grad` of `render` outside `jax.jit`, where small
voxel types are fetched from their packed copy. Nearly all the time is compilation: 10 to 15 CPU seconds for
the two programs of a gradient, which all cameras, transfer functions and voxels of one type share.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import jaxvol as jv
from experiments import scenes as real_scenes

from ..scenes import LEAVES, in_float64, to_float64


SHAPE = (26, 21, 31)
SIZE = (37, 21)
"""More than one beam of 16 x 16 pixels along each axis."""

BOX, PLANE = (0.5, 1.8, -0.2, 1.2, 0.3, 1.6), ((0.6, 0.5, 0.6), (0.5, -0.2, 0.6))
"""A clip that leaves a part of each blob, on either side of it."""

SETS = {
    "plain": ("left", ()),
    "aligned": ("midpoint", (jv.AlphaCorrection(),)),
    "jittered": ("left", (jv.Jitter(3), jv.AlphaCorrection(), jv.EarlyTermination(0.05))),
    "moving": ("left", (jv.EmptySpaceJitter(4), jv.AlphaCorrection())),
    "integrated": ("preintegrated", (jv.EmptySpaceJitter(4), jv.AlphaCorrection())),
    "adaptive": ("midpoint", (jv.EmptySpaceJitter(4), jv.AlphaCorrection(), jv.AdaptiveSampling(0.03))),
    "residual": ("midpoint", (jv.Jitter(3, "blue", front_residual=True), jv.AlphaCorrection())),
    "clipped": ("midpoint", (jv.EmptySpaceJitter(4), jv.AlphaCorrection(), jv.Clip(BOX, [PLANE]))),
    "hollowed": (
        "left",
        (jv.EmptySpaceJitter(4), jv.AlphaCorrection(), jv.Clip(BOX, [PLANE], inside_out=True)),
    ),
}

EXACT = ["hierarchy", "distance", "beam"]
"""Methods that never leap over anything visible."""

METHODS = [None, *EXACT, "min_distance"]

TOPS = {"uint8": 255, "uint16": 60_000, "int16": 4000, "float32": 1, "float64": 1}
"""Largest value of a volume of each type."""

CAMERAS = {
    "outside": ((3.1, -3.9, 2.4), (1.1, 0.5, 1.0), 30.0),
    "inside": ((1.15, 0.45, 1.0), (0.7, 0.6, 0.6), 70.0),
    "past it": ((3.1, -3.9, 2.4), (1.9, 0.9, 1.6), 30.0),
}
"""Position, focal point and view angle. `"parallel"` is `"outside"` in parallel projection."""

slow = pytest.mark.slow


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


def scene_of(name="jittered", method=None, dtype="uint8", camera="outside", max_samples=None):
    """A scene of blobs with a set of transforms and a method of leaping, in JAX's current float type."""
    quadrature, transforms = SETS[name]
    transforms = transforms if method is None else (*transforms, jv.SpaceLeaping(method, 4))
    volume = jv.Volume(blobs(dtype), (0.07, 0.09, 0.06), (0.2, -0.4, 0.1))
    values, extinction = np.array([0.0, 0.1, 0.3, 0.5, 0.7, 1.0]), np.array([0.0, 0.0, 4.0, 12.0, 0.0, 36.0])
    if name == "moving":  # enough control points to be looked up by a search
        few, values = values, np.linspace(0, 1, 31)
        extinction = np.interp(values, few, extinction)
    colors = np.random.default_rng(2).random((len(values), 3))
    transfer = jv.TransferFunction(values * TOPS[dtype], colors, extinction)
    parallel = 0.8 if camera == "parallel" else None
    position, target, angle = CAMERAS["outside" if parallel else camera]
    camera = jv.Camera(position, target, (0.1, 0.2, 1), angle, size=SIZE, parallel_scale=parallel)
    if jax.config.read("jax_enable_x64"):
        transforms = to_float64(transforms)
    return volume, transfer, camera, jv.March(0.043, transforms, quadrature, max_samples=max_samples)


def loss(scene, adjoint="replay"):
    """A scalar function of image and depths, without cancellation."""
    return loss_and_opacity(scene, adjoint)[0]


def loss_and_opacity(scene, adjoint):
    rendering = jv.render(*scene, adjoint=adjoint)
    opacity = rendering.rgba[..., 3]
    weights = np.random.default_rng(5).normal(size=(*opacity.shape, 5))
    depth = jnp.where(opacity > 0, rendering.depth, 0) * opacity
    seen = jnp.concatenate([rendering.rgba, depth[..., None]], axis=-1)
    return jnp.sum(seen * jnp.asarray(weights, seen.dtype)), opacity


def gradient(scene, adjoint="replay", *, empty=False):
    """Gradients of all leaves by name, those of extinctions of 0 set to 0. `empty`: assert that some rays see
    nothing and others become opaque."""
    take = eqx.filter_grad(functools.partial(loss_and_opacity, adjoint=adjoint), has_aux=True)
    found, opacity = take(scene)
    assert not empty or (0.05 < np.mean(opacity > 0) < 0.95 and opacity.max() > 0.95)
    leaves = {name: where(found) for name, where in LEAVES.items()}
    leaves["extinction"] = jnp.where(scene[1].extinction > 0, leaves["extinction"], 0)
    return {name: np.asarray(leaf) for name, leaf in leaves.items() if leaf is not None}


def directions(scene, seed=0):
    """For every leaf, a random direction that changes only this leaf: (name, tangent of the scene).
    Extinctions of 0 do not change."""
    random = np.random.default_rng(seed)
    still = jax.tree.map(lambda leaf: jnp.zeros_like(leaf) if eqx.is_inexact_array(leaf) else None, scene)
    for name, where in LEAVES.items():
        leaf = where(scene)
        if not eqx.is_inexact_array(leaf):
            continue
        along = jnp.asarray(random.choice([-1.0, 1.0], leaf.shape), leaf.dtype)
        along = jnp.where(leaf > 0, along, 0) if name == "extinction" else along
        yield name, eqx.tree_at(where, still, along)


def slopes(scene, adjoint="forward"):
    """Directional derivatives of the loss along each direction, by forward mode."""

    def slope(tangent):
        return eqx.filter_jvp(functools.partial(loss, adjoint=adjoint), (scene,), (tangent,))[1]

    return {name: float(slope(tangent)) for name, tangent in directions(scene)}


def central(scene, h=1e-8):
    """The same by central differences of the value that `jax.value_and_grad` returns.

    With h = 1e-7, a few of the 40 000 samples cross a voxel face or a control point, where the slope changes:
    a change of the spacing by h moves the far samples by 250 h voxels. With 1e-9, rounding is visible."""
    value = eqx.filter_value_and_grad(loss)

    def moved(tangent, by):
        return jax.tree.map(
            lambda leaf, along: leaf if along is None else leaf + by * along,
            scene,
            tangent,
            is_leaf=lambda leaf: leaf is None,
        )

    return {
        name: float(value(moved(tangent, h))[0] - value(moved(tangent, -h))[0]) / (2 * h)
        for name, tangent in directions(scene)
    }


def assert_same(found, expected, tolerance, context="", absent=()):
    """Each leaf's gradient agrees to `tolerance` times its norm, which is not 0, except for the `absent`
    leaves, on which nothing depends."""
    assert found.keys() == expected.keys()
    for name, want in expected.items():
        norm = np.linalg.norm(want)
        assert (norm == 0) == (name in absent), (context, name)
        error = np.linalg.norm(found[name] - want)
        assert error <= tolerance * norm, f"{context} {name}: off by {error:.1e}, norm {norm:.3g}"


def assert_slopes(found, gradients, scene, tolerance, context="", absent=()):
    """Slopes along `directions`, whose components are ±1, agree to `tolerance` times the gradient's norm, as
    `assert_same` has it."""
    for name, tangent in directions(scene):
        along, norm = np.asarray(LEAVES[name](tangent)), np.linalg.norm(gradients[name])
        assert (norm == 0) == (name in absent), (context, name)
        error = abs(found[name] - np.vdot(gradients[name], along))
        assert error <= tolerance * norm, f"{context} {name}: off by {error:.1e}, norm {norm:.3g}"


DEFAULT = "hierarchy"
FAST = {("jittered", DEFAULT, "uint8")}
TYPES = ["uint8", "uint16", "int16", "float32"]
LEAPING = [
    *((name, method, "uint8") for name in SETS for method in EXACT),
    *(("moving", "hierarchy", dtype) for dtype in TYPES[1:]),
]


@pytest.mark.parametrize(
    ("name", "method", "dtype"),
    [case if case in FAST else pytest.param(*case, marks=slow) for case in LEAPING],
)
def test_leaping_does_not_change_replay_gradients(name, method, dtype):
    for camera in CAMERAS:
        found, expected = (
            gradient(scene_of(name, leaps, dtype, camera), empty=True) for leaps in (method, None)
        )
        assert_same(found, expected, 1e-4, camera)


@pytest.mark.parametrize("method", [m if m == DEFAULT else pytest.param(m, marks=slow) for m in EXACT])
def test_no_leap_shows_in_a_gradient_whatever_is_rendered(method):
    """Invariant 2 for gradients, with random cameras, transfer functions, voxels, seeds and steps."""

    @settings(max_examples=6, deadline=None, derandomize=True)
    @given(
        seed=st.integers(0, 1000),
        away=st.floats(0.2, 6),
        step=st.floats(0.02, 0.2),
        dense=st.floats(0.05, 20),
        shown=st.lists(st.booleans(), min_size=6, max_size=6),
    )
    def check(seed, away, step, dense, shown):
        random = np.random.default_rng(seed)
        volume, transfer, camera, march = scene_of("jittered", method)
        volume = jv.Volume(blobs("uint8", seed), volume.spacing, volume.origin)
        side = random.normal(size=3)
        position = np.asarray(volume.center) + away * side / np.linalg.norm(side)
        target = np.asarray(volume.center) + random.uniform(-0.3, 0.3, 3)
        camera = jv.Camera(position, target, random.normal(size=3), random.uniform(15, 90), size=SIZE)
        extinction = np.where(shown, dense * random.random(6), 0)
        transfer = jv.TransferFunction(transfer.values, random.random((6, 3)), extinction)
        transforms = (jv.Jitter(seed), *march.transforms[1:])
        scenes = [(volume, transfer, camera, jv.March(step, used)) for used in (transforms, transforms[:-1])]
        found, expected = map(gradient, scenes)
        for name, want in expected.items():
            assert np.isfinite(found[name]).all(), name
            # rounding in float32 of sums with strong cancellation
            rounding = 1e-6 * np.linalg.norm(expected["focal_point"])
            assert np.linalg.norm(found[name] - want) <= 1e-4 * np.linalg.norm(want) + rounding, name

    check()


FORWARD = [
    *(("jittered", method, "uint8") for method in METHODS),
    *(("moving", method, "uint8") for method in METHODS),
    *(
        (name, "hierarchy", "uint8")
        for name in ("plain", "aligned", "integrated", "residual", "clipped", "hollowed")
    ),
    *(("moving", "hierarchy", dtype) for dtype in TYPES[1:]),
]


@pytest.mark.parametrize(
    ("name", "method", "dtype"),
    [case if case in FAST else pytest.param(*case, marks=slow) for case in FORWARD],
)
def test_forward_and_replay_gradients_agree(name, method, dtype):
    """Also for `"min_distance"`, whose image differs from that of the other methods."""
    for camera in CAMERAS:
        scene = scene_of(name, method, dtype, camera)
        assert_slopes(slopes(scene), gradient(scene), scene, 1e-4, camera)


@pytest.mark.parametrize(
    ("name", "method", "dtype"),
    [
        ("moving", "hierarchy", "float64"),
        *(
            pytest.param(name, None, "float64", marks=slow)
            for name in ("aligned", "moving", "integrated", "residual")
        ),
        *(pytest.param("moving", method, "uint8", marks=slow) for method in EXACT),
    ],
)
def test_gradients_are_central_differences(name, method, dtype):
    """In a scene without jumps: the last cell is cut at the exit, no ray ends early, and the camera is in
    empty space, so that the first transparent sample of each ray stays the same."""
    with in_float64():
        scene = scene_of(name, method, dtype, "inside")
        assert_slopes(central(scene), gradient(scene), scene, 1e-5)


@slow
@pytest.mark.parametrize("name", SETS)
def test_adjoints_agree_to_rounding(name):
    with in_float64():
        for camera in (*CAMERAS, "parallel"):
            scene = scene_of(name, None, "float64", camera, max_samples=128)
            expected = gradient(scene, "direct")
            absent = ("view_angle",) if camera == "parallel" else ()
            assert_same(gradient(scene), expected, 1e-9, camera, absent)
            assert_slopes(slopes(scene), expected, scene, 1e-9, camera, absent)
            for method in EXACT:
                leapt = scene_of(name, method, "float64", camera)
                assert_same(gradient(leapt), expected, 1e-9, f"{camera}, {method}", absent)


@slow
@pytest.mark.parametrize("method", EXACT)
def test_gradients_under_jit_are_those_without(method):
    """Under `jax.jit`, voxels are traced and therefore not packed."""
    scene = scene_of("moving", method)
    inside = eqx.filter_jit(eqx.filter_grad(loss))(scene)
    leaves = {name: np.asarray(where(inside)) for name, where in LEAVES.items() if where(inside) is not None}
    leaves["extinction"] = np.where(scene[1].extinction > 0, leaves["extinction"], 0)
    assert_same(leaves, gradient(scene), 1e-4)


@pytest.mark.parametrize(
    "asked",
    [("voxels",), *(pytest.param(asked, marks=slow) for asked in (("extinction", "position"), ("step",)))],
)
def test_only_what_is_asked_for_is_computed_and_it_is_the_same(asked):
    """A program of its own for each set of leaves."""
    scene = scene_of("aligned", "hierarchy", "float32")
    leaves = [LEAVES[name](scene) for name in asked]

    def of(leaves):
        return loss(eqx.tree_at(lambda s: [LEAVES[name](s) for name in asked], scene, leaves))

    expected = gradient(scene)
    found = dict(zip(asked, jax.grad(of)(leaves), strict=True))
    if "extinction" in asked:
        found["extinction"] = jnp.where(scene[1].extinction > 0, found["extinction"], 0)
    assert_same(found, {name: expected[name] for name in asked}, 1e-5)


@slow
def test_tiles_and_batches_of_rays_do_not_show():
    """1.07 million pixels: two tiles, and tens of batches."""
    gradients = {}
    for method in (None, "hierarchy"):
        volume, transfer, camera, march = scene_of("jittered", method)
        large = jv.Camera(camera.position, camera.focal_point, camera.view_up, 30.0, size=(1040, 1030))
        gradients[method] = gradient((volume, transfer, large, march))
    assert_same(gradients["hierarchy"], gradients[None], 1e-4)


@slow
def test_float32_gradients_are_those_of_float64():
    single = gradient(scene_of("moving", "hierarchy"))
    with in_float64():
        double = gradient(scene_of("moving", "hierarchy"))
    assert_same(single, double, 1e-3)


def assert_slopes_of(of, given, leaps, context=""):
    """For `of(parameters, method, adjoint)`: replay with and without leaping, forward mode and differences
    agree."""
    random = np.random.default_rng(0)
    signs = jax.tree.map(lambda leaf: jnp.asarray(random.choice([-1.0, 1.0], leaf.shape)), given)
    signs = jax.tree.map(lambda sign, leaf: jnp.where(leaf == 0, 0, sign), signs, given)
    floats = {}
    for method in (None, leaps):
        found = jax.grad(lambda g, m=method: of(g, m, "replay"))(given)
        floats[method] = [np.asarray(leaf) for leaf in jax.tree.leaves(found)]
    norm = np.linalg.norm([np.linalg.norm(leaf) for leaf in floats[None]])
    for found, expected, leaf in zip(floats[leaps], floats[None], jax.tree.leaves(given), strict=True):
        found, expected = (np.where(leaf == 0, 0, part) for part in (found, expected))
        assert np.linalg.norm(found - expected) <= 1e-9 * norm, context
    slope = sum(np.vdot(part, sign) for part, sign in zip(floats[leaps], jax.tree.leaves(signs), strict=True))
    forward = jax.jvp(lambda g: of(g, leaps, "forward"), (given,), (signs,))[1]
    ends = [
        of(jax.tree.map(lambda leaf, sign, h=h: leaf + h * sign, given, signs), leaps, "replay")
        for h in (1e-6, -1e-6)
    ]
    assert abs(forward - slope) <= 1e-9 * norm, context
    assert abs((ends[0] - ends[1]) / 2e-6 - slope) <= 1e-5 * norm, context


@slow
@pytest.mark.parametrize("method", EXACT)
def test_functions_by_label(method):
    labels = (np.indices(SHAPE).sum(axis=0) // 9 % 3).astype(np.uint8)
    with in_float64():

        def of(given, leaps, adjoint):
            volume, transfer, camera, march = scene_of("jittered", leaps)
            volume = jv.Volume(volume.data, volume.spacing, volume.origin, labels)
            functions = [jv.TransferFunction(transfer.values, *leaves) for leaves in given]
            transfer = jv.LabelTransferFunction([functions[0], None, functions[1]])
            transforms = [t for t in march.transforms if not isinstance(t, jv.AlphaCorrection)]
            march = jv.March(march.step, (*transforms, jv.AlphaCorrection(labels=True)))
            return loss((volume, transfer, camera, march), adjoint)

        transfer = scene_of()[1]
        given = [
            (transfer.colors, transfer.extinction),
            (1 - transfer.colors, 2 * transfer.extinction),
        ]
        assert_slopes_of(of, given, method)


@slow
@pytest.mark.parametrize("method", EXACT[:2])
def test_rays_of_ones_own(method):
    with in_float64():

        def of(given, leaps, adjoint):
            volume, transfer, _, march = scene_of("jittered", leaps)
            rendering = jv.render_rays(volume, transfer, *given, march=march, adjoint=adjoint)
            weights = np.random.default_rng(5).normal(size=rendering.rgba.shape)
            return jnp.sum(rendering.rgba * jnp.asarray(weights))

        origins, directions = scene_of()[2].rays()
        # directions that are not normalized, and rays that are no rectangular image
        assert_slopes_of(of, (origins.reshape(-1, 3)[:500], 3 * directions.reshape(-1, 3)[:500]), method)


FILES = {
    "engine": "engine_256x256x128_uint8.raw.gz",
    "bonsai": "bonsai_256x256x256_uint8.raw.gz",
    "lidc0314_airway": "lidc0314_airway_256x192x200_int16le.raw.gz",
    "aneurism": "aneurism_256x256x256_uint8.raw.gz",
}


@slow
@pytest.mark.parametrize("name", real_scenes.SCENES)
def test_adjoints_agree_on_the_scenes_of_the_experiments(name, real_volume):
    folder = None if name == real_scenes.PHANTOM else real_volume(FILES[name]).parent
    scene = real_scenes.SCENES[name](folder, 128)

    def leapt(method):
        leaps = () if method is None else (jv.SpaceLeaping(method),)
        transforms = (jv.AlphaCorrection(), *leaps, jv.EarlyTermination(1 / 255))
        return *scene[:3], jv.March(scene.step, transforms)

    expected = gradient(leapt(None))
    for method in EXACT:
        found = gradient(leapt(method))
        assert_same(found, expected, 1e-4, method)
        assert_slopes(slopes(leapt(method)), found, leapt(method), 1e-4, method)
