"""`jaxvol plan`: the cheapest way to render a volume file within a tolerance, and why."""

import argparse
from typing import Any

from .frames import planned, planning
from .options import scene_options, view_options
from .progress import working
from .scene import scene_of


def add_plan(commands: Any, shared: argparse.ArgumentParser) -> None:
    """Add the subcommand. `commands`: what `add_subparsers` returned."""
    parser = commands.add_parser(
        "plan",
        parents=[shared, scene_options(), view_options()],
        help="show the cheapest way to render a volume file within a tolerance, and why",
        description="Show the cheapest way to render a volume file within a tolerance, and why. The command "
        "`render` uses it.",
    )
    parser.set_defaults(run=_plan)


def _plan(options: argparse.Namespace) -> None:
    if options.step is not None:
        raise ValueError("--step sets the step; jaxvol plan finds one: leave it out.")
    scene = scene_of(options)
    with working(planning(options)):
        found = planned(options, scene)
    print(found)
