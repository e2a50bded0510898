"""Which settings of which methods are charted by `pareto`? One entry each, by name: how its program is made.

Each method has its own sweep around one base: the midpoint rule at steps of one voxel, cells cut at the exit
(`AlphaCorrection`), space leaping by the hierarchy, and rays that end at a transmittance of 1e-4. In a lit
scene the base is lit once per ray, by one template of eight photons; in a shaded one each sample is
shaded by its gradient, and an isosurface where it is hit. A scene in bricks is rendered whole and by
`render_bricks`, from a file, within a budget.
"""

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol.bricks.grid import COPIES
from jaxvol.lighting import Lighting

from . import peer_vtk
from .pareto_scenes import Row
from .programs import (
    DRJIT,
    FINEST_OF,
    LEFT,
    QUADRATURES,
    VTK,
    Case,
    Program,
    adaptive,
    by_drjit,
    by_vtk,
    deferred,
    is_here,
    lighting_of,
    ours,
)


STEPS = (0.25, 0.5, 1.0, 2.0, 4.0)
BASE = "midpoint, step 1"
LIT_BASE = "lit, midpoint, step 1"
SHADED_BASE = "shaded, midpoint, step 1"
SURFACE_BASE = "isosurface, step 1"
WHOLE_BASE = "whole, step 1"
PHOTONS = 8


def unlit(row: Row) -> bool:
    return not row.lit and not row.bricks


class Setting(NamedTuple):
    """A point of the chart: the method whose sweep it belongs to, and how its program is made.

    `where`: of which scenes.
    """

    family: str
    make: Callable[[Case], Program]
    where: Callable[[Row], bool] = unlit


def stepped(
    name: str,
    family: str,
    steps: tuple[float, ...],
    *transforms: Any,
    where: Callable[[Row], bool] = unlit,
    **how: Any,
) -> Any:
    """The same setting at several steps, by name."""
    return {f"{name}, step {s:g}": Setting(family, ours(*transforms, step=s, **how), where) for s in steps}


def lit(family: str, *transforms: Any, by: Callable[..., Lighting] = lighting_of, **how: Any) -> Setting:
    """A setting of light; `step` and `quadrature` are the march's, all else the templates'."""
    march: dict[str, Any] = {name: how.pop(name) for name in ("step", "quadrature") if name in how}

    def keep(case: Case) -> Case:  # a volume keeps one baked light only
        return case._replace(scene=case.scene._replace(volume=copied(case.scene.volume)))

    if "baked" in how:
        march["changed"] = keep
    made = ours(*transforms, lighting=partial(by, **how), **march)
    return Setting(family, made, lambda row: row.noisy)


def straight(row: Row) -> bool:
    """Where frames are fast enough for all settings: each ray of a toroidal scan is bent sample by sample."""
    return unlit(row) and not row.toroidal


def peer(row: Row) -> bool:
    return row.peers is None


def unlit_peer(row: Row) -> bool:
    return peer(row) and not row.shaded


def copied(volume: jv.Volume) -> jv.Volume:
    """The same volume in arrays of its own: what is computed once for each array of voxels, such as baked
    light, is then kept apart."""
    return jv.Volume(jnp.array(volume.data, copy=True), volume.spacing, volume.origin)


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
    path = Path(_folder().name) / f"{len(list(Path(_folder().name).glob('*.npy')))}.npy"
    np.save(path, np.asarray(volume.data))
    source = jv.bricks.source_of(path, spacing=volume.spacing, origin=volume.origin)

    def render() -> jv.Rendering:
        return jv.render_bricks(source, transfer, camera, march, memory=memory, outputs="rgba")

    def image() -> np.ndarray:
        rendering = render()
        assert not np.any(rendering.exhausted)
        return np.asarray(rendering.image())

    return Program(lambda: render().rgba, image)


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


JITTERS: dict[str, tuple[jv.Transform, ...]] = {
    "jittered": (jv.Jitter(0),),
    "jittered, blue": (jv.Jitter(0, "blue"),),
    "jittered, front residual": (jv.Jitter(0, front_residual=True),),
    "empty-space jittered": (jv.EmptySpaceJitter(0),),
    "empty-space jittered, blue": (jv.EmptySpaceJitter(0, "blue"),),
}

PAPER = "jittered", "empty-space jittered"
"""Those of Kye 2013, and the only ones in toroidal scans."""

UNLIT: dict[str, Setting] = {
    **{
        f"{q}, step {step:g}": Setting(q, ours(step=step, quadrature=q))
        for q in QUADRATURES
        for step in STEPS
    },
    **{f"adaptive, tolerance {t:g}": Setting("adaptive", adaptive(t)) for t in FINEST_OF},
    **{
        name: setting
        for how, jitter in JITTERS.items()
        for name, setting in stepped(
            how, "jitter", (1.0, 2.0), *jitter, where=unlit if how in PAPER else straight
        ).items()
    },
    **stepped("not aligned", "alignment", (0.5, 1.0, 2.0), without=(jv.AlphaCorrection,)),
    **stepped("not aligned, left", "alignment", (0.5, 1.0), without=(jv.AlphaCorrection,), quadrature="left"),
    **stepped(
        "plain ray casting",
        "alignment",
        (0.5, 1.0, 2.0),
        without=(jv.AlphaCorrection, jv.SpaceLeaping, jv.EarlyTermination),
        quadrature="left",
    ),
    **stepped("no leaping", "leaping", (0.5, 1.0), without=(jv.SpaceLeaping,)),
    **stepped("leaping by distance", "leaping", (0.5, 1.0), jv.SpaceLeaping("distance")),
    **{
        f"leaping by {method}, cell {cell}": Setting("leaping", ours(jv.SpaceLeaping(method, cell)), straight)
        for method in ("min_distance", "beam")
        for cell in (4, 8, 16)
    },
    **{
        f"ending at {left:g}": Setting("termination", ours(jv.EarlyTermination(left)))
        for left in (0.1, 0.03, 0.01, 1 / 255, 1e-3)
    },
    "not ending early": Setting("termination", ours(without=(jv.EarlyTermination,))),
    **{
        f"transfer table of {n}": Setting("transfer table", ours(changed=partial(tabulated, n)), straight)
        for n in (16, 64, 256, 1024)
    },
    **{
        f"stored as {kind}": Setting("storage", ours(changed=partial(stored, kind)), straight)
        for kind in ("uint8", "uint16", "float16", "float32")
    },
}

LIT: dict[str, Setting] = {
    **{
        f"lit, {q}, step {step:g}": lit("deferred", by=deferred, photons=PHOTONS, step=step, quadrature=q)
        for q in ("midpoint", "left")
        for step in STEPS[1:]
    },
    **{f"photons {n}": lit("photons", photons=n) for n in (1, 4, 8, 16)},
    "all photons": lit("photons"),
    "all photons, hard occlusion": lit("photons", occlusion="hard"),
    **{
        f"templates {n}, photons {PHOTONS}": lit("templates", templates=n, blend=True, photons=PHOTONS)
        for n in (1, 2, 4)
    },
    **{f"baked {n}": lit("baked", baked=n) for n in (32, 64, 128)},
    **{f"baked 64, step {step:g}": lit("baked", baked=64, step=step) for step in (0.5, 2.0)},
    **{f"baked {n}, deferred": lit("baked", by=deferred, baked=n) for n in (32, 64, 128)},
    "all photons, deferred": lit("deferred", by=deferred),
    **{
        f"templates {n}, deferred": lit("deferred", by=deferred, templates=n, blend=True, photons=PHOTONS)
        for n in (2, 4, 8)
    },
}

SHADED: dict[str, Setting] = {
    f"shaded{once}, {q}, step {step:g}": Setting(
        f"shaded{once}", ours(step=step, quadrature=q, lighting=by), lambda row: row.shaded
    )
    for once, by in (("", lighting_of), (" once", deferred))
    for q in QUADRATURES
    for step in STEPS
}

SURFACE: dict[str, Setting] = {
    f"isosurface{how}, step {step:g}": Setting(
        f"isosurface{how}",
        ours(*leaps, step=step, without=without, lighting=lighting_of),
        lambda row: row.surface,
    )
    for how, leaps, without in (
        ("", (), ()),
        (", no leaping", (), (jv.SpaceLeaping,)),
        (", leaping by distance", (jv.SpaceLeaping("distance"),), ()),
    )
    for step in STEPS
}

BRICKS: dict[str, Setting] = {
    **stepped("whole", "whole", STEPS[1:], where=lambda row: row.bricks),
    **{
        f"bricks, memory {words}, step {step:g}": Setting(
            f"bricks, memory {words}", partial(in_bricks, part, step), lambda row: row.bricks
        )
        for words, part in (("of the whole", 1.0), ("of a quarter", 0.25))
        for step in STEPS[2:4]
    },
}

PEERS: dict[str, Setting] = {
    **{f"{VTK}, step {step:g}": Setting(VTK, partial(by_vtk, step), peer) for step in STEPS[1:]},
    **{
        f"{DRJIT}, {q}, step {step:g}": Setting(DRJIT, partial(by_drjit, q, step), unlit_peer)
        for q in ("left", "midpoint")
        for step in STEPS[1:]
    },
}

SETTINGS: dict[str, Setting] = {**UNLIT, **LIT, **SHADED, **SURFACE, **BRICKS, **PEERS}

GRADIENTS = (
    "midpoint, step 0.5",
    BASE,
    "midpoint, step 2",
    "left, step 1",
    "preintegrated, step 1",
    "adaptive, tolerance 0.01",
    "not aligned, step 1",
    "no leaping, step 1",
    "empty-space jittered, step 1",
    "ending at 0.01",
    f"ending at {1 / 255:g}",
)
"""At which gradients are compared."""


def of(row: Row, there: dict[str, str]) -> dict[str, Setting]:
    """The settings of a scene, its base first; `there`: version of each peer, or why it is missing."""
    found = {name: setting for name, setting in SETTINGS.items() if setting.where(row)}
    present = {n: s for n, s in found.items() if is_here(there, s.family)}
    base = base_of(row)
    return {base: present[base], **present}


def base_of(row: Row) -> str:
    """Name of the setting that all others of the scene are timed against."""
    if row.surface:
        return SURFACE_BASE
    if row.bricks:
        return WHOLE_BASE
    return SHADED_BASE if row.shaded else LIT_BASE if row.lit else BASE


def few(settings: dict[str, Setting], count: int = 2) -> dict[str, Setting]:
    """The first settings of each family."""
    families: dict[str, list[str]] = {}
    for name, setting in settings.items():
        families.setdefault(setting.family, []).append(name)
    return {n: settings[n] for names in families.values() for n in names[:count]}
