"""Adaptive sampling: what is known of the voxels, what is predicted, what the image's error becomes, and
whether both engines choose the same cells."""

import itertools
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import jaxvol as jv
from experiments import jitter_accuracy, scenes as real_scenes
from jaxvol.march import RUN, Run
from jaxvol.metrics import rmse
from jaxvol.occupancy import BLOCK
from jaxvol.space import Affine, enter, node_distance
from jaxvol.transforms.adaptive_sampling import _coded, _decoded
from jaxvol.variation import MARGIN, Windows

from ..engine.test_gradient_matrix import CAMERAS, TOPS, assert_same, gradient
from ..scenes import around, counting, slow
from ..test_agreement import compare, reference_image


RAMP = jv.TransferFunction([0.0, 1.0], [[1.0, 1.0, 1.0]] * 2, [0.0, 2.0])
"""Extinction and emission grow by 2 for each unit of the value."""


def strides(volume, transfer, sampling, step=1.0, quadrature="preintegrated", mode: Any = None):
    """By block, the most steps of a cell with nothing in front."""
    variation = partial((mode or jv.Over()).variation, transfer)
    march = jv.March(step, (sampling,), quadrature).prepared(Affine(volume), Windows.of(volume), variation)
    (prepared,) = march.transforms
    assert isinstance(prepared, jv.AdaptiveSampling)
    assert prepared.errors is not None
    allowed = np.asarray(_decoded(prepared.errors, jnp.float32)) <= float(sampling.tolerance)
    return np.max([np.where(fits, 2**k, 1) for k, fits in enumerate(allowed)], axis=0)


# -- what is known of the voxels -------------------------------------------------------------------------


@settings(max_examples=20, deadline=None)
@given(
    shape=st.tuples(*[st.sampled_from([2, 3, 5, 9, 11])] * 3),
    dtype=st.sampled_from(["uint8", "int16", "float32"]),
    seed=st.integers(0, 2**16),
)
def test_windows_hold_what_lies_in_and_around_each_block(shape, dtype, seed):
    data = (np.random.default_rng(seed).random(shape) * 200).astype(dtype)
    found, value = Windows.of(jv.Volume(data)), data.astype(float)
    bend = np.zeros(shape)
    for axis, other in ((0, 1), (1, 2), (2, 0)):
        ahead, behind = (np.clip(np.arange(shape[axis]) + way, 0, shape[axis] - 1) for way in (1, -1))
        pure = np.abs(np.take(value, ahead, axis) - 2 * value + np.take(value, behind, axis))
        inner = np.zeros(shape[axis], bool)
        inner[1:-1] = True
        bend = np.maximum(bend, np.where(np.expand_dims(inner, [i for i in range(3) if i != axis]), pure, 0))
        slope = np.diff(value, axis=axis)
        mixed = np.abs(np.diff(slope, axis=other))
        bend[tuple(slice(n) for n in mixed.shape)] = np.maximum(
            bend[tuple(slice(n) for n in mixed.shape)], mixed
        )
    for block in itertools.product(*(range(n) for n in found.low.shape)):
        part = tuple(slice(max(i * BLOCK - MARGIN, 0), (i + 1) * BLOCK + MARGIN + 1) for i in block)
        assert found.low[block] == value[part].min()
        assert found.high[block] == value[part].max()
        np.testing.assert_allclose(found.bend[block], bend[part].max(), rtol=1e-5, atol=1e-4)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**16), points=st.sampled_from([2, 7, 40]))
def test_the_variation_bounds_every_change_of_extinction_and_emission(seed, points):
    random = np.random.default_rng(seed)
    values = np.sort(random.random(points)).astype(np.float32)
    transfer = jv.TransferFunction(values, random.random((points, 3)), random.random(points) * 5)
    low, high = np.sort(random.uniform(-0.2, 1.2, (2, 30)), axis=0)
    least, most, bend = (jnp.asarray(a, jnp.float32).reshape(30, 1, 1) for a in (low, high, 0 * low))
    windows = Windows(least, most, bend)
    found = transfer.variation(windows)
    for bound, turns, colored, _, a, b in zip(*(np.ravel(part) for part in found), low, high, strict=True):
        at = np.linspace(a, b, 2001)
        extinction = np.interp(at, values, np.asarray(transfer.extinction))
        channels = [extinction * np.interp(at, values, c) for c in np.asarray(transfer.colors).T]
        total = max(np.abs(np.diff(each)).sum() for each in (extinction, *channels))
        assert total <= bound * (1 + 1e-4) + 1e-4
        assert colored <= bound
        turned = max(np.abs(np.diff(each, 2)).sum() / (at[1] - at[0]) for each in (extinction, *channels))
        assert turned <= turns * (1 + 1e-3) + 1e-3


def test_a_hard_step_does_not_swallow_what_turns_elsewhere():
    """Neither its own slope, in a sum with the others, nor where it lies in the range."""
    for height in (1.0, 1e3, 1e6):
        points, extinction = [0.0, 0.1, 0.1, 0.5, 0.55, 0.6, 1.0], [height, height, 0.0, 0.0, 2.0, 0.0, 0.0]
        transfer = jv.TransferFunction(points, np.ones((7, 3)), extinction)
        low, high = (
            jnp.asarray(ends, jnp.float32).reshape(4, 1, 1)
            for ends in ((0.3, 0.05, 0.05, 0.1), (0.8, 0.2, 0.1, 0.3))
        )
        turns = np.ravel(transfer.variation(Windows(low, high, 0 * low)).turns)
        np.testing.assert_allclose(turns, [160.0, np.inf, np.inf, 0.0], rtol=1e-5)


# -- what is predicted -----------------------------------------------------------------------------------


def parabola(n=33, axis=0, bend=1 / 512):
    """Values in [0, 1] with this second difference along one axis."""
    x = np.meshgrid(*[np.arange(n) - n // 2] * 3, indexing="ij")[axis]
    return jv.Volume((bend * x**2 / 2).astype(np.float32))


@pytest.mark.parametrize("axis", range(3))
def test_cells_are_as_long_as_the_tolerance_lets_them_be(axis):
    """The value bends by H = 1/512 everywhere, so that e / 20 = ℓ V δ / (20 R) = 4 · 2 · H w² / 160."""
    for stride in (1, 2, 4, 8):
        error = 4 * 2 * (1 / 512) * (stride / 2) ** 2 / 160
        found = strides(parabola(axis=axis), RAMP, jv.AdaptiveSampling(1.01 * error), 0.5)
        inner = np.delete(np.arange(8), [0, 7])  # at faces a window holds no more than the bend of its inside
        assert (found[np.ix_(inner, inner, inner)] == stride).all(), stride


def test_steps_and_spacing_have_the_same_unit():
    """A volume, its extinction and its step may be scaled together."""
    volume = parabola()
    scaled = jv.Volume(volume.data, (3.0, 3.0, 3.0))
    thinner = jv.TransferFunction(RAMP.values, RAMP.colors, RAMP.extinction / 3)
    for tolerance in (1e-4, 1e-3, 1e-2):
        sampling = jv.AdaptiveSampling(tolerance)
        np.testing.assert_array_equal(
            strides(scaled, thinner, sampling, 1.5), strides(volume, RAMP, sampling, 0.5)
        )


def test_a_value_that_bends_across_the_axes_alone_is_found():
    x, y, _ = np.meshgrid(*[np.linspace(-1, 1, 33)] * 3, indexing="ij")
    saddle = jv.Volume((0.5 + 0.5 * x * y).astype(np.float32))
    assert strides(saddle, RAMP, jv.AdaptiveSampling(1e-5), 0.5).max() == 1


def test_long_stretches_heed_what_lies_farther_away():
    """A window says nothing of what lies beyond it. One voxel differs from the others."""
    data = np.full((65, 65, 65), 0.5, np.float32)
    data[32, 32, 32] = 1
    for longest, step, blocks in ((2, 0.5, 2), (4, 0.5, 4), (4, 1.0, 6), (8, 1.0, 10), (32, 0.25, 10)):
        found = strides(jv.Volume(data), RAMP, jv.AdaptiveSampling(1e-3, longest), step)
        assert (found < longest).any(axis=(1, 2)).sum() == blocks, (longest, step)
        assert found.max() == longest
    for step, longest in ((1.0, 16), (2.0, 8)):  # nothing is known of 64 voxels
        assert strides(jv.Volume(data), RAMP, jv.AdaptiveSampling(1e3, 64), step).max() == longest


def test_samples_must_find_what_integrals_hold():
    """The value is linear. A ramp of the extinction suits the midpoint rule; a peak does not; the rule of the
    front errs by half of what changes."""
    x = np.broadcast_to(np.linspace(0, 1, 65, dtype=np.float32)[:, None, None], (65, 9, 9))
    volume, sampling = jv.Volume(x), jv.AdaptiveSampling(1e-3)
    points = [0.0, 0.49, 0.5, 0.51, 1.0]
    peak = jv.TransferFunction(points, [[1.0, 1.0, 1.0]] * 5, [0.0, 0.0, 2.0, 0.0, 0.0])
    longest = {
        (name, quadrature): strides(volume, transfer, sampling, 0.5, quadrature)[:, 0, 0]
        for name, transfer in (("ramp", RAMP), ("peak", peak))
        for quadrature in ("preintegrated", "midpoint", "left")
    }
    for quadrature in ("preintegrated", "midpoint"):
        assert (longest["ramp", quadrature][1:-1] == 8).all()
    assert (longest["ramp", "left"][1:-1] == 1).all()
    assert (longest["peak", "preintegrated"] == 8).all()
    for quadrature in ("midpoint", "left"):
        assert (longest["peak", quadrature][7:9] == 1).all()  # around the peak
        assert (longest["peak", quadrature][[3, 12]] == 8).all()  # far from it


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**16), step=st.sampled_from([0.1, 0.3, 0.5]))
def test_the_error_of_a_run_is_that_of_a_window_that_holds_it(seed, step):
    errors = np.random.default_rng(seed).random((2, 16)).astype(np.float32)
    volume = jv.Volume(np.zeros((65, 3, 3), np.float32))
    sampling = eqx.tree_at(
        lambda of: of.errors,
        jv.AdaptiveSampling(1.0, 2),
        _coded(jnp.asarray(errors)[:, :, None, None]),
        is_leaf=lambda leaf: leaf is None,
    )
    zero, one = jnp.float32(0), jnp.float32(1)
    ray = enter(Affine(volume), (zero - 1, one, one), (one, zero, zero), (jnp.int32(0), jnp.int32(0)))
    fronts = jnp.arange(0, 56, 0.5, dtype=jnp.float32)
    start = BLOCK * np.arange(16)
    for level in (0, 1):
        run = partial(Run, stride=2**level, step=jnp.float32(step))
        found, tolerated = jax.vmap(lambda front, run=run: sampling.stride_error(ray, run(front)))(fronts)
        assert (np.asarray(tolerated) == 1).all()
        for front, error in zip(np.asarray(fronts), np.asarray(found), strict=True):
            back = front + RUN * 2**level * step
            holds = (start - MARGIN <= front) & (back <= start + BLOCK + MARGIN)
            assert (errors[level][holds] == error).any(), (front, level)


@pytest.mark.parametrize("case", ["nan", "field", "selection", "unknown", "labels"])
def test_cells_are_one_step_long_where_nothing_is_known(case):
    volume, transfer, more = parabola(), RAMP, {}
    if case == "nan":
        volume = eqx.tree_at(lambda of: of.data, volume, volume.data.at[16, 16, 16].set(jnp.nan))
        found = strides(volume, RAMP, jv.AdaptiveSampling(1.0), 0.5)
        assert found[4, 4, 4] == 1
        assert found[0, 0, 0] == 8
        return
    if case == "field":

        class Constant(jv.Field):
            def value(self, volume, coordinate):
                return jnp.zeros_like(coordinate[0])

        volume = jv.Volume(volume.data, field=Constant())
    elif case == "selection":
        more["mode"] = jv.FirstVisible()
    elif case == "unknown":

        class Unknown(jv.TransferFunction):
            def variation(self, windows):
                return super(jv.TransferFunction, self).variation(windows)

        transfer = Unknown(RAMP.values, RAMP.colors, RAMP.extinction)
    else:
        transfer = jv.LabelTransferFunction([RAMP, RAMP])
        volume = jv.Volume(volume.data, labels=np.zeros(volume.data.shape, np.uint8))
    # of a field it is known that it varies no more than the transfer function does
    tolerance = 1e-3 if case == "field" else 1e3
    assert strides(volume, transfer, jv.AdaptiveSampling(tolerance), 0.5, **more).max() == 1


# -- what the image becomes ------------------------------------------------------------------------------


@pytest.mark.parametrize("tolerance", [1e-2, *slow(3e-2, 3e-3)])
def test_a_real_volume_is_rendered_within_the_tolerance_by_fewer_samples(real_volume, tolerance):
    folder = real_volume("engine_256x256x128_uint8.raw.gz").parent
    volume, transfer, camera, step = real_scenes.engine(folder, 96)
    base, step = (jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination()), step / 2
    uniform = jv.render(volume, transfer, camera, jv.March(step, base, "preintegrated"))
    truth = jv.render(volume, transfer, camera, jv.March(step / 8, base, "preintegrated"))
    march = jv.March(step, (*base, jv.AdaptiveSampling(tolerance)), "preintegrated")
    found = jv.render(volume, transfer, camera, march)
    assert rmse(found.image(), truth.image()) <= tolerance
    share = {3e-2: 4, 1e-2: 3, 3e-3: 2}[tolerance]
    assert share * int(found.samples.sum()) < int(uniform.samples.sum())


@pytest.mark.parametrize("quadrature", ["midpoint", *slow("left", "preintegrated")])
def test_the_estimated_error_is_mostly_above_the_true_one(quadrature):
    """And within two orders of magnitude."""
    volume, transfer, camera, march = scene_of()
    march = jv.March(march.step, march.transforms[1:], quadrature)  # no jitter
    fine = jv.March(march.step / 8, march.transforms[:-1], quadrature)
    found, truth = (jv.render(volume, transfer, camera, m) for m in (march, fine))
    assert rmse(found.image(), truth.image()) <= 0.03
    error = np.sqrt(np.mean((np.asarray(found.image()) - np.asarray(truth.image())) ** 2, axis=-1))
    seen = np.asarray(truth.rgba[..., 3]) > 0.01
    estimate = np.asarray(found.error)
    assert np.isfinite(estimate).all()
    assert np.mean(error[seen] <= estimate[seen]) > 0.95
    assert np.sqrt(np.mean(estimate[seen] ** 2)) < 100 * np.sqrt(np.mean(error[seen] ** 2))


def test_the_estimated_error_is_that_of_the_reference():
    scene = changed(scene_of(), without=[jv.SpaceLeaping], max_samples=256)
    volume, transfer, camera, march = scene
    origins, directions = camera.rays()
    found = np.asarray(jv.render(*scene).error)
    for row, column in ((10, 18), (7, 12), (12, 27), (0, 0)):
        ray = origins[row, column], directions[row, column]
        alone = jv.render_ray_reference(volume, transfer, *ray, march, pixel=(column, row))
        np.testing.assert_allclose(found[row, column], alone.error, rtol=1e-4, atol=1e-9)
    assert found.max() > 0


def test_samples_that_run_out_end_the_estimate():
    """It must not grow while other rays of a batch are marched."""
    scene = changed(scene_of(), without=[jv.SpaceLeaping], max_samples=40)
    reference = reference_image(*scene)
    assert 0.1 < np.mean(reference.exhausted) < 1
    np.testing.assert_allclose(jv.render(*scene).error, reference.error, rtol=1e-4, atol=1e-9)


def test_cells_that_are_all_one_step_long_have_an_estimate_too():
    volume, transfer, camera, march = scene_of()
    uniform = jv.March(march.step, (jv.AlphaCorrection(),), "midpoint")
    sampling = jv.March(march.step, (jv.AlphaCorrection(), jv.AdaptiveSampling(0.03, 1)), "midpoint")
    found, expected = (jv.render(volume, transfer, camera, m) for m in (sampling, uniform))
    np.testing.assert_allclose(found.rgba, expected.rgba, atol=1e-6)
    np.testing.assert_array_equal(found.samples, expected.samples)
    assert 0 < found.error.max() < 1


def test_the_reference_needs_no_limit_of_samples_inside_jit():
    volume, transfer, camera, march = scene_of()
    origins, directions = (part[10, 18] for part in camera.rays())
    for finest in (1, 2):
        sampling = jv.March(march.step, (jv.AdaptiveSampling(0.03, 2, finest),), "midpoint")

        def inside(origin, direction, sampling=sampling):
            return jv.render_ray_reference(volume, transfer, origin, direction, sampling).rgba

        expected = jax.jit(inside)(origins, directions)
        np.testing.assert_allclose(inside(origins, directions), expected, atol=1e-6)


def test_the_estimated_error_is_infinite_where_nothing_is_known_and_missing_where_nothing_is_estimated():
    volume, transfer, camera, march = scene_of()
    nearest = jv.render(volume, transfer, camera, march, compositing=jv.FirstVisible())
    seen = np.asarray(nearest.rgba[..., 3]) > 0
    assert np.isinf(nearest.error[seen]).all()
    uniform = jv.render(*changed((volume, transfer, camera, march), without=[jv.AdaptiveSampling]))
    with pytest.raises(AttributeError, match="error is not part of this rendering: give the march Adaptive"):
        _ = uniform.error


def within_tolerance(volume, transfer, tolerance, sampling, quadrature="midpoint", step=0.25, cut=True):
    """Whether it holds, and by how many samples a ray, adaptive and uniform; and the root mean square of what
    was estimated."""
    camera, cuts = around(volume, (24, 24)), (jv.AlphaCorrection(),)
    base = cuts if cut else ()
    truth = jv.render(volume, transfer, camera, jv.March(step / 16, cuts, "midpoint")).rgba
    found, uniform = (
        jv.render(volume, transfer, camera, jv.March(step, (*base, *more), quadrature))
        for more in ((sampling,), ())
    )
    # nothing is better than what is one step long
    error, floor = (rmse(each.rgba, truth) for each in (found, uniform))
    samples = [float(each.samples.mean()) for each in (found, uniform)]
    return error <= max(tolerance, 1.01 * floor), *samples, float(np.sqrt(np.mean(found.error**2)))


def line(n=33):
    """Values from 0 to 1 along x."""
    x = np.linspace(0, 1, n, dtype=np.float32)
    return jv.Volume(np.broadcast_to(x[:, None, None], (n, n, n)).copy())


@pytest.mark.parametrize("quadrature", ["midpoint", *slow("left", "preintegrated")])
def test_long_cells_do_not_reach_past_the_exit(quadrature):
    """In a constant, where all cells may be long, and which no `AlphaCorrection` cuts."""
    volume = jv.Volume(np.full((33, 33, 33), 0.5, np.float32))
    transfer = jv.TransferFunction([0.0, 1.0], [(1.0, 0.5, 0.2)] * 2, [0.02, 0.02])
    held, samples, uniform, _ = within_tolerance(
        volume, transfer, 1e-6, jv.AdaptiveSampling(1e-3, 64), quadrature, cut=False
    )
    assert held
    assert samples < uniform / 3


@pytest.mark.parametrize(
    ("colors", "extinction"),
    [
        ([(1, 0, 0), (0, 0, 1)], (2.0, 2.0)),
        *slow(([(0, 0, 0), (1, 1, 1)], (0.0, 0.2)), ([(1, 0, 0), (0, 0, 1)], (0.1, 0.1))),
    ],
)
def test_colours_that_hide_each_other_and_products_that_bend_are_heeded(colors, extinction):
    """The value is linear, and so are colour and extinction: no cell errs by anything else."""
    transfer = jv.TransferFunction([0.0, 1.0], colors, extinction)
    for tolerance in (1e-3, 1e-4):
        held, samples, uniform, estimate = within_tolerance(
            line(), transfer, tolerance, jv.AdaptiveSampling(tolerance, 16)
        )
        assert held, tolerance
        assert estimate > tolerance / 100
    assert samples <= uniform


def test_finest_divides_the_steps_of_the_march():
    """Steps four times as long, divided by four, and cells of as many parts are the same march."""
    volume, transfer, camera, march = scene_of()
    rest = march.transforms[1:-1]
    fine = jv.March(march.step, (*rest, jv.AdaptiveSampling(0.03, 8)), march.quadrature)
    divided = jv.March(4 * march.step, (*rest, jv.AdaptiveSampling(0.03, 2, finest=4)), march.quadrature)
    found, expected = (jv.render(volume, transfer, camera, m) for m in (divided, fine))
    np.testing.assert_allclose(found.rgba, expected.rgba, atol=1e-6)
    np.testing.assert_array_equal(found.samples, expected.samples)


def test_jitter_breaks_the_wood_grain_of_long_cells():
    """The rings of cells that are all two steps long, on an inclined plane."""
    scene = jitter_accuracy.cut_block(48, 256)
    step = float(scene.volume.spacing[0])

    def image(*transforms, step=step):
        march = jv.March(step, transforms)
        return np.asarray(jv.render(scene.volume, scene.transfer, scene.camera, march).rgba[..., :3], float)

    truth, sampling = image(step=step / 4), jv.AdaptiveSampling(1e3, 2)
    plain, jittered = (
        scene.grain(image(sampling, *more) - truth, 2 * step) for more in ((), (jv.EmptySpaceJitter(1),))
    )
    assert plain > 1e-5
    assert jittered < plain / 100


# -- both engines ----------------------------------------------------------------------------------------


SIZE = (37, 21)
"""More than one beam along each axis."""


def scene_of(dtype="uint8", camera="outside"):
    """Two smooth blobs, one inside and one cut by a face, in empty space."""
    x, y, z = np.meshgrid(*(np.linspace(-1, 1, n) for n in (41, 33, 49)), indexing="ij")
    centers = ((-0.5, 0.1, -0.3), 0.06), ((0.9, -0.2, 0.5), 0.1)
    value = sum(np.exp(-((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2) / s) for (a, b, c), s in centers)
    volume = jv.Volume(
        (np.clip(value, 0, 1) * TOPS[dtype]).astype(dtype), (0.045, 0.055, 0.04), (0.2, -0.4, 0.1)
    )
    values, extinction = np.array([0.0, 0.15, 0.4, 1.0]), [0.0, 0.0, 6.0, 20.0]
    transfer = jv.TransferFunction(values * TOPS[dtype], np.random.default_rng(2).random((4, 3)), extinction)
    position, target, angle = CAMERAS[camera]
    view = jv.Camera(position, target, (0.1, 0.2, 1), angle, size=SIZE)
    transforms = jv.EmptySpaceJitter(4), jv.AlphaCorrection(), jv.SpaceLeaping("distance")
    return volume, transfer, view, jv.March(0.02, (*transforms, jv.AdaptiveSampling(0.03)), "midpoint")


def changed(scene, tolerance=0.03, without=(), max_samples=None):
    """The scene with another tolerance, without transforms of some types."""
    volume, transfer, camera, march = scene
    kept = [t for t in march.transforms if not isinstance(t, (jv.AdaptiveSampling, *without))]
    if jv.AdaptiveSampling not in without:
        kept.append(jv.AdaptiveSampling(tolerance))
    return volume, transfer, camera, jv.March(march.step, kept, march.quadrature, max_samples=max_samples)


@pytest.mark.parametrize("camera", ["outside", "inside"])
@pytest.mark.parametrize("dtype", ["uint8", *slow("uint16", "int16", "float32")])
def test_both_engines_choose_the_same_cells(dtype, camera):
    scene = scene_of(dtype, camera)
    leapt, plain = (jv.render(*changed(scene, without=none)) for none in ([], [jv.AdaptiveSampling]))
    assert int(leapt.samples.sum()) < 0.8 * int(plain.samples.sum())
    unleapt = jv.render(*changed(scene, without=[jv.SpaceLeaping]))
    np.testing.assert_allclose(leapt.rgba, unleapt.rgba, atol=1e-6)
    counted = changed(scene, without=[jv.SpaceLeaping], max_samples=256)
    reference = reference_image(*counted)
    compare(unleapt, reference.rgba, np.asarray(reference.samples), tolerance=2e-5)


@pytest.mark.slow
def test_leaping_does_not_change_its_gradients():
    scene = scene_of()
    found, expected = (gradient(changed(scene, without=none)) for none in ([], [jv.SpaceLeaping]))
    assert_same(found, expected, 1e-4)


@pytest.mark.slow
def test_it_follows_tolerance_and_transfer_function_in_one_program():
    volume, transfer, camera, march = scene_of()
    kind, samples = counting(), []

    @eqx.filter_jit
    def inside(volume, transfer, tolerance):
        return jv.render(*changed((volume, transfer, camera, march), tolerance)).rgba

    for tolerance, factor in ((0.1, 1.0), (0.03, 1.0), (0.01, 1.0), (0.03, 0.1)):
        function = kind(transfer.values, transfer.colors, factor * transfer.extinction)
        found = jv.render(*changed((volume, function, camera, march), tolerance))
        samples.append(int(found.samples.sum()))
        np.testing.assert_allclose(inside(volume, function, tolerance), found.rgba, atol=1e-5)
    assert samples[3] < samples[1]
    assert samples[0] < samples[1] < samples[2]
    assert kind.traces == 2  # one outside `jax.jit`, one inside


@pytest.mark.slow
def test_tolerances_may_be_vmapped_over():
    scene = changed(scene_of())
    tolerances = jnp.asarray([0.1, 0.01])
    found = jax.vmap(lambda tolerance: jv.render(*changed(scene, tolerance)).samples)(tolerances)
    expected = [jv.render(*changed(scene, tolerance)).samples for tolerance in (0.1, 0.01)]
    np.testing.assert_array_equal(found, expected)


def test_the_distance_of_nodes_in_a_fan_grows_with_that_from_the_probe():
    volume, probe = jv.toroidal_phantom("shells", (17, 25, 33), speckle=False)
    space = probe.locate(Affine(volume), volume)
    found = np.asarray(node_distance(space, (4, 6, 8)))
    assert (np.diff(found, axis=2) > 0).any()
    for block in ((0, 0, 0), (2, 3, 4), (3, 5, 7)):
        middle = BLOCK * (np.array(block) + 0.5)
        ends = [
            [np.array(space.point(tuple(jnp.asarray(middle + way * axis)))) for way in (0.5, -0.5)]
            for axis in np.eye(3)
        ]
        expected = min(np.linalg.norm(ahead - behind) for ahead, behind in ends)
        np.testing.assert_allclose(found[block], expected, rtol=0.02)


@pytest.mark.slow
def test_fans_are_rendered_within_the_tolerance_by_fewer_samples():
    volume, probe = jv.toroidal_phantom("shells", speckle=False)
    transfer = jv.TransferFunction.from_points(
        [(40, (0.2, 0.1, 0.1), 0.0), (120, (0.8, 0.5, 0.4), 0.3), (255, (1.0, 0.9, 0.8), 0.8)], 3.0
    )
    low, high = (np.asarray(corner) for corner in probe.corners)
    camera = jv.Camera(
        (low + high) / 2 + 2 * (high - low).max() * np.array([0.5, -0.8, 0.3]),
        (low + high) / 2,
        (0, 0, 1),
        30.0,
        size=(48, 48),
    )
    base = (probe, jv.AlphaCorrection(), jv.SpaceLeaping())
    truth, uniform, adaptive = (
        jv.render(volume, transfer, camera, jv.March(step, (*base, *more), "midpoint"))
        for step, more in ((0.1, ()), (0.2, ()), (0.2, (jv.AdaptiveSampling(0.003),)))
    )
    assert np.mean(truth.rgba[..., 3] > 0.1) > 0.1
    assert rmse(adaptive.image(), truth.image()) <= 0.003
    assert 2 * int(adaptive.samples.sum()) < int(uniform.samples.sum())


@pytest.mark.parametrize("given", [0.0, -1.0, np.nan, "much", [0.1, 0.2]])
def test_a_tolerance_that_is_none_is_refused(given):
    with pytest.raises(ValueError, match="tolerance must "):
        jv.AdaptiveSampling(given)


@pytest.mark.parametrize("name", ["longest", "finest"])
@pytest.mark.parametrize("given", [0, 3, 128, 2.0, True])
def test_a_stride_that_is_none_is_refused(name, given):
    with pytest.raises(ValueError, match=f"{name} must be"):
        jv.AdaptiveSampling(0.01, **{name: given})


def test_strides_that_are_too_many_are_refused():
    with pytest.raises(ValueError, match=r"longest \* finest must be at most 64; got 32 \* 4"):
        jv.AdaptiveSampling(0.01, 32, 4)
