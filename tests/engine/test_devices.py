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
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, PartitionSpec as P

import jaxvol as jv
from jaxvol.bricks.distributed import bounds_of

from ..bricks import scenes
from ..scenes import anisotropic_noise, around, soft_transfer


ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "several_processes.py"


def environment(devices: int) -> dict[str, str]:
    """That of a process with so many devices."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    return {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PYTHONPATH": ":".join(sys.path)}


def on_eight_devices(fault: str | None, known: Path | str, *cases: str) -> None:
    """Runs cases of `on_devices.py`, with the fault of this session, if any."""
    start = f"""import sys
from tests import faults
from tests.engine import on_devices
if {fault!r}:
    faults.all_faults()[{fault!r}].inject()
on_devices.run(*sys.argv[1:])"""
    command = [sys.executable, "-c", start, str(known), *cases]
    found = subprocess.run(command, cwd=ROOT, env=environment(8), capture_output=True, text=True, check=False)
    assert found.returncode == 0, f"{found.stdout[-2000:]}\n{found.stderr[-6000:]}"


@pytest.fixture
def fault(request) -> str | None:
    return request.config.option.fault


CASES = "image_and_gradient", "owned_bricks", "sharded_by_caller"


def test_work_is_balanced_and_image_gradient_and_owned_bricks_are_those_of_one_device(fault, tmp_path):
    (gradient, one), whole = scenes.whole_gradient(), scenes.whole()
    known: dict[str, Any] = {name: getattr(one, name) for name in ("rgba", "depth", "samples")}
    known |= {f"{name} by bricks": getattr(whole, name) for name in ("rgba", "depth")}
    known |= {f"gradient {i}": leaf for i, leaf in enumerate(jax.tree.leaves(gradient))}
    np.savez(tmp_path / "known.npz", **known)
    on_eight_devices(fault, tmp_path / "known.npz", "balance", *CASES)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["numbers_of_devices", "modes", "adjoints", "rays", "bricks"])
def test_on_eight_devices(case, fault):
    on_eight_devices(fault, "", case)


ZEROS = np.zeros((8, 3), np.float32)


def test_rays_that_a_caller_sharded_are_traced_with_types_checked_and_devices_are_refused_there():
    """Traced only; on two devices it runs in the slow tests."""
    volume, transfer, mesh = anisotropic_noise(), soft_transfer(), Mesh(np.array(jax.devices()), ("rays",))
    march, rays = jv.March(0.07, (jv.Jitter(5), jv.SpaceLeaping())), (ZEROS, ZEROS + 1)

    def traced(devices, checked):
        def seen(transfer, origins, directions):
            return jv.render_rays(volume, transfer, origins, directions, march, devices=devices).rgba

        specs = {"in_specs": (P(), P("rays"), P("rays")), "out_specs": P("rays")}
        sharded = jax.shard_map(seen, mesh=mesh, **specs, check_vma=checked)
        return jax.eval_shape(jax.grad(lambda transfer: jnp.sum(sharded(transfer, *rays))), transfer)

    assert traced(None, True).extinction.shape == transfer.extinction.shape
    for checked in (True, False):
        with pytest.raises(ValueError, match=r"devices= is not allowed inside jax\.shard_map"):
            traced(jax.devices(), checked)
    with pytest.raises(ValueError, match=r"pixels must be integers of shape \(8, 2\); got float32"):
        jv.render_rays(volume, transfer, *rays, march, pixels=np.zeros((8, 2), np.float32))


@pytest.mark.slow
def test_two_processes_render_the_image_of_one(tmp_path):
    """Each with two devices, over sockets of this machine; and with bricks of their own."""
    spec = importlib.util.spec_from_file_location("several_processes", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    expected = jv.render(*example.scene(32, 77)).rgba
    assert float(expected[..., 3].max()) > 0.5
    for more, tolerance in (([], 1e-6), (["--bricks"], 3e-5)):
        with socket.socket() as free:
            free.bind(("localhost", 0))
            address = f"localhost:{free.getsockname()[1]}"
        how = ["--coordinator", address, "--processes", "2", "--output", str(tmp_path / "image.npy"), *more]
        processes = [
            subprocess.Popen(
                [sys.executable, EXAMPLE, *how, "--process", str(i), "--resolution", "32", "--size", "77"],
                env=environment(2),
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
            for i in range(2)
        ]
        said = [process.communicate(timeout=600)[0] for process in processes]
        assert [process.returncode for process in processes] == [0, 0], "\n".join(said)
        assert "by 2 processes on 4 devices" in said[0]
        np.testing.assert_allclose(np.load(tmp_path / "image.npy"), expected, atol=tolerance, rtol=0)


BAD: list[tuple[Any, str]] = [
    ([], "one or more different devices of one platform; got \\[\\]"),
    ([jax.devices()[0]] * 2, "one or more different devices of one platform"),
    (8, "a sequence of JAX devices, such as jax.devices\\(\\), or .* got 8"),
    ([0, 1], "a sequence of JAX devices, .* got 0"),
    ("cpu", "a sequence of JAX devices, .* got 'cpu'"),
    (jax.make_mesh((1, 1), ("x", "y")), r".* of one axis; got a mesh of the axes \{'x': 1, 'y': 1\}"),
]


@pytest.mark.parametrize(("given", "message"), BAD)
def test_devices_that_are_none_are_refused(given, message):
    scene = anisotropic_noise(), soft_transfer(), around(anisotropic_noise())
    for render in (jv.render, jv.render_bricks):
        with pytest.raises(ValueError, match=f"devices must be {message}"):
            render(*scene, jv.March(0.07), devices=given)
    with pytest.raises(ValueError, match=f"devices must be {message}"):
        jv.render_rays(*scene[:2], (0, 0, 0), (0, 0, 1), jv.March(0.07), devices=given)


PROBE = jv.ToroidalMap(20.0, 10.0, (1.1, 2.0), (1.1, 2.0), (5.0, 30.0))
UNOWNED: list[tuple[tuple[jv.Transform, ...], dict[str, Any], str]] = [
    ((PROBE,), {}, "ToroidalMap, where a ray may come back"),
    ((jv.EmptySpaceJitter(1),), {}, "EmptySpaceJitter, which shifts"),
    ((), {"compositing": "maximum"}, "compositing by Maximum, which"),
    ((), {"compositing": "average"}, "compositing by Average, which"),
    ((), {"method": "reload"}, "method='reload'"),
]


@pytest.mark.parametrize(("transforms", "more", "message"), UNOWNED)
def test_what_does_not_join_front_to_back_is_refused_where_bricks_are_owned(transforms, more, message):
    volume, march = anisotropic_noise(), jv.March(0.07, transforms)

    def image(transfer):
        return jv.render_bricks(volume, transfer, around(volume), march, devices=jax.devices(), **more)

    with pytest.raises(ValueError, match=f"devices, which own bricks, do not go with {message}"):
        image(soft_transfer())


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
