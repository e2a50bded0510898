"""Where does the toroidal map fail? Short gaps of rays, and rays near the motor axis."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxvol as jv

from .entry import Entry, finite, signed, uniform


DEGREES = math.pi / 180
A, B, FAN, TURN = 20.0, 30.0, 40 * DEGREES, 35 * DEGREES
EXTINCTION = 0.02
STEP = 5.0


def ones() -> jv.Volume:
    return jv.Volume(np.ones((8, 8, 8), np.float32))


def probe(a: float, b: float, depth: float) -> jv.ToroidalMap:
    half = math.pi / 2
    return jv.ToroidalMap(a, b, (half - TURN, half + TURN), (half - FAN, half + FAN), (0.0, depth))


# -- gaps of rays -----------------------------------------------------------------------------------------

SIZE = A + B + 100
"""Of the probe: from the motor axis to the deepest sample."""


@jax.jit
def _within(origins: Array, directions: Array) -> Array:
    """Lengths of rays within the sector, as the march sees them."""
    march = jv.March(STEP, (probe(A, B, 100.0), jv.AlphaCorrection()))
    rendering = jv.render_rays(
        ones(), uniform(EXTINCTION), origins, directions, march, outputs="rgba", adjoint="forward"
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


def gap(ratio: float, size: int) -> dict[str, float]:
    """`ratio`: length of the gap over the size of the probe."""
    error = _over_gaps(np.array(ratio * SIZE), np.linspace(-0.8, 0.8, 24) * TURN)
    return {"share of the gap": float(np.mean(error)), "rays": float(np.mean(error > 0.5))}


def gap_picture(ratio: float, size: int) -> np.ndarray:
    gaps = ratio * SIZE * np.linspace(0.5, 1.5, size)
    return signed(_over_gaps(gaps[None], np.linspace(-0.8, 0.8, size)[:, None] * TURN), 1.0)


GAPS = Entry(
    name="gaps of rays under a toroidal map",
    question="How short a gap, where a ray leaves the sector and enters it again, is missed?",
    method="jaxvol.ToroidalMap",
    regime="length of the gap over the size of the probe",
    values=(0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4, 1e-4),
    measure=gap,
    metric="share of the gap that is taken for material; share of rays",
    judged="share of the gap",
    limit=0.05,
    does="Gaps are found ray by ray, whatever the step of the march, by steps that cannot pass a face. A ray "
    "that is nowhere farther outside than some roundings of float32 counts as inside.",
    picture=gap_picture,
    shows="error of the length inside the sector over the length of the gap, rows by angle about the motor "
    "axis, columns by gap, from half to 1.5 times the stated length; red: missed",
    scales=("log", "linear"),
)


# -- near the motor axis ----------------------------------------------------------------------------------

NEAR = (-10.0, 10.0, 50.0)
"""a, b and the range of depths of a probe whose near side touches the motor axis."""


@jax.jit
def _near_axis(offset: Array) -> tuple[Array, tuple]:
    """Opacity of rays that pass the axis at this distance, from three directions, and its gradients."""

    def loss(given: tuple[jv.ToroidalMap, Array, Array]) -> tuple[Array, Array]:
        map_, data, origins = given
        directions = jnp.array([[0.0, 0.0, 1.0], [0.0, 0.6, 0.8], [1.0, 0.0, 0.2]])
        volume = jv.Volume(data)
        march = jv.March(2.0, (map_, jv.AlphaCorrection()))
        rgba = jv.render_rays(volume, uniform(EXTINCTION), origins, directions, march, outputs="rgba").rgba
        return jnp.sum(rgba[..., 3]), rgba[..., 3]

    shift = jnp.stack([0 * offset, offset, 0 * offset])[None]
    origins = jnp.array([[0.0, 0.0, -60.0], [0.0, -60.0, -80.0], [-60.0, 0.0, -12.0]]) + shift
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


def near_axis(offset: float, size: int) -> dict[str, float]:
    opacity, gradient = _near_axis(jnp.asarray(offset, jnp.float32))
    exact = [
        -np.expm1(-EXTINCTION * _length(np.add(o, (0, offset, 0)), np.array(d)))
        for o, d in (
            ((0.0, 0.0, -60.0), (0.0, 0.0, 1.0)),
            ((0.0, -60.0, -80.0), (0.0, 0.6, 0.8)),
            ((-60.0, 0.0, -12.0), (1.0, 0.0, 0.2)),
        )
    ]
    error = float(np.abs(np.asarray(opacity, np.float64) - exact).max())
    return {"opacity": error if finite((opacity, gradient)) else np.nan}


AXIS = Entry(
    name="rays near the motor axis",
    question="Do image and gradients stay finite and right where a fan touches its axis of rotation?",
    method="jaxvol.ToroidalMap",
    regime="distance of rays from the axis (the fan is 50 deep)",
    values=(10.0, 1.0, 0.1, 1e-2, 1e-4, 1e-8, 1e-20, 0.0),
    measure=near_axis,
    metric="error of the opacity; NaN if anything is not finite",
    judged="opacity",
    limit=2e-4,
    outcome="bounded",
    does="On the axis and at the apex, where an angle has no gradient, it is taken as 0. Image and "
    "gradients with respect to probe, voxels and rays are finite.",
    scales=("symlog", "log"),
)

ENTRIES = (GAPS, AXIS)
