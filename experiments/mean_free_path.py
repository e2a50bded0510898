"""Are mean free paths recovered from images, rendered with templates and path-traced?

Three balls of three materials, lit from the side, are rendered with scatterer templates. Starting three times
too long or too short, Levenberg–Marquardt fits the three mean free paths.

Then one ball at a time, with an optical thickness from far below 1 to far above, is rendered with templates
and by path tracing. Templates are on the scale of path tracing only approximately, and less so where objects
are thin and colours dark. So the brightness of the lights is fitted along with the mean free path, and the
error that remains is the bias of the model. This is done twice: with the extinction that the camera's rays
meet known, and with it following from the mean free path, as in the path tracer. Objects too small for their
mean free path leave it undetermined.
"""

from argparse import Namespace
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol.lighting import ConstantLight, DirectionalLight, ScattererTemplates

from . import charts
from .harness import experiment
from .scenes import grid, on_cube


GOAL = 0.01
STEPS = 40
OFF = (3.0, 1 / 3, 3.0)
COLOR = (0.8, 0.6, 0.5)
RADIUS = 0.7
THICKNESSES = (0.02, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
TEMPLATES, KNOWN, TIED = "templates", "extinction known", "extinction 1/λ"


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


def lights(brightness: Any = 1.0) -> tuple[Any, ...]:
    sun, sky = jnp.full(3, 2.0) * brightness, jnp.full(3, 0.15) * brightness
    return DirectionalLight((0.8, 0.5, -0.6), sun), ConstantLight(sky)


def templates(materials: Any, brightness: Any = 1.0) -> ScattererTemplates:
    how: dict[str, Any] = {"templates": 4, "photons": 12, "levels": 4, "reach": (2.0, 4.0)}
    return ScattererTemplates(materials, lights(brightness), **how)


def rendered(scene: tuple) -> jv.Rendering:
    return jv.render(*scene[:4], lighting=scene[4])


def marching(volume: jv.Volume) -> jv.March:
    return jv.March(float(volume.spacing.min()), (jv.AlphaCorrection(),), "midpoint")


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

    views = [(camera, rendered(scene(materials_of(truth), camera)).rgba) for camera in cameras(size)]
    start = materials_of([path * off for path, off in zip(truth, OFF, strict=True)])
    found = jv.fit(jv.ImageResidual(scene, views), start, max_steps=STEPS)
    ratios = [float(m.mean_free_path) / path for m, path in zip(found.parameters, truth, strict=True)]
    about = {"losses": found.losses.tolist(), "message": found.message}
    return {"truth": truth, "start": OFF, "found": ratios, **about}


def one_ball(thickness: float, volume: jv.Volume, chosen: Namespace) -> dict[str, Any]:
    """Fit one mean free path to renders with templates and path-traced ones."""
    march, values = marching(volume), np.array([60.0, 140.0, 255.0])
    path = 2 * RADIUS / thickness
    # with templates, the extinction that the camera sees is free to choose: here the true one, but enough to
    # be visible at all
    visible = max(1 / path, 2.0)

    def material(path: Any) -> jv.Material:
        return jv.Material(0.2, path, 1.0, values=(60, 256))

    def transfer(extinction: Any) -> jv.TransferFunction:
        there = jnp.array([0.0, 1.0, 1.0]) * extinction
        return jv.TransferFunction(values, np.broadcast_to(COLOR, (3, 3)), there)

    def scene(given: dict[str, Any], camera: jv.Camera) -> tuple:
        path = given["material"].mean_free_path
        extinction = given["tied"] / path + (1 - given["tied"]) * given["extinction"]
        return volume, transfer(extinction), camera, march, templates(given["material"], given["brightness"])

    def start(off: float, tied: float) -> dict[str, Any]:
        known = {"tied": jnp.float32(tied), "extinction": jnp.float32(visible)}
        return {"material": material(path * off), "brightness": jnp.float32(1.0), **known}

    own, traced = [], []
    for camera in cameras(chosen.size):
        own.append((camera, rendered(scene(start(1.0, 0.0), camera)).image((0, 0, 0))))
        how = {"paths": chosen.paths, "key": chosen.seed, "materials": material(path)}
        traced.append((camera, jv.path_trace(volume, transfer(1 / path), camera, lights(), **how).radiance))
    constraints = {
        "material": None,
        "brightness": jv.Positive(),
        "tied": jv.Fixed(),
        "extinction": jv.Fixed(),
    }
    row: dict[str, Any] = {"thickness": thickness}
    for name, views, tied in ((TEMPLATES, own, 0.0), (KNOWN, traced, 0.0), (TIED, traced, 1.0)):
        residual = jv.ImageResidual(scene, views, background=(0, 0, 0))
        found = jv.fit(residual, start(1 / 3, tied), constraints=constraints, max_steps=STEPS)
        assert found.uncertainty is not None
        errors = found.uncertainty.standard_errors
        row[name] = {
            "ratio": float(found.parameters["material"].mean_free_path) / path,
            "standard error": next(e for n, e in errors.items() if "mean_free_path" in n) / path,
            "brightness": float(found.parameters["brightness"]),
            "undetermined": found.uncertainty.undetermined,
            "loss": float(found.losses.min()),
            "message": found.message,
        }
    return row


def draw(result: dict[str, Any]) -> Any:
    figure, ((left, right),) = charts.panels(1, 2, 9, 3.8)
    losses = result["three materials"]["losses"]
    left.semilogy(range(1, len(losses) + 1), losses, "o-")
    left.set(xlabel="step of the fit", ylabel="mean squared difference of the images")
    left.set_title("λ of three materials, from starts 3 times off")
    rows = result["one ball"]
    for name, mark in ((TEMPLATES, "ko-"), (KNOWN, "C0s-"), (TIED, "C3^-")):
        known = [row for row in rows if not row[name]["undetermined"] and np.isfinite(row[name]["ratio"])]
        label = "from images by templates" if name == TEMPLATES else f"from path-traced images, {name}"
        right.loglog([r["thickness"] for r in known], [r[name]["ratio"] for r in known], mark, label=label)
    lost = [row["thickness"] for row in rows if row[TEMPLATES]["undetermined"]]
    label = "from images by templates: said to be undetermined"
    right.plot(lost, np.ones(len(lost)), "kx", markersize=9, label=label)
    right.axhline(1, color="k", linewidth=0.8)
    right.set(xlabel="optical thickness, diameter / λ", ylabel="λ found / λ true")
    right.set_title("λ of one ball, from two views")
    charts.legend_below(figure, right, 2)
    return figure


@experiment(
    size=32,
    resolution=32,
    paths=256,
    thicknesses=THICKNESSES,
    quick={"size": 10, "resolution": 12, "paths": 2, "thicknesses": (2.0,)},
)
def main(chosen: Namespace) -> dict[str, Any]:
    ball = balls(chosen.resolution, [(200, (0, 0, 0), RADIUS)])
    return {
        "goal": GOAL,
        "three materials": three_materials(chosen.size, chosen.resolution),
        "one ball": [one_ball(thickness, ball, chosen) for thickness in chosen.thicknesses],
    }
