"""The toroidal map: does it match the paper's formula, where do rays meet the sector, are images right?"""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.io.phantoms import toroidal_phantom
from jaxvol.scene.space import enter

from ...modes import check_gradients
from ...scenes import SIZE, in_float64, rendered, slow


HALF = np.pi / 2
SHAPE = (9, 11, 13)
RAYS = 448
"""Always so many, so that all tests share one program."""

PROBES = {
    "across the middle": (20.0, 30.0, (0.9, 2.3), (0.8, 2.4), (0.0, 60.0)),
    "apex behind the axis": (-15.0, 40.0, (HALF - 0.5, HALF + 0.6), (HALF - 0.6, HALF + 0.4), (5.0, 55.0)),
    "above the middle": (20.0, 30.0, (1.9, 2.6), (1.75, 2.5), (10.0, 60.0)),
    "below the middle": (8.0, -12.0, (0.4, 1.2), (0.5, 1.3), (20.0, 84.0)),  # b < 0
    "half a turn": (20.0, 15.0, (0.0, np.pi), (0.3, 2.9), (0.0, 60.0)),
    "apex on the axis": (0.0, 25.0, (1.0, 2.0), (0.9, 2.4), (0.0, 40.0)),
}


MIDDLE = PROBES["across the middle"]


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


def pieces_inside(origins, directions, probe, reach=400.0, dense=4001):
    """Of each ray, (n, 2) distances between which it is inside, by dense sampling and bisection."""
    origins, directions = (np.asarray(part, np.float64).reshape(-1, 3) for part in (origins, directions))
    t = np.linspace(0, np.broadcast_to(reach, len(origins)), dense, axis=1)
    seen = np.stack(
        [is_inside(o + s[:, None] * d, probe) for o, d, s in zip(origins, directions, t, strict=True)]
    )
    seen[:, -1] = False
    seen = np.concatenate([np.zeros((len(t), 1), bool), seen], axis=1)
    t = np.concatenate([t[:, :1], t], axis=1)
    ray, change = np.nonzero(seen[:, 1:] != seen[:, :-1])
    low, high, before = t[ray, change], t[ray, change + 1], seen[ray, change]
    for _ in range(45):
        middle = (low + high) / 2
        same = is_inside(origins[ray] + middle[:, None] * directions[ray], probe) == before
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return [high[ray == i].reshape(-1, 2) for i in range(len(t))]


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


def entered(probe, origins, directions):
    """Distance to the entry, length, and gaps (rays, gaps, 2), found by one program."""
    padded = (np.resize(np.asarray(part, np.float32), (RAYS, 3)) for part in (origins, directions))
    rays = rays_of(jv.ToroidalMap(*probe), *padded)
    found = rays.t_in, rays.length, np.asarray(rays.gaps).transpose(2, 0, 1)
    return [np.asarray(part, np.float64)[: len(origins)] for part in found]


# ---- the map ----


@eqx.filter_jit
def mapped(probe, points, toroidal):
    extent = *probe.corners, probe.bounds, probe.center
    return probe.to_toroidal(points), probe.to_world(toroidal), extent, probe.nearest_to_axis


@pytest.mark.parametrize("name", PROBES)
def test_map_inverse_and_bounds_are_those_of_the_printed_formula(name):
    a, b, *_ = probe = PROBES[name]
    swept = nodes(probe, (17, 18, 19))[1:-1, 1:-1, 1:-1]
    points = world_of(swept, a, b)
    with in_float64():
        found, world, (low, high, bounds, center), nearest = mapped(jv.ToroidalMap(*probe), points, swept)
        np.testing.assert_allclose(found, printed_map(points, a, b), atol=1e-11)
        np.testing.assert_allclose(found, swept, atol=1e-11)
        np.testing.assert_allclose(world, points, atol=1e-11)
    outer = world_of(nodes(probe, (301, 301, 2)), a, b).reshape(-1, 3)  # extremes lie on the γ faces
    size = np.ptp(outer, axis=0).max()
    low, high = np.asarray(low), np.asarray(high)
    assert (outer.min(axis=0) >= low - 1e-6 * size).all()
    assert (outer.max(axis=0) <= high + 1e-6 * size).all()
    np.testing.assert_allclose([low, high], [outer.min(axis=0), outer.max(axis=0)], atol=1e-4 * size)
    np.testing.assert_allclose(bounds, np.stack([low, high], -1).ravel())
    np.testing.assert_allclose(center, (low + high) / 2)
    # ρ = a + (b + γ) cos(σ - π/2), least of all samples; negative if the axis lies beyond
    _, angle, depth = np.moveaxis(nodes(probe, (2, 40, 40)), -1, 0)
    np.testing.assert_allclose(nearest, np.min(a + (b + depth) * np.cos(angle - HALF)), atol=1e-4)


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


@pytest.mark.parametrize("name", ["across the middle", "apex behind the axis"])
def test_values_and_gradients_are_finite_where_the_map_is_singular(name):
    probe, points = jv.ToroidalMap(*PROBES[name]), singular_points(PROBES[name])
    special = np.array([[3.0, 0.0, 0.0], [0.0, 0.0, PROBES[name][0]]])  # on the axis, at the apex

    @eqx.filter_jit
    def derivatives(points, probe):
        one = lambda p, probe: probe.to_toroidal(p)  # noqa: E731
        of = [
            jax.vmap(jac(one, argnums=(0, 1)), (0, None))(points, probe) for jac in (jax.jacrev, jax.jacfwd)
        ]
        return probe.to_toroidal(points), of

    found, (backward, forward) = jax.device_get(
        derivatives(np.asarray([*special, *points], np.float32), probe)
    )
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((found, backward, forward)))
    np.testing.assert_array_equal(backward[0][0, 0], 0)  # of β on the axis
    if PROBES[name][0] > 0:  # else no world point is the apex
        np.testing.assert_array_equal(backward[0][1, 1], 0)  # of σ


# ---- where the sector lies ----


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


def gap_rays():
    """Rays across the hollow at the near side, which enter and leave the sector twice."""
    z, tilt = (part.ravel() for part in np.meshgrid([36.0, 40, 44, 47], [0.0, 0.03, -0.05]))
    origins = np.stack([2 + 0 * z, -150 + 0 * z, z], -1)
    directions = np.stack([tilt, 1 + 0 * z, tilt / 2], -1)
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


TWICE = (20.5, 3.9, (0.02, 3.12), (0.3, 2.0), (2.1, 27.6))
"""A probe, and a ray that leaves its sector twice in between."""
TWICE_OUT = [(0.45013, 3.09314, 26.96575)], [(-0.5495195, -0.748074, -0.3720396)]
OTHERS = {"across the middle": gap_rays(), "twice": TWICE_OUT}


@pytest.mark.parametrize("name", [*PROBES, "twice"])
def test_rays_enter_and_leave_where_dense_samples_do(name):
    """Entry, exit, and every gap in between; none is missed, and none is added."""
    probe = PROBES.get(name, TWICE)
    size = abs(probe[0]) + probe[1] + probe[4][1]
    origins, directions = random_rays(probe, 300, seed=1)
    if name in OTHERS:
        others = (np.asarray(part, np.float32) for part in OTHERS[name])
        origins, directions = (np.concatenate(p) for p in zip(others, (origins, directions), strict=True))
    t_in, length, gaps = entered(probe, origins, directions)
    reach = 3 * size + np.linalg.norm(origins, axis=1)
    found = missed = within = most = 0
    for i, pieces in enumerate(pieces_inside(origins, directions, probe, reach)):
        if len(pieces) == 0:
            missed += 1
            if length[i] > 0:  # a ray that grazes the sector may get an interval
                points = origins[i] + (t_in[i] + np.linspace(0, length[i], 101)[:, None]) * directions[i]
                assert np.abs(to_sector(points, probe)).max(axis=1).min() < 1e-3 * size
            continue
        if np.diff(pieces.ravel()).min() < 0.01 * size:
            continue  # a grazing ray
        found, within, most = found + 1, within + (pieces[0, 0] == 0), max(most, len(pieces) - 1)
        atol, start = 1e-4 * size / 4, t_in[i]
        known = gaps[i][np.isfinite(gaps[i, :, 0])]
        known = known[known[:, 1] > 0]
        if (
            len(known) and known[0, 0] == 0
        ):  # a ray that grazes the sector first, or leaves it just behind its
            start, known = start + known[0, 1], known[1:]  # origin, begins with a gap
        np.testing.assert_allclose([start, t_in[i] + length[i]], [pieces[0, 0], pieces[-1, 1]], atol=atol)
        between = np.stack([pieces[:-1, 1], pieces[1:, 0]], -1)
        np.testing.assert_allclose(known + t_in[i], between, atol=atol)
    assert found > 60
    assert missed > 10
    assert within > 3
    assert most == {"twice": 2, "across the middle": 1}.get(name, most)


def to_sector(points, probe):
    """Vectors from points to the nearest points (in β, σ, γ) of the sector."""
    a, b, *ranges = probe
    place = printed_map(points, a, b)
    inside = np.stack([np.clip(place[..., i], *ends) for i, ends in enumerate(ranges)], -1)
    return world_of(inside, a, b) - points


def rays_along(probe, heights):
    """Rays outside a sector, along generators of its faces of σ at these heights, and of β; and some through
    the motor axis in the plane across it."""
    a, b, *ranges = probe
    size, middle = abs(a) + b + probe[4][1], np.mean(ranges, axis=1)
    origins, directions = [], []
    for height, face, axis in itertools.product(heights, (0, 1), (0, 1)):
        at = np.array([middle] * 2)
        at[:, 2], at[:, axis] = probe[4], ranges[axis][face]
        (near, far), inner = world_of(at, a, b), world_of(middle, a, b)
        along = (far - near) / np.linalg.norm(far - near)
        away = near - inner - along * ((near - inner) @ along)
        origins.append(near + height * size * away / np.linalg.norm(away) - size * along)
        directions.append(along)
    for angle in np.linspace(0, 2 * np.pi, 23):
        direction = np.array([0, np.sin(angle), np.cos(angle)])
        origins.append(-3 * size * direction)
        directions.append(direction)
    return np.array(origins), np.array(directions)


@pytest.mark.parametrize(
    "name", ["across the middle", "apex behind the axis", "half a turn", "touches the axis"]
)
def test_rays_along_faces_and_across_the_axis_see_no_more_than_the_sector(name):
    """Every piece of a ray that counts as inside is inside, but for a part of the probe's size."""
    angles = (HALF - 0.61, HALF + 0.61), (HALF - 0.7, HALF + 0.7)
    probe = PROBES.get(name, (-10.0, 10.0, *angles, (0.0, 50.0)))
    size = abs(probe[0]) + probe[1] + probe[4][1]
    origins, directions = rays_along(probe, (1e-4, 1e-3, 1e-2))
    _, length, gaps = entered(probe, origins, directions)
    gaps = np.clip(gaps, 0, length[:, None, None])
    seen = length - np.sum(gaps[..., 1] - gaps[..., 0], axis=1)
    expected = [np.sum(p[:, 1] - p[:, 0]) for p in pieces_inside(origins, directions, probe, 8 * size, 8001)]
    np.testing.assert_allclose(seen, expected, atol=1e-3 * size)


@pytest.mark.slow
def test_a_far_camera_finds_the_faces_and_their_gradients():
    """A ray is restarted near its entry, even if rounding moved it past the face."""
    targets = world_of(nodes(MIDDLE, (5, 5, 5))[1:-1, 1:-1, 1:-1], 20, 30).reshape(-1, 3)
    direction = np.array([0.48, -0.6, 0.64])
    directions = jnp.asarray(np.broadcast_to(direction, targets.shape), jnp.float32)
    by_origins = jax.jit(jax.grad(lambda o: rays_of(jv.ToroidalMap(*MIDDLE), o, directions).t_in.sum()))
    for away in (3e2, 3e4, 1e6):
        origins = jnp.asarray(targets - away * direction, jnp.float32)
        np.testing.assert_allclose(by_origins(origins) @ np.float32(direction), -1, atol=2e-3)
        close = np.asarray(origins, np.float64) + (away - 200) * np.float64(directions)
        ends = pieces_inside(close, directions, MIDDLE)
        _, length, _ = entered(MIDDLE, origins, directions)
        # the ray itself has been rounded
        np.testing.assert_allclose(length, [e[-1, 1] - e[0, 0] for e in ends], atol=1e-3 + 8e-7 * away)


# ---- images ----


def noise_volume():
    """Independent random values at every node. Under the map, the spacing is ignored."""
    return jv.Volume(np.random.default_rng(2).random(SHAPE, np.float32), spacing=(0.5, 2.0, 7.0))


def ramp_transfer(top=0.06):
    """Transparent below 0.3; red is 1, so that its channel is the sum of the weights."""
    colors = [(1, 0.1, 0.9), (1, 0.3, 0.7), (1, 0.9, 0.1)]
    return jv.TransferFunction([0.0, 0.3, 1.0], np.array(colors, float), [0.0, 0.0, top])


def view():
    """A camera at the side, several of whose rays cross the hollow."""
    return jv.Camera((40.0, -190.0, 20.0), (1.83, 2.46, 52.0), (0, 0, -1), 30.0, size=SIZE)


def independent_march(volume, probe, transfer, camera, step, midpoint, align):
    """(rays, 4) colour and opacity, in float64 by NumPy; values by scipy."""
    origins, directions = (np.asarray(part, np.float64).reshape(-1, 3) for part in camera.rays())
    pieces = pieces_inside(origins, directions, probe, dense=8001)
    most = max(map(len, pieces))
    padded = np.stack([np.pad(part, ((0, most - len(part)), (0, 0))) for part in pieces])
    start, stop = padded[..., 0], padded[..., 1]
    first, last = start[:, :1], np.max(stop, axis=1, keepdims=True)
    front = first + step * np.arange(int(np.max(last - first) / step) + 2)
    # (rays, cells, pieces)
    low, high = (part[:, None] for part in (start, stop))
    if align:
        begin, end = (np.clip(part[..., None], low, high) for part in (front, front + step))
        at = (begin + end) / 2 if midpoint else begin
        width = end - begin
    else:
        at = front[..., None] + step / 2 * midpoint + 0 * low
        width = step * ((low <= at) & (at < high))
    at, width = (part.reshape(len(origins), -1) for part in (at, width))
    place = printed_map(origins[:, None] + at[..., None] * directions[:, None], *probe[:2])
    grid = [(c - e[0]) / (e[1] - e[0]) * (n - 1) for c, e, n in zip(place.T, probe[2:], SHAPE, strict=True)]
    value = map_coordinates(
        np.asarray(volume.data, np.float64), np.nan_to_num(grid), order=1, mode="nearest"
    ).T
    points = np.asarray(transfer.values)
    depth = np.interp(value, points, np.asarray(transfer.extinction)) * width
    weight = np.exp(depth - np.cumsum(depth, axis=1)) * -np.expm1(-depth)
    colors = [np.interp(value, points, c) for c in np.asarray(transfer.colors).T]
    return np.stack([np.sum(weight * c, axis=1) for c in (*colors, 1 + 0 * value)], -1), most


@pytest.mark.parametrize(("align", "quadrature"), [(True, "midpoint"), *slow((False, "left"))])
def test_an_independent_marcher_sees_the_same(align, quadrature):
    with in_float64():
        probe, transfer, volume = jv.ToroidalMap(*MIDDLE), ramp_transfer(), noise_volume()
        march = jv.March(5.3, (*(jv.AlphaCorrection(),) * align, probe), quadrature)
        camera = view()
        rgba = np.asarray(rendered(volume, transfer, camera, march).rgba).reshape(-1, 4)
        expected, most = independent_march(
            volume, MIDDLE, transfer, camera, 5.3, quadrature == "midpoint", align
        )
    assert most > 2  # some rays have two gaps
    np.testing.assert_allclose(rgba, expected, atol=2e-6)


EVERYTHING = jv.Jitter(1, "blue"), jv.EmptySpaceJitter(2), jv.AlphaCorrection(), jv.EarlyTermination(0.1)
COMBINED = {
    "integrated": ("preintegrated", (jv.AlphaCorrection(), jv.SpaceLeaping())),
    "all": ("midpoint", EVERYTHING),
}


@pytest.mark.parametrize("name", slow("all"))
def test_it_composes_with_other_transforms(name):
    """At any place among them, and in the reference."""
    quadrature, others = COMBINED[name]
    probe = jv.ToroidalMap(*MIDDLE)
    volume, transfer, camera = noise_volume(), ramp_transfer(), view()
    rendering = jv.render(volume, transfer, camera, jv.March(5.3, (*others, probe), quadrature))
    np.testing.assert_allclose(rendering.rgba[..., 0], rendering.rgba[..., 3], atol=1e-6)
    assert float(rendering.rgba[..., 3].max()) > 0.5
    march = jv.March(5.3, (probe, *others), quadrature, max_samples=64)

    @jax.jit
    @jax.vmap
    @jax.vmap
    def reference(origin, direction, column, row):
        return jv.render_ray_reference(volume, transfer, origin, direction, march, pixel=(column, row))

    width, height = camera.size
    column, row = jnp.meshgrid(jnp.arange(width), jnp.arange(height))
    expected = reference(*camera.rays(), column, row)
    assert not np.any(expected.exhausted)
    np.testing.assert_allclose(rendering.rgba, expected.rgba, atol=2e-5)
    if name != "integrated":  # leaps
        np.testing.assert_array_equal(rendering.samples, expected.samples)


@pytest.mark.slow
def test_image_gradients_in_the_probe_match_central_differences():
    """From beside the probe, where rays meet gaps."""
    with in_float64():
        volume = jv.Volume(np.random.default_rng(0).random((6, 5, 7)))
        camera = jv.Camera((2.0, -150.0, 20.0), (1.0, 2.0, 48.0), (1.0, 0.1, 0.0), 22.0, size=(6, 5))
        assert max(map(len, pieces_inside(*camera.rays(), MIDDLE))) == 2
        march = jv.March(2.3, (jv.ToroidalMap(*MIDDLE), jv.AlphaCorrection()), "midpoint", max_samples=128)
        names = "a", "b", "beta_range", "sigma_range", "gamma_range"
        parameters = {name: lambda scene, name=name: getattr(scene[3].transforms[0], name) for name in names}
        scene = volume, ramp_transfer(), camera, march, jv.Over()
        check_gradients(scene, parameters, constant={"spacing", "origin"})


# ---- phantoms, a real scan, bad input ----


@pytest.fixture
def nodes_by_one_program(monkeypatch):
    """The places of a phantom's nodes, which would be nine."""
    monkeypatch.setattr(jv.ToroidalMap, "to_world", eqx.filter_jit(jv.ToroidalMap.to_world))


def test_a_phantom_is_one_scene_at_every_shape(nodes_by_one_program):
    fine, probe = toroidal_phantom("fetus", (17, 21, 33), speckle=False)
    coarse, _ = toroidal_phantom("fetus", (9, 11, 17), speckle=False)
    assert (fine.data.dtype, fine.shape) == (jnp.uint8, (17, 21, 33))
    assert np.asarray(probe.gamma_range)[1] == 100
    difference = np.asarray(fine.data, int)[::2, ::2, ::2] - np.asarray(coarse.data, int)
    assert np.abs(difference).max() <= 1  # from rounding to uint8
    spot, again, other = (
        np.asarray(toroidal_phantom("fetus", (9, 11, 17), seed=s)[0].data) for s in (0, 0, 1)
    )
    np.testing.assert_array_equal(spot, again)
    assert np.any(spot != other)


def test_speckle_is_rayleigh_and_correlated_along_the_beam_alone(nodes_by_one_program):
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
    angles = (HALF - elevation, HALF + elevation), (HALF - azimuth, HALF + azimuth)
    probe = jv.ToroidalMap(22.70 - 52.70, 52.70, *angles, (0, 69.58))
    camera = jv.Camera((100, -180, -60), probe.center, (0, 0, -1), 30.0, size=(24, 20))
    march = jv.March(1.0, (probe, jv.AlphaCorrection(), jv.EarlyTermination()))
    rendering = jv.render(volume, jv.colormap("gray", (60, 200), (0.0, 0.5)), camera, march)
    assert not np.any(rendering.exhausted)
    assert np.isfinite(rendering.rgba).all()
    opacity = np.asarray(rendering.rgba[..., 3])
    assert opacity.max() > 0.8
    assert 0.03 < (opacity > 0.1).mean() < 0.5


GOOD = {"a": 20.0, "b": 30.0, "beta_range": (1, 2), "sigma_range": (1, 2), "gamma_range": (0, 60)}


BAD = [
    ({"beta_range": (2, 1)}, "beta_range must be .* first < last"),
    ({"sigma_range": (-0.1, 1)}, r"sigma_range must lie in \[0, π\]"),
    ({"beta_range": (55, 125)}, r"beta_range must lie in \[0, π\]"),
    ({"b": 5.0, "gamma_range": (-5, 60)}, "gamma_range must begin beyond the apex"),
    ({"a": float("nan")}, "a must be finite"),
    ({"gamma_range": (0, float("inf"))}, "gamma_range must be finite"),
    ({"b": (1, 2)}, r"b must have shape \(\)"),
    ({"beta_range": (1, 1.5, 2)}, r"beta_range must have shape \(2,\)"),
]


def test_bad_probes_points_and_phantoms_are_named():
    for changes, message in BAD:
        with pytest.raises(ValueError, match=message):
            jv.ToroidalMap(**{**GOOD, **changes})
    probe = jv.ToroidalMap(**GOOD)
    for make, message in (
        (lambda: probe.to_toroidal(1.0), r"points must have shape \(\*points, 3\)"),
        (lambda: probe.to_world(np.zeros((3, 2))), r"toroidal must have shape \(\*points, 3\)"),
        (lambda: toroidal_phantom("skull"), "name must be one of shells, spheres, wires, fetus; got 'skull'"),
        (lambda: toroidal_phantom("fetus", (64, 64)), "shape must be three numbers of nodes"),
        (lambda: toroidal_phantom("fetus", (64, 4, 64)), "shape must be an integer of at least 8; got 4"),
    ):
        with pytest.raises(ValueError, match=message):
            make()
