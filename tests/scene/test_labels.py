"""Transfer functions per label, and cells cut at the boundaries between labels."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.scene.occupancy import Blocks

from ..modes import free_leaves
from ..scenes import same_trees, slow
from ..switch import switch


RED, GREEN, BLUE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def plain(color, extinction):
    """The same colour and extinction for every value."""
    return jv.TransferFunction([0.0, 100.0, 200.0], [color] * 3, [extinction] * 3)


def layers(*widths, value=100):
    """A block of 16 nodes along x, in layers labelled 0, 1, …; `widths` in nodes."""
    labels = np.repeat(np.arange(len(widths)), widths).astype(np.uint8)[:, None, None]
    assert len(labels) == 16
    labels = labels * np.ones((1, 3, 3), np.uint8)
    return jv.Volume(np.full(labels.shape, value, np.uint8), labels=labels)


THREE = [plain(RED, 0.1), plain(GREEN, 0.3), plain(BLUE, 0.2)]
TRANSFER = jv.LabelTransferFunction(THREE)
VOLUME = layers(4, 5, 7)
WIDTHS = np.array([3.5, 5.0, 6.5])
"""World lengths of its layers: boundaries lie half-way between nodes."""
EXTINCTION = np.array([0.1, 0.3, 0.2])


def behind_each_other(depths):
    """Red, green and blue of layers of these optical depths, and the opacity of all."""
    before = np.exp(-np.concatenate([[0], np.cumsum(depths)[:-1]]))
    return [*before * (1 - np.exp(-depths)), 1 - np.exp(-depths.sum())]


RAY = [[-1.0, 1.0, 1.0]], [[1.0, 0.0, 0.0]]


@eqx.filter_jit
def _along_x(volume, transfer, step, jittered, cut, quadrature):
    transforms = switch(jv.Jitter(0, front_residual=True), jittered), jv.AlphaCorrection(labels=cut)
    return jv.render_rays(volume, transfer, *RAY, jv.March(step, transforms, quadrature)).rgba[0]


def along_x(volume, transfer, step=0.01, jittered=False, *, cut=True, quadrature="midpoint"):
    """A ray through the middle of the block."""
    return _along_x(volume, transfer, np.float32(step), np.asarray(jittered), cut, quadrature)


@pytest.mark.parametrize("quadrature", ["midpoint", *slow("preintegrated")])
def test_cells_are_cut_at_labels_and_exact_at_any_step(quadrature):
    for jittered in (False, True):
        for step in (0.01, 0.3, 0.77, 2.9):
            rgba = along_x(VOLUME, TRANSFER, step, jittered, quadrature=quadrature)
            np.testing.assert_allclose(rgba, behind_each_other(WIDTHS * EXTINCTION), atol=2e-5)
    thin = layers(4, 1, 11)  # a layer within one cell is found: label 1 from 3.5 to 4.5
    expected = behind_each_other(np.array([3.5, 1.0, 10.5]) * EXTINCTION)
    np.testing.assert_allclose(along_x(thin, TRANSFER, 3.0, quadrature=quadrature), expected, atol=2e-5)


def test_labels_without_a_function_are_not_seen_and_functions_may_differ_in_points():
    three = jv.TransferFunction([0.0, 50.0, 200.0], [BLUE] * 3, [0.0, 0.2, 0.2])
    two = jv.TransferFunction([0.0, 200.0], [RED] * 2, [0.1] * 2)
    given = {np.uint8(2): three, 0: two}, [two, None, three]
    named, listed = map(jv.LabelTransferFunction, given)
    assert same_trees(named, listed)
    # label 3 has no function, either; also beyond the end points
    for value in (100, 255):
        rgba = along_x(layers(4, 4, 4, 4, value=value), named)
        np.testing.assert_allclose(rgba, behind_each_other(np.array([0.35, 0, 0.8])), atol=2e-5)


def test_labels_are_hidden_and_shown_again_with_their_opacity():
    transfer = TRANSFER.with_opacity({0: 2.0, 1: 0.5})
    for hidden in ({0: False}, {1: False, 2: False}, {1: True}, {}):
        factors = np.array([2.0, 0.5, 1.0]) * [hidden.get(label, True) for label in range(3)]
        rgba = along_x(VOLUME, transfer.with_visibility(hidden))
        np.testing.assert_allclose(rgba, behind_each_other(WIDTHS * EXTINCTION * factors), atol=2e-5)
    away = transfer.with_visibility({0: False, 1: False}).with_visibility(
        {0: True, 1: jax.device_put(np.asarray(True))}
    )
    assert same_trees(away.with_opacity({0: 1.0, 1: 1}), TRANSFER)
    # a factor is one of the optical depth, whatever the value: 1 - (1 - α)^f
    ramp = jv.TransferFunction.from_points([(0, RED, 0.0), (100, RED, 0.5), (200, RED, 0.9)])
    thin = jv.LabelTransferFunction({2: ramp}).with_opacity({2: 0.3})
    assert np.asarray(along_x(VOLUME, thin))[3] == pytest.approx(1 - 0.5 ** (0.3 * 6.5), abs=2e-5)


@pytest.mark.parametrize(("adjoint", "cut"), [("replay", False), *slow(("forward", True))])
def test_gradients_of_opacity_are_those_of_the_closed_form(adjoint, cut):
    """Also without cutting, since faces are where cells end."""

    def green(factors):
        transfer = eqx.tree_at(lambda t: t.opacity, TRANSFER, jnp.concatenate([factors, jnp.ones(2)]))
        march = jv.March(0.7 if cut else 0.5, (jv.AlphaCorrection(labels=cut),), "midpoint")
        return jv.render_rays(VOLUME, transfer, *RAY, march, adjoint=adjoint).rgba[0, 1]

    # the green layer, behind the red one: exp(-0.35 f) (1 - exp(-1.5 g))
    f, g = 0.8, 0.4
    before, behind = np.exp(-0.35 * f), np.exp(-1.5 * g)
    exact = [-0.35 * before * (1 - behind), 1.5 * before * behind]
    take = jax.jacfwd if adjoint == "forward" else jax.grad
    np.testing.assert_allclose(jax.jit(take(green))(np.asarray([f, g], np.float32)), exact, rtol=1e-4)


def test_hidden_labels_are_leapt_over():
    labels = np.repeat(np.arange(3), 16).astype(np.uint8)[:, None, None] * np.ones((1, 3, 3), np.uint8)
    volume = jv.Volume(np.full(labels.shape, 100, np.uint8), labels=labels)

    @jax.jit
    def of_blocks(transfer):
        blocks = Blocks.of(volume)
        return transfer.visible(blocks), transfer.majorant(blocks)

    for hidden in (TRANSFER.with_visibility({1: False}), TRANSFER.with_opacity({1: 0.0})):
        seen, majorant = map(np.asarray, of_blocks(hidden))
        assert seen[:4].all()
        assert seen[8:].all()
        assert not seen[5:7].any()
        assert np.all((majorant > 0) == seen)
    _, faint = of_blocks(TRANSFER.with_opacity({1: 0.25}))
    np.testing.assert_allclose(np.asarray(faint)[5:7], 0.075, rtol=1e-5)


def test_a_fit_leaves_visibility_and_opacity_as_they_are():
    assert free_leaves(TRANSFER) == {".stacked.colors", ".stacked.extinction"}


UNLABELLED = jv.Volume(np.zeros((4, 3, 3), np.uint8))
ONE = plain(RED, 1.0)
SINGLE = jv.LabelTransferFunction([ONE])
BAD = {
    "a colour": (lambda: jv.LabelTransferFunction([ONE, "red"]), r"functions\[1\] must be .*got 'red'"),
    "many labels": (
        lambda: jv.LabelTransferFunction([ONE] * 257),
        "for labels 0 to 255; got a list of length 257",
    ),
    "a list to hide": (lambda: SINGLE.with_visibility([False]), "visible must be by label.*got a list"),
    "no function": (lambda: jv.LabelTransferFunction([None]), "functions must hold a TransferFunction"),
    "one bare": (lambda: jv.LabelTransferFunction(ONE), "{label: TransferFunction}.*got a TransferFunction"),
    "no label": (lambda: jv.LabelTransferFunction({"liver": ONE}), "functions' label must be .*got 'liver'"),
    "no label to hide": (
        lambda: jv.LabelTransferFunction([ONE, ONE]).with_visibility({2: False}),
        "visible's label must be an integer from 0 to 1; got 2",
    ),
    "half hidden": (lambda: SINGLE.with_visibility({0: 0.5}), r"visible\[0\] must be True or False; got 0.5"),
    "negative opacity": (
        lambda: SINGLE.with_opacity({0: -0.1}),
        r"opacity\[0\] must not be negative; got -0.1",
    ),
    "no labels to classify by": (lambda: along_x(UNLABELLED, SINGLE, cut=False), "labels are needed here"),
    "no labels to cut at": (lambda: along_x(UNLABELLED, ONE), "labels are needed here"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    make, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        make()
