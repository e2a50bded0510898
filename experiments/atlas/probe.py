"""Where do scans fail? Short gaps of rays, rays near the motor axis, bricks to which a ray comes back."""

import math
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxvol as jv
from jaxvol.bricks import overlap_of

from ..bricks import each_at_once, grid
from ..bricks_once import EachOnce
from .entry import LEVEL, entry, finite, ray_opacities, rgba, signed, uniform


DEGREES = math.pi / 180
A, B, FAN, TURN = 20.0, 30.0, 40 * DEGREES, 35 * DEGREES
EXTINCTION = 0.02
STEP = 5.0


def probe(a: float, b: float, depth: float) -> jv.ToroidalMap:
    half = math.pi / 2
    return jv.ToroidalMap(a, b, (half - TURN, half + TURN), (half - FAN, half + FAN), (0.0, depth))


SIZE = A + B + 100
"""Of the probe: from the motor axis to the deepest sample."""


@jax.jit
def _within(origins: Array, directions: Array) -> Array:
    """Lengths of rays within the sector, as the march sees them."""
    march = jv.March(STEP, (probe(A, B, 100.0), jv.AlphaCorrection()))
    volume, transfer = jv.Volume(np.ones((8, 8, 8), np.float32)), uniform(EXTINCTION)
    rendering = jv.render_rays(
        volume, transfer, origins, directions, march, outputs="rgba", adjoint="forward"
    )
    return -jnp.log1p(-rendering.rgba[..., 3]) / EXTINCTION


def _over_gaps(gaps: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Error of the length within the sector over the length of the gap, of rays along x, above the apex,
    where the hollow near side cuts a chord as long as the gap; turned about the motor axis."""
    gaps, turns = np.broadcast_arrays(gaps, turns)
    heights = np.sqrt(B**2 - (gaps / 2) ** 2)
    away = A + heights
    along = np.full(away.shape, -200.0)
    origins = np.stack([along, away * np.sin(turns), away * np.cos(turns)], axis=-1).astype(np.float32)
    directions = np.broadcast_to(np.array([1, 0, 0], np.float32), origins.shape)
    lengths = 2 * heights * math.tan(FAN) - gaps
    seen = np.asarray(_within(jnp.asarray(origins), jnp.asarray(directions)), np.float64)
    return (seen - lengths) / gaps


def gap_picture(ratio: float, size: int) -> np.ndarray:
    gaps = ratio * SIZE * np.linspace(0.5, 1.5, size)
    return signed(_over_gaps(gaps[None], np.linspace(-0.8, 0.8, size)[:, None] * TURN), 1.0)


@entry(
    "jaxvol.ToroidalMap",
    "length of the gap over the size of the probe",
    (0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4, 1e-4),
    "share of the gap that is taken for material; share of rays",
    "share of the gap",
    limit=0.05,
    picture=gap_picture,
    shows="error of the length inside the sector over the length of the gap, rows by angle about the motor "
    "axis, columns by gap, from half to 1.5 times the stated length; red: missed",
)
def gaps_of_rays_under_a_toroidal_map(ratio: float, size: int) -> dict[str, float]:
    """How short a gap, where a ray leaves the sector and enters it again, is missed?

    Gaps are found ray by ray, whatever the step of the march, by steps that cannot pass a face. A ray that is
    nowhere farther outside than some roundings of float32 counts as inside."""
    error = _over_gaps(np.array(ratio * SIZE), np.linspace(-0.8, 0.8, 24) * TURN)
    return {"share of the gap": float(np.mean(error)), "rays": float(np.mean(error > 0.5))}


NEAR = (-10.0, 10.0, 50.0)
"""a, b and the range of depths of a probe whose near side touches the motor axis."""
ORIGINS = np.array([[0.0, 0.0, -60.0], [0.0, -60.0, -80.0], [-60.0, 0.0, -12.0]])
DIRECTIONS = np.array([[0.0, 0.0, 1.0], [0.0, 0.6, 0.8], [1.0, 0.0, 0.2]])


@jax.jit
def _near_axis(offset: Array) -> tuple[Array, tuple]:
    """Opacity of rays that pass the axis at this distance, from three directions, and its gradients."""

    def loss(given: tuple[jv.ToroidalMap, Array, Array]) -> tuple[Array, Array]:
        map_, data, origins = given
        march = jv.March(2.0, (map_, jv.AlphaCorrection()))
        rays = origins, jnp.asarray(DIRECTIONS, jnp.float32)
        opacity = ray_opacities(jv.Volume(data), uniform(EXTINCTION), rays, march)
        return jnp.sum(opacity), opacity

    shift = jnp.stack([0 * offset, offset, 0 * offset])[None]
    origins = jnp.asarray(ORIGINS, jnp.float32) + shift
    gradient, opacity = jax.grad(loss, has_aux=True)((probe(*NEAR), jnp.ones((8, 8, 8)), origins))
    return opacity, gradient


def _length(origin: np.ndarray, direction: np.ndarray) -> float:
    """Length of a line within the sector, from points 0.0005 apart, in float64."""
    a, b, depth = NEAR
    t = np.arange(0, 200, 5e-4) + 2.5e-4
    x, y, z = (o + t * d for o, d in zip(origin, direction / np.linalg.norm(direction), strict=True))
    off = np.hypot(y, z) - a
    inside = (np.abs(np.arctan2(y, z)) <= TURN) & (np.abs(np.arctan2(x, off)) <= FAN)
    gamma = np.hypot(x, off) - b
    return float(5e-4 * np.sum(inside & (gamma >= 0) & (gamma <= depth)))


@entry(
    "jaxvol.ToroidalMap",
    "distance of rays from the axis (the fan is 50 deep)",
    (10.0, 1.0, 0.1, 1e-2, 1e-4, 1e-8, 1e-20, 0.0),
    "error of the opacity; NaN if anything is not finite",
    "opacity",
    outcome="bounded",
    limit=2e-4,
)
def rays_near_the_motor_axis(offset: float, size: int) -> dict[str, float]:
    """Do image and gradients stay finite and right where a fan touches its axis of rotation?

    On the axis and at the apex, where an angle has no gradient, it is taken as 0. Image and gradients with
    respect to probe, voxels and rays are finite."""
    opacity, gradient = _near_axis(jnp.asarray(offset, jnp.float32))
    lengths = [_length(o + np.array((0, offset, 0)), d) for o, d in zip(ORIGINS, DIRECTIONS, strict=True)]
    exact = -np.expm1(-EXTINCTION * np.array(lengths))
    error = float(np.abs(np.asarray(opacity, np.float64) - exact).max())
    return {"opacity": error if finite((opacity, gradient)) else np.nan}


@cache
def scan(depth: float, size: int) -> tuple[Any, ...]:
    """Red near the probe and blue far from it, seen along the fan: rays pass the curved faces at small
    angles, and most of them twice. `depth`: optical depth of the image's width."""
    width, shape, half = 90.0, (24, 32, 48), math.pi / 2
    volume = jv.Volume(np.broadcast_to(np.linspace(20, 250, shape[2]), shape).astype(np.uint8))
    red, blue = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    fog = jv.TransferFunction(
        [0, 120, 135, 255], [red, red, blue, blue], np.full(4, depth / width, np.float32)
    )
    camera = jv.Camera((300, 10, 45), (0, 0, 45), (0, 0, 1), size=(size, size), parallel_scale=width / 2)
    fan = jv.ToroidalMap(10.0, 20.0, (half - 0.6, half + 0.6), (half - 0.9, half + 0.9), (0.0, 60.0))
    return volume, fog, camera, jv.March(1.5, (fan,))


BRICKS = 1, 1, 3


def by_bricks(depth: float, size: int, method: Any) -> np.ndarray:
    how = {"bricks": BRICKS, "method": method, "outputs": "rgba"}
    return np.asarray(jv.render_bricks(*scan(depth, size), **how).rgba)


@entry(
    "jaxvol.render_bricks",
    "optical depth of the scan",
    (0.01, 0.03, 0.1, 0.3, 1.0, 3.0),
    "largest error of a pixel",
    "naive",
    picture=lambda depth, size: by_bricks(depth, size, each_at_once)[..., :3],
    shows="a scan that is red near the probe (below) and blue far from it, each brick shown at once",
    size=24,
)
def wrong_order(depth: float, size: int) -> dict[str, float]:
    """From which optical depth on does it show that each brick of a scan is shown at once?

    A ray that leaves a brick and comes back passes another one between. Shown at once (naive), both parts of
    it in the first brick are blended at once, and what lies between them after or before both. "overlap" and
    "reload" keep the order of the samples, and their error is that of rounding."""
    truth, methods = rgba(*scan(depth, size)), {"naive": each_at_once, "overlap": "overlap"}
    return {name: float(np.abs(by_bricks(depth, size, how) - truth).max()) for name, how in methods.items()}


@entry(
    "jaxvol.render_bricks",
    "overlap / K* of the paper's formula",
    (1.5, 1.0, 0.75, 0.5, 0.25, 0.0),
    "share of rays that are incomplete",
    "each brick read once",
    limit=0.01,
    size=24,
)
def overlaps_shorter_than_published(part: float, size: int) -> dict[str, float]:
    """How short may the overlap of bricks be, against K*, if each brick is read once?

    A ray that leaves a brick, and comes back to it farther on, is incomplete where the overlap does not hold
    that part. "overlap" takes K*, and reads a brick again where that is too short: no ray is incomplete."""
    volume, _, _, march = scan(1.0, size)
    formula = overlap_of(march.transforms[0], grid(volume.shape, BRICKS))
    once = EachOnce([part * overlap for overlap in formula])
    by_bricks(1.0, size, once)
    wrong = np.abs(by_bricks(1.0, size, "overlap") - rgba(*scan(1.0, size))).max(axis=-1) > LEVEL
    return {"each brick read once": once.incomplete, '"overlap"': float(wrong.mean())}
