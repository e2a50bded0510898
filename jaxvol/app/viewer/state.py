"""State of a viewer: `ViewerSetup`, the constant part, and `State`, which the controls replace. The camera
turns as on a turntable. Drags are in units of the view's height, to the right and down."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from ..._util.checks import Arrayable, described
from ..._util.srgb import linear_color
from ...compositing.blending import Compositing, Over
from ...compositing.isosurface import Isosurface
from ...compositing.line_integral import LineIntegral
from ...compositing.modes import MODES, Mode, compositing_of
from ...engine.stages import Place
from ...lighting import Phong
from ...lighting.shading import Lighting
from ...march.march import March, Transform
from ...march.transforms.alpha_correction import AlphaCorrection
from ...march.transforms.clip import Clip
from ...march.transforms.early_termination import EarlyTermination
from ...march.transforms.jitter import EmptySpaceJitter, Jitter
from ...march.transforms.space_leaping import SpaceLeaping
from ...ray import check_arguments
from ...scene.camera import Camera
from ...scene.occupancy import BLOCK
from ...scene.several import together, with_others
from ...scene.transfer import Transfer, sized
from ...scene.volume import Volume
from ..automatic import automatic_transfer, labels_if_any
from ..framing import FAINT, VISIBLE, automatic_camera, is_placed, warn_of_gap


MIN_STEP, MAX_STEP = 1 / 16, 16.0  # voxels
ISOSURFACE = "isosurface"
SEVERAL = Over, LineIntegral  # modes for several volumes
WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
STEEPEST = math.radians(89.9)  # largest elevation of a camera: from straight above, up is undefined

Vector = Float[np.ndarray, "3"]


@dataclass(frozen=True)
class Orbit:
    """A camera at `distance` from the focal point in the unit direction `toward`. It turns about `view_up`,
    and sees `view_angle` degrees over the height of the image."""

    focal_point: Vector
    toward: Vector
    distance: float
    view_up: Vector
    view_angle: float

    @classmethod
    def at(cls, position: object, focal_point: object, view_up: object, view_angle: float) -> "Orbit":
        """The orbit of a world position. A camera that looks along `view_up` is turned away slightly."""
        position, focal, up = (np.asarray(v, np.float64) for v in (position, focal_point, view_up))
        offset = position - focal
        distance, length = float(np.linalg.norm(offset)), float(np.linalg.norm(up))
        return cls(focal, offset / distance, distance, up / length, view_angle).turned(0, 0)

    @classmethod
    def of(cls, camera: Camera) -> "Orbit":
        """Orbit of a camera, ignoring its window. An orthographic camera becomes the perspective one of the
        same view height."""
        place = camera.position, camera.focal_point, camera.view_up
        orbit = cls.at(*place, float(camera.view_angle))
        if camera.parallel_scale is None:
            return orbit
        return orbit.zoomed(orbit.half_height / float(camera.parallel_scale))

    def turned(self, right: float, down: float) -> "Orbit":
        """The orbit turned by a drag of the front: half a turn over the view's height."""
        up = self.view_up
        height = math.asin(float(np.clip(self.toward @ up, -1, 1)))
        level = self.toward - (self.toward @ up) * up
        if np.linalg.norm(level) < 1e-9:
            level = np.cross(np.eye(3)[np.argmin(np.abs(up))], up)  # so that y is up from above
        level = level / np.linalg.norm(level)
        angle = -math.pi * right  # the camera moves against the drag
        level = math.cos(angle) * level + math.sin(angle) * np.cross(up, level)
        height = min(max(height + math.pi * down, -STEEPEST), STEEPEST)
        return replace(self, toward=math.cos(height) * level + math.sin(height) * up)

    def panned(self, right: float, down: float) -> "Orbit":
        """The orbit moved by a drag: points at the focal point's distance stay under the pointer."""
        height = 2 * self.half_height
        across, upward, _ = self.axes()
        return replace(self, focal_point=self.focal_point + height * (down * upward - right * across))

    def zoomed(self, factor: float) -> "Orbit":
        """The orbit nearer by a factor, which magnifies points at the focal point's distance."""
        return replace(self, distance=self.distance / factor)

    @property
    def position(self) -> Vector:
        """World position of the camera."""
        return self.focal_point + self.distance * self.toward

    @property
    def half_height(self) -> float:
        """Half height of the view at the focal point's distance, world length."""
        return self.distance * math.tan(math.radians(self.view_angle) / 2)

    def withdrawn(self, min_distance: float) -> "Orbit":
        """The orbit at a least distance, with the same view height at the focal point."""
        distance = max(self.distance, min_distance)
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
        """The camera of an image of `size` pixels; `parallel`: of the same view height at the focal point."""
        place = self.position, self.focal_point, self.view_up, self.view_angle
        scale = self.half_height if parallel else None
        return Camera(*place, size=size, parallel_scale=scale, window=window, corner=corner)


@dataclass(frozen=True)
class State:
    """Settings of the controls of a viewer."""

    orbit: Orbit
    size: tuple[int, int]  # (width, height) of the view, pixels
    transfer: Transfer
    step: float  # voxels
    enabled: frozenset[str]  # names of the active transforms
    lit: bool  # light, in modes that can be lit
    mode: str  # key of `ViewerSetup.modes`, or `ISOSURFACE`
    isovalue: float
    background: tuple[float, float, float]  # linear RGB
    parallel: bool  # orthographic camera
    clip: bool  # box and plane are applied
    box: tuple[float, ...]  # visible box, as `Volume.bounds`
    normal: tuple[float, ...] = (0.0, 0.0, 1.0)  # of the plane, to the visible side
    offset: float = -1.0  # of the plane from the middle of the volume, in half diagonals
    point: Vector | None = None  # picked world point


PROGRAM = {"enabled": "", "lit": "light", "mode": "mode", "parallel": "orthographic", "clip": "clip"}
"""Fields with a compiled program for each value, and their names in the status."""


@dataclass(frozen=True)
class ViewerSetup:
    """Constant part of a viewer: volumes, and the choices of the controls."""

    volume: Volume
    transforms: tuple[Transform, ...]  # choices, in the order of application
    initial_march: March  # its quadrature and `max_samples` are constant
    lighting: Lighting  # while light is on
    voxel: float  # world length of a step of 1
    modes: dict[str, Compositing[Any]]  # besides isosurfaces, for a single volume
    extra_pairs: tuple[tuple[Volume, Transfer], ...] = ()  # more volumes in the image, without controls

    def march(self, state: State, step_factor: float = 1.0) -> March:
        """The march, with `step_factor` times the step."""
        enabled = tuple(t for t in self.transforms if type(t).__name__ in state.enabled)
        if state.clip:
            enabled = (Clip(state.box, [self.plane(state)]), *enabled)
        step, initial = state.step * step_factor * self.voxel, self.initial_march
        return March(step, enabled, initial.quadrature, max_samples=initial.max_samples)

    def plane(self, state: State) -> tuple[Vector, Vector]:
        """Origin and normal of the clip plane."""
        low, high = (np.asarray(corner, np.float64) for corner in self.volume.corners)
        normal = np.asarray(state.normal, np.float64)
        # a little farther than half the diagonal, so that nothing is cut away at -1
        return (low + high) / 2 + 0.501 * state.offset * np.linalg.norm(high - low) * normal, normal

    def orbit(self, state: State) -> Orbit:
        """The orbit of the state; an orthographic camera stands in front of all volumes."""
        if not state.parallel:
            return state.orbit
        far = np.abs(self.ends - state.orbit.focal_point).max(axis=0)
        return state.orbit.withdrawn(1.1 * float(np.linalg.norm(far)))

    @cached_property
    def ends(self) -> Float[np.ndarray, "2 3"]:
        """The lowest and the highest corner of the world box around all volumes."""
        volumes = self.volume, *(volume for volume, _ in self.extra_pairs)
        bounds = np.stack([np.asarray(volume.bounds) for volume in volumes])
        return np.stack([bounds[:, ::2].min(axis=0), bounds[:, 1::2].max(axis=0)])

    def camera(
        self, state: State, size: tuple[int, int], window: object = None, corner: object = None
    ) -> Camera:
        """The camera of a state for an image of `size` pixels, or a part of it."""
        return self.orbit(state).camera(size, window, corner, parallel=state.parallel)

    def compositing(self, state: State) -> Compositing[Any]:
        """The compositing of a state."""
        return Isosurface(state.isovalue) if state.mode == ISOSURFACE else self.modes[state.mode]

    def light(self, state: State) -> Lighting | None:
        """The light, if it is on and the mode can be lit; None for several volumes."""
        lit = state.lit and self.compositing(state).can_be_lit and not self.extra_pairs
        return self.lighting if lit else None

    def seen_from(self, state: State, toward: Vector) -> Orbit:
        """An orbit in a direction, framed on the visible part."""
        if is_placed(self.volume):  # a patient's front, at -y, is up from above, too
            toward = toward + np.array([0, 1e-6 * max(float(toward[2]), 0), 0])
        orbit = replace(state.orbit, toward=toward).turned(0, 0)  # not straight from above
        view = orbit.toward, orbit.view_up, orbit.view_angle
        kwargs: Any = {"parallel": state.parallel, "size": state.size, "least": FAINT, "centered": True}
        pair = with_others(self.volume, state.transfer, self.extra_pairs)
        return Orbit.of(automatic_camera(*pair, *view, **kwargs))

    def settings(self, state: State) -> dict[str, Any]:
        """Options of `jaxvol render` that draw a state."""
        orbit = self.orbit(state)
        options = {"size": state.size, "step": state.step * self.voxel, "background": state.background}
        options |= {"camera": [*orbit.position.tolist(), *orbit.focal_point.tolist()]}
        options |= {"view_up": orbit.view_up.tolist(), "view_angle": orbit.view_angle}
        options |= {"parallel": state.parallel, "shade": self.light(state) is not None}
        if state.clip:
            options |= {"clip_box": state.box, "clip_plane": [np.concatenate(self.plane(state)).tolist()]}
        options |= {"compositing": state.mode} if state.mode in (*MODES, ISOSURFACE) else {}
        return options | ({"isovalue": state.isovalue} if state.mode == ISOSURFACE else {})

    def in_mode(self, state: State, mode: str) -> State:
        """The state in another mode, with that mode's default light, and its default background if the old
        one was a default. **Raises** `ValueError` if the mode cannot show the transfer function."""
        old, new = (BLACK if name in MODES.keys() - {"over"} else WHITE for name in (state.mode, mode))
        background = new if state.background == old else state.background
        changed = replace(state, mode=mode, background=background, lit=mode in ("over", ISOSURFACE))
        self.compositing(changed).marched(changed.transfer, self.initial_march, self.volume)
        return changed


def checked_pairs(pairs: Sequence[tuple[Volume, Transfer]]) -> tuple[tuple[Volume, Transfer], ...]:
    """Pairs of a volume and its transfer function. **Raises** `ValueError` for anything else."""
    entries: Any = tuple(pairs) if isinstance(pairs, list | tuple) else (pairs,)
    for pair in entries:
        if not isinstance(pair, tuple) or tuple(map(type, pair))[:1] != (Volume,) or len(pair) != 2:
            raise ValueError(f"others must be pairs (Volume, transfer function); got {described(pair)}.")
    return tuple((volume, sized(transfer, volume)) for volume, transfer in entries)


def initial(
    volume: Volume,
    transfer: Transfer | None = None,
    camera: Camera | None = None,
    march: March | None = None,
    *,
    lighting: Lighting | None = None,
    lit: bool = True,
    compositing: Mode | Compositing[Any] = "over",
    background: Arrayable | str = (1.0, 1.0, 1.0),
    size: tuple[int, int] = (640, 480),
    others: Sequence[tuple[Volume, Transfer]] = (),
) -> tuple[ViewerSetup, State]:
    """The constant part and the initial state of a viewer. Arguments and errors as for `view`."""
    pairs = checked_pairs(others)
    view_size = Camera.looking_at(volume, size=size).size  # checks volume and size
    min_opacity = VISIBLE if transfer is None else FAINT
    if transfer is None:
        volume, transfer = labels_if_any(volume) or (volume, automatic_transfer(volume))
    if camera is None:
        pair = with_others(volume, transfer, pairs)
        camera = automatic_camera(*pair, size=size, least=min_opacity, centered=True)
    warn_of_gap(volume, pairs)
    initial_march = March(1.0, (), "midpoint") if march is None else march
    shown: Transfer = sized(transfer, volume)
    arguments = {"volume": volume, "transfer": shown, "camera": camera, "march": initial_march}
    check_arguments("view(volume, transfer, camera, march)", **arguments, lighting=lighting)
    mode = compositing_of(compositing)
    mode.marched(shown, initial_march, volume)  # refuses a transfer function that it cannot show
    if pairs:
        together(*with_others(volume, shown, pairs))  # refuses pairs that do not fit together
        if not isinstance(mode, SEVERAL) or lighting is not None:
            raise ValueError(
                'with others, compositing must be "over" or "integral" and lighting None; '
                f"got {type(mode).__name__} and {described(lighting)}."
            )
    if lighting is not None and not mode.can_be_lit:
        raise ValueError(f"lighting must be None under {type(mode).__name__}, which shows no single place.")
    color: Any = tuple(np.asarray(linear_color("background", background)).tolist())
    blocks = tuple(-(-n // BLOCK) for n in volume.shape)
    voxel = Place.of(initial_march, volume).voxel(blocks)
    finest = min([voxel, *(float(np.asarray(added.spacing).min()) for added, _ in pairs)])
    step = max(0.5 * finest / voxel, MIN_STEP) if march is None else float(march.step) / voxel
    if not MIN_STEP <= step <= MAX_STEP:
        raise ValueError(
            f"march must have a step from {MIN_STEP * voxel:.4g} to {MAX_STEP * voxel:.4g}, {MIN_STEP:g} to "
            f"{MAX_STEP:g} voxels, to be shown; got one of {step * voxel:.4g}, {step:.4g} voxels."
        )
    # no module constants: their arrays would be on a device before `jax.distributed` is initialized
    defaults = AlphaCorrection(), SpaceLeaping(), EarlyTermination(1 / 256)
    transforms = initial_march.transforms
    choices = EmptySpaceJitter(seed=0), Jitter(seed=0), *defaults
    choices = (*transforms, *(t for t in choices if type(t) not in map(type, transforms)))
    modes: dict[str, Compositing[Any]] = {
        name: kind() for name, kind in MODES.items() if not pairs or issubclass(kind, SEVERAL)
    }
    name = next((n for n, kind in MODES.items() if type(mode) is kind), type(mode).__name__.lower())
    modes |= {} if isinstance(mode, Isosurface) else {name: mode}
    scene = ViewerSetup(volume, choices, initial_march, lighting or Phong(), voxel, modes, pairs)
    enabled = frozenset(type(t).__name__ for t in (defaults if march is None else transforms))
    data = np.asarray(volume.data)
    between = (float(data.min()) + float(data.max())) / 2
    isovalue = float(mode.value) if isinstance(mode, Isosurface) else between
    settings = step, enabled, lit, name, isovalue, color, camera.parallel_scale is not None, False
    box = tuple(np.asarray(volume.bounds).tolist())
    return scene, State(Orbit.of(camera), view_size, shown, *settings, box)
