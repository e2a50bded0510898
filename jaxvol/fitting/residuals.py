"""Residuals of a fit, in tiles that fit into memory, and the QR factor that a least-squares solver needs.

A least-squares solver uses the residual r (m,) and its Jacobian J (m, n). With millions of pixels J is too
large to hold, but a Gauss–Newton or Levenberg–Marquardt step needs only the triangle of

    [J r] = Q [R c; 0 ρ]      with      |J d + r|² = |R d + c|² + ρ²   for every step d,

which is (n + 1, n + 1) and is computed tile by tile, by QR of the triangle so far and the tile's rows (TSQR,
Demmel et al. 2012). A residual of n + 1 numbers with the Jacobian [R; 0] thus replaces that of all pixels
exactly, for any solver; unlike JᵀJ, it does not square the condition number.
"""

import math
from abc import abstractmethod
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from .._util.checks import Arrayable, described, finite, finite_array, require
from ..compositing.blending import Compositing
from ..compositing.modes import Mode, compositing_of
from ..lighting.shading import Lighting
from ..march.march import March
from ..ray import check_arguments
from ..render import Adjoint, render
from ..scene.camera import Camera, rows_of
from ..scene.transfer import Transfer
from ..scene.volume import Volume
from ..xla.trees import PyTree
from .constraints import Free, FreeVariables, size


TANGENTS = 64
"""Columns of the Jacobian computed at once: a march keeps its state for each of them."""


class Tiles(NamedTuple):
    """Pieces of a residual, of equal shape: `residual(parameters, item, adjoint)` of each stacked item."""

    residual: Callable[[PyTree, Any, Adjoint], Float[Array, " entries"]]
    items: PyTree


class Residual(eqx.Module):
    """What a fit minimises: the loss is half the sum of its squares."""

    @abstractmethod
    def tiles(self, most: int) -> list[Tiles]:
        """The residual in pieces of at most `most` entries."""

    @abstractmethod
    def count(self) -> int:
        """Total number of entries."""

    def scale(self) -> float:
        """Norm of the compared data: changes within its rounding carry no information. 0 if unknown."""
        return 0.0


def check_residual(residual: Any) -> None:
    """Reject what is not a residual, including a transfer function, which is callable, too."""
    if isinstance(residual, Transfer) or not (callable(residual) or isinstance(residual, Residual)):
        raise ValueError(
            "residual must be an ImageResidual, or a function from parameters to arrays; "
            f"got {described(residual)}. The order is fit(residual, parameters)."
        )


class OwnResidual(Residual):
    """A residual given as a function from parameters to arrays, in one piece."""

    function: Callable[[PyTree], PyTree]
    length: int

    @classmethod
    def of(cls, function: Any, parameters: PyTree) -> "OwnResidual":
        shapes = jax.tree.leaves(eqx.filter_eval_shape(function, parameters))
        count = sum(math.prod(leaf.shape) for leaf in shapes)
        if count == 0:
            raise ValueError("residual must return at least one number; got none.")
        return cls(function, count)

    def count(self) -> int:
        return self.length

    def tiles(self, most: int) -> list[Tiles]:
        if self.length > most:
            raise ValueError(
                f"max_jacobian leaves room for {most} of the residual's {self.length} entries, and a "
                "custom function is not split into tiles. Raise max_jacobian, or use an ImageResidual."
            )

        def residual(parameters: PyTree, item: Any, adjoint: Adjoint) -> Array:
            return ravel_pytree(self.function(parameters))[0]

        return [Tiles(residual, jnp.zeros(1))]


class _Group(eqx.Module):
    """Stacked views of the same size and kind."""

    cameras: Camera
    images: Float[Array, "views height width channels"]


SceneParts = tuple[Volume, Transfer, Camera, March] | tuple[Volume, Transfer, Camera, March, Lighting | None]
SceneFunction = Callable[[Any, Camera], SceneParts]


class ImageResidual(Residual):
    """Rendered images minus reference images, as the residual of a fit.

    **Arguments:**

    - `scene`: `scene(parameters, camera)` returns what to render for the parameters and a view's camera:
      `(volume, transfer, camera, march)`, and `lighting` as a fifth entry if it is lit. The solver chooses
      the adjoint.
    - `views`: pairs (camera, image), at least one. An image is (height, width, 3), linear RGB over
      `background`, or (height, width, 4), as `Rendering.rgba`.
    - `background`: linear RGB behind the volume, for three-channel images.
    - `compositing`: as in `render`.
    - `blur`: compare blurred images: standard deviation of a Gaussian, in parts of the image's height.
      `fit_coarse_to_fine` finds a geometry whose start is off by more than the size of features. Whole
      images are then differentiated at once. Pixels beyond the border do not count. Standard errors are too
      small, since the noise of blurred pixels is not independent: take those of a last fit without blur.

    The residual is divided by the square root of the number of its entries, so that the loss, half the
    sum of squares, is half the mean squared error: an error of PSNR p dB has the loss 10^(-p/10) / 2.

    A Jacobian that is too large is computed in tiles of whole image rows.

    **Raises:** `ValueError` for no views, an image that differs in size from its camera or holds integers,
    NaN or infinite pixels, a negative `blur`, and a scene that returns something else; and when it is fitted,
    for blurred images that `max_jacobian` leaves no room for.
    """

    scene: SceneFunction
    groups: list[_Group]
    background: Float[Array, "3"]
    compositing: Compositing[Any]
    blur: Float[Array, ""] | None

    def __init__(
        self,
        scene: SceneFunction | Any,
        views: Iterable[tuple[Camera, Arrayable]] | Any,
        background: Arrayable = (1.0, 1.0, 1.0),
        *,
        compositing: Mode | Compositing[Any] | Any = "over",
        blur: Arrayable | None = None,
    ):
        if not callable(scene):
            raise ValueError(f"scene must be a function of parameters and camera; got {scene!r}.")
        self.scene = cast(SceneFunction, scene)
        self.background = finite_array("background", background, (3,))
        self.compositing = compositing_of(compositing)
        self.blur = None if blur is None else not_negative("blur", blur)
        views = list(views) if isinstance(views, Iterable) else []
        if not views:
            raise ValueError("views must hold at least one pair (camera, image); got none.")
        by_kind: dict[Any, list[tuple[Camera, Array]]] = {}
        for number, view in enumerate(views):
            camera, image = _view(number, view)
            by_kind.setdefault((jax.tree.structure(camera), image.shape), []).append((camera, image))
        self.groups = [
            _Group(*jax.tree.map(lambda *leaves: jnp.stack(leaves), *group)) for group in by_kind.values()
        ]

    def blurred(self, blur: Arrayable | None) -> "ImageResidual":
        """The same residual, of images blurred otherwise."""
        sigma = None if blur is None else not_negative("blur", blur)
        return eqx.tree_at(lambda residual: residual.blur, self, sigma, is_leaf=lambda leaf: leaf is None)

    def count(self) -> int:
        return sum(group.images.size for group in self.groups)

    def scale(self) -> float:
        squares = sum(float(jnp.sum(group.images**2)) for group in self.groups)
        return math.sqrt(squares / self.count())

    def tiles(self, most: int) -> list[Tiles]:
        return [self._tiles(group, most) for group in self.groups]

    def _tiles(self, group: _Group, most: int) -> Tiles:
        views, height, width, channels = group.images.shape
        if most < width * channels:
            raise ValueError(
                f"max_jacobian leaves room for {most} entries of the residual, and one row of an image has "
                f"{width * channels}. Raise max_jacobian, or fit fewer parameters."
            )
        pieces = math.ceil(height / min(height, most // (width * channels)))
        if pieces > 1 and self.blur is not None:
            raise ValueError(
                f"max_jacobian leaves room for {most} entries of the residual, and blurred images are not "
                f"split: one has {height * width * channels}. Raise max_jacobian, or leave out blur."
            )
        rows = math.ceil(height / pieces)
        weight = 1 / math.sqrt(self.count())

        def residual(parameters: PyTree, item: tuple[Array, Array], adjoint: Adjoint) -> Array:
            view, first = item
            volume, transfer, camera, march, lighting = self._scene(parameters, group, view)
            if pieces > 1:
                camera = rows_of(camera, first, rows)
            rendering = render(
                *(volume, transfer, camera, march),
                compositing=self.compositing,
                lighting=lighting,
                outputs="rgba",
                adjoint=adjoint,
            )
            rendered = rendering.rgba if channels == 4 else rendering.image(self.background)
            row = first + jnp.arange(rows)
            reference = group.images[view, jnp.minimum(row, height - 1)]
            # the last piece may reach past the image
            inside = (row < height)[:, None, None]
            difference = jnp.where(inside, (rendered - reference) * weight, 0)
            if self.blur is not None:
                for axis, n in enumerate((height, width)):
                    kernel = _blurring(n, self.blur * height)
                    difference = jnp.moveaxis(jnp.tensordot(kernel, difference, axes=(1, axis)), 0, axis)
            return difference.reshape(-1)

        view, piece = np.divmod(np.arange(views * pieces), pieces)
        return Tiles(residual, (jnp.asarray(view), jnp.asarray(piece * rows)))

    def _scene(
        self, parameters: PyTree, group: _Group, view: Int[Array, ""]
    ) -> tuple[Volume, Transfer, Camera, March, Lighting | None]:
        of_view = jax.tree.map(lambda leaf: leaf[view], group.cameras)
        result = cast(Any, self.scene(parameters, of_view))
        if not isinstance(result, tuple) or len(result) not in (4, 5):
            raise ValueError(
                "scene must return (volume, transfer, camera, march), and lighting if it is lit; got "
                f"{described(result)}."
            )
        names = "volume", "transfer", "camera", "march", "lighting"
        check_arguments(f"({', '.join(names)})", **dict(zip(names, result, strict=False)))
        if result[2].size != of_view.size:
            raise ValueError(
                f"scene must return a camera of its view's size {of_view.size}; got {result[2].size}."
            )
        return (*result, None) if len(result) == 4 else result


def cameras_of(residual: ImageResidual) -> list[Camera]:
    """Cameras of all views of a residual."""
    return [
        jax.tree.map(lambda leaf, view=view: leaf[view], group.cameras)
        for group in residual.groups
        for view in range(len(group.images))
    ]


def not_negative(name: str, value: Arrayable) -> Float[Array, ""]:
    """`value` as a number of at least 0."""
    message = f"{name} must not be negative; got {{got}}."
    return require(finite_array(name, value, ()), lambda sigma: sigma >= 0, message)


def _blurring(n: int, sigma: Float[Array, ""]) -> Float[Array, "n n"]:
    """Matrix that blurs a line of `n` pixels by a Gaussian, `sigma` in pixels; the identity for 0. Weights of
    the pixels that exist sum to 1."""
    at = jnp.arange(n, dtype=sigma.dtype)
    away = (at[:, None] - at[None, :]) / jnp.maximum(sigma, 1e-3)
    return jax.nn.softmax(-(away**2) / 2, axis=1)


def _view(number: int, view: Any) -> tuple[Camera, Array]:
    if not isinstance(view, tuple | list) or len(view) != 2 or not isinstance(view[0], Camera):
        raise ValueError(f"views[{number}] must be a pair (camera, image); got {described(view)}.")
    camera, image = view[0], np.asarray(view[1])
    width, height = camera.size
    if image.dtype.kind not in "fV":  # V: JAX's own 8- and 16-bit floats
        raise ValueError(
            f"views[{number}]: the image must be linear RGB, floats in [0, 1]; got {image.dtype}. Convert a "
            "picture file with jv.read_views, or its pixels with jv.from_srgb(image / 255)."
        )
    image = image.astype(np.float32)
    if image.shape not in ((height, width, 3), (height, width, 4)):
        raise ValueError(
            f"views[{number}]: the image must have shape {(height, width, 3)} or {(height, width, 4)}, "
            f"to match its camera of size {camera.size}; got {image.shape}."
        )
    if bad := int(np.sum(~finite(image))):
        raise ValueError(f"views[{number}]: the image must be finite; {bad} of its numbers are not.")
    return camera, jnp.asarray(image)


class Problem(eqx.Module):
    """A residual as a function of the free variables, in the forms that solvers need."""

    residual: Residual
    free: Free
    tile: int = eqx.field(static=True)
    """Entries of the residual differentiated at once."""

    def loss(self, free: FreeVariables) -> Float[Array, ""]:
        """Half the sum of squares. Its gradient is summed tile by tile, in reverse mode."""

        def of_item(tiles: Tiles, item: Any, free: FreeVariables) -> Array:
            return jnp.sum(tiles.residual(self.free.forward(free), item, "replay") ** 2) / 2

        @jax.custom_jvp
        def loss(free: FreeVariables) -> Array:
            return self._accumulate(lambda tiles, sum, item: sum + of_item(tiles, item, free), jnp.zeros(()))

        @loss.defjvp
        def _(primal: tuple[FreeVariables], tangent: tuple[FreeVariables]) -> tuple[Array, Array]:
            def add(tiles: Tiles, sums: Any, item: Any) -> Any:
                both = jax.value_and_grad(lambda free: of_item(tiles, item, free))(*primal)
                return jax.tree.map(jnp.add, sums, both)

            zeros = jnp.zeros(()), jax.tree.map(jnp.zeros_like, primal[0])
            value, gradient = self._accumulate(add, zeros)
            products = jax.tree.map(jnp.vdot, gradient, *tangent)
            return value, jnp.sum(jnp.stack(jax.tree.leaves(products)))

        return loss(free)

    def condensed(self, free: FreeVariables) -> Float[Array, "numbers numbers"]:
        """The triangle [R c; 0 ρ], whose last column of n + 1 numbers replaces the residual, in value and
        derivative. Forward mode."""

        @jax.custom_jvp
        def condensed(free: FreeVariables) -> Array:
            flat, unravel = ravel_pytree(free)

            def add(tiles: Tiles, triangle: Array, item: Any) -> Array:
                def residual(flat: Array) -> Array:
                    found = tiles.residual(self.free.forward(unravel(flat)), item, "forward")
                    return found.astype(flat.dtype)

                return jnp.linalg.qr(jnp.concatenate([triangle, _jacobian(residual, flat)]), mode="r")

            triangle = self._accumulate(add, jnp.zeros((flat.size + 1, flat.size + 1), flat.dtype))
            # QR's row signs are arbitrary; fixed here, so that they do not jump from step to step
            return triangle * jnp.where(jnp.diagonal(triangle) < 0, -1, 1)[:, None].astype(flat.dtype)

        @condensed.defjvp
        def _(primal: tuple[FreeVariables], tangent: tuple[FreeVariables]) -> tuple[Array, Array]:
            triangle = condensed(*primal)
            change = triangle[:, :-1] @ ravel_pytree(*tangent)[0]
            return triangle, jnp.zeros_like(triangle).at[:, -1].set(change)

        return condensed(free)

    def _accumulate(self, add: Callable[[Tiles, Any, Any], Any], total: Any) -> Any:
        """Accumulate `add` over all tiles, starting from `total`."""
        for tiles in self.residual.tiles(self.tile):
            total, _ = jax.lax.scan(
                lambda total, item, tiles=tiles: (add(tiles, total, item), None), total, tiles.items
            )
        return total


def _jacobian(f: Callable[[Array], Array], at: Float[Array, " n"]) -> Float[Array, "entries numbers"]:
    """[J r] by forward mode, at most `TANGENTS` columns at a time."""
    n = at.size
    chunk = min(n, TANGENTS)
    chunks = math.ceil(n / chunk)
    directions = jnp.eye(chunks * chunk, n, dtype=at.dtype).reshape(chunks, chunk, n)
    push = jax.vmap(lambda direction: jax.jvp(f, (at,), (direction,)), out_axes=(None, 0))
    value, columns = jax.lax.map(push, directions)
    columns = columns.reshape(chunks * chunk, -1)[:n]
    return jnp.concatenate([columns, value[:1]]).T


def tile_entries(residual: Residual, free: FreeVariables, max_jacobian: int, least_squares: bool) -> int:
    """Number of residual entries differentiated at once: as many as have rows [J r] that fit into
    `max_jacobian` bytes; all of them if no Jacobian is computed."""
    if not least_squares:
        return residual.count()
    bytes_of_row = (size(free) + 1) * 4
    if bytes_of_row * (size(free) + 1) > max_jacobian:
        raise ValueError(
            f"max_jacobian must hold the triangle of {size(free)} parameters, "
            f"{bytes_of_row * (size(free) + 1)} bytes; got {max_jacobian}. "
            'For so many parameters, use solver="adam" or "bfgs".'
        )
    return max_jacobian // bytes_of_row
