"""Does a transfer function that is guessed from a histogram show what is there?"""

import numpy as np
import pytest

import jaxvol as jv
from jaxvol.automatic import INSIDE, labels_shown, thresholds, visible_box
from jaxvol.lighting import Phong


MARCH = (jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination())


def ball(radius, inner, n=32, *, noise=2.0, spacing=1.0, at=0.0):
    """A ball of value 100 around a dense one of value 200, in noise around 10."""
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij")
    r = np.sqrt((x - at) ** 2 + y**2 + z**2)
    data = (
        10 + 90 * np.clip((radius - r) * n / 4 + 0.5, 0, 1) + 100 * np.clip((inner - r) * n / 4 + 0.5, 0, 1)
    )
    rng = np.random.default_rng(0)
    return jv.Volume(
        (data + noise * rng.standard_normal(data.shape)).clip(0, 255).astype(np.uint8), [spacing] * 3
    )


def opacity_at(transfer, value, length):
    return float(-np.expm1(-length * np.interp(value, transfer.values, transfer.extinction)))


def test_thresholds_part_three_classes():
    values = np.concatenate([np.full(900, 10.0), np.full(80, 100.0), np.full(20, 200.0)]).astype(np.float32)
    values += np.random.default_rng(0).normal(0, 3, values.shape).astype(np.float32)
    first, second = thresholds(values)
    assert first == pytest.approx(55, abs=2)  # in the middle, wherever between them
    assert second == pytest.approx(150, abs=2)


def test_what_is_around_is_transparent_and_what_is_dense_opaque():
    volume = ball(0.8, 0.35)
    transfer = jv.automatic_transfer(volume)
    across = float(np.linalg.norm(np.subtract(*volume.corners)))
    assert opacity_at(transfer, 10, across) == 0
    assert 0.2 < opacity_at(transfer, 100, 0.2 * across) < 0.95  # what is inside shines through
    assert opacity_at(transfer, 200, 0.1 * across) > 0.9
    camera = jv.Camera.looking_at(volume, size=(32, 32))
    rgba = np.asarray(
        jv.render(volume, transfer, camera, jv.March(0.4, MARCH, "midpoint"), lighting=Phong()).rgba
    )
    assert rgba[0, 0, 3] == 0
    assert rgba[16, 16, 3] > 0.95
    assert 0.1 < (rgba[..., 3] > 0.1).mean() < 0.5
    # the dense ball is brighter than what is around it
    assert rgba[16, 16, :3].mean() > 1.3 * np.median(rgba[..., :3].mean(-1)[rgba[..., 3] > 0.1])


def test_units_of_length_and_of_values_do_not_matter():
    volume, scaled = ball(0.8, 0.35), ball(0.8, 0.35, spacing=20.0)
    scaled = jv.Volume(np.asarray(scaled.data, np.float32) * 1000 - 7, scaled.spacing)
    one, other = jv.automatic_transfer(volume), jv.automatic_transfer(scaled)
    np.testing.assert_allclose(np.asarray(one.values) * 1000 - 7, other.values, rtol=0.02)
    np.testing.assert_allclose(one.extinction, 20 * np.asarray(other.extinction), rtol=1e-4)


def test_an_object_that_the_faces_cut_is_no_block():
    volume = ball(3.0, 0.35)
    transfer = jv.automatic_transfer(volume)
    across = float(np.linalg.norm(np.subtract(*volume.corners)))
    assert opacity_at(transfer, 100, across) < 0.5
    assert opacity_at(transfer, 200, 0.1 * across) > 0.9


@pytest.mark.parametrize("kinds", [1, 2, 3])
def test_volumes_of_few_values_are_shown_too(kinds):
    data = (np.arange(27) % kinds).astype(np.uint8).reshape(3, 3, 3)
    transfer = jv.automatic_transfer(jv.Volume(data))
    assert np.isfinite(np.asarray(transfer.extinction)).all()
    assert float(transfer.extinction.max()) > 0


def test_what_is_no_volume_is_named():
    with pytest.raises(ValueError, match="volume must be a jaxvol Volume"):
        jv.automatic_transfer(np.zeros((3, 3, 3)))


def test_the_box_holds_what_is_visible():
    volume = ball(0.3, 0.15, at=0.5)
    box = visible_box(volume, jv.automatic_transfer(volume))
    low, high = (np.asarray(corner) for corner in box.corners)
    middle = (low + high) / 2 / 31 * 2 - 1
    np.testing.assert_allclose(middle, (0.5, 0, 0), atol=0.06)
    assert ((high - low) / 31 * 2 > 0.55).all()
    assert ((high - low) / 31 * 2 < 0.85).all()
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    turned = jv.Volume(volume.data, volume.spacing, (5, 6, 7), direction=turn)
    there = visible_box(turned, jv.automatic_transfer(volume))
    np.testing.assert_allclose(there.center, turn @ np.asarray(box.center) + (5, 6, 7), atol=1e-4)


def labels(n=24):
    data = np.zeros((n, n, n), np.uint8)
    data[4:12, 4:-4, 4:-4], data[12:-4, 4:-4, 4:-4], data[10:14, 10:14, :4] = 2, 5, 7
    return data


def test_labels_are_shown_in_colours_of_their_own():
    shown = labels_shown(jv.Volume(labels()))
    assert shown is not None
    volume, transfer = shown
    assert np.asarray(volume.data).max() == INSIDE
    camera = jv.Camera.looking_at(volume, (0, -1, 0), size=(24, 24))
    march = jv.March(0.4, (jv.AlphaCorrection(labels=True), jv.EarlyTermination()), "midpoint")
    rgba = np.asarray(jv.render(volume, transfer, camera, march, lighting=Phong()).rgba)
    left, right = rgba[12, 9], rgba[12, 15]
    assert min(left[3], right[3]) > 0.9
    assert np.abs(left[:3] / left[:3].max() - right[:3] / right[:3].max()).max() > 0.5


@pytest.mark.parametrize("name", ["head", "engine", "colon", "vessels"])
def test_grey_values_are_not_taken_for_labels(name):
    assert labels_shown(jv.phantom(name, 24)) is None


def test_floats_two_values_and_many_are_no_labels():
    assert labels_shown(jv.Volume(labels().astype(np.float32))) is None
    assert labels_shown(jv.Volume((labels() > 0).astype(np.uint8))) is None
    assert labels_shown(jv.Volume(np.repeat(np.arange(128, dtype=np.uint8), 8).reshape(32, 8, 4))) is None
