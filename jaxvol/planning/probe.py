"""How far is an image from the converged one, and what does it cost? Found out from some of its pixels."""

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._util.vec3 import Scalar, along, apart
from ..engine.image import render_scene
from ..engine.rays import RayTiles
from ..engine.stages import Place
from ..engine.tiling import Tiling
from ..march.march import March
from ..ray import Scene
from ..scene.camera import Camera, GivenRays, axes_of
from ..scene.occupancy import BLOCK
from ..scene.rendering import Rendering
from ..xla.kept_programs import kept


SIDE = 8
"""Pixels along the side of a patch, as of the engine's beams, so that its samples are those of the image."""

PATCHES, SMALL, FEW = 128, 512, 32
"""Patches that are rendered, a thirty-second of 512 x 512 pixels; of images of fewer than SMALL patches FEW,
since their plan takes as long as several of them."""

LIKELY = 7 / 8
"""Fraction of the patches that are chosen where visible blocks lie on or near their middle ray; the others,
where a ray meets the volume."""

POINTS, NEAR = 256, 2
"""Points of the middle ray that are looked at, and blocks around each."""

CONFIDENT = 1.5
"""Standard errors that are added to a mean square from some of the pixels. Were those of patches normally
distributed, 93 % of estimates would not be too low; where a few patches hold most of the error, fewer."""

FASTEST, SLOWEST = 0.25, 0.9
"""By what errors are taken to shrink for each halving of the step: a quarter where the order is 2; never
faster, and never standing still."""

UNSEEN = 3.0
"""Pixels that may show something if none of n does: with a confidence of 95 %, no more than UNSEEN / n of
them."""

ROUNDING = 1e-6
"""Differences of images that may be due to rounding."""


class Candidates(NamedTuple):
    """Patches of a camera's image, which of them meet the volume, and which are likely to show anything."""

    camera: Camera
    hit: Bool[np.ndarray, " patches"]
    likely: Bool[np.ndarray, " patches"]

    @classmethod
    def of(cls, camera: Camera, place: Place, visible: Bool[np.ndarray, "bx by bz"]) -> "Candidates":
        """`visible`: blocks that may hold anything visible."""
        from scipy.ndimage import maximum_filter  # here, so that a first image does not wait for it

        (width, height), (across, down) = camera.size, _patches(camera)

        def hits(pixels: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
            enters, leaves = _intervals(place, *_rays(camera, pixels % width, pixels // width))
            return leaves > np.maximum(enters, 0)

        parts = np.split(np.arange(width * height), range(RAYS, width * height, RAYS))
        hit = np.concatenate(list(map(hits, parts))).reshape(height, width)
        hit = np.pad(hit, ((0, down * SIDE - height), (0, across * SIDE - width)))
        hit = hit.reshape(down, SIDE, across, SIDE).any(axis=(1, 3)).reshape(-1)
        near = maximum_filter(visible, 2 * NEAR + 1, mode="constant")
        likely = hit & _passes(camera, place, near)
        hit[0] |= not hit.any()
        return cls(camera, hit, likely)

    @property
    def wanted(self) -> int:
        """Patches of a probe."""
        return PATCHES if self.hit.size >= SMALL else FEW

    def pixels(self, chosen: Int[np.ndarray, " n"]) -> tuple[Int[np.ndarray, "n m"], Int[np.ndarray, "n m"]]:
        """Columns and rows of patches' pixels, in the order of the engine's beams."""
        half = SIDE // 2
        down, across, y, x = np.unravel_index(np.arange(SIDE**2), (2, 2, half, half))
        y, x = down * half + y, across * half + x
        row, column = np.divmod(chosen, _patches(self.camera)[0])
        return column[:, None] * SIDE + x, row[:, None] * SIDE + y

    def rays(self, column: Int[np.ndarray, "*n"], row: Int[np.ndarray, "*n"]) -> GivenRays:
        """Those of pixels; past the edges of the image, of the last ones."""
        ends = zip((column, row), self.camera.size, strict=True)
        column, row = (np.minimum(each, n - 1).reshape(-1) for each, n in ends)
        origins, directions = _rays(self.camera, column, row)
        pixels = np.stack([column, row], axis=-1) + np.round(np.asarray(self.camera.corner)).astype(int)
        arrays = origins, directions, pixels.astype(np.int32)
        return GivenRays(*(jnp.asarray(each, each.dtype) for each in arrays))

    def narrowed(self, render: Callable[[GivenRays], Rendering]) -> "Candidates":
        """Likely are those that show anything in pixels which are spread evenly over the likely ones, or else
        over all, as many as a probe has; if any do."""
        patches = np.flatnonzero(self.likely if self.likely.any() else self.hit)
        spread = np.linspace(0, patches.size * SIDE**2 - 1, self.wanted * SIDE**2).astype(int)
        column, row = (each.reshape(-1)[spread] for each in self.pixels(patches))
        shown = np.asarray(render(self.rays(column, row)).rgba).any(axis=-1)
        likely = np.zeros_like(self.likely)
        likely[patches[spread[shown] // SIDE**2]] = True
        return self._replace(likely=likely) if shown.any() else self


class Probe(NamedTuple):
    """Patches of an image: one of each stratum of neighbours, of those that may show anything.

    Attributes:
        source: their rays, patch by patch.
        strata: how many patches of the image each stands for; 0 for those that only fill up the program.
        likely: which were chosen where something is likely to be visible.
        inside: 1 for pixels of the image, 0 for those past its edges.
        pixels: of the whole image.
    """

    source: GivenRays
    strata: Float[np.ndarray, " patches"]
    likely: Bool[np.ndarray, " patches"]
    inside: Float[np.ndarray, "patches pixels"]
    pixels: int

    @classmethod
    def of(cls, candidates: Candidates, seed: int) -> "Probe":
        """Some patches of a camera's image; all, if they are few. Without any ray that meets the volume,
        the first one."""
        groups = np.flatnonzero(candidates.likely), np.flatnonzero(candidates.hit & ~candidates.likely)
        reserved = min(groups[1].size, round(candidates.wanted * (1 - LIKELY)))
        first = min(groups[0].size, candidates.wanted - reserved)
        rest = min(groups[1].size, candidates.wanted - first)
        random, chosen, strata = np.random.default_rng(seed), [], []
        for group, count in zip(groups, (first, rest), strict=True):
            edges = np.linspace(0, group.size, count + 1).astype(int)
            chosen.append(group[random.integers(edges[:-1], edges[1:])])
            strata.append(np.diff(edges))
        chosen, strata = np.concatenate(chosen), np.concatenate(strata).astype(float)
        # one of two numbers of rays, so that images of all sizes share programs
        more = candidates.wanted - chosen.size
        chosen, strata = np.pad(chosen, (0, more), mode="edge"), np.pad(strata, (0, more))
        likely, (width, height) = np.arange(candidates.wanted) < first, candidates.camera.size
        column, row = candidates.pixels(chosen)
        inside = ((column < width) & (row < height)).astype(float)
        return cls(candidates.rays(column, row), strata, likely, inside, width * height)

    def mean(self, of_pixels: Any) -> float:
        """Of a number of each pixel, over the whole image; 0 where nothing can be seen."""
        return float(self.strata @ self._totals(of_pixels) / self.pixels)

    def _totals(self, of_pixels: Any) -> Float[np.ndarray, " patches"]:
        return np.sum(np.asarray(of_pixels, np.float64).reshape(self.inside.shape) * self.inside, axis=1)

    def render(self, scene: Scene, march: March) -> Rendering:
        """These pixels of the scene's image under another march."""
        return rendered(self.source, scene, march, squares=True)

    def mean_square(self, difference: Float[np.ndarray, "pixels 3"]) -> tuple[float, float]:
        """Over the whole image, and its standard error, since only some pixels are known: of one patch of
        each stratum."""
        square = np.mean(difference**2, axis=-1)
        totals, error = self._totals(square), 0.0
        for group in (self.likely, ~self.likely & (self.strata > 0)):
            if group.sum() > 1:
                strata = self.strata[group]
                error += totals[group].var(ddof=1) * np.sum(strata * np.maximum(strata - 1, 0))
        return self.mean(square), float(np.sqrt(error)) / self.pixels


def rendered(rays: GivenRays, scene: Scene, march: March, *, squares: bool = False) -> Rendering:
    """As many rays as a probe has, of the scene's image under another march. `squares`: as in `Tiling`."""
    tiling = Tiling.of_backend()
    if isinstance(scene.source, Camera):  # by the program of its image
        tiling = tiling._replace(least=RayTiles.shared(scene.source, tiling)[0], squares=squares)
    return render_scene(scene._replace(source=rays, march=march), "all", "replay", tiling)


def is_empty(image: Rendering) -> bool:
    """Whether nothing is visible."""
    return not np.asarray(image.rgba).any()


def differences(image: Rendering, other: Rendering) -> list[Float[np.ndarray, "pixels 3"]]:
    """Of colours, over black and over white."""
    a, b = (np.asarray(each.rgba, np.float64) for each in (image, other))
    color, opacity = a[:, :3] - b[:, :3], a[:, 3:] - b[:, 3:]
    return [color, color - opacity]


class Truth(NamedTuple):
    """What images are compared with.

    Attributes:
        probe: the patches.
        image: the most accurate one.
        own: its own error, as the last halvings of the step let expect; ten times their difference, where
            that grew.
        ratio: by which errors shrink for each halving of the step.
        alike: correlation of errors of different steps, 0 where it is negative: 1 where all point the same
            way, as of smooth functions; less where steps miss details at random.
    """

    probe: Probe
    image: Rendering
    own: float
    ratio: float = SLOWEST
    alike: float = 1.0

    @classmethod
    def of(cls, probe: Probe, images: list[Rendering]) -> "Truth":
        """The last of at least three images, each with half the step of the one before."""
        pairs = zip(differences(*images[-3:-1]), differences(*images[-2:]), strict=True)
        # of both backgrounds: squares of the two differences, and their product
        means = [[probe.mean(np.mean(a * b, axis=-1)) for a, b in ((x, x), (y, y), (x, y))] for x, y in pairs]
        before, last = (math.sqrt(max(each)) for each in list(zip(*means, strict=True))[:2])
        if last > max(before, ROUNDING):
            return cls(probe, images[-1], 10 * last)  # steps pass over something: nothing is known yet
        ratio = min(max(last / before if before > 0 else 0.0, FASTEST), SLOWEST)
        turn = max(xy / math.sqrt(xx * yy) if xx * yy > 0 else 1.0 for xx, yy, xy in means)
        turn = max(turn, -ratio / (1 + ratio**2))
        # Of errors a, ratio a and ratio² a with the correlation c, differences have the one
        # turn = (c (1 - ratio + ratio²) - ratio) / (1 + ratio² - 2 c ratio), less than c; solved for c.
        alike = (turn * (1 + ratio**2) + ratio) / (1 - ratio + ratio**2 + 2 * ratio * turn)
        alike = min(max(alike, 0.0), 1.0)
        # last² = e² + (ratio e)² - 2 alike ratio e², where e is the error of the image before the last
        own = last * ratio / math.sqrt(1 + ratio**2 - 2 * alike * ratio)
        return cls(probe, images[-1], own, ratio, alike)

    def error(self, image: Rendering) -> float:
        """Root mean square error of another image, over black or over white, whichever is greater; infinite
        if either is not finite, or rays used up their samples."""
        squares = []
        for square, doubt in map(self.probe.mean_square, differences(image, self.image)):
            whole = square + self.own**2 + 2 * self.alike * math.sqrt(square) * self.own
            # `own` is known from the same patches, and as little as the difference
            squares.append(whole * (1 + CONFIDENT * doubt / square) if square > 0 else whole)
        ended = any(bool(np.asarray(each.exhausted).any()) for each in (image, self.image))
        return math.sqrt(max(squares)) if np.isfinite(squares).all() and not ended else math.inf


def _patches(camera: Camera) -> tuple[int, int]:
    """How many lie across and down an image."""
    width, height = camera.size
    return -(-width // SIDE), -(-height // SIDE)


RAYS, LINES = 2**15, 2**10
"""Rays, and lines of `POINTS`, that are computed at a time, by programs that images of all sizes share."""


def _in_parts(program: Callable[..., Any], size: int, *arrays: np.ndarray) -> Iterator[Any]:
    """Results, as NumPy arrays, of a program that takes as many elements of arrays at a time."""
    for begin in range(0, len(arrays[0]), size):
        given = [each[begin : begin + size] for each in arrays]
        missing = size - len(given[0])
        found = program(
            *(np.pad(each, ((0, missing), *((0, 0),) * (each.ndim - 1)), "edge") for each in given)
        )
        yield jax.tree.map(lambda each, count=size - missing: np.asarray(each)[:count], found)


def _rays(camera: Camera, column: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions of the rays of pixels, as of `Camera.ray`, in NumPy."""
    known = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), camera)
    (left, right, bottom, top), (width, height) = known.window, camera.size
    x = left + (right - left) * (column + 0.5) / width
    y = top - (top - bottom) * (row + 0.5) / height
    across, up, forward = axes_of(known, np)
    beside = x[:, None] * across + y[:, None] * up
    if camera.parallel_scale is not None:
        origins, directions = known.position + known.parallel_scale * beside, forward + 0 * beside
    else:
        directions = forward + np.tan(np.deg2rad(known.view_angle) / 2) * beside
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        origins = known.position + 0 * beside
    dtype = np.dtype(camera.position.dtype)
    return origins.astype(dtype), directions.astype(dtype)


@kept
def _interval(place: Place, origins: Array, directions: Array) -> tuple[Array, Array]:
    return place.space.interval(*(tuple(each.T) for each in (origins, directions)))


def _intervals(place: Place, *rays: np.ndarray) -> list[np.ndarray]:
    """Depths at which rays enter and leave the volume."""
    parts = _in_parts(partial(_interval, place), RAYS, *rays)
    return [np.concatenate(ends) for ends in zip(*parts, strict=True)]


def _passes(
    camera: Camera, place: Place, blocks: Bool[np.ndarray, "bx by bz"]
) -> Bool[np.ndarray, " patches"]:
    """Whether the middle ray of each patch passes through one of the blocks."""
    across, down = _patches(camera)
    row, column = (SIDE * each + (SIDE - 1) / 2 for each in np.divmod(np.arange(across * down), across))
    rays = _rays(camera, column, row)
    lines = *rays, *_intervals(place, *rays)
    last, found = np.array(blocks.shape) - 1, []
    for at, crosses in _in_parts(partial(_along, place), LINES, *lines):
        i, j, k = np.clip(np.floor(at / BLOCK).T, 0, last[:, None, None]).astype(int)
        found.append(crosses & blocks[i, j, k].any(axis=0))
    return np.concatenate(found)


@kept
def _along(place: Place, origins: Array, directions: Array, nears: Array, fars: Array) -> tuple[Array, Array]:
    """Grid coordinates of `POINTS` points along each ray, and whether it meets the volume."""
    space, parts = place.space, (jnp.arange(POINTS, dtype=nears.dtype) + 0.5) / POINTS

    def at(origin: Array, direction: Array, entry: Scalar, leave: Scalar, part: Scalar) -> Array:
        line = apart(origin), apart(direction)
        return jnp.stack(space.coordinate(along(*line, entry + (leave - entry) * part)))

    entries = jnp.maximum(nears, 0)
    over_parts = jax.vmap(at, in_axes=(None, None, None, None, 0))
    points = jax.vmap(over_parts, in_axes=(0, 0, 0, 0, None))(origins, directions, entries, fars, parts)
    return points, fars > entries
