"""How is a volume rendered within a tolerance and a budget of memory? By bricks, where it does not fit."""

import math
import time
from typing import Any, NamedTuple, overload

import jax
import numpy as np

from .._util.checks import Arrayable
from ..compositing.blending import Compositing
from ..compositing.modes import Mode
from ..lighting.shading import Lighting
from ..march.march import March
from ..march.transforms import AlphaCorrection, SpaceLeaping
from ..planning import Part, Plan, plan as plan_in_memory
from ..render import render
from ..scene.camera import Camera
from ..scene.rendering import Rendering
from ..scene.transfer import Transfer
from ..scene.volume import Volume
from .opening import OF_RAW, OF_ZARR, Openable, levels_of
from .render import bricks_of, budget, render_bricks
from .sources import VoxelSource
from .split import TooLittleMemory, check_smallest


IN_MEMORY = 9
"""Bytes for each byte of voxels, or less, that `render` takes: the voxels as read and in the device, a packed
copy of 8-bit ones, what finding the extremes of blocks takes, and slopes."""


HALVED = 4
"""How often a step may be halved so that bricks fit."""


class BudgetPlan(NamedTuple):
    """How to render a volume within a tolerance and a budget of memory. `print` shows it.

    - `plan`: the march and its parts. Where the volume fits, that of the volume; otherwise that of a copy
      with every `stride`-th voxel, whose step was divided by `stride`: `plan.error` is the copy's.
    - `source`: the volume. `memory`: the budget, bytes.
    - `stride`: 1 where the volume fits.
    - `counts`: bricks along each axis; None where the volume fits. `loads`: how many of them are read at
      most: those that may hold anything visible. `bytes_read`: of these, at most. All three hold for the
      camera of the plan, and for others of as many pixels: into which bricks a volume is split depends on
      the number of rays (`bricks/choice.py`).
    - `compositing`: as given.
    """

    plan: Plan
    source: VoxelSource
    memory: int
    stride: int
    counts: tuple[int, int, int] | None
    loads: int
    bytes_read: int
    compositing: Any

    @property
    def march(self) -> March:
        return self.plan.march

    @property
    def lighting(self) -> Lighting | None:
        return self.plan.lighting

    def render(self, transfer: Transfer, camera: Camera, **options: Any) -> Rendering:
        """The image as planned, by `jv.render` or `jv.render_bricks`, which take the `options`."""
        how = {"compositing": self.compositing, "lighting": self.lighting} | options
        if self.counts is None:
            return render(self.plan.volume, transfer, camera, self.march, **how)
        how = {"memory": self.memory} | how
        return render_bricks(self.source, transfer, camera, self.march, **how)

    def __str__(self) -> str:
        size, given, read = (
            f"{count / 2**20:.1f} MiB" for count in (self.source.nbytes, self.memory, self.bytes_read)
        )
        if self.counts is None:
            return f"in memory: {size} of voxels, and what is made of them, fit into {given}\n{self.plan}"
        return (
            f"{' x '.join(map(str, self.counts))} bricks: {size} of voxels, and what is made of them, do not "
            f"fit into {given}; at most {self.loads} are read, {read}. Planned on a "
            f"copy of one voxel in {self.stride} along each axis, at 1/{self.stride} of its step; error and "
            f"time below are the copy's\n{self.plan}"
        )


@overload
def plan(
    volume: Volume,
    transfer: Transfer | Any,
    camera: Camera | Any,
    tolerance: float | Any,
    *,
    memory: None = None,
    compositing: Mode | Compositing[Any] | Any = "over",
    **options: Any,
) -> Plan: ...
@overload
def plan(
    volume: Openable,
    transfer: Transfer | Any,
    camera: Camera | Any,
    tolerance: float | Any,
    *,
    memory: int | Any | None = None,
    spacing: Arrayable | None = None,
    origin: Arrayable | None = None,
    compositing: Mode | Compositing[Any] | Any = "over",
    source: dict[str, Any] | None = None,
    **options: Any,
) -> BudgetPlan: ...
def plan(
    volume: Volume | Openable,
    transfer: Transfer | Any,
    camera: Camera | Any,
    tolerance: float | Any,
    *,
    memory: int | Any | None = None,
    spacing: Arrayable | None = None,
    origin: Arrayable | None = None,
    compositing: Mode | Compositing[Any] | Any = "over",
    source: dict[str, Any] | Any | None = None,
    **options: Any,
) -> Plan | BudgetPlan:
    """Finds the cheapest way to render a scene within a tolerance, and within a budget of memory.

    Of a `Volume`, without `memory`: as `planning.plan`, which says how it is found. Otherwise:

    - where the volume and what `render` makes of it fit into `memory` (IN_MEMORY bytes for each byte of
      voxels), it is read, and planned as a `Volume`;
    - otherwise it is rendered by `render_bricks`. The march is planned on a copy of every n-th voxel along
      each axis that fits, read slab by slab, and its step divided by n: as many steps a voxel as the copy
      needs. That is cautious where the volume is smooth, but the error is that of the copy: detail finer than
      n voxels has been seen in samples only. Whether faces and blocks are empty is not proven by a copy, so
      that `AlphaCorrection` and `SpaceLeaping` are kept. What is read around a brick is a number of steps:
      where the smallest bricks do not fit, the step is halved, up to four times.

    **Arguments:**

    - `volume`: a `Volume`, or what `bricks.levels_of` opens: an array, a memory map, a path. Of several
      levels of detail, the finest.
    - `transfer`, `camera`, `tolerance`, `compositing`: as for `planning.plan`.
    - `memory`: bytes, as for `render_bricks`; by default a quarter of the device's memory.
    - `spacing`, `origin`: as for `render_bricks`.
    - `source`: other options of `bricks.levels_of`, such as {"shape": (nx, ny, nz), "dtype": "uint8"}.
    - `options`: of `planning.plan`: `transforms`, `lighting`, `gradients`, `seed`.

    **Returns:** a `Plan` of a `Volume` without `memory`, otherwise a `BudgetPlan`.

    **Raises:** `ValueError` as `planning.plan` and `render_bricks` do.
    """
    how = {"compositing": compositing, **options}
    if isinstance(volume, Volume) and memory is None:
        return plan_in_memory(volume, transfer, camera, tolerance, **how)
    begun, room = time.perf_counter(), budget(memory)
    place = {name: value for name, value in (("spacing", spacing), ("origin", origin)) if value is not None}
    if not isinstance(source, dict | None) or {*(source or ())} - {*OF_RAW, *OF_ZARR}:
        raise ValueError(
            f"source must be a dictionary of options, of {', '.join((*OF_RAW, *OF_ZARR))}; got {source!r}."
        )
    opened, *_ = levels_of(volume, **place, **(source or {}))
    if opened.direction is not None:
        raise ValueError("volume must lie along the axes of the world to be planned with memory.")
    # before anything takes time
    check_smallest(opened.shape, opened.dtype, room)
    stride = 1
    while IN_MEMORY * opened.dtype.itemsize * math.prod(-(-n // stride) for n in opened.shape) > room:
        stride += 1
        if min(opened.shape) // stride < 2:
            raise ValueError(
                f"memory must hold a copy of 2 voxels along each axis to plan with; got {memory}."
            )
    copy = copied(opened, stride)
    found = plan_in_memory(copy, transfer, camera, tolerance, **how)
    if stride == 1:
        return BudgetPlan(found, opened, room, 1, None, 0, opened.nbytes, compositing)
    march, parts = _finer(found.march, stride), _parts(found.parts)
    how = {"compositing": compositing, "lighting": found.lighting}
    halved = 0
    while True:
        try:
            stream = bricks_of(opened, transfer, camera, march, memory=room, **how)
            break
        except TooLittleMemory:  # what is read around a brick is a number of steps
            if halved == HALVED:
                raise
            halved, march = halved + 1, _finer(march, 2)
    loads = int(stream.visible.sum())
    nbytes = loads * int(np.prod(stream.stored)) * opened.dtype.itemsize
    found = found._replace(march=march, parts=parts, probed=time.perf_counter() - begun)
    return BudgetPlan(found, opened, room, stride, stream.report().counts, loads, nbytes, compositing)


def copied(source: VoxelSource, stride: int) -> Volume:
    """Every `stride`-th voxel, read in slabs across the axis where these are thinnest."""
    spacing, origin = source.spacing or (1.0, 1.0, 1.0), source.origin or (0.0, 0.0, 0.0)
    axis = int(np.argmax([n / c for n, c in zip(source.shape, source.chunks, strict=True)]))
    thick = -(-max(source.chunks[axis], stride) // stride) * stride
    parts = []
    for begin in range(0, source.shape[axis], thick):
        low, high = [0, 0, 0], list(source.shape)
        low[axis], high[axis] = begin, min(begin + thick, source.shape[axis])
        parts.append(source.read(low, high)[::stride, ::stride, ::stride].copy())
    return Volume(np.concatenate(parts, axis), [stride * s for s in spacing], origin)


def _finer(march: March, stride: int) -> March:
    """The march at a step of so many times less, with what a copy cannot prove to be of no use."""
    kept = list(march.transforms)
    needed = (SpaceLeaping(), AlphaCorrection())
    kept += [each for each in needed if not any(isinstance(own, type(each)) for own in kept)]
    return March(jax.numpy.asarray(march.step) / stride, tuple(kept), march.quadrature)


def _parts(parts: tuple[Part, ...]) -> tuple[Part, ...]:
    said = "not proven by a copy; kept"
    names = "AlphaCorrection", "SpaceLeaping"
    return tuple(Part(p.name, True, said) if p.name in names and not p.kept else p for p in parts)
