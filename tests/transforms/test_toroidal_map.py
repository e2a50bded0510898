"""The toroidal map: does it match the paper's formula, where do rays meet the sector, are images right?"""

import itertools
from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.phantoms import toroidal_phantom
from jaxvol.space import enter, world_gradient

from ..scenes import in_float64, uniform_transfer


HALF = np.pi / 2
SHAPE = (9, 11, 13)

PROBES = {
    "across the middle": (20.0, 30.0, (0.9, 2.3), (0.8, 2.4), (0.0, 60.0)),
    "apex behind the axis": (-15.0, 40.0, (HALF - 0.5, HALF + 0.6), (HALF - 0.6, HALF + 0.4), (5.0, 55.0)),
    "above the middle": (20.0, 30.0, (1.9, 2.6), (1.75, 2.5), (10.0, 60.0)),
    "below the middle": (8.0, 12.0, (0.4, 1.2), (0.5, 1.3), (-4.0, 60.0)),
    "half a turn": (20.0, 15.0, (0.0, np.pi), (0.3, 2.9), (0.0, 60.0)),
    "apex on the axis": (0.0, 25.0, (1.0, 2.0), (0.9, 2.4), (0.0, 40.0)),
}


def probe_of(name):
    return jv.ToroidalMap(*PROBES[name])


def printed_map(points, a, b):
    """Equation 1 as printed in the paper, in float64; it holds where z > 0 and R > 0."""
    x, y, z = np.moveaxis(np.asarray(points, np.float64), -1, 0)
    away = np.sqrt(y**2 + z**2) - a
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack(
            [HALF + np.arctan(y / z), HALF + np.arctan(x / away), np.sqrt(x**2 + away**2) - b], -1
        )


def is_inside(points, probe):
    """Which points are inside the sector, by the paper's formula."""
    a, b, *ranges = probe
    y, z = points[..., 1], points[..., 2]
    inside = (z > 0) & (np.sqrt(y**2 + z**2) > a)
    for value, (first, last) in zip(np.moveaxis(printed_map(points, a, b), -1, 0), ranges, strict=True):
        inside &= (first <= value) & (value <= last)
    return inside


def pieces_inside(origin, direction, probe, reach=400.0, behind=0.0, dense=8001):
    """(n, 2) distances between which a ray is inside, by dense sampling and bisection."""
    origin, direction = np.asarray(origin, np.float64), np.asarray(direction, np.float64)

    def inside(t):
        return is_inside(origin + t[:, None] * direction, probe)

    t = np.linspace(-behind, reach, dense)
    seen = inside(t)
    change = np.flatnonzero(seen[1:] != seen[:-1])
    low, high, before = t[change], t[change + 1], seen[change]
    for _ in range(45):
        middle = (low + high) / 2
        same = inside(middle) == before
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    ends = list(high)
    return np.array(([t[0]] if seen[0] else []) + ends + ([t[-1]] if seen[-1] else [])).reshape(-1, 2)


def nodes(probe, shape):
    """(β, σ, γ) of the nodes of a grid."""
    return np.stack(
        np.meshgrid(
            *(np.linspace(*ends, num=n) for ends, n in zip(probe[2:], shape, strict=True)), indexing="ij"
        ),
        -1,
    )


def world_of(toroidal, a, b):
    """The inverse map, from the geometry: along the beam, then rotated about the x axis."""
    beta, sigma, gamma = np.moveaxis(np.asarray(toroidal, np.float64), -1, 0)
    rho = a + (b + gamma) * np.cos(sigma - HALF)
    return np.stack(
        [(b + gamma) * np.sin(sigma - HALF), rho * np.sin(beta - HALF), rho * np.cos(beta - HALF)], -1
    )


def space_of(probe, shape=SHAPE):
    return jv.March(1.0, (probe,)).locate(jv.Volume(np.zeros(shape, np.uint8)))


@eqx.filter_jit
def rays_of(probe, origins, directions):
    space, pixel = space_of(probe), (jnp.int32(0), jnp.int32(0))
    return jax.vmap(lambda o, d: enter(space, apart(o), apart(d), pixel))(origins, directions)


def part_inside(probe, origins, directions):
    rays = rays_of(probe, origins, directions)
    return rays.t_in, rays.length


# ---- the map ----


@pytest.mark.parametrize("name", PROBES)
def test_map_and_inverse_agree_with_each_other_and_with_the_printed_formula(name):
    a, b, *_ = PROBES[name]
    swept = nodes(PROBES[name], (17, 18, 19))[1:-1, 1:-1, 1:-1]
    probe, points = probe_of(name), world_of(swept, a, b)
    scale = np.array([1, 1, b + PROBES[name][4][1]])
    np.testing.assert_allclose(np.asarray(probe.to_world(swept)) / scale[2], points / scale[2], atol=1e-6)
    np.testing.assert_allclose(printed_map(points, a, b) / scale, swept / scale, atol=1e-12)
    np.testing.assert_allclose(
        np.asarray(probe.to_toroidal(points)) / scale, printed_map(points, a, b) / scale, atol=1e-5
    )
    np.testing.assert_allclose(
        np.asarray(probe.to_toroidal(probe.to_world(swept))) / scale, swept / scale, atol=1e-5
    )
    with in_float64():
        back = probe_of(name).to_toroidal(probe_of(name).to_world(swept))
        np.testing.assert_allclose(back, swept, atol=1e-12)


def test_derivatives_of_the_map_match_finite_differences():
    with in_float64():
        points = world_of(nodes(PROBES["across the middle"], (3, 4, 3)), 20.0, 30.0).reshape(-1, 3)
        space = space_of(probe_of("across the middle"))
        leaves, rebuild = jax.tree.flatten((space, tuple(jnp.asarray(points.T))))
        random = np.random.default_rng(0)

        def coordinates(leaves):
            space, point = jax.tree.unflatten(rebuild, leaves)
            return jnp.stack(jax.vmap(space.coordinate)(point))

        for i, leaf in enumerate(leaves):
            change = [jnp.zeros_like(other) for other in leaves]
            change[i] = jnp.asarray(random.normal(size=leaf.shape))
            ends = [[p + h * d for p, d in zip(leaves, change, strict=True)] for h in (1e-6, -1e-6)]
            difference = (coordinates(ends[0]) - coordinates(ends[1])) / 2e-6
            slope = jax.jvp(coordinates, (leaves,), (change,))[1]
            np.testing.assert_allclose(slope, difference, rtol=1e-6, atol=1e-7)
            weights = jnp.asarray(random.normal(size=difference.shape))
            gradient = jax.grad(lambda leaves, w=weights: jnp.sum(w * coordinates(leaves)))(leaves)
            np.testing.assert_allclose(jnp.vdot(gradient[i], change[i]), jnp.vdot(weights, slope), rtol=1e-9)


def singular_points(probe):
    """Points on and around the motor axis, at and behind the apex, and at the sector's corners and edges."""
    a, b, *_ranges = probe
    special = [(x, 0, 0) for x in (-3, 0, 7)] + [(0, 0, a), (0, a, 0), (0, a * 0.6, a * 0.8), (0, 0, -a)]
    special += [tuple(p) for p in world_of(nodes(probe, (3, 3, 3)), a, b).reshape(-1, 3)]
    special += [(5, 1, a / 2), (0, 0, -60), (10, -20, -60)]
    nudges = [0, 1e-30, 1e-20, 1e-12, 1e-6, 1e-3]
    return np.array(
        [np.add(p, s * h * np.ones(3) * (1, 1, -1)) for p in special for h in nudges for s in (1, -1)]
    )


@pytest.mark.parametrize("name", ["across the middle", "apex behind the axis", "apex on the axis"])
def test_values_and_gradients_are_finite_where_the_map_is_singular(name):
    probe = probe_of(name)
    points = jnp.asarray(singular_points(PROBES[name]), jnp.float32)
    assert np.isfinite(probe.to_toroidal(points)).all()
    backward = jax.vmap(jax.jacrev(lambda p, probe: probe.to_toroidal(p), argnums=(0, 1)), (0, None))
    forward = jax.vmap(jax.jacfwd(lambda p, probe: probe.to_toroidal(p), argnums=(0, 1)), (0, None))
    for derivative in (backward, forward):
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(derivative(points, probe)))
    on_axis = jax.grad(lambda p: probe.to_toroidal(p)[0])(jnp.asarray([3.0, 0.0, 0.0]))
    np.testing.assert_array_equal(on_axis, 0)
    if PROBES[name][0] < 0:
        return  # no world point is the apex
    at_apex = jax.grad(lambda p: probe.to_toroidal(p)[1])(jnp.asarray([0.0, 0.0, PROBES[name][0]]))
    np.testing.assert_array_equal(at_apex, 0)


@pytest.mark.slow
def test_rays_through_the_singular_points_see_finite_things():
    """Along the motor axis, through the apex, along edges, into corners, from corners."""
    points = singular_points(PROBES["across the middle"])[::12]
    random = np.random.default_rng(0)
    directions = np.concatenate([np.eye(3), -np.eye(3), random.normal(size=(2, 3))])
    origins, directions = (
        part.reshape(-1, 3)
        for part in np.broadcast_arrays(points[:, None] - 80 * directions, directions[None])
    )
    origins = np.concatenate([origins, points])
    directions = np.concatenate([directions, np.broadcast_to(directions[:1], points.shape)])
    volume = jv.Volume(random.random(SHAPE, np.float32))

    def loss(probe, origins):
        march = jv.March(4.0, (probe, jv.AlphaCorrection()))
        rgba = jv.render_rays(volume, uniform_transfer(0.01), origins, directions, march).rgba
        return jnp.sum(rgba), rgba

    compute = jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)
    (_, rgba), gradients = compute(probe_of("across the middle"), jnp.asarray(origins, jnp.float32))
    assert np.isfinite(rgba).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))


# ---- where the sector lies ----


@pytest.mark.parametrize("name", PROBES)
def test_bounds_are_tight(name):
    probe = PROBES[name]
    points = world_of(nodes(probe, (301, 301, 2)), *probe[:2]).reshape(-1, 3)  # extremes lie on the γ faces
    size = np.ptp(points, axis=0).max()
    low, high = probe_of(name).corners
    assert (points.min(axis=0) >= low - 1e-6 * size).all()
    assert (points.max(axis=0) <= high + 1e-6 * size).all()
    np.testing.assert_allclose(low, points.min(axis=0), atol=1e-4 * size)
    np.testing.assert_allclose(high, points.max(axis=0), atol=1e-4 * size)
    np.testing.assert_allclose(probe_of(name).bounds, np.stack([low, high], -1).ravel())
    np.testing.assert_allclose(probe_of(name).center, (low + high) / 2)


def random_rays(probe, count, seed):
    """Rays from outside, inside and the hollow, toward the sector and past it, some along axes."""
    random = np.random.default_rng(seed)
    points = world_of(nodes(probe, (9, 9, 9)), *probe[:2]).reshape(-1, 3)
    middle, size = points.mean(axis=0), np.ptp(points, axis=0)
    distance = random.choice([0.05, 0.4, 1.0, 2.0], (count, 1))
    origins = middle + distance * size.max() * random.normal(size=(count, 3))
    directions = middle + random.uniform(-0.7, 0.7, (count, 3)) * size - origins
    axis = np.eye(3)[random.integers(3, size=count)] * random.choice([-1, 1], (count, 1))
    directions = np.where(random.random((count, 1)) < 0.2, axis, directions)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return origins.astype(np.float32), directions.astype(np.float32)


@pytest.mark.parametrize("name", PROBES)
def test_entry_and_exit_are_the_first_and_last_place_inside(name):
    probe = PROBES[name]
    size = abs(probe[0]) + probe[1] + probe[4][1]
    origins, directions = random_rays(probe, 250, seed=1)
    t_in, length = (np.asarray(part) for part in part_inside(probe_of(name), origins, directions))
    found = missed = within = gaps = 0
    for origin, direction, near, extent in zip(origins, directions, t_in, length, strict=True):
        pieces = pieces_inside(origin, direction, probe, reach=3 * size + float(np.linalg.norm(origin)))
        if len(pieces) == 0:
            missed += 1
            # a ray that grazes the sector may get an empty interval
            if extent > 0:
                t = np.linspace(near, near + extent, 101)[:, None]
                away = np.abs(world_of_clipped(origin + t * direction, probe)).max(axis=1)
                assert away.min() < 1e-3 * size
            continue
        if (pieces[:, 1] - pieces[:, 0]).min() < 0.01 * size:
            continue  # a grazing ray
        found, within = found + 1, within + (pieces[0, 0] == 0)
        gaps += len(pieces) > 1
        np.testing.assert_allclose([near, near + extent], [pieces[0, 0], pieces[-1, 1]], atol=1e-4 * size / 4)
    assert found > 60
    assert missed > 10
    assert within > 5
    assert gaps > 0 or name != "across the middle"


TWICE = (20.5, 3.9, (0.02, 3.12), (0.3, 2.0), (2.1, 27.6))
"""A probe, and a ray that leaves its sector twice in between."""
TWICE_OUT = ((-83.3237, 167.7067, -131.6659), (0.3564766, -0.6642374, 0.6570488))


@pytest.mark.parametrize("name", [*PROBES, "twice"])
def test_gaps_are_where_a_ray_is_outside_in_between(name):
    """As dense sampling in float64 finds them; none is missed, and none is added."""
    probe = TWICE if name == "twice" else PROBES[name]
    size = abs(probe[0]) + probe[1] + probe[4][1]
    origins, directions = random_rays(probe, 400, seed=7)
    if name == "twice":
        found = [np.array([part], np.float32) for part in TWICE_OUT]
        origins, directions = (np.concatenate(p) for p in zip(found, (origins, directions), strict=True))
    elif name == "across the middle":
        found = gap_rays()
        origins, directions = (np.concatenate(p) for p in zip(found, (origins, directions), strict=True))
    a, b, *ranges = probe
    rays = rays_of(jv.ToroidalMap(a, b, *ranges), jnp.float32(origins), jnp.float32(directions))
    gaps = np.asarray(rays.gaps).transpose(2, 0, 1)
    most = 0
    for i in np.flatnonzero(np.asarray(rays.length) > 0):
        reach = 3 * size + float(np.linalg.norm(origins[i]))
        pieces = pieces_inside(origins[i], directions[i], probe, reach, dense=4001)
        widths = np.diff(pieces.ravel())
        if len(pieces) == 0 or widths.min() < 0.01 * size:
            continue  # a grazing ray
        known = gaps[i][np.isfinite(gaps[i, :, 0])]
        known = known[known[:, 1] > 0]  # a ray that grazes the sector first may begin outside
        between = np.stack([pieces[:-1, 1], pieces[1:, 0]], -1)
        np.testing.assert_allclose(known + rays.t_in[i], between, atol=1e-4 * size / 4)
        most = max(most, len(between))
    assert most == {"twice": 2, "across the middle": 1}.get(name, most)


def rays_along(probe, heights):
    """Rays outside a sector, along generators of its faces of σ at these heights, and of β; and some through
    the motor axis in the plane across it."""
    a, b, beta, sigma, gamma = probe
    size = abs(a) + b + gamma[1]
    to_world = jv.ToroidalMap(*probe).to_world
    origins, directions = [], []
    for height in heights:
        for face in (0, 1):
            for axis in (0, 1):
                at = [np.mean(beta), np.mean(sigma), gamma[0]]
                at[axis] = (beta, sigma)[axis][face]
                near, far = (np.asarray(to_world(jnp.asarray([*at[:2], g]))) for g in gamma)
                inner = np.asarray(to_world(jnp.asarray([np.mean(beta), np.mean(sigma), np.mean(gamma)])))
                along = (far - near) / np.linalg.norm(far - near)
                away = near - inner - along * ((near - inner) @ along)
                origins.append(near + height * size * away / np.linalg.norm(away) - size * along)
                directions.append(along)
    for angle in np.linspace(0, 2 * np.pi, 23):
        direction = np.array([0, np.sin(angle), np.cos(angle)])
        origins.append(-3 * size * direction)
        directions.append(direction)
    return np.array(origins), np.array(directions)


@pytest.mark.parametrize("name", [*PROBES, "touches the axis"])
def test_rays_along_faces_and_across_the_axis_see_no_more_than_the_sector(name):
    """Every piece of a ray that counts as inside is inside, but for a part of the probe's size."""
    angles = (np.pi / 2 - 0.61, np.pi / 2 + 0.61), (np.pi / 2 - 0.7, np.pi / 2 + 0.7)
    probe = PROBES.get(name, (-10.0, 10.0, *angles, (0.0, 50.0)))
    size = abs(probe[0]) + probe[1] + probe[4][1]
    origins, directions = rays_along(probe, (1e-4, 1e-3, 1e-2))
    a, b, *ranges = probe
    rays = rays_of(jv.ToroidalMap(a, b, *ranges), jnp.float32(origins), jnp.float32(directions))
    gaps = np.asarray(rays.gaps).transpose(2, 0, 1)
    for i in range(len(origins)):
        pieces = pieces_inside(origins[i], directions[i], probe, 8 * size, dense=8001)
        gap = np.clip(gaps[i], 0, rays.length[i])
        seen = float(rays.length[i] - np.sum(gap[:, 1] - gap[:, 0]))
        assert abs(seen - np.sum(pieces[:, 1] - pieces[:, 0])) < 1e-3 * size, (i, seen, pieces)


def world_of_clipped(points, probe):
    """Vectors from points to the nearest points (in β, σ, γ) of the sector."""
    a, b, *ranges = probe
    place = printed_map(points, a, b)
    inside = np.stack([np.clip(place[..., i], *ends) for i, ends in enumerate(ranges)], -1)
    return world_of(inside, a, b) - points


def test_a_ray_from_the_hollow_begins_at_the_near_face():
    probe = PROBES["across the middle"]
    (near,), (extent,) = part_inside(probe_of("across the middle"), jnp.zeros((1, 3)), jnp.eye(3)[2:])
    np.testing.assert_allclose([near, extent], [50, 60], atol=1e-4)
    origins, directions = (
        np.array([[0, 0, 45], [0, 0, 50], [0, 0, 110], [0, 0, 80]], np.float32),
        np.array([[0, 1, 0]], np.float32),
    )
    directions = np.repeat(directions, 4, 0)
    t_in, length = part_inside(probe_of("across the middle"), origins, directions)
    for i in (0, 3):
        ends = pieces_inside(origins[i], directions[i], probe)
        np.testing.assert_allclose([t_in[i], t_in[i] + length[i]], [ends[0, 0], ends[-1, 1]], atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("away", [3e2, 3e4, 1e6])
def test_a_far_camera_finds_the_faces_and_their_gradients(away):
    """A ray is restarted near its entry, even if rounding moved it past the face."""
    probe = probe_of("across the middle")
    targets = world_of(nodes(PROBES["across the middle"], (5, 5, 5))[1:-1, 1:-1, 1:-1], 20, 30).reshape(-1, 3)
    direction = np.array([0.48, -0.6, 0.64])
    origins = jnp.asarray(targets - away * direction, jnp.float32)
    directions = jnp.asarray(np.broadcast_to(direction, targets.shape), jnp.float32)
    _, length = part_inside(probe, origins, directions)
    slopes = jax.grad(lambda o: part_inside(probe, o, directions)[0].sum())(origins)
    np.testing.assert_allclose(slopes @ np.float32(direction), -1, atol=2e-3)
    close = np.asarray(origins, np.float64) + (away - 200) * np.float64(directions)
    for origin, d, extent in zip(close, np.asarray(directions), length, strict=True):
        ends = pieces_inside(origin, d, PROBES["across the middle"])
        # the ray itself has been rounded
        np.testing.assert_allclose(extent, ends[-1, 1] - ends[0, 0], atol=1e-3 + 8e-7 * away)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["across the middle", "apex behind the axis", "above the middle"])
def test_gradients_of_entry_and_length_match_finite_differences(name):
    origins, directions = random_rays(PROBES[name], 120, seed=3)
    kept = []
    for i, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        pieces = pieces_inside(origin, direction, PROBES[name], reach=1000.0)
        if len(pieces) and pieces[0, 0] > 1 and (pieces[:, 1] - pieces[:, 0]).min() > 8:
            kept.append(i)
    assert len(kept) > 8
    with in_float64():
        leaves = {
            "origins": jnp.asarray(origins[kept], jnp.float64),
            "directions": jnp.asarray(directions[kept], jnp.float64),
            **dict(zip(("a", "b", "beta", "sigma", "gamma"), map(jnp.asarray, PROBES[name]), strict=True)),
        }

        def ends(leaves):
            probe = jv.ToroidalMap(*(leaves[k] for k in ("a", "b", "beta", "sigma", "gamma")))
            return jnp.stack(part_inside(probe, leaves["origins"], leaves["directions"]))

        ends = jax.jit(ends)
        random, changed = np.random.default_rng(0), jax.jit(lambda p, c: jax.jvp(ends, (p,), (c,))[1])
        change = {}
        for key, leaf in leaves.items():
            change = {k: jnp.zeros_like(v) for k, v in leaves.items()}
            change[key] = jnp.asarray(random.normal(size=leaf.shape))
            moved = [ends(jax.tree.map(lambda p, c, h=h: p + h * c, leaves, change)) for h in (1e-5, -1e-5)]
            difference = (moved[0] - moved[1]) / 2e-5
            np.testing.assert_allclose(changed(leaves, change), difference, rtol=1e-5, atol=1e-5, err_msg=key)
        weights = jnp.asarray(random.normal(size=(2, len(kept))))
        gradient = jax.grad(lambda p: jnp.sum(weights * ends(p)))(leaves)
        slope = sum(jnp.vdot(gradient[k], change[k]) for k in leaves)
        np.testing.assert_allclose(slope, jnp.vdot(weights, changed(leaves, change)), rtol=1e-9)


# ---- images ----


def gap_rays():
    """Rays across the hollow at the near side, which enter and leave the sector twice."""
    z, tilt = (part.ravel() for part in np.meshgrid([36.0, 40, 44, 47], [0.0, 0.03, -0.05]))
    origins = np.stack([2 + 0 * z, -150 + 0 * z, z], -1)
    directions = np.stack([tilt, 1 + 0 * z, tilt / 2], -1)
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.slow
@pytest.mark.parametrize("quadrature", ["left", "midpoint"])
@pytest.mark.parametrize("step", [0.37, 11.0, 70.0])
def test_a_gap_is_left_out_of_a_constant_volume_exactly(step, quadrature):
    origins, directions = gap_rays()
    volume, transfer = jv.Volume(np.ones(SHAPE, np.float32)), uniform_transfer(0.02)
    march = jv.March(step, (probe_of("across the middle"), jv.AlphaCorrection()), quadrature)
    rendering = jv.render_rays(volume, transfer, origins, directions, march)
    pieces = [
        pieces_inside(o, d, PROBES["across the middle"]) for o, d in zip(origins, directions, strict=True)
    ]
    assert sum(len(p) == 2 for p in pieces) >= 8
    inside = np.array([(p[:, 1] - p[:, 0]).sum() for p in pieces])
    np.testing.assert_allclose(rendering.rgba[:, 3], -np.expm1(-0.02 * inside), atol=1e-6)


@pytest.mark.slow
def test_nothing_is_seen_behind_the_axis_and_behind_the_apex():
    volume, transfer = jv.Volume(np.ones(SHAPE, np.float32)), uniform_transfer(1.0)
    for name in ("across the middle", "half a turn"):
        origins = np.array([(x, y, z) for x in (-8.0, 0, 3) for y in (-4.0, 0, 5) for z in (-70.0, -30, -1)])
        march = jv.March(0.5, (probe_of(name),))
        along_x = np.broadcast_to([1.0, 0, 0], origins.shape)
        assert not jv.render_rays(volume, transfer, origins, along_x, march).rgba.any()
        down = np.broadcast_to([0, 0, -1.0], origins.shape)
        assert not jv.render_rays(volume, transfer, origins, down, march).rgba.any()
        behind = origins * (1, 0.5, -0.2) + (0, 0, 1)  # 0 < ρ < a: R < 0
        assert (np.hypot(behind[:, 1], behind[:, 2]) < PROBES[name][0]).all()
        inward = np.concatenate([along_x[:, :1] * 0, -behind[:, 1:]], -1)
        short = inward / np.linalg.norm(inward, axis=1, keepdims=True)
        assert not jv.render_rays(volume, transfer, behind, short, march).rgba.any()


CENTER, RADIUS, DENSITY = np.array([4.0, -5.0, 82.0]), 16.0, 0.05


def acquired_sphere(refine):
    """A sphere sampled by the probe, its edge a ramp about one node wide, and the largest node spacing."""
    probe = PROBES["across the middle"]
    shape = tuple(n * refine + 1 for n in (12, 12, 10))
    points = world_of(nodes(probe, shape), *probe[:2])
    spacing = max((2.3 - 0.9) * 100 / 12, 1.6 * 80 / 12, 6.0) / refine
    distance = np.linalg.norm(points - CENTER, axis=-1) - RADIUS
    return jv.Volume(np.clip(0.5 - distance / spacing, 0, 1).astype(np.float32)), spacing


def flat(rays):
    return np.asarray(rays).reshape(-1, 3)


def rays_past_the_sphere(impact):
    """Parallel rays at these distances from the sphere's centre, in several directions."""
    origins, directions = [], []
    for angle in (0.0, 0.9, 2.2):
        direction = np.array([np.sin(angle), 0.8, np.cos(angle)])
        direction /= np.linalg.norm(direction)
        across = np.cross(direction, [0.2, -0.3, 0.9])
        across /= np.linalg.norm(across)
        origins.append(CENTER + impact[:, None] * across - 200 * direction)
        directions.append(np.broadcast_to(direction, (len(impact), 3)))
    return np.stack(origins), np.stack(directions)


def seen_past_the_sphere(volume, impact, extinction, step):
    """Opacity, given extinctions at the values 0, ½, 0.501 and 1, by one program per volume shape."""
    transfer = jv.TransferFunction([0.0, 0.5, 0.501, 1.0], np.ones((4, 3)), extinction)
    march = jv.March(step, (probe_of("across the middle"),), "midpoint")
    return np.asarray(jv.render_rays(volume, transfer, *rays_past_the_sphere(impact), march).rgba[..., 3])


@pytest.mark.slow
def test_a_sphere_acquired_by_a_probe_renders_as_a_sphere():
    """At the silhouette, a ramp of width h adds a chord of about sqrt(R h) in a ring of width h. So the
    largest error falls as h^½, and the root mean square error as h."""
    impact = (np.arange(160) + 0.5) / 8
    exact = -np.expm1(-DENSITY * 2 * np.sqrt(np.maximum(RADIUS**2 - impact**2, 0)))
    ramp = DENSITY * np.array([0, 0.5, 0.501, 1])
    spacings, errors = [], []
    for refine in (2, 8):
        volume, spacing = acquired_sphere(refine)
        off = np.abs(seen_past_the_sphere(volume, impact, ramp, 0.5) - exact)
        spacings.append(spacing)
        errors.append([np.sqrt(np.mean(off**2)), off.max()])
    order = np.polyfit(np.log(spacings), np.log(errors), 1)[0]
    np.testing.assert_allclose(order, [1, 0.5], atol=0.15)
    assert errors[-1][0] < 0.025


@pytest.mark.slow
def test_the_silhouette_lies_within_half_a_sample():
    volume, spacing = acquired_sphere(2)
    impact = RADIUS + np.linspace(-1, 1, 160) * spacing
    seen = seen_past_the_sphere(volume, impact, [0.0, 0.0, 100.0, 100.0], 0.1) > 0.5
    silhouette = impact[seen.shape[1] - 1 - np.argmax(seen[:, ::-1], axis=1)]
    np.testing.assert_allclose(silhouette, RADIUS, atol=spacing / 2)


# ---- with other transforms ----


def noise_volume():
    """Independent random values at every node. Under the map, the spacing is ignored."""
    return jv.Volume(np.random.default_rng(2).random(SHAPE, np.float32), spacing=(0.5, 2.0, 7.0))


def ramp_transfer(top=0.06):
    """Transparent below 0.3; red is 1, so that its channel is the sum of the weights."""
    colors = [(1, 0.1, 0.9), (1, 0.3, 0.7), (1, 0.9, 0.1)]
    return jv.TransferFunction([0.0, 0.3, 1.0], np.array(colors, float), [0.0, 0.0, top])


COMBINED = {
    "plain": (),
    "aligned": (jv.AlphaCorrection(),),
    "jittered": (jv.Jitter(3), jv.AlphaCorrection(), jv.EarlyTermination(0.1)),
    "all": (jv.Jitter(1, "blue"), jv.EmptySpaceJitter(2), jv.AlphaCorrection(), jv.EarlyTermination(0.1)),
}


def view(probe, size=(9, 7)):
    """A camera at the side, several of whose rays cross the hollow."""
    return jv.Camera(
        (40.0, -190.0, 20.0), probe.center - jnp.asarray([0.0, 0.0, 18.0]), (0, 0, -1), 30.0, size=size
    )


@eqx.filter_jit
def reference_image(volume, transfer, camera, march):
    width, height = camera.size
    column, row = jnp.meshgrid(jnp.arange(width), jnp.arange(height))
    origins, directions = camera.rays()

    def one(origin, direction, column, row):
        return jv.render_ray_reference(volume, transfer, origin, direction, march, pixel=(column, row))

    return jax.vmap(jax.vmap(one))(origins, directions, column, row)


@pytest.mark.slow
@pytest.mark.parametrize("quadrature", ["left", "midpoint"])
@pytest.mark.parametrize("names", COMBINED)
def test_it_composes_with_other_transforms(names, quadrature):
    probe = probe_of("across the middle")
    volume, transfer, camera = noise_volume(), ramp_transfer(), view(probe)
    transforms = (probe, *COMBINED[names])
    rendering = jv.render(volume, transfer, camera, jv.March(5.3, transforms, quadrature))
    np.testing.assert_allclose(rendering.rgba[..., 0], rendering.rgba[..., 3], atol=1e-6)
    assert float(rendering.rgba[..., 3].max()) > 0.5
    counted = jv.March(5.3, transforms, quadrature, max_samples=64)
    reference = reference_image(volume, transfer, camera, counted)
    assert not np.any(reference.exhausted)
    np.testing.assert_allclose(rendering.rgba, reference.rgba, atol=2e-5)
    np.testing.assert_array_equal(rendering.samples, reference.samples)


@pytest.mark.slow
def test_its_place_among_other_transforms_does_not_show():
    probe = probe_of("across the middle")
    volume, transfer, camera = noise_volume(), ramp_transfer(), view(probe)
    first, last = (
        jv.render(volume, transfer, camera, jv.March(5.3, transforms))
        for transforms in ((probe, *COMBINED["all"]), (*COMBINED["all"], probe))
    )
    np.testing.assert_array_equal(first.rgba, last.rgba)


def independent_march(data, probe, points, origins, directions, d, midpoint, align):
    """(rays, 4) colour and opacity: float64 NumPy, ray by ray and cell by cell, values by scipy."""
    values, colors, extinction = points
    a, b, *ranges = probe
    images = []
    for origin, direction in zip(origins, directions, strict=True):
        pieces = pieces_inside(origin, direction, probe, dense=20001)
        color, left = np.zeros(3), 1.0
        cells = []
        if len(pieces):
            count = int(np.ceil((pieces[-1, 1] - pieces[0, 0]) / d)) + 1
            for front in pieces[0, 0] + d * np.arange(count):
                if align:
                    parts = np.clip(pieces, front, front + d)
                    cells += [(p, q) for p, q in parts if q > p]
                else:
                    at = front + d / 2 * midpoint
                    cells += [(front, front + d)] * bool(((pieces[:, 0] <= at) & (at < pieces[:, 1])).any())
        for start, stop in cells:
            at = (start + stop) / 2 if midpoint else start
            place = printed_map(origin + at * direction, a, b)
            grid = [
                (c - e[0]) / (e[1] - e[0]) * (n - 1)
                for c, e, n in zip(place, ranges, data.shape, strict=True)
            ]
            value = map_coordinates(data, np.array(grid)[:, None], order=1, mode="nearest")[0]
            alpha = 1 - np.exp(-np.interp(value, values, extinction) * (stop - start))
            color = color + left * alpha * np.array([np.interp(value, values, c) for c in colors.T])
            left *= 1 - alpha
        images.append([*color, 1 - left])
    return np.array(images)


@pytest.mark.parametrize(
    ("align", "quadrature"),
    [
        pytest.param(*case, marks=[] if case == (True, "midpoint") else pytest.mark.slow)
        for case in itertools.product((False, True), ("left", "midpoint"))
    ],
)
def test_an_independent_marcher_sees_the_same(align, quadrature):
    with in_float64():
        probe, transfer, volume = probe_of("across the middle"), ramp_transfer(), noise_volume()
        march = jv.March(5.3, (*(jv.AlphaCorrection(),) * align, probe), quadrature)
        camera = view(probe)
        rgba = jv.render(volume, transfer, camera, march).rgba.reshape(-1, 4)
        origins, directions = (np.asarray(part).reshape(-1, 3) for part in camera.rays())
        points = tuple(np.asarray(p) for p in (transfer.values, transfer.colors, transfer.extinction))
        data = np.asarray(volume.data, np.float64)
        expected = independent_march(
            data,
            PROBES["across the middle"],
            points,
            origins,
            directions,
            5.3,
            quadrature == "midpoint",
            align,
        )
    np.testing.assert_allclose(rgba, expected, atol=2e-6)


# ---- gradients of values and of images ----


def test_world_gradient_is_the_slope_of_the_value_in_the_world():
    with in_float64():
        probe = probe_of("apex behind the axis")
        i, j, k = np.meshgrid(*map(np.arange, SHAPE), indexing="ij")
        flat = jv.Volume((0.3 * i - 0.7 * j + 0.2 * k).astype(np.float32))
        points = world_of(nodes(PROBES["apex behind the axis"], (4, 4, 4))[1:-1, 1:-1, 1:-1] + 0.011, -15, 40)
        noise = noise_volume()
        cases: list[tuple[jv.Volume, Literal["trilinear", "central"]]]
        cases = [(noise, "trilinear"), (flat, "trilinear"), (flat, "central")]
        for volume, method in cases:
            space = jv.March(1.0, (probe,)).locate(volume)

            def value(point, volume=volume, space=space):
                return volume.value(space.coordinate(apart(point)))

            for point in points.reshape(-1, 3):
                nudged = [
                    [float(value(jnp.asarray(point + s * 1e-6 * e))) for s in (1, -1)] for e in np.eye(3)
                ]
                difference = np.array([(p - q) / 2e-6 for p, q in nudged])
                slope = world_gradient(volume, space, apart(jnp.asarray(point)), method)
                np.testing.assert_allclose(jnp.stack(slope), difference, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", ["replay", "direct", "forward"])
@pytest.mark.parametrize("position", [(6.0, -9.0, -150.0), (2.0, -150.0, 20.0)], ids=["behind", "beside"])
def test_image_gradients_in_the_probe_match_central_differences(adjoint, position):
    """From behind the probe, where no ray meets a gap, and from beside it, where some do."""
    with in_float64():
        names = ("a", "b", "beta", "sigma", "gamma")
        leaves: dict[str, Any] = dict(zip(names, map(jnp.asarray, PROBES["across the middle"]), strict=True))
        leaves["position"] = jnp.asarray(position)
        volume = jv.Volume(np.random.default_rng(0).random((6, 5, 7)))
        weights = jnp.asarray(np.random.default_rng(5).normal(size=(5, 6, 4)))
        beside = position[1] < -100
        target, up = ((1.0, 2.0, 48.0), (1.0, 0.1, 0.0)) if beside else ((1.0, 2.0, 80.0), (0.1, 1.0, 0.0))
        rays = jv.Camera(position, target, up, 22.0, size=(6, 5)).rays()
        found = map(partial(pieces_inside, probe=PROBES["across the middle"]), *map(flat, rays))
        assert (max(map(len, found)) == 2) == beside

        @jax.jit
        def loss(leaves):
            probe = jv.ToroidalMap(*(leaves[k] for k in names))
            camera = jv.Camera(leaves["position"], target, up, 22.0, size=(6, 5))
            march = jv.March(2.3, (probe, jv.AlphaCorrection()), "midpoint", max_samples=128)
            return jnp.sum(weights * jv.render(volume, ramp_transfer(), camera, march, adjoint=adjoint).rgba)

        random = np.random.default_rng(1)
        gradient = {} if adjoint == "forward" else jax.jit(jax.grad(loss))(leaves)
        for key, leaf in leaves.items():
            change = {k: jnp.zeros_like(v) for k, v in leaves.items()}
            change[key] = jnp.asarray(random.normal(size=leaf.shape))
            ends = [loss(jax.tree.map(lambda p, c, h=h: p + h * c, leaves, change)) for h in (1e-6, -1e-6)]
            difference = (ends[0] - ends[1]) / 2e-6
            if adjoint != "forward":
                slope = jnp.vdot(gradient[key], change[key])
            else:
                slope = jax.jvp(loss, (leaves,), (change,))[1]
            np.testing.assert_allclose(slope, difference, rtol=1e-5, atol=1e-8, err_msg=key)


# ---- phantoms, a real scan, bad input ----


@pytest.mark.parametrize("name", ["shells", "spheres", "wires", "fetus"])
def test_a_phantom_is_one_scene_at_every_shape(name):
    fine, probe = toroidal_phantom(name, (17, 21, 33), speckle=False)
    coarse, _ = toroidal_phantom(name, (9, 11, 17), speckle=False)
    assert fine.data.dtype == jnp.uint8
    assert fine.shape == (17, 21, 33)
    difference = np.asarray(fine.data, int)[::2, ::2, ::2] - np.asarray(coarse.data, int)
    assert np.abs(difference).max() <= 1  # from rounding to uint8
    spot, again, other = (toroidal_phantom(name, (9, 11, 17), seed=s)[0].data for s in (0, 0, 1))
    np.testing.assert_array_equal(spot, again)
    assert np.any(spot != other)
    assert probe.gamma_range[1] == 100


def echo_at(name, points, shape=(65, 81, 129)):
    volume, probe = toroidal_phantom(name, shape, speckle=False)
    space = jv.March(1.0, (probe,)).locate(volume)
    at = jax.vmap(lambda p: volume.value(space.coordinate(apart(p))))
    return np.asarray(at(jnp.asarray(points, jnp.float32)))


@pytest.mark.slow
def test_phantoms_hold_what_their_table_says():
    shells = np.asarray(toroidal_phantom("shells", (9, 9, 401), speckle=False)[0].data, int)
    assert np.ptp(shells, axis=(0, 1)).max() == 0
    np.testing.assert_array_equal(shells[0, 0, [48, 96, 24]], [220, 187, 8])
    centers = [(x, y, 95) for y in (-20, 20) for x in (-30, -4, 28)]
    np.testing.assert_allclose(
        echo_at("spheres", [*centers, (0, 0, 60)]), [4, 4, 4, 130, 160, 190, 60], atol=1
    )
    # wires, and tissue beside them
    found = echo_at(
        "wires", [(30, 0, 110), (0, -40, 75), (0, 0, 97.5), (30, 6, 110), (30, 0, 116)], (129, 161, 257)
    )
    assert np.all(found[:3] > 200)
    np.testing.assert_allclose(found[3:], 60, atol=1)
    # amniotic fluid above the belly, uterus, belly, brain, skull (some of it between nodes)
    seen = echo_at("fetus", [(5, 0, 76), (0, 0, 140), (13, 0, 97), (-36, 0, 98), (-45.5, 0, 98)])
    np.testing.assert_allclose(seen[:4], [4, 30, 70, 40], atol=1)
    assert seen[4] > 90


def test_speckle_is_rayleigh_and_correlated_along_the_beam_alone():
    volume, _ = toroidal_phantom("spheres", (48, 48, 300))
    echo = np.asarray(volume.data, float)[..., :100] / 60  # before the spheres
    assert echo.mean() == pytest.approx(1, abs=0.01)
    assert echo.std() == pytest.approx(np.sqrt(4 / np.pi - 1), rel=0.02)
    away = echo - echo.mean()
    beam, across = ((away * np.roll(away, 1, axis)).mean() / away.var() for axis in (2, 0))
    assert beam > 0.5
    assert abs(across) < 0.02


@pytest.mark.slow
def test_the_real_scan_renders(real_volume):
    data = np.asarray(jv.load(real_volume("us_aplio_convex_239x128x91_uint8.raw.gz")).data)
    volume = jv.Volume(np.ascontiguousarray(data.transpose(2, 1, 0)))
    azimuth, elevation = np.deg2rad(38.55), np.deg2rad(54.45) / 2
    probe = jv.ToroidalMap(
        22.70 - 52.70,
        52.70,
        (HALF - elevation, HALF + elevation),
        (HALF - azimuth, HALF + azimuth),
        (0, 69.58),
    )
    camera = jv.Camera((100, -180, -60), probe.center, (0, 0, -1), 30.0, size=(24, 20))
    march = jv.March(1.0, (probe, jv.AlphaCorrection(), jv.EarlyTermination()))
    rendering = jv.render(volume, jv.colormap("gray", (60, 200), (0.0, 0.5)), camera, march)
    assert not np.any(rendering.exhausted)
    assert np.isfinite(rendering.rgba).all()
    opacity = np.asarray(rendering.rgba[..., 3])
    assert opacity.max() > 0.8
    assert 0.03 < (opacity > 0.1).mean() < 0.5


GOOD = {"a": 20.0, "b": 30.0, "beta_range": (1, 2), "sigma_range": (1, 2), "gamma_range": (0, 60)}
BAD = {
    "a range that falls": ({"beta_range": (2, 1)}, "beta_range must be .* first < last"),
    "a range of no width": ({"gamma_range": (3, 3)}, "gamma_range must be .* first < last"),
    "below 0": ({"sigma_range": (-0.1, 1)}, r"sigma_range must lie in \[0, π\]"),
    "degrees": ({"beta_range": (55, 125)}, r"beta_range must lie in \[0, π\]"),
    "through the apex": ({"b": 5.0, "gamma_range": (-5, 60)}, "gamma_range must begin beyond the apex"),
    "NaN": ({"a": float("nan")}, "a must be finite"),
    "infinite": ({"gamma_range": (0, float("inf"))}, "gamma_range must be finite"),
    "no angle": ({"sigma_range": (1.5, 1.5)}, "sigma_range must be .* first < last"),
    "over pi": ({"beta_range": (0.1, 3.3)}, r"beta_range must lie in \[0, π\]"),
    "a first depth behind the apex": ({"b": -5.0}, "gamma_range must begin beyond the apex"),
    "not a number": ({"b": (1, 2)}, r"b must have shape \(\)"),
    "three ends": ({"beta_range": (1, 1.5, 2)}, r"beta_range must have shape \(2,\)"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_probes_are_named(case):
    changes, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        jv.ToroidalMap(**{**GOOD, **changes})


def test_b_may_be_negative_where_depth_begins_beyond_the_apex():
    one = jv.ToroidalMap(**{**GOOD, "b": -5.0, "gamma_range": (35, 95)})
    other = jv.ToroidalMap(**{**GOOD, "b": 30.0, "gamma_range": (0, 60)})
    np.testing.assert_allclose(one.bounds, other.bounds, rtol=1e-6)


@pytest.mark.parametrize("name", PROBES)
@pytest.mark.parametrize("lower", [0.0, 60.0])
def test_the_sample_nearest_to_the_axis_is_that_of_the_formula(name, lower):
    """ρ = a + (b + γ) cos(σ - π/2), least of all samples; negative if the axis lies beyond."""
    a, b, beta, sigma, gamma = PROBES[name]
    _, angle, depth = np.moveaxis(nodes(PROBES[name], (2, 40, 40)), -1, 0)
    least = np.min(a - lower + (b + depth) * np.cos(angle - HALF))
    probe = jv.ToroidalMap(a - lower, b, beta, sigma, gamma)
    np.testing.assert_allclose(probe.nearest_to_axis, least, atol=1e-4)


def test_bad_points_are_named():
    probe = jv.ToroidalMap(**GOOD)
    for read, name in ((probe.to_toroidal, "points"), (probe.to_world, "toroidal")):
        for bad in (1.0, np.zeros((3, 2))):
            with pytest.raises(ValueError, match=rf"{name} must have shape \(\*points, 3\)"):
                read(bad)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("skull",), "name must be one of shells, spheres, wires, fetus; got 'skull'"),
        (("fetus", 64), "shape must be three numbers of nodes"),
        (("fetus", (64, 64)), "shape must be three numbers of nodes"),
        (("fetus", (64, 4, 64)), "shape must be an integer of at least 8; got 4"),
    ],
)
def test_bad_phantoms_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        toroidal_phantom(*arguments)
