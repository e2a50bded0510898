"""Which scenes does `pareto` chart? One row each: what it shows, from where, on which grid, in what light.

Lengths of steps are counted in voxels; in a toroidal scan, whose voxels are longer across beams than along
them, in twice the distance between the samples of a beam.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol.lighting import ConstantLight, DirectionalLight, Lighting, Phong, ScattererTemplates
from jaxvol.march.march import Quadrature

from . import peer_vtk, scenes
from .accuracy import peaked
from .adaptive_error import inside
from .lighting import FLESH, LIGHTS
from .scenes import PHANTOM, SCENES, Scene


class Case(NamedTuple):
    """A scene, the transforms without which it cannot be rendered, its light, and its compositing mode.

    `lighting` makes the light: templates from the options of `ScattererTemplates`, or without options
    `Phong`; None where the scene is unlit.
    """

    scene: Scene
    placed: tuple[jv.Transform, ...] = ()
    lighting: Callable[..., Lighting] | None = None
    compositing: Any = "over"


class Row(NamedTuple):
    """A scene of the chart.

    - `make`: from the folder of real volumes, the pixels along a side, and the voxels along an axis of a
      phantom.
    - `file`: the real volume, None for a phantom.
    - `peers`: None, or why VTK and Dr.Jit are left out.
    - `bricks`: whether it is rendered whole and in bricks, and not by all other settings.
    - `lit`: whether there is light; `shaded`: whether it is `Phong`'s; `surface`: whether an isosurface is
      shown.
    - `gradients`: whether gradients are measured, too.
    - `finer`, `quadrature`: of the converged image, into how many parts it divides a step, and its rule.
    - `part`: of the image's side, where frames take longer.
    """

    make: Callable[[Path | None, int, int], Case]
    file: str | None = None
    view: Literal["outside", "inside"] = "outside"
    look: Literal["translucent", "opaque", "thin peak"] = "translucent"
    peers: str | None = None
    toroidal: bool = False
    bricks: bool = False
    lit: bool = False
    shaded: bool = False
    surface: bool = False
    gradients: bool = False
    finer: int = 16
    quadrature: Quadrature = "midpoint"
    part: float = 1.0

    @property
    def noisy(self) -> bool:
        """Whether its light is made of templates, which are random."""
        return self.lit and not self.shaded and not self.surface


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


def fetus(folder: Path | None, size: int, resolution: int) -> Case:
    shape = resolution // 3, resolution // 2, resolution
    volume, probe = jv.toroidal_phantom("fetus", shape)
    transfer = jv.TransferFunction.from_points(
        [(50, (0.1, 0.04, 0.03), 0.0), (90, (0.8, 0.5, 0.35), 0.1), (170, (1.0, 0.9, 0.8), 0.5)]
    )
    camera = jv.Camera((60, -150, -110), (0, 0, 95), (1, 0, 0), 30.0, size=(size, size))
    return Case(Scene(volume, transfer, camera, 2 * 100 / (resolution - 1)), (probe,))


def shells(folder: Path | None, size: int, resolution: int) -> Case:
    """A real convex scan of reverberation; its file has the beam's samples first. The angle of elevation is
    taken as the whole one."""
    assert folder is not None
    data = np.asarray(jv.load(folder / SHELLS).data)
    volume = jv.Volume(np.ascontiguousarray(data.transpose(2, 1, 0)))
    azimuth, elevation, span = np.deg2rad(38.55), np.deg2rad(54.45) / 2, 69.58
    beta, sigma = ((np.pi / 2 - half, np.pi / 2 + half) for half in (elevation, azimuth))
    probe = jv.ToroidalMap(22.70 - 52.70, 52.70, beta, sigma, (0, span))
    camera = jv.Camera((100, -180, -60), probe.center, (0, 0, -1), 30.0, size=(size, size))
    transfer = jv.colormap("gray", (60, 200), (0.0, 0.5))
    return Case(Scene(volume, transfer, camera, 2 * span / (data.shape[0] - 1)), (probe,))


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


ENGINE, BONSAI, AIRWAY, ANEURISM, SHELLS = (
    "engine_256x256x128_uint8.raw.gz",
    "bonsai_256x256x256_uint8.raw.gz",
    "lidc0314_airway_256x192x200_int16le.raw.gz",
    "aneurism_256x256x256_uint8.raw.gz",
    "us_aplio_convex_239x128x91_uint8.raw.gz",
)

PEAK: Any = {"finer": 32, "quadrature": "preintegrated"}
"""By the midpoint rule, such an image would err by 0.003 to 0.005."""

ROWS: dict[str, Row] = {
    PHANTOM: Row(head, gradients=True),
    f"{PHANTOM}, inside": Row(partial(within, head), view="inside"),
    f"{PHANTOM}, opaque": Row(skin, look="opaque"),
    f"{PHANTOM}, thin peak": Row(partial(thin, head), look="thin peak", **PEAK),
    "engine": Row(partial(real, "engine"), ENGINE, gradients=True),
    "engine, thin peak": Row(partial(thin, partial(real, "engine")), ENGINE, look="thin peak", **PEAK),
    "bonsai": Row(partial(real, "bonsai"), BONSAI),
    "bonsai, inside": Row(partial(within, partial(real, "bonsai")), BONSAI, view="inside"),
    "lidc0314_airway": Row(partial(real, "lidc0314_airway"), AIRWAY),
    "lidc0314_airway, inside": Row(bronchi, AIRWAY, view="inside", look="opaque"),
    "aneurism": Row(partial(real, "aneurism"), ANEURISM),
    "fetus phantom": Row(fetus, peers=UNBENT, toroidal=True, finer=8, part=0.25),
    "us_aplio_convex": Row(shells, SHELLS, peers=UNBENT, toroidal=True, finer=8, part=0.25),
    f"{PHANTOM}, lit": Row(lit_head, look="opaque", peers=TEMPLATES, lit=True, finer=4, part=0.5),
    "engine, lit": Row(lit_engine, ENGINE, peers=TEMPLATES, lit=True, finer=4, part=0.25),
    "engine, shaded": Row(partial(shaded, "engine"), ENGINE, lit=True, shaded=True),
    "bonsai, shaded": Row(partial(shaded, "bonsai"), BONSAI, lit=True, shaded=True),
    "engine, cut": Row(cut, ENGINE, peers=WHOLE),
    "engine, in bricks": Row(partial(real, "engine"), ENGINE, peers=WHOLE, bricks=True),
    "engine, isosurface": Row(surface, ENGINE, peers=SURFACES, lit=True, surface=True),
}


def copied(volume: jv.Volume) -> jv.Volume:
    """The same volume in arrays of its own: what is computed once for each array of voxels, such as baked
    light, is then kept apart."""
    return jv.Volume(jnp.array(volume.data, copy=True), volume.spacing, volume.origin)
