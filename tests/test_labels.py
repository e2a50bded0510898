"""Transfer functions per label, and cells cut at the boundaries between labels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.fitting.constraints import Free
from jaxvol.occupancy import Blocks

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


FINE = jv.March(0.01, (jv.AlphaCorrection(labels=True),))
THREE = [plain(RED, 0.1), plain(GREEN, 0.3), plain(BLUE, 0.2)]


def test_labels_are_hidden_and_shown_again_with_their_opacity():
    volume = layers(4, 5, 6)  # 3.5, 5 and 5.5 long
    transfer = jv.LabelTransferFunction(THREE).with_opacity({0: 2.0, 1: 0.5})
    for hidden in ({0: False}, {1: False, 2: False}, {1: True}, {}):
        rgba = along_x(volume, transfer.with_visibility(hidden), FINE).rgba[0]
        factors = np.array([2.0, 0.5, 1.0]) * [hidden.get(label, True) for label in range(3)]
        depths = np.array([3.5 * 0.1, 5 * 0.3, 5.5 * 0.2]) * factors
        before = np.exp(-np.concatenate([[0], np.cumsum(depths)[:-1]]))
        np.testing.assert_allclose(rgba[:3], before * (1 - np.exp(-depths)), atol=2e-5)
    away = transfer.with_visibility({0: False, 1: False}).with_visibility({0: True, 1: True})
    again = along_x(volume, away.with_opacity({0: 1.0, 1: 1}), FINE).rgba
    np.testing.assert_array_equal(again, along_x(volume, jv.LabelTransferFunction(THREE), FINE).rgba)


def test_an_opacity_factor_is_that_of_a_layer_s_optical_depth():
    """Whatever the value: 1 - (1 - α)^f."""
    volume = layers(4, 4)
    ramp = jv.TransferFunction.from_points([(0, RED, 0.0), (100, RED, 0.5), (255, RED, 0.9)])
    thin = jv.LabelTransferFunction({1: ramp}).with_opacity({1: 0.3})
    alpha = float(along_x(volume, thin, FINE).rgba[0, 3])
    assert alpha == pytest.approx(1 - 0.5 ** (0.3 * 3.5), abs=2e-5)


@pytest.mark.parametrize("quadrature", ["midpoint", *slow("preintegrated")])
def test_gradients_of_opacity_are_those_of_the_closed_form(quadrature):
    volume = layers(4, 5, 6)

    def red(factors, adjoint):
        transfer = jv.LabelTransferFunction(THREE).with_opacity({0: factors[0], 1: factors[1]})
        march = jv.March(0.7, FINE.transforms, quadrature)
        rays = [[-1.0, 1.0, 1.0]], [[1.0, 0.0, 0.0]]
        return jv.render_rays(volume, transfer, *rays, march, adjoint=adjoint).rgba[0, 1]

    # the green layer, behind the red one: exp(-0.35 f) (1 - exp(-1.5 g))
    f, g = 0.8, 0.4
    before, behind = np.exp(-0.35 * f), np.exp(-1.5 * g)
    exact = [-0.35 * before * (1 - behind), 1.5 * before * behind]
    for adjoint in ("replay", "forward", "direct"):
        take = jax.jacfwd if adjoint == "forward" else jax.grad
        found = take(lambda factors, a=adjoint: red(factors, a))(jnp.array([f, g]))
        np.testing.assert_allclose(found, exact, rtol=1e-4)


def test_hidden_labels_are_leapt_over():
    volume = layers(16, 16, 16)
    blocks = Blocks.of(volume)
    transfer = jv.LabelTransferFunction(THREE)
    for hidden in (transfer.with_visibility({1: False}), transfer.with_opacity({1: 0.0})):
        seen = np.asarray(hidden.visible(blocks))
        assert seen[:4].all()
        assert seen[8:].all()
        assert not seen[5:7].any()
        assert np.all((np.asarray(hidden.majorant(blocks)) > 0) == seen)
    faint = transfer.with_opacity({1: 0.25}).majorant(blocks)
    np.testing.assert_allclose(faint[5:7], 0.075, rtol=1e-5)


def test_changes_compile_nothing_again():
    volume, traces = layers(4, 5, 6), []

    @jax.jit
    def image(transfer):
        traces.append(transfer)
        return along_x(volume, transfer, jv.March(0.3, (jv.SpaceLeaping(),))).rgba

    transfer = jv.LabelTransferFunction(THREE)
    for each in (transfer, transfer.with_visibility({1: False}), transfer.with_opacity({2: 0.1})):
        image(each)
    assert len(traces) == 1


def test_a_fit_leaves_visibility_and_opacity_as_they_are():
    free, start = Free.of(jv.LabelTransferFunction(THREE), None, None)
    assert {name.split("[")[0] for name in free.names(start)} == {".stacked.colors", ".stacked.extinction"}


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
    "no label to hide": (
        lambda: jv.LabelTransferFunction([ONE, ONE]).with_visibility({2: False}),
        "visible's label must be an integer from 0 to 1; got 2",
    ),
    "a list to hide": (
        lambda: jv.LabelTransferFunction([ONE]).with_visibility([False]),
        "visible must be by label.*got a list",
    ),
    "half hidden": (
        lambda: jv.LabelTransferFunction([ONE]).with_visibility({0: 0.5}),
        r"visible\[0\] must be True or False; got 0.5",
    ),
    "negative opacity": (
        lambda: jv.LabelTransferFunction([ONE]).with_opacity({0: -0.1}),
        r"opacity\[0\] must be at least 0; got -0.1",
    ),
    "opacity that is NaN": (
        lambda: jv.LabelTransferFunction([ONE]).with_opacity({0: np.nan}),
        r"opacity\[0\] must be finite",
    ),
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
