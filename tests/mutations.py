"""Would the tests see it? Known faults, each put into a copy of the tree, where the fast tests must fail.

`python -m tests.mutations` runs the named tests of every fault below, first as the library is, when all must
pass, and then with each fault in turn, when at least one must fail. Nothing is changed in place. `--only
NAME` runs some of them, `-j N` so many at once, `--list` tells which there are.

A fault is one that happened, or that is easily made: an index that overflows, a sign, a place off by one.
Where none of the fast tests sees one, a test is missing; where its old text is not found any more, the code
has changed, and the fault wants to be stated anew.
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
"""Seconds after which a test that does not end is taken for one that sees nothing."""

COPIED = ("jaxvol", "tests", "experiments", "pyproject.toml")


class Mutation(NamedTuple):
    """A fault.

    - `name`: what goes wrong.
    - `file`: of `jaxvol/`; `old`: a text that it holds once; `new`: what stands there instead.
    - `tests`: fast tests, relative to `tests/`, of which at least one must fail.
    """

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    def applied(self, root: Path) -> str:
        """The file's text with the fault in it."""
        path = root / "jaxvol" / self.file
        text = path.read_text(encoding="utf-8")
        count = text.count(self.old)
        if count != 1:
            raise ValueError(
                f"{self.name}: jaxvol/{self.file} must hold this text once, and holds it {count} times:\n\n"
                f"{self.old}\n\nThe code has changed: state the fault anew in tests/mutations.py."
            )
        return text.replace(self.old, self.new)


LEAPT_GRADIENT = (
    "engine/test_gradient_matrix.py::test_replay_does_not_see_the_leaps[jittered-hierarchy-uint8]"
)
FORWARD_GRADIENT = "engine/test_gradient_matrix.py::test_forward_is_replay[jittered-hierarchy-uint8]"
DIFFERENCES = (
    "engine/test_gradient_matrix.py::test_gradients_are_central_differences[moving-hierarchy-float64]"
)
FAULTS = "engine/test_faults.py::test_what_is_no_number_reaches_image_and_gradient[leaping]"
IN_TURN = "engine/test_vmap.py::test_over_one_part[cameras-uint8]"
PACKED = "transforms/test_space_leaping.py::test_packed_voxels_are_the_same_values"
RENDERED = "test_agreement.py::test_the_renderer_is_the_independent_marcher"

MUTATIONS = [
    # where rays are, and where they begin
    Mutation(
        "toroidal map: the sign of an angle",
        "transforms/toroidal_map.py",
        "return half + _atan2(y, z), half + _atan2(x, off)",
        "return half - _atan2(y, z), half + _atan2(x, off)",
        (
            "transforms/test_toroidal_map.py::test_map_and_inverse_agree_with_each_other_and_with_the_printed_formula",
        ),
    ),
    Mutation(
        "locate: distances of a far camera counted from its base, not from its origin",
        "space.py",
        "ray = Ray(entry, direction, base + start, length,",
        "ray = Ray(entry, direction, start, length,",
        ("test_space.py::test_depth_is_the_mean_distance_of_what_is_seen",),
    ),
    Mutation(
        "camera: rays are rounded anew by every program that differentiates them",
        "engine/tiles.py",
        "return in_memory(all_finite(camera), vmap_rays(partial(_of_pixel, camera)), columns, rows)",
        "return vmap_rays(partial(_of_pixel, camera))(columns, rows)",
        ("test_camera.py::test_rays_round_alike_whether_or_not_they_are_differentiated",),
    ),
    Mutation(
        "start: no transform is asked where the first cell begins",
        "reference.py",
        "offset=march.start(ray),",
        "offset=zero,",
        ("transforms/test_jitter.py::test_jitter_starts_each_ray_a_part_of_a_step_in",),
    ),
    Mutation(
        "jitter: keyed by the place in a beam, not by the pixel",
        "engine/tiles.py",
        "(column + left, row + top))",
        "((column + left) % 8, (row + top) % 8))",
        (f"{RENDERED}[jittered-left]",),
    ),
    Mutation(
        "jitter: every shard draws the same numbers",
        "engine/tiles.py",
        "return self.first + place, jnp.zeros_like(place)",
        "return place, jnp.zeros_like(place)",
        ("engine/test_sharding.py::test_image_and_gradient_are_those_of_one_device",),
    ),
    Mutation(
        "leaping: start distances of a crop are looked up by the pixel of the whole image",
        "transforms/space_leaping.py",
        "jnp.minimum((pixel - first.astype(pixel.dtype)) // self.cell, n)",
        "jnp.minimum(pixel // self.cell, n)",
        ("transforms/test_space_leaping.py::test_a_part_of_an_image_leaps_as_the_whole",),
    ),
    Mutation(
        "volume: a field of one's own is not asked",
        "volume.py",
        "return self.interpolated(coordinate) if self.field is None else self.field.value(self, coordinate)",
        "return self.interpolated(coordinate)",
        ("engine/test_volume_kinds.py::test_a_volume_that_measures_in_its_own_way_keeps_it[uint8]",),
    ),
    Mutation(
        "occupancy: of a field of one's own, taken from the voxels",
        "occupancy.py",
        "if volume.field is not None:  #",
        "if False:  #",
        ("engine/test_volume_kinds.py::test_a_volume_that_measures_in_its_own_way_keeps_it[uint8]",),
    ),
    Mutation(
        "replay: gradients of 16-bit voxels are summed in 16 bits",
        "engine/replay.py",
        "dtype if jnp.finfo(dtype).bits >= 32 else jnp.float32",
        "dtype",
        ("engine/test_volume_kinds.py::test_gradients_of_voxels_in_16_bits_are_summed_in_32[float16]",),
    ),
    Mutation(
        "jitter: a crop has numbers of its own",
        "camera.py",
        "left, top = jnp.round(self.corner).astype(jnp.int32)",
        "left, top = jnp.zeros(2, jnp.int32)",
        ("transforms/test_jitter.py::test_a_crop_is_jittered_as_its_part_of_the_image",),
    ),
    # how they move on
    Mutation(
        "shift: made at every transparent cell",
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
        (LEAPT_GRADIENT,),
    ),
    Mutation(
        "leap: finished rays move by an index that is none, and overflow",
        "engine/batch.py",
        "jnp.where((cells > 0) & ~at.finished, a, b), moved, at)",
        "jnp.where(cells > 0, a, b), moved, at)",
        (LEAPT_GRADIENT,),
    ),
    Mutation(
        "leap: a ray's visible cells end one too early",
        "engine/replay.py",
        "until = jnp.max(jnp.where(seen, cells + 1, kept.until[None]), axis=0)",
        "until = jnp.max(jnp.where(seen, cells, kept.until[None]), axis=0)",
        (LEAPT_GRADIENT,),
    ),
    Mutation(
        "leap: a ray's visible cells begin one too late",
        "engine/replay.py",
        "return CellRange(jnp.minimum(kept.first, first), until), None, None",
        "return CellRange(jnp.minimum(kept.first, first) + 1, until), None, None",
        (LEAPT_GRADIENT,),
    ),
    Mutation(
        "survey: boxes of beams do without the bulge between their corners",
        "beams.py",
        "least(d, 1) - bulge / size,",
        "least(d, 1),",
        ("test_beams.py::test_a_box_holds_every_ray_of_its_beam",),
    ),
    Mutation(
        "survey: boxes of stretches end before the stretch does",
        "beams.py",
        "first + 1.01 * length)",
        "first + 0.5 * length)",
        ("test_beams.py::test_no_stretch_in_which_a_ray_meets_anything_is_empty",),
    ),
    Mutation(
        "survey: blocks without the nodes of their upper faces",
        "occupancy.py",
        "BLOCK, axis) for i in range(BLOCK + 1)",
        "BLOCK, axis) for i in range(BLOCK)",
        ("test_occupancy.py::test_blocks_hold_every_value_between_their_nodes",),
    ),
    Mutation(
        "survey: chessboard distances one too large",
        "occupancy.py",
        "return jnp.where(anything, distance, jnp.uint8(FARTHEST)).reshape(-1)",
        "return jnp.where(anything, distance + (distance > 0), jnp.uint8(FARTHEST)).reshape(-1)",
        ("test_occupancy.py::test_distances_are_those_of_a_chessboard",),
    ),
    Mutation(
        "survey: the bit of another label",
        "occupancy.py",
        "return (self.labels >> (label % 32)) & 1 == 1",
        "return (self.labels >> (label % 31)) & 1 == 1",
        ("test_occupancy.py::test_blocks_know_their_labels",),
    ),
    Mutation(
        "survey: blocks with NaN taken for empty",
        "engine/acceleration.py",
        "transfer.visible(blocks) | blocks.unordered",
        "transfer.visible(blocks)",
        (FAULTS,),
    ),
    Mutation(
        "kept: what was computed from an array stays when the array has gone",
        "_util/memo.py",
        "weakref.finalize(array, _MEMORY.pop, key, None)",
        "pass",
        ("test_occupancy.py::test_what_was_computed_goes_with_its_array",),
    ),
    # what a sample stands for
    Mutation(
        "cut: the last cell reaches past the exit",
        "transforms/alpha_correction.py",
        "cell = Cell(cell.front, jnp.where(reaches_past, left, cell.width),",
        "cell = Cell(cell.front, cell.width,",
        ("transforms/test_alpha_correction.py::test_a_constant_volume_is_exact_under_jitter",),
    ),
    Mutation(
        "cut: the part behind a label's face dropped",
        "transforms/alpha_correction.py",
        "Cell(last, end - last, cell.cut),",
        "Cell(last, 0 * last, cell.cut),",
        ("test_labels.py::test_cells_are_cut_at_labels_and_exact_at_any_step",),
    ),
    Mutation(
        "quadrature: midpoints sampled at the front",
        "march.py",
        'return cell.front if self.quadrature == "left" else cell.front + cell.width / 2',
        "return cell.front",
        ("test_march.py::test_midpoint_samples_only_inside",),
    ),
    Mutation(
        "stop: rays end while much is left",
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
        "compositing: samples weighted as if nothing lay before them",
        "compositing.py",
        "return (1 - self.opacity) * alpha",
        "return alpha",
        (f"{RENDERED}[plain-left]",),
    ),
    # what is read, and what it looks like
    Mutation(
        "packing: the sign of int16 and int8 lost",
        "_util/fetching.py",
        "if signed:  #",
        "if not signed:  #",
        (PACKED,),
    ),
    Mutation(
        "packing: the row beside taken from the wrong axis",
        "engine/packing.py",
        "words = words | beside(words, 1) << 16",
        "words = words | beside(words, 0) << 16",
        (PACKED,),
    ),
    Mutation(
        "labels: the node below, not the nearest",
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
        (FAULTS,),
    ),
    Mutation(
        "transfer function: the gradient of the upper point forgotten",
        "transfer.py",
        "at_points = sums[:, :4] + jnp.pad(sums[:-1, 4:], ((1, 0), (0, 0)))",
        "at_points = sums[:, :4]",
        ("engine/test_gradients.py::test_tables_pull_as_jax_does",),
    ),
    Mutation(
        "faults: a leaf that is NaN leaves the image black",
        "engine/image.py",
        "return one(number, invalid(tiles.rays(source, space, number), fault))",
        "return one(number, tiles.rays(source, space, number))",
        (FAULTS,),
    ),
    Mutation(
        "faults: and its gradient finite",
        "engine/gradients.py",
        "return jax.tree.map(lambda leaf: jnp.where(fault, jnp.nan, leaf), found)",
        "return found",
        (FAULTS,),
    ),
    Mutation(
        "faults: the second march of a faulty scene goes on for as many samples as it may",
        "engine/gradients.py",
        "return invalid(tiles.rays(source_, space, number), fault)",
        "return tiles.rays(source_, space, number)",
        ("engine/test_faults.py::test_a_step_that_is_none_is_not_marched_in_the_gradient_either",),
    ),
    Mutation(
        "faults: an image that is NaN has the derivative 0",
        "reference.py",
        "rgba = at.seen.rgba() * jnp.where(valid, 1, jnp.nan).astype(ray.length.dtype)",
        "rgba = jnp.where(valid, at.seen.rgba(), jnp.nan)",
        ("engine/test_faults.py::test_other_adjoints_have_no_number_either[direct]",),
    ),
    Mutation(
        "transfer function: points taken for even whose deviations add up",
        "_util/piecewise_linear.py",
        "even = jnp.all(jnp.abs(values - places) < 0.4 * step)",
        "even = jnp.all(jnp.abs(values[1:] - values[:-1] - step) < 1e-3 * step)",
        ("test_transfer.py::test_points_that_lie_nearly_evenly_are_counted_exactly",),
    ),
    Mutation(
        "transfer function: one that looks up in its own way is differentiated as if it did not",
        "transfer.py",
        "if any(getattr(type(self), method.__name__) is not method for method in own):",
        "if False:",
        ("test_transfer.py::test_a_transfer_function_of_ones_own_pulls_as_its_look_up_says",),
    ),
    Mutation(
        "light: what lies behind a photon does not hide it",
        "lighting/scatterers.py",
        "seen = intensity * self._visible(around, sample, offset, place.extinction)",
        "seen = intensity",
        ("lighting/test_lighting.py::test_step_2_a_wall_behind_a_photon_hides_it_within_reach[soft]",),
    ),
    Mutation(
        "light: photons on the far side from a light are lit",
        "lighting/scatterers.py",
        "near = closer - length**2 / (2 * distance)",
        "near = -closer - length**2 / (2 * distance)",
        ("lighting/test_lighting.py::test_step_1_photons_toward_the_sun_are_lit[soft]",),
    ),
    Mutation(
        "light: of templates, brighter by what a material absorbs",
        "lighting/scatterers.py",
        "scale = matter * WHITE * notes.optics.reflectance",
        "scale = matter * WHITE",
        ("lighting/test_lighting.py::test_templates_are_as_bright_as_path_tracing[0.6]",),
    ),
    Mutation(
        "light: at a material's edge a part of its matter shines by itself",
        "lighting/scatterers.py",
        "matter = jnp.minimum(2 * sum(notes.shares), 1)",
        "matter = sum(notes.shares)",
        ("lighting/test_lighting.py::test_nothing_of_a_material_shines_by_itself[soft]",),
    ),
    Mutation(
        "path tracing: a block's majorant without the points within its range",
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
        "light: what was baked inside a program is kept as its tracers",
        "lighting/scatterers.py",
        "with jax.ensure_compile_time_eval():  #",
        "if True:  #",
        ("lighting/test_lighting.py::test_light_that_was_baked_inside_a_program_serves_outside",),
    ),
    # what a loss sees of it
    Mutation(
        "replay: the sign of what lies behind a sample",
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
        "replay: depths count from the entry",
        "engine/gradients.py",
        "of_rays = eqx.tree_at(lambda ray: ray.t_in, of_rays, of_rays.t_in + toward)",
        "pass",
        (FORWARD_GRADIENT,),
    ),
    Mutation(
        "replay: one of eight voxels gets no gradient",
        "_util/fetching.py",
        "for place, part in zip(asked, parts, strict=True):",
        "for place, part in list(zip(asked, parts, strict=True))[1:]:",
        (DIFFERENCES,),
    ),
    Mutation(
        "replay: the gradient of a camera is that of its last tile",
        "engine/gradients.py",
        "return (total, added(of_source, of_rays_source)), None",
        "return (total, jax.tree.map(jnp.zeros_like, of_source)), None",
        (FORWARD_GRADIENT,),
    ),
    # programs
    Mutation(
        "programs: the branch that is never taken is",
        "_util/xla.py",
        "return jax.lax.cond(live, f, never, *arguments)",
        "return jax.lax.cond(~live, f, never, *arguments)",
        (f"{RENDERED}[plain-left]",),
    ),
    Mutation(
        "vmap: elements of a batch in another order",
        "_util/xla.py",
        "return jax.lax.map(one, [leaf for leaf, moves in",
        "return jax.lax.map(one, [leaf[::-1] for leaf, moves in",
        (IN_TURN,),
    ),
]


def copy_to(folder: Path) -> None:
    """The tree, without what is not needed to test it."""
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            ignored = shutil.ignore_patterns("__pycache__", "results")
            shutil.copytree(source, folder / name, ignore=ignored)
        elif source.exists():
            shutil.copy2(source, folder / name)


def run(folder: Path, tests: tuple[str, ...], programs: Path) -> subprocess.CompletedProcess[str]:
    """pytest on these tests, of the tree in a folder, with programs kept from run to run."""
    environment = os.environ | {
        "PYTHONDONTWRITEBYTECODE": "1",
        "JAX_COMPILATION_CACHE_DIR": str(programs),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    named = [f"tests/{test}" for test in tests]
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", *named]
    how: Any = {"cwd": folder, "env": environment, "capture_output": True, "text": True, "check": False}
    try:
        return subprocess.run(command, timeout=TIMEOUT, **how)
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(command, -1, f"does not end within {TIMEOUT} s", "")


def first_failure(output: str) -> str:
    """The test that failed, from what pytest printed."""
    lines = [line for line in output.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return lines[0].split(" - ")[0] if lines else output.strip()[-2000:]


def check(tests: tuple[str, ...], mutation: Mutation | None, folder: Path, programs: Path) -> bool:
    """Whether these tests pass in a copy of the tree, made in `folder`; with a fault, whether one fails."""
    begin = time.monotonic()
    folder.mkdir()
    copy_to(folder)
    if mutation is not None:
        (folder / "jaxvol" / mutation.file).write_text(mutation.applied(folder), encoding="utf-8")
    found = run(folder, tests, programs)
    shutil.rmtree(folder)
    # 0: all passed; 1: some failed; all else: pytest could not run them
    good = found.returncode == (0 if mutation is None else 1)
    told = {0: "all pass", 1: first_failure(found.stdout)}
    name = f"as it is, {len(tests)} tests" if mutation is None else mutation.name
    verdict = told.get(found.returncode, found.stdout + found.stderr)
    print(f"{'ok' if good else 'MISSED'}: {name}: {verdict} ({time.monotonic() - begin:.0f} s)", flush=True)
    return good


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.mutations", description=__doc__.splitlines()[0])
    parser.add_argument("--only", action="append", metavar="NAME", help="faults whose names hold this")
    parser.add_argument("-j", type=int, default=1, metavar="N", help="as many at once")
    parser.add_argument("--list", action="store_true", help="name the faults, and run nothing")
    given = parser.parse_args()
    chosen = [m for m in MUTATIONS if not given.only or any(part in m.name for part in given.only)]
    if not chosen:
        parser.error(f"--only {given.only}: no fault has such a name; --list names them.")
    if given.list:
        print("\n".join(m.name for m in chosen))
        return 0
    for mutation in chosen:
        mutation.applied(ROOT)
    tests = tuple(sorted({test for mutation in chosen for test in mutation.tests}))
    parts = [tests[i :: given.j] for i in range(min(given.j, len(tests)))]

    with tempfile.TemporaryDirectory() as temporary, ThreadPoolExecutor(given.j) as pool:

        def run_all(jobs: list[tuple[tuple[str, ...], Mutation | None]], name: str) -> list[bool]:
            folders = [Path(temporary) / f"{name}{i}" for i in range(len(jobs))]
            programs = [Path(temporary) / "programs"] * len(jobs)
            return list(pool.map(check, *zip(*jobs, strict=True), folders, programs))

        if not all(run_all([(part, None) for part in parts], "whole")):
            return 1
        caught = run_all([(m.tests, m) for m in chosen], "fault")
    print(f"{sum(caught)} of {len(caught)} faults are caught.")
    return 0 if all(caught) else 1


if __name__ == "__main__":
    sys.exit(main())
