"""Does the gradient of the second march agree with forward mode, on real volumes, under every leaping method?

For each scene, method of `SpaceLeaping` and leaf, the gradient g by `adjoint="replay"` is compared with the
slopes of the same loss along directions d by `adjoint="forward"`, which is another program with another
differentiation rule. The result is the largest |g·d - slope| / |g| over unit directions d: all axes for a
leaf of at most 4 numbers; for larger leaves the direction of a gradient, and random ones. A second result is
the distance of g from the gradient without leaps; it leaves out "min_distance", which renders another image.
Extinctions of 0, whose gradient leaping leaves out by design, are excluded everywhere.

The loss is a weighted sum of all pixels' colour and opacity. The weights vary smoothly and at random, and for
each direction they have the sign of the pixel's derivative, so that nothing cancels. A gradient that is a
small difference of large sums, such as that of an unweighted sum of pixels by the direction of view (5 out of
2700), shows the rounding of these sums hundreds of times as large.

Everything is at its default and in float32, with early termination, both proposed methods of Kye 2013, and
volumes in the types of their files. Float voxels are a leaf of a second scene, the same volume in float32.

Real volumes are read from the folder that JAXVOL_DATA names; without one, only the phantom is measured.
"""

from argparse import Namespace
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import gaussian_filter

import jaxvol as jv

from . import common, marches
from .common import plt
from .scenes import PHANTOM, SCENES, Scene


METHODS = ("none", "hierarchy", "distance", "beam", "min_distance")
GOAL = 1e-4
FEW = 4
"""A leaf of at most this size is probed along each of its axes."""

LEAVES: dict[str, Callable[[Any], Any]] = {
    "colors": lambda s: s.transfer.colors,
    "extinction": lambda s: s.transfer.extinction,
    "position": lambda s: s.camera.position,
    "focal point": lambda s: s.camera.focal_point,
    "view up": lambda s: s.camera.view_up,
    "view angle": lambda s: s.camera.view_angle,
    "window": lambda s: s.camera.window,
    "spacing": lambda s: s.volume.spacing,
    "origin": lambda s: s.volume.origin,
    "step": lambda s: s.march.step,
}
VOXELS = {"voxels": lambda s: s.volume.data}


class Marched(eqx.Module):
    """What is rendered: a scene and its march."""

    volume: jv.Volume
    transfer: jv.TransferFunction
    camera: jv.Camera
    march: jv.March


def small(name: str) -> Callable[[Path, int], Scene]:
    """One of the smaller volumes of the Open SciVis collection; all but the darkest tenth of values is
    visible."""

    def scene(folder: Path, size: int) -> Scene:
        volume = jv.load(next(folder.glob(f"{name}_*")))
        camera = jv.Camera.looking_at(volume, (0.5, -1, 0.4), (0, 0, 1), size=(size, size)).zoom(1.3)
        points = [(25, (0.1, 0.2, 0.5), 0.0), (90, (0.7, 0.8, 0.3), 0.02), (255, (1.0, 0.9, 0.8), 0.4)]
        return Scene(volume, jv.TransferFunction.from_points(points), camera, 1.0)

    return scene


ALL = {**SCENES, **{name: small(name) for name in ("nucleon", "fuel", "tooth")}}


def marched(scene: Scene, method: str, seed: int) -> Marched:
    leaps = () if method == "none" else (jv.SpaceLeaping(method),)
    transforms = (*marches.transforms(marches.BOTH, seed), *leaps, jv.EarlyTermination(1 / 255))
    return Marched(scene.volume, scene.transfer, scene.camera, jv.March(scene.step, transforms))


class Probe(NamedTuple):
    """A unit direction in which to change a leaf, and pixel weights with which nothing cancels along it."""

    leaf: str
    direction: np.ndarray
    weights: np.ndarray


class Measured:
    """A scene under a method of leaping, differentiated with respect to some of its leaves: the gradient of a
    weighted sum of the image by replay, as a user takes it, and the image's tangent by forward mode."""

    def __init__(self, scene: Scene, method: str, leaves: dict[str, Callable[[Any], Any]], seed: int):
        whole = marched(scene, method, seed)
        mask = jax.tree.map(lambda _: False, whole)
        mask = eqx.tree_at(lambda s: [where(s) for where in leaves.values()], mask, [True] * len(leaves))
        self.leaves = leaves
        self.moving, fixed = eqx.partition(whole, mask)
        self.visible = np.asarray(scene.transfer.extinction) > 0

        def image(moving: Any, adjoint: str) -> Any:
            s = eqx.combine(moving, fixed)
            return jv.render(s.volume, s.transfer, s.camera, s.march, outputs="rgba", adjoint=adjoint).rgba

        self._grad = jax.grad(lambda moving, weights: jnp.vdot(image(moving, "replay"), weights))
        self._jvp = jax.jit(lambda x, along: jax.jvp(lambda x: image(x, "forward"), (x,), (along,))[1])

    def _counted(self, name: str, leaf: Any) -> np.ndarray:
        """A leaf, with 0 for what leaping leaves out."""
        return np.asarray(leaf, np.float64) * (self.visible if name == "extinction" else 1)

    def gradient(self, name: str, weights: np.ndarray) -> np.ndarray:
        found = self._grad(self.moving, jnp.asarray(weights, jnp.float32))
        return self._counted(name, self.leaves[name](found))

    def tangent(self, name: str, direction: np.ndarray) -> np.ndarray:
        still = jax.tree.map(jnp.zeros_like, self.moving)
        along = jnp.asarray(self._counted(name, direction), jnp.float32)
        return np.asarray(self._jvp(self.moving, eqx.tree_at(self.leaves[name], still, along)), np.float64)


def directions(gradient: np.ndarray, seed: int) -> list[np.ndarray]:
    """Unit directions for a leaf with this gradient; in a larger leaf, 0 where its gradient is 0."""
    if gradient.size <= FEW:
        return list(np.eye(gradient.size).reshape(-1, *gradient.shape))
    random = np.random.default_rng(seed).normal(size=(2, *gradient.shape)) * (gradient != 0)
    found = [gradient, *random]
    return [each / np.linalg.norm(each) for each in found if np.any(each)]


def probes(plain: Measured, size: int, seed: int) -> list[Probe]:
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=(size, size, 4)), (3, 3, 0))
    uneven = np.clip(1 + 0.3 * noise / noise.std(), 0.1, None)
    found = []
    for name in plain.leaves:
        for direction in directions(plain.gradient(name, uneven), seed):
            tangent = plain.tangent(name, direction)
            if np.any(tangent):  # it is 0 for an extinction of 0
                found.append(Probe(name, direction, uneven * np.sign(tangent)))
    return found


def measure(scene: Scene, methods: Sequence[str], size: int, seed: int) -> dict[str, Any]:
    """Every leaf under every method: the volume as it is, then its voxels as floats."""
    volume = scene.volume
    floating = jv.Volume(volume.data.astype(jnp.float32), volume.spacing, volume.origin)
    rows: dict[str, Any] = {method: {"from forward": {}, "from no leaps": {}} for method in methods}
    for kind, leaves in ((scene, LEAVES), (scene._replace(volume=floating), VOXELS)):
        plain = Measured(kind, "none", leaves, seed)
        asked = probes(plain, size, seed)
        whole = [plain.gradient(probe.leaf, probe.weights) for probe in asked]
        for method in methods:
            here = plain if method == "none" else Measured(kind, method, leaves, seed)
            for probe, without in zip(asked, whole, strict=True):
                g = here.gradient(probe.leaf, probe.weights)
                slope = np.vdot(probe.weights, here.tangent(probe.leaf, probe.direction))
                norm = np.linalg.norm(g)
                errors = {"from forward": abs(np.subtract(np.vdot(g, probe.direction), slope)) / norm}
                if method not in ("none", "min_distance"):
                    errors["from no leaps"] = np.linalg.norm(g - without) / norm
                for name, error in errors.items():
                    row = rows[method][name]
                    row[probe.leaf] = max(float(error), row.get(probe.leaf, 0.0))
            jax.clear_caches()
    return rows


def draw(scenes: dict[str, Any], path: Path) -> None:
    figure, axes = plt.subplots(figsize=(7, 0.5 * len(scenes) + 2.2), layout="constrained")
    for number, rows in enumerate(scenes.values()):
        for shift, (method, row) in enumerate(rows.items()):
            values, y = list(row["from forward"].values()), number + 0.14 * (shift - 2)
            label = method if number == 0 else None
            axes.plot(values, [y] * len(values), "o", color=f"C{shift}", markersize=3, label=label)
    axes.axvline(GOAL, color="k", linestyle=":", linewidth=0.8)
    axes.set_xscale("log")
    axes.set_yticks(range(len(scenes)), list(scenes))
    axes.invert_yaxis()
    axes.set_xlabel(
        "difference of the derivatives by replay and by forward mode along a random direction,\n"
        "relative to the length of the gradient; a point for each leaf (colours, voxels, …);\ndotted: goal",
        fontsize=8,
    )
    figure.legend(loc="outside upper center", ncols=5, fontsize=8, title="method of SpaceLeaping")
    common.save(figure, path)


@common.experiment(
    "gradient_agreement",
    "Is replay's gradient that of forward mode, and that without leaps?",
    __doc__,
    size=256,
    only=common.some_of(ALL, "VOLUME"),
    methods=common.some_of(METHODS, "METHOD"),
)
def main(chosen: Namespace) -> common.Answer:
    folder, names = common.available(chosen, PHANTOM)
    more = {}
    if chosen.quick:
        chosen.size, chosen.methods, more = 24, ["none", "hierarchy"], {"resolution": 24}

    scenes: dict[str, Any] = {}
    for name in names:
        scene = ALL[name](folder, chosen.size, **more)
        scenes[name] = measure(scene, chosen.methods, chosen.size, chosen.seed)
        for method, row in scenes[name].items():
            leaf, worst = max(row["from forward"].items(), key=lambda item: item[1])
            apart = max(row["from no leaps"].values(), default=float("nan"))
            print(
                f"{name:16} {method:13} from forward at most {worst:.1e} ({leaf}), from no leaps {apart:.1e}",
                flush=True,
            )
    return {"size": chosen.size, "goal": GOAL, "scenes": scenes}, partial(draw, scenes)


if __name__ == "__main__":
    main()
