"""How is an image drawn part by part, by one compiled program for any size of the view?

All parts are tiles of `SIDE` x `SIDE` rays. A coarse image is a few of them, stretched over the view, whose
pixels need not be square; a fine one has a tile's pixel for each of the view's.
"""

import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from ..._util.srgb import to_srgb
from ...metrics import rmse
from ...render import render
from .editing import padded
from .state import Scene, State


SIDE = 192
"""Rays along a side of a tile. Each tile finds out anew what is empty: at this size that takes less time than
its rays, and a drag waits for one tile at most."""

Pixels = UInt8[np.ndarray, "height width 3"]
"""sRGB of a view or a part of it."""


@dataclass(frozen=True)
class Grid:
    """Tiles that cover a view.

    - `columns`, `rows`: how many. `size`: (width, height), pixels of the image that they make together; those
      at the right and at the lower edge may reach past it.
    """

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

    def __len__(self) -> int:
        return self.columns * self.rows

    def center_first(self) -> list[tuple[int, int]]:
        """(column, row) of the tiles, those in the middle of the view first."""
        tiles = [(c, r) for r in range(self.rows) for c in range(self.columns)]
        middle = self.size[0] / SIDE / 2 - 0.5, self.size[1] / SIDE / 2 - 0.5
        return sorted(tiles, key=lambda tile: math.dist(tile, middle))

    def canvas(self, pixels: Pixels | None = None) -> Pixels:
        """An image that holds all tiles whole: of another image, each pixel the nearest one, or empty."""
        height, width = self.rows * SIDE, self.columns * SIDE
        if pixels is None:
            return np.empty((height, width, 3), np.uint8)
        rows, columns, _ = pixels.shape
        row = np.minimum(np.arange(height) * rows // self.size[1], rows - 1)
        column = np.minimum(np.arange(width) * columns // self.size[0], columns - 1)
        return pixels[row[:, None], column[None, :]]

    def window(self, column: int, row: int, aspect: float) -> tuple[float, float, float, float]:
        """The part of the image plane that a tile shows, as `Camera.window`. `aspect`: width over height of
        the view."""
        width, height = self.size
        x, y = 2 * aspect * SIDE / width, 2 * SIDE / height
        return column * x - aspect, (column + 1) * x - aspect, 1 - (row + 1) * y, 1 - row * y


class TileRenderer:
    """Draws tiles of one state of a viewer, with steps that are `step_factor` times as long."""

    def __init__(self, scene: Scene, state: State, step_factor: float = 1.0):
        self.scene, self.state = scene, state
        self.march = scene.march(state, step_factor)
        self.lighting = scene.light(state)
        self.transfer = padded(state.transfer)
        self.background = np.asarray(scene.background, np.float32)

    @property
    def program_key(self) -> tuple[Any, ...]:
        """Equal for states that one compiled program draws."""
        leaves, structure = jax.tree.flatten(self.transfer)
        return self.state.enabled, self.state.lit, structure, *(leaf.shape for leaf in leaves)

    def draw(self, pixels: Pixels, grid: Grid, column: int, row: int) -> None:
        """Draw a tile into its place in a `Grid.canvas`."""
        drawn = np.asarray(_displayed(self.rgba(grid, column, row), self.background))
        pixels[row * SIDE : (row + 1) * SIDE, column * SIDE : (column + 1) * SIDE] = drawn

    def image(self, grid: Grid) -> Pixels:
        """All tiles."""
        width, height = grid.size
        pixels = grid.canvas()
        for column, row in grid.center_first():
            self.draw(pixels, grid, column, row)
        return pixels[:height, :width]

    def overview(self) -> Float[np.ndarray, "side side 3"]:
        """Linear colours of one tile that is stretched over the view."""
        rgba = np.asarray(self.rgba(Grid.coarse(self.state.size, 1), 0, 0))
        return rgba[..., :3] + (1 - rgba[..., 3:]) * self.background

    def rgba(self, grid: Grid, column: int, row: int) -> Float[Array, "side side 4"]:
        """A tile as `render` returns it."""
        width, height = self.state.size
        window, corner = grid.window(column, row, width / height), (column * SIDE, row * SIDE)
        camera = self.state.orbit.camera((SIDE, SIDE), window, corner)
        how = {"compositing": self.scene.compositing, "lighting": self.lighting, "outputs": "rgba"}
        return render(self.scene.volume, self.transfer, camera, self.march, **how).rgba


def estimated_error(
    image: Float[np.ndarray, "side side 3"], doubled: Float[np.ndarray, "side side 3"], quadrature: str
) -> float:
    """RMSE of linear colours because of the step, estimated from an image and the same with steps of twice
    the length: the error is taken to fall with the square of the step, or with the step under "left"."""
    return float(rmse(image, doubled)) / (1 if quadrature == "left" else 3)


@jax.jit
def _displayed(rgba: Float[Array, "height width 4"], background: Float[Array, "3"]) -> UInt8[Array, "..."]:
    linear = rgba[..., :3] + (1 - rgba[..., 3:]) * background[None, None, :]
    return jnp.round(255 * to_srgb(linear)).astype(jnp.uint8)
