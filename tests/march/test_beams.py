"""Do a beam's boxes bound its rays at every distance? Is a stretch called empty only if no ray meets anything
in it?"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.march.beams import STRETCHES, Box, stretches
from jaxvol.scene.occupancy import Occupancy, Sums
from jaxvol.scene.space import Ray
from jaxvol.xla import platform
from jaxvol.xla.trees import unchecked

from ..round_trips import counted


VOLUME = jv.Volume(np.zeros((33, 41, 29), np.uint8), (0.1, 0.07, 0.12), (-1.0, 0.3, 2.0))
LOW, HIGH = (np.asarray(corner, float) for corner in VOLUME.corners)
CENTER, DIAGONAL = (LOW + HIGH) / 2, float(np.linalg.norm(HIGH - LOW))
SIZES = 4 * np.asarray(VOLUME.spacing, float)
BLOCKS = tuple(-(-(n - 1) // 4) for n in VOLUME.shape)
WAYS = [(1, 0, 0), (0, -1, 0), (0, 0, 1), (-1, -1, -1), (-0.6, 0.2, 0.1)]
SIDE = 32
ROUNDING = 1e-4
"""Bound on the rounding of the rays in these tests, which are computed in float32; in blocks."""


@functools.cache
def beams(parallel):
    """For cameras in several directions, at several distances: all rays, and the four corner rays."""
    found = []
    for way in WAYS:
        way = np.asarray(way) / np.linalg.norm(way)
        right = np.cross(way, (0.3, 0.5, 0.7))
        right /= np.linalg.norm(right)
        across = np.linspace(-1, 1, SIDE)[:, None, None] * right
        across = across + np.linspace(-1, 1, SIDE)[:, None] * np.cross(right, way)
        for away in (0.1, 1, 20):
            origins = CENTER - away * DIAGONAL * way + (2.0 if parallel else 0) * across
            directions = way + (0 if parallel else np.tan(np.deg2rad(40))) * across
            directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
            rays = np.broadcast_to(origins, across.shape), directions
            ends = slice(None, None, SIDE - 1), slice(None, None, SIDE - 1)
            corners = [np.float32(part[ends].reshape(4, 3)) for part in rays]
            found.append((rays, corners))
    return found


def occupancy(occupied):
    return Occupancy(
        jax.device_put(occupied), apart(VOLUME.origin), apart(jax.device_put(SIZES.astype(np.float32)))
    )


@jax.jit
def box_of(origins, directions):
    """The box of a beam, and its two corners at each of many distances."""
    # as rays that miss the volume, and begin somewhere on their way
    t_in = jnp.asarray([0.0, 0.3, 0.1, 0.2], jnp.float32)
    entries = origins + t_in[:, None] * directions
    places = {"entry": tuple(entries.T), "direction": tuple(directions.T), "t_in": t_in}
    others = {"length": jnp.zeros(4), "path": None, "pixel": None, "gaps": (), "spans": (), "reach": None}
    box = Box.within(occupancy(jnp.zeros(BLOCKS, bool)), unchecked(Ray, **places, **others))
    at = jnp.linspace(0, 1, 9) * (box.far - box.near)
    return (
        box,
        at,
        jax.vmap(lambda u: tuple(jnp.stack(ends) for ends in zip(*box.between(u, u), strict=True)))(at),
    )


def blocks_at(rays, distance):
    """Positions along the rays, in blocks."""
    origins, directions = rays
    return (origins + distance * directions - LOW) / SIZES


@pytest.mark.parametrize("parallel", [False, True], ids=["perspective", "parallel"])
def test_a_box_holds_every_ray_of_its_beam(parallel):
    for rays, corners in beams(parallel):
        box, distances, sides = box_of(*corners)
        for u, low, high in zip(*map(np.asarray, (distances, *sides)), strict=True):
            place = blocks_at(rays, float(box.near) + u)
            assert (place >= low - ROUNDING).all(), u
            assert (place <= high + ROUNDING).all(), u


@jax.jit
def known(occupied, boxes):
    seen = occupancy(occupied)
    return stretches(seen, Sums.of(seen.occupied), boxes, jnp.float32(0.3))


def test_stretches_called_empty_contain_nothing_along_any_ray():
    met = 0
    for seed, (rays, corners) in enumerate(beams(False)):
        occupied = np.random.default_rng(seed).random(BLOCKS) < 0.01
        box, *_ = box_of(*corners)
        found = known(occupied, jax.tree.map(lambda leaf: np.asarray(leaf)[..., None], box))
        following, near, length = (
            np.asarray(x)
            for x in (np.asarray(found.following)[:, 0], np.asarray(found.near)[0], found.length)
        )
        for u in np.linspace(0, float(box.far) - float(box.near), 300, endpoint=False):
            place = np.floor(blocks_at(rays, near + u)).astype(int)
            inside = ((place >= 0) & (place < BLOCKS)).all(axis=-1)
            if occupied[tuple(place[inside].T)].any():
                met += 1
                stretch = int(u / length)
                assert following[stretch] == stretch, u
    assert met > 50


def test_stretches_are_the_same_all_at_once(monkeypatch):
    seen = occupancy(np.random.default_rng(0).random(BLOCKS) < 0.005)
    boxes = [box_of(*corners)[0] for _, corners in beams(False)[-3:]]
    box = jax.tree.map(lambda *leaves: np.stack(leaves, axis=-1), *boxes)
    arguments = seen, eqx.filter_jit(Sums.of)(seen.occupied), box, jnp.float32(0.05)
    in_turn, (looks, _) = counted(stretches, *arguments)
    monkeypatch.setattr(platform, "platform", lambda: "gpu")
    at_once, trips = counted(stretches, *arguments)
    assert int(looks) > 20
    assert trips.number == 0
    last = STRETCHES
    following = np.asarray(in_turn.following)
    assert (following < last).any()
    assert (following == last).any()
    jax.tree.map(np.testing.assert_array_equal, *jax.device_get((in_turn, at_once)))
