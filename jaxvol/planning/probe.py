"""How far is an image from the converged one, and what does it cost? Found out from some of its pixels."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._util.vec3 import along
from ..engine.image import render_scene
from ..march.march import March
from ..ray import Scene
from ..scene.camera import Camera, GivenRays
from ..scene.occupancy import BLOCK
from ..scene.rendering import Rendering
from ..scene.space import Space


SIDE = 8
"""Pixels along the side of a patch, as of the engine's beams, so that its samples are those of the image."""

PATCHES, SMALL, FEW = 128, 512, 32
"""Patches that are rendered, a thirty-second of 512 x 512 pixels; of images of fewer than SMALL patches FEW,
or their plan would take longer than ten of them."""

LIKELY = 7 / 8
"""Fraction of the patches that are chosen where visible blocks lie on or near their middle ray; the others,
where a ray meets the volume."""

POINTS, NEAR = 256, 2
"""Points of the middle ray that are looked at, and blocks around each."""

CONFIDENT = 2.0
"""Standard errors that are added to an estimate from some of the pixels. Were errors of patches normally
distributed, 98 % of estimates would not be too low; where a few patches hold most of the error, fewer."""

ROUNDING = 1e-6
"""Differences of images that may be due to rounding."""


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
    def of(cls, camera: Camera, space: Space, visible: Bool[Array, "bx by bz"], seed: int) -> "Probe":
        """Some patches of a camera's image; all, if they are few. Without any ray that meets the volume,
        the first one. `visible`: blocks that may hold anything visible."""
        from scipy.ndimage import maximum_filter  # here, so that a first image does not wait for it

        width, height = camera.size
        across, down = -(-width // SIDE), -(-height // SIDE)
        hit = np.asarray(_hits(camera, space))
        hit = np.pad(hit, ((0, down * SIDE - height), (0, across * SIDE - width)))
        hit = hit.reshape(down, SIDE, across, SIDE).any(axis=(1, 3)).reshape(-1)
        near = jnp.asarray(maximum_filter(np.asarray(visible), 2 * NEAR + 1, mode="constant"))
        likely = hit & np.asarray(_passes(camera, space, near)).reshape(-1)
        hit[0] |= not hit.any()
        groups = np.flatnonzero(likely), np.flatnonzero(hit & ~likely)
        patches = PATCHES if hit.size >= SMALL else FEW
        reserved = min(groups[1].size, round(patches * (1 - LIKELY)))
        first = min(groups[0].size, patches - reserved)
        random, chosen, strata = np.random.default_rng(seed), [], []
        for group, count in zip(groups, (first, min(groups[1].size, patches - first)), strict=True):
            edges = np.linspace(0, group.size, count + 1).astype(int)
            chosen.append(group[random.integers(edges[:-1], edges[1:])])
            strata.append(np.diff(edges))
        chosen, strata = np.concatenate(chosen), np.concatenate(strata).astype(float)
        more = patches - chosen.size  # one of two numbers of rays, so that images of all sizes share programs
        chosen, strata = np.pad(chosen, (0, more), mode="edge"), np.pad(strata, (0, more))
        y, x = np.divmod(np.arange(SIDE**2), SIDE)
        column, row = (chosen % across)[:, None] * SIDE + x, (chosen // across)[:, None] * SIDE + y
        inside = ((column < width) & (row < height)).astype(float)
        column, row = (
            jnp.asarray(np.minimum(part, last).reshape(-1), jnp.int32)
            for part, last in ((column, width - 1), (row, height - 1))
        )
        rays = _rays(camera, column, row)
        return cls(rays, strata, np.arange(patches) < first, inside, width * height)

    def mean(self, of_pixels: Any) -> float:
        """Of a number of each pixel, over the whole image; 0 where nothing can be seen."""
        return float(self.strata @ self._totals(of_pixels) / self.pixels)

    def _totals(self, of_pixels: Any) -> Float[np.ndarray, " patches"]:
        return np.sum(np.asarray(of_pixels, np.float64).reshape(self.inside.shape) * self.inside, axis=1)

    def render(self, scene: Scene, march: March) -> Rendering:
        """These pixels of the scene's image under another march."""
        return render_scene(scene._replace(source=self.source, march=march), "all", "replay")

    def distance(self, image: Rendering, other: Rendering) -> float:
        """Root mean square difference of colours over the whole image, over black or over white, whichever is
        greater; plus CONFIDENT standard errors, since only some pixels are known."""
        a, b = (np.asarray(each.rgba, np.float64) for each in (image, other))
        color, opacity = a[:, :3] - b[:, :3], a[:, 3:] - b[:, 3:]
        squares = [np.mean(each**2, axis=-1) for each in (color, color - opacity)]
        return float(np.sqrt(max(self._bound(square) for square in squares)))

    def _bound(self, square: Float[np.ndarray, " pixels"]) -> float:
        """The mean over the whole image, plus its standard errors: of one patch of each stratum."""
        totals, error = self._totals(square), 0.0
        for group in (self.likely, ~self.likely & (self.strata > 0)):
            if group.sum() > 1:
                strata = self.strata[group]
                error += totals[group].var(ddof=1) * np.sum(strata * np.maximum(strata - 1, 0))
        return self.mean(square) + CONFIDENT * float(np.sqrt(error)) / self.pixels


class Truth(NamedTuple):
    """What images are compared with.

    Attributes:
        probe: the patches.
        image: the most accurate one.
        own: its own error, as the last halvings of the step let expect; ten times their difference, where
            that grew.
    """

    probe: Probe
    image: Rendering
    own: float

    @classmethod
    def of(cls, probe: Probe, images: list[Rendering]) -> "Truth":
        """The last of at least three images, each with half the step of the one before."""
        before, last = (probe.distance(a, b) for a, b in zip(images[-3:-1], images[-2:], strict=True))
        if last > max(before, ROUNDING):
            return cls(probe, images[-1], 10 * last)  # steps pass over something: nothing is known yet
        # by a quarter for each halving where the order is 2; never taken to be faster, nor to stand still
        ratio = min(max(last / before if before > 0 else 0.0, 0.25), 0.7)
        return cls(probe, images[-1], last * ratio / (1 - ratio))

    def error(self, image: Rendering) -> float:
        """Of another image; infinite if either is not finite, or rays used up their samples."""
        found = self.probe.distance(image, self.image) + self.own
        ended = any(bool(np.asarray(each.exhausted).any()) for each in (image, self.image))
        return found if np.isfinite(found) and not ended else np.inf


@jax.jit
def _hits(camera: Camera, space: Space) -> Bool[Array, "height width"]:
    """Which pixels' rays meet the volume."""

    def hits(column: Int[Array, ""], row: Int[Array, ""]) -> Bool[Array, ""]:
        near, far = space.interval(*camera.ray(column, row))
        return far > jnp.maximum(near, 0)

    width, height = camera.size
    columns, rows = jnp.meshgrid(jnp.arange(width), jnp.arange(height))
    return jax.vmap(jax.vmap(hits))(columns, rows)


@jax.jit
def _passes(camera: Camera, space: Space, blocks: Bool[Array, "bx by bz"]) -> Bool[Array, "down across"]:
    """Whether the middle ray of each patch passes through one of the blocks."""

    def passes(column: Int[Array, ""], row: Int[Array, ""]) -> Bool[Array, ""]:
        middle = [SIDE * part.astype(camera.position.dtype) + (SIDE - 1) / 2 for part in (column, row)]
        line = camera.ray(*middle)
        entry, leave = space.interval(*line)
        entry = jnp.maximum(entry, 0)
        depths = entry + (leave - entry) * ((jnp.arange(POINTS, dtype=entry.dtype) + 0.5) / POINTS)

        def at(depth: Float[Array, ""]) -> Bool[Array, ""]:
            coordinate = space.coordinate(along(*line, depth))
            i, j, k = (
                jnp.clip(jnp.floor(c / BLOCK), 0, n - 1).astype(jnp.int32)
                for c, n in zip(coordinate, blocks.shape, strict=True)
            )
            return blocks[i, j, k]

        return (leave > entry) & jnp.any(jax.vmap(at)(depths))

    width, height = camera.size
    columns, rows = jnp.meshgrid(jnp.arange(-(-width // SIDE)), jnp.arange(-(-height // SIDE)))
    return jax.vmap(jax.vmap(passes))(columns, rows)


@jax.jit
def _rays(camera: Camera, columns: Int[Array, " rays"], rows: Int[Array, " rays"]) -> GivenRays:
    origins, directions = jax.vmap(camera.ray)(columns, rows)
    left, top = camera.first_pixel
    pixels = jnp.stack([columns + left, rows + top], axis=-1)
    return GivenRays(jnp.stack(origins, axis=-1), jnp.stack(directions, axis=-1), pixels)
