"""Which march is the cheapest whose image is accurate enough? No more model than the scene needs."""

import math
import time
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool

from .._util.checks import flag, integer, number
from ..bricks import VoxelSource, render_bricks
from ..bricks.opening import Openable
from ..compositing.blending import Compositing, Over
from ..compositing.modes import Mode, compositing_of
from ..engine.image import render_scene
from ..lighting.shading import Lighting
from ..march.march import March, Transform
from ..march.transforms import AdaptiveSampling, AlphaCorrection, EarlyTermination, SpaceLeaping
from ..ray import Scene, check_arguments
from ..scene.camera import Camera
from ..scene.occupancy import Blocks
from ..scene.rendering import BrickReport, Rendering
from ..scene.space import Space, median_node_distance
from ..scene.transfer import Transfer
from ..scene.volume import Volume
from ..xla.platform import is_traced
from .memory import read_within, with_bricks
from .probe import Probe
from .search import COARSEST, Part, Search


MARGIN = 0.95
"""Part of the tolerance that is used."""

ENDS = 1 / 16
"""Part of it for rays that end early, whose error is at most the transmittance at which they end."""

GRADIENTS_END = 1e-4
"""Transmittance at which rays may end where gradients count."""

OPAQUE = 0.01
"""Part of the pixels that become opaque, below which there is nothing to end early."""

EMPTY = 0.05
"""Part of the blocks in which nothing is visible, below which leaps are not worth their look-ups."""

DECIDED = AdaptiveSampling, EarlyTermination, SpaceLeaping
"""Transforms that a scene cannot bring along, besides `AlphaCorrection` at the exit."""

UNPROVEN = "not proven by a copy; kept"


class Plan(NamedTuple):
    """How to render a scene within a tolerance. `print` shows it.

    - `march`, `volume`, `lighting`, `compositing`: what to pass to `render`. Where `bricks` is given,
      `volume` is only the copy that was planned with.
    - `tolerance`: what was asked for. `error`: predicted, on the safe side, from a part of the pixels; where
      nothing could be proven to be within the tolerance, just above it.
    - `samples`: predicted for each pixel.
    - `parts`: what was kept or left out, and why.
    - `probed`: seconds that planning took, compilation included.
    - `source`, `memory`: the volume and the budget, bytes, if there was one.
    - `stride`: of the copy of every n-th voxel that was planned with, to which `error` and `samples`
      belong; 1 where the volume fits.
    - `bricks`: what to expect of `render_bricks`, of which nothing is read yet: at most `needed` bricks will
      be, for this camera and others of as many pixels. None where the volume fits.
    """

    march: March
    volume: Volume
    lighting: Lighting | None
    tolerance: float
    error: float
    samples: float
    parts: tuple[Part, ...]
    probed: float
    compositing: Compositing[Any] = Over()
    source: VoxelSource | None = None
    memory: int | None = None
    stride: int = 1
    bricks: BrickReport | None = None

    @property
    def within(self) -> bool:
        """Whether the predicted error is within the tolerance."""
        return self.error <= self.tolerance

    def render(self, transfer: Transfer | Any, camera: Camera | Any, **options: Any) -> Rendering:
        """The image as planned.

        **Arguments:** `transfer`, `camera`: as for the plan. `options`: `outputs` and `devices`, as for
        `render`.

        **Returns:** as `render`.
        """
        how = {"compositing": self.compositing, "lighting": self.lighting, **options}
        if self.bricks is not None:
            return render_bricks(self.source, transfer, camera, self.march, memory=self.memory, **how)
        check_arguments("render(transfer, camera)", transfer=transfer, camera=camera)
        scene = Scene(self.volume, transfer, camera, self.march, self.compositing, self.lighting)
        return render_scene(scene, options.get("outputs", "all"), "replay", devices=options.get("devices"))

    def __str__(self) -> str:
        transforms = ", ".join(_written(each) for each in self.march.transforms) or "no transform"
        missed = "" if self.within else "NOT PROVEN TO BE WITHIN THE TOLERANCE: "
        rmse = f"RMSE {self.error:.2g} predicted" if self.within else "RMSE unknown"
        lines = [
            f"{missed}step {float(self.march.step):.4g}, {self.march.quadrature}, {transforms}",
            f"{rmse}, {self.tolerance:.2g} asked for; {self.samples:.1f} samples a pixel; "
            f"planned in {self.probed:.1f} s",
        ]
        wide = max((len(part.name) for part in self.parts), default=0)
        lines += [f"  {'+' if part.kept else '-'} {part.name:{wide}}  {part.why}" for part in self.parts]
        if self.source is None or self.memory is None:
            return "\n".join(lines)
        size, room = (f"{count / 2**20:.1f} MiB" for count in (self.source.nbytes, self.memory))
        if self.bricks is None:
            head = f"in memory: {size} of voxels, and what is made of them, fit into {room}"
        else:
            head = (
                f"{' x '.join(map(str, self.bricks.counts))} bricks: {size} of voxels, and what is made of "
                f"them, do not fit into {room}; at most {self.bricks.needed} are read. Planned on a copy of "
                f"one voxel in {self.stride} along each axis, whose error is given below"
            )
        return "\n".join([head, *lines])


def plan(
    volume: Volume | Openable,
    transfer: Transfer | Any,
    camera: Camera | Any,
    tolerance: float | Any,
    *,
    memory: int | Any | None = None,
    transforms: tuple[Transform, ...] | Any = (),
    compositing: Mode | Compositing[Any] | Any = "over",
    lighting: Lighting | Any | None = None,
    gradients: bool | Any = False,
    once: bool | Any = False,
    seed: int | Any = 0,
) -> Plan:
    """Finds the cheapest way to render a scene within a tolerance, by rendering parts of it.

    At most 128 patches of 8 x 8 pixels are rendered by the midpoint rule, with steps of two voxels, one, a
    half, and so on, until some are within the tolerance, compared with steps of a quarter of theirs. From
    there:

    - **step**: the longest within the tolerance, between two of these.
    - **quadrature**: `"preintegrated"` is tried where rays take many samples, or where the midpoint rule
      takes more than 8 steps of a voxel; it is kept where it is faster, by what a sample costs on CPU
      (`planning/search.py`: `RAY`, `SAMPLE`).
    - **`SpaceLeaping`**: kept where blocks are proven empty. It does not change the image; but extinctions of
      0 have no gradient from what is leapt over.
    - **`AlphaCorrection`**: left out if it is proven that nothing is visible in the blocks at the volume's
      faces, and where a `Clip` cuts.
    - **`EarlyTermination`**: kept where rays end early, at a sixteenth of the tolerance, which bounds its
      error (over the brightest colour, where that is above 1).
    - **bricks**: a volume that does not fit into `memory`, with what `render` makes of it (IN_MEMORY bytes
      for each byte of voxels), is rendered by `render_bricks`. The march is planned on a copy of every n-th
      voxel along each axis, and its step divided by n; the error is that of the copy: detail finer than n
      voxels has been seen in samples only. A copy does not prove what is empty, so that `AlphaCorrection` and
      `SpaceLeaping` are kept. Where the smallest bricks do not fit, the step is halved, up to four times.

    The error is the RMSE of linear colours, over black or over white, whichever is greater. It is an
    estimate: from a part of the pixels, and compared with images that are themselves wrong, by what the last
    halvings of the step let expect. The noise of a lighting, such as `ScattererTemplates` without `blend`,
    counts as an error. `Jitter` and `EmptySpaceJitter` are not chosen: they change the structure of an error,
    not its size. On other devices than CPUs, the errors hold, but what is cheapest was not measured.

    **Arguments:**

    - `volume`: a `Volume`, or what `bricks.source_of` opens: an array, a memory map, a path, a `VoxelSource`.
    - `transfer`, `camera`: as for `render`. An image of another camera needs a plan of its own.
    - `tolerance`: RMSE of the image's linear colours, above 0 and below 1; 1/255 is one level of 8 bits.
    - `memory`: bytes that the volume may take. By default as much as it needs if it is a `Volume`, and a
      quarter of the device's memory otherwise.
    - `transforms`: those that are part of the scene, such as a `ToroidalMap`, a `Clip`, or jitter. They are
      kept.
    - `compositing`, `lighting`: as for `render`.
    - `gradients`: whether the image is to be differentiated. Rays then end at 1e-4 or less. What is proven
      (empty space, faces) is proven for this transfer function only.
    - `once`: whether the march is for a single image. `"preintegrated"`, whose program takes longer to
      compile than it saves, is then tried only where the midpoint rule is not within the tolerance.
    - `seed`: of the choice of patches. With it, the plan depends on nothing but the scene.

    **Returns:** a `Plan`. If no step is proven to be within the tolerance, down to 1/64 of a voxel (which
    takes images of steps of 1/256), `Plan.within` is False and `Plan.parts` says so.

    **Raises:** `ValueError` for arguments of another kind, a tolerance out of range, arrays that are traced
    (plan outside of `jax.jit` and `jax.grad`), and transforms on which the plan decides; for a source that
    `bricks.source_of` refuses; and for less memory than a copy or the smallest bricks take.
    """
    begun = time.perf_counter()
    order = "plan(volume, transfer, camera, tolerance)"
    check_arguments(order, transfer=transfer, camera=camera, lighting=lighting)
    gradients = flag("gradients", gradients)
    once = flag("once", once)
    source, room, stride = None, None, 1
    if memory is not None or not isinstance(volume, Volume):
        volume, source, room, stride = read_within(volume, memory)
    check_arguments(order, volume=volume)
    scene = Scene(volume, transfer, camera, March(1.0), compositing_of(compositing), lighting)
    tolerance, given = _checked(tolerance, transforms, scene)
    space = March(1.0, given).locate(volume)
    visible = _occupied(scene, given)
    probe = Probe.of(camera, space, visible, integer("seed", seed, 0))
    proven, parts = proven_transforms(visible, space, given, copy=stride > 1)
    voxel = float(median_node_distance(space, visible.shape))

    over = isinstance(scene.compositing, Over)
    ends = min(tolerance * ENDS, GRADIENTS_END if gradients else math.inf)

    def search(ends: float, goal: float) -> Search:
        own = (EarlyTermination(ends),) if over else ()
        return Search(probe, scene, goal, tolerance, voxel, (*given, *proven, *own))

    # Where few rays become opaque, none ends early in the end. In trials they do, all alike: without that,
    # programs of another kind would be compiled to learn of a sixteenth of the tolerance in these few.
    seen = search(ends, tolerance).image(COARSEST, "midpoint")
    opaque = probe.mean(seen.rgba[:, 3] >= 1 - ends) if over else 0.0
    share = ends if opaque >= OPAQUE else 0.0
    within = search(ends / brightest_of(seen), MARGIN * tolerance - share)
    chosen, truth, tried = within.cheapest(once=once)
    ending = EarlyTermination(ends / brightest_of(truth.image))
    kept = (*given, *proven, *((ending,) if share else ()))
    march = March(chosen.march.step, kept, chosen.march.quadrature)
    parts += tried
    if over:
        name = _written(ending) if share else "EarlyTermination"
        parts.append(Part(name, bool(share), f"{opaque:.1%} of the pixels become opaque"))
    bricks = None
    if source is not None and room is not None and stride > 1:
        how = room, stride, scene.compositing, lighting
        march, bricks = with_bricks(source, transfer, camera, march, *how)
    return Plan(
        march=march,
        volume=volume,
        lighting=lighting,
        tolerance=tolerance,
        error=chosen.error + share,
        samples=chosen.samples,
        parts=tuple(parts),
        probed=time.perf_counter() - begun,
        compositing=scene.compositing,
        source=source,
        memory=room,
        stride=stride,
        bricks=bricks,
    )


def _checked(tolerance: Any, transforms: Any, scene: Any) -> tuple[float, tuple[Transform, ...]]:
    """The tolerance, and the transforms that are part of the scene."""
    if is_traced(jax.tree.leaves((scene, transforms, tolerance))):
        raise ValueError(
            "plan looks at the numbers of a scene, which are traced here: call it outside of jax.jit, "
            "jax.vmap and jax.grad, and pass the march that it finds to render."
        )
    number("tolerance", tolerance, above=0, below=1)
    given = March(1.0, transforms).transforms  # checks them
    for each in given:
        if isinstance(each, DECIDED) or (isinstance(each, AlphaCorrection) and not each.labels):
            raise ValueError(
                "transforms must be those that are part of the scene, such as a ToroidalMap; got "
                f"{type(each).__name__}, on which the plan decides."
            )
    return float(tolerance), given


def _occupied(scene: Scene, given: tuple[Transform, ...]) -> Bool[Array, "bx by bz"]:
    """The blocks that may change a pixel."""
    transfer, mode = scene.transfer, scene.compositing
    if mode.resolves:
        transfer, _ = mode.marched(transfer, March(1.0, given), scene.volume)
    return mode.occupied(transfer, Blocks.of(scene.volume, slopes=transfer.reads_gradient))


def proven_transforms(
    visible: Bool[Array, "bx by bz"], space: Space, given: tuple[Transform, ...], *, copy: bool = False
) -> tuple[tuple[Transform, ...], list[Part]]:
    """Transforms that proofs decide on, from the blocks that may hold anything visible. `copy`: these are of
    a copy, which does not prove that there is nothing in between."""
    found: list[Transform] = []
    at_faces = space.visible_at_faces(visible)
    faces = sum(map(bool, at_faces))
    aligned, why = True, "part of the scene"
    if not any(isinstance(each, AlphaCorrection) for each in given):
        aligned, why = bool(faces) or copy, "nothing is visible at the volume's faces: proven"
        if faces:
            cut = "" if len(at_faces) == 6 else " and cuts"
            why = f"something may be visible at {faces} of the volume's {len(at_faces)} faces{cut}"
        elif copy:
            why = UNPROVEN
        if aligned:
            found.append(AlphaCorrection())
    empty = float(np.mean(~np.asarray(visible)))
    leaps = empty >= EMPTY or copy
    if leaps:
        found.append(SpaceLeaping())
    kept = f"{empty:.1%} of the blocks hold nothing visible" if empty >= EMPTY or not copy else UNPROVEN
    return tuple(found), [Part("AlphaCorrection", aligned, why), Part("SpaceLeaping", leaps, kept)]


def brightest_of(image: Rendering) -> float:
    """The brightest colour, 1 or more: by so much of what is left of a ray its early end may err."""
    rgba = np.asarray(image.rgba, np.float64)
    seen = rgba[:, 3] > 1e-3
    return float(max(1.0, np.max(rgba[seen, :3] / rgba[seen, 3:], initial=0.0)))


def _written(transform: Transform) -> str:
    """A transform as it is written, with its parameter where that is what matters."""
    name = type(transform).__name__
    if isinstance(transform, EarlyTermination):
        return f"{name}({float(transform.opacity_left):.2g})"
    return name
