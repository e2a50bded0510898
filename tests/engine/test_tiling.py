"""Tiles and batches do not change images, nothing is compiled twice, memory does not grow with the image."""

from typing import Any, ClassVar, cast

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.engine.image import render_scene
from jaxvol.engine.tiling import GPU, LEAST_BATCH, Tiling
from jaxvol.ray import Scene
from jaxvol.scene.transfer import Transfer

from ..scenes import anisotropic_noise, around, slow, soft_transfer
from ..switch import switch


MARCH = jv.March(0.07, (jv.AlphaCorrection(),))


def assert_same(a, b, tolerance=1e-6):
    for name in ("rgba", "depth", "samples", "aligned", "exhausted"):
        left, right = np.asarray(getattr(a, name), float), np.asarray(getattr(b, name), float)
        np.testing.assert_array_equal(np.isinf(left), np.isinf(right))
        np.testing.assert_allclose(left, right, atol=tolerance, rtol=0, err_msg=name)


@pytest.mark.parametrize(
    "sizes",
    [{"batch": 8, "tile": 5}, *slow({"cells": 16, "group": 4, "batch": 64, "tile": 4, "min_alive": 0.5})],
)
def test_tiles_and_batches_that_are_refilled_do_not_show(sizes):
    """Where some rays of a batch have shifted when others join them; and with a limit of samples, under which
    no segment is taken whole. One incomplete beam along each axis."""
    nodes = np.arange(48)
    x, y, z = np.meshgrid(nodes, nodes, nodes, indexing="ij")
    cut = np.hypot(y - 20, z - 20) < 15  # reaches both faces across x; other rays begin in empty space
    volume = jv.Volume(np.where(cut | (np.hypot(x - 30, y - 38) < 6), 200 + x, 0).astype(np.uint8))
    transfer = jv.TransferFunction.from_points([(190, (0, 0, 0), 0.0), (250, (1, 0.5, 0.2), 0.3)])
    camera = jv.Camera.looking_at(volume, (1.0, 0.3, 0.2), size=(65, 61))
    for leaps in (False, True):
        transforms = jv.EmptySpaceJitter(5), switch(jv.SpaceLeaping(), leaps), jv.AlphaCorrection()
        scene = Scene(volume, transfer, camera, jv.March(0.9, transforms))
        whole = render_scene(scene, "all", "replay")
        assert whole.rgba.shape == (61, 65, 4)
        assert 0.2 < np.mean(np.asarray(whole.rgba)[..., 3] > 0) < 0.95
        few = render_scene(scene, "all", "replay", Tiling(**sizes))
        np.testing.assert_allclose(few.rgba, whole.rgba, atol=1e-6)
        np.testing.assert_array_equal(few.aligned, whole.aligned)
        if not leaps:
            np.testing.assert_array_equal(few.samples, whole.samples)
        careful = scene._replace(march=jv.March(0.9, transforms, max_samples=256))
        np.testing.assert_allclose(render_scene(careful, "rgba", "replay").rgba, whole.rgba, atol=1e-6)


def test_small_images_are_several_batches_too():
    """So that other rays can take the places of those that end; on a GPU, lanes count for more."""
    for groups in (1, LEAST_BATCH, LEAST_BATCH + 1, 256, 4096, 2**14, 2**20):
        batch = Tiling().batch_of(groups)
        assert 0 < batch <= min(Tiling().batch, groups)
        assert batch < groups or groups <= LEAST_BATCH
        assert GPU.batch_of(groups) == min(GPU.batch, groups)


def test_rays_of_ones_own_see_what_the_camera_sees():
    volume = anisotropic_noise()
    camera = around(volume)
    origins, directions = camera.rays()
    # of any length, also where squares overflow or underflow
    lengths = np.geomspace(1e-37, 1e37, origins.size // 3).reshape(*origins.shape[:2], 1)
    longer = (np.asarray(directions) * lengths).astype(np.float32)
    rays = jv.render_rays(volume, soft_transfer(), origins, longer, MARCH)
    assert_same(rays, jv.render(volume, soft_transfer(), camera, MARCH), 2e-5)


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


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", ["forward", "direct"])
def test_adjoints_share_one_image(adjoint):
    volume = anisotropic_noise()
    camera = around(volume)
    plain = jv.render(volume, soft_transfer(), camera, MARCH)
    assert_same(plain, jv.render(volume, soft_transfer(), camera, MARCH, adjoint=adjoint))


def test_one_program_serves_all_cameras_steps_seeds_transfer_functions_and_volumes():
    class Counting(Transfer):
        function: jv.TransferFunction
        bands = 3
        traces: ClassVar[int] = 0
        """Programs traced with it."""

        def classifier(self):
            Counting.traces += 1
            return self.function.classifier()

    for i in range(4):
        volume = anisotropic_noise(seed=i)
        transfer = Counting(soft_transfer(0.3 + 0.1 * i))
        transforms = jv.Jitter(i), jv.SpaceLeaping(), jv.EarlyTermination(0.01 + 0.01 * i)
        camera = around(volume, (6, 5)).zoom(1 + i)
        rendering = jv.render(volume, transfer, camera, jv.March(0.05 + 0.01 * i, transforms), outputs="rgba")
        for name in ("depth", "samples", "aligned"):
            with pytest.raises(
                AttributeError, match=f'{name} is not part of this rendering: pass outputs="all"'
            ):
                getattr(rendering, name)
    assert Counting.traces == 1


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


def test_unknown_outputs_are_named():
    volume = anisotropic_noise()
    with pytest.raises(ValueError, match=r"outputs must be one of all, rgba; and .*; got 'depth'"):
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
