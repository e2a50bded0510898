"""Brings voxels along the axes of the world, as far as exchanging and reversing axes does it."""

import itertools
from typing import Any

import numpy as np


ALONG_AXES = 1e-5
"""Greatest entry by which directions may differ from the world's axes to count as these: it misplaces no
voxel of 1000 by more than a hundredth. NIfTI's own rounding is smaller."""

ROUNDED = 1e-3
"""Greatest cosine between the directions of two axes that counts as a right angle, and greatest difference of
a squared length from 1: files hold directions of a few decimal places."""


def orthonormal(what: str, direction: Any) -> np.ndarray:
    """The orthonormal directions (columns) nearest to those of a file, which are rounded there. A third
    column is made where there are two.

    **Raises:** `ValueError`, which begins with `what`, if they are farther from that than by rounding."""
    columns = np.asarray(direction, float)
    lengths = columns.T @ columns
    if not np.allclose(lengths, np.eye(len(lengths)), rtol=0, atol=ROUNDED):
        raise ValueError(
            f"{what} must be orthogonal directions of length 1; got {np.round(columns.T, 4).tolist()}."
        )
    if len(lengths) == 2:
        columns = np.column_stack([columns, np.cross(*columns.T)])
    left, _, right = np.linalg.svd(columns)
    return left @ right


def toward_axes(data: np.ndarray, spacing: Any, origin: Any, direction: Any) -> dict[str, Any]:
    """Arguments of `Volume` for `data[i, j, k]` whose axes point along the columns of `direction`.

    Axes are exchanged and reversed so that x, y and z of the result increase along the world's as nearly as
    they can; what is left is its `direction`, which is missing if it is none. No voxel is interpolated.
    """
    matrix = np.reshape(np.asarray(direction, float), (3, 3))
    # the axis of the data that is nearest to each axis of the world, all three at once
    order = max(map(list, itertools.permutations(range(3))), key=lambda p: np.abs(matrix[range(3), p]).sum())
    matrix, steps = matrix[:, order], np.asarray(spacing, float)[order]
    signs = np.where(np.diag(matrix) >= 0, 1, -1)
    turned = np.transpose(data, order)
    last = np.where(signs < 0, np.array(turned.shape) - 1, 0)
    arguments: dict[str, Any] = {
        "data": np.ascontiguousarray(turned[tuple(slice(None, None, sign) for sign in signs)]),
        "spacing": steps,
        "origin": np.asarray(origin, float) + matrix @ (steps * last),
    }
    if not np.allclose(matrix * signs, np.eye(3), rtol=0, atol=ALONG_AXES):
        arguments["direction"] = matrix * signs
    return arguments
