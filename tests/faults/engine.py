"""Faults of the march, its transforms, the fast engine and its gradients."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxvol.ray import NEVER

from . import Fault


SEVERAL = (
    "engine/test_several.py::"
    "test_extinctions_and_colors_add_at_each_sample_and_derivatives_are_central_differences"
)


def a_cell_later(shifted):
    """`_shifted`, one cell too late."""

    def found(*given):
        cell = shifted(*given)
        return jnp.where(cell < NEVER, cell + 1, cell)

    return found


def whole_at_the_exit(cut):
    """`cut`, whose cells that end just at the exit do not move with it."""

    def pieces(self, cell, ray, volume):
        first, *rest = cut(self, cell, ray, volume)
        ends = cell.front + cell.width == ray.length
        return eqx.tree_at(lambda c: c.width, first, jnp.where(ends, cell.width, first.width)), *rest

    return pieces


def later(widened):
    """`widened`, by which the first visible cell is found four too late."""

    def found(self, at, samples):
        wider = widened(self, at, samples)
        return wider._replace(first=jnp.where(wider.first < self.first, wider.first + 4, self.first))

    return found


def unshifted(front, step):
    """Where a cell would begin without jitter, that is at a whole number of steps."""
    return jnp.floor(front / step + 1e-3) * step


def normals_of_unshifted(light_terms):
    def terms(shader, scene, live, ray, cells):
        step = scene.march.step
        moved = lambda: tuple(replace(cell, front=unshifted(cell.front, step)) for cell in cells())  # noqa: E731
        return light_terms(shader, scene, live, ray, moved)

    return terms


def behind_leaps_at_whole_steps(to_next_cell):
    def moved(job, beam, rays, at):
        after = to_next_cell(job, beam, rays, at)
        leapt, track = after.index > at.index, after.track
        kept = lambda leaf: None if leaf is None else jnp.where(leapt, 0, leaf)  # noqa: E731
        return replace(after, track=replace(track, offset=kept(track.offset), shift=kept(track.shift)))

    return moved


def a_cell_further(leap_by_ray):
    def leap_of(*given):
        leap = leap_by_ray(*given)

        def further(at):
            at = leap(at)
            return replace(at, index=at.index + 1)

        return further

    return leap_of


MARCH, GRAIN = "march/test_march.py::", "test_wood_grain.py::"
RANDOM = "march/test_random_ends_and_growing_steps.py::"
OF_VOXELS = f"{GRAIN}test_jitter_breaks_wood_grain_of_voxels_and_leaves_the_error"
FAULTS: list[Fault] = [
    Fault(
        "quadrature: midpoint samples at the front of cells",
        "march.march:CellRules.sample",
        lambda _: lambda self, cell: cell.front,
        (f"{MARCH}test_midpoint_samples_only_inside",),
    ),
    Fault(
        "start: offsets of transforms are ignored",
        "march.march:March.start",
        lambda _: lambda self, ray: jnp.zeros_like(ray.length),
        (f"{MARCH}test_cells_reach_past_the_exit_unless_they_are_cut_there",),
    ),
    Fault(
        "shift: a cell too late",
        "engine.shifts:_shifted",
        a_cell_later,
        (
            "test_agreement.py::"
            "test_every_subset_of_transforms_means_the_same_in_both_engines_and_to_an_independent_marcher",
        ),
    ),
    Fault(
        "shift: rays do not shift",
        "engine.shifts:find_shifts",
        lambda _: lambda scene, rays, at, tiling: at,
        (
            "test_agreement.py::"
            "test_every_subset_of_transforms_means_the_same_in_both_engines_and_to_an_independent_marcher",
        ),
    ),
    Fault(
        "stop: rays end while their transmittance is high",
        "march.march:CellRules.stop",
        lambda _: lambda self, transmittance: transmittance >= self.opacity_left,
        (f"{MARCH}test_early_termination_stops_where_little_is_left",),
    ),
    Fault(
        "growing steps: cells are as wide as the first",
        "ray:cell_at",
        lambda f: lambda march, *rest: replace(f(march, *rest), width=march.step),
        (f"{RANDOM}test_images_are_those_of_another_marcher_in_both_engines",),
    ),
    Fault(
        "growing steps: leaps count equal steps",
        "march.march:_Cells.distance",
        lambda _: lambda self, depth, ray: depth,
        (f"{RANDOM}test_images_are_those_of_another_marcher_in_both_engines",),
    ),
    Fault(
        "roulette: transparent cells count, too",
        "ray:reweigh",
        lambda f: (
            lambda scene, ray, at, alphas, ahead=0: f(
                scene, ray, at, [jnp.ones_like(alpha) for alpha in alphas], ahead
            )
        ),
        (f"{RANDOM}test_images_are_those_of_another_marcher_in_both_engines",),
    ),
    Fault(
        "roulette: factors are not in the gradient",
        "engine.replay:_scaled",
        lambda _: lambda value, factor: value,
        (f"{RANDOM}test_gradients_are_central_differences",),
    ),
    Fault(
        "cut: the last cell reaches past the exit",
        "march.transforms.alpha_correction:AlphaCorrection.cut",
        lambda _: lambda self, cell, ray, volume: (cell,),
        ("march/transforms/test_alpha_correction.py::test_a_cell_is_cut_at_the_exit",),
    ),
    Fault(
        "cut: marched cells reach past the exit",
        "march.march:CellRules.cut",
        lambda _: lambda self, cell, ray, volume: (cell,),
        ("test_invariants.py::test_a_constant_volume_is_exact_at_any_step_under_alpha_correction",),
    ),
    Fault(
        "cut: a cell that ends at the exit does not move with it",
        "march.transforms.alpha_correction:AlphaCorrection.cut",
        whole_at_the_exit,
        ("march/transforms/test_alpha_correction.py::test_the_gradient_by_an_exit_at_the_end_of_a_cell",),
    ),
    Fault(
        "cut: labels change in front of the entry",
        "march.march:cut_at_entry",
        lambda _: lambda cell: cell,
        ("march/transforms/test_alpha_correction.py::test_a_cell_is_divided_where_the_label_changes",),
    ),
    *(
        Fault(
            f"cut: faces of labels {name}",
            "march.transforms.alpha_correction:_face",
            wrong,
            ("march/transforms/test_alpha_correction.py::test_faces_of_labels_are_exact_and_move",),
        )
        for name, wrong in {
            "stand still": lambda face: lambda *given: jax.lax.stop_gradient(face(*given)),
            "are sampled in front of them": lambda face: lambda *given: face(*given) - 1e-3,
        }.items()
    ),
    Fault(
        "jitter: pixels of a row have the same number",
        "march.transforms.jitter:Noise.__call__",
        lambda f: lambda self, pixel, dtype: f(self, (0 * pixel[0], pixel[1]), dtype),
        (
            "march/transforms/test_jitter.py::test_numbers_are_uniform_and_depend_on_seed_stream_and_pixel_alone",
        ),
    ),
    Fault(
        "jitter: numbers have four values",
        "march.transforms.jitter:Noise.__call__",
        lambda f: lambda self, pixel, dtype: (jnp.floor(4 * f(self, pixel, dtype)) + 0.5) / 4,
        (f"{GRAIN}test_each_ray_begins_by_its_own_uniform_part_of_a_step",),
    ),
    Fault(
        "jitter: rays begin up to two steps late",
        "march.transforms.jitter:Jitter.start",
        lambda f: lambda self, steps, ray: 2 * f(self, steps, ray) - steps,
        (f"{GRAIN}test_each_ray_begins_by_its_own_uniform_part_of_a_step",),
    ),
    Fault(
        "empty-space jitter: only rays whose first sample is transparent shift",
        "engine.shifts:_shifted",
        lambda f: lambda *given: jnp.where(f(*given) == 1, 1, NEVER),
        (f"{GRAIN}test_each_ray_shifts_once_at_its_first_transparent_sample",),
    ),
    Fault(
        "jitter: normals are those of samples that are not shifted",
        "engine.shading:light_terms",
        normals_of_unshifted,
        (f"{OF_VOXELS}[lit-phantom_head-8-0.05]",),
    ),
    Fault(
        "jitter: values are integrated over cells that are not shifted",
        "march.march:CellRules.ends",
        lambda f: lambda self, cell, ray: f(self, replace(cell, front=unshifted(cell.front, self.step)), ray),
        (f"{OF_VOXELS}[integrated-phantom_head-8-0.05]",),
    ),
    Fault(
        "jitter: behind a leap samples lie at whole steps",
        "engine.wavefront:to_next_cell",
        behind_leaps_at_whole_steps,
        (f"{OF_VOXELS}[leaps and early ends-phantom_head-8-0.05]",),
    ),
    Fault(
        "clip: cells whose middle is cut away are taken as empty",
        "march.transforms.clip:HalfSpace.over",
        lambda f: lambda self, grid: (f(self, grid)[0], 0 * f(self, grid)[1]),
        ("march/transforms/test_clip.py::test_no_cell_that_holds_anything_seen_is_taken_as_empty",),
    ),
    Fault(
        "NaN: a parameter that is NaN gives a finite image",
        "ray:Scene.has_fault",
        lambda _: property(lambda scene: jnp.zeros((), bool)),
        ("march/transforms/test_clip.py::test_nan_in_a_plane_shows",),
    ),
    Fault(
        "several volumes: a cell that a face divides counts as a whole",
        "ray:_share",
        lambda _: (
            lambda piece, enters, leaves: jnp.where(
                (enters < piece.front + piece.width) & (leaves > piece.front), 1, jnp.zeros_like(piece.front)
            )
        ),
        (SEVERAL,),
    ),
    Fault(
        "several volumes: what is not visible has no emission to differentiate",
        "engine.replay:Replay._weight_of_thin",
        lambda _: lambda self, before: jnp.zeros_like(before),
        (SEVERAL,),
    ),
    Fault(
        "voxels: the interpolation's derivative is that of the node before",
        "scene.voxel_fetch:_interpolated_pairs",
        lambda f: lambda fraction, rows: f((fraction[0], fraction[1], 0 * fraction[2]), rows),
        (SEVERAL,),
    ),
    Fault(
        "leap: a voxel too far",
        "engine.wavefront:_leap",
        lambda f: lambda *given: f(*given) + 4,
        ("march/transforms/test_space_leaping.py::test_no_ray_misses_what_is_seen",),
    ),
    Fault(
        "leap: the second march begins four cells too late",
        "engine.wavefront:CellRange.widened",
        later,
        ("engine/test_gradients.py::test_leaps_show_in_no_image_and_no_gradient",),
    ),
    Fault(
        "vmap: the batch in reverse order",
        "xla.compiling:_batch",
        lambda f: lambda *given: jax.tree.map(lambda leaf: leaf[::-1], f(*given)),
        ("engine/test_gradients.py::test_vmap_is_a_loop_for_image_and_gradient",),
    ),
    Fault(
        "ray samples: rays leap a cell too far",
        "engine.direct:leap_by_ray",
        a_cell_further,
        ("engine/test_ray_samples.py::test_sums_over_samples_are_the_image",),
    ),
]
