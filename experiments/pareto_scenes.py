"""Which scenes does `pareto` chart? One row each: what it shows, from where, on which grid, in what light.

Lengths of steps are counted in voxels; in a toroidal scan, whose voxels are longer across beams than along
them, in twice the distance between the samples of a beam.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import jaxvol as jv
from jaxvol.lighting import ConstantLight, DirectionalLight, Phong, ScattererTemplates

from . import peer_vtk, scan_conversion
from .lighting import FLESH, LIGHTS
from .programs import Case, Quadrature
from .scenes import AIRWAY, ANEURISM, BONSAI, ENGINE, PHANTOM, SCENES, Scene, inside, peaked, skin_head


Kind: TypeAlias = Literal["unlit", "uniform", "lit", "shaded", "surface", "bricks"]
"""Of a scene: unlit, under all settings or with uniform steps only; lit by templates, shaded by `Phong`, an
isosurface, or rendered whole and in bricks."""

Make: TypeAlias = Callable[[Path | None, int, int], Case]
"""From the folder of real volumes, the pixels along a side, and the voxels along an axis of a phantom."""


class Row(NamedTuple):
    """A scene of the chart.

    Attributes:
        make: makes it.
        file: the real volume, None for a phantom.
        peers: None, or why VTK and Dr.Jit are left out.
        toroidal: whether it is a scan, as acquired.
        kind: which settings it is rendered under.
        finer: into how many parts the converged image divides a step.
        quadrature: of the converged image.
        part: of the image's side, where frames take longer.
    """

    make: Make
    file: str | None = None
    peers: str | None = None
    toroidal: bool = False
    kind: Kind = "unlit"
    finer: float = 16
    quadrature: Quadrature = "midpoint"
    part: float = 1.0


def of(name: str, *changes: Callable[[Scene], Scene], **how: Any) -> Make:
    """A scene, changed in turn; `how`: the rest of the case."""

    def make(folder: Path | None, size: int, resolution: int) -> Case:
        scene = SCENES[name](folder, size, resolution)
        for change in changes:
            scene = change(scene)
        return Case(scene, **how)

    return make


def thin(scene: Scene) -> Scene:
    """Under a narrow peak, as a table, so that all programs interpolate between the same values."""
    scene = peaked(scene)
    return scene._replace(transfer=peer_vtk.dense(scene.transfer, scene.volume))


def opaque_airway(scene: Scene) -> Scene:
    return scene._replace(transfer=jv.preset("ct_airway"))


def skin(folder: Path | None, size: int, resolution: int) -> Case:
    scene = skin_head(size, resolution)
    return Case(scene._replace(step=2 * scene.step))


def lit_head(folder: Path | None, size: int, resolution: int) -> Case:
    templates = partial(ScattererTemplates, FLESH, LIGHTS)
    return skin(folder, size, resolution // 2)._replace(lighting=templates)


def scan(name: str) -> Make:
    """Ultrasound as acquired."""

    def make(folder: Path | None, size: int, resolution: int) -> Case:
        scene = scan_conversion.SCENES[name](folder, size, resolution)
        return Case(Scene(scene.volume, scene.transfer, scene.camera, 2 * scene.sample), (scene.probe,))

    return make


def cut(folder: Path | None, size: int, resolution: int) -> Case:
    """The engine, cut obliquely through its middle."""
    scene = SCENES["engine"](folder, size)
    return Case(scene, (jv.Clip(planes=((scene.volume.center, (0.6, -0.9, -0.5)),)),))


ABOVE = DirectionalLight((0.9, 0.7, 0.6), (12.0, 12.0, 12.0)), ConstantLight((1.0, 1.0, 1.0))
"""From the left and from above, which is -z in the engine."""
IN_ENGINE = partial(ScattererTemplates, jv.Material(0.5, 4.0, 1.4), ABOVE)
"""A mean free path of four voxels."""

PEAK: Any = {"finer": 32, "quadrature": "preintegrated"}
"""By the midpoint rule, such an image would err by 0.003 to 0.005."""
UNBENT = "the ray casters of VTK and Dr.Jit that are compared here have no toroidal grids"
SCAN: Any = {"peers": UNBENT, "toroidal": True, "finer": 8, "part": 0.25}
LIT: Any = {"peers": "VTK and Dr.Jit have no templates of light", "kind": "lit", "finer": 4}
WHOLE = "VTK and Dr.Jit are compared on whole volumes"
LARGE: Any = {"kind": "uniform", "part": 2.0}
SURFACES = "VTK and Dr.Jit are compared where samples are composited"

ROWS: dict[str, Row] = {
    PHANTOM: Row(of(PHANTOM)),
    f"{PHANTOM}, inside": Row(of(PHANTOM, inside)),
    f"{PHANTOM}, opaque": Row(skin),
    f"{PHANTOM}, thin peak": Row(of(PHANTOM, thin), **PEAK),
    "engine": Row(of("engine"), ENGINE),
    "engine, thin peak": Row(of("engine", thin), ENGINE, **PEAK),
    "bonsai": Row(of("bonsai"), BONSAI),
    "bonsai, inside": Row(of("bonsai", inside), BONSAI),
    "lidc0314_airway": Row(of("lidc0314_airway"), AIRWAY),
    "lidc0314_airway, inside": Row(of("lidc0314_airway", opaque_airway, inside), AIRWAY),
    "aneurism": Row(of("aneurism"), ANEURISM),
    f"{PHANTOM}, large": Row(of(PHANTOM), **LARGE),
    "engine, large": Row(of("engine"), ENGINE, **LARGE),
    "bonsai, large": Row(of("bonsai"), BONSAI, **LARGE),
    "lidc0314_airway, large": Row(of("lidc0314_airway"), AIRWAY, **LARGE),
    "aneurism, large": Row(of("aneurism"), ANEURISM, **LARGE),
    "fetus phantom": Row(scan("fetus phantom"), **SCAN),
    "us_aplio_convex": Row(scan("us_aplio_convex"), scan_conversion.APLIO, **SCAN),
    f"{PHANTOM}, lit": Row(lit_head, part=0.5, **LIT),
    "engine, lit": Row(of("engine", lighting=IN_ENGINE), ENGINE, part=0.25, **LIT),
    "engine, shaded": Row(of("engine", lighting=Phong), ENGINE, kind="shaded"),
    "bonsai, shaded": Row(of("bonsai", lighting=Phong), BONSAI, kind="shaded"),
    "engine, cut": Row(cut, ENGINE, peers=WHOLE),
    "engine, in bricks": Row(of("engine"), ENGINE, peers=WHOLE, kind="bricks"),
    "engine, isosurface": Row(
        of("engine", lighting=Phong, compositing=jv.Isosurface(100)), ENGINE, peers=SURFACES, kind="surface"
    ),
}
