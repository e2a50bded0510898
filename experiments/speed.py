"""How fast is an image, and an image with its gradient, compared with VTK and Dr.Jit?

Five scenes at steps of one voxel. Ours skips empty space and ends rays early; "plain" does neither. VTK's
fixed-point ray caster does both (`peer_vtk.py`), Dr.Jit ends rays early (`peer_drjit.py`). All use as many
threads as there are cores, or JAX's GPU. Frames are drawn in turn: a ratio is the median over rounds of a
program's time over ours. Beside each time stands the RMSE of its image, over white, against one converged
image of ours; VTK's image is compared with that image as VTK's display would show it.

Also measured: our frame as a program under `jax.jit`, without what Python does before it; and, with
--gradients, an image with the gradient of every entry of a transfer function (256 for 8-bit data), and with
that of every voxel as float32, relative to the image alone and to Dr.Jit's replay adjoint, with the relative
difference of the two gradients. Records until e296103 have the time to a process' first image, too.
"""

from argparse import Namespace
from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.lines import Line2D

import jaxvol as jv
from jaxvol.xla.compiling import OPTIONS

from . import charts, harness, marches, peer_vtk, programs, timing
from .harness import chosen_scenes, experiment, geometric_mean, some_of
from .programs import DRJIT, THREADS, VTK, Case, is_here
from .scenes import PHANTOM, SCENES, Scene


OURS, PLAIN, VTK_RAYS = "jaxvol", "jaxvol, plain", "VTK, its rays alone"
COLORS = {PLAIN: "C7", VTK: "C0", VTK_RAYS: "C9", DRJIT: "C3"}
LABELS = {PLAIN: "jaxvol, all samples", VTK_RAYS: "VTK, without drawing its image"}
"""How a program is called in the chart, where not as in the record."""
GOAL = 3.0
LEFT = 1 / 255


def fast(scene: Scene) -> jv.March:
    return jv.March(scene.step, (jv.SpaceLeaping(), jv.EarlyTermination(LEFT)))


def images(scene: Scene, there: dict[str, str], repetitions: int) -> dict[str, dict[str, Any]]:
    """Time and error of every program's frame, and the time of ours under `jax.jit`."""
    case, march = Case(scene), fast(scene)
    truth = programs.program(case, marches.converged(scene.step, harness.FINER)).image()
    made = {OURS: programs.program(case, march), PLAIN: programs.program(case, jv.March(scene.step))}
    if is_here(there, VTK):
        drawn = peer_vtk.Drawn(scene.volume, scene.transfer, scene.camera, scene.step, THREADS)
        made[VTK] = programs.of_vtk(drawn)
        made[VTK_RAYS] = made[VTK]._replace(draw=drawn.cast)
    if is_here(there, DRJIT):
        made[DRJIT] = programs.of_drjit(programs.marcher(scene, left=LEFT))
    under_jit = jax.jit(
        lambda tf, camera: harness.image(scene._replace(transfer=tf, camera=camera), march).rgba
    )
    made["under jit"] = made[OURS]._replace(draw=lambda: under_jit(scene.transfer, scene.camera))
    rows = programs.measured(made, truth, repetitions)
    rows[OURS]["under jit"] = rows.pop("under jit")["ratio"]
    return rows


def gradients(
    scene: Scene, of: Literal["transfer", "voxels"], there: dict[str, str], repetitions: int
) -> dict[str, Any]:
    """Time of an image with the gradient of mean(rgba²) to all entries of the transfer function, or to all
    voxels, as float32. (8-bit values lie on points of the transfer function, where its slope jumps: there
    gradients of voxels differ between programs.) Voxels that are differentiated are new in each call, so that
    their ranges, too, are computed again, which an image alone has kept."""
    scene = scene._replace(transfer=peer_vtk.dense(scene.transfer, scene.volume))
    volume, transfer = scene.volume, scene.transfer
    if of == "voxels":
        volume = eqx.tree_at(lambda v: v.data, volume, jnp.asarray(volume.data, jnp.float32))
        scene = scene._replace(volume=volume)
    where: Any = (lambda p: p[0].data) if of == "voxels" else (lambda p: (p[1].colors, p[1].extinction))
    leaf, march = where((volume, transfer)), fast(scene)

    def loss(leaf: Any) -> jax.Array:
        volume_, transfer_ = eqx.tree_at(where, (volume, transfer), leaf)
        return jnp.mean(harness.image(scene._replace(volume=volume_, transfer=transfer_), march).rgba ** 2)

    def entries(found: Any) -> np.ndarray:
        return np.asarray(found) if of == "voxels" else np.column_stack(found)

    # compiled as one program, like the image
    both_of = jax.jit(jax.value_and_grad(loss), compiler_options=OPTIONS)
    ours = entries(both_of(leaf)[1])
    timed: dict[str, Any] = {
        "image": lambda: harness.image(scene, march),
        "image and gradient": lambda: both_of(leaf),
    }
    found: dict[str, Any] = {}
    if is_here(there, DRJIT):
        marcher = programs.marcher(scene, left=LEFT)
        timed[DRJIT] = partial(marcher.differentiate, of=of)
        theirs = marcher.gradient(of=of)
        # with leaps, the gradient of what has an extinction of 0 is left out
        seen = np.ones(ours.shape, bool)
        if of == "transfer":
            seen[:, 3] = np.asarray(transfer.extinction > 0)
        found["difference"] = float(np.linalg.norm((ours - theirs)[seen]) / np.linalg.norm(theirs[seen]))
    seconds = timing.interleaved(timed, repetitions)
    both = seconds["image and gradient"]
    found["seconds"] = {name: timing.median(times) for name, times in seconds.items()}
    found["over image"] = timing.ratio(both, seconds["image"])
    if DRJIT in seconds:
        found["Dr.Jit over ours"] = timing.ratio(seconds[DRJIT], both)
    return found


def draw(result: dict[str, Any]) -> Any:
    """Each program's time over ours, scene by scene."""
    sizes, volumes = result["sizes"], result["volumes"]
    figure, axes = charts.panels(len(sizes), 1, 8.8, (0.75 * len(volumes) + 1.3) * len(sizes))
    for (panel,), pixels in zip(axes, sizes, strict=True):
        for number, rows in enumerate(of_size[str(pixels)] for of_size in volumes.values()):
            for shift, (name, color) in enumerate(COLORS.items()):
                if name in rows:
                    charts.interval(panel, rows[name]["ratio"], number + 0.2 * (shift - 1.5), color)
        panel.axvline(1, color="k", linewidth=0.8)
        panel.axvline(GOAL, color="k", linewidth=0.8, linestyle=":")
        charts.numbered(panel, (0.5, 1, 2, 3, 5, 10, 20), ("0.5", "1", "2", "3", "5", "10", "20"))
        ours = [(name, of_size[str(pixels)][OURS]) for name, of_size in volumes.items()]
        labels = [f"{name}\n{row['seconds'] * 1e3:.0f} ms, RMSE {row['rmse']:.4f}" for name, row in ours]
        panel.set_yticks(range(len(volumes)), labels)
        panel.set_ylim(len(volumes) - 0.5, -0.6)
        panel.set_xlabel(f"time of an image / that of jaxvol, {pixels} x {pixels} pixels")
        panel.text(GOAL, -0.55, " goal", va="top")
        panel.set_title(
            "Right of 1: slower than jaxvol, whose own time and error\n"
            "stand below a scene; bars: 95 % intervals"
        )
    shown = [name for name in COLORS if any(name in r for v in volumes.values() for r in v.values())]
    marks = [Line2D([], [], color=COLORS[name], marker="o", linestyle="") for name in shown]
    labels = [LABELS.get(name, name) for name in shown]
    figure.legend(marks, labels, loc="outside upper center", ncols=4)
    return figure


@experiment(
    repetitions=15,
    sizes={"nargs": "+", "type": int, "default": (512, 1024)},
    only=some_of(SCENES, "VOLUME"),
    gradients={"action": "store_true", "help": "measure gradients, too, at the first size"},
    resolution=256,
    steps={"type": int, "default": 1, "help": "steps to a voxel"},
    quick={"sizes": (32, 48), "repetitions": 2, "resolution": 32},
)
def main(chosen: Namespace) -> dict[str, Any]:
    there = programs.peers()
    volumes: dict[str, dict[str, Any]] = {}
    slopes: dict[str, Any] = {}
    for size in chosen.sizes:
        for name, scene in chosen_scenes(chosen, SCENES, PHANTOM, size):
            scene = scene._replace(step=scene.step / chosen.steps)
            volumes.setdefault(name, {})[str(size)] = images(scene, there, chosen.repetitions)
            if chosen.gradients and size == chosen.sizes[0]:
                slopes[name] = {
                    of: gradients(scene, of, there, chosen.repetitions) for of in ("transfer", "voxels")
                }
    rows = [row for of_size in volumes.values() for row in of_size.values()]
    everywhere = [name for name in COLORS if all(name in row for row in rows)]
    means = {name: geometric_mean(row[name]["ratio"]["median"] for row in rows) for name in everywhere}
    return {
        "sizes": chosen.sizes,
        "goal": GOAL,
        "peers": there,
        "geometric means": means,
        "volumes": volumes,
        "gradients": slopes,
    }
