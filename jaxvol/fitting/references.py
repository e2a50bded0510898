"""Reference images of a fit, stacked by kind, and their noise and weights."""

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
from ..xla.platform import stack
from ..xla.trees import PyTree
from .noise import Noise, path_traced_view, pixel_values


class References(eqx.Module):
    """Views of a residual, with the noise and the weights of their pixels."""

    groups: list[tuple[Camera, Float[Array, "views height width channels"]]]
    """Stacked views of the same size and kind."""
    weights: list[Float[Array, "views height width channels"] | None]
    """Weights of the entries of each group, with mean 1 over positive ones; None for equal weights."""
    background: Float[Array, "3"]
    noise: Noise | None
    """Noise of all views; None if it is unknown for one of them."""
    count: int = eqx.field(static=True)
    """Number of entries with positive weight."""

    @classmethod
    def of(
        cls, views: Iterable[Any], background: Arrayable, noise: PyTree, weights: PyTree = None
    ) -> "References":
        """Stack pairs (camera, image), noise and weights, after checks."""
        color = finite_array("background", background, (3,))
        views = list(views) if isinstance(views, Iterable) else []
        if not views:
            raise ValueError("views must hold at least one pair (camera, image); got none.")
        read = [_view(number, view, color) for number, view in enumerate(views)]
        shapes = [image.shape for _, image, _ in read]
        counted = _weights(weights, shapes)
        kinds: dict[Any, list[int]] = {}
        for number, (camera, image, _) in enumerate(read):
            kinds.setdefault((jax.tree.structure(camera), image.shape), []).append(number)
        pairs = [[read[number][:2] for number in kind] for kind in kinds.values()]
        groups = [jax.tree.map(lambda *leaves: stack(leaves), *kind) for kind in pairs]
        stacked = [
            None if counted is None else jax.device_put(np.stack([counted[number] for number in kind]))
            for kind in kinds.values()
        ]
        sigmas = zip(pixel_values("noise", noise, shapes), read, strict=True)
        known = [traced if sigma is None else sigma**2 for sigma, (*_, traced) in sigmas]
        variances = [variance for variance in known if variance is not None]
        if counted is not None:
            variances = [variance * weight for variance, weight in zip(variances, counted, strict=False)]
        noise = Noise.of(variances) if len(variances) == len(read) else None
        count = sum(math.prod(s) for s in shapes) if counted is None else sum(map(np.count_nonzero, counted))
        return cls(groups, stacked, color, noise, int(count))

    def size(self) -> int:
        """Total number of entries."""
        return sum(images.size for _, images in self.groups)

    def scale(self) -> float:
        """Root mean square of the images: changes within its rounding carry no information."""
        pairs = zip(self.groups, self.weights, strict=True)
        squares = (np.sum((1 if w is None else np.asarray(w)) * np.asarray(i) ** 2.0) for (_, i), w in pairs)
        return math.sqrt(sum(map(float, squares)) / self.count)


def _weights(value: PyTree, shapes: list[tuple[int, ...]]) -> list[np.ndarray] | None:
    """Weights of all entries, with mean 1 over positive ones; None without weights."""
    weights = pixel_values("weights", value, shapes)
    if all(weight is None for weight in weights):
        return None
    full = [np.ones(s) if w is None else w for w, s in zip(weights, shapes, strict=True)]
    count = sum(np.count_nonzero(weight) for weight in full)
    if count == 0:
        raise ValueError("weights must be positive for one pixel at least; got 0 for all.")
    scale = count / sum(weight.sum() for weight in full)
    return [(scale * weight).astype(np.float32) for weight in full]


def camera_and_image(number: int, view: object) -> tuple[Camera, Any]:
    """Camera and image of a view; the image is not checked."""
    if not isinstance(view, tuple | list) or len(view) != 2 or not isinstance(view[0], Camera):
        raise ValueError(f"views[{number}] must be a pair (camera, image); got {described(view)}.")
    return view[0], view[1]


def _view(number: int, view: Any, background: Float[Array, "3"]) -> tuple[Camera, Array, np.ndarray | None]:
    """Camera, image, and the variance of its noise if the image is path-traced."""
    camera, pixels = camera_and_image(number, view)
    variance, name = None, f"views[{number}]: the image"
    if isinstance(pixels, PathTraced):
        pixels, variance = path_traced_view(pixels, background)
    if (kind := np.asarray(pixels).dtype).kind not in "fV":  # V: JAX's own 8- and 16-bit floats
        raise ValueError(
            f"{name} must be linear RGB, floats in [0, 1]; got {kind}. Convert a picture file with "
            "jv.read_views, or its pixels with jv.from_srgb(image / 255)."
        )
    image = finite_array(name, pixels, (*camera.size[::-1], None)).astype(jnp.float32)
    if image.shape[2] < 3:
        raise ValueError(f"{name} must have 3 channels, or those of Rendering.rgba; got {image.shape[2]}.")
    return camera, image, variance
