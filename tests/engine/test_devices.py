"""Do several devices, and several processes, render the image and the gradient of one device?

Devices are those of the host, eight of them in a process of their own, since JAX is told their number before
it starts. What is checked there is in `on_devices.py`."""

import importlib.util
import os
import socket
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.bricks.owned import bounds_of

from ..scenes import anisotropic_noise, around, soft_transfer


ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "several_processes.py"


def environment(devices: int) -> dict[str, str]:
    """That of a process with so many devices."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    return {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PYTHONPATH": ":".join(sys.path)}


def on_eight_devices(*cases: str) -> None:
    """Runs cases of `on_devices.py`."""
    # `conftest` first, by which shapes and types are checked there, too
    start = "import sys, tests.conftest; from tests.engine import on_devices; on_devices.run(*sys.argv[1:])"
    command = [sys.executable, "-c", start, *cases]
    found = subprocess.run(command, cwd=ROOT, env=environment(8), capture_output=True, text=True, check=False)
    assert found.returncode == 0, f"{found.stdout[-2000:]}\n{found.stderr[-6000:]}"


def test_work_is_balanced_and_images_and_gradients_are_those_of_one_device():
    on_eight_devices("balance", "refused", "image_and_gradient")


def test_devices_that_own_bricks_render_the_whole():
    on_eight_devices("owned_bricks")


@pytest.mark.slow
@pytest.mark.parametrize(
    "cases",
    [
        ("numbers_of_devices", "sizes"),
        ("every_device_works", "own_rays"),
        ("modes",),
        ("adjoints",),
        ("transformations",),
        ("owned_from_everywhere",),
        ("bricks", "curved_bricks"),
    ],
    ids=" and ".join,
)
def test_on_eight_devices(cases):
    on_eight_devices(*cases)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("devices", "bricks", "tolerance"), [(1, False, 1e-6), (2, False, 1e-6), (1, True, 3e-5)]
)
def test_two_processes_render_the_image_of_one(devices, bricks, tolerance, tmp_path):
    """Each with so many devices, over sockets of this machine; and each with bricks of its own."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    size = ["--resolution", "32", "--size", "77", "--output", str(tmp_path / "image.npy")]
    processes = [
        subprocess.Popen(
            [
                sys.executable,
                EXAMPLE,
                "--coordinator",
                address,
                "--processes",
                "2",
                "--process",
                str(i),
                *size,
            ],
            env=environment(devices),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for i in range(2)
    ]
    said = [process.communicate(timeout=600)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], "\n".join(said)
    assert f"by 2 processes on {2 * devices} devices" in said[0]
    spec = importlib.util.spec_from_file_location("several_processes", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    expected = jv.render(*example.scene(32, 77)).rgba
    assert float(expected[..., 3].max()) > 0.5
    np.testing.assert_allclose(np.load(tmp_path / "image.npy"), expected, atol=tolerance, rtol=0)


BAD: dict[str, tuple[Any, str]] = {
    "none": ([], "one or more different devices of one platform; got \\[\\]"),
    "a number": (8, "a sequence of JAX devices, such as jax.devices\\(\\), or .* got 8"),
    "numbers": ([0, 1], "a sequence of JAX devices, .* got 0"),
    "a name": ("cpu", "a sequence of JAX devices, .* got 'cpu'"),
}


@pytest.mark.parametrize(("given", "message"), BAD.values(), ids=BAD)
def test_devices_that_are_none_are_refused(given, message):
    volume = anisotropic_noise()
    for render in (jv.render, jv.render_bricks):
        with pytest.raises(ValueError, match=f"devices must be {message}"):
            render(volume, soft_transfer(), around(volume), jv.March(0.07), devices=given)
    with pytest.raises(ValueError, match=f"devices must be {message}"):
        jv.render_rays(volume, soft_transfer(), (0, 0, 0), (0, 0, 1), jv.March(0.07), devices=given)


PROBE = jv.ToroidalMap(20.0, 10.0, (1.1, 2.0), (1.1, 2.0), (5.0, 30.0))
UNOWNED: dict[str, tuple[tuple[jv.Transform, ...], dict[str, Any], str]] = {
    "curved": ((PROBE,), {}, "ToroidalMap, where a ray may come back"),
    "shifted": ((jv.EmptySpaceJitter(1),), {}, "EmptySpaceJitter, which shifts"),
    "adaptive": ((jv.AdaptiveSampling(0.1),), {}, "AdaptiveSampling, whose strides"),
    "selecting": ((), {"compositing": "maximum"}, "compositing by Maximum, which"),
    "summing": ((), {"compositing": "average"}, "compositing by Average, which"),
    "naive": ((), {"method": "naive"}, "method='naive'"),
}


@pytest.mark.parametrize(("transforms", "more", "message"), UNOWNED.values(), ids=UNOWNED)
def test_what_does_not_join_front_to_back_is_refused_where_bricks_are_owned(transforms, more, message):
    volume = anisotropic_noise()
    given = volume, soft_transfer(), around(volume), jv.March(0.07, transforms)
    with pytest.raises(ValueError, match=f'own="bricks" does not go with {message}.* Use own="rays"'):
        jv.render_bricks(*given, devices=jax.devices(), own="bricks", **more)


def test_owned_bricks_have_no_gradient():
    volume = anisotropic_noise()

    def loss(transfer):
        return jv.render_bricks(
            volume, transfer, around(volume), jv.March(0.07), devices=jax.devices(), own="bricks"
        ).rgba.sum()

    with pytest.raises(ValueError, match=r'own="bricks" does not go with gradients\. Use own="rays"'):
        jax.grad(loss)(soft_transfer())
    with pytest.raises(ValueError, match="own must be one of rays, bricks; got 'voxels'"):
        jv.render_bricks(volume, soft_transfer(), around(volume), jv.March(0.07), own="voxels")


def test_devices_own_as_many_bricks_that_are_needed():
    wanted = np.array([0, 1, 1, 0, 0, 1, 0, 1, 1, 1, 0], bool)
    for number in range(1, 9):
        bounds = bounds_of(wanted, number)
        assert bounds[0][0] == 0
        assert bounds[-1][1] == len(wanted)
        assert all(a[1] == b[0] for a, b in pairwise(bounds))
        counts = [int(wanted[i:j].sum()) for i, j in bounds]
        assert max(counts) - min(counts) <= 1, counts
    assert bounds_of(np.zeros(3, bool), 2)[-1][1] == 3
