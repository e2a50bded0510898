"""How far is an image from the converged one, and what does it cost? Found out from a part of its pixels."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..camera import Camera
from ..compositing import Compositing
from ..engine.driver import render_scene
from ..engine.rays import OwnRays
from ..engine.scene import Scene
from ..lighting.shading import Lighting
from ..march import March
from ..rendering import Rendering
from ..space import Space
from ..transfer import Transfer
from ..volume import Volume


SIDE = 8
"""Pixels along the side of a patch. The engine bounds empty space for beams of as many, so that a patch takes
the samples that it takes in the whole image."""

PATCHES = 128
"""Patches that are rendered: a thirty-second of 512 x 512 pixels."""

CONFIDENT = 1.645
"""Standard errors above the mean: 95 % of estimates from a part of the image are not too low."""


class Setting(NamedTuple):
    """A scene without its camera."""

    volume: Volume
    transfer: Transfer
    compositing: Compositing[Any]


class Probe(NamedTuple):
    """Patches of an image, spread evenly over those that may show anything.

    - `source`: their rays, patch by patch.
    - `patches`: number of patches in the image that may show something; `pixels`: of the whole image.
    """

    source: OwnRays
    patches: int
    pixels: int

    @classmethod
    def of(cls, camera: Camera, space: Space, seed: int) -> "Probe":
        """Some patches of a camera's image; all, if they are few. Without any ray that meets the volume,
        the first one."""
        (width, height), number = camera.size, SIDE**2
        across, down = -(-width // SIDE), -(-height // SIDE)
        hit = np.asarray(_hits(camera, space))
        hit = np.pad(hit, ((0, down * SIDE - height), (0, across * SIDE - width)))
        seen = hit.reshape(down, SIDE, across, SIDE).any(axis=(1, 3)).reshape(-1)
        candidates = np.flatnonzero(seen) if seen.any() else np.zeros(1, int)
        count = min(PATCHES, candidates.size)
        # one from each of equally many neighbours
        part = np.random.default_rng(seed).random(count)
        chosen = candidates[((np.arange(count) + part) * candidates.size / count).astype(int)]
        # a fixed number of rays, so that images of all sizes share a program; what is added is not counted
        chosen = np.pad(chosen, (0, PATCHES - count), mode="edge")
        y, x = np.divmod(np.arange(number), SIDE)
        # past the image's edge, its last pixels
        column = np.minimum((chosen % across)[:, None] * SIDE + x, width - 1).reshape(-1)
        row = np.minimum((chosen // across)[:, None] * SIDE + y, height - 1).reshape(-1)
        source = _rays(camera, jnp.asarray(column, jnp.int32), jnp.asarray(row, jnp.int32))
        return cls(source, int(seen.sum()), width * height)

    @property
    def used(self) -> int:
        """Number of different patches."""
        return max(min(PATCHES, self.patches), 1)

    @property
    def share(self) -> float:
        """Part of the image's pixels that may show anything."""
        return min(self.patches * SIDE**2 / self.pixels, 1.0)

    def render(self, setting: Setting, march: March, lighting: Lighting | None = None) -> Rendering:
        """These pixels of the image."""
        volume, transfer, compositing = setting
        scene = Scene(volume, transfer, self.source, march, compositing, lighting)
        return render_scene(scene, "all", "replay")

    def by_patch(self, of_pixels: Any) -> Float[np.ndarray, "patches pixels"]:
        """A number of each pixel, by patch, without those that are there twice."""
        return np.asarray(of_pixels, np.float64).reshape(PATCHES, -1)[: self.used]

    def distance(self, image: Rendering, other: Rendering) -> float:
        """Root mean square difference of both images' colours, over the whole image: over black or over
        white, whichever is greater. A bound that is exceeded in one of twenty cases, since only a part of the
        pixels is known."""
        a, b = (np.asarray(each.rgba, np.float64) for each in (image, other))
        color, opacity = a[:, :3] - b[:, :3], a[:, 3:] - b[:, 3:]
        squares = [np.mean(each**2, axis=-1) for each in (color, color - opacity)]
        return float(np.sqrt(max(self._bound(self.by_patch(square)) for square in squares)))

    def _bound(self, square: Float[np.ndarray, "patches pixels"]) -> float:
        """Of the mean over the whole image, from that of these patches."""
        each, unseen = square.mean(axis=1), 1 - self.used / max(self.patches, 1)
        error = each.std(ddof=1) / np.sqrt(self.used) if self.used > 1 else 0.0
        return float((each.mean() + CONFIDENT * error * np.sqrt(max(unseen, 0.0))) * self.share)

    def samples(self, image: Rendering) -> float:
        """Mean number of samples of a pixel, over the whole image."""
        return float(self.by_patch(image.samples).mean() * self.share)

    def part(self, of_pixels: Bool[Array, " rays"]) -> float:
        """Part of the image's pixels of which this is true."""
        return float(self.by_patch(of_pixels).mean() * self.share)


class Truth(NamedTuple):
    """What images are compared with.

    - `image`: the most accurate one.
    - `own`: its own error, as the last halvings of the step let expect.
    """

    probe: Probe
    image: Rendering
    own: float

    @classmethod
    def of(cls, probe: Probe, images: list[Rendering]) -> "Truth":
        """The last of at least three images, each with half the step of the one before."""
        before, last = (probe.distance(a, b) for a, b in zip(images[-3:-1], images[-2:], strict=True))
        # by a quarter for each halving where the order is 2; never taken to be faster, nor to stand still
        ratio = min(max(last / before if before > 0 else 0.0, 0.25), 0.7)
        return cls(probe, images[-1], last * ratio / (1 - ratio))

    def error(self, image: Rendering) -> float:
        """Of another image; infinite if it is not finite."""
        found = self.probe.distance(image, self.image) + self.own
        return found if np.isfinite(found) else np.inf


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
def _rays(camera: Camera, columns: Int[Array, " rays"], rows: Int[Array, " rays"]) -> OwnRays:
    origins, directions = jax.vmap(camera.ray)(columns, rows)
    left, top = camera.first_pixel
    pixels = jnp.stack([columns + left, rows + top], axis=-1)
    return OwnRays(jnp.stack(origins, axis=-1), jnp.stack(directions, axis=-1), pixels)
