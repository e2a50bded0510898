"""Does a plan with a budget choose bricks where they are needed, and only there?"""

import re
import sys
from typing import Any

import numpy as np
import pytest

import jaxvol as jv
from jaxvol.bricks import source_of
from jaxvol.bricks.plan import IN_MEMORY
from jaxvol.bricks.render import bricks_of
from jaxvol.bricks.split import TooLittleMemory, check_smallest, split
from jaxvol.metrics import rmse

from ..scenes import scaled_phantom, soft_transfer


TOLERANCE = 0.02
PLANNING = sys.modules["jaxvol.bricks.plan"]  # the name is that of a function, too


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
    found = jv.plan(file if path is None else path, transfer, camera, TOLERANCE, memory=memory, **place)
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


def test_too_little_memory_is_named_before_anything_is_planned(scene, monkeypatch):
    monkeypatch.setattr(PLANNING, "plan_in_memory", None)
    least = r"memory must be at least \d+ bytes, which the smallest bricks take, of 16 x 16 x 16 cells"
    with pytest.raises(ValueError, match=least + r".* Got 100\."):
        planned(scene, 100)
    flat = np.zeros((4, 512, 512), np.uint8)
    with pytest.raises(ValueError, match=r"memory must hold a copy of 2 voxels along each axis"):
        planned(scene, 500_000, flat)


def test_the_least_memory_that_is_named_holds_bricks():
    """It is no more than what a march takes that reads little around a brick."""
    data = np.random.default_rng(0).uniform(size=(64, 64, 64)).astype(np.float32)
    with pytest.raises(TooLittleMemory) as refused:
        check_smallest(data.shape, data.dtype, 1)
    least = int(re.findall(r"\d+", str(refused.value))[0])
    check_smallest(data.shape, data.dtype, least)
    with pytest.raises(TooLittleMemory):
        check_smallest(data.shape, data.dtype, least - 1)
    camera = jv.Camera.looking_at(jv.Volume(data), size=(8, 8))
    stream = bricks_of(source_of(data), soft_transfer(), camera, jv.March(1e-3), memory=10**9)
    with pytest.raises(TooLittleMemory):
        split(data.shape, data.dtype, least - 1, stream.margin, None)


def test_a_cache_that_is_none_is_named_before_anything_is_planned(scene, monkeypatch):
    monkeypatch.setattr(PLANNING, "plan_in_memory", None)
    with pytest.raises(ValueError, match="cache must be"):
        jv.plan(np.zeros((8, 8, 8)), scene[2], scene[3], TOLERANCE, memory=10**6, cache=7)


def test_what_is_no_volume_is_named(scene):
    with pytest.raises(ValueError, match=r"no file no_such\.raw"):
        planned(scene, 10**9, "no_such.raw")
    wrong: Any
    for wrong in (3, {"depth": 8}):
        with pytest.raises(ValueError, match="source must be a dictionary of options, of shape, dtype"):
            jv.plan(np.zeros((8, 8, 8)), scene[2], scene[3], TOLERANCE, memory=10**6, source=wrong)
    with pytest.raises(ValueError, match=r"memory must be an integer of at least 1; got 1\.5"):
        planned(scene, 1.5)
