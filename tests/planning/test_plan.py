"""Is a plan within its tolerance, and does it hold nothing that the scene does not need?"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.lighting import ConstantLight, Deferred, DirectionalLight, ScattererTemplates
from jaxvol.metrics import rmse
from jaxvol.occupancy import Blocks
from jaxvol.planning import trials
from jaxvol.planning.plan import _proven
from jaxvol.space import Affine

from ..scenes import scaled_phantom, slow, soft_transfer, uniform_transfer


TOLERANCE = 0.01


def camera_of(volume: jv.Volume) -> jv.Camera:
    return jv.Camera.looking_at(volume, (0.5, -1, 0.4), size=(64, 48))


def plan_of(scene, tolerance, **more) -> jv.Plan:
    volume, transfer, camera = scene
    return jv.plan(volume, transfer, camera, tolerance, **more)


def transforms_of(found: jv.Plan) -> set[str]:
    return {type(each).__name__ for each in found.march.transforms}


def error_of(found: jv.Plan, volume, transfer, camera) -> float:
    """Of the planned image, over black or white: compared with steps of a sixty-fourth of a voxel, without
    leaps; integrated, since the midpoint rule would miss a narrow peak."""
    image = jv.render(found.volume, transfer, camera, found.march, lighting=found.lighting)
    fine = jv.March(float(volume.spacing.min()) / 64, (jv.AlphaCorrection(),), "preintegrated")
    truth = jv.render(volume, transfer, camera, fine)
    return max(rmse(image.image(c), truth.image(c)) for c in ((0, 0, 0), (1, 1, 1)))


@pytest.fixture(scope="module")
def sphere():
    """A translucent ball in empty space: a volume, a transfer function and a camera."""
    volume = scaled_phantom("sphere")
    return volume, soft_transfer(), camera_of(volume)


@pytest.fixture(scope="module")
def planned(sphere):
    return plan_of(sphere, TOLERANCE)


def test_it_is_within_its_tolerance(sphere, planned):
    assert planned.within
    assert TOLERANCE / 10 < error_of(planned, *sphere) <= planned.error <= TOLERANCE


@pytest.mark.slow
def test_a_smaller_tolerance_takes_shorter_steps(sphere, planned):
    finer = plan_of(sphere, TOLERANCE / 8)
    assert float(finer.march.step) < float(planned.march.step) / 1.5
    assert finer.samples > 1.5 * planned.samples
    assert error_of(finer, *sphere) <= TOLERANCE / 8


def test_the_same_call_gives_the_same_plan(sphere, planned):
    again = plan_of(sphere, TOLERANCE)
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(jnp.all(a == b)), planned.march, again.march))
    assert (again.error, again.samples, again.parts) == (planned.error, planned.samples, planned.parts)


def test_empty_space_is_leapt_over_and_empty_faces_are_not_aligned(planned):
    assert "SpaceLeaping" in transforms_of(planned)
    assert "AlphaCorrection" not in transforms_of(planned)


def test_a_full_volume_is_aligned_and_not_leapt_over(sphere):
    volume, transfer, camera = sphere
    full = volume.__class__(0.3 + 0.5 * volume.data, volume.spacing, volume.origin)
    found = jv.plan(full, transfer, camera, TOLERANCE)
    assert "AlphaCorrection" in transforms_of(found)
    assert "SpaceLeaping" not in transforms_of(found)
    assert error_of(found, full, transfer, camera) <= TOLERANCE


@pytest.mark.parametrize(("axis", "end"), [(0, 0), (1, -1), (2, -1)])
def test_a_full_cube_in_empty_space_is_aligned_where_it_touches_a_face(sphere, axis, end):
    volume, transfer, _ = sphere
    data = np.zeros(volume.shape, np.float32)
    data[8:16, 8:16, 8:16] = 0.5
    data = np.roll(data, 8 * (1 if end else -1), axis)
    cube = jv.Volume(data, volume.spacing)
    visible = transfer.visible(Blocks.of(cube))
    proven, parts = _proven(visible, Affine(cube), ())
    assert [type(each).__name__ for each in proven] == ["AlphaCorrection", "SpaceLeaping"]
    assert parts[0].why == "something may be visible at 1 of the volume's 6 faces"


@pytest.mark.parametrize("inside_out", [False, True])
def test_faces_that_a_clip_cuts_are_aligned_where_something_is_visible(sphere, inside_out):
    volume, transfer, _ = sphere
    visible = transfer.visible(Blocks.of(volume))
    found = {}
    for name, side in {"through the ball": 0.1, "around it": 0.9}.items():
        clip = jv.Clip((-side, side, -0.9, 0.9, -0.9, 0.9), inside_out=inside_out)
        space = jv.March(1.0, (clip,)).locate(volume)
        proven, parts = _proven(visible, space, (clip,))
        found[name] = parts[0]
        assert (type(proven[0]) is jv.AlphaCorrection) == parts[0].kept
    assert found["through the ball"].why == (
        "something may be visible at 2 of the volume's 12 faces and cuts"
    )
    assert not found["around it"].kept


@pytest.mark.slow
def test_a_clipped_scene_is_within_its_tolerance(sphere):
    volume, transfer, camera = sphere
    clip = jv.Clip(planes=[((0.1, 0.0, 0.1), (-0.5, 1.0, 0.3))])
    found = jv.plan(volume, transfer, camera, TOLERANCE, transforms=(clip,))
    assert {"Clip", "AlphaCorrection"} <= transforms_of(found)
    fine = jv.March(float(volume.spacing.min()) / 64, (jv.AlphaCorrection(), clip), "preintegrated")
    image = jv.render(found.volume, transfer, camera, found.march)
    truth = jv.render(volume, transfer, camera, fine)
    assert (
        max(rmse(image.image(c), truth.image(c)) for c in ((0, 0, 0), (1, 1, 1))) <= found.error <= TOLERANCE
    )


@pytest.mark.slow
def test_rays_end_early_only_where_some_become_opaque(sphere):
    volume, _, camera = sphere
    thin, thick = (jv.plan(volume, soft_transfer(d), camera, TOLERANCE) for d in (20.0, 0.05))
    assert "EarlyTermination" not in transforms_of(thin)
    assert "EarlyTermination" in transforms_of(thick)
    assert error_of(thick, volume, soft_transfer(0.05), camera) <= TOLERANCE


def test_gradients_let_rays_end_later_only(sphere):
    volume, _, camera = sphere
    found = jv.plan(volume, soft_transfer(0.05), camera, TOLERANCE, gradients=True)
    (ends,) = (each for each in found.march.transforms if isinstance(each, jv.EarlyTermination))
    assert ends.opacity_left == pytest.approx(1e-4)
    assert found.volume.data.dtype == volume.data.dtype


@pytest.mark.slow
def test_a_narrow_peak_is_integrated(sphere):
    volume, _, camera = sphere
    values = [0.0, 0.395, 0.4, 0.405, 1.0]
    peak = jv.TransferFunction(values, np.full((5, 3), 0.8), [0.0, 0.0, 300.0, 0.0, 0.0])
    found = jv.plan(volume, peak, camera, TOLERANCE)
    assert found.march.quadrature == "preintegrated"
    assert error_of(found, volume, peak, camera) <= TOLERANCE


@pytest.mark.slow
def test_for_one_image_no_other_program_is_tried(sphere):
    """The midpoint rule is within this tolerance, too, if with more samples."""
    volume, _, camera = sphere
    peak = jv.TransferFunction([0.0, 0.3, 0.4, 0.5, 1.0], np.full((5, 3), 0.8), [0.0, 0.0, 60.0, 0.0, 0.0])
    found = jv.plan(volume, peak, camera, TOLERANCE, once=True)
    assert found.within
    assert found.march.quadrature == "midpoint"
    assert any("not tried for one image" in part.why for part in found.parts)
    assert error_of(found, volume, peak, camera) <= TOLERANCE


@pytest.mark.slow
def test_light_without_variants_is_in_the_error(sphere):
    volume, transfer, camera = sphere
    light = jv.lighting.Phong()
    found = jv.plan(volume, transfer, camera, TOLERANCE / 2, lighting=light, once=True)
    fine = jv.March(float(volume.spacing.min()) / 32, (jv.AlphaCorrection(),), "midpoint")
    image, truth = (
        jv.render(volume, transfer, camera, march, lighting=light) for march in (found.march, fine)
    )
    error = max(rmse(image.image(c), truth.image(c)) for c in ((0, 0, 0), (1, 1, 1)))
    assert found.within
    assert found.lighting is light
    assert "light: as given" in str(found)
    assert TOLERANCE / 20 < error <= found.error <= TOLERANCE / 2


@pytest.mark.slow
def test_colours_above_1_let_rays_end_later(sphere):
    volume, _, camera = sphere
    thick = soft_transfer(0.05)
    bright = jv.TransferFunction(thick.values, 50 * thick.colors, thick.extinction)
    found = jv.plan(volume, bright, camera, TOLERANCE)
    assert found.within
    assert error_of(found, volume, bright, camera) <= TOLERANCE
    for each in found.march.transforms:
        if isinstance(each, jv.EarlyTermination):
            assert each.opacity_left < TOLERANCE / 16


@pytest.mark.slow
def test_a_small_object_in_a_large_image_is_seen():
    data = np.zeros((64, 64, 64), np.uint8)
    data[30:32, 40:42, 20:22] = 255
    volume = jv.Volume(data)
    points = [(60, (1, 0.8, 0.6), 0.0), (255, (1, 1, 1), 0.95)]
    transfer = jv.TransferFunction.from_points(points, unit_distance=0.2)
    camera = jv.Camera.looking_at(volume, (1, 0.5, 0.3), size=(192, 192))
    for seed in range(5):
        found = jv.plan(volume, transfer, camera, 0.003, seed=seed)
        assert error_of(found, volume, transfer, camera) <= 0.003


def test_an_empty_image_is_planned(sphere):
    volume, _, camera = sphere
    found = jv.plan(volume, uniform_transfer(0.0), camera, TOLERANCE)
    assert found.within
    assert found.error < TOLERANCE / 4
    assert found.seconds < 1


@pytest.mark.slow
def test_what_cannot_be_reached_is_said(sphere, monkeypatch):
    monkeypatch.setattr(trials, "FINE", 0.5)  # of a voxel, with both quadratures
    monkeypatch.setattr(trials, "FINEST", 0.5)
    found = plan_of(sphere, 2e-4)
    assert not found.within
    assert "not proven to be within the tolerance" in str(found)
    assert "RMSE unknown" in str(found)
    volume, transfer, camera = sphere
    with pytest.warns(UserWarning, match="may not be within"):
        jv.render(volume, transfer, camera, "auto", tolerance=2e-4)


@pytest.mark.slow
def test_a_peak_that_the_midpoint_rule_cannot_resolve_is_planned():
    """Here no step by the midpoint rule is within the tolerance."""
    volume = jv.phantom("head", 48)
    peak = jv.TransferFunction([99.5, 100, 100.5], [[1, 1, 1]] * 3, [0, 50.0, 0])
    camera = jv.Camera.looking_at(volume, size=(64, 64))
    found = jv.plan(volume, peak, camera, 0.001)
    assert found.within
    assert found.march.quadrature == "preintegrated"
    assert error_of(found, volume, peak, camera) <= 0.001
    assert not jv.plan(volume, peak, camera, 0.0001).within


@pytest.mark.slow
def test_light_is_simpler_where_that_looks_the_same(sphere):
    """Light that is nearly the same everywhere may be fetched from a grid, unless it is to be differentiated;
    and the image is as far from that under all templates, blended, as the plan says."""
    volume, transfer, camera = sphere
    light = ScattererTemplates(jv.Material(0.3, 0.1, 1.4), ConstantLight((0.5, 0.5, 0.5)), templates=2)
    tolerance = 0.05
    found = jv.plan(volume, transfer, camera, tolerance, lighting=light)
    fine = jv.March(float(volume.spacing.min()) / 8, (jv.AlphaCorrection(),), "midpoint")
    truth = jv.render(volume, transfer, camera, fine, lighting=light.smooth)
    image = jv.render(found.volume, transfer, camera, found.march, lighting=found.lighting)
    error = max(rmse(image.image(c), truth.image(c)) for c in ((0, 0, 0), (1, 1, 1)))
    assert found.within
    assert error <= tolerance
    assert isinstance(found.lighting, Deferred)
    inner = found.lighting.lighting
    assert isinstance(inner, ScattererTemplates)
    assert inner.baked
    kept: Any = jv.plan(volume, transfer, camera, tolerance, lighting=light, gradients=True).lighting
    while isinstance(kept, Deferred):
        kept = kept.lighting
    assert isinstance(kept, ScattererTemplates)
    assert not kept.baked


@pytest.mark.slow
def test_light_without_its_noise_is_the_last_resort(sphere):
    """One template for each pixel is too noisy for this tolerance, and so is all that is simpler and has
    gradients."""
    volume, transfer, camera = sphere
    sun = DirectionalLight((1, 0.3, 0.2), (30, 30, 30))
    light = ScattererTemplates(jv.Material(0.3, 0.1, 1.4), sun, templates=2)
    found = jv.plan(volume, transfer, camera, 0.004, lighting=light, gradients=True)
    assert isinstance(found.lighting, ScattererTemplates)
    assert found.lighting.blend
    assert not light.blend


@pytest.mark.slow
def test_transforms_of_the_scene_are_kept():
    volume, probe = jv.toroidal_phantom("spheres", (24, 20, 16))
    transfer = jv.preset("mr_head", (0, 255))
    camera = jv.Camera.looking_at(volume, size=(64, 48))
    found = jv.plan(volume, transfer, camera, 0.02, transforms=(probe, jv.EmptySpaceJitter(0)))
    assert {"ToroidalMap", "EmptySpaceJitter"} <= transforms_of(found)


def test_it_says_what_it_decided_and_why(planned):
    said = str(planned)
    for word in ("AlphaCorrection", "SpaceLeaping", "EarlyTermination", "voxels as", "RMSE", "proven"):
        assert word in said
    assert all(part.why for part in planned.parts)


def test_the_image_march_auto_is_that_of_the_plan(sphere, planned):
    volume, transfer, camera = sphere
    auto = jv.render(volume, transfer, camera, "auto", tolerance=TOLERANCE).rgba
    given = jv.render(planned.volume, transfer, camera, planned.march).rgba
    np.testing.assert_array_equal(auto, given)


@pytest.mark.parametrize("bad", [0, 1, -1, float("nan"), True, "small", None])
def test_a_tolerance_out_of_range_is_refused(sphere, bad):
    with pytest.raises(ValueError, match="tolerance must be"):
        plan_of(sphere, bad)


@pytest.mark.parametrize("kind", [jv.SpaceLeaping(), jv.EarlyTermination(), jv.AlphaCorrection()])
def test_transforms_that_it_decides_on_are_refused(sphere, kind):
    with pytest.raises(ValueError, match=type(kind).__name__):
        plan_of(sphere, TOLERANCE, transforms=(kind,))


def test_traced_scenes_are_refused(sphere):
    volume, transfer, camera = sphere
    with pytest.raises(ValueError, match="outside of"):
        jax.jit(lambda t: jv.plan(volume, t, camera, TOLERANCE).march)(transfer)
    with pytest.raises(ValueError, match="outside of"):
        jax.grad(lambda t: jv.render(volume, t, camera, "auto").rgba.sum())(transfer)


def test_a_tolerance_without_auto_is_refused(sphere):
    volume, transfer, camera = sphere
    with pytest.raises(ValueError, match="tolerance goes with"):
        jv.render(volume, transfer, camera, jv.March(0.1), tolerance=0.1)


@pytest.mark.parametrize("name", ["maximum", *slow("minimum", "average", "isosurface")])
def test_other_modes_are_planned(sphere, name):
    """They leap where the mode says that nothing shows; cells are cut where all of them count."""
    volume, transfer, camera = sphere
    mode = jv.Isosurface(0.4) if name == "isosurface" else name
    found = jv.plan(volume, transfer, camera, 0.02, compositing=mode)
    assert found.within
    assert ("SpaceLeaping" in transforms_of(found)) == (name in ("maximum", "isosurface"))
    assert "AlphaCorrection" in transforms_of(found) or name in ("maximum", "isosurface")
    image, truth = (
        jv.render(volume, transfer, camera, march, compositing=mode)
        for march in (
            found.march,
            jv.March(float(volume.spacing[0]) / 32, (jv.AlphaCorrection(),), "midpoint"),
        )
    )
    assert max(rmse(image.image(c), truth.image(c)) for c in ((0, 0, 0), (1, 1, 1))) <= 0.02
