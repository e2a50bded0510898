"""How well does a fitted model agree with views that it was not fitted to, and how sure are differences?

Noise enters a held-out loss L = |r|² / 2 through every pixel. Of two models, the noise is the same: with r
the residual of one and r + δ that of the other, the losses differ by |δ|² / 2 + r · δ, where δ, the
difference of the two images, is free of noise. Only r · δ is uncertain. If r is noise of mean 0, its standard
error is √ Σ (r · δ)², summed over blocks between which the noise is independent, whatever its variance; or
√ (mean r² |δ|²), if it is independent and of equal variance in all entries. The first is known badly if δ
is confined to few blocks, the second is wrong where variances differ: the larger one is used. So a model that
is wrong in a few pixels only is recognised, and where nothing is noisy, nothing is uncertain. The scatter of
the differences of squares would be a larger error, since δ is not the same in all pixels.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Float64, Int

from ..scene.camera import Camera
from ..xla.trees import PyTree
from .residuals import ImageResidual, OwnResidual, Residual, Tiles, check_residual


class ModelResidual(Residual):
    """A residual, as one of the parameters of a model."""

    residual: Residual
    expand: Callable[[PyTree], PyTree]

    def tiles(self, most: int) -> list[Tiles]:
        def of_model(tiles: Tiles) -> Tiles:
            return tiles._replace(
                residual=lambda parameters, *rest: tiles.residual(self.expand(parameters), *rest)
            )

        return [of_model(tiles) for tiles in self.residual.tiles(most)]

    def count(self) -> int:
        return self.residual.count()

    def scale(self) -> float:
        return self.residual.scale()


def as_residual(residual: Any, parameters: PyTree) -> Residual:
    """A residual, or a function from parameters like these that is one."""
    check_residual(residual)
    return residual if isinstance(residual, Residual) else OwnResidual.of(residual, parameters)


class HeldOut:
    """Residuals of held-out views, one for each, evaluated together: the loss is the mean of the views'.

    - `block`: pixels along a side of the blocks of images, within which noise may be correlated; all channels
      of a pixel are in one. An entry of any other residual is a block of its own.
    """

    def __init__(self, residuals: Sequence[Residual], block: int):
        self.residuals = residuals
        first, found = 0, list[np.ndarray]()
        for residual in self.residuals:
            for shape in _shapes(residual):
                of_entries = _blocks(shape, block) if len(shape) == 3 else np.arange(shape[0])
                found.append(of_entries + first)
                first += int(of_entries.max()) + 1
        self.block_of_entry, self.blocks = np.concatenate(found), first

    def residual(
        self, parameters: PyTree, expand: Callable[[PyTree], PyTree]
    ) -> Float64[np.ndarray, " entries"]:
        """Residual of all views, with the sum of squares that is the mean over views."""
        of_views = [_entries(ModelResidual(each, expand), parameters) for each in self.residuals]
        entries = [np.asarray(part, np.float64).reshape(-1) for parts in of_views for part in parts]
        return np.concatenate(entries) / math.sqrt(len(self.residuals))

    def loss(self, residual: Float64[np.ndarray, " entries"]) -> tuple[float, float]:
        """Its loss, and the standard error of that: from the variation between blocks."""
        squares = self._sums(residual**2 / 2)
        return float(squares.sum()), math.sqrt(self.blocks) * float(np.std(squares, ddof=1))

    def excess(
        self, residual: Float64[np.ndarray, " entries"], best: Float64[np.ndarray, " entries"]
    ) -> tuple[float, float]:
        """By how much its loss exceeds that of the best one, and the standard error of the difference."""
        change = residual - best
        uncertain, square = self._sums(best * change), float(np.sum(change**2))
        variance = max(float(np.sum(uncertain**2)), float(np.mean(best**2)) * square)
        return square / 2 + float(uncertain.sum()), math.sqrt(variance)

    def _sums(self, entries: Float64[np.ndarray, " entries"]) -> Float64[np.ndarray, " blocks"]:
        return np.bincount(self.block_of_entry, entries)


@eqx.filter_jit
def _entries(residual: Residual, parameters: PyTree) -> list[Float[Array, "items entries"]]:
    """Entries of a residual, for each kind of tile."""
    return [
        jax.lax.map(lambda item, tiles=tiles: tiles.residual(parameters, item, "replay"), tiles.items)
        for tiles in residual.tiles(residual.count())
    ]


def _shapes(residual: Residual) -> list[tuple[int, ...]]:
    """Of its images; or its number of entries."""
    if not isinstance(residual, ImageResidual):
        return [(residual.count(),)]
    return [shape for group in residual.groups for shape in [group.images.shape[1:]] * len(group.images)]


def _blocks(shape: tuple[int, ...], block: int) -> Int[np.ndarray, " entries"]:
    """Index of the block of each entry of an image."""
    height, width, channels = shape
    rows, columns = np.arange(height) // block, np.arange(width) // block
    return np.repeat((rows[:, None] * math.ceil(width / block) + columns).reshape(-1), channels)


def data_norm(residuals: Sequence[Residual]) -> float:
    """Norm of the data that residuals compare with, root mean square over residuals; 0 if unknown."""
    return math.sqrt(sum(residual.scale() ** 2 for residual in residuals) / len(residuals))


def cameras_of(residual: ImageResidual) -> list[Camera]:
    """Cameras of all views of a residual."""
    return [
        jax.tree.map(lambda leaf, view=view: leaf[view], group.cameras)
        for group in residual.groups
        for view in range(len(group.images))
    ]


def check_apart(training: Sequence[Any], held_out: Sequence[Any]) -> None:
    """Raise `ValueError` if a held-out view is a training view. Of pairs (camera, image), cameras are
    compared: another picture by the same camera tells nothing of other views."""
    for number, view in enumerate(held_out):
        for other, fitted in enumerate(training):
            if eqx.tree_equal(_camera(view), _camera(fitted)):
                raise ValueError(
                    f"held_out[{number}] must not be among the views that are fitted; it is the same as "
                    f"number {other} of these. Hold out views of other cameras."
                )


def _camera(view: Any) -> Any:
    """The camera of a pair (camera, image), or any other view itself."""
    return view[0] if isinstance(view, tuple | list) and view and isinstance(view[0], Camera) else view
