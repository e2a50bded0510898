"""Why is nothing visible in an image?"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._util.vec3 import apart
from ..compositing.blending import Compositing
from ..compositing.isosurface import Isosurface
from ..march.march import March
from ..scene.camera import Camera
from ..scene.rendering import Rendering
from ..scene.space import Ray, Space, enter
from ..scene.transfer import Transfer, TransferFunction
from ..scene.volume import Volume


LEAST = 0.5 / 255
"""Opacity below which an 8-bit image shows nothing."""

RAYS, POINTS = 4096, 128
"""Maximum number of rays, and number of points per ray, at which a volume is sampled."""


def why_empty(
    volume: Volume,
    transfer: Transfer,
    camera: Camera,
    march: March,
    rendering: Rendering,
    compositing: Compositing[Any],
) -> str | None:
    """Why an image of this scene shows nothing, and what to change; None where a pixel's opacity reaches
    1/510."""
    opacity = float(np.asarray(rendering.rgba)[..., 3].max())
    if opacity >= LEAST:
        return None
    hit, values = _values_along(volume, camera, march.locate(volume))
    if not hit.any():
        bounds = " to ".join(str(np.asarray(corner)) for corner in volume.corners)
        return f"no ray of the camera meets the volume, {bounds}, or what the clip leaves of it."
    if opacity > 0:
        return f"the opacity is at most {opacity:.2g}. Use a shorter unit distance, or higher opacities."
    low, high = float(np.nanmin(values[hit])), float(np.nanmax(values[hit]))
    where = f"the volume's values along the rays run from {low:g} to {high:g}"
    if isinstance(compositing, Isosurface):
        return f"{where}, and none crosses the isosurface's value, {float(compositing.value):g}."
    if not isinstance(transfer, TransferFunction):
        return f"{where}, and the transfer function shows none of them."
    seen = np.flatnonzero(np.asarray(transfer.extinction) > 0)
    if not seen.size:
        return f"{where}, and the transfer function's opacity is 0 everywhere."
    # the opacity of a point extends to its neighbours, that of the first and the last to infinity
    at = [-np.inf, *np.asarray(transfer.values), np.inf]
    return (
        f"{where}, and the transfer function shows values between {at[seen[0]]:g} and {at[seen[-1] + 2]:g}. "
        f"A clim from {low:g} to {high:g} would show something."
    )


def _values_along(
    volume: Volume, camera: Camera, space: Space
) -> tuple[Bool[np.ndarray, " rays"], Float[np.ndarray, "rays points"]]:
    """For some rays, preferably those that hit the volume: whether they hit, and the values along them, NaN
    in gaps."""
    zero = jnp.zeros((), jnp.int32)

    @jax.jit
    @jax.vmap
    def entered(origin: Float[Array, "3"], direction: Float[Array, "3"]) -> Ray:
        return enter(space, apart(origin), apart(direction), (zero, zero))

    @jax.jit
    @jax.vmap
    def values(ray: Ray) -> Float[Array, " points"]:
        depths = ray.length * jnp.linspace(0, 1, POINTS)
        found = jax.vmap(lambda depth: volume.value(ray.path(depth)))(depths)
        return jnp.where(ray.in_gap(depths), jnp.nan, found)

    rays = entered(*(part.reshape(-1, 3) for part in camera.rays()))
    hit = rays.length > 0
    count = max(int(hit.sum()), 1)
    chosen = jnp.argsort(~hit, stable=True)[: count : -(-count // RAYS)]
    return np.asarray(hit[chosen]), np.asarray(values(jax.tree.map(lambda leaf: leaf[chosen], rays)))
