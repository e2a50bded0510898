"""Draws a view of any size with one program, in tiles of `SIDE` x `SIDE` rays: a coarse image is a few
stretched tiles; a fine image has one ray per pixel."""

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
from .state import PROGRAM, State, ViewerSetup


SIDE = 128  # rays along a side of a tile: many beside the search for empty space, few for a drag
Pixels = UInt8[np.ndarray, "height width 3"]  # sRGB


@dataclass(frozen=True)
class Grid:
    """Tiles that cover a view of `size` pixels; those at the right and lower edges may exceed it."""

    columns: int
    rows: int
    size: tuple[int, int]

    @classmethod
    def fine(cls, size: tuple[int, int]) -> "Grid":
        """The grid of a fine image, with one ray for each pixel of the view."""
        width, height = size
        return cls(-(-width // SIDE), -(-height // SIDE), size)

    @classmethod
    def coarse(cls, size: tuple[int, int], max_tiles: int) -> "Grid":
        """The grid of at most `max_tiles` tiles whose stretched pixels have the smallest larger side."""
        width, height = size
        shapes = [(c, r) for c in range(1, max_tiles + 1) for r in range(1, max_tiles // c + 1)]
        columns, rows = min(shapes, key=lambda s: (max(width / s[0], height / s[1]), s[0] * s[1]))
        return cls(columns, rows, (columns * SIDE, rows * SIDE))

    def tiles(self) -> list[tuple[int, int]]:
        """(column, row) of the tiles, from the middle of the view outwards."""
        tiles = [(c, r) for r in range(self.rows) for c in range(self.columns)]
        middle = self.size[0] / SIDE / 2 - 0.5, self.size[1] / SIDE / 2 - 0.5
        return sorted(tiles, key=lambda tile: math.dist(tile, middle))

    def empty(self) -> Pixels:
        """An uninitialized image of all tiles."""
        return np.empty((self.rows * SIDE, self.columns * SIDE, 3), np.uint8)

    def canvas(self, pixels: Pixels) -> Pixels:
        """An image of all tiles, filled with a smoothly stretched one."""
        width, height = self.size
        stretched = np.asarray(Image.fromarray(pixels).resize(self.size, Image.Resampling.BILINEAR))
        beyond = (0, self.rows * SIDE - height), (0, self.columns * SIDE - width), (0, 0)
        return np.pad(stretched, beyond, "edge")

    def window(self, column: int, row: int, aspect: float) -> tuple[float, float, float, float]:
        """The `Camera.window` of a tile. `aspect`: width over height of the view."""
        width, height = self.size
        x, y = 2 * aspect * SIDE / width, 2 * SIDE / height
        return column * x - aspect, (column + 1) * x - aspect, 1 - (row + 1) * y, 1 - row * y


class TileRenderer:
    """Draws tiles of one state of a viewer, with `step_factor` times its step."""

    def __init__(self, scene: ViewerSetup, state: State, step_factor: float = 1.0):
        self.scene, self.state = scene, state
        self.march = scene.march(state, step_factor)
        self.background = np.asarray(state.background, np.float32)
        self.mode, self.light = scene.compositing(state), scene.light(state)

    @property
    def program_key(self) -> tuple[Any, ...]:
        """Key of the compiled program: equal for states that share one."""
        leaves, structure = jax.tree.flatten(with_shared_points(self.state.transfer))
        return *(getattr(self.state, name) for name in PROGRAM), structure, *map(np.shape, leaves)

    def camera(self, window: object, corner: object = None) -> Camera:
        """The camera of a tile."""
        return self.scene.camera(self.state, (SIDE, SIDE), window, corner)

    def rendered(self, camera: Camera) -> Rendering:
        """Render with a camera of a tile's size."""
        pair = with_others(self.scene.volume, self.state.transfer, self.scene.extra_pairs)
        return render(*pair, camera, self.march, compositing=self.mode, lighting=self.light)

    def rgba(self, grid: Grid, column: int, row: int) -> Float[Array, "side side 4"]:
        """Render a tile."""
        width, height = self.state.size
        window, corner = grid.window(column, row, width / height), (column * SIDE, row * SIDE)
        return self.rendered(self.camera(window, corner)).rgba

    def draw(self, pixels: Pixels, grid: Grid, column: int, row: int) -> None:
        """Draw a tile into an image of all tiles."""
        drawn = np.asarray(_displayed(self.rgba(grid, column, row), self.background))
        pixels[row * SIDE : (row + 1) * SIDE, column * SIDE : (column + 1) * SIDE] = drawn

    def coarse(self, max_tiles: int) -> Pixels:
        """An image of at most `max_tiles` tiles."""
        grid = Grid.coarse(self.state.size, max_tiles)
        pixels = grid.empty()
        for column, row in grid.tiles():
            self.draw(pixels, grid, column, row)
        return pixels

    def overview(self) -> Float[np.ndarray, "side side 3"]:
        """Linear colours of one tile over the whole view."""
        rgba = np.asarray(self.rgba(Grid.coarse(self.state.size, 1), 0, 0))
        return rgba[..., :3] + (1 - rgba[..., 3:]) * self.background

    def picked(self, across: float, down: float) -> Float[np.ndarray, "3"] | None:
        """World point at a fraction of width and height, at the mean depth; None if nothing is visible."""
        (width, height), margin, middle = self.state.size, 1e-3, SIDE // 2
        x, y = (2 * across - 1) * width / height, 1 - 2 * down
        camera = self.camera((x - margin, x + margin, y - margin, y + margin))
        depths = self.rendered(camera).details.depth
        depth = np.inf if depths is None else float(np.asarray(depths)[middle, middle])
        return np.asarray(camera.point(middle, middle, depth), np.float64) if np.isfinite(depth) else None


def estimated_error(
    image: Float[np.ndarray, "side side 3"], doubled: Float[np.ndarray, "side side 3"], quadrature: str
) -> float:
    """RMSE due to the step, from an image of twice the step. The order is 2; under "left" 1."""
    return float(rmse(image, doubled)) / (1 if quadrature == "left" else 3)


@jax.jit
def _displayed(rgba: Float[Array, "height width 4"], background: Float[Array, "3"]) -> UInt8[Array, "..."]:
    linear = rgba[..., :3] + (1 - rgba[..., 3:]) * background[None, None, :]
    return jnp.round(255 * to_srgb(linear)).astype(jnp.uint8)
