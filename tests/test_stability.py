"""Is the edge of each entry of the failure atlas still where it was? And does the page show all of them?"""

import re
from pathlib import Path
from typing import NamedTuple

import pytest

from experiments import atlas, record
from experiments.atlas.entry import Edge, edge, sweep
from experiments.atlas.page import method


ROOT = Path(__file__).parent.parent
POINTER = re.compile(r'`experiments/stability\.py`,\s+((?:"[^"]+",?\s*)+)')
"""How docstrings point to entries."""


class Pin(NamedTuple):
    """A sweep around an edge: values within the limit and beyond it, and what is measured at each."""

    within: dict[float, float]
    beyond: dict[float, float] | None = None


PINS = {
    "wood grain without empty samples": Pin({0.05: 0.00152}, {0.4: 0.3526}),
    "jitter on cut faces": Pin({0.5: 0.001935}, {1.5: 0.005688}),
    "jitter at label faces": Pin({0.03: 0.002897}, {0.06: 0.005679}),
    "sheets thinner than a step": Pin({1.02: 0.0}, {0.98: 0.0227}),
    "jitter offsets near 1": Pin({1.0: 0.0, 0.5: 0.0, 2.0**-24: 0.0}),
    "gradients of opaque rays": Pin({14.0: 0.00353}, {16.5: 0.345}),
    "extinction without bound": Pin({1.0: 0.0, 1e6: 0.0, 1e38: 0.0}),
    "grazing exits": Pin({0.9: 0.0, 1e-4: 0.0, 2e-7: 0.0}),
    "exits at the end of a cell": Pin({0.5: 0.0, 1e-5: 0.0, 0.0: 0.0}),
    "early termination in gradients": Pin({5e-5: 0.01822}, {2e-4: 0.06258}),
    "tolerances finer than the finest cell": Pin({0.01: 0.5795}, {0.004: 1.398}),
    "adaptive strides under light": Pin({0.005: 0.6104}, {0.002: 1.526}),
    "sheets thinner than a cell of rays": Pin({0.9: 0.0}, {0.75: 0.0835, 0.5: 0.332}),
    "occupancy under steep transfer functions": Pin({2.0**22: 0.0, 1.0: 0.0}),
    "gradients of what is leapt over": Pin({1e-2: 0.0, 1e-24: 0.0}, {0.0: 0.987}),
    "voxels of 16-bit floats": Pin({300.0: 0.000616}, {1e4: 0.0156}),
    "rays of very many samples": Pin({30.0: 0.0, 1e4: 0.0}),
    "rays that run out of samples": Pin({131072.0: 0.0}, {1.5e5: 0.0229}),
    "gradients at label faces": Pin({1.2: 0.0787}, {1.5: 0.171}),
    "jitter behind cuts": Pin({0.02: 0.0031}, {0.04: 0.00532}),
    "gaps of rays under a toroidal map": Pin({3e-3: -0.0034}, {1e-3: 1.0}),
    "rays near the motor axis": Pin({1.0: 0.0, 1e-20: 0.0, 0.0: 0.0}),
    "wrong order": Pin({0.1: 0.000742}, {0.3: 0.00606}),
    "overlap under k": Pin({1.0: 1e-6}, {0.9: 0.6995}),
    "isosurfaces of thin sheets": Pin({1.02: 0.0}, {0.98: 0.02}),
    "energy of templates as printed": Pin({0.45: 0.697}, {0.55: 1.02}),
    "lopsided templates": Pin({2.0: 0.738}, {1.0: 1.32}),
    "long mean free paths": Pin({0.5: 0.152}, {2.0: 0.286}),
    "short mean free paths": Pin({0.2: 0.306}, {0.1: 0.39}),
    "normals in noise": Pin({0.3: 8.3}, {1.0: 26.0}),
    "fits of what images do not show": Pin({0.0: 0.0}, {1.0: 4.0, 2.0: 8.0}),
    "fits from opaque starts": Pin({1e3: 0.0}, {1e4: 0.00344}),
    "fits under noise": Pin({0.003: 0.0167}, {0.03: 0.116}),
}

RELATIVE, ABSOLUTE = 0.1, 2e-5
"""How far a pinned number may move."""

SLOW = {
    "gradients at label faces",
    "jitter at label faces",
    "lopsided templates",
    "tolerances finer than the finest cell",
    "gradients of what is leapt over",
    "wood grain without empty samples",
    "gaps of rays under a toroidal map",
    "wrong order",
    "overlap under k",
    "voxels of 16-bit floats",
    "jitter offsets near 1",
    "extinction without bound",
    "occupancy under steep transfer functions",
    "early termination in gradients",
    "adaptive strides under light",
    "sheets thinner than a cell of rays",
    "rays near the motor axis",
    "energy of templates as printed",
    "long mean free paths",
    "short mean free paths",
    "fits of what images do not show",
    "fits from opaque starts",
    "fits under noise",
}
"""Entries whose programs take long to compile or to run."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in PINS]
)
def test_edge_is_where_it_was(name):
    entry, pin = atlas.ENTRIES[name], PINS[name]
    beyond = pin.beyond or {}
    expected = {**pin.within, **beyond}
    found = sweep(entry, entry.size, list(expected))
    within = list(pin.within)[-1] if pin.within else None
    first = next(iter(beyond), None)
    assert found["edge"] == {"within": within, "beyond": first}
    judged = found["curves"][entry.judged]
    assert judged == pytest.approx(list(expected.values()), rel=RELATIVE, abs=ABSOLUTE, nan_ok=True)
    if entry.said is not None:  # jaxvol speaks up beyond the edge, and only there
        assert found["curves"][entry.said] == [0.0] * len(pin.within) + [1.0] * len(beyond)


def test_every_entry_is_pinned_and_on_both_sides_of_its_edge():
    assert set(PINS) == set(atlas.ENTRIES)
    for name, pin in PINS.items():
        entry = atlas.ENTRIES[name]
        assert pin.within or pin.beyond
        assert bool(pin.beyond) == (entry.outcome != "bounded"), name
        if entry.outcome == "detected and said":
            assert entry.said is not None, name


def test_an_edge_is_the_first_value_beyond_the_limit():
    assert edge([1, 2, 3, 4], [0, 1, 5, 0], 1) == Edge(2, 3)
    assert edge([1, 2, 3], [0, 1, 1], 1) == Edge(3, None)
    assert edge([1, 2, 3], [2, 0, 0], 1) == Edge(None, 1)
    assert edge([1, 2], [0, float("nan")], 1) == Edge(1, 2)


def pointers():
    """Names of entries that docstrings of jaxvol mention, by file."""
    for path in sorted((ROOT / "jaxvol").rglob("*.py")):
        for found in POINTER.findall(path.read_text(encoding="utf-8")):
            for name in re.findall(r'"([^"]+)"', found):
                yield path.relative_to(ROOT).as_posix(), " ".join(name.split())


def test_docstrings_point_to_entries_that_exist_and_each_entry_is_pointed_to():
    mentioned = list(pointers())
    assert {name for _, name in mentioned} == set(atlas.ENTRIES)
    for name, entry in atlas.ENTRIES.items():
        documented = " ".join((method(entry.method).__doc__ or "").split())
        assert "experiments/stability.py" in documented, name
        assert f'"{name}"' in documented, name


def test_record_holds_every_entry_with_the_edge_of_its_own_curve():
    entries = record.read(record.RESULTS / "stability.json")["result"]["entries"]
    assert list(entries) == list(atlas.ENTRIES)
    for name, found in entries.items():
        entry = atlas.ENTRIES[name]
        assert tuple(found["values"]) == entry.values
        again = edge(found["values"], found["curves"][entry.judged], entry.limit)
        assert again._asdict() == found["edge"]
        assert (found["edge"]["beyond"] is None) == (entry.outcome == "bounded"), name
        if entry.said is not None:
            beyond = [not number <= entry.limit for number in found["curves"][entry.judged]]
            assert [bool(said) for said in found["curves"][entry.said]] == beyond, name


def test_page_shows_every_entry_without_scripts_or_other_files():
    text = (record.RESULTS / "stability.html").read_text(encoding="utf-8")
    assert len(text) < 3e6
    for name in atlas.ENTRIES:
        assert f">{name}</h3>" in text
    assert "<script" not in text
    assert re.findall(r'src="(?!data:image/png;base64,)', text) == []
    assert text.count('src="data:image/png') == 3 * len(atlas.ENTRIES)  # a curve and two pictures each
    for link in set(re.findall(r'href="(?!#)([^"]+)"', text)):
        assert (record.RESULTS / link).is_file(), link


@pytest.mark.parametrize("name", list(atlas.ENTRIES))
def test_name_is_a_stable_plain_string(name):
    assert re.fullmatch(r"[a-z0-9 ,-]+", name)
    assert atlas.ENTRIES[name].question.endswith("?")
