"""Cameras and other sources of rays: origin and direction of each pixel's ray.

Names and conventions are those of VTK and PyVista: `view_angle` and `parallel_scale` measure the height of
the view. Pixel (0, 0) is at the top left; a pixel's ray passes through its center.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from types import ModuleType
from typing import Any, SupportsIndex, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num

from .._util.checks import (
    Arrayable,
    described,
    finite_array,
    flag,
    integer,
    is_flag,
    number,
    require,
    shortened,
)
from .._util.texts import is_concrete, pasted
from .._util.vec3 import Scalar, Vec3, along, apart, minus, plus
from ..xla.platform import in_numpy, is_traced
from .space import Line
from .volume import Volume


Size: TypeAlias = Sequence[SupportsIndex] | int
"""(width, height) of an image in pixels, or the side of a square one."""

Index: TypeAlias = SupportsIndex | Array
Coordinate: TypeAlias = Num[Array, ""] | float


class Camera(eqx.Module):
    """A pinhole camera, or an orthographic one if `parallel_scale` is given.

    Args:
        position: world position, in JAX's default float type (float32 has steps of half a metre at
            5 846 925 m). It may lie inside a volume (endoscopy); nothing behind it is visible. On a face of
            the volume the image has a kink, and the gradient of a pixel is one-sided; so it is where rays
            run along planes of voxels.
        focal_point: world point at the center of the image.
        view_up: direction that points up in the image; not parallel to the view direction.
        view_angle: angle between the lower and the upper edge of the image, degrees, in (0, 180).
        parallel_scale: half the height of the view, in world length. Makes the camera orthographic, with ray
            origins in the plane through `position`.
        size: (width, height) of the image in pixels; one number is a square.
        window: (left, right, bottom, top) of the visible rectangle of the image plane, relative to its
            center, in half heights of the full view; by default the full view. Set by `crop` and `zoom`.
        corner: (column, row) of the first pixel in the uncropped image, so that pixels of a crop keep their
            random numbers; by default (0, 0). Set by `crop`.

    Raises:
        ValueError: for a camera at its focal point, a `view_up` along the view direction, an angle, scale or
            size out of range, and coordinates of 1e18 or more (in float32).
    """

    position: Float[Array, "3"]
    focal_point: Float[Array, "3"]
    view_up: Float[Array, "3"]
    view_angle: Float[Array, ""]
    parallel_scale: Float[Array, ""] | None
    window: Float[Array, "4"]
    corner: Float[Array, "2"]
    """Whole numbers, stored as floats so that `jax.grad` accepts a camera; their gradient is 0."""
    size: tuple[int, int] = eqx.field(static=True)

    def __init__(
        self,
        position: Arrayable,
        focal_point: Arrayable,
        view_up: Arrayable = (0.0, 1.0, 0.0),
        view_angle: Arrayable = 30.0,
        *,
        size: Size = (512, 512),
        parallel_scale: Arrayable | None = None,
        window: Arrayable | None = None,
        corner: Arrayable | None = None,
    ):
        self.size = width, height = image_size(size)
        self.focal_point = _moderate("focal_point", finite_array("focal_point", focal_point, (3,)))
        self.position = require(
            _moderate("position", finite_array("position", position, (3,))),
            lambda position, focal: (position != focal).any(),
            "position must differ from focal_point; got {got} for both.",
            self.focal_point,
        )
        self.view_up = require(
            finite_array("view_up", view_up, (3,)),
            lambda up, position, focal: _sine(up, focal - position) > 1e-6,
            "view_up must not be zero or point along the view; got {got}.",
            self.position,
            self.focal_point,
        )
        self.view_angle = number("view_angle", view_angle, above=0, below=180, unit="degrees")
        self.parallel_scale = None
        if parallel_scale is not None:
            self.parallel_scale = number("parallel_scale", parallel_scale, above=0)
        window = (-width / height, width / height, -1.0, 1.0) if window is None else window
        self.window = finite_array("window", window, (4,))
        self.corner = finite_array("corner", (0.0, 0.0) if corner is None else corner, (2,))

    def __repr__(self) -> str:
        aspect = self.size[0] / self.size[1]
        usual: dict[str, Any] = {"parallel_scale": None, "window": (-aspect, aspect, -1, 1), "corner": (0, 0)}
        arguments: list[str] = []
        for name in ("position", "focal_point", "view_up", "view_angle", *usual):
            value, expected = getattr(self, name), usual.get(name)
            is_usual = expected is not None and is_concrete(value) and np.allclose(value, expected)
            arguments += [] if is_usual or value is None else [f"{name}={pasted(value)}"]
        return f"Camera({', '.join(arguments)}, size={self.size})"

    @classmethod
    def looking_at(
        cls,
        volume: Volume,
        direction: Arrayable = (0.5, -1.0, 0.4),
        view_up: Arrayable = (0.0, 0.0, 1.0),
        view_angle: Arrayable = 30.0,
        *,
        parallel: bool = False,
        size: Size = (512, 512),
    ) -> "Camera":
        """A camera that sees the whole volume from the side that `direction` points to. As in VTK's
        `ResetCamera`, the bounding sphere just fits into the view.

        Args:
            volume: the `Volume` to look at.
            direction: from the center of the volume to the camera, of any length.
            view_up: as in `Camera`. Within 0.06° of `direction`, y is used instead, or else -z.
            view_angle: degrees. It only sets the distance of an orthographic camera.
            parallel: whether the camera is orthographic.
            size: (width, height) of the image in pixels.

        Raises:
            ValueError: as `Camera` does, for a `direction` or `view_up` of 0, and if `volume` is not a
                `Volume`.
        """
        if not isinstance(volume, Volume):
            raise ValueError(f"volume must be a jaxvol Volume; got {described(volume)}.")
        direction, view_up = (
            require(finite_array(name, vector, (3,)), lambda v: (v != 0).any(), f"{name} must not be zero.")
            for name, vector in (("direction", direction), ("view_up", view_up))
        )
        view_angle = number("view_angle", view_angle, above=0, below=180, unit="degrees")
        width, height = image_size(size)
        cells = np.array(volume.shape, volume.spacing.dtype) - 1
        place, aspect = (volume.origin, volume.spacing, volume.direction, cells), min(1.0, width / height)
        with np.errstate(over="ignore"):  # refused below
            view = _fitted_view(*in_numpy(place, direction, view_up, view_angle, aspect))
        position, center, up, scale = view
        position = jnp.asarray(position.astype(direction.dtype), direction.dtype)
        position = _moderate("volume, as seen from the camera,", position)
        scale = scale if flag("parallel", parallel) else None
        return cls(position, center, up, view_angle, size=size, parallel_scale=scale)

    @classmethod
    def from_intrinsics(cls, K: Arrayable, R: Arrayable, t: Arrayable, size: Size) -> "Camera":
        """The calibrated camera of OpenCV and COLMAP, which sees a world point x at the homogeneous pixel
        coordinates K (R x + t). Differentiable with respect to K, R and t.

        Args:
            K: ((fx, 0, cx), (0, fy, cy), (0, 0, 1)) in pixels, without skew. The first pixel reaches from 0
                to 1 and has its center at 0.5, as in COLMAP. OpenCV's `calibrateCamera` has centers at
                integers: add 0.5 to its cx and cy. Undistort images first.
            R: (3, 3), the rotation from the world to the camera's axes: x to the right of the image, y down,
                z forward.
            t: (3,), the world's origin in the camera's axes, world length.
            size: (width, height) of the image in pixels.

        Raises:
            ValueError: for another form of `K`, an `R` that is no rotation (up to 0.001), and the errors of
                `Camera`.
        """
        K = require(
            finite_array("K", K, (3, 3)),
            lambda k: (
                ((k[0, 0] > 0) & (k[1, 1] > 0) & (k[2, 2] == 1))
                & ((k[0, 1] == 0) & (k[1, 0] == 0) & (k[2, 0] == 0) & (k[2, 1] == 0))
            ),
            "K must be ((fx, 0, cx), (0, fy, cy), (0, 0, 1)), fx and fy above 0, without skew; got {got}.",
        )
        message = "R must be a rotation, whose rows are orthonormal and right-handed; got {got}."
        R, t = require(finite_array("R", R, (3, 3)), _is_rotation, message), finite_array("t", t, (3,))
        size = image_size(size)
        place, window = _calibrated(K, R, t, np.array(size, K.dtype))
        return cls(*place, view_angle=90, size=size, window=window)

    @classmethod
    def from_detector(
        cls,
        source: Arrayable,
        center: Arrayable,
        right: Arrayable,
        down: Arrayable,
        pixel_pitch: Arrayable,
        size: Size,
        *,
        parallel: bool = False,
    ) -> "Camera":
        """The camera of an X-ray machine, such as a C-arm: a flat detector seen from the source.
        Differentiable with respect to the geometry. Rays continue behind it; `render(until=)` ends them.

        Args:
            source: world position of the focal spot.
            center: world position of the middle of the detector.
            right: direction in which the image's columns count up, of any length.
            down: direction in which its rows count up, perpendicular to `right`; it may be seen from behind.
            pixel_pitch: distance between pixels, world length; or (along `right`, along `down`).
            size: (width, height) of the detector in pixels.
            parallel: whether rays run perpendicular to the detector, from the plane through `source`.

        Raises:
            ValueError: for directions that are not perpendicular (up to 0.001), a pitch that is not positive,
                and the errors of `Camera` (whose position is the source).
        """
        source, center = finite_array("source", source, (3,)), finite_array("center", center, (3,))
        right = require(
            finite_array("right", right, (3,)),
            lambda a, b: abs((a * b).sum()) < 1e-3 * ((a * a).sum() * (b * b).sum()) ** 0.5,
            "right must be perpendicular to down, and neither may be zero; got {got} for right.",
            down := finite_array("down", down, (3,)),
        )
        pitch = finite_array("pixel_pitch", pixel_pitch, (2,) if np.shape(pixel_pitch) else ())
        pitch = require(pitch, lambda p: p > 0, "pixel_pitch must be greater than 0; got {got}.")
        size, parallel = image_size(size), flag("parallel", parallel)
        place, window = _facing(source, center, right, down, pitch, np.array(size, source.dtype), parallel)
        scale = 1 if parallel else None
        return cls(*place, view_angle=90, size=size, window=window, parallel_scale=scale)

    def crop(self, left: Index, top: Index, width: SupportsIndex, height: SupportsIndex) -> "Camera":
        """A camera that renders a rectangle of the image: the same pixels, jitter included, except that the
        rounding of `window` turns rays by 1e-7 in float32. For 256³ voxels and a hard edge of the transfer
        function, that changes up to one pixel in fifty by 2e-5 to 1e-3. Where it decides whether a sample is
        visible, a pixel jumps: by 0.03 in ten pixels of a large volume.

        Args:
            left: column of the rectangle's first pixel.
            top: row of the rectangle's first pixel. If `left` or `top` is traced, so that all patches share
                one program, a rectangle beyond the image is not refused: it shows the continued view.
            width: number of columns.
            height: number of rows.

        Raises:
            ValueError: for a rectangle that is empty or extends beyond the image, and a `left` or `top` that
                is no integer.
        """
        width, height = integer("width", width, 1), integer("height", height, 1)
        if is_traced(left, top):
            column, row = jnp.asarray(left), jnp.asarray(top)
            if not all(jnp.issubdtype(edge.dtype, jnp.integer) for edge in (column, row)):
                got = f"got {described(left)} and {described(top)}"
                raise ValueError(f"left and top must be integers; {got}.")
        else:
            column, row = integer("left", left, 0), integer("top", top, 0)
            if column + width > self.size[0] or row + height > self.size[1]:
                got = f"got left={column}, top={row}, width={width}, height={height}"
                raise ValueError(f"crop must be a rectangle inside the image of {self.size} pixels; {got}.")
        xp, (view, *_) = in_numpy(self, left, top)
        x = [view._column(edge) for edge in (column, column + width)]
        y = [view._row(edge) for edge in (row + height, row)]
        camera = replace(self, window=xp.stack([*x, *y]), size=(width, height), corner=None)
        corner = view.corner + xp.asarray([column, row], self.corner.dtype)
        return eqx.tree_at(lambda camera: camera.corner, camera, jnp.asarray(corner, self.corner.dtype))

    def zoom(self, factor: Arrayable, center: Arrayable = (0.5, 0.5)) -> "Camera":
        """A camera that shows 1/`factor` of the view's width and height at the same image size, in the same
        perspective. Its `corner` is (0, 0): a zoomed crop is a new image.

        Args:
            factor: magnification of the image, > 0.
            center: the image's new center, in fractions of width and height from the top left.
        """
        factor = number("zoom factor", factor, above=0)
        window = _zoomed(*in_numpy(self.window, factor, finite_array("center", center, (2,))))
        return replace(self, window=window, corner=None)

    @property
    def valid(self) -> Any:
        """True if angle, scale and `view_up` are as the constructor requires; else all rays are NaN."""
        height = self.view_angle if self.parallel_scale is None else self.parallel_scale
        return _is_valid(height, self.parallel_scale is None, self.view_up, self.focal_point - self.position)

    def ray(self, column: Coordinate, row: Coordinate) -> tuple[Vec3, Vec3]:
        """Origin and unit direction of one pixel's ray; fractional pixels give rays in between."""
        return self.ray_from(None, column, row)

    def ray_from(self, anchor: Vec3 | None, column: Coordinate, row: Coordinate) -> tuple[Vec3, Vec3]:
        """Origin, relative to `anchor`, and unit direction of one pixel's ray."""
        offset, direction = self.beside(column, row)
        place = apart(self.position) if anchor is None else minus(apart(self.position), anchor)
        return place if offset is None else plus(place, offset), direction

    def beside(self, column: Coordinate, row: Coordinate) -> tuple[Vec3 | None, Vec3]:
        """Offset of a ray's origin from the camera's position, None in perspective; and unit direction."""
        dtype = self.position.dtype
        column, row = jnp.asarray(column, dtype), jnp.asarray(row, dtype)
        x, y = self._column(column + 0.5), self._row(row + 0.5)
        right, up, forward = (apart(axis) for axis in axes_of(self))
        scale = self.parallel_scale
        if scale is not None:
            scale = jnp.where(self.valid, scale, jnp.nan)
            x, y = scale * x, scale * y
            a, b, c = (x * r + y * u for r, u in zip(right, up, strict=True))
            return (a, b, c), forward
        scale = jnp.where(self.valid, jnp.tan(jnp.deg2rad(self.view_angle) / 2), jnp.nan)
        dx, dy, dz = along(along(forward, right, scale * x), up, scale * y)
        norm = jnp.sqrt(dx * dx + dy * dy + dz * dz)
        return None, (dx / norm, dy / norm, dz / norm)

    def point(self, column: Arrayable, row: Arrayable, depth: Arrayable) -> Float[Array, "*pixels 3"]:
        """The world point at a distance along a pixel's ray, to pick what is visible there:
        `camera.point(column, row, rendering.depth[row, column])`. Arrays give an array of points.

        Args:
            column: column of the pixel.
            row: row of the pixel.
            depth: distance from the ray's origin.

        Returns:
            The point; NaN where the depth is infinite, since nothing is visible.
        """
        return _points(self, *(jnp.asarray(value, self.position.dtype) for value in (column, row, depth)))

    @eqx.filter_jit  # compiled like the renderer's rays, so that both round the same way
    def rays(self) -> tuple[Float[Array, "height width 3"], Float[Array, "height width 3"]]:
        """Origins and unit directions of the rays of all pixels, indexed `[row, column]`."""
        width, height = self.size
        over_row = jax.vmap(self.ray, in_axes=(0, None))
        origin, direction = jax.vmap(over_row, in_axes=(None, 0))(jnp.arange(width), jnp.arange(height))
        return jnp.stack(origin, axis=-1), jnp.stack(direction, axis=-1)

    @property
    def first_pixel(self) -> tuple[Int[Array, ""], Int[Array, ""]]:
        """`corner`, as integers."""
        column, row = jnp.round(self.corner).astype(jnp.int32)
        return column, row

    def _column(self, column: Any) -> Any:
        """Image-plane x of a column; integers are pixel edges."""
        low, high, _, _ = self.window
        return low + (high - low) * (column / self.size[0])

    def _row(self, row: Any) -> Any:
        _, _, bottom, top = self.window
        return top - (top - bottom) * (row / self.size[1])


class GivenRays(eqx.Module):
    """World origins and unit directions. A ray's pixel, (column, row), seeds its random numbers; without
    `pixels` it is (`first` + index in the flattened array, 0)."""

    origins: Float[Array, "*rays 3"]
    directions: Float[Array, "*rays 3"]
    pixels: Int[Array, "*rays 2"] | None = None
    first: Int[Array, ""] | int = 0

    def pixel(self, index: Int[Array, "*batch"]) -> tuple[Int[Array, "*batch"], Int[Array, "*batch"]]:
        """The pixels of the rays at these indices."""
        if self.pixels is None:
            index = index.astype(jnp.int32)  # from 64 bits under x64
            return self.first + index, jnp.zeros_like(index)
        flat = self.pixels.reshape(-1, 2)
        return flat[index, 0], flat[index, 1]

    def line(self, index: Int[Array, ""]) -> Line:
        """The ray at this index of the flattened array."""
        (x, y, z), (dx, dy, dz) = (rays.reshape(-1, 3)[index] for rays in (self.origins, self.directions))
        return Line((x, y, z), (dx, dy, dz), self.pixel(index))


class Ending(eqx.Module):
    """Rays with end distances `until` from their origins; infinite for rays that continue to the exit."""

    rays: Camera | GivenRays
    until: Float[Array, "*rays"]


class RaySubset(eqx.Module):
    """Selected rays of an image, by indices into the flattened image."""

    rays: Camera | GivenRays | Ending
    indices: Int[Array, " n"]


def without_ends(source: Camera | GivenRays | Ending | RaySubset) -> Camera | GivenRays:
    """Unwrap the camera or `GivenRays` from end distances and subsets."""
    return source if isinstance(source, Camera | GivenRays) else without_ends(source.rays)


def finer(camera: Camera, n: int) -> Camera:
    """The same view with n x n pixels for each pixel of `camera`."""
    width, height = camera.size
    return replace(camera, size=(n * width, n * height), corner=n * camera.corner)


def axes_of(camera: Camera, xp: ModuleType = jnp) -> tuple[Any, Any, Any]:
    """Unit vectors right, up and forward of the image; `xp`: `jax.numpy` or `numpy`."""
    place = camera.focal_point, camera.position, camera.view_up
    focal, position, up = place if xp is jnp else map(np.asarray, place)
    forward = focal - position
    forward = forward / xp.linalg.norm(forward)
    right = xp.cross(forward, up)
    right = right / xp.linalg.norm(right)
    return right, xp.cross(right, forward), forward


def _fitted_view(xp: Any, arguments: Any) -> tuple[Any, ...]:
    """Position, focal point, up direction and parallel scale of the view of a volume's bounding sphere."""
    (origin, spacing, turn, cells), direction, up, angle, aspect = arguments
    across = cells * spacing
    across = across if turn is None else (turn * across[None, :]).sum(axis=1)
    center, radius = origin + across / 2, xp.linalg.norm(across) / 2
    half = xp.arctan(xp.tan(xp.deg2rad(angle) / 2) * aspect)
    position = center + direction / xp.linalg.norm(direction) * radius / xp.sin(half)
    y, minus_z = np.array([0, 1, 0], direction.dtype), np.array([0, 0, -1], direction.dtype)
    fallback = xp.where(_sine(y, direction) > 1e-3, y, minus_z)
    up = xp.where(_sine(up, direction) > 1e-3, up, fallback)
    return position, center, up, radius / aspect


@eqx.filter_jit
def _points(camera: Camera, columns: Array, rows: Array, depths: Array) -> Float[Array, "*pixels 3"]:
    def point_at(column: Scalar, row: Scalar, depth: Scalar) -> Float[Array, "3"]:
        point = jnp.stack(along(*camera.ray(column, row), jnp.where(jnp.isinf(depth), 0, depth)))
        return jnp.where(jnp.isinf(depth), jnp.nan, point)

    return jnp.vectorize(point_at, signature="(),(),()->(k)")(columns, rows, depths)


@jax.jit
def _calibrated(k: Array, r: Array, t: Array, size: Array) -> tuple[list[Array], Array]:
    """Position, focal point and up of a calibrated camera, and its window for a view angle of 90°."""
    position = -jnp.sum(r * t[:, None], axis=0)
    # as far as the world's origin, since a near point would be rounded
    distance = 1 + jax.lax.stop_gradient(jnp.linalg.norm(t))
    focal, middle = jnp.diagonal(k)[:2], k[:2, 2]
    low, high = -middle / focal, (size - middle) / focal
    window = jnp.stack([low[0], high[0], -high[1], -low[1]])
    return [position, position + distance * r[2], -r[1]], window


@partial(jax.jit, static_argnums=6)
def _facing(
    source: Array, center: Array, right: Array, down: Array, pitch: Array, size: Array, parallel: bool
) -> tuple[list[Array], Array]:
    """Position, focal point and up, and the window for a view angle of 90° or a parallel scale of 1."""
    right, down = (axis / jnp.linalg.norm(axis) for axis in (right, down))
    to_center, normal = center - source, jnp.cross(right, down)
    distance = jnp.sum(normal * to_center)
    middle = jnp.stack([jnp.sum(axis * to_center) for axis in (right, down)])
    scale = 1 if parallel else jnp.abs(distance)
    low, high = ((middle + sign * size * pitch / 2) / scale for sign in (-1, 1))
    side = jnp.sign(distance)  # seen from behind, the image's columns run to the left of the camera
    window = jnp.stack([side * low[0], side * high[0], -high[1], -low[1]])
    return [source, source + distance * normal, -down], window


def _zoomed(xp: Any, arguments: Any) -> Any:
    """1/`factor` of a window around a center; `arguments`: (window, factor, center)."""
    (x_min, x_max, y_min, y_max), factor, center = arguments
    x, y = x_min + (x_max - x_min) * center[0], y_max - (y_max - y_min) * center[1]
    half_x, half_y = (x_max - x_min) / 2 / factor, (y_max - y_min) / 2 / factor
    return xp.stack([x - half_x, x + half_x, y - half_y, y + half_y])


def _is_valid(height: Any, is_angle: bool, up: Any, forward: Any) -> Any:
    # a margin, since the constructor may round another way
    has_plane = _sine(up, forward / abs(forward).max()) > 0.5e-6
    return (height > 0) & ((height < 180) | (not is_angle)) & has_plane


def _sine(a: Any, b: Any) -> Any:
    """Sine of the angle between two vectors; 0 if one is zero."""
    across = sum((a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2]) ** 2 for i in range(3))
    lengths = (a * a).sum() * (b * b).sum()
    return (across / (lengths + (lengths == 0).astype(lengths.dtype))) ** 0.5


def _is_rotation(r: Any) -> Any:
    """True if the rows of a matrix are orthonormal and right-handed, up to 0.001."""
    x, y, z = r
    across = [x[i - 2] * y[i - 1] - x[i - 1] * y[i - 2] - z[i] for i in range(3)]
    errors = (x * x).sum() - 1, (y * y).sum() - 1, (x * y).sum(), *across
    return sum(error * error for error in errors) < 1e-6


def _moderate(name: str, point: Float[Array, "3"]) -> Float[Array, "3"]:
    """A point checked for squared lengths that do not overflow; unchecked if traced, the image is NaN."""
    if is_traced(point):
        return point
    limit = float(jnp.finfo(point.dtype).max) ** 0.5 / 16
    message = f"{name} must have coordinates below {limit:.1e}, since squares of larger ones overflow; use a "
    return require(point, lambda p: abs(p) < limit, f"{message}greater unit of length. Got {{got}}.")


def image_size(size: Size) -> tuple[int, int]:
    """(width, height) of an image, checked. **Raises** `ValueError` for a bad `size`."""
    pair: Any = (size, size) if isinstance(size, int) and not is_flag(size) else size
    try:
        width, height = (int(n) for n in pair)
        integral = (width, height) == tuple(pair)
    except (TypeError, ValueError, OverflowError):
        width = height = integral = 0
    if not integral or min(width, height) < 1 or width * height >= 2**31:
        expected = "(width, height) in whole pixels, fewer than 2**31 in all and each at least 1"
        raise ValueError(f"size must be {expected}; got {shortened(pair)}.")
    return width, height
