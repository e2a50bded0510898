"""One ray, cell by cell: the steps that the reference and the fast engine share.

`begin` a ray; cut each cell into `pieces`, `measure` each piece at its sample, compute its `opacity`, and
`add` it to the pixel; `reweigh` what lies behind, `stop` the ray if it needs no more, and `move` it on; at
last `end` it. A cell of
extinction σ and width w has the opacity α = 1 - exp(-σ w); `compositing` makes the pixel. "In front" and
"behind" are as seen from the camera. Comparing the two engines cannot show a bug of this file, which is in
both: `tests/oracle.py` is independent.
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ._util.checks import all_finite, check_answer, described
from ._util.vec3 import Color, Scalar, Vec3
from .compositing.blending import Compositing, Fragment, Outputs, Over, Weighting
from .compositing.selection import RaySampler, Selection
from .lighting.shading import Lighting, lit_classification
from .march.march import Cell, CellRules, March
from .scene.camera import Camera, without_ends
from .scene.rendering import Details, Rendering
from .scene.several import Several, Together
from .scene.space import Line, Ray, Space, enter, world_gradient
from .scene.transfer import Classification, Measured, Transfer, classification_of
from .scene.volume import Volume, grids, without_voxels
from .xla.differentiation import check_captured
from .xla.memory import in_memory
from .xla.platform import is_traced
from .xla.trees import PyTree


class Scene(NamedTuple):
    """Inputs of an image: the arguments of `render`, and what `prepared` computes from them.

    Attributes:
        source: source of the rays, a `Camera` or `GivenRays`; None for a single ray.
        space: the map between world and grid; None until `prepared`.
        classification: measures, classifies and shades samples; None until `prepared`.
    """

    volume: Volume
    transfer: Transfer
    source: Any
    march: March
    compositing: Compositing[Any] = Over()
    lighting: Lighting | None = None
    space: Space = cast(Space, None)
    classification: Classification = cast(Classification, None)

    def prepared(self) -> "Scene":
        """Compute the parts of the scene that are computed once for each image."""
        space = self.march.locate(self.volume)
        lit = lit_classification(
            self.volume, self.transfer, space, self.lighting, integrated=self.march.integrates
        )
        return self._replace(space=space, classification=lit)

    @property
    def has_fault(self) -> Any:
        """True if a number on which all pixels depend is NaN, infinite, or out of its range: a step that is
        not positive; a volume, a transfer function, a transform or a camera that is not `valid`.

        All pixels are NaN then. Otherwise comparisons with NaN, which are false, would hide the fault, and a
        fit that diverged would look converged. `GivenRays` are checked one by one; NaN in voxels spreads to
        the pixels that meet it."""
        rays = None if self.source is None else without_ends(self.source)
        camera = [rays] if isinstance(rays, Camera) else []
        parts = without_voxels(self.volume), self.march, self.transfer, self.compositing, self.lighting
        valid = all_finite((parts, camera)) & (self.march.step > 0)
        for part in (*grids(self.volume), self.transfer, *self.march.transforms, *camera):
            valid &= part.valid
        return ~valid

    @property
    def resolves(self) -> bool:
        """True if pixels are computed after the march, by `resolve`. Rays are then marched without light."""
        return self.compositing.resolves

    @property
    def marched(self) -> "Scene":
        """The scene for marching rays: if it `resolves`, without light, and with the march and transfer
        function that its compositing mode chooses."""
        if not self.resolves:
            return self
        if self.lighting is not None and not self.compositing.can_be_lit:
            mode, light = type(self.compositing).__name__, described(self.lighting)
            raise ValueError(f"lighting must be None under {mode}, which shows no single place; got {light}.")
        transfer, march = self.compositing.marched(self.transfer, self.march, self.volume)
        return self._replace(transfer=transfer, march=march, lighting=None)


def by_rules(scene: Scene) -> Scene:
    """The prepared scene for the kernel of its march, with the march's `rules` instead of the march."""
    rules: Any = scene.march.rules
    return scene._replace(march=rules)


EXPECTED: dict[str, tuple[type, str, str]] = {
    "volume": (
        Volume,
        "a jaxvol Volume",
        "Pass jv.Volume(data, spacing=...) for an array, jv.load(path) for a file, or jv.phantom(name).",
    ),
    "transfer": (
        Transfer,
        "a transfer function",
        "Pass jv.preset(name), jv.colormap(cmap, clim) or jv.TransferFunction.from_points(points).",
    ),
    "camera": (
        Camera,
        "a jaxvol Camera",
        "Pass jv.Camera.looking_at(volume) or jv.Camera(position, focal_point).",
    ),
    "march": (
        March,
        "a jaxvol March",
        'Pass jv.March(step) or jv.March(step, transforms), or "auto" to jv.render.',
    ),
    "lighting": (
        Lighting,
        "None or a Lighting",
        "Pass jv.lighting.Phong() or jv.lighting.ScattererTemplates(materials, lights).",
    ),
}
"""For each argument name: its type, a description, and how to make one."""

COARSE = 1 / 16
"""Largest rounding error of world points, in voxels, for light that is read at them."""

MATCH = 1e-3
"""Distance from a selected depth, in steps, up to which a sample is the selected one."""


def check_arguments(call: str, **arguments: Any) -> None:
    """Check that arguments are of the types that `EXPECTED` has for their names.

    Args:
        call: signature of the function, such as `render(volume, transfer, camera, march)`, quoted when
            arguments are swapped.

    Raises:
        ValueError: naming the first argument of another type, what came, and what to pass.
    """
    for name, value in arguments.items():
        kind, expected, remedy = EXPECTED[name]
        for final in type(value).__mro__[1:]:
            if base := vars(final).get("subclass_instead"):
                raise ValueError(
                    f"{name} must be a jaxvol {final.__name__} itself; got its subclass "
                    f"{type(value).__name__}, with which the fast engine may disagree. Subclass {base}."
                )
        if isinstance(value, kind) or (name == "lighting" and value is None):
            continue
        for slot, (kind, _, _) in EXPECTED.items():
            if isinstance(value, kind):
                remedy = f"That is the {slot}: the order is {call}."
        raise ValueError(f"{name} must be {expected}; got {described(value)}. {remedy}")


def check_channels(
    volume: Volume, transfer: Transfer, march: March, compositing: Compositing[Any], lighting: Lighting | None
) -> None:
    """Raise `ValueError` for a transfer function of another number of channels than the volume, for modes and
    lightings that need a single channel, and for light so far from 0 that world points are coarse."""
    volumes = volume.field.volumes if isinstance(volume.field, Several) else ()
    if volumes and (moved := march.overriding("locate")):
        raise ValueError(
            f"march.transforms: {type(moved[0]).__name__} places one volume; got {len(volumes)}."
        )
    for leaf in jax.tree.leaves(volume.field):
        if callable(leaf):
            check_captured("a function of the volume's field", leaf)
    channels, reads = volume.channels, transfer.channels
    if reads not in (None, channels):
        raise ValueError(
            f"volume must have as many channels as {type(transfer).__name__} reads, {reads}; got {channels}. "
            "Pass several volumes as lists: render([a, b], [transfer_a, transfer_b], ...)."
        )
    # materials of colours are distinguished by labels, which a group of volumes does not have
    needs_value = bool(volumes) or (lighting is not None and lighting.reads_value)
    single = {
        "compositing": described(compositing) if compositing.reads_value else None,
        "lighting": None if lighting is None or not needs_value else described(lighting),
        "march.quadrature": '"preintegrated"' if march.integrates else None,
    }
    for name, value in single.items():
        if channels > 1 and value is not None:
            got = f"{len(volumes)} volumes" if volumes else f"one of {channels} channels"
            raise ValueError(f"{name}: {value} needs a single volume of one channel; got {got}.")
    if march.reweights and not isinstance(compositing, Weighting):
        name = type(march.overriding("roulette")[0]).__name__
        raise ValueError(
            f"march.transforms: {name}.roulette weights the cells of a Weighting; got compositing by "
            f"{type(compositing).__name__}, which selects one."
        )
    bands_of(transfer, volume, lighting)
    if lighting is not None and not lighting.reads_gradient:  # as `Phong` does, where samples are placed
        _check_near(volume, lighting)


def _check_near(volume: Volume, lighting: Lighting) -> None:
    """Raise `ValueError` if the float type does not resolve the world points at which the lighting reads."""
    origin, spacing = volume.origin, volume.spacing
    if is_traced((origin, spacing)):
        return
    far = float(np.max(np.abs(np.asarray(origin)) + np.asarray(volume.shape) * np.asarray(spacing)))
    gap, voxel = far * float(jnp.finfo(spacing.dtype).eps), float(np.min(np.asarray(spacing)))
    if gap > COARSE * voxel:
        raise ValueError(
            f"lighting: {described(lighting)} reads at world points, which lie {gap:.2g} apart at "
            f"{far:.3g} in {spacing.dtype}, for voxels of {voxel:.2g}. Move the volume (origin), the camera "
            "and the lights near 0."
        )


def bands_of(transfer: Transfer, volume: Volume, lighting: Lighting | None = None) -> int:
    """Number of colours of a transfer function: 3 except for custom ones (`Transfer.bands`).

    Raises:
        ValueError: if its classifier returns no colours and extinction, if transfer functions of several
            volumes differ, and for a lighting if there are not three colours.
    """
    bands, kind = transfer.bands, type(transfer).__name__
    if bands is None and isinstance(transfer, Together) and isinstance(volume.field, Several):
        counts = [bands_of(*pair) for pair in zip(transfer.transfers, volume.field.volumes, strict=True)]
        if len(set(counts)) > 1:
            raise ValueError(f"transfer functions must have equally many colours; got {counts}.")
        bands = counts[0]
    if bands is None:
        place = (jax.ShapeDtypeStruct((), volume.spacing.dtype),) * 3
        answer = eqx.filter_eval_shape(lambda t, v, at: _classified(t, v, at), transfer, volume, place)
        colors: Any = ()
        try:
            colors, extinction = answer
            shapes = {jnp.shape(number) for number in (*colors, extinction)}
        except (TypeError, ValueError):
            shapes = None
        if shapes != {()} or not colors:
            expected = "((c1, c2, ...), extinction), colours and extinction of a sample, all of them numbers"
            raise ValueError(f"{kind}.classifier must return {expected}; got {eqx.tree_pformat(answer)}.")
        bands = len(colors)
    if bands != 3 and lighting is not None:
        light = described(lighting)
        raise ValueError(f"lighting: {light} shades three colours; {kind}.classifier returns {bands}.")
    return bands


def _classified(transfer: Transfer, volume: Volume, coordinate: Vec3) -> Any:
    classification = classification_of(transfer, volume)
    return classification.classify(classification.at(coordinate))


NEVER = int(jnp.iinfo(jnp.int32).max)
"""Index past the last cell of any ray."""


class Track(eqx.Module):
    """Distances past the entry at which the cells of a ray begin: depths, unless steps grow (`March.depth`).

    Cell k begins at the distance `(offset + k) d`, and from the cell `shifted` on, which follows the first
    transparent cell (NEVER until that is known), at `(offset + shift + k) d`. Counting steps rather than
    summing them keeps the ten-thousandth sample as exact as the first. `until`: end of the cells that are
    marched, exclusive. `shift` and `shifted` are None where no transform shifts.
    """

    offset: Scalar
    shift: Scalar | None
    shifted: Int[Array, ""] | None
    until: Int[Array, ""]

    def distance(self, number: Int[Array, "..."], step: Scalar) -> Scalar:
        """Distance at which a cell begins."""
        offset = self.offset
        if self.shift is not None and self.shifted is not None:
            offset = offset + jnp.where(number >= self.shifted, self.shift, 0)
        return (offset + number.astype(offset.dtype)) * step


class Progress(eqx.Module):
    """State of a ray on its `track`. `index`: the next cell. `composite`: the compositing mode's state after
    all cells before it. `stats`: None unless `outputs` is "all"."""

    index: Int[Array, ""]
    composite: PyTree
    stats: "SampleStats | None"
    finished: Bool[Array, ""]
    track: Track


class SampleStats(eqx.Module):
    """Values of `Rendering.samples` and `Rendering.aligned`."""

    samples: Int[Array, ""]
    aligned: Bool[Array, ""]


def begin(scene: Scene, ray: Ray, track: Track, outputs: Outputs | None = "all") -> Progress:
    """Start a ray at its entry. Without `outputs`, only its opacity is computed."""
    compositing = scene.compositing
    zero, no = jnp.zeros_like(ray.length), jnp.zeros(ray.length.shape, bool)
    count = jnp.zeros(ray.length.shape, jnp.int32)
    composite = compositing.begin(zero, outputs)
    if isinstance(compositing, Weighting) and composite.color is not None:
        bands = bands_of(scene.transfer, scene.volume)
        composite = composite if bands == 3 else replace(composite, color=(zero,) * bands)
    if scene.march.reweights:
        composite = replace(composite, factor=jnp.ones_like(zero), reweighted=zero)
    return Progress(
        index=count,
        composite=composite,
        stats=SampleStats(count, no) if outputs == "all" else None,
        finished=no,
        track=track,
    )


def track_of(march: March, ray: Ray) -> Track:
    """Track of a ray at its entry, where no cell is known to be transparent."""
    count = jnp.full(ray.length.shape, march.most_samples, jnp.int32)
    if not march.may_shift:
        return Track(march.start(ray), None, None, count)
    return Track(march.start(ray), march.shift(ray), jnp.full_like(count, NEVER), count)


def pieces(scene: Scene, ray: Ray, at: PyTree, number: Int[Array, ""] | int = 0) -> tuple[Cell, ...]:
    """Cut the ray's next cell, or the `number`-th one after it, into pieces. `at`: a `Progress`, or another
    object with its `index` and `track`."""
    march = scene.march
    cell = cell_at(march, ray, at.track.distance(at.index + number, march.step))
    return march.cut(cell, ray, scene.volume)


def cell_at(march: March | CellRules, ray: Ray, distance: Scalar) -> Cell:
    """The cell of a step that begins at this distance."""
    begin, width = march.depth(distance, ray), march.step
    if march.grows:
        width = march.depth(distance + march.step, ray) - begin
    return Cell(begin, width, jnp.zeros(begin.shape, bool))


def read(scene: Scene, ray: Ray, piece: Cell) -> Measured:
    """Read a piece's sample from memory; for several volumes, with the shares of the piece inside them."""
    measured = scene.classification.measure(ray.path(scene.march.sample(piece)))
    return (*measured, tuple(_share(piece, *span) for span in ray.spans)) if ray.spans else measured


def _share(piece: Cell, enters: Scalar, leaves: Scalar) -> Scalar:
    """Share of a piece between two depths."""
    # not by minima and maxima: inside loops on CPU, XLA loses their derivatives (jaxlib 0.10)
    back = piece.front + piece.width
    begin, end = jnp.where(enters > piece.front, enters, piece.front), jnp.where(leaves < back, leaves, back)
    overlap = jnp.where(end > begin, end - begin, 0)
    contained = (begin == piece.front) & (end == back)
    return jnp.where(contained, 1, overlap / jnp.where(piece.width > 0, piece.width, 1))


def measure(scene: Scene, ray: Ray, piece: Cell, *, recorded: bool = False) -> Measured:
    """Values at a piece's sample, or at its ends if the march integrates, with the results of the transfer
    function's search. `recorded`: by the engine's `Recording`, which cannot record fetches in branches."""
    march, classification = scene.march, scene.classification
    if not march.integrates:
        return classification.searched(read(scene, ray, piece))

    def measured(depth: Scalar) -> Measured:
        return classification.measure(ray.path(depth))[:1]

    # In separate branches, which XLA does not fuse: where a kernel interpolates both values, one of them may
    # be that of the next node (jaxlib 0.10 on CPU with FMA; see `test_render_agrees_with_the_reference`).
    ends = march.ends(piece, ray)
    front, back = (measured(s) if recorded else in_memory(march.step > 0, measured, s) for s in ends)
    attributes = classification.attributes(ray.path(march.sample(piece)))
    return classification.spanned(attributes, *(classification.searched(end) for end in (front, back)))


def opacity(scene: Scene, ray: Ray, piece: Cell, measured: Measured) -> Scalar:
    """Opacity of a piece; 0 past the exit, and in gaps."""
    _, extinction = scene.classification.of_cells(measured)
    inside = ray.contains(scene.march.sample(piece))
    optical_depth = jnp.where(inside, extinction, 0) * piece.width
    # 1 - exp(-τ) with t = tanh(τ / 2): as exact for thin cells as expm1, which takes 1.5 times as long
    t = jnp.tanh(optical_depth / 2)
    return 2 * t / (1 + t)


def is_sample(march: March | CellRules, ray: Ray, piece: Cell, *, divided: bool) -> Bool[Array, ""]:
    """True if a piece counts as a sample. `divided`: transforms divide cells, so pieces may have width 0."""
    before_exit = march.sample(piece) < ray.end
    # only where cells are divided: elsewhere the second test would take 15 % of a frame
    return before_exit & (piece.width > 0) if divided else before_exit


def add(
    scene: Scene,
    ray: Ray,
    at: Progress,
    piece: Cell,
    measured: Measured,
    color: Color | None,
    alpha: Scalar,
    *,
    divided: bool,
) -> Progress:
    """Composite a piece of the next cell, unless the ray is finished. `measured`: a `Weighting` needs only
    the value. `divided`: as for `is_sample`."""
    march, compositing = scene.march, scene.compositing
    depth, counts = march.sample(piece), ~at.finished & is_sample(march, ray, piece, divided=divided)
    alpha = jnp.where(at.finished, 0, alpha)
    fragment = Fragment(alpha, depth, piece, measured, color, counts & ray.contains(depth))
    stats = at.stats
    if stats is not None:
        shows = (alpha > 0) & (transmittance(scene, at.composite) > 0)
        samples = stats.samples + counts.astype(stats.samples.dtype)
        stats = replace(stats, samples=samples, aligned=stats.aligned | (piece.cut & shows))
    composite = compositing.add(at.composite, fragment)
    check_answer(compositing, "add", composite, at.composite)
    return replace(at, composite=composite, stats=stats)


def transmittance(scene: Scene, composite: PyTree) -> Scalar:
    """Transmittance of a ray in this state of compositing, times all factors of `roulette`."""
    plain = scene.compositing.transmittance(composite)
    return plain * composite.factor if scene.march.reweights else plain


def reweigh(
    scene: Scene, ray: Ray, at: Progress, alphas: list[Scalar], ahead: Int[Array, ""] | int = 0
) -> Progress:
    """Multiply the weights of all cells behind one by its factor, unless it is transparent, so that leaps do
    not show. `alphas`: opacities of its pieces. `ahead`: its steps past the next one."""
    if not scene.march.reweights:
        return at
    visible = jnp.any(jnp.stack(alphas) > 0, axis=0) & ~at.finished
    factor = scene.march.roulette(transmittance(scene, at.composite), ray, at.index + ahead)
    factor = at.composite.factor * jnp.where(visible, factor, 1)
    return replace(at, composite=replace(at.composite, factor=factor))


def stop(scene: Scene, at: Progress) -> Progress:
    """Finish a ray that needs no other cell."""
    return replace(at, finished=at.finished | stopped(scene, at.composite))


def stopped(scene: Scene, composite: PyTree) -> Bool[Array, ""]:
    """True if a ray in this state of compositing needs no other cell."""
    march, compositing = scene.march, scene.compositing
    stops, finished = march.stop(transmittance(scene, composite)), compositing.finished(composite)
    check_answer(compositing, "finished", finished, stops)
    return stops | finished | (composite.factor <= 0) if march.reweights else stops | finished


def move(
    march: March | CellRules, ray: Ray, at: Progress, transparent: Bool[Array, ""] | None, steps: Array | int
) -> Progress:
    """Advance a ray by `steps`; it is finished if the next cell begins past the exit. `transparent`: true if
    the cell just composited, or all cells leapt over, are transparent: the ray then shifts if it has not yet
    shifted. None if the shift is known."""
    at = replace(at, index=at.index + steps)
    track = at.track
    if track.shifted is not None and transparent is not None:
        shifted = jnp.where(transparent, jnp.minimum(track.shifted, at.index), track.shifted)
        at = replace(at, track=replace(track, shifted=shifted))
    return replace(at, finished=at.finished | (front(march, ray, at) >= ray.length))


def front(march: March | CellRules, ray: Ray, at: Progress) -> Scalar:
    """Depth at which the next cell begins."""
    return march.depth(at.track.distance(at.index, march.step), ray)


def end(scene: Scene, ray: Ray, at: Progress) -> Rendering:
    """Rendering of a ray, with the outputs passed to `begin`. If the scene `resolves`, `resolve` makes the
    pixel from it."""
    valid, details = ~jnp.isnan(ray.t_in), Details()
    rgba, depth = scene.compositing.end(at.composite)
    # times NaN, so that the derivative is NaN, too; that of `where` would be 0
    rgba = rgba * jnp.where(valid, 1, jnp.nan).astype(ray.length.dtype)
    if depth is not None:
        details = Details(jnp.where(valid & jnp.isinf(depth), jnp.inf, ray.t_in + depth))
    if at.stats is not None:
        details = details._replace(samples=at.stats.samples, aligned=at.stats.aligned)
    if isinstance(scene.compositing, Selection):
        details = details._replace(selected=at.composite)
    return Rendering(rgba, ~at.finished, details)


class Pixel(NamedTuple):
    """Pixel computed after the march: premultiplied colour and opacity, distance from the ray's origin
    (infinite where nothing is visible), and a unit normal, if the mode has one."""

    rgba: Float[Array, " n"]
    depth: Scalar
    normal: Float[Array, "3"] | None = None


def resolve(scene: Scene, line: Line, rgba: Float[Array, " n"], depth: Scalar, selected: PyTree) -> Pixel:
    """Compute the pixel of a ray that is not transparent from the results of its march."""
    compositing = scene.compositing
    if isinstance(compositing, Selection):
        return _selected(compositing, scene, line, rgba, selected)
    assert isinstance(compositing, Weighting)
    pixel = compositing.resolved(scene.classification, rgba)
    check_answer(compositing, "resolved", pixel, _pixel_like(scene, rgba))
    return Pixel(pixel, depth)


def _pixel_like(scene: Scene, rgba: Float[Array, " n"]) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((bands_of(scene.transfer, scene.volume) + 1,), rgba.dtype)


def _selected(
    compositing: Selection[Any], scene: Scene, line: Line, rgba: Float[Array, " n"], state: PyTree
) -> Pixel:
    ray, march = enter(scene.space, *line), scene.march
    # a selected depth is a fixed number of steps: its derivative by the step is depth / step
    scale = march.step / jax.lax.stop_gradient(march.step)
    gradient = partial(world_gradient, scene.volume, scene.space.local)
    state = jax.lax.stop_gradient(state)
    chosen = compositing.depth(state)
    moving = chosen + _movement(march, ray, scene.volume, chosen, scale)
    sampler = RaySampler(ray, scene.classification, scale, gradient, (chosen, moving), scene.space)
    answer = compositing.pixel(sampler, state)
    check_answer(compositing, "pixel", answer, (_pixel_like(scene, rgba), rgba[3]))
    pixel, depth = answer
    normal = compositing.normal(sampler, depth)
    if normal is not None:
        check_answer(compositing, "normal", normal, rgba[:3])
    valid = jnp.where(jnp.isnan(rgba[3]), jnp.nan, 1).astype(pixel.dtype)
    # a product with infinity would have the derivative NaN
    visible = ~jnp.isinf(depth)
    depth = sampler.differentiable_depth(jnp.where(visible, depth, 0))
    depth = jnp.where(visible, ray.t_in + depth, jnp.inf)
    return Pixel(pixel * valid, depth, None if normal is None else normal * valid)


def _movement(march: March, ray: Ray, volume: Volume, depth: Scalar, scale: Scalar) -> Scalar:
    """0, with the derivatives of the depth of a selected sample: those of the sample in a cell that begins a
    fixed number of steps past the entry, and is cut."""
    start = march.start(ray)
    starts = [start, start + march.shift(ray)] if march.may_shift else [start]
    step = jax.lax.stop_gradient(march.step)
    moving, gap = depth * scale, jnp.full_like(depth, MATCH) * step
    for start in map(jax.lax.stop_gradient, starts):
        number = jnp.floor(march.distance(depth, ray) / step - start + MATCH)
        for piece in march.cut(cell_at(march, ray, (start + number) * march.step), ray, volume):
            sample = march.sample(piece)
            distance = jnp.abs(jax.lax.stop_gradient(sample) - depth)
            moving = jnp.where(distance < gap, sample, moving)
            gap = jnp.minimum(gap, distance)
    return moving - jax.lax.stop_gradient(moving)
