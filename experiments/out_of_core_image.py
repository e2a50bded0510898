"""What do images of a large volume take? Measured in a process of its own, which prints it as JSON.

`python -m experiments.out_of_core_image PATH VOXELS PIXELS MEMORY`, or `resident` in place of MEMORY (bytes):
then the volume is read into memory, and rendered as a whole. Called by `experiments.out_of_core`.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxvol as jv

from .peak_memory import peak
from .scenes import seen_head


THIN = 0.02
"""Factor to the extinction in the scene of which all is seen."""
REPETITIONS = 2
"""Images that are timed of each scene, once programs are compiled and ranges of values known."""


def read() -> float:
    """What this process has read from files so far, MiB, from the system's cache or not."""
    file = Path("/proc/self/io")
    lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
    return sum(int(line.split()[1]) for line in lines if line.startswith("rchar")) / 2**20


def scenes(pixels: int) -> tuple[dict[str, jv.TransferFunction], jv.Camera]:
    """The transfer functions, and the camera, whatever the number of voxels."""
    _, opaque, camera, _ = seen_head(jv.phantom("head", 16), pixels)
    thin = jv.TransferFunction(opaque.values, opaque.colors, THIN * opaque.extinction)
    return {"opaque": opaque, "translucent": thin}, camera


def measure(path: Path, voxels: int, pixels: int, memory: int | None) -> dict[str, Any]:
    """Time and memory of images of a file, at steps of one voxel, leaping over empty space."""
    transfers, camera = scenes(pixels)
    spacing, origin = (2 / (voxels - 1),) * 3, (-1.0,) * 3
    march = jv.March(spacing[0], (jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination()), "midpoint")
    raw = {"shape": (voxels,) * 3, "dtype": "uint8"} if path.suffix == ".raw" else {}
    jax.block_until_ready(camera.position + 1)  # JAX is up
    found: dict[str, Any] = {"before": round(peak(), 1)}
    volume = source = None
    if memory is not None:
        source = jv.bricks.source_of(path, spacing=spacing, origin=origin, **raw)
    else:
        begun = time.perf_counter()
        data = np.fromfile(path, np.uint8).reshape((voxels,) * 3).T
        volume = jv.Volume(data, spacing, origin)
        del data
        found["seconds to read"] = round(time.perf_counter() - begun, 3)

    def image(transfer: jv.TransferFunction) -> jv.Rendering:
        if volume is not None:
            return jv.render(volume, transfer, camera, march, outputs="rgba")
        return jv.render_bricks(source, transfer, camera, march, outputs="rgba", memory=memory)

    for name, transfer in transfers.items():
        row = found[name] = {}
        begun = time.perf_counter()
        rendering = jax.block_until_ready(image(transfer))
        row["first seconds"] = round(time.perf_counter() - begun, 3)
        row["seconds"], before = [], read()
        for _ in range(REPETITIONS):
            begun, before = time.perf_counter(), read()
            rendering = jax.block_until_ready(image(transfer))
            row["seconds"].append(round(time.perf_counter() - begun, 3))
        row["peak"] = round(peak() - found["before"], 1)
        row["mean"] = np.mean(np.asarray(rendering.rgba, np.float64), (0, 1)).tolist()
        if volume is not None:
            samples = jv.render(volume, transfer, camera, march).samples
            row["samples"] = int(np.sum(np.asarray(samples), dtype=np.int64))
        else:
            row["MiB read"] = round(read() - before, 1)
            row["bricks"] = rendering.bricks._asdict()
    return found


if __name__ == "__main__":
    path, voxels, pixels, memory = sys.argv[1:]
    budget = None if memory == "resident" else int(memory)
    print(json.dumps(measure(Path(path), int(voxels), int(pixels), budget)))
