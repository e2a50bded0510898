"""Differences of an image from a reference, and measures of errors by kind.

Images are (height, width) or (height, width, channels), and are analysed in float64. Energies are mean
squares per pixel, summed over channels: scaling an error by k scales them by k². Frequencies are (x, y)
in cycles per pixel. Functions are NumPy, not JAX, since they analyse finished images. Similarities, `ncc` and
`gradient_ncc`, are JAX, since they are maximised: they take images of one channel, and keep their type.
"""

import math
from functools import partial
from typing import TypeAlias, cast

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64

from ._util import checks
from ._util.checks import Arrayable


Image: TypeAlias = Float64[np.ndarray, "height width channels"]
Plane: TypeAlias = Float64[np.ndarray, "height width"]

BLOCK = 32
"""Side of blocks searched for wood grain, in which rings are straight, and frequencies still separate."""

SLOWEST = 3
"""Cycles per block below which an error counts as shading, not wood grain: a period of 10.7 pixels."""

PEAKS = 16
"""Number of frequencies that count as a block's peaks: the main lobe of a wave between bins is 4 x 4."""


def rmse(image: Arrayable, reference: Arrayable) -> float:
    """Root-mean-square difference over pixels and channels.

    Args:
        image: (height, width) or (height, width, channels).
        reference: an image of the same shape.

    Returns:
        The difference, in the unit of the images.

    Raises:
        ValueError: for NaN or infinity, shapes that differ, and input that is not an image.
    """
    image, reference = _pair(image, reference)
    return float(np.sqrt(np.mean((image - reference) ** 2)))


def psnr(image: Arrayable, reference: Arrayable, data_range: float = 1.0) -> float:
    """Peak signal-to-noise ratio in dB, `20 log10(data_range / rmse)`; infinite for equal images.

    Args:
        image: as for `rmse`.
        reference: as for `rmse`.
        data_range: the greatest value of an image, > 0.

    Returns:
        The ratio, dB.

    Raises:
        ValueError: as `rmse`, and for a `data_range` that is not positive.
    """
    checks.number("data_range", data_range, above=0)
    error = rmse(image, reference)
    return 20 * math.log10(data_range / error) if error > 0 else math.inf


def ssim(image: Arrayable, reference: Arrayable, data_range: float = 1.0) -> float:
    """Mean structural similarity over windows of 7 x 7 pixels, then over channels; 1 for equal images.

    Args:
        image: as for `psnr`.
        reference: as for `psnr`.
        data_range: as for `psnr`.

    Returns:
        The similarity, at most 1.

    Raises:
        ValueError: as `psnr`, and for an image with fewer than 7 pixels along a side.

    Source: Wang et al. 2004, as implemented in scikit-image.
    """
    from skimage.metrics import structural_similarity  # here, since it imports more slowly than jaxvol

    checks.number("data_range", data_range, above=0)
    image, reference = _pair(image, reference)
    _at_least("image", image, 7)
    mean = structural_similarity(reference, image, data_range=data_range, channel_axis=-1)
    return float(cast(float, mean))  # a tuple only if more outputs are requested


def ncc(image: Arrayable, reference: Arrayable, weights: Arrayable | None = None) -> Float[Array, ""]:
    """Normalised cross-correlation: Pearson's correlation of two images over their pixels, in [-1, 1]. It
    does not change with brightness or contrast, is differentiable, and is 0 if an image is constant.

    Args:
        image: (height, width).
        reference: an image of the same shape.
        weights: weights of the pixels, (height, width), at least 0; a pixel of weight 0 does not count.

    Returns:
        The correlation, a scalar.

    Raises:
        ValueError: for images that are not (height, width), shapes that differ, and negative weights.
    """
    _same_shape(image, reference)
    return jnp.sum(standardized(image, weights) * standardized(reference, weights))


def gradient_ncc(
    image: Arrayable, reference: Arrayable, weights: Arrayable | None = None
) -> Float[Array, ""]:
    """Gradient correlation: the mean of the normalised cross-correlations of the two derivatives, along x and
    y, of two images, by Sobel's masks. It compares edges, and is otherwise as `ncc`.

    Args:
        image: (height, width), at least 3 x 3 pixels.
        reference: as for `ncc`.
        weights: as for `ncc`. A derivative has the smallest weight of its 3 x 3 pixels.

    Returns:
        The correlation, a scalar.

    Raises:
        ValueError: as `ncc`, and for fewer pixels.

    Source: Penney et al., "A comparison of similarity measures for use in 2-D-3-D medical image
    registration", IEEE TMI 17(4), 1998.
    """
    _same_shape(image, reference)
    standard = partial(standardized, weights=weights, gradient=True)
    return jnp.sum(standard(image) * standard(reference))


def standardized(
    image: Arrayable, weights: Arrayable | None = None, *, gradient: bool = False
) -> Float[Array, "..."]:
    """Scale an image, or its derivatives, to weighted mean 0 and length 1. The sum of the products of two
    such images is their `ncc`, or `gradient_ncc`; half the sum of the squares of their difference is 1 minus
    that. So `fit` maximises it with the residual `standardized(rendered) - standardized(reference)`.

    Args:
        image: (height, width).
        weights: as for `ncc`.
        gradient: whether to take Sobel's derivatives, as for `gradient_ncc`.

    Returns:
        (height, width), or (2, height - 2, width - 2); 0 for a constant image.

    Raises:
        ValueError: as `ncc` and `gradient_ncc`.
    """
    image = jnp.asarray(image)
    if image.dtype not in (jnp.float32, jnp.float64):  # sums overflow in 16 bits
        image = image.astype(jnp.float32)
    if image.ndim != 2 or min(image.shape) < (3 if gradient else 1):
        size = ", of at least 3 x 3 pixels" if gradient else ""
        raise ValueError(f"image must have shape (height, width){size}; got {image.shape}.")
    weights = jnp.ones_like(image) if weights is None else jnp.asarray(weights, image.dtype)
    if weights.shape != image.shape:
        raise ValueError(f"weights must have the shape of the image, {image.shape}; got {weights.shape}.")
    message = "weights must not be negative; got {got}."
    weights = jnp.asarray(checks.require(weights, lambda w: w >= 0, message))
    if not gradient:
        return _unit(image, weights)
    last = image.shape[0] - 2, image.shape[1] - 2
    shifted = [[(slice(y, last[0] + y), slice(x, last[1] + x)) for x in range(3)] for y in range(3)]
    smallest = jnp.min(jnp.stack([weights[at] for row in shifted for at in row]), axis=0)
    derivatives = []
    for lines in (shifted, list(zip(*shifted, strict=True))):  # along x, and along y
        slopes = [image[after] - image[before] for before, _, after in lines]
        derivatives.append(_unit(slopes[0] + 2 * slopes[1] + slopes[2], smallest))
    return jnp.stack(derivatives) * 0.5**0.5


def _unit(image: Array, weights: Array) -> Array:
    """Shift an image to weighted mean 0, and scale it by √weights to length 1; a constant image gives 0."""
    total = jnp.sum(weights)
    centered = image - jnp.sum(weights * image) / jnp.where(total > 0, total, 1)
    square = jnp.sum(weights * centered**2)
    # a constant image has only this much left, by rounding of its mean
    varies = square > image.size * jnp.finfo(centered.dtype).eps ** 2 * jnp.sum(weights * image**2)
    return jnp.where(varies, jnp.sqrt(weights) * centered / jnp.sqrt(jnp.where(varies, square, 1)), 0)


def comb_frequency(step: float, depth_slope: tuple[float, float], pixel_size: float) -> tuple[float, float]:
    """Frequency of the wood grain on an inclined plane in an orthographic camera, cycles per pixel.

    The plane's depth grows by one step, and the rings repeat, every `step / (pixel_size depth_slope)` pixels.

    Args:
        step: distance between samples, world length, > 0.
        depth_slope: increase of world depth per world length to the right and downwards in the image.
        pixel_size: world length of a pixel, > 0.

    Returns:
        The frequency to the right and downwards, cycles per pixel, as `wood_grain_energy` takes it.

    Raises:
        ValueError: for a step or pixel size that is not positive, and slopes that are not finite.
    """
    checks.number("step", step, above=0)
    checks.number("pixel_size", pixel_size, above=0)
    checks.finite_array("depth_slope", depth_slope, (2,))
    along_x, along_y = map(float, depth_slope)
    return pixel_size * along_x / step, pixel_size * along_y / step


def wood_grain_energy(
    error: Arrayable, frequency: tuple[float, float] | None = None, harmonics: int = 3
) -> float:
    """Energy of the wood grain in an error: mean square per pixel, summed over channels.

    With `frequency` (the fundamental of the rings, see `comb_frequency`): the energy of the waves at the
    fundamental and its harmonics, by their Fourier coefficients under a Hann window w over the image,

        a_h = Σ w (e - mean_w(e)) exp(-2πi h f·x) / Σ w,    energy = Σ_h 2 |a_h|²,  h = 1 … harmonics.

    Harmonics above Nyquist are measured at their aliases; harmonics within two bins (2/width, 2/height) of 0,
    of their mirror image, or of an earlier harmonic are omitted. White noise of variance v adds
    2.25 v · 2 harmonics / pixels. A `frequency` that is wrong by half a bin loses 28 %.

    Without `frequency`, for any scene: the energy in the peaks of local spectra, minus the expected energy of
    noise there. In a block of `BLOCK` pixels under a Hann window, E is the energy over frequencies of at
    least `SLOWEST` cycles per block (slower errors are shading), T the energy of the `PEAKS` largest values,
    and q the mean T / E of white noise. The result is the mean over blocks of (T - q E) / (1 - q): E for
    waves, 0 on average for white noise. Noise added to waves lowers it by up to 0.13 of the noise's energy.
    An edge counts as structure, a single pixel does not.

    Args:
        error: an image minus its reference, (height, width) or (height, width, channels).
        frequency: frequency to the right and downwards, cycles per pixel; None if unknown.
        harmonics: number of harmonics that are summed, with `frequency`.

    Returns:
        The energy, in squared units of the error.

    Raises:
        ValueError: for NaN or infinity, input that is not an image, an image smaller than a block,
            harmonics < 1, and a fundamental that cannot be separated from 0 or from its mirror image.
    """
    error = _image("error", error)
    if frequency is None:
        _at_least("error", error, BLOCK)
        return sum(_peaks(error[..., channel]) for channel in range(error.shape[-1]))
    checks.finite_array("frequency", frequency, (2,))
    return _comb(error, frequency, checks.integer("harmonics", harmonics, 1))


def boundary_noise(image: Arrayable, region: Arrayable) -> float:
    """Noise in part of an image, without its shading: variance per pixel, summed over channels.

    Mean of (M * image)² / 36 over the pixels whose 3 x 3 neighbours all lie in `region`, with the mask
    M = [1 -2 1; -2 4 -2; 1 -2 1]. White noise of variance v gives v. Shading that is the sum of a function of
    the row and a function of the column gives 0, as does any quadratic; other smooth shading leaves its
    ∂⁴/∂x²∂y².

    Args:
        image: an image, or an error, (height, width) or (height, width, channels).
        region: (height, width) booleans of the part, such as the pixels where the bounds cut material.

    Returns:
        The variance, in squared units of the image.

    Raises:
        ValueError: for NaN or infinity, input that is not an image, a region of another shape, and one that
            holds no 3 x 3 pixels.

    Source: Immerkær, "Fast noise variance estimation", CVIU 64(2), 1996, with squares for absolute values.
    """
    image, region = _image("image", image), np.asarray(region)
    if region.dtype != bool or region.shape != image.shape[:2]:
        raise ValueError(
            f"region must be booleans of shape {image.shape[:2]}, one for each pixel; "
            f"got {region.dtype} of shape {region.shape}."
        )
    _at_least("image", image, 3)
    inside = np.lib.stride_tricks.sliding_window_view(region, (3, 3)).all(axis=(2, 3))
    rough = np.diff(np.diff(image, 2, axis=0), 2, axis=1)
    if not inside.any():
        raise ValueError("region must hold a pixel with all its 3 x 3 neighbours; got none.")
    return float(np.mean(np.sum(rough[inside] ** 2, axis=-1)) / 36)


def _comb(error: Image, frequency: tuple[float, float], harmonics: int) -> float:
    height, width, _ = error.shape
    windowed, window = _windowed(error)
    x, y = np.arange(width), np.arange(height)
    earlier, energy = [np.zeros(2)], 0.0
    for harmonic in range(1, harmonics + 1):
        wave = harmonic * np.array(frequency)
        differences = wave - np.array([*earlier, -wave])
        distances = np.abs(differences - np.round(differences))  # of their aliases
        if np.any(np.all(distances < 2 / np.array([width, height]), axis=1)):
            if harmonic > 1:
                continue
            raise ValueError(
                f"frequency must be two bins (2/width, 2/height) away from 0 and from its mirror image; "
                f"got {frequency} in an image of {width} x {height}."
            )
        earlier += [wave, -wave]
        across, down = np.exp(-2j * np.pi * wave[0] * x), np.exp(-2j * np.pi * wave[1] * y)
        energy += 2 * np.sum(np.abs(np.einsum("y,yxc,x->c", down, windowed / window.sum(), across)) ** 2)
    return float(energy)


def _peaks(error: Plane) -> float:
    cycles = np.fft.fftfreq(BLOCK, 1 / BLOCK)
    y, x = np.meshgrid(cycles, cycles, indexing="ij")
    # one of each mirrored pair, without the two lines at Nyquist, which are their own mirror images
    half = ((y > 0) | ((y == 0) & (x > 0))) & (np.abs(x) < BLOCK / 2) & (np.abs(y) < BLOCK / 2)
    selected = half & (np.hypot(x, y) >= SLOWEST)

    blocks = np.lib.stride_tricks.sliding_window_view(error, (BLOCK, BLOCK))
    starts = [np.append(np.arange(0, n - 1, BLOCK // 2), n - 1) for n in blocks.shape[:2]]
    blocks = blocks[np.ix_(*starts)].reshape(-1, BLOCK, BLOCK, 1)
    windowed, windows = zip(*map(_windowed, blocks), strict=True)
    spectra = np.fft.fft2(np.array(windowed)[..., 0])[:, selected]
    energy = np.sort(2 * np.abs(spectra) ** 2, axis=1) / (BLOCK**2 * np.sum(windows[0] ** 2))

    chance = _share_of_largest(PEAKS, int(selected.sum()))
    total, top = energy.sum(axis=1).mean(), energy[:, -PEAKS:].sum(axis=1).mean()
    return float((top - chance * total) / (1 - chance))


def _share_of_largest(m: int, n: int) -> float:
    """Expected share of the m largest of n exponentially distributed numbers in their sum."""
    tails = np.cumsum(1 / np.arange(n, 0, -1))[::-1]  # the i-th largest has mean Σ_{i ≤ j ≤ n} 1/j
    return float(tails[:m].sum() / n)


def _windowed(error: Image) -> tuple[Image, Plane]:
    """The error minus its windowed mean, times a Hann window; and the window."""
    y, x = (np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2 for n in error.shape[:2])
    window = np.outer(y, x)
    mean = np.tensordot(window, error, axes=2) / window.sum()
    return (error - mean) * window[..., None], window


def _pair(image: Arrayable, reference: Arrayable) -> tuple[Image, Image]:
    _same_shape(image, reference)
    return _image("image", image), _image("reference", reference)


def _same_shape(image: Arrayable, reference: Arrayable) -> None:
    shapes = np.shape(image), np.shape(reference)
    if shapes[0] != shapes[1]:
        raise ValueError(f"image and reference must agree in shape; got {shapes[0]} and {shapes[1]}.")


def _image(name: str, value: Arrayable) -> Image:
    """Convert `value` to (height, width, channels), in float64."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError) as fault:
        raise ValueError(f"{name} must be numbers; got {value!r}.") from fault
    if array.ndim not in (2, 3) or 0 in array.shape:
        raise ValueError(f"{name} must have shape (height, width) or (height, width, c); got {array.shape}.")
    if bad := np.sum(~np.isfinite(array)):
        raise ValueError(f"{name} must be finite; got {bad} of {array.size} numbers that are not.")
    return array[..., None] if array.ndim == 2 else array


def _at_least(name: str, image: Image, side: int) -> None:
    if min(image.shape[:2]) < side:
        raise ValueError(f"{name} must have at least {side} pixels along each side; got {image.shape[:2]}.")
