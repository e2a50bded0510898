"""Adaptive sampling and cells of several steps: what is known of the voxels, what is predicted, what the
image's error becomes, and whether both engines choose the same cells."""

import itertools
from functools import cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import jaxvol as jv
from experiments import scenes as real_scenes
from jaxvol.march.strides import RUN, Run, StrideControl, Strides, predicted
from jaxvol.march.transforms.adaptive_sampling import _coded
from jaxvol.metrics import rmse
from jaxvol.scene.occupancy import BLOCK
from jaxvol.scene.space import Affine, enter
from jaxvol.scene.variation import MARGIN, Windows

from ...scenes import around
from ...switch import switch
from ...test_agreement import compare, reference_image


RAMP = jv.TransferFunction([0.0, 1.0], [[1.0, 1.0, 1.0]] * 2, [0.0, 2.0])
"""Extinction and emission grow by 2 for each unit of the value."""


OVER = jv.Over()


@eqx.filter_jit
def errors(volume, transfer, march, mode):
    """By level of stride and block, the predicted error."""
    known = predicted(march, Affine(volume), Windows.of(volume), partial(mode.variation, transfer))
    (sampling,) = known.transforms
    assert isinstance(sampling, jv.AdaptiveSampling)
    assert sampling.errors is not None
    return jax.lax.bitcast_convert_type(sampling.errors, jnp.float32)


def strides(volume, transfer, sampling, step=1.0, quadrature="preintegrated", mode: Any = OVER):
    """By block, the most steps of a cell with nothing in front."""
    found = errors(volume, transfer, jv.March(step, (sampling,), quadrature), mode)
    allowed = np.asarray(found) <= float(sampling.tolerance)
    return np.max([np.where(fits, 2**k, 1) for k, fits in enumerate(allowed)], axis=0)


# -- what is known of the voxels -------------------------------------------------------------------------


@settings(max_examples=12)
@given(
    shape=st.tuples(*[st.sampled_from([2, 9])] * 3),
    dtype=st.sampled_from(["int16", "float32"]),
    seed=st.integers(0, 2**16),
)
def test_windows_hold_what_lies_in_and_around_each_block(shape, dtype, seed):
    data = (np.random.default_rng(seed).random(shape) * 200).astype(dtype)
    found, value = eqx.filter_jit(Windows.of)(jv.Volume(data)), data.astype(float)
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


@settings(max_examples=15)
@given(seed=st.integers(0, 2**16), points=st.sampled_from([2, 7]))
def test_the_variation_bounds_every_change_of_extinction_and_emission(seed, points):
    random = np.random.default_rng(seed)
    values = np.sort(random.random(points)).astype(np.float32)
    transfer = jv.TransferFunction(values, random.random((points, 3)), random.random(points) * 5)
    low, high = np.sort(random.uniform(-0.2, 1.2, (2, 30)), axis=0)
    least, most, bend = (jnp.asarray(a, jnp.float32).reshape(30, 1, 1) for a in (low, high, 0 * low))
    windows = Windows(least, most, bend)
    found = eqx.filter_jit(jv.TransferFunction.variation)(transfer, windows)
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
        turns = np.ravel(
            eqx.filter_jit(jv.TransferFunction.variation)(transfer, Windows(low, high, 0 * low)).turns
        )
        np.testing.assert_allclose(turns, [160.0, np.inf, np.inf, 0.0], rtol=1e-5)


# -- what is predicted -----------------------------------------------------------------------------------


def parabola(n=33, axis=0, bend=1 / 512):
    """Values in [0, 1] with this second difference along one axis."""
    x = np.meshgrid(*[np.arange(n) - n // 2] * 3, indexing="ij")[axis]
    return jv.Volume((bend * x**2 / 2).astype(np.float32))


def test_cells_are_as_long_as_the_tolerance_lets_them_be():
    """The value bends by H = 1/512 everywhere, so that e / 20 = ℓ V δ / (20 R) = 4 · 2 · H w² / 160. Volume,
    extinction and step may be scaled together."""
    inner = np.ix_(*[np.arange(1, 7)] * 3)  # at faces a window holds no more than the bend of its inside
    thinner = jv.TransferFunction(RAMP.values, RAMP.colors, RAMP.extinction / 3)
    volume = parabola()
    for axis, stride in itertools.product(range(3), (1, 2, 4, 8)):
        volume = parabola(axis=axis)
        sampling = jv.AdaptiveSampling(1.01 * 4 * 2 * (1 / 512) * (stride / 2) ** 2 / 160)
        found = strides(volume, RAMP, sampling, 0.5)
        assert (found[inner] == stride).all(), (axis, stride)
        scaled = jv.Volume(volume.data, (3.0, 3.0, 3.0))
        np.testing.assert_array_equal(strides(scaled, thinner, sampling, 1.5), found)
    x, y, _ = np.meshgrid(*[np.linspace(-1, 1, 33)] * 3, indexing="ij")
    saddle = jv.Volume((0.5 + 0.5 * x * y).astype(np.float32))  # bends across the axes alone
    assert strides(saddle, RAMP, jv.AdaptiveSampling(1e-5), 0.5).max() == 1
    broken = eqx.tree_at(lambda of: of.data, volume, volume.data.at[16, 16, 16].set(jnp.nan))
    found = strides(broken, RAMP, jv.AdaptiveSampling(1.0), 0.5)
    assert found[4, 4, 4] == 1
    assert found[0, 0, 0] == 8


def test_long_stretches_heed_what_lies_farther_away():
    """A window says nothing of what lies beyond it. One voxel differs from the others."""
    data = np.full((65, 65, 65), 0.5, np.float32)
    data[32, 32, 32] = 1
    for longest, step, blocks in ((4, 0.5, 4), (8, 1.0, 10)):
        found = strides(jv.Volume(data), RAMP, jv.AdaptiveSampling(1e-3, longest), step)
        assert (found < longest).any(axis=(1, 2)).sum() == blocks, (longest, step)
        assert found.max() == longest
    # nothing is known of 64 voxels
    assert strides(jv.Volume(data), RAMP, jv.AdaptiveSampling(1e3, 8), 2.0).max() == 8
    assert strides(jv.Volume(data), RAMP, jv.AdaptiveSampling(1e3, 8), 4.0).max() == 4


@pytest.mark.slow
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


@settings(max_examples=15)
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
        found = jax.jit(jax.vmap(lambda front, run=run: sampling.error(ray, run(front))))(fronts)
        for front, error in zip(np.asarray(fronts), np.asarray(found), strict=True):
            back = front + RUN * 2**level * step
            holds = (start - MARGIN <= front) & (back <= start + BLOCK + MARGIN)
            assert (errors[level][holds] == error).any(), (front, level)


def test_cells_are_one_step_long_where_nothing_is_known():
    volume, sampling = parabola(), jv.AdaptiveSampling(1e3)
    assert strides(volume, RAMP, sampling, 0.5, mode=jv.FirstVisible()).max() == 1
    labelled = jv.Volume(volume.data, labels=np.zeros(volume.data.shape, np.uint8))
    assert strides(labelled, jv.LabelTransferFunction([RAMP, RAMP]), sampling, 0.5).max() == 1


# -- cells of several steps ------------------------------------------------------------------------------


class Table(StrideControl):
    """Allows runs as a table says, by stride and number of the run, where at most half is visible; and
    behind less than that all of them."""

    allowed: jax.Array
    phase: jax.Array
    tolerance: jax.Array = eqx.field(converter=jnp.asarray, default=1.0)
    longest: int = eqx.field(static=True, default=16)

    def prepared(self, march, space, windows, variation):
        return self

    def error(self, ray, run):
        number = jnp.round((run.front / run.step + self.phase) / (RUN * run.stride)).astype(jnp.int32)
        fits = self.allowed[run.stride.bit_length() - 1, number]
        return jnp.where(fits, 1.0, 4.0).astype(ray.length.dtype)


@cache
def straight():
    """A ray of 16 runs of the longest stride. Made once, so that all marches share a program."""
    box, zero = Affine(jv.Volume(np.zeros((3, 3, 3)), (200.0, 200.0, 200.0))), jnp.float32(0)
    line = (zero + 1, zero + 1, zero + 1), (zero + 1, zero, zero)
    return enter(box, *line, (jnp.int32(0), jnp.int32(0)))


@eqx.filter_jit
def strides_of(march, ray, first, index, stride, target, transmittance):
    index, stride, target = (i.astype(jnp.int32) for i in (index, stride, target))
    at, no = Strides(stride, first, jnp.float32(0)), jnp.zeros((), bool)
    transmittance = transmittance.astype(jnp.float32)
    found, steps = at.next(march, ray, index, target - index, transmittance, leaves=no, finished=no)
    assert found.error is not None
    return index + steps, found.steps, jnp.sqrt(found.error)


@settings(max_examples=20)
@given(
    seed=st.integers(0, 2**16),
    share=st.sampled_from([0.1, 0.3, 0.5]),
    first=st.one_of(st.just(0), st.integers(0, 16 * RUN - 1)),
)
def test_runs_are_the_same_however_a_ray_comes_to_them(seed, share, first):
    """By steps or by leaps, from where a run begins or from within it. The first of all runs begins so many
    steps before the ray."""
    random, steps = np.random.default_rng(seed), 16 * RUN * 4
    allowed = random.random((5, steps // RUN)) < share
    march = jv.March(0.5, (Table(allowed=jnp.asarray(allowed), phase=jnp.asarray(first)),))

    def strides(*where):
        return strides_of(march, straight(), np.asarray(first, np.int32), *map(np.asarray, where))

    runs, index, stride = [], 0, 1
    while index < steps - first:
        begin, stride, error = (int(each) for each in strides(index, stride, index, 1.0))
        level, since = stride.bit_length() - 1, index + first
        assert begin == index
        assert since % (RUN * stride) == 0 or (index == 0 and stride == 1)
        assert stride == 1 or allowed[level, since // (RUN * stride)]
        assert error == (1 if allowed[level, since // (RUN * stride)] else 4)
        runs.append((index, stride))
        index = (since // (RUN * stride) + 1) * RUN * stride - first
    ends = [index for index, _ in runs[1:]] + [index]
    for target in random.integers(0, steps - first, 12):
        begin, stride = runs[np.searchsorted(ends, target, side="right")]
        since = runs[random.integers(0, runs.index((begin, stride)) + 1)]
        before = runs[max(runs.index(since) - 1, 0)][1]
        found = strides(since[0], before, target, 1.0)
        assert (int(found[0]), int(found[1])) == (begin, stride)
        within = since[0] + since[1] * random.integers(1, RUN)
        if within <= target and within < ends[runs.index(since)]:
            found = strides(within, since[1], target, 1.0)
            ahead = within if since == (begin, stride) else begin
            assert (int(found[0]), int(found[1])) == (ahead, stride)
    assert int(strides(0, 1, 0, 0.25)[1]) == max(2**k for k in range(5) if first % (RUN << k) == 0 or k == 0)
    for index, _ in runs:  # what became allowed behind something does not reach before it
        assert int(strides(index, 1, index, 0.25)[0]) == index


# -- what the image becomes ------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [1e-2, 3e-3])
def test_a_real_volume_is_rendered_within_the_tolerance_by_fewer_samples(real_volume, tolerance):
    folder = real_volume("engine_256x256x128_uint8.raw.gz").parent
    volume, transfer, camera, step = real_scenes.engine(folder, 96)
    base = jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination()

    def image(step, on):
        march = jv.March(step, (*base, switch(jv.AdaptiveSampling(tolerance), on)), "preintegrated")
        return jv.render(volume, transfer, camera, march)

    uniform, truth, found = image(step / 2, False), image(step / 16, False), image(step / 2, True)
    assert rmse(found.image(), truth.image()) <= tolerance
    share = {3e-2: 4, 1e-2: 3, 3e-3: 2}[tolerance]
    assert share * int(found.samples.sum()) < int(uniform.samples.sum())


SIZE = (37, 21)
"""More than one beam along each axis."""


@cache
def smooth(dtype="uint8"):
    """Two smooth blobs, one inside and one cut by a face, in empty space; and a transfer function."""
    x, y, z = np.meshgrid(*(np.linspace(-1, 1, n) for n in (41, 33, 49)), indexing="ij")
    centers = ((-0.5, 0.1, -0.3), 0.06), ((0.9, -0.2, 0.5), 0.1)
    value = sum(np.exp(-((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2) / s) for (a, b, c), s in centers)
    top = {"uint8": 255, "int16": 4000}[dtype]
    volume = jv.Volume((np.clip(value, 0, 1) * top).astype(dtype), (0.045, 0.055, 0.04), (0.2, -0.4, 0.1))
    values, extinction = np.array([0.0, 0.15, 0.4, 1.0]), [0.0, 0.0, 6.0, 20.0]
    return volume, jv.TransferFunction(values * top, np.random.default_rng(2).random((4, 3)), extinction)


def smooth_camera(inside):
    outside = (3.1, -3.9, 2.4), (1.1, 0.5, 1.0), 30.0
    position, target, angle = ((1.15, 0.45, 1.0), (0.7, 0.6, 0.6), 70.0) if inside else outside
    return jv.Camera(position, target, (0.1, 0.2, 1), angle, size=SIZE)


def smooth_march(adaptive=True, leaps=True, jitter=True, step=0.02, **how):
    transforms = (
        switch(jv.EmptySpaceJitter(4), jitter),
        jv.AlphaCorrection(),
        switch(jv.SpaceLeaping("distance"), leaps),
        switch(jv.AdaptiveSampling(0.03), adaptive),
    )
    return jv.March(step, transforms, "midpoint", **how)


def test_both_engines_choose_the_same_cells_and_estimate_the_same_error():
    volume, transfer = smooth("uint8")
    for inside in (False, True):
        camera = smooth_camera(inside)
        leapt, plain, unleapt, fine = (
            jv.render(volume, transfer, camera, march)
            for march in (
                smooth_march(),
                smooth_march(adaptive=False),
                smooth_march(leaps=False),
                smooth_march(adaptive=False, jitter=False, step=0.0025),
            )
        )
        assert int(leapt.samples.sum()) < 0.8 * int(plain.samples.sum())
        np.testing.assert_allclose(leapt.rgba, unleapt.rgba, atol=1e-6)
        reference = reference_image(volume, transfer, camera, smooth_march(leaps=False, max_samples=256))
        compare(unleapt, reference.rgba, np.asarray(reference.samples), tolerance=2e-5)
        same = np.asarray(reference.samples) == np.asarray(unleapt.samples)
        np.testing.assert_allclose(unleapt.error[same], reference.error[same], rtol=1e-3, atol=1e-9)
        # what is estimated is mostly above the true error, and within two orders of magnitude
        quiet = jv.render(volume, transfer, camera, smooth_march(jitter=False))
        assert rmse(quiet.image(), fine.image()) <= 0.03
        error = np.sqrt(np.mean((np.asarray(quiet.image()) - np.asarray(fine.image())) ** 2, axis=-1))
        seen, estimate = np.asarray(fine.rgba[..., 3]) > 0.01, np.asarray(quiet.error)
        assert np.mean(error[seen] <= estimate[seen]) > 0.95
        assert np.sqrt(np.mean(estimate[seen] ** 2)) < 100 * np.sqrt(np.mean(error[seen] ** 2))


@pytest.mark.slow
def test_samples_that_run_out_end_the_estimate():
    """It must not grow while other rays of a batch are marched."""
    scene = *smooth(), smooth_camera(False), smooth_march(leaps=False, max_samples=40)
    reference = reference_image(*scene)
    assert 0.1 < np.mean(reference.exhausted) < 1
    np.testing.assert_allclose(jv.render(*scene).error, reference.error, rtol=1e-4, atol=1e-9)


@pytest.mark.slow
def test_without_adaptive_sampling_there_is_no_estimate():
    scene = *smooth(), smooth_camera(False)
    rest = jv.AlphaCorrection(), jv.SpaceLeaping()
    with pytest.raises(AttributeError, match="error is not part of this rendering: give the march Adaptive"):
        _ = jv.render(*scene, jv.March(0.02, rest)).error


@pytest.mark.slow
def test_tolerances_may_be_traced_and_vmapped_over():
    volume, transfer = smooth()

    def samples(tolerance):
        transforms = jv.AlphaCorrection(), jv.SpaceLeaping(), jv.AdaptiveSampling(tolerance)
        return jv.render(
            volume, transfer, smooth_camera(False), jv.March(0.02, transforms, "midpoint")
        ).samples

    found = jax.vmap(samples)(jnp.asarray([0.1, 0.01]))
    np.testing.assert_array_equal(found, [samples(0.1), samples(0.01)])
    assert found[0].sum() < found[1].sum()


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


@pytest.mark.slow
def test_long_cells_do_not_reach_past_the_exit():
    """In a constant, where all cells may be long, and which no `AlphaCorrection` cuts."""
    volume = jv.Volume(np.full((33, 33, 33), 0.5, np.float32))
    transfer = jv.TransferFunction([0.0, 1.0], [(1.0, 0.5, 0.2)] * 2, [0.02, 0.02])
    held, samples, uniform, _ = within_tolerance(
        volume, transfer, 1e-6, jv.AdaptiveSampling(1e-3, 64), cut=False
    )
    assert held
    assert samples < uniform / 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("colors", "extinction"),
    [
        ([(1, 0, 0), (0, 0, 1)], (2.0, 2.0)),
        ([(0, 0, 0), (1, 1, 1)], (0.0, 0.2)),
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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        *(((given,), "tolerance must ") for given in (0.0, -1.0, np.nan, "much", [0.1, 0.2])),
        *(((0.01, given), "longest must be") for given in (0, 3, 128, 2.0, True)),
    ],
    ids=repr,
)
def test_bad_input_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        jv.AdaptiveSampling(*arguments)
