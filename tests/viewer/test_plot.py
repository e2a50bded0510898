"""Does the plot beside the controls show how often values occur, and how opaque they are?"""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

import jaxvol as jv
from jaxvol.viewer.curve import Curve
from jaxvol.viewer.plot import BINS, HEIGHT, WIDTH, Histogram
from jaxvol.viewer.table import Table


VALUES = np.r_[np.zeros(700), np.full(299, 50), 100].reshape(10, 10, 10).astype(np.uint8)
"""Many of 0, fewer of 50, one of 100."""

HISTOGRAM = Histogram.of(jv.Volume(VALUES))
LOOK = jv.TransferFunction.from_points([(0, (1, 0, 0), 0.0), (50, (0, 1, 0), 0.25), (200, (0, 0, 1), 1.0)])


def elements(svg, kind):
    return [e for e in ElementTree.fromstring(svg).iter() if e.tag.endswith(f"}}{kind}")]


def number(element, name):
    return float(element.get(name, "nan"))


def test_columns_are_the_logarithms_of_counts():
    assert (HISTOGRAM.low, HISTOGRAM.high) == (0, 100)
    heights = np.zeros(BINS)
    heights[[0, BINS // 2, -1]] = np.log1p([700, 299, 1]) / np.log1p(700)
    np.testing.assert_allclose(HISTOGRAM.heights, heights)
    same = Histogram.of(jv.Volume(np.full((3, 3, 3), 7.0, np.float32)))
    assert same.low < same.high
    assert max(same.heights) == 1


def test_a_point_stands_at_its_value_and_the_root_of_its_opacity():
    curve = Curve.of(LOOK, 1.0)
    svg = HISTOGRAM.plot(curve)
    first, second = elements(svg, "circle")  # the third lies beyond the volume's values
    assert (number(first, "cx"), number(first, "cy")) == (0, HEIGHT)
    assert number(second, "cx") == WIDTH / 2
    top = HEIGHT - number(second, "cy")
    assert second.get("fill") == "#00ff00"
    (line,) = elements(svg, "polyline")
    places = np.array([list(map(float, pair.split(","))) for pair in line.get("points", "").split()])
    assert np.all(np.diff(places[:, 0]) >= 0)
    # the curve goes through the point, and where the extinction is half-way, as the opacity there
    rises = HEIGHT - np.interp([WIDTH / 4, WIDTH / 2], *places.T)
    assert rises[1] == pytest.approx(top, abs=0.1)
    assert rises[0] / rises[1] == pytest.approx(np.sqrt((1 - np.sqrt(0.75)) / 0.25), abs=0.01)


def test_of_what_has_no_points_the_range_is_shown():
    table = Table.of(jv.TransferFunction2D.from_transfer(LOOK, (1.0, 2.0)))
    ends = elements(HISTOGRAM.plot(table), "line")
    assert [number(end, "x1") for end in ends] == [0, WIDTH]
    many = Curve.of(jv.colormap("gray", (0, 100), n_colors=40), 1.0)
    assert not elements(HISTOGRAM.plot(many), "circle")
    assert not re.search("nan|inf", HISTOGRAM.plot(many))
