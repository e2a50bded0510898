"""Phantoms with a closed form, whose images have a known answer."""

from collections.abc import Callable

import numpy as np

from .canvas import Canvas
from .shapes import Block


def maker(value: Callable[..., Block]) -> Callable[[int, np.random.Generator], np.ndarray]:
    """The maker of a scene with the value `value(x, y, z)`."""

    def make(n: int, rng: np.random.Generator) -> np.ndarray:
        canvas = Canvas(n)
        for where, at in canvas.slabs():
            canvas.values[where] = value(*at)
        return canvas.values

    return make


def plane(x: Block, y: Block, z: Block) -> Block:
    height = 0.25 + 0.35 * (x + 1) / 2
    return _logistic(((z + 1) / 2 - height) / 0.004)


def cut_block(x: Block, y: Block, z: Block) -> Block:
    return np.where(x < 0, 0.5 + 0.1 * np.sin(20 * (z + 1)), plane(x, y, z))


def sphere(x: Block, y: Block, z: Block) -> Block:
    return _logistic((0.5 - np.sqrt(x * x + y * y + z * z)) / 0.008)


def constant(x: Block, y: Block, z: Block) -> Block:
    return np.ones_like(x)


def linear(x: Block, y: Block, z: Block) -> Block:
    return (x + 1) / 2


def gaussian(x: Block, y: Block, z: Block) -> Block:
    return np.exp((x * x + y * y + z * z) / (-2 * 0.3**2))


def _logistic(x: Block) -> Block:
    """Logistic function."""
    from scipy.special import expit  # here, so that a first image does not wait for it

    return expit(x)
