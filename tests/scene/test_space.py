"""Entry and exit of rays: misses, grazing rays, rays along axes, origins inside, rays that look away."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.scene.space import Affine, enter

from .. import oracle
from ..scenes import soft_transfer


LOW, HIGH = np.array([0.0, -1.0, 2.0]), np.array([2.0, 0.0, 5.0])
BOX = jv.Volume(np.ones((5, 3, 4), np.float32), spacing=(0.5, 0.5, 1.0), origin=LOW)
RAYS = 320

CASES = {
    "through the middle along x": ((-3, -0.5, 3), (1, 0, 0), 3.0, 2.0),
    "through the middle against z": ((1, -0.5, 9), (0, 0, -1), 4.0, 3.0),
    "from far away": ((1, -0.5, 9000), (0, 0, -1), 8995.0, 3.0),
    "along y from inside": ((1, -0.25, 3), (0, -1, 0), 0.0, 0.75),
    "from the centre, oblique": ((1, -0.5, 3.5), (0.6, 0, 0.8), 0.0, 5 / 3),
    "misses": ((-3, 5, 3), (1, 0, 0), None, 0.0),
    "parallel to a face, just outside": ((-3, 0.001, 3), (1, 0, 0), None, 0.0),
    "looks away": ((-3, -0.5, 3), (-1, 0, 0), None, 0.0),
    "starts at the exit, looking out": ((2, -0.5, 3), (1, 0, 0), None, 0.0),
    "starts at the entry, looking in": ((0, -0.5, 3), (1, 0, 0), 0.0, 2.0),
    "in a face": ((-3, 0, 3), (1, 0, 0), 3.0, 2.0),
    "along an edge": ((-3, 0, 5), (1, 0, 0), 3.0, 2.0),
    "touches a corner": ((-1, 0, 4), (np.sqrt(0.5), 0, np.sqrt(0.5)), None, 0.0),
    "through two opposite corners": (
        (-2, -2, -1),
        np.array([2, 1, 3]) / np.sqrt(14),
        np.sqrt(14),
        np.sqrt(14),
    ),
}


@jax.jit
@jax.vmap
def inside(origin, direction):
    """Distance to the entry, length from there to the exit, and the entry; derivatives of the first two by
    origin and direction."""

    def ends(origin, direction):
        space = Affine(BOX)
        ray = enter(space, apart(origin), apart(direction), (jnp.int32(0), jnp.int32(0)))
        return jnp.stack([ray.t_in, ray.length]), jnp.stack(space.world(ray.entry))

    slopes, _ = jax.jacrev(ends, argnums=(0, 1))(origin, direction)
    return *ends(origin, direction), jnp.concatenate(slopes, axis=-1)


@pytest.fixture(scope="module")
def rays():
    """The cases above, and random rays, some of them along axes and planes: origins, directions, answers."""
    random = np.random.default_rng(0)
    origins = random.uniform(-4, 6, (RAYS, 3))
    directions = random.normal(size=(RAYS, 3)) * random.choice([0, 1e-3, 1], (RAYS, 3)) + 1e-12
    directions[::2] = (random.uniform(LOW, HIGH, (RAYS, 3)) - origins)[::2]
    for i, (origin, direction, *_) in enumerate(CASES.values()):
        origins[i], directions[i] = origin, direction
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    given = origins.astype(np.float32), directions.astype(np.float32)
    return given, [np.asarray(found) for found in inside(*given)]


def test_entry_and_length_are_right(rays):
    _, (ends, _, slopes) = rays
    for (name, (*_, distance, length)), found in zip(CASES.items(), ends, strict=False):
        np.testing.assert_allclose(found[1], length, atol=1e-6, err_msg=name)
        assert distance is None or abs(found[0] - distance) < 1e-6 * max(1, distance), name
    assert np.isfinite(slopes[: len(CASES)]).all()


def test_entry_and_exit_agree_with_an_independent_clip(rays):
    """And so do their gradients with its differences, of rays that are not nearly parallel to a face."""
    (origins, directions), (ends, entries, slopes) = rays
    exact = [part.astype(float) for part in (origins, directions)]

    def clipped(origins, directions):
        near, far = oracle.box_interval(origins, directions, LOW, HIGH)
        return np.stack([near, np.maximum(far - near, 0)], axis=-1)

    expected = clipped(*exact)
    hit = expected[:, 1] > 1e-4
    assert 0.1 < hit.mean() < 0.9
    tolerance = np.where(np.arange(RAYS) < len(CASES), 1e-3, 1e-4)[:, None]
    assert (np.abs(ends - expected) <= tolerance)[hit].all()
    assert (ends[~hit, 1] < 2e-4).all()
    assert ((entries > LOW - 1e-5) & (entries < HIGH + 1e-5))[len(CASES) :][hit[len(CASES) :]].all()
    random = np.arange(RAYS) >= len(CASES)  # at corners there are several slopes
    plain = random & hit & (np.abs(directions) > 0.05).all(axis=1) & (expected[:, 0] > 1e-3)
    assert plain.sum() > 5
    for axis in range(6):
        nudge = 1e-6 * np.eye(6)[axis]
        ahead, behind = (clipped(exact[0] + s * nudge[:3], exact[1] + s * nudge[3:]) for s in (1, -1))
        np.testing.assert_allclose(
            slopes[plain, :, axis], (ahead - behind)[plain] / 2e-6, rtol=1e-3, atol=2e-3
        )


BAD = {
    "shapes differ": (np.zeros((4, 3)), np.ones((5, 3)), r"agree in shape; got \(4, 3\) and \(5, 3\)"),
    "not triples": (np.zeros((4, 2)), np.ones((4, 2)), r"origins must have shape \(\*rays, 3\)"),
    "no direction": (np.zeros((1, 3)), np.zeros((1, 3)), "directions must not have length 0"),
    "hardly a direction": (np.zeros((1, 3)), np.full((1, 3), 1e-39), "directions must not have length 0"),
    "NaN": (np.full((1, 3), np.nan), np.ones((1, 3)), "origins must be finite"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_rays_are_named(case):
    origins, directions, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        jv.render_rays(BOX, soft_transfer(), origins, directions, jv.March(0.3))
