"""Where does a fit start when nothing is known yet?"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from .._util.checks import Arrayable, finite_array, integer, require
from ..scene.transfer import TransferFunction
from ..scene.volume import Volume


def flat_grey(volume: Volume, points: int | Any = 8, clim: Arrayable | None = None) -> TransferFunction:
    """A transfer function to start a fit from: middle grey, with the same extinction everywhere.

    **Arguments:**

    - `volume`: its optical depth becomes about 1, so that the back is visible as well as the front.
    - `points`: number of control points, at least 2, evenly spaced.
    - `clim`: their range (low, high), in value units; by default that of the volume's values.

    **Returns:** the `TransferFunction`, of colours 0.5.

    **Raises:** `ValueError` for fewer than two points, and for a range that does not increase.
    """
    points = integer("points", points, 2)
    clim = (float(volume.data.min()), float(volume.data.max())) if clim is None else clim
    low, high = require(
        finite_array("clim", clim, (2,)),
        lambda c: c[0] < c[1],
        "clim must be (low, high), low first; got {got}.",
    )
    bounds = volume.bounds
    extent = float(jnp.mean(bounds[1::2] - bounds[::2]))
    return TransferFunction(
        np.linspace(float(low), float(high), points), np.full((points, 3), 0.5), np.full(points, 1 / extent)
    )


def refined(transfer: TransferFunction, points: int | Any) -> TransferFunction:
    """The same transfer function with more control points.

    All points are kept. Each new one goes where the gap is widest, and those of one gap divide it evenly:
    even points become even ones again from n to 2n - 1, as 2, 3, 5, 9, and nearly even ones otherwise.

    **Arguments:**

    - `transfer`: the transfer function.
    - `points`: their number, at least that of `transfer`.

    **Returns:** a `TransferFunction` that shows the same.

    **Raises:** `ValueError` for fewer points, and where the float type has no values left between two.
    """
    values = np.asarray(transfer.values)
    points = integer("points", points, len(values))
    gaps = np.diff(values.astype(float))
    pieces = np.ones(len(gaps), int)
    for _ in range(points - len(values)):
        pieces[np.argmax(gaps / pieces)] += 1
    gap = np.repeat(np.arange(len(gaps)), pieces)
    part = np.concatenate([np.arange(n) / n for n in pieces])

    def between(rows: Any) -> np.ndarray:
        rows = np.asarray(rows)
        share = part.astype(rows.dtype).reshape(-1, *(1,) * (rows.ndim - 1))
        return np.concatenate([rows[gap] * (1 - share) + rows[gap + 1] * share, rows[-1:]])

    at = between(values)
    if np.any((np.diff(at) <= 0) & (pieces[gap] > 1)):
        raise ValueError(
            f"points must be few enough for {values.dtype} to hold values between those of transfer; "
            f"got {points} from {values[0]} to {values[-1]}."
        )
    return TransferFunction(at, between(transfer.colors), between(transfer.extinction))
