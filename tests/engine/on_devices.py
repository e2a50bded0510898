"""What `test_devices.py` runs in a process of eight devices. A case is a function of this file: it compares
what several devices render with what one does, which the fast cases are given."""

from functools import cache, partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec as P

import jaxvol as jv
from jaxvol.engine import devices
from jaxvol.engine.tiling import Tiling
from jaxvol.lighting import Phong

from ..bricks import scenes
from ..bricks.scenes import CAMERA, LEAPING, PLACE, TRANSFER
from ..scenes import CAMERAS, RESOLUTION, anisotropic_noise, around, soft_transfer


SIZE = (65, 43)  # 9 x 6 beams, the last ones cut
MOVING = (jv.Jitter(5), jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination(1e-3))
FIELDS = ("rgba", "depth", "aligned", "exhausted", "normal")
"""How many samples are taken depends on which rays leap together."""


def all_devices() -> list[Any]:
    found = jax.devices()
    assert len(found) == 8
    return found


@cache
def blocks() -> jv.Volume:
    """Noise, with empty space on one side."""
    volume = anisotropic_noise()
    data = np.array(volume.data)
    data[: RESOLUTION // 2, :, : RESOLUTION // 2] = 0
    return jv.Volume(data, volume.spacing, volume.origin)


def thin() -> jv.TransferFunction:
    """Of which rays see many cells."""
    return soft_transfer(3.0)


def assert_same(found: jv.Rendering, expected: jv.Rendering, tolerance: float = 1e-6, fields=FIELDS) -> None:
    assert float(expected.rgba[..., 3].max()) > 0.1
    for name in fields:
        if getattr(expected.details, name, True) is None or not hasattr(expected, name):
            continue
        one, two = (np.asarray(getattr(each, name), float) for each in (found, expected))
        np.testing.assert_array_equal(np.isinf(one), np.isinf(two))
        np.testing.assert_allclose(one, two, atol=tolerance, rtol=0, err_msg=name)


def assert_same_gradient(found: Any, expected: Any) -> None:
    for one, two in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        scale = float(np.linalg.norm(two))
        np.testing.assert_allclose(one, two, atol=1e-5 * scale + 1e-12, rtol=0)


def weights(size: tuple[int, int] = SIZE) -> jax.Array:
    return jnp.asarray(np.random.default_rng(1).normal(size=(*size[::-1], 4)), jnp.float32)


# ---- fast ----


def image_and_gradient(known: dict[str, np.ndarray]):
    """On eight devices, of a volume that is so large that it is copied to them once."""
    assert scenes.balls().nbytes > devices.LARGE
    render = partial(scenes.of_volume, devices=all_devices())
    gradient, every = scenes.gradient_of(*scenes.AT, render)
    for name in ("rgba", "depth", "samples"):
        np.testing.assert_allclose(getattr(every, name), known[name], atol=1e-6, rtol=1e-6, err_msg=name)
    assert every.rgba.sharding.is_fully_replicated
    assert every.rgba.sharding.device_set == set(all_devices())
    leaves = jax.tree.leaves(gradient)
    assert_same_gradient(leaves, [known[f"gradient {i}"] for i in range(len(leaves))])


def owned_bricks(known: dict[str, np.ndarray]):
    """Bricks of four devices, some in front of others on every ray."""
    how: Any = {"bricks": (2, 2, 3), "devices": all_devices()[:4]}
    found = jv.render_bricks(scenes.balls(), TRANSFER, CAMERA, LEAPING, **PLACE, **how)
    assert 6 < found.bricks.loads <= found.bricks.needed
    np.testing.assert_allclose(found.rgba, known["rgba by bricks"], atol=2e-5, rtol=0)
    np.testing.assert_allclose(found.depth, known["depth by bricks"], rtol=1e-5)


def balance(_: Any):
    """Of a 512² image, every device has as many rays of a narrow object as any other, wherever it is."""
    y, x = np.indices((512, 512))
    objects = {
        "all": x >= 0,
        "a bar upright": abs(x - 133) < 4,
        "a bar across": abs(y - 300) < 4,
        "a ball": np.hypot(x - 200, y - 270) < 60,
    }
    for name, seen in objects.items():
        _, dealt, place = devices.shard_rays(around(blocks(), (512, 512)), Tiling(), 8)
        np.testing.assert_array_equal(dealt[place], np.arange(seen.size))
        counts = seen.reshape(-1)[dealt].reshape(8, -1).sum(axis=1)
        assert counts.sum() == seen.sum()
        assert counts.min() > 0.8 * counts.mean(), (name, counts)


def sharded_by_caller(_: Any):
    """The gradient by every leaf, of rays that a caller shards: that of replicated leaves is summed once."""
    volume = anisotropic_noise()
    leaves = volume, soft_transfer(3.0), jv.March(0.2, (jv.AlphaCorrection(),)), around(volume)
    arrays, static = eqx.partition(leaves, eqx.is_inexact_array)
    rows, columns = np.indices((8, 8), np.float32).reshape(2, -1) * 2
    target, two = weights((64, 1))[0], all_devices()[:2]

    def seen(arrays: Any, *pixels: Any) -> jax.Array:
        volume, transfer, march, camera = eqx.combine(arrays, static)
        origins, directions = (jnp.stack(part, -1) for part in jax.vmap(camera.ray)(*pixels))
        return jv.render_rays(volume, transfer, origins, directions, march).rgba

    def gradient(image: Any, *given: Any) -> Any:
        return jax.jit(jax.grad(lambda arrays, *pixels: jnp.sum(image(arrays, *pixels) * target)))(*given)

    one = gradient(seen, arrays, columns, rows)
    assert sum(bool(jnp.any(leaf != 0)) for leaf in jax.tree.leaves(one)) >= 10
    specs = {"in_specs": (P(), P("rays"), P("rays")), "out_specs": P("rays")}
    for mesh in (Mesh(np.array(two), ("rays",)), jax.make_mesh((2,), ("rays",), devices=two)):
        places = tuple(NamedSharding(mesh, spec) for spec in specs["in_specs"])
        given = jax.device_put((arrays, columns, rows), places)
        for checked in (True, False):
            image = jax.shard_map(seen, mesh=mesh, **specs, check_vma=checked)
            assert_same_gradient(gradient(image, *given), one)


# ---- slow ----


def numbers_of_devices(_: Any):
    parts = blocks(), thin(), around(blocks(), SIZE), jv.March(0.05, MOVING)
    one = jv.render(*parts)
    assert_same(jv.render(*parts, devices=all_devices()[:3]), one)
    how: Any = {"antialias": 2, "until": one.depth}
    assert_same(jv.render(*parts, devices=all_devices()[:3], **how), jv.render(*parts, **how))
    # arrays that lie on one device only
    moved = jax.device_put(parts, all_devices()[3])
    assert_same(jv.render(*moved, devices=jax.make_mesh((8,), ("x",))), one)
    # images of one pixel, and of fewer beams than devices
    for size in ((1, 1), (3, 70)):
        scene = blocks(), thin(), around(blocks(), size), jv.March(0.05, MOVING[:1])
        one, every = (jv.render(*scene, outputs="rgba", devices=given) for given in (None, all_devices()))
        assert every.rgba.shape == (*size[::-1], 4)
        assert_same(every, one)


def modes(_: Any):
    """Pixels that are computed after the march, with a gradient."""
    camera = around(blocks(), SIZE)

    def loss(mode: Any, given: Any) -> Any:
        how = {"compositing": mode, "devices": given}
        rendering = jv.render(blocks(), thin(), camera, jv.March(0.05, MOVING[:2]), **how)
        return jnp.sum(rendering.rgba * weights()), rendering

    (of_one, one), (of_all, every) = (
        eqx.filter_grad(loss, has_aux=True)(jv.Isosurface(0.5), given) for given in (None, all_devices())
    )
    assert_same(every, one)
    assert_same_gradient(of_all, of_one)


def adjoints(_: Any):
    """In forward mode; by JAX through the reference engine; and inside of `jax.jit` and `jax.vmap`."""
    march = jv.March(0.05, (jv.Jitter(5), jv.AlphaCorrection()))
    camera, target = around(blocks(), (33, 17)), weights((33, 17))

    def loss(extinction: jax.Array, given: Any, **more: Any) -> Any:
        transfer = eqx.tree_at(lambda transfer: transfer.extinction, thin(), extinction)
        return jnp.sum(jv.render(blocks(), transfer, camera, march, devices=given, **more).rgba * target)

    at, every = thin().extinction, all_devices()
    of_one = jax.grad(loss)(at, None)
    assert_same_gradient(jax.grad(partial(loss, given=every, adjoint="direct"))(at), of_one)
    assert_same_gradient(jax.jacfwd(partial(loss, given=every, adjoint="forward"))(at), of_one)
    two = jax.jit(jax.vmap(jax.grad(partial(loss, given=every))))(jnp.stack([at, at]))
    assert_same_gradient(two, jnp.stack([of_one, of_one]))


def rays(_: Any):
    """Rays of any number, none, and those of a caller who has sharded them, which are jittered
    by their index."""
    volume, march = blocks(), jv.March(0.05, (*MOVING[:1], *MOVING[2:3]))
    origins, directions = (np.asarray(part).reshape(-1, 3) for part in around(volume, (33, 17)).rays())
    for some in (slice(0, 251), slice(0)):
        one, every = (
            jv.render_rays(volume, thin(), origins[some], directions[some], march, devices=given)
            for given in (None, all_devices())
        )
        assert every.rgba.shape == (len(origins[some]), 4)
        if every.rgba.size:
            assert_same(every, one)

    def seen(*given: Any) -> jax.Array:
        return jv.render_rays(volume, thin(), *given, march=march).rgba

    mesh, given = Mesh(np.array(all_devices()[:2]), ("rays",)), (origins[:512], directions[:512])
    sharded = jax.shard_map(seen, mesh=mesh, in_specs=P("rays"), out_specs=P("rays"))
    two = jax.jit(sharded)(*given)
    assert len(two.sharding.device_set) == 2
    # programs of other shapes round differently; a different jitter would change pixels by a tenth
    np.testing.assert_allclose(two, jax.jit(seen)(*given), atol=5e-6, rtol=0)


def bricks(_: Any):
    """Owned by more and by fewer devices than there are, lit and clipped."""
    volume, every = blocks(), all_devices()
    clipped: tuple[jv.Transform, ...] = (jv.Jitter(2), jv.Clip((-0.2, 0.9, -0.9, 0.3, 0, 1.9)))
    given = volume, thin(), CAMERAS["orthographic"](volume, SIZE), jv.March(0.05, clipped)
    one = jv.render(*given, lighting=Phong())
    for number, counts in ((3, (2, 2, 2)), (8, (1, 1, 2))):
        how = {"devices": every[:number], "lighting": Phong()}
        found = jv.render_bricks(*given, bricks=counts, **how)
        assert_same(found, one, 2e-5, ("rgba", "depth", "aligned", "exhausted"))


def run(known: str, *names: str) -> None:
    """Runs these cases, with what one device renders."""
    for name in names:
        print(f"-- {name}", flush=True)
        globals()[name](dict(np.load(Path(known))) if known else {})
