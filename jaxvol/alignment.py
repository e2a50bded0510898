"""How wide is the last cell? Sampling alignment, also called alpha correction (Kye 2013)."""

import jax.numpy as jnp

from .locate import Ray
from .march import Cell, Transform
from .volume import Volume


class AlphaCorrection(Transform):
    """Cut the last cell of a ray at the volume's exit.

    The last sample's cell reaches past the exit, by a different part of a step in every pixel, which
    makes the back face of a non-transparent volume bumpy. Here that sample stands just for the width
    e up to the exact exit: its opacity becomes `1 - exp(-extinction e)`, which is the paper's
    `1 - (1 - α)^(e/d)`. A volume of constant extinction comes out exact at any step.

    With it the image is continuous in the camera and in everything else that moves the exit, and its
    gradient is whole. Without it the image jumps when a sample crosses the exit, and the gradient
    with respect to the camera misses these jumps.

    Source: Kye 2013, section 3.2 (sampling position alignment).
    """

    def cut(self, cell: Cell, ray: Ray, volume: Volume) -> tuple[Cell, ...]:
        reaches_past = cell.front + cell.width > ray.length
        # A cell that lies past the exit altogether is not sampled; its width just has to be ≥ 0.
        left = jnp.maximum(ray.length - cell.front, 0)
        return (Cell(cell.front, jnp.where(reaches_past, left, cell.width), cell.cut | reaches_past),)
