"""Does a plan with a budget choose bricks where they are needed, and only there?"""

import sys
from typing import Any

import numpy as np
import pytest

import jaxvol as jv
from jaxvol.bricks.plan import IN_MEMORY
from jaxvol.metrics import rmse

from ..scenes import around, scaled_phantom, soft_transfer


TOLERANCE = 0.02
PARTS = (jv.planning.Part("SpaceLeaping", False, "nothing is empty"),)
PLANNING = sys.modules["jaxvol.bricks.plan"]  # the name is that of a function, too
VOLUME = scaled_phantom("sphere", 48)


@pytest.fixture
def path(tmp_path):
    np.save(tmp_path / "ball.npy", np.asarray(VOLUME.data))
    return tmp_path / "ball.npy"


def planned(thing, memory, **options) -> jv.BudgetPlan:
    place = {"spacing": VOLUME.spacing, "origin": VOLUME.origin}
    return jv.plan(thing, soft_transfer(), around(VOLUME), TOLERANCE, memory=memory, **place, **options)


def test_bricks_are_planned_where_the_volume_does_not_fit(path, monkeypatch):
    """What is planned in memory is planned there: here, always the same march."""
    march = jv.March(0.02, (jv.Jitter(0),))
    monkeypatch.setattr(
        PLANNING,
        "plan_in_memory",
        lambda copy, *_, **__: jv.Plan(march, copy, None, TOLERANCE, 0.01, 0.1, 9.0, PARTS, 0.0),
    )
    found = planned(path, IN_MEMORY * VOLUME.data.nbytes)
    assert (found.counts, found.stride) == (None, 1)
    assert found.plan.volume.shape == VOLUME.shape
    assert "in memory" in str(found)
    found = planned(path, IN_MEMORY * VOLUME.data.nbytes // 8)
    assert found.stride == 2
    assert found.plan.volume.shape == (24, 24, 24)
    assert np.prod(found.counts or ()) > 1
    assert {type(each) for each in found.march.transforms} == {jv.Jitter, jv.AlphaCorrection, jv.SpaceLeaping}
    assert float(found.march.step) <= float(march.step) / 2
    assert f"at most {found.loads} are read" in str(found)
    assert found.plan.parts[0].kept  # a copy does not prove that nothing is empty


@pytest.mark.slow
def test_a_plan_by_bricks_keeps_its_tolerance_and_its_memory(path):
    memory, given = IN_MEMORY * VOLUME.data.nbytes // 8, (soft_transfer(), around(VOLUME, (64, 48)))
    found = planned(path, memory)
    image = found.render(*given)
    assert image.bricks.counts == found.counts
    assert image.bricks.loads <= found.loads == image.bricks.needed
    assert image.bricks.bytes_read <= found.bytes_read
    assert image.bricks.bytes_held <= memory
    fine = jv.March(float(VOLUME.spacing.min()) / 16, (jv.AlphaCorrection(),), "preintegrated")
    assert rmse(image.image(), jv.render(VOLUME, *given, fine).image()) <= TOLERANCE


BAD: list[tuple[Any, Any, dict[str, Any], str]] = [
    (None, 100, {}, r"memory must be at least \d+ bytes, which the smallest bricks take.* Got 100\."),
    (np.zeros((4, 512, 512), np.uint8), 500_000, {}, "memory must hold a copy of 2 voxels along each axis"),
    (None, 1.5, {}, r"memory must be an integer of at least 1; got 1\.5"),
    ("no_such.raw", 10**9, {}, r"no file no_such\.raw"),
    (None, 10**6, {"source": 3}, "source must be a dictionary of options, of shape, dtype"),
    (None, 10**6, {"source": {"depth": 8}}, "source must be a dictionary of options, of shape, dtype"),
]


@pytest.mark.parametrize(("source", "memory", "options", "message"), BAD)
def test_bad_arguments_are_named_before_anything_is_planned(
    source, memory, options, message, path, monkeypatch
):
    monkeypatch.setattr(PLANNING, "plan_in_memory", None)
    with pytest.raises(ValueError, match=message):
        planned(path if source is None else source, memory, **options)
