"""Renders a volume that does not fit into memory, brick by brick."""

from collections.abc import Callable
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np

from .._util.checks import Arrayable, described, finite_array, integer, is_traced
from .._util.memory import memory_of_device
from .._util.trees import strong
from .._util.xla import compiled
from ..arguments import check_arguments
from ..camera import Camera
from ..compositing import Compositing
from ..engine.acceleration import VolumeAcceleration
from ..engine.batch import with_fields
from ..engine.driver import Asked
from ..engine.image import RenderOptions
from ..engine.parts import NOTHING, Underway, arrive, march_part, resolve_part, set_out
from ..engine.resolve import resolve_image
from ..engine.scene import Scene
from ..engine.tiling import Tiling
from ..lighting.shading import Lighting
from ..march import March
from ..modes import Mode, compositing_of
from ..occupancy import Blocks, widened
from ..rendering import Details, Rendering
from ..selection import Selection
from ..transfer import Transfer
from .._util.vec3 import apart
from ..space import Space
from ..transforms import ToroidalMap
from ..volume import Volume, part_of
from .grid import BrickGrid, is_straight
from .sources import ArraySource, VoxelSource
from .split import Margin, bytes_of, split, stored_of
from .stream import Method, Stream
from .summary import Summary, scan


def render_bricks(
    source: VoxelSource | Any,
    transfer: Transfer | Any,
    camera: Camera | Any,
    march: March | Any,
    *,
    spacing: Arrayable | None = None,
    origin: Arrayable | None = None,
    memory: int | Any | None = None,
    bricks: tuple[int, int, int] | Any | None = None,
    method: Method | Any = "overlap",
    compositing: Mode | Compositing[Any] | Any = "over",
    lighting: Lighting | Any | None = None,
    outputs: Asked | Any = "all",
    summary: Summary | None = None,
    progress: Callable[[int, int], Any] | None = None,
) -> Rendering:
    source = source if isinstance(source, VoxelSource) else ArraySource(source)
    order = "render_bricks(source, transfer, camera, march)"
    check_arguments(order, transfer=transfer, camera=camera, march=march, lighting=lighting)
    scene = _scene(source, spacing, origin, transfer, camera, march, compositing, lighting)
    how = scene.compositing
    selects, resolves = isinstance(how, Selection), how.resolves
    marched = scene
    if resolves:  # rays are marched without light
        transfer, march = how.marched(scene.transfer, scene.march, scene.volume)
        marched = scene._replace(transfer=transfer, march=march, lighting=None)
    options = RenderOptions("depth" if resolves and outputs == "rgba" else outputs, Tiling.of_backend())
    stream = _stream(source, marched, scene, options, memory, bricks, method, summary, progress)
    underway = _set_out(marched, options)

    def march_brick(part: Volume, cells: Any, state: Any) -> Any:
        underway, pixels = state
        here = marched._replace(volume=part)
        acceleration = VolumeAcceleration.of(part, here.transfer, here.march, here.lighting)
        after = _march_part(here, options, acceleration, underway, cells, method == "naive")
        if selects:
            whole = scene._replace(volume=part)
            acceleration = VolumeAcceleration.of(part, whole.transfer, whole.march, whole.lighting)
            pixels = _resolve_part(whole, options, acceleration, marched.march, underway.at, after, pixels)
        return after, pixels

    state = stream.through(underway.rays, (underway, None), lambda state: state[0].alive, march_brick)
    underway, pixels = state
    if method == "naive":  # rays go back, and have no end
        underway = Underway(underway.rays, with_fields(underway.at, finished=underway.at.index >= 0))
    rendering = _arrive(marched, options, underway)
    if resolves and not selects:
        found = rendering.rgba, rendering.depth, None
        pixels = _resolve(scene, options, NOTHING, found)
    details = rendering.details._replace(bricks=stream.report(), selected=None)
    if pixels is None:
        return Rendering(rendering.rgba, rendering.exhausted, details)
    normal = pixels[..., 5:] if pixels.shape[-1] > 5 else None
    details = details._replace(depth=pixels[..., 4], normal=normal)
    if outputs == "rgba":
        details = Details(bricks=details.bricks)
    return Rendering(pixels[..., :4], rendering.exhausted, details)


_set_out = compiled(set_out)
_resolve_part = compiled(resolve_part)
_resolve = compiled(resolve_image)
_march_part = compiled(march_part)
_arrive = compiled(arrive)


def _scene(
    source: VoxelSource,
    spacing: Arrayable | None,
    origin: Arrayable | None,
    transfer: Transfer,
    camera: Camera,
    march: March,
    compositing: Any,
    lighting: Lighting | None,
) -> Scene:
    """The scene, with a volume of which no voxel is known."""
    spacing = spacing if spacing is not None else source.spacing or (1.0, 1.0, 1.0)
    origin = origin if origin is not None else source.origin or (0.0, 0.0, 0.0)
    nothing = np.zeros((2, 2, 2), source.dtype)
    volume = part_of(Volume(nothing, spacing, origin), jnp.zeros(3, jnp.int32), source.shape)
    return strong(Scene(volume, transfer, camera, march.divided(), compositing_of(compositing), lighting))


def _stream(
    source: VoxelSource,
    scene: Scene,
    shown: Scene,
    options: RenderOptions,
    memory: int | Any | None,
    bricks: tuple[int, int, int] | Any | None,
    method: Method | Any,
    summary: Summary | None,
    progress: Callable[[int, int], Any] | None,
) -> Stream:
    if method not in get_args(Method):
        raise ValueError(f"method must be one of {', '.join(get_args(Method))}; got {method!r}.")
    volume, _, camera, march, _, _ = scene
    space = march.locate(volume)
    straight = is_straight(space)
    probe = next((t for t in march.transforms if isinstance(t, ToroidalMap)), None)
    spacing = np.asarray(volume.spacing, float)
    if not straight:
        spacing = _distances(space, source.shape)
    margin = Margin.of(march, spacing, options.tiling.cells, shown.transfer, shown.lighting)
    memory = memory_of_device() // 4 if memory is None else integer("memory", memory, 1)
    if bricks is None:
        grid = split(source.shape, source.dtype, memory, margin, probe)
    else:
        counts = [integer("bricks", n, 1) for n in bricks]
        x, y, z = (-(-(n - 1) // c) for n, c in zip(source.shape, counts, strict=True))
        grid = BrickGrid(source.shape, (x, y, z))
    stored = stored_of(grid, margin, probe)
    if summary is None:
        summary = scan(source, 16)
    visible = _visible(scene, grid, summary)
    return Stream(
        *(source, scene, options, grid, margin, grid.order(space, camera), visible, straight, stored),
        *(max(memory, bytes_of(stored, source.dtype)), method, progress),
    )


def _distances(space: Space, shape: tuple[int, ...]) -> np.ndarray:
    """World distances between nodes along the three axes, in the middle of a grid with curved rays. Where a
    brick takes more of its surroundings, more is read."""
    middle = jnp.asarray([(n - 1) / 2 for n in shape])
    along = jax.jacfwd(lambda at: jnp.stack(space.point(apart(at))))(middle)
    return np.linalg.norm(np.asarray(along, float), axis=0)


def _visible(scene: Scene, grid: BrickGrid, summary: Summary) -> np.ndarray:
    """For each brick, whether anything may be visible in it."""
    ranges = np.array(
        [
            summary.range_of(low, [end + 1 for end in high])
            for low, high in (grid.cells(brick) for brick in range(grid.number))
        ],
        np.float32,
    )
    low, high = (jnp.asarray(end.reshape(grid.counts)) for end in ranges.T)
    blocks = Blocks(*widened(low, high), None)
    return np.asarray(scene.compositing.occupied(scene.transfer, blocks)).reshape(-1)
