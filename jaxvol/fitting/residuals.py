"""Residuals of a fit, in tiles, and the QR factor that a least-squares solver needs of r (m,) and J (m, n):

    [J r] = Q [R c; 0 ρ]      with      |J d + r|² = |R d + c|² + ρ²   for every step d.

The triangle is computed by QR of that so far and the next rows (TSQR, Demmel et al. 2012). The residual of n
+ 1 numbers with the Jacobian [R; 0] replaces that of all pixels exactly; unlike JᵀJ, it does not square the
condition number. The scores Jᵢ rᵢ are reduced in the same pass.
"""

import inspect
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .._util.checks import Arrayable, described, not_negative
from ..compositing.blending import Compositing
from ..compositing.modes import Mode, compositing_of
from ..ray import check_arguments
from ..render import Adjoint, render
from ..scene.camera import Camera
from ..scene.several import together
from ..scene.transfer import Transfer
from ..xla.trees import PyTree, is_none
from .constraints import Free, FreeVariables, size
from .noise import Noise
from .references import References


TANGENTS = 64
"""Columns of the Jacobian computed at once: a march keeps its state for each of them."""


Tiles = tuple[Callable[[PyTree, Any, Adjoint], Float[Array, "pixels channels"]], PyTree]
"""Equal pieces of a residual: `function(parameters, item, adjoint)`, and the stacked items."""


def check_residual(residual: Any) -> None:
    """Reject what is not a residual, including a transfer function, which is callable, too."""
    if isinstance(residual, Transfer) or not (callable(residual) or isinstance(residual, ImageResidual)):
        raise ValueError(
            "residual must be an ImageResidual, or a function from parameters to arrays; "
            f"got {described(residual)}. The order is fit(residual, parameters)."
        )


def check_scene(scene: Any) -> None:
    """Reject what cannot be called with parameters and a camera."""
    try:
        inspect.signature(scene).bind(None, None)
    except TypeError as fault:
        raise ValueError(f"scene must be a function of (parameters, camera); got {scene!r}.") from fault


SceneFunction = Callable[[Any, Camera], tuple[Any, ...]]
"""From parameters and a view's camera to volume, transfer function, camera, march, and maybe lighting."""


class ImageResidual(eqx.Module):
    """Rendered images minus reference images, as the residual of a fit.

    The residual is divided by the square root of the number of its entries, so that the loss, half the
    sum of squares, is half the mean squared error: an error of PSNR p dB has the loss 10^(-p/10) / 2.
    A Jacobian that is too large is computed in tiles of whole image rows.

    Args:
        scene: `scene(parameters, camera)` returns what to render for the parameters and a view's camera:
            `(volume, transfer, camera, march)`, and `lighting` as a fifth entry if it is lit; of several
            volumes lists, as for `render`. The solver chooses the adjoint.
        views: pairs (camera, image), at least one. An image is (height, width, 3), linear RGB over
            `background`, or as `Rendering.rgba`, (height, width, 4) but for more colours; or a `PathTraced`,
            which is put before `background`.
        background: linear RGB behind the volume, for three-channel images.
        compositing: as in `render`.
        noise: standard deviation of the noise of the references: a number; or a list with a number, an array
            like the image or one that broadcasts to it, or None, for each view. Where it is not given, it is
            the standard error of a view that is a `PathTraced` of more than one path, and else unknown. If it
            is known for all views, `fit` compares it with the residual, and warns of a model that does not
            fit. It doesn't weight the residual.
        weights: of the pixels, in the form of `noise`, or (height, width) for all channels of a view: a pixel
            of weight 0 does not count, as outside a mask, and None weights all pixels of a view by 1. The
            loss is then half the weighted mean squared error, whatever the sum of the weights. For pixels of
            known noise, 1 / noise² gives the smallest standard errors.
        blur: compare blurred images: standard deviation of a Gaussian, as a fraction of the image's height,
            to fit from coarse to fine. A derivative describes only features that move by less than their own
            size: in blurred images these are large, so that a pose or a geometry is found from farther away
            (fit `residual.blurred(blur)` for blurs such as 1/8, 1/32 and None, each from where the last one
            ended). Whole images are then differentiated at once. Pixels beyond the border do not count.
            Standard errors are too small, since the noise of blurred pixels is not independent: take those of
            a last fit without blur.

    Raises:
        ValueError: for no views, an image that differs in size from its camera or holds integers, NaN or
            infinite pixels, a negative `blur`, `noise` or `weights` that are negative, infinite or of another
            shape, weights that are all 0, and a scene that returns something else; and when it is fitted, for
            blurred images that `max_jacobian` leaves no room for.
    """

    scene: SceneFunction
    references: References
    compositing: Compositing[Any]
    blur: Float[Array, ""] | None

    def __init__(
        self,
        scene: SceneFunction | Any,
        views: Iterable[tuple[Camera, Arrayable]] | Any,
        background: Arrayable = (1.0, 1.0, 1.0),
        *,
        compositing: Mode | Compositing[Any] | Any = "over",
        noise: Arrayable | Sequence[Arrayable | None] | None = None,
        weights: Arrayable | Sequence[Arrayable | None] | None = None,
        blur: Arrayable | None = None,
    ):
        check_scene(scene)
        self.scene = cast(Any, scene)
        self.compositing = compositing_of(compositing)
        self.blur = None if blur is None else not_negative("blur", blur)
        self.references = References.of(views, background, noise, weights)

    def blurred(self, blur: Arrayable | None) -> "ImageResidual":
        """The same residual, of images blurred otherwise."""
        sigma = None if blur is None else not_negative("blur", blur)
        return eqx.tree_at(lambda residual: residual.blur, self, sigma, is_leaf=is_none)

    def tiles(self, most: int) -> list[Tiles]:
        """The residual in pieces of at most `most` entries."""
        each = zip(self.references.groups, self.references.weights, strict=True)
        return [self._tiles(*group, weights, most) for group, weights in each]

    def _tiles(self, cameras: Camera, images: Array, weights: Array | None, most: int) -> Tiles:
        views, height, width, channels = images.shape
        what, least = ("one row of an image", 1) if self.blur is None else ("one blurred image", height)
        if most < least * width * channels:
            raise ValueError(
                f"max_jacobian leaves room for {most} entries of the residual; {what} has "
                f"{least * width * channels}. Raise max_jacobian, or fit fewer parameters."
            )
        pieces = math.ceil(height / min(height, most // (width * channels)))
        rows = math.ceil(height / pieces)
        share = 1 / math.sqrt(self.references.count)

        def residual(parameters: PyTree, item: tuple[Array, Array], adjoint: Adjoint) -> Array:
            view, first = item
            of_view = jax.tree.map(lambda leaf: leaf[view], cameras)
            result: Any = self.scene(parameters, of_view)
            order = "(volume, transfer, camera, march, lighting)"
            if not isinstance(result, tuple) or len(result) not in (4, 5):
                raise ValueError(
                    f"scene must return {order}, the last if it is lit; got {described(result)}."
                )
            *both, camera, march, lighting = cast(Any, (*result, None)[:5])
            volume, transfer = together(*both)
            scene = {"volume": volume, "transfer": transfer, "camera": camera, "march": march}
            check_arguments(order, **scene, lighting=lighting)
            if camera.size != of_view.size:
                raise ValueError(
                    f"scene must return a camera of its view's size {of_view.size}; got {camera.size}."
                )
            if pieces > 1:
                camera = camera.crop(0, first, camera.size[0], rows)
            how: Any = {"compositing": self.compositing, "lighting": lighting, "adjoint": adjoint}
            rendering = render(volume, transfer, camera, march, outputs="rgba", **how)
            rendered = rendering.rgba if channels > 3 else rendering.image(self.references.background)
            if rendered.shape[-1] != channels:
                got = f"{rendered.shape[-1]} of the rendering, and {channels} of the view"
                raise ValueError(f"views must have the channels of Rendering.rgba; got {got}.")
            row = first + jnp.arange(rows)
            at = view, jnp.minimum(row, height - 1)
            # the last piece may reach past the image
            inside = (row < height)[:, None, None]
            difference = jnp.where(inside, (rendered - images[at]) * share, 0)
            weight = None if weights is None else weights[at]
            if self.blur is not None:
                difference = _blurred(difference, weight, self.blur * height)
            return (difference if weight is None else jnp.sqrt(weight) * difference).reshape(-1, channels)

        view, piece = np.divmod(np.arange(views * pieces), pieces)
        return residual, (jnp.asarray(view), jnp.asarray(piece * rows))


def _blurred(image: Array, weight: Array | None, sigma: Float[Array, ""]) -> Array:
    """An image blurred by a Gaussian, `sigma` in pixels. Pixels of weight 0 do not count in the others."""

    def blur(image: Array) -> Array:
        for axis in (0, 1):
            kernel = _blurring(image.shape[axis], sigma)
            image = jnp.moveaxis(jnp.tensordot(kernel, image, axes=(1, axis)), 0, axis)
        return image

    if weight is None:
        return blur(image)
    sums = blur(weight)
    return blur(weight * image) / jnp.where(weight > 0, sums, 1)


def _blurring(n: int, sigma: Float[Array, ""]) -> Float[Array, "n n"]:
    """Gaussian blur of a line of `n` pixels, `sigma` in pixels; weights inside sum to 1."""
    at = jnp.arange(n, dtype=sigma.dtype)
    away = (at[:, None] - at[None, :]) / jnp.maximum(sigma, 1e-3)
    return jax.nn.softmax(-(away**2) / 2, axis=1)


class Triangles(NamedTuple):
    """What a least-squares fit keeps of a residual of m entries and its Jacobian.

    Attributes:
        residual: the triangle R of [J r], whose last column replaces the residual.
        scores: the triangle S of the scores, the gradients of each pixel's part of the loss (that is, Σ Jᵢ rᵢ
            over its entries i): SᵀS is the sum of their outer products.
    """

    residual: Float[Array, "numbers numbers"]
    scores: Float[Array, "rows free"]


class Problem(eqx.Module):
    """A residual as a function of the free variables, in the forms that solvers need."""

    residual: ImageResidual | Callable[[PyTree], PyTree]
    free: Free
    count: int = eqx.field(static=True)
    """Number of entries of the residual."""
    tile: int = eqx.field(static=True)
    """Number of these that are differentiated at once."""
    least_squares: bool = eqx.field(static=True)

    @classmethod
    def of(cls, residual: Any, free: Free, y: FreeVariables, most: int, least_squares: bool) -> "Problem":
        """With as large tiles as fit into `most` bytes; without Jacobian, all of the residual."""
        images = isinstance(residual, ImageResidual)
        if images:
            count, whole = residual.references.count, residual.references.size()
        else:
            count = whole = size(eqx.filter_eval_shape(residual, free.forward(y)))
        row = (size(y) + 1) * 4
        if count == 0:
            raise ValueError("residual must return at least one number; got none.")
        if least_squares and row * (size(y) + 1) > most:
            raise ValueError(
                f"max_jacobian must hold the triangle of {size(y)} parameters, {row * (size(y) + 1)} bytes; "
                f'got {most}. For so many parameters, use solver="adam" or "bfgs".'
            )
        tile = most // row if least_squares else whole
        if not images and tile < count:
            raise ValueError(
                f"max_jacobian leaves room for {tile} of the residual's {count} entries, and only an "
                "ImageResidual is split into tiles. Raise max_jacobian, or use one."
            )
        return cls(residual, free, count, tile, least_squares)

    @property
    def noise(self) -> Noise | None:
        """Of the references, if it is known. Noise of blurred pixels is not independent."""
        if isinstance(self.residual, ImageResidual) and self.residual.blur is None:
            return self.residual.references.noise
        return None

    @property
    def scale(self) -> float:
        """Norm of the references; 0 for a function."""
        return self.residual.references.scale() if isinstance(self.residual, ImageResidual) else 0.0

    def __call__(self, y: FreeVariables, _: Any = None) -> tuple[Array, tuple[Array, FreeVariables, Any]]:
        """What a solver minimises; and the loss, its point, and the triangles there."""
        if not self.least_squares:
            loss = self.loss(y)
            return loss, (loss, y, None)
        triangles = self.condensed(y)
        column = triangles.residual[:, -1]
        return column, (jnp.sum(column**2) / 2, y, triangles)

    def loss(self, free: FreeVariables) -> Float[Array, ""]:
        """Half the sum of squares. Its gradient is summed tile by tile, in reverse mode."""

        def of_item(function: Any, item: Any, free: FreeVariables) -> Array:
            return jnp.sum(function(self.free.forward(free), item, "replay") ** 2) / 2

        @jax.custom_jvp
        def loss(free: FreeVariables) -> Array:
            return self._accumulate(lambda f, sum, item: sum + of_item(f, item, free), jnp.zeros(()))

        @loss.defjvp
        def _(primal: tuple[FreeVariables], tangent: tuple[FreeVariables]) -> tuple[Array, Array]:
            def add(function: Any, sums: Any, item: Any) -> Any:
                both = jax.value_and_grad(lambda free: of_item(function, item, free))(*primal)
                return jax.tree.map(jnp.add, sums, both)

            zeros = jnp.zeros(()), jax.tree.map(jnp.zeros_like, primal[0])
            value, gradient = self._accumulate(add, zeros)
            products = jax.tree.map(jnp.vdot, gradient, *tangent)
            return value, jnp.sum(jnp.stack(jax.tree.leaves(products)))

        return loss(free)

    def condensed(self, free: FreeVariables) -> Triangles:
        """[R c; 0 ρ], whose last column replaces the residual, and the scores' triangle, a constant."""

        @jax.custom_jvp
        def condensed(free: FreeVariables) -> Triangles:
            flat, unravel = ravel_pytree(free)

            def add(function: Any, triangles: Triangles, item: Any) -> Triangles:
                def residual(flat: Array) -> Array:
                    return function(self.free.forward(unravel(flat)), item, "forward").astype(flat.dtype)

                rows = jacobian(residual, flat)
                scores = jnp.sum(rows[..., :-1] * rows[..., -1:], axis=1)
                both = zip(triangles, (rows.reshape(-1, flat.size + 1), scores), strict=True)
                return Triangles(*(jnp.linalg.qr(jnp.concatenate(pair), mode="r") for pair in both))

            zeros = (jnp.zeros((n, n), flat.dtype) for n in (flat.size + 1, flat.size))
            triangle, scores = self._accumulate(add, Triangles(*zeros))
            # QR's row signs are arbitrary; fixed here, so that they do not jump from step to step
            signs = jnp.where(jnp.diagonal(triangle) < 0, -1, 1)[:, None].astype(flat.dtype)
            return Triangles(triangle * signs, scores)

        @condensed.defjvp
        def _(primal: tuple[FreeVariables], tangent: tuple[FreeVariables]) -> tuple[Triangles, Triangles]:
            triangle, scores = condensed(*primal)
            change = triangle[:, :-1] @ ravel_pytree(*tangent)[0]
            changes = jnp.zeros_like(triangle).at[:, -1].set(change), jnp.zeros_like(scores)
            return Triangles(triangle, scores), Triangles(*changes)

        return condensed(free)

    def _accumulate(self, add: Callable[[Any, Any, Any], Any], total: Any) -> Any:
        """Accumulate `add(function, total, item)` over all tiles, starting from `total`."""
        if isinstance(self.residual, ImageResidual):
            tiles = self.residual.tiles(self.tile)
        else:
            own: Any = self.residual
            tiles = [(lambda parameters, *_: ravel_pytree(own(parameters))[0][:, None], jnp.zeros(1))]
        for function, items in tiles:
            total, _ = jax.lax.scan(lambda sum, item, f=function: (add(f, sum, item), None), total, items)
        return total


def jacobian(
    f: Callable[[Array], Float[Array, "pixels channels"]], at: Float[Array, " n"]
) -> Float[Array, "pixels channels numbers"]:
    """[J r] by forward mode, at most `TANGENTS` columns at a time."""
    n = at.size
    chunk = min(n, TANGENTS)
    chunks = math.ceil(n / chunk)
    directions = jnp.eye(chunks * chunk, n, dtype=at.dtype).reshape(chunks, chunk, n)
    push = jax.vmap(lambda direction: jax.jvp(f, (at,), (direction,)), out_axes=(None, 0))
    value, columns = jax.lax.map(push, directions)
    columns = columns.reshape(chunks * chunk, *value.shape[1:])[:n]
    return jnp.moveaxis(jnp.concatenate([columns, value[:1]]), 0, -1)
