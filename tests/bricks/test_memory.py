"""Does memory stay within the budget, and is nothing lost or repeated if a render is killed?"""

import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

import jaxvol as jv
from experiments.peak_memory import STATUS
from jaxvol.bricks.files import FileSource
from jaxvol.bricks.opening import source_of
from jaxvol.bricks.render import bricks_of

from .scenes import CAMERA, LEAPING, PLAIN, TRANSFER, balls, raw_file


SIDE = 461
"""Voxels along the side of a volume of 93 MiB, in which all is visible."""
BUDGET = 24
BESIDE = 48
"""MiB that an image of 32 x 32 pixels may take beside its voxels, once its programs are compiled."""

IMAGES = """
    import sys
    import jax, jaxvol as jv
    from experiments.peak_memory import forget_peak, held, peak
    from jaxvol.bricks.files import FileSource
    path, n, budget = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    transfer = jv.TransferFunction([0, 255], [[1, 1, 1]] * 2, [1e-3, 1e-3])
    camera = jv.Camera((3 * n, -2 * n, n), (n / 2, n / 2, n / 2), (0, 0, 1), 30.0, size=(32, 32))

    def measure():
        forget_peak()
        before = held()
        march, raw = jv.March(1.0, (jv.SpaceLeaping(),)), {"shape": (n, n, n), "dtype": "uint8"}
        image = jv.render_bricks(path, transfer, camera, march, memory=budget, cache=None, **raw)
        print(image.bricks.loads, image.bricks.needed, peak() - before)

    measure()  # compiles
    measure()
    some = FileSource._stored

    def all_of_it(source, low, high, axes):
        whole = some(source, (0, 0, 0), source.shape, (0, 1, 2))
        return whole[tuple(map(slice, low, high))].transpose(axes)

    FileSource._stored = all_of_it
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
def test_voxels_outside_of_the_ranges_found_before_are_refused(value, tmp_path, monkeypatch):
    """As where a file changes within a tick of the clock: its fingerprint is the same."""
    data = np.full((24, 25, 26), 100, np.uint8)
    monkeypatch.setattr(FileSource, "fingerprint", lambda _: {"same": 1})

    def read():
        stream = bricks_of(source_of(tmp_path / "a.npy"), TRANSFER, CAMERA, PLAIN, memory=10**6)
        return stream.read(0, *stream.around(0))[1].result()

    np.save(tmp_path / "a.npy", data)
    np.testing.assert_array_equal(read(), data)
    data[20, 20, 20] = value
    np.save(tmp_path / "a.npy", data)
    with pytest.raises(ValueError, match=rf"a.npy changed since the ranges.* 100\.0 to 100\.0 .*{value}"):
        read()


# ---- killed ----

WAY = """
    import sys, time
    import signal
    from tests.bricks.test_memory import rendered

    # as in a terminal, however the tests are run
    signal.signal(signal.SIGINT, signal.default_int_handler)

    def wait(*_):
        print("here", flush=True)
        time.sleep(100)
"""
DURING_THE_IMAGE = """
    rendered(sys.argv[1], progress=lambda done, of: wait() if done == 2 else None)
"""
DURING_THE_PASS = """
    from jaxvol.bricks import summary
    slabs = summary.slabs

    def first(*given, **more):
        for number, slab in enumerate(slabs(*given, **more)):
            if number == 1:
                wait()
            yield slab

    summary.slabs = first
    rendered(sys.argv[1])
"""


def rendered(path, **options):
    """An image of the balls in a raw file, at a budget that takes several slabs and bricks."""
    return jv.render_bricks(path, TRANSFER, CAMERA, LEAPING, memory=90_000, **options)


def killed(way: str, path: Path, sign: signal.Signals) -> None:
    """Renders a file in another process, and ends it where it waits."""
    command = program(textwrap.dedent(WAY) + textwrap.dedent(way), path)
    how = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "cwd": Path(__file__).parents[2]}
    process = subprocess.Popen(command, **how)
    assert process.stdout is not None
    assert process.stdout.readline() == b"here\n"
    process.send_signal(sign)
    process.communicate(timeout=60)
    assert process.returncode != 0


@pytest.mark.slow
def test_an_image_that_is_killed_damages_nothing_and_only_an_unfinished_pass_is_repeated(
    tmp_path, monkeypatch
):
    path, reads, stored = raw_file(tmp_path), [], FileSource._stored
    monkeypatch.setattr(FileSource, "_stored", lambda *box: reads.append(box) or stored(*box))
    whole = rendered(path, cache=None)
    of_pass = len(reads) - whole.bricks.loads
    assert of_pass > 1
    for way, sign, finished in (
        (DURING_THE_PASS, signal.SIGKILL, False),
        (DURING_THE_IMAGE, signal.SIGKILL, True),
        (DURING_THE_IMAGE, signal.SIGINT, True),
    ):
        killed(way, path, sign)
        assert path.read_bytes() == balls().tobytes(order="F")
        caches = list(tmp_path.glob("balls*.npz"))
        assert len(caches) == finished
        reads.clear()
        again = rendered(path)
        assert len(reads) == again.bricks.loads + (0 if finished else of_pass)
        np.testing.assert_array_equal(again.rgba, whole.rgba)
        for cache in tmp_path.glob("balls*.npz"):
            cache.unlink()
