"""How is a tile drawn, and how far is the image from the converged one?"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from ..._util.srgb import to_srgb
from ...compositing.blending import Compositing
from ...metrics import rmse
from ...render import render
from ...scene.camera import Camera
from ...scene.volume import Volume
from .plot import Histogram
from .state import Choices, State
from .tiles import SIDE, Grid


Pixels = UInt8[np.ndarray, "height width 3"]
"""sRGB of a view or a part of it."""

LEFT_ORDER, OTHER_ORDER = 1, 2
"""With which power of the step the error of a march falls."""


@dataclass(frozen=True)
class Content:
    """What does not change while a volume is looked at.

    - `compositing`: how cells become a pixel. `background`: linear RGB.
    - `histogram`: of the volume.
    """

    volume: Volume
    choices: Choices
    compositing: Compositing[Any]
    background: tuple[float, float, float]
    histogram: Histogram


class Drawing:
    """One state of a viewer, ready to be drawn. `coarser`: how many times as long as the state's the steps
    are."""

    def __init__(self, content: Content, state: State, coarser: float = 1.0):
        self.content, self.state, self.coarser = content, state, coarser
        self.march = content.choices.march(state, coarser)
        self.lighting = content.choices.light(state)
        self.transfer = state.look.padded()

    @property
    def program(self) -> tuple[Any, ...]:
        """What another program must be compiled for."""
        leaves, structure = jax.tree.flatten(self.transfer)
        return self.state.on, self.state.lit, structure, *(leaf.shape for leaf in leaves)

    def tile(self, grid: Grid, column: int, row: int) -> Pixels:
        """The pixels of a tile."""
        rgba = self._rgba(grid, column, row)
        return np.asarray(_displayed(rgba, self._background))

    def image(self, grid: Grid) -> Pixels:
        """All tiles."""
        width, height = grid.size
        pixels = np.empty((grid.rows * SIDE, grid.columns * SIDE, 3), np.uint8)
        for column, row in grid.inside_out():
            pixels[place(column, row)] = self.tile(grid, column, row)
        return pixels[:height, :width]

    def error(self) -> Iterator[float | None]:
        """How far the image's linear colours are from the converged ones because of the step, as an RMSE: an
        estimate, from one tile stretched over the view, and the same with steps of twice the length. It comes
        last; None before, so that a drag need not wait for it.

        It takes the error to fall with the square of the step, and with the step under
        `quadrature="left"`; where steps are longer than what is seen, it falls by other amounts. What
        `EarlyTermination` adds is not in it."""
        whole, order = Grid(1, 1, (SIDE, SIDE)), LEFT_ORDER if self._left else OTHER_ORDER
        images = []
        for drawing in (self, Drawing(self.content, self.state, 2 * self.coarser)):
            rgba = np.asarray(drawing._rgba(whole, 0, 0))
            images.append(rgba[..., :3] + (1 - rgba[..., 3:]) * self._background)
            yield None
        yield float(rmse(*images)) / (2**order - 1)

    @property
    def _left(self) -> bool:
        return self.content.choices.quadrature == "left"

    @property
    def _background(self) -> Float[np.ndarray, "3"]:
        return np.asarray(self.content.background, np.float32)

    def camera(self, grid: Grid, column: int, row: int) -> Camera:
        """The camera of a tile."""
        width, height = self.state.size
        window = grid.window(column, row, width / height)
        return self.state.orbit.camera((SIDE, SIDE), window, (column * SIDE, row * SIDE))

    def _rgba(self, grid: Grid, column: int, row: int) -> Float[Array, "side side 4"]:
        camera = self.camera(grid, column, row)
        how = {"compositing": self.content.compositing, "lighting": self.lighting, "outputs": "rgba"}
        return render(self.content.volume, self.transfer, camera, self.march, **how).rgba


def place(column: int, row: int) -> tuple[slice, slice]:
    """Where the pixels of a tile lie in the image."""
    return slice(row * SIDE, (row + 1) * SIDE), slice(column * SIDE, (column + 1) * SIDE)


@jax.jit
def _displayed(rgba: Float[Array, "height width 4"], background: Float[Array, "3"]) -> UInt8[Array, "..."]:
    linear = rgba[..., :3] + (1 - rgba[..., 3:]) * background[None, None, :]
    return jnp.round(255 * to_srgb(linear)).astype(jnp.uint8)
