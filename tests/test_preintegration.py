"""Cells that are integrated between their ends: the means, and what is made of them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol._util.piecewise_means import mean_by_rows, mean_by_spans, span_rows
from jaxvol.engine.image import render_scene
from jaxvol.engine.tiling import Tiling
from jaxvol.march.march import Cell
from jaxvol.ray import Scene
from jaxvol.scene.transfer import Transfer

from . import oracle
from .modes import Rays, ball_in_a_corner, classified, scaled_transfer
from .scenes import around, in_float64, scaled_phantom, slow, soft_transfer, to_float64, with_voxels
from .transforms import oracle_image


# ---- means ----

POINTS, CELLS = 7, 2000


def points_of(seed, count=POINTS):
    """Control points of which two make a step and some are transparent."""
    random = np.random.default_rng(seed)
    values = np.sort(random.random(count))
    values[count // 2] = values[count // 2 - 1]
    return values, random.random((count, 3)), random.random(count) * (random.random(count) < 0.7)


def ends_of(seed, values):
    """Values at both ends of cells: anywhere, near each other, equal, and at control points."""
    random = np.random.default_rng(seed + 1)
    front = random.uniform(-0.3, 1.3, CELLS)
    back = front + random.choice([0, 1e-7, 1e-4, 0.01, 0.3, 2], CELLS) * random.uniform(-1, 1, CELLS)
    front[:200] = random.choice(values, 200)
    return front, back


@jax.jit
def means(values, colors, extinction, front, back):
    """By spans, and by rows; NumPy arrays of one type."""
    rows = span_rows(values, jnp.concatenate([colors, extinction[:, None]], axis=1))

    def one(front, back):
        i, j = (jnp.sum(value >= values) for value in (front, back))
        by_rows = mean_by_rows(tuple(rows[i]), tuple(rows[j]), front, back, i == j)
        return mean_by_spans(rows, front, back), by_rows

    return [(jnp.stack(color, axis=-1), extinction) for color, extinction in jax.vmap(one)(front, back)]


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-9), (np.float32, 2e-4)])
def test_means_are_integrals(dtype, tolerance):
    """Differences across a control point of 1e-7 of the range amplify rounding by as much."""
    with in_float64():
        for seed in range(20):
            points = points_of(seed)
            ends = [end.astype(dtype) for end in ends_of(seed, points[0])]
            given = [part.astype(dtype) for part in points]
            exact = [part.astype(np.float64) for part in (*ends, *given)]
            rgb, sigma = oracle.mean_between(*exact)
            # equal values at a step belong to its upper side; means of values to either side differ much
            plain = (abs(exact[0] - exact[1]) > 1e-6) | (abs(exact[0][:, None] - exact[2]).min(axis=1) > 1e-6)
            assert plain.mean() > 0.6
            for color, extinction in jax.device_get(means(*given, *ends)):
                assert extinction.dtype == dtype
                np.testing.assert_allclose(extinction[plain], sigma[plain], atol=tolerance)
                emission = color * extinction[:, None]
                np.testing.assert_allclose(emission[plain], (rgb * sigma[:, None])[plain], atol=tolerance)


def test_what_is_transparent_stays_exactly_so_and_nan_is_passed_on():
    values = np.array([0.1, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95], np.float32)
    extinction = np.array([0, 0, 3.3, 0, 0, 0, 0], np.float32)
    front, back = np.random.default_rng(0).random((2, CELLS), np.float32)
    broken = np.where(np.arange(CELLS) == 7, np.float32(np.nan), front)
    low, high = np.minimum(front, back), np.maximum(front, back)
    with in_float64():
        colors = np.ones((POINTS, 3), np.float32)
        for _, found in means(values, colors, extinction, front, back):
            np.testing.assert_array_equal(np.asarray(found) == 0, (high <= 0.3) | (low >= 0.7))
        for _, hurt in means(values, colors, extinction, broken, back):
            np.testing.assert_array_equal(np.isnan(hurt), np.isnan(broken))


@pytest.mark.parametrize("dense", [1e3, 1e6])
def test_what_is_dense_elsewhere_does_not_show(dense):
    """Beside values of this extinction, thin ones: sums over the former must not round the latter away."""
    values = np.array([0, 0.2, 0.4, 0.5, 0.62, 0.8, 1], np.float32)
    extinction = np.where(values < 0.45, dense, 0.02 + 0.01 * np.sin(40 * values)).astype(np.float32)
    colors = np.random.default_rng(0).random((POINTS, 3)).astype(np.float32)
    front, back = np.random.default_rng(1).uniform(0.51, 0.99, (2, CELLS)).astype(np.float32)
    apart = abs(front - back) > 0.01
    exact = (part.astype(np.float64) for part in (front, back, values, colors, extinction))
    rgb, sigma = oracle.mean_between(*exact)
    with in_float64():
        _, (color, found) = jax.device_get(means(values, colors, extinction, front, back))
    np.testing.assert_allclose(found[apart], sigma[apart], rtol=1e-4)
    np.testing.assert_allclose(color[apart], rgb[apart], atol=1e-4)


@pytest.mark.parametrize("points", [POINTS, 64])
def test_the_vjp_of_integrals_is_that_of_jax(points):
    """By few control points, which are compared, and by many, which are looked up."""
    with in_float64():
        values, colors, extinction = points_of(3, points)
        transfer = to_float64(jv.TransferFunction(values, colors, extinction))
        front, back = (end[:400] for end in ends_of(5, [0.05]))
        cotangent = jax.device_put(((*np.random.default_rng(1).normal(size=(3, 400)),), front + 0.3))

        @eqx.filter_jit
        def both(transfer, front, back):
            search = transfer.search()

            def measured(front, back):
                each = [(end,) if search is None else (end, *search((end,))) for end in (front, back)]
                return ((front + back) / 2, *each)

            def classify(transfer, front, back):
                return jax.vmap(lambda u, v: transfer.integrator()(measured(u, v)))(front, back)

            _, pull = eqx.filter_vjp(classify, transfer, front, back)
            return pull(cotangent), transfer.vjp(jax.vmap(measured)(front, back), *cotangent, integrated=True)

        (of_transfer, *of_ends), (found, (none, *of_each)) = both(transfer, front, back)
        assert not np.asarray(none).any()
        for part, want in zip(
            (found.colors, found.extinction, *(end for (end,) in of_each)),
            (of_transfer.colors, of_transfer.extinction, *of_ends),
            strict=True,
        ):
            scale = np.abs(want).max()
            assert scale > 0
            np.testing.assert_allclose(part, want, atol=1e-6 * scale)


# ---- images ----


PEAK = jv.TransferFunction(
    [0.0, 0.2, 0.3, 0.4, 0.595, 0.6, 0.605, 1.0], [(1.0, 0.6, 0.2)] * 8, [0.0] * 5 + [90.0, 0.0, 0.0]
)
"""Shows 1 % of the range of values."""
LINEAR = scaled_phantom("linear")
"""Values that are linear along every ray."""


JITTERED = jv.Jitter(3, front_residual=True), jv.AlphaCorrection()


def integrated(volume, transfer, step, transforms=JITTERED):
    """An image; the last cell of each ray is cut, and the first one by jitter."""
    march = jv.March(step, transforms, "preintegrated")
    return np.asarray(jv.render(volume, transfer, around(volume), march).rgba)


def opacity_of(transfer):
    """Of `LINEAR`, exact."""
    rays = Rays(LINEAR, around(LINEAR))
    front, back = rays.value(np.stack([0 * rays.length, rays.length], axis=1)).T
    points = (np.asarray(p, np.float64) for p in (transfer.values, transfer.colors, transfer.extinction))
    return -np.expm1(-oracle.mean_between(front, back, *points)[1] * rays.length).reshape(16, 20)


def white(transfer):
    return jv.TransferFunction(transfer.values, np.ones_like(transfer.colors), transfer.extinction)


class Halves(jv.Transform):
    """Splits each cell into halves, which are measured separately."""

    def cut(self, cell, ray, volume):
        half = cell.width / 2
        return Cell(cell.front, half, cell.cut), Cell(cell.front + half, half, cell.cut)


@pytest.mark.parametrize("halved", [False, *slow(True)])
def test_opacity_is_exact_where_the_value_is_linear_along_the_ray(halved):
    """At any width. A peak of 1 % of the values is not missed between samples."""
    transforms = (Halves(), jv.AlphaCorrection()) if halved else JITTERED
    for transfer in map(white, (PEAK, soft_transfer())):
        exact = opacity_of(transfer)
        assert exact.max() > 0.2
        for step in (0.013, 0.3, 1.7, 20.0):
            rgba = integrated(LINEAR, transfer, step, transforms)
            np.testing.assert_allclose(rgba, exact[..., None] * np.ones(4), atol=1e-5)


def test_what_hides_within_a_cell_is_within_its_bound():
    """A mean does not know that the colour in front hides the one behind: α τ / 8 times the change of colour,
    at most. Along a ray the colour changes by 1 here."""
    rays = Rays(LINEAR, around(LINEAR))
    front, width = rays.cells(0.004)
    colors = np.where(np.arange(8)[:, None] < 4, (1, 0, 0), (0, 0, 1))
    for density in (0.3, 1.0, 3.0):
        transfer = jv.TransferFunction([0.0, 0.1, 0.2, 0.4, 0.6, 0.7, 0.8, 1.0], colors, [density] * 8)
        color, _ = classified(transfer, rays.value(front + width / 2))
        before = np.exp(-density * front)
        exact = np.sum((before * -np.expm1(-density * width))[..., None] * color, axis=1).reshape(16, 20, 3)
        for step in (0.1, 0.2, 0.4):
            error = np.abs(integrated(LINEAR, transfer, step)[..., :3] - exact).max()
            bound = -np.expm1(-density * step) * density * step / 8
            assert bound / 10 <= error <= bound + 1e-5, (density, step, error, bound)


def test_nan_in_a_voxel_reaches_the_pixels_that_see_it():
    hurt = with_voxels(LINEAR, (9, 12, 12), np.nan)
    assert 0 < np.isnan(integrated(hurt, soft_transfer(5.0), 0.07)).any(axis=-1).mean() < 0.3


def test_small_types_leaps_and_tiles_do_not_show():
    """They are fetched from their packed copy; three tiles of two beams."""
    ball, top = ball_in_a_corner(), 200
    volume = jv.Volume((np.asarray(ball.data) * top).astype(np.uint8), ball.spacing)
    transfer, camera, jitter = scaled_transfer(top), around(volume).zoom(2.0), jv.EmptySpaceJitter(4)
    march = jv.March(0.11, (jitter, jv.AlphaCorrection(), jv.SpaceLeaping()), "preintegrated")
    scene = Scene(volume, transfer, camera, march, jv.Over())
    rgba = np.asarray(render_scene(scene, "all", "replay", Tiling(batch=4, tile=2)).rgba)
    assert 0.05 < np.mean(rgba[..., 3] > 0) < 0.95
    expected, _ = oracle_image(volume, transfer, camera, march)
    np.testing.assert_allclose(rgba, expected, atol=2e-5)


class Own(Transfer):
    def classifier(self):
        return lambda measured: ((measured[0],) * 3, measured[0])


def test_a_transfer_function_without_an_integral_is_refused():
    message = 'quadrature="preintegrated" needs .* Own has no integrator'
    with pytest.raises(ValueError, match=message):
        integrated(LINEAR, Own(), 0.1, ())
