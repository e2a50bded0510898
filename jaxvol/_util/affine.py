"""Where grids lie: the spacing and directions of an affine map, cleaned of rounding."""

import numpy as np


ROUNDED, SHEARED = 1e-3, 1e-4
"""Greatest difference of a length from 1, and greatest cosine of a right angle: files round directions. A
smaller shear misplaces no voxel of 1000 by more than a tenth; a greater one is kept."""

FLAT = 1e-3
"""Three directions of length 1 whose determinant is not above this lie in a plane: no grid, but a mistake."""


def directions(what: str, columns: np.ndarray) -> np.ndarray:
    """The directions (columns) that a file holds, of length 1; orthonormal if they are so but for rounding.
    Raises `ValueError`, which begins with `what`, for other lengths, and for three in a plane."""
    lengths = np.linalg.norm(columns, axis=0)
    turn = columns / np.where(lengths > 0, lengths, 1)
    if not (np.all(np.abs(lengths - 1) <= ROUNDED) and abs(np.linalg.det(turn)) > FLAT):  # of NaN, too
        told = np.round(columns, 4).T.tolist()
        raise ValueError(f"{what} must be three directions of length 1, not all in a plane; got {told}.")
    if np.abs(turn.T @ turn - np.eye(3)).max() > SHEARED:
        return turn
    left, _, right = np.linalg.svd(turn)
    return left @ right
