"""Does a transfer function that is guessed from a histogram show what is there?"""

import itertools

import jax
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import jaxvol as jv
from jaxvol.app.automatic import (
    INSIDE,
    is_body,
    labels_if_any,
    preset_unit,
    range_of_object,
    spread_of,
    thresholds,
)
from jaxvol.app.commands.animate import turned
from jaxvol.app.framing import MARGIN, clipped_points, framed, visible_points
from jaxvol.lighting import Phong


MARCH = (jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination())


def ball(radius, inner, n=32, *, noise=2.0, spacing=1.0, at=0.0):
    """A ball of value 100 around a dense one of value 200, in noise around 10."""
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij")
    r = np.sqrt((x - at) ** 2 + y**2 + z**2)
    data = (
        10 + 90 * np.clip((radius - r) * n / 4 + 0.5, 0, 1) + 100 * np.clip((inner - r) * n / 4 + 0.5, 0, 1)
    )
    rng = np.random.default_rng(0)
    return jv.Volume(
        (data + noise * rng.standard_normal(data.shape)).clip(0, 255).astype(np.uint8), [spacing] * 3
    )


def opacity_at(transfer, value, length):
    return float(-np.expm1(-length * np.interp(value, transfer.values, transfer.extinction)))


def test_thresholds_part_three_classes():
    values = np.concatenate([np.full(900, 10.0), np.full(80, 100.0), np.full(20, 200.0)]).astype(np.float32)
    values += np.random.default_rng(0).normal(0, 3, values.shape).astype(np.float32)
    first, second = thresholds(values)
    assert first == pytest.approx(55, abs=2)  # in the middle, wherever between them
    assert second == pytest.approx(150, abs=2)


def test_what_is_around_is_transparent_and_what_is_dense_opaque():
    volume = ball(0.8, 0.35)
    transfer = jv.automatic_transfer(volume)
    across = float(np.linalg.norm(np.subtract(*map(np.asarray, volume.corners))))
    assert opacity_at(transfer, 10, across) == 0
    assert 0.2 < opacity_at(transfer, 100, 0.2 * across) < 0.95  # what is inside shines through
    assert opacity_at(transfer, 200, 0.1 * across) > 0.9


@pytest.mark.slow
def test_a_picture_shows_what_is_dense_through_what_is_around_it():
    volume = ball(0.8, 0.35)
    transfer, camera = jv.automatic_transfer(volume), jv.Camera.looking_at(volume, size=(32, 32))
    rgba = np.asarray(
        jv.render(volume, transfer, camera, jv.March(0.4, MARCH, "midpoint"), lighting=Phong()).rgba
    )
    assert rgba[0, 0, 3] == 0
    assert rgba[16, 16, 3] > 0.95
    assert 0.1 < (rgba[..., 3] > 0.1).mean() < 0.5
    # the dense ball is brighter than what is around it
    assert rgba[16, 16, :3].mean() > 1.3 * np.median(rgba[..., :3].mean(-1)[rgba[..., 3] > 0.1])


def test_units_of_length_and_of_values_do_not_matter():
    volume, scaled = ball(0.8, 0.35), ball(0.8, 0.35, spacing=20.0)
    scaled = jv.Volume(np.asarray(scaled.data, np.float32) * 1000 - 7, scaled.spacing)
    one, other = jv.automatic_transfer(volume), jv.automatic_transfer(scaled)
    np.testing.assert_allclose(np.asarray(one.values) * 1000 - 7, other.values, rtol=0.02)
    np.testing.assert_allclose(one.extinction, 20 * np.asarray(other.extinction), rtol=1e-4)


def test_an_object_that_the_faces_cut_is_no_block_and_few_values_are_shown_too():
    volume = ball(3.0, 0.35)
    transfer = jv.automatic_transfer(volume)
    across = float(np.linalg.norm(np.subtract(*map(np.asarray, volume.corners))))
    assert opacity_at(transfer, 100, across) < 0.5
    assert opacity_at(transfer, 200, 0.1 * across) > 0.9
    for kinds in (1, 2, 3):
        data = (np.arange(27) % kinds).astype(np.uint8).reshape(3, 3, 3)
        extinction = np.asarray(jv.automatic_transfer(jv.Volume(data)).extinction)
        assert np.isfinite(extinction).all()
        assert extinction.max() > 0


def test_what_is_no_volume_or_a_traced_one_is_refused():
    with pytest.raises(ValueError, match="volume must be a jaxvol Volume"):
        jv.automatic_transfer(np.zeros((3, 3, 3)))
    volume = jv.phantom("head", 16)
    transfer = jv.automatic_transfer(volume)
    with pytest.raises(ValueError, match="automatic_transfer needs numbers, and some"):
        jax.jit(jv.automatic_transfer)(volume)
    with pytest.raises(ValueError, match="automatic_camera needs numbers"):
        jax.jit(lambda angle: jv.automatic_camera(volume, transfer, view_angle=angle))(30.0)
    camera = jax.jit(lambda _: jv.automatic_camera(volume, transfer).position)(0.0)
    np.testing.assert_allclose(camera, jv.automatic_camera(volume, transfer).position, rtol=1e-6)
    found, inside = jv.automatic_transfer(volume), jax.jit(lambda _: jv.automatic_transfer(volume))(0.0)
    np.testing.assert_array_equal(found.extinction, inside.extinction)
    np.testing.assert_array_equal(found.colors, inside.colors)


def extent(points):
    low, high = points.min(axis=0), points.max(axis=0)
    return (low + high) / 2, high - low


def test_the_points_are_around_what_is_visible():
    volume = ball(0.3, 0.15, at=0.5)
    points = visible_points(volume, jv.automatic_transfer(volume))
    middle, size = extent(points)
    np.testing.assert_allclose(middle / 31 * 2 - 1, (0.5, 0, 0), atol=0.06)
    assert (size / 31 * 2 > 0.55).all()
    assert (size / 31 * 2 < 0.85).all()
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    turned = jv.Volume(volume.data, volume.spacing, (5, 6, 7), direction=turn)
    there, _ = extent(visible_points(turned, jv.automatic_transfer(volume)))
    np.testing.assert_allclose(there, turn @ middle + (5, 6, 7), atol=1e-4)


def test_specks_far_away_do_not_count_and_parts_that_are_near_do():
    data = np.array(ball(0.3, 0.15, at=0.5).data)
    volume = jv.Volume(data)
    transfer = jv.automatic_transfer(volume)
    middle, size = extent(visible_points(volume, transfer))
    data[1, 1, 1] = data[1, 30, 30] = 200
    specks = extent(visible_points(jv.Volume(data), transfer))
    np.testing.assert_array_equal(specks, (middle, size))
    data[12:19:2, 16, 16] = 200  # with one voxel between them, like leaves
    _, longer = extent(visible_points(jv.Volume(data), transfer))
    assert longer[0] >= size[0] + 5
    flat = np.full((9, 9, 9), 10, np.uint8)
    flat[4] = 200
    shown = jv.TransferFunction([10, 200], np.ones((2, 3)), [0, 99])
    np.testing.assert_array_equal(extent(visible_points(jv.Volume(flat), shown))[1], (2, 8, 8))
    hidden = jv.TransferFunction([0, 1], np.zeros((2, 3)), np.zeros(2))
    np.testing.assert_array_equal(extent(visible_points(volume, hidden))[1], (31, 31, 31))


def in_picture(camera, points):
    """Image coordinates of points, in units of half the picture's height and width."""
    away = np.asarray(camera.position) - np.asarray(camera.focal_point)
    back = away / np.linalg.norm(away)
    right = np.cross(camera.view_up, back)
    right /= np.linalg.norm(right)
    offset = points - np.asarray(camera.position)
    plane = np.stack([offset @ right, offset @ np.cross(back, right)], axis=1)
    if camera.parallel_scale is None:
        plane /= -(offset @ back)[:, None] * np.tan(np.deg2rad(float(camera.view_angle)) / 2)
    else:
        plane /= float(camera.parallel_scale)
    return plane / (camera.size[0] / camera.size[1], 1)


def test_a_framed_camera_just_sees_all_points():
    points = np.random.default_rng(1).normal(size=(40, 3)) * (3, 1, 0.5) + (10, -20, 5)
    volume = jv.Volume(np.zeros((4, 4, 4), np.uint8))
    for parallel in (False, True):
        for size in ((32, 32), (48, 32), (16, 32)):
            camera = jv.Camera.looking_at(volume, (1, -1, 0.3), view_angle=40, parallel=parallel, size=size)
            seen = in_picture(framed(camera, points), points)
            low, high = seen.min(axis=0), seen.max(axis=0)
            # both sides of the tighter axis are at the margin, and the other is as far inside on both sides
            assert max(high) == pytest.approx(1 / MARGIN, abs=1e-4)
            np.testing.assert_allclose(low[np.argmax(high)], -1 / MARGIN, atol=1e-4)
            assert np.abs(seen).max() < 1 / MARGIN + 1e-4
            np.testing.assert_allclose(low + high, 0, atol=1e-4)
    # one that turns sees them all the time
    points -= (10, -20, 5)
    camera = jv.Camera.looking_at(volume, (1, -1, 0.3), size=(32, 32))
    angles = range(0, 360, 15)
    found = framed(camera, points, [turned(camera, angle, (0, 0, 1)) for angle in angles])
    reach = [np.abs(in_picture(turned(found, angle, (0, 0, 1)), points)).max() for angle in angles]
    assert max(reach) == pytest.approx(1 / MARGIN, abs=1e-4)


def test_borders_and_grain_between_thresholds_are_no_body():
    solid = np.asarray(ball(0.8, 0.35).data)
    assert is_body(solid, 55, 150)
    border = np.where(solid > 55, 200, solid).astype(np.uint8)
    border[1:] = np.maximum(border[1:], border[:-1] // 2)  # of 100, on one side
    assert not is_body(border, 55, 150)
    grain = solid + 45 * np.random.default_rng(0).uniform(-1, 1, solid.shape) * (solid > 55) * (solid < 150)
    assert not is_body(grain.astype(np.float32), 55, 150)
    assert is_body(solid[:2], 55, 150)  # too thin to tell


def labels(n=24):
    data = np.zeros((n, n, n), np.uint8)
    data[4:12, 4:-4, 4:-4], data[12:-4, 4:-4, 4:-4], data[10:14, 10:14, :4] = 2, 5, 7
    return data


def test_labels_are_shown_in_colours_of_their_own():
    # a hundred more at one end: 2 x 2 x 3 voxels each
    more = np.kron(np.arange(144).reshape(12, 12), np.ones((2, 2)))
    data = labels()
    data[21:] = np.where(more < 114, 100 + more, 0)
    volume, transfer = jv.labels_shown(jv.Volume(given := data, (1, 2, 3), (4, 5, 6)))
    np.testing.assert_array_equal(volume.spacing, (1, 2, 3))
    np.testing.assert_array_equal(volume.origin, (4, 5, 6))
    # voxels are smooth, and opaque inside; labels, counted from 1 on, reach two voxels beyond
    data, kinds = np.asarray(volume.data), np.asarray(volume.labels)
    assert data[8, 12, 12] == data[16, 12, 12] == INSIDE
    assert 0 < data[3, 12, 12] < data[4, 12, 12] < INSIDE
    assert kinds[[1, 2, 8, 16, 12], 12, [12, 12, 12, 12, 1]].tolist() == [0, 1, 1, 2, 3]
    assert volume.label_ids == tuple(np.unique(given))
    colors = np.asarray(transfer.stacked.colors)[1:-1, 0]
    apart = np.abs(colors[:, None] - colors[None]).max(axis=-1)[np.triu_indices(117, 1)]
    assert apart[[0, 1, 116]].min() > 0.3  # of the first three labels
    assert apart.min() > 0.004
    across = float(np.linalg.norm(np.subtract(*map(np.asarray, volume.corners))))
    first = jax.tree.map(lambda leaf: np.asarray(leaf)[1], transfer.stacked)
    assert opacity_at(first, INSIDE, 0.02 * across) > 0.9


def test_other_volumes_are_not_taken_for_labels():
    for name in ("head", "engine", "colon", "vessels"):
        assert labels_if_any(jv.phantom(name, 24)) is None
    floats, two = labels().astype(np.float32), (labels() > 0).astype(np.uint8)
    many = np.repeat(np.arange(128, dtype=np.uint8), 8).reshape(32, 8, 4)
    for data in (floats, two, many):
        assert labels_if_any(jv.Volume(data)) is None
    with pytest.raises(ValueError, match="volume must have up to 256 labels"):
        jv.labels_shown(jv.Volume(floats))


def test_grey_values_in_a_fill_value_that_is_not_the_lowest_are_no_labels():
    places = np.meshgrid(*(np.linspace(-1, 1, n) for n in (18, 15, 8)), indexing="ij")
    ball = np.clip(
        1.3 - np.sqrt(sum((x / s) ** 2 for x, s in zip(places, (0.7, 0.55, 0.4), strict=True))), 0, 1
    )
    data = np.full((18, 15, 24), 3, np.uint8)
    data[:, :, 8:16] = (250 * ball).astype(np.uint8)
    assert labels_if_any(jv.Volume(data)) is None
    segments = np.full((18, 15, 24), 3, np.uint8)
    segments[2:16, 2:13, 8:16], segments[2:8, 2:13, 9:15] = 0, 7
    assert labels_if_any(jv.Volume(segments)) is not None


def test_the_automatic_camera_is_upright_and_as_near_as_what_is_visible_allows():
    data = np.asarray(ball(0.5, 0.2).data)
    transfer, stand = jv.automatic_transfer(jv.Volume(data)), data
    for axis, sign in itertools.product(range(3), (1, -1)):
        stand = np.array(data)  # a slab on one face
        np.moveaxis(stand, axis, 0)[-1 if sign < 0 else 0] = 200
        camera = jv.automatic_camera(volume := jv.Volume(stand), transfer, size=(32, 32))
        np.testing.assert_array_equal(camera.view_up, sign * np.eye(3)[axis])
        away = np.asarray(camera.position) - np.asarray(camera.focal_point)
        assert away @ np.asarray(camera.view_up) > 0.3 * np.linalg.norm(away)  # from above
        seen = in_picture(camera, visible_points(volume, transfer))
        assert np.abs(seen).max() == pytest.approx(1 / MARGIN, abs=1e-4)
        # also where what is around hides it
        camera = jv.automatic_camera(volume, jv.colormap("gray", (0, 255)), size=(32, 32))
        np.testing.assert_array_equal(camera.view_up, sign * np.eye(3)[axis])
    # a file that says where it lies, and a user who says what is up
    for volume, up in ((jv.Volume(stand, origin=(0, 0, 1)), None), (jv.Volume(stand), (0, 0, 1))):
        camera = jv.automatic_camera(volume, transfer, (1, 2, 0.5), up, size=(32, 32))
        np.testing.assert_array_equal(camera.view_up, (0, 0, 1))
        away = np.asarray(camera.position) - np.asarray(camera.focal_point)
        np.testing.assert_allclose(away / away[2], (2, 4, 1), rtol=1e-3)
    # from above and below, a patient's front is up, at -y; where it is not known, y
    for origin, toward, up in ((1, 1, -1), (1, -1, -1), (0, 1, 1)):
        lying = jv.Volume(data, origin=(0, 0, origin))
        camera = jv.automatic_camera(lying, transfer, (0, 1e-5, toward), size=(32, 32))
        np.testing.assert_array_equal(camera.view_up, (0, up, 0))
    with pytest.raises(ValueError, match=r"view_up must not point along direction, \(0\.0, 2\.0, 0\.0\)"):
        jv.automatic_camera(volume, transfer, (0, 2, 0), (0, -1, 0))


def test_presets_count_millimetres_where_voxels_are_not_far_smaller():
    data = np.zeros((2, 2, 2), np.uint8)
    assert [preset_unit(jv.Volume(data, (s, s, s))) for s in (3.0, 0.5, 0.125)] == [1, 1, 1]
    assert preset_unit(jv.Volume(data, (0.05, 0.05, 0.05))) == pytest.approx(0.05)


def test_the_automatic_camera_shows_all_of_several_volumes():
    near = ball(0.8, 0.35)
    volumes, transfers = [near, jv.Volume(near.data, origin=(60, 0, 0))], [jv.automatic_transfer(near)] * 2
    camera = jv.automatic_camera(volumes, transfers, size=(32, 32))
    points = np.concatenate([*map(visible_points, volumes, transfers)])
    assert np.abs(in_picture(camera, points)).max() == pytest.approx(1 / MARGIN, abs=1e-4)
    camera = jv.automatic_camera(volumes[::-1], transfers, (-1, 0, 0), size=(32, 32), parallel=True)
    assert (points @ (1, 0, 0) > np.asarray(camera.position)[0]).all()
    camera = jv.automatic_camera(volumes, transfers, size=(32, 32), centered=True)
    np.testing.assert_allclose(camera.focal_point, (points.min(axis=0) + points.max(axis=0)) / 2, rtol=1e-5)
    assert np.abs(in_picture(camera, points)).max() == pytest.approx(1 / MARGIN, abs=1e-4)


def test_what_is_thin_is_dense_and_what_hides_is_not():
    """Leaves beside a trunk, and a body around bones; both of value 100, and of 200 what is dense."""
    leaves = np.full((64, 64, 64), 10, np.float32)
    for at in range(8):
        x, y, z = (8 * (at * step % 8) for step in (1, 3, 5))
        leaves[x : x + 6, y : y + 6, z : z + 6] = 100
    leaves[28:36, 60:64, 2:62] = 200
    leaves = jv.Volume(gaussian_filter(leaves, 0.7).astype(np.uint8))
    thin, thick = map(jv.automatic_transfer, (leaves, ball(0.8, 0.35)))
    assert opacity_at(thin, 90, 64 * 3**0.5 / 100) > 3 * opacity_at(thick, 100, 32 * 3**0.5 / 100)
    assert opacity_at(thin, 45, 64 * 3**0.5 / 100) < 0.05  # noise above the threshold
    assert opacity_at(thin, 39, 64 * 3**0.5) == 0


def padded(kind, value):
    """A head in air of -1000, and the same with a value in place of some voxels."""
    head = np.asarray(jv.phantom("head", 32).data)
    noise = np.random.default_rng(0).normal(0, 15, head.shape)
    data = (np.select([head > 150, head > 20], [900, 40], -1000) + noise).astype(np.float32)
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, 32)] * 3, indexing="ij")
    where = {
        "circle": x * x + y * y > 1.05,
        "ball": x * x + y * y + z * z > 1.5,
        "voxel": (abs(x) + abs(y) + abs(z)) < 0.1,
    }
    return data, np.where(where[kind], np.float32(value), data)


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        *(("circle", v) for v in (-2000, -3024, -9999, 1e20)),
        *(("ball", v) for v in (-3024, -32768, 9.97e36)),
        *(("voxel", v) for v in (-1e30, 1e30, 1e5)),
    ],
)
def test_padding_fill_values_and_strays_are_no_class(kind, value):
    data, spiked = padded(kind, value)
    whole = jv.automatic_transfer(jv.Volume(data))
    with pytest.warns(UserWarning, match="far from all others: taken as background"):
        found = jv.automatic_transfer(jv.Volume(spiked))
    at = np.linspace(-1100, 930, 200)

    def opacity(transfer):
        return -np.expm1(-np.interp(at, transfer.values, transfer.extinction))

    assert np.abs(opacity(found) - opacity(whole)).max() < 0.1
    if value > 1e10 and kind != "voxel":  # a fill value is as transparent as what it stands for
        assert np.interp(value, found.values, found.extinction) == 0
    low, high = range_of_object(jv.Volume(data))
    with pytest.warns(UserWarning, match="far from all others"):
        found = range_of_object(jv.Volume(spiked))
    np.testing.assert_allclose(found, (low, high), atol=0.02 * (high - low))


def test_values_of_objects_are_no_strays():
    rng = np.random.default_rng(0)
    noise, two = rng.normal(0, 5, (24, 24, 24)), np.zeros((24, 24, 24))
    bright = np.where(np.indices(noise.shape).sum(0) > 50, 255.0, noise.clip(-20, 20) + 60)  # saturated
    two[6:12], two[12:18] = 100, 200
    for data in (noise, bright, two, labels()):
        assert spread_of(data).warning == ""


def test_a_distance_is_shown_where_it_is_0():
    x = np.linspace(-1, 1, 32)
    distance = np.sqrt(sum(np.square(each) for each in np.meshgrid(x, x, x))) - 0.5
    for sign in (1, -1):
        volume = jv.Volume((sign * distance).astype(np.float32), (2 / 31,) * 3)
        with pytest.warns(UserWarning, match="slope of one are a distance: shown where they are 0"):
            transfer = jv.automatic_transfer(volume)
        inside, outside = (opacity_at(transfer, sign * at, 1.0) for at in (-0.2, 0.2))
        assert inside > 0.9
        assert outside == 0


def test_a_slab_is_seen_from_its_broad_side_and_a_plane_cuts_the_points():
    data = np.asarray(ball(0.8, 0.35).data)
    for axis in range(3):
        slab = jv.Volume(data.take(range(14, 18), axis))
        camera = jv.automatic_camera(slab, jv.automatic_transfer(slab), size=(32, 32))
        away = np.asarray(camera.position) - np.asarray(camera.focal_point)
        assert abs(away[axis]) > 0.8 * np.linalg.norm(away)
    cube = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
    cut = clipped_points(cube, [((0.25, 0, 0), (1, 0, 0)), ((0, 0, 0.5), (0, 0, -1))])
    np.testing.assert_allclose([cut.min(0), cut.max(0)], [(0.25, 0, 0), (1, 1, 0.5)])
    assert clipped_points(cube, [((2, 0, 0), (1, 0, 0))]).shape == (0, 3)
