"""In which type are voxels stored? The smallest in which the image stays what it is."""

from collections.abc import Iterator

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Shaped

from ..march.march import March
from .probe import Probe, Setting


Voxels = Shaped[np.ndarray, "nx ny nz"]


def stored(
    probe: Probe, setting: Setting, march: March, allowed: float
) -> tuple[Setting, float, list[tuple[str, bool, str]]]:
    """The scene with its voxels in a smaller type, if that changes the image by at most `allowed`; by how
    much it does; and what was kept and left out, with the reasons."""
    data = np.asarray(setting.volume.data)
    if data.dtype != np.float32 or setting.volume.field is not None:
        return setting, 0.0, [(f"voxels as {data.dtype}", True, "as they are given")]
    said, before = [], None
    for small in _smaller(data):
        changed = small.astype(np.float32)
        if np.array_equal(changed, data):
            change, why = 0.0, "no voxel changes"
        else:
            # rounded, but as float32: the program that is compiled already
            before = probe.render(setting, march) if before is None else before
            change = probe.distance(probe.render(_holding(setting, changed), march), before)
            why = f"the image changes by {change:.2g}"
        if change <= allowed:
            return _holding(setting, small), change, [*said, (f"voxels as {small.dtype}", True, why)]
        said.append((f"voxels as {small.dtype}", False, why))
    return setting, 0.0, [*said, ("voxels as float32", True, "as they are given")]


def _holding(setting: Setting, data: Voxels) -> Setting:
    return setting._replace(volume=eqx.tree_at(lambda v: v.data, setting.volume, jnp.asarray(data)))


def _smaller(data: Voxels) -> Iterator[Voxels]:
    """The voxels in smaller types that can hold them, the fastest first."""
    low, high = float(data.min()), float(data.max())
    for name in ("uint8", "int16", "uint16"):
        if np.iinfo(name).min <= low and high <= np.iinfo(name).max:
            yield np.round(data).astype(name)
            break
    if max(abs(low), abs(high)) <= float(np.finfo(np.float16).max):
        yield data.astype(np.float16)
