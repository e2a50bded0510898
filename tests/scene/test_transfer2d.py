"""Transfer functions of value and gradient magnitude: the table, its bounds, images and gradients."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.engine.acceleration import VolumeAcceleration
from jaxvol.scene.occupancy import BLOCK, Blocks
from jaxvol.scene.transfer import classification_of

from ..modes import Rays, check_gradients, free_leaves, scaled_transfer
from ..scenes import (
    RESOLUTION,
    around,
    in_float64,
    random_numbers,
    slow,
    soft_transfer,
    to_float64,
    with_voxels,
)


def random_table(n: int, m: int, seed: int = 0) -> jv.TransferFunction2D:
    """Values from 0 to 10, magnitudes from 0 to 5; a third of the extinctions are 0."""
    random = np.random.default_rng(seed)
    values, magnitudes = (np.sort(random.uniform(0, top, count)) for top, count in ((10, n), (5, m)))
    extinction = random.uniform(0, 2, (n, m)) * (random.random((n, m)) > 1 / 3)
    return jv.TransferFunction2D(values, magnitudes, random.random((n, m, 3)), extinction)


@eqx.filter_jit
def all_of(transfer: jv.TransferFunction2D, places: Any, cotangent: Any) -> Any:
    """Colours and extinctions (points, 4); their vector–Jacobian product by JAX, and as engines have it."""

    def look_up(transfer, places):
        color, extinction = jax.vmap(transfer)(*places)
        return jnp.stack([*color, extinction], axis=-1)

    found, pull = jax.vjp(look_up, transfer, places)
    measured = *places, *jax.vmap(lambda *place: transfer.search()(place))(*places)
    return found, pull(cotangent), transfer.vjp(measured, tuple(cotangent[:, :3].T), cotangent[:, 3])


def looked_up(transfer: jv.TransferFunction2D, values: Any, magnitudes: Any) -> np.ndarray:
    """Colour and extinction, (points, 4)."""
    places = tuple(np.float32(each) for each in (values, magnitudes))
    return np.asarray(all_of(transfer, places, np.zeros((len(values), 4), np.float32))[0])


def table_of(transfer: jv.TransferFunction2D) -> np.ndarray:
    """The entries of `looked_up`."""
    return np.concatenate([transfer.colors, np.asarray(transfer.extinction)[..., None]], axis=-1)


# ---------------------------------------------------------------- the table


@pytest.mark.parametrize(("n", "m"), [(2, 2), (5, 3), (40, 30)])
def test_the_table_is_bilinear_and_constant_beyond_its_lines(n, m):
    """And its derivative by many samples is that of JAX, also on lines and beyond ends."""
    transfer, random = random_table(n, m), np.random.default_rng(1)
    lines = np.asarray(transfer.values, float), np.asarray(transfer.magnitudes, float)
    places = np.concatenate(
        [
            random.uniform((-2, -1), (12, 6), (2000, 2)),
            np.stack(np.meshgrid(*lines), axis=-1).reshape(-1, 2),  # the corners themselves
        ]
    )
    cotangent = np.float32(random.normal(size=(len(places), 4)))
    given = tuple(np.asarray(places.T, np.float32))
    found, expected, pulled = all_of(transfer, given, cotangent)
    for a, b in zip(jax.tree.leaves(pulled), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-4 * np.abs(b).max() + 1e-6)
    table = table_of(transfer)
    inside = np.clip(places, [line[0] for line in lines], [line[-1] for line in lines])
    # of lines that lie close together, places are rounded
    near = min(float(np.diff(line).min()) for line in lines)
    interpolated = RegularGridInterpolator(lines, table.astype(float))(inside)
    np.testing.assert_allclose(found, interpolated, atol=2e-6 + 4e-6 / near)


def test_two_equal_lines_make_a_step():
    """What lies below takes the first one's entries, what lies there or above the second's; also at ends."""
    extinction = np.array([[1.0, 1, 2, 2], [3, 3, 4, 4], [5, 5, 6, 6], [7, 7, 8, 8]])
    transfer = jv.TransferFunction2D((1, 1, 3, 3), (2, 4, 4, 5), np.zeros((4, 4, 3)), extinction)
    values, magnitudes = [0.9, 1, 2, 3, 0.9, 3], [2, 2, 2, 3.9, 4, 4]
    found = looked_up(transfer, values, magnitudes)[:, 3]
    np.testing.assert_allclose(found, [1, 3, 4, 7, 2, 8], rtol=1e-6)


def soft() -> jv.TransferFunction:
    """For values from 0 to 255."""
    return scaled_transfer(255, soft_transfer(0.1))


POINTS = [
    (20.0, 6.0, (1.0, 0.0, 0.0), 0.5, (10.0, 4.0)),
    (60.0, 3.0, (0.0, 1.0, 0.0), 0.9, (20.0, 3.0)),
    (70.0, 4.0, (0.0, 0.0, 1.0), 0.2, (20.0, 2.0)),
]


def test_nothing_is_left_of_a_point_at_its_sides_and_beyond():
    """Where quotients that would be 1 are rounded, as of these numbers."""
    drawn = [np.random.default_rng(seed).uniform(0.01, 1, 4).round(2) for seed in range(50)]
    points = [[(value, at, (1.0, 0.5, 0.2), 0.9, (reach, other))] for value, at, reach, other in drawn]
    found = jax.jit(lambda: [jv.TransferFunction2D.from_points(each).extinction for each in points])()
    for extinction in map(np.asarray, found):
        np.testing.assert_array_equal(extinction[[0, -1]], 0)
        np.testing.assert_array_equal(extinction[:, [0, -1]], 0)
        assert extinction.max() > 2


def test_points_are_tents_and_add_up():
    transfer = jax.jit(lambda: jv.TransferFunction2D.from_points(POINTS, unit_distance=2.0))()
    random = np.random.default_rng(3)
    places = random.uniform((0, 0), (100, 12), (4000, 2))
    expected = np.zeros(len(places))
    for value, magnitude, _, opacity, (reach, other) in POINTS:
        tents = [
            np.maximum(1 - np.abs(at - center) / far, 0)
            for at, center, far in zip(places.T, (value, magnitude), (reach, other), strict=True)
        ]
        expected -= np.log(1 - opacity) / 2 * tents[0] * tents[1]
    found = looked_up(transfer, *places.T)
    np.testing.assert_allclose(found[:, 3], expected, atol=1e-5)
    alone = np.abs(places[:, 0] - 20) < 10  # of the first point alone, up to its sides
    np.testing.assert_allclose(found[alone & (expected > 0), :3], [[1, 0, 0]] * sum(alone & (expected > 0)))


# ---------------------------------------------------------------- bounds over blocks

KINDS = ["uint8", "float32", "NaN"]


def patches(kind: str, seed: int = 0) -> jv.Volume:
    """Parts of noise, of a smooth wave, and of constant values, of 10 units at most. These end in steps that
    only nodes on faces of blocks see."""
    random = np.random.default_rng(seed)
    x, y, z = np.indices((22, 15, 17))
    data = np.where(x < 8, random.uniform(0, 10, x.shape), 5 + 4 * np.sin(0.3 * y + 0.2 * z))
    data = np.where(z > 8, np.where((x > 12) & (y > 9), 3.0, 7.0), data)
    volume = jv.Volume(np.round(data).astype("float32" if kind == "NaN" else kind), (0.9, 2.0, 1.3))
    if kind == "float32":
        volume = jv.Volume(data, volume.spacing)
    return with_voxels(volume, (10, 5, 12), np.nan) if kind == "NaN" else volume


@eqx.filter_jit
def at_places(volume, transfer, places):
    """Magnitude and extinction at grid coordinates."""
    classification = classification_of(transfer, volume)

    def at(place):
        measured = classification.at(apart(place))
        return measured[1], classification.classify(measured)[1]

    return jax.vmap(at)(places)


def measured_in_blocks(volume: jv.Volume, transfer: jv.TransferFunction2D) -> tuple[Any, ...]:
    """Magnitude and extinction at many places, and the block of each. Nodes are among them, those on faces as
    parts of the blocks on either side."""
    last = np.array(volume.shape) - 1
    nodes = np.indices(volume.shape).reshape(3, -1).T
    places = np.concatenate([np.random.default_rng(5).uniform(0, last, (60_000, 3)), nodes])
    blocks = np.concatenate([places // BLOCK, np.maximum(-(-nodes // BLOCK) - 1, 0)])
    places = np.float32(np.concatenate([places, nodes]))
    block = tuple(np.minimum(blocks, (last - 1) // BLOCK).astype(int).T)
    return *(np.asarray(each) for each in at_places(volume, transfer, places)), block


@eqx.filter_jit
def bounds(transfer, volume):
    blocks = Blocks.of(volume, slopes=True)
    return transfer.majorant(blocks), transfer.visible(blocks), blocks.magnitudes, blocks.unordered


@pytest.mark.parametrize("kind", KINDS)
def test_ranges_of_magnitude_and_majorants_hold_all_that_is_in_a_block(kind):
    volume = patches(kind)
    for seed in range(6):
        transfer = random_table(12, 9, seed)
        bound, visible, (least, most), unordered = jax.tree.map(np.asarray, bounds(transfer, volume))
        assert np.any(unordered) == (kind == "NaN")
        magnitude, extinction, block = measured_in_blocks(volume, transfer)
        # a node on a face is interpolated with those above it, also in the block below: 0 · NaN is NaN
        lost, above = np.isnan(extinction), np.s_[: -volume.data.size]
        assert np.all(unordered[block][above][lost[above]])
        known = ~unordered[block] & ~lost
        assert np.all((least[block] <= magnitude)[known])
        assert np.all((magnitude <= most[block])[known])
        assert np.all((extinction <= bound[block])[known])
        np.testing.assert_array_equal((bound > 0)[~unordered], visible[~unordered])


def test_slopes_of_large_doubles_are_not_lost():
    with in_float64():
        x = np.arange(9.0)
        volume = jv.Volume(np.broadcast_to((1e5 + 0.002 * np.sin(2 * x))[:, None, None], (9, 9, 9)))
        *_, (least, most), _ = jax.tree.map(np.asarray, bounds(random_table(12, 9), volume))
        slopes = np.abs(np.gradient(np.asarray(volume.data), axis=0))
        for block in (0, 1):
            here = slopes[4 * block : 4 * block + 5]
            assert np.all(most[block] >= here.max())
            assert np.all(most[block] <= 1.01 * here.max())
            assert np.all(least[block] <= here.min())


# ---------------------------------------------------------------- images


def emphasised() -> jv.TransferFunction2D:
    """Boundaries alone: extinction grows with the magnitude."""
    transfer = soft()
    colors, extinction = np.asarray(transfer.colors), np.asarray(transfer.extinction)
    colors, extinction = np.stack([colors] * 2, axis=1), np.stack([0 * extinction, extinction], axis=1)
    return jv.TransferFunction2D(transfer.values, (50.0, 250.0), colors, extinction)


def shells(kind: str) -> jv.Volume:
    """Two nested balls in a corner of empty space, in values of 0 to 255, on a grid of three spacings."""
    axis = np.linspace(-1.4, 1.4, RESOLUTION)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1) - [0.7, -0.6, 0.6]
    away, beside = np.linalg.norm(points, axis=-1), np.linalg.norm(points - [0.1, 0.1, -0.1], axis=-1)
    data = np.clip(300 * (0.7 - away), 0, 80) + np.clip(700 * (0.4 - beside), 0, 170)
    return jv.Volume(np.round(data).astype(kind), (0.12, 0.13, 0.11), (-1.4, -1.4, -1.4))


JITTER = jv.EmptySpaceJitter(4)


@pytest.mark.parametrize("kind", ["uint8", *slow("float32")])
def test_an_image_is_that_of_numpy(kind):
    """Over leaps, by slopes that are stored of small types. Magnitudes are per world length."""
    volume, transfer = shells(kind), emphasised()
    camera, step = around(volume).zoom(2.0), 0.05
    found = jv.render(
        volume, transfer, camera, jv.March(step, (JITTER, jv.AlphaCorrection(), jv.SpaceLeaping()))
    )
    rays = Rays(volume, camera)
    slopes = np.gradient(rays.data, *rays.spacing)
    table = table_of(transfer).astype(float)
    lines = [np.asarray(line, float) for line in (transfer.values, transfer.magnitudes)]

    def classified(depth):
        magnitude = np.sqrt(sum(rays.value(depth, slope) ** 2 for slope in slopes))
        places = [
            np.clip(at, of[0], of[-1]) for at, of in zip((rays.value(depth), magnitude), lines, strict=True)
        ]
        return RegularGridInterpolator(lines, table)(np.stack(places, axis=-1))

    start = random_numbers(JITTER, camera)
    front, width = rays.cells(step, start, lambda front, _: classified(front)[..., 3] == 0)
    *color, extinction = np.moveaxis(classified(front), -1, 0)
    depth = np.cumsum(extinction * width, axis=1)
    weight = np.exp(extinction * width - depth) * -np.expm1(-extinction * width)
    expected = np.stack([np.sum(weight * part, axis=1) for part in (*color, np.ones_like(weight))], axis=-1)
    assert 0.1 < np.mean(expected[:, 3] > 0.3) < 0.9
    np.testing.assert_allclose(np.asarray(found.rgba).reshape(-1, 4), expected, atol=4e-5)
    assert np.sum(np.asarray(found.samples)) < 0.8 * np.sum(width > 0)


def test_slopes_are_stored_for_a_transfer_function_that_reads_them():
    march = jv.March(0.1, (jv.SpaceLeaping(),))
    for transfer, stored in ((soft(), False), (emphasised(), True)):
        found = VolumeAcceleration.of(shells("uint8"), transfer, march)
        assert found.blocks is not None
        assert (found.slopes[0] is not None) == (found.blocks.slopes is not None) == stored


# ---------------------------------------------------------------- gradients


def smooth() -> Any:
    """Voxels of float64, and a table without zeros."""
    x, y, z = np.meshgrid(*(np.linspace(0, 1, RESOLUTION),) * 3, indexing="ij")
    data = 0.5 + 0.2 * np.sin(3 * x + y) * np.cos(2 * z) + 0.15 * y * x
    volume = jv.Volume(data, (0.05, 0.06, 0.07))
    random = np.random.default_rng(7)
    extinction = random.uniform(0.1, 0.9, (3, 4))
    lines = (-0.2, 0.3, 0.8), (0.1, 0.22, 0.27, 0.4)
    return volume, jv.TransferFunction2D(lines[0], lines[1], random.random((3, 4, 3)), extinction)


def leapt() -> Any:
    """8-bit voxels, whose slopes are stored, and blocks that are empty because nothing is steep there."""
    volume = shells("uint8")
    assert 0.1 < np.mean(bounds(emphasised(), volume)[1]) < 0.8
    return volume, emphasised()


@pytest.mark.slow
@pytest.mark.parametrize("make", [leapt, smooth])
def test_gradients_match_central_differences(make):
    """Of the transfer function, of the voxels through value and magnitude, of camera and spacing."""
    with in_float64():
        volume, transfer = to_float64(make())
        march = jv.March(0.23, (jv.AlphaCorrection(), jv.SpaceLeaping()), max_samples=32)
        scene = volume, transfer, around(volume).zoom(2.5), march, jv.Over()
        check_gradients(scene, {}, jit=make is smooth)


def test_nothing_that_is_steep_has_no_gradient_by_its_magnitude():
    """Where the magnitude is 0, which has a kink there, its derivative is 0 and not NaN."""
    transfer = jv.TransferFunction2D((0, 1), (0, 1), np.ones((2, 2, 3)), [[0.5, 1], [0.5, 1]])

    @jax.jit
    @jax.grad
    def slope(data):
        measured = classification_of(transfer, jv.Volume(data)).at(apart(jnp.full(3, 1.3)))
        return transfer.classifier()(measured)[1]

    np.testing.assert_array_equal(slope(np.full((4, 4, 4), np.float32(0.5))), 0)


# ---------------------------------------------------------------- arguments

ONES = np.ones((2, 2, 3)), np.ones((2, 2))
make = jv.TransferFunction2D
points = make.from_points
POINT = (1, 1, (1, 1, 1), 0.5, (1, 1))
WRONG: list[tuple[Callable[[], Any], str]] = [
    (lambda: make((2, 1), (0, 1), *ONES), "values must increase"),
    (lambda: make((1, 2), (0, 1), np.ones((2, 3)), ONES[1]), r"colors must have shape \(2, 2, 3\)"),
    (lambda: make((1, 2), (0, 1), ONES[0], np.ones((2, 3))), r"extinction must have shape \(2, 2\)"),
    (lambda: make((1, 2), (0, np.nan), *ONES), "magnitudes must be finite"),
    (lambda: points([(1, (1, 1, 1), 0.5)]), "points must be one or more of"),
    (lambda: points([(*POINT[:3], 1.5, (1, 1))]), r"opacity must be in \[0, 1\]"),
    (lambda: points([(*POINT[:4], (1, 0))]), "reaches must be positive"),
    (
        lambda: jax.jit(lambda v: points([(v, *POINT[1:])]).extinction)(1.0),
        "must be numbers; some are traced",
    ),
    (lambda: jv.write_transfer("never.json", emphasised()), "transfer must be a TransferFunction"),
]


@pytest.mark.parametrize(("make", "message"), WRONG, ids=[message for _, message in WRONG])
def test_bad_arguments_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_what_needs_more_than_a_sample_is_refused():
    volume = shells("uint8")
    scene = volume, emphasised(), around(volume)
    for quadrature, mode, message in (
        ("preintegrated", "over", "TransferFunction2D has no integrator"),
        ("left", "average", "TransferFunction2D reads more"),
    ):
        with pytest.raises(ValueError, match=message):
            jv.render(*scene, jv.March(0.11, (), quadrature), compositing=mode)


def test_a_fit_changes_colours_and_extinction_alone():
    assert free_leaves(emphasised()) == {".colors", ".extinction"}
