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

from . import peer_vtk, scan_conversion, scenes
from .lighting import FLESH, LIGHTS
from .programs import Case, Quadrature
from .scenes import PHANTOM, SCENES, Scene, inside, peaked


Kind: TypeAlias = Literal["unlit", "lit", "shaded", "surface", "bricks"]
"""Of a scene: what is lit by templates, shaded by `Phong`, an isosurface, or rendered whole and in bricks."""


class Row(NamedTuple):
    """A scene of the chart.

    - `make`: from the folder of real volumes, the pixels along a side, and the voxels along an axis of a
      phantom.
    - `file`: the real volume, None for a phantom.
    - `peers`: None, or why VTK and Dr.Jit are left out.
    - `kind`: which settings it is rendered under.
    - `finer`, `quadrature`: of the converged image, into how many parts it divides a step, and its rule.
    - `part`: of the image's side, where frames take longer.
    """

    make: Callable[[Path | None, int, int], Case]
    file: str | None = None
    view: Literal["outside", "inside"] = "outside"
    look: Literal["translucent", "opaque", "thin peak"] = "translucent"
    peers: str | None = None
    toroidal: bool = False
    kind: Kind = "unlit"
    finer: int = 16
    quadrature: Quadrature = "midpoint"
    part: float = 1.0

    @property
    def lit(self) -> bool:
        return self.kind in ("lit", "shaded", "surface")


UNBENT = "the ray casters of VTK and Dr.Jit that are compared here have no toroidal grids"
TEMPLATES = "VTK and Dr.Jit have no templates of light"
SURFACES = "VTK and Dr.Jit are compared where samples are composited"
WHOLE = "VTK and Dr.Jit are compared on whole volumes"


def real(name: str, folder: Path | None, size: int, resolution: int) -> Case:
    return Case(SCENES[name](folder, size))


def head(folder: Path | None, size: int, resolution: int) -> Case:
    return Case(scenes.head(folder, size, resolution))


def skin(folder: Path | None, size: int, resolution: int) -> Case:
    scene = scenes.skin_head(size, resolution)
    return Case(scene._replace(step=2 * scene.step))


def within(
    make: Callable[[Path | None, int, int], Case], folder: Path | None, size: int, resolution: int
) -> Case:
    """The same scene, seen from its widest empty place."""
    return Case(inside(make(folder, size, resolution).scene, size))


def thin(
    make: Callable[[Path | None, int, int], Case], folder: Path | None, size: int, resolution: int
) -> Case:
    """The same scene under a narrow peak, as a table, so that all programs interpolate between the same
    values."""
    scene = peaked(make(folder, size, resolution).scene)
    return Case(scene._replace(transfer=peer_vtk.dense(scene.transfer, scene.volume)))


def bronchi(folder: Path | None, size: int, resolution: int) -> Case:
    """The chest CT from inside an airway, whose walls are opaque."""
    scene = real("lidc0314_airway", folder, size, resolution).scene
    return Case(inside(scene._replace(transfer=jv.preset("ct_airway")), size))


def scan(name: str, folder: Path | None, size: int, resolution: int) -> Case:
    """Ultrasound as acquired."""
    scene = scan_conversion.SCENES[name](folder, size, resolution)
    return Case(Scene(scene.volume, scene.transfer, scene.camera, 2 * scene.sample), (scene.probe,))


def lit_head(folder: Path | None, size: int, resolution: int) -> Case:
    case = skin(folder, size, resolution // 2)
    return case._replace(lighting=partial(ScattererTemplates, FLESH, LIGHTS))


def lit_engine(folder: Path | None, size: int, resolution: int) -> Case:
    """A mean free path of four voxels; lit from the left and from above, which is -z here."""
    case = real("engine", folder, size, resolution)
    lights = DirectionalLight((0.9, 0.7, 0.6), (12.0, 12.0, 12.0)), ConstantLight((1.0, 1.0, 1.0))
    return case._replace(lighting=partial(ScattererTemplates, jv.Material(0.5, 4.0, 1.4), lights))


def shaded(name: str, folder: Path | None, size: int, resolution: int) -> Case:
    return real(name, folder, size, resolution)._replace(lighting=Phong)


def cut(folder: Path | None, size: int, resolution: int) -> Case:
    """The engine, cut obliquely through its middle."""
    scene = real("engine", folder, size, resolution).scene
    plane = jv.Clip(planes=((scene.volume.center, (0.6, -0.9, -0.5)),))
    return Case(scene, (plane,))


def surface(folder: Path | None, size: int, resolution: int) -> Case:
    """An isosurface of the engine."""
    return shaded("engine", folder, size, resolution)._replace(compositing=jv.Isosurface(100))


ENGINE, BONSAI, AIRWAY, ANEURISM = (
    "engine_256x256x128_uint8.raw.gz",
    "bonsai_256x256x256_uint8.raw.gz",
    "lidc0314_airway_256x192x200_int16le.raw.gz",
    "aneurism_256x256x256_uint8.raw.gz",
)

PEAK: Any = {"finer": 32, "quadrature": "preintegrated"}
"""By the midpoint rule, such an image would err by 0.003 to 0.005."""

TOROIDAL: Any = {"peers": UNBENT, "toroidal": True, "finer": 8, "part": 0.25}

ROWS: dict[str, Row] = {
    PHANTOM: Row(head),
    f"{PHANTOM}, inside": Row(partial(within, head), view="inside"),
    f"{PHANTOM}, opaque": Row(skin, look="opaque"),
    f"{PHANTOM}, thin peak": Row(partial(thin, head), look="thin peak", **PEAK),
    "engine": Row(partial(real, "engine"), ENGINE),
    "engine, thin peak": Row(partial(thin, partial(real, "engine")), ENGINE, look="thin peak", **PEAK),
    "bonsai": Row(partial(real, "bonsai"), BONSAI),
    "bonsai, inside": Row(partial(within, partial(real, "bonsai")), BONSAI, view="inside"),
    "lidc0314_airway": Row(partial(real, "lidc0314_airway"), AIRWAY),
    "lidc0314_airway, inside": Row(bronchi, AIRWAY, view="inside", look="opaque"),
    "aneurism": Row(partial(real, "aneurism"), ANEURISM),
    "fetus phantom": Row(partial(scan, "fetus phantom"), **TOROIDAL),
    "us_aplio_convex": Row(partial(scan, "us_aplio_convex"), scan_conversion.APLIO, **TOROIDAL),
    f"{PHANTOM}, lit": Row(lit_head, look="opaque", peers=TEMPLATES, kind="lit", finer=4, part=0.5),
    "engine, lit": Row(lit_engine, ENGINE, peers=TEMPLATES, kind="lit", finer=4, part=0.25),
    "engine, shaded": Row(partial(shaded, "engine"), ENGINE, kind="shaded"),
    "bonsai, shaded": Row(partial(shaded, "bonsai"), BONSAI, kind="shaded"),
    "engine, cut": Row(cut, ENGINE, peers=WHOLE),
    "engine, in bricks": Row(partial(real, "engine"), ENGINE, peers=WHOLE, kind="bricks"),
    "engine, isosurface": Row(surface, ENGINE, peers=SURFACES, kind="surface"),
}
