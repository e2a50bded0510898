"""Do the phantoms match their descriptions, at every resolution?"""

import functools
from typing import cast

import numpy as np
import pytest
from scipy import ndimage

from jaxvol.io.phantoms import PHANTOMS, colon_path, phantom


UINT8 = ("head", "engine", "colon", "vessels", "labels")
FLOAT = ("plane", "cut_block", "sphere", "constant", "linear", "gaussian")
SEEDED = ("head", "colon", "vessels")


@functools.cache
def volume(name, resolution, seed=0):
    return phantom(name, resolution, seed=seed)


def voxels(name, resolution=96, seed=0):
    return np.asarray(volume(name, resolution, seed).data)


def at(data, points):
    """Trilinearly interpolated values at world points."""
    coordinates = (np.asarray(points).reshape(-1, 3) + 1) / 2 * (np.array(data.shape) - 1)
    return ndimage.map_coordinates(data.astype(np.float64), coordinates.T, order=1)


def components(mask) -> np.ndarray:
    """The number of each voxel's 6-connected component; 0 outside of the mask."""
    labels, _ = cast(tuple[np.ndarray, int], ndimage.label(mask))
    return labels


def largest(mask):
    """Part of the voxels that are in the largest 6-connected component."""
    return np.bincount(components(mask).ravel())[1:].max() / mask.sum()


def faces(data):
    """The largest value on each face, in the order -x, +x, -y, +y, -z, +z."""
    return [np.take(data, side, axis).max() for axis in range(3) for side in (0, -1)]


@pytest.mark.parametrize("name", PHANTOMS)
def test_every_phantom_fills_the_cube_and_depends_on_its_seed_where_promised(name):
    made = volume(name, 24)
    data = np.asarray(made.data)
    assert data.shape == (24, 24, 24)
    assert data.dtype == (np.uint8 if name in UINT8 else np.float32)
    assert (name in UINT8) != (name in FLOAT)
    assert np.all(np.isfinite(data))
    np.testing.assert_allclose(made.bounds, [-1, 1] * 3, atol=1e-6)
    assert (made.labels is not None) == (name == "labels")
    np.testing.assert_array_equal(phantom(name, 24, seed=0).data, data)
    assert np.array_equal(phantom(name, 24, seed=1).data, data) == (name not in SEEDED)


@pytest.mark.parametrize("name", UINT8)
def test_resolutions_show_one_scene_and_finer_ones_agree_better(name):
    """The nodes of resolution n are among those of 2n - 1; only boundary ramps, 2 voxels wide, may differ."""

    def difference(n):
        fine = voxels(name, 2 * n - 1)[::2, ::2, ::2].astype(float)
        return np.abs(fine - voxels(name, n)).mean() / voxels(name, 2 * n - 1).std()

    coarse, fine = difference(17), difference(33)
    assert fine < 0.15  # relative to the standard deviation of the values
    assert fine <= 0.75 * coarse  # the fraction of voxels near a surface is ~ 1/n


@pytest.mark.parametrize("name", FLOAT)
def test_formulas_hold_at_every_node(name):
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, 24)] * 3, indexing="ij")
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
    np.testing.assert_allclose(voxels(name, 24), expected[name], atol=2e-5)


def test_the_head_is_one_body_with_its_face_towards_minus_y_and_its_neck_cut():
    head = voxels("head")
    *others, neck, crown = faces(head)
    assert max(*others, crown) == 0
    assert neck > 180  # a vertebra is cut
    assert 0.03 < (head[:, :, 0] > 40).mean() < 0.2
    assert largest(head > 40) > 0.999
    solid, teeth = (np.argwhere(head > least) / 95 * 2 - 1 for least in (40, 240))
    nose = solid[solid[:, 1].argmin()]
    assert abs(nose[0]) < 0.05
    assert -0.3 < nose[2] < 0.0
    assert len(teeth) > 100
    assert teeth[:, 1].max() < -0.15  # all in the jaws


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
    colon, path = voxels("colon"), colon_path(200)
    lumen = components(colon < 90)
    (inside,) = np.unique(lumen[tuple(np.rint((path + 1) / 2 * 95).astype(int).T)])
    assert inside not in (0, lumen[0, 0, 0])
    assert 0.02 < (lumen == inside).mean() < 0.3
    # even steps, with room for a camera
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert path.shape == (200, 3)
    assert steps.std() < 0.02 * steps.mean()
    around = np.concatenate([path + 0.04 * way for way in np.vstack([np.eye(3), -np.eye(3)])])
    assert np.mean(at(colon, around) < 60) > 0.99


def test_vessels_are_one_thin_tree_from_the_root_in_mostly_empty_space():
    vessels = voxels("vessels")
    filled = vessels > 115
    labels = components(filled)
    root = labels[48, 48, 0]
    assert 0.005 < filled.mean() < 0.03
    assert root > 0
    assert (labels == root).sum() > 0.95 * filled.sum()
    assert sum(face > 0 for face in faces(vessels)) == 1
    leaves = np.argwhere(filled) / 95 * 2 - 1
    assert np.all(np.abs([leaves.min(axis=0), leaves.max(axis=0)]) > 0.7)


def test_labels_are_organs_in_a_body_and_neighbours_touch():
    made = volume("labels", 96)
    labels = np.asarray(made.labels)
    assert labels.dtype == np.uint8
    assert np.array_equal(np.unique(labels), np.arange(6))
    assert all(largest(labels == label) > 0.999 for label in range(1, 6))
    assert faces(labels) == [0] * 6

    def touch(a, b):
        return ndimage.binary_dilation(labels == a)[labels == b].any()

    for organ in (2, 3, 4, 5):
        assert touch(organ, 1)
        assert not touch(organ, 0)
    for pair in ((2, 3), (2, 4), (3, 5), (4, 5)):
        assert touch(*pair)


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: phantom("heat"), "name must be one of head, engine"),
        (lambda: phantom("head", 7), "resolution must be an integer of at least 8; got 7"),
        (lambda: phantom("head", 32.0), "resolution .* got 32.0"),
        (lambda: phantom("head", 16, seed=-1), "seed must be an integer of at least 0; got -1"),
        (lambda: colon_path(1), "points must be an integer of at least 2; got 1"),
    ],
)
def test_a_bad_argument_is_named(call, named):
    with pytest.raises(ValueError, match=named):
        call()
