"""Into which parts is a view divided, so that one compiled program draws an image of any size?

All parts are tiles of `SIDE` x `SIDE` rays. A coarse image is a few of them, stretched over the view, whose
pixels need not be square; a fine one has a tile's pixel for each of the view's.
"""

import math
from dataclasses import dataclass


SIDE = 192
"""Rays along a side of a tile. Finding out what is empty, which each tile does anew, then takes less time
than the rays; and a drag waits for one tile at most."""


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

    def inside_out(self) -> list[tuple[int, int]]:
        """(column, row) of the tiles, those in the middle of the view first."""
        every = [(c, r) for r in range(self.rows) for c in range(self.columns)]
        middle = self.size[0] / SIDE / 2 - 0.5, self.size[1] / SIDE / 2 - 0.5
        return sorted(every, key=lambda tile: math.dist(tile, middle))

    def window(self, column: int, row: int, aspect: float) -> tuple[float, float, float, float]:
        """The part of the image plane that a tile shows, as `Camera.window`. `aspect`: width over height of
        the view."""
        width, height = self.size
        x, y = (2 * aspect * SIDE / width, 2 * SIDE / height)
        return (column * x - aspect, (column + 1) * x - aspect, 1 - (row + 1) * y, 1 - row * y)
