"""How large is the noise of reference images, and how much larger may a residual be by chance?"""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._util.checks import described, not_negative
from ..path_tracing import PathTraced


BLOCK = 4
"""Pixels along a side of blocks within which noise may be correlated."""

Z = 3.0
"""Standard deviations of a Gaussian beyond which a residual is not due to chance: once in 741 fits."""


class Noise(eqx.Module):
    """Of all references together."""

    variance: Float[Array, ""]
    """Sum of the variances of all entries."""
    noisy: Float[Array, ""]
    """Number of entries whose variance is positive."""
    freedom: Float[Array, ""]
    """Degrees of freedom of the sum of squares, at least: as if the noise of a block were a single number."""

    @classmethod
    def of(cls, variances: Sequence[Float[np.ndarray, "height width channels"]]) -> "Noise | None":
        """None if no pixel has any noise, since nothing can be compared with that."""
        blocks = []
        for image in variances:
            for axis in (0, 1):
                image = np.add.reduceat(image, range(0, image.shape[axis], BLOCK), axis)
            blocks.append(image.sum(axis=-1).ravel())
        total, squares = np.sum(sums := np.concatenate(blocks)), np.sum(sums**2)
        if total == 0:
            return None
        noisy = sum(np.count_nonzero(image) for image in variances)
        return cls(*(jnp.asarray(each, jnp.float32) for each in (total, noisy, total**2 / squares)))

    def reduced_chi_squared(self, squares: float, numbers: int) -> float | None:
        """Of a residual with this sum of squares, after a fit of so many numbers; None if none are left."""
        left = float(self.noisy) - numbers
        return squares / float(self.variance) * float(self.noisy) / left if left > 0 else None

    @property
    def largest_by_chance(self) -> float:
        """Reduced χ² that noise exceeds once in 741 fits, at most.

        A sum of squares of Gaussian numbers of variances vᵢ is nearly distributed as χ² with
        ν = (Σ vᵢ)² / Σ vᵢ² degrees of freedom (Satterthwaite 1946), whose quantiles follow from those of a
        Gaussian (Wilson and Hilferty 1931). Here vᵢ are the sums over blocks of pixels, all colours together:
        so ν is as small as if the noise within a block were a single number. Independent noise with rare
        bright pixels, as of paths, varies less than that, too.
        """
        spread = 2 / (9 * float(self.freedom))
        return (1 - spread + Z * math.sqrt(spread)) ** 3


def path_traced_view(
    traced: PathTraced, background: Float[Array, "3"]
) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width 3"] | None]:
    """The image over a background, and the variance of its pixels; None for a single path, which has none.

    A path that meets nothing shows the background b, and brings no radiance L. So with A the opacity, the
    mean of n paths has the variance var L + [b² A (1 - A) - 2 b L (1 - A)] / (n - 1), where var L is that of
    the mean radiance, the square of `PathTraced.standard_error`.
    """
    given = traced.radiance, traced.deviations, traced.opacity[..., None], background
    radiance, deviations, opacity, behind = (np.asarray(each, np.float64) for each in given)
    image = radiance + (1 - opacity) * behind
    if traced.paths < 2:
        return image, None
    of_background = behind * (1 - opacity) * (behind * opacity - 2 * radiance)
    # the sum is a variance of paths, and so at least 0, up to rounding
    return image, np.maximum(deviations / traced.paths + of_background, 0) / (traced.paths - 1)


def of_pixels(
    name: str, given: Any, shapes: Sequence[tuple[int, ...]]
) -> list[Float[np.ndarray, "height width channels"] | None]:
    """What a user gives for the pixels of each view, numbers of at least 0; None where nothing is given."""
    several = isinstance(given, list | tuple)
    if (several and len(given) != len(shapes)) or (not several and np.ndim(given) > 0):
        expected = f"a number, or a list with an entry for each of {len(shapes)} views"
        raise ValueError(f"{name} must be {expected}; got {described(given)}.")
    each = list(given) if several else [given] * len(shapes)
    names = [f"{name}[{view}]" if several else name for view in range(len(shapes))]
    return [_of_view(*view) for view in zip(names, each, shapes, strict=True)]


def _of_view(name: str, given: Any, shape: tuple[int, ...]) -> np.ndarray | None:
    if given is None:
        return None
    array = np.asarray(not_negative(name, given, (None,) * np.ndim(given)), np.float64)
    try:
        return np.broadcast_to(array[..., None] if array.shape == shape[:-1] else array, shape)
    except ValueError as fault:
        expected = f"a number, {shape[:-1]}, or an array like its image, {shape}"
        raise ValueError(f"{name} must be {expected}; got shape {array.shape}.") from fault
