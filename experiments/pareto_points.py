"""Which settings of which methods are charted by `pareto`? One entry each, by name: how its program is made.

Each method has its own sweep around one base, the first setting of its kind of scene. Unlit: the midpoint
rule at steps of one voxel, cells cut at the exit (`AlphaCorrection`), space leaping by the hierarchy, and
rays that end at a transmittance of 1e-4. In a lit scene the base is lit once per ray, by one template of
eight photons; in a shaded one each sample is shaded by its gradient, and an isosurface where it is hit. A
scene in bricks is rendered whole and by `render_bricks`, from a file, within a budget.
"""

from collections.abc import Callable, Iterable
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol.bricks.grid import COPIES

from . import peer_vtk, programs
from .pareto_scenes import Kind, Row
from .programs import DRJIT, LEFT, QUADRATURES, VTK, Case, Program, lighting_of, ours


STEPS = (0.25, 0.5, 1.0, 2.0, 4.0)
BASE = "midpoint, step 1"
PHOTONS = 8


class Setting(NamedTuple):
    """A point of the chart: the method whose sweep it belongs to, and how its program is made. `toroidal`:
    whether it is measured in toroidal scans, too, where each ray is bent sample by sample."""

    family: str
    make: Callable[[Case], Program]
    toroidal: bool = False


Settings = dict[str, Setting]


def sweep(
    family: str, name: str, steps: Iterable[float], *transforms: Any, toroidal: bool = True, **how: Any
) -> Settings:
    """The same setting at several steps, by name."""
    return {f"{name}, step {s:g}": Setting(family, ours(*transforms, step=s, **how), toroidal) for s in steps}


def lit(
    family: str,
    step: float = 1.0,
    quadrature: Any = "midpoint",
    **how: Any,
) -> Setting:
    """A setting of light, by options of its templates."""
    return Setting(family, ours(lighting=partial(lighting_of, **how), step=step, quadrature=quadrature))


@cache
def _folder() -> TemporaryDirectory:
    """Where volumes lie that are read brick by brick, until the program ends."""
    return TemporaryDirectory()


def in_bricks(part: float, step: float, case: Case) -> Program:
    """The base by `render_bricks` from a file, within `part` of what the whole volume takes in memory with
    the copies that are made of it. Ranges of values are found once, before."""
    volume, transfer, camera, voxel = case.scene
    transforms = *case.placed, jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination(LEFT)
    march = jv.March(step * voxel, transforms, "midpoint")
    memory = int(part * COPIES * volume.data.nbytes)
    path = Path(_folder().name) / f"{part:g}, {step:g}.npy"
    np.save(path, np.asarray(volume.data))
    source = jv.bricks.source_of(path, spacing=volume.spacing, origin=volume.origin)

    def render() -> jv.Rendering:
        return jv.render_bricks(source, transfer, camera, march, memory=memory, outputs="rgba")

    return Program(lambda: render().rgba, lambda: np.asarray(render().image()))


def tabulated(points: int, case: Case) -> Case:
    """The transfer function as a table of equidistant entries."""
    values = jnp.linspace(case.scene.transfer.values[0], case.scene.transfer.values[-1], points)
    return case._replace(scene=case.scene._replace(transfer=peer_vtk.tabulated(case.scene.transfer, values)))


def stored(kind: str, case: Case) -> Case:
    """The voxels in another type. What does not fit is scaled to the type's range and rounded, and the
    transfer function with it."""
    volume, transfer = case.scene.volume, case.scene.transfer
    data = np.asarray(volume.data)
    if np.issubdtype(kind, np.integer) and not np.can_cast(data.dtype, kind):
        low, high = float(data.min()), float(data.max())
        scale = np.iinfo(kind).max / (high - low)
        data = np.rint((data.astype(np.float64) - low) * scale)
        values = (np.asarray(transfer.values) - low) * scale
        transfer = jv.TransferFunction(values, transfer.colors, transfer.extinction)
    volume = jv.Volume(data.astype(kind), volume.spacing, volume.origin)
    return case._replace(scene=case.scene._replace(volume=volume, transfer=transfer))


JITTERS: dict[str, tuple[jv.Transform, bool]] = {
    "jittered": (jv.Jitter(0), True),
    "jittered, blue": (jv.Jitter(0, "blue"), False),
    "jittered, front residual": (jv.Jitter(0, front_residual=True), False),
    "empty-space jittered": (jv.EmptySpaceJitter(0), True),
    "empty-space jittered, blue": (jv.EmptySpaceJitter(0, "blue"), False),
}
"""With whether they are measured in toroidal scans, too: those of Kye 2013."""
PLAIN = jv.AlphaCorrection, jv.SpaceLeaping, jv.EarlyTermination
NOT_ALIGNED: Any = {"without": (jv.AlphaCorrection,)}
NO_LEAPING: Any = {"without": (jv.SpaceLeaping,)}


def uniform() -> Settings:
    found = {BASE: Setting("midpoint", ours(), True)}
    for quadrature in QUADRATURES:
        found |= sweep(quadrature, quadrature, STEPS, quadrature=quadrature)
    return found


def unlit() -> Settings:
    found = uniform()
    for name, (jitter, toroidal) in JITTERS.items():
        found |= sweep("jitter", name, (1.0, 2.0), jitter, toroidal=toroidal)
    found |= sweep("alignment", "not aligned", (0.5, 1.0, 2.0), **NOT_ALIGNED)
    found |= sweep("alignment", "not aligned, left", (0.5, 1.0), quadrature="left", **NOT_ALIGNED)
    found |= sweep("alignment", "plain ray casting", (0.5, 1.0, 2.0), quadrature="left", without=PLAIN)
    found |= sweep("leaping", "no leaping", (0.5, 1.0), **NO_LEAPING)
    found |= sweep("leaping", "leaping by distance", (0.5, 1.0), jv.SpaceLeaping("distance"))
    for method in ("min_distance", "beam"):
        for cell in (4, 8, 16):
            leaps = jv.SpaceLeaping(method, cell)
            found[f"leaping by {method}, cell {cell}"] = Setting("leaping", ours(leaps))
    for left in (0.1, 0.03, 0.01, 1 / 255, 1e-3):
        found[f"ending at {left:g}"] = Setting("termination", ours(jv.EarlyTermination(left)), True)
    found["not ending early"] = Setting("termination", ours(without=(jv.EarlyTermination,)), True)
    for n in (16, 64, 256, 1024):
        found[f"transfer table of {n}"] = Setting("transfer table", ours(changed=partial(tabulated, n)))
    for kind in ("uint8", "uint16", "float16", "float32"):
        found[f"stored as {kind}"] = Setting("storage", ours(changed=partial(stored, kind)))
    return found


def of_templates() -> Settings:
    found = {}
    for q in ("midpoint", "left"):
        for step in (1.0, 0.5, 2.0, 4.0):
            found[f"lit, {q}, step {step:g}"] = lit("photons", step, q, photons=PHOTONS)
    found |= {f"photons {n}": lit("photons", photons=n) for n in (1, 4, 8, 16)}
    found["all photons"] = lit("photons")
    found["all photons, hard occlusion"] = lit("photons", occlusion="hard")
    blended: Any = {"blend": True, "photons": PHOTONS}
    for n in (1, 2, 4):
        found[f"templates {n}, photons {PHOTONS}"] = lit("templates", templates=n, **blended)
    return found


def shaded() -> Settings:
    found = sweep("shaded", "shaded, midpoint", (1.0,), lighting=lighting_of)
    for q in QUADRATURES:
        found |= sweep("shaded", f"shaded, {q}", STEPS, quadrature=q, lighting=lighting_of)
    return found


def surface() -> Settings:
    found = sweep("isosurface", "isosurface", (1.0, 0.25, 0.5, 2.0, 4.0), lighting=lighting_of)
    name = "isosurface, no leaping"
    found |= sweep(name, name, STEPS, lighting=lighting_of, **NO_LEAPING)
    name = "isosurface, leaping by distance"
    return found | sweep(name, name, STEPS, jv.SpaceLeaping("distance"), lighting=lighting_of)


def whole_and_in_bricks() -> Settings:
    found = sweep("whole", "whole", (1.0, 0.5, 2.0, 4.0))
    for words, part in (("of the whole", 1.0), ("of a quarter", 0.25)):
        for step in (1.0, 2.0):
            name = f"bricks, memory {words}"
            found[f"{name}, step {step:g}"] = Setting(name, partial(in_bricks, part, step))
    return found


SETTINGS: dict[Kind, Settings] = {
    "unlit": unlit(),
    "uniform": uniform(),
    "lit": of_templates(),
    "shaded": shaded(),
    "surface": surface(),
    "bricks": whole_and_in_bricks(),
}
"""By kind of scene, its base first."""
OF_VTK = {f"{VTK}, step {step:g}": Setting(VTK, partial(programs.by_vtk, step)) for step in STEPS[1:]}
OF_DRJIT = {
    f"{DRJIT}, {q}, step {step:g}": Setting(DRJIT, partial(programs.by_drjit, q, step))
    for q in ("left", "midpoint")
    for step in STEPS[1:]
}


def of(row: Row, there: dict[str, str]) -> Settings:
    """The settings of a scene, its base first; `there`: version of each peer, or why it is missing."""
    found = {n: s for n, s in SETTINGS[row.kind].items() if s.toroidal or not row.toroidal}
    if row.peers is None and programs.is_here(there, VTK):
        found |= OF_VTK
    if row.peers is None and row.kind in ("unlit", "uniform") and programs.is_here(there, DRJIT):
        found |= OF_DRJIT
    return found


def base_of(row: Row) -> str:
    """Name of the setting that all others of the scene are timed against."""
    return next(iter(SETTINGS[row.kind]))
