"""Transfer functions per label, and cells cut at the boundaries between labels."""

import numpy as np
import pytest

import jaxvol as jv

from .scenes import slow


def plain(color, extinction):
    """The same colour and extinction for every value."""
    return jv.TransferFunction([0.0, 255.0], [color, color], [extinction, extinction])


def layers(*widths):
    """A block of layers labelled 0, 1, … along x; `widths` in nodes."""
    labels = np.repeat(np.arange(len(widths)), widths).astype(np.uint8)[:, None, None] * np.ones(
        (1, 3, 3), np.uint8
    )
    return jv.Volume(np.full(labels.shape, 100, np.uint8), labels=labels)


RED, GREEN, BLUE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


LEFT = np.exp(-0.35)
RED_THEN_BLUE = LEFT * np.array([1 / LEFT - 1, 0, 1 - np.exp(-0.8), 1 / LEFT - np.exp(-0.8)])
"""Colour and opacity of a red layer (length 3.5, extinction 0.1) in front of a blue one (4, 0.2)."""


def along_x(volume, transfer, march, y=1.0):
    return jv.render_rays(volume, transfer, [[-1.0, y, 1.0]], [[1.0, 0.0, 0.0]], march)


def test_each_label_has_its_own_function_and_others_are_not_seen():
    volume = layers(4, 4, 4, 4)  # label 3 has no function
    transfer = jv.LabelTransferFunction([plain(RED, 0.1), None, plain(BLUE, 0.2)])
    # nodes 0..15; label boundaries half-way between nodes, at 3.5, 7.5 and 11.5
    fine = jv.March(0.01, (jv.AlphaCorrection(labels=True),))
    np.testing.assert_allclose(along_x(volume, transfer, fine).rgba[0], RED_THEN_BLUE, atol=1e-5)


def test_functions_may_be_named_by_label_and_differ_in_points():
    volume = layers(4, 4, 4, 4)
    three = jv.TransferFunction([0.0, 50.0, 255.0], [BLUE] * 3, [0.0, 0.2, 0.2])
    fine = jv.March(0.01, (jv.AlphaCorrection(labels=True),))
    named = jv.LabelTransferFunction({np.uint8(2): three, 0: plain(RED, 0.1)})
    # also beyond the end points
    for value in (100, 300):
        data = jv.Volume(np.full(volume.shape, value, np.uint16), labels=volume.labels)
        np.testing.assert_allclose(along_x(data, named, fine).rgba[0], RED_THEN_BLUE, atol=1e-5)


@pytest.mark.parametrize("quadrature", ["midpoint", *slow("left", "preintegrated")])
@pytest.mark.parametrize("step", [0.3, 0.77, 2.9])
@pytest.mark.parametrize("jittered", [pytest.param(False, marks=pytest.mark.slow), True])
def test_cells_are_cut_at_labels_and_exact_at_any_step(step, quadrature, jittered):
    volume = layers(4, 5, 6)
    transfer = jv.LabelTransferFunction([plain(RED, 0.1), plain(GREEN, 0.3), plain(BLUE, 0.2)])
    transforms = (jv.Jitter(0, front_residual=True),) if jittered else ()
    march = jv.March(step, (*transforms, jv.AlphaCorrection(labels=True)), quadrature)
    rgba = along_x(volume, transfer, march).rgba[0]
    depths = np.array([3.5 * 0.1, 5 * 0.3, 5.5 * 0.2])  # boundaries at 3.5 and 8.5, exit at 14
    before = np.exp(-np.concatenate([[0], np.cumsum(depths)[:-1]]))
    np.testing.assert_allclose(rgba[:3], before * (1 - np.exp(-depths)), atol=2e-5)


def test_a_layer_within_one_cell_is_found():
    volume = layers(4, 1, 6)  # label 1 from 3.5 to 4.5
    transfer = jv.LabelTransferFunction([plain(RED, 0.1), plain(GREEN, 0.9), plain(BLUE, 0.1)])
    march = jv.March(3.0, (jv.AlphaCorrection(labels=True),))
    rgba = along_x(volume, transfer, march).rgba[0]
    np.testing.assert_allclose(rgba[1], np.exp(-0.35) * (1 - np.exp(-0.9)), atol=2e-5)


def test_without_cutting_the_face_lies_where_the_samples_happen_to_be():
    volume = layers(4, 5, 6)
    transfer = jv.LabelTransferFunction([plain(RED, 0.1), plain(GREEN, 0.3), plain(BLUE, 0.2)])
    rgba = along_x(volume, transfer, jv.March(0.77, (jv.AlphaCorrection(),))).rgba[0]
    assert abs(float(rgba[0]) - (1 - np.exp(-0.35))) > 0.02


def label_runs(volume, camera, steps=1500):
    """World length of the shortest run of one label along each pixel's ray, by dense sampling."""
    origins, directions = (np.asarray(part, np.float64).reshape(-1, 3) for part in camera.rays())
    low, high = (np.asarray(corner, np.float64) for corner in volume.corners)
    middle = np.linalg.norm(np.asarray(camera.position) - (low + high) / 2)
    radius = np.linalg.norm(high - low) / 2
    t = np.linspace(middle - radius, middle + radius, steps)
    labels = np.asarray(volume.labels)
    shortest = np.full(len(origins), np.inf)
    for i, (o, d) in enumerate(zip(origins, directions, strict=True)):
        where = np.floor((o + t[:, None] * d - low) / np.asarray(volume.spacing) + 0.5).astype(int)
        inside = ((where >= 0) & (where < labels.shape)).all(axis=1)
        seen = labels[tuple(where[inside].T)]
        faces = np.flatnonzero(np.diff(seen))
        if len(faces):
            shortest[i] = np.diff(faces).min(initial=steps) * (t[1] - t[0])
    return shortest.reshape(camera.size[::-1])


@pytest.mark.slow
def test_faces_of_a_frog_stay_smooth_under_jitter():
    frog = jv.phantom("labels", 64)
    tissue = {1: (GREEN, 0.2), 2: (RED, 3.0), 3: (RED, 3.0), 4: ((0.4, 0.1, 0.1), 4.0), 5: (BLUE, 3.0)}
    transfer = jv.LabelTransferFunction([None, *(plain(*tissue[label]) for label in range(1, 6))])
    camera = jv.Camera.looking_at(frog, (0.4, -0.6, 0.9), size=(56, 56)).zoom(2.2)
    exact = jv.render(frog, transfer, camera, jv.March(2e-4, (jv.AlphaCorrection(labels=True),)))
    step = 0.016  # half a voxel

    def error(alignment):
        rendering = jv.render(frog, transfer, camera, jv.March(step, (jv.Jitter(0), alignment)))
        return np.abs(np.asarray(rendering.rgba - exact.rgba)).max(axis=-1)

    jittered, cut = error(jv.AlphaCorrection()), error(jv.AlphaCorrection(labels=True))
    # pixels whose rays cross label boundaries, without runs shorter than the documented limit
    runs = label_runs(frog, camera)
    boundary = np.isfinite(runs) & (runs > step / 2)
    assert boundary.sum() > 200
    rms = [np.sqrt(np.mean(e[boundary] ** 2)) for e in (jittered, cut)]
    assert rms[1] < rms[0] / 10
    # even including grazing rays and voxel corners, the error falls
    assert cut.mean() < jittered.mean() / 3


UNLABELLED = jv.Volume(np.zeros((4, 3, 3), np.uint8))
ONE = plain(RED, 1.0)
CUTTING = jv.March(0.1, (jv.AlphaCorrection(labels=True),))
BAD = {
    "no function": (lambda: jv.LabelTransferFunction([None]), "functions must hold a TransferFunction"),
    "one bare": (lambda: jv.LabelTransferFunction(ONE), "{label: TransferFunction}.*got a TransferFunction"),
    "no label": (lambda: jv.LabelTransferFunction({"liver": ONE}), "functions' label must be .*got 'liver'"),
    "negative": (lambda: jv.LabelTransferFunction({-1: ONE}), "functions' label must be .*got -1"),
    "a colour": (lambda: jv.LabelTransferFunction([ONE, "red"]), r"functions\[1\] must be .*got 'red'"),
    "many labels": (lambda: jv.LabelTransferFunction([ONE] * 257), "of labels 0 to 255; got 257"),
    "no labels to classify by": (
        lambda: along_x(UNLABELLED, jv.LabelTransferFunction([ONE]), jv.March(0.1)),
        "labels are needed here",
    ),
    "no labels to cut at": (lambda: along_x(UNLABELLED, ONE, CUTTING), "labels are needed here"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    make, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        make()
