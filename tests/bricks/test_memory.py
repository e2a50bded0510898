"""Does memory stay within the budget, and is nothing lost or repeated if a render is killed?"""

import os
import signal
import subprocess
import sys
import textwrap
from hashlib import blake2b
from pathlib import Path

import numpy as np
import pytest

import jaxvol as jv
from experiments.peak_memory import STATUS
from jaxvol.bricks import stream
from jaxvol.bricks.files import FileSource

from .test_render_bricks import TRANSFER, balls, outside


SIDE = 577
"""Voxels along the side of a volume of 183 MiB, in which all is visible."""
BUDGET = 24
BESIDE = 48
"""MiB that an image of 32 x 32 pixels may take beside its voxels, once its programs are compiled."""

LINUX = pytest.mark.skipif(not STATUS.exists(), reason="needs Linux's /proc")

PEAK = """
    from experiments.peak_memory import peak
    print(peak())
"""

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


@LINUX
def test_a_peak_is_that_of_the_process_alone():
    """And not of what started it, which may have held more than any bound asks for."""
    here = b"." * 2**28
    run = subprocess.run(program(PEAK), capture_output=True, text=True, check=True)
    assert 1 < float(run.stdout) < 64 < len(here) / 2**20


def test_what_was_freed_goes_back_once_much_was_read(file, monkeypatch):
    """After each of many small bricks it would take as long as marching through them."""
    returns = []
    monkeypatch.setattr(stream, "give_back", lambda: returns.append(None))
    bricks = rendered(file).bricks
    assert bricks.loads > 2
    assert returns == []
    monkeypatch.setattr(stream, "KEPT", 2 * bricks.bytes_read // bricks.loads)
    rendered(file)
    assert len(returns) == bricks.loads // 2


@pytest.mark.slow
@LINUX
def test_memory_stays_within_the_budget_and_30_percent(tmp_path):
    """In a process of its own. That reading everything would be seen is tested beside it."""
    path = tmp_path / "data.raw"
    x, y = np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij")
    with path.open("wb") as file:
        for z in range(SIDE):
            file.write(((x // 8 + y // 8 + z // 8) % 7 * 30 + 9).astype(np.uint8).data)
    run = subprocess.run(
        program(IMAGES, path, SIDE, BUDGET * 2**20), capture_output=True, text=True, check=True
    )
    _, own, faulty = (line.split() for line in run.stdout.splitlines())
    loads, needed, peak = map(float, own)
    assert loads == needed > 20
    assert peak < 1.3 * BUDGET + BESIDE < SIDE**3 / 2**20
    assert float(faulty[2]) > SIDE**3 / 2**20


WAY = """
    import sys, time
    import signal
    import jaxvol as jv
    from tests.bricks.test_memory import rendered

    # as in a terminal, however the tests are run
    signal.signal(signal.SIGINT, signal.default_int_handler)

    def wait(*_):
        print("here", flush=True)
        time.sleep(100)
"""
DURING_THE_IMAGE = """
    def second(done, of):
        if done == 2:
            wait()

    rendered(sys.argv[1], progress=second)
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
WHILE_THE_CACHE_IS_WRITTEN = """
    import os
    os.replace = wait
    rendered(sys.argv[1])
"""


def rendered(path, **options):
    """An image of the balls in a raw file, at a budget that takes several slabs and bricks."""
    march, camera = jv.March(0.5, (jv.SpaceLeaping(),)), outside(jv.Volume(balls()), 24)
    return jv.render_bricks(path, TRANSFER, camera, march, memory=115_000, **options)


def killed(way: str, path: Path, sign: signal.Signals) -> None:
    """Renders a file in another process, and ends it where it waits."""
    process = subprocess.Popen(
        program(textwrap.dedent(WAY) + textwrap.dedent(way), path),
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        cwd=Path(__file__).parents[2],
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"here\n"
    process.send_signal(sign)
    process.communicate(timeout=60)
    assert process.returncode != 0


def checksums(folder: Path) -> dict[str, str]:
    return {file.name: blake2b(file.read_bytes()).hexdigest() for file in folder.iterdir()}


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "balls_41x35x50_uint8.raw"
    path.write_bytes(balls().tobytes(order="F"))
    return path


@pytest.fixture
def reads(monkeypatch):
    """The boxes that are read of files."""
    boxes, stored = [], FileSource._stored

    def counted(source, low, high, axes):
        boxes.append((low, high))
        return stored(source, low, high, axes)

    monkeypatch.setattr(FileSource, "_stored", counted)
    return boxes


@pytest.mark.slow
@pytest.mark.parametrize("sign", [signal.SIGKILL, signal.SIGINT])
def test_an_image_that_is_killed_damages_nothing_and_its_pass_is_not_repeated(file, reads, sign):
    whole = rendered(file)
    before = checksums(file.parent)
    of_pass = len(reads) - whole.bricks.loads
    assert of_pass > 1
    [cache] = file.parent.glob("balls*.npz")
    cache.unlink()
    killed(DURING_THE_IMAGE, file, sign)
    assert checksums(file.parent).keys() == before.keys()
    assert checksums(file.parent)[file.name] == before[file.name]
    after, _ = checksums(file.parent), reads.clear()
    again = rendered(file)
    assert len(reads) == again.bricks.loads == whole.bricks.loads
    assert checksums(file.parent) == after
    np.testing.assert_array_equal(again.rgba, whole.rgba)


@pytest.mark.slow
@pytest.mark.parametrize("way", [DURING_THE_PASS, WHILE_THE_CACHE_IS_WRITTEN])
def test_a_pass_that_is_killed_begins_anew(file, reads, way):
    whole = rendered(file, cache=None)
    expected, _ = len(reads), reads.clear()
    killed(way, file, signal.SIGKILL)
    assert not list(file.parent.glob("balls*.npz"))
    again = rendered(file)
    assert len(reads) == expected > again.bricks.loads
    np.testing.assert_array_equal(again.rgba, whole.rgba)
    assert len(list(file.parent.glob("balls*.npz"))) == 1
    assert os.stat(file).st_size == balls().size
