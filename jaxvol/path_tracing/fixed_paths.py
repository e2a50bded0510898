"""Which inputs have no derivative, since they move paths, or the places where the medium jumps?"""

from typing import Any, TypeVar

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp

from ..lighting.materials import Material
from ..scene.camera import Camera
from ..scene.transfer import Transfer, TransferFunction
from ..scene.transfer2d import TransferFunction2D
from ..scene.volume import Volume, with_voxels, without_voxels
from ..xla.platform import is_traced


T = TypeVar("T")

REMEDY = (
    "Keep constant what is not to be differentiated by jax.lax.stop_gradient; for a derivative, take "
    "differences of images of the same key, or differentiate render with lighting.ScattererTemplates."
)


def constant(name: str, tree: T, reason: str = "it moves the paths") -> T:
    """The tree. Raises `RuntimeError` where it is differentiated."""
    message = f"path_trace has no derivative with respect to {name}, since {reason}. {REMEDY}"
    return eqxi.nondifferentiable(tree, msg=message)


def with_constant_paths(
    volume: Volume, transfer: Transfer, camera: Camera, materials: tuple[Material, ...]
) -> tuple[Volume, Transfer, Camera, tuple[Material, ...]]:
    """The same. Raises `RuntimeError` where what moves paths or jumps of the medium is differentiated."""
    place = "the volume's spacing, origin and direction"
    data, field = volume.data, volume.field
    volume = constant(place, eqx.tree_at(_field_of, without_voxels(volume), None, is_leaf=_is_none))
    volume = eqx.tree_at(_field_of, with_voxels(volume, data), field, is_leaf=_is_none)

    def one(part: Any) -> Any:
        if not isinstance(part, TransferFunction | TransferFunction2D):
            return part
        lines = constant("the control points' values of transfer", _lines_of(part), "they are constants")
        return eqx.tree_at(_lines_of, part, lines)

    transfer = jax.tree.map(
        one, transfer, is_leaf=lambda p: isinstance(p, TransferFunction | TransferFunction2D)
    )
    edges = constant("the values of materials", [m.values for m in materials], "the medium jumps there")
    materials = tuple(
        eqx.tree_at(lambda m: m.values, material, edge, is_leaf=_is_none)
        for material, edge in zip(materials, edges, strict=True)
    )
    return volume, transfer, constant("camera", camera), materials


def check_voxels(transfer: Transfer, materials: tuple[Material, ...]) -> None:
    """Raises `RuntimeError` if jumps of the medium move with the voxels."""
    if materials:
        raise RuntimeError(
            "path_trace has no derivative with respect to the volume's voxels where there are materials, since "
            f"these end at values and where transfer shows something. {REMEDY}"
        )
    for part in jax.tree.leaves(
        transfer, is_leaf=lambda p: isinstance(p, TransferFunction | TransferFunction2D)
    ):
        for line in _lines_of(part) if isinstance(part, TransferFunction | TransferFunction2D) else ():
            if not is_traced(line) and bool(jnp.any(line[..., 1:] == line[..., :-1])):
                raise RuntimeError(
                    "path_trace has no derivative with respect to the volume's voxels where transfer has a step "
                    f"(two equal values), since it moves with them. {REMEDY}"
                )


def _lines_of(transfer: Any) -> list[Any]:
    return [transfer.values, *([transfer.magnitudes] if isinstance(transfer, TransferFunction2D) else [])]


def _field_of(volume: Volume) -> Any:
    return volume.field


def _is_none(leaf: Any) -> bool:
    return leaf is None
