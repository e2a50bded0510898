"""Does a plan with a budget choose bricks where they are needed, and only there?"""

import sys
from typing import Any

import numpy as np
import pytest

import jaxvol as jv
from jaxvol.bricks import source_of
from jaxvol.compositing.blending import Over
from jaxvol.metrics import rmse
from jaxvol.planning.memory import IN_MEMORY, read_within, with_bricks
from jaxvol.planning.plan import chosen_transforms

from ..scenes import around, scaled_phantom, soft_transfer


TOLERANCE = 0.02
VOLUME = scaled_phantom("sphere", 48)


@pytest.fixture
def path(tmp_path):
    np.save(tmp_path / "ball.npy", np.asarray(VOLUME.data))
    return tmp_path / "ball.npy"


def planned(thing, memory) -> jv.Plan:
    return jv.plan(thing, soft_transfer(), around(VOLUME), TOLERANCE, memory=memory)


def placed(path):
    return source_of(path, spacing=VOLUME.spacing, origin=VOLUME.origin)


def test_bricks_are_planned_where_the_volume_does_not_fit(path):
    volume, source, room, stride = read_within(placed(path), IN_MEMORY * VOLUME.data.nbytes)
    assert (volume.shape, stride) == (VOLUME.shape, 1)
    copy, source, room, stride = read_within(placed(path), IN_MEMORY * VOLUME.data.nbytes // 8)
    assert (copy.shape, stride) == ((24, 24, 24), 2)
    march = jv.March(0.02, (jv.Jitter(0),))
    given = source, soft_transfer(), around(VOLUME), march, stride
    finer, bricks = with_bricks(*given, memory=room, compositing=Over(), lighting=None)
    assert np.prod(bricks.counts) > 1
    assert float(finer.step) <= float(march.step) / 2
    assert finer.transforms == march.transforms
    found = jv.Plan(finer, copy, None, TOLERANCE, 0.01, 9.0, (), 0.0, Over(), source, room)
    assert "in memory" in str(found)
    found = found._replace(stride=stride, bricks=bricks)
    assert f"at most {bricks.needed} are read" in str(found)


def test_a_copy_does_not_prove_that_nothing_is_empty():
    for visible in (True, False):
        blocks = np.full((12, 12, 12), visible)
        own, _ = chosen_transforms(blocks, ())
        assert any(isinstance(each, jv.SpaceLeaping) for each in own) != visible
        found, parts = chosen_transforms(blocks, (), copy=True)
        assert [type(each).__name__ for each in found] == ["SpaceLeaping", "AlphaCorrection"]
        assert all(part.kept for part in parts)
        assert [part.why for part in parts].count("not proven by a copy; kept") == visible


@pytest.mark.slow
def test_a_plan_by_bricks_keeps_its_tolerance_and_its_memory(path):
    memory, given = IN_MEMORY * VOLUME.data.nbytes // 8, (soft_transfer(), around(VOLUME, (64, 48)))
    found = planned(placed(path), memory)
    image = found.render(*given)
    assert found.bricks is not None
    assert image.bricks.counts == found.bricks.counts
    assert image.bricks.loads <= found.bricks.needed == image.bricks.needed
    assert image.bricks.bytes_held == found.bricks.bytes_held <= memory
    fine = jv.March(float(VOLUME.spacing.min()) / 16, (jv.AlphaCorrection(),), "preintegrated")
    assert rmse(image.image(), jv.render(VOLUME, *given, fine).image()) <= TOLERANCE


def test_a_plan_without_parts_is_printed_and_rendered():
    march = jv.March(0.1, max_samples=4)
    found = jv.Plan(march, VOLUME, None, TOLERANCE, 0.01, 9.0, (), 0.0)
    assert "step 0.1" in str(found)
    given = soft_transfer(), around(VOLUME)
    image = jv.render(VOLUME, *given, march)
    np.testing.assert_array_equal(found.render(*given).rgba, image.rgba)
    with pytest.raises(ValueError, match=r"transfer must be .* That is the camera"):
        found.render(*given[::-1])
    with pytest.raises(ValueError, match="options must be outputs and devices; got output"):
        found.render(*given, output="rgba")


BAD: list[tuple[Any, Any, str]] = [
    (None, 100, r"memory must hold a copy of 2 voxels along each axis.* got 100 bytes"),
    (np.zeros((4, 512, 512), np.uint8), 500_000, "memory must hold a copy of 2 voxels along each axis"),
    (None, 1.5, r"memory must be an integer of at least 1, a number of bytes; got 1\.5"),
    ("no_such.raw", 10**9, r"no file no_such\.raw"),
    (3, None, "source must be an array, a Volume, a VoxelSource or a path"),
]


@pytest.mark.parametrize(("source", "memory", "message"), BAD)
def test_bad_arguments_are_named_before_anything_is_planned(source, memory, message, path, monkeypatch):
    monkeypatch.setattr(sys.modules["jaxvol.planning.plan"], "Probe", None)
    with pytest.raises(ValueError, match=message):
        planned(path if source is None else source, memory)
