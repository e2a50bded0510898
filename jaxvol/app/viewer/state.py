"""What does a viewer show? `Scene`, which stays, and `State`, which its controls replace."""

from dataclasses import dataclass
from typing import Any, get_args

import numpy as np

from ..._util.checks import described, finite_array
from ...compositing.blending import Compositing
from ...compositing.modes import Mode, compositing_of
from ...compositing.projections import Average
from ...lighting import Phong
from ...lighting.shading import Lighting
from ...march.march import March, Transform
from ...march.transforms import (
    AdaptiveSampling,
    AlphaCorrection,
    EarlyTermination,
    EmptySpaceJitter,
    Jitter,
    SpaceLeaping,
)
from ...ray import check_arguments
from ...scene.camera import Camera
from ...scene.labels import LabelTransferFunction
from ...scene.occupancy import BLOCK
from ...scene.space import median_node_distance
from ...scene.transfer import TransferFunction
from ...scene.transfer2d import TransferFunction2D
from ...scene.volume import Volume
from ..automatic import automatic_transfer, framed, labels_shown, visible_points
from .histogram import Histogram
from .orbit import Orbit


MIN_STEP, MAX_STEP, DEFAULT_STEP = 1 / 16, 16.0, 0.5
"""Voxels; the last where no march is given."""

ENABLED = AlphaCorrection, SpaceLeaping, EarlyTermination
"""Transforms that are applied where no march is given."""

ViewedTransfer = TransferFunction | TransferFunction2D | LabelTransferFunction


@dataclass(frozen=True)
class State:
    """All that the controls of a viewer change.

    - `orbit`: the camera. `size`: (width, height) of the view, pixels.
    - `transfer`: the transfer function.
    - `step`: distance between samples, in voxels.
    - `enabled`: names of the transforms that are applied. `lit`: whether there is light.
    """

    orbit: Orbit
    size: tuple[int, int]
    transfer: ViewedTransfer
    step: float
    enabled: frozenset[str]
    lit: bool


@dataclass(frozen=True)
class Scene:
    """What stays the same while a volume is viewed, and what the controls choose from.

    - `transforms`: those that can be turned on, in the order in which they are applied.
    - `lighting`: the light that can be turned on; None where nothing can be lit.
    - `quadrature`, `max_samples`: of the march. `voxel`: world length of a step of 1.
    - `compositing`: how cells become a pixel. `background`: linear RGB.
    - `histogram`: of the volume.
    """

    volume: Volume
    transforms: tuple[Transform, ...]
    lighting: Lighting | None
    quadrature: str
    max_samples: int | None
    voxel: float
    compositing: Compositing[Any]
    background: tuple[float, float, float]
    histogram: Histogram

    def march(self, state: State, step_factor: float = 1.0) -> March:
        """The march, with steps that are so many times as long."""
        enabled = tuple(t for t in self.transforms if type(t).__name__ in state.enabled)
        step = state.step * step_factor * self.voxel
        return March(step, enabled, self.quadrature, max_samples=self.max_samples)

    def light(self, state: State) -> Lighting | None:
        """The light, if it is on."""
        return self.lighting if state.lit else None


def initial(
    volume: Volume | Any,
    transfer: ViewedTransfer | Any | None,
    camera: Camera | Any | None,
    march: March | Any | None,
    *,
    lighting: Lighting | Any | None,
    lit: bool,
    compositing: Mode | Compositing[Any] | Any,
    background: Any,
    size: tuple[int, int] | Any,
) -> tuple[Scene, State]:
    """What is viewed, and how at first. Arguments and errors as for `view`."""
    if not isinstance(transfer, ViewedTransfer | None):
        kinds = " or ".join(kind.__name__ for kind in get_args(ViewedTransfer))
        raise ValueError(f"the viewer shows a {kinds}; got {described(transfer)}.")
    whole = Camera.looking_at(volume, size=size)  # checks volume and size
    seen: Any = whole if camera is None else camera
    if transfer is None:
        volume, transfer = labels_shown(volume) or (volume, automatic_transfer(volume))
        seen = framed(seen, visible_points(volume, transfer)) if camera is None else seen
    given = March(1.0, (), "midpoint") if march is None else march
    names = {"volume": volume, "transfer": transfer, "camera": seen, "march": given, "lighting": lighting}
    check_arguments("view(volume, transfer, camera, march)", **names)
    mode = compositing_of(compositing)
    mode.marched(transfer, given, volume)  # refuses what it cannot show
    can_be_lit = not isinstance(mode, Average)
    if lighting is not None and not can_be_lit:
        raise ValueError("lighting must be None where an average is composited: it lies nowhere.")
    r, g, b = np.asarray(finite_array("background", background, (3,))).tolist()
    blocks = tuple(-(-n // BLOCK) for n in volume.shape)
    voxel = float(median_node_distance(given.locate(volume), blocks))
    step = DEFAULT_STEP if march is None else float(given.step) / voxel
    if not MIN_STEP <= step <= MAX_STEP:
        raise ValueError(
            f"march must have a step from {MIN_STEP * voxel:.4g} to {MAX_STEP * voxel:.4g}, {MIN_STEP:g} to "
            f"{MAX_STEP:g} voxels, to be shown; got one of {float(given.step):.4g}, {step:.4g} voxels."
        )
    # not a constant: their arrays are made on a device, and none may be in use before `jax.distributed`
    offered = (
        EmptySpaceJitter(seed=0),
        Jitter(seed=0),
        AdaptiveSampling(0.005),
        AlphaCorrection(),
        SpaceLeaping(),
        EarlyTermination(1 / 256),
    )
    own = {type(transform) for transform in given.transforms}
    scene = Scene(
        volume,
        transforms=(*given.transforms, *(each for each in offered if type(each) not in own)),
        lighting=Phong() if lighting is None and can_be_lit else lighting,
        quadrature=given.quadrature,
        max_samples=given.max_samples,
        voxel=voxel,
        compositing=mode,
        background=(r, g, b),
        histogram=Histogram.of(volume),
    )
    enabled = frozenset(kind.__name__ for kind in (ENABLED if march is None else own))
    return scene, State(Orbit.of(seen), whole.size, transfer, step, enabled, lit and can_be_lit)
