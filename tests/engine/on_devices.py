"""What `test_devices.py` runs in a process of eight devices. A case is a function of this file: it compares
what several devices render with what one does."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec as P

import jaxvol as jv
from jaxvol.engine import devices
from jaxvol.engine.rays import RayTiles
from jaxvol.engine.tiling import Tiling
from jaxvol.lighting import Phong

from ..bricks.test_render_bricks import SIDE, assert_same as assert_same_bricks, fog
from ..scenes import CAMERAS, RESOLUTION, anisotropic_noise, around, soft_transfer


SIZE = (65, 43)  # 9 x 6 beams, the last ones cut
MOVING = (jv.Jitter(5), jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination(1e-3))
SHIFTED = (jv.EmptySpaceJitter(4), jv.AdaptiveSampling(0.02), jv.SpaceLeaping(), jv.AlphaCorrection())
FIELDS = ("rgba", "depth", "samples", "aligned", "exhausted", "normal", "error")


def all_devices() -> list[Any]:
    found = jax.devices()
    assert len(found) == 8
    return found


def blocks() -> jv.Volume:
    """Noise, with empty space on one side."""
    volume = anisotropic_noise()
    data = np.array(volume.data)
    data[: RESOLUTION // 2, :, : RESOLUTION // 2] = 0
    return jv.Volume(data, volume.spacing, volume.origin)


def large() -> jv.Volume:
    """One that is copied to devices once."""
    small = blocks()
    data = np.kron(np.array(small.data), np.ones((2, 2, 1), np.float32))
    assert data.nbytes > devices.LARGE
    return jv.Volume(data, small.spacing / 2, small.origin)


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


def image_and_gradient():
    """On eight devices, of all that has a gradient."""
    volume, march = large(), jv.March(0.05, MOVING)
    parts = volume, thin(), around(volume, SIZE), march

    def loss(parts: Any, given: Any) -> tuple[Any, jv.Rendering]:
        rendering = jv.render(*parts, devices=given)
        return jnp.sum(rendering.rgba * weights()) + 0.1 * jnp.sum(jnp.minimum(rendering.depth, 9)), rendering

    (of_one, one), (of_all, every) = (
        eqx.filter_grad(loss, has_aux=True)(parts, given) for given in (None, all_devices())
    )
    assert_same(every, one)
    assert every.rgba.sharding.is_fully_replicated
    assert every.rgba.sharding.device_set == set(all_devices())
    assert_same_gradient(of_all, of_one)


def balance():
    """Of a 512² image, every device has as many rays of a narrow object as any other, wherever it is."""
    for name, seen in shapes(*np.indices((512, 512))[::-1]).items():
        counts = on_each(jnp.asarray(seen, jnp.int32))
        assert counts.sum() == seen.sum()
        assert counts.min() > 0.8 * counts.mean(), (name, counts)


def shapes(x: np.ndarray, y: np.ndarray) -> dict[str, np.ndarray]:
    """Pixels of some objects."""
    return {
        "all": x >= 0,
        "a bar upright": abs(x - 133) < 4,
        "a bar across": abs(y - 300) < 4,
        "a ball": np.hypot(x - 200, y - 270) < 60,
    }


def on_each(image: jax.Array) -> np.ndarray:
    """The sum of an image's pixels over those that each of all devices has."""
    mesh = devices.mesh_of(all_devices())
    height, width = image.shape
    camera = around(blocks(), (width, height))
    tiles = RayTiles.of(camera, Tiling(devices=mesh))

    def own(image: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        mine = tiles.disassemble(image)
        return tiles.assemble(mine), jnp.sum(mine)[None]

    whole, counts = devices.split(mesh, own, image, None)
    np.testing.assert_array_equal(whole, image)
    assert [shard.device for shard in counts.addressable_shards] == all_devices()
    return np.asarray(counts)


def owned_bricks():
    """Bricks of four devices, some in front of others on every ray, against the whole volume on one. They are
    kept as they are stored, with z in front."""
    volume, march = blocks(), jv.March(0.05, MOVING[:3])
    camera = around(volume, SIZE)
    one = jv.render(volume, thin(), camera, march)
    data, place = np.asfortranarray(volume.data), {"spacing": volume.spacing, "origin": volume.origin}
    found = jv.render_bricks(
        data, thin(), camera, march, **place, bricks=(2, 2, 2), devices=all_devices()[:4], own="bricks"
    )
    assert found.bricks.loads == found.bricks.needed == 8
    # leaps end at bricks, so that the number of samples may differ
    assert_same(found, one, 2e-5, ("rgba", "depth", "aligned", "exhausted"))


def refused():
    """Devices inside of a `shard_map`, and those of another kind of argument."""
    volume, march = blocks(), jv.March(0.05)
    camera, mesh = around(volume), jax.make_mesh((8,), ("rays",), axis_types=(jax.sharding.AxisType.Auto,))

    def image(step: jax.Array) -> jax.Array:
        march = jv.March(step.sum(), ())
        return jv.render(volume, thin(), camera, march, devices=mesh).rgba[:1]

    for checked in (True, False):
        inside = jax.shard_map(image, mesh=mesh, in_specs=P("rays"), out_specs=P("rays"), check_vma=checked)
        with pytest.raises(ValueError, match=r"devices cannot be given inside jax\.shard_map"):
            jax.jit(inside)(jnp.full(8, 0.05))
    two = jax.make_mesh((2, 4), ("x", "y"))
    for wrong, message in (
        (two, r"one axis; got a mesh of the axes \{'x': 2, 'y': 4\}"),
        ([all_devices()[0]] * 2, "one or more different devices of one platform"),
    ):
        with pytest.raises(ValueError, match=message):
            jv.render(volume, thin(), camera, march, devices=wrong)


# ---- slow ----


def numbers_of_devices():
    volume, march = blocks(), jv.March(0.05, MOVING)
    parts = volume, thin(), around(volume, SIZE), march
    one = jv.render(*parts)
    for number in (1, 2, 3, 4, 8):
        assert_same(jv.render(*parts, devices=all_devices()[:number]), one)
    mesh = jax.make_mesh((8,), ("x",))
    assert_same(jv.render(*parts, devices=mesh), one)
    # arrays that lie on one device only
    moved = jax.device_put(parts, all_devices()[3])
    assert_same(jv.render(*moved, devices=mesh), one)


def sizes():
    """Images of one pixel, of fewer beams than devices, and of a whole number of beams for each."""
    volume, march = blocks(), jv.March(0.05, MOVING[:1])
    for size in ((1, 1), (3, 70), (64, 64)):
        camera = around(volume, size)
        one, every = (
            jv.render(volume, thin(), camera, march, outputs="rgba", devices=given)
            for given in (None, all_devices())
        )
        assert every.rgba.shape == (*size[::-1], 4)
        assert_same(every, one)


def every_device_works():
    """At 512², by the samples that each device takes."""
    volume = jv.phantom("head", 64)
    camera = jv.Camera.looking_at(volume, (0.5, -0.9, 0.3), size=(512, 512))
    transfer = jv.TransferFunction.from_points([(60, (0, 0, 0), 0.0), (255, (1, 1, 1), 0.9)], 0.02)
    march = jv.March(0.03, (jv.Jitter(1), jv.SpaceLeaping(), jv.AlphaCorrection()))
    one, every = (
        jv.render(volume, transfer, camera, march, devices=given) for given in (None, all_devices())
    )
    assert_same(every, one)
    samples = on_each(every.samples)
    assert samples.min() > 0.9 * samples.mean(), samples


def modes():
    """Transforms whose cells depend on what lies before; light; and pixels computed after the march."""
    volume, camera = blocks(), around(blocks(), SIZE)
    light = Phong()
    cases = {
        "shifted": (jv.March(0.05, SHIFTED), {"lighting": light}),
        "isosurface": (jv.March(0.05, MOVING[:2]), {"compositing": jv.Isosurface(0.5), "lighting": light}),
        "average": (jv.March(0.05, MOVING[:1]), {"compositing": "average"}),
        "minimum distance": (jv.March(0.05, (jv.SpaceLeaping("min_distance"),)), {}),
        "beam": (jv.March(0.05, (jv.Jitter(2), jv.SpaceLeaping("beam"))), {"outputs": "rgba"}),
    }
    for name, (march, more) in cases.items():
        print(name, flush=True)
        one, every = (
            jv.render(volume, thin(), camera, march, devices=given, **more) for given in (None, all_devices())
        )
        assert_same(every, one)

    def loss(parts: Any, given: Any) -> Any:
        mode, volume = parts
        march, more = cases["isosurface"]
        return jnp.sum(
            jv.render(volume, thin(), camera, march, devices=given, **(more | {"compositing": mode})).rgba
            * weights()
        )

    of_one, of_all = (
        eqx.filter_grad(loss)((jv.Isosurface(0.5), volume), given) for given in (None, all_devices())
    )
    assert_same_gradient(of_all, of_one)


def adjoints():
    """Lit, in reverse mode; in forward mode; and by JAX through the reference engine."""
    volume, march = blocks(), jv.March(0.05, (jv.Jitter(5), jv.AlphaCorrection()))
    camera = around(volume, (33, 17))
    target = weights((33, 17))

    def loss(transfer: jv.TransferFunction, camera: jv.Camera, given: Any, **more: Any) -> Any:
        return jnp.sum(jv.render(volume, transfer, camera, march, devices=given, **more).rgba * target)

    for more in ({"lighting": Phong()}, {"adjoint": "direct"}):
        print(more, flush=True)
        of_one, of_all = (
            jax.grad(partial(loss, given=given, **more), (0, 1), allow_int=True)(thin(), camera)
            for given in (None, all_devices())
        )
        assert_same_gradient(*(eqx.filter(each, eqx.is_inexact_array) for each in (of_all, of_one)))
    print("forward", flush=True)

    def at(position: jax.Array, given: Any) -> Any:
        moved = eqx.tree_at(lambda camera: camera.position, camera, position)
        return loss(thin(), moved, given, adjoint="forward")

    of_one, of_all = (
        jax.jacfwd(partial(at, given=given))(camera.position) for given in (None, all_devices())
    )
    assert_same_gradient(of_all, of_one)


def transformations():
    """Inside `jax.jit` and `jax.vmap`, also of a gradient."""
    volume, march = blocks(), jv.March(0.05, MOVING)
    camera, extinctions = around(volume, (33, 17)), jnp.stack([thin().extinction, 2 * thin().extinction])

    def image(extinction: jax.Array, given: Any) -> jax.Array:
        transfer = eqx.tree_at(lambda transfer: transfer.extinction, thin(), extinction)
        return jv.render(volume, transfer, camera, march, outputs="rgba", devices=given).rgba

    def slope(extinction: jax.Array, given: Any) -> jax.Array:
        return jax.grad(lambda extinction: jnp.sum(image(extinction, given) * weights((33, 17))))(extinction)

    every = all_devices()
    one = image(extinctions[0], None)
    np.testing.assert_allclose(jax.jit(image, static_argnums=1)(extinctions[0], tuple(every)), one, atol=1e-6)
    # programs for batches of different sizes round differently: samples move by the last bit of a position
    one = jax.vmap(partial(image, given=None))(extinctions)
    for over in (jax.vmap(partial(image, given=every)), jax.jit(jax.vmap(partial(image, given=every)))):
        np.testing.assert_allclose(over(extinctions), one, atol=2e-6)
    slopes = jnp.stack([slope(each, None) for each in extinctions])
    assert_same_gradient(jax.vmap(partial(slope, given=every))(extinctions), slopes)


def own_rays():
    """Rays whose number is no multiple of anything, fewer than devices, and none: jittered by their index."""
    volume, march = blocks(), jv.March(0.05, MOVING[:1])
    origins, directions = (np.asarray(part).reshape(-1, 3) for part in around(volume, (33, 17)).rays())
    for some in (slice(None), slice(250, 253), slice(0)):
        one, every = (
            jv.render_rays(volume, thin(), origins[some], directions[some], march, devices=given)
            for given in (None, all_devices())
        )
        assert every.rgba.shape == (len(origins[some]), 4)
        if every.rgba.size:
            assert_same(every, one)


def owned_from_everywhere():
    """Bricks that are owned, by more and by fewer devices than there are bricks; and rays that end early."""
    volume, every = blocks(), all_devices()
    more: dict[str, Any]
    for name, camera in CAMERAS.items():
        for march, more in (
            (jv.March(0.05, MOVING[:3]), {}),
            (jv.March(0.05, (jv.Jitter(2), jv.Clip((-0.2, 0.9, -0.9, 0.3, 0, 1.9)))), {"lighting": Phong()}),
        ):
            print(name, flush=True)
            given = volume, thin(), camera(volume, SIZE), march
            one = jv.render(*given, **more)
            for number, counts in ((3, (2, 2, 2)), (8, None), (8, (1, 1, 2))):
                found = jv.render_bricks(*given, bricks=counts, devices=every[:number], own="bricks", **more)
                assert_same(found, one, 2e-5, ("rgba", "depth", "aligned", "exhausted"))

    camera = around(volume, SIZE)
    ended = jv.March(0.05, (jv.Jitter(5), jv.EarlyTermination(0.1)))
    plain = jv.March(0.05, (jv.Jitter(5),))
    whole = jv.render(volume, soft_transfer(), camera, plain).rgba
    found = jv.render_bricks(
        volume, soft_transfer(), camera, ended, bricks=(2, 2, 2), devices=every[:4], own="bricks"
    ).rgba
    assert 0 < float(jnp.abs(found - whole).max()) <= 0.1


def bricks():
    """Rays of all bricks dealt out: with cells that depend on what lies in front, with pixels computed after
    the march, and a gradient."""
    volume, every = blocks(), all_devices()
    camera = around(volume, SIZE)
    more: dict[str, Any]
    for march, more in (
        (jv.March(0.05, SHIFTED), {}),
        (jv.March(0.05, MOVING[:2]), {"compositing": jv.Isosurface(0.5)}),
    ):
        one = jv.render(volume, thin(), camera, march, **more)
        found = jv.render_bricks(volume, thin(), camera, march, bricks=(2, 2, 2), devices=every, **more)
        assert_same(found, one, 2e-5, ("rgba", "depth", "exhausted"))

    def loss(transfer: jv.TransferFunction, render: Callable[..., jv.Rendering], **more: Any) -> Any:
        return jnp.sum(render(volume, transfer, camera, jv.March(0.05, MOVING[:3]), **more).rgba * weights())

    # a leap counts as empty what has no extinction, and blocks of bricks are others
    some = eqx.tree_at(lambda t: t.extinction, thin(), jnp.maximum(thin().extinction, 1e-3))
    of_one = jax.grad(loss)(some, jv.render)
    assert_same_gradient(jax.grad(loss)(some, jv.render_bricks, bricks=(2, 2, 2), devices=every), of_one)


def curved_bricks():
    """A probe's rays are curved in its grid: rays are dealt out."""
    volume, probe, transfer = fog()
    given = volume, transfer, SIDE, jv.March(1.0, (probe, jv.Jitter(0)))
    found = jv.render_bricks(*given, bricks=(2, 3, 2), devices=all_devices())
    assert found.bricks.loads == found.bricks.needed == 12
    assert_same_bricks(jv.render(*given), found)


def run(*names: str) -> None:
    """Runs these cases."""
    for name in names:
        print(f"-- {name}", flush=True)
        globals()[name]()
