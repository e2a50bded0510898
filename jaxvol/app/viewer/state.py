"""What does a viewer show? `Scene`, which stays, and `State`, which its controls replace.

The camera turns about its focal point as on a turntable: `view_up` stays up. Drags are given in units of the
view's height, to the right and down, as the pointer moved.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from ..._util.checks import finite_array
from ...compositing.blending import Compositing
from ...compositing.modes import Mode, compositing_of
from ...lighting import Phong
from ...lighting.shading import Lighting
from ...march.march import March, Transform
from ...march.transforms import (
    AlphaCorrection,
    EarlyTermination,
    EmptySpaceJitter,
    Jitter,
    SpaceLeaping,
)
from ...ray import check_arguments
from ...scene.camera import Camera
from ...scene.occupancy import BLOCK
from ...scene.space import median_node_distance
from ...scene.transfer import Transfer, sized
from ...scene.volume import Volume
from ..automatic import automatic_transfer, labels_shown
from ..framing import framed, visible_points


MIN_STEP, MAX_STEP = 1 / 16, 16.0  # voxels
STEEPEST = math.radians(89)  # elevation of a camera, at most: from straight above, nothing says what is up

Vector = Float[np.ndarray, "3"]


@dataclass(frozen=True)
class Orbit:
    """A perspective camera that looks at a point.

    Attributes:
        focal_point: world point.
        toward: unit direction from there to the camera.
        distance: between them, world length.
        view_up: unit direction about which it turns.
        view_angle: degrees, over the height of the image.
    """

    focal_point: Vector
    toward: Vector
    distance: float
    view_up: Vector
    view_angle: float

    @classmethod
    def at(cls, position: object, focal_point: object, view_up: object, view_angle: float) -> "Orbit":
        """A camera at a world position. One that looks along `view_up` is turned away from it a little."""
        position, focal, up = (np.asarray(v, np.float64) for v in (position, focal_point, view_up))
        offset = position - focal
        distance, length = float(np.linalg.norm(offset)), float(np.linalg.norm(up))
        return cls(focal, offset / distance, distance, up / length, view_angle).turned(0, 0)

    def turned(self, right: float, down: float) -> "Orbit":
        """After a drag that turns what is seen, as if the pointer held its front: by half a turn for a drag
        over the height of the view."""
        up = self.view_up
        height = math.asin(float(np.clip(self.toward @ up, -1, 1)))
        level = self.toward - (self.toward @ up) * up
        if np.linalg.norm(level) < 1e-9:
            level = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
        level = level / np.linalg.norm(level)
        angle = -math.pi * right  # the camera moves against what is seen
        level = math.cos(angle) * level + math.sin(angle) * np.cross(up, level)
        height = min(max(height + math.pi * down, -STEEPEST), STEEPEST)
        return replace(self, toward=math.cos(height) * level + math.sin(height) * up)

    def panned(self, right: float, down: float) -> "Orbit":
        """After a drag along the image: what lies at the focal point's distance stays under the pointer."""
        height = 2 * self.distance * math.tan(math.radians(self.view_angle) / 2)
        across = np.cross(-self.toward, self.view_up)
        across = across / np.linalg.norm(across)
        upward = np.cross(across, -self.toward)
        return replace(self, focal_point=self.focal_point + height * (down * upward - right * across))

    def zoomed(self, factor: float) -> "Orbit":
        """Nearer by this factor: what lies at the focal point appears so many times as large."""
        return replace(self, distance=self.distance / factor)

    @property
    def position(self) -> Vector:
        """World position of the camera."""
        return self.focal_point + self.distance * self.toward

    def camera(self, size: tuple[int, int], window: object = None, corner: object = None) -> Camera:
        """The camera, for an image of this size in pixels."""
        place = (self.position, self.focal_point, self.view_up, self.view_angle)
        return Camera(*place, size=size, window=window, corner=corner)  # pyright: ignore[reportArgumentType]


@dataclass(frozen=True)
class State:
    """All that the controls of a viewer change.

    Attributes:
        orbit: the camera.
        size: (width, height) of the view, pixels.
        transfer: the transfer function.
        step: distance between samples, in voxels.
        enabled: names of the transforms that are applied.
        lit: whether there is light.
    """

    orbit: Orbit
    size: tuple[int, int]
    transfer: Transfer
    step: float
    enabled: frozenset[str]
    lit: bool


@dataclass(frozen=True)
class Scene:
    """What stays the same while a volume is viewed, and what the controls choose from.

    Attributes:
        volume: what is looked at.
        transforms: those that can be turned on, in the order in which they are applied.
        given: the march whose quadrature and `max_samples` are kept.
        lighting: the light that can be turned on; None where nothing can be lit.
        voxel: world length of a step of 1.
        compositing: how cells become a pixel.
        background: linear RGB.
    """

    volume: Volume
    transforms: tuple[Transform, ...]
    given: March
    lighting: Lighting | None
    voxel: float
    compositing: Compositing[Any]
    background: tuple[float, float, float]

    def march(self, state: State, step_factor: float = 1.0) -> March:
        """The march, with steps that are so many times as long."""
        enabled = tuple(t for t in self.transforms if type(t).__name__ in state.enabled)
        step = state.step * step_factor * self.voxel
        return March(step, enabled, self.given.quadrature, max_samples=self.given.max_samples)

    def light(self, state: State) -> Lighting | None:
        """The light, if it is on."""
        return self.lighting if state.lit else None


def initial(
    volume: Volume | Any,
    transfer: Transfer | Any | None = None,
    camera: Camera | Any | None = None,
    march: March | Any | None = None,
    *,
    lighting: Lighting | Any | None = None,
    lit: bool = True,
    compositing: Mode | Compositing[Any] | Any = "over",
    background: Any = (1.0, 1.0, 1.0),
    size: tuple[int, int] | Any = (640, 480),
) -> tuple[Scene, State]:
    """What is viewed, and how at first. Arguments and errors as for `view`."""
    whole = Camera.looking_at(volume, size=size)  # checks volume and size
    chosen: Any = whole if camera is None else camera
    if transfer is None:
        volume, transfer = labels_shown(volume) or (volume, automatic_transfer(volume))
        chosen = framed(chosen, visible_points(volume, transfer)) if camera is None else chosen
    given = March(1.0, (), "midpoint") if march is None else march
    shown: Any = sized(transfer, volume)
    names = {"volume": volume, "transfer": shown, "camera": chosen, "march": given, "lighting": lighting}
    check_arguments("view(volume, transfer, camera, march)", **names)
    if chosen.parallel_scale is not None:
        raise ValueError("the viewer's camera must be perspective; got one with a parallel_scale.")
    mode = compositing_of(compositing)
    mode.marched(shown, given, volume)  # refuses what it cannot show
    can_be_lit = mode.can_be_lit
    if lighting is not None and not can_be_lit:
        raise ValueError(f"lighting must be None under {type(mode).__name__}, which shows no single place.")
    r, g, b = np.asarray(finite_array("background", background, (3,))).tolist()
    blocks = tuple(-(-n // BLOCK) for n in volume.shape)
    voxel = float(median_node_distance(given.locate(volume), blocks))
    step = 0.5 if march is None else float(given.step) / voxel
    if not MIN_STEP <= step <= MAX_STEP:
        raise ValueError(
            f"march must have a step from {MIN_STEP * voxel:.4g} to {MAX_STEP * voxel:.4g}, {MIN_STEP:g} to "
            f"{MAX_STEP:g} voxels, to be shown; got one of {float(given.step):.4g}, {step:.4g} voxels."
        )
    # not a constant: their arrays are made on a device, and none may be in use before `jax.distributed`
    offered = EmptySpaceJitter(seed=0), Jitter(seed=0)
    default = AlphaCorrection(), SpaceLeaping(), EarlyTermination(1 / 256)
    own = {type(transform) for transform in given.transforms}
    others = (each for each in (*offered, *default) if type(each) not in own)
    light = Phong() if lighting is None and can_be_lit else lighting
    scene = Scene(volume, (*given.transforms, *others), given, light, voxel, mode, (r, g, b))
    enabled = frozenset(type(t).__name__ for t in (default if march is None else given.transforms))
    orbit = Orbit.at(chosen.position, chosen.focal_point, chosen.view_up, float(chosen.view_angle))
    return scene, State(orbit, whole.size, shown, step, enabled, lit and can_be_lit)
