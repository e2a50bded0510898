"""Do rays sharded over two devices by `jax.shard_map` give the same image as on one?"""

import os
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv

from ..scenes import around, soft_transfer


SHARDED = """
import sys
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import Mesh, PartitionSpec as P
import jaxvol as jv

given = np.load(sys.argv[1])
volume = jv.Volume(given["data"], given["spacing"])
transfer = jv.TransferFunction(given["values"], given["colors"], given["extinction"])
march = jv.March(0.05, (jv.Jitter(5), jv.AlphaCorrection(), jv.SpaceLeaping()))
mesh = Mesh(np.array(jax.devices()), ("rays",))
rays, found = (given["origins"], given["directions"]), {}
pixels = np.stack([np.arange(len(rays[0])), np.zeros(len(rays[0]), int)], -1).astype(np.int32)


def sharded(image, specs, **more):
    return jax.jit(jax.shard_map(image, mesh=mesh, in_specs=specs, out_specs=P("rays"), **more))


def seen(transfer, origins, directions, pixels=None):
    return jv.render_rays(volume, transfer, origins, directions, march, pixels=pixels).rgba


part = sharded(seen, (P(), P("rays"), P("rays")))
image, pull = jax.vjp(lambda transfer: part(transfer, *rays), transfer)
assert len(image.sharding.device_set) == 2
gradient = pull(given["weights"])[0]
bare = jax.shard_map(seen, mesh=mesh, in_specs=(P(), P("rays"), P("rays")), out_specs=P("rays"))
np.testing.assert_allclose(bare(transfer, *rays), image, atol=5e-6, rtol=0)
unchecked = sharded(seen, (P(), P("rays"), P("rays"), P("rays")), check_vma=False)(transfer, *rays, pixels)
leaves = {"colors": gradient.colors, "extinction": gradient.extinction}
np.savez(sys.argv[2], image=image, unchecked=unchecked, **leaves)
"""


@pytest.fixture(scope="module")
def scene():
    """Two beams of rays through a block in empty space."""
    data = np.zeros((20, 20, 20), np.uint8)
    data[7:14, 6:13, 8:15] = np.random.default_rng(0).integers(90, 255, (7, 7, 7))
    volume = jv.Volume(data, (0.05, 0.06, 0.04))
    points = soft_transfer(0.2)
    transfer = jv.TransferFunction(points.values * 255, points.colors, points.extinction)
    rays = tuple(np.asarray(part).reshape(-1, 3) for part in around(volume, (32, 16)).rays())
    weights = np.random.default_rng(1).normal(size=(len(rays[0]), 4)).astype(np.float32)
    return volume, transfer, rays, weights


@pytest.fixture(scope="module")
def sharded(scene, tmp_path_factory):
    """Results on two devices, computed in a subprocess."""
    volume, transfer, (origins, directions), weights = scene
    folder = tmp_path_factory.mktemp("sharded")
    points: dict[str, Any] = {
        name: np.asarray(getattr(transfer, name)) for name in ("values", "colors", "extinction")
    }
    np.savez(
        folder / "given.npz",
        data=np.asarray(volume.data),
        spacing=np.asarray(volume.spacing),
        **points,
        origins=origins,
        directions=directions,
        weights=weights,
    )
    (folder / "sharded.py").write_text(SHARDED)
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    devices = {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    subprocess.run(
        [sys.executable, folder / "sharded.py", folder / "given.npz", folder / "seen.npz"],
        env={**os.environ, **devices, "PYTHONPATH": ":".join(sys.path)},
        check=True,
    )
    return dict(np.load(folder / "seen.npz"))


def test_image_and_gradient_are_those_of_one_device(scene, sharded):
    volume, transfer, rays, weights = scene
    march = jv.March(0.05, (jv.Jitter(5), jv.AlphaCorrection(), jv.SpaceLeaping()))

    @jax.jit  # as for the shards, since compiled programs round differently
    def image(transfer):
        return jv.render_rays(volume, transfer, *rays, march=march).rgba

    whole, pull = jax.vjp(image, transfer)
    gradient = pull(jnp.asarray(weights))[0]
    assert float(whole[:, 3].max()) > 0.5
    # programs of other shapes round differently; a different jitter would change pixels by a tenth
    np.testing.assert_allclose(sharded["image"], whole, atol=5e-6, rtol=0)
    np.testing.assert_allclose(sharded["unchecked"], whole, atol=5e-6, rtol=0)
    for leaf in ("colors", "extinction"):
        expected = np.asarray(getattr(gradient, leaf))
        np.testing.assert_allclose(
            sharded[leaf], expected, atol=1e-5 * float(np.linalg.norm(expected)), rtol=0
        )


def test_pixels_must_be_integers_for_every_ray(scene):
    volume, transfer, rays, _ = scene
    with pytest.raises(ValueError, match=r"pixels must be integers of shape \(512, 2\); got float32"):
        jv.render_rays(volume, transfer, *rays, march=jv.March(0.05), pixels=np.zeros((512, 2), np.float32))
