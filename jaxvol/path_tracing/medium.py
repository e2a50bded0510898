"""What does light meet at a place in a volume? An extinction, and an albedo."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp

from .._util.vec3 import Scalar, Vec3
from ..lighting.materials import Material, shares
from ..transfer import Measured, Transfer
from ..volume import Volume


class Medium(NamedTuple):
    """A volume as something that scatters and absorbs.

    - `measure`: what is read from memory at a grid coordinate.
    - `meet`: from that to extinction (1/length) and single-scattering albedo (r, g, b) in [0, 1].
    """

    measure: Callable[[Vec3], Measured]
    meet: Callable[[Measured], tuple[Scalar, Vec3]]

    @classmethod
    def of(cls, volume: Volume, transfer: Transfer, materials: tuple[Material, ...] = ()) -> "Medium":
        """Extinction is the transfer function's, at the trilinear value, and albedo its colour.

        What the transfer function shows of a material has an extinction of 1/λ in place of its own, and an
        albedo of colour · (1 - opacity). Where materials overlap, the first counts.
        """
        seen = transfer.over(volume)

        def measure(coordinate: Vec3) -> Measured:
            measured = seen.measure(coordinate)
            if not materials:
                return measured
            return (*shares(materials, volume, coordinate, measured[0]), *measured)

        def meet(measured: Measured) -> tuple[Scalar, Vec3]:
            share, measured = measured[: len(materials)], measured[len(materials) :]
            color, extinction = seen.classify(seen.searched(measured))
            kept = jnp.ones_like(extinction)
            visible = extinction > 0
            for part, material in zip(share, materials, strict=True):
                here = visible & (part > 0)
                extinction = jnp.where(here, 1 / material.mean_free_path, extinction)
                kept = jnp.where(here, 1 - material.opacity, kept)
            r, g, b = (jnp.clip(c, 0, 1) * kept for c in color)
            return extinction, (r, g, b)

        return cls(measure, meet)
