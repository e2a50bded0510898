"""Does a plan with a budget choose bricks where they are needed, and only there?"""

import numpy as np
import pytest

import jaxvol as jv
from jaxvol.bricks.plan import IN_MEMORY
from jaxvol.metrics import rmse

from ..scenes import scaled_phantom, soft_transfer


TOLERANCE = 0.02


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A file, the volume in it, a transfer function, and a camera."""
    volume = scaled_phantom("sphere", 64)
    path = tmp_path_factory.mktemp("plan") / "ball.npy"
    np.save(path, np.asarray(volume.data))
    camera = jv.Camera.looking_at(volume, (0.5, -1, 0.4), size=(64, 48))
    return path, volume, soft_transfer(), camera


def planned(scene, memory, path=None) -> jv.BudgetPlan:
    file, volume, transfer, camera = scene
    place = {"spacing": volume.spacing, "origin": volume.origin}
    found = jv.plan(path or file, transfer, camera, TOLERANCE, memory=memory, **place)
    assert isinstance(found, jv.BudgetPlan)
    return found


def test_a_volume_that_fits_is_rendered_in_memory(scene):
    _, volume, transfer, camera = scene
    found = planned(scene, IN_MEMORY * volume.data.nbytes)
    assert found.counts is None
    assert found.stride == 1
    assert "in memory" in str(found)
    own = jv.plan(volume, transfer, camera, TOLERANCE)
    assert isinstance(own, jv.Plan)
    assert (found.plan.error, found.plan.parts) == (own.error, own.parts)
    image = found.render(transfer, camera)
    assert image.details.bricks is None
    np.testing.assert_allclose(image.rgba, jv.render(own.volume, transfer, camera, own.march).rgba)


@pytest.mark.slow
def test_a_volume_that_does_not_fit_is_rendered_by_bricks(scene):
    _, volume, transfer, camera = scene
    memory = IN_MEMORY * volume.data.nbytes // 8
    found = planned(scene, memory)
    assert found.stride == 2
    image = found.render(transfer, camera)
    assert image.bricks.counts == found.counts
    assert np.prod(found.counts or ()) > 1
    assert image.bricks.loads <= found.loads == image.bricks.needed
    assert image.bricks.bytes_read <= found.bytes_read
    assert image.bricks.bytes_held <= memory
    fine = jv.March(float(volume.spacing.min()) / 16, (jv.AlphaCorrection(),), "preintegrated")
    truth = jv.render(volume, transfer, camera, fine)
    assert rmse(image.image(), truth.image()) <= TOLERANCE
    said = str(found)
    assert f"at most {found.loads} are read" in said
    assert "error and time below are the copy's" in said
    assert {type(each) for each in found.march.transforms} >= {jv.AlphaCorrection, jv.SpaceLeaping}


def test_less_memory_than_a_copy_takes_is_named(scene):
    with pytest.raises(ValueError, match=r"memory must hold a copy of 2 voxels along each axis .* got 100"):
        planned(scene, 100)


def test_what_is_no_volume_is_named(scene):
    with pytest.raises(ValueError, match=r"no file no_such\.raw"):
        planned(scene, 10**9, "no_such.raw")
    with pytest.raises(ValueError, match=r"memory must be an integer of at least 1; got 1\.5"):
        planned(scene, 1.5)
