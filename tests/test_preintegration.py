"""Cells that are integrated between their ends: the means, and what is made of them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol._util.piecewise_means import mean_by_rows, mean_by_spans, span_rows
from jaxvol.engine.driver import render_scene
from jaxvol.engine.scene import Scene
from jaxvol.engine.tiling import Tiling
from jaxvol.lighting import DirectionalLight, Material, ScattererTemplates
from jaxvol.transfer import Transfer

from . import oracle
from .engine.test_gradient_matrix import scene_of
from .scenes import (
    anisotropic_noise,
    around,
    in_float64,
    scaled_phantom,
    slow,
    soft_transfer,
    to_float64,
    uniform_transfer,
)
from .test_agreement import compare, oracle_image, reference_image
from .test_march import Halves


# -- means ----------------------------------------------------------------------------------------------


def points_of(seed, count):
    """Control points of which two make a step and some are transparent."""
    random = np.random.default_rng(seed)
    values = np.sort(random.random(count))
    values[count // 2] = values[count // 2 - 1]
    return values, random.random((count, 3)), random.random(count) * (random.random(count) < 0.7)


def ends_of(seed, values):
    """Values at both ends of cells: anywhere, near each other, equal, and at control points."""
    random = np.random.default_rng(seed + 1)
    front = random.uniform(-0.3, 1.3, 2000)
    back = front + random.choice([0, 1e-7, 1e-4, 0.01, 0.3, 2], 2000) * random.uniform(-1, 1, 2000)
    front[:200] = random.choice(values, 200)
    return front, back


@jax.jit
def means_by_spans(values, colors, extinction, front, back):
    rows = span_rows(values, jnp.concatenate([colors, extinction[:, None]], axis=1))
    return jax.vmap(lambda v, w: mean_by_spans(rows, v, w))(front, back)


@jax.jit
def means_by_rows(values, colors, extinction, front, back):
    rows = span_rows(values, jnp.concatenate([colors, extinction[:, None]], axis=1))

    def one(front, back):
        i, j = (jnp.sum(value >= values) for value in (front, back))
        return mean_by_rows(tuple(rows[i]), tuple(rows[j]), front, back, i == j)

    return jax.vmap(one)(front, back)


@pytest.mark.parametrize("means", [means_by_spans, means_by_rows])
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-9), (np.float32, 2e-4)])
def test_means_are_integrals(means, dtype, tolerance):
    """Differences across a control point of 1e-7 of the range amplify rounding by as much."""
    with in_float64():
        for seed in range(20):
            points = points_of(seed, 7)
            ends = [end.astype(dtype) for end in ends_of(seed, points[0])]
            given = [np.asarray(part, dtype) for part in points]
            (r, g, b), extinction = means(*given, *ends)
            assert extinction.dtype == dtype
            exact = [part.astype(np.float64) for part in (*ends, *given)]
            rgb, sigma = oracle.mean_between(*exact)
            # equal values at a step belong to its upper side; means of values to either side differ much
            plain = (abs(exact[0] - exact[1]) > 1e-6) | (abs(exact[0][:, None] - exact[2]).min(axis=1) > 1e-6)
            assert plain.mean() > 0.6
            np.testing.assert_allclose(extinction[plain], sigma[plain], atol=tolerance)
            emission = np.stack([r, g, b], axis=1) * np.asarray(extinction)[:, None]
            np.testing.assert_allclose(emission[plain], (rgb * sigma[:, None])[plain], atol=tolerance)


@pytest.mark.parametrize("means", [means_by_spans, means_by_rows])
def test_what_is_transparent_stays_exactly_so_and_nan_is_passed_on(means):
    values = np.array([0.1, 0.3, 0.5, 0.7, 0.8], np.float32)
    extinction = np.array([0, 0, 3.3, 0, 0], np.float32)
    front, back = np.random.default_rng(0).random((2, 5000), np.float32)
    _, found = means(values, np.ones((5, 3), np.float32), extinction, front, back)
    low, high = np.minimum(front, back), np.maximum(front, back)
    np.testing.assert_array_equal(np.asarray(found) == 0, (high <= 0.3) | (low >= 0.7))
    broken = np.where(np.arange(5000) == 7, np.float32(np.nan), front)
    hurt = means(values, np.ones((5, 3), np.float32), extinction, broken, back)
    assert np.isnan(hurt[1][7])
    assert np.isnan(hurt[1]).sum() == 1


@pytest.mark.parametrize("points", [7, 64])
def test_the_vjp_of_integrals_is_that_of_jax(points):
    """By few control points, which are compared, and by many, which are looked up."""
    with in_float64():
        values, colors, extinction = points_of(3, points)
        transfer = to_float64(jv.TransferFunction(values, colors, extinction))
        front, back = (jnp.asarray(end[:400].reshape(20, 20)) for end in ends_of(5, [0.05]))
        search = transfer.search()

        def measured(front, back):
            each = [(end,) if search is None else (end, *search((end,))) for end in (front, back)]
            return ((front + back) / 2, *each)

        def classified(transfer, front, back):
            integrate = jax.vmap(jax.vmap(lambda u, v: transfer.integrator()(measured(u, v))))
            return integrate(front, back)

        random = np.random.default_rng(1)
        cotangent = tuple(jnp.asarray(random.normal(size=(20, 20))) for _ in range(3)), front + 0.3
        _, pull = eqx.filter_vjp(classified, transfer, front, back)
        expected = pull(cotangent)
        found, (none, (of_front,), (of_back,)) = transfer.pull_integrated(measured(front, back), *cotangent)
        assert not np.any(none)
        for part, want in zip(
            (found.colors, found.extinction, of_front, of_back),
            (expected[0].colors, expected[0].extinction, *expected[1:]),
            strict=True,
        ):
            scale = np.abs(want).max()
            assert scale > 0
            np.testing.assert_allclose(part, want, atol=1e-6 * scale)


@pytest.mark.parametrize("dense", [1e3, 1e6])
def test_what_is_dense_elsewhere_does_not_show(dense):
    """Beside values of this extinction, thin ones: sums over the former must not round the latter away."""
    values = np.linspace(0, 1, 256).astype(np.float32)
    extinction = np.where(values < 0.5, dense, 0.02 + 0.01 * np.sin(40 * values)).astype(np.float32)
    colors = np.random.default_rng(0).random((256, 3)).astype(np.float32)
    front, back = np.random.default_rng(1).uniform(0.55, 0.99, (2, 500)).astype(np.float32)
    apart = abs(front - back) > 0.01
    (r, g, b), found = means_by_rows(values, colors, extinction, front, back)
    rgb, sigma = oracle.mean_between(
        *(part.astype(np.float64) for part in (front, back, values, colors, extinction))
    )
    np.testing.assert_allclose(found[apart], sigma[apart], rtol=1e-4)
    np.testing.assert_allclose(np.stack([r, g, b], axis=1)[apart], rgb[apart], atol=1e-4)


# -- images ---------------------------------------------------------------------------------------------


PEAK = jv.TransferFunction([0.0, 0.595, 0.6, 0.605, 1.0], [(1.0, 0.6, 0.2)] * 5, [0.0, 0.0, 90.0, 0.0, 0.0])
"""Shows 1 % of the range of values."""


def optical_depths(volume, camera, transfer):
    """Of rays on which the value is linear from the entry to the exit: exact, and the values at both."""
    origins, directions = (np.asarray(part, np.float64).reshape(-1, 3) for part in camera.rays())
    low, high = (np.asarray(corner, np.float64) for corner in volume.corners)
    t_in, t_out = oracle.box_interval(origins, directions, low, high)
    length = np.maximum(t_out - t_in, 0)
    t_in = np.where(length > 0, t_in, 0)
    data, slopes = np.asarray(volume.data, np.float64), []
    for axis in range(3):
        slopes.append(np.take(data, -1, axis).flat[0] - np.take(data, 0, axis).flat[0])
    first = origins + t_in[:, None] * directions
    at = lambda place: data[0, 0, 0] + (place - low) / (high - low) @ np.array(slopes)  # noqa: E731
    front, back = at(first), at(first + length[:, None] * directions)
    points = (
        np.asarray(part, np.float64) for part in (transfer.values, transfer.colors, transfer.extinction)
    )
    return oracle.mean_between(front, back, *points)[1] * length


@pytest.mark.parametrize("transfer", [PEAK, soft_transfer()], ids=["peak", "soft"])
def test_opacity_is_exact_where_the_value_is_linear_along_the_ray(transfer):
    """At any width; the last cell of each ray is cut, and the first one where rays are jittered."""
    volume = scaled_phantom("linear")
    white = jv.TransferFunction(transfer.values, np.ones_like(transfer.colors), transfer.extinction)
    camera = around(volume)
    exact = -np.expm1(-optical_depths(volume, camera, white)).reshape(camera.size[::-1])
    assert exact.max() > 0.2
    for step in (0.013, 0.3, 1.7, 20.0):
        for jitter in ((), (jv.Jitter(3, front_residual=True),)):
            march = jv.March(step, (*jitter, jv.AlphaCorrection()), "preintegrated")
            rgba = jv.render(volume, white, camera, march).rgba
            np.testing.assert_allclose(rgba, exact[..., None] * np.ones(4), atol=1e-5)


def errors(volume, transfer, camera, marches):
    """Largest and root-mean-square error of images, compared with a march of far finer steps."""
    cut = (jv.AlphaCorrection(),)
    exact = jv.render(volume, transfer, camera, jv.March(0.001, cut, "midpoint")).rgba
    found = []
    for step, quadrature in marches:
        off = jv.render(volume, transfer, camera, jv.March(step, cut, quadrature)).rgba - exact
        found.append((float(jnp.abs(off).max()), float(jnp.sqrt(jnp.mean(off**2)))))
    return np.array(found)


def test_a_thin_peak_is_not_missed_between_samples():
    volume = scaled_phantom("gaussian")
    (_, plain), (_, integrated) = errors(
        volume, PEAK, around(volume), [(0.05, "midpoint"), (0.2, "preintegrated")]
    )
    assert plain > 0.01
    assert integrated <= plain


def test_what_hides_within_a_cell_is_within_its_bound():
    """A mean does not know that the colour in front hides the one behind: α τ / 8 times the change of colour,
    at most. Along a ray the colour changes by 1 here."""
    volume, colors = scaled_phantom("linear"), [(1, 0, 0), (1, 0, 0), (0, 0, 1), (0, 0, 1)]
    for density in (0.3, 1.0, 3.0):
        transfer = jv.TransferFunction([0.0, 0.4, 0.6, 1.0], colors, [density] * 4)
        steps = np.array([0.1, 0.2, 0.4])
        found = errors(volume, transfer, around(volume), [(step, "preintegrated") for step in steps])[:, 0]
        bound = -np.expm1(-density * steps) * density * steps / 8
        assert (found <= bound + 1e-5).all(), (density, found, bound)
        assert (found >= bound / 10).all(), (density, found, bound)


# -- whatever goes with it -----------------------------------------------------------------------------


@pytest.mark.parametrize("transforms", [[Halves()], *slow([Halves(), jv.AlphaCorrection()])], ids=len)
def test_pieces_that_need_not_be_joined_are_measured_at_both_ends(transforms):
    volume, transfer = anisotropic_noise(), soft_transfer()
    march = jv.March(0.2, transforms, "preintegrated", max_samples=32)
    camera = around(volume)
    rendering, reference = (make(volume, transfer, camera, march) for make in (jv.render, reference_image))
    compare(rendering, reference.rgba, np.asarray(reference.samples), tolerance=2e-5)


@pytest.mark.parametrize("dtype", ["uint8", *slow("int16", "uint16", "float32")])
def test_types_of_voxels_leaps_and_tiles_do_not_show(dtype):
    """Small types are fetched from their packed copy; three tiles of two beams."""
    scene = scene_of("integrated", "hierarchy", dtype)
    rgba = render_scene(Scene(*scene), "all", "replay", Tiling(batch=4, tile=2)).rgba
    assert 0.05 < np.mean(rgba[..., 3] > 0) < 0.95
    expected, _ = oracle_image(*scene)
    np.testing.assert_allclose(rgba, expected, atol=2e-5)


@pytest.mark.slow
def test_fans_are_integrated_and_programs_vmapped():
    """In the fan of an ultrasound probe, for two transfer functions at once."""
    volume, probe = jv.toroidal_phantom("shells", (17, 25, 33), speckle=False)
    colors, extinction = np.linspace(0, 1, 12).reshape(4, 3), np.array([0.0, 0.0, 0.3, 1.0])
    low, high = (np.asarray(corner) for corner in probe.corners)
    away = 2 * (high - low).max() * np.array([0.5, -0.8, 0.3])
    camera = jv.Camera((low + high) / 2 + away, (low + high) / 2, (0, 0, 1), 30.0, size=(20, 16))
    step = float((high - low).max()) / 60
    transforms = probe, jv.EmptySpaceJitter(2), jv.AlphaCorrection(), jv.SpaceLeaping()

    def image(extinction, march):
        transfer = jv.TransferFunction([0.0, 40.0, 120.0, 255.0], colors, extinction)
        return jv.render(volume, transfer, camera, march).rgba

    march = jv.March(step, transforms, "preintegrated")
    both = jnp.stack([jnp.asarray(extinction), jnp.asarray(3 * extinction)])
    found = jax.vmap(lambda extinction: image(extinction, march))(both)
    for rgba, each in zip(found, both, strict=True):
        np.testing.assert_allclose(rgba, image(each, march), atol=1e-6)
        transfer = jv.TransferFunction([0.0, 40.0, 120.0, 255.0], colors, each)
        counted = jv.March(step, transforms[:-1], "preintegrated", max_samples=256)
        reference = reference_image(volume, transfer, camera, counted)
        np.testing.assert_allclose(rgba, reference.rgba, atol=2e-5)


class Own(Transfer):
    def classifier(self):
        return lambda measured: ((measured[0],) * 3, measured[0])


class Dimmed(jv.TransferFunction):
    def classifier(self):
        plain = super().classifier()
        return lambda measured: (plain(measured)[0], plain(measured)[1] / 2)


@pytest.mark.parametrize("kind", [Own, Dimmed])
def test_a_transfer_function_without_an_integral_is_refused(kind):
    plain = soft_transfer()
    transfer = kind() if kind is Own else kind(plain.values, plain.colors, plain.extinction)
    volume = scaled_phantom("sphere")
    message = f'quadrature="preintegrated" needs .* {type(transfer).__name__} has no integrator'
    with pytest.raises(ValueError, match=message):
        jv.render(volume, transfer, around(volume), jv.March(0.1, (), "preintegrated"))


def test_nan_in_a_voxel_reaches_the_pixels_that_see_it():
    volume = anisotropic_noise()
    hurt = eqx.tree_at(lambda v: v.data, volume, volume.data.at[9, 12, 12].set(jnp.nan))
    march = jv.March(0.07, (jv.SpaceLeaping(),), "preintegrated")
    rgba = jv.render(hurt, soft_transfer(5.0), around(volume), march).rgba
    assert 0 < np.isnan(rgba).any(axis=-1).mean() < 0.3


@pytest.mark.slow
def test_visible_cells_are_lit_in_their_middle():
    volume, transfer = anisotropic_noise(), soft_transfer()
    light = DirectionalLight((0.3, -1.0, 0.5))
    material = Material(0.5, 0.2, values=(0.2, 0.9))
    lighting = ScattererTemplates([material], [light], templates=1)
    march, camera = jv.March(0.21, (jv.AlphaCorrection(),), "preintegrated", max_samples=32), around(volume)
    lit = jv.render(volume, transfer, camera, march, lighting=lighting)
    column, row = 9, 7
    origin, direction = (part[row, column] for part in camera.rays())
    alone = jv.render_ray_reference(
        volume, transfer, origin, direction, march, pixel=(column, row), lighting=lighting
    )
    np.testing.assert_allclose(lit.rgba[row, column], alone.rgba, atol=2e-5)
    assert np.abs(lit.rgba - jv.render(volume, transfer, camera, march).rgba).max() > 0.05


@pytest.mark.slow
def test_a_selection_takes_samples_in_the_middle():
    volume, camera = anisotropic_noise(), around(anisotropic_noise())
    march = jv.March(0.07, (jv.SpaceLeaping(),), "preintegrated")
    found = jv.render(volume, soft_transfer(), camera, march, compositing=jv.FirstVisible())
    origin, direction = (part[7, 9] for part in camera.rays())
    alone = jv.render_ray_reference(
        volume, soft_transfer(), origin, direction, march, pixel=(9, 7), compositing=jv.FirstVisible()
    )
    np.testing.assert_allclose(found.rgba[7, 9], alone.rgba, atol=2e-5)
    np.testing.assert_allclose(found.depth[7, 9], alone.depth, rtol=1e-5)


@pytest.mark.slow
def test_constant_labelled_volumes_are_exact():
    labels = np.zeros((24,) * 3, np.uint8)
    labels[12:] = 1
    volume = scaled_phantom("constant")
    volume = jv.Volume(volume.data, volume.spacing, volume.origin, labels=labels)
    transfer = jv.LabelTransferFunction([uniform_transfer(1.0), uniform_transfer(3.0)])
    rays = [[-2.0, 0.1, 0.1]], [[1.0, 0.0, 0.0]]
    march = jv.March(0.17, (jv.AlphaCorrection(labels=True),), "preintegrated")
    face = -1 + 2 * 11.5 / 23
    exact = 1 - np.exp(-(face + 1) * 1.0 - (1 - face) * 3.0)
    assert float(jv.render_rays(volume, transfer, *rays, march).rgba[0, 3]) == pytest.approx(exact, abs=1e-5)
