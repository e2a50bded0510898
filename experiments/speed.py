"""How fast is an image, and an image with its gradient, compared with VTK and Dr.Jit?

Five scenes at steps of one voxel, two image sizes. Ours skips empty space and ends rays early; "plain" does
neither. VTK's fixed-point ray caster does both (`peer_vtk.py`), Dr.Jit ends rays early (`peer_drjit.py`). All
use as many threads as there are cores; where JAX has a GPU, ours and Dr.Jit's use that. Frames are drawn in
turn: a ratio is the median over rounds of a program's time over ours. Beside each time stands the RMSE of its
image, over white, against one converged image of ours; VTK's image is compared with that image as VTK's
display would show it.

Also measured: the part of a frame that computes the occupancy; the time of our frame as a program under
`jax.jit`, without what Python does before it; the time from the start of a fresh process to its first image
(`fresh.py`); and, with --gradients, the time of an image with the gradient of every entry of a transfer
function (256 for 8-bit data), and with that of every voxel as float32, relative to the image alone and to
Dr.Jit's replay adjoint, with the relative difference of the two gradients.

Peers that are not installed are left out, and the record says why. Real volumes are read from the folder that
JAXVOL_DATA names; without one, only the head phantom is measured.
"""

import itertools
import os
from argparse import Namespace
from collections.abc import Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.lines import Line2D

import jaxvol as jv
from jaxvol.metrics import rmse
from jaxvol.scene.occupancy import Blocks, Sums
from jaxvol.xla.compiling import OPTIONS

from . import common, fresh, marches, peer_vtk, timing
from .common import plt
from .scenes import PHANTOM, SCENES, Scene


try:
    from . import peer_drjit
except ImportError as fault:
    peer_drjit, NO_DRJIT = None, str(fault)

OURS, PLAIN, VTK, VTK_RAYS, DRJIT = "jaxvol", "jaxvol, plain", "VTK", "VTK, its rays alone", "Dr.Jit"
PEERS = (PLAIN, VTK, VTK_RAYS, DRJIT)
LABELS = {PLAIN: "jaxvol, all samples", VTK_RAYS: "VTK, without drawing its image"}
"""How a program is called in the chart, where not as in the record."""
GOAL = 3.0
LEFT = 1 / 255
SIZES = (512, 1024)
RESOLUTION = 256  # of the head phantom
THREADS = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def fast(scene: Scene) -> jv.March:
    return jv.March(scene.step, (jv.SpaceLeaping(), jv.EarlyTermination(LEFT)))


def peers() -> dict[str, str]:
    """The version of each peer, or why it is left out."""
    reason = peer_vtk.missing()
    return {
        VTK: f"not here: {reason}" if reason else version("vtk"),
        DRJIT: f"mitsuba {version('mitsuba')}, drjit {version('drjit')}, {peer_drjit.VARIANT}"
        if peer_drjit
        else f"not here: {NO_DRJIT}",
    }


def images(scene: Scene, there: dict[str, str], repetitions: int) -> dict[str, dict[str, Any]]:
    """Time and error of every program's frame, and the part of ours that computes the occupancy."""
    truth = np.asarray(common.image(scene, marches.converged(scene.step, common.FINER)).image())
    under = {OURS: fast(scene), PLAIN: jv.March(scene.step)}
    programs: dict[str, Any] = {n: lambda m=m: common.image(scene, m) for n, m in under.items()}
    errors = {n: rmse(common.image(scene, m).image(), truth) for n, m in under.items()}
    if there[VTK][0].isdigit():
        drawn = peer_vtk.prepare(scene.volume, scene.transfer, scene.camera, scene.step, THREADS)
        programs |= {VTK: drawn.draw, VTK_RAYS: drawn.cast}
        errors[VTK] = errors[VTK_RAYS] = rmse(drawn.image(), peer_vtk.as_displayed(truth, drawn.mapper))
    if peer_drjit:
        marcher = drjit(scene)
        programs[DRJIT] = marcher.draw
        rgba = marcher.rgba()
        errors[DRJIT] = rmse(rgba[..., :3] + 1 - rgba[..., 3:], truth)
    programs |= {"occupancy": occupancy(scene), "under jit": jitted(scene)}
    seconds = timing.interleaved(programs, repetitions)
    rows = {name: common.row(seconds[name], seconds[OURS], error) for name, error in errors.items()}
    for part in ("occupancy", "under jit"):
        rows[OURS][part] = timing.ratio(seconds[part], seconds[OURS])
    return rows


def jitted(scene: Scene) -> Any:
    """Our image as a program of the user's, of which Python calls nothing but the program."""

    @jax.jit
    def image(transfer: jv.TransferFunction, camera: jv.Camera) -> jax.Array:
        return common.image(scene._replace(transfer=transfer, camera=camera), fast(scene)).rgba

    return lambda: image(scene.transfer, scene.camera)


def occupancy(scene: Scene) -> Any:
    """The program that computes the occupancy, with which every frame of ours begins."""

    @eqx.filter_jit
    def found(scene: Scene, march: jv.March, blocks: Blocks) -> Sums:
        return march.locate(scene.volume).occupancy(scene.transfer.visible(blocks)).sums()

    return lambda: found(scene, fast(scene), Blocks.of(scene.volume))


def drjit(scene: Scene) -> Any:
    assert peer_drjit is not None
    return peer_drjit.prepare(*scene, opacity_left=LEFT, threads=THREADS)


def gradients(scene: Scene, of: Literal["transfer", "voxels"], repetitions: int) -> dict[str, Any]:
    """Time of an image with the gradient of mean(rgba²) to all entries of the transfer function, or to all
    voxels, as float32. (8-bit values lie on points of the transfer function, where its slope jumps: there
    gradients of voxels differ between programs.) Voxels that are differentiated are new in each call, so that
    their ranges, too, are computed again, which an image alone has kept."""
    scene = scene._replace(transfer=peer_vtk.dense(scene.transfer, scene.volume))
    volume, transfer = scene.volume, scene.transfer
    if of == "voxels":
        volume = eqx.tree_at(lambda v: v.data, volume, jnp.asarray(volume.data, jnp.float32))
        scene = scene._replace(volume=volume)
    leaf = volume.data if of == "voxels" else (transfer.colors, transfer.extinction)
    march = fast(scene)

    def loss(leaf: Any, march: jv.March = march) -> jax.Array:
        if of == "voxels":
            here = scene._replace(volume=eqx.tree_at(lambda v: v.data, volume, leaf))
        else:
            changed = eqx.tree_at(lambda t: (t.colors, t.extinction), transfer, leaf)
            here = scene._replace(transfer=changed)
        return jnp.mean(common.image(here, march).rgba ** 2)

    def entries(found: Any) -> np.ndarray:
        return np.asarray(found) if of == "voxels" else np.column_stack(found)

    # compiled as one program, like the image
    both_of = jax.jit(jax.value_and_grad(loss), compiler_options=OPTIONS)
    ours = entries(both_of(leaf)[1])
    programs: dict[str, Any] = {
        "image": lambda: common.image(scene, march),
        "image and gradient": lambda: both_of(leaf),
    }
    found: dict[str, Any] = {"entries": len(ours) if of == "transfer" else ours.size}
    found["pixels"] = scene.camera.size[0]
    if peer_drjit:
        marcher = drjit(scene)
        programs[DRJIT] = partial(marcher.differentiate, of=of)
        theirs = marcher.gradient(of=of)
        # with leaps, the gradient of what has an extinction of 0 is left out; without leaps it is computed
        seen = np.ones(ours.shape, bool)
        if of == "transfer":
            seen[:, 3] = np.asarray(transfer.extinction > 0)
        plain = entries(jax.grad(loss)(leaf, jv.March(march.step, (jv.EarlyTermination(LEFT),))))
        size = np.linalg.norm(theirs)
        found["size"] = float(size)
        found["difference"] = float(np.linalg.norm((ours - theirs)[seen]) / np.linalg.norm(theirs[seen]))
        found["difference, without leaps"] = float(np.linalg.norm(plain - theirs) / size)
    seconds = timing.interleaved(programs, repetitions)
    both = seconds["image and gradient"]
    found["seconds"] = {name: round(float(np.median(times)), 5) for name, times in seconds.items()}
    found["over image"] = timing.ratio(both, seconds["image"])
    if peer_drjit:
        found["Dr.Jit over ours"] = timing.ratio(seconds[DRJIT], both)
    return found


def draw(result: dict[str, Any], path: Path) -> None:
    """Each program's time over ours, scene by scene."""
    sizes, volumes = result["sizes"], result["volumes"]
    size = (6 * len(sizes), 0.75 * len(volumes) + 1.5)
    figure, (axes,) = plt.subplots(1, len(sizes), figsize=size, squeeze=False, layout="constrained")
    for panel, pixels in zip(axes, sizes, strict=True):
        for number, rows in enumerate(of_size[str(pixels)] for of_size in volumes.values()):
            for shift, (name, color) in enumerate(zip(PEERS, ("C7", "C0", "C9", "C3"), strict=True)):
                if name in rows:
                    ratio, y = rows[name]["ratio"], number + 0.2 * (shift - 1.5)
                    panel.plot((ratio["low"], ratio["high"]), (y, y), color=color, linewidth=2, alpha=0.5)
                    panel.plot(ratio["median"], y, "o", color=color, markersize=5)
        panel.axvline(1, color="k", linewidth=0.8)
        panel.axvline(GOAL, color="k", linewidth=0.8, linestyle=":")
        panel.set_xscale("log")
        panel.set_xticks((0.5, 1, 2, 3, 5, 10, 20), ("0.5", "1", "2", "3", "5", "10", "20"))
        panel.minorticks_off()
        ours = [(name, of_size[str(pixels)][OURS]) for name, of_size in volumes.items()]
        labels = [f"{name}\n{row['seconds'] * 1e3:.0f} ms, RMSE {row['rmse']:.4f}" for name, row in ours]
        panel.set_yticks(range(len(volumes)), labels, fontsize=8)
        panel.set_ylim(len(volumes) - 0.5, -0.6)
        panel.set_xlabel(f"time of an image / that of jaxvol, {pixels} x {pixels} pixels", fontsize=9)
        panel.text(GOAL, -0.55, " goal", va="top", fontsize=8)
        panel.set_title(
            "Right of 1: slower than jaxvol, whose own time and\n"
            "error stand below a scene; bars: 95 % intervals",
            fontsize=9,
        )
    shown = [name for name in PEERS if any(name in r for v in volumes.values() for r in v.values())]
    colors: dict[str, str] = dict(zip(PEERS, ("C7", "C0", "C9", "C3"), strict=True))
    marks = [Line2D([], [], color=colors[name], marker="o", linestyle="") for name in shown]
    figure.legend(
        marks, [LABELS.get(name, name) for name in shown], loc="outside upper center", ncols=4, fontsize=8
    )
    common.save(figure, path)


def means(volumes: dict[str, Any], sizes: Sequence[int]) -> dict[str, float]:
    """Geometric mean over all scenes and sizes of each program's time over ours."""
    rows = [of_size[str(size)] for of_size in volumes.values() for size in sizes]
    there = [name for name in PEERS if all(name in row for row in rows)]
    return {name: common.geometric_mean(row[name]["ratio"]["median"] for row in rows) for name in there}


def print_rows(name: str, size: int, rows: dict[str, dict[str, Any]]) -> None:
    for program, row in rows.items():
        ratio = row["ratio"]
        print(
            f"{name:16} {size:4}  {program:20} {row['seconds'] * 1e3:8.1f} ms  {ratio['median']:6.3f} x ours"
            f" [{ratio['low']:.3f}, {ratio['high']:.3f}]  RMSE {row['rmse']:.5f}",
            flush=True,
        )
    shares = (f"{part}: {rows[OURS][part]['median']:.1%} of our frame" for part in ("occupancy", "under jit"))
    print(f"{name:16} {size:4}  {', '.join(shares)}", flush=True)


@common.experiment(
    "speed",
    "How fast is an image, and an image with its gradient, beside VTK and Dr.Jit?",
    __doc__,
    repetitions=15,
    sizes={"nargs": "+", "type": int, "default": SIZES},
    only=common.some_of(SCENES, "VOLUME"),
    gradients={"action": "store_true", "help": "measure gradients, too, at the first size"},
    resolution={"type": int, "default": RESOLUTION, "help": "voxels along an axis of the head phantom"},
    steps={"type": int, "default": 1, "help": "steps to a voxel"},
    processes={"type": int, "default": 5, "help": "fresh processes, each of which draws a first image"},
)
def main(chosen: Namespace) -> common.Answer:
    folder, names = common.available(chosen, PHANTOM)
    if chosen.quick:
        chosen.sizes, chosen.repetitions, chosen.resolution, chosen.processes = (32, 48), 2, 32, 1

    there = peers()
    print(there, flush=True)
    volumes: dict[str, dict[str, Any]] = {}
    slopes: dict[str, Any] = {}
    for name in names:
        more = {"resolution": chosen.resolution} if name == PHANTOM else {}
        volumes[name] = {}
        for size in chosen.sizes:
            scene = SCENES[name](folder, size, **more)
            scene = scene._replace(step=scene.step / chosen.steps)
            rows = volumes[name][str(size)] = images(scene, there, chosen.repetitions)
            print_rows(name, size, rows)
            if chosen.gradients and size == chosen.sizes[0]:
                slopes[name] = {of: gradients(scene, of, chosen.repetitions) for of in ("transfer", "voxels")}
                print(f"{name:16} {size:4}  {slopes[name]}", flush=True)
    result = {
        "sizes": chosen.sizes,
        "steps to a voxel": chosen.steps,
        "repetitions": chosen.repetitions,
        "opacity left": LEFT,
        "threads": THREADS,
        "goal": GOAL,
        "peers": there,
        "geometric means": means(volumes, chosen.sizes),
        "first image": fresh.measure(chosen.sizes[0], chosen.resolution, LEFT, chosen.processes)
        if chosen.processes
        else None,
        "volumes": volumes,
        "gradients": slopes,
    }
    for of, key in itertools.product(("transfer", "voxels"), ("over image", "Dr.Jit over ours")):
        ratios = [found[of][key]["median"] for found in slopes.values() if key in found[of]]
        if ratios:
            result["geometric means"][f"{of}, {key}"] = common.geometric_mean(ratios)
    print("first image:", result["first image"])
    print(f"times over ours, geometric means: {result['geometric means']}; the goal is {GOAL}")
    return result, partial(draw, result)


if __name__ == "__main__":
    main()
