"""Is a level of detail coarse where that cannot be seen, and fine where it can?"""

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


N = 64


def levels(data, spacing=(1.0, 1.0, 1.0), count=3):
    """A pyramid of means, each level at the centers of what it averages."""
    found = []
    for number, each in enumerate(pyramid(data, count)):
        wide = tuple(2**number * s for s in spacing)
        shift = tuple((2**number - 1) / 2 * s for s in spacing)
        found.append(ArraySource(each, wide, shift))
    return tuple(found)


def ball(radius=10, at=(32, 32, 32)):
    grid = np.indices((N, N, N)) - np.reshape(at, (3, 1, 1, 1))
    return np.where(np.linalg.norm(grid, axis=0) < radius, 200, 0).astype(np.uint8)


def transfer(first=50.0, extinction=0.5):
    return jv.TransferFunction([first, first + 50], [[1, 1, 1]] * 2, [0.0, extinction])


def camera(distance, size=(100, 100), **options):
    """Looks along -z at the volume's center; `distance` is from its face."""
    return jv.Camera((31.5, 31.5, 63 + distance), (31.5, 31.5, 0), view_angle=90, size=size, **options)


# ---- size ----


def test_a_pixel_at_the_nearest_face():
    (source,) = levels(ball(), count=1)
    # at 90°, the view is twice as high as its distance
    assert nearest_pixel(source, camera(200)) == pytest.approx(2 * 200 / 100)
    assert nearest_pixel(source, camera(200, size=(100, 400))) == pytest.approx(2 * 200 / 400)
    assert nearest_pixel(source, camera(200).zoom(4)) == pytest.approx(2 * 200 / 400)
    assert nearest_pixel(source, camera(-5)) == 0  # within the volume
    assert nearest_pixel(source, camera(200, parallel_scale=40)) == pytest.approx(2 * 40 / 100)
    away = jv.Camera((31.5, 31.5, 100), (31.5, 31.5, 200))
    assert nearest_pixel(source, away) == np.inf


def test_a_pixel_at_the_nearest_block_that_is_visible():
    (source,) = levels(ball(), count=1)
    summary = scan(source)
    seen = nearest_pixel(source, camera(200), transfer(), summary)
    top = 2 * (200 + 63 - 44) / 100  # the ball's last nodes, at z = 41, lie in the blocks up to 44
    assert seen == pytest.approx(top)
    coarse = nearest_pixel(source, camera(200), transfer(), scan(source, 16))
    assert coarse == pytest.approx(2 * (200 + 63 - 48) / 100)
    assert nearest_pixel(source, camera(200), transfer(210.0), summary) == np.inf
    aside = jv.Camera((31.5, 31.5, 263), (500, 31.5, 263), view_up=(0, 0, 1), view_angle=20)
    assert nearest_pixel(source, aside, transfer(), summary) == np.inf


def test_blocks_beside_the_view_do_not_count():
    data = ball(6, (32, 32, 10)) | ball(6, (56, 56, 56))
    (source,) = levels(data, count=1)
    summary = scan(source)
    wide = nearest_pixel(source, camera(30), transfer(), summary)
    narrow = nearest_pixel(source, camera(30).zoom(10), transfer(), summary)
    assert wide == pytest.approx(2 * (93 - 63) / 100)
    assert narrow == pytest.approx(2 * (93 - 16) / 1000)


@pytest.mark.parametrize("parallel", [False, True])
def test_pixels_are_those_of_the_rays(parallel):
    """The distance between the points where neighbouring rays meet the face."""
    spacing, first = (0.5, 1.5, 1.0), (-3.0, 2.0, 5.0)
    source = ArraySource(ball(), spacing, first)
    for direction in ((0, 0, 1.0), (0, -1.0, 0)):
        view = jv.Camera.looking_at(
            jv.Volume(ball(), spacing, first),
            direction,
            (1, 0, 0),
            parallel=parallel,
            size=(80, 60),
        )
        origin, along = view.ray(40.0, 30.0), view.ray(41.0, 30.0)
        axis = int(np.argmax(np.abs(direction)))
        face = first[axis] + (spacing[axis] * 63 if direction[axis] > 0 else 0)

        def point(ray, axis=axis, face=face):
            start, way = (np.array([float(c) for c in part]) for part in ray)
            return start + way * (face - start[axis]) / way[axis]

        distance = np.linalg.norm(point(along) - point(origin))
        assert nearest_pixel(source, view) == pytest.approx(distance, rel=1e-4)


@pytest.mark.parametrize(("distance", "expected"), [(10, 0), (49, 0), (99, 0), (101, 1), (199, 1), (201, 2)])
def test_voxels_are_not_larger_than_a_pixel(distance, expected):
    found = levels(ball())  # voxels of 1, 2, 4; a pixel is distance / 50
    assert level_for(found, camera(distance)) == expected
    assert level_for(found, camera(distance), pixels=0.5) == max(0, expected - 1)
    assert level_for(found[:1], camera(distance)) == 0


def test_an_axis_that_no_level_refines_does_not_count():
    data = pyramid(ball(), 1)[0]
    same_z = [
        ArraySource(data, (1, 1, 5), (0, 0, 0)),
        ArraySource(data[::2, ::2], (2, 2, 5), (0, 0, 0)),
    ]
    assert (
        level_for(
            same_z, jv.Camera((31.5, 31.5, 63 * 5 + 101), (31.5, 31.5, 0), view_angle=90, size=(100, 100))
        )
        == 1
    )


def test_nothing_visible_needs_no_detail():
    found = levels(ball())
    assert level_for(found, camera(10), transfer(210.0), [scan(found[0])]) == 2


# ---- content ----


def errors(data, function=None, spacing=(1.0, 1.0, 1.0)):
    found = levels(data, spacing)
    summaries = [scan(level) for level in found]
    return [range_error(found, summaries, k, function or transfer()) for k in range(3)]


def test_large_bodies_lose_nothing_and_small_ones_do():
    assert errors(ball(20)) == [0, 0, 0]
    dot = ball(1, (33, 33, 33))  # one voxel
    none, one, two = errors(dot)
    assert none == 0
    # means of 8 and of 64 voxels are 25 and 3, which are transparent: the whole extinction is lost
    assert one == two == pytest.approx(1 - np.exp(-0.5 * 4), rel=1e-5)


def test_the_error_is_the_opacity_of_the_difference():
    data = np.zeros((N, N, N), np.uint8)
    data[28:36, 28:36, 28:36] = 200
    data[10:12, 10:12, 10:12] = 80  # of extinction 0.3, a voxel of level 1, and 10 in level 2
    _, one, two = errors(data)
    assert one == 0
    assert two == pytest.approx(1 - np.exp(-0.3 * 4), rel=1e-5)
    thick = errors(data, spacing=(1.0, 1.0, 3.0))
    assert thick[2] == pytest.approx(1 - np.exp(-0.3 * 12), rel=1e-5)


def test_values_that_a_level_adds_count():
    data = np.zeros((N, N, N), np.uint8)
    data[20:40, 20:40, 20:40] = 1
    found = list(levels(data))
    odd = np.array(found[1]._data)
    odd[3, 3, 3] = 100  # nowhere near this in the finest level
    found[1] = ArraySource(odd, found[1].spacing, found[1].origin)
    assert range_error(found, [scan(level) for level in found], 1, transfer()) == pytest.approx(
        1 - np.exp(-0.5 * 4), rel=1e-5
    )


def test_colors_count_as_extinction_does():
    function = jv.TransferFunction([0, 100, 200], [[0, 0, 0], [0, 0, 0], [1, 0, 0]], [0.5, 0.5, 0.5])
    assert errors(ball(20), function) == [0, 0, 0]
    assert errors(ball(1, (33, 33, 33)), function)[1] == pytest.approx(1 - np.exp(-0.5 * 4), rel=1e-5)


def test_what_the_transfer_function_hides_does_not_count():
    noise = np.random.default_rng(0).integers(0, 40, (N, N, N)).astype(np.uint8)
    assert errors(noise) == [0, 0, 0]
    assert errors(noise, transfer(10.0))[1] > 0.1


def test_unknown_variation_is_the_greatest_error():
    class Unknown(Transfer):
        def classifier(self):
            return lambda measured: ((measured[0],) * 3, measured[0])

    assert errors(ball(1, (33, 33, 33)), Unknown()) == [0, 1, 1]
    by_gradient = jv.TransferFunction2D([0, 255], [0, 300], np.ones((2, 2, 3)), np.ones((2, 2)))
    assert errors(ball(20), by_gradient) == [0, 1, 1]


def test_tolerance_chooses_the_coarsest_level_within_it():
    data = np.zeros((N, N, N), np.uint8)
    data[28:36, 28:36, 28:36] = 200
    data[10:12, 10:12, 10:12] = 60  # of extinction 0.1
    found = levels(data)
    summaries = [scan(level) for level in found]
    error = 1 - np.exp(-0.1 * 4)
    for tolerance, expected in ((error * 0.9, 1), (error * 1.1, 2)):
        assert level_for(found, camera(-5), transfer(), summaries, tolerance=tolerance) == expected


def test_levels_of_other_cells_and_of_ome_zarr(tmp_path):
    data = ball(20)
    ome_written(tmp_path, pyramid(data, 3), "0.5", spacing=(1.0, 1.0, 1.0))
    found = levels_of(tmp_path)
    for cell in (4, 8):
        summaries = [scan(level, cell) for level in found]
        assert [range_error(found, summaries, k, transfer()) for k in range(3)] == [0, 0, 0]
    assert level_for(found, camera(101)) == 1


def test_a_real_volume_has_errors_that_grow_with_what_averaging_removes(real_volume):
    data = np.asarray(jv.load(real_volume("tooth_103x94x161_uint8.raw")).data)
    found = levels(data)
    summaries = [scan(level) for level in found]
    opaque = transfer(120.0)
    values = [range_error(found, summaries, k, opaque) for k in range(3)]
    assert 0 == values[0] < values[1] < values[2] < 1
    assert jnp.isfinite(values[2])


def test_arguments_that_miss_are_named():
    found = levels(ball())
    with pytest.raises(ValueError, match="tolerance needs a transfer function and one summary for each of 3"):
        level_for(found, camera(5), transfer(), [scan(found[0])], tolerance=0.1)
    with pytest.raises(ValueError, match="tolerance must be"):
        level_for(found, camera(5), transfer(), [scan(each) for each in found], tolerance=2.0)
    with pytest.raises(ValueError, match="pixels must be"):
        level_for(found, camera(5), pixels=0.0)
    with pytest.raises(ValueError, match="levels must have spacing and origin; level 1"):
        level_for([found[0], ArraySource(ball())], camera(5))


def test_a_level_and_a_tolerance_exclude_each_other(tmp_path):
    ome_written(tmp_path, pyramid(ball(20), 2), "0.5", spacing=(1.0, 1.0, 1.0))
    for level in (0, 1):
        with pytest.raises(
            ValueError, match=rf"tolerance chooses a level, and level={level} is one.*got toler"
        ):
            jv.render_bricks(tmp_path, transfer(), camera(101), jv.March(1.0), level=level, tolerance=0.1)


def test_under_a_toroidal_map_the_level_is_the_finest(tmp_path):
    """The map's ranges are those of the finest level's nodes."""
    ome_written(tmp_path, pyramid(ball(20), 3), "0.5", spacing=(1.0, 1.0, 1.0))
    far, march = camera(1001), jv.March(1.0, (jv.ToroidalMap(10, 20, (1, 2), (1, 2), (0, 60)),))
    given = levels_of(tmp_path), "auto", far, transfer()
    assert _level(*given, jv.March(1.0), None, 2**28, None).shape == (16, 16, 16)
    assert _level(*given, march, None, 2**28, None).shape == (64, 64, 64)
    assert _level(*given, march, 0.5, 2**28, None).shape == (64, 64, 64)
    with pytest.raises(ValueError, match=r"level must be 0 under a ToroidalMap.*got 1"):
        jv.render_bricks(tmp_path, transfer(), far, march, level=1)
