"""`jaxvol plan`: the cheapest way to render a volume file within a tolerance, and why."""

import argparse

from .frames import plans_of
from .options import SCENE, Command
from .scene import scene_of


def _plan(options: argparse.Namespace) -> None:
    if options.step is not None:
        raise ValueError("--step sets the step; jaxvol plan finds one: leave it out.")
    scene = scene_of(options)
    (found,) = plans_of(options, scene, [scene.camera])
    print(found)


PLAN = Command(
    "plan",
    "show the cheapest way to render a volume file within a tolerance, and why",
    SCENE,
    _plan,
)
