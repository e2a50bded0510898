"""What does a viewer show? `Scene`, which stays, and `State`, which its controls replace. The camera turns as
on a turntable. Drags are in units of the view's height, to the right and down."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from ..._util.checks import described
from ..._util.srgb import linear_color
from ...compositing.blending import Compositing, Over
from ...compositing.isosurface import Isosurface
from ...compositing.line_integral import LineIntegral
from ...compositing.modes import MODES, Mode, compositing_of
from ...engine.stages import Place
from ...lighting import Phong
from ...lighting.shading import Lighting
from ...march.march import March, Transform
from ...march.transforms import (
    AlphaCorrection,
    Clip,
    EarlyTermination,
    EmptySpaceJitter,
    Jitter,
    SpaceLeaping,
)
from ...ray import check_arguments
from ...scene.camera import Camera
from ...scene.occupancy import BLOCK
from ...scene.several import together, with_others
from ...scene.transfer import Transfer, sized
from ...scene.volume import Volume
from ..automatic import automatic_transfer, labels_if_any
from ..framing import FAINT, VISIBLE, automatic_camera, is_placed, warn_of_distance


MIN_STEP, MAX_STEP = 1 / 16, 16.0  # voxels
ISOSURFACE = "isosurface"
SEVERAL = Over, LineIntegral  # modes that show several volumes
WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
STEEPEST = math.radians(89.9)  # elevation of a camera, at most: from straight above, nothing says what is up

Vector = Float[np.ndarray, "3"]


@dataclass(frozen=True)
class Orbit:
    """A camera that looks at a point: `toward`, the unit direction from there, and `distance` place it; it
    turns about `view_up`, and sees `view_angle` degrees over the height of the image."""

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

    @classmethod
    def of(cls, camera: Camera) -> "Orbit":
        """That of a camera, without its window; of an orthographic one, from where the same height shows."""
        place = camera.position, camera.focal_point, camera.view_up
        orbit = cls.at(*place, float(camera.view_angle))
        if camera.parallel_scale is None:
            return orbit
        return orbit.zoomed(orbit.half_height / float(camera.parallel_scale))

    def turned(self, right: float, down: float) -> "Orbit":
        """Turned by a drag, as if the pointer held the front: half a turn over the view's height."""
        up = self.view_up
        height = math.asin(float(np.clip(self.toward @ up, -1, 1)))
        level = self.toward - (self.toward @ up) * up
        if np.linalg.norm(level) < 1e-9:
            level = np.cross(np.eye(3)[np.argmin(np.abs(up))], up)  # so that y is up from above
        level = level / np.linalg.norm(level)
        angle = -math.pi * right  # the camera moves against what is seen
        level = math.cos(angle) * level + math.sin(angle) * np.cross(up, level)
        height = min(max(height + math.pi * down, -STEEPEST), STEEPEST)
        return replace(self, toward=math.cos(height) * level + math.sin(height) * up)

    def panned(self, right: float, down: float) -> "Orbit":
        """After a drag along the image: what lies at the focal point's distance stays under the pointer."""
        height = 2 * self.half_height
        across, upward, _ = self.axes()
        return replace(self, focal_point=self.focal_point + height * (down * upward - right * across))

    def zoomed(self, factor: float) -> "Orbit":
        """Nearer by this factor: what lies at the focal point appears so many times as large."""
        return replace(self, distance=self.distance / factor)

    @property
    def position(self) -> Vector:
        """World position of the camera."""
        return self.focal_point + self.distance * self.toward

    @property
    def half_height(self) -> float:
        """Of what is seen at the focal point's distance, world length."""
        return self.distance * math.tan(math.radians(self.view_angle) / 2)

    def withdrawn(self, least: float) -> "Orbit":
        """From at least so far, by an angle that shows as much at the focal point."""
        distance = max(self.distance, least)
        angle = math.degrees(2 * math.atan(self.half_height / distance))
        return replace(self, distance=distance, view_angle=angle)

    def axes(self) -> tuple[Vector, Vector, Vector]:
        """Unit vectors to the right and up in the image, and forward."""
        right = np.cross(-self.toward, self.view_up)
        right = right / np.linalg.norm(right)
        return right, np.cross(right, -self.toward), -self.toward

    def camera(
        self, size: tuple[int, int], window: object = None, corner: object = None, *, parallel: bool = False
    ) -> Camera:
        """The camera, for an image of this size in pixels; `parallel`: as high at the focal point."""
        place: Any = self.position, self.focal_point, self.view_up, self.view_angle
        part: Any = {"window": window, "corner": corner}
        return Camera(*place, size=size, parallel_scale=self.half_height if parallel else None, **part)


@dataclass(frozen=True)
class State:
    """All that the controls of a viewer change."""

    orbit: Orbit
    size: tuple[int, int]  # (width, height) of the view, pixels
    transfer: Transfer
    step: float  # voxels
    enabled: frozenset[str]  # names of the transforms that are applied
    lit: bool  # whether there is light, where there can be
    mode: str  # how cells become a pixel, a key of `Scene.modes` or `ISOSURFACE`
    isovalue: float
    background: tuple[float, float, float]  # linear RGB
    parallel: bool  # whether the camera is orthographic
    clip: bool  # whether box and plane are applied
    box: tuple[float, ...]  # what is inside is shown, as `Volume.bounds`
    normal: tuple[float, ...] = (0.0, 0.0, 1.0)  # of the plane, to what is shown
    offset: float = -1.0  # of the plane from the middle of the volume, in half diagonals
    point: Vector | None = None  # of the world, which was picked


PROGRAM = {"enabled": "", "lit": "light", "mode": "mode", "parallel": "orthographic", "clip": "clip"}
"""Fields of which each value has a program of its own, as each form of transfer function has."""


@dataclass(frozen=True)
class Scene:
    """What stays the same while a volume is viewed, and what the controls choose from."""

    volume: Volume
    transforms: tuple[Transform, ...]  # that can be turned on, in the order in which they are applied
    given: March  # whose quadrature and `max_samples` are kept
    lighting: Lighting  # that can be turned on
    voxel: float  # world length of a step of 1
    modes: dict[str, Compositing[Any]]  # besides isosurfaces, which are of a single volume
    others: tuple[tuple[Volume, Transfer], ...] = ()  # volumes in the same image, which are not changed

    def march(self, state: State, step_factor: float = 1.0) -> March:
        """The march, with steps that are so many times as long."""
        enabled = tuple(t for t in self.transforms if type(t).__name__ in state.enabled)
        if state.clip:
            enabled = (Clip(state.box, [self.plane(state)]), *enabled)
        step = state.step * step_factor * self.voxel
        return March(step, enabled, self.given.quadrature, max_samples=self.given.max_samples)

    def plane(self, state: State) -> tuple[Vector, Vector]:
        """Origin and normal of the plane that clips."""
        low, high = (np.asarray(corner, np.float64) for corner in self.volume.corners)
        normal = np.asarray(state.normal, np.float64)
        # a little farther than half the diagonal, so that nothing is cut away at -1
        return (low + high) / 2 + 0.501 * state.offset * np.linalg.norm(high - low) * normal, normal

    def orbit(self, state: State) -> Orbit:
        """That of the state; of an orthographic camera, from before all that it shows."""
        if not state.parallel:
            return state.orbit
        far = np.abs(self.ends - state.orbit.focal_point).max(axis=0)
        return state.orbit.withdrawn(1.1 * float(np.linalg.norm(far)))

    @cached_property
    def ends(self) -> Float[np.ndarray, "2 3"]:
        """The lowest and the highest corner of the world box around all volumes."""
        bounds = np.stack([np.asarray(v.bounds) for v in (self.volume, *(each for each, _ in self.others))])
        return np.stack([bounds[:, ::2].min(axis=0), bounds[:, 1::2].max(axis=0)])

    def camera(self, state: State, size: tuple[int, int], window: Any = None, corner: Any = None) -> Camera:
        """The camera of a state, for an image of this size in pixels, or a part of it."""
        return self.orbit(state).camera(size, window, corner, parallel=state.parallel)

    def compositing(self, state: State) -> Compositing[Any]:
        """How cells become a pixel."""
        return Isosurface(state.isovalue) if state.mode == ISOSURFACE else self.modes[state.mode]

    def light(self, state: State) -> Lighting | None:
        """The light, if it is on, and the mode can be lit; none of several volumes."""
        lit = state.lit and self.compositing(state).can_be_lit and not self.others
        return self.lighting if lit else None

    def seen_from(self, state: State, toward: Vector) -> Orbit:
        """An orbit in this direction, as near as what is visible allows."""
        if is_placed(self.volume):  # a patient's front, at -y, is up from above, too
            toward = toward + np.array([0, 1e-6 * max(float(toward[2]), 0), 0])
        orbit = replace(state.orbit, toward=toward).turned(0, 0)  # not straight from above
        what = with_others(self.volume, state.transfer, self.others)
        how: Any = {"parallel": state.parallel, "size": state.size, "least": FAINT, "centered": True}
        return Orbit.of(automatic_camera(*what, orbit.toward, orbit.view_up, orbit.view_angle, **how))

    def settings(self, state: State) -> dict[str, Any]:
        """Options of `jaxvol render` that draw a state."""
        orbit = self.orbit(state)
        options = {"size": state.size, "step": state.step * self.voxel, "background": state.background}
        options |= {"camera": [*orbit.position.tolist(), *orbit.focal_point.tolist()]}
        options |= {"view_up": orbit.view_up.tolist(), "view_angle": orbit.view_angle}
        options |= {"parallel": state.parallel, "shade": self.light(state) is not None}
        if state.clip:
            planes = [[each for vector in self.plane(state) for each in vector.tolist()]]
            options |= {"clip_box": state.box, "clip_plane": planes}
        options |= {"compositing": state.mode} if state.mode in (*MODES, ISOSURFACE) else {}
        return options | ({"isovalue": state.isovalue} if state.mode == ISOSURFACE else {})

    def in_mode(self, state: State, mode: str) -> State:
        """The state in another mode, with the light that is usual for it, and its background, if that was so.
        **Raises** `ValueError` where the mode cannot show the transfer function."""
        old, new = (BLACK if each in MODES.keys() - {"over"} else WHITE for each in (state.mode, mode))
        background = new if state.background == old else state.background
        changed = replace(state, mode=mode, background=background, lit=mode in ("over", ISOSURFACE))
        self.compositing(changed).marched(changed.transfer, self.given, self.volume)
        return changed


def checked_others(others: Any) -> tuple[tuple[Volume, Transfer], ...]:
    """Pairs of a volume and its transfer function. **Raises** `ValueError` for anything else."""
    pairs = tuple(others) if isinstance(others, list | tuple) else (others,)
    for each in pairs:
        if not isinstance(each, tuple) or tuple(map(type, each))[:1] != (Volume,) or len(each) != 2:
            raise ValueError(
                f"others must be pairs of a Volume and its transfer function; got {described(each)}."
            )
    return tuple((volume, sized(transfer, volume)) for volume, transfer in pairs)


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
    others: Sequence[tuple[Volume, Transfer]] | Any = (),
) -> tuple[Scene, State]:
    """What is viewed, and how at first. Arguments and errors as for `view`."""
    others = checked_others(others)
    whole = Camera.looking_at(volume, size=size)  # checks volume and size
    least = VISIBLE if transfer is None else FAINT
    if transfer is None:
        volume, transfer = labels_if_any(volume) or (volume, automatic_transfer(volume))
    if (chosen := camera) is None:
        what = with_others(volume, transfer, others)
        chosen = automatic_camera(*what, size=size, least=least, centered=True)
    warn_of_distance(volume, others)
    given = March(1.0, (), "midpoint") if march is None else march
    shown: Any = sized(transfer, volume)
    names = {"volume": volume, "transfer": shown, "camera": chosen, "march": given, "lighting": lighting}
    check_arguments("view(volume, transfer, camera, march)", **names)
    mode = compositing_of(compositing)
    mode.marched(shown, given, volume)  # refuses what it cannot show
    if others:
        together(*with_others(volume, shown, others))  # as well
        if not isinstance(mode, SEVERAL) or lighting is not None:
            raise ValueError(
                'of several volumes, compositing must be "over" or "integral", without lighting.'
            )
    if lighting is not None and not mode.can_be_lit:
        raise ValueError(f"lighting must be None under {type(mode).__name__}, which shows no single place.")
    r, g, b = np.asarray(linear_color("background", background)).tolist()
    blocks = tuple(-(-n // BLOCK) for n in volume.shape)
    voxel = Place.of(given, volume).voxel(blocks)
    finest = min([voxel, *(float(np.min(each.spacing)) for each, _ in others)])
    step = max(0.5 * finest / voxel, MIN_STEP) if march is None else float(given.step) / voxel
    if not MIN_STEP <= step <= MAX_STEP:
        raise ValueError(
            f"march must have a step from {MIN_STEP * voxel:.4g} to {MAX_STEP * voxel:.4g}, {MIN_STEP:g} to "
            f"{MAX_STEP:g} voxels, to be shown; got one of {float(given.step):.4g}, {step:.4g} voxels."
        )
    # not a constant: their arrays are made on a device, and none may be in use before `jax.distributed`
    offered = EmptySpaceJitter(seed=0), Jitter(seed=0)
    default = AlphaCorrection(), SpaceLeaping(), EarlyTermination(1 / 256)
    own = {type(transform) for transform in given.transforms}
    more = (each for each in (*offered, *default) if type(each) not in own)
    modes: dict[str, Compositing[Any]] = {
        name: kind() for name, kind in MODES.items() if not others or issubclass(kind, SEVERAL)
    }
    name = next((n for n, kind in MODES.items() if type(mode) is kind), type(mode).__name__.lower())
    modes |= {} if isinstance(mode, Isosurface) else {name: mode}
    scene = Scene(volume, (*given.transforms, *more), given, lighting or Phong(), voxel, modes, others)
    enabled = frozenset(type(t).__name__ for t in (default if march is None else given.transforms))
    data = np.asarray(volume.data)
    between = (float(data.min()) + float(data.max())) / 2
    isovalue = float(mode.value) if isinstance(mode, Isosurface) else between
    box, color = tuple(np.asarray(volume.bounds).tolist()), (r, g, b)
    how = step, enabled, lit, name, isovalue, color, chosen.parallel_scale is not None, False, box
    return scene, State(Orbit.of(chosen), whole.size, shown, *how)
