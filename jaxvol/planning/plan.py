"""Planning: the cheapest march whose image is within a tolerance."""

import math
import time
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool

from .._util.checks import flag, integer, number
from ..compositing.blending import Compositing, Over
from ..compositing.modes import Mode, compositing_of
from ..engine.acceleration import visible_in_numpy
from ..engine.stages import Place
from ..lighting.shading import Lighting
from ..march.march import March, Quadrature, Transform
from ..march.transforms.alpha_correction import AlphaCorrection
from ..march.transforms.early_termination import EarlyTermination
from ..march.transforms.space_leaping import SpaceLeaping
from ..ray import Scene, check_arguments
from ..scene.camera import Camera
from ..scene.occupancy import Blocks
from ..scene.rendering import Rendering
from ..scene.several import Several
from ..scene.transfer import Transfer, sized
from ..scene.volume import Volume
from ..xla.platform import is_traced
from .probe import UNSEEN, Probe, is_empty, likely_patches, rendered
from .search import COARSEST, Part, Search, Trial, integrable


MARGIN = 0.95  # fraction of the tolerance that a plan uses
# Fraction of the tolerance for early termination, whose error is at most the transmittance where rays end.
ENDS = 1 / 16
GRADIENTS_END = 1e-4  # transmittance at which rays may end if gradients are needed
OPAQUE = 0.01  # least fraction of opaque pixels for which rays end early
EMPTY = 0.05  # least fraction of empty blocks for which leaps are worth their look-ups


class Plan(NamedTuple):
    """A march that renders a scene within a tolerance. `print` shows it.

    Attributes:
        march: the march to pass to `render`, with the same scene.
        tolerance: the requested RMSE.
        error: predicted RMSE, a safe estimate; above the tolerance if nothing could be proven.
        samples: predicted samples per pixel.
        parts: the decisions, and their reasons.
        probed: planning time in seconds, compilation included.
    """

    march: March
    tolerance: float
    error: float
    samples: float
    parts: tuple[Part, ...]
    probed: float

    @property
    def within(self) -> bool:
        """True if the predicted error is within the tolerance."""
        return self.error <= self.tolerance

    def __str__(self) -> str:
        transforms = (
            ", ".join(type(transform).__name__ for transform in self.march.transforms) or "no transform"
        )
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
    volume: Volume,
    transfer: Transfer,
    camera: Camera,
    tolerance: float,
    *,
    transforms: tuple[Transform, ...] = (),
    compositing: Mode | Compositing[Any] = "over",
    lighting: Lighting | None = None,
    gradients: bool = False,
    once: bool = False,
    seed: int = 0,
) -> Plan:
    """Finds the cheapest march that renders a scene within a tolerance, by rendering patches of the image.

    At most 128 patches of 8 x 8 pixels (32 if the image has fewer than 512), seven of eight from where a
    coarse image shows anything, are rendered by the midpoint rule, with steps of two voxels, one, a half, and
    so on. Each step is compared with half of it, until one is within the tolerance. The plan then decides on:

    - **step**: the longest within the tolerance, between two of the steps, or up to four voxels.
    - **quadrature**: `"preintegrated"` is tried if rays take many samples, or if the midpoint rule fails, or
      seems to fail, to be within the tolerance at an eighth of a voxel. It is kept if it is faster, by the
      costs of samples on a CPU.
    - **`SpaceLeaping`**: kept if blocks are proven empty. The image does not change, but extinctions of 0 in
      the blocks that are leapt over get no gradient.
    - **`AlphaCorrection`**: always kept.
    - **`EarlyTermination`**: kept if rays become opaque. It ends them at a sixteenth of the tolerance, which
      bounds its error (divided by the brightest colour, if that is above 1).

    Plan a volume that is rendered in bricks with a copy of every n-th voxel, `source.subsampled(n)`, and
    divide the step by n. The error is that of the copy, which does not prove that blocks are empty.

    The error is the RMSE of linear colours, over black or over white, whichever is greater: an estimate from
    the patches' pixels, and from the changes by the last halvings of the step. The noise of a lighting counts
    as an error. `Jitter` and `EmptySpaceJitter` are not chosen: they change the structure of an error, not
    its size. The costs were measured on CPUs only; the errors hold on all devices.

    Args:
        volume: a single volume.
        transfer: as for `render`.
        camera: as for `render`. Another camera needs another plan.
        tolerance: RMSE of the image's linear colours, above 0 and below 1; 1/255 is one level of 8 bits.
        transforms: transforms that are part of the scene, such as a `ToroidalMap`, a `Clip`, or jitter. They
            are kept.
        compositing: as for `render`.
        lighting: as for `render`.
        gradients: True for an image that is differentiated. Rays then end at a transmittance of at most 1e-4.
            Empty space is proven for this transfer function only.
        once: True for a single image. `"preintegrated"`, whose program takes longer to compile than it saves,
            is then tried only if the midpoint rule is not within the tolerance.
        seed: seed of the choice of patches. The plan is a function of the scene and the seed.

    Returns:
        A `Plan`. If no step down to 1/64 of a voxel is proven to be within the tolerance, `Plan.within` is
        False. If the patches are empty although blocks may be visible, `Plan.parts` reports it, and the
        predicted error is a bound for missed pixels.

    Raises:
        ValueError: for arguments of another kind, a tolerance out of range, traced arrays (plan outside of
            `jax.jit` and `jax.grad`), and transforms on which the plan decides.
    """
    start = time.perf_counter()
    order = "plan(volume, transfer, camera, tolerance)"
    group = isinstance(volume, Volume) and isinstance(volume.field, Several)
    if group or isinstance(volume, list | tuple):
        raise ValueError("volume must be a single Volume for a plan; got several. Pass a March.")
    check_arguments(order, volume=volume, transfer=transfer, camera=camera, lighting=lighting)
    gradients, once = flag("gradients", gradients), flag("once", once)
    transfer = sized(transfer, volume)
    if lighting is not None:
        transfer = lighting.medium(transfer)
    scene = Scene(volume, transfer, camera, March(1.0), compositing_of(compositing), lighting)
    tolerance, fixed = _checked(tolerance, transforms, scene)
    shown, mode = transfer, scene.compositing
    if mode.resolves:
        shown, _ = mode.marched(transfer, March(1.0, fixed), volume)
    blocks = Blocks.of(volume, slopes=shown.reads_gradient)
    visible = visible_in_numpy(mode, shown, blocks)
    visible = np.asarray(_occupied(mode, shown, blocks)) if visible is None else visible
    seed, (proven, parts) = integer("seed", seed, 0), chosen_transforms(visible, fixed)
    voxel = Place.of(March(1.0, fixed), volume).voxel(visible.shape)

    shows, over = bool(visible.any()), isinstance(mode, Over)
    ends = min(tolerance * ENDS, GRADIENTS_END if gradients else math.inf)

    def trials(ends: float) -> tuple[Transform, ...]:
        # The plan drops EarlyTermination if few rays become opaque. Trials keep it, to share programs.
        return (*fixed, *proven, *((EarlyTermination(ends),) if over else ()))

    def search(ends: float, goal: float, known: dict[tuple[float, Quadrature], Trial]) -> Search:
        return Search(probe, scene, goal, tolerance, voxel, trials(ends), known)

    def survey(quadrature: Quadrature) -> Bool[np.ndarray, " patches"]:
        march = March(COARSEST * voxel, trials(ends), quadrature)
        return likely_patches(camera, partial(rendered, scene=scene, march=march))

    likely = survey("midpoint")
    if shows and not likely.any() and integrable(scene):  # what shows may lie between samples
        likely = survey("preintegrated")
    probe = Probe.of(camera, likely, seed)
    first = search(ends, tolerance, {})
    coarse = first.render(COARSEST, "midpoint").image
    between = shows and is_empty(coarse)
    opaque = probe.mean(np.asarray(coarse.rgba)[..., -1] >= 1 - ends) if over else 0.0
    share = ends if opaque >= OPAQUE else 0.0
    brightest = brightest_of(coarse)
    within = search(ends / brightest, MARGIN * tolerance - share, first.rendered if brightest == 1 else {})
    chosen, reference, tried = within.cheapest(once=once, between=between)
    unseen = 0.0
    if shows and is_empty(reference.image):
        unseen = math.sqrt(UNSEEN / math.prod(probe.source.origins.shape[:-1]))
        tried.append(Part("visible", False, "nothing in the probed pixels, though blocks may be visible"))
    parts += tried
    ending = ()
    if over:
        ending = (EarlyTermination(ends / brightest_of(reference.image)),) if share else ()
        parts.append(Part("EarlyTermination", bool(share), f"{opaque:.1%} of the pixels become opaque"))
    return Plan(
        march=March(chosen.march.step, (*fixed, *proven, *ending), chosen.march.quadrature),
        tolerance=tolerance,
        error=max(chosen.error + share, unseen),
        samples=chosen.samples,
        parts=tuple(parts),
        probed=time.perf_counter() - start,
    )


def _checked(tolerance: Any, transforms: Any, scene: Any) -> tuple[float, tuple[Transform, ...]]:
    """The tolerance, and the transforms that are part of the scene."""
    if is_traced(jax.tree.leaves((scene, transforms, tolerance))):
        raise ValueError(
            "plan needs concrete numbers of a scene, but they are traced here: call it outside of jax.jit, "
            "jax.vmap and jax.grad, and pass its march to render."
        )
    number("tolerance", tolerance, above=0, below=1)
    fixed = March(1.0, transforms).transforms  # checks them
    for transform in fixed:
        decided = isinstance(transform, EarlyTermination | SpaceLeaping)
        if decided or (isinstance(transform, AlphaCorrection) and not transform.labels):
            name = type(transform).__name__
            raise ValueError(f"transforms must be those of the scene; got {name}, on which the plan decides.")
    return float(tolerance), fixed


def chosen_transforms(
    visible: Bool[np.ndarray, "bx by bz"], fixed: tuple[Transform, ...]
) -> tuple[tuple[Transform, ...], list[Part]]:
    """Transforms that do not depend on the step, by the mask of blocks that may hold anything visible."""
    aligned = any(isinstance(transform, AlphaCorrection) for transform in fixed)
    why = "part of the scene" if aligned else "removes the error at faces; free where there is none"
    empty = float(np.mean(~visible))
    leaps = (SpaceLeaping(),) if empty >= EMPTY else ()
    added = () if aligned else (AlphaCorrection(),)
    proof = Part("SpaceLeaping", bool(leaps), f"{empty:.1%} of the blocks hold nothing visible")
    return (*leaps, *added), [Part("AlphaCorrection", True, why), proof]


@eqx.filter_jit
def _occupied(mode: Compositing[Any], transfer: Transfer, blocks: Blocks) -> Bool[Array, "bx by bz"]:
    """Mask of the blocks that may change a pixel."""
    return mode.occupied(transfer, blocks)


def brightest_of(image: Rendering) -> float:
    """The brightest colour, at least 1: factor of the remaining transmittance in the error of early ends."""
    rgba = np.asarray(image.rgba, np.float64)
    rgba = rgba[rgba[:, -1] > 1e-3]
    return float(max(1.0, np.max(rgba[:, :-1] / rgba[:, -1:], initial=0.0)))
