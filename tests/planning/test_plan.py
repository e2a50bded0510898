"""Is a plan within its tolerance, and does it hold nothing that the scene does not need?"""

import inspect
from typing import Any

import jax
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.metrics import rmse
from jaxvol.planning import search
from jaxvol.planning.plan import _checked, chosen_transforms

from ..scenes import scaled_phantom, soft_transfer, uniform_transfer


TOLERANCE = 0.01
SPHERE = scaled_phantom("sphere")
THICK = soft_transfer(0.05)
CAMERA = jv.Camera.looking_at(SPHERE, (0.5, -1, 0.4), size=(64, 48))
"""Of few patches, so that all pixels are compared."""


def plan_of(transfer=None, tolerance: Any = TOLERANCE, volume=SPHERE, **more) -> jv.Plan:
    """Plan of a translucent ball in empty space, without the types' checks: errors are those of users."""
    return inspect.unwrap(jv.plan)(volume, transfer or soft_transfer(), CAMERA, tolerance, **more)


def transforms_of(found: jv.Plan) -> set[str]:
    return {type(each).__name__ for each in found.march.transforms}


def differ(one: jv.Rendering, other: jv.Rendering) -> float:
    """Over black or white."""
    return max(rmse(*(np.asarray(each.image(c)) for each in (one, other))) for c in ((0, 0, 0), (1, 1, 1)))


def error_of(found: jv.Plan, transfer=None, volume=SPHERE, camera=CAMERA, finer=64, clip=(), **how) -> float:
    """Of the planned image, compared with much shorter steps, without leaps; integrated, since the midpoint
    rule would miss a narrow peak."""
    quadrature = "midpoint" if how else "preintegrated"
    step = float(volume.spacing.min()) / finer
    fine = jv.March(step, (jv.AlphaCorrection(), *clip), quadrature)
    transfer = transfer or soft_transfer()
    # the adjoint that compiles fastest
    image = jv.render(volume, transfer, camera, found.march, adjoint="forward", **how)
    return differ(image, jv.render(volume, transfer, camera, fine, adjoint="forward", **how))


@pytest.fixture(scope="module")
def planned():
    return plan_of()


def test_something_that_lies_beside_all_patches_is_found():
    """A single voxel, in an image of which two thirds of the patches are known: with another seed, too."""
    data = np.zeros(SPHERE.shape, np.float32)
    data[14, 9, 14] = 1
    volume, camera = jv.Volume(data, SPHERE.spacing, SPHERE.origin), CAMERA.zoom(1.8)
    found = jv.plan(volume, soft_transfer(), camera, 0.001, seed=1)
    assert 0 < found.error <= 0.001
    assert error_of(found, volume=volume, camera=camera) <= 0.001
    # outside of the picture
    found = jv.plan(volume, soft_transfer(), CAMERA.zoom(9, (0.9, 0.9)), 0.001)
    assert not found.within
    assert any(part.name == "visible" for part in found.parts)


def test_it_is_within_its_tolerance_and_says_what_follows_from_the_scene(planned):
    assert planned.within
    error = error_of(planned, finer=32)
    assert TOLERANCE / 2 < error <= TOLERANCE
    assert 0.9 * planned.error < error < 1.03 * planned.error
    assert {"SpaceLeaping", "AlphaCorrection"} <= transforms_of(planned)
    assert all(part.why for part in planned.parts)
    for word in ("AlphaCorrection", "SpaceLeaping", "EarlyTermination", "RMSE"):
        assert word in str(planned)


def test_the_same_call_gives_the_same_plan_and_march_auto_its_image(planned):
    again = plan_of()
    assert jax.tree.all(jax.tree.map(np.array_equal, planned.march, again.march))
    assert (again.error, again.samples, again.parts) == (planned.error, planned.samples, planned.parts)
    auto = jv.render(SPHERE, soft_transfer(), CAMERA, "auto", tolerance=TOLERANCE, adjoint="forward").rgba
    given = jv.render(SPHERE, soft_transfer(), CAMERA, planned.march, adjoint="forward").rgba
    np.testing.assert_array_equal(auto, given)


def test_gradients_let_rays_end_later_only():
    found = plan_of(THICK, gradients=True)
    (ends,) = (each for each in found.march.transforms if isinstance(each, jv.EarlyTermination))
    assert ends.opacity_left == pytest.approx(1e-4)


def test_an_empty_image_is_planned():
    found = plan_of(uniform_transfer(0.0))
    assert found.within
    assert found.error < TOLERANCE / 4


def test_transforms_that_are_part_of_the_scene_are_kept():
    clip, borders = jv.Clip((-1, 1, -1, 1, -1, 1)), jv.AlphaCorrection(labels=True)
    tolerance, given = _checked(0.1, (clip, borders), SPHERE)
    assert (tolerance, given) == (0.1, (clip, borders))
    proven, (aligned, *_) = chosen_transforms(np.ones((6, 6, 6), bool), given)
    assert (aligned.kept, aligned.why) == (True, "part of the scene")
    assert not any(isinstance(each, jv.AlphaCorrection) for each in proven)


def auto(**how):
    return lambda: jv.render(SPHERE, soft_transfer(), CAMERA, **how)


BAD = {
    **{
        f"tolerance {bad}": (lambda bad=bad: plan_of(tolerance=bad), "tolerance must be")
        for bad in (0, 1, -1, float("nan"), True, "small", None)
    },
    **{
        type(each).__name__: (lambda each=each: plan_of(transforms=(each,)), type(each).__name__)
        for each in (jv.SpaceLeaping(), jv.EarlyTermination(), jv.AlphaCorrection())
    },
    "a traced scene": (lambda: jax.jit(lambda t: plan_of(t).march)(soft_transfer()), "outside of"),
    "a traced image": (
        lambda: jax.grad(lambda t: jv.render(SPHERE, t, CAMERA, "auto").rgba.sum())(soft_transfer()),
        "outside of",
    ),
    "tolerance without auto": (auto(march=jv.March(0.1), tolerance=0.1), "tolerance needs march"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    call, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        call()


FULL = jv.Volume(np.float32(0.3) + np.float32(0.5) * np.asarray(SPHERE.data), SPHERE.spacing, SPHERE.origin)
CLIP = jv.Clip(planes=[((0.1, 0.0, 0.1), (-0.5, 1.0, 0.3))])
# how a scene is planned, how it is rendered, and whether blocks hold nothing that shows
SCENES: dict[str, tuple[dict[str, Any], dict[str, Any], bool]] = {
    "average": ({"compositing": "average"}, {"compositing": "average"}, False),
    "maximum": ({"compositing": "maximum"}, {"compositing": "maximum"}, True),
    "isosurface": ({"compositing": jv.Isosurface(0.4)}, {"compositing": jv.Isosurface(0.4)}, True),
    "full": ({"volume": FULL}, {"volume": FULL}, False),
    "clipped": ({"transforms": (CLIP,)}, {"clip": (CLIP,)}, True),
    "lit": ({"lighting": jv.lighting.Phong(), "once": True}, {"lighting": jv.lighting.Phong()}, True),
}


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES)
def test_other_scenes_are_within_their_tolerance_and_leap_where_nothing_shows(scene):
    """All pixels are known, but what the shortest step errs by is an estimate."""
    how, shown, leaps = SCENES[scene]
    found = plan_of(**how)
    assert found.within
    assert ("SpaceLeaping" in transforms_of(found)) == leaps
    assert "AlphaCorrection" in transforms_of(found)
    assert error_of(found, finer=32, **shown) <= min(1.02 * found.error, TOLERANCE)


@pytest.mark.slow
def test_rays_end_early_where_some_become_opaque_and_later_under_colours_above_1():
    assert "EarlyTermination" not in transforms_of(plan_of(soft_transfer(20.0)))
    thick = plan_of(THICK)
    assert "EarlyTermination" in transforms_of(thick)
    assert error_of(thick, THICK) <= TOLERANCE
    bright = jv.TransferFunction(THICK.values, 7 * THICK.colors, THICK.extinction)
    found = plan_of(bright)
    assert found.within
    assert error_of(found, bright) <= TOLERANCE
    for each in found.march.transforms:
        assert not isinstance(each, jv.EarlyTermination) or each.opacity_left < TOLERANCE / 16


@pytest.mark.slow
def test_a_narrow_peak_is_integrated():
    """For one image, no other program is tried where the midpoint rule is within the tolerance."""
    thin, narrow, wide = (
        jv.TransferFunction([0.0, 0.4 - w, 0.4, 0.4 + w, 1.0], np.full((5, 3), 0.8), [0, 0, most, 0, 0])
        for w, most in ((1e-5, 1.5e5), (0.005, 300.0), (0.2, 20.0))
    )
    for each in (thin, narrow):  # between all samples, and between some
        found = plan_of(each)
        assert found.march.quadrature == "preintegrated"
        assert 0 < error_of(found, each) <= TOLERANCE
    found = plan_of(wide, once=True)
    assert found.within
    assert found.march.quadrature == "midpoint"
    assert any("not tried for one image" in part.why for part in found.parts)
    assert error_of(found, wide) <= TOLERANCE


@pytest.mark.slow
def test_a_small_object_in_a_large_image_is_seen():
    data = np.zeros((64, 64, 64), np.uint8)
    data[30:32, 40:42, 20:22] = 255
    volume = jv.Volume(data)
    points = [(60, (1, 0.8, 0.6), 0.0), (255, (1, 1, 1), 0.95)]
    transfer = jv.TransferFunction.from_points(points, unit_distance=0.2)
    camera = jv.Camera.looking_at(volume, (1, 0.5, 0.3), size=(192, 192))
    found = jv.plan(volume, transfer, camera, 0.003)
    assert error_of(found, transfer, volume, camera) <= 0.003


@pytest.mark.slow
def test_what_cannot_be_reached_is_said(monkeypatch):
    monkeypatch.setattr(search, "FINE", 0.5)  # of a voxel, with both quadratures
    monkeypatch.setattr(search, "FINEST", 0.5)
    found = plan_of(tolerance=2e-4)
    assert not found.within
    assert "not proven to be within the tolerance" in str(found)
    assert "RMSE unknown" in str(found)
    with pytest.warns(UserWarning, match="may not be within"):
        auto(march="auto", tolerance=2e-4)()
