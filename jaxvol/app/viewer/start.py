"""How does a viewer begin? A scene as `render` takes it becomes what is shown and what can be changed."""

from typing import Any

import numpy as np

from ..._util.checks import described, finite_array
from ...arguments import check_arguments
from ...compositing.compositing import Compositing
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
from ...scene.camera import Camera
from ...scene.labels import LabelTransferFunction
from ...scene.occupancy import BLOCK
from ...scene.space import median_node_distance
from ...scene.transfer import TransferFunction
from ...scene.transfer2d import TransferFunction2D
from ...scene.volume import Volume
from ..automatic import automatic_transfer, framed, labels_shown, visible_points
from .curve import Curve
from .drawing import Content
from .labelled import Labelled
from .look import Look
from .orbit import Orbit
from .plot import Histogram
from .state import LONGEST, SHORTEST, Choices, State
from .table import Table


ON = AlphaCorrection, SpaceLeaping, EarlyTermination
"""Those that are on where no march is given."""

SHOWN = TransferFunction, TransferFunction2D, LabelTransferFunction
"""Transfer functions of which a viewer can change something."""

STEP = 0.5
"""Voxels between the samples of a fine image where no march is given."""


def begin(
    volume: Volume | Any,
    transfer: TransferFunction | Any | None,
    camera: Camera | Any | None,
    march: March | Any | None,
    *,
    lighting: Lighting | Any | None,
    lit: bool,
    compositing: Mode | Compositing[Any] | Any,
    background: Any,
    size: tuple[int, int] | Any,
) -> tuple[Content, State]:
    """What is looked at, and how at first. Arguments as for `view`.

    **Raises:** `ValueError` as `render` does, for a transfer function of another kind than `SHOWN`, an
    orthographic camera, a march whose step is shorter than `SHORTEST` or longer than `LONGEST` voxels, and a
    background that is not linear RGB."""
    if transfer is not None and not isinstance(transfer, SHOWN):
        kinds = " or ".join(kind.__name__ for kind in SHOWN)
        raise ValueError(f"the viewer shows a {kinds}; got {described(transfer)}.")
    if not isinstance(volume, Volume):
        check_arguments("view(volume, transfer, camera, march)", volume=volume)
    whole = Camera.looking_at(volume, size=size)  # which checks the size
    seen: Any = whole if camera is None else camera
    if transfer is None:
        volume, transfer = labels_shown(volume) or (volume, automatic_transfer(volume))
        seen = framed(seen, visible_points(volume, transfer)) if camera is None else seen
    given = March(1.0) if march is None else march
    check_arguments(
        "view(volume, transfer, camera, march)",
        volume=volume,
        transfer=transfer,
        camera=seen,
        march=given,
        lighting=lighting,
    )
    mode = compositing_of(compositing)
    mode.marched(transfer, given, volume)  # refuses what it cannot show
    can_be_lit = not isinstance(mode, Average)
    if lighting is not None and not can_be_lit:
        raise ValueError("lighting must be None where an average is composited: it lies nowhere.")
    r, g, b = np.asarray(finite_array("background", background, (3,))).tolist()
    own = {type(transform) for transform in given.transforms}
    others = tuple(transform for transform in _offered() if type(transform) not in own)
    on = own if march is not None else set(ON)
    voxel = _voxel(volume, given)
    choices = Choices(
        (*given.transforms, *others),
        Phong() if lighting is None and can_be_lit else lighting,
        "midpoint" if march is None else given.quadrature,
        voxel,
        given.max_samples,
    )
    state = State(
        Orbit.of(seen),
        _look(transfer, voxel),
        (1, 1),
        1.0,
        frozenset(kind.__name__ for kind in on),
        lit and can_be_lit,
    )
    state = state.with_step(STEP if march is None else _step(march, voxel)).with_size(*size)
    return Content(volume, choices, mode, (r, g, b), Histogram.of(volume)), state


def _offered() -> tuple[Transform, ...]:
    """Transforms that can be turned on, beside those that are given. Not a constant: their arrays are made on
    a device, and none may be in use before `jax.distributed.initialize`."""
    return (
        EmptySpaceJitter(seed=0),
        Jitter(seed=0),
        AdaptiveSampling(0.005),
        AlphaCorrection(),
        SpaceLeaping(),
        EarlyTermination(1 / 256),
    )


def _look(transfer: TransferFunction | TransferFunction2D | LabelTransferFunction, voxel: float) -> Look:
    """What can be changed of a transfer function. `voxel`: the length to which opacities are to refer."""
    if isinstance(transfer, LabelTransferFunction):
        return Labelled.of(transfer)
    if isinstance(transfer, TransferFunction2D):
        return Table.of(transfer)
    return Curve.of(transfer, voxel)


def _step(march: March, voxel: float) -> float:
    """Voxels between the samples of a march.

    **Raises:** `ValueError` for fewer or more than a viewer's step can be."""
    step = float(march.step) / voxel
    if not SHORTEST <= step <= LONGEST:
        raise ValueError(
            f"march must have a step from {SHORTEST * voxel:.4g} to {LONGEST * voxel:.4g}, {SHORTEST:g} to "
            f"{LONGEST:g} voxels, to be shown; got one of {float(march.step):.4g}, {step:.4g} voxels."
        )
    return step


def _voxel(volume: Volume, march: March) -> float:
    """World length between nodes."""
    blocks = tuple(-(-n // BLOCK) for n in volume.shape)
    return float(median_node_distance(march.locate(volume), blocks))
