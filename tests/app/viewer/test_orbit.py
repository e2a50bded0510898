"""Does the camera move as the pointer wants it to?"""

import math
from dataclasses import replace

import jax
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.app.viewer.marks import AXES, MARGIN, PICKED, with_marks
from jaxvol.app.viewer.state import STEEPEST, Orbit

from .test_model import begun


START = Orbit.at((5.0, -3.0, 2.0), (1.0, 2.0, 0.5), (0.0, 0.0, 2.0), 40.0)

HEIGHT = 400
"""Pixels of the view."""


def pixel(orbit: Orbit, point) -> np.ndarray:
    """Where a world point appears: (x, y) from the middle of the view, to the right and down, in heights."""
    forward = -orbit.toward
    right = np.cross(forward, orbit.view_up)
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    offset = np.asarray(point) - orbit.position
    scale = 2 * math.tan(math.radians(orbit.view_angle) / 2) * (offset @ forward)
    return np.array([offset @ right, -(offset @ up)]) / scale


@pytest.mark.parametrize("drag", [(0.01, 0.0), (0.0, 0.01), (-0.004, 0.007)])
def test_the_front_of_what_is_seen_follows_a_drag(drag):
    front = START.focal_point + 0.5 * START.toward
    moved = pixel(START.turned(*drag), front) - pixel(START, front)
    assert np.dot(moved, drag) > 0.99 * np.linalg.norm(moved) * np.linalg.norm(drag)


def test_half_a_turn_for_a_drag_over_the_height():
    turned = START.turned(1.0, 0.0)
    level, was = (v - (v @ START.view_up) * START.view_up for v in (turned.toward, START.toward))
    np.testing.assert_allclose(level, -was, atol=1e-12)
    assert turned.distance == START.distance
    assert turned.toward @ START.view_up == pytest.approx(START.toward @ START.view_up)


def test_a_camera_stops_short_of_the_pole_and_comes_back():
    over = START.turned(0.0, 5.0)
    assert math.asin(over.toward @ START.view_up) == pytest.approx(STEEPEST)
    over.camera((8, 8))  # a legal camera
    back = over.turned(0.0, -(STEEPEST - math.asin(START.toward @ START.view_up)) / math.pi)
    np.testing.assert_allclose(back.toward, START.toward, atol=1e-6)


def test_a_camera_that_looks_along_the_axis_is_turned_away_from_it():
    above = Orbit.at((0, 0, 5), (0, 0, 0), (0, 0, 1), 30)
    above.camera((8, 8))
    assert np.isfinite(above.turned(0.1, 0.1).toward).all()


@pytest.mark.parametrize("drag", [(0.1, 0.0), (0.0, 0.1), (-0.3, 0.2)])
def test_what_is_panned_stays_under_the_pointer(drag):
    moved = pixel(START.panned(*drag), START.focal_point) - pixel(START, START.focal_point)
    np.testing.assert_allclose(moved, drag, atol=1e-12)


def test_a_zoom_magnifies_what_is_at_the_focal_point():
    beside = START.focal_point + 1e-3 * np.cross(START.toward, START.view_up)
    grown = pixel(START.zoomed(3.0), beside) / pixel(START, beside)
    assert grown[0] == pytest.approx(3.0, rel=1e-5)


def test_the_camera_is_that_of_the_renderer():
    camera = jv.Camera((5, -3, 2), (1, 2, 0.5), (0, 0, 1), 40, size=(HEIGHT, HEIGHT))
    orbit = Orbit.at(camera.position, camera.focal_point, camera.view_up, 40)
    again = orbit.camera((HEIGHT, HEIGHT))
    ray = jax.jit(lambda camera: camera.ray(30, 70))
    origin, direction = (np.asarray(part) for part in ray(again))
    np.testing.assert_allclose((origin, direction), ray(camera), atol=1e-6)
    # and so are the pixels of `pixel`
    x, y = pixel(orbit, origin + 3 * direction)
    np.testing.assert_allclose([x * HEIGHT, y * HEIGHT], [30.5 - HEIGHT / 2, 70.5 - HEIGHT / 2], atol=1e-2)


def test_marks_lie_where_the_camera_sees_the_point_and_the_axes():
    point, orbit = np.array([1.5, 1.0, 0.9]), START
    state = replace(begun()[1], orbit=orbit, size=(600, HEIGHT), point=point)
    image = with_marks(np.full((HEIGHT // 2, 300, 3), 255, np.uint8), state)  # of half the resolution
    near = [np.abs(image.astype(int) - color).sum(-1) < 9 for color in (PICKED, AXES[0][1])]
    yellow, red = (2 * np.argwhere(each).mean(axis=0)[::-1] for each in near)
    np.testing.assert_allclose(yellow, np.array([300, HEIGHT / 2]) + HEIGHT * pixel(orbit, point), atol=1.5)
    x_axis, along = pixel(orbit, np.add(orbit.focal_point, (1e-3, 0, 0))), red - (MARGIN, HEIGHT - MARGIN)
    assert along @ x_axis > 0.95 * np.linalg.norm(along) * np.linalg.norm(x_axis)
    small = replace(state, size=(300, 100))
    assert np.all(with_marks(np.full((100, 300, 3), 255, np.uint8), small) == 255)
