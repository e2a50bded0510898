"""Cells of several steps: the fast engine against the reference, leaping against none, and gradients."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import jaxvol as jv
from jaxvol.march import RUN
from jaxvol.space import Affine, enter

from ..scenes import in_float64, slow
from ..test_agreement import compare, reference_image
from .test_gradient_matrix import assert_same, assert_slopes, central, gradient, scene_of, slopes


class Patchy(jv.Transform):
    """Cells whose length changes all over the volume: 1, 2, 4 or 8 steps."""

    longest: int = eqx.field(static=True, default=8)

    @property
    def longest_stride(self):
        return self.longest

    def stride_error(self, ray, run):
        x, y, z = ray.path(run.middle)
        longest = 2 ** (jnp.floor(x / 3 + y / 2 + z / 5).astype(jnp.int32) % 5)
        # longer cells than that behind what hides some of them
        return jnp.where(run.stride <= longest, 0.0, run.stride / longest).astype(x.dtype), jnp.ones_like(x)


class Table(jv.Transform):
    """Allows runs as a table says, by stride and number of the run, where at most half is visible; and
    behind less than that all of them."""

    allowed: jax.Array
    phase: jax.Array

    @property
    def longest_stride(self):
        return 16

    def stride_error(self, ray, run):
        number = jnp.round((run.front / run.step + self.phase) / (RUN * run.stride)).astype(jnp.int32)
        fits = self.allowed[run.stride.bit_length() - 1, number]
        return jnp.where(fits, 1.0, 4.0).astype(ray.length.dtype), jnp.ones_like(run.front)


@cache
def straight():
    """A ray of 16 runs of the longest stride. Made once, so that all marches share a program."""
    box, zero = Affine(jv.Volume(np.zeros((3, 3, 3)), (200.0, 200.0, 200.0))), jnp.float32(0)
    line = (zero + 1, zero + 1, zero + 1), (zero + 1, zero, zero)
    return enter(box, *line, (jnp.int32(0), jnp.int32(0)))


@eqx.filter_jit
def strides_of(march, ray, first, index, stride, target, transmittance):
    index, stride, target = (i.astype(jnp.int32) for i in (index, stride, target))
    return march.strides(ray, index, stride, target, transmittance.astype(jnp.float32), first)


@settings(max_examples=30, deadline=None)
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
    march = jv.March(0.5, (Table(jnp.asarray(allowed), jnp.asarray(first)),))

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
        assert (int(found.begin), int(found.stride)) == (begin, stride)
        within = since[0] + since[1] * random.integers(1, RUN)
        if within <= target and within < ends[runs.index(since)]:
            found = strides(within, since[1], target, 1.0)
            ahead = within if since == (begin, stride) else begin
            assert (int(found.begin), int(found.stride)) == (ahead, stride)
    assert int(strides(0, 1, 0, 0.25).stride) == max(
        2**k for k in range(5) if first % (RUN << k) == 0 or k == 0
    )
    for index, _ in runs:  # what became allowed behind something does not reach before it
        assert int(strides(index, 1, index, 0.25).begin) == index


def with_strides(scene):
    volume, transfer, camera, march = scene
    return volume, transfer, camera, jv.March(march.step, (*march.transforms, Patchy()), march.quadrature)


@pytest.mark.parametrize("name", ["moving", *slow("aligned", "jittered")])
def test_strides_are_those_of_the_reference(name):
    scene = with_strides(scene_of(name, "distance"))  # which leaps nearest to what is visible
    volume, transfer, camera, march = scene
    rendering, plain = jv.render(*scene), jv.render(*scene_of(name, "distance"))
    assert int(rendering.samples.sum()) < 0.7 * int(plain.samples.sum())
    without = [t for t in march.transforms if not isinstance(t, jv.SpaceLeaping)]
    counted = jv.March(march.step, tuple(without), march.quadrature, max_samples=128)
    reference = reference_image(volume, transfer, camera, counted)
    unleapt = jv.render(volume, transfer, camera, jv.March(march.step, tuple(without), march.quadrature))
    left = 0.05 if name == "jittered" else 0.0
    compare(unleapt, reference.rgba, np.asarray(reference.samples), tolerance=2e-5, left=left)
    np.testing.assert_allclose(rendering.rgba, unleapt.rgba, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["hierarchy", *slow("distance", "beam")])
@pytest.mark.parametrize("name", ["aligned", *slow("moving")])
def test_leaping_does_not_change_gradients_under_strides(name, method):
    leapt, plain = (with_strides(scene_of(name, m, "float32")) for m in (method, None))
    assert_same(gradient(leapt), gradient(plain), 1e-4)


@pytest.mark.slow
def test_forward_and_replay_gradients_agree_under_strides():
    leapt = with_strides(scene_of("moving", "hierarchy", "float32"))
    assert_slopes(slopes(leapt), gradient(leapt), leapt, 1e-4)


@pytest.mark.slow
def test_gradients_under_strides_are_central_differences():
    """A cell's length is a constant to derivatives; here it changes nowhere between the differences."""
    with in_float64():
        scene = with_strides(scene_of("aligned", None, "float64", "inside"))
        assert_slopes(central(scene), gradient(scene), scene, 1e-5)
