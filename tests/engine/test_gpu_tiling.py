"""The tiling for GPUs, run on any device: it shows in no image and no gradient, and the host rarely waits."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.engine.image import render_scene
from jaxvol.engine.rays import lines
from jaxvol.engine.tiling import GPU, Tiling
from jaxvol.lighting import DirectionalLight, Material, ScattererTemplates
from jaxvol.ray import Scene
from jaxvol.xla import platform

from ..round_trips import counted
from ..scenes import slow


SMALL = GPU._replace(batch=24, turns=3, tile=16, cells=Tiling().cells)
"""For images of few groups: two tiles, batches that are refilled, rays that end within their turns. As many
cells as on a CPU, so that as many samples lie between two leaps."""

PARTS = [
    (60, (0.9, 0.6, 0.3), 0.0),
    (95, (0.9, 0.6, 0.3), 0.02),
    (160, (0.6, 0.7, 0.9), 0.1),
    (255, (1, 1, 1), 0.9),
]
DEFAULTS = jv.EmptySpaceJitter(5), jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination()


def engine(resolution: int = 40, size: tuple[int, int] = (45, 38), **how: Any) -> Scene:
    """An 8-bit volume with empty space around and inside its parts."""
    volume = jv.phantom("engine", resolution)
    step = how.pop("step", float(volume.spacing[0]))
    march = jv.March(
        step, how.pop("transforms", DEFAULTS), how.pop("quadrature", "left"), **how.pop("more", {})
    )
    transfer = jv.TransferFunction.from_points(PARTS, unit_distance=float(volume.spacing[0]))
    camera = jv.Camera.looking_at(volume, (0.6, -0.9, -0.7), (0, 0, -1), size=size).zoom(1.4)
    return Scene(volume, transfer, camera, march, **how)


def toroidal() -> Scene:
    volume, probe = jv.toroidal_phantom("spheres", (24, 20, 16), speckle=False)
    transfer = jv.TransferFunction.from_points([(20, (1, 0.7, 0.5), 0.0), (200, (1, 1, 1), 0.5)], 5.0)
    transforms = probe, jv.Jitter(2), jv.AlphaCorrection(), jv.SpaceLeaping()
    march = jv.March(2.0, transforms)
    space = march.locate(volume)
    center = np.array([float(m) for m in space.middle])
    position = center + 1.5 * float(space.diagonal) * np.array([0.5, -0.7, 0.5])
    camera = jv.Camera(position, center, (0, 0, 1), 30.0, size=(45, 38))
    return Scene(volume, transfer, camera, march)


LIGHT = DirectionalLight((0.4, 0.8, 0.6), (2.0, 2.0, 2.0))
SCATTERERS = ScattererTemplates(Material(0.8, 0.1, 1.4), LIGHT, templates=1, photons=2)
JITTERED = jv.Jitter(3), jv.AlphaCorrection(), jv.SpaceLeaping()

SCENES = {
    "defaults": engine,
    "jittered": lambda: engine(transforms=JITTERED, quadrature="preintegrated"),
    "toroidal": toroidal,
    "scatterers": lambda: engine(lighting=SCATTERERS),
}


@pytest.mark.parametrize("name", ["defaults", *slow("scatterers")])
def test_images_are_those_of_the_tiling_for_cpus(name):
    scene = SCENES[name]()
    assert_same(*(render_scene(scene, "all", "replay", tiling) for tiling in (SMALL, Tiling())))


def test_a_fault_of_a_scene_makes_all_rays_nan_where_no_branch_computes_them(monkeypatch):
    monkeypatch.setattr("jaxvol.xla.memory.on_gpu", lambda: True)
    pixels = np.arange(4, dtype=np.int32).reshape(1, 4)
    cameras = [jv.Camera((1, 2, 5), (0, 0, 0), parallel_scale=scale, size=(4, 4)) for scale in (None, 2.0)]
    found = jax.jit(lambda at, fault: [lines(camera, at, at, fault).origin for camera in cameras])
    for fault in (True, False):
        for origin in found(pixels, fault):
            assert np.isnan(origin).all() == fault


@pytest.mark.slow
def test_images_and_gradients_are_those_of_the_tiling_for_cpus():
    scene = SCENES["jittered"]()
    weights = np.random.default_rng(0).normal(size=(38, 45, 4)).astype(np.float32)

    def differentiated(tiling):
        def loss(leaves):
            transfer, source, march = leaves
            moved = scene._replace(transfer=transfer, source=source, march=march)
            rendering = render_scene(moved, "all", "replay", tiling)
            return jnp.sum(rendering.rgba * weights), rendering

        return eqx.filter_grad(loss, has_aux=True)((scene.transfer, scene.source, scene.march))

    (expected, image), (found, other) = (differentiated(tiling) for tiling in (Tiling(), SMALL))
    assert_same(other, image)
    assert any(np.any(leaf != 0) for leaf in jax.tree.leaves(expected))
    scales = jax.tree.map(lambda leaf: float(np.linalg.norm(leaf)), expected)
    leaves = (jax.tree.leaves(each) for each in (found, expected, scales))
    for a, b, scale in zip(*leaves, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-5 * scale + 1e-9)


def assert_same(found: jv.Rendering, expected: jv.Rendering) -> None:
    assert 0.02 < np.mean(np.asarray(expected.rgba)[..., 3] > 0) < 0.98
    for part in ("rgba", "depth", "samples", "aligned", "exhausted"):
        a, b = (np.asarray(getattr(each, part), float) for each in (found, expected))
        np.testing.assert_array_equal(np.isinf(a), np.isinf(b))
        np.testing.assert_allclose(a, b, rtol=1e-6 * (part == "depth"), atol=2e-6, err_msg=part)


@pytest.mark.slow
def test_rays_that_are_out_of_samples_rest_in_surplus_turns():
    """At the default number of samples, of which one less than a turn's is left when a batch is refilled."""
    volume = jv.Volume(np.ones((2, 2, 2), np.float32))
    transfer = jv.TransferFunction([0.0, 1.0], np.ones((2, 3)), np.full(2, 1e-3))
    most = 2**17
    camera = jv.Camera((0.5, 0.5, -2), (0.5, 0.5, 0), (0, 1, 0), size=(2, 2), parallel_scale=0.1)
    scene = Scene(volume, transfer, camera, jv.March(1 / (most + 100), (jv.AlphaCorrection(),)))
    tiling = GPU._replace(turns=48)
    assert (most // tiling.cells) % tiling.turns > 0
    found = render_scene(scene, "all", "replay", tiling)
    np.testing.assert_array_equal(found.samples, most)
    assert found.exhausted.all()


def test_a_gpu_gets_its_tiling_and_all_others_that_of_the_cpu(monkeypatch):
    for name, expected in (("cpu", Tiling()), ("tpu", Tiling()), ("gpu", GPU), ("cuda", GPU), ("rocm", GPU)):
        monkeypatch.setattr(platform, "platform", lambda name=name: name)
        assert Tiling.of_backend() == expected


@pytest.fixture
def on_a_gpu(monkeypatch):
    """Programs are traced as for a GPU. None that was traced before is used, or left behind."""
    monkeypatch.setattr(platform, "platform", lambda: "gpu")
    jax.clear_caches()
    yield
    jax.clear_caches()


def render(scene: Scene, outputs: str = "rgba") -> jv.Rendering:
    """By the tiling of the platform."""
    return render_scene(scene, outputs, "replay")


def gradient(scene: Scene) -> Any:
    """Of a loss by transfer function, camera and march."""

    def loss(leaves: Any) -> Any:
        transfer, source, march = leaves
        return jnp.mean(render(scene._replace(transfer=transfer, source=source, march=march)).rgba ** 2)

    return eqx.filter_grad(loss)((scene.transfer, scene.source, scene.march))


def moving(scene: Scene, f: Any) -> tuple[Any, ...]:
    """A function of what changes from frame to frame, and this: voxels are known, as where one renders."""

    def moved(transfer: Any, source: Any, march: Any) -> Any:
        return f(scene._replace(transfer=transfer, source=source, march=march))

    return moved, scene.transfer, scene.source, scene.march


def test_a_program_for_cuda_has_no_branch(on_a_gpu):
    """It is not compiled, for lack of a GPU, but lowered to what XLA compiles."""
    f, *arguments = moving(engine(), render)
    traced = jax.jit(lambda *leaves: f(*leaves).rgba).trace(*arguments)
    text = traced.lower(lowering_platforms=("cuda",)).as_text()
    assert "optimization_barrier" in text
    assert "stablehlo.while" in text
    assert "stablehlo.case" not in text
    assert "stablehlo.if" not in text


@pytest.mark.slow
def test_programs_for_gpus_wait_at_most_40_times_and_show_the_same(on_a_gpu):
    """Where XLA fuses otherwise, as it does here without branches, positions are rounded otherwise; and the
    few pixels that are seen along faces of these parts are steep in them."""
    scene = SCENES["toroidal"]()
    found, trips = counted(*moving(scene, render))
    assert 1 < trips.number <= 40
    with pytest.MonkeyPatch.context() as of_cpu:
        of_cpu.setattr(platform, "platform", lambda: "cpu")
        expected = render(scene)
    different = np.abs(found.rgba - expected.rgba).max(axis=-1) > 2e-5
    assert np.mean(different) < 0.005


@pytest.mark.slow
def test_the_host_waits_at_most_40_times_a_frame(on_a_gpu):
    """At 512² pixels, for a scene with much empty space and rays that graze what is seen."""
    size, volume = (512, 512), jv.phantom("vessels", 128)
    points = [(60, (0.9, 0.3, 0.2), 0.0), (255, (1, 0.9, 0.8), 0.9)]
    transfer = jv.TransferFunction.from_points(points, 0.02)
    camera = jv.Camera.looking_at(volume, (0.3, 1, 0.3), (0, 0, 1), size=size).zoom(1.3)
    scene = engine(128, size)._replace(volume=volume, transfer=transfer, source=camera)
    found, of_image = counted(*moving(scene, render))
    assert np.mean(found.rgba[..., 3] > 0) > 0.05
    assert 1 < of_image.number <= 40
    _, of_gradient = counted(*moving(scene, gradient))
    assert of_gradient.number <= 80
