"""Does memory stay within the budget?"""

import subprocess
import sys
import textwrap

import numpy as np
import pytest

from .peak_memory import STATUS


SIDE = 461
"""Voxels along the side of a volume of 93 MiB, in which all is visible."""
BUDGET = 24
BESIDE = 48
"""MiB that an image of 32 x 32 pixels may take beside its voxels, once its programs are compiled."""

IMAGES = """
    import sys
    import jax, jaxvol as jv
    from tests.bricks.peak_memory import forget_peak, held, peak
    from jaxvol.bricks.sources import VoxelSource
    path, n, budget = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    transfer = jv.TransferFunction([0, 255], [[1, 1, 1]] * 2, [1e-3, 1e-3])
    camera = jv.Camera((3 * n, -2 * n, n), (n / 2, n / 2, n / 2), (0, 0, 1), 30.0, size=(32, 32))

    def measure():
        forget_peak()
        before = held()
        march, raw = jv.March(1.0, (jv.SpaceLeaping(),)), {"shape": (n, n, n), "dtype": "uint8"}
        image = jv.render_bricks(path, transfer, camera, march, memory=budget, **raw)
        print(image.bricks.loads, image.bricks.needed, peak() - before)

    measure()  # compiles
    measure()
    some = VoxelSource._read_at_once

    def all_of_it(source, box, axes):
        whole = some(source, ((0, 0, 0), source.shape), (0, 1, 2)).copy()
        return whole[tuple(map(slice, *box))].transpose(axes)

    VoxelSource._read_at_once = all_of_it
    measure()
"""


def program(text: str, *arguments: object) -> list[str]:
    return [sys.executable, "-c", textwrap.dedent(text), *map(str, arguments)]


@pytest.mark.slow
@pytest.mark.skipif(not STATUS.exists(), reason="needs Linux's /proc")
def test_memory_stays_within_the_budget_and_30_percent(tmp_path):
    """In a process of its own. That reading everything would be seen is tested beside it."""
    path = tmp_path / "data.raw"
    x, y = np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij")
    with path.open("wb") as file:
        for z in range(SIDE):
            file.write(((x // 8 + y // 8 + z // 8) % 7 * 30 + 9).astype(np.uint8).data)
    command = program(IMAGES, path, SIDE, BUDGET * 2**20)
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    _, own, faulty = (line.split() for line in run.stdout.splitlines())
    loads, needed, peak = map(float, own)
    assert loads == needed > 10
    assert peak < 1.3 * BUDGET + BESIDE < SIDE**3 / 2**20
    assert float(faulty[2]) > SIDE**3 / 2**20
