"""How is a Zarr array in a folder opened? By tensorstore, which reads the chunks that a box touches side by
side."""

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from .._util.checks import described
from .sources import SPACE, Triple, VoxelSource


LARGE, BEYOND = 2**26, 8
"""Bytes of a chunk that are always taken, and of those of the array, how many times as many."""

DECODED = 2**24
"""Bytes of decoded chunks that are kept, for boxes that share them."""

DECODERS = min(os.cpu_count() or 1, 8)
"""Threads that read files, and threads that decode them."""


def is_zarr_array(path: Path) -> bool:
    """Whether a folder is that of a Zarr array, not of a group or anything else."""
    if (path / "zarr.json").is_file():
        return read_json(path / "zarr.json").get("node_type") == "array"
    return (path / ".zarray").is_file()


def zarr_array(
    path: Path,
    *,
    axes: Any = None,
    index: Mapping[str, int] | None = None,
    missing: Literal["error", "fill"] | Any = "error",
    spacing: Triple | None = None,
    origin: Triple | None = None,
) -> VoxelSource:
    """The array in a folder, opened by tensorstore. Arguments and errors as for `levels_of`."""
    if missing not in ("error", "fill"):
        raise ValueError(f'missing must be "error" or "fill"; got {missing!r}.')
    try:
        import tensorstore
    except ImportError as fault:
        raise ImportError(
            f'{path} is a Zarr array, which tensorstore reads; it is missing: pip install "jaxvol[bricks]".'
        ) from fault
    second = (path / ".zarray").is_file()
    spec = {
        "driver": "zarr" if second else "zarr3",
        "kvstore": {"driver": "file", "path": f"{path.resolve()}{os.sep}"},
        "fill_missing_data_reads": missing == "fill",
    }
    context = {
        "cache_pool": {"total_bytes_limit": DECODED},
        "data_copy_concurrency": {"limit": DECODERS},
        "file_io_concurrency": {"limit": DECODERS},
    }
    try:
        store = tensorstore.open(spec, open=True, read=True, context=tensorstore.Context(context)).result()
    except ValueError as fault:
        raise ValueError(f"path: {path} cannot be opened as a Zarr array (tensorstore: {fault}).") from fault
    _check_chunks(path, store)
    if axes is None:
        axes = _told_axes(path, second=second)
    return VoxelSource(store, spacing, origin, axes=axes, index=index, name=str(path), hint=_hint)


def _hint(fault: str) -> str:
    if "missing" in fault:
        return (
            'A chunk is missing. Fetch it again; or pass missing="fill", if chunks were left out because '
            "all their voxels have the fill value."
        )
    return "A chunk is damaged. Fetch it again."


def _told_axes(path: Path, *, second: bool) -> list[str] | None:
    """The names of the axes that the array's metadata tell, if x, y and z are among them."""
    told: Any = None
    if second and (path / ".zattrs").is_file():
        told = read_json(path / ".zattrs").get("_ARRAY_DIMENSIONS")
    elif not second:
        metadata = read_json(path / "zarr.json")
        attributes = metadata.get("attributes")
        told = metadata.get("dimension_names")
        if told is None and isinstance(attributes, dict):
            told = attributes.get("_ARRAY_DIMENSIONS")
    if not isinstance(told, list) or not all(isinstance(name, str) for name in told):
        return None
    names = [name.lower() for name in told]
    return names if {*SPACE} <= {*names} else None


def _check_chunks(path: Path, store: Any) -> None:
    """Raises for chunks for which no memory should be taken: a chunk is decoded as a whole, even if it
    reaches beyond the array."""
    chunk = [c or n for c, n in zip(store.chunk_layout.read_chunk.shape, store.shape, strict=True)]
    of_chunk, whole = (math.prod(shape) * store.dtype.numpy_dtype.itemsize for shape in (chunk, store.shape))
    if of_chunk > max(LARGE, BEYOND * whole):
        raise ValueError(
            f"path: {path} must have chunks that are not much larger than it; got chunks of {tuple(chunk)} "
            f"voxels, {of_chunk} bytes, for an array of {tuple(store.shape)}. Its metadata may be damaged."
        )


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file. **Raises** `ValueError` if it holds anything else."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as fault:
        raise ValueError(f"path: {path} cannot be read as JSON ({fault}).") from fault
    if not isinstance(content, dict):
        raise ValueError(f"path: {path} must hold a JSON object; got {described(content)}.")
    return content
