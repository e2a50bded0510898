"""`jaxvol plan`: the cheapest way to render a volume file within a tolerance, and why."""

import argparse
from typing import Any

from .frames import plans_of
from .options import add_command, add_scene
from .scene import scene_of


def _plan(options: argparse.Namespace) -> None:
    if options.step is not None:
        raise ValueError("--step sets the step; jaxvol plan finds one: leave it out.")
    scene = scene_of(options)
    (found,) = plans_of(options, scene, [scene.camera])
    print(found)


def add_plan(commands: Any) -> None:
    text = "show the cheapest way to render a volume file within a tolerance, and why"
    add_scene(add_command(commands, "plan", text, _plan))
