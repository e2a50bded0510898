"""The distance map of voxels, with which the minimum-distance grid was published."""

from itertools import product

import numpy as np
import pytest

import jaxvol as jv
from experiments.voxel_distances import VoxelLeaping, distances


@pytest.fixture(scope="module")
def scene():
    """Two small bright things, one of them at a corner, in a grid whose voxels are not cubes."""
    data = np.zeros((14, 11, 9), np.float32)
    data[0, 0, 0], data[9:11, 5, 6] = 1, 0.4
    volume = jv.Volume(data, spacing=(1, 1.5, 0.5), origin=(3, -2, 1))
    return volume, jv.TransferFunction([0.1, 1], np.ones((2, 3)), [0, 2])


def test_distances_are_those_to_the_nearest_cell_that_shows_anything(scene):
    volume, transfer = scene
    grid, data = distances(volume, transfer), np.asarray(volume.data)
    cells = list(product(*(range(n - 1) for n in data.shape)))
    shown = [c for c in cells if data[tuple(slice(i, i + 2) for i in c)].max() > 0.1]
    nearest = [np.abs(np.asarray(c) - shown).max(axis=1).min() for c in cells]
    np.testing.assert_array_equal(grid.distance(), nearest)


@pytest.mark.parametrize("method", ["distance", "beam"])
def test_leaps_by_voxels_change_no_image_and_take_fewer_samples(scene, method):
    volume, transfer = scene
    camera = jv.Camera.looking_at(volume, (0.5, -0.7, 0.6), size=(24, 24))
    leaps = VoxelLeaping(distances(volume, transfer), method)
    plain, by_blocks, by_voxels = (
        jv.render(volume, transfer, camera, jv.March(0.1, transforms))
        for transforms in ((), (jv.SpaceLeaping(method),), (leaps,))
    )
    np.testing.assert_array_equal(by_voxels.rgba, plain.rgba)
    assert by_voxels.samples.sum() < by_blocks.samples.sum()


def test_nothing_visible_is_leapt_over_whole(scene):
    volume, _ = scene
    transfer = jv.TransferFunction([0.1, 1], np.ones((2, 3)), [0, 0])
    camera = jv.Camera.looking_at(volume, (0.5, -0.7, 0.6), size=(24, 24))
    leaps = VoxelLeaping(distances(volume, transfer))
    image = jv.render(volume, transfer, camera, jv.March(0.1, (leaps,)))
    assert not image.rgba.any()
    assert image.samples.sum() < 5  # of rays shorter than a thousandth of a step
