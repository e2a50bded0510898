"""Is the edge of entries of the failure atlas where it is recorded, and does the record hold all of them?"""

import re
from operator import attrgetter
from pathlib import Path

import pytest

import jaxvol as jv
from experiments import atlas, record
from experiments.atlas.entry import Edge, edge, sweep

from .scenes import slow


ROOT = Path(__file__).parent.parent
RECORDED = record.read(record.RESULTS / "stability.json")["result"]["entries"]

RELATIVE, ABSOLUTE = 0.1, 2e-5
"""How far a recorded number may move."""

PROMISED = sorted(name for name, entry in atlas.ENTRIES.items() if entry.outcome != "documented")
"""Entries in which jaxvol holds, or says that it does not; the others only show where a method ends."""
QUICK = ["distance maps along a wall", "rays that run out of samples"]


@pytest.mark.parametrize("name", [*QUICK, *slow(*(name for name in PROMISED if name not in QUICK))])
def test_edge_is_where_it_was(name):
    entry, then = atlas.ENTRIES[name], RECORDED[name]
    at = [value for value in then["edge"].values() if value is not None]
    found = sweep(entry, entry.size, at)
    assert found["edge"] == then["edge"]
    judged, expected = found["curves"][entry.judged], then["curves"][entry.judged]
    expected = [expected[then["values"].index(value)] for value in at]
    assert judged == pytest.approx(expected, rel=RELATIVE, abs=ABSOLUTE, nan_ok=True)
    if entry.said is not None:  # jaxvol speaks up beyond the edge, and only there
        assert found["curves"][entry.said] == [0.0, 1.0][: len(at)]


def test_an_edge_is_the_first_value_beyond_the_limit():
    assert edge([1, 2, 3, 4], [0, 1, 5, 0], 1) == Edge(2, 3)
    assert edge([1, 2, 3], [0, 1, 1], 1) == Edge(3, None)
    assert edge([1, 2, 3], [2, 0, 0], 1) == Edge(None, 1)
    assert edge([1, 2], [0, float("nan")], 1) == Edge(1, 2)


def test_record_holds_every_entry_with_the_edge_of_its_own_curve():
    assert set(RECORDED) == set(atlas.ENTRIES)
    for name, found in RECORDED.items():
        entry = atlas.ENTRIES[name]
        assert found["shows"] == entry.shows
        assert ("pictured" in found) == (entry.picture is not None)
        shown = len(list((record.RESULTS / "stability").glob(f"{name.replace(' ', '-')}.*.webp")))
        assert shown == (0 if entry.picture is None else 2), name
        assert tuple(found["values"]) == entry.values
        again = edge(found["values"], found["curves"][entry.judged], entry.limit)
        assert again._asdict() == found["edge"]
        assert (found["edge"]["beyond"] is None) == (entry.outcome == "bounded"), name
        if entry.said is not None:
            beyond = [not number <= entry.limit for number in found["curves"][entry.judged]]
            assert [bool(said) for said in found["curves"][entry.said]] == beyond, name


def test_docstrings_point_to_entries_that_exist_and_each_entry_is_pointed_to():
    pointer = re.compile(r'`experiments/stability\.py`,\s+((?:"[^"]+",?\s*)+)')
    files = sorted((ROOT / "jaxvol").rglob("*.py"))
    groups = [group for path in files for group in pointer.findall(path.read_text(encoding="utf-8"))]
    assert {" ".join(n.split()) for g in groups for n in re.findall(r'"([^"]+)"', g)} == set(atlas.ENTRIES)
    for name, entry in atlas.ENTRIES.items():
        documented = " ".join((attrgetter(entry.method.removeprefix("jaxvol."))(jv).__doc__ or "").split())
        assert f'"{name}"' in documented.partition("experiments/stability.py")[2], name
