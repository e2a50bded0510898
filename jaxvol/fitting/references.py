"""Reference images that a fit compares with, stacked by kind, and their noise."""

import math
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._util.checks import Arrayable, described, finite_array
from ..path_tracing import PathTraced
from ..scene.camera import Camera
from .noise import Noise, given_variances, path_traced_view


class References(eqx.Module):
    """Views of a residual."""

    groups: list[tuple[Camera, Float[Array, "views height width channels"]]]
    """Stacked views of the same size and kind."""
    background: Float[Array, "3"]
    noise: Noise | None
    """None if it is unknown for any view."""

    @classmethod
    def of(cls, views: Iterable[Any] | Any, background: Arrayable, noise: Any) -> "References":
        """From pairs (camera, image).

        Raises:
            ValueError: for no views, an image that differs in size from its camera or holds integers, NaN or
                infinite pixels, and noise that does not belong to them.
        """
        color = finite_array("background", background, (3,))
        views = list(views) if isinstance(views, Iterable) else []
        if not views:
            raise ValueError("views must hold at least one pair (camera, image); got none.")
        read = [_view(number, view, color) for number, view in enumerate(views)]
        by_kind: dict[Any, list[tuple[Camera, Array]]] = {}
        for camera, image, _ in read:
            by_kind.setdefault((jax.tree.structure(camera), image.shape), []).append((camera, image))
        groups = [jax.tree.map(lambda *leaves: jnp.stack(leaves), *views) for views in by_kind.values()]
        given = given_variances(noise, [image.shape for _, image, _ in read])
        known = [own if told is None else told for (*_, own), told in zip(read, given, strict=True)]
        every = [variance for variance in known if variance is not None]
        return cls(groups, color, Noise.of(every) if len(every) == len(read) else None)

    def cameras(self) -> list[Camera]:
        """Cameras of all views."""
        each = ((cameras, view) for cameras, images in self.groups for view in range(len(images)))
        return [jax.tree.map(lambda leaf, view=view: leaf[view], cameras) for cameras, view in each]

    def count(self) -> int:
        """Total number of entries."""
        return sum(images.size for _, images in self.groups)

    def scale(self) -> float:
        """Root mean square of the images: changes within its rounding carry no information."""
        squares = sum(float(jnp.sum(images**2)) for _, images in self.groups)
        return math.sqrt(squares / self.count())


def _view(number: int, view: Any, background: Float[Array, "3"]) -> tuple[Camera, Array, np.ndarray | None]:
    """Camera, image, and the variance of its noise if the image is path-traced."""
    if not isinstance(view, tuple | list) or len(view) != 2 or not isinstance(view[0], Camera):
        raise ValueError(f"views[{number}] must be a pair (camera, image); got {described(view)}.")
    camera, given = view
    variance, name = None, f"views[{number}]: the image"
    if isinstance(given, PathTraced):
        given, variance = path_traced_view(given, background)
    if (kind := np.asarray(given).dtype).kind not in "fV":  # V: JAX's own 8- and 16-bit floats
        raise ValueError(
            f"{name} must be linear RGB, floats in [0, 1]; got {kind}. Convert a picture file with "
            "jv.read_views, or its pixels with jv.from_srgb(image / 255)."
        )
    image = finite_array(name, given, (*camera.size[::-1], None)).astype(jnp.float32)
    if image.shape[2] not in (3, 4):
        raise ValueError(f"{name} must have 3 or 4 channels; got {image.shape[2]}.")
    return camera, image, variance
