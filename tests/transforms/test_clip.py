"""Is that part of the volume seen which a clip leaves, and are cut faces like the volume's own?"""

import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.march import Cell
from jaxvol.metrics import boundary_noise
from jaxvol.occupancy import Blocks
from jaxvol.space import Ray, Straight, enter

from .. import oracle
from ..scenes import (
    BOX,
    PLANE,
    anisotropic_noise,
    around,
    counting,
    in_float64,
    scaled_phantom,
    slow,
    soft_transfer,
    uniform_transfer,
)
from . import test_space_leaping as leaping, test_toroidal_map as toroidal


ALIGNED = jv.AlphaCorrection()
EVERYWHERE = (-9.0, 9.0) * 3


@functools.cache
def constant():
    """[-1, 1]³, filled with 1."""
    return scaled_phantom("constant")


def kept_lengths(origins, directions, planes, inside_out, low=(-1.0,) * 3, high=(1.0,) * 3):
    """Length of each ray in a box that is left by the planes, in float64."""
    t_in, t_out = oracle.box_interval(origins, directions, low, high)
    first, last = oracle.side_interval(origins, directions, planes)
    clipped = np.maximum(np.minimum(t_out, last) - np.maximum(t_in, first), 0)
    return np.maximum(t_out - t_in, 0) - clipped if inside_out else clipped


def random_rays(seed, count=64):
    """Rays toward [-1, 1]³, some of them along an axis; a third begin within it."""
    random = np.random.default_rng(seed)
    targets = random.uniform(-1, 1, (count, 3))
    origins = targets + random.normal(size=(count, 3)) * np.where(np.arange(count) % 3, 3.0, 0.3)[:, None]
    directions = (targets - origins) / np.linalg.norm(targets - origins, axis=1, keepdims=True)
    directions[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    return origins.astype(np.float32), directions.astype(np.float32)


def in_double(rays):
    """Origins and directions, each of shape (n, 3)."""
    origins, directions = (np.asarray(part, np.float64).reshape(-1, 3) for part in rays)
    return origins, directions


# ---- which part is seen ----


@pytest.mark.parametrize("inside_out", [False, True])
@pytest.mark.parametrize("step", [0.13, 5.0])
def test_a_constant_volume_is_exact_at_any_step(inside_out, step):
    """1 - exp(-σ · length that is left), for boxes and planes of all kinds, and rays from everywhere."""

    @settings(max_examples=25, deadline=None)
    @given(seed=st.integers(0, 10**6))
    def check(seed):
        random = np.random.default_rng(seed)
        origins, directions = random_rays(seed)
        ends = np.sort(random.uniform(-1.6, 1.6, (3, 2)), axis=1).reshape(-1)
        pairs = [
            (random.uniform(-0.8, 0.8, 3), random.normal(size=3) * 10 ** random.uniform(-3, 3))
            for _ in range(2)
        ]
        march = jv.March(step, (ALIGNED, jv.Clip(ends, pairs, inside_out=inside_out)))
        rgba = jv.render_rays(constant(), uniform_transfer(1.5), origins, directions, march).rgba
        planes = oracle.planes_of(ends, pairs)
        length = kept_lengths(origins.astype(float), directions.astype(float), planes, inside_out)
        np.testing.assert_allclose(rgba[:, 3], 1 - np.exp(-1.5 * length), atol=1e-5)

    check()


CROP = (slice(5, 18), slice(3, 21), slice(8, 16))


@pytest.mark.parametrize(
    "transforms",
    [(jv.Jitter(3), ALIGNED), *slow(((),), ((jv.EmptySpaceJitter(4), jv.EarlyTermination(0.05)),))],
)
def test_a_box_along_the_grid_shows_what_a_cropped_volume_shows(transforms):
    whole = anisotropic_noise()
    spacing, origin = np.asarray(whole.spacing, float), np.asarray(whole.origin, float)
    low = origin + spacing * [part.start for part in CROP]
    high = origin + spacing * [part.stop - 1 for part in CROP]
    part = jv.Volume(np.asarray(whole.data)[CROP], whole.spacing, low)
    camera, transfer = around(whole).zoom(2.5), soft_transfer()
    clipped = jv.March(0.07, (*transforms, jv.Clip(np.stack([low, high], axis=1).reshape(-1))))
    cut = jv.render(whole, transfer, camera, clipped)
    cropped = jv.render(part, transfer, camera, jv.March(0.07, transforms))
    off = np.abs(np.asarray(cut.rgba - cropped.rgba)).max(axis=-1)
    same = np.asarray(cut.samples) == np.asarray(cropped.samples)
    assert 0.2 < np.mean(np.asarray(cut.samples) > 0) < 0.9
    assert same.mean() > 0.99
    assert off[same].max() < 2e-5
    np.testing.assert_allclose(cut.depth[same], cropped.depth[same], rtol=1e-5)


def opacity_of(rays, box=EVERYWHERE, planes=(), *, inside_out=False, extinction=1.5, transforms=(ALIGNED,)):
    """Opacity of `constant`. Always of two planes, so that one program serves all."""
    origins, directions = rays
    aside = [((0, 0, -9), (0, 0, 1))] * (2 - len(planes))
    march = jv.March(0.13, (*transforms, jv.Clip(box, [*planes, *aside], inside_out=inside_out)))
    rendering = jv.render_rays(constant(), uniform_transfer(extinction), origins, directions, march)
    return np.asarray(rendering.rgba[:, 3])


def test_what_misses_the_volume_or_holds_all_of_it_changes_nothing_or_leaves_nothing():
    rays = random_rays(0)
    whole = 1 - np.exp(-1.5 * kept_lengths(*in_double(rays), (), inside_out=False))
    for box in (EVERYWHERE, (-1, 1) * 3):
        np.testing.assert_allclose(opacity_of(rays, box), whole, atol=1e-5)
        assert not opacity_of(rays, box, inside_out=True).any()
    far = (3, 4, 3, 4, 3, 4)
    assert not opacity_of(rays, far).any()
    np.testing.assert_allclose(opacity_of(rays, far, inside_out=True), whole, atol=1e-5)


def test_planes_that_contradict_each_other_hold_nothing():
    rays, planes = random_rays(0), [((0, 0, 0.1), (0, 0, 1)), ((0, 0, -0.1), (0, 0, -1))]
    assert not opacity_of(rays, planes=planes).any()
    whole = opacity_of(rays, (3, 4, 3, 4, 3, 4), inside_out=True)
    np.testing.assert_allclose(opacity_of(rays, planes=planes, inside_out=True), whole, atol=1e-6)


def test_rays_within_a_plane_are_inside():
    origins = np.repeat(np.array([[0.25, 0, -3], [0, 0, -3], [-0.5, 0, -3], [0.25, 0, 0]], np.float32), 16, 0)
    directions = np.tile(np.array([[0, 0, 1]], np.float32), (64, 1))
    inside = np.exp(-1.5 * np.array([2, 2, 2, 1])), np.array([True, False, False, True])
    for inside_out in (False, True):
        expected = np.where(inside[1] != inside_out, 1 - inside[0], 0)
        for box, planes in ((EVERYWHERE, [((0.25, 0, 0), (3, 0, 0))]), ((0.25, 9, -9, 9, -9, 9), ())):
            found = opacity_of((origins, directions), box, planes, inside_out=inside_out)
            np.testing.assert_allclose(found[::16], expected, atol=1e-5)


def test_derivatives_of_ends_are_finite_wherever_a_ray_runs():
    """Within a plane, along an edge, past the volume, and where a face of the box is one of the volume."""
    pixel = jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32)
    origins = np.array([[0.25, 0, -3], [0.25, -1, -3], [-0.5, 0, -3], [0.25, 0, 0], [1, 1, -3], [5, 5, 5]])
    directions = np.tile(np.array([[0, 0, 1.0]]), (6, 1))

    @functools.partial(jax.jit, static_argnums=1)
    @functools.partial(jax.jacrev, has_aux=True)
    def slopes(given, inside_out):
        box, origins, directions, planes = given
        space = jv.March(1.0, (jv.Clip(box, planes, inside_out=inside_out),)).locate(constant())
        rays = jax.vmap(lambda o, d: enter(space, apart(o), apart(d), pixel))(origins, directions)
        ends = jnp.concatenate([rays.t_in, rays.length])
        return ends, ends

    plane = jnp.array([0.25, 0.0, 0.0]), jnp.array([2.0, 0.0, 0.0])
    for box in ((0.25, 1, -1, 1, -1, 1), (0.25, 1, 2, 3, -1, 1)):
        given = jnp.array(box, float), *map(jnp.float32, (origins, directions)), (plane,)
        for inside_out in (False, True):
            found, ends = slopes(given, inside_out)
            assert np.all(np.isfinite(ends))
            assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(found))


def test_a_film_between_a_face_and_a_cut_that_coincide_is_not_seen():
    """The whole step of its only sample would be."""
    box = np.array((0.0, 1.0) * 3, np.float32)
    origins, directions = random_rays(1)
    within = np.abs(origins).max(axis=1, keepdims=True) < 1.2
    rays = np.where(within, origins - 3 * directions, origins), directions
    exact = opacity_of(rays, box, inside_out=True, extinction=50.0, transforms=())
    for toward in (0, 2):
        rounded = np.where(box > 0, np.nextafter(box, np.float32(toward)), box)
        found = opacity_of(rays, rounded, inside_out=True, extinction=50.0, transforms=())
        np.testing.assert_allclose(found, exact, atol=1e-3)


# ---- cut faces ----


@pytest.mark.parametrize(
    ("inside_out", "position"),
    [(True, (0.1, 0.2, -3.0)), *slow((False, (0.1, 0.2, -3.0)), (True, (0.1, 0, -0.6)))],
)
def test_cut_faces_stay_smooth_under_empty_space_jitter(inside_out, position):
    """Seen from outside, and from within what is cut away. Under `Jitter` they do not."""
    volume = scaled_phantom("linear", 32)
    colors = np.array([[0.2], [0.9], [0.4]]) * np.ones(3)
    transfer = jv.TransferFunction([-1.0, 0.0, 1.0], colors, [4.0, 9, 6])
    camera = jv.Camera(position, (0.1, 0.1, 0.3), (0, 1, 0), 16.0, size=(48, 48))
    away = -1 if inside_out else 1
    clip = jv.Clip(planes=[((0, 0, -0.2), (0.3 * away, 0.1 * away, away))], inside_out=inside_out)
    noise = {}
    for name, jitter in {"plain": (), "empty": (jv.EmptySpaceJitter(0),), "jitter": (jv.Jitter(0),)}.items():
        rendering = jv.render(volume, transfer, camera, jv.March(0.05, (*jitter, ALIGNED, clip)))
        assert float(rendering.rgba[..., 3].min()) > 0.5
        noise[name] = boundary_noise(rendering.image(), np.ones((48, 48), bool))
    assert noise["empty"] <= 1.05 * noise["plain"]
    assert noise["jitter"] > 20 * noise["plain"]


@pytest.mark.parametrize("quadrature", ["left", *slow("midpoint", "preintegrated")])
@pytest.mark.parametrize("inside_out", [False, True])
def test_with_labels_cells_are_cut_at_labels_and_cuts(inside_out, quadrature):
    labels = (np.arange(16) >= 8).astype(np.uint8)[:, None, None] * np.ones((1, 4, 4), np.uint8)
    volume = jv.Volume(np.ones(labels.shape, np.float32), labels=labels)  # the face lies at x = 7.5
    red, blue = (uniform_transfer(sigma, color) for sigma, color in ((0.1, (1, 0, 0)), (0.2, (0, 0, 1))))
    transfer = jv.LabelTransferFunction([red, blue])
    clip = jv.Clip((5.3, 9.9, -1, 5, -1, 5), inside_out=inside_out)
    for step in (0.4, 1.7):
        march = jv.March(step, (jv.AlphaCorrection(labels=True), clip), quadrature)
        ray = jnp.array([[-2.0, 1.3, 1.6]]), jnp.array([[1.0, 0, 0]])
        rgba = np.asarray(jv.render_rays(volume, transfer, *ray, march).rgba[0])
        depths = np.array([5.3, 5.1] if inside_out else [2.2, 2.4]) * (0.1, 0.2)
        shown = np.array([1, np.exp(-depths[0])]) * (1 - np.exp(-depths))
        np.testing.assert_allclose(rgba, [shown[0], 0, shown[1], shown.sum()], atol=2e-5)


def test_gaps_may_come_in_any_order():
    """Those of a space and that of a clip may also overlap."""
    zero, unit = jnp.zeros(()), jnp.ones(())
    straight = Straight((zero, zero, zero), (unit, zero, zero))
    cell = Cell(zero, 10 * unit, jnp.zeros((), bool))
    pixel = jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32)
    for gaps in (
        ((2, 5), (3, 4)),
        ((3, 4), (2, 5)),
        ((4, 5), (2, 3)),
        ((2, 4), (3, 5)),
        ((2, 5), (jnp.inf,) * 2),
    ):
        ends = tuple((jnp.asarray(left, float), jnp.asarray(back, float)) for left, back in gaps)
        ray = Ray((zero, zero, zero), (unit, zero, zero), zero, 20 * unit, straight, pixel, ends)
        pieces = ALIGNED.cut(cell, ray, constant())
        assert [(float(p.front), float(p.width)) for p in pieces] == [(0, 2), (2, 3), (5, 5)], gaps


# ---- empty space ----


CLIPS = {
    "clipped": jv.Clip((0.31, 1.2, -0.05, 0.7, 0.2, 1.0), [((0.8, 0.3, 0.6), (1, -0.5, 0.3))]),
    "hollowed": jv.Clip(
        (0.31, 1.2, -0.05, 0.7, 0.2, 1.0), [((0.8, 0.3, 0.6), (1, -0.5, 0.3))], inside_out=True
    ),
}
"""Through the volumes of `test_space_leaping`."""


@pytest.mark.parametrize(
    ("name", "method", "transforms"),
    [
        ("hollowed", "hierarchy", "moving"),
        *slow(
            *((name, method, "moving") for name in CLIPS for method in leaping.METHODS),
            *((name, "hierarchy", other) for name in CLIPS for other in ("plain", "residual", "adaptive")),
        ),
    ],
)
def test_leaping_does_not_show(name, method, transforms):
    given_ = {**leaping.SETS, "adaptive": (jv.AdaptiveSampling(0.03), jv.AlphaCorrection())}[transforms]

    @settings(max_examples=12, deadline=None)
    @given(kind=leaping.KINDS, seed=leaping.SEEDS, step=st.floats(0.01, 0.3))
    def check(kind, seed, step):
        data = leaping.bytes_of(leaping.contents(kind, seed))
        volume = jv.Volume(data, leaping.SPACING, origin=(0.3, -0.2, 0.1))
        view = list(leaping.PERSPECTIVE.values())[seed % 3]
        camera, transfer = leaping.drawn_camera(view, volume, seed), leaping.table(seed, 255)
        quadrature = "midpoint" if transforms == "adaptive" else "left"
        leaping.compare_methods(volume, transfer, camera, step, (*given_, CLIPS[name]), [method], quadrature)

    check()


@pytest.mark.parametrize("method", ["hierarchy", *slow(*leaping.METHODS[1:])])
def test_what_is_cut_away_is_leapt_over(method):
    """In a volume that is visible everywhere, there is nothing else to leap over."""
    box = (-0.7, 0.7) * 3
    clip = jv.Clip(box, inside_out=True)
    camera = around(constant()).zoom(8)
    march = jv.March(0.02, (ALIGNED, clip, jv.SpaceLeaping(method, 4)))
    rendering = jv.render(constant(), uniform_transfer(0.3), camera, march)
    exact = kept_lengths(*in_double(camera.rays()), oracle.planes_of(box), inside_out=True)
    np.testing.assert_allclose(rendering.rgba[..., 3].reshape(-1), 1 - np.exp(-0.3 * exact), atol=1e-5)
    whole = kept_lengths(*in_double(camera.rays()), (), inside_out=False)
    assert np.asarray(rendering.samples).mean() < 0.8 * whole.mean() / 0.02


@pytest.mark.parametrize("inside_out", [False, True])
def test_no_cell_that_holds_anything_seen_is_taken_as_empty(inside_out):
    random, volume = np.random.default_rng(0), anisotropic_noise()
    visible = jnp.ones_like(Blocks.of(volume).low, bool)
    low, high = (np.asarray(corner) for corner in volume.corners)
    empty = 0
    for _ in range(20):
        point = random.uniform(low, high)
        clip = jv.Clip(BOX, [PLANE, (point, random.normal(size=3))], inside_out=inside_out)
        space = jv.March(1.0, (clip,)).locate(volume)
        grid = space.occupancy(visible)
        points = random.uniform(low, high, (4000, 3))
        planes = oracle.planes_of(clip.box, zip(clip.origins, clip.normals, strict=True))
        inside_all = np.all([(points - p) @ n >= 0 for p, n in planes], axis=0)
        x, y, z = jnp.asarray(points.T)
        cell = np.floor(np.stack(grid.cell((x, y, z)), axis=-1)).astype(int)
        occupied = np.asarray(grid.occupied)[tuple(cell.T)]
        assert occupied[inside_all != inside_out].all()
        empty += np.sum(~occupied)
    assert empty > 300


# ---- gradients ----


def clip_loss(leaves, adjoint, inside_out, dtype=np.float64, leaps=()):
    """A scalar of the image of noise, of 8-bit voxels beside empty space."""
    data = np.random.default_rng(0).random((20, 18, 19))
    if dtype == np.uint8:
        data[:, :, 9:] = 0  # empty space
        data = np.round(255 * data)
    volume = jv.Volume(data.astype(dtype), (0.115, 0.13, 0.12), (-1.1, -1.0, -1.2))
    top = 255 if dtype == np.uint8 else 1
    colors = np.random.default_rng(1).random((4, 3))
    transfer = jv.TransferFunction(top * np.array([0.0, 0.2, 0.6, 1.0]), colors, leaves["extinction"])
    clip = jv.Clip(leaves.get("box"), zip_planes(leaves["origins"], leaves["normals"]), inside_out=inside_out)
    camera = jv.Camera(leaves["position"], (0.1, 0.0, -0.1), (0, 0, 1), 34.0, size=(9, 7))
    march = jv.March(0.11, (clip, jv.EmptySpaceJitter(4), ALIGNED, *leaps), "midpoint")
    rgba = jv.render(volume, transfer, camera, march, adjoint=adjoint).rgba
    weights = np.random.default_rng(5).normal(size=rgba.shape)
    return jnp.sum(rgba * jnp.asarray(weights, rgba.dtype))


def zip_planes(origins, normals):
    return [(origins[i], normals[i]) for i in range(origins.shape[0])]


def leaves_of(box=True):
    leaves = {
        "box": jnp.asarray([-0.7, 0.8, -0.9, 0.6, -0.8, 0.9]),
        "origins": jnp.asarray([[0.1, 0.2, -0.1], [0.4, 0.0, 0.5]]),
        "normals": jnp.asarray([[2.0, -1.0, 0.5], [-0.3, 0.4, -1.0]]),
        "position": jnp.asarray([2.6, -3.1, 1.9]),
        "extinction": jnp.asarray([0.0, 0.4, 1.5, 3.0]),
    }
    return leaves if box else {name: leaf for name, leaf in leaves.items() if name != "box"}


@pytest.mark.parametrize(
    ("inside_out", "adjoint", "box"),
    [
        (True, "replay", False),  # fewer faces, of which each lengthens the program
        *slow(*itertools.product((False, True), ("replay", "forward", "direct"), (True,))),
    ],
)
def test_gradients_are_central_differences(inside_out, adjoint, box):
    with in_float64():
        leaves = leaves_of(box)
        loss = jax.jit(lambda leaves: clip_loss(leaves, adjoint, inside_out))
        random = np.random.default_rng(1)
        gradient = None if adjoint == "forward" else jax.jit(jax.grad(loss))(leaves)
        for key, leaf in leaves.items():
            change = {k: jnp.zeros_like(v) for k, v in leaves.items()}
            change[key] = jnp.asarray(random.normal(size=leaf.shape))
            if key == "extinction":
                change[key] = jnp.where(leaf > 0, change[key], 0)
            ends = [loss(jax.tree.map(lambda p, c, h=h: p + h * c, leaves, change)) for h in (1e-7, -1e-7)]
            difference = (ends[0] - ends[1]) / 2e-7
            slope = (
                jax.jvp(loss, (leaves,), (change,))[1]
                if gradient is None
                else jnp.vdot(gradient[key], change[key])
            )
            assert abs(difference) > 1e-4, key
            np.testing.assert_allclose(slope, difference, rtol=1e-5, atol=1e-7, err_msg=key)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("inside_out", "method"), [(False, "hierarchy"), *((True, method) for method in leaping.METHODS)]
)
def test_leaping_does_not_change_gradients(inside_out, method):
    """Of 8-bit voxels, in float32, by replay."""
    leaves, found = leaves_of(), {}
    for name, leaps in {"whole": (), "leapt": (jv.SpaceLeaping(method, 4),)}.items():
        found[name] = jax.grad(clip_loss)(leaves, "replay", inside_out, np.uint8, leaps)
    for key, expected in found["whole"].items():
        keep = np.asarray(leaves["extinction"] > 0) if key == "extinction" else np.ones(expected.shape, bool)
        off = np.linalg.norm(np.where(keep, found["leapt"][key] - expected, 0))
        assert off <= 1e-5 * np.linalg.norm(expected), key


# ---- under a toroidal map ----


def hollow_rays(count=64):
    """Rays through the hollow near side of a probe's sector."""
    random = np.random.default_rng(0)
    origins = np.array([30.0, -180.0, 20.0]) + random.normal(size=(count, 3)) * (9, 3, 3)
    directions = np.array([17.0, 0, 36]) + random.normal(size=(count, 3)) * (6, 6, 1.5) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return origins.astype(np.float32), directions.astype(np.float32)


@pytest.mark.parametrize("inside_out", [False, *slow(True)])
def test_it_clips_a_swept_sector_in_the_world(inside_out):
    """The length that is left, by dense sampling: also where a cut lies in a gap of the sector."""
    probe, rays = toroidal.probe_of("across the middle"), hollow_rays()
    volume = jv.Volume(np.ones(toroidal.SHAPE, np.float32))
    within = dict.fromkeys(("gap and cut", "begins in a gap", "ends in a gap"), 0)
    for planes in (
        [((17, -4, 36), (0.2, 1.0, 0.3)), ((15, 30, 36), (0.1, -1, -0.2))],
        [((17, 4, 36), (0.2, -1.0, 0.3)), ((15, -60, 36), (0.1, 1, -0.2))],
    ):
        march = jv.March(5.3, (jv.Clip(planes=planes, inside_out=inside_out), ALIGNED, probe))
        rgba = jv.render_rays(volume, uniform_transfer(0.02), *rays, march).rgba
        lengths = []
        for origin, direction in zip(*in_double(rays), strict=True):
            pieces = toroidal.pieces_inside(origin, direction, toroidal.PROBES["across the middle"])
            (first,), (last,) = oracle.side_interval(
                origin[None], direction[None], oracle.planes_of(None, planes)
            )
            clipped = np.clip(np.minimum(pieces[:, 1], last) - np.maximum(pieces[:, 0], first), 0, None)
            whole = pieces[:, 1] - pieces[:, 0]
            lengths.append((whole - clipped if inside_out else clipped).sum())
            if len(pieces) > 1:
                left, back = pieces[0, 1], pieces[1, 0]
                within["gap and cut"] += 0 < clipped.sum() < whole.sum()
                within["begins in a gap"] += left < first < back
                within["ends in a gap"] += left < last < back
        np.testing.assert_allclose(rgba[:, 3], 1 - np.exp(-0.02 * np.array(lengths)), atol=1e-5)
    assert min(within.values()) > 5, within


def test_its_place_among_other_transforms_does_not_show():
    probe, clip = toroidal.probe_of("across the middle"), jv.Clip(EVERYWHERE, [PLANE])
    volume = toroidal.noise_volume()
    first, last = (jv.March(1.0, order).locate(volume) for order in ((clip, probe), (probe, clip)))
    assert eqx.tree_equal(first, last)


@pytest.mark.slow
@pytest.mark.parametrize("inside_out", [False, True])
def test_with_a_toroidal_map_engines_agree_and_leaping_does_not_show(inside_out):
    probe = toroidal.probe_of("across the middle")
    volume, transfer, camera = toroidal.noise_volume(), toroidal.ramp_transfer(), toroidal.view(probe)
    clip = jv.Clip(planes=[(probe.center, (0.2, 1.0, 0.3))], inside_out=inside_out)
    transforms = (clip, probe, *toroidal.COMBINED["all"])
    rendering = jv.render(volume, transfer, camera, jv.March(5.3, transforms))
    counted = jv.March(5.3, transforms, max_samples=64)
    reference = toroidal.reference_image(volume, transfer, camera, counted)
    assert not np.any(reference.exhausted)
    np.testing.assert_allclose(rendering.rgba, reference.rgba, atol=2e-5)
    for method in leaping.METHODS:
        leapt = jv.render(volume, transfer, camera, jv.March(5.3, (*transforms, jv.SpaceLeaping(method, 4))))
        np.testing.assert_allclose(leapt.rgba, rendering.rgba, atol=1e-6)


# ---- parameters ----


@pytest.mark.slow
def test_other_parameters_compile_nothing_again():
    transfer_class = counting()
    transfer = transfer_class(np.linspace(0, 1, 8), np.ones((8, 3)), np.full(8, 2.0))
    traces = []
    for shift in (0.0, 0.1, 0.2):
        clip = jv.Clip(np.add((0.5, 3, -3, -0.2, 0.4, 3), shift), [((shift, 0, 0), (1, shift, 0))])
        jv.render(constant(), transfer, around(constant()), jv.March(0.13, (ALIGNED, clip)))
        traces.append(transfer_class.traces)
    assert len(set(traces)) == 1


def test_nan_in_a_plane_shows():
    clip = jv.Clip(EVERYWHERE, [((0, 0, -9), (0, 0, 1))] * 2)
    for where in (lambda clip: clip.box, lambda clip: clip.origins, lambda clip: clip.normals):
        broken = eqx.tree_at(where, clip, where(clip) * jnp.nan)
        march = jv.March(0.13, (ALIGNED, broken))
        assert np.isnan(jv.render_rays(constant(), uniform_transfer(1.5), *random_rays(0), march).rgba).all()


@pytest.mark.parametrize("bad", ["box", "normal"])
def test_traced_parameters_are_checked_where_they_are_used(bad):
    @eqx.filter_jit
    def made(x):
        return jv.Clip((x, 1, 0, 1, 0, 1)) if bad == "box" else jv.Clip(planes=[((0, 0, 0), (0, 0, x))])

    good, wrong, message = (0.5, 1.5, "box must be") if bad == "box" else (1.0, 0.0, "must not be 0")
    assert np.all(np.isfinite(made(jnp.float32(good)).normals))
    with pytest.raises((RuntimeError, ValueError), match=message):
        made(jnp.float32(wrong))


UNIT = (0, 1, 0, 1, 0, 1)
BAD = {
    "nothing": ((), "Clip must be given a box, planes, or both; got neither"),
    "no planes": ((None, []), "Clip must be given a box, planes, or both; got neither"),
    "corners": ((((0, 0, 0), (1, 1, 1)),), r"box must have shape \(6,\); got shape \(2, 3\)"),
    "corners in a row": (
        ((0, 0, 0, 1, 1, 1),),
        r"box must be .* each minimum below its maximum; got \[0\. 0\. 0\. 1\.",
    ),
    "NaN": (((0, 1, 0, 1, 0, np.nan),), "box must be finite"),
    "infinite": (((0, 1, 0, 1, 0, np.inf),), "box must be finite"),
    "a bare plane": (
        (None, ((0, 0, 0), (0, 0, 1))),
        r"planes\[0\] must be a pair \(origin, normal\); got a tuple of length 3\. "
        r"For a single plane, pass \[\(origin, normal\)\]\.",
    ),
    "a bare plane in arrays": (
        (None, (np.zeros(3), np.ones(3))),
        r"got a NumPy array of shape \(3,\) .*For a single plane, pass",
    ),
    "coefficients": (
        (None, [(1, 0, 0, 5)]),
        r"planes\[0\] must be a pair \(origin, normal\); got a tuple of length 4\.$",
    ),
    "None": ((None, None), r"planes must be a list of pairs \(origin, normal\); got None\.$"),
    "a generator": ((None, (pair for pair in ())), r"planes must be a list of pairs .* got a generator\.$"),
    "a name": ((None, "x"), r"planes\[0\] must be a pair"),
    "a number": ((None, 3.0), r"planes must be a list of pairs .* got 3.0"),
    "no normal": ((None, [((0, 0, 0), (0, 0, 0))]), r"the normal of planes\[0\] must not be 0"),
    "a flat normal": ((None, [((0, 0, 0), (0, 1))]), r"the normal of planes\[0\] must have shape \(3,\)"),
    "NaN in a plane": (
        (UNIT, [((0, 0, 0), (0, 0, 1)), ((np.nan, 0, 0), (0, 0, 1))]),
        r"the origin of planes\[1\] must be finite",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    arguments, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        jv.Clip(*arguments)
