"""Compositing modes: what pixels show of values along rays, in NumPy; gradients by central differences."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import map_coordinates

import jaxvol as jv
from docs.registry import subclasses
from jaxvol.fitting.bijections import Bijection, Fixed
from jaxvol.fitting.constraints import _default

from . import oracle
from .scenes import LEAVES, RESOLUTION, random_numbers, soft_transfer


class Additive(jv.Weighting):
    """A part of all opacities is summed; nothing hides what lies behind it."""

    part: float = eqx.field(static=True, default=0.01)

    def weight(self, alpha, before):
        return self.part * alpha

    def slope(self, alpha, after, weight_bar, sum_behind):
        return self.part * (1 - alpha) * weight_bar


class FoggedSurface(jv.Isosurface):
    """An isosurface that is darker the farther away it is, and brighter the denser what lies before it is: it
    uses what the march has found in every way in which a mode may."""

    def pixel(self, sampler, state):
        rgba, depth = super().pixel(sampler, state)
        _, extinction = sampler.shaded(state.front)
        return rgba * jnp.exp(-0.3 * sampler.differentiable_depth(state.front)) * (1 + extinction), depth


VALUE = 0.45
"""Of the isosurface, for values from 0 to 1."""


def ball_in_a_corner():
    """A ball of values from 0 to 1, greatest in its middle, with much empty space around it."""
    place = np.indices((RESOLUTION,) * 3) - np.reshape([17.5, 17.2, 16.8], (3, 1, 1, 1))
    return jv.Volume(np.clip(1 - np.linalg.norm(place, axis=0) / 5.5, 0, 1).astype(np.float32), [0.1] * 3)


def scaled_transfer(top, transfer=None):
    """A transfer function for values from 0 to 1, by default the soft one, for values from 0 to `top`."""
    transfer = soft_transfer() if transfer is None else transfer
    return jv.TransferFunction(np.asarray(transfer.values) * top, transfer.colors, transfer.extinction)


def free_leaves(parameters):
    """Paths of the leaves that a fit changes by default."""
    bounds = jax.tree.leaves_with_path(_default(parameters), is_leaf=lambda b: isinstance(b, Bijection))
    return {jax.tree_util.keystr(path) for path, bound in bounds if not isinstance(bound, Fixed)}


def classified(transfer, values):
    """Colours and extinctions of values."""
    points, colors, extinction = (
        np.asarray(part, np.float64) for part in (transfer.values, transfer.colors, transfer.extinction)
    )
    return np.stack([np.interp(values, points, c) for c in colors.T], -1), np.interp(
        values, points, extinction
    )


class Rays:
    """The rays of a camera through a volume, one after the other, in float64. Depths are past the entry."""

    def __init__(self, volume, camera):
        self.data, self.spacing, self.corner = (
            np.asarray(part, np.float64) for part in (volume.data, volume.spacing, volume.origin)
        )
        self.origins, self.directions = (
            np.asarray(part, np.float64).reshape(-1, 3) for part in camera.rays()
        )
        last = self.corner + (np.array(self.data.shape) - 1) * self.spacing
        first, last = oracle.box_interval(self.origins, self.directions, self.corner, last)
        self.hit = last > first
        self.t_in, self.length = np.where(self.hit, first, 0), np.where(self.hit, last - first, 0)

    def points(self, depth):
        """World points at depths (rays, cells)."""
        t = self.t_in[:, None] + np.clip(depth, 0, self.length[:, None])
        return self.origins[:, None] + t[..., None] * self.directions[:, None]

    def value(self, depth, data=None):
        """Values at depths (rays, cells), or what is interpolated of other `data`."""
        at = (self.points(depth) - self.corner) / self.spacing
        found = map_coordinates(
            self.data if data is None else data, at.reshape(-1, 3).T, order=1, mode="nearest"
        )
        return found.reshape(np.shape(depth))

    def cells(self, step, start=None, empty=None):
        """Front and width of cells (rays, cells), the last one cut at the exit, and of width 0 behind it.
        `start`: of the first cells, in steps; or, with `empty`, how far the first empty cell is from the next
        one. `empty`: which cells are, by front and width."""
        front = step * np.arange(int(self.length.max() / step) + 2) + np.zeros((len(self.length), 1))
        start = np.zeros(len(front)) if start is None else start
        if empty is None:
            front += step * start[:, None]
        else:
            seen = empty(front, np.clip(self.length[:, None] - front, 0, step))
            behind = np.cumsum(seen, axis=1) - seen > 0
            front -= step * (1 - start)[:, None] * behind
        return front, np.clip(self.length[:, None] - front, 0, step)


class Cells(NamedTuple):
    """What NumPy knows of the cells of rays, arrays (rays, cells); `value`: of the isosurface."""

    rays: Rays
    transfer: jv.TransferFunction
    front: np.ndarray
    width: np.ndarray
    depth: np.ndarray
    values: np.ndarray
    value: float

    @property
    def extinction(self):
        return classified(self.transfer, self.values)[1]

    @property
    def optical_depth(self):
        return self.extinction * self.width

    @property
    def alpha(self):
        return -np.expm1(-self.optical_depth)

    @property
    def crosses(self):
        ends = self.front, self.front + self.width
        first, last = (self.rays.value(end) >= self.value for end in ends)
        return first != last


def layer(transfer, value, visible, thickness=0.5):
    """Premultiplied colour and opacity of a layer of a value."""
    color, extinction = classified(transfer, value)
    opacity = visible * -np.expm1(-thickness * extinction)
    return opacity[:, None] * color, opacity


def bisected(rays, near, far, value):
    """Where values cross one, between depths on either side."""
    rises = rays.value(near[:, None])[:, 0] < value
    for _ in range(50):
        middle = (near + far) / 2
        behind = (rays.value(middle[:, None])[:, 0] >= value) == rises
        near, far = np.where(behind, near, middle), np.where(behind, middle, far)
    return near


def weighted(weight_of, finished=None):
    """The formula of a weighting, by its weights; `finished`: what becomes of the sums."""

    def pixel(cells):
        weight, color = weight_of(cells), classified(cells.transfer, cells.values)[0]
        opacity = weight.sum(axis=1)
        whole = np.where(opacity > 0, opacity, 1)
        depth = np.where(opacity > 0, (weight * cells.depth).sum(axis=1) / whole, np.inf)
        premultiplied = (weight[..., None] * color).sum(axis=1)
        if finished is not None:
            premultiplied, opacity = finished(
                cells, premultiplied, opacity, (weight * cells.values).sum(axis=1)
            )
        return premultiplied, opacity, depth

    return pixel


def behind_others(cells):
    alpha = cells.alpha
    hidden = np.cumprod(1 - alpha, axis=1)[:, :-1]
    return alpha * np.concatenate([np.ones((len(alpha), 1)), hidden], axis=1)


def of_mean(cells, premultiplied, length, sums):
    return layer(cells.transfer, sums / np.where(length > 0, length, 1), cells.rays.hit)


def extreme(sign):
    """The formula of the greatest value of a ray, or by a sign of -1 of the least."""

    def pixel(cells):
        best = np.argmax(np.where(cells.width > 0, sign * cells.values, -np.inf), axis=1)
        depth = cells.depth[np.arange(len(best)), best]
        premultiplied, opacity = layer(cells.transfer, cells.rays.value(depth[:, None])[:, 0], cells.rays.hit)
        return premultiplied, opacity, np.where(opacity > 0, depth, np.inf)

    return pixel


def first_visible(cells):
    seen = cells.alpha > 0
    depth = cells.depth[np.arange(len(seen)), np.argmax(seen, axis=1)]
    return opaque(cells, cells.rays.value(depth[:, None])[:, 0], seen.any(axis=1), depth)


def surface(cells):
    crosses = cells.crosses
    at = np.arange(len(crosses)), np.argmax(crosses, axis=1)
    depth = bisected(cells.rays, cells.front[at], (cells.front + cells.width)[at], cells.value)
    return opaque(cells, cells.value, crosses.any(axis=1), depth)


def opaque(cells, value, visible, depth):
    premultiplied = visible[:, None] * classified(cells.transfer, value)[0]
    return premultiplied, visible.astype(float), np.where(visible, depth, np.inf)


class Known(NamedTuple):
    """A mode, and what its pixels show by NumPy.

    Attributes:
        formula: premultiplied colour, opacity, and depth past the entry, of `Cells`.
        dtype: voxels with which its image is compared.
        quadrature: by which marches sample.
        shifts: whether `EmptySpaceJitter` shifts samples, at a first cell that is `empty`.
    """

    mode: jv.Weighting | jv.Selection
    formula: Callable[[Cells], tuple[np.ndarray, np.ndarray, np.ndarray]]
    dtype: str = "float32"
    quadrature: Any = "left"
    shifts: bool = True
    empty: Callable[[Cells], np.ndarray] = lambda cells: cells.extinction == 0


KNOWN = {
    "over": Known(jv.Over(), weighted(behind_others), "int16"),
    "additive": Known(Additive(), weighted(lambda cells: 0.01 * cells.alpha), "uint8"),
    "average": Known(
        jv.Average(0.5), weighted(lambda cells: cells.width, of_mean), quadrature="midpoint", shifts=False
    ),
    "integral": Known(
        jv.LineIntegral(),
        weighted(lambda cells: cells.optical_depth, lambda _, rgb, depth, sums: (rgb, -np.expm1(-depth))),
    ),
    "maximum": Known(jv.Maximum(0.5), extreme(1), "uint8"),
    "minimum": Known(jv.Minimum(0.5), extreme(-1), "uint16"),
    "first visible": Known(jv.FirstVisible(), first_visible, "uint8"),
    "isosurface": Known(jv.Isosurface(VALUE), surface, empty=lambda cells: ~cells.crosses),
}
MODES = {name: known.mode for name, known in KNOWN.items()}
assert {*map(type, MODES.values())} >= {*subclasses(jv.Compositing)}, "each public mode has a formula"


def shown(name, volume, transfer, camera, step, jitter, value=VALUE):
    """What pixels show under a mode of `KNOWN`, by NumPy, with `EmptySpaceJitter` and cells that are cut at
    the exit: rgba, distance, and how many samples the rays have. `value`: of the isosurface."""
    rays, known = Rays(volume, camera), KNOWN[name]

    def cells_of(front, width):
        depth = front + width / 2 * (known.quadrature == "midpoint")
        return Cells(rays, transfer, front, width, depth, rays.value(depth), value)

    if known.shifts:
        empty = lambda front, width: known.empty(cells_of(front, width))  # noqa: E731
        cells = cells_of(*rays.cells(step, random_numbers(jitter, camera), empty))
    else:
        cells = cells_of(*rays.cells(step))
    premultiplied, opacity, depth = known.formula(cells)
    shape = camera.size[::-1]
    rgba = np.concatenate([premultiplied, opacity[:, None]], axis=1).reshape(*shape, 4)
    return rgba, (rays.t_in + depth).reshape(shape), np.sum(cells.width > 0)


def same_image(found, rgba, depth):
    """Asserts that a rendering shows this, at these distances; those of surfaces to 1e-4 of a voxel."""
    np.testing.assert_allclose(found.rgba, rgba, atol=2e-5)
    finite = np.isfinite(depth)
    np.testing.assert_array_equal(np.isfinite(found.depth), finite)
    np.testing.assert_allclose(np.asarray(found.depth)[finite], depth[finite], rtol=1e-5, atol=5e-6)


def check_gradients(
    scene, parameters, adjoint="replay", *, normals=False, constant=(), lighting=None, jit=True
):
    """Asserts that the gradient of a loss of colours and depths (and normals) is that of central differences,
    for each leaf of the scene; and 0 for a camera that looks away. All by one program, in float64.

    `scene`: volume, transfer function, camera, march, mode. `parameters`: further leaves of it, by name.
    `constant`: those on which the loss does not depend. `jit`: without, 8-bit voxels are packed."""
    leaves = {name: of for name, of in (LEAVES | parameters).items() if eqx.is_inexact_array(of(scene))}
    random = np.random.default_rng(3)
    weights = random.normal(size=(*scene[2].size[::-1], 8))

    def loss(given):
        new = tuple(jnp.asarray(given[name]) for name in leaves)
        moved = eqx.tree_at(lambda s: tuple(of(s) for of in leaves.values()), scene, new)
        image = jv.render(*moved[:4], compositing=moved[4], adjoint=adjoint, lighting=lighting)
        hit = jnp.isfinite(image.depth)
        parts = [image.rgba, jnp.where(hit, image.depth, 0)[..., None], *([image.normal] if normals else [])]
        seen = jnp.concatenate(parts, axis=-1)
        return jnp.sum(seen * weights[..., : seen.shape[-1]]), jnp.mean(hit)

    run: Any = jax.value_and_grad(loss, has_aux=True)
    if adjoint == "forward":
        run = lambda given, way: jax.jvp(loss, (given,), (way,), has_aux=True)  # noqa: E731
    run = jax.jit(run) if jit else run

    def along(given, way):
        """Loss, its slope along a direction, and the share of the pixels that show anything."""
        if adjoint == "forward":
            found, slope, hit = run(given, way)
            return float(found), float(slope), float(hit)
        (found, hit), gradient = run(given)
        return float(found), float(sum(np.vdot(gradient[name], way[name]) for name in way)), float(hit)

    # NumPy arrays, so that arithmetic needs no programs
    given = {name: np.asarray(of(scene)) for name, of in leaves.items()}
    ways = {name: random.choice([-1.0, 1.0], leaf.shape) for name, leaf in given.items()}
    # extinctions of 0 stay 0, since none is negative
    ways["extinction"] = np.where(given["extinction"] > 0, ways["extinction"], 0)
    none = {name: np.zeros_like(leaf) for name, leaf in given.items()}
    slopes, expected, h = {}, [], 1e-7
    for name, way in ways.items():
        _, slopes[name], hit = along(given, {**none, name: way})
        assert hit > 0.15
        ahead, behind = (along({**given, name: given[name] + h * side * way}, none)[0] for side in (1, -1))
        expected.append((ahead - behind) / (2 * h))
    np.testing.assert_allclose([*slopes.values()], expected, rtol=1e-5, atol=1e-7, err_msg=str([*slopes]))
    assert {name for name, slope in slopes.items() if abs(slope) < 1e-9} == set(constant)
    away = {**given, "focal_point": 2 * given["position"] - given["focal_point"]}
    _, slope, hit = along(away, ways)
    assert hit == slope == 0
