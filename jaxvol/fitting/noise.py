"""Noise of reference images, and the largest residual that it explains."""

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from .._util.checks import Arrayable, described, not_negative
from ..path_tracing import PathTraced
from ..xla.trees import PyTree


BLOCK = 4
"""Side, in pixels, of blocks within which noise may be correlated."""

Z = 3.0
"""Standard deviations of a Gaussian beyond which a residual is not due to chance: once in 741 fits."""


class Noise(eqx.Module):
    """Noise of all references."""

    variance: Float[Array, ""]
    """Sum of the variances of all entries."""
    noisy: Float[Array, ""]
    """Number of entries whose variance is positive."""
    freedom: Float[Array, ""]
    """Lower bound of the degrees of freedom of the sum of squares: a single one for each block."""

    @classmethod
    def of(cls, variances: Sequence[Float[np.ndarray, "height width channels"]]) -> "Noise | None":
        """Noise by the variances of all pixels of each image; None if all are 0."""
        blocks = []
        for image in variances:
            for axis in (0, 1):
                image = np.add.reduceat(image, range(0, image.shape[axis], BLOCK), axis)
            blocks.append(image.sum(axis=-1).ravel())
        total, squares = np.sum(sums := np.concatenate(blocks)), np.sum(sums**2)
        if total == 0:
            return None
        noisy = sum(np.count_nonzero(image) for image in variances)
        return cls(*(jax.device_put(np.float32(number)) for number in (total, noisy, total**2 / squares)))

    def reduced_chi_squared(self, squares: float, numbers: int) -> float | None:
        """Reduced χ² of a residual's sum of `squares` after a fit of `numbers`; None without freedom."""
        freedom = float(self.noisy) - numbers
        return squares / float(self.variance) * float(self.noisy) / freedom if freedom > 0 else None

    @property
    def largest_by_chance(self) -> float:
        """Reduced χ² that noise exceeds in at most one of 741 fits.

        A sum of squares of Gaussian numbers of variances vᵢ is nearly distributed as χ² with
        ν = (Σ vᵢ)² / Σ vᵢ² degrees of freedom (Satterthwaite 1946), whose quantiles follow from those of a
        Gaussian (Wilson and Hilferty 1931). Here vᵢ are the sums over blocks of pixels and their colours, so
        that ν is as small as if the noise within a block were a single number. The sum of independent noise
        with rare bright pixels, as of paths, also varies less than that.
        """
        spread = 2 / (9 * float(self.freedom))
        return (1 - spread + Z * math.sqrt(spread)) ** 3


def path_traced_view(
    traced: PathTraced, background: Float[Array, "3"]
) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width 3"] | None]:
    """The image over a background, and the variance of its pixels; None for a single path.

    A path that meets nothing shows the background b and has the radiance L = 0. So with the opacity A, the
    mean of n paths has the variance var L + [b² A (1 - A) - 2 b L (1 - A)] / (n - 1), where var L is that of
    the mean radiance, the square of `PathTraced.standard_error`.
    """
    arrays = traced.radiance, traced.deviations, traced.opacity, background
    radiance, deviations, opacity, color = (np.asarray(array, np.float64) for array in arrays)
    opacity = opacity[..., None]
    image = radiance + (1 - opacity) * color
    if traced.paths < 2:
        return image, None
    background_variance = color * (1 - opacity) * (color * opacity - 2 * radiance)
    # the sum is a variance of paths, and so at least 0, up to rounding
    return image, np.maximum(deviations / traced.paths + background_variance, 0) / (traced.paths - 1)


def pixel_values(
    name: str, value: PyTree, shapes: Sequence[tuple[int, ...]]
) -> list[Float[np.ndarray, "height width channels"] | None]:
    """Numbers of at least 0, such as noise or weights, for the pixels of each view; None where missing."""
    several = isinstance(value, list | tuple)
    if (several and len(value) != len(shapes)) or (not several and np.ndim(value) > 0):
        expected = f"a number, or a list with an entry for each of {len(shapes)} views"
        raise ValueError(f"{name} must be {expected}; got {described(value)}.")
    values = list(value) if several else [value] * len(shapes)
    names = [f"{name}[{view}]" if several else name for view in range(len(shapes))]
    return [_view_values(*view) for view in zip(names, values, shapes, strict=True)]


def _view_values(name: str, value: Arrayable | None, shape: tuple[int, ...]) -> np.ndarray | None:
    if value is None:
        return None
    array = np.asarray(not_negative(name, value, (None,) * np.ndim(value)), np.float64)
    try:
        return np.broadcast_to(array[..., None] if array.shape == shape[:-1] else array, shape)
    except ValueError as fault:
        expected = f"a number, {shape[:-1]}, or an array like its image, {shape}"
        raise ValueError(f"{name} must be {expected}; got shape {array.shape}.") from fault
