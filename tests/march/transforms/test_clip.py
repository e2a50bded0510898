"""Is that part of the volume seen which a clip leaves, and are cut faces like the volume's own?
(`test_agreement` has clips among all other transforms, `test_gradients` their gradients.)"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.metrics import boundary_noise
from jaxvol.scene.occupancy import Blocks
from jaxvol.scene.space import enter

from ... import oracle
from ...scenes import (
    BOX,
    PLANE,
    anisotropic_noise,
    around,
    in_float64,
    reference_image,
    rendered,
    rendered_rays,
    same_trees,
    scaled_phantom,
    slow,
    uniform_transfer,
)
from ...switch import switch


EXAMPLES = {
    "clip": lambda values: jv.Clip(values.box, values.planes),
    "hollow": lambda values: jv.Clip(values.box, values.planes, inside_out=True),
}


def clipped(clip, camera):
    """A ray begins with the first point that is seen, and ends with the last one; inside out, what is not
    seen in between is a gap."""
    planes = oracle.planes_of(clip.box, zip(*map(np.asarray, (clip.origins, clip.normals)), strict=True))

    def clip_rays(origins, directions, rays):
        (t_in, t_out, _), (first, last) = rays, oracle.side_interval(origins, directions, planes)
        if not clip.inside_out:
            return oracle.Rays(np.maximum(t_in, first), np.minimum(t_out, last))
        crosses = (first < last) & (first < t_out) & (last > t_in)
        gap = np.where(crosses & (first > t_in) & (last < t_out), (first, last), np.inf)
        starts, stops = crosses & (first <= t_in), crosses & (last >= t_out)
        return oracle.Rays(np.where(starts, last, t_in), np.where(stops, first, t_out), gap)

    return oracle.Meaning(clip=clip_rays)


MEANINGS = {jv.Clip: clipped}
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


def opacity_of(rays, box=EVERYWHERE, planes=(), *, inside_out=False, extinction=1.5, step=0.13, cut=True):
    """Opacity of `constant`, along 64 rays. Always of two planes, so that one program serves all."""
    origins, directions = rays
    aside = [((0, 0, -9), (0, 0, 1))] * (2 - len(planes))
    march = jv.March(step, (switch(ALIGNED, cut), jv.Clip(box, [*planes, *aside], inside_out=inside_out)))
    of = constant(), uniform_transfer(extinction), origins, directions
    return np.asarray(rendered_rays(*of, march).rgba)[:, 3]


@pytest.mark.parametrize("inside_out", [False, True])
@settings(max_examples=40)
@given(seed=st.integers(0, 10**6), step=st.sampled_from([0.13, 5.0]))
def test_a_constant_volume_is_exact_at_any_step(inside_out, seed, step):
    """1 - exp(-σ · length that is left), for boxes and planes of all kinds, and rays from everywhere."""
    random, rays = np.random.default_rng(seed), random_rays(seed)
    ends = np.sort(random.uniform(-1.6, 1.6, (3, 2)), axis=1).reshape(-1)
    pairs = [
        (random.uniform(-0.8, 0.8, 3), random.normal(size=3) * 10 ** random.uniform(-3, 3)) for _ in range(2)
    ]
    length = kept_lengths(*in_double(rays), oracle.planes_of(ends, pairs), inside_out)
    found = opacity_of(rays, ends, pairs, inside_out=inside_out, step=step)
    np.testing.assert_allclose(found, 1 - np.exp(-1.5 * length), atol=1e-5)


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
    pixel, volume = (jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32)), constant()
    origins = np.array([[0.25, 0, -3], [0.25, -1, -3], [-0.5, 0, -3], [0.25, 0, 0], [1, 1, -3], [5, 5, 5]])
    directions = np.tile(np.array([[0, 0, 1.0]]), (6, 1))

    @jax.jit
    @functools.partial(jax.jacrev, has_aux=True)
    def slopes(given):
        box, origins, directions, planes = given
        ends = []
        for inside_out in (False, True):
            space = jv.March(1.0, (jv.Clip(box, planes, inside_out=inside_out),)).locate(volume)
            rays = jax.vmap(lambda o, d, space=space: enter(space, apart(o), apart(d), pixel))
            found = rays(origins, directions)
            ends += [found.t_in, found.length]
        return jnp.concatenate(ends), ends

    plane = np.array([0.25, 0.0, 0.0], np.float32), np.array([2.0, 0.0, 0.0], np.float32)
    for box in ((0.25, 1, -1, 1, -1, 1), (0.25, 1, 2, 3, -1, 1)):
        found = slopes((*(np.asarray(part, np.float32) for part in (box, origins, directions)), (plane,)))
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(found))


def test_a_film_between_a_face_and_a_cut_that_coincide_is_not_seen():
    """The whole step of its only sample would be."""
    box = np.array((0.0, 1.0) * 3, np.float32)
    origins, directions = random_rays(1)
    within = np.abs(origins).max(axis=1, keepdims=True) < 1.2
    rays = np.where(within, origins - 3 * directions, origins), directions
    exact = opacity_of(rays, box, inside_out=True, extinction=50.0, cut=False)
    for toward in (0, 2):
        rounded = np.where(box > 0, np.nextafter(box, np.float32(toward)), box)
        found = opacity_of(rays, rounded, inside_out=True, extinction=50.0, cut=False)
        np.testing.assert_allclose(found, exact, atol=1e-3)


def test_nan_in_a_plane_shows():
    clip = jv.Clip(EVERYWHERE, [((0, 0, -9), (0, 0, 1))] * 2)
    box, normals = (lambda clip: clip.box), (lambda clip: clip.normals)
    parts = [(where, np.asarray(where(clip))) for where in (box, lambda clip: clip.origins, normals)]
    wrongs = [(where, part * np.float32(np.nan)) for where, part in parts]
    wrongs += [(box, parts[0][1][[1, 0, 2, 3, 4, 5]]), (normals, 0 * parts[2][1])]
    for where, wrong in wrongs:
        broken = eqx.tree_at(where, clip, jax.device_put(wrong))
        march = jv.March(0.13, (switch(ALIGNED, True), broken))
        assert np.isnan(rendered_rays(constant(), uniform_transfer(1.5), *random_rays(0), march).rgba).all()


# ---- cut faces ----


@pytest.mark.parametrize(
    ("inside_out", "position"),
    [(True, (0.1, 0.2, -3.0)), *slow((False, (0.1, 0.2, -3.0)))],
)
def test_cut_faces_stay_smooth_under_empty_space_jitter(inside_out, position):
    """Seen from outside, and from within what is cut away. Under `Jitter` they do not."""
    volume = scaled_phantom("linear")
    colors = np.array([[0.2], [0.9], [0.4]]) * np.ones(3)
    transfer = jv.TransferFunction([-1.0, 0.0, 1.0], colors, [4.0, 9, 6])
    camera = jv.Camera(position, (0.1, 0.1, 0.3), (0, 1, 0), 16.0, size=(48, 48))
    away = -1 if inside_out else 1
    clip = jv.Clip(planes=[((0, 0, -0.2), (0.3 * away, 0.1 * away, away))], inside_out=inside_out)
    noise = {}
    for name in ("plain", "empty", "jitter"):
        jitters = switch(jv.EmptySpaceJitter(0), name == "empty"), switch(jv.Jitter(0), name == "jitter")
        rendering = rendered(volume, transfer, camera, jv.March(0.05, (*jitters, ALIGNED, clip)))
        assert np.asarray(rendering.rgba)[..., 3].min() > 0.5
        noise[name] = boundary_noise(rendering.image(), np.ones((48, 48), bool))
    assert noise["empty"] <= 1.05 * noise["plain"]
    assert noise["jitter"] > 20 * noise["plain"]


@pytest.mark.slow
@pytest.mark.parametrize(("inside_out", "quadrature"), [(False, "left"), (True, "preintegrated")])
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


# ---- empty space ----


@pytest.mark.parametrize("method", ["blocks", *slow("beam")])
def test_what_is_cut_away_is_leapt_over(method):
    """In a volume that is visible everywhere, there is nothing else to leap over."""
    box = (-0.7, 0.7) * 3
    clip = jv.Clip(box, inside_out=True)
    camera = around(constant()).zoom(8)
    march = jv.March(0.02, (ALIGNED, clip, jv.SpaceLeaping(method, 4)))
    rendering = rendered(constant(), uniform_transfer(0.3), camera, march)
    exact = kept_lengths(*in_double(camera.rays()), oracle.planes_of(box), inside_out=True)
    np.testing.assert_allclose(
        np.asarray(rendering.rgba)[..., 3].reshape(-1), 1 - np.exp(-0.3 * exact), atol=1e-5
    )
    whole = kept_lengths(*in_double(camera.rays()), (), inside_out=False)
    assert np.asarray(rendering.samples).mean() < 0.8 * whole.mean() / 0.02


@pytest.mark.parametrize("inside_out", [False, True])
def test_no_cell_that_holds_anything_seen_is_taken_as_empty(inside_out):
    random, volume = np.random.default_rng(0), anisotropic_noise()
    visible = jax.device_put(np.ones(Blocks.of(volume).low.shape, bool))
    low, high = (np.asarray(corner) for corner in volume.corners)

    @jax.jit
    def occupied_at(clip, x, y, z):
        space = jv.March(1.0, (clip,)).locate(volume)
        grid = space.occupancy(visible)
        return grid.occupied[tuple(jnp.floor(c).astype(int) for c in grid.cell(space.place((x, y, z))))]

    empty = 0
    for _ in range(20):
        point = random.uniform(low, high)
        clip = jv.Clip(BOX, [PLANE, (point, random.normal(size=3))], inside_out=inside_out)
        points = random.uniform(low, high, (4000, 3))
        planes = oracle.planes_of(clip.box, zip(*map(np.asarray, (clip.origins, clip.normals)), strict=True))
        inside_all = np.all([(points - p) @ n >= 0 for p, n in planes], axis=0)
        occupied = np.asarray(occupied_at(clip, *np.asarray(points.T, np.float32)))
        assert occupied[inside_all != inside_out].all()
        empty += np.sum(~occupied)
    assert empty > 300


# ---- gradients ----


@pytest.mark.slow
@pytest.mark.parametrize(("inside_out", "adjoint"), [(False, "direct"), (True, "replay")])
def test_gradients_are_central_differences(inside_out, adjoint):
    with in_float64():
        volume = jv.Volume(
            np.random.default_rng(0).random((20, 18, 19)), (0.115, 0.13, 0.12), (-1.1, -1.0, -1.2)
        )
        leaves = {
            "box": jnp.asarray([-0.7, 0.8, -0.9, 0.6, -0.8, 0.9]),
            "origins": jnp.asarray([[0.1, 0.2, -0.1], [0.4, 0.0, 0.5]]),
            "normals": jnp.asarray([[2.0, -1.0, 0.5], [-0.3, 0.4, -1.0]]),
            "position": jnp.asarray([2.6, -3.1, 1.9]),
        }

        @jax.jit
        def loss(leaves):
            transfer = jv.TransferFunction(
                [0.0, 0.2, 0.6, 1.0], np.linspace((1, 0, 0), (0, 1, 1), 4), [0, 0.4, 1.5, 3]
            )
            planes = [(leaves["origins"][i], leaves["normals"][i]) for i in range(2)]
            clip = jv.Clip(leaves["box"], planes, inside_out=inside_out)
            camera = jv.Camera(leaves["position"], (0.1, 0.0, -0.1), (0, 0, 1), 34.0, size=(9, 7))
            march = jv.March(0.11, (clip, ALIGNED), "midpoint", max_samples=64)
            rgba = jv.render(volume, transfer, camera, march, adjoint=adjoint).rgba
            return jnp.sum(rgba * np.random.default_rng(5).normal(size=rgba.shape))

        random, gradient = np.random.default_rng(1), jax.jit(jax.grad(loss))(leaves)
        for key, leaf in leaves.items():
            way = random.normal(size=leaf.shape)
            ends = [loss({**leaves, key: leaf + h * way}) for h in (1e-7, -1e-7)]
            difference = (ends[0] - ends[1]) / 2e-7
            assert abs(difference) > 1e-4, key
            np.testing.assert_allclose(
                np.vdot(gradient[key], way), difference, rtol=1e-5, atol=1e-7, err_msg=key
            )


# ---- under a toroidal map ----


def test_its_place_among_other_transforms_does_not_show():
    volume, probe = constant(), jv.ToroidalMap(20.0, 30.0, (0.9, 2.3), (0.8, 2.4), (0.0, 60.0))

    @eqx.filter_jit
    def located(*order):
        return [jv.March(1.0, transforms).locate(volume) for transforms in (order, order[::-1])]

    assert same_trees(*located(jv.Clip(EVERYWHERE, [PLANE]), probe))


@pytest.mark.slow
def test_with_a_toroidal_map_engines_agree():
    volume, probe = jv.toroidal_phantom("spheres", (17, 21, 33), speckle=False)
    transfer = jv.TransferFunction.from_points([(20, (1, 0.7, 0.5), 0.0), (200, (1, 1, 1), 0.5)], 5.0)
    low, high = (np.asarray(corner) for corner in probe.corners)
    camera = jv.Camera(low - 1.5 * (high - low), (low + high) / 2, (1.0, 0, 0), 35.0, size=(20, 16)).zoom(1.5)
    clip = jv.Clip(planes=[((low + high) / 2, (0.2, 1.0, 0.3))])
    transforms = clip, probe, jv.EmptySpaceJitter(4), ALIGNED
    rendering = jv.render(volume, transfer, camera, jv.March(5.3, transforms))
    assert float(rendering.rgba[..., 3].max()) > 0.1
    reference = reference_image(volume, transfer, camera, jv.March(5.3, transforms, max_samples=64))
    assert not np.any(reference.exhausted)
    np.testing.assert_allclose(rendering.rgba, reference.rgba, atol=2e-5)


# ---- parameters ----


UNIT = (0, 1, 0, 1, 0, 1)
BAD = {
    "nothing": ((), "Clip must be given a box, planes, or both; got neither"),
    "no planes": ((None, []), "Clip must be given a box, planes, or both; got neither"),
    "corners": ((((0, 0, 0), (1, 1, 1)),), r"box must have shape \(6,\); got shape \(2, 3\)"),
    "corners in a row": (
        ((0, 0, 0, 1, 1, 1),),
        r"box must be .* minima below maxima; got \[0\. 0\. 0\. 1\.",
    ),
    "NaN": (((0, 1, 0, 1, 0, np.nan),), "box must be finite"),
    "infinite": (((0, 1, 0, 1, 0, np.inf),), "box must be finite"),
    "a bare plane": (
        (None, ((0, 0, 0), (0, 0, 1))),
        r"planes must be pairs \[\(origin, normal\), \.\.\.\]; got",
    ),
    "a bare plane in arrays": ((None, (np.zeros(3), np.ones(3))), "planes must be pairs"),
    "coefficients": ((None, [(1, 0, 0, 5)]), r"planes must be pairs .* got \[\(1, 0, 0, 5\)\]"),
    "None": ((None, None), "planes must be pairs .* got None"),
    "a name": ((None, "x"), "planes must be pairs .* got 'x'"),
    "a number": ((None, 3.0), "planes must be pairs .* got 3.0"),
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
