"""Counts of leaps and samples of single rays, by a distance map of voxels and by a minimum-distance grid.

As the program of Chae and Shin marches: each ray by itself, with Euclidean distances between voxels, found
before the image, and early ends. A look-up of the map in an empty cell of the volume is a leap, by as many
steps as the distance proves empty, but at least by one; anything else is a sample. Corner rays of the grid
are not marched twice. In NumPy, independent of the engine, whose rays leap side by side.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt, map_coordinates

import jaxvol as jv

from .scenes import Scene


LEFT = 1 / 255
"""Transmittance at which rays end."""


class Counts(NamedTuple):
    """What each ray takes, (height, width): leaps, samples, and the index of the step at its first visible
    sample, or that at the exit."""

    leaps: Int[np.ndarray, "height width"]
    samples: Int[np.ndarray, "height width"]
    hit: Int[np.ndarray, "height width"]
    exit: Int[np.ndarray, "height width"]


class Marcher:
    """Marches the rays of a scene, whose volume's axes are those of the world. Steps are counted from the
    entry."""

    def __init__(self, scene: Scene):
        volume, self.step = scene.volume, scene.step
        self.data = np.asarray(volume.data, np.float32)
        self.spacing, self.origin = np.asarray(volume.spacing, float), np.asarray(volume.origin, float)
        self.values = np.asarray(scene.transfer.values, float)
        self.extinctions = np.asarray(scene.transfer.extinction, float)
        self.empty = ~self.occupied()
        # two points of two cells are at most a diagonal nearer than the centres of these
        apart = np.asarray(distance_transform_edt(self.empty, sampling=self.spacing))
        self.leap = np.maximum((apart - np.linalg.norm(self.spacing)) / self.step, 1).astype(int)

    def extinction(self, values: np.ndarray) -> np.ndarray:
        return np.interp(values, self.values, self.extinctions)

    def occupied(self) -> Bool[np.ndarray, "x y z"]:
        """Cells in which a value between the least and the greatest node is visible."""
        low = high = self.data
        for axis in range(3):
            low = np.minimum(np.delete(low, -1, axis), np.delete(low, 0, axis))
            high = np.maximum(np.delete(high, -1, axis), np.delete(high, 0, axis))
        visible = np.append(0, np.cumsum(self.extinctions > 0))  # control points up to an index
        first, last = np.searchsorted(self.values, low), np.searchsorted(self.values, high, "right")
        return (visible[last] > visible[first]) | (self.extinction(low) > 0) | (self.extinction(high) > 0)

    def rays(self, camera: jv.Camera) -> tuple[np.ndarray, np.ndarray, Int[np.ndarray, "rays"]]:
        """Entries and directions in grid coordinates for a step, (rays, 3), and numbers of steps."""
        origin, direction = (np.asarray(part, float).reshape(-1, 3) for part in camera.rays())
        ends = self.origin, self.origin + self.spacing * (np.asarray(self.data.shape) - 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            planes = np.stack([(end - origin) / direction for end in ends])
        near, far = np.maximum(planes.min(0).max(-1), 0), planes.max(0).min(-1)
        start = (origin + near[:, None] * direction - self.origin) / self.spacing
        steps = np.ceil(np.maximum(far - near, 0) / self.step).astype(int)
        return start, direction * self.step / self.spacing, steps

    def count(self, camera: jv.Camera, start: Int[np.ndarray, "height width"] | int = 0) -> Counts:
        """Counts of rays that begin at these steps."""
        entry, rate, steps = self.rays(camera)
        index = np.minimum(np.broadcast_to(start, camera.size[::-1]).reshape(-1), steps)
        leaps, samples, hit = np.zeros_like(index), np.zeros_like(index), steps.copy()
        depth, alive = np.zeros(len(index)), np.flatnonzero(index < steps)
        most = np.asarray(self.empty.shape) - 1
        while len(alive):
            place = entry[alive] + index[alive, None] * rate[alive]
            cell = tuple(np.clip(place.astype(int), 0, most).T)
            empty = self.empty[cell]
            leaps[alive] += empty
            samples[alive] += ~empty
            index[alive] += np.where(empty, self.leap[cell], 1)
            here = alive[~empty]
            values = map_coordinates(self.data, place[~empty].T, order=1, mode="nearest")
            extinction = self.extinction(values)
            first = here[(extinction > 0) & (hit[here] == steps[here])]
            hit[first] = index[first] - 1
            depth[here] += extinction * self.step
            alive = alive[(index[alive] < steps[alive]) & (depth[alive] < -np.log(LEFT))]
        return Counts(*(each.reshape(camera.size[::-1]) for each in (leaps, samples, hit, steps)))

    def slopes(
        self, camera: jv.Camera, hit: Int[np.ndarray, "height width"]
    ) -> Float[np.ndarray, "height width"]:
        """Angle between each ray and the surface where it is hit, degrees: 0 along it, 90 head-on."""
        entry, rate, _ = self.rays(camera)
        place = entry + hit.reshape(-1, 1) * rate
        ahead, behind = (
            [map_coordinates(self.data, (place + s * axis).T, order=1, mode="nearest") for axis in np.eye(3)]
            for s in (1, -1)
        )
        normal = (np.array(ahead) - behind).T / self.spacing
        way = rate * self.spacing
        sine = np.abs(np.sum(normal * way, -1)) / np.linalg.norm(way, axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            sine = sine / np.linalg.norm(normal, axis=-1)
        return np.degrees(np.arcsin(np.clip(sine, 0, 1))).reshape(hit.shape)


class Grid(NamedTuple):
    """Starts by a grid of square cells of pixels, (height, width).

    Attributes:
        start: step at which each ray begins: 0 at the corners.
        spread: of the hits at the corners of a pixel's cell, how much nearer the nearest is than the
            farthest, relative to that.
    """

    start: Int[np.ndarray, "height width"]
    spread: Float[np.ndarray, "height width"]


def grid_of(hit: Int[np.ndarray, "height width"], side: int) -> Grid:
    """A grid of cells of `side` x `side` pixels, from the first hits of all rays, of which it takes those of
    the corners. Corners beyond the image are moved to its edge."""
    rows, columns = (np.minimum(np.arange(-(-n // side) + 1) * side, n - 1) for n in hit.shape)
    known = hit[np.ix_(rows, columns)]
    four = np.stack([known[:-1, :-1], known[1:, :-1], known[:-1, 1:], known[1:, 1:]])
    near, far = (
        np.kron(end, np.ones((side, side), int))[: hit.shape[0], : hit.shape[1]]
        for end in (four.min(0), four.max(0))
    )
    start = near.copy()
    start[np.ix_(rows, columns)] = 0
    return Grid(start, 1 - near / np.maximum(far, 1))


class Saved(NamedTuple):
    """What a grid saves of all leaps, and of leaps and samples together, as parts of these; and the part of
    the rays that begin behind their first visible sample."""

    leaps: float
    both: float
    late: float

    @classmethod
    def of(cls, alone: Counts, started: Counts, grid: Grid) -> "Saved":
        leaps, samples = alone.leaps.sum(), alone.samples.sum()
        return cls(
            1 - float(started.leaps.sum() / leaps),
            1 - float((started.leaps.sum() + started.samples.sum()) / (leaps + samples)),
            float(np.mean(grid.start > alone.hit)),
        )
