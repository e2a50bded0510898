"""Tiles and batches do not change images, nothing is compiled twice, memory does not grow with the image."""

from functools import partial
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.engine.driver import render_scene
from jaxvol.engine.scene import Scene
from jaxvol.engine.tiling import Tiling

from ..scenes import anisotropic_noise, around, counting, in_float64, soft_transfer, to_float64


MARCH = jv.March(0.07, (jv.AlphaCorrection(),))


def assert_same(a, b, tolerance=1e-6):
    for name in ("rgba", "depth", "samples", "aligned", "exhausted"):
        left, right = np.asarray(getattr(a, name), float), np.asarray(getattr(b, name), float)
        np.testing.assert_array_equal(np.isinf(left), np.isinf(right))
        np.testing.assert_allclose(left, right, atol=tolerance, rtol=0, err_msg=name)


@pytest.mark.parametrize(
    "size", [(65, 65), *(pytest.param(size, marks=pytest.mark.slow) for size in ((1, 1), (70, 3)))]
)
def test_tiles_do_not_show(size):
    volume = anisotropic_noise()
    camera = around(volume, size)
    whole = jv.render(volume, soft_transfer(), camera, MARCH)
    assert whole.rgba.shape == (size[1], size[0], 4)
    assert whole.depth.shape == whole.samples.shape == (size[1], size[0])
    Other = counting()  # another type, hence another program
    scene = Scene(volume, Other(*jax.tree.leaves(soft_transfer())), camera, MARCH)
    assert_same(whole, render_scene(scene, "all", "replay", Tiling(tile=4)))
    assert Other.traces == 1


def test_rays_of_ones_own_see_what_the_camera_sees():
    volume = anisotropic_noise()
    camera = around(volume)
    origins, directions = camera.rays()
    rays = jv.render_rays(volume, soft_transfer(), origins, 3 * directions, MARCH)
    assert_same(rays, jv.render(volume, soft_transfer(), camera, MARCH), 2e-5)


def test_rays_of_ones_own_draw_the_same_numbers_in_float64():
    """By index, without pixels."""
    volume = anisotropic_noise()
    origins, directions = (np.asarray(rays, np.float64) for rays in around(volume).rays())
    origins, directions = origins.reshape(-1, 3), directions.reshape(-1, 3)
    march = jv.March(0.07, (jv.Jitter(3), jv.AlphaCorrection()))
    single = jv.render_rays(volume, soft_transfer(), origins, directions, march)
    with in_float64():
        volume, march = to_float64((volume, march))
        double = jv.render_rays(volume, to_float64(soft_transfer()), origins, directions, march)
    assert double.rgba.dtype == jnp.float64
    assert_same(single, double, 2e-5)


@pytest.mark.slow
def test_one_ray_and_none_are_rays_too():
    volume = anisotropic_noise()
    origins, directions = around(volume).rays()
    rays, alone, none = (
        jv.render_rays(volume, soft_transfer(), origins[which], directions[which], MARCH)
        for which in (slice(None), (3, 5), slice(0))
    )
    assert alone.rgba.shape == (4,)
    np.testing.assert_allclose(alone.rgba, rays.rgba[3, 5], atol=2e-5)
    assert none.rgba.shape == (0, 20, 4)


@pytest.mark.parametrize("leaps", [False, True])
def test_batches_that_are_refilled_do_not_show_where_rays_may_shift(leaps):
    """Batches of 8 groups, of which some have shifted when others join them, against one of all groups."""
    nodes = np.arange(48)
    x, y, z = np.meshgrid(nodes, nodes, nodes, indexing="ij")
    cut = np.hypot(y - 20, z - 20) < 15  # reaches both faces across x; other rays begin in empty space
    volume = jv.Volume(np.where(cut | (np.hypot(x - 30, y - 38) < 6), 200 + x, 0).astype(np.uint8))
    transfer = jv.TransferFunction.from_points([(190, (0, 0, 0), 0.0), (250, (1, 0.5, 0.2), 0.3)])
    camera = jv.Camera.looking_at(volume, (1.0, 0.3, 0.2), size=(64, 64))
    march = jv.March(0.9, (jv.EmptySpaceJitter(5), *((jv.SpaceLeaping(),) if leaps else ())))
    scene = Scene(volume, transfer, camera, march)
    whole = render_scene(scene, "rgba", "replay", Tiling(batch=4096))
    assert float(np.mean(whole.rgba[..., 3] > 0)) > 0.2
    few = render_scene(scene, "rgba", "replay", Tiling(batch=8, tile=64))
    np.testing.assert_allclose(few.rgba, whole.rgba, atol=1e-6)
    # the number of samples being limited, no segment is taken whole
    careful = scene._replace(march=jv.March(march.step, march.transforms, max_samples=256))
    np.testing.assert_allclose(render_scene(careful, "rgba", "replay").rgba, whole.rgba, atol=1e-6)


@pytest.mark.parametrize("adjoint", ["replay", "forward", "direct"])
def test_adjoints_share_one_image(adjoint):
    volume = anisotropic_noise()
    camera = around(volume)
    plain = jv.render(volume, soft_transfer(), camera, MARCH)
    assert_same(plain, jv.render(volume, soft_transfer(), camera, MARCH, adjoint=adjoint))


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", ["replay", "forward", "direct"])
def test_an_image_alone_is_the_same_with_its_gradient(adjoint):
    volume, transfer = anisotropic_noise(), soft_transfer()
    march = jv.March(0.07, (jv.AlphaCorrection(), jv.EarlyTermination(0.1)))
    camera = around(volume)

    def seen(extinction, outputs="all"):
        changed = eqx.tree_at(lambda t: t.extinction, transfer, extinction)
        return jv.render(volume, changed, camera, march, outputs=outputs, adjoint=adjoint)

    def loss(extinction, outputs):
        rendering = seen(extinction, outputs)
        return jnp.mean(rendering.rgba**2), rendering

    # take the image from the gradient's program, since a separate program would take as long to compile
    differentiated = jax.jacfwd if adjoint == "forward" else jax.grad
    (of_whole, whole), (of_alone, alone) = (
        differentiated(partial(loss, outputs=outputs), has_aux=True)(transfer.extinction)
        for outputs in ("all", "rgba")
    )
    assert whole.samples.max() > 0
    for name in ("depth", "samples", "aligned"):
        with pytest.raises(AttributeError, match=f'{name} is not part of this rendering: pass outputs="all"'):
            getattr(alone, name)
    np.testing.assert_allclose(alone.rgba, whole.rgba, atol=1e-6)
    np.testing.assert_array_equal(alone.exhausted, whole.exhausted)
    np.testing.assert_allclose(alone.image(), whole.image(), atol=1e-6)
    assert np.abs(of_whole).max() > 0
    np.testing.assert_allclose(of_alone, of_whole, rtol=1e-4, atol=1e-7)


def test_one_program_serves_all_cameras_steps_transfer_functions_and_volumes():
    Counting = counting()
    for i in range(4):
        volume = anisotropic_noise(seed=i)
        transfer = Counting(*jax.tree.leaves(soft_transfer(0.3 + 0.1 * i)))
        camera = around(volume, (6, 5)).zoom(1 + i)
        march = jv.March(0.05 + 0.01 * i, (jv.AlphaCorrection(), jv.EarlyTermination(0.01 + 0.01 * i)))
        jax.block_until_ready(jv.render(volume, transfer, camera, march))
    assert Counting.traces == 1


def test_runs_inside_jit_and_vmap():
    volume = anisotropic_noise()
    cameras = [around(volume), around(volume).zoom(2)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)

    @eqx.filter_jit
    def both(cameras):
        return eqx.filter_vmap(lambda camera: jv.render(volume, soft_transfer(), camera, MARCH))(cameras)

    renderings = both(stacked)
    for i, camera in enumerate(cameras):
        one = jax.tree.map(lambda leaf, i=i: leaf[i], renderings)
        assert_same(one, jv.render(volume, soft_transfer(), camera, MARCH), 2e-5)


@pytest.mark.slow
def test_memory_beside_the_image_does_not_grow_with_it():
    volume = anisotropic_noise()

    def workspace(side):
        arguments = volume, soft_transfer(), around(volume, (side, side)), MARCH
        return (
            cast(Any, eqx.filter_jit(jv.render))
            .lower(*arguments)
            .compile()
            .compiled.memory_analysis()
            .temp_size_in_bytes
        )

    small, large = workspace(1024), workspace(2048)  # four tiles, and sixteen
    pixels = 2048**2 - 1024**2
    bytes_per_pixel = 4 * 4 + 4 + 4 + 1 + 1  # of a Rendering's tiles, before they are assembled
    assert large - small <= 1.1 * bytes_per_pixel * pixels


def test_a_transform_that_is_not_asked_for_leaves_no_trace():
    """A plain march's program has fewer operations than that of any other."""
    volume = anisotropic_noise()

    def operations(*transforms):
        arguments = volume, soft_transfer(), around(volume, (8, 8)), jv.March(0.07, transforms)
        return cast(Any, eqx.filter_jit(jv.render)).lower(*arguments).lowered.cost_analysis()["flops"]

    plain = operations()
    assert 0 < plain < operations(jv.AlphaCorrection())
    assert plain < operations(jv.EarlyTermination(0.1))


def test_unknown_outputs_are_named():
    volume = anisotropic_noise()
    with pytest.raises(ValueError, match="outputs must be one of all, rgba; got 'depth'"):
        jv.render(volume, soft_transfer(), around(volume, (4, 4)), MARCH, outputs="depth")


def test_an_unknown_adjoint_is_named():
    # not through `render`, since the tests' type checker rejects its argument first
    with pytest.raises(ValueError, match="adjoint must be one of replay, forward, direct; got 'reverse'"):
        render_scene(
            Scene(anisotropic_noise(), soft_transfer(), around(anisotropic_noise()), MARCH), "all", "reverse"
        )


def test_direct_under_jit_asks_for_the_number_of_samples():
    volume = anisotropic_noise()

    @jax.jit
    def image(step):
        return jv.render(volume, soft_transfer(), around(volume), jv.March(step), adjoint="direct").rgba

    with pytest.raises(ValueError, match=r"March\(max_samples=...\) must be given"):
        image(0.1)


def test_direct_under_jit_with_the_number_of_samples_given():
    volume = anisotropic_noise()

    @jax.jit
    def image(step):
        march = jv.March(step, (jv.AlphaCorrection(),), max_samples=64)
        return jv.render(volume, soft_transfer(), around(volume), march, adjoint="direct").rgba

    np.testing.assert_allclose(
        image(0.07), jv.render(volume, soft_transfer(), around(volume), MARCH).rgba, atol=2e-5
    )


WRONG_WAYS = {
    "jvp": ("replay", lambda loss, x: jax.jvp(loss, (x,), (x,)), 'pass adjoint="forward"'),
    "grad of grad": ("replay", lambda loss, x: jax.grad(lambda x: jax.grad(loss)(x) ** 2)(x), '"direct"'),
    "hessian": ("replay", lambda loss, x: jax.hessian(loss)(x), 'higher derivatives, adjoint="direct"'),
    "grad": ("forward", lambda loss, x: jax.grad(loss)(x), 'pass adjoint="replay"'),
    "grad of jit": ("forward", lambda loss, x: jax.grad(jax.jit(loss))(x), 'pass adjoint="replay"'),
}


@pytest.mark.parametrize("way", WRONG_WAYS)
def test_the_wrong_way_to_differentiate_is_named_with_what_to_pass(way):
    adjoint, differentiate, message = WRONG_WAYS[way]
    volume, transfer = anisotropic_noise(), soft_transfer()
    camera = around(volume)

    def loss(step):
        return jv.render(volume, transfer, camera, jv.March(step), adjoint=adjoint).rgba.sum()

    with pytest.raises(ValueError, match=message):
        differentiate(loss, jnp.asarray(0.07))
