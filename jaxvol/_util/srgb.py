"""The sRGB curve: linear colour to display values, and back."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .checks import Arrayable


def to_srgb(linear: Arrayable) -> Float[Array, "*image"]:
    """Linear colour to sRGB display values, both in [0, 1]; values outside are clipped.

    Args:
        linear: colours, of any shape.

    Returns:
        The values, of the same shape.

    Source: IEC 61966-2-1.
    """
    return _to_srgb(jnp.asarray(linear))


def from_srgb(display: Arrayable) -> Float[Array, "*image"]:
    """sRGB display values (as of a matplotlib colormap) to linear colour, both in [0, 1].

    Args:
        display: values, of any shape.

    Returns:
        The colours, of the same shape.

    Source: IEC 61966-2-1.
    """
    return _from_srgb(jnp.asarray(display))


# Jitted: one program for each shape, rather than one for each operation.


@jax.jit
def _to_srgb(linear: Array) -> Float[Array, "*image"]:
    linear = jnp.clip(linear, 0, 1)
    curved = 1.055 * jnp.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return jnp.where(linear <= 0.0031308, 12.92 * linear, curved)


@jax.jit
def _from_srgb(display: Array) -> Float[Array, "*image"]:
    display = jnp.clip(display, 0, 1)
    return jnp.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
