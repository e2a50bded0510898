"""Which march is the cheapest whose image is accurate enough?"""

import math
import time
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from .._util.checks import flag, integer, number
from ..compositing.blending import Compositing, Over
from ..compositing.modes import Mode, compositing_of
from ..engine.acceleration import visible_in_numpy
from ..engine.stages import Place
from ..lighting.shading import Lighting
from ..march.march import March, Transform
from ..march.transforms import AlphaCorrection, EarlyTermination, SpaceLeaping
from ..ray import Scene, check_arguments
from ..scene.camera import Camera
from ..scene.occupancy import Blocks
from ..scene.rendering import Rendering
from ..scene.several import Several
from ..scene.transfer import Transfer, sized, with_shared_points
from ..scene.volume import Volume
from ..xla.platform import is_traced
from .probe import UNSEEN, Candidates, Probe, is_empty, rendered
from .search import COARSEST, Part, Search


MARGIN = 0.95
"""Fraction of the tolerance that is used."""

ENDS = 1 / 16
"""Fraction of it for rays that end early, whose error is at most the transmittance at which they end."""

GRADIENTS_END = 1e-4
"""Transmittance at which rays may end where gradients count."""

OPAQUE = 0.01
"""Fraction of the pixels that become opaque, below which there is nothing to end early."""

EMPTY = 0.05
"""Fraction of the blocks in which nothing is visible, below which leaps are not worth their look-ups."""


class Plan(NamedTuple):
    """How to render a scene within a tolerance. `print` shows it.

    Attributes:
        march: what to pass to `render`, with the same scene.
        tolerance: as given.
        error: predicted, on the safe side; above the tolerance where nothing could be proven.
        samples: predicted for each pixel.
        parts: what was kept or left out, and why.
        probed: seconds that planning took, compilation included.
    """

    march: March
    tolerance: float
    error: float
    samples: float
    parts: tuple[Part, ...]
    probed: float

    @property
    def within(self) -> bool:
        """Whether the predicted error is within the tolerance."""
        return self.error <= self.tolerance

    def __str__(self) -> str:
        transforms = ", ".join(type(each).__name__ for each in self.march.transforms) or "no transform"
        missed = "" if self.within else "NOT PROVEN TO BE WITHIN THE TOLERANCE: "
        rmse = f"RMSE {self.error:.2g} predicted" if self.within else "RMSE unknown"
        lines = [
            f"{missed}step {float(self.march.step):.4g}, {self.march.quadrature}, {transforms}",
            f"{rmse}, {self.tolerance:.2g} asked for; {self.samples:.1f} samples a pixel; "
            f"planned in {self.probed:.1f} s",
            *(f"  {'+' if part.kept else '-'} {part.name:16}  {part.why}" for part in self.parts),
        ]
        return "\n".join(lines)


def plan(
    volume: Volume | Any,
    transfer: Transfer | Any,
    camera: Camera | Any,
    tolerance: float | Any,
    *,
    transforms: tuple[Transform, ...] | Any = (),
    compositing: Mode | Compositing[Any] | Any = "over",
    lighting: Lighting | Any | None = None,
    gradients: bool | Any = False,
    once: bool | Any = False,
    seed: int | Any = 0,
) -> Plan:
    """Finds the cheapest way to render a scene within a tolerance, by rendering patches of it.

    At most 128 patches of 8 x 8 pixels (32 of images of fewer than 512) are rendered by the midpoint rule,
    with steps of two voxels, one, a half, and so on, until some are within the tolerance, compared with steps
    of half of theirs. Then:

    - **step**: the longest within the tolerance, between two of these, or up to four voxels.
    - **quadrature**: `"preintegrated"` is tried where rays take many samples, or where the midpoint rule is
      not within the tolerance at an eighth of a voxel, or seems not to get there; it is kept where it is
      faster, by what a sample costs on CPU.
    - **`SpaceLeaping`**: kept where blocks are proven empty. It does not change the image; but extinctions of
      0 have no gradient from what is leapt over.
    - **`AlphaCorrection`**: always kept.
    - **`EarlyTermination`**: kept where rays end early, at a sixteenth of the tolerance, which bounds its
      error (over the brightest colour, where that is above 1).

    A volume that is rendered in bricks is planned for by a copy of every n-th voxel, `source.subsampled(n)`;
    divide the step by n. The error is that of the copy, which does not prove that blocks are empty.

    The error is the RMSE of linear colours, over black or over white, whichever is greater: an estimate from
    some of the pixels, and from how images change with the last halvings of the step. The noise of a lighting
    counts as an error. `Jitter` and `EmptySpaceJitter` are not chosen: they change the structure of an error,
    not its size. On other devices than CPUs, the errors hold, but what is cheapest was not measured.

    Args:
        volume: a single one.
        transfer: as for `render`.
        camera: as for `render`. An image of another camera needs a plan of its own.
        tolerance: RMSE of the image's linear colours, above 0 and below 1; 1/255 is one level of 8 bits.
        transforms: those that belong to the scene, such as a `ToroidalMap`, a `Clip`, or jitter. They are
            kept.
        compositing: as for `render`.
        lighting: as for `render`.
        gradients: whether the image is to be differentiated. Rays then end at 1e-4 or less. What is proven
            (empty space) is proven for this transfer function only.
        once: whether the march is for a single image. `"preintegrated"`, whose program takes longer to
            compile than it saves, is then tried only where the midpoint rule is not within the tolerance.
        seed: of the choice of patches. With it, the plan depends on nothing but the scene.

    Returns:
        A `Plan`. If no step down to 1/64 of a voxel is proven to be within the tolerance, `Plan.within` is
        False. If nothing is seen although blocks may show something, `Plan.parts` says so, and the predicted
        error is what may have been missed.

    Raises:
        ValueError: for arguments of another kind, a tolerance out of range, arrays that are traced (plan
            outside of `jax.jit` and `jax.grad`), and transforms on which the plan decides.
    """
    begun = time.perf_counter()
    order = "plan(volume, transfer, camera, tolerance)"
    several = isinstance(volume, Volume) and isinstance(volume.field, Several)
    if several or isinstance(volume, list | tuple):
        raise ValueError("volume must be a single one to be planned for; got several. Pass a March.")
    check_arguments(order, volume=volume, transfer=transfer, camera=camera, lighting=lighting)
    gradients, once = flag("gradients", gradients), flag("once", once)
    transfer = sized(transfer, volume)
    scene = Scene(volume, transfer, camera, March(1.0), compositing_of(compositing), lighting)
    tolerance, given = _checked(tolerance, transforms, scene)
    place = Place.of(March(1.0, given), volume)
    shown, mode = transfer, scene.compositing
    if mode.resolves:
        shown, _ = mode.marched(transfer, March(1.0, given), volume)
    visible = _occupied(mode, shown, Blocks.of(volume, slopes=shown.reads_gradient))
    candidates, seed = Candidates.of(camera, place, visible), integer("seed", seed, 0)
    proven, parts = chosen_transforms(visible, given)
    voxel = place.voxel(visible.shape)

    over = isinstance(scene.compositing, Over)
    ends = min(tolerance * ENDS, GRADIENTS_END if gradients else math.inf)

    def search(ends: float, goal: float, known: Any) -> Search:
        own = (EarlyTermination(ends),) if over else ()
        return Search(probe, scene, goal, tolerance, voxel, (*given, *proven, *own), known)

    # Where few rays become opaque, none ends early in the end. In trials they do, all alike: without that,
    # programs of another kind would be compiled to learn of a sixteenth of the tolerance in these few.
    probe = Probe.of(candidates, seed)
    first = search(ends, tolerance, {})
    seen = first.render(COARSEST, "midpoint").image
    shows = bool(visible.any())
    if shows and is_empty(seen):  # what is visible lies in other patches, or between samples
        quadrature = "preintegrated" if first.integrable else "midpoint"
        coarse = March(COARSEST * voxel, first.transforms, quadrature)
        probe = Probe.of(candidates.narrowed(lambda rays: rendered(rays, scene, coarse)), seed)
        first = search(ends, tolerance, {})
        seen = first.render(COARSEST, "midpoint").image
    between = shows and is_empty(seen)
    opaque = probe.mean(np.asarray(seen.opacity) >= 1 - ends) if over else 0.0
    share = ends if opaque >= OPAQUE else 0.0
    brightest = brightest_of(seen)
    within = search(ends / brightest, MARGIN * tolerance - share, first.rendered if brightest == 1 else {})
    chosen, truth, tried = within.cheapest(once=once, between=between)
    unseen = 0.0
    if shows and is_empty(truth.image):
        unseen = math.sqrt(UNSEEN / probe.source.origins[..., 0].size)
        tried.append(
            Part("visible", False, "nothing in the pixels looked at, though some blocks may show any")
        )
    ending = EarlyTermination(ends / brightest_of(truth.image))
    kept = (*given, *proven, *((ending,) if share else ()))
    march = March(chosen.march.step, kept, chosen.march.quadrature)
    parts += tried
    if over:
        parts.append(Part("EarlyTermination", bool(share), f"{opaque:.1%} of the pixels become opaque"))
    return Plan(
        march=march,
        tolerance=tolerance,
        error=max(chosen.error + share, unseen),
        samples=chosen.samples,
        parts=tuple(parts),
        probed=time.perf_counter() - begun,
    )


def _checked(tolerance: Any, transforms: Any, scene: Any) -> tuple[float, tuple[Transform, ...]]:
    """The tolerance, and the transforms that belong to the scene."""
    if is_traced(jax.tree.leaves((scene, transforms, tolerance))):
        raise ValueError(
            "plan looks at the numbers of a scene, which are traced here: call it outside of jax.jit, "
            "jax.vmap and jax.grad, and pass the march that it finds to render."
        )
    number("tolerance", tolerance, above=0, below=1)
    given = March(1.0, transforms).transforms  # checks them
    for each in given:
        decided = isinstance(each, EarlyTermination | SpaceLeaping)
        if decided or (isinstance(each, AlphaCorrection) and not each.labels):
            name = type(each).__name__
            raise ValueError(f"transforms must be those of the scene; got {name}, on which the plan decides.")
    return float(tolerance), given


def chosen_transforms(
    visible: Bool[np.ndarray, "bx by bz"], given: tuple[Transform, ...]
) -> tuple[tuple[Transform, ...], list[Part]]:
    """Transforms that do not depend on the step, from the blocks that may hold anything visible."""
    aligned = any(isinstance(each, AlphaCorrection) for each in given)
    why = (
        "part of the scene"
        if aligned
        else "the error at faces is left out; costs nothing where there is none"
    )
    alpha = Part("AlphaCorrection", True, why)
    empty = float(np.mean(~visible))
    leaps = (SpaceLeaping(),) if empty >= EMPTY else ()
    proof = f"{empty:.1%} of the blocks hold nothing visible"
    added = () if aligned else (AlphaCorrection(),)
    return (*leaps, *added), [alpha, Part("SpaceLeaping", bool(leaps), proof)]


def _occupied(mode: Compositing[Any], transfer: Transfer, blocks: Blocks) -> Bool[np.ndarray, "bx by bz"]:
    """Which blocks may change a pixel; by JAX in a row, of a length that many volumes share: a power of 8."""
    if (known := visible_in_numpy(mode, transfer, blocks)) is not None:
        return known
    count = math.prod(blocks.shape)
    length = 8 ** max(4, -(-(count - 1).bit_length() // 3))

    def in_a_row(leaf: Array) -> Array:
        row = np.asarray(leaf).reshape(*leaf.shape[:-3], count)
        row = np.append(row, row[..., -1:].repeat(length - count, axis=-1), axis=-1)
        return jnp.asarray(row[..., None, None], leaf.dtype)

    found = _occupied_in_a_row(mode, with_shared_points(transfer), jax.tree.map(in_a_row, blocks))
    return np.asarray(found).reshape(-1)[:count].reshape(blocks.shape)


@eqx.filter_jit
def _occupied_in_a_row(mode: Compositing[Any], transfer: Transfer, blocks: Blocks) -> Bool[Array, "n 1 1"]:
    return mode.occupied(transfer, blocks)


def brightest_of(image: Rendering) -> float:
    """The brightest colour, 1 or more: by so much of what is left of a ray its early end may err."""
    rgba = np.asarray(image.rgba, np.float64)
    seen = rgba[:, -1] > 1e-3
    return float(max(1.0, np.max(rgba[seen, :-1] / rgba[seen, -1:], initial=0.0)))
