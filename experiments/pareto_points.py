"""Which settings of which methods are charted by `pareto`? One entry each, by name: how its program is made.

Each method has its own sweep around one base: the midpoint rule at steps of one voxel, cells cut at the exit
(`AlphaCorrection`), space leaping by the hierarchy, and rays that end at a transmittance of 1e-4. In a lit
scene the base is lit once per ray, by one template of eight photons.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import jaxvol as jv
from jaxvol.lighting import Deferred, Lighting
from jaxvol.march import Quadrature

from . import accuracy, peer_vtk
from .accuracy import DRJIT, FINEST_OF, LEFT, LONGEST, QUADRATURES, VTK
from .pareto_scenes import Case, Row, copied
from .speed import THREADS


STEPS = (0.25, 0.5, 1.0, 2.0, 4.0)
BASE = "midpoint, step 1"
LIT_BASE = "lit, midpoint, step 1"
PHOTONS = 8

Image = Float[np.ndarray, "height width 3"]


class Program(NamedTuple):
    """A setting in a scene, ready to run.

    - `draw`: renders a frame; this is what is timed.
    - `image`: the frame, linear RGB over white.
    - `seen`: the converged image as this program's display would show it.
    - `of_transfer`: the frame's premultiplied RGBA, as a function of the transfer function; None where it
      cannot be differentiated.
    """

    draw: Callable[[], Any]
    image: Callable[[], Image]
    seen: Callable[[Image], Image] = lambda truth: truth
    of_transfer: Callable[[jv.TransferFunction], jax.Array] | None = None


def unlit(row: Row) -> bool:
    return not row.lit


class Setting(NamedTuple):
    """A point of the chart: the method whose sweep it belongs to, and how its program is made.

    `where`: of which scenes.
    """

    family: str
    make: Callable[[Case], Program]
    where: Callable[[Row], bool] = unlit


def program(case: Case, march: jv.March, lighting: Lighting | None = None) -> Program:
    volume, transfer, camera, _ = case.scene

    def render(transfer: jv.TransferFunction) -> jv.Rendering:
        return jv.render(volume, transfer, camera, march, lighting=lighting, outputs="rgba")

    def image() -> np.ndarray:
        rendering = render(transfer)
        assert not np.any(rendering.exhausted)
        return np.asarray(rendering.image())

    return Program(lambda: render(transfer).rgba, image, of_transfer=lambda t: render(t).rgba)


def ours(
    *transforms: jv.Transform,
    step: float = 1.0,
    quadrature: Quadrature = "midpoint",
    without: tuple[type[jv.Transform], ...] = (),
    changed: Callable[[Case], Case] = lambda case: case,
    lighting: Callable[[Case], Lighting] | None = None,
) -> Callable[[Case], Program]:
    """The base with what differs: transforms in the place of those of their kind or added, kinds that are
    left out, a changed volume or transfer function, a light."""
    base = jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination(LEFT)
    left_out = {*without, *map(type, transforms)}
    kept = (*transforms, *(t for t in base if type(t) not in left_out))

    def make(case: Case) -> Program:
        case = changed(case)
        march = jv.March(step * case.scene.step, (*case.placed, *kept), quadrature)
        return program(case, march, None if lighting is None else lighting(case))

    return make


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


def by_vtk(step: float, case: Case) -> Program:
    volume, transfer, camera, voxel = case.scene
    drawn = peer_vtk.prepare(volume, transfer, camera, step * voxel, THREADS)
    return Program(drawn.draw, drawn.image, lambda truth: peer_vtk.as_displayed(truth, drawn.mapper))


def by_drjit(quadrature: Literal["left", "midpoint"], step: float, case: Case) -> Program:
    marcher = accuracy.drjit(case.scene, quadrature, step)

    def image() -> np.ndarray:
        rgba = marcher.rgba()
        return rgba[..., :3] + 1 - rgba[..., 3:]

    return Program(marcher.draw, image)


def templates(case: Case, **how: Any) -> Any:
    assert case.lighting is not None
    return case.lighting(**how)


def deferred(case: Case, **how: Any) -> Lighting:
    return Deferred(templates(case, **how))


def lit(family: str, *transforms: Any, by: Callable[..., Lighting] = templates, **how: Any) -> Setting:
    """A setting of light; `step` and `quadrature` are the march's, all else the templates'."""
    march: dict[str, Any] = {name: how.pop(name) for name in ("step", "quadrature") if name in how}

    def keep(case: Case) -> Case:  # a volume keeps one baked light only
        return case._replace(scene=case.scene._replace(volume=copied(case.scene.volume)))

    if "baked" in how:
        march["changed"] = keep
    made = ours(*transforms, lighting=partial(by, **how), **march)
    return Setting(family, made, lambda row: row.lit)


def straight(row: Row) -> bool:
    """Where frames are fast enough for all settings: each ray of a toroidal scan is bent sample by sample."""
    return not row.lit and not row.toroidal


def peer(row: Row) -> bool:
    return row.peers is None


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
    **{
        f"adaptive, tolerance {t:g}": Setting("adaptive", ours(jv.AdaptiveSampling(t, LONGEST, finest)))
        for t, finest in FINEST_OF.items()
    },
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

PEERS: dict[str, Setting] = {
    **{f"{VTK}, step {step:g}": Setting(VTK, partial(by_vtk, step), peer) for step in STEPS[1:]},
    **{
        f"{DRJIT}, {q}, step {step:g}": Setting(DRJIT, partial(by_drjit, q, step), peer)
        for q in ("left", "midpoint")
        for step in STEPS[1:]
    },
}

SETTINGS: dict[str, Setting] = {**UNLIT, **LIT, **PEERS}

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
    present = {n: s for n, s in found.items() if not there.get(s.family, "").startswith("not here")}
    base = base_of(row)
    return {base: present[base], **present}


def base_of(row: Row) -> str:
    """Name of the setting that all others of the scene are timed against."""
    return LIT_BASE if row.lit else BASE
