"""Smooth bijections from unconstrained real numbers onto the values that a parameter may take.

A solver moves the free variables, `free`; what is rendered is `forward(free)`, so no step can leave the
allowed range. Free variables are of order 1 whatever the parameter's units, which suits a damped step.
"""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logit
from jaxtyping import Array, Float

from .._util.checks import Arrayable, finite_array, number, require
from ..scene.camera import Camera, axes_of


MARGIN = 1e-3
"""A start closer than this to an open end of the range (relative to the scale) is moved to this distance from
it: at the end itself the map is flat, and a fit could never leave it."""


class Bijection(eqx.Module):
    """A smooth map from free variables, any real numbers, onto the allowed values."""

    whole: bool = eqx.field(static=True, default=False, init=False)
    """Whether it maps a whole object, such as a camera, rather than each array separately."""

    @abstractmethod
    def forward(self, free: Any) -> Any:
        """Value for these free variables."""

    @abstractmethod
    def inverse(self, value: Any, name: str = "value") -> Any:
        """Free variables for a value.

        **Raises:** `ValueError`, naming `name`, for a value that is not allowed.
        """

    def moved(self, value: Any) -> Any:
        """Parts of a value that the free variables change."""
        return value


class Fixed(Bijection):
    """No free variables: the value stays as it was at the start."""

    def forward(self, free: Any) -> Any:
        raise ValueError("Fixed has no free variables: the caller keeps the value.")

    def inverse(self, value: Any, name: str = "value") -> None:
        return None


class Unconstrained(Bijection):
    """Any real number: the value is the free variable itself."""

    def forward(self, free: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        return free

    def inverse(self, value: Arrayable, name: str = "value") -> Float[Array, "*shape"]:
        return _finite(value, name)


class Positive(Bijection):
    """Positive numbers: `scale` · log(1 + exp(free)).

    **Arguments:**

    - `scale`: a typical value, in the value's unit, > 0. The map is linear far above it and exponential far
      below.

    A start at 0, or below `scale` / 1000, is raised to `scale` / 1000.

    **Raises:** `ValueError` for a scale that is not positive, and for negative starts.
    """

    scale: Float[Array, ""]

    def __init__(self, scale: Arrayable = 1.0):
        self.scale = number("scale", scale, above=0)

    def forward(self, free: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        return self.scale.astype(free.dtype) * jax.nn.softplus(free)

    def inverse(self, value: Arrayable, name: str = "value") -> Float[Array, "*shape"]:
        value = require(
            _finite(value, name), lambda v: v >= 0, f"{name} must not be negative to be fitted; got {{got}}."
        )
        part = jnp.maximum(value / self.scale.astype(value.dtype), MARGIN)
        return part + jnp.log(-jnp.expm1(-part))  # inverse of softplus, which JAX lacks


class UnitInterval(Bijection):
    """Numbers between 0 and 1: 1 / (1 + exp(-free)).

    A start within 1/1000 of an end is moved to that distance from it.

    **Raises:** `ValueError` for starts outside [0, 1].
    """

    def forward(self, free: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        return jax.nn.sigmoid(free)

    def inverse(self, value: Arrayable, name: str = "value") -> Float[Array, "*shape"]:
        value = require(
            _finite(value, name),
            lambda v: (v >= 0) & (v <= 1),
            f"{name} must be in [0, 1] to be fitted; got {{got}}.",
        )
        return logit(jnp.clip(value, MARGIN, 1 - MARGIN))


class Pose(Bijection):
    """Position and orientation of a camera, as a rigid motion of the camera `start`.

    The free variables are `rotation` (3,), the rotation vector (exponential map) in radians, about the
    camera's focal point, and `translation` (3,), of both camera and focal point, in units of the distance
    between the two. Everything else (field of view, size) stays fixed. Rotating about the focal point, rather
    than about the camera itself, keeps rotation and translation from imitating each other.

    **Raises:** `ValueError` for a camera that is not a rigid motion of `start`.
    """

    whole: bool = eqx.field(static=True, default=True, init=False)
    start: Camera

    def forward(self, free: dict[str, Float[Array, "3"]]) -> Camera:
        start = jax.lax.stop_gradient(self.start)
        arm = start.position - start.focal_point
        focal_point = start.focal_point + jnp.linalg.norm(arm) * free["translation"]
        return eqx.tree_at(
            _moved,
            self.start,
            (
                focal_point + rotate(free["rotation"], arm),
                focal_point,
                rotate(free["rotation"], start.view_up),
            ),
        )

    def inverse(self, value: Camera, name: str = "value") -> dict[str, Float[Array, "3"]]:
        from scipy.spatial.transform import Rotation  # here, so that a first image does not wait for it

        start = self.start
        invariants = [(c.view_angle, c.parallel_scale, c.window, _distance(c)) for c in (start, value)]
        same = jax.tree.structure(value) == jax.tree.structure(start) and all(
            np.allclose(a, b, rtol=1e-5) for a, b in zip(*map(jax.tree.leaves, invariants), strict=True)
        )
        if not same:
            raise ValueError(
                f"{name} must be a camera that differs from the pose's start only in position and "
                f"orientation, at the same distance from its focal point; got {value} for the start {start}."
            )
        axes = [np.stack([np.asarray(axis, float) for axis in axes_of(c)], axis=1) for c in (start, value)]
        rotation = Rotation.from_matrix(axes[1] @ axes[0].T).as_rotvec()
        shift = (value.focal_point - start.focal_point) / _distance(start)
        return {"rotation": jnp.asarray(rotation, shift.dtype), "translation": shift}

    def moved(self, value: Camera) -> dict[str, Float[Array, "3"]]:
        return dict(zip(("position", "focal_point", "view_up"), _moved(value), strict=True))


def _moved(camera: Camera) -> tuple[Any, Any, Any]:
    return camera.position, camera.focal_point, camera.view_up


def _distance(camera: Camera) -> Float[Array, ""]:
    return jnp.linalg.norm(camera.position - camera.focal_point)


def rotate(turn: Float[Array, "3"], vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """`vector` rotated about the axis `turn` by its length in radians (Rodrigues' formula). Smooth at 0.

    Written out because the slope of JAX's own `Rotation` is NaN at 0, where every fit of a pose starts.
    """
    square = jnp.sum(turn**2)
    small = square < 1e-6
    angle = jnp.sqrt(jnp.where(small, 1, square))  # never at 0, where the slope of sqrt is infinite
    first = jnp.where(small, 1 - square / 6, jnp.sin(angle) / angle)
    second = jnp.where(small, 0.5 - square / 24, 2 * (jnp.sin(angle / 2) / angle) ** 2)
    across = jnp.cross(turn, vector)
    return vector + first * across + second * jnp.cross(turn, across)


def _finite(value: Arrayable, name: str) -> Array:
    return finite_array(name, value, (None,) * np.ndim(value))
