"""How are images of a scene rendered? As planned or with the given step, in memory or by bricks."""

import argparse
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax

from ...bricks import VoxelSource, render_bricks
from ...lighting import Lighting
from ...march.march import March
from ...march.transforms.alpha_correction import AlphaCorrection
from ...march.transforms.early_termination import EarlyTermination
from ...march.transforms.space_leaping import SpaceLeaping
from ...planning import Plan, plan
from ...render import PLANNED, render
from ...scene.camera import Camera
from ...scene.rendering import Rendering
from ...scene.volume import Volume
from .scene import Scene


FAST = SpaceLeaping(), AlphaCorrection(), EarlyTermination()
"""Transforms of a march whose step is given."""


class Frames(NamedTuple):
    """Renders images of a scene: of `volume`, or, within `memory`, of `source` by bricks."""

    scene: Scene
    volume: Volume
    march: March
    lighting: Lighting | None
    source: VoxelSource | None
    memory: int | None

    def render(self, camera: Camera) -> Rendering:
        """One image."""
        how = {"compositing": self.scene.compositing, "lighting": self.lighting}
        if self.source is None:
            found = render(self.volume, self.scene.transfer, camera, self.march, **how)
        else:
            how["memory"] = self.memory
            found = render_bricks(self.source, self.scene.transfer, camera, self.march, **how)
        return jax.block_until_ready(found)


def plans_of(options: argparse.Namespace, scene: Scene, cameras: Sequence[Camera]) -> list[Plan]:
    """The cheapest way to render the scene within the tolerance that is asked for, for each camera."""
    what: Any = scene.volume if scene.source is None else scene.source
    how: dict[str, Any] = {
        "transforms": scene.clip,
        "compositing": scene.compositing,
        "lighting": scene.lighting,
        "once": len(cameras) == 1,
    }
    if scene.source is not None:
        how["memory"] = options.memory
    tolerance = PLANNED if options.tolerance is None else options.tolerance
    return [plan(what, scene.transfer, camera, tolerance, **how) for camera in cameras]


def frames_of(options: argparse.Namespace, scene: Scene, cameras: Sequence[Camera]) -> Frames:
    """How to render images of the scene: with the given step; without one, by the shortest step of those that
    are planned for the cameras."""
    if options.step is not None:
        march = March(options.step, (*scene.clip, *FAST), "midpoint")
        return Frames(scene, scene.volume, march, scene.lighting, scene.source, options.memory)
    found = min(plans_of(options, scene, cameras), key=lambda plan: float(plan.march.step))
    source = None if found.bricks is None else found.source
    if not found.within:
        print(f"not proven to be within an RMSE of {found.tolerance:.2g}; jaxvol plan tells more")
    return Frames(scene, found.volume, found.march, found.lighting, source, options.memory)
