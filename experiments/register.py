"""From how far off is the pose of an X-ray image found, and how fast are image and gradient beside DiffDRR's?

A frontal X-ray image of a real head (CT, 256 x 256 x 113 voxels of 1 x 1 x 2 mm) is made from its line
integrals, with the noise of 100,000 photons a pixel. Registration begins at 100 cameras turned by 10° to 20°
about the head's center and moved by up to 30 mm, in random directions, and at 30 more that are turned by up
to 90° and moved by up to 100 mm, to see where capture ends. A start is captured if it ends within 0.5° and
2 mm of the truth; a single image tells the distance along its own rays the least.

DiffDRR renders the same image by both of its methods, in turn with jaxvol; the gradient is that of the mean
square by the six numbers of a motion. Its voxels are cells around the nodes, so that its volume ends half a
voxel beyond the outer nodes, where ours ends at them: the images differ where a face cuts tissue, as below
this head, and so a layer of air is put around for one of the comparisons. Gradients are those of each
program's own samples, and differ by more than the images. `DIFFDRR_PYTHON` names the interpreter of an
environment that has it (`pip install diffdrr`); without, it is left out.
"""

import ast
import math
import os
import tempfile
import time
from argparse import Namespace
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxvol as jv

from . import charts, harness, timing
from .harness import experiment
from .peer_diffdrr import Peer
from .scenes import CT_HEAD


AIR = -1000
"""Hounsfield units."""
WATER = 0.02
"""Attenuation of water, 1/mm."""
AWAY, FIELD = 1000.0, 300.0
"""Distance of the source from the center, and height of what is seen there, mm."""
PHOTONS = 1e5
GOALS = {"degrees": 0.5, "mm": 2.0}
NEAR, FAR = "10° to 20°, up to 30 mm", "up to 90°, up to 100 mm"
RANGES = {NEAR: ((10, 20), (0, 30)), FAR: ((0, 90), (0, 100))}


def head(resolution: int) -> jv.Volume:
    """The CT in Hounsfield units, and without it the phantom, 200 mm wide."""
    if (folder := harness.data()) is not None and resolution == 0:
        stored = jv.load(folder / CT_HEAD, spacing=(1, 1, 2))
        return jv.Volume(np.asarray(stored.data).astype(np.int16) + AIR, stored.spacing)
    n = resolution or 96
    return jv.Volume(np.asarray(jv.phantom("head", n).data) * 10.0 + AIR, (200 / n,) * 3)


def source(volume: jv.Volume, size: int) -> jv.Camera:
    """The camera in the X-ray's source, in front of the head."""
    center = np.asarray(volume.center)
    angle = 2 * np.rad2deg(np.arctan(FIELD / 2 / AWAY))
    return jv.Camera(center - [0, AWAY, 0], center, (0, 0, -1), angle, size=(size, size))


def integrals(volume: jv.Volume, camera: jv.Camera) -> jax.Array:
    march = jv.March(jnp.min(volume.spacing), (jv.AlphaCorrection(),), "midpoint")
    how: Any = {"compositing": "integral", "outputs": "rgba"}
    return jv.render(volume, jv.attenuation(WATER), camera, march, **how).rgba[..., 0]


def drawn(rng: np.random.Generator, n: int, low: float, high: float) -> np.ndarray:
    """Vectors of random directions, whose lengths are evenly distributed."""
    vectors = rng.normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True) * rng.uniform(low, high, (n, 1))


def errors(motions: jv.RigidMotion) -> dict[str, np.ndarray]:
    """Of cameras whose true motion is none."""
    of = np.rad2deg(np.asarray(motions.rotation)), np.asarray(motions.translation)
    return {k: np.linalg.norm(v, axis=1).round(5) for k, v in zip(GOALS, of, strict=True)}


def capture(volume: jv.Volume, camera: jv.Camera, counts: dict[str, int], rng: Any) -> dict[str, Any]:
    """Where starts of all ranges end, by one call."""
    integral = np.asarray(integrals(volume, camera), np.float64)
    image = -np.log(np.maximum(rng.poisson(PHOTONS * np.exp(-integral)), 1) / PHOTONS)
    each = [[drawn(rng, n, *ends) for ends in RANGES[name]] for name, n in counts.items()]
    turns, shifts = (np.concatenate(vectors) for vectors in zip(*each, strict=True))
    starts = jv.RigidMotion(np.deg2rad(turns), shifts, volume.center)
    begun = time.monotonic()
    found = jv.register(volume, jv.attenuation(WATER), [(camera, image)], starts)
    result: dict[str, Any] = {"seconds of all starts, compilation included": round(time.monotonic() - begun)}
    similar, owners = found.similarities[:, 1], np.repeat(list(counts), list(counts.values()))
    for name in counts:
        before, after = ({k: v[owners == name] for k, v in errors(m).items()} for m in found[3:5])
        medians = ((f"{k}, median of these", v) for k, v in after.items())
        inside = np.all([after[key] <= goal for key, goal in GOALS.items()], axis=0)
        result[name] = {
            "captured": float(np.mean(inside)),
            **{key: float(np.median(v[inside])) for key, v in medians if inside.any()},
            "least similar of these": float(similar[owners == name][inside].min(initial=1)),
            "most similar of the others": float(similar[owners == name][~inside].max(initial=-1)),
            "before": [{k: v.tolist() for k, v in before.items()}],
            "after": [{k: v.tolist() for k, v in after.items()}],
        }
    return result


def beside(python: str, volume: jv.Volume, camera: jv.Camera, repetitions: int) -> dict[str, Any]:
    """Times and images of jaxvol and DiffDRR. All pass the scene in the same way."""
    padded = jv.Volume(
        np.pad(np.asarray(volume.data), 1, constant_values=AIR),
        volume.spacing,
        volume.origin - volume.spacing,
    )
    of_image = eqx.filter_jit(integrals)

    @eqx.filter_jit
    def of_gradient(volume: jv.Volume, motion: jv.RigidMotion) -> Any:
        def loss(turn: Any, shift: Any) -> jax.Array:
            moved = jv.RigidMotion(turn, shift, motion.center).camera(camera)
            return jnp.mean(integrals(volume, moved) ** 2)

        return jax.value_and_grad(loss, (0, 1))(motion.rotation, motion.translation)

    still = jv.RigidMotion(jnp.zeros(3), jnp.zeros(3), camera.position)
    result: dict[str, Any] = {}
    for name, each in (("as it is", volume), ("air around", padded)):
        forward, up = np.array([0, 1.0, 0]), np.array([0, 0, -1.0])
        scene = {
            "density": np.maximum(0, WATER * (1 + np.asarray(each.data, np.float32) / 1000)),
            "spacing": np.asarray(each.spacing),
            "origin": np.asarray(each.origin),
            "axes": np.stack([np.cross(forward, up), up, forward], axis=1),
            "position": np.asarray(camera.position),
            "distance": AWAY,
            "slope": FIELD / AWAY / camera.size[1],
            "pixels": camera.size[1],
        }
        with tempfile.TemporaryDirectory() as folder:
            peer = Peer(python, Path(folder), scene)
            ours, own = np.asarray(of_image(each, camera)), np.concatenate(of_gradient(each, still)[1])
            rows: dict[str, Any] = {"greatest": float(ours.max())}
            for method in ("siddon", "trilinear"):
                away = peer.image(method) - ours
                gradient = np.array(ast.literal_eval(peer.ask(f"gradient {method}")))
                rows[method] = {
                    "largest difference": float(np.abs(away).max()),
                    "rms difference": float(np.sqrt(np.mean(away**2))),
                    "gradient apart, relative": float(np.linalg.norm(gradient - own) / np.linalg.norm(own)),
                }
            result[name] = rows
            if name == "as it is":
                programs: dict[str, Any] = {
                    "jaxvol, image": lambda: of_image(volume, camera),
                    "jaxvol, gradient": lambda: of_gradient(volume, still),
                }
                for method in ("siddon", "trilinear"):
                    for kind in ("image", "gradient"):
                        programs[f"{method}, {kind}"] = partial(peer.ask, f"{kind} {method}")
                seconds = timing.interleaved(programs, repetitions)
                result["seconds"] = {key: timing.median(runs) for key, runs in seconds.items()}
                result["ratios"] = {
                    key: timing.ratio(runs, seconds[f"jaxvol, {key.split()[-1]}"])
                    for key, runs in seconds.items()
                    if not key.startswith("jaxvol")
                }
                result["version"] = peer.version
            peer.close()
    return result


def draw(result: dict[str, Any]) -> Any:
    figure, (panels,) = charts.panels(1, 3, 12, 3.8)
    for name, color in zip(RANGES, ("C0", "C3"), strict=True):
        found = result["starts"][name]
        (before,), (after,) = found["before"], found["after"]
        for panel, key in zip(panels, GOALS, strict=False):
            panel.semilogy(before[key], np.maximum(after[key], 1e-3), "o", color=color, alpha=0.6, label=name)
    for panel, (key, goal) in zip(panels, GOALS.items(), strict=False):
        panel.axhline(goal, color="k", linestyle=":", linewidth=0.8)
        panel.set(xlabel=f"{key} off at the start", ylabel=f"{key} off at the end")
    shares = [f"{name}: {result['starts'][name]['captured']:.0%} captured" for name in RANGES]
    panels[0].set_title("\n".join(shares))
    panels[1].set_title("dotted: what counts as captured")
    charts.legend_below(figure, panels[0], 2)
    if "seconds" in result["diffdrr"]:
        names, seconds = zip(*result["diffdrr"]["seconds"].items(), strict=True)
        panels[2].barh(names, seconds, color=["C0" if n.startswith("jaxvol") else "0.6" for n in names])
        panels[2].set(xscale="log", xlabel=f"seconds, {result['pixels']}² pixels")
        panels[2].set_title("beside DiffDRR (grey)")
        panels[2].invert_yaxis()
    else:
        panels[2].set_axis_off()
    return figure


@experiment(
    size=128,
    resolution={"type": int, "default": 0, "help": "voxels of the phantom; 0: the CT in JAXVOL_DATA"},
    starts=100,
    repetitions=9,
    quick={"size": 32, "resolution": 24, "starts": 2},
)
def main(chosen: Namespace) -> dict[str, Any]:
    volume = head(chosen.resolution)
    camera, rng = source(volume, chosen.size), np.random.default_rng(chosen.seed)
    python = None if chosen.quick else os.environ.get("DIFFDRR_PYTHON")
    peer: dict[str, Any] = {"left out": "DIFFDRR_PYTHON is not set"}
    if python is not None:
        peer = beside(python, volume, camera, chosen.repetitions)
    counts = {NEAR: chosen.starts, FAR: math.ceil(0.3 * chosen.starts)}
    starts = capture(volume, camera, counts, rng)
    return {"pixels": chosen.size, "goals": GOALS, "starts": starts, "diffdrr": peer}
