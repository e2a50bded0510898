"""Where do isosurfaces fail? Sheets that a ray enters and leaves within one cell."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxvol as jv

from .entry import Entry, grey


STEP = 2 / 128
SEED = 0


class Ridge(jv.Field):
    """1 on an inclined plane across z = 0, falling linearly to 0 on both sides: above 1/2 in a sheet of this
    thickness."""

    thickness: Float[Array, ""]

    def value(self, volume: jv.Volume, coordinate: tuple) -> Array:
        x, y, z = (c * volume.spacing[i] + volume.origin[i] for i, c in enumerate(coordinate))
        return jnp.clip(1 - jnp.abs(z - 0.13 * x - 0.07 * y) / self.thickness, 0, 1)


def surface(ratio: float, size: int, *, jitter: bool) -> np.ndarray:
    """Opacity of both faces of a sheet that is so many steps thick."""
    field = Ridge(jnp.asarray(ratio * STEP, jnp.float32))
    volume = jv.Volume(np.zeros((8, 8, 8), np.float32), [2 / 7] * 3, [-1.0] * 3, field=field)
    camera = jv.Camera((0, 0, -3), (0, 0, 0), (0, 1, 0), size=(size, size), parallel_scale=0.5)
    march = jv.March(STEP, (jv.EmptySpaceJitter(SEED),) if jitter else ())
    transfer = jv.TransferFunction([0.0, 1.0], np.ones((2, 3)), [0.0, 1.0])
    how = {"outputs": "rgba", "adjoint": "forward", "compositing": jv.Isosurface(0.5)}
    return np.asarray(jv.render(volume, transfer, camera, march, **how).rgba[..., 3], np.float64)


def surfaces(ratio: float, size: int) -> dict[str, float]:
    return {
        "EmptySpaceJitter": float(1 - np.mean(surface(ratio, size, jitter=True))),
        "without jitter": float(1 - np.mean(surface(ratio, size, jitter=False))),
        "1 - thickness / step": max(0.0, 1 - ratio),
    }


SHEETS = Entry(
    name="isosurfaces of thin sheets",
    question="How thin may a sheet be before rays pass through both of its faces unseen?",
    method="jaxvol.Isosurface",
    regime="thickness of the sheet, steps",
    values=(4.0, 2.0, 1.25, 1.05, 0.95, 0.8, 0.5, 0.25, 0.1),
    measure=surfaces,
    metric="share of pixels that miss the sheet",
    judged="EmptySpaceJitter",
    limit=0.001,
    outcome="documented",
    does="A cell that begins before the sheet and ends behind it has both ends below the value: rays miss a "
    "sheet by as much as it is thinner than a step, in bands without jitter, as noise with it. A shorter "
    "step sees it.",
    picture=lambda ratio, size: grey(surface(ratio, size, jitter=True)),
    shows="pixels that meet the sheet, under EmptySpaceJitter",
    scales=("log", "linear"),
    size=64,
)

ENTRIES = (SHEETS,)
