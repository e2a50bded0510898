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
from .noise import Noise, of_pixels, path_traced_view


class References(eqx.Module):
    """Views of a residual."""

    groups: list[tuple[Camera, Float[Array, "views height width channels"]]]
    """Stacked views of the same size and kind."""
    weights: list[Float[Array, "views height width channels"] | None]
    """Of the entries of each group, 1 in the mean of those that count; None if all count alike."""
    background: Float[Array, "3"]
    noise: Noise | None
    """None if it is unknown for any view."""
    count: int = eqx.field(static=True)
    """Number of entries that count."""

    @classmethod
    def of(
        cls, views: Iterable[Any] | Any, background: Arrayable, noise: Any, weights: Any = None
    ) -> "References":
        """From pairs (camera, image). **Raises** `ValueError` for no views, images that differ in size from
        their camera, integers, NaN or infinity, and noise or weights that do not belong to them."""
        color = finite_array("background", background, (3,))
        views = list(views) if isinstance(views, Iterable) else []
        if not views:
            raise ValueError("views must hold at least one pair (camera, image); got none.")
        read = [_view(number, view, color) for number, view in enumerate(views)]
        shapes = [image.shape for _, image, _ in read]
        counted = _weights(weights, shapes)
        by_kind: dict[Any, list[tuple[Camera, Array]]] = {}
        of_kind: dict[Any, list[np.ndarray]] = {}
        for at, (camera, image, _) in enumerate(read):
            kind = jax.tree.structure(camera), image.shape
            by_kind.setdefault(kind, []).append((camera, image))
            of_kind.setdefault(kind, []).extend([] if counted is None else counted[at : at + 1])
        groups = [jax.tree.map(lambda *leaves: jnp.stack(leaves), *views) for views in by_kind.values()]
        stacked = [jax.device_put(np.stack(each)) if each else None for each in of_kind.values()]
        given = [None if sigma is None else sigma**2 for sigma in of_pixels("noise", noise, shapes)]
        known = [own if told is None else told for (*_, own), told in zip(read, given, strict=True)]
        every = [variance for variance in known if variance is not None]
        if counted is not None:
            every = [variance * weight for variance, weight in zip(every, counted, strict=False)]
        told = Noise.of(every) if len(every) == len(read) else None
        count = sum(math.prod(s) for s in shapes) if counted is None else sum(map(np.count_nonzero, counted))
        return cls(groups, stacked, color, told, int(count))

    def size(self) -> int:
        """Total number of entries."""
        return sum(images.size for _, images in self.groups)

    def scale(self) -> float:
        """Root mean square of the images: changes within its rounding carry no information."""
        each = zip(self.groups, self.weights, strict=True)
        squares = (np.sum((1 if w is None else np.asarray(w)) * np.asarray(i) ** 2.0) for (_, i), w in each)
        return math.sqrt(sum(map(float, squares)) / self.count)


def _weights(given: Any, shapes: list[tuple[int, ...]]) -> list[np.ndarray] | None:
    """Weights of all entries, 1 in the mean of those that count; None if none are given."""
    each = of_pixels("weights", given, shapes)
    if all(weight is None for weight in each):
        return None
    full = [np.ones(s) if w is None else w for w, s in zip(each, shapes, strict=True)]
    count = sum(np.count_nonzero(weight) for weight in full)
    if count == 0:
        raise ValueError("weights must be positive for one pixel at least; got 0 for all.")
    scale = count / sum(weight.sum() for weight in full)
    return [(scale * weight).astype(np.float32) for weight in full]


def camera_and_image(number: int, view: Any) -> tuple[Camera, Any]:
    """A view's pair, whose image is not checked yet."""
    if not isinstance(view, tuple | list) or len(view) != 2 or not isinstance(view[0], Camera):
        raise ValueError(f"views[{number}] must be a pair (camera, image); got {described(view)}.")
    return view[0], view[1]


def _view(number: int, view: Any, background: Float[Array, "3"]) -> tuple[Camera, Array, np.ndarray | None]:
    """Camera, image, and the variance of its noise if the image is path-traced."""
    camera, given = camera_and_image(number, view)
    variance, name = None, f"views[{number}]: the image"
    if isinstance(given, PathTraced):
        given, variance = path_traced_view(given, background)
    if (kind := np.asarray(given).dtype).kind not in "fV":  # V: JAX's own 8- and 16-bit floats
        raise ValueError(
            f"{name} must be linear RGB, floats in [0, 1]; got {kind}. Convert a picture file with "
            "jv.read_views, or its pixels with jv.from_srgb(image / 255)."
        )
    image = finite_array(name, given, (*camera.size[::-1], None)).astype(jnp.float32)
    if image.shape[2] < 3:
        raise ValueError(f"{name} must have 3 channels, or those of Rendering.rgba; got {image.shape[2]}.")
    return camera, image, variance
