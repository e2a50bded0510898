"""Finds the ranks of the blue noise that `Jitter(pattern="blue")` repeats: `jaxvol/_util/blue_noise.npy`."""

from pathlib import Path

import numpy as np
from jaxtyping import Int

import jaxvol as jv


def blue_ranks(side: int = 128, sigma: float = 1.9) -> Int[np.ndarray, "side side"]:
    """Ranks 0 … side² - 1 on a torus, with neighbours far apart in rank: void and cluster (Ulichney 1993).

    Each rank goes to the largest void: the pixel farthest, by a Gaussian of `sigma` pixels, from those taken
    so far. At first, points in the tightest clusters are moved there.
    """
    away = np.minimum(np.arange(side), side - np.arange(side))
    bell = np.exp(-(away**2) / (2 * sigma**2)).astype(np.float32)
    kernel = np.tile(np.outer(bell, bell), (2, 2))
    taken, density = np.zeros((side, side), bool), np.zeros((side, side), np.float32)

    def put(index: int, sign: int) -> int:
        y, x = divmod(index, side)
        taken[y, x] = sign > 0
        density[...] += sign * kernel[side - y : 2 * side - y, side - x : 2 * side - x]
        return index

    def largest_void() -> int:
        return int(np.where(taken, np.inf, density).argmin())

    def tightest_cluster() -> int:
        return int(np.where(taken, density, -np.inf).argmax())

    first, moved, void = side * side // 10, -1, 0
    for index in np.random.default_rng(0).permutation(side * side)[:first].tolist():
        put(index, 1)
    while moved != void:
        moved = put(tightest_cluster(), -1)
        void = put(largest_void(), 1)

    # ranks below `first`: remove points from the tightest clusters; ranks above: fill the largest voids
    start = taken.copy(), density.copy()
    below = [put(tightest_cluster(), -1) for _ in range(first)]
    taken[...], density[...] = start
    above = [put(largest_void(), 1) for _ in range(first, side * side)]
    return np.argsort(below[::-1] + above).reshape(side, side)


if __name__ == "__main__":
    folder = Path(jv.__file__).parent / "_util"
    np.save(folder / "blue_noise.npy", blue_ranks().astype(np.uint16))
