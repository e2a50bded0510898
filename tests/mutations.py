"""Do the tests catch known faults? Mutation testing: each fault is applied to a copy of the tree.

`python -m tests.mutations` runs the tests listed for each fault below. Without the fault all of them must
pass; with it at least one must fail. Nothing is changed in place. `--only NAME` selects faults, `-j N` runs
N jobs in parallel, `--list` lists the faults.

The faults happened or are easy to make: an overflowing index, a wrong sign, an off-by-one error. If no fast
test catches a fault, a test is missing. If a fault's old text is no longer found, the code has changed and
the fault must be updated.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple


ROOT = Path(__file__).parent.parent

TIMEOUT = 3600
"""Seconds after which tests that are still running count as having missed the fault."""

COPIED = ("jaxvol", "tests", "experiments", "pyproject.toml")


class Mutation(NamedTuple):
    """A fault.

    - `name`: what goes wrong.
    - `file`: path relative to `jaxvol/`; `old`: a text that occurs in it once; `new`: its replacement.
    - `tests`: fast tests, relative to `tests/`, at least one of which must fail.
    """

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    def applied(self, root: Path) -> str:
        """The file's text with the fault applied."""
        path = root / "jaxvol" / self.file
        text = path.read_text(encoding="utf-8")
        count = text.count(self.old)
        if count != 1:
            raise ValueError(
                f"{self.name}: jaxvol/{self.file} must contain this text once; it occurs {count} times:\n\n"
                f"{self.old}\n\nThe code has changed: update the fault in tests/mutations.py."
            )
        return text.replace(self.old, self.new)


TO_AXIS = (
    "transforms/test_toroidal_map.py::"
    "test_rays_along_faces_and_across_the_axis_see_no_more_than_the_sector[touches the axis]"
)
LEAPING_GRADIENT = (
    "engine/test_gradient_matrix.py::test_leaping_does_not_change_replay_gradients[jittered-hierarchy-uint8]"
)
FORWARD_GRADIENT = (
    "engine/test_gradient_matrix.py::test_forward_and_replay_gradients_agree[jittered-hierarchy-uint8]"
)
DIFFERENCES = (
    "engine/test_gradient_matrix.py::test_gradients_are_central_differences[moving-hierarchy-float64]"
)
NAN = "engine/test_faults.py::test_nan_and_infinity_reach_image_and_gradient[leaping]"
VMAP = "engine/test_vmap.py::test_over_one_part[cameras-uint8]"
PACKED = "transforms/test_space_leaping.py::test_packed_voxels_are_the_same_values"
ON_GPUS = "engine/test_gpu_tiling.py"
RENDERED = "test_agreement.py::test_render_agrees_with_the_independent_marcher"

SLOPES = "lighting/test_phong.py::test_the_gradient_is_interpolated_between_central_differences"

TABLE = "test_transfer2d.py::test_the_table_is_bilinear_and_constant_beyond_its_lines"
RANGES = "test_transfer2d.py::test_ranges_of_magnitude_and_majorants_hold_all_that_is_in_a_block"

SHARED = "engine/test_devices.py::test_work_is_balanced_and_images_and_gradients_are_those_of_one_device"
OWNED = "engine/test_devices.py::test_devices_that_own_bricks_render_the_whole"
SURFACE = "bricks/test_axes.py::test_a_lit_surface_does_not_depend_on_the_order_of_storage"

MUTATIONS = [
    # devices
    Mutation(
        "devices: gradients are not summed over them",
        "engine/devices.py",
        "jax.lax.psum(tree, AXIS)",
        "tree",
        (SHARED,),
    ),
    Mutation(
        "devices: what they found is put together as if each had a stretch of the image",
        "engine/devices.py",
        "turns = jax.lax.all_gather(things, AXIS, axis=1)",
        "turns = jax.lax.all_gather(things, AXIS, axis=0)",
        (SHARED,),
    ),
    Mutation(
        "devices: each has the same columns of an image in every row",
        "engine/rays.py",
        "across += shares > 1 and across % shares == 0",
        "across += 0",
        (SHARED,),
    ),
    Mutation(
        "devices: the beams of each follow each other",
        "engine/rays.py",
        "turns * devices.number_of(mesh) + devices.index_of(mesh)",
        "turns + devices.index_of(mesh) * self.number * self.beam_count",
        (SHARED,),
    ),
    Mutation(
        "devices: given inside of a shard_map, they deal out again",
        "engine/devices.py",
        "    if mesh is not None and (jax.sharding",
        "    if False and (jax.sharding",
        (SHARED,),
    ),
    Mutation(
        "owned bricks: what is behind is not dimmed",
        "compositing.py",
        "a + (1 - front.opacity) * b",
        "a + b",
        (OWNED,),
    ),
    Mutation(
        "owned bricks: cells between two devices are marched by both",
        "bricks/owned.py",
        "share.underway, cells, exact=True)",
        "share.underway, cells)",
        (OWNED,),
    ),
    Mutation(
        "owned bricks: a device begins where its bricks might, rather than where those before it end",
        "bricks/owned.py",
        "first, until = jnp.maximum(cells.first, self.own.first), jnp",
        "first, until = cells.first, jnp",
        (OWNED,),
    ),
    Mutation(
        "owned bricks: one device has all of them",
        "bricks/owned.py",
        "seen[-1] * i / number",
        "seen[-1]",
        ("engine/test_devices.py::test_devices_own_as_many_bricks_that_are_needed",),
    ),
    # sources of bricks
    Mutation(
        "files: the gap between rows is not stepped over",
        "bricks/files.py",
        "(rows, row), self._type, run, 0, (row_stride, size)",
        "(rows, row), self._type, run, 0, (row * size, size)",
        ("bricks/test_sources.py::test_raw_files_are_read_in_rows_and_in_planes[uint8-16384-8388608]",),
    ),
    Mutation(
        "files: a change after opening is not noticed",
        "bricks/files.py",
        "return status.st_size, status.st_ino, status.st_dev, time",
        "return (0,)",
        ("bricks/test_sources.py::test_a_file_that_is_cut_or_changed_after_opening_is_an_error[False]",),
    ),
    Mutation(
        "files: a writable memory map is taken for a file that does not change",
        "bricks/files.py",
        'writable=root.mode != "r"',
        "writable=False",
        ("bricks/test_sources.py::test_what_is_written_to_a_memory_map_is_read",),
    ),
    Mutation(
        "files: a view of a memory map starts where the map does",
        "bricks/files.py",
        'array.__array_interface__["data"][0] - root.__array_interface__["data"][0]',
        "0",
        ("bricks/test_sources.py::test_views_of_memory_maps_are_read_from_the_file",),
    ),
    Mutation(
        "bricks: rays that are finished in one go on from elsewhere",
        "engine/batch.py",
        "        if job.resumable:",
        "        if False:",
        ("bricks/test_render_bricks.py::test_bricks_of_a_real_volume_look_like_the_whole",),
    ),
    Mutation(
        "bricks: rays leap over the next one, too",
        "engine/batch.py",
        "steps = jnp.minimum(steps, jnp.maximum(range_.until - at.index, 0))",
        "steps = jnp.asarray(steps)",
        ("bricks/test_render_bricks.py::test_only_bricks_that_are_needed_are_read",),
    ),
    Mutation(
        "bricks: back to front",
        "bricks/grid.py",
        "np.argsort(depth, ",
        "np.argsort(-depth, ",
        ("bricks/test_render_bricks.py::test_bricks_of_a_real_volume_look_like_the_whole",),
    ),
    Mutation(
        "bricks: of parallel rays, a slow one along an axis counts as none",
        "bricks/grid.py",
        "np.sign(rate)",
        "np.sign(np.where(np.abs(rate) < 1e-6, 0, rate))",
        (
            "bricks/test_render_bricks.py::"
            "test_no_ray_meets_a_brick_after_one_that_is_behind_it[10000000.0-100.0-True]",
        ),
    ),
    Mutation(
        "bricks: cells of curved rays are looked for behind their last sample",
        "bricks/ranges.py",
        " & (index < march.most_samples)",
        "",
        ("bricks/test_split.py::test_no_cells_are_looked_for_behind_the_last_sample_of_a_ray",),
    ),
    Mutation(
        "bricks: nodes are as far apart near a box as in it",
        "bricks/split.py",
        "_distances(space, low - nodes, high + nodes)",
        "_distances(space, low, high)",
        ("bricks/test_split.py::test_nodes_that_lie_nearer_to_the_apex_than_a_box_are_closer_to_each_other",),
    ),
    Mutation(
        "bricks: one may have more voxels than a volume",
        "bricks/split.py",
        "math.prod(stored) <= MOST_VOXELS and ",
        "",
        ("bricks/test_split.py::test_a_brick_has_fewer_voxels_than_a_volume_may_have",),
    ),
    Mutation(
        "bricks: voxels outside of the ranges found before are rendered",
        "bricks/stream.py",
        "if lowest < least or highest > most:",
        "if False:",
        ("bricks/test_split.py::test_voxels_outside_of_the_ranges_found_before_are_refused[250]",),
    ),
    Mutation(
        "bricks: freed memory goes back after each of them, which takes as long as a small one",
        "bricks/stream.py",
        "if self.bytes_read - returned >= KEPT:",
        "if True:",
        ("bricks/test_memory.py::test_what_was_freed_goes_back_once_much_was_read",),
    ),
    Mutation(
        "bricks: kept in the order of storage, they lie as if it were x, y, z",
        "bricks/render.py",
        "jnp.zeros(3, jnp.int32), source.shape, source.order)",
        "jnp.zeros(3, jnp.int32), source.shape)",
        ("bricks/test_axes.py::test_images_do_not_depend_on_the_order_of_storage",),
    ),
    Mutation(
        "bricks: kept in the order of storage, the slope along x is that along the array's first axis",
        "_util/voxel_fetch.py",
        "return permuted(found, inverse(self.axes))",
        "return found[0], found[1], found[2]",
        (f"{SURFACE}[yzx-0]",),
    ),
    Mutation(
        "bricks: ranges of values are along other axes than the bricks",
        "bricks/summary.py",
        "over_blocks(slab.voxels, combine).transpose(inverse(source.order))",
        "over_blocks(slab.voxels, combine)",
        ("bricks/test_choice.py::test_an_image_reads_what_the_choice_says[F]",),
    ),
    Mutation(
        "bricks: a block at the far end of a brick is not looked at",
        "bricks/choice.py",
        "ends.append(((first, -1), (last + 1, 1)))",
        "ends.append(((first, -1), (np.maximum(last, first + 1), 1)))",
        ("bricks/test_choice.py::test_a_brick_is_visible_if_any_of_its_blocks_is",),
    ),
    Mutation(
        "bricks: what is visible does not count in the choice of a split",
        "bricks/choice.py",
        "return each * -(-int(visible(other, summary, table).sum()) // least)",
        "return each * other.number",
        ("bricks/test_choice.py::test_bricks_follow_what_is_visible",),
    ),
    Mutation(
        "files: planes of another byte order are taken as they are",
        "bricks/files.py",
        "voxels if self._type.isnative else voxels.byteswap(inplace=True)",
        "voxels",
        ("bricks/test_axes.py::test_a_file_is_read_in_any_order_of_axes",),
    ),
    Mutation(
        "empty space: the last, shorter layer of blocks is left out",
        "occupancy.py",
        "low, high = jnp.concatenate([low, last_low]), jnp.concatenate([high, last_high])",
        "low, high = jnp.concatenate([low, low[:1]]), jnp.concatenate([high, high[:1]])",
        ("test_occupancy.py::test_blocks_hold_every_value_between_their_nodes",),
    ),
    Mutation(
        "files: another file under the name of a memory map is taken for it",
        "bricks/files.py",
        "return source if source.holds(array) else None",
        "return source",
        ("bricks/test_sources.py::test_a_memory_map_keeps_its_voxels_when_its_file_is_replaced[r]",),
    ),
    Mutation(
        "bricks: nothing is read around them but what interpolation needs",
        "bricks/split.py",
        "x, y, z = far + ",
        "x, y, z = 0 * far + ",
        ("bricks/test_render_bricks.py::test_every_way_to_render_bricks_looks_like_the_whole[residual]",),
    ),
    Mutation(
        "bricks: none takes what lies in another one",
        "bricks/stream.py",
        "else {brick, *had}",
        "else {brick}",
        ("bricks/test_render_bricks.py::test_bricks_of_a_curved_grid_are_read_once_each",),
    ),
    Mutation(
        "bricks: rays are looked for at whole steps from their entry only",
        "bricks/ranges.py",
        "fronts = [at.offset] if at.shift is None else [at.offset, at.offset + at.shift]",
        "fronts = [0 * at.offset]",
        ("bricks/test_render_bricks.py::test_bricks_of_a_curved_grid_are_read_once_each",),
    ),
    Mutation(
        "bricks: where a ray comes back between two samples is not looked at",
        "bricks/ranges.py",
        "returns = [_End.of(rays, back) for _, back in rays.gaps]",
        "returns = [_End.of(rays, left) for left, _ in rays.gaps]",
        ("bricks/test_render_bricks.py::test_a_stretch_behind_a_gap_that_is_shorter_than_a_step_is_seen",),
    ),
    Mutation(
        "bricks: empty ones have no gradient where rays do not leap",
        "bricks/render.py",
        "    if not scene.march.leaps:",
        "    if False:",
        ("bricks/test_render_bricks.py::test_gradients_through_bricks_are_those_of_the_whole",),
    ),
    Mutation(
        "bricks: the second march forgets what lies in front",
        "engine/parts_gradient.py",
        "replay.carry, replay.sums = carry, of_rays",
        "replay.sums = of_rays",
        ("bricks/test_render_bricks.py::test_gradients_through_bricks_are_those_of_the_whole",),
    ),
    Mutation(
        "sources: NaN in a brick is not noticed",
        "bricks/dtypes.py",
        "if not np.all(np.isfinite(range_of(voxels))):",
        "if False:",
        ("bricks/test_sources.py::test_a_voxel_that_is_not_finite_is_refused_with_its_place[nan-float32]",),
    ),
    Mutation(
        "zarr: missing chunks are filled silently",
        "bricks/zarr.py",
        '"fill_missing_data_reads": fill',
        '"fill_missing_data_reads": True',
        ("bricks/test_zarr.py::test_a_missing_chunk_is_an_error_unless_it_means_fill[3, sharded]",),
    ),
    Mutation(
        "OME-Zarr: translations of a level are not scaled by those of all levels",
        "bricks/ome_zarr.py",
        "(scale * values, offset * values)",
        "(scale * values, offset)",
        ("bricks/test_zarr.py::test_transformations_of_all_levels_come_after_their_own",),
    ),
    Mutation(
        "summary: slabs overlap by one voxel less",
        "bricks/streaming.py",
        "last = min(length, BLOCK * blocks + 1)",
        "last = min(length, BLOCK * blocks)",
        ("bricks/test_summary.py::test_blocks_equal_those_of_the_volume_in_memory[uint8-(23, 18, 33)]",),
    ),
    Mutation(
        "summary: a node on the face between two blocks belongs to one of them",
        "bricks/summary.py",
        "max(begin, (last - 1) // self.cell)",
        "max(begin, (last - 2) // self.cell)",
        ("bricks/test_summary.py::test_range_of_a_box_holds_its_voxels_and_no_more_than_its_blocks[4]",),
    ),
    Mutation(
        "summary: a file of other data is used",
        "bricks/summary_files.py",
        '"data": fingerprint}',
        '"data": {}}',
        ("bricks/test_summary.py::test_changed_data_get_a_new_summary",),
    ),
    Mutation(
        "detail: blocks outside the view count",
        "bricks/detail.py",
        "visible = visible & (_greatest(normal, edges) + offset >= 0)",
        "pass",
        ("bricks/test_detail.py::test_blocks_beside_the_view_do_not_count",),
    ),
    Mutation(
        "detail: what a coarse level adds does not count",
        "bricks/detail.py",
        "_unmatched(transfer, *coarse, *fine)",
        "0",
        ("bricks/test_detail.py::test_values_that_a_level_adds_count",),
    ),
    # shading by gradients
    Mutation(
        "slopes: of two nodes at the border, over two cells",
        "_util/voxel_fetch.py",
        "jnp.where(whole, 1, 0.5)",
        "jnp.where(whole, 0.5, 0.5)",
        (f"{SLOPES}[float32]",),
    ),
    Mutation(
        "slopes: a bit of y is read as one of z",
        "_util/voxel_fetch.py",
        "for bits in (0, 10, shift)",
        "for bits in (0, 9, shift)",
        (f"{SLOPES}[uint8]",),
    ),
    Mutation(
        "Phong: normals are not turned to the viewer",
        "lighting/phong.py",
        "jnp.where(toward_viewer < 0, -1, 1)",
        "jnp.where(toward_viewer < 0, 1, 1)",
        ("lighting/test_phong.py::test_both_sides_are_lit_alike",),
    ),
    Mutation(
        "inline shading: where cells begin, not where they are sampled",
        "engine/inline_shading.py",
        "pipeline.march.sample(cell)",
        "cell.front",
        ("lighting/test_phong.py::test_quadratures_shade_where_they_sample[preintegrated]",),
    ),
    # transfer functions of value and gradient magnitude
    Mutation(
        "2-D transfer function: rows as long as the number of lines",
        "transfer2d.py",
        "return i * (self.magnitudes.shape[0] - 1) + j",
        "return i * self.magnitudes.shape[0] + j",
        (f"{TABLE}[5-3]",),
    ),
    Mutation(
        "2-D transfer function: the derivative by the magnitude is that by the value",
        "transfer2d.py",
        "of_across * slope_between_lines(self.magnitudes",
        "of_along * slope_between_lines(self.magnitudes",
        ("test_transfer2d.py::test_the_pull_of_many_samples_is_jaxs_derivative",),
    ),
    Mutation(
        "slopes of blocks: without the nodes on their far faces",
        "occupancy.py",
        "jnp.clip(BLOCK * block + jnp.arange(BLOCK + 1), 0, last)",
        "jnp.clip(BLOCK * block + jnp.arange(BLOCK), 0, last)",
        (f"{RANGES}[float32]",),
    ),
    Mutation(
        "slopes of blocks: per node, not per world length",
        "occupancy.py",
        "low, high = self.low[axis] / spacing[axis], self.high[axis] / spacing[axis]",
        "low, high = self.low[axis], self.high[axis]",
        (f"{RANGES}[float32]",),
    ),
    Mutation(
        "slopes of blocks: one that is NaN is like any other",
        "occupancy.py",
        "unordered |= ~(low <= high)",
        "unordered |= low > high",
        (f"{RANGES}[NaN]",),
    ),
    Mutation(
        "2-D transfer function: a range ends at the line below its end",
        "_util/bilinear.py",
        "last = jnp.maximum(points_below(lines, high, strictly=True), points_below(lines, high) - 1)",
        "last = jnp.maximum(points_below(lines, high) - 1, 0)",
        (f"{RANGES}[float32]",),
    ),
    Mutation(
        "shading: invisible samples have no light under replay",
        "engine/replay.py",
        "if samples.light is None:",
        "if samples.light is not None:",
        ("lighting/test_invisible_samples.py::test_gradients_match_one_sided_differences[midpoint]",),
    ),
    Mutation(
        "shading: directions of samples have no cotangent under replay",
        "engine/shading_gradient.py",
        "place = of_sample.point, of_sample.direction",
        "place = of_sample.point, jax.tree.map(jnp.zeros_like, of_sample.direction)",
        ("lighting/test_phong.py::test_gradients_match_central_differences[replay]",),
    ),
    Mutation(
        "shading: parameters of a field have no cotangent under replay",
        "lighting/shading.py",
        "whole = with_fetch(with_voxels(rest, volume.data), volume.fetch)",
        "whole = volume",
        ("lighting/test_phong.py::test_fields_are_shaded_and_have_gradients",),
    ),
    Mutation(
        "2-D transfer function: points reach to their sides",
        "transfer2d.py",
        "(low < lines[-1]) & (lines[-1] < high)",
        "(low <= lines[-1]) & (lines[-1] <= high)",
        ("test_transfer2d.py::test_nothing_is_left_of_a_point_at_its_sides_and_beyond",),
    ),
    Mutation(
        "occupancy: slopes of doubles subtracted in single precision",
        "occupancy.py",
        "dtype = data.dtype if data.dtype == jnp.float64 else jnp.float32",
        "dtype = jnp.float32",
        ("test_transfer2d.py::test_slopes_of_large_doubles_are_not_lost",),
    ),
    # planning
    Mutation(
        "plan: the opacity of an error left out",
        "planning/probe.py",
        "for each in (color, color - opacity)]",
        "for each in (color, color)]",
        ("planning/test_probe.py",),
    ),
    Mutation(
        "plan: patches at the edge counted as whole ones",
        "planning/probe.py",
        "inside = ((column < width) & (row < height)).astype(float)",
        "inside = ((column < width + 9) & (row < height + 9)).astype(float)",
        ("planning/test_probe.py",),
    ),
    Mutation(
        "plan: the error of the most accurate image taken to be 0",
        "planning/probe.py",
        "return cls(probe, images[-1], last * ratio / (1 - ratio))",
        "return cls(probe, images[-1], 0 * last)",
        ("planning/test_probe.py",),
    ),
    Mutation(
        "plan: faces at the far ends not looked at",
        "space.py",
        "for axis in range(3) for end in (0, -1)]",
        "for axis in range(3) for end in (1, 1)]",
        ("planning/test_plan.py::test_a_full_cube_in_empty_space_is_aligned_where_it_touches_a_face",),
    ),
    Mutation(
        "plan: the tolerance ten times as large",
        "planning/plan.py",
        "goal = MARGIN * tolerance - share",
        "goal = 10 * MARGIN * tolerance - share",
        ("planning/test_plan.py::test_it_is_within_its_tolerance",),
    ),
    Mutation(
        "plan: rounded voxels kept whatever they change",
        "planning/storage.py",
        "if change <= allowed:",
        "if change <= 1:",
        ("planning/test_storage.py",),
    ),
    # adaptive sampling
    Mutation(
        "adaptive sampling: differences across two axes left out",
        "variation.py",
        "(jnp.diff(slope, axis=axis), 1), (jnp.diff(slope, axis=other), 0)",
        "(jnp.diff(slope, axis=axis), 1), (0 * jnp.diff(slope, axis=other), 0)",
        (
            "transforms/test_adaptive_sampling.py::test_a_value_that_bends_across_the_axes_alone_is_found",
            "transforms/test_adaptive_sampling.py::test_windows_hold_what_lies_in_and_around_each_block",
        ),
    ),
    Mutation(
        "adaptive sampling: NaN in a voxel is not seen",
        "variation.py",
        "return low, high, jnp.where(lost, jnp.nan, bend)",
        "return low, high, bend",
        ("transforms/test_adaptive_sampling.py::test_cells_are_one_step_long_where_nothing_is_known[nan]",),
    ),
    Mutation(
        "adaptive sampling: looked up where a run begins, not in its middle",
        "transforms/adaptive_sampling.py",
        "ray.path(run.middle)",
        "ray.path(run.front)",
        ("transforms/test_adaptive_sampling.py::test_the_error_of_a_run_is_that_of_a_window_that_holds_it",),
    ),
    Mutation(
        "adaptive sampling: runs longer than what is known of their surroundings",
        "transforms/adaptive_sampling.py",
        "rounds = jnp.maximum(jnp.ceil(reach - MARGIN / BLOCK), 0)",
        "rounds = jnp.zeros_like(reach)",
        ("transforms/test_adaptive_sampling.py::test_long_stretches_heed_what_lies_farther_away",),
    ),
    Mutation(
        "adaptive sampling: samples are taken to integrate",
        "transforms/adaptive_sampling.py",
        "if not march.integrates:",
        "if False:",
        ("transforms/test_adaptive_sampling.py::test_samples_must_find_what_integrals_hold",),
    ),
    # rays: positions, first samples, volumes
    Mutation(
        "toroidal map: wrong sign of an angle",
        "transforms/toroidal_map.py",
        "return half + _atan2(y, z), half + _atan2(x, off)",
        "return half - _atan2(y, z), half + _atan2(x, off)",
        (
            "transforms/test_toroidal_map.py::test_map_and_inverse_agree_with_each_other_and_with_the_printed_formula",
        ),
    ),
    Mutation(
        "toroidal map: the first gap of a ray only",
        "transforms/sector_faces.py",
        "GAPS = 2",
        "GAPS = 1",
        ("transforms/test_toroidal_map.py::test_gaps_are_where_a_ray_is_outside_in_between",),
    ),
    Mutation(
        "toroidal map: a ray is back as soon as it passes one face",
        "transforms/sector_faces.py",
        "reduce(jnp.minimum if inside else jnp.maximum, map(clear, to_faces, near))",
        "reduce(jnp.maximum, map(clear, to_faces, near))",
        ("transforms/test_toroidal_map.py::test_gaps_are_where_a_ray_is_outside_in_between",),
    ),
    Mutation(
        "clip: what is cut away in front of a ray's entry is a gap",
        "transforms/clip.py",
        "first = jnp.where(cut & (enters <= begin + film), _later(near, leaves), near)",
        "first = near",
        ("transforms/test_clip.py::test_cut_faces_stay_smooth_under_empty_space_jitter",),
    ),
    Mutation(
        "clip: cells are empty where their middle is cut away",
        "transforms/clip.py",
        "reach = 0.51 * dot((a, b, c), grid.size)",
        "reach = 0 * dot((a, b, c), grid.size)",
        (
            "transforms/test_clip.py::test_no_cell_that_holds_anything_seen_is_taken_as_empty",
            "transforms/test_clip.py::test_leaping_does_not_show",
        ),
    ),
    Mutation(
        "clip: gaps of a sector that begin before a cut and end behind it are lost",
        "transforms/clip.py",
        "gaps = self.inner.gaps(entry, direction, _later(length, far))",
        "gaps = self.inner.gaps(entry, direction, length)",
        ("transforms/test_clip.py::test_it_clips_a_swept_sector_in_the_world",),
    ),
    Mutation(
        "clip: planes of a sector's world replaced by a map that comes later",
        "march.py",
        "            space = transform.clip(space)",
        "            space = transform.clip(Affine(volume))",
        ("transforms/test_clip.py::test_it_clips_a_swept_sector_in_the_world",),
    ),
    Mutation(
        "plan: faces that a clip cuts not looked at",
        "transforms/clip.py",
        "return *self.inner.visible_at_faces(visible), *own",
        "return self.inner.visible_at_faces(visible)",
        ("planning/test_plan.py::test_faces_that_a_clip_cuts_are_aligned_where_something_is_visible",),
    ),
    Mutation(
        "labels: hidden ones are not leapt over",
        "labels.py",
        "functions = jax.lax.stop_gradient(self._seen)",
        "functions = jax.lax.stop_gradient(self.stacked)",
        ("test_labels.py::test_hidden_labels_are_leapt_over",),
    ),
    Mutation(
        "alignment: the last end of a gap in the list taken for the farthest",
        "transforms/alpha_correction.py",
        "last = jnp.where(here & (last < depth), depth, last)",
        "last = jnp.where(here, depth, last)",
        ("transforms/test_clip.py::test_gaps_may_come_in_any_order",),
    ),
    Mutation(
        "alignment: cells are not cut at gaps",
        "transforms/alpha_correction.py",
        "here = (depth > cell.front) & (depth < cell.front + cell.width)",
        "here = (depth > cell.front) & (depth < cell.front)",
        ("transforms/test_toroidal_map.py::test_an_independent_marcher_sees_the_same",),
    ),
    Mutation(
        "entry: distances measured from a ray's base point, not from its origin",
        "space.py",
        "ray = Ray(entry, direction, base + start, length,",
        "ray = Ray(entry, direction, start, length,",
        ("test_space.py::test_depth_is_the_mean_distance_of_what_is_seen",),
    ),
    Mutation(
        "camera: rays round differently in each program that differentiates them",
        "engine/rays.py",
        "return in_memory(all_finite(camera), vmap_rays(partial(_of_pixel, camera)), columns, rows)",
        "return vmap_rays(partial(_of_pixel, camera))(columns, rows)",
        ("test_camera.py::test_rays_round_alike_whether_or_not_they_are_differentiated",),
    ),
    Mutation(
        "start: transforms' start offsets ignored",
        "reference.py",
        "offset=march.start(ray),",
        "offset=zero,",
        ("transforms/test_jitter.py::test_jitter_starts_each_ray_a_part_of_a_step_in",),
    ),
    Mutation(
        "jitter: keyed by the position within a beam, not by the pixel",
        "engine/rays.py",
        "(column + left, row + top))",
        "((column + left) % 8, (row + top) % 8))",
        (f"{RENDERED}[jittered-left]",),
    ),
    Mutation(
        "jitter: every shard draws the same numbers",
        "engine/rays.py",
        "return self.first + index, jnp.zeros_like(index)",
        "return index, jnp.zeros_like(index)",
        ("engine/test_sharding.py::test_image_and_gradient_are_those_of_one_device",),
    ),
    Mutation(
        "leaping: start distances of a crop looked up by the pixel of the whole image",
        "transforms/space_leaping.py",
        "jnp.minimum((pixel - first.astype(pixel.dtype)) // self.cell, n)",
        "jnp.minimum(pixel // self.cell, n)",
        ("transforms/test_space_leaping.py::test_a_part_of_an_image_leaps_as_the_whole",),
    ),
    Mutation(
        "volume: a custom field is ignored",
        "volume.py",
        "return self.interpolated(coordinate) if self.field is None else self.field.value(self, coordinate)",
        "return self.interpolated(coordinate)",
        ("engine/test_volume_kinds.py::test_a_custom_field_is_used_for_image_and_gradient[uint8]",),
    ),
    Mutation(
        "occupancy: computed from the voxels in spite of a custom field",
        "occupancy.py",
        "if volume.field is not None:  #",
        "if False:  #",
        ("engine/test_volume_kinds.py::test_a_custom_field_is_used_for_image_and_gradient[uint8]",),
    ),
    Mutation(
        "replay: gradients of 16-bit voxels summed in 16 bits",
        "engine/replay.py",
        "dtype if jnp.finfo(dtype).bits >= 32 else jnp.float32",
        "dtype",
        ("engine/test_volume_kinds.py::test_gradients_of_voxels_in_16_bits_are_summed_in_32[float16]",),
    ),
    Mutation(
        "jitter: a crop draws other numbers than the whole image",
        "camera.py",
        "left, top = jnp.round(self.corner).astype(jnp.int32)",
        "left, top = jnp.zeros(2, jnp.int32)",
        ("transforms/test_jitter.py::test_a_crop_is_jittered_as_its_part_of_the_image",),
    ),
    # advancing: shifts, leaps, empty space
    Mutation(
        "shift: applied at every transparent cell",
        "reference.py",
        "at = replace(at, offset=at.offset + shift, shift=jnp.where(transparent, 0, at.shift))",
        "at = replace(at, offset=at.offset + shift)",
        (
            "transforms/test_jitter.py::test_empty_space_jitter_shortens_one_step_at_the_first_transparent_sample",
        ),
    ),
    Mutation(
        "leap: one cell too far",
        "engine/batch.py",
        "/ march.step - 1e-3)",
        "/ march.step + 1)",
        (LEAPING_GRADIENT,),
    ),
    Mutation(
        "leap: finished rays advance by an invalid index and overflow",
        "engine/batch.py",
        "jnp.where((steps > 0) & ~at.finished, a, b), moved, at)",
        "jnp.where(steps > 0, a, b), moved, at)",
        (LEAPING_GRADIENT,),
    ),
    Mutation(
        "shift: whole segments are taken although rays may still shift",
        "engine/batch.py",
        "(limited | jnp.any(job.shifts(state[0])))",
        "limited",
        ("engine/test_tiling.py::test_batches_that_are_refilled_do_not_show_where_rays_may_shift",),
    ),
    Mutation(
        "shift: only the first group's shifts count",
        "engine/batch.py",
        "jnp.any(job.shifts(state[0]))",
        "jnp.any(job.shifts(state[0])[:1])",
        ("engine/test_tiling.py::test_batches_that_are_refilled_do_not_show_where_rays_may_shift",),
    ),
    Mutation(
        "toroidal map: the search for a face ends too early",
        "transforms/sector_faces.py",
        "STEPS = 256",
        "STEPS = 8",
        (TO_AXIS,),
    ),
    Mutation(
        "leap: range of visible cells ends one cell too early",
        "engine/batch.py",
        "until = jnp.max(jnp.where(visible, begin + 1, carry.until[None]), axis=0)",
        "until = jnp.max(jnp.where(visible, begin, carry.until[None]), axis=0)",
        (LEAPING_GRADIENT,),
    ),
    Mutation(
        "leap: range of visible cells begins one cell too late",
        "engine/batch.py",
        "return CellRange(jnp.minimum(carry.first, first), until), None, None",
        "return CellRange(jnp.minimum(carry.first, first) + 1, until), None, None",
        (LEAPING_GRADIENT,),
    ),
    Mutation(
        "empty space: beam boxes without the bulge between their corner rays",
        "beams.py",
        "least(d, 1) - bulge / size,",
        "least(d, 1),",
        ("test_beams.py::test_a_box_holds_every_ray_of_its_beam",),
    ),
    Mutation(
        "empty space: boxes of stretches end before their stretch",
        "beams.py",
        "first + 1.01 * length)",
        "first + 0.5 * length)",
        ("test_beams.py::test_stretches_called_empty_contain_nothing_along_any_ray",),
    ),
    Mutation(
        "empty space: blocks without the nodes of their upper faces",
        "occupancy.py",
        "range(BLOCK + 1 + 2 * margin)",
        "range(BLOCK + 2 * margin)",
        ("test_occupancy.py::test_blocks_hold_every_value_between_their_nodes",),
    ),
    Mutation(
        "empty space: chessboard distances one too large",
        "occupancy.py",
        "return jnp.where(anything, distance, jnp.uint8(FARTHEST)).reshape(-1)",
        "return jnp.where(anything, distance + (distance > 0), jnp.uint8(FARTHEST)).reshape(-1)",
        ("test_occupancy.py::test_distances_are_those_of_a_chessboard",),
    ),
    Mutation(
        "empty space: wrong bit for a label",
        "occupancy.py",
        "return (self.labels >> (label % 32)) & 1 == 1",
        "return (self.labels >> (label % 31)) & 1 == 1",
        ("test_occupancy.py::test_blocks_know_their_labels",),
    ),
    Mutation(
        "empty space: blocks with NaN count as empty",
        "engine/acceleration.py",
        "visible |= blocks.unordered",
        "pass",
        (NAN,),
    ),
    Mutation(
        "memo: results outlive their array",
        "_util/memo.py",
        "weakref.finalize(array, _MEMORY.pop, key, None)",
        "pass",
        ("test_occupancy.py::test_memoized_results_are_freed_with_their_array",),
    ),
    # cells and samples
    Mutation(
        "cut: last cell reaches past the exit",
        "transforms/alpha_correction.py",
        "cell = Cell(cell.front, jnp.where(back >= ray.length, left, cell.width),",
        "cell = Cell(cell.front, cell.width,",
        ("transforms/test_alpha_correction.py::test_a_constant_volume_is_exact_under_jitter",),
    ),
    Mutation(
        "cut: a cell that ends at the exit has a width that does not follow it",
        "transforms/alpha_correction.py",
        "jnp.where(back >= ray.length, left, cell.width)",
        "jnp.where(reaches_past, left, cell.width)",
        ("transforms/test_alpha_correction.py::test_the_gradient_by_an_exit_at_the_end_of_a_cell",),
    ),
    Mutation(
        "cut: part of a cell behind a label boundary dropped",
        "transforms/alpha_correction.py",
        "Cell(last, end - last, cell.cut),",
        "Cell(last, 0 * last, cell.cut),",
        ("test_labels.py::test_cells_are_cut_at_labels_and_exact_at_any_step",),
    ),
    Mutation(
        "quadrature: midpoint samples taken at the cell's front",
        "march.py",
        'return cell.front if self.quadrature == "left" else cell.front + cell.width / 2',
        "return cell.front",
        ("test_march.py::test_midpoint_samples_only_inside",),
    ),
    Mutation(
        "integrated: a cell begins with the value at its own end",
        "engine/segment.py",
        "fronts = [jax.tree.map(lambda leaf: leaf[:-1], joints), *inner]",
        "fronts = [jax.tree.map(lambda leaf: leaf[1:], joints), *inner]",
        ("test_preintegration.py::test_opacity_is_exact_where_the_value_is_linear_along_the_ray",),
    ),
    Mutation(
        "integrated: pieces with gaps between them share ends",
        "engine/segment.py",
        "    if not march.joins:\n        fronts, backs = read[::2], read[1::2]",
        "    if len(read) == 4:\n        fronts, backs = [read[0], read[0]], [read[1], read[3]]",
        ("test_preintegration.py::test_pieces_that_need_not_be_joined_are_measured_at_both_ends",),
    ),
    Mutation(
        "integrated: whole spans between falling values counted as between rising ones",
        "_util/piecewise_means.py",
        "jnp.where(up, to_start - to_end, to_end_there - to_start_here)",
        "jnp.where(up, to_start - to_end, to_start_here - to_end_there)",
        ("test_preintegration.py::test_means_are_integrals",),
    ),
    Mutation(
        "integrated: the mean of colours is not weighted by the extinction",
        "_util/piecewise_means.py",
        "jnp.where(emits, part / jnp.where(emits, extinction, 1), color)",
        "color + 0 * part",
        ("test_preintegration.py::test_means_are_integrals",),
    ),
    Mutation(
        "integrated: the value at a cell's end gets the gradient of the one at its front",
        "transfer.py",
        "return transfer, (jnp.zeros_like(of_front), (of_front,), (of_back,))",
        "return transfer, (jnp.zeros_like(of_front), (of_front,), (of_front,))",
        ("test_preintegration.py::test_the_vjp_of_integrals_is_that_of_jax",),
    ),
    Mutation(
        "stop: rays end while their transmittance is high",
        "transforms/early_termination.py",
        "(transmittance <= self.opacity_left)",
        "(transmittance >= self.opacity_left)",
        ("test_march.py::test_early_termination_stops_where_little_is_left",),
    ),
    Mutation(
        "stop: one sample more than the march allows",
        "march.py",
        "return 2**17 if self.max_samples is None else self.max_samples",
        "return 2**17 if self.max_samples is None else self.max_samples + 1",
        ("test_march.py::test_a_march_that_runs_out_of_samples_says_so",),
    ),
    Mutation(
        "compositing: samples not attenuated by those in front",
        "compositing.py",
        "return (1 - before) * alpha",
        "return alpha",
        (f"{RENDERED}[plain-left]",),
    ),
    Mutation(
        "rays: index of 64 bits added to one of 32 under x64",
        "engine/rays.py",
        "index = index.astype(jnp.int32)  # from 64 bits under x64",
        "pass",
        ("engine/test_tiling.py::test_rays_of_ones_own_draw_the_same_numbers_in_float64",),
    ),
    Mutation(
        "selection: rays move past their first cell unseen",
        "engine/wavefront.py",
        "if march.may_shift and weighs and index",
        "if march.may_shift and index",
        ("test_selections.py::test_selections_are_those_of_the_reference[around-isosurface]",),
    ),
    Mutation(
        "selection: opaque blocks are leapt over, and samples shift behind them",
        "engine/acceleration.py",
        "visible |= transfer.visible(blocks)",
        "pass",
        ("test_selections.py::test_rays_shift_where_they_are_transparent_alone",),
    ),
    Mutation(
        "selection: pixels that see nothing are differentiated at an infinite depth",
        "engine/resolve.py",
        "jnp.where(visible, leaf, jnp.zeros_like(leaf))",
        "leaf",
        ("test_selections.py::test_an_image_of_nothing_has_the_gradient_0",),
    ),
    Mutation(
        "selection: depths do not grow with the step",
        "reference.py",
        "depth = jnp.where(seen, ray.t_in + jnp.where(seen, depth, 0) * scale, jnp.inf)",
        "depth = jnp.where(seen, ray.t_in + jnp.where(seen, depth, 0), jnp.inf)",
        ("test_selections.py::test_gradients_are_central_differences[replay-fog]",),
    ),
    Mutation(
        "selection: finished rays go on looking",
        "reference.py",
        "return stops | finished",
        "return stops",
        ("test_selections.py::test_a_finished_ray_takes_no_more_samples",),
    ),
    Mutation(
        "stride: asked about a run that begins where the ray is",
        "march.py",
        "first = ahead & -(RUN << level)",
        "first = ahead & -RUN",
        ("engine/test_strides.py::test_strides_are_those_of_the_reference",),
    ),
    Mutation(
        "stride: a leap ends within a run",
        "reference.py",
        "jnp.where(leaves, steps, ahead.begin - at.index)",
        "jnp.where(leaves, steps, steps)",
        ("engine/test_strides.py::test_strides_are_those_of_the_reference",),
    ),
    Mutation(
        "stride: the fast engine's cells are one step wide",
        "engine/segment.py",
        "partial(pieces, pipeline), in_axes=(0, 0, None))",
        "lambda ray, at, k: pieces(pipeline, ray, eqx.tree_at(lambda a: a.stride, at, 1 + 0 * at.stride), k),"
        " in_axes=(0, 0, None))",
        ("engine/test_strides.py::test_strides_are_those_of_the_reference",),
    ),
    Mutation(
        "stride: a segment moves rays by its number of cells",
        "engine/segment.py",
        "steps = steps if at.stride is None else steps * at.stride",
        "",
        ("engine/test_strides.py::test_strides_are_those_of_the_reference",),
    ),
    Mutation(
        "stride: a segment goes on past the end of a run",
        "engine/segment.py",
        "steps = jnp.minimum(left, run - ((at.index + phase) & (run - 1)))",
        "steps = left",
        ("engine/test_strides.py::test_strides_are_those_of_the_reference",),
    ),
    Mutation(
        "stride: all rays' runs begin where the ray does",
        "march.py",
        "return jnp.floor((part - jnp.floor(part)) * longest).astype(jnp.int32) & (longest - 1)",
        "return jnp.zeros(part.shape, jnp.int32)",
        ("transforms/test_adaptive_sampling.py::test_jitter_breaks_the_wood_grain_of_long_cells",),
    ),
    Mutation(
        "stride: transmittance does not count",
        "march.py",
        "fits &= transmittance * error <= tolerated",
        "fits &= error <= tolerated",
        ("engine/test_strides.py::test_runs_are_the_same_however_a_ray_comes_to_them",),
    ),
    Mutation(
        "stride: a run may hold cells that were taken in another one",
        "march.py",
        "fits = first >= end",
        "fits = first >= 0",
        ("engine/test_strides.py::test_runs_are_the_same_however_a_ray_comes_to_them",),
    ),
    Mutation(
        "stride: long cells reach past the exit",
        "march.py",
        "fits &= run.within(ray.length)",
        "fits &= run.within(ray.length + 1e6)",
        ("transforms/test_adaptive_sampling.py::test_long_cells_do_not_reach_past_the_exit",),
    ),
    Mutation(
        "stride: the estimate grows where samples have run out",
        "reference.py",
        " | (at.index >= pipeline.march.most_samples)\n        error",
        "\n        error",
        ("transforms/test_adaptive_sampling.py::test_samples_that_run_out_end_the_estimate",),
    ),
    Mutation(
        "adaptive: what a cell hides of itself is left out",
        "transforms/adaptive_sampling.py",
        "HIDDEN * hidden",
        "0 * hidden",
        (
            "transforms/test_adaptive_sampling.py::test_colours_that_hide_each_other_and_products_that_bend_are_heeded",
        ),
    ),
    Mutation(
        "variation: emission does not bend between points",
        "_util/piecewise_linear.py",
        " + between(bends)",
        "",
        (
            "transforms/test_adaptive_sampling.py::test_the_variation_bounds_every_change_of_extinction_and_emission",
        ),
    ),
    Mutation(
        "variation: a step is as steep as its height",
        "_util/piecewise_linear.py",
        "jnp.where(stepped, jnp.inf, turned)",
        "turned",
        ("transforms/test_adaptive_sampling.py::test_a_hard_step_does_not_swallow_what_turns_elsewhere",),
    ),
    Mutation(
        "preintegrated: what rounding loses is left out",
        "_util/piecewise_means.py",
        "between = (high + low for high",
        "between = (high for high",
        ("test_preintegration.py::test_what_is_dense_elsewhere_does_not_show",),
    ),
    Mutation(
        "transfer: a classifier of one's own is not asked",
        "transfer.py",
        "        if not self._looks_up_rows:\n            return super().visible(blocks)\n",
        "",
        ("test_transfer.py::test_nothing_is_proven_of_a_classifier_of_ones_own",),
    ),
    Mutation(
        "replay: a leaf alone has another gradient",
        "engine/replay.py",
        "if not total.geometric and total.voxels is None:",
        "if not total.geometric:",
        ("engine/test_gradient_matrix.py::test_only_what_is_asked_for_is_computed_and_it_is_the_same",),
    ),
    # fetching, transfer functions, lighting, path tracing
    Mutation(
        "packing: sign of int16 and int8 lost",
        "_util/voxel_fetch.py",
        "if signed:  #",
        "if not signed:  #",
        (PACKED,),
    ),
    Mutation(
        "packing: neighbouring row taken along the wrong axis",
        "engine/packing.py",
        "jnp.roll(words, -1, 0) << 16",
        "jnp.roll(words, -1, 1) << 16",
        (PACKED,),
    ),
    Mutation(
        "labels: node below instead of the nearest",
        "volume.py",
        "jnp.clip(jnp.floor(c + 0.5).astype(jnp.int32), 0, n - 1)",
        "jnp.clip(jnp.floor(c).astype(jnp.int32), 0, n - 1)",
        ("test_volume.py::test_label_is_that_of_the_nearest_node",),
    ),
    Mutation(
        "transfer function: NaN has extinction 0",
        "_util/piecewise_linear.py",
        "jnp.where(extinction < 0, 0, extinction)",
        "jnp.where(extinction > 0, extinction, 0)",
        (NAN,),
    ),
    Mutation(
        "transfer function: gradient of the upper control point dropped",
        "transfer.py",
        "at_points = sums[:, :4] + jnp.pad(sums[:-1, 4:], ((1, 0), (0, 0)))",
        "at_points = sums[:, :4]",
        ("engine/test_gradients.py::test_vjp_of_tables_matches_jax",),
    ),
    Mutation(
        "NaN: a NaN leaf gives a black image",
        "engine/image.py",
        "return one(each[0], invalid(tiles.rays(scene.source, space, each[0]), fault))",
        "return one(each[0], tiles.rays(scene.source, space, each[0]))",
        (NAN,),
    ),
    Mutation(
        "NaN: a NaN leaf gives a finite gradient",
        "engine/gradients.py",
        "return jax.tree.map(lambda leaf: jnp.where(fault, jnp.nan, leaf), found)",
        "return found",
        (NAN,),
    ),
    Mutation(
        "NaN: the backward march of an invalid scene takes the maximum number of samples",
        "engine/gradients.py",
        "return invalid(self.tiles.rays(source_, space, number), self.fault)",
        "return self.tiles.rays(source_, space, number)",
        ("engine/test_faults.py::test_the_gradient_does_not_march_with_a_nan_step",),
    ),
    Mutation(
        "NaN: a NaN image has derivative 0",
        "reference.py",
        "rgba = rgba * jnp.where(valid, 1, jnp.nan).astype(ray.length.dtype)",
        "rgba = jnp.where(valid, rgba, jnp.nan)",
        ("engine/test_faults.py::test_nan_reaches_image_and_derivative_of_other_adjoints[direct]",),
    ),
    Mutation(
        "transfer function: unevenly spaced points treated as evenly spaced",
        "_util/piecewise_linear.py",
        "even = jnp.all(jnp.abs(values - evenly) < 0.4 * step)",
        "even = jnp.all(jnp.abs(values[1:] - values[:-1] - step) < 1e-3 * step)",
        ("test_transfer.py::test_points_that_lie_nearly_evenly_are_counted_exactly",),
    ),
    Mutation(
        "transfer function: a custom look-up gets the VJP of the standard one",
        "transfer.py",
        "        if not self._looks_up_rows:\n            transfer, ",
        "        if False:\n            transfer, ",
        ("test_transfer.py::test_vjp_of_a_custom_transfer_function_matches_its_look_up",),
    ),
    Mutation(
        "light: photons not occluded by what lies behind them",
        "lighting/photons.py",
        "visible = self._visible(photon.offset, extinctions)",
        "visible = self._visible(photon.offset, [0 * each for each in extinctions])",
        ("lighting/test_lighting.py::test_step_2_a_wall_behind_a_photon_hides_it_within_reach[soft]",),
    ),
    Mutation(
        "light: photons on the side away from a light are lit",
        "lighting/photons.py",
        "near = closer - length**2 / (2 * distance)",
        "near = -closer - length**2 / (2 * distance)",
        ("lighting/test_lighting.py::test_step_1_photons_toward_the_sun_are_lit[soft]",),
    ),
    Mutation(
        "light: template brightness ignores a material's absorption",
        "lighting/photons.py",
        "scale = matter * WHITE * shared.optics.reflectance",
        "scale = matter * WHITE",
        ("lighting/test_lighting.py::test_templates_are_as_bright_as_path_tracing[0.6]",),
    ),
    Mutation(
        "light: unlit emission at the soft edge of a material",
        "lighting/photons.py",
        "return jnp.minimum(2 * sum(shares), 1)",
        "return sum(shares)",
        ("lighting/test_lighting.py::test_nothing_of_a_material_shines_by_itself[soft]",),
    ),
    Mutation(
        "light: the loop over photons ends before the cutoff is reached",
        "lighting/photons.py",
        "least = (1 - 1e-5) * jax",
        "least = 2 * jax",
        ("lighting/test_terms.py::test_samples_shaded_together_are_shaded_as_each_alone[hard]",),
    ),
    Mutation(
        "light: the last group of terms is filled up with terms that there are not",
        "lighting/shading.py",
        "jnp.where(numbers[i] < shading.terms, leaf[i], 0)",
        "leaf[i]",
        ("lighting/test_terms.py::test_the_loop_ends_where_none_of_the_samples_needs_more",),
    ),
    Mutation(
        "templates: photons fade out where the threshold is on whole levels",
        "lighting/growth.py",
        "        if self.ends.fades:",
        "        if True:",
        ("lighting/test_threshold.py::test_a_threshold_on_levels_gives_the_papers_count",),
    ),
    Mutation(
        "path tracing: majorant ignores control points within a block's range",
        "_util/piecewise_linear.py",
        "return jnp.maximum(ends, inside) + ROUNDING * extinction.max()",
        "return ends + ROUNDING * extinction.max()",
        ("path_tracing/test_tracking.py::test_no_extinction_exceeds_its_majorant",),
    ),
    Mutation(
        "path tracing: a material absorbs nothing",
        "path_tracing/medium.py",
        "kept = jnp.where(here, 1 - material.opacity, kept)",
        "kept = jnp.where(here, 1, kept)",
        (
            "path_tracing/test_path_trace.py::test_a_material_has_the_extinction_of_its_mean_free_path_and_the_albedo_of_"
            "its_opacity",
        ),
    ),
    Mutation(
        "light: light baked under tracing memoized as tracers",
        "lighting/scatterers.py",
        "with jax.ensure_compile_time_eval():  #",
        "if True:  #",
        ("lighting/test_lighting.py::test_light_that_was_baked_inside_a_program_serves_outside",),
    ),
    # viewer
    Mutation(
        "viewer: a drag turns what is seen against the pointer",
        "viewer/orbit.py",
        "angle = -math.pi * right",
        "angle = math.pi * right",
        ("viewer/test_orbit.py::test_the_front_of_what_is_seen_follows_a_drag",),
    ),
    Mutation(
        "viewer: a fine image is finished before a newer request is drawn",
        "viewer/worker.py",
        "            if self._newer():\n                break",
        "            pass",
        ("viewer/test_worker.py::test_a_newer_request_cancels_a_fine_image_between_two_parts",),
    ),
    Mutation(
        "viewer: pages of others may connect",
        "viewer/page.py",
        "if origin.hostname not in OWN_NAMES or origin.port != self.port:",
        "if origin.port is not None and origin.port != self.port:",
        ("viewer/test_page.py::test_only_its_own_pages_may_connect",),
    ),
    # projections and isosurfaces
    Mutation(
        "maximum: leaps over what may win, since it is invisible",
        "projections.py",
        "Blocks(jnp.full_like(blocks.low, jnp.nanmin(blocks.low)), blocks.high, None)",
        "blocks",
        ("test_projections.py::test_what_is_invisible_of_one_label_may_hide_another",),
    ),
    Mutation(
        "maximum: of equal values, the farthest",
        "projections.py",
        "fragment.valid & ~(rank <= best)",
        "fragment.valid & ~(rank < best)",
        ("test_projections.py::test_they_are_those_of_numpy[random-maximum]",),
    ),
    Mutation(
        "average: cells weigh their opacity",
        "projections.py",
        "return -jnp.log1p(-alpha)  # the optical depth",
        "return alpha",
        ("test_projections.py::test_a_mean_of_linear_values_is_exact[around-midpoint]",),
    ),
    Mutation(
        "average: widths without their derivative",
        "projections.py",
        "        return worth\n",
        "        return 0 * worth\n",
        ("test_projections.py::test_gradients_are_central_differences[average-replay]",),
    ),
    Mutation(
        "isosurface: differentiated behind the crossing, where values may not change",
        "isosurface.py",
        "return jnp.where(state.rises, near, far)",
        "return far",
        ("test_isosurface.py::test_a_plateau_on_the_value_leaves_its_gradient",),
    ),
    Mutation(
        "isosurface: no derivative by the value",
        "isosurface.py",
        "missing = self.value - found",
        "missing = -found",
        ("test_isosurface.py::test_a_plateau_on_the_value_leaves_its_gradient",),
    ),
    Mutation(
        "isosurface: what lies in the last part of a step is not looked for",
        "isosurface.py",
        "cut = () if march.ends_at_exit else (AlphaCorrection(),)",
        "cut = ()",
        ("test_isosurface.py::test_a_plane_is_exact_up_to_the_exit[left]",),
    ),
    Mutation(
        "isosurface: normals point to greater values",
        "isosurface.py",
        "return -slopes *",
        "return slopes *",
        ("test_isosurface.py::test_normals_are_those_of_the_world",),
    ),
    # gradients
    Mutation(
        "replay: wrong sign of the term from behind a sample",
        "compositing.py",
        "transmittance * worth - behind",
        "transmittance * worth + behind",
        (FORWARD_GRADIENT,),
    ),
    Mutation(
        "replay: samples behind early termination have a gradient",
        "engine/replay.py",
        "slopes[i].append(jnp.where(weights.finished[i][k], 0, slope))",
        "slopes[i].append(slope)",
        (FORWARD_GRADIENT,),
    ),
    Mutation(
        "replay: depths measured from the entry point",
        "engine/gradients.py",
        "of_rays = eqx.tree_at(lambda ray: ray.t_in, of_rays, of_rays.t_in + toward)",
        "pass",
        (FORWARD_GRADIENT,),
    ),
    Mutation(
        "replay: one of the eight voxels of a sample gets no gradient",
        "_util/voxel_fetch.py",
        "pair = jnp.stack(cube[x][y], axis=-1)",
        "pair = jnp.stack([cube[x][y][0], cube[x][y][1] * x], axis=-1)",
        (DIFFERENCES,),
    ),
    Mutation(
        "replay: camera gradient of the last tile only",
        "engine/gradients.py",
        "return Sums(total, added(sums.source, of_source))",
        "return Sums(total, jax.tree.map(jnp.zeros_like, of_source))",
        (FORWARD_GRADIENT,),
    ),
    # compiled programs
    Mutation(
        "programs: the branch that must never run is taken",
        "_util/xla.py",
        "return jax.lax.cond(live, f, never, *arguments)",
        "return jax.lax.cond(~live, f, never, *arguments)",
        (f"{RENDERED}[plain-left]",),
    ),
    Mutation(
        "vmap: batch elements in reverse order",
        "_util/xla.py",
        "return jax.lax.map(one, [leaf for leaf, moves in",
        "return jax.lax.map(one, [leaf[::-1] for leaf, moves in",
        (VMAP,),
    ),
    # programs for GPUs
    Mutation(
        "gpu: rays that are out of samples go on in surplus turns",
        "engine/batch.py",
        "over = ~job.alive(here)",
        "over = here.finished",
        (f"{ON_GPUS}::test_rays_that_are_out_of_samples_rest_in_surplus_turns",),
    ),
    Mutation(
        "gpu: segments are taken whole although rays may still shift",
        "engine/batch.py",
        "regular=not may_end",
        "regular=True",
        (f"{ON_GPUS}::test_images_and_gradients_are_those_of_the_tiling_for_cpus[defaults]",),
    ),
    Mutation(
        "gpu: a group that is alive after its turns is dropped",
        "engine/wavefront.py",
        'state[1].at[some].set(going, mode="drop")',
        'state[1].at[some].set(going & (keep > 0), mode="drop")',
        (f"{ON_GPUS}::test_images_and_gradients_are_those_of_the_tiling_for_cpus[defaults]",),
    ),
    Mutation(
        "gpu: surplus turns of a loop change its state",
        "_util/platform.py",
        "partial(jnp.where, cond(state))",
        "partial(jnp.where, True)",
        ("_util/test_platform.py::test_surplus_turns_change_nothing",),
    ),
    Mutation(
        "gpu: what is to lie in memory takes a branch",
        "_util/xla.py",
        "return jax.lax.optimization_barrier(f(*arguments))",
        "return jax.lax.cond(live, f, f, *arguments)",
        (f"{ON_GPUS}::test_a_program_for_cuda_has_no_branch",),
    ),
    Mutation(
        "gpu: stretches of beams look back",
        "beams.py",
        "axis=0, reverse=True)",
        "axis=0)",
        ("test_beams.py::test_stretches_are_the_same_all_at_once",),
    ),
    Mutation(
        "gpu: samples that are not chosen overwrite the first one",
        "_util/compaction.py",
        "jnp.arange(chosen.size, dtype=jnp.int32), chosen.size)",
        "jnp.arange(chosen.size, dtype=jnp.int32), 0)",
        ("_util/test_compaction.py::test_all_at_once_each_chosen_one_is_put_where_it_was_and_no_other",),
    ),
    Mutation(
        "gpu: zeros are added, all to the same place",
        "_util/row_sums.py",
        "jnp.any(rows != 0, axis=-1)",
        "jnp.any(rows == rows, axis=-1)",
        ("_util/test_row_sums.py::test_zeros_are_left_out_and_the_rows_of_one_index_are_dealt_to_copies",),
    ),
    Mutation(
        "gpu: the rows of copies of a table overlap",
        "_util/row_sums.py",
        "number * copy + index",
        "copy + index",
        ("_util/test_row_sums.py::test_sums_are_those_of_float64",),
    ),
    Mutation(
        "gpu: voxels to which something is added are left out",
        "_util/voxel_fetch.py",
        'without_zeros(index, pair, voxels.size), "drop"',
        'without_zeros(index, pair[:, :1], voxels.size), "drop"',
        ("_util/test_voxel_fetch.py::test_cubes_are_added_to_the_voxels_that_they_were_fetched_from",),
    ),
    Mutation(
        "gpu: sums of occupied cells miss an axis",
        "occupancy.py",
        "table = jnp.cumsum(table, axis=axis, dtype=jnp.int32)",
        "table = jnp.cumsum(table, axis=min(axis, 1), dtype=jnp.int32)",
        ("test_occupancy.py::test_box_queries_agree_with_direct_inspection",),
    ),
    Mutation(
        "bricks: in naive order, rays stop after each cell",
        "bricks/stream.py",
        "own[-1] = True",
        "own[-1] = False",
        ("bricks/test_render_bricks.py::test_the_naive_order_is_visibly_wrong",),
    ),
    # direction
    Mutation(
        "direction: rays are not turned into the cells of what is visible",
        "occupancy.py",
        "return direction if self.frame is None else self.frame.components(direction)",
        "return direction",
        ("test_direction.py::test_what_is_leapt_over_does_not_show",),
    ),
    Mutation(
        "direction: rows taken for columns",
        "_util/frame.py",
        "apart(direction[:, axis])",
        "apart(direction[axis])",
        ("test_direction.py::test_nodes_lie_where_numpy_puts_them",),
    ),
    Mutation(
        "direction: left out of bricks",
        "bricks/render.py",
        "*place, direction=direction)\n    # its",
        "*place)\n    # its",
        ("test_direction.py::test_bricks_keep_the_direction",),
    ),
    Mutation(
        "direction: light comes from where it would without",
        "path_tracing/walks.py",
        "x, y, z = self.space.point(coordinate)",
        "x, y, z = (o + c for o, c in zip(apart(self.volume.origin), coordinate, strict=True))",
        ("test_direction.py::test_light_arrives_at_the_world_point",),
    ),
    Mutation(
        "DICOM: slices in the order of their names",
        "formats/dicom.py",
        "slices = sorted(slices, key=lambda each: float(each.position @ normal))",
        "slices = list(slices)",
        ("formats/test_dicom.py::test_a_shuffled_series_comes_out_sorted_and_rescaled",),
    ),
    Mutation(
        "an axis is reversed, and the origin stays",
        "formats/orientation.py",
        "        if sign < 0:",
        "        if False:",
        ("formats/test_save.py::test_a_volume_turned_by_more_comes_back_in_the_same_place",),
    ),
    # ultrasound as acquired
    Mutation(
        "kretz: beams and planes exchanged",
        "formats/kretz.py",
        "for tag in (BETA, SIGMA, GAMMA))",
        "for tag in (SIGMA, BETA, GAMMA))",
        ("formats/test_kretz.py::test_voxels_and_probe_come_out_as_they_were_written",),
    ),
    Mutation(
        "kretz: the radius of the motor for that of the fan",
        "formats/kretz.py",
        "ToroidalMap(apex * step, first * step,",
        "ToroidalMap(-apex * step, first * step,",
        ("formats/test_kretz.py::test_nodes_lie_where_slicerheart_puts_them",),
    ),
    Mutation(
        "kretz: items that end behind the file",
        "formats/kretz.py",
        "if at > n_bytes:",
        "if False:",
        ("formats/test_kretz.py::test_a_bad_file_is_refused_with_its_reason",),
    ),
    Mutation(
        "kretz: uneven angles taken as even ones",
        "formats/kretz.py",
        "if not (step > 0 and away <= UNEVEN):",
        "if not step > 0:",
        ("formats/test_kretz.py::test_angles_may_be_uneven_up_to_what_the_docstring_says",),
    ),
    Mutation(
        "kretz: voxels that do not match the header",
        "formats/kretz.py",
        "if voxels.length != expected:",
        "if False:",
        ("formats/test_kretz.py::test_a_bad_file_is_refused_with_its_reason",),
    ),
    Mutation(
        "kretz: the last sample is one step deeper",
        "formats/kretz.py",
        "(0.0, (shape[2] - 1) * step)",
        "(0.0, shape[2] * step)",
        ("formats/test_kretz.py::test_voxels_and_probe_come_out_as_they_were_written",),
    ),
    Mutation(
        "kretz: lengths in metres",
        "formats/kretz.py",
        "step = 1000 * resolution",
        "step = resolution",
        ("formats/test_kretz.py::test_voxels_and_probe_come_out_as_they_were_written",),
    ),
    Mutation(
        "kretz: the last one of equal items counts",
        "formats/kretz.py",
        "if tag in found:\n            raise",
        "if False:\n            raise",
        ("formats/test_kretz.py::test_a_bad_file_is_refused_with_its_reason",),
    ),
    Mutation(
        "kretz: samples behind the motor axis are taken",
        "formats/kretz.py",
        "if nearest < -1e-6 * abs(apex * step):",
        "if False:",
        ("formats/test_kretz.py::test_a_bad_file_is_refused_with_its_reason",),
    ),
    Mutation(
        "kretz: a resolution of 0",
        "formats/kretz.py",
        "if not 0 < resolution < math.inf:",
        "if not 0 <= resolution < math.inf:",
        ("formats/test_kretz.py::test_a_bad_file_is_refused_with_its_reason",),
    ),
    Mutation(
        "scan conversion: integers are cut, not rounded",
        "scan_conversion.py",
        "jnp.clip(jnp.rint(value), ",
        "jnp.clip(value, ",
        ("test_scan_conversion.py::test_the_type_may_be_another_and_integers_are_rounded_not_cut",),
    ),
    Mutation(
        "scan conversion: the sector's faces belong to the outside",
        "scan_conversion.py",
        "(c >= -more) & (c <= n - 1 + more)",
        "(c > more) & (c < n - 1 - more)",
        ("test_scan_conversion.py::test_nodes_on_the_faces_are_inside",),
    ),
    Mutation(
        "scan conversion: outside is what the nearest sample is",
        "scan_conversion.py",
        "value = jnp.where(inside, volume.value(at), fill)",
        "value = volume.value(at)",
        ("test_scan_conversion.py::test_behind_the_apex_and_the_axis_there_is_nothing",),
    ),
    Mutation(
        "scan conversion: labels are those of the next sample",
        "scan_conversion.py",
        "jnp.where(inside, volume.label(at), 0)",
        "jnp.where(inside, volume.label((at[0] + 1, *at[1:])), 0)",
        ("test_scan_conversion.py::test_labels_are_those_of_the_nearest_sample",),
    ),
    Mutation(
        "scan conversion: the grid begins at the middle of the sector",
        "scan_conversion.py",
        "(jnp.asarray(nodes, spacing.dtype) - 1) * spacing / 2",
        "0 * spacing",
        ("test_scan_conversion.py::test_the_grid_encloses_the_sector_and_is_centred_on_it",),
    ),
    Mutation(
        "scan conversion: one node too few",
        "scan_conversion.py",
        "int(min(n, MOST_VOXELS)) + 1 for n",
        "int(min(n, MOST_VOXELS)) for n",
        ("test_scan_conversion.py::test_the_grid_encloses_the_sector_and_is_centred_on_it",),
    ),
    Mutation(
        "scan conversion: memory is not asked for",
        "scan_conversion.py",
        "    require_room(\n        math.prod(nodes)",
        "    require_room(\n        0 * math.prod(nodes)",
        ("test_scan_conversion.py::test_a_grid_larger_than_memory_is_refused_before_it_is_made",),
    ),
    Mutation(
        "probe geometry: samples behind the motor axis",
        "fitting/probe_geometry.py",
        "about_axis, axis - about_axis.nearest_to_axis)",
        "about_axis, axis - near)",
        ("fitting/test_probe_geometry.py::test_forward_undoes_inverse",),
    ),
    Mutation(
        "probe geometry: where depth begins is fitted, too",
        "fitting/probe_geometry.py",
        "gamma = jnp.stack([first, first + span])",
        "gamma = jnp.stack([first, span])",
        ("fitting/test_probe_geometry.py::test_forward_undoes_inverse",),
    ),
    Mutation(
        "toroidal map: the outermost beams are the farthest from the motor axis",
        "transforms/toroidal_map.py",
        "depth * jnp.min(jnp.sin(self.sigma_range))",
        "depth * jnp.max(jnp.sin(self.sigma_range))",
        ("transforms/test_toroidal_map.py::test_the_sample_nearest_to_the_axis_is_that_of_the_formula",),
    ),
    Mutation(
        "residual: blurred along columns only",
        "fitting/residuals.py",
        "for axis, n in enumerate((height, width)):",
        "for axis, n in enumerate((height,)):",
        ("fitting/test_probe_geometry.py::test_the_loss_of_blurred_images_is_that_of_scipys_blur",),
    ),
    Mutation(
        "coarse to fine: every fit begins at the start",
        "fitting/coarse_to_fine.py",
        "        parameters = fits[-1].parameters\n",
        "",
        ("fitting/test_probe_geometry.py::test_coarse_to_fine_is_one_fit_after_the_other",),
    ),
    Mutation(
        "coarse to fine: nothing is blurred",
        "fitting/coarse_to_fine.py",
        "fit(residual.blurred(blur), parameters",
        "fit(residual.blurred(None), parameters",
        ("fitting/test_probe_geometry.py::test_coarse_to_fine_is_one_fit_after_the_other",),
    ),
    # choices among models
    Mutation(
        "choice: the largest candidate, always",
        "fitting/choice.py",
        "chosen = [row.supported for row in rows].index(True)",
        "chosen = len(rows) - 1",
        ("fitting/test_choice.py::test_the_truth_is_chosen_in_nine_of_ten_noisy_trials",),
    ),
    Mutation(
        "choice: training views in place of held-out ones",
        "fitting/choice.py",
        "judge = HeldOut(unseen, block)",
        "judge = HeldOut([seen], block)",
        ("fitting/test_choice.py::test_numbers_of_the_table_are_those_of_their_definitions",),
    ),
    Mutation(
        "choice: the least held-out loss",
        "fitting/choice.py",
        "within = excess <= errors * excess_error",
        "within = excess <= 0 * errors * excess_error",
        ("fitting/test_choice.py::test_the_truth_is_chosen_in_nine_of_ten_noisy_trials",),
    ),
    Mutation(
        "choice: rounding decides where there is no noise",
        "fitting/choice.py",
        " or math.sqrt(2 * of_row[0]) <= of_held_out",
        "",
        ("fitting/test_choice.py::test_rounding_alone_decides_nothing",),
    ),
    Mutation(
        "choice: larger models start anew",
        "fitting/candidates.py",
        "return _firsts(self.coarse(found), self.fine)",
        "return _firsts(self.coarse.parts, self.fine)",
        ("fitting/test_choice.py::test_materials_share_what_they_have_in_common",),
    ),
    Mutation(
        "choice: refinement moves points",
        "fitting/candidates.py",
        "rows[gap] * (1 - share) + rows[gap + 1] * share",
        "rows[gap] * share + rows[gap + 1] * (1 - share)",
        ("fitting/test_choice.py::test_a_refined_transfer_function_is_the_same_function",),
    ),
]


def copy_to(folder: Path) -> None:
    """Copy the parts of the tree that the tests need."""
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            ignored = shutil.ignore_patterns("__pycache__", "results")
            shutil.copytree(source, folder / name, ignore=ignored)
        elif source.exists():
            shutil.copy2(source, folder / name)


def run(folder: Path, tests: tuple[str, ...], programs: Path) -> subprocess.CompletedProcess[str]:
    """Run pytest on these tests in a copy of the tree; all runs share a compilation cache in `programs`."""
    environment = os.environ | {
        "PYTHONDONTWRITEBYTECODE": "1",
        "JAX_COMPILATION_CACHE_DIR": str(programs),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    named = [f"tests/{test}" for test in tests]
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", *named]
    options: Any = {"cwd": folder, "env": environment, "capture_output": True, "text": True, "check": False}
    try:
        return subprocess.run(command, timeout=TIMEOUT, **options)
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(command, -1, f"still running after {TIMEOUT} s", "")


def first_failure(output: str) -> str:
    """Name of the first failed test in pytest's output."""
    lines = [line for line in output.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return lines[0].split(" - ")[0] if lines else output.strip()[-2000:]


def check(tests: tuple[str, ...], mutation: Mutation | None, folder: Path, programs: Path) -> bool:
    """Whether the tests pass in a copy of the tree, made in `folder`; with a mutation, whether one fails."""
    begin = time.monotonic()
    folder.mkdir()
    copy_to(folder)
    if mutation is not None:
        (folder / "jaxvol" / mutation.file).write_text(mutation.applied(folder), encoding="utf-8")
    result = run(folder, tests, programs)
    shutil.rmtree(folder)
    # pytest's exit code is 0 if all passed, 1 if some failed, and else it could not run the tests
    good = result.returncode == (0 if mutation is None else 1)
    outcomes = {0: "all pass", 1: first_failure(result.stdout)}
    name = f"without faults, {len(tests)} tests" if mutation is None else mutation.name
    verdict = outcomes.get(result.returncode, result.stdout + result.stderr)
    print(f"{'ok' if good else 'MISSED'}: {name}: {verdict} ({time.monotonic() - begin:.0f} s)", flush=True)
    return good


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.mutations", description=str(__doc__).splitlines()[0]
    )
    parser.add_argument("--only", action="append", metavar="NAME", help="faults whose name contains this")
    parser.add_argument("-j", type=int, default=1, metavar="N", help="number of parallel jobs")
    parser.add_argument("--list", action="store_true", help="list the faults and run nothing")
    arguments = parser.parse_args()
    chosen = [m for m in MUTATIONS if not arguments.only or any(part in m.name for part in arguments.only)]
    if not chosen:
        parser.error(f"--only {arguments.only}: no fault has such a name; see --list.")
    if arguments.list:
        print("\n".join(m.name for m in chosen))
        return 0
    for mutation in chosen:
        mutation.applied(ROOT)
    tests = tuple(sorted({test for mutation in chosen for test in mutation.tests}))
    parts = [tests[i :: arguments.j] for i in range(min(arguments.j, len(tests)))]

    with tempfile.TemporaryDirectory() as temporary, ThreadPoolExecutor(arguments.j) as pool:

        def run_all(jobs: list[tuple[tuple[str, ...], Mutation | None]], name: str) -> list[bool]:
            folders = [Path(temporary) / f"{name}{i}" for i in range(len(jobs))]
            programs = [Path(temporary) / "programs"] * len(jobs)
            return list(pool.map(check, *zip(*jobs, strict=True), folders, programs))

        if not all(run_all([(part, None) for part in parts], "plain")):
            return 1
        caught = run_all([(m.tests, m) for m in chosen], "fault")
    print(f"{sum(caught)} of {len(caught)} faults are caught.")
    return 0 if all(caught) else 1


if __name__ == "__main__":
    sys.exit(main())
