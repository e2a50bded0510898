"""Do `render`, the reference engine and an independent float64 marcher give the same image?"""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv

from . import oracle
from .scenes import CAMERAS, FEW, TRANSFORMS, VOLUMES, in_float64, slow, soft_transfer, to_float64


STEP = 0.07


def oracle_image(volume, transfer, camera, march):
    """Image and numbers of samples by the independent marcher, for the camera's rays."""
    origins, directions = camera.rays()
    kinds = {type(t): t for t in march.transforms}
    ending, jitter, jump = (kinds.get(t) for t in (jv.EarlyTermination, jv.Jitter, jv.EmptySpaceJitter))
    rgba, samples = oracle.march(
        volume.data,
        volume.spacing,
        volume.origin,
        (transfer.values, transfer.colors, transfer.extinction),
        origins,
        directions,
        float(march.step),
        quadrature=march.quadrature,
        align=jv.AlphaCorrection in kinds,
        opacity_left=None if ending is None else float(ending.opacity_left),
        start=0.0 if jitter is None else random_numbers(jitter, camera),
        front_residual=jitter is not None and jitter.front_residual,
        empty_jump=None if jump is None else random_numbers(jump, camera),
        **clipped_by(kinds.get(jv.Clip)),
    )
    shape = origins.shape[:-1]
    return rgba.reshape(*shape, 4), samples.reshape(shape)


def clipped_by(clip):
    """Arguments of the independent marcher for a `Clip`, or None."""
    if clip is None:
        return {}
    planes = oracle.planes_of(clip.box, zip(clip.origins, clip.normals, strict=True))
    return {"planes": planes, "inside_out": clip.inside_out}


def random_numbers(transform, camera):
    """The transform's random number for every pixel, row by row."""
    width, height = camera.size
    row, column = (jnp.asarray(index.reshape(-1), jnp.int32) for index in np.mgrid[:height, :width])
    numbers = jax.vmap(lambda c, r: transform.noise((c, r), jnp.float32))(column, row)
    return np.asarray(numbers, np.float64)


def compare(rendering, rgba, samples, *, tolerance, left=0.0):
    """Assert agreement within the tolerance in pixels with equal numbers of samples. Where rounding changes
    the number, by at most one, the images may differ by `left`, the contribution of that sample."""
    off = np.abs(np.asarray(rendering.rgba) - rgba).max(axis=-1)
    moved = np.asarray(rendering.samples) != samples
    assert np.abs(np.asarray(rendering.samples) - samples).max() <= 1
    assert moved.mean() < 0.01
    assert off[~moved].max() <= tolerance
    assert not moved.any() or off[moved].max() <= max(left, tolerance)


@eqx.filter_jit
def reference_image(volume, transfer, camera, march):
    """Render every pixel with the reference engine."""

    def one(column, row):
        origin, direction = (jnp.stack(part) for part in camera.ray(column, row))
        return jv.render_ray_reference(volume, transfer, origin, direction, march, pixel=(column, row))

    width, height = camera.size
    across = jax.vmap(one, in_axes=(0, None))
    return jax.vmap(across, in_axes=(None, 0))(jnp.arange(width), jnp.arange(height))


FAST = {
    *((name, "left") for name in ("plain", "aligned", "jittered")),
    *((name, "midpoint") for name in FEW[2:4]),
    (FEW[4], "left"),
    (FEW[5], "midpoint"),
    (FEW[2], "preintegrated"),
}
"""Cases of the fast run, which cover every transform; the slow run adds the others."""

CASES = [
    pytest.param(*case, marks=[] if case in FAST else pytest.mark.slow)
    for case in (
        *((name, "left") for name in TRANSFORMS),
        *itertools.product(FEW, ("midpoint", "preintegrated")),
    )
]


@pytest.mark.parametrize(("transforms", "quadrature"), CASES)
def test_render_agrees_with_the_independent_marcher(transforms, quadrature):
    march = jv.March(STEP, TRANSFORMS[transforms], quadrature)
    left = 0.05 if "terminated" in transforms else 0.0
    transfer = soft_transfer()
    # parallel rays need programs of their own: two sets are enough for them
    views = [view for name, view in CAMERAS.items() if name != "orthographic" or transforms in FEW[1:3]]
    for volume in (make() for make in VOLUMES.values()):
        for view in views:
            camera = view(volume)
            rendering = jv.render(volume, transfer, camera, march)
            compare(rendering, *oracle_image(volume, transfer, camera, march), tolerance=2e-5, left=left)


SECOND_ORDER = pytest.mark.parametrize(
    ("transforms", "quadrature"),
    [
        *((FEW[2], quadrature) for quadrature in ("midpoint", "preintegrated")),
        *slow(*itertools.product([*FEW[:2], *FEW[3:]], ("midpoint", "preintegrated"))),
    ],
)


@SECOND_ORDER
def test_render_agrees_with_the_reference(transforms, quadrature):
    march = jv.March(STEP, TRANSFORMS[transforms], quadrature)
    counted = jv.March(STEP, TRANSFORMS[transforms], quadrature, max_samples=80)
    left = 0.05 if "terminated" in transforms else 0.0
    transfer = soft_transfer()
    for volume in (make() for make in VOLUMES.values()):
        for view in CAMERAS.values():
            camera = view(volume)
            rendering = jv.render(volume, transfer, camera, march)
            reference = reference_image(volume, transfer, camera, counted)
            assert not np.any(reference.exhausted)
            compare(rendering, reference.rgba, np.asarray(reference.samples), tolerance=2e-5, left=left)
            np.testing.assert_array_equal(rendering.aligned, reference.aligned)


@SECOND_ORDER
def test_float64_reference_agrees_with_the_independent_marcher_to_rounding(transforms, quadrature):
    with in_float64():
        march = to_float64(jv.March(STEP, TRANSFORMS[transforms], quadrature, max_samples=80))
        transfer = to_float64(soft_transfer())
        for make in VOLUMES.values():
            volume = to_float64(make())
            camera = to_float64(CAMERAS["around"](volume))
            reference = reference_image(volume, transfer, camera, march)
            assert reference.rgba.dtype == jnp.float64
            rgba, samples = oracle_image(volume, transfer, camera, march)
            np.testing.assert_array_equal(reference.samples, samples)
            np.testing.assert_allclose(reference.rgba, rgba, atol=1e-12, rtol=0)


@pytest.mark.parametrize(
    ("file", "spacing", "points"),
    [
        ("engine_256x256x128_uint8.raw.gz", (1, 1, 1), [(50, 0.0), (120, 0.05), (255, 0.3)]),
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
    volume = jv.load(real_volume(file), spacing=spacing)
    colors = [(0.2, 0.1, 0.1), (0.8, 0.5, 0.3), (1.0, 1.0, 1.0)]
    transfer = jv.TransferFunction.from_points(
        [(value, color, opacity) for (value, opacity), color in zip(points, colors, strict=True)]
    )
    camera = CAMERAS["around"](volume, (40, 40))
    march = jv.March(0.8, (jv.AlphaCorrection(),), "left")
    rendering = jv.render(volume, transfer, camera, march)
    assert float(rendering.rgba[..., 3].max()) > 0.5
    # 300 voxels behind the entry, float32 resolves 3e-5 voxels, and neighbouring voxels differ by thousands
    compare(rendering, *oracle_image(volume, transfer, camera, march), tolerance=3e-5)
