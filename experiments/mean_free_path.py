"""Are mean free paths recovered from images, rendered with templates and path-traced?

From renders of templates: three balls of three materials, lit from the side. Starting three times too long or
too short, Levenberg–Marquardt fits the three mean free paths.

From path-traced views, whose noise is known: one ball, from half a mean free path thick to 32. All fits start
three times too short, and see two views. Three ways:

- templates by transport;
- the path tracer itself, with other paths in each step; and from where templates by transport end.

Each is repeated with other references, and other templates. A warning says where a model does not fit: then,
standard errors do not tell of its bias. Fits of published templates stalled: `mean_free_path_scan` scans.
"""

import time
import warnings
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol.fitting.uncertainty import MISFIT
from jaxvol.lighting import ConstantLight, DirectionalLight, ScattererTemplates
from jaxvol.path_tracing import PathTraced

from . import charts, harness
from .harness import experiment
from .scenes import grid, on_cube


GOAL = 0.01
STEPS = 40
OFF = (3.0, 1 / 3, 3.0)
COLOR = (0.8, 0.6, 0.5)
RADIUS = 0.7
THICKNESSES = ("0.5", "1", "2", "4", "8", "16", "32")
TRANSPORT = "templates by transport"
KNOWN, TIED = ", extinction known", ", extinction 1/λ"
PATHS, STAGES = "path tracer", "templates by transport, then path tracer"
MATERIALS = {
    "ball": (60.0, 256.0, COLOR, 2 * RADIUS, 0.2),
    "ball, opacity 50 %": (60.0, 256.0, COLOR, 2 * RADIUS, 0.5),
    "CT of a head": (500.0, 5000.0, COLOR, 0.3, 0.5),
}
"""Low and high value, colour, mean free path and opacity; balls are one mean free path thick."""
MARKS = {TRANSPORT + TIED: "C9^", PATHS: "C2o", STAGES: "ko"}
PER_PATH = 3
"""Nodes of templates by transport per mean free path of the ball, as long as there are few."""


def balls(resolution: int, parts: Sequence[tuple[float, tuple[float, float, float], float]]) -> jv.Volume:
    """Balls (value, centre, radius) in [-1, 1]³, with boundaries one voxel wide."""
    nodes = np.stack(grid(resolution), axis=-1)
    data = np.zeros(nodes.shape[:3])
    for value, center, radius in parts:
        inside = (radius - np.linalg.norm(nodes - center, axis=-1)) * (resolution - 1) / 2 + 0.5
        data = np.maximum(data, value * np.clip(inside, 0, 1))
    return on_cube(data.astype(np.uint8))


def cameras(size: int) -> list[jv.Camera]:
    positions = (0.0, -4.0, 1.0), (3.0, 2.5, 1.0)
    return [jv.Camera(position, (0, 0, 0), (0, 0, 1), 32, size=(size, size)) for position in positions]


def lights() -> tuple[Any, ...]:
    return DirectionalLight((0.8, 0.5, -0.6), (2.0, 2.0, 2.0)), ConstantLight((0.15, 0.15, 0.15))


def templates(materials: Any) -> ScattererTemplates:
    return ScattererTemplates(materials, lights(), templates=4, photons=12, levels=4, reach=(2.0, 4.0))


def marching(volume: jv.Volume, steps: int = 1) -> jv.March:
    """So many steps a voxel."""
    return jv.March(float(np.asarray(volume.spacing).min()) / steps, (jv.AlphaCorrection(),), "midpoint")


def three_materials(size: int, resolution: int) -> dict[str, Any]:
    """Fit the mean free paths of three materials to renders with templates."""
    parts = [(60, (-0.45, 0, -0.1), 0.4), (130, (0.4, 0.1, -0.2), 0.38), (210, (0.0, 0, 0.5), 0.36)]
    volume, truth = balls(resolution, parts), (0.08, 0.12, 0.16)
    march, colors = marching(volume), ((0.8, 0.4, 0.3), (0.5, 0.6, 0.3), (0.8, 0.8, 0.75))
    shown = [(value, color, 0.4) for (value, *_), color in zip(parts, colors, strict=True)]
    transfer = jv.TransferFunction.from_points([(20.0, colors[0], 0.0), *shown], unit_distance=0.1)

    def materials_of(paths: Sequence[float]) -> tuple[jv.Material, ...]:
        each = zip(paths, ((15, 90), (90, 170), (170, 256)), strict=True)
        return tuple(jv.Material(0.5, path, 1.4, values=values) for path, values in each)

    def scene(materials: Any, camera: jv.Camera) -> tuple:
        return volume, transfer, camera, march, templates(materials)

    def rendered(camera: jv.Camera) -> Any:
        *plain, lighting = scene(materials_of(truth), camera)
        return jv.render(*plain, lighting=lighting).rgba

    views = [(camera, rendered(camera)) for camera in cameras(size)]
    start = materials_of([path * off for path, off in zip(truth, OFF, strict=True)])
    found = jv.fit(jv.ImageResidual(scene, views), start, max_steps=STEPS)
    ratios = [float(m.mean_free_path) / path for m, path in zip(found.parameters, truth, strict=True)]
    about = {"losses": found.losses.tolist(), "message": found.message}
    return {"truth": truth, "start": OFF, "found": ratios, **about}


@dataclass(frozen=True, eq=False)
class Scene:
    """A volume of materials in steps of the transfer function, as templates and path tracing show it.

    Attributes:
        volume: what is shown.
        march: of templates, by short steps: paths have none.
        bounds: low and high value of each material.
        colors: of each material.
        nodes: of the grid of templates by transport.
        levels: of templates by transport, after which a hundredth of the light is left.
        seed: of the templates.
    """

    volume: jv.Volume
    march: jv.March
    bounds: Any
    colors: Any
    nodes: int
    levels: int
    seed: int

    def medium(self, given: dict[str, Any]) -> jv.TransferFunction:
        """What the camera's rays meet: the given extinction, or what follows from mean free paths."""
        own = 1 / jnp.stack([each.mean_free_path for each in given["materials"]])
        extinction = own * given["tied"] + given["extinction"] * (1 - given["tied"])
        # a step up to the first material, and steps from each to the next
        twice = (jnp.repeat(jnp.asarray(each), 2, axis=0) for each in (self.colors, extinction))
        values = jnp.ravel(self.bounds)
        pairs = ((values[:1], values), *((jnp.zeros_like(each[:1]), each) for each in twice))
        return jv.TransferFunction(*(jnp.concatenate(pair) for pair in pairs))

    def templates(self, given: dict[str, Any], camera: jv.Camera, **options: Any) -> tuple:
        lit = ScattererTemplates(given["materials"], lights(), seed=self.seed, **options)
        return self.volume, self.medium(given), camera, self.march, lit

    def transport(self, given: dict[str, Any], camera: jv.Camera) -> tuple:
        return self.templates(given, camera, form="transport", nodes=self.nodes, levels=self.levels)

    def traced(self, given: dict[str, Any], camera: jv.Camera) -> tuple:
        return self.volume, self.medium(given), camera, lights(), given["materials"]

    def views(self, truth: dict[str, Any], size: int, paths: int) -> list[tuple[jv.Camera, PathTraced]]:
        """Path-traced views; other paths for each seed."""
        found = []
        for at, camera in enumerate(cameras(size)):
            *plain, materials = self.traced(truth, camera)
            how = {"paths": paths, "key": 1000 + 10 * self.seed + at, "materials": materials}
            found.append((camera, jv.path_trace(*plain, **how)))
        return found


def scene_of(
    volume: jv.Volume, names: Sequence[str], nodes: int, seed: int, thickness: float = 1.0
) -> tuple[Scene, dict[str, Any]]:
    """The scene of a volume of these materials, with mean free paths so many times shorter, and its true
    parameters."""
    columns = zip(*(MATERIALS[name] for name in names), strict=True)
    low, high, colors, paths, opacities = map(np.array, columns)
    paths = paths / thickness
    albedo = np.max(np.max(colors, axis=1) * (1 - opacities))
    levels = int(np.ceil(np.log(0.01) / np.log(albedo)))
    bounds, march = np.stack([low, high], axis=1), marching(volume, 8)
    scene = Scene(volume, march, bounds, colors, nodes, levels, seed)
    each = zip(opacities, paths, low, high, strict=True)
    materials = tuple(jv.Material(a, path, values=(lo, hi)) for a, path, lo, hi in each)
    extinction = jnp.asarray(1 / paths, jnp.float32)
    return scene, {"materials": materials, "extinction": extinction, "tied": jnp.float32(1.0)}


def times(factor: float, given: dict[str, Any]) -> dict[str, Any]:
    """Parameters with mean free paths so many times as long."""
    return given | {
        "materials": tuple(
            eqx.tree_at(lambda m: m.mean_free_path, each, each.mean_free_path * factor)
            for each in given["materials"]
        )
    }


FIXED = {"materials": None, "extinction": jv.Fixed(), "tied": jv.Fixed()}


def told(found: jv.Fit, truth: dict[str, Any], start: dict[str, Any]) -> dict[str, Any]:
    """A row: what was found, over what is true; if the fit never left its start, it is no estimate."""
    assert found.uncertainty is not None
    true = [float(each.mean_free_path) for each in truth["materials"]]
    errors = [e for name, e in found.uncertainty.standard_errors.items() if "mean_free_path" in name]
    paths = [float(each.mean_free_path) for each in found.parameters["materials"]]
    first = [float(each.mean_free_path) for each in start["materials"]]
    return {
        "moved": paths != first,
        "ratio": [path / t for path, t in zip(paths, true, strict=True)],
        "standard error": [float(error) / t for error, t in zip(errors, true, strict=True)],
        "reduced chi-squared": float(found.uncertainty.reduced_chi_squared or 0),
        "steps": len(found.losses),
        "message": found.message,
    }


def from_paths(scene: Scene, truth: dict[str, Any], chosen: Namespace) -> dict[str, dict[str, Any]]:
    """Fit mean free paths to path-traced views, in all ways."""
    views = scene.views(truth, chosen.size, chosen.paths)
    transport = jv.ImageResidual(scene.transport, views, (0, 0, 0))
    paths = jv.PathTracedResidual(scene.traced, views, (0, 0, 0), paths=16, key=scene.seed)
    ways: list[tuple[Sequence[str], Sequence[Any]]] = [
        ([TRANSPORT + TIED, STAGES], [transport, paths]),
        ([PATHS], [paths]),
    ]
    rows: dict[str, dict[str, Any]] = {}
    for names, residuals in ways:
        start, begun = times(1 / 3, truth), time.perf_counter()
        how = {"constraints": FIXED, "max_steps": chosen.steps, "patience": 3, "rtol": 1e-3}
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            fits = []
            for residual in residuals:  # each from where the last one ended
                fits.append(jv.fit(residual, fits[-1].parameters if fits else start, **how))
        misfit = any(str(each.message).startswith(MISFIT) for each in caught)
        seconds = round(time.perf_counter() - begun, 1)
        for name, found in zip(names, fits, strict=True):
            # of several fits, the first one may warn, and the time is that of all
            last = {"warned of a misfit": misfit, "seconds": seconds} if found is fits[-1] else {}
            rows[name] = {**told(found, truth, start), **last}
            print(name, rows[name], flush=True)
    return rows


def balls_of(material: str, chosen: Namespace, seed: int) -> dict[str, tuple[Scene, dict[str, Any]]]:
    volume, found = balls(chosen.resolution, [(200, (0, 0, 0), RADIUS)]), {}
    same: dict[int, Scene] = {}  # programs are of a scene
    for name in chosen.thicknesses:
        wanted = 1 + float(name) * PER_PATH / RADIUS
        nodes = int(np.clip(np.ceil(wanted), chosen.nodes / 2, chosen.nodes))
        scene, truth = scene_of(volume, [material], nodes, seed, float(name))
        found[name] = same.setdefault(nodes, scene), truth
    return found


def draw(result: dict[str, Any]) -> Any:
    rows = result["path-traced views"]
    figure, ((panel,),) = charts.panels(1, 1, 6, 4.2)
    for n, (name, mark) in enumerate(MARKS.items()):
        fits = ((float(x), each[name]) for x, row in rows.items() for each in row["fits"].values())
        points = [(x * 1.04 ** (n - 1), fit["ratio"][0]) for x, fit in fits]
        panel.plot(*zip(*points, strict=True), mark, label=name, linestyle="none", alpha=0.7)
    panel.axhspan(0.95, 1.05, color="0.9", zorder=0)
    panel.axhline(1, color="k", linewidth=0.8)
    panel.set(ylabel="λ found / λ true", title="One ball")
    charts.numbered(panel, [float(x) for x in rows], list(rows))
    panel.set_xlabel("optical thickness, diameter / λ")
    charts.legend_below(figure, panel, 1)
    return figure


OPTIONS: dict[str, Any] = {
    "size": 24,
    "resolution": 32,
    "paths": 512,
    "nodes": {"type": int, "default": 64, "help": "most nodes of templates by transport, along an axis"},
    "steps": {"type": int, "default": 48, "help": "most steps of a fit"},
    "seeds": {"type": int, "default": 3, "help": "number of references of each scene, and of templates"},
}
QUICK = {"size": 8, "resolution": 8, "paths": 4, "nodes": 6, "steps": 2, "seeds": 1}


@experiment(
    **OPTIONS, thicknesses=harness.some_of(THICKNESSES, "THICKNESS"), quick=QUICK | {"thicknesses": ["2"]}
)
def main(chosen: Namespace) -> dict[str, Any]:
    rows: dict[str, dict[str, Any]] = {}
    for seed in range(chosen.seed, chosen.seed + chosen.seeds):
        for name, (scene, truth) in balls_of("ball", chosen, seed).items():
            print(f"{name}, seed {seed}", flush=True)
            fits = from_paths(scene, truth, chosen)
            rows.setdefault(name, {"nodes": scene.nodes, "fits": {}})["fits"][str(seed)] = fits
    own = three_materials(chosen.size, chosen.resolution)
    return {"goal": GOAL, "three materials": own, "path-traced views": rows}
