"""Smooth bijections from free variables, real numbers of order 1 that a solver moves, onto allowed values.
The scene is rendered at `forward(free)`, so no step can leave the allowed range."""

from abc import abstractmethod
from types import ModuleType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._util.checks import Arrayable, described, finite_array, number, require
from ..march.transforms.toroidal_map import ToroidalMap
from ..scene.camera import Camera, axes_of
from ..xla.platform import in_numpy
from ..xla.trees import PyTree


MARGIN = 1e-3
"""Minimum distance of a start from an open end, relative to the scale: the map is flat at the end."""

REACH = 0.5
"""Largest relative change of a value, far from 0, over which a function may be almost linear."""


class RigidMotion(NamedTuple):
    """A rotation about a point, and a translation after it: p becomes R (p - center) + center + translation.

    Attributes:
        rotation: rotation vector (exponential map), (3,) radians; (n, 3) for n motions.
        translation: (3,), in world length; (n, 3) for n motions.
        center: the point, (3,), shared by all motions.
    """

    rotation: Arrayable
    translation: Arrayable
    center: Arrayable

    def camera(self, camera: Camera) -> Camera:
        """The camera, moved by a single motion. The volume moves the opposite way in its image."""
        turn, shift, center = (jnp.asarray(part, camera.position.dtype) for part in self)
        points = camera.position, camera.focal_point
        moved = *(rotate(turn, p - center) + center + shift for p in points), rotate(turn, camera.view_up)
        return eqx.tree_at(lambda c: (c.position, c.focal_point, c.view_up), camera, moved)


class Bijection(eqx.Module):
    """A smooth map from free variables, any real numbers, onto the allowed values."""

    per_object: bool = eqx.field(static=True, default=False, init=False)
    """Whether the bijection maps an object, such as a camera, rather than a single array."""

    @abstractmethod
    def forward(self, free: PyTree) -> PyTree:
        """Value at the free variables."""

    @abstractmethod
    def inverse(self, value: PyTree, name: str = "value") -> PyTree:
        """Free variables of a value. **Raises** `ValueError` with `name` for a value that is not allowed."""

    def moved(self, value: PyTree) -> PyTree:
        """Part of a value that the free variables change."""
        return value

    def reach(self, free: PyTree) -> PyTree:
        """Largest change of the free variables over which a function of the value may be almost linear."""
        return jax.tree.map(jnp.ones_like, free)


class Fixed(Bijection):
    """Bijection without free variables: the value stays as it was at the start."""

    start: PyTree = None

    def forward(self, free: None) -> PyTree:
        return self.start

    def inverse(self, value: PyTree, name: str = "value") -> None:
        return None

    def moved(self, value: PyTree) -> None:
        return None


class Unconstrained(Bijection):
    """Identity: the value, any real number, is the free variable."""

    def forward(self, free: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        return free

    def inverse(self, value: Arrayable, name: str = "value") -> Float[Array, "*shape"]:
        return finite_array(name, value, (...,))

    def reach(self, free: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        return jnp.maximum(1, REACH * jnp.abs(free))


class Positive(Bijection):
    """Positive numbers: `scale` · log(1 + exp(free)). A start below `scale` / 1000 is raised to
    `scale` / 1000.

    Args:
        scale: a typical value, in the value's unit, > 0. The map is linear far above it and exponential far
            below.

    Raises:
        ValueError: for a scale that is not positive, and for negative starts.
    """

    scale: Float[Array, ""]

    def __init__(self, scale: Arrayable = 1.0):
        self.scale = number("scale", scale, above=0)

    def forward(self, free: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        return self.scale.astype(free.dtype) * jax.nn.softplus(free)

    def inverse(self, value: Arrayable, name: str = "value") -> Float[Array, "*shape"]:
        message = f"{name} must not be negative to be fitted; got {{got}}."
        value = require(finite_array(name, value, (...,)), lambda v: v >= 0, message)
        xp, (value, scale) = in_numpy(value, self.scale)
        ratio = xp.maximum(value / scale.astype(value.dtype), MARGIN)
        # inverse of softplus, which JAX lacks
        return jnp.asarray(xp.asarray(ratio + xp.log(-xp.expm1(-ratio))), value.dtype)

    def reach(self, free: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        return jnp.maximum(1, REACH * free)  # below 0, free is a logarithm


class UnitInterval(Bijection):
    """Numbers between 0 and 1: 1 / (1 + exp(-free)). Starts keep a distance of 1/1000 from both ends.

    Raises:
        ValueError: for starts outside [0, 1].
    """

    def forward(self, free: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        return jax.nn.sigmoid(free)

    def inverse(self, value: Arrayable, name: str = "value") -> Float[Array, "*shape"]:
        message = f"{name} must be in [0, 1] to be fitted; got {{got}}."
        value = require(finite_array(name, value, (...,)), lambda v: (v >= 0) & (v <= 1), message)
        xp, (inner,) = in_numpy(value)
        inner = xp.clip(inner, MARGIN, 1 - MARGIN)
        return jnp.asarray(xp.asarray(xp.log(inner / (1 - inner))), value.dtype)


class Pose(Bijection):
    """Position and orientation of a camera, as a rigid motion of the camera `start`.

    The free variables are `rotation` (3,), the rotation vector (exponential map) in radians about the
    camera's focal point, and `translation` (3,) of the camera and its focal point, in units of the distance
    between the two. Field of view and size stay fixed. Rotation about the focal point, rather than about the
    camera's position, keeps rotation and translation from imitating each other.

    Args:
        start: the camera at which rotation and translation are 0.

    Raises:
        ValueError: for a camera that is not a rigid motion of `start`.
    """

    per_object: bool = eqx.field(static=True, default=True, init=False)
    start: Camera

    def forward(self, free: dict[str, Float[Array, "3"]]) -> Camera:
        start = jax.lax.stop_gradient(self.start)
        shift = _distance(start) * free["translation"]
        return RigidMotion(free["rotation"], shift, start.focal_point).camera(start)

    def inverse(self, value: Camera, name: str = "value") -> dict[str, Float[Array, "3"]]:
        from scipy.spatial.transform import Rotation  # here, so that a first image does not wait for it

        start, value = jax.device_get((self.start, value))
        invariants = [(c.view_angle, c.parallel_scale, c.window, _distance(c, np)) for c in (start, value)]
        if jax.tree.structure(value) != jax.tree.structure(start) or not all(
            np.allclose(a, b, rtol=1e-5) for a, b in zip(*map(jax.tree.leaves, invariants), strict=True)
        ):
            raise ValueError(
                f"{name} must be a camera that differs from the pose's start only in position and "
                f"orientation, at the same distance from its focal point; got {value} for the start {start}."
            )
        before, after = (np.stack(axes_of(c, np), axis=1).astype(float) for c in (start, value))
        rotation = Rotation.from_matrix(after @ before.T).as_rotvec()
        shift = (value.focal_point - start.focal_point) / _distance(start, np)
        return jax.device_put({"rotation": rotation.astype(shift.dtype), "translation": shift})

    def moved(self, value: Camera) -> dict[str, Float[Array, "3"]]:
        return {name: getattr(value, name) for name in ("position", "focal_point", "view_up")}


def _distance(camera: Camera, xp: ModuleType = jnp) -> Any:
    return xp.linalg.norm(camera.position - camera.focal_point)


def rotate(turn: Float[Array, "3"], vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """Rotate `vector` by a rotation vector (Rodrigues' formula), differentiably also at 0."""
    square = jnp.sum(turn**2)
    small = square < 1e-6
    angle = jnp.sqrt(jnp.where(small, 1, square))  # never at 0, where the slope of sqrt is infinite
    first = jnp.where(small, 1 - square / 6, jnp.sin(angle) / angle)
    second = jnp.where(small, 0.5 - square / 24, 2 * (jnp.sin(angle / 2) / angle) ** 2)
    across = jnp.cross(turn, vector)
    return vector + first * across + second * jnp.cross(turn, across)


class ProbeGeometry(Bijection):
    """Geometry of a swept probe: `a`, `b`, both ranges of angles, and the last depth of a `ToroidalMap`.

    The first depth, `gamma_range[0]`, stays that of `start`, since a length that is added to `b` and
    subtracted from both ends of `gamma_range` has no effect. Images determine the seven other numbers, up to
    scale and position if those of the cameras are unknown, where the scene has edges in all directions and
    its ends are in view. `Fit.uncertainty` names undetermined directions.

    The free variables, of order 1, are the distances of the first sample from the apex and, on the beam
    nearest to it, from the motor axis; the length of a beam; and the logarithms of the ratios in which a
    range of angles divides [0, π]. So every step is a valid probe: no sample lies behind the apex or the
    motor axis, ranges increase, and angles stay within [0, π]. Starts keep a distance of 1/1000 from these
    limits, relative to π or the size of the probe.

    Args:
        start: the probe that sets the typical lengths, and the first depth.

    Raises:
        ValueError: for a value that is not a `ToroidalMap`, that begins at another depth, or that has samples
            behind the motor axis.
    """

    per_object: bool = eqx.field(static=True, default=True, init=False)
    start: ToroidalMap
    length: Positive

    def __init__(self, start: ToroidalMap | Any):
        if not isinstance(start, ToroidalMap):
            raise ValueError(f"start must be a ToroidalMap; got {described(start)}.")
        self.start = start
        _, (b, depths) = in_numpy(start.b, start.gamma_range)
        self.length = Positive(b + depths[1])

    def forward(self, free: dict[str, Any]) -> ToroidalMap:
        start = jax.lax.stop_gradient(self.start)
        near, axis, span = (self.length.forward(free[name]) for name in ("near", "axis", "span"))
        beta, sigma = (_range_of(free[name]) for name in ("beta", "sigma"))
        first = start.gamma_range[0]
        gamma = jnp.stack([first, first + span])
        fields = jnp.zeros_like(near), near - first, beta, sigma, gamma
        probe = eqx.tree_at(
            lambda p: (p.a, p.b, p.beta_range, p.sigma_range, p.gamma_range), self.start, fields
        )
        return eqx.tree_at(lambda p: p.a, probe, axis - probe.nearest_to_axis)

    def inverse(self, value: PyTree, name: str = "value") -> dict[str, Any]:
        if not isinstance(value, ToroidalMap):
            raise ValueError(f"{name} must be a ToroidalMap; got {described(value)}.")
        first, depth = float(self.start.gamma_range[0]), float(value.gamma_range[0])
        if not np.isclose(depth, first, atol=1e-5 * float(self.length.scale)):
            raise ValueError(
                f"{name} must begin at the same depth as the start, gamma_range[0] = {first}; got {depth}. "
                "Add the difference to b."
            )
        nearest = require(
            value.nearest_to_axis,
            lambda axis, size: axis >= -1e-6 * size,
            f"{name} must not have samples behind the motor axis to be fitted: its outermost beams begin at "
            "{got} from it. Raise a, or narrow sigma_range.",
            self.length.scale,
        )
        value = jax.device_get(value)
        near, axis = value.b + value.gamma_range[0], np.maximum(nearest, 0)
        lengths = {"near": near, "axis": axis, "span": value.gamma_range[1] - value.gamma_range[0]}
        free = {key: self.length.inverse(length, f"{name}, {key}") for key, length in lengths.items()}
        return free | {"beta": _ratios(value.beta_range), "sigma": _ratios(value.sigma_range)}

    def moved(self, value: ToroidalMap) -> ToroidalMap:
        """The map with its last depth, which is fitted, in place of `gamma_range`."""
        return eqx.tree_at(lambda probe: probe.gamma_range, value, value.gamma_range[1])


def _ratios(angles: Float[np.ndarray, "2"]) -> Float[Array, "2"]:
    """Logarithms of the angles below and above a range of angles, relative to its width."""
    gaps = np.stack([angles[0], angles[1] - angles[0], np.pi - angles[1]])
    gaps = np.maximum(gaps, MARGIN * np.pi)
    return jnp.asarray(np.log(gaps[::2] / gaps[1]), angles.dtype)


def _range_of(ratios: Float[Array, "2"]) -> Float[Array, "2"]:
    gaps = jnp.pi * jax.nn.softmax(jnp.stack([ratios[0], jnp.zeros_like(ratios[0]), ratios[1]]))
    return jnp.stack([gaps[0], gaps[0] + gaps[1]])
