"""The medium at a point of a volume: its extinction and albedo."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp

from .._util.vec3 import Scalar, Vec3
from ..lighting.materials import Material, shares
from ..scene.transfer import Measured, Transfer, classification_of
from ..scene.volume import Volume


class Medium(NamedTuple):
    """A volume as a medium that scatters and absorbs light.

    - `measure`: reads from memory what is needed at a grid coordinate.
    - `meet`: maps that to extinction (1/length) and single-scattering albedo (r, g, b) in [0, 1].
    """

    measure: Callable[[Vec3], Measured]
    meet: Callable[[Measured], tuple[Scalar, Vec3]]

    @classmethod
    def of(cls, volume: Volume, transfer: Transfer, materials: tuple[Material, ...] = ()) -> "Medium":
        """Medium with the transfer function's extinction, at the trilinear value, and its colour as albedo.

        Where the transfer function shows a material, the extinction is 1/λ instead, and the albedo is
        colour · (1 - opacity). Where materials overlap, the first counts.
        """
        classification = classification_of(transfer, volume)

        def measure(coordinate: Vec3) -> Measured:
            measured = classification.measure(coordinate)
            if not materials:
                return measured
            return (*shares(materials, volume, coordinate, measured[0]), *measured)

        def meet(measured: Measured) -> tuple[Scalar, Vec3]:
            share, measured = measured[: len(materials)], measured[len(materials) :]
            color, extinction = classification.classify(classification.searched(measured))
            kept = jnp.ones_like(extinction)
            visible = extinction > 0
            for part, material in zip(share, materials, strict=True):
                here = visible & (part > 0)
                extinction = jnp.where(here, 1 / material.mean_free_path, extinction)
                kept = jnp.where(here, 1 - material.opacity, kept)
            r, g, b = (jnp.clip(c, 0, 1) * kept for c in color)
            return extinction, (r, g, b)

        return cls(measure, meet)
