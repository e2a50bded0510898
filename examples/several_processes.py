"""Renders one image in several processes, each with devices of its own, and saves it.

All processes run this same program. On a cluster it is started as any JAX job is, by Slurm
(`several_processes.sh`), Open MPI or Kubernetes: `jax.distributed.initialize()` then finds out by itself who
takes part. Anywhere else it is told; two processes on one machine, for example:

    python examples/several_processes.py --coordinator localhost:12345 --processes 2 --process 1 &
    python examples/several_processes.py --coordinator localhost:12345 --processes 2 --process 0

With `--bricks`, each process reads and renders parts of the volume of its own.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

import jaxvol as jv


def scene(resolution: int, size: int) -> tuple[jv.Volume, jv.TransferFunction, jv.Camera, jv.March]:
    """The head phantom under translucent skin. Jitter is the same on any number of devices."""
    volume = jv.phantom("head", resolution)
    transfer = jv.TransferFunction.from_points(
        [(60, (0.0, 0.0, 0.0), 0.0), (90, (0.8, 0.7, 0.5), 0.02), (255, (1, 1, 1), 0.9)], unit_distance=0.02
    )
    camera = jv.Camera.looking_at(volume, (0.5, -0.9, 0.3), size=(size, size))
    transforms = jv.Jitter(seed=0), jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination(1e-5)
    return volume, transfer, camera, jv.March(2 / resolution, transforms)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--coordinator", help="host:port of process 0; found out on a cluster")
    parser.add_argument("--processes", type=int, help="number of processes; found out on a cluster")
    parser.add_argument("--process", type=int, help="number of this one; found out on a cluster")
    parser.add_argument("--resolution", type=int, default=128, help="voxels along an axis")
    parser.add_argument("--size", type=int, default=512, help="pixels along a side")
    parser.add_argument(
        "--output", type=Path, default=Path("head.png"), help=".png, or .npy for (H, W, 4) floats"
    )
    parser.add_argument("--bricks", action="store_true", help="each process has parts of the volume")
    given = parser.parse_args(argv)

    # before anything else of JAX, which would begin without the other processes
    jax.distributed.initialize(given.coordinator, given.processes, given.process)
    parts = scene(given.resolution, given.size)
    if given.bricks:
        rendering = jv.render_bricks(*parts, devices=jax.devices())
    else:
        rendering = jv.render(*parts, devices=jax.devices())

    # every process has the whole image; one of them saves it
    if jax.process_index() == 0:
        if given.output.suffix == ".npy":
            np.save(given.output, rendering.rgba)
        else:
            jv.save_png(given.output, rendering.image())
        print(f"{given.output}: by {jax.process_count()} processes on {jax.device_count()} devices")


if __name__ == "__main__":
    main()
