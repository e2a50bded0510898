"""Do a beam's boxes bound its rays at every distance? Is a stretch called empty only if no ray meets anything
in it?"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol._util import platform
from jaxvol._util.vec3 import apart
from jaxvol.beams import STRETCHES, Box, stretches
from jaxvol.occupancy import Occupancy

from .round_trips import counted


VOLUME = jv.Volume(np.zeros((33, 41, 29), np.uint8), (0.1, 0.07, 0.12), (-1.0, 0.3, 2.0))
SIDE = 32
ROUNDING = 1e-4
"""Bound on the rounding of the rays in these tests, which are computed in float32; in blocks."""


WAYS = [(1, 0, 0), (0, -1, 0), (0, 0, 1), (-1, -1, -1), (-0.6, 0.2, 0.1)]
SIZES = apart(4 * VOLUME.spacing)
BLOCKS = tuple(-(-(n - 1) // 4) for n in VOLUME.shape)


def beams(way, parallel=None):
    """For cameras at several distances: all rays, and the four corner rays."""
    center, diagonal = np.asarray(VOLUME.center), float(np.linalg.norm(np.subtract(*VOLUME.corners)))
    for away in (0.1, 1, 20):
        position = center - away * diagonal * np.asarray(way) / np.linalg.norm(way)
        camera = jv.Camera(
            position, center, (0.3, 0.5, 0.7), 80.0, size=(SIDE, SIDE), parallel_scale=parallel
        )
        rays = [np.asarray(part, np.float64) for part in camera.rays()]
        ends = slice(None, None, SIDE - 1), slice(None, None, SIDE - 1)
        corners = [jnp.asarray(part[ends].reshape(4, 3), jnp.float32) for part in rays]
        yield rays, [(part[:, 0], part[:, 1], part[:, 2]) for part in corners]


def blocks_at(rays, distance):
    """Positions along the rays, in blocks."""
    origins, directions = rays
    return (origins + distance * directions - np.asarray(VOLUME.origin)) / np.asarray(jnp.stack(SIZES))


@pytest.mark.parametrize("parallel", [None, 2.0], ids=["perspective", "parallel"])
@pytest.mark.parametrize("way", WAYS, ids=str)
def test_a_box_holds_every_ray_of_its_beam(way, parallel):
    occupancy = Occupancy(jnp.zeros(BLOCKS, bool), apart(VOLUME.origin), SIZES)
    for rays, corners in beams(way, parallel):
        box = Box.within(occupancy, *corners)
        for u in np.linspace(0, float(box.far - box.near), 9):
            low, high = (np.asarray(jnp.stack(side)) for side in box.between(jnp.float32(u), jnp.float32(u)))
            place = blocks_at(rays, float(box.near) + u)
            assert (place >= low - ROUNDING).all(), u
            assert (place <= high + ROUNDING).all(), u


@pytest.mark.parametrize("way", WAYS, ids=str)
def test_stretches_called_empty_contain_nothing_along_any_ray(way):
    met = 0
    for seed, (rays, corners) in enumerate(beams(way)):
        occupied = np.random.default_rng(seed).random(BLOCKS) < 0.01
        occupancy = Occupancy(jnp.asarray(occupied), apart(VOLUME.origin), SIZES)
        box = jax.tree.map(lambda leaf: leaf[None], Box.within(occupancy, *corners))
        found = known(occupancy, box)
        for u in np.linspace(0, float(box.far[0] - box.near[0]), 300, endpoint=False):
            place = np.floor(blocks_at(rays, float(found.near[0]) + u)).astype(int)
            inside = ((place >= 0) & (place < BLOCKS)).all(axis=-1)
            if occupied[tuple(place[inside].T)].any():
                met += 1
                stretch = int(u / float(found.length))
                assert found.following[stretch, 0] == stretch, u
    assert met > 10


@jax.jit
def known(occupancy, box):
    return stretches(occupancy, occupancy.sums(), box, jnp.float32(0.3))


def test_stretches_are_the_same_all_at_once(monkeypatch):
    occupied = np.random.default_rng(0).random(BLOCKS) < 0.005
    occupancy = Occupancy(jnp.asarray(occupied), apart(VOLUME.origin), SIZES)
    boxes = [Box.within(occupancy, *corners) for _, corners in beams((-0.6, 0.2, 0.1))]
    box = jax.tree.map(lambda *leaves: jnp.stack(leaves), *boxes)
    arguments = occupancy, occupancy.sums(), box, jnp.float32(0.05)
    in_turn, (looks, _) = counted(stretches, *arguments)
    monkeypatch.setattr(platform, "platform", lambda: "gpu")
    at_once, trips = counted(stretches, *arguments)
    assert looks > 20
    assert trips.number == 0
    last = STRETCHES
    assert (in_turn.following < last).any()
    assert (in_turn.following == last).any()
    jax.tree.map(np.testing.assert_array_equal, in_turn, at_once)
