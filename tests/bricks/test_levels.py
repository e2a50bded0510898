"""Is a level of detail no coarser than a pixel?"""

import numpy as np
import pytest

import jaxvol as jv
from jaxvol.bricks import VoxelSource, level_for, levels_of
from jaxvol.bricks.render import _level

from .test_zarr import ome_written, pyramid


N = 32


def levels(count=3):
    """A pyramid of means, each level at the centers of what it averages."""
    found = []
    for k, each in enumerate(pyramid(np.zeros((N, N, N), np.uint8), count)):
        s, first = 2.0**k, (2**k - 1) / 2
        found.append(VoxelSource(each, (s, s, s), (first, first, first)))
    return tuple(found)


def camera(distance, size=(100, 100), **options):
    """Looks along -z at the volume's center; `distance` is from its face."""
    return jv.Camera((15.5, 15.5, 31 + distance), (15.5, 15.5, 0), view_angle=90, size=size, **options)


def test_voxels_are_no_larger_than_a_pixel_at_the_nearest_corner():
    """At 90 degrees, the view is twice as high as its distance."""
    for distance, pixels, expected in (
        (99, 100, 0),
        (101, 100, 1),
        (201, 100, 2),
        (201, 200, 1),
        (900, 100, 2),
    ):
        assert level_for(levels(), camera(distance, (pixels, pixels))) == expected
    assert level_for(levels(), camera(201, (100, 200))) == 1  # the smaller side of a pixel counts
    assert level_for(levels(), camera(-5)) == 0  # from within
    flat = [VoxelSource(np.zeros((N, N // f, N // f), np.uint8), (4.0, f, f)) for f in (1, 2)]
    assert level_for(flat, camera(150)) == 1  # an axis along which levels are as fine does not count
    parallel = camera(9000, parallel_scale=101.0)
    assert level_for(levels(), parallel) == 1
    assert level_for(levels(), parallel.crop(0, 0, 50, 50)) == 1  # pixels are as large


def test_an_image_of_ome_zarr_takes_the_level_of_its_pixels_or_the_one_that_is_asked_for(tmp_path):
    data = np.random.default_rng(0).integers(0, 255, (N, N, N)).astype(np.uint8)
    ome_written(tmp_path / "a.zarr", pyramid(data, 3), "0.5", (1e3, 1e3, 1e3), axes="zyx")  # µm
    found, march = levels_of(tmp_path / "a.zarr"), jv.March(1.0)
    near, far = camera(50), camera(150)
    assert _level(found, "auto", near, march) is found[0]
    assert _level(found, "auto", far, march) is found[1]
    assert _level(found, 2, near, march) is found[2]
    probe = jv.ToroidalMap(20.0, 10.0, (1.1, 2.0), (1.1, 2.0), (5.0, 30.0))
    assert _level(found, "auto", far, jv.March(1.0, (probe,))) is found[0]
    with pytest.raises(ValueError, match=r"level must be an integer from 0 to 0, .*; got 1"):
        _level(found, 1, far, jv.March(1.0, (probe,)))
    with pytest.raises(ValueError, match=r'level must be an integer from 0 to 2, or "auto"; got 3'):
        _level(found, 3, far, march)
