"""VJP of marching a tile's rays: a second march, front to back, recomputes all samples.

Let c̄, ā and d̄ be the cotangents of a ray's colour C, opacity A and depth D = t_in + Σ w s / A, where sample
k has weight w_k, colour c_k and depth s_k past the entry. The derivative of the loss by its weight is

    q_k = c̄ · c_k + ā + (d̄ / A) (s_k - (D - t_in))

(`weight_bar`), and

    ∂L/∂c_k = w_k c̄        ∂L/∂s_k = w_k d̄ / A        ∂L/∂τ_k = Σ_j q_j ∂w_j/∂τ_k

with the optical depth τ_k (extinction × width). The compositing mode computes the last (`Weighting.slope`)
from q_k and Σ_{j>k} w_j q_j: the total Σ w_j q_j = c̄ · C + ā A, known from the image, minus the sum over
j ≤ k. So no sample is stored, and nothing is divided by a transmittance, which may be 0. `Transfer.vjp` pulls
colours and optical depths back to the transfer function; JAX pulls the others back to voxels, ray and step,
segment by segment.

If rays leap over empty space, the first march records each ray's first and last visible cell, and the second
leaps over all others, which saves two fifths of the samples in the head.
"""

from functools import reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from .._util.vec3 import Color, Scalar, along
from ..compositing.blending import Weighting
from ..lighting.shading import Shader
from ..ray import Progress, Scene, measure, pieces
from ..scene.rendering import Rendering
from ..scene.several import Together
from ..scene.space import Ray
from ..scene.transfer import classification_of
from ..scene.volume import fetches_of, voxels_of, with_fetches, with_voxels, without_voxels
from ..scene.voxel_fetch import Fetched
from ..xla.trees import PyTree, added, floats, with_fields, zeros_of
from .rays import vmap_cells
from .segment import Samples, SampleVisitor
from .shading import Weights, lit_colors, weights_of
from .shading_gradient import ShadingTotal, ShadingVjp, shading_vjp
from .voxel_gradient import Sums, check_fetched, recorded, with_cotangents, zero_perturbations, zero_sums


class Cotangents(NamedTuple):
    """Cotangents of rays: c̄ and ā of colour and opacity; `total`, Σ w_j q_j; and, if the loss depends on
    depth, `depth`, d̄ / A, and `middle`, D - t_in."""

    color: Color
    opacity: Scalar
    total: Scalar
    depth: Scalar | None = None
    middle: Scalar | None = None

    @classmethod
    def of(cls, ray: Ray, rendering: Rendering, gradient: Rendering) -> "Cotangents":
        """Cotangents of rays (groups, rays in a group), from their pixels and the pixels' cotangents."""
        *color, opacity = (gradient.rgba[..., i] for i in range(gradient.rgba.shape[-1]))
        final, total = rendering.opacity, jnp.sum(gradient.rgba * rendering.rgba, axis=-1)
        if gradient.details.depth is None:
            return cls(tuple(color), opacity, total)
        visible = final > 0
        middle = jnp.where(visible, rendering.depth - ray.t_in, 0)
        depth = jnp.where(visible, gradient.depth, 0) / jnp.where(visible, final, 1)
        return cls(tuple(color), opacity, total, depth, middle)


class Total(NamedTuple):
    """Cotangents summed over all rays; None for parts that are not perturbed."""

    transfer: PyTree
    rules: PyTree
    """Cotangent of `CellRules.moving`."""
    march: PyTree
    """Cotangent of the march, except through its rules."""
    volume: PyTree
    """Cotangent of the volume without its voxels."""
    voxels: Sums
    shader: PyTree
    """Cotangent of `Shader.leaves`."""
    mode: PyTree
    """Cotangent of the compositing mode."""

    @property
    def of_voxels(self) -> bool:
        """True if the gradient to any voxels is requested."""
        return any(sums is not None for sums in self.voxels)

    @property
    def geometric(self) -> bool:
        """True if samples' depths, widths and points have a gradient, in addition to their values."""
        return self.march is not None

    @classmethod
    def zeros(
        cls,
        scene: Scene,
        shader: Shader | None,
        *,
        transfer: bool,
        mode: bool,
        geometric: bool,
        voxels: list[bool],
    ) -> "Total":
        """Zeros for the requested parts."""
        volume = scene.volume
        return cls(
            zeros_of(scene.transfer) if transfer else None,
            jax.tree.map(jnp.zeros_like, scene.march.rules.moving) if geometric else None,
            zeros_of(scene.march) if geometric else None,
            zeros_of(without_voxels(volume)) if geometric else None,
            zero_sums(volume, voxels),
            None if shader is None else zeros_of(shader.leaves),
            zeros_of(scene.compositing) if mode else None,
        )


class Replay(SampleVisitor):
    """Pulls the cotangents of rays (groups, rays in a group) back to the inputs of their samples.

    Args:
        scene: the scene, whose leaves get the cotangents.
        prepared: the prepared scene, without lighting.
        shader: the shader of samples, applied to `chunk` samples at a time.
        rays: the rays that are marched.
        constants: the rays' cotangents.
        total: the cotangents summed so far, to which those of these rays are added.
    """

    constants: Cotangents
    carry: Scalar
    sums: PyTree
    total: Total

    def __init__(
        self,
        scene: Scene,
        prepared: Scene,
        shader: Shader | None,
        chunk: int,
        rays: Ray,
        constants: Cotangents,
        total: Total,
    ):
        self.scene, self.prepared, self.shader, self.chunk = scene, prepared, shader, chunk
        self.constants, self.total = constants, total
        self.carry = jnp.zeros_like(constants.total)  # the sum of w_j q_j over the samples in front
        self.sums = zeros_of(rays) if total.geometric else None

    def visit(
        self, ray: Ray, at: Progress, samples: Samples, constants: Cotangents, carry: Scalar, total: Total
    ) -> tuple[Scalar, PyTree, Total]:
        bar = jax.tree.map(lambda leaf: leaf[None], constants)  # broadcast over a ray's cells
        classify = vmap_cells(self.prepared.classification.of_cells)
        classified = [classify(measured) for measured in samples.measured]
        depths = [self.prepared.march.sample(cell) for cell in samples.cells]
        weights = weights_of(self.prepared, ray, at, samples.opacity)
        of_color = [tuple(weight * of for of in bar.color) for weight in weights.weight]
        shaded: list[ShadingVjp] | None = None
        colors = [color for color, _ in classified]
        if self.shader is not None:
            sums = ShadingTotal(total.shader, total.transfer, total.voxels)
            shaded, sums = shading_vjp(
                self.shader, self.prepared, ray, samples, weights, of_color, self.chunk, sums
            )
            total = total._replace(transfer=sums.transfer, voxels=sums.voxels, shader=sums.shader)
            of_color = [part.of_color for part in shaded]
            if samples.light is None:
                colors = [part.color for part in shaded]
            else:  # also of invisible samples, whose weight has a derivative
                colors = lit_colors(self.shader, self.prepared, ray, samples.cells, colors, samples.light)
        weight_bars = [_dot(bar.color, color) + bar.opacity for color in colors]
        if bar.depth is not None:
            pairs = zip(weight_bars, depths, strict=True)
            weight_bars = [value + bar.depth * (depth - bar.middle) for value, depth in pairs]
        inside = vmap_cells(Ray.contains, of_cells=(False, True))
        carry, slopes, of_mode = self._slopes(samples.opacity, weights, weight_bars, constants.total, carry)
        total = total._replace(mode=added(total.mode, of_mode))
        slopes = [jnp.where(inside(ray, s), slope, 0) for s, slope in zip(depths, slopes, strict=True)]

        of_measured = []
        for i, (cell, measured) in enumerate(zip(samples.cells, samples.measured, strict=True)):
            of_extinction = slopes[i] * cell.width + (0 if shaded is None else shaded[i].of_extinction)
            if isinstance(self.scene.transfer, Together):
                (color, extinction), weight = classified[i], weights.weight[i]
                live = inside(ray, depths[i]) & ~weights.finished[i]
                thin = _scaled(self._weight_of_thin(weights.before[i]), weights.factor[i])
                clear = jnp.where(live, thin * cell.width, 0)
                # the derivative of colour by emission, also where nothing is visible
                scale = jnp.where(extinction > 0, weight / jnp.where(extinction > 0, extinction, 1), clear)
                emission = tuple(of * scale for of in bar.color)
                of_extinction = of_extinction - _dot(emission, color)
                of_transfer, of_read = self.scene.transfer.emission_vjp(measured, emission, of_extinction)
            else:
                of_transfer, of_read = self.scene.transfer.vjp(
                    measured, of_color[i], of_extinction, integrated=self.prepared.march.integrates
                )
            total = total._replace(transfer=added(total.transfer, of_transfer))
            if shaded is not None:
                of_value, *of_attributes = of_read
                of_read = (of_value + shaded[i].of_value, *of_attributes)
            of_measured.append(of_read)
        if not (total.geometric or self.reads_transfer or total.of_voxels):
            return carry, None, total
        of_width = [slope * extinction for slope, (_, extinction) in zip(slopes, classified, strict=True)]
        of_depth = [None if bar.depth is None else weight * bar.depth for weight in weights.weight]
        of_place = [None] * len(depths) if shaded is None else [part.of_place for part in shaded]
        cotangents = list(zip(of_measured, of_width, of_depth, of_place, strict=True))
        (of_rules, of_march, of_volume, of_rays, of_transfer), fetched, of_fetched = self._geometric_vjp(
            with_fields(ray, reach=None), at, samples.number, cotangents
        )
        total = total._replace(rules=added(total.rules, of_rules), volume=added(total.volume, of_volume))
        if of_march is not None:
            total = total._replace(march=added(total.march, of_march))
        if self.reads_transfer:
            total = total._replace(transfer=added(total.transfer, of_transfer))
        if total.of_voxels:
            voxels = with_cotangents(total.voxels, self.scene.volume, fetched, of_fetched)
            total = total._replace(voxels=voxels)
        return carry, of_rays, total

    def _weight_of_thin(self, before: Scalar) -> Scalar:
        """The derivative of a cell's weight by its opacity, at 0, behind the opacity `before`."""
        compositing, zero = self.prepared.compositing, jnp.zeros_like(before)
        assert isinstance(compositing, Weighting)
        return jax.jvp(lambda alpha: compositing.weight(alpha, before), (zero,), (zero + 1,))[1]

    @property
    def reads_transfer(self) -> bool:
        """True if measured values may depend on the transfer function, and it is perturbed."""
        return self.total.transfer is not None and self.scene.transfer.reads_more

    def _geometric_vjp(
        self, ray: Ray, at: Progress, number: int, cotangents: list[tuple[PyTree, Scalar, Any, Any]]
    ) -> tuple[tuple[PyTree, ...], list[list[Fetched]], list[Any]]:
        """Pulls the cotangents of pieces' measured values, width, depth (None if the loss ignores it) and
        point (None if it is not shaded) back to rules, march (if samples are shaded), volume, rays, and
        transfer function (if it measures samples). Also returns the fetches of each array of voxels, with
        their cotangents. The number of samples is a constant."""
        rules: Any = self.prepared.march
        geometric, voxels = self.total.geometric, self.total.of_voxels
        parts = self.scene.march, without_voxels(self.scene.volume), ray, self.scene.transfer
        asked = geometric and self.shader is not None, geometric, geometric, self.reads_transfer
        pairs = list(zip(parts, asked, strict=True))
        moving = tuple(floats(part) if wanted else None for part, wanted in pairs)
        fixed = tuple(
            eqx.filter(part, eqx.is_inexact_array, inverse=True) if wanted else part for part, wanted in pairs
        )
        moving = (rules.moving if geometric else None, *moving)
        fixed = (rules.constant if geometric else rules, *fixed)
        *shared, ray_fixed, transfer_fixed = fixed

        def one(
            rules: PyTree,
            march: PyTree,
            volume: PyTree,
            ray: PyTree,
            transfer: PyTree,
            perturbations: PyTree,
            ray_fixed: PyTree,
            at: Progress,
            number: Int[Array, ""],
        ) -> tuple[list[Any], list[list[Fetched]]]:
            rules, march, volume, ray, transfer = eqx.combine(
                (rules, march, volume, ray, transfer), (*shared, ray_fixed, transfer_fixed)
            )
            volume, fetched = with_voxels(volume, voxels_of(self.scene.volume)), []
            if voxels:
                volume, fetched = recorded(volume, perturbations)
            else:
                volume = with_fetches(volume, fetches_of(self.prepared.volume))
            classification = classification_of(transfer, volume, integrated=rules.integrates)
            classification = classification._replace(search=None)  # its results have no gradient
            scene = self.prepared._replace(march=rules, volume=volume, classification=classification)
            space = None if self.shader is None else march.locate(volume)
            outputs = []
            for piece in pieces(scene, ray, at, number):
                depth, measured = rules.sample(piece), measure(scene, ray, piece, recorded=True)
                place = along(ray.entry, ray.direction, depth)
                lit = None if space is None else (space.world(place), place, ray.direction)
                at_depth = depth if self.constants.depth is not None else None
                outputs.append((floats(measured), piece.width, at_depth, lit))
            return outputs, fetched

        rays = jax.vmap(one, in_axes=(None, None, None, 0, None, 0, 0, 0, None))
        cells: Any = jax.vmap(rays, in_axes=(None, None, None, None, None, 0, None, None, 0))

        def all_(moving: tuple[PyTree, ...], perturbations: list[Any]) -> PyTree:
            numbers = jnp.arange(number, dtype=at.index.dtype)
            return cells(*moving, perturbations, ray_fixed, at, numbers)

        perturbations = []
        if voxels:
            _, fetched = jax.eval_shape(all_, moving, [])
            check_fetched(self.scene.volume, self.total.voxels)
            dtype = ray.length.dtype
            perturbations = zero_perturbations(self.scene.volume, fetched, self.total.voxels, dtype)
        _, pull, fetched = jax.vjp(all_, moving, perturbations, has_aux=True)
        of_moving, of_fetched = pull(cotangents)
        return of_moving, fetched, of_fetched

    def _slopes(
        self, alphas: list[Scalar], weights: Weights, weight_bars: list[Scalar], total: Scalar, front: Scalar
    ) -> tuple[Scalar, list[Scalar], PyTree]:
        """The new sum of w_j q_j in front, the derivative of the loss by each sample's optical depth, and the
        cotangent of the compositing mode, None if it is not perturbed."""
        slopes: list[list[Scalar]] = [[] for _ in weight_bars]
        total_bars: list[list[Scalar]] = [[] for _ in weight_bars]
        compositing, of_mode = self.prepared.compositing, self.total.mode
        assert isinstance(compositing, Weighting)
        for k in range(weight_bars[0].shape[0]):
            for i, value in enumerate(weight_bars):
                front = front + weights.weight[i][k] * value[k]
                of_weight, finished = _scaled(value, weights.factor[i])[k], weights.finished[i][k]
                parts = weights.after[i][k], of_weight, total - front
                if compositing.has_slope:
                    slope = compositing.slope(alphas[i][k], *parts)
                    slopes[i].append(jnp.where(finished, 0, slope))
                if of_mode is not None or not compositing.has_slope:
                    total_bars[i].append(jnp.where(finished, 0, compositing.total_bar(*parts)))
        known = [jnp.stack(values) for values in slopes] if compositing.has_slope else None
        if known is not None and of_mode is None:
            return front, known, None
        groups = zip(alphas, weights.before, map(jnp.stack, total_bars), strict=True)
        pulled = [_weight_vjp(compositing, *group) for group in groups]
        of_mode = None if of_mode is None else reduce(added, (of_part for of_part, _ in pulled))
        return front, [slope for _, slope in pulled] if known is None else known, of_mode


def _weight_vjp(mode: Weighting, alpha: Scalar, before: Scalar, bar: Scalar) -> tuple[PyTree, Scalar]:
    """Pull-back of the weights of cells to the mode, and to the cells' optical depths."""
    moving, fixed = eqx.partition(mode, eqx.is_inexact_array)

    def weight(moving: PyTree, more: Scalar) -> Scalar:
        # the derivative of opacity 1 is 0, also where that of the weight is infinite
        thicker = alpha + jnp.where(alpha < 1, (1 - alpha) * more, 0)
        return eqx.combine(moving, fixed).weight(thicker, before)

    return jax.vjp(weight, moving, jnp.zeros_like(alpha))[1](bar)


def _scaled(value: Scalar, factor: Scalar | None) -> Scalar:
    return value if factor is None else value * factor


def _dot(a: Color, b: Color) -> Scalar:
    return reduce(jnp.add, map(jnp.multiply, a, b))
