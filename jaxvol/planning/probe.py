"""Estimates of an image's error and cost from the pixels of some patches."""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..engine.image import render_scene
from ..engine.rays import RayTiles
from ..engine.tiling import Tiling
from ..march.march import March
from ..ray import Scene
from ..scene.camera import Camera, GivenRays, axes_of
from ..scene.rendering import Rendering
from ..xla.trees import unchecked


SIDE = 8  # pixels along the side of a patch, as of the engine's beams, so that its samples are the image's

# Patches that are rendered, a thirty-second of 512 x 512 pixels. Images of fewer than SMALL patches use
# SMALL_PATCHES, since their plan takes as long as several images.
PATCHES, SMALL, SMALL_PATCHES = 128, 512, 32

LIKELY = 7 / 8  # fraction of the patches chosen from those that are likely to be visible

# Standard errors added to a mean square of patches. If patches were normally distributed, 93 % of estimates
# would not be too low; fewer where a few patches hold most of the error.
CONFIDENT = 1.5

# Limits of the factor by which an error shrinks with each halving of the step; 0.25 for a method of order 2.
FASTEST, SLOWEST = 0.25, 0.9

UNSEEN = 3.0  # if n pixels are empty, at most UNSEEN / n of all are not, with a confidence of 95 %
ROUNDING = 1e-6  # differences of images that may be due to rounding


def wanted(camera: Camera) -> int:
    """Number of patches of a probe: one of two, so that images of all sizes share programs."""
    across, down = _patches(camera)
    return PATCHES if across * down >= SMALL else SMALL_PATCHES


def likely_patches(camera: Camera, render: Callable[[GivenRays], Rendering]) -> Bool[np.ndarray, " patches"]:
    """Mask of the patches in or near which a coarse image, of as many pixels as a probe, shows anything."""
    from scipy.ndimage import maximum_filter  # imported late, so that a first image does not wait for it

    count, (across, down), (width, height) = wanted(camera), _patches(camera), camera.size
    columns = min(max(round(math.sqrt(count * width / height)), 1), count, across)
    rows = min(count // columns, down)
    size = min(columns * SIDE, width), min(rows * SIDE, height)
    coarse = unchecked(camera, size=size, corner=np.zeros(2))
    rays = rays_of(coarse, *pixels_of(coarse, np.resize(np.arange(columns * rows), count)))
    shown, ratio = np.asarray(render(rays).rgba).any(axis=-1), np.divide(camera.size, size)
    column, row = ((np.asarray(rays.pixels)[shown] + 0.5) * ratio // SIDE).astype(int).T
    likely = np.zeros((down, across), bool)
    likely[row, column] = True
    return maximum_filter(likely, 2 * math.ceil(ratio.max() / SIDE) + 1, mode="constant").reshape(-1)


def pixels_of(
    camera: Camera, patches: Int[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, "n m"], Int[np.ndarray, "n m"]]:
    """Columns and rows of patches' pixels, in the order of the engine's beams."""
    half = SIDE // 2
    down, across, y, x = np.unravel_index(np.arange(SIDE**2), (2, 2, half, half))
    row, column = np.divmod(patches, _patches(camera)[0])
    return column[:, None] * SIDE + across * half + x, row[:, None] * SIDE + down * half + y


def rays_of(camera: Camera, column: Int[np.ndarray, "*n"], row: Int[np.ndarray, "*n"]) -> GivenRays:
    """Rays of pixels, clamped to the image, as by `Camera.ray`, in NumPy."""
    ends = zip((column, row), camera.size, strict=True)
    column, row = (np.minimum(index, n - 1).reshape(-1) for index, n in ends)
    known = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), camera)
    (x0, x1, y0, y1), (width, height) = known.window, camera.size
    x = x0 + (x1 - x0) * (column + 0.5) / width
    y = y1 - (y1 - y0) * (row + 0.5) / height
    across, up, forward = axes_of(known, np)
    offset = x[:, None] * across + y[:, None] * up
    if camera.parallel_scale is not None:
        origins, directions = known.position + known.parallel_scale * offset, forward + 0 * offset
    else:
        directions = forward + np.tan(np.deg2rad(known.view_angle) / 2) * offset
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        origins = known.position + 0 * offset
    dtype = np.dtype(camera.position.dtype)
    pixels = np.stack([column, row], axis=-1) + np.round(np.asarray(camera.corner)).astype(int)
    arrays = origins.astype(dtype), directions.astype(dtype), pixels.astype(np.int32)
    return GivenRays(*(jnp.asarray(array, array.dtype) for array in arrays))


class Probe(NamedTuple):
    """A sample of an image's patches: one of each stratum of neighbours.

    Attributes:
        source: rays of the patches, patch by patch.
        strata: number of the image's patches that a patch represents; 0 for padding.
        likely: mask of the patches that were chosen as likely to be visible.
        inside: 1 for pixels of the image, 0 past its edges.
        pixels: number of pixels of the image.
    """

    source: GivenRays
    strata: Float[np.ndarray, " patches"]
    likely: Bool[np.ndarray, " patches"]
    inside: Float[np.ndarray, "patches pixels"]
    pixels: int

    @classmethod
    def of(cls, camera: Camera, likely: Bool[np.ndarray, " patches"], seed: int) -> "Probe":
        """Random patches of an image; all if they are few. `likely`: those that are likely to be visible."""
        count, groups = wanted(camera), (np.flatnonzero(likely), np.flatnonzero(~likely))
        reserved = min(groups[1].size, round(count * (1 - LIKELY)))
        first = min(groups[0].size, count - reserved)
        second = min(groups[1].size, count - first)
        random, chosen, strata = np.random.default_rng(seed), [], []
        for group, number in zip(groups, (first, second), strict=True):
            edges = np.linspace(0, group.size, number + 1).astype(int)
            chosen.append(group[random.integers(edges[:-1], edges[1:])])
            strata.append(np.diff(edges))
        chosen, strata = np.concatenate(chosen), np.concatenate(strata).astype(float)
        more = count - chosen.size
        chosen, strata = np.pad(chosen, (0, more), mode="edge"), np.pad(strata, (0, more))
        column, row = pixels_of(camera, chosen)
        width, height = camera.size
        inside = ((column < width) & (row < height)).astype(float)
        return cls(rays_of(camera, column, row), strata, np.arange(count) < first, inside, width * height)

    def mean(self, values: np.ndarray | Array) -> float:
        """Estimate of a mean over the image by values of pixels."""
        return float(self.strata @ self._totals(values) / self.pixels)

    def _totals(self, values: np.ndarray | Array) -> Float[np.ndarray, " patches"]:
        return np.sum(np.asarray(values, np.float64).reshape(self.inside.shape) * self.inside, axis=1)

    def render(self, scene: Scene, march: March) -> Rendering:
        """Renders the probe's pixels of the scene's image under another march."""
        return rendered(self.source, scene, march)

    def mean_square(self, difference: Float[np.ndarray, "pixels 3"]) -> tuple[float, float]:
        """Estimate of the mean square over the image, and its standard error."""
        square = np.mean(difference**2, axis=-1)
        totals, error = self._totals(square), 0.0
        for group in (self.likely, ~self.likely & (self.strata > 0)):
            if group.sum() > 1:
                strata = self.strata[group]
                error += totals[group].var(ddof=1) * np.sum(strata * np.maximum(strata - 1, 0))
        return self.mean(square), float(np.sqrt(error)) / self.pixels


def rendered(rays: GivenRays, scene: Scene, march: March) -> Rendering:
    """Renders the rays of a probe's number of patches of a scene under another march."""
    tiling = Tiling.of_backend()
    if isinstance(scene.source, Camera):  # by the program of its image
        tiling = tiling._replace(least=RayTiles.shared(scene.source, tiling)[0], squares=True)
    return render_scene(scene._replace(source=rays, march=march), "all", "replay", tiling)


def is_empty(image: Rendering) -> bool:
    """Tests whether an image is fully transparent."""
    return not np.asarray(image.rgba).any()


def differences(first: Rendering, second: Rendering) -> list[Float[np.ndarray, "pixels 3"]]:
    """Differences of two images' colours, over black and over white."""
    a, b = (np.asarray(image.rgba, np.float64) for image in (first, second))
    color, opacity = a[:, :3] - b[:, :3], a[:, 3:] - b[:, 3:]
    return [color, color - opacity]


class Reference(NamedTuple):
    """The most accurate image, with which others are compared.

    Attributes:
        probe: the patches.
        image: the image at the probe's pixels.
        image_error: estimated error of `image`, extrapolated from the last halvings of the step; ten times
            their difference if that grew.
        ratio: factor by which the error shrinks with each halving of the step.
        correlation: correlation of the errors of different steps, at least 0: 1 for smooth functions, less
            where steps miss details at random.
    """

    probe: Probe
    image: Rendering
    image_error: float
    ratio: float = SLOWEST
    correlation: float = 1.0

    @classmethod
    def of(cls, probe: Probe, images: list[Rendering]) -> "Reference":
        """Reference from at least three images, sorted by steps that halve."""
        pairs = zip(differences(*images[-3:-1]), differences(*images[-2:]), strict=True)
        # for each background: mean squares of the two differences, and of their product
        means = [[probe.mean(np.mean(a * b, axis=-1)) for a, b in ((x, x), (y, y), (x, y))] for x, y in pairs]
        before, last = (math.sqrt(max(squares)) for squares in list(zip(*means, strict=True))[:2])
        if last > max(before, ROUNDING):
            return cls(probe, images[-1], 10 * last)  # not converging: steps miss some features
        r = min(max(last / before if before > 0 else 0.0, FASTEST), SLOWEST)
        cosine = max(xy / math.sqrt(xx * yy) if xx * yy > 0 else 1.0 for xx, yy, xy in means)
        cosine = max(cosine, -r / (1 + r**2))
        # If errors a, r a and r² a have the correlation c, the cosine between their differences is
        # (c (1 - r + r²) - r) / (1 + r² - 2 c r), which is less than c; solved for c.
        c = min(max((cosine * (1 + r**2) + r) / (1 - r + r**2 + 2 * r * cosine), 0.0), 1.0)
        # last² = e² + (r e)² - 2 c r e², where e is the error of the last but one image
        return cls(probe, images[-1], last * r / math.sqrt(1 + r**2 - 2 * c * r), r, c)

    def error(self, image: Rendering) -> float:
        """Root mean square error of another image, over black or over white, whichever is greater; infinite
        if either is not finite, or rays used up their samples."""
        squares, known = [], self.image_error
        for square, deviation in map(self.probe.mean_square, differences(image, self.image)):
            total = square + known**2 + 2 * self.correlation * math.sqrt(square) * known
            # `known` is estimated from the same patches, with the same relative deviation
            squares.append(total * (1 + CONFIDENT * deviation / square) if square > 0 else total)
        ended = any(bool(np.asarray(part.exhausted).any()) for part in (image, self.image))
        return math.sqrt(max(squares)) if np.isfinite(squares).all() and not ended else math.inf


def _patches(camera: Camera) -> tuple[int, int]:
    """Number of patches across and down an image."""
    width, height = camera.size
    return -(-width // SIDE), -(-height // SIDE)
