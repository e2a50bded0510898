"""Residuals of a fit, in tiles, and the QR factor that a least-squares solver needs of r (m,) and J (m, n):

    [J r] = Q [R c; 0 ρ]      with      |J d + r|² = |R d + c|² + ρ²   for every step d.

The triangle is updated by QR of itself and the next rows (TSQR, Demmel et al. 2012). The residual [c; ρ] of
n + 1 numbers with the Jacobian [R; 0] replaces that of all pixels exactly; unlike JᵀJ, it does not square the
condition number. The scores Jᵢ rᵢ are reduced in the same pass.
"""

import inspect
import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeAlias, cast

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


def check_residual(residual: object) -> None:
    """Raise a `ValueError` unless `residual` is callable, and not a transfer function, which also is."""
    if isinstance(residual, Transfer) or not (callable(residual) or isinstance(residual, ImageResidual)):
        raise ValueError(
            "residual must be an ImageResidual, or a function from parameters to arrays; "
            f"got {described(residual)}. The order is fit(residual, parameters)."
        )


def check_scene(scene: object) -> None:
    """Raise a `ValueError` unless `scene` accepts parameters and a camera."""
    try:
        inspect.signature(cast(Any, scene)).bind(None, None)
    except TypeError as fault:
        raise ValueError(f"scene must be a function of (parameters, camera); got {scene!r}.") from fault


SceneFunction = Callable[[Any, Camera], tuple[Any, ...]]
"""Function from parameters and a view's camera to volume, transfer, camera, march, and maybe lighting."""


class ImageResidual(eqx.Module):
    """Residual of a fit by rendered images: images minus reference images.

    The residual is divided by the square root of the number of its entries, so that the loss, half the
    sum of squares, is half the mean squared error: an error of PSNR p dB has the loss 10^(-p/10) / 2.
    A Jacobian that is too large is computed in tiles of image rows.

    Args:
        scene: `scene(parameters, camera)` returns the arguments of `render` for the parameters and a view's
            camera: `(volume, transfer, camera, march)`, and optionally the lighting; lists for several
            volumes. The solver chooses the adjoint.
        views: pairs (camera, image), at least one. An image is (height, width, 3), linear RGB over
            `background`, or (height, width, 4) (n + 1 for n colours), as `Rendering.rgba`; or a `PathTraced`,
            which is composited over `background`.
        background: linear RGB behind the volume, for three-channel images.
        compositing: as in `render`.
        noise: standard deviation of the noise of the references: a number; or a list with a number, an array
            like the image or one that broadcasts to it, or None, for each view. By default the standard error
            of a view that is a `PathTraced` of more than one path, and else unknown. If it is known for all
            views, `fit` compares it with the residual, and warns of a model that does not fit. It doesn't
            weight the residual.
        weights: weights of the pixels, in the form of `noise`, or (height, width) for all channels of a view.
            A pixel of weight 0, such as outside a mask, does not count; None weights all pixels of a view by
            1. The loss is then half the weighted mean squared error, whatever the sum of the weights. For
            pixels of known noise, 1 / noise² gives the smallest standard errors.
        blur: standard deviation of a Gaussian that blurs the images that are compared, as a fraction of the
            image's height, to fit from coarse to fine. A derivative describes only features that move by less
            than their size; blurred features are large, so that a pose or a geometry converges from farther
            away (fit `residual.blurred(blur)` for blurs such as 1/8, 1/32 and None, starting from the last
            result). Blurred images are differentiated without tiles. Pixels beyond the border do not count.
            Standard errors are too small, since the noise of blurred pixels is not independent: take those of
            a last fit without blur.

    Raises:
        ValueError: for no views, an image that differs in size from its camera or holds integers, NaN or
            infinite pixels, a negative `blur`, `noise` or `weights` that are negative, infinite or of another
            shape, weights that are all 0, and a scene that returns something else; and during a fit, for
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
        compositing: Mode | Compositing[Any] = "over",
        noise: Arrayable | Sequence[Arrayable | None] | None = None,
        weights: Arrayable | Sequence[Arrayable | None] | None = None,
        blur: Arrayable | None = None,
    ):
        check_scene(scene)
        self.scene = scene
        self.compositing = compositing_of(compositing)
        self.blur = None if blur is None else not_negative("blur", blur)
        self.references = References.of(views, background, noise, weights)

    def blurred(self, blur: Arrayable | None) -> "ImageResidual":
        """The same residual with another blur."""
        sigma = None if blur is None else not_negative("blur", blur)
        return eqx.tree_at(lambda residual: residual.blur, self, sigma, is_leaf=is_none)

    def tiles(self, limit: int) -> list[Tiles]:
        """The residual in pieces of at most `limit` entries."""
        groups = zip(self.references.groups, self.references.weights, strict=True)
        return [self._tiles(*group, weights, limit) for group, weights in groups]

    def _tiles(self, cameras: Camera, images: Array, weights: Array | None, limit: int) -> Tiles:
        views, height, width, channels = images.shape
        part, needed = "one row of an image", width * channels
        if self.blur is not None:
            part, needed = "one blurred image", height * needed
        if limit < needed:
            raise ValueError(
                f"max_jacobian leaves room for {limit} entries of the residual; {part} has {needed}. "
                "Raise max_jacobian, or fit fewer parameters."
            )
        pieces = math.ceil(height / min(height, limit // (width * channels)))
        rows = math.ceil(height / pieces)
        share = 1 / math.sqrt(self.references.count)

        def residual(parameters: PyTree, item: tuple[Array, Array], adjoint: Adjoint) -> Array:
            view, first = item
            view_camera = jax.tree.map(lambda leaf: leaf[view], cameras)
            result: Any = self.scene(parameters, view_camera)
            order = "(volume, transfer, camera, march, lighting)"
            if not isinstance(result, tuple) or len(result) not in (4, 5):
                raise ValueError(
                    f"scene must return {order}, the last if it is lit; got {described(result)}."
                )
            *pair, camera, march, lighting = cast(Any, (*result, None)[:5])
            volume, transfer = together(*pair)
            scene = {"volume": volume, "transfer": transfer, "camera": camera, "march": march}
            check_arguments(order, **scene, lighting=lighting)
            if camera.size != view_camera.size:
                raise ValueError(
                    f"scene must return a camera of its view's size {view_camera.size}; got {camera.size}."
                )
            if pieces > 1:
                camera = camera.crop(0, first, camera.size[0], rows)
            options: Any = {"compositing": self.compositing, "lighting": lighting, "adjoint": adjoint}
            rendering = render(volume, transfer, camera, march, outputs="rgba", **options)
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
    """Blur an image by a Gaussian of `sigma` pixels. Pixels of weight 0 do not affect others."""

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
    """Gaussian blur of a line of `n` pixels, `sigma` in pixels, as a matrix; rows sum to 1."""
    at = jnp.arange(n, dtype=sigma.dtype)
    distance = (at[:, None] - at[None, :]) / jnp.maximum(sigma, 1e-3)
    return jax.nn.softmax(-(distance**2) / 2, axis=1)


class Triangles(NamedTuple):
    """Triangular factors of a residual and its Jacobian, which replace them in a least-squares fit.

    Attributes:
        residual: the triangle R of [J r], whose last column replaces the residual.
        scores: the triangle S of the scores, the gradients of each pixel's part of the loss (that is, Σ Jᵢ rᵢ
            over its entries i): SᵀS is the sum of their outer products.
        informed: number of entries whose row of the Jacobian is not 0.
    """

    residual: Float[Array, "numbers numbers"]
    scores: Float[Array, "rows free"]
    informed: Float[Array, ""]

    @classmethod
    def of(cls, rows: Float[Array, "pixels channels numbers"]) -> "Triangles":
        """Matrices of rows [J r], before their triangles are taken."""
        scores = jnp.sum(rows[..., :-1] * rows[..., -1:], axis=1)
        informed = jnp.sum(jnp.any(rows[..., :-1] != 0, axis=-1), dtype=rows.dtype)
        return cls(rows.reshape(-1, rows.shape[-1]), scores, informed)


Residual: TypeAlias = ImageResidual | Callable[[Any], PyTree]


class Problem(eqx.Module):
    """A residual as a function of the free variables, in the forms that solvers need."""

    residual: Residual
    free: Free
    count: int = eqx.field(static=True)
    """Number of entries of the residual."""
    tile: int = eqx.field(static=True)
    """Number of entries that are differentiated at once."""
    least_squares: bool = eqx.field(static=True)

    @classmethod
    def of(
        cls, residual: Residual, free: Free, y: FreeVariables, limit: int, least_squares: bool
    ) -> "Problem":
        """The problem with the largest tiles that fit into `limit` bytes; a single one without Jacobian."""
        images = isinstance(residual, ImageResidual)
        if images:
            count, total = residual.references.count, residual.references.size()
        else:
            count = total = size(eqx.filter_eval_shape(lambda y: cast(Any, residual)(free.forward(y)), y))
        row = (size(y) + 1) * 4
        if count == 0:
            raise ValueError("residual must return at least one number; got none.")
        if least_squares and row * (size(y) + 1) > limit:
            raise ValueError(
                f"max_jacobian must hold the triangle of {size(y)} parameters, {row * (size(y) + 1)} bytes; "
                f'got {limit}. For so many parameters, use solver="adam" or "bfgs".'
            )
        tile = limit // row if least_squares else total
        if not images and tile < count:
            raise ValueError(
                f"max_jacobian leaves room for {tile} of the residual's {count} entries, and only an "
                "ImageResidual is split into tiles. Raise max_jacobian, or use one."
            )
        return cls(residual, free, count, tile, least_squares)

    @property
    def noise(self) -> Noise | None:
        """Noise of the references, if it is known. Noise of blurred pixels is not independent."""
        if isinstance(self.residual, ImageResidual) and self.residual.blur is None:
            return self.residual.references.noise
        return None

    @property
    def scale(self) -> float:
        """Norm of the references; 0 for a function."""
        return self.residual.references.scale() if isinstance(self.residual, ImageResidual) else 0.0

    def __call__(self, y: FreeVariables, _: Any = None) -> tuple[Array, tuple[Array, FreeVariables, Any]]:
        """Residual or loss that a solver minimises; and the loss, its point, and the triangles there."""
        if not self.least_squares:
            loss = self.loss(y)
            return loss, (loss, y, None)
        triangles = self.condensed(y)
        column = triangles.residual[:, -1]
        return column, (jnp.sum(column**2) / 2, y, triangles)

    def loss(self, free: FreeVariables) -> Float[Array, ""]:
        """Half the sum of squares. Its gradient is summed tile by tile, in reverse mode."""

        def item_loss(function: Callable[..., Array], item: PyTree, free: FreeVariables) -> Array:
            return jnp.sum(function(self.free.forward(free), item, "replay") ** 2) / 2

        @jax.custom_jvp
        def loss(free: FreeVariables) -> Array:
            return self._accumulate(lambda f, sum, item: sum + item_loss(f, item, free), jnp.zeros(()))

        @loss.defjvp
        def _(primal: tuple[FreeVariables], tangent: tuple[FreeVariables]) -> tuple[Array, Array]:
            def add(function: Callable[..., Array], sums: PyTree, item: PyTree) -> PyTree:
                terms = jax.value_and_grad(lambda free: item_loss(function, item, free))(*primal)
                return jax.tree.map(jnp.add, sums, terms)

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

            def add(function: Callable[..., Array], triangles: Triangles, item: PyTree) -> Triangles:
                def residual(flat: Array) -> Array:
                    return function(self.free.forward(unravel(flat)), item, "forward").astype(flat.dtype)

                matrices = Triangles.of(jacobian(residual, flat))
                pairs = zip(triangles[:2], matrices[:2], strict=True)
                rows, scores = (jnp.linalg.qr(jnp.concatenate(pair), mode="r") for pair in pairs)
                return Triangles(rows, scores, triangles.informed + matrices.informed)

            n, zeros = flat.size, partial(jnp.zeros, dtype=flat.dtype)
            start = Triangles(zeros((n + 1, n + 1)), zeros((n, n)), zeros(()))
            triangle, scores, informed = self._accumulate(add, start)
            # QR's row signs are arbitrary; fix them, so that they do not jump from step to step
            signs = jnp.where(jnp.diagonal(triangle) < 0, -1, 1)[:, None].astype(flat.dtype)
            return Triangles(triangle * signs, scores, informed)

        @condensed.defjvp
        def _(primal: tuple[FreeVariables], tangent: tuple[FreeVariables]) -> tuple[Triangles, Triangles]:
            triangles = condensed(*primal)
            change = triangles.residual[:, :-1] @ ravel_pytree(*tangent)[0]
            still = jax.tree.map(jnp.zeros_like, triangles)
            return triangles, still._replace(residual=still.residual.at[:, -1].set(change))

        return condensed(free)

    def _accumulate(self, add: Callable[[Any, Any, Any], Any], total: Any) -> Any:
        """Accumulate `add(function, total, item)` over all tiles, starting from `total`."""
        if isinstance(self.residual, ImageResidual):
            tiles = self.residual.tiles(self.tile)
        else:
            residual: Any = self.residual
            tiles = [(lambda parameters, *_: ravel_pytree(residual(parameters))[0][:, None], jnp.zeros(1))]
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
