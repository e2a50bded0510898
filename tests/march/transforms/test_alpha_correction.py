"""Back faces: uneven if the last cell reaches past the exit, smooth if it is cut there. (`test_agreement` has
what becomes of images.)"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.engine.acceleration import changes_of
from jaxvol.march.march import Cell
from jaxvol.scene.space import Affine, Ray, Straight, enter

from ... import oracle
from ...scenes import around, rendered, scaled_phantom, soft_transfer, uniform_transfer
from ...switch import switch


EXAMPLES = {"alignment": lambda values: jv.AlphaCorrection()}


def cut_at_exit(begin, end, rays):
    """What lies before the exit, in three pieces where rays have a gap."""
    end = np.minimum(end, rays.t_out)
    if rays.gap is None:
        return [(begin, end)]
    first, last = (np.clip(side, begin, np.maximum(begin, end)) for side in rays.gap)
    return [(begin, first), (first, last), (last, end)]


MEANINGS = {jv.AlphaCorrection: lambda alignment, camera: oracle.Meaning(cut=cut_at_exit)}
BOX = jv.Volume(np.ones((2, 2, 2), np.float32))
LABELS = (np.arange(16) >= 8).astype(np.uint8)[:, None, None] * np.ones((1, 4, 4), np.uint8)
LABELLED = jv.Volume(np.ones(LABELS.shape, np.float32), labels=LABELS)  # the face lies at x = 7.5


@partial(jax.jit, static_argnums=0)
def cut(labels, front, width, length, gaps, line):
    """The pieces of a cell of a ray along x; on a `line` through `LABELLED` if by labels."""
    zero, one, pixel = jnp.float32(0), jnp.float32(1), (jnp.int32(0), jnp.int32(0))
    path = Straight((zero, zero, zero), (one, zero, zero))
    ray = Ray((zero, zero, zero), (one, zero, zero), zero, length, path, pixel, gaps)
    if labels:
        ray = enter(Affine(LABELLED), apart(line[0]), apart(line[1]), pixel)
    cell = Cell(front, width, jnp.zeros((), bool))
    return jv.AlphaCorrection(labels=labels).cut(cell, ray, LABELLED if labels else BOX)


ALONG_X = [-2, 1.3, 1.6], [1, 0, 0]


def pieces(front, width, length: float = 9, gaps=(), *, labels=False, line=ALONG_X):
    gaps = tuple(tuple(map(np.float32, gap)) for gap in gaps)
    found = jax.device_get(cut(labels, *map(np.float32, (front, width, length)), gaps, np.float32(line)))
    return [(float(p.front), float(p.width), bool(p.cut)) for p in found]


def test_a_cell_is_cut_at_the_exit():
    assert pieces(2, 1, 4.5) == [(2, 1, False)]
    assert pieces(4, 1, 4.5) == [(4, 0.5, True)]
    assert pieces(3.5, 1, 4.5) == [(3.5, 1, False)]  # ends there
    assert pieces(5, 1, 4.5) == [(5, 0, True)]  # past it


def test_cells_are_cut_at_gaps_which_may_come_in_any_order_and_overlap():
    for gaps in (
        ((2, 5), (3, 4)),
        ((3, 4), (2, 5)),
        ((4, 5), (2, 3)),
        ((2, 4), (3, 5)),
        ((2, 5), (np.inf,) * 2),
    ):
        found = pieces(0, 10, 20, gaps)
        assert [piece[:2] for piece in found] == [(0, 2), (2, 3), (5, 5)], gaps


def test_a_cell_is_divided_where_the_label_changes():
    (a, first, _), (b, last, _), (c, rest, _) = pieces(7.1, 1, labels=True)
    np.testing.assert_allclose([a, first, b, last], [7.1, 0.4, 7.5, 0], atol=1e-4)
    np.testing.assert_allclose([c, rest], [7.5, 0.6], atol=1e-4)
    assert [width for _, width, _ in pieces(8.1, 1, labels=True)] == [1, 0, 0]
    # enters at x = 7.6: in front of that, the nearest labels change, but the ray crosses no face
    oblique = [6.4, -1.6, 1.6], [0.6, 0.8, 0]
    assert [width for _, width, _ in pieces(-0.5, 1, labels=True, line=oblique)] == [1, 0, 0]


def depth_by_planes(labels, extinctions, origin, direction):
    """The optical depth of a line through unit voxels. Between planes half-way between nodes, and between
    those and faces of the grid, the label does not change."""
    planes = [
        (np.concatenate([[0, n - 1], np.arange(n - 1) + 0.5]) - start) / rate
        for n, start, rate in zip(labels.shape, origin, direction, strict=True)
    ]
    near, far = max(min(axis[:2]) for axis in planes), min(max(axis[:2]) for axis in planes)
    depths = np.sort(np.clip(np.concatenate(planes), near, far))
    middle = origin + direction * (depths[1:] + depths[:-1])[:, None] / 2
    nodes = np.clip(np.floor(middle + 0.5).astype(int), 0, np.array(labels.shape) - 1)
    return np.sum(extinctions[labels[tuple(nodes.T)]] * np.diff(depths))


def test_faces_of_labels_are_exact_and_move():
    """Rays through blobs of two labels: opacity, and its gradient by origins, against sums over planes."""
    random, shape, number = np.random.default_rng(0), (9, 10, 8), 64
    x, y, z = np.indices(shape)
    labels = (np.sin(0.9 * x + 0.4 * y) + np.cos(0.7 * z - 0.5 * y) > 0.4).astype(np.uint8)
    extinctions = np.array([0.05, 0.3])
    directions = random.normal(size=(number, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = random.uniform(2, 6, (number, 3)) - 20 * directions

    # made outside of the program, where labels are known, so that pieces are merged
    volume = jv.Volume(np.ones(shape, np.float32), labels=labels)

    @jax.jit
    def opacity_and_gradient(step, origins):
        transfer = jv.LabelTransferFunction([uniform_transfer(extinction) for extinction in extinctions])
        march = jv.March(step, (jv.AlphaCorrection(labels=True),), max_samples=64)

        def opacity(origins):
            rays = origins, jnp.asarray(directions, jnp.float32)
            return jv.render_rays(volume, transfer, *rays, march, outputs="rgba").rgba[:, 3]

        found, pull = jax.vjp(opacity, origins)
        return found, pull(jnp.ones(number))[0]

    def exact(origins):
        lines = zip(origins, directions, strict=True)
        return -np.expm1([-depth_by_planes(labels, extinctions, *line) for line in lines])

    h = 1e-6
    slopes = [(exact(origins + h * axis) - exact(origins - h * axis)) / (2 * h) for axis in np.eye(3)]
    # a cell of 2.1 voxels may pass more than two faces
    for step, share in ((0.3, 1), (2.1, 0.75)):
        found, gradient = jax.device_get(opacity_and_gradient(np.float32(step), origins.astype(np.float32)))
        right = np.abs(found - exact(origins)) < 1e-5
        assert right.mean() >= share
        np.testing.assert_allclose(gradient[right], np.stack(slopes, 1)[right], atol=2e-3, rtol=2e-3)


@pytest.mark.parametrize("quadrature", ["midpoint", "preintegrated"])
def test_merged_pieces_show_what_single_ones_do(quadrature):
    """All outputs and a derivative in forward mode; pieces are single where labels are traced."""
    random, shape = np.random.default_rng(1), (12, 11, 13)
    labels = random.integers(0, 4, shape).astype(np.uint8)
    labels[4:9, 3:8, 2:9] = 1
    volume = jv.Volume(random.uniform(0.2, 1, shape).astype(np.float32), labels=labels)
    functions = [uniform_transfer(extinction, random.random(3)) for extinction in (0.02, 0, 0.3, 1.5)]
    transfer, camera = jv.LabelTransferFunction(functions), around(volume, (24, 24))
    gap = jv.Clip((3.3, 7.6, 2.9, 7.1, 4.2, 8.8), inside_out=True)
    march = jv.March(1.3, (jv.Jitter(3), gap, jv.AlphaCorrection(labels=True)), quadrature)
    assert changes_of(volume) is not None

    @jax.jit
    def image_and_slope(labels):
        traced = volume if labels is None else eqx.tree_at(lambda v: v.labels, volume, labels)

        def image(factor):
            return jv.render(traced, transfer.with_opacity({1: factor - 1, 2: factor}), camera, march)

        return jax.jvp(image, (jnp.float32(1),), (jnp.float32(1),))

    (merged, slope), (single, other) = image_and_slope(None), image_and_slope(volume.labels)
    np.testing.assert_allclose(merged.rgba, single.rgba, atol=3e-6)
    np.testing.assert_allclose(slope.rgba, other.rgba, atol=2e-5)
    np.testing.assert_allclose(merged.depth, single.depth, rtol=1e-5)
    np.testing.assert_array_equal(merged.samples, single.samples)
    np.testing.assert_array_equal(merged.aligned, single.aligned)
    assert np.asarray(single.aligned).any()


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

    def image(step, on, of=transfer, left=1e-6):
        transforms = switch(jv.AlphaCorrection(), on), jv.EarlyTermination(left)
        return rendered(volume, of, camera, jv.March(step, transforms, "midpoint"))

    exact = np.asarray(image(0.002, True).rgba)
    bumpy, smooth = image(0.11, False), image(0.11, True)
    errors = [np.asarray(each.rgba) - exact for each in (bumpy, smooth)]
    jumps = [np.abs(np.diff(error[..., 3], axis=1)).max() for error in errors]
    assert jumps[0] > 0.02
    assert jumps[1] < jumps[0] / 20
    touched = np.asarray(smooth.aligned)
    assert touched.mean() > 0.2
    assert not np.asarray(bumpy.aligned).any()
    rms = [np.sqrt(np.mean(error[touched] ** 2)) for error in errors]
    assert rms[1] < rms[0] / 20
    # not rays that end earlier, nor those whose last cell is transparent (Kye 2013, Fig. 13)
    clear, dense = (
        jv.TransferFunction(transfer.values, transfer.colors, by * np.asarray(transfer.extinction))
        for by in (0, 20)
    )
    assert not np.asarray(image(0.11, True, clear).aligned).any()
    ended = image(0.11, True, dense, 0.01)
    assert np.asarray(ended.aligned).sum() < touched.sum()
    assert not np.any(np.asarray(ended.aligned) & (np.asarray(ended.rgba)[..., 3] > 0.999))


@pytest.mark.slow
def test_aligned_marks_the_neck_of_a_head():
    volume = scaled_phantom("head")
    march = jv.March(0.05, (jv.AlphaCorrection(), jv.EarlyTermination(0.01)))
    assert 0 < np.mean(jv.render(volume, soft_transfer(0.01), around(volume), march).aligned) < 0.5
