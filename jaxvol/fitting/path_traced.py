"""Path-traced images minus reference images: a residual of which only noisy samples can be computed."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from .._util.checks import Arrayable, described, integer
from ..path_tracing import path_trace
from ..ray import check_arguments
from ..scene.camera import Camera
from ..xla.trees import PyTree
from .constraints import Free, FreeVariables, size
from .noise import Noise
from .references import References
from .residuals import check_scene, jacobian


HELD = 8
"""Jacobians that are held at once: by two halves of the paths, means over two epochs and both, and copies."""


class PathTracedResidual(eqx.Module):
    """Path-traced images minus reference images, as the residual of a fit; with other random numbers in each
    step.

    Its square is larger than that of the mean image's residual, by the noise of the paths, which depends on
    the parameters, and so does its gradient. `fit` therefore takes all products between halves of the paths,
    which are independent, and the losses that it tells of single steps may be negative.

    What is free must be differentiable by the path tracer: see `path_trace`.

    Args:
        scene: `scene(parameters, camera)` returns what to trace for the parameters and a view's camera:
            `(volume, transfer, camera, lights, materials)`, and the anisotropy as a sixth entry, as
            `path_trace` takes them. The camera must be of the view's size.
        views: pairs (camera, image), at least one: see `ImageResidual`. An image has three channels. Where it
            is path-traced, it must be by another key.
        background: linear RGB behind the volume.
        paths: for each pixel and step, even. How near a fit comes depends on paths times steps. From far
            away, few paths and many steps take less time.
        key: seed of all random numbers, an integer.
        noise: standard deviation of the noise of the references: see `ImageResidual`.

    Raises:
        ValueError: for arguments out of these ranges, and as `ImageResidual`.
    """

    scene: Callable[[Any, Camera], tuple[Any, ...]]
    references: References
    key: Int[Array, ""]
    paths: int = eqx.field(static=True)

    def __init__(
        self,
        scene: Callable[[Any, Camera], tuple[Any, ...]] | Any,
        views: Iterable[tuple[Camera, Arrayable]] | Any,
        background: Arrayable = (1.0, 1.0, 1.0),
        *,
        paths: int | Any = 16,
        key: int | Any = 0,
        noise: Arrayable | Sequence[Arrayable | None] | None = None,
    ):
        check_scene(scene)
        self.scene = cast(Any, scene)
        self.references = References.of(views, background, noise)
        for _, images in self.references.groups:
            if images.shape[-1] != 3:
                raise ValueError(f"images must have 3 channels to be path-traced; got {images.shape[-1]}.")
        self.paths = integer("paths", paths, 2)
        if self.paths % 2:
            raise ValueError(f"paths must be even, for two independent halves; got {self.paths}.")
        self.key = jnp.asarray(integer("key", key, 0, 2**31 - 1), jnp.int32)


class Sample(NamedTuple):
    """Residual and Jacobian at a point, by one set of paths: [J r] of each half of them."""

    rows: Float[Array, "2 pixels 3 numbers"]

    @property
    def loss(self) -> Float[Array, ""]:
        """Half the sum of squares, unbiased."""
        return jnp.vdot(*self.rows[..., -1]) / 2


class SampledProblem(eqx.Module):
    """A path-traced residual as a function of the free variables."""

    residual: PathTracedResidual
    free: Free

    @classmethod
    def of(cls, residual: PathTracedResidual, free: Free, y: FreeVariables, most: int) -> "SampledProblem":
        """Checks that the Jacobians that a step holds fit into `most` bytes."""
        needed = HELD * 4 * residual.references.count * (size(y) + 1)
        if needed > most:
            raise ValueError(
                f"max_jacobian leaves no room for the Jacobian of {size(y)} parameters and all views, which "
                f"takes {needed} bytes as paths are averaged; got {most}. Raise it, or fit fewer parameters."
            )
        return cls(residual, free)

    @property
    def count(self) -> int:
        """Number of entries."""
        return self.residual.references.count

    @property
    def noise(self) -> Noise | None:
        """Of the references."""
        return self.residual.references.noise

    @property
    def scale(self) -> float:
        """Norm of the references."""
        return self.residual.references.scale()

    def sample(self, at: FreeVariables, step: Int[Array, ""]) -> Sample:
        """At a point, by the random numbers of a step."""
        references, (flat, unravel) = self.residual.references, ravel_pytree(at)
        key = jax.random.fold_in(jax.random.key(self.residual.key), step)
        weight, number, rows = 1 / math.sqrt(references.count), 0, []
        for cameras, images in references.groups:
            numbers = jnp.arange(number, number + len(images), dtype=jnp.uint32)
            number += len(images)

            def of_view(view: Any) -> Array:
                camera, image, number = view
                of_step = jax.random.fold_in(key, number)

                def residual(flat: Array) -> Array:
                    halves = self.halves(self.free.forward(unravel(flat)), camera, of_step)
                    return ((halves - image[None]) * weight).reshape(-1, 3)

                return jacobian(residual, flat)

            found = jax.lax.map(of_view, (cameras, images, numbers))
            of_half = found.reshape(len(images), 2, -1, 3, flat.size + 1)
            rows.append(jnp.swapaxes(of_half, 0, 1).reshape(2, -1, 3, flat.size + 1))
        return Sample(jnp.concatenate(rows, axis=1))

    def halves(self, parameters: PyTree, view: Camera, key: Any) -> Float[Array, "2 height width 3"]:
        """Images by the two halves of the paths."""
        result: Any = self.residual.scene(parameters, view)
        order = "(volume, transfer, camera, lights, materials, anisotropy)"
        if not isinstance(result, tuple) or len(result) not in (5, 6):
            raise ValueError(f"scene must return {order}, the last if it is not 0; got {described(result)}.")
        volume, transfer, camera, lights, materials, anisotropy = cast(Any, (*result, 0.0)[:6])
        check_arguments(order, volume=volume, transfer=transfer, camera=camera)
        if camera.size != view.size:
            raise ValueError(f"scene must return a camera of its view's size {view.size}; got {camera.size}.")
        how: Any = {
            "materials": materials,
            "anisotropy": anisotropy,
            "paths": self.residual.paths,
            "key": key,
        }
        traced = path_trace(volume, transfer, camera, lights, groups=2, **how)
        return traced.images(self.residual.references.background)
