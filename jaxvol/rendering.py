"""What does a render give back?"""

from typing import Any, Literal, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ._util.checks import finite, is_traced


Outputs: TypeAlias = Literal["all", "rgba"]
"""What is asked for of rays: a `Rendering`, or just a `Picture`."""

Found: TypeAlias = Literal["all", "depth", "rgba"]
"""What is found out about rays: what is asked for, or a `DepthPicture`."""


class AbstractPicture(eqx.Module):
    """What rays look like, at least."""

    rgba: eqx.AbstractVar[Float[Array, "*rays 4"]]
    exhausted: eqx.AbstractVar[Bool[Array, "*rays"]]

    def image(self, background: Any = (1.0, 1.0, 1.0)) -> Float[Array, "*rays 3"]:
        """Linear RGB over a background: one colour (3,), or an image of the same shape."""
        background = self._background(background)
        if background.shape not in ((3,), (*self.rgba.shape[:-1], 3)):
            raise ValueError(
                f"background must be one colour (3,) or an image {(*self.rgba.shape[:-1], 3)}; "
                f"got shape {background.shape}."
            )
        background = jnp.broadcast_to(background, (*self.rgba.shape[:-1], 3))
        return self.rgba[..., :3] + (1 - self.rgba[..., 3:]) * background

    def _background(self, background: Any) -> Float[Array, "..."]:
        """As numbers. A traced one may be NaN, and shows as it."""
        if not is_traced(background):
            given = background
            try:
                background = np.asarray(given, np.float32)
            except (TypeError, ValueError) as fault:
                raise ValueError(f"background must be linear RGB numbers; got {given!r}.") from fault
            if not np.all(finite(background)):
                raise ValueError("background must be finite; got NaN or infinity.")
        return jnp.asarray(background, self.rgba.dtype)


class AbstractDepthPicture(AbstractPicture):
    """What rays look like and how far away that is, at least."""

    depth: eqx.AbstractVar[Float[Array, "*rays"]]


class Picture(AbstractPicture):
    """What rays look like. The leading shape is that of the rays: (height, width) from a camera.

    - `rgba`: linear colour, premultiplied by opacity, and opacity; not yet over any background.
    - `exhausted`: whether the ray spent `March.max_samples` before it was finished: it lacks what
      lies behind.
    """

    rgba: Float[Array, "*rays 4"]
    exhausted: Bool[Array, "*rays"]


class DepthPicture(AbstractDepthPicture):
    """What deferred light needs: a `Picture`, and its `depth`, as in `Rendering`."""

    rgba: Float[Array, "*rays 4"]
    exhausted: Bool[Array, "*rays"]
    depth: Float[Array, "*rays"]


class Rendering(AbstractDepthPicture):
    """What rays look like, and what they met. `rgba` and `exhausted` as in `Picture`.

    - `depth`: mean distance from the ray's origin to what is seen, weighted by how much each cell
      adds to the opacity, world length; infinite where nothing is seen.
    - `samples`: samples evaluated, one for each piece into which a cell falls.
    - `aligned`: whether the ray reached a non-transparent last cell that was cut at the exit
      (Kye 2013, Fig. 13).
    """

    rgba: Float[Array, "*rays 4"]
    exhausted: Bool[Array, "*rays"]
    depth: Float[Array, "*rays"]
    samples: Int[Array, "*rays"]
    aligned: Bool[Array, "*rays"]
