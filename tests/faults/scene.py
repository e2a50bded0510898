"""Faults of volumes, cameras, transfer functions, spaces and compositing."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from . import Fault


def _from_base(enter):
    """`enter`, with distances from where a ray of a far camera is restarted, and not from its origin."""

    def entered(space, origin, direction, *rest):
        ray = enter(space, origin, direction, *rest)
        toward = sum((m - o) * d for m, o, d in zip(space.middle, origin, direction, strict=True))
        return eqx.tree_at(lambda r: r.t_in, ray, ray.t_in - jnp.maximum(toward - space.diagonal / 2, 0))

    return entered


def _without_bulge(box_of):
    """`Box._of`, whose last argument is the bulge."""

    def of(cls, *given: Any):
        return box_of.__func__(cls, *given[:-1], jnp.zeros_like(given[-1]))

    return classmethod(of)


FAULTS: list[Fault] = [
    Fault(
        "colours: a gradient leaves out those after the third",
        "engine.replay:_dot",
        lambda _: lambda a, b: sum(x * y for x, y in zip(a[:3], b[:3], strict=True)),
        (
            "scene/test_own_transfer.py::"
            "test_nine_colours_are_those_of_closed_forms_in_both_engines_and_so_is_their_gradient",
        ),
    ),
    Fault(
        "constructors: wrong numbers pass where they are traced",
        "_util.checks:require",
        lambda _: lambda value, *rest: value,
        (
            "test_arguments.py::"
            "test_wrong_numbers_are_nan_in_a_program_without_calls_of_the_host_and_named_without_jit",
        ),
    ),
    Fault(
        "owned bricks: what is behind is not dimmed",
        "compositing.blending:joined",
        lambda _: lambda front, back: jax.tree.map(jnp.add, front, back),
        ("compositing/test_compositing.py::test_weightings_sum_cells_as_numpy_does",),
    ),
    Fault(
        "replay: wrong sign of what is behind a sample",
        "compositing.blending:Over.slope",
        lambda f: lambda self, alpha, after, bar, behind: f(self, alpha, after, bar, -behind),
        ("compositing/test_compositing.py::test_slopes_are_those_of_jax",),
    ),
    Fault(
        "replay: what a transfer function reads beside the value has no gradient to it",
        "engine.replay:Replay.reads_transfer",
        lambda _: False,
        ("scene/test_own_transfer.py::test_what_is_read_beside_the_value_has_its_gradient",),
    ),
    Fault(
        "camera: a view angle of 180 degrees is taken",
        "scene.camera:_is_valid",
        lambda _: lambda height, is_angle, up, forward: height == height,
        ("engine/test_gradients.py::test_nan_and_infinity_reach_image_and_gradient",),
    ),
    Fault(
        "direct: what is NaN has the gradient 0",
        "xla.differentiation:nan_derivatives",
        lambda _: lambda tree, fault: tree,
        ("engine/test_gradients.py::test_nan_and_infinity_reach_image_and_gradient",),
    ),
    Fault(
        "selection: a sample stays where a moving face cuts its cell",
        "ray:_movement",
        lambda _: lambda march, ray, volume, depth, scale: depth * (scale - 1),
        ("compositing/test_mode_images.py::test_a_selected_sample_moves_with_the_face_that_cuts_its_cell",),
    ),
    Fault(
        "transfer function: extinction below 0 has a gradient",
        "_util.piecewise_linear:not_negative",
        lambda _: lambda extinction: extinction,
        (
            "scene/test_transfer.py::test_negative_extinction_counts_as_zero_and_has_no_gradient[8]",
            "scene/test_transfer.py::test_negative_extinction_counts_as_zero_and_has_no_gradient[40]",
        ),
    ),
    Fault(
        "maximum: leaps over what may win, since it is invisible",
        "compositing.projections:Maximum.occupied",
        lambda _: lambda self, transfer, blocks: transfer.visible(blocks),
        ("compositing/test_compositing.py::test_leaps_are_over_what_cannot_win_alone",),
    ),
    Fault(
        "line integral: how deep a cell is, is lost in its opacity",
        "compositing.line_integral:SCALE",
        lambda _: 1.0,
        (
            "compositing/test_line_integral.py::test_a_box_is_as_deep_as_its_chords_and_its_derivative_at_any_depth",
        ),
    ),
    Fault(
        "average: cells weigh their opacity",
        "compositing.blending:OpticalDepths.weight",
        lambda _: lambda self, alpha, before: alpha,
        ("compositing/test_compositing.py::test_weightings_sum_cells_as_numpy_does",),
    ),
    Fault(
        "isosurface: no derivative by its value",
        "compositing.isosurface:Isosurface._implicit",
        lambda _: lambda self, sampler, root: root,
        ("compositing/test_isosurface.py::test_a_plateau_on_the_value_leaves_its_gradient",),
    ),
    Fault(
        "entry: distances from a ray's base point, and not from its origin",
        "scene.space:enter",
        _from_base,
        ("scene/test_space.py::test_entry_and_length_are_right",),
    ),
    Fault(
        "ends of rays: no derivative by them",
        "scene.space:enter",
        lambda f: lambda *given: f(*given[:4], *jax.lax.stop_gradient(given[4:])),
        ("engine/test_ends.py::test_a_uniform_box_is_seen_up_to_a_depth_by_several_rays_a_pixel",),
    ),
    Fault(
        "toroidal map: the first gap of a ray only",
        "march.transforms.sector_faces:GAPS",
        lambda _: 1,
        ("march/transforms/test_toroidal_map.py::test_rays_enter_and_leave_where_dense_samples_do[twice]",),
    ),
    Fault(
        "empty space: beam boxes without the bulge between their corner rays",
        "march.beams:Box._of",
        _without_bulge,
        ("march/test_beams.py::test_a_box_holds_every_ray_of_its_beam",),
    ),
    Fault(
        "empty space: box queries leave out the last cells",
        "scene.occupancy:Sums.any_between",
        lambda f: (
            lambda self, first, last: f(self, first, tuple(map(jnp.maximum, first, (n - 1 for n in last))))
        ),
        ("scene/test_occupancy.py::test_box_queries_agree_with_direct_inspection",),
    ),
    Fault(
        "slopes of blocks: per node, not per world length",
        "scene.occupancy:_lengths",
        lambda lengths: lambda *ranges: lengths(*ranges[:3], jnp.ones(3), ranges[4]),
        (
            "scene/test_transfer2d.py::test_ranges_of_magnitude_and_majorants_hold_all_that_is_in_a_block[float32]",
        ),
    ),
    Fault(
        "transfer: nothing is visible of a classifier of one's own",
        "scene.transfer:Transfer.majorant",
        lambda _: lambda self, blocks: jnp.zeros(blocks.low.shape),
        ("scene/test_transfer.py::test_nothing_is_proven_of_a_classifier_of_ones_own",),
    ),
    Fault(
        "integrated: the mean of colours is not weighted by the extinction",
        "_util.piecewise_means:_classified",
        lambda f: lambda means, plain: (plain[:3], f(means, plain)[1]),
        ("test_preintegration.py::test_means_are_integrals",),
    ),
    Fault(
        "compositing: a weight's derivative leaves out what the cell hides",
        "compositing.blending:Weighting.total_bar",
        lambda _: lambda self, after, weight_bar, sum_behind: weight_bar,
        ("compositing/test_fitted_modes.py::test_parameters_have_the_gradient_of_differences[veiled]",),
    ),
    Fault(
        "space: a cell of the default occupancy reaches half as far",
        "scene.space:blocks_in_reach",
        lambda f: lambda center, changes, *given: f(center, [0.5 * c for c in changes], *given),
        ("march/test_space_of_a_user.py::test_a_cell_that_is_empty_reaches_nothing_visible",),
    ),
]
