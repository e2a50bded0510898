"""Directions of an affine map, cleaned of rounding."""

import numpy as np


ROUNDED, SHEARED = 1e-3, 1e-4
"""Tolerances of a length from 1, and of the cosine of a right angle: files round directions. Over 1000
voxels, a smaller shear moves no voxel by more than a tenth; a larger one is kept."""

FLAT = 1e-3
"""Determinant of three unit directions up to which they count as coplanar: no grid, but a mistake."""


def directions(subject: str, columns: np.ndarray) -> np.ndarray:
    """Unit directions (columns), made orthonormal unless sheared. Raises `ValueError` for other lengths."""
    lengths = np.linalg.norm(columns, axis=0)
    turn = columns / np.where(lengths > 0, lengths, 1)
    if not (np.all(np.abs(lengths - 1) <= ROUNDED) and abs(np.linalg.det(turn)) > FLAT):  # also for NaN
        got = np.round(columns, 4).T.tolist()
        raise ValueError(f"{subject} must be three directions of length 1, not all in a plane; got {got}.")
    if np.abs(turn.T @ turn - np.eye(3)).max() > SHEARED:
        return turn
    u, _, vt = np.linalg.svd(turn)
    return u @ vt
