"""How are images of a scene rendered? As planned or with the given step, in memory or by bricks."""

import argparse
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax

from ...bricks import VoxelSource, render_bricks
from ...compositing.blending import Compositing
from ...lighting import Lighting
from ...march.march import March
from ...march.transforms.alpha_correction import AlphaCorrection
from ...march.transforms.early_termination import EarlyTermination
from ...march.transforms.space_leaping import SpaceLeaping
from ...planning import Plan, plan
from ...render import PLANNED, render
from ...scene.camera import Camera
from ...scene.rendering import Rendering
from ...scene.transfer import Transfer
from ...scene.volume import Volume
from .progress import Told, working
from .scene import Scene


FAST = SpaceLeaping(), AlphaCorrection(), EarlyTermination()
"""Transforms of a march whose step is given."""


class Frames(NamedTuple):
    """Renders images of a scene, by `march`. `source` and `memory`: of a volume that is read in bricks."""

    volume: Volume
    transfer: Transfer
    march: March
    compositing: Compositing[Any]
    lighting: Lighting | None
    source: VoxelSource | None = None
    memory: int | None = None

    def render(self, camera: Camera, told: Told | None = None) -> Rendering:
        """One image. `told`: called with the numbers of bricks rendered and to render."""
        how = {"compositing": self.compositing, "lighting": self.lighting}
        if self.source is None:
            found = render(self.volume, self.transfer, camera, self.march, **how)
        else:
            how |= {"memory": self.memory, "progress": told}
            found = render_bricks(self.source, self.transfer, camera, self.march, **how)
        return jax.block_until_ready(found)


def planning(options: argparse.Namespace) -> str:
    """What is going on while a plan is made."""
    return f"planning how to render {options.file}"


def planned(
    options: argparse.Namespace, scene: Scene, camera: Camera | None = None, *, once: bool = True
) -> Plan:
    """The cheapest way to render the scene within the tolerance that is asked for. `once`: of one image."""
    how: dict[str, Any] = {
        "transforms": scene.clip,
        "compositing": scene.compositing,
        "lighting": scene.lighting,
        "once": once,
    }
    seen = scene.transfer, scene.camera if camera is None else camera
    volume = scene.volume if scene.source is None else scene.source
    return plan(volume, *seen, tolerance_of(options), memory=options.memory, **how)


def frames_of(options: argparse.Namespace, scene: Scene, cameras: Sequence[Camera] = ()) -> Frames:
    """How to render images of the scene: with the given step; without one, as planned for each of the cameras
    (by default the scene's), by the shortest step of these plans."""
    transfer, mode = scene.transfer, scene.compositing
    if options.step is not None:
        if options.tolerance is not None:
            raise ValueError("--tolerance finds a step; leave out --step.")
        march = March(options.step, (*scene.clip, *FAST), "midpoint")
        return Frames(scene.volume, transfer, march, mode, scene.lighting, scene.source, options.memory)
    seen = cameras or (scene.camera,)
    plans = []
    with working(planning(options)) as told:
        for camera in seen:
            plans.append(planned(options, scene, camera, once=len(seen) == 1))
            told(len(plans), len(seen))
    found = min(plans, key=lambda plan: float(plan.march.step))
    source = None if found.bricks is None else found.source
    if not found.within:
        print(f"not proven to be within an RMSE of {found.tolerance:.2g}; jaxvol plan tells more")
    return Frames(found.volume, transfer, found.march, mode, found.lighting, source, options.memory)


def tolerance_of(options: argparse.Namespace) -> float:
    """The tolerance that is asked for, or one level of 8 bits."""
    return PLANNED if options.tolerance is None else options.tolerance
