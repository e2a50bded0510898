"""Which scenes have a closed form, so that an image of them has a known answer?"""

from collections.abc import Callable

import numpy as np

from .canvas import Canvas
from .shapes import Block


def maker(value: Callable[..., Block]) -> Callable[[int, np.random.Generator], np.ndarray]:
    """The maker of a scene whose value at (x, y, z) is given."""

    def make(n: int, rng: np.random.Generator) -> np.ndarray:
        canvas = Canvas(n)
        for where, at in canvas.slabs():
            canvas.values[where] = value(*at)
        return canvas.values

    return make


def plane(x, y, z):
    height = 0.25 + 0.35 * (x + 1) / 2
    return _rising(((z + 1) / 2 - height) / 0.004)


def cut_block(x, y, z):
    return np.where(x < 0, 0.5 + 0.1 * np.sin(20 * (z + 1)), plane(x, y, z))


def sphere(x, y, z):
    return _rising((0.5 - np.sqrt(x * x + y * y + z * z)) / 0.008)


def constant(x, y, z):
    return np.ones_like(x)


def linear(x, y, z):
    return (x + 1) / 2


def gaussian(x, y, z):
    return np.exp((x * x + y * y + z * z) / (-2 * 0.3**2))


def _rising(x: Block) -> Block:
    """From 0 far below 0 to 1 far above."""
    from scipy.special import expit  # here: a first image need not wait for it

    return expit(x)
