"""Does an independent path tracer compute the same light? Mitsuba's `volpath`, on the head phantom.

The media are equal up to rounding: Mitsuba interpolates grids of extinction and albedo trilinearly between
our nodes, and our extinction and albedo are linear in the trilinear value.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.lighting import ConstantLight, DirectionalLight

from .scenes import slow


mi: Any = pytest.importorskip("mitsuba", reason="mitsuba is not installed: pip install jaxvol[peers]")

SIZE = 24
DENSE = 12.0
"""Extinction at the largest value, 1/length; the head is 1.7 lengths high."""
DARK, BRIGHT = np.array([0.95, 0.6, 0.4]), np.array([0.7, 0.9, 0.99])
"""Albedo at the values 0 and 255."""
POSITION, VIEW_UP, ANGLE = (1.5, -3.0, 1.2), (0.3, 0.1, 1.0), 34.0
SUN, IRRADIANCE, SKY = (-0.3, 1.0, -0.6), (6.0, 8.0, 10.0), (0.3, 0.2, 0.1)


@pytest.fixture(scope="module", autouse=True)
def variant():
    """Use the LLVM variant if LLVM is available, else the scalar one, which always is."""
    dr: Any = pytest.importorskip("drjit")

    mi.set_variant("llvm_ad_rgb" if dr.has_backend(dr.JitBackend.LLVM) else "scalar_rgb")


def by_mitsuba(volume: jv.Volume, anisotropy: float, samples: int, seed: int) -> np.ndarray:
    """Mitsuba's image, with samples at random positions in each pixel and the sky as background."""
    place = mi.ScalarTransform4f
    low, high = (corner.tolist() for corner in volume.corners)
    # its voxels are cell centres, ours are nodes: its grid extends half a cell farther
    half = np.asarray(volume.spacing, float) / 2
    start, end = np.asarray(low) - half, np.asarray(high) + half
    to_grid = place().translate(start.tolist()).scale((end - start).tolist())
    share = np.asarray(volume.data, np.float32).transpose(2, 1, 0)[..., None] / 255

    def grid(values: np.ndarray) -> dict[str, Any]:
        tensor = mi.VolumeGrid(np.ascontiguousarray(values, np.float32))
        return {"type": "gridvolume", "grid": tensor, "to_world": to_grid, "raw": True, "wrap_mode": "clamp"}

    middle, extent = (np.asarray(low) + high) / 2, (np.asarray(high) - low) / 2
    fields = {"width": SIZE, "height": SIZE, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    media = {
        "sigma_t": grid(share * DENSE),
        "albedo": grid(DARK + share * (BRIGHT - DARK)),
        "phase": {"type": "hg", "g": anisotropy},
    }
    things = {
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": -1, "rr_depth": 64},
        "sensor": {
            "type": "perspective",
            "fov": ANGLE,
            "fov_axis": "y",
            "to_world": place().look_at(origin=POSITION, target=middle.tolist(), up=VIEW_UP),
            "film": {"type": "hdrfilm", **fields},
            "sampler": {"type": "independent"},
        },
        "sun": {"type": "directional", "direction": SUN, "irradiance": {"type": "rgb", "value": IRRADIANCE}},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": SKY}},
        "head": {
            "type": "cube",
            "to_world": place().translate(middle.tolist()).scale(extent.tolist()),
            "bsdf": {"type": "null"},
            "interior": {"type": "heterogeneous", **media},
        },
    }
    scene = mi.load_dict(things)
    return np.array(mi.render(scene, spp=samples, seed=seed))


@pytest.mark.parametrize("anisotropy", [0.6, *slow(0.0)])
def test_the_head_is_lit_as_by_mitsuba(anisotropy):
    volume = jv.phantom("head", 32)
    transfer = jv.TransferFunction([0, 255], np.stack([DARK, BRIGHT]), [0, DENSE])
    camera = jv.Camera(POSITION, volume.center, VIEW_UP, ANGLE, size=(SIZE, SIZE))
    lights = DirectionalLight(SUN, IRRADIANCE), ConstantLight(SKY)
    how: Any = {"paths": 256, "anisotropy": anisotropy, "antialias": True}
    ours = jv.path_trace(volume, transfer, camera, lights, **how)
    # Mitsuba's standard error, estimated from images of several seeds
    theirs = np.stack([by_mitsuba(volume, anisotropy, samples=64, seed=seed) for seed in range(8)])

    def regions(image: Any) -> np.ndarray:
        return np.asarray(image, float).reshape(6, SIZE // 6, 6, SIZE // 6, 3).mean(axis=(1, 3))

    mine, sky, met = regions(ours.image(jnp.asarray(SKY))), np.asarray(SKY), ours.opacity[..., None]
    # with the noise of the opacity; a path that meets nothing has radiance 0, so means tell the covariance
    behind = sky * (1 - met) * (sky * met - 2 * ours.radiance) / (ours.paths - 1)
    variance = regions(jnp.square(ours.standard_error) + behind) / (SIZE // 6) ** 2
    each = np.stack([regions(image) for image in theirs])
    # a variance from 8 images is too noisy: bound it below by ours, scaled by the median ratio of all regions
    of_8 = each.var(axis=0, ddof=1) / 8
    pooled = np.maximum(of_8, variance * np.median(of_8[variance > 0] / variance[variance > 0]))
    z = (mine - each.mean(axis=0)) / np.sqrt(np.maximum(variance + pooled, 1e-12))
    assert mine[2:4, 2:4].min() > 0.05
    assert np.ptp(mine[..., 0]) > 0.03
    assert abs(z).max() < 3.5
    assert abs(mine.mean() - each.mean()) < 3 * np.sqrt((variance + pooled).mean() / 36 * 3)
