"""Which gradients are wrong, under which transform, with cells cut at the exit and without?

A derivative describes how an image changes as long as no sample crosses a face. Where one does, the image of
a march that does not cut its cells there jumps, and no derivative sees it. So the gradient of each march
(float64, `adjoint="replay"`) is integrated along a move of a leaf, and compared with the change of the image
between the ends of the move (central differences of the reference engine): both agree, unless something
jumped in between. The shortest move is the usual finite difference, which rarely meets a jump; the longest
moves samples by about a step, as a step of a fit does.

The scene has material at all faces of the volume, empty space in its middle and, in the marches named
"labels", a segmentation with a transfer function for each label. Error: |sum of the gradients - change| over
the larger of the two, over several weightings of the image and directions of each leaf.
"""

from argparse import Namespace
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from matplotlib.colors import LogNorm

import jaxvol as jv

from . import charts
from .harness import experiment


STEP = 0.11
WIDTHS = ((1e-5, 1), (0.1, 8), (1.0, 48))
"""Half the lengths of moves, in the units of `LEAVES` (which move samples by about a step), and the number of
points of a move at which the gradient is taken."""
WRONG = 0.1
"""Error from which a gradient counts as wrong. Correct gradients have kinks, and err by less."""
WEIGHTINGS, DIRECTIONS = 6, 2
LEFT = 0.3
NOTE = f"EarlyTermination leaves {LEFT:g} here, by default 1/255: its jumps are as large as what it leaves."
CUT = " + AlphaCorrection"

Scene = tuple[jv.Volume, Any, jv.Camera, jv.March]


def functions(scene: Scene) -> jv.TransferFunction:
    """The transfer function, or those of all labels."""
    transfer = scene[1]
    return transfer.stacked if isinstance(transfer, jv.LabelTransferFunction) else transfer


LEAVES: dict[str, tuple[Callable[[Scene], Array], Any]] = {
    "position": (lambda s: s[2].position, STEP),
    "focal point": (lambda s: s[2].focal_point, STEP),
    "view angle": (lambda s: s[2].view_angle, 3.0),
    "spacing": (lambda s: s[0].spacing, STEP / 8),
    "origin": (lambda s: s[0].origin, STEP),
    "step": (lambda s: s[3].step, STEP / 24),
    "colours": (lambda s: functions(s).colors, 0.1),
    # relative: an extinction of 0 stays 0; that it may grow is a matter of leaps, not of jumps
    "extinction": (lambda s: functions(s).extinction, None),
    "voxels": (lambda s: s[0].data, 0.02),
}
"""Parts of the scene, and a change of each that moves samples by about a step."""

ALONE: dict[str, tuple[jv.Transform, ...]] = {
    "ray casting": (),
    "Jitter": (jv.Jitter(3),),
    "EmptySpaceJitter": (jv.EmptySpaceJitter(4),),
    "SpaceLeaping": (jv.SpaceLeaping(),),
    "EarlyTermination": (jv.EarlyTermination(LEFT),),
    "labels": (),
}
MARCHES: dict[str, tuple[jv.Transform, ...]] = {
    name + cut: (*transforms, *aligned)
    for name, transforms in ALONE.items()
    for cut, aligned in (("", ()), (CUT, (jv.AlphaCorrection(),)))
}
"""Each transform alone, and with cells cut at the exit."""
MARCHES[f"labels{CUT}(labels)"] = (jv.AlphaCorrection(labels=True),)


def scene_of(name: str, quadrature: Any, size: int) -> Scene:
    """A smooth field that is visible at its rim and invisible in its middle, in float64."""
    shape, spacing, origin = (9, 8, 10), (0.3, 0.35, 0.25), (-0.5, 0.2, 0.1)
    x, y, z = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij")
    data = 0.15 + 0.25 * (x**2 + 0.8 * y**2 + 1.1 * z**2) + 0.1 * np.sin(2 * x + 3 * y - z)
    labels = (x + 0.6 * y - 0.3 * z > 0.25).astype(np.uint8)
    volume = jv.Volume(jnp.asarray(data, float), spacing, origin, labels)
    colors = np.array([(0.2, 0.3, 0.8), (0.3, 0.8, 0.3), (0.9, 0.7, 0.4)])
    transfer: Any = jv.TransferFunction([0.0, 0.25, 1.0], colors, [0.0, 0.0, 3.0])
    if name.startswith("labels"):
        other = jv.TransferFunction([0.0, 0.25, 1.0], 1 - colors, [0.0, 0.0, 6.0])
        transfer = jv.LabelTransferFunction([transfer, other])
    middle = np.asarray(volume.center) + 0.05
    camera = jv.Camera((3.9, -3.3, 3.1), middle, (0.1, 0, 1), 35.0, size=(size, size))
    march = jv.March(STEP, MARCHES[name], quadrature, max_samples=64)
    inexact, others = eqx.partition((volume, transfer, camera, march), eqx.is_inexact_array)
    return eqx.combine(jax.tree.map(lambda leaf: jnp.asarray(leaf, float), inexact), others)


def measure(name: str, quadrature: str, chosen: Namespace) -> dict[str, list[float]]:
    """Relative error of the gradient with respect to each leaf, over moves of each width."""
    scene, rng = scene_of(name, quadrature, chosen.size), np.random.default_rng(chosen.seed)
    weights = jnp.asarray(rng.normal(size=(WEIGHTINGS, chosen.size, chosen.size, 4)))

    @eqx.filter_jit
    def losses(scene: Scene) -> Array:
        """Weighted sums of the reference engine's image."""
        return jnp.tensordot(weights, jv.render(*scene, adjoint="direct").rgba, axes=3)

    @eqx.filter_jit
    def gradients(scene: Scene) -> Any:
        """Gradients of these sums for the image of the fast engine."""
        _, pull = eqx.filter_vjp(lambda scene: jv.render(*scene).rgba, scene)
        return jax.vmap(lambda weight: pull(weight)[0])(weights)

    def changes(where: Callable[[Scene], Array], move: Array, points: int) -> tuple[np.ndarray, np.ndarray]:
        """Change of the losses from -`move` to +`move` around the scene: the gradients' integral, and the
        true one."""

        def moved(part: float) -> Scene:
            return eqx.tree_at(where, scene, where(scene) + part * move)

        parts = (np.arange(points) + 0.5) / points * 2 - 1
        slopes = [where(gradients(moved(part))).reshape(WEIGHTINGS, -1) @ move.reshape(-1) for part in parts]
        return 2 * np.mean(slopes, axis=0), np.asarray(losses(moved(1.0)) - losses(moved(-1.0)))

    found: dict[str, list[float]] = {leaf: [] for leaf in chosen.leaves}
    for leaf, errors in found.items():
        where, unit = LEAVES[leaf]
        unit = 0.1 * where(scene) if unit is None else unit
        moves = [jnp.asarray(rng.normal(size=where(scene).shape)) * unit for _ in range(DIRECTIONS)]
        for width, points in chosen.widths:
            both = np.array([changes(where, width * move, points) for move in moves])
            integral, change = both[:, 0], both[:, 1]
            largest = max(np.linalg.norm(integral), np.linalg.norm(change))
            errors.append(float(np.linalg.norm(integral - change) / largest))
    return found


def draw(result: dict[str, Any]) -> Any:
    """A heat map of marches by leaves, for each quadrature and width."""
    found, widths = result["relative errors"], result["widths"]
    names, leaves = list(next(iter(found.values()))), list(LEAVES)
    size = 4.2 * len(widths) + 1.6, (0.27 * len(names) + 1.2) * len(found)
    figure, axes = charts.panels(len(found), len(widths), *size, sharex=True, sharey=True)
    for line, (quadrature, rows) in zip(axes, found.items(), strict=True):
        for number, (panel, width) in enumerate(zip(line, widths, strict=True)):
            unknown = [np.nan] * len(widths)
            errors = np.array([[rows[name].get(leaf, unknown)[number] for leaf in leaves] for name in names])
            panel.imshow(errors, norm=LogNorm(1e-4, 1, clip=True), cmap="YlOrRd", aspect="auto")
            for row, column in np.argwhere(errors >= WRONG):
                how: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 8, "color": "white"}
                panel.text(column, row, f"{errors[row, column]:.1f}", **how)
            panel.set_title(f"{quadrature} rule, moves of ± {width:g} step")
            panel.set_xticks(range(len(leaves)), leaves, rotation=40, ha="right")
            panel.set_yticks(range(len(names)), names)
    bar = figure.colorbar(axes.flat[-1].images[0], ax=axes, shrink=0.6, pad=0.01)
    bar.set_label(f"what the gradient misses of the change; as a number from {WRONG:g} on")
    figure.suptitle(
        "How far the change of an image, as a leaf moves by so much, differs from the sum of its gradients: "
        f"|sum - change| / the larger one.\n{NOTE}"
    )
    return figure


@experiment(
    size=6,
    names=tuple(MARCHES),
    leaves=tuple(LEAVES),
    quadratures=("left", "midpoint"),
    widths=WIDTHS,
    quick={
        "names": ("ray casting", f"ray casting{CUT}"),
        "leaves": ("position", "colours"),
        "quadratures": ("left",),
        "widths": ((1e-5, 1), (1.0, 24)),
    },
)
def main(chosen: Namespace) -> dict[str, Any]:
    with jax.enable_x64(True):
        found = {
            rule: {name: measure(name, rule, chosen) for name in chosen.names} for rule in chosen.quadratures
        }
    wrong = {
        rule: {name: [leaf for leaf, e in row.items() if e[-1] >= WRONG] for name, row in rows.items()}
        for rule, rows in found.items()
    }
    widths = [width for width, _ in chosen.widths]
    return {"widths": widths, "wrong": wrong, "relative errors": found}
