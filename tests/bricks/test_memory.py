"""Does memory stay within the budget, and is it noticed if what is read has changed?"""

import subprocess
import sys
import textwrap

import numpy as np
import pytest

from jaxvol.bricks import source_of
from jaxvol.bricks.render import bricks_of
from tests.peak_memory import STATUS

from .scenes import CAMERA, PLAIN, TRANSFER


SIDE = 461
"""Voxels along the side of a volume of 93 MiB, in which all is visible."""
BUDGET = 24
BESIDE = 48
"""MiB that an image of 32 x 32 pixels may take beside its voxels, once its programs are compiled."""

IMAGES = """
    import sys
    import jax, jaxvol as jv
    from tests.peak_memory import forget_peak, held, peak
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
    some = VoxelSource._stored

    def all_of_it(source, box, axes):
        whole = some(source, ((0, 0, 0), source.shape), (0, 1, 2)).copy()
        return whole[tuple(map(slice, *box))].transpose(axes)

    VoxelSource._stored = all_of_it
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


# ---- what is read ----


@pytest.mark.parametrize("value", [0, 250])
def test_voxels_outside_of_the_ranges_found_before_are_refused(value, tmp_path):
    """As where another process writes to a map."""
    data = np.memmap(tmp_path / "a", np.uint8, "w+", shape=(24, 25, 26))
    data[:] = 100
    traversal = bricks_of(source_of(data), TRANSFER, CAMERA, PLAIN, memory=10**6)

    def read():
        return traversal.load(0, None, *traversal.around(0)).voxels.result()

    np.testing.assert_array_equal(read(), data)
    data[20, 20, 20] = value
    with pytest.raises(ValueError, match=rf"array changed since the ranges.* 100\.0 to 100\.0 .*{value}"):
        read()
