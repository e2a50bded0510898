"""Smooth random textures that are the same at every resolution."""

import numpy as np
from jaxtyping import Float

from .shapes import Block


class PlaneWaves:
    """A smooth random texture: a sum of plane waves with wavelengths of a given range, variance 1."""

    wave_vector: Float[np.ndarray, "waves 3"]
    phase: Float[np.ndarray, " waves"]

    def __init__(self, rng: np.random.Generator, shortest: float, longest: float, count: int = 32):
        direction = rng.normal(size=(count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        self.wave_vector = 2 * np.pi * direction / rng.uniform(shortest, longest, (count, 1))
        self.phase = rng.uniform(0, 2 * np.pi, count)

    def __call__(self, x: Block, y: Block, z: Block) -> Block:
        # the cosine as the real part of a product of three exponentials: one matrix product sums all waves
        ex, ey, ez = (
            np.exp(1j * np.outer(v.ravel(), k)).astype(np.complex64)
            for v, k in zip((x, y, z), self.wave_vector.T, strict=True)
        )
        ex = ex * (np.exp(1j * self.phase) * np.sqrt(2 / len(self.phase))).astype(np.complex64)
        exy = (ex[:, None, :] * ey).reshape(-1, len(self.phase))
        real, imaginary = exy.real @ ez.real.T, exy.imag @ ez.imag.T
        return (real - imaginary).reshape(x.size, y.size, z.size)
