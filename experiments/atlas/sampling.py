"""Where do jitters and steps fail? Rays without an empty sample, thin sheets, offsets near 1."""

from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxvol as jv
from jaxvol.metrics import wood_grain_energy

from .entry import along_z, colors, cube, entry, grey, of_field, opacities, shift_of, signed, uniform


STEP = 2 / 128
ALIGNED = jv.AlphaCorrection()


class Hazy(jv.Field):
    """An inclined plane, exact between voxels, behind haze over a share of the cube."""

    share: Float[Array, ""]

    def value(self, volume: jv.Volume, coordinate: tuple) -> Array:
        x, _, z = (c * volume.spacing[i] + volume.origin[i] for i, c in enumerate(coordinate))
        plane = jax.nn.sigmoid(((z + 1) / 2 - 0.25 - 0.35 * (x + 1) / 2) / 0.004)
        # the image spans x from -1/2 to 1/2
        return jnp.where(x + 0.5 < self.share, jnp.maximum(plane, 0.1), plane)


MARCHES = {
    "converged": jv.March(STEP / 12, (ALIGNED, jv.EarlyTermination(1e-6)), "midpoint"),
    "ray casting": jv.March(STEP, (ALIGNED,)),
    "EmptySpaceJitter": jv.March(STEP, (jv.EmptySpaceJitter(0), ALIGNED)),
    "Jitter": jv.March(STEP, (jv.Jitter(0), ALIGNED)),
}


@cache
def hazy(share: float, size: int, march: str) -> np.ndarray:
    shade = np.tile(np.array([0.3, 0.3, 0.36, 0.36, 0.9])[:, None], 3)
    transfer = jv.TransferFunction([0.0, 0.04, 0.05, 0.1, 1.0], shade, [0.0, 0.0, 0.05, 0.05, 30.0])
    volume = of_field(Hazy(jnp.asarray(share, jnp.float32)))
    return colors(volume, transfer, along_z(size), MARCHES[march])


def haze_error(share: float, size: int, march: str) -> np.ndarray:
    return hazy(share, size, march) - hazy(share, size, "converged")


@entry(
    "jaxvol.EmptySpaceJitter",
    "share of rays in haze from their first sample on",
    (0.0, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0),
    "wood grain energy / that of ray casting",
    "EmptySpaceJitter",
    limit=0.1,
    picture=lambda share, size: signed(haze_error(share, size, "EmptySpaceJitter"), 0.05),
    shows="error of EmptySpaceJitter, ± 0.05 from blue to red",
    size=96,
)
def wood_grain_without_empty_samples(share: float, size: int) -> dict[str, float]:
    """How many rays may begin in visible material before EmptySpaceJitter leaves wood grain?

    A ray that meets no transparent sample is not shifted: the wood grain that is left is the share of such
    rays. Jitter breaks it there, too."""
    plain = wood_grain_energy(haze_error(share, size, "ray casting"))
    names = "EmptySpaceJitter", "Jitter"
    return {name: abs(wood_grain_energy(haze_error(share, size, name))) / plain for name in names}


class Sheet(jv.Field):
    """An inclined sheet of this thickness across z = 0: `solid` 1 within it and 0 elsewhere; or 1 in its
    middle plane, falling linearly to both sides, so that the sheet is where it is above 1/2."""

    thickness: Float[Array, ""]
    solid: bool

    def value(self, volume: jv.Volume, coordinate: tuple) -> Array:
        x, y, z = (c * volume.spacing[i] + volume.origin[i] for i, c in enumerate(coordinate))
        away = jnp.abs(z - 0.13 * x - 0.07 * y) / self.thickness
        return jnp.where(away < 0.5, 1.0, 0.0).astype(z.dtype) if self.solid else jnp.clip(1 - away, 0, 1)


def sheet(ratio: float, size: int, jitter: bool) -> np.ndarray:
    """Opacity of an opaque sheet that is so many steps thick."""
    volume = of_field(Sheet(jnp.asarray(ratio * STEP, jnp.float32), True))
    transfer = jv.TransferFunction([0.4, 0.6], np.ones((2, 3)), [0.0, 1e4])
    return opacities(volume, transfer, along_z(size), MARCHES["Jitter" if jitter else "ray casting"])


def surface(ratio: float, size: int, jitter: bool) -> np.ndarray:
    """Opacity of the isosurfaces on both sides of a sheet."""
    volume = of_field(Sheet(jnp.asarray(ratio * STEP, jnp.float32), False))
    transfer = jv.TransferFunction([0.0, 1.0], np.ones((2, 3)), [0.0, 1.0])
    march = jv.March(STEP, (jv.EmptySpaceJitter(0),) if jitter else ())
    return opacities(volume, transfer, along_z(size), march, compositing=jv.Isosurface(0.5))


def missed(
    image: Callable[[float, int, bool], np.ndarray], ratio: float, size: int, jittered: str, plain: str
) -> dict[str, float]:
    """Share of pixels that miss the sheet, with jitter and without."""
    return {
        jittered: float(1 - np.mean(image(ratio, size, True))),
        plain: float(1 - np.mean(image(ratio, size, False))),
        "1 - thickness / step": max(0.0, 1 - ratio),
    }


THIN = (
    "thickness of the sheet, steps",
    (4.0, 2.0, 1.25, 1.05, 0.95, 0.8, 0.5, 0.25, 0.1),
    "share of pixels that miss the sheet",
)


@entry(
    "jaxvol.March",
    *THIN,
    "Jitter",
    limit=0.001,
    picture=lambda ratio, size: grey(sheet(ratio, size, True)),
    shows="opacity of the sheet under Jitter",
    size=64,
)
def sheets_thinner_than_a_step(ratio: float, size: int) -> dict[str, float]:
    """How thin may an opaque sheet be before rays pass through it?

    A sheet thinner than a step is met by as many rays as it is thick, in steps: as bands without jitter, as
    noise with it. No quadrature sees what lies between two samples alike; a shorter step does."""
    return missed(sheet, ratio, size, "Jitter", "ray casting")


@entry(
    "jaxvol.Isosurface",
    *THIN,
    "EmptySpaceJitter",
    limit=0.001,
    picture=lambda ratio, size: grey(surface(ratio, size, True)),
    shows="pixels that meet the sheet, under EmptySpaceJitter",
    size=64,
)
def isosurfaces_of_thin_sheets(ratio: float, size: int) -> dict[str, float]:
    """How thin may a sheet be before rays pass through both of its faces unseen?

    A cell that begins before the sheet and ends behind it has both ends below the value: rays miss a sheet by
    as much as it is thinner than a step, in bands without jitter, as noise with it. A shorter step sees
    it."""
    return missed(surface, ratio, size, "EmptySpaceJitter", "without jitter")


BLUE = {
    "Jitter": jv.Jitter(0, "blue"),
    "Jitter, front residual": jv.Jitter(0, "blue", front_residual=True),
    "EmptySpaceJitter": jv.EmptySpaceJitter(0, "blue"),
}


def offset_error(left: float, size: int, transform: Any) -> np.ndarray:
    """Error of the opacity of a cube of optical depth 2, by steps of 1/4, at the offset 1 - `left`."""
    offset = np.float32(1) - np.float32(left)
    camera = jv.Camera((0.1, 0.2, -3), (0, 0, 0), (0, 1, 0), size=(size, size), parallel_scale=0.5)
    march = jv.March(0.25, (shift_of(transform, offset), ALIGNED))
    origins, directions = (np.asarray(part, np.float64) for part in camera.rays())
    near, far = ((face - origins) / directions for face in (-np.sign(directions), np.sign(directions)))
    length = far.min(axis=-1) - near.max(axis=-1)
    return opacities(cube(), uniform(1.0), camera, march) - (1 - np.exp(-length))


@entry(
    "jaxvol.Jitter",
    "1 - ξ",
    (1.0, 0.5, 0.1, 0.01, 1e-3, 1e-4, 1e-5, 1e-6, 2.0**-24),
    "largest error of the opacity of a cube",
    "Jitter, front residual",
    limit=1e-5,
    outcome="bounded",
    picture=lambda left, size: signed(offset_error(left, size, BLUE["Jitter"]), 0.05),
    shows="error of the opacity under Jitter without front residual, ± 0.05 from blue to red",
    pictured=(1.0, 2.0**-24),
)
def jitter_offsets_near_1(left: float, size: int) -> dict[str, float]:
    """Does the first cell survive an offset that rounds to a whole step?

    Random numbers have 24 bits, so that ξ is at most 1 - 2⁻²⁴. The front residual and the cells behind it
    always cover the whole ray. Without it, Jitter lacks the first ξ d, here up to e⁻² ξ d."""
    return {name: float(np.abs(offset_error(left, size, each)).max()) for name, each in BLUE.items()}
