"""Which photons of a template count as one?"""

import math

import jax
import jax.numpy as jnp

from .template import ScattererTemplate


def merged(photons: ScattererTemplate, distance: float) -> ScattererTemplate:
    """Adds each photon's intensity to the brightest photon within this distance; photons are sorted."""
    offset = jax.lax.stop_gradient(photons.offset)
    near = sum((offset[:, None, i] - offset[None, :, i]) ** 2 for i in range(3)) <= distance**2
    # Photons are sorted, so argmax finds the brightest: the photon itself if none near is brighter. A host
    # may have a host in turn; doubling follows the chain to its end.
    host = jnp.argmax(near, axis=-1)
    for _ in range(math.ceil(math.log2(max(host.shape[0], 2)))):
        host = host[host]
    intensity = jnp.zeros_like(photons.intensity).at[host].add(photons.intensity)
    return ScattererTemplate(photons.offset, intensity)
