"""Does the gradient of the second march agree with forward mode, under every leaping method?

For each leaf, the gradient g by `adjoint="replay"` is compared with slopes along unit directions d by
`adjoint="forward"`: the largest |g·d - slope| / |g| over g's own direction and two random ones; and with g
without leaps. Extinctions of 0, whose gradient leaps leave out, do not count. The loss is a weighted sum of
all pixels; weights have the sign of the pixel's derivative along d, so that nothing cancels.
"""

from argparse import Namespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxvol as jv

from . import marches
from .harness import chosen_scenes, experiment, show, some_of
from .scenes import PHANTOM, SCENES, Scene


METHODS = ("none", "hierarchy", "distance", "beam", "min_distance")
FIELDS = "spacing origin data", "colors extinction", "position focal_point view_up view_angle window", "step"
LEAVES = {
    {"data": "voxels"}.get(name, name.replace("_", " ")): lambda scene, i=i, n=name: getattr(scene[i], n)
    for i, names in enumerate(FIELDS)
    for name in names.split()
}


def derivatives(scene: Scene, method: str, seed: int) -> tuple[Any, Any]:
    """The image's `gradient(leaf, weights)` by replay, and its `tangent(leaf, direction)` by forward mode."""
    leaps = () if method == "none" else (jv.SpaceLeaping(method),)
    transforms = (*marches.transforms(marches.BOTH, seed), *leaps, jv.EarlyTermination(1 / 255))
    whole = (*scene[:3], jv.March(scene.step, transforms))
    mask = jax.tree.map(lambda _: False, whole)
    mask = eqx.tree_at(lambda s: [where(s) for where in LEAVES.values()], mask, [True] * len(LEAVES))
    moving, fixed = eqx.partition(whole, mask)

    def image(moving: Any, adjoint: Any) -> jax.Array:
        return jv.render(*eqx.combine(moving, fixed), outputs="rgba", adjoint=adjoint).rgba

    grad = jax.grad(lambda x, weights: jnp.vdot(image(x, "replay"), weights))
    jvp = jax.jit(lambda x, along: jax.jvp(lambda x: image(x, "forward"), (x,), (along,))[1])

    def tangent(leaf: str, direction: np.ndarray) -> np.ndarray:
        still = jax.tree.map(jnp.zeros_like, moving)
        return np.asarray(jvp(moving, eqx.tree_at(LEAVES[leaf], still, jnp.float32(direction))), np.float64)

    seen = {"extinction": np.asarray(scene.transfer.extinction) > 0}
    return lambda n, w: np.float64(LEAVES[n](grad(moving, jnp.float32(w)))) * seen.get(n, 1), tangent


def measure(scene: Scene, methods: list[str], seed: int) -> dict[str, Any]:
    random, width = np.random.default_rng(seed), scene.camera.size[0]
    uneven = random.uniform(0.4, 1.6, (width, width, 4))
    made = {method: derivatives(scene, method, seed) for method in ("none", *methods)}
    plain, plain_tangent = made["none"]
    rows: dict[str, Any] = {method: {"from forward": {}, "from no leaps": {}} for method in methods}
    for leaf in LEAVES:
        own = plain(leaf, uneven)
        for along in (own, *random.normal(size=(2, *own.shape)) * (own != 0)):
            along /= np.linalg.norm(along)
            weights = uneven * np.sign(plain_tangent(leaf, along))
            for method, found in rows.items():
                gradient, tangent = made[method]
                g = gradient(leaf, weights)
                errors = {"from forward": np.vdot(g, along) - np.vdot(weights, tangent(leaf, along))}
                if method not in ("none", "min_distance"):  # which renders another image
                    errors["from no leaps"] = np.linalg.norm(g - plain(leaf, weights))
                for name, error in errors.items():
                    found[name][leaf] = max(float(abs(error) / np.linalg.norm(g)), found[name].get(leaf, 0))
    jax.clear_caches()
    return rows


@experiment(
    size=256,
    resolution=192,
    only=some_of(SCENES, "VOLUME"),
    methods=some_of(METHODS, "METHOD"),
    quick={"size": 24, "resolution": 24, "methods": METHODS[:2]},
)
def main(chosen: Namespace) -> dict[str, Any]:
    scenes: dict[str, Any] = {}
    for name, scene in chosen_scenes(chosen, SCENES, PHANTOM, chosen.size):
        volume = jv.Volume(scene.volume.data.astype(jnp.float32), scene.volume.spacing, scene.volume.origin)
        scenes[name] = measure(scene._replace(volume=volume), chosen.methods, chosen.seed)
        show(scenes[name], name)
    return {"size": chosen.size, "goal": 1e-4, "scenes": scenes}
