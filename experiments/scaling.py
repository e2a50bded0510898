"""How does the time of an image, and of its gradient, change with the number of devices?

The head phantom, leaping, with early termination. Strong scaling: one image of 512² pixels on 1, 2, 4 and 8
devices, against the same image where `devices` is not given. Weak scaling: 256² pixels for each device.

Where there is no accelerator, devices are parts of the host, which share its cores; and one device uses these
already, though not all of them all the time. Then times do not show how an image scales, but what dealing out
rays gains and costs on a host. `balance` does not depend on the machine: the samples that devices take on
average, over those of the one that takes most. It bounds how much faster so many devices of their own could
be.
"""

import math
import os
from argparse import Namespace
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol.engine import devices
from jaxvol.engine.rays import RayTiles
from jaxvol.engine.tiling import Tiling

from . import common, timing
from .common import plt
from .scenes import Scene, seen_head


NUMBERS = (1, 2, 4, 8)
LEFT = 1 / 255
IMAGE, GRADIENT, WEAK = "image", "image and gradient", "image, weak"


def measure(size: int, share: int, resolution: int, repetitions: int) -> dict[str, Any]:
    """Times and balance, by number of devices. `size`: pixels along a side; `share`: of what each device has
    in weak scaling."""
    volume = jv.phantom("head", resolution)
    numbers = [number for number in NUMBERS if number <= jax.device_count()]
    found: dict[str, Any] = {"platform": jax.default_backend(), "devices": jax.device_count()}
    for name, render in ((IMAGE, image), (GRADIENT, gradient)):
        scene = seen_head(volume, size)
        programs = {"not given": partial(render, scene, None)}
        programs |= {str(number): partial(render, scene, jax.devices()[:number]) for number in numbers}
        found[name] = rows(timing.interleaved(programs, repetitions), "not given")
    whole = image(seen_head(volume, size), None, "all").samples
    scenes = {number: seen_head(volume, round(share * math.sqrt(number))) for number in numbers}
    weak = {str(n): partial(image, scene, jax.devices()[:n]) for n, scene in scenes.items()}
    found[WEAK] = rows(timing.interleaved(weak, repetitions), "1")
    for number, scene in scenes.items():
        found[IMAGE][str(number)]["balance"] = balance(seen_head(volume, size), whole, number)
        found[WEAK][str(number)]["pixels along a side"] = scene.camera.size[0]
    return found


def march(scene: Scene) -> jv.March:
    return jv.March(
        scene.step, (jv.Jitter(0), jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination(LEFT))
    )


def image(scene: Scene, given: Any, outputs: Any = "rgba") -> jv.Rendering:
    return jv.render(*scene[:3], march(scene), outputs=outputs, devices=given)


def gradient(scene: Scene, given: Any) -> Any:
    """An image's mean, and its gradient by the transfer function."""

    def loss(transfer: jv.TransferFunction) -> jax.Array:
        return jnp.mean(image(scene._replace(transfer=transfer), given).rgba)

    return eqx.filter_value_and_grad(loss)(scene.transfer)


def balance(scene: Scene, samples: jax.Array, number: int) -> float:
    """Mean over greatest number of an image's samples on so many devices."""
    mesh = devices.mesh_of(jax.devices()[:number])
    tiles = RayTiles.of(scene.camera, Tiling(devices=mesh))

    def own(samples: jax.Array, _: None) -> tuple[None, jax.Array]:
        return None, jnp.sum(tiles.disassemble(samples))[None]

    shares = np.asarray(devices.split(mesh, own, samples, None)[1])
    return round(float(shares.mean() / shares.max()), 4)


def rows(seconds: dict[str, list[float]], base: str) -> dict[str, Any]:
    """Each program's time, and its ratio to that of the first."""
    return {
        name: {
            "seconds": round(float(np.median(each)), 5),
            "ratio": timing.ratio(each, seconds[base]),
            "all seconds": [round(second, 5) for second in each],
        }
        for name, each in seconds.items()
    }


def on_host_devices(number: int, function: Callable[..., Any], *arguments: Any) -> Any:
    """The result of a function of this module, in a process whose host has so many devices."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={number}"
    with (
        mock.patch.dict(os.environ, XLA_FLAGS=flags),
        ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool,
    ):
        return pool.submit(function, *arguments).result()


def draw(found: dict[str, Any], path: Path) -> None:
    figure, (strong, weak) = plt.subplots(1, 2, figsize=(8, 3.6), layout="constrained")
    for panel, names in ((strong, (IMAGE, GRADIENT)), (weak, (WEAK,))):
        for name, style in zip(names, ("C0o-", "C1s-"), strict=False):
            of = {int(number): row["ratio"] for number, row in found[name].items() if number.isdigit()}
            middle = np.array([ratio["median"] for ratio in of.values()])
            bars = [middle - [r["low"] for r in of.values()], [r["high"] for r in of.values()] - middle]
            panel.errorbar(list(of), middle, np.abs(bars), fmt=style, markersize=4, capsize=2, label=name)
        panel.axhline(1, color="k", linestyle=":", linewidth=1)
        panel.set_xscale("log", base=2)
        panel.set_xticks(NUMBERS, NUMBERS)
        panel.set_ylim(bottom=0)
        panel.set_xlabel(
            "devices, parts of one host" if found["platform"] == "cpu" else "devices", fontsize=9
        )
        panel.tick_params(labelsize=8)
        if panel is strong:
            panel.legend(fontsize=8)
        panel.grid(alpha=0.3)
    strong.set_title(f"one image of {found['pixels']}² pixels", fontsize=9)
    strong.set_ylabel("time over that without devices=", fontsize=9)
    weak.set_title(f"an image of {found['pixels a device']}² pixels for each device", fontsize=9)
    weak.set_ylabel("time over that of one device", fontsize=9)
    common.save(figure, path)


@common.experiment(
    "scaling",
    "How does the time of an image, and of its gradient, change with the number of devices?",
    __doc__,
    size=512,
    resolution=256,
    repetitions=9,
)
def main(chosen: Namespace) -> common.Answer:
    if chosen.quick:
        chosen.size, chosen.resolution, chosen.repetitions = 32, 24, 1
    share = chosen.size // 2
    found = on_host_devices(max(NUMBERS), measure, chosen.size, share, chosen.resolution, chosen.repetitions)
    found |= {"pixels": chosen.size, "pixels a device": share, "voxels": chosen.resolution}
    for name in (IMAGE, GRADIENT, WEAK):
        for number, row in found[name].items():
            print(
                f"{name:18} {number:>9} {row['seconds'] * 1e3:9.1f} ms {row['ratio']['median']:6.3f} x"
                f" balance {row.get('balance', '')}"
            )
    return found, partial(draw, found)


if __name__ == "__main__":
    main()
