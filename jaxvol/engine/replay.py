"""VJP of marching a tile's rays: a second march, front to back, computes each sample again.

Let c̄, ā and d̄ be the cotangents of a ray's colour C, opacity A and depth D = t_in + Σ w s / A, where sample
k has weight w_k, colour c_k and depth s_k past the entry. Then a unit of its weight is worth

    q_k = c̄ · c_k + ā + (d̄ / A) (s_k - (D - t_in))

to the loss, and

    ∂L/∂c_k = w_k c̄        ∂L/∂s_k = w_k d̄ / A        ∂L/∂τ_k = Σ_j q_j ∂w_j/∂τ_k

with the optical depth τ_k (extinction × width). The last is the compositing mode's to say
(`Weighting.slope`) from q_k and Σ_{j>k} w_j q_j, which is Σ w_j q_j = c̄ · C + ā A, known from the image,
minus the sum over j ≤ k. So nothing is kept for each sample, and nothing is divided by a transmittance,
which may be 0. `Transfer.vjp` pulls colours and optical depths back to the transfer function, JAX all else to
the voxels, the ray and the step, one segment at a time.

Where rays leap over empty space, the first march records each ray's first and last visible cell, and the
second one leaps over all others, which saves two fifths of the samples in the head.
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
from .segment import Samples, SampleVisitor, vmap_cells
from .shading import Weights, lit_colors, weights_of
from .shading_gradient import ShadingTotal, ShadingVjp, shading_vjp
from .voxel_gradient import Sums, check_fetched, recorded, with_cotangents, zero_perturbations, zero_sums


class Cotangents(NamedTuple):
    """For each ray, the cotangents of colour and opacity, c̄ and ā; `worth`, Σ w_j q_j; and, where the loss
    depends on depth, `depth`, d̄ / A, and `middle`, D - t_in."""

    color: Color
    opacity: Scalar
    worth: Scalar
    depth: Scalar | None = None
    middle: Scalar | None = None

    @classmethod
    def of(cls, ray: Ray, rendering: Rendering, gradient: Rendering) -> "Cotangents":
        """Of rays (groups, rays in a group), from their part of the image and of its cotangent."""
        *color, opacity = (gradient.rgba[..., i] for i in range(gradient.rgba.shape[-1]))
        final, worth = rendering.opacity, jnp.sum(gradient.rgba * rendering.rgba, axis=-1)
        if gradient.details.depth is None:
            return cls(tuple(color), opacity, worth)
        visible = final > 0
        middle = jnp.where(visible, rendering.depth - ray.t_in, 0)
        depth = jnp.where(visible, gradient.depth, 0) / jnp.where(visible, final, 1)
        return cls(tuple(color), opacity, worth, depth, middle)


class Total(NamedTuple):
    """Gradients summed over all rays; None for what is not asked for."""

    transfer: PyTree
    rules: PyTree
    """Of `CellRules.moving`."""
    march: PyTree
    """Of the march, but for what its rules take from it."""
    volume: PyTree
    """Of everything in it but the voxels."""
    voxels: Sums
    shader: PyTree
    """Of `Shader.leaves`."""

    @property
    def of_voxels(self) -> bool:
        """Whether voxels have a gradient."""
        return any(sums is not None for sums in self.voxels)

    @property
    def geometric(self) -> bool:
        """Whether samples' depths, widths and points have a gradient, not only what they show."""
        return self.march is not None

    @classmethod
    def zeros(
        cls, scene: Scene, shader: Shader | None, *, transfer: bool, geometric: bool, voxels: list[bool]
    ) -> "Total":
        """Zeros for these parts."""
        volume = scene.volume
        return cls(
            zeros_of(scene.transfer) if transfer else None,
            jax.tree.map(jnp.zeros_like, scene.march.rules.moving) if geometric else None,
            zeros_of(scene.march) if geometric else None,
            zeros_of(without_voxels(volume)) if geometric else None,
            zero_sums(volume, voxels),
            None if shader is None else zeros_of(shader.leaves),
        )


class Replay(SampleVisitor):
    """Pulls the cotangents of rays (groups, rays in a group) back to what their samples depend on.

    Args:
        scene: as given; its leaves get the cotangents.
        prepared: the same, without lighting.
        shader: what shades the samples, `chunk` at a time.
        rays: those that are marched.
        given: their cotangents.
        total: the gradients so far, to which those of these rays are added.
    """

    given: Cotangents
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
        given: Cotangents,
        total: Total,
    ):
        self.scene, self.prepared, self.shader, self.chunk = scene, prepared, shader, chunk
        self.given, self.total = given, total
        self.carry = jnp.zeros_like(given.worth)  # what the samples in front are worth
        self.sums = zeros_of(rays) if total.geometric else None

    def visit(
        self, ray: Ray, at: Progress, samples: Samples, given: Cotangents, carry: Scalar, total: Total
    ) -> tuple[Scalar, PyTree, Total]:
        each = jax.tree.map(lambda leaf: leaf[None], given)  # broadcast over a ray's cells
        whole = with_fields(ray, reach=None)
        classify = vmap_cells(self.prepared.classification.of_cells)
        classified = [classify(measured) for measured in samples.measured]
        depths = [self.prepared.march.sample(cell) for cell in samples.cells]
        weights = weights_of(self.prepared, at, samples.opacity)
        of_color = [tuple(weight * of for of in each.color) for weight in weights.weight]
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
            else:  # also of invisible samples, which are worth something: they would become visible
                colors = lit_colors(self.shader, self.prepared, ray, samples.cells, colors, samples.light)
        worth = [_dot(each.color, color) + each.opacity for color in colors]
        if each.depth is not None:
            worth = [
                value + each.depth * (depth - each.middle) for value, depth in zip(worth, depths, strict=True)
            ]
        inside = vmap_cells(Ray.contains, of_cells=(False, True))
        carry, slopes = self._slopes(samples.opacity, weights, worth, given.worth, carry)
        slopes = [jnp.where(inside(ray, s), slope, 0) for s, slope in zip(depths, slopes, strict=True)]

        of_measured = []
        for i, (cell, measured) in enumerate(zip(samples.cells, samples.measured, strict=True)):
            of_extinction = slopes[i] * cell.width + (0 if shaded is None else shaded[i].of_extinction)
            if isinstance(self.scene.transfer, Together):
                (color, extinction), weight = classified[i], weights.weight[i]
                live = inside(ray, depths[i]) & ~weights.finished[i]
                clear = jnp.where(live, self._weight_of_thin(weights.before[i]) * cell.width, 0)
                # what a unit of emission shows as, where nothing is visible, too
                seen = jnp.where(extinction > 0, weight / jnp.where(extinction > 0, extinction, 1), clear)
                emission = tuple(of * seen for of in each.color)
                of_extinction = of_extinction - _dot(emission, color)
                of_transfer, of_read = self.scene.transfer.emission_vjp(measured, emission, of_extinction)
            else:
                of_transfer, of_read = self.scene.transfer.vjp(
                    measured, of_color[i], of_extinction, integrated=self.prepared.march.integrates
                )
            total = total._replace(transfer=added(total.transfer, of_transfer))
            if shaded is not None:
                of_value, *rest = of_read
                of_read = (of_value + shaded[i].of_value, *rest)
            of_measured.append(of_read)
        if not (total.geometric or self.reads_transfer or total.of_voxels):
            return carry, None, total
        of_width = [slope * extinction for slope, (_, extinction) in zip(slopes, classified, strict=True)]
        of_depth = [None if each.depth is None else weight * each.depth for weight in weights.weight]
        of_place = [None] * len(depths) if shaded is None else [part.of_place for part in shaded]
        (of_rules, of_march, of_volume, of_rays, of_transfer), fetched, of_fetched = self._geometric_vjp(
            whole, at, samples.number, list(zip(of_measured, of_width, of_depth, of_place, strict=True))
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
        """The weight of a very thin cell behind this opacity, for a unit of its own opacity."""
        compositing, zero = self.prepared.compositing, jnp.zeros_like(before)
        assert isinstance(compositing, Weighting)
        return jax.jvp(lambda alpha: compositing.weight(alpha, before), (zero,), (zero + 1,))[1]

    @property
    def reads_transfer(self) -> bool:
        """Whether what is measured at a sample may depend on the transfer function, and has a gradient."""
        return self.total.transfer is not None and self.scene.transfer.reads_more

    def _geometric_vjp(
        self, ray: Ray, at: Progress, number: int, cotangents: list[tuple[PyTree, Scalar, Any, Any]]
    ) -> tuple[tuple[PyTree, ...], list[list[Fetched]], list[Any]]:
        """From the cotangents of each piece's measured values and width, of its depth where the loss depends
        on that, and of its point where it is shaded: those of the march's rules, of the march where samples
        are shaded, of volume, rays, and of the transfer function where samples are measured by it; what was
        fetched of each array of voxels; and the cotangents of that. The number of samples counts as constant.
        """
        rules: Any = self.prepared.march
        geometric, voxels = self.total.geometric, self.total.of_voxels
        parts = self.scene.march, without_voxels(self.scene.volume), ray, self.scene.transfer
        asked = geometric and self.shader is not None, geometric, geometric, self.reads_transfer
        moving = tuple(floats(part) if a else None for part, a in zip(parts, asked, strict=True))
        fixed = tuple(
            eqx.filter(part, eqx.is_inexact_array, inverse=True) if a else part
            for part, a in zip(parts, asked, strict=True)
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
            perturbations: Any,
            ray_fixed: PyTree,
            at: Progress,
            number: Int[Array, ""],
        ) -> tuple[list[Any], list[list[Fetched]]]:
            rules, march, volume, ray, transfer = eqx.combine(
                (rules, march, volume, ray, transfer), (*shared, ray_fixed, transfer_fixed)
            )
            whole, fetched = with_voxels(volume, voxels_of(self.scene.volume)), []
            if voxels:
                here, fetched = recorded(whole, perturbations)
            else:
                here = with_fetches(whole, fetches_of(self.prepared.volume))
            classification = classification_of(transfer, here, integrated=rules.integrates)
            classification = classification._replace(search=None)  # what it finds has no gradient
            scene = self.prepared._replace(march=rules, volume=here, classification=classification)
            space = None if self.shader is None else march.locate(here)
            found = []
            for piece in pieces(scene, ray, at, number):
                depth, measured = rules.sample(piece), measure(scene, ray, piece, recorded=True)
                place = along(ray.entry, ray.direction, depth)
                lit = None if space is None else (space.world(place), place, ray.direction)
                at_depth = depth if self.given.depth is not None else None
                found.append((floats(measured), piece.width, at_depth, lit))
            return found, fetched

        rays = jax.vmap(one, in_axes=(None, None, None, 0, None, 0, 0, 0, None))
        cells: Any = jax.vmap(rays, in_axes=(None, None, None, None, None, 0, None, None, 0))

        def all_(moving: tuple[PyTree, ...], perturbations: list[Any]) -> PyTree:
            each = jnp.arange(number, dtype=at.index.dtype)
            return cells(*moving, perturbations, ray_fixed, at, each)

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
        self, alphas: list[Scalar], weights: Weights, worth: list[Scalar], whole: Scalar, front: Scalar
    ) -> tuple[Scalar, list[Scalar]]:
        """What all samples so far are worth, and the derivative of the loss by each one's optical depth."""
        slopes: list[list[Scalar]] = [[] for _ in worth]
        compositing = self.prepared.compositing
        assert isinstance(compositing, Weighting)
        for k in range(worth[0].shape[0]):
            for i, value in enumerate(worth):
                front = front + weights.weight[i][k] * value[k]
                slope = compositing.slope(alphas[i][k], weights.after[i][k], value[k], whole - front)
                slopes[i].append(jnp.where(weights.finished[i][k], 0, slope))
        return front, [jnp.stack(each) for each in slopes]


def _dot(a: Color, b: Color) -> Scalar:
    return reduce(jnp.add, map(jnp.multiply, a, b))
