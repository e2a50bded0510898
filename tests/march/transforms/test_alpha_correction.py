"""Back faces: uneven if the last cell reaches past the exit, smooth if it is cut there. (`test_agreement` has
what becomes of images.)"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.march.march import Cell
from jaxvol.scene.space import Affine, Ray, Straight, enter

from ...scenes import around, scaled_phantom, soft_transfer, uniform_transfer
from ...switch import switch


ZERO, ONE, NO = jnp.float32(0), jnp.float32(1), jnp.zeros((), bool)
PIXEL = jnp.int32(0), jnp.int32(0)


def ray_of(length, gaps=()):
    path = Straight((ZERO, ZERO, ZERO), (ONE, ZERO, ZERO))
    ends = tuple((jnp.float32(left), jnp.float32(back)) for left, back in gaps)
    return Ray((ZERO, ZERO, ZERO), (ONE, ZERO, ZERO), ZERO, jnp.float32(length), path, PIXEL, ends)


BOX = jv.Volume(np.ones((2, 2, 2), np.float32))


def pieces(front, width, ray, volume=BOX, **how):
    cut = jv.AlphaCorrection(**how).cut(Cell(jnp.float32(front), jnp.float32(width), NO), ray, volume)
    return [(float(p.front), float(p.width), bool(p.cut)) for p in cut]


def test_a_cell_is_cut_at_the_exit():
    ray = ray_of(4.5)
    assert pieces(2, 1, ray) == [(2, 1, False)]
    assert pieces(4, 1, ray) == [(4, 0.5, True)]
    assert pieces(3.5, 1, ray) == [(3.5, 1, False)]  # ends there
    assert pieces(5, 1, ray) == [(5, 0, True)]  # past it


def test_cells_are_cut_at_gaps_which_may_come_in_any_order_and_overlap():
    for gaps in (
        ((2, 5), (3, 4)),
        ((3, 4), (2, 5)),
        ((4, 5), (2, 3)),
        ((2, 4), (3, 5)),
        ((2, 5), (np.inf,) * 2),
    ):
        found = pieces(0, 10, ray_of(20, gaps))
        assert [piece[:2] for piece in found] == [(0, 2), (2, 3), (5, 5)], gaps


def test_a_cell_is_divided_where_the_label_changes():
    labels = (np.arange(16) >= 8).astype(np.uint8)[:, None, None] * np.ones((1, 4, 4), np.uint8)
    volume = jv.Volume(np.ones(labels.shape, np.float32), labels=labels)  # the face lies at x = 7.5
    line = apart(jnp.array([-2.0, 1.3, 1.6])), apart(jnp.array([1.0, 0, 0]))
    ray = enter(Affine(volume), *line, PIXEL)
    (a, first, _), (b, last, _), (c, rest, _) = pieces(7.1, 1, ray, volume, labels=True)
    np.testing.assert_allclose([a, first, b, last], [7.1, 0.4, 7.5, 0], atol=1e-4)
    np.testing.assert_allclose([c, rest], [7.5, 0.6], atol=1e-4)
    assert [width for _, width, _ in pieces(8.1, 1, ray, volume, labels=True)] == [1, 0, 0]


@pytest.mark.parametrize("fast", [True, False])
def test_the_gradient_by_an_exit_at_the_end_of_a_cell(fast):
    """A ray of eight whole steps, or of a little more or less, through a constant cube."""
    march = jv.March(0.25, (jv.AlphaCorrection(),), max_samples=16)
    origin, direction = np.array([0.1, 0.2, -3], np.float32), np.array([0, 0, 1], np.float32)

    @jax.jit
    def slope(spacing):
        def opacity(spacing):
            along = jnp.stack([jnp.float32(0.25), jnp.float32(0.25), spacing])
            volume = jv.Volume(np.ones((9, 9, 9), np.float32), along, [-1.0] * 3)
            scene = volume, uniform_transfer(1.0)
            if fast:
                return jv.render_rays(*scene, origin[None], direction[None], march).rgba[0, 3]
            return jv.render_ray_reference(*scene, origin, direction, march).rgba[3]

        return jax.grad(opacity)(spacing)

    for spacing in np.array([0.25, 0.2501, 0.2499], np.float32):
        assert slope(spacing) == pytest.approx(8 * np.exp(-8 * float(spacing)), rel=1e-5)


def test_back_faces_are_smooth_with_it_alone_and_marked_where_it_acts():
    """The error without it is a sawtooth: it jumps between neighbours by up to the weight of a cell."""
    volume = scaled_phantom("linear")
    transfer = jv.TransferFunction(
        np.linspace(0, 1, 8), np.linspace((0.9, 0.3, 0.1), (0.1, 0.3, 0.9), 8), np.linspace(0.2, 0.9, 8)
    )
    camera = around(volume, (40, 32))

    def rendered(step, on, of=transfer, left=1e-6):
        transforms = switch(jv.AlphaCorrection(), on), jv.EarlyTermination(left)
        return jv.render(volume, of, camera, jv.March(step, transforms, "midpoint"))

    exact = np.asarray(rendered(0.002, True).rgba)
    bumpy, smooth = rendered(0.11, False), rendered(0.11, True)
    errors = [np.asarray(each.rgba) - exact for each in (bumpy, smooth)]
    jumps = [np.abs(np.diff(error[..., 3], axis=1)).max() for error in errors]
    assert jumps[0] > 0.02
    assert jumps[1] < jumps[0] / 20
    touched = np.asarray(smooth.aligned)
    assert touched.mean() > 0.2
    assert not np.any(bumpy.aligned)
    rms = [np.sqrt(np.mean(error[touched] ** 2)) for error in errors]
    assert rms[1] < rms[0] / 20
    # not rays that end earlier, nor those whose last cell is transparent (Kye 2013, Fig. 13)
    clear = jv.TransferFunction(transfer.values, transfer.colors, 0 * transfer.extinction)
    assert not np.any(rendered(0.11, True, clear).aligned)
    dense = jv.TransferFunction(transfer.values, transfer.colors, 20 * transfer.extinction)
    ended = rendered(0.11, True, dense, 0.01)
    assert np.sum(ended.aligned) < np.sum(touched)
    assert not np.any(np.asarray(ended.aligned) & (np.asarray(ended.rgba[..., 3]) > 0.999))


@pytest.mark.slow
def test_aligned_marks_the_neck_of_a_head():
    volume = scaled_phantom("head")
    march = jv.March(0.05, (jv.AlphaCorrection(), jv.EarlyTermination(0.01)))
    assert 0 < np.mean(jv.render(volume, soft_transfer(0.01), around(volume), march).aligned) < 0.5
