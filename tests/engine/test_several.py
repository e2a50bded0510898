"""Several volumes in one image: a grid of values, one of colours and densities, and a field of a network.

Against an independent marcher in NumPy, which adds up at each sample, and central differences; in float64.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

import jaxvol as jv

from .. import oracle
from ..scenes import in_float64, slow


STEP, SIZE = 0.17, (7, 6)
TURN = np.array([[0.8, -0.36, 0], [0.6, 0.8, 0.28], [0, 0.48, 0.96]])
"""Sheared: its axes are 47° to 80° apart."""


class Network(jv.Field):
    """A density of a multilayer perceptron, of which an activation is a function, and of another volume."""

    layers: eqx.nn.MLP
    inner: jv.Volume

    def value(self, volume, coordinate):
        (found,) = self.layers(jnp.stack([*coordinate, self.inner.value(coordinate)]) / 4)
        return jax.nn.softplus(found)


def above(least, density):
    return jnp.where(density > least, (density - least) ** 2, 0)


def noise(*shape, seed):
    data = gaussian_filter(np.random.default_rng(seed).normal(size=shape), (1, 1, 1, 0)[: len(shape)])
    return (data - data.min()) / (data.max() - data.min())


def scene():
    """Values (the largest, whose axes the others share a grid with), colours on sheared axes, a network."""
    grid = jv.Volume(noise(9, 8, 7, seed=0), (0.2, 0.22, 0.25))
    colors = jv.Volume(noise(5, 6, 7, 4, seed=1), (0.3, 0.25, 0.2), (0.6, -0.3, 0.4), direction=TURN)
    shapes = eqx.filter_eval_shape(
        lambda: eqx.nn.MLP(4, 1, 4, 1, activation=jax.nn.tanh, key=jax.random.key(0))
    )
    random = np.random.default_rng(3)
    layers = jax.tree.map(
        lambda leaf: jax.device_put(random.normal(size=leaf.shape)) if hasattr(leaf, "shape") else leaf,
        shapes,
    )
    inner = jv.Volume(noise(4, 4, 4, seed=2))
    field = jv.Volume(np.zeros((4, 4, 4)), (0.3, 0.3, 0.3), (-0.5, 0.2, 0.1), field=Network(layers, inner))
    tables = [
        jv.TransferFunction([0.5, 0.7, 1], np.eye(3), [0, 2, 5]),
        jv.RadianceField(6.0, density=jax.tree_util.Partial(above, jax.device_put(0.2))),
        jv.TransferFunction([0, 2], [[1, 1, 0], [0, 1, 1]], [0.1, 1]),
    ]
    camera = jv.Camera((2.5, -6.5, 2.5), (0.8, 0.8, 0.8), (0, 0, 1), 20, size=SIZE)
    return [grid, colors, field], tables, camera


def march(leaps):
    # not by a switch: whoever may leap doesn't differentiate what is in front of all that is visible
    transforms = jv.AlphaCorrection(), *([jv.SpaceLeaping("distance")] if leaps else [])
    return jv.March(STEP, transforms, "midpoint", max_samples=64)


@eqx.filter_jit
def found(parts, along, leaps, second=False) -> Any:
    """The image; a loss, its gradient, and, where rays leap, its derivative along a direction, forwards.
    Or the gradient, and its derivative along the direction."""
    floats, fixed = eqx.partition(parts, eqx.is_inexact_array)
    weights = jnp.asarray(np.random.default_rng(5).normal(size=(*SIZE[::-1], 4)))

    def loss(floats):
        volumes, tables, camera = eqx.combine(floats, fixed)
        rgba = jv.render(volumes, tables, camera, march(leaps), outputs="rgba").rgba
        return jnp.sum(weights * rgba + rgba**2), rgba

    gradient = jax.value_and_grad(loss, has_aux=True)
    if second:
        return jax.jvp(lambda floats: gradient(floats)[1], (floats,), (along,))
    (value, image), of = gradient(floats)
    return image, value, of, leaps and jax.jvp(lambda floats: loss(floats)[0], (floats,), (along,))[1]


class Placed:
    """A volume and its transfer function in NumPy."""

    def __init__(self, volume, table):
        self.volume, self.table = jax.tree.map(
            lambda leaf: np.asarray(leaf) if eqx.is_array(leaf) else leaf, (volume, table)
        )
        self.last = np.array(volume.shape) - 1
        self.turn = np.eye(3) if volume.direction is None else self.volume.direction
        self.back = np.linalg.inv(self.turn).T / self.volume.spacing

    def at(self, point):
        return (point - self.volume.origin) @ self.back

    @property
    def corners(self):
        at = np.stack(np.meshgrid(*[[0, 1]] * 3), axis=-1).reshape(-1, 3) * self.last * self.volume.spacing
        return self.volume.origin + at @ self.turn.T

    def span(self, origin, way):
        return interval(self.at(origin), way @ self.back, np.zeros(3), self.last)

    def shown(self, point):
        """Colour and extinction."""
        place, data, table = np.clip(self.at(point), 0, self.last), self.volume.data, self.table
        if self.volume.field is not None:
            inner = map_coordinates(self.volume.field.inner.data, place[:, None], order=1)
            first, second = self.volume.field.layers.layers
            hidden = np.tanh(first.weight @ (np.append(place, inner) / 4) + first.bias)
            value = np.log1p(np.exp(second.weight @ hidden + second.bias))[0]
        elif data.ndim > 3:
            read = [map_coordinates(each, place[:, None], order=1)[0] for each in np.moveaxis(data, -1, 0)]
            (least,) = table.density.args
            return np.array(read[:3]), table.scale * max(read[3] - least, 0) ** 2
        else:
            value = map_coordinates(data, place[:, None], order=1)[0]
        color = np.array([np.interp(value, table.values, channel) for channel in table.colors.T])
        return color, np.interp(value, table.values, table.extinction)


def interval(origin, way, low, high):
    (near,), (far,) = oracle.box_interval(origin[None], way[None], low, high)
    return near, max(far, near)


def marched(parts):
    """The image, by sums at each sample, from the entry into the box that holds all volumes."""
    placed = list(map(Placed, *parts[:2]))
    corners = np.concatenate([each.corners for each in placed])
    origins, ways = map(np.asarray, parts[2].rays())
    image = np.zeros((*SIZE[::-1], 4))
    for pixel in np.ndindex(SIZE[::-1]):
        origin, way = origins[pixel], ways[pixel]
        near, far = interval(origin, way, corners.min(0), corners.max(0))
        spans = [each.span(origin, way) for each in placed]
        for front in np.arange(near, far, STEP):
            width, emission, whole = min(STEP, far - front), np.zeros(3), 0.0
            for each, (enters, leaves) in zip(placed, spans, strict=True):
                color, extinction = each.shown(origin + way * (front + width / 2))
                extinction *= max(min(leaves, front + width) - max(enters, front), 0) / width
                emission, whole = emission + extinction * color, whole + extinction
            weight = (1 - image[pixel][3]) * -np.expm1(-whole * width)
            image[pixel] += weight * np.append(emission / max(whole, 1e-300), 1)
    return image


def along(parts, seed):
    """A random direction. Control points stay, which have no gradient, and extinctions of 0, below which
    there is nothing."""
    random = np.random.default_rng(seed)

    def of(path, leaf):
        if not eqx.is_inexact_array(leaf):
            return None
        name, way = jax.tree_util.keystr(path), random.normal(size=leaf.shape)
        if "extinction" in name:
            way = np.where(np.asarray(leaf) == 0, 0, way)
        return jax.device_put(0 * way if ".values" in name else way)

    return jax.tree_util.tree_map_with_path(of, parts)


def moved(parts, direction, by):
    """In NumPy, which compiles nothing."""
    return jax.tree.map(
        lambda leaf, way: leaf if way is None else jax.device_put(np.asarray(leaf) + by * np.asarray(way)),
        parts,
        direction,
        is_leaf=lambda leaf: leaf is None,
    )


def dot(a, b):
    return sum(float(np.vdot(x, y)) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def test_extinctions_and_colors_add_at_each_sample_and_derivatives_are_central_differences():
    with in_float64():
        parts, h = scene(), 1e-6
        direction = along(parts, 3)
        image, _, gradient, forward = found(parts, direction, True)
        np.testing.assert_allclose(image, marched(parts), atol=1e-10)
        assert 0.3 < np.mean(np.asarray(image)[..., 3] > 0.05) < 1
        _, value, of, _ = found(parts, direction, False)
        np.testing.assert_allclose(dot(of, direction), forward, rtol=1e-9)
        # also where nothing is visible, by an extinction of 0
        more = eqx.tree_at(lambda p: p[1][0].extinction, parts, jax.device_put(np.array([h, 2, 5])))
        rise = (np.asarray(found(more, direction, False)[1]) - np.asarray(value)) / h
        np.testing.assert_allclose(np.asarray(of[1][0].extinction)[0], rise, rtol=1e-4)
        np.testing.assert_allclose(dot(gradient, direction), forward, rtol=1e-9)
        before, after = (found(moved(parts, direction, sign * h), direction, True)[1] for sign in (-1, 1))
        np.testing.assert_allclose(forward, (np.asarray(after) - np.asarray(before)) / (2 * h), rtol=1e-5)


@pytest.mark.parametrize("kind", [0, *slow(1, 2, 3)])
def test_forward_over_replay_is_the_change_of_the_gradient(kind):
    """Of one volume of each kind, and of all together."""
    with in_float64():
        volumes, tables, camera = scene()
        parts = (volumes, tables, camera) if kind == 3 else ([volumes[kind]], [tables[kind]], camera)
        direction, h = along(parts, 4), 1e-6
        gradient, second = found(parts, direction, True, second=True)
        before, after = (
            found(moved(parts, direction, sign * h), direction, True, second=True)[0] for sign in (-1, 1)
        )
        change = jax.tree.map(lambda a, b: (np.asarray(a) - np.asarray(b)) / (2 * h), after, before)
        for (path, leaf), expected in zip(
            jax.tree_util.tree_flatten_with_path(second)[0], jax.tree.leaves(change), strict=True
        ):
            size = max(float(np.linalg.norm(expected)), 1e-3)
            assert np.linalg.norm(np.asarray(leaf) - expected) < 1e-5 * size, jax.tree_util.keystr(path)
        assert dot(gradient, direction) != 0
