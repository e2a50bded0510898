"""How long does the first image of a fresh process take, including start, import and compilation?

The head phantom of 256³ voxels is read from a file and rendered at 512² pixels: in a process without a
compilation cache, and in one that finds compiled programs in JAX_COMPILATION_CACHE_DIR. Called by
`experiments.speed`.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import jaxvol as jv
from jaxvol.metrics import rmse

from . import harness, marches, timing
from .scenes import seen_head


CACHE = {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
"""Small programs are cached as well."""

CHILD = """
import json, sys, time
begun, voxels, size, left, image = sys.argv[1:]
import numpy as np
import jax
import jaxvol as jv
imported = time.time()
from experiments.scenes import seen_head
data = np.load(voxels)
volume = jv.Volume(data, (2 / (data.shape[0] - 1),) * 3, (-1.0,) * 3)
scene = seen_head(volume, int(size))
march = jv.March(scene.step, (jv.SpaceLeaping(), jv.EarlyTermination(float(left))))
ready = time.time()
rendering = jv.render(scene.volume, scene.transfer, scene.camera, march, outputs="rgba")
rendering = jax.block_until_ready(rendering)
done = time.time()
np.save(image, rendering.rgba)
times = [at - float(begun) for at in (imported, ready, done)]
print(json.dumps(dict(zip(("import", "scene", "image"), times))))
"""


def measure(size: int, resolution: int, left: float, repetitions: int) -> dict[str, Any]:
    """Seconds from the start of a process until the import, the scene and the image are done."""
    volume = jv.phantom("head", resolution)
    scene = seen_head(volume, size)
    truth = harness.frame(scene, marches.converged(scene.step, harness.FINER)).rgba
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        voxels, image, cache = (Path(folder) / name for name in ("voxels.npy", "image.npy", "cache"))
        np.save(voxels, np.asarray(volume.data))

        def child(more: dict[str, str]) -> dict[str, float]:
            settings = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"} | more
            arguments = [str(time.time()), str(voxels), str(size), str(left), str(image)]
            ran = subprocess.run(
                [sys.executable, "-c", CHILD, *arguments],
                cwd=Path(__file__).parent.parent,
                env=settings,
                capture_output=True,
                text=True,
                check=True,
            )
            return json.loads(ran.stdout.splitlines()[-1])

        warm = {**CACHE, "JAX_COMPILATION_CACHE_DIR": str(cache)}
        child(warm)  # fills the cache
        for name, more in (("nothing kept", {}), ("compiled before", warm)):
            times = [child(more) for _ in range(repetitions)]
            found[name] = {
                **{part: timing.median([t[part] for t in times]) for part in times[0]},
                "all": times,
                "rmse": rmse(np.load(image), truth),
            }
    return {"pixels": size, "voxels": resolution, "settings": CACHE, **found}
