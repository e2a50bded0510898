"""Draws a view of any size by one program, in tiles of `SIDE` x `SIDE` rays: a coarse image is a few of them,
stretched; a fine one has a tile's pixel for each of the view's."""

import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8
from PIL import Image

from ..._util.srgb import to_srgb
from ...metrics import rmse
from ...render import render
from ...scene.camera import Camera
from ...scene.rendering import Rendering
from ...scene.several import with_others
from ...scene.transfer import with_shared_points
from .state import PROGRAM, Scene, State


SIDE = 128
"""Rays along a side of a tile: finding empty space takes less time than these, and a drag waits for few."""

Pixels = UInt8[np.ndarray, "height width 3"]  # sRGB


@dataclass(frozen=True)
class Grid:
    """Tiles that cover a view, of a `size` in pixels, which those at the right and lower edge may exceed."""

    columns: int
    rows: int
    size: tuple[int, int]

    @classmethod
    def fine(cls, size: tuple[int, int]) -> "Grid":
        """A pixel of the image for each of a view of this size."""
        width, height = size
        return cls(-(-width // SIDE), -(-height // SIDE), size)

    @classmethod
    def coarse(cls, size: tuple[int, int], most: int) -> "Grid":
        """At most so many tiles, so that the larger side of a pixel is as small as may be."""
        width, height = size
        shapes = [(c, r) for c in range(1, most + 1) for r in range(1, most // c + 1)]
        columns, rows = min(shapes, key=lambda s: (max(width / s[0], height / s[1]), s[0] * s[1]))
        return cls(columns, rows, (columns * SIDE, rows * SIDE))

    def tiles(self) -> list[tuple[int, int]]:
        """(column, row) of the tiles, those in the middle of the view first."""
        tiles = [(c, r) for r in range(self.rows) for c in range(self.columns)]
        middle = self.size[0] / SIDE / 2 - 0.5, self.size[1] / SIDE / 2 - 0.5
        return sorted(tiles, key=lambda tile: math.dist(tile, middle))

    def empty(self) -> Pixels:
        """An image that holds all tiles whole."""
        return np.empty((self.rows * SIDE, self.columns * SIDE, 3), np.uint8)

    def canvas(self, pixels: Pixels) -> Pixels:
        """An image of whole tiles, filled with another one, stretched smoothly."""
        width, height = self.size
        stretched = np.asarray(Image.fromarray(pixels).resize(self.size, Image.Resampling.BILINEAR))
        beyond = (0, self.rows * SIDE - height), (0, self.columns * SIDE - width), (0, 0)
        return np.pad(stretched, beyond, "edge")

    def window(self, column: int, row: int, aspect: float) -> tuple[float, float, float, float]:
        """A tile's part of the image plane, as `Camera.window`. `aspect`: width over height of the view."""
        width, height = self.size
        x, y = 2 * aspect * SIDE / width, 2 * SIDE / height
        return column * x - aspect, (column + 1) * x - aspect, 1 - (row + 1) * y, 1 - row * y


class TileRenderer:
    """Draws tiles of one state of a viewer, with steps that are `step_factor` times as long."""

    def __init__(self, scene: Scene, state: State, step_factor: float = 1.0):
        self.scene, self.volume, self.state = scene, scene.volume, state
        self.march = scene.march(state, step_factor)
        self.transfer = state.transfer
        self.others = scene.others
        self.background = np.asarray(state.background, np.float32)
        self.how = {"compositing": scene.compositing(state), "lighting": scene.light(state)}

    @property
    def program_key(self) -> tuple[Any, ...]:
        """Equal for states that one compiled program draws."""
        leaves, structure = jax.tree.flatten(with_shared_points(self.transfer))
        return *(getattr(self.state, name) for name in PROGRAM), structure, *map(np.shape, leaves)

    def camera(self, window: object, corner: object = None) -> Camera:
        """That of a tile."""
        return self.scene.camera(self.state, (SIDE, SIDE), window, corner)

    def rendered(self, camera: Camera) -> Rendering:
        """What `render` returns for a camera of a tile's size."""
        return render(*with_others(self.volume, self.transfer, self.others), camera, self.march, **self.how)

    def rgba(self, grid: Grid, column: int, row: int) -> Float[Array, "side side 4"]:
        """A tile as `render` returns it."""
        width, height = self.state.size
        window, corner = grid.window(column, row, width / height), (column * SIDE, row * SIDE)
        return self.rendered(self.camera(window, corner)).rgba

    def draw(self, pixels: Pixels, grid: Grid, column: int, row: int) -> None:
        """Draw a tile into its place in an image that holds all tiles whole."""
        drawn = np.asarray(_displayed(self.rgba(grid, column, row), self.background))
        pixels[row * SIDE : (row + 1) * SIDE, column * SIDE : (column + 1) * SIDE] = drawn

    def coarse(self, most: int) -> Pixels:
        """An image of at most so many tiles."""
        grid = Grid.coarse(self.state.size, most)
        pixels = grid.empty()
        for column, row in grid.tiles():
            self.draw(pixels, grid, column, row)
        return pixels

    def overview(self) -> Float[np.ndarray, "side side 3"]:
        """Linear colours of one tile that is stretched over the view."""
        rgba = np.asarray(self.rgba(Grid.coarse(self.state.size, 1), 0, 0))
        return rgba[..., :3] + (1 - rgba[..., 3:]) * self.background

    def picked(self, across: float, down: float) -> Float[np.ndarray, "3"] | None:
        """World point seen at a fraction of width and height, at the mean depth; None where nothing is."""
        (width, height), least = self.state.size, 1e-3
        x, y = (2 * across - 1) * width / height, 1 - 2 * down
        camera = self.camera((x - least, x + least, y - least, y + least))
        depth = self.rendered(camera).details.depth
        found = np.inf if depth is None else float(np.asarray(depth)[SIDE // 2, SIDE // 2])
        point = camera.point(SIDE // 2, SIDE // 2, found) if np.isfinite(found) else None
        return None if point is None else np.asarray(point, np.float64)


def estimated_error(
    image: Float[np.ndarray, "side side 3"], doubled: Float[np.ndarray, "side side 3"], quadrature: str
) -> float:
    """RMSE due to the step, by an image of twice the step: of order 2, or 1 under "left"."""
    return float(rmse(image, doubled)) / (1 if quadrature == "left" else 3)


@jax.jit
def _displayed(rgba: Float[Array, "height width 4"], background: Float[Array, "3"]) -> UInt8[Array, "..."]:
    linear = rgba[..., :3] + (1 - rgba[..., 3:]) * background[None, None, :]
    return jnp.round(255 * to_srgb(linear)).astype(jnp.uint8)
