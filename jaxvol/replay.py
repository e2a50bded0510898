"""What does a loss see of each sample? A second march, front to back, that computes the samples again.

Say the loss changes by c̄, ā and d̄ with a ray's colour C, opacity A and depth D = t_in + Σ w s / A, in which
sample k has weight w_k, colour c_k and depth s_k past the entry. Then each unit of its weight is worth

    q_k = c̄ · c_k + ā + (d̄ / A) (s_k - (D - t_in))

and, with T_k the transmittance behind sample k and τ_k its optical depth (extinction times width),

    ∂L/∂τ_k = T_k q_k - Σ_{j>k} w_j q_j        ∂L/∂c_k = w_k c̄        ∂L/∂s_k = w_k d̄ / A

The sum over what lies behind is what the sums in front leave of Σ w_j q_j = c̄ · C + ā A, which the image
tells, so nothing need be kept from the first march, and nothing is divided by a transmittance, which may
be 0. What the optical depths, colours and depths owe to the transfer function, the voxels, the ray and the
step is left to JAX, a segment at a time.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree, Shaped

from .locate import Ray
from .march import March
from .reference import Progress, contained, front, pieces
from .rendering import Rendering
from .transfer import Classification, Transfer
from .triple import Scalar, Triple
from .volume import Volume
from .wavefront import CELLS, Follower, Samples, over_cells


class Cotangents(NamedTuple):
    """What the loss makes of each ray: how it changes with colour, opacity, and a unit of weight at a depth
    from `middle` on; and what all the ray's samples are worth."""

    color: Triple
    opacity: Scalar
    depth: Scalar
    middle: Scalar
    worth: Scalar

    @classmethod
    def of(cls, ray: Ray, rendering: Rendering, gradient: Rendering) -> "Cotangents":
        """For rays (groups, rays in a group) and their part of the image, and of its gradient."""
        red, green, blue, opacity = (gradient.rgba[..., i] for i in range(4))
        seen = rendering.rgba[..., 3] > 0
        alpha = jnp.where(seen, rendering.rgba[..., 3], 1)
        middle = jnp.where(seen, rendering.depth - ray.t_in, 0)
        worth = jnp.sum(gradient.rgba * rendering.rgba, axis=-1)
        depth = jnp.where(seen, gradient.depth, 0) / alpha
        return cls((red, green, blue), opacity, depth, middle, worth)


class Total(eqx.Module):
    """Gradients that all rays add to; None for what is not asked for."""

    transfer: PyTree
    march: PyTree
    volume: PyTree
    """Of all but the voxels."""
    voxels: Float[Array, " voxels"] | None

    @classmethod
    def zeros(cls, volume: Volume, transfer: Transfer, march: March, *, voxels: bool) -> "Total":
        """None yet."""
        transfer, march, volume_ = (
            jax.tree.map(jnp.zeros_like, floats(part)) for part in (transfer, march, without_voxels(volume))
        )
        data = volume.data
        return cls(transfer, march, volume_, jnp.zeros(data.size, data.dtype) if voxels else None)


class Replay(Follower):
    """The second march over rays (groups, rays in a group).

    **Arguments:**

    - `total`: to be added to.
    - `places`: whether the gradient of anything but the transfer function is asked for.
    """

    def __init__(
        self,
        scene: tuple[Volume, Transfer, March],
        seen: Classification,
        rays: Ray,
        given: Cotangents,
        total: Total,
        *,
        places: bool,
    ):
        self.volume, self.transfer, self.march = scene
        self.seen, self.places = seen, places
        self.given, self.total = given, total
        self.kept = jnp.zeros_like(given.worth)  # of the samples in front
        self.sums = jax.tree.map(jnp.zeros_like, floats(rays)) if places else None

    def follow(
        self, ray: Ray, at: Progress, samples: Samples, given: Cotangents, kept: Scalar, total: Total
    ) -> tuple[Scalar, PyTree, Total]:
        each = jax.tree.map(lambda leaf: leaf[None], given)  # for all cells of a ray
        red, green, blue = each.color
        classify = over_cells(self.seen.classify)
        classified = [classify(measured) for measured in samples.measured]
        depths = [self.march.sample(cell) for cell in samples.cells]
        worth = [
            red * r + green * g + blue * b + each.opacity + each.depth * (depth - each.middle)
            for ((r, g, b), _), depth in zip(classified, depths, strict=True)
        ]
        inside = over_cells(contained, of_cells=(False, True))
        kept, weights, slopes = self._weighed(at, samples.opacity, worth, given.worth, kept)
        slopes = [jnp.where(inside(ray, s), slope, 0) for s, slope in zip(depths, slopes, strict=True)]

        of_measured = []
        for cell, measured, weight, slope in zip(
            samples.cells, samples.measured, weights, slopes, strict=True
        ):
            of_color = weight * red, weight * green, weight * blue
            of_transfer, pulled = self.transfer.pull(measured, of_color, slope * cell.width)
            total = eqx.tree_at(lambda t: t.transfer, total, added(total.transfer, of_transfer))
            of_measured.append(pulled)
        if not self.places:
            return kept, None, total
        of_width = [slope * extinction for slope, (_, extinction) in zip(slopes, classified, strict=True)]
        of_depth = [weight * each.depth for weight in weights]
        wanted = list(zip(of_measured, of_width, of_depth, strict=True))
        of_march, of_volume, of_rays, of_voxels = self._placed(ray, at, wanted)
        voxels: Any = total.voxels
        for place, part in of_voxels:
            voxels = voxels.at[place].add(part, mode="promise_in_bounds", wrap_negative_indices=False)
        march, volume = added(total.march, of_march), added(total.volume, of_volume)
        return kept, of_rays, Total(total.transfer, march, volume, voxels)

    def _weighed(
        self, at: Progress, alphas: list[Scalar], worth: list[Scalar], whole: Scalar, front: Scalar
    ) -> tuple[Scalar, list[Scalar], list[Scalar]]:
        """What the samples so far are worth; each one's weight; and how the loss changes with its optical
        depth."""
        opacity, finished = at.opacity, at.finished
        # With no more than this left, what lies behind is lost in the rounding of the sums, which an opaque
        # sample's extinction would blow up.
        nothing = 2 * float(jnp.finfo(opacity.dtype).eps)
        weights: list[list[Scalar]] = [[] for _ in alphas]
        slopes: list[list[Scalar]] = [[] for _ in alphas]
        for k in range(CELLS):
            for i, (alpha, value) in enumerate(zip(alphas, worth, strict=True)):
                weight = jnp.where(finished, 0, (1 - opacity) * alpha[k])
                opacity, front = opacity + weight, front + weight * value[k]
                slope = (1 - opacity) * value[k] - (whole - front)
                weights[i].append(weight)
                slopes[i].append(jnp.where(finished | (1 - opacity <= nothing), 0, slope))
            finished |= jax.vmap(self.march.stop)(1 - opacity)
        return front, [jnp.stack(w) for w in weights], [jnp.stack(s) for s in slopes]

    def _placed(self, ray: Ray, at: Progress, wanted: list[tuple[PyTree, Scalar, Scalar]]) -> tuple:
        """What march, volume, rays and voxels get of what is wanted of each piece's measured values, width
        and depth. Which samples a ray has is taken as it is."""
        voxels = self.total.voxels is not None
        march, march_rest = eqx.partition(self.march, eqx.is_inexact_array)
        volume, volume_rest = eqx.partition(without_voxels(self.volume), eqx.is_inexact_array)
        ray_floats, ray_rest = eqx.partition(ray, eqx.is_inexact_array)

        def one(
            march: PyTree, volume: PyTree, ray: PyTree, taps: Any, ray_rest: PyTree, at: Progress, k: Array
        ):
            march, ray = eqx.combine(march, march_rest), eqx.combine(ray, ray_rest)
            tapped = _Tapped(eqx.combine(volume, volume_rest), self.volume, taps if voxels else None)
            found = []
            for piece in pieces(march, ray, tapped, front(march, at, k)):
                depth = march.sample(piece)
                measured = self.transfer.measured(tapped, ray.path(depth))
                found.append((floats(measured), piece.width, depth))
            return found, tapped.asked

        ahead = jnp.arange(CELLS, dtype=at.index.dtype)
        rays = jax.vmap(one, in_axes=(None, None, 0, 0, 0, 0, None))
        cells = jax.vmap(rays, in_axes=(None, None, None, 0, None, None, 0))

        def all_(march: PyTree, volume: PyTree, ray: PyTree, taps: list | None) -> PyTree:
            return cells(march, volume, ray, taps, ray_rest, at, ahead)

        taps = []
        if voxels:
            _, asked = jax.eval_shape(lambda: all_(march, volume, ray_floats, None))
            taps = [jnp.zeros(place.shape, self.volume.data.dtype) for place in asked]
        _, pull, asked = jax.vjp(all_, march, volume, ray_floats, taps, has_aux=True)
        of_march, of_volume, of_ray, of_taps = pull(wanted)
        return of_march, of_volume, of_ray, list(zip(asked, of_taps, strict=True)) if voxels else []


class _Tapped(Volume):
    """A volume that writes down which voxels it is asked for, and adds something to each."""

    taps: list | None
    asked: list = eqx.field(static=True)

    def __init__(self, volume: Volume, whole: Volume, taps: list | None):
        self.data, self.labels = whole.data, whole.labels
        self.spacing, self.origin = volume.spacing, volume.origin
        self.taps, self.asked = taps, []

    def _voxel(self, flat: Int[Array, ""]) -> Shaped[Array, ""]:
        self.asked.append(flat)
        value = jax.lax.stop_gradient(super()._voxel(flat))
        return value if not self.taps else value + self.taps[len(self.asked) - 1]


def floats(tree: PyTree) -> PyTree:
    """What of it can have a gradient."""
    return eqx.filter(tree, eqx.is_inexact_array)


def without_voxels(volume: Volume) -> Volume:
    """A volume but for its voxels, of which there are too many to be handed around."""
    return eqx.tree_at(lambda v: v.data, volume, None)


def with_voxels(volume: Volume, data: Array) -> Volume:
    """The volume with these voxels."""
    return eqx.tree_at(lambda v: v.data, volume, data, is_leaf=lambda leaf: leaf is None)


def added(a: PyTree, b: PyTree) -> PyTree:
    """Leaf by leaf."""
    return jax.tree.map(jnp.add, a, b)
