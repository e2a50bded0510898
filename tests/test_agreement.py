"""Do the fast engine, the reference and an independent marcher in float64 show the same, whatever transforms
are given?"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

import jaxvol as jv

from .scenes import (
    CAMERAS,
    QUADRATURES,
    VOLUMES,
    around,
    in_float64,
    reference_image,
    rendered,
    slow,
    soft_transfer,
    to_float64,
)
from .transforms import MOST, OTHERS, SUBSETS, oracle_image, plain, switched


SCENES = {
    "seed": st.integers(0, 2**32 - 1),
    "step": st.floats(0.06, 0.3),
    "volume": st.sampled_from(sorted(VOLUMES)),
    "view": st.sampled_from(["around", "inside"]),
    "left": st.floats(0.01, 0.5),
}


@pytest.mark.parametrize(
    ("quadrature", "without"), [*((q, ("hollow",)) for q in QUADRATURES), *slow(("midpoint", ()))]
)
def test_every_subset_of_transforms_means_the_same_in_both_engines_and_to_an_independent_marcher(
    quadrature, without
):
    """In float64, where rounding decides of no sample. A clip that is inside out doubles the time to
    compile."""

    @settings(max_examples=10)
    @given(on=SUBSETS, **SCENES)
    @example(on=MOST, seed=1, step=0.1, volume="noise", view="around", left=0.05)
    @example(on=OTHERS, seed=2, step=0.2, volume="sphere", view="inside", left=0.05)
    def check(on, seed, step, volume, view, left):
        with in_float64():
            volume, transfer = to_float64(VOLUMES[volume]()), to_float64(soft_transfer())
            camera, values = to_float64(CAMERAS[view](volume)), {"seed": seed, "left": left}

            def march(transforms, most=None):
                return to_float64(jv.March(step, transforms, quadrature, max_samples=most))

            scene = volume, transfer, camera
            on = on.difference(without)
            rgba, samples = oracle_image(*scene, march(plain(on, **values)))
            all_of_them = switched(on, without, **values)
            fast = rendered(*scene, march(all_of_them))
            assert fast.rgba.dtype == jnp.float64
            np.testing.assert_allclose(fast.rgba, rgba, atol=1e-10, rtol=0)
            reference = reference_image(*scene, march(all_of_them, 80))
            assert not np.asarray(reference.exhausted).any()
            np.testing.assert_allclose(reference.rgba, rgba, atol=1e-10, rtol=0)
            np.testing.assert_array_equal(reference.samples, samples)
            np.testing.assert_array_equal(fast.aligned, reference.aligned)
            assert "leaping" in on or np.array_equal(fast.samples, samples)

    check()


@pytest.mark.parametrize("quadrature", ["midpoint", "preintegrated"])
def test_in_float32_a_thin_peak_magnifies_what_is_rounded_by_its_slope(quadrature):
    """So do leaps and crops, whose values and rays are rounded anew; other transfer functions are in
    `test_every_subset...`."""

    @eqx.filter_jit
    def images(volume, transfer, camera, march):
        leaping = eqx.tree_at(lambda m: m.transforms, march, (*march.transforms, jv.SpaceLeaping()))
        crop = jv.render(volume, transfer, camera.crop(7, 3, 9, 10), leaping)
        return [jv.render(volume, transfer, camera, each).rgba for each in (march, leaping)], crop.rgba

    @settings(max_examples=20)
    @given(at=st.floats(0.2, 0.8), log_width=st.floats(-5, -1), log_top=st.floats(0, 2), **SCENES)
    def check(at, log_width, log_top, seed, step, volume, view, left):
        volume, width, top = VOLUMES[volume](), 10**log_width, 10**log_top
        values, colors = np.array([at - width, at, at + width], np.float32), np.eye(3, dtype=np.float32)
        transfer = jv.TransferFunction(values, colors, np.array([0, top, 0], np.float32))
        camera, transforms = CAMERAS[view](volume), (jv.Jitter(seed), jv.AlphaCorrection())
        march = jv.March(np.float32(step), transforms, quadrature)
        (whole, leapt), part = jax.device_get(images(volume, transfer, camera, march))
        rgba, _ = oracle_image(volume, transfer, camera, march)
        rounded = {"rtol": 0, "atol": 2e-5 + 1e-5 * top / width * step}
        np.testing.assert_allclose(whole, rgba, **rounded)
        np.testing.assert_allclose(leapt, whole, **rounded)
        np.testing.assert_allclose(part, leapt[3:13, 7:16], **rounded)

    check()


@pytest.mark.parametrize(
    ("file", "spacing", "points"),
    [
        pytest.param(
            "engine_256x256x128_uint8.raw.gz",
            (1, 1, 1),
            [(50, 0.0), (120, 0.05), (255, 0.3)],
            marks=pytest.mark.slow,
        ),
        (
            "lidc0314_airway_256x192x200_int16le.raw.gz",
            (0.78125, 0.78125, 1),
            [(-600, 0.0), (0, 0.05), (1500, 0.3)],
        ),
        pytest.param(
            "cthead_256x256x113_uint16le.raw.gz",
            (1, 1, 2),
            [(300, 0.0), (1000, 0.02), (3000, 0.3)],
            marks=pytest.mark.slow,
        ),
    ],
)
def test_real_volumes_agree_with_the_independent_marcher(real_volume, file, spacing, points):
    """In their own types, in float32, by the usual transforms."""
    volume = jv.load(real_volume(file), spacing=spacing)
    colors = [(0.2, 0.1, 0.1), (0.8, 0.5, 0.3), (1.0, 1.0, 1.0)]
    transfer = jv.TransferFunction.from_points(
        [(value, color, opacity) for (value, opacity), color in zip(points, colors, strict=True)]
    )
    camera = around(volume, (40, 40))
    march = jv.March(0.8, (jv.EmptySpaceJitter(1), jv.AlphaCorrection(), jv.SpaceLeaping()))
    rendering = jv.render(volume, transfer, camera, march)
    assert np.asarray(rendering.rgba)[..., 3].max() > 0.5
    rgba, _ = oracle_image(volume, transfer, camera, march)
    off = np.abs(np.asarray(rendering.rgba) - rgba).max(axis=-1)
    # 300 voxels behind the entry, float32 resolves 3e-5 voxels, and neighbouring voxels differ by thousands.
    # A ray that grazes what is transparent may shift at another sample
    assert np.mean(off > 3e-5) < 0.005
    np.testing.assert_array_equal(rendering.exhausted, False)
