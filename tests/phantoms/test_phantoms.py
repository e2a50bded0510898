"""Do the phantoms match their descriptions, at every resolution?"""

import functools
from typing import cast

import numpy as np
import pytest
from scipy import ndimage

from jaxvol.phantoms import PHANTOMS, colon_path, phantom

from ..scenes import slow


UINT8 = ("head", "engine", "colon", "vessels", "labels")
FLOAT = ("plane", "cut_block", "sphere", "constant", "linear", "gaussian")
SEEDED = ("head", "colon", "vessels")
QUICK = [name for name in UINT8 if name != "vessels"]


@functools.cache
def volume(name, resolution, seed=0):
    return phantom(name, resolution, seed=seed)


def voxels(name, resolution, seed=0):
    return np.asarray(volume(name, resolution, seed).data)


def axes(resolution):
    axis = np.linspace(-1, 1, resolution)
    return np.meshgrid(axis, axis, axis, indexing="ij")


def at(data, points):
    """Trilinearly interpolated values at world points."""
    coordinates = (np.asarray(points).reshape(-1, 3) + 1) / 2 * (np.array(data.shape) - 1)
    return ndimage.map_coordinates(data.astype(np.float64), coordinates.T, order=1)


def components(mask) -> np.ndarray:
    """The number of each voxel's 6-connected component; 0 outside of the mask."""
    labels, _ = cast(tuple[np.ndarray, int], ndimage.label(mask))
    return labels


def sizes(mask):
    """Numbers of voxels of all 6-connected components, the largest first."""
    labels = components(mask)
    return np.sort(np.bincount(labels.ravel())[1:])[::-1]


def faces(data):
    """The largest value on each face, in the order -x, +x, -y, +y, -z, +z."""
    return [np.take(data, side, axis).max() for axis in range(3) for side in (0, -1)]


def test_the_tests_know_every_phantom():
    assert sorted(PHANTOMS) == sorted(UINT8 + FLOAT)


@pytest.mark.parametrize("name", PHANTOMS)
def test_every_phantom_fills_the_cube_with_finite_values_of_its_type(name):
    made = volume(name, 24)
    data = np.asarray(made.data)
    assert data.shape == (24, 24, 24)
    assert data.dtype == (np.uint8 if name in UINT8 else np.float32)
    assert np.all(np.isfinite(data))
    np.testing.assert_allclose(made.bounds, [-1, 1] * 3, atol=1e-6)
    np.testing.assert_allclose(made.center, 0, atol=1e-6)
    assert (made.labels is not None) == (name == "labels")


@pytest.mark.parametrize("name", [*QUICK, *FLOAT, *slow("vessels")])
def test_the_same_seed_gives_the_same_voxels_and_another_seed_another_scene_where_promised(name):
    again, other = np.asarray(phantom(name, 24, seed=0).data), voxels(name, 24, seed=1)
    np.testing.assert_array_equal(again, voxels(name, 24))
    assert np.array_equal(other, again) == (name not in SEEDED)


@pytest.mark.parametrize("name", [*QUICK, *slow("vessels")])
def test_resolutions_show_one_scene_and_finer_ones_agree_better(name):
    """The nodes of resolution n are among those of 2n - 1; only boundary ramps, 2 voxels wide, may differ."""

    def difference(n):
        fine = voxels(name, 2 * n - 1)[::2, ::2, ::2].astype(float)
        return np.abs(fine - voxels(name, n)).mean() / voxels(name, 2 * n - 1).std()

    coarse, fine = difference(33), difference(65)
    assert fine < 0.1  # relative to the standard deviation of the values
    assert fine <= 0.75 * coarse  # the fraction of voxels near a surface is ~ 1/n


@pytest.mark.parametrize("name", FLOAT)
def test_formulas_hold_at_every_node(name):
    x, y, z = axes(40)
    u_x, u_z, radius = (x + 1) / 2, (z + 1) / 2, np.sqrt(x**2 + y**2 + z**2)
    with np.errstate(over="ignore"):
        plane = 1 / (1 + np.exp(-(u_z - (0.25 + 0.35 * u_x)) / 0.004))
        expected = {
            "plane": plane,
            "cut_block": np.where(u_x < 0.5, 0.5 + 0.1 * np.sin(40 * u_z), plane),
            "sphere": 1 / (1 + np.exp((radius - 0.5) / 0.008)),
            "constant": np.ones_like(x),
            "linear": u_x,
            "gaussian": np.exp(-(radius**2) / (2 * 0.3**2)),
        }
    # 1 / 0.008 and 1 / 0.004 magnify the rounding of a float32 coordinate
    np.testing.assert_allclose(voxels(name, 40), expected[name], atol=2e-5)


def test_the_cut_block_is_cut_by_the_box_and_the_plane_has_its_back_in_material():
    assert voxels("cut_block", 40)[:20, :, 0].min() > 0.4
    assert voxels("plane", 40)[:, :, -1].min() > 0.999
    assert voxels("plane", 40)[:, :, 0].max() < 1e-3


def test_only_the_neck_of_the_head_reaches_the_box():
    head = voxels("head", 96)
    *others, neck, crown = faces(head)
    assert max(*others, crown) == 0
    assert neck > 180  # a vertebra is cut
    cut = head[:, :, 0] > 40
    assert len(sizes(cut)) == 1
    assert 0.03 < cut.mean() < 0.2


def test_the_head_is_one_body_with_its_face_towards_minus_y():
    head = voxels("head", 96)
    assert sizes(head > 40)[0] > 0.999 * (head > 40).sum()
    solid = np.argwhere(head > 40) / 95 * 2 - 1
    nose = solid[solid[:, 1].argmin()]
    assert abs(nose[0]) < 0.05
    assert -0.3 < nose[2] < 0.0
    teeth = np.argwhere(head > 240) / 95 * 2 - 1
    assert len(teeth) > 100
    assert teeth[:, 1].max() < -0.15  # all in the jaws
    assert np.all((teeth[:, 2] > -0.55) & (teeth[:, 2] < -0.2))
    ears = np.abs(solid[:, 0]).argmax()
    assert abs(solid[ears][1] - 0.1) < 0.15


def test_the_head_has_closed_sinuses_and_an_open_airway():
    head = voxels("head", 96)
    air = components(head < 40)
    outside = air[0, 0, 0]

    def label(*point):
        return air[tuple(np.rint((np.array(point) + 1) / 2 * 95).astype(int))]

    assert label(0.06, -0.4, -0.07) == outside  # nasal cavity, through the nostrils
    assert label(0, -0.05, -0.5) == outside  # airway, through the neck's cut
    for closed in ((0.165, -0.40, -0.11), (-0.165, -0.40, -0.11)):
        assert label(*closed) not in (0, outside)


def test_the_brain_lies_inside_a_closed_vault_of_bone():
    """Upward rays from the middle of the brain cross bone before they leave the head."""
    head = voxels("head", 96)
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(300, 3))
    ways[:, 2] = np.abs(ways[:, 2])
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    start, steps = np.array([0, 0.08, 0.35]), np.linspace(0, 0.8, 200)[:, None]
    along = np.array([at(head, start + way * steps) for way in ways])
    first_bone = (along > 160).argmax(axis=1)
    assert np.all(along.max(axis=1) > 160)
    inside = np.concatenate([ray[: end - 6] for ray, end in zip(along, first_bone, strict=True)])
    assert inside.min() > 75
    assert 108 < inside.mean() < 128


def test_the_engine_has_three_materials_of_increasing_density_and_stays_inside():
    engine = voxels("engine", 129)
    assert max(faces(engine)) == 0
    counts = np.bincount(engine.ravel(), minlength=256)
    for value in (90, 150, 240):
        assert counts[value] > 2000
        assert counts[value] > 3 * counts[value - 20]  # materials are plateaus, ramps are thin
    assert at(engine, [(x, 0.12, 0.25) for x in (-0.42, 0.42)]).max() < 60  # the space above a piston
    assert at(engine, [(-0.7, 0, -0.52), (0.7, 0, -0.52)]).min() > 220  # the crankshaft passes both walls


def test_the_lumen_of_the_colon_is_one_closed_cavity_round_its_path():
    for seed in (0, 1):
        colon = voxels("colon", 96, seed)
        lumen = components(colon < 90)
        path = np.rint((colon_path() + 1) / 2 * 95).astype(int)
        inside = np.unique(lumen[tuple(path.T)])
        assert len(inside) == 1
        assert inside[0] not in (0, lumen[0, 0, 0])
        cavity = (lumen == inside[0]).sum()
        assert cavity > 0.995 * ((colon < 90) & (lumen != lumen[0, 0, 0])).sum()
        assert 0.02 < cavity / colon.size < 0.3
        assert at(colon, colon_path()).max() < 10


def test_the_wall_of_the_colon_is_brighter_than_its_tissue():
    colon = voxels("colon", 129)
    lumen = components(colon < 90)
    cavity = (lumen != lumen[0, 0, 0]) & (lumen > 0)
    distance = np.asarray(ndimage.distance_transform_edt(~cavity)) * (2 / 128)
    wall, tissue = (distance > 0.02) & (distance < 0.03), (distance > 0.08) & (colon > 90)
    assert np.median(colon[wall]) > 210
    assert abs(np.median(colon[tissue]) - 180) < 5


def test_the_colon_path_has_even_steps_and_room_for_a_camera():
    path = colon_path(200)
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert path.shape == (200, 3)
    assert steps.std() < 0.02 * steps.mean()
    np.testing.assert_allclose(colon_path(400)[[0, -1]], path[[0, -1]])
    colon = voxels("colon", 96)
    around = np.concatenate([path + 0.04 * way for way in np.vstack([np.eye(3), -np.eye(3)])])
    assert np.mean(at(colon, around) < 60) > 0.99


@pytest.mark.parametrize("seed", [0, *slow(1)])
def test_vessels_are_one_thin_tree_from_the_root_in_mostly_empty_space(seed):
    vessels = voxels("vessels", 129, seed)
    filled = vessels > 115
    assert 0.005 < filled.mean() < 0.03
    labels = components(filled)
    root = labels[64, 64, 0]
    assert root > 0
    assert (labels == root).sum() > 0.95 * filled.sum()
    assert sum(face > 0 for face in faces(vessels)) == 1
    depth = np.asarray(ndimage.distance_transform_edt(filled)) * (2 / 128)
    assert 0.1 < depth.max() < 0.15  # the trunk
    leaves = np.argwhere(filled) / 128 * 2 - 1
    assert np.all(leaves.max(axis=0) > 0.7)
    assert np.all(leaves.min(axis=0) < -0.7)


def test_labels_are_organs_in_a_body_and_neighbours_touch():
    made = volume("labels", 96)
    labels = np.asarray(made.labels)
    assert labels.dtype == np.uint8
    assert np.array_equal(np.unique(labels), np.arange(6))
    for label in range(1, 6):
        assert sizes(labels == label)[0] > 0.999 * (labels == label).sum()
    assert labels[0].max() == 0
    assert faces(labels) == [0] * 6

    def touch(a, b):
        return ndimage.binary_dilation(labels == a)[labels == b].any()

    for organ in (2, 3, 4, 5):
        assert touch(organ, 1)
        assert not touch(organ, 0)
    for pair in ((2, 3), (2, 4), (3, 5), (4, 5)):
        assert touch(*pair)


def test_where_touching_organs_meet_the_labels_jump_and_the_intensity_does_not():
    made = volume("labels", 96)
    data, labels = np.asarray(made.data).astype(float), np.asarray(made.labels).astype(int)
    steps = []
    for axis in range(3):
        before, after = (np.take(labels, np.arange(95) + side, axis) for side in (0, 1))
        boundary = (before > 1) & (after > 1) & (before != after)
        steps.append(np.abs(np.diff(data, axis=axis))[boundary])
    steps = np.concatenate(steps)
    assert len(steps) > 200
    # the largest contrast, 120, is spread over a ramp 0.06 wide; a hard edge would jump by 120
    assert steps.max() < 120 * (2 / 95) / 0.06 + 1


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("heat",), "name must be one of head, engine"),
        (("head", 7), "resolution must be an integer of at least 8; got 7"),
        (("head", 32.0), "resolution .* got 32.0"),
        (("head", True), "resolution .* got True"),
    ],
)
def test_a_bad_argument_is_named(arguments, named):
    with pytest.raises(ValueError, match=named):
        phantom(*arguments)


def test_a_bad_seed_or_path_length_is_named():
    with pytest.raises(ValueError, match="seed must be an integer of at least 0; got -1"):
        phantom("head", 16, seed=-1)
    with pytest.raises(ValueError, match="points must be an integer of at least 2; got 1"):
        colon_path(1)
