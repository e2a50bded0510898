"""Errors for derivatives by inputs that have none, since they move paths, or the medium's discontinuities."""

from operator import attrgetter
from typing import Any, TypeVar

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from ..lighting.lights import Light, located
from ..lighting.materials import Material
from ..scene.camera import Camera
from ..scene.transfer import Transfer, TransferFunction
from ..scene.transfer2d import TransferFunction2D
from ..scene.volume import Volume, with_voxels, without_voxels
from ..xla.platform import in_numpy, is_traced
from ..xla.trees import is_none


T = TypeVar("T")

REMEDY = (
    "Make that input constant by jax.lax.stop_gradient; for a derivative, take differences of images of the "
    "same key, or differentiate render with lighting.ScattererTemplates."
)


def constant(name: str, tree: T, reason: str = "it moves the paths") -> T:
    """The tree. **Raises** `RuntimeError` where it is differentiated."""
    message = f"path_trace has no derivative with respect to {name}, since {reason}. {REMEDY}"
    return eqxi.nondifferentiable(tree, msg=message)


def with_constant_paths(
    volume: Volume,
    transfer: Transfer,
    camera: Camera,
    materials: tuple[Material, ...],
    lights: tuple[Light, ...],
) -> tuple[Volume, Transfer, Camera, tuple[Material, ...]]:
    """The arguments. **Raises** `RuntimeError` where an input that moves paths or jumps is differentiated."""
    name = "the volume's spacing, origin and direction"
    data, field, field_of = volume.data, volume.field, attrgetter("field")
    volume = constant(name, without_voxels(eqx.tree_at(field_of, volume, None, is_leaf=is_none)))
    if materials:
        reason = "which end at values of the volume, or where the transfer function shows nothing"
        data, field = constant("voxels where there are materials", (data, field), reason)
    elif not is_traced(transfer) and has_step(transfer):
        name = "voxels under a transfer function with a step (two equal values)"
        data, field = constant(name, (data, field), "the medium jumps there")
    volume = eqx.tree_at(field_of, with_voxels(volume, [data]), field, is_leaf=is_none)

    lines = constant("the control points' values of transfer", _lines_of(transfer), "they are constants")
    transfer = eqx.tree_at(_lines_of, transfer, lines) if lines else transfer
    edges = constant("the values of materials", [m.values for m in materials], "the medium jumps there")
    materials = tuple(
        eqx.tree_at(lambda m: m.values, material, edge, is_leaf=is_none)
        for material, edge in zip(materials, edges, strict=True)
    )

    for light in located(lights) if is_traced(lights) else ():  # any place shows what `at` depends on
        zero = jnp.zeros(())
        arriving = light.at((zero, zero, zero), (zero, zero, zero))
        constant("the directions and positions of lights", (arriving.toward, arriving.distance))
    return volume, transfer, constant("camera", camera), materials


def has_step(transfer: Transfer) -> Bool[Array, ""] | np.bool_:
    """True if two neighbouring control points have the same value."""
    xp, lines = in_numpy(*_lines_of(transfer))
    equal = [xp.any(line[..., 1:] == line[..., :-1]) for line in lines]
    return xp.any(xp.stack(equal)) if equal else xp.zeros((), bool)


def _lines_of(transfer: Transfer) -> list[Any]:
    """Values, and magnitudes, of the control points of all tables in a transfer function."""
    tables = TransferFunction | TransferFunction2D
    parts = jax.tree.leaves(transfer, is_leaf=lambda part: isinstance(part, tables))
    values: list[Any] = [part.values for part in parts if isinstance(part, tables)]
    return values + [part.magnitudes for part in parts if isinstance(part, TransferFunction2D)]
