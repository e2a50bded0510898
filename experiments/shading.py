"""What does shading by gradients cost, beside the unshaded frame and beside VTK's?

An engine and a bonsai, rendered with and without `Phong` by jaxvol, and with and without `ShadeOn` by VTK's
ray caster, all in turn, at steps of one voxel on as many threads as cores. Each shaded image's error is its
RMSE against the converged image of its own renderer, since the two shade by different rules: VTK lights nodes
and interpolates what that gives. The goals: 1.8 times the unshaded frame in the geometric mean, and half of
the time of VTK's shaded frame at no larger error.
"""

from argparse import Namespace
from typing import Any

from jaxvol.lighting import Phong
from jaxvol.metrics import rmse

from . import marches, programs, timing
from .harness import FINER, chosen_scenes, experiment, geometric_mean, some_of
from .programs import Case, is_here
from .scenes import PHANTOM, SCENES, Scene


GOALS = {"over unshaded": 1.8, "VTK's shaded over ours": 2.0}
OURS, PLAIN, VTK, VTK_PLAIN = "Phong", "unshaded", "VTK, ShadeOn", "VTK, unshaded"


def measure(scene: Scene, there: dict[str, str], repetitions: int) -> dict[str, Any]:
    """Times, their ratios, and the errors of the shaded images."""
    plain, lit = Case(scene), Case(scene, lighting=Phong)
    made = {PLAIN: programs.ours()(plain), OURS: programs.ours(lighting=programs.lighting_of)(lit)}
    exact = programs.program(lit, marches.converged(scene.step, FINER), Phong()).image()
    errors = {OURS: rmse(made[OURS].image(), exact)}
    if is_here(there, programs.VTK):
        made |= {VTK_PLAIN: programs.by_vtk(1, plain), VTK: programs.by_vtk(1, lit)}
        errors[VTK] = rmse(made[VTK].image(), programs.by_vtk(1 / FINER, lit).image())
    seconds = timing.interleaved({name: each.draw for name, each in made.items()}, repetitions)
    found: dict[str, Any] = {
        "seconds": {name: timing.median(all_) for name, all_ in seconds.items()},
        "over unshaded": timing.ratio(seconds[OURS], seconds[PLAIN]),
        "rmse": {name: float(error) for name, error in errors.items()},
    }
    if VTK in seconds:
        found["VTK's over unshaded"] = timing.ratio(seconds[VTK], seconds[VTK_PLAIN])
        found["VTK's shaded over ours"] = timing.ratio(seconds[VTK], seconds[OURS])
    return found


@experiment(
    repetitions=15,
    size=512,
    resolution=192,
    only=some_of(("engine", "bonsai"), "SCENE"),
    quick={"size": 32, "repetitions": 2, "resolution": 32},
)
def main(chosen: Namespace) -> dict[str, Any]:
    scenes, there = {}, programs.peers()
    for name, scene in chosen_scenes(chosen, SCENES, PHANTOM, chosen.size):
        scenes[name] = measure(scene, there, chosen.repetitions)
    rows = scenes.values()
    means = {
        k: geometric_mean(row[k]["median"] for row in rows) for k in GOALS if all(k in row for row in rows)
    }
    return {"image": [chosen.size] * 2, "goals": GOALS, "geometric means": means, "scenes": scenes}
