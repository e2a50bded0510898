"""Where do float types fail? Voxels of 16-bit floats, and rays of very many samples."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxvol as jv

from .entry import colors, cube, entry, rms, uniform


POINTS = [
    (40, (0.10, 0.04, 0.03), 0.0),
    (78, (0.85, 0.50, 0.35), 0.3),
    (130, (0.90, 0.75, 0.60), 0.5),
    (255, (1.00, 0.95, 0.85), 0.95),
]


def stored(offset: float, size: int, dtype: Any) -> np.ndarray:
    """The head phantom, its values 0 to 255 stored with an offset in a float type."""
    head = jv.phantom("head", 64)
    data = jnp.asarray(np.asarray(head.data, np.float32) + np.float32(offset)).astype(dtype)
    points = [(value + offset, color, opacity) for value, color, opacity in POINTS]
    transfer = jv.TransferFunction.from_points(points, unit_distance=0.05)
    camera = jv.Camera.looking_at(head, (0.65, -1, 0.15), size=(size, size)).zoom(1.45)
    march = jv.March(float(head.spacing[0]), (jv.AlphaCorrection(),))
    return colors(jv.Volume(data, head.spacing, head.origin), transfer, camera, march)


@entry(
    "jaxvol.Volume",
    "offset of values that range over 255",
    (0.0, 100.0, 300.0, 1000.0, 3000.0, 1e4, 3e4, 1e5),
    "RMSE of the image",
    "bfloat16",
    picture=lambda offset, size: stored(offset, size, jnp.bfloat16),
    shows="the head phantom stored as bfloat16",
    pictured=(0.0, 3000.0),
    size=96,
)
def voxels_of_16_bit_floats(offset: float, size: int) -> dict[str, float]:
    """How far from 0 may values lie that are stored as bfloat16 or float16?

    A voxel keeps its type: 8 significant bits in bfloat16, 11 in float16, so that values around 1000 (CT in
    Hounsfield units + 1000) are rounded to multiples of 4 and of 0.5. float16 ends at 65504, and Volume
    refuses what is infinite (crosses). Integers of 16 bits keep all of it."""
    truth = stored(0, size, jnp.float32)
    found = {"float32": rms(stored(offset, size, jnp.float32) - truth)}
    for name, dtype in (("bfloat16", jnp.bfloat16), ("float16", jnp.float16)):
        try:
            found[name] = rms(stored(offset, size, dtype) - truth)
        except ValueError:  # values that the type does not hold
            found[name] = np.nan
    return found


EXTINCTION = 1.5


@jax.jit
def _opacity(step: Array) -> tuple[Array, Array]:
    """Opacity of a cube of side 2, and whether its ray was exhausted."""
    rays = jnp.array([[0.1, 0.2, -3.0]]), jnp.array([[0.0, 0.0, 1.0]])
    march, volume = jv.March(step, (jv.AlphaCorrection(),)), cube()
    rendering = jv.render_rays(volume, uniform(EXTINCTION), *rays, march, outputs="rgba", adjoint="forward")
    return rendering.rgba[0, 3], rendering.exhausted[0]


def one_long_ray(samples: float) -> dict[str, float]:
    opacity, exhausted = _opacity(jnp.asarray(2 / samples, jnp.float32))
    return {
        "float32": float(abs(np.float64(opacity) + np.expm1(-2 * EXTINCTION))),
        "samples · 2⁻²⁴": samples * 2.0**-24,
        "exhausted": float(exhausted),
    }


@entry(
    "jaxvol.March",
    "samples along a ray",
    (30.0, 100.0, 1e3, 1e4, 3e4, 1e5),
    "error of the opacity",
    "float32",
    outcome="bounded",
    limit=1 / 255 / 10,
)
def rays_of_very_many_samples(samples: float, size: int) -> dict[str, float]:
    """How many samples may a ray take before float32 shows?

    Depths are counted in steps, not summed, so the ten-thousandth sample is as exact as the first. Opacity is
    accumulated in float32; its rounding errors grow more slowly than the number of samples."""
    return one_long_ray(samples)


@entry(
    "jaxvol.March",
    "samples that a ray needs (max_samples: 131072)",
    (1e3, 1e4, 1e5, 131072.0, 1.5e5, 2e5),
    "error of the opacity",
    "float32",
    outcome="detected and said",
    said="exhausted",
)
def rays_that_run_out_of_samples(samples: float, size: int) -> dict[str, float]:
    """What happens to a ray that needs more than max_samples?

    What lies behind the last sample is missing, and Rendering.exhausted marks the ray."""
    return one_long_ray(samples)
