"""Is a level of detail coarse where that cannot be seen, and fine where it can?"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.bricks.detail import level_for, nearest_pixel, range_error
from jaxvol.bricks.opening import levels_of
from jaxvol.bricks.render import _level
from jaxvol.bricks.sources import ArraySource
from jaxvol.bricks.summary import scan
from jaxvol.transfer import Transfer

from .test_zarr import ome_written, pyramid


N = 32


def levels(data, count=3):
    """A pyramid of means, each level at the centers of what it averages."""
    found = []
    for k, each in enumerate(pyramid(data, count)):
        s, first = 2.0**k, (2**k - 1) / 2
        found.append(ArraySource(each, (s, s, s), (first, first, first)))
    return tuple(found)


def ball(radius=10, at=(16, 16, 16)):
    offsets = np.indices((N, N, N)) - np.reshape(at, (3, 1, 1, 1))
    return np.where(np.linalg.norm(offsets, axis=0) < radius, 200, 0).astype(np.uint8)


class OneProgram(jv.TransferFunction):
    """Compiles one program for each question, and not one for each operation."""

    def visible(self, blocks):
        return eqx.filter_jit(jv.TransferFunction.visible)(self, blocks)

    def variation(self, windows):
        return eqx.filter_jit(jv.TransferFunction.variation)(self, windows)


def transfer(first=50.0, extinction=0.5):
    values, extinctions = jnp.asarray([first, first + 50]), jnp.asarray([0.0, extinction])
    return OneProgram(values, jnp.ones((2, 3)), extinctions)


def camera(distance, size=(100, 100), **options):
    """Looks along -z at the volume's center; `distance` is from its face."""
    return jv.Camera((15.5, 15.5, 31 + distance), (15.5, 15.5, 0), view_angle=90, size=size, **options)


def test_a_pixel_at_the_nearest_face_or_at_what_is_visible_in_the_view():
    (source,) = levels(ball(5), count=1)
    # at 90°, the view is twice as high as its distance
    assert nearest_pixel(source, camera(200)) == pytest.approx(2 * 200 / 100)
    assert nearest_pixel(source, camera(200, size=(100, 400))) == pytest.approx(2 * 200 / 400)
    assert nearest_pixel(source, camera(-5)) == 0  # within the volume
    assert nearest_pixel(source, camera(200, parallel_scale=40)) == pytest.approx(2 * 40 / 100)
    summary = scan(source)
    # the ball's last nodes, at z = 20, lie in the blocks up to 24
    assert nearest_pixel(source, camera(200), transfer(), summary) == pytest.approx(2 * (200 + 31 - 24) / 100)
    assert nearest_pixel(source, camera(200), transfer(210.0), summary) == np.inf
    (source,) = levels(ball(4, (16, 16, 6)) | ball(4, (27, 27, 27)), count=1)
    wide, narrow = (
        nearest_pixel(source, c, transfer(), scan(source)) for c in (camera(30), camera(30).zoom(10))
    )
    assert wide == pytest.approx(2 * 30 / 100)
    assert narrow == pytest.approx(2 * (61 - 12) / 1000)


@pytest.mark.parametrize(("distance", "expected"), [(10, 0), (99, 0), (101, 1), (199, 1), (201, 2)])
def test_voxels_are_not_larger_than_a_pixel(distance, expected):
    found = levels(ball())  # voxels of 1, 2, 4; a pixel is distance / 50
    assert level_for(found, camera(distance)) == expected
    assert level_for(found, camera(distance), pixels=0.5) == max(0, expected - 1)
    # an axis that no level refines does not count
    coarse = [ArraySource(found[0]._data[::s, ::s], (s, s, 5), (0, 0, 0)) for s in (1, 2)]
    away = jv.Camera((15.5, 15.5, 31 * 5 + distance), (15.5, 15.5, 0), view_angle=90, size=(100, 100))
    assert level_for(coarse, away) == min(expected, 1)


class Unknown(Transfer):
    def classifier(self):
        return lambda measured: ((measured[0],) * 3, measured[0])


def test_a_tolerance_chooses_the_coarsest_level_that_loses_and_adds_no_more():
    data = np.zeros((2 * N, 2 * N, 2 * N), np.uint8)
    data[28:36, 28:36, 28:36] = 200
    data[10:12, 10:12, 10:12] = 60  # of extinction 0.1, a voxel of level 1, and 7 in level 2
    found = levels(data)
    summaries, error = [scan(level) for level in found], 1 - np.exp(-0.1 * 4)
    errors = [range_error(found, summaries, k, transfer()) for k in range(3)]
    assert errors[:2] == [0, 0]
    assert errors[2] == pytest.approx(error, rel=1e-5)
    for tolerance, expected in ((error * 0.9, 1), (error * 1.1, 2)):
        assert level_for(found, camera(-5), transfer(), summaries, tolerance=tolerance) == expected
    odd = np.array(found[1]._data)
    odd[26, 3, 3] = 100  # nowhere near this in the finest level
    added = [found[0], ArraySource(odd, found[1].spacing, found[1].origin), found[2]]
    found_there = range_error(added, [summaries[0], scan(added[1]), summaries[2]], 1, transfer())
    assert found_there == pytest.approx(1 - np.exp(-0.5 * 4), rel=1e-5)
    by_gradient = jv.TransferFunction2D([0, 255], [0, 300], jnp.ones((2, 2, 3)), jnp.ones((2, 2)))
    for unknown in (Unknown(), by_gradient):
        assert range_error(found, summaries, 2, unknown) == 1


def test_arguments_that_miss_are_named():
    found = levels(ball())
    for given, options, message in (
        (found, {"tolerance": 0.1}, "tolerance needs a transfer function and one summary for each of 3"),
        (found, {"tolerance": 2.0}, "tolerance must be"),
        (found, {"pixels": 0.0}, "pixels must be"),
        ([found[0], ArraySource(ball())], {}, "levels must have spacing and origin; level 1"),
    ):
        with pytest.raises(ValueError, match=message):
            level_for(given, camera(5), transfer(), [scan(found[0])], **options)


def test_under_a_toroidal_map_the_level_is_the_finest(tmp_path):
    """The map's ranges are those of the finest level's nodes."""
    ome_written(tmp_path, pyramid(ball(), 3), "0.5", spacing=(1.0, 1.0, 1.0))
    far, march = camera(1001), jv.March(1.0, (jv.ToroidalMap(10, 20, (1, 2), (1, 2), (0, 60)),))
    given = levels_of(tmp_path), "auto", far, transfer()
    assert _level(*given, jv.March(1.0), None, 2**28, None).shape == (8, 8, 8)
    for tolerance in (None, 0.5):
        assert _level(*given, march, tolerance, 2**28, None).shape == (N, N, N)
    with pytest.raises(ValueError, match=r"level must be 0 under a ToroidalMap.*got 1"):
        jv.render_bricks(tmp_path, transfer(), far, march, level=1)
