"""Checks and conversions of arrays of voxels and labels."""

import os

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Shaped

from ..xla.platform import is_traced
from .checks import Arrayable, described, finite, require
from .files import MOST_VOXELS


DTYPES = ("uint8", "int8", "uint16", "int16", "float16", "bfloat16", "float32")

WHOLE = {name: (int(np.iinfo(name).min), int(np.iinfo(name).max)) for name in DTYPES[:4]}
WHOLE["float32"] = -(2**24), 2**24
"""Ranges of integers that the types hold exactly, smallest type first."""

FLAT = 0.8
"""Minimum fraction of equal neighbours for which `is_flat` is true."""


def voxel_array(data: Arrayable) -> Array:
    """Convert to a JAX array of a supported type, checked to hold finite voxels."""
    data = _as_array("data", data)
    check_shape(data.shape)
    check_type(data.dtype)
    if data.size > MOST_VOXELS:
        raise ValueError(f"data must have fewer than 2**31 voxels; got {data.size} (shape {data.shape}).")
    if data.dtype.kind in "bui":
        return _on_device(data if data.dtype.name in DTYPES else _narrow(data))
    if is_traced(data):
        message = "data must be finite; got some voxels that are NaN or infinite. Replace them first."
        return require(jnp.asarray(data), finite, message)
    stored = np.asarray(data)
    if stored.dtype == np.float64:
        with np.errstate(over="ignore"):  # overflow to infinity is rejected below
            stored = stored.astype(jnp.result_type(float))
    if not np.all(finite(stored)):
        beyond = f" in {stored.dtype}, as they are stored" if np.all(finite(np.asarray(data))) else ""
        raise ValueError(
            f"data must be finite{beyond}; got {np.sum(~finite(stored))} of {stored.size} voxels that are "
            "NaN or infinite. Replace them, or rescale all, first: jv.load(path, nan=VALUE), --nan VALUE."
        )
    return _on_device(stored if stored.dtype != data.dtype else data)


def _on_device(array: Array | np.ndarray) -> Array:
    """Convert to a JAX array that does not share memory with a NumPy array."""
    if isinstance(array, jax.Array):
        return array
    # with a type, JAX may share the memory; without, it compiles a copy per shape
    return jnp.asarray(array.copy(), array.dtype)


def check_shape(shape: tuple[int, ...]) -> None:
    """Raise a `ValueError` unless an array of this shape can hold a volume's voxels."""
    if len(shape) not in (3, 4) or min(shape[:3]) < 2 or 0 in shape:
        raise ValueError(
            f"data must be data[x, y, z] with at least 2 voxels along each axis; got shape {shape}. (With "
            "channels: data[x, y, z, channel].) For a stack of images, stack them along the last axis."
        )


def check_type(dtype: np.dtype) -> None:
    """Raise a `ValueError` unless voxels of this type are supported or can be converted."""
    if dtype.kind not in "bui" and dtype.name not in (*DTYPES, "float64"):
        raise ValueError(
            f"data must be of type {', '.join(DTYPES)}; got {dtype}. Convert it, for example with "
            "data.astype(np.float32), if float32 keeps the values distinct."
        )


def _narrow(data: Array | np.ndarray) -> np.ndarray:
    """Convert integers to the smallest type that voxels may have."""
    if is_traced(data):
        raise ValueError(
            f"data must be of type {', '.join(DTYPES)} if traced; got {data.dtype}, whose range is not known "
            "before the program runs. Convert them: data.astype(jnp.float32)."
        )
    data = np.asarray(data)
    low, high = int(data.min()), int(data.max())
    for dtype, (minimum, maximum) in WHOLE.items():
        if minimum <= low and high <= maximum:
            return data.astype(dtype)
    raise ValueError(
        "data must be whole numbers from -2**24 to 2**24, which float32 holds exactly; got "
        f"{data.dtype} from {low} to {high}. Subtract an offset, or rescale them to data.astype(np.float32)."
    )


def within(integers: np.ndarray, ends: tuple[int, int]) -> bool:
    """Test that all integers lie in a range, inclusive."""
    return ends[0] <= int(integers.min()) and int(integers.max()) <= ends[1]


def is_flat(data: np.ndarray) -> bool:
    """Test whether most voxels but the background equal their neighbour, as 0.92 do in segmentations, not in
    scans (0.46)."""
    values, following = data[:-1], data[1:]
    face_values, counts = np.unique(faces_of(data), return_counts=True)
    counted = values != data.min()
    if 2 * counts.max() > counts.sum():
        inner = counted & (values != face_values[counts.argmax()])
        counted = inner if inner.any() else counted
    return bool(counted.any() and np.mean(values[counted] == following[counted]) >= FLAT)


def faces_of(data: Shaped[np.ndarray, "nx ny nz"]) -> Shaped[np.ndarray, " n"]:
    """Values on a volume's six faces."""
    return np.concatenate([data.take(end, axis).ravel() for axis in range(3) for end in (0, -1)])


def label_array(labels: Arrayable, shape: tuple[int, ...]) -> Array:
    """Convert to a JAX array of integers of at most 32 bits."""
    labels = _as_array("labels", labels)
    if labels.dtype.kind not in "bui":
        raise ValueError(f"labels must be integers; got {labels.dtype}. Use labels.astype(np.int32).")
    if labels.shape != shape:
        raise ValueError(f"labels must have the shape of data, {shape}; got shape {labels.shape}.")
    if labels.dtype.kind == "b":
        return jnp.asarray(labels, jnp.uint8)
    if labels.dtype.itemsize < 4 or labels.dtype == np.int32 or is_traced(labels):
        return _on_device(labels)
    low, high = int(labels.min()), int(labels.max())
    if low < -(2**31) or high >= 2**31:
        raise ValueError(
            f"labels must lie within int32; got {labels.dtype} from {low} to {high}. Renumber them: "
            "np.unique(labels, return_inverse=True)."
        )
    return _on_device(np.asarray(labels).astype(np.int32))


def _as_array(name: str, value: Arrayable) -> Array | np.ndarray:
    """Convert to a JAX array or a NumPy array in native byte order."""
    if isinstance(value, jax.Array):
        return value
    if is_traced(value):
        return jnp.asarray(value)
    if isinstance(value, str | os.PathLike):
        raise ValueError(f"{name} must be an array; got {described(value)}. jv.load(path) reads files.")
    if isinstance(value, np.ma.MaskedArray):
        raise ValueError(f"{name} must be an array without a mask; got a masked one. Use data.filled(0).")
    try:
        array = np.asarray(value)
    except ValueError as fault:  # sequences of different lengths
        raise ValueError(f"{name} must be an array; got {described(value)}: {fault}") from fault
    return array if array.dtype.isnative else array.astype(array.dtype.newbyteorder("="))
