"""Errors for wrong arguments in place of a volume, transfer function, camera or march, and their advice."""

import importlib
import inspect
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol._util.checks import all_finite, check_answer
from jaxvol._util.memory import memory_available, memory_of_device
from jaxvol.lighting import ConstantLight, HeadLight, Material, Phong, ScattererTemplates

from .scenes import in_float64


VOLUME = jv.phantom("sphere", 8)
TRANSFER = jv.colormap("gray", (0, 255), unit_distance=0.01)
CAMERA = jv.Camera.looking_at(VOLUME, size=(4, 4))
MARCH = jv.March(0.1)
LIGHT = ConstantLight()
RAY = [0.0, 0.0, -5.0], [0.0, 0.0, 1.0]
RAYS = [RAY[0]], [RAY[1]]
LIGHTINGS = r"Pass jv\.lighting\.Phong\(\) or jv\.lighting\.ScattererTemplates\(materials, lights\)"


class Denser(jv.Volume):
    """Overrides how values are fetched, which is a field's task."""

    def value(self, coordinate):
        return 2 * super().value(coordinate)


class Dimmed(jv.TransferFunction):
    """Overrides what engines do not ask."""

    def classifier(self):
        return lambda measured: ((measured[0],) * 3, measured[0])


BAD = {
    "a transfer function of another class": (
        lambda: jv.render(VOLUME, cast(Any, Dimmed)((0, 1), np.ones((2, 3)), (0, 1)), CAMERA, MARCH),
        r"transfer must be a jaxvol TransferFunction itself; got its subclass Dimmed, .*Subclass .*Transfer ",
    ),
    "a class": (lambda: jv.render(VOLUME, TRANSFER, CAMERA, jv.March), "got the class March"),
    "lights": (
        lambda: jv.render(VOLUME, TRANSFER, CAMERA, MARCH, lighting=(LIGHT, LIGHT)),
        "got a tuple of length 2. " + LIGHTINGS,
    ),
    "a volume of another class": (
        lambda: jv.render(cast(Any, Denser)(VOLUME.data), TRANSFER, CAMERA, MARCH),
        r"volume must be a jaxvol Volume itself; got its subclass Denser, .*field=",
    ),
    "camera and march swapped": (
        lambda: jv.render(VOLUME, TRANSFER, MARCH, CAMERA),
        r"camera must be a jaxvol Camera; got a March\. That is the march: "
        r"the order is render\(volume, transfer, camera, march\)",
    ),
    "an array": (
        lambda: jv.render(np.zeros((4, 5, 6), np.uint8), TRANSFER, CAMERA, MARCH),
        r"volume must be a jaxvol Volume; got a NumPy array of shape \(4, 5, 6\) and type uint8\. "
        r"Pass jv\.Volume\(data, spacing=\.\.\.\)",
    ),
    "a traced array": (
        lambda: jax.jit(lambda data: jv.render(data, TRANSFER, CAMERA, MARCH).rgba)(VOLUME.data),
        "volume must be a jaxvol Volume; got a traced array of shape",
    ),
    "no transfer function": (
        lambda: jv.render(VOLUME, None, CAMERA, MARCH),
        r"transfer must be a transfer function; got None\. Pass jv\.preset\(name\)",
    ),
    "a step": (
        lambda: jv.render(VOLUME, TRANSFER, CAMERA, 0.1),
        r"march must be a jaxvol March; got 0\.1\. Pass jv\.March\(step\)",
    ),
    "a light": (
        lambda: jv.render(VOLUME, TRANSFER, CAMERA, MARCH, lighting=LIGHT),
        r"lighting must be None or a Lighting; got a ConstantLight\. " + LIGHTINGS,
    ),
    "half a ray": (
        lambda: jv.render(VOLUME, TRANSFER, CAMERA, MARCH, antialias=0.5),
        "antialias must be an integer of at least 1; got 0.5",
    ),
    "ends of another image": (
        lambda: jv.render(VOLUME, TRANSFER, CAMERA, MARCH, until=np.ones((4, 5))),
        r"until must have shape \(4, 4\); got shape \(4, 5\)",
    ),
    "an end that is NaN": (
        lambda: jv.render_rays(VOLUME, TRANSFER, *RAYS, MARCH, until=[np.nan]),
        "until must not be NaN",
    ),
    "rays' order": (
        lambda: jv.render_rays(TRANSFER, VOLUME, *RAYS, MARCH),
        r"the order is render_rays\(volume, transfer, origins, directions, march\)",
    ),
    "rays of text": (
        lambda: jv.render_rays(VOLUME, TRANSFER, "abc", RAYS[1], MARCH),
        r"origins must be numbers of shape \(\*rays, 3\); got 'abc'",
    ),
    "reference's ray": (
        lambda: jv.render_ray_reference(VOLUME, TRANSFER, RAYS[0], RAYS[1], MARCH),
        r"origin must have shape \(3,\); got shape \(1, 3\)",
    ),
    "paths": (
        lambda: jv.path_trace(VOLUME, CAMERA, TRANSFER, LIGHT),
        r"transfer must be .*got a Camera.*the order is path_trace\(volume, transfer, camera, lights\)",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_wrong_argument_types_are_named(case):
    make, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        make()


FLAGS: dict[str, Callable[[Any], Any]] = {
    "antialias": lambda value: jv.path_trace(VOLUME, TRANSFER, CAMERA, LIGHT, paths=1, antialias=value),
    "blend": lambda value: ScattererTemplates(Material(0.5, 0.1), LIGHT, blend=value).blend,
    "front_residual": lambda value: jv.Jitter(front_residual=value).front_residual,
    "gradients": lambda value: inspect.unwrap(jv.plan)(VOLUME, TRANSFER, CAMERA, 0.9, gradients=value),
    "inside_out": lambda value: jv.Clip((0, 1, 0, 1, 0, 1), inside_out=value).inside_out,
    "labels": lambda value: jv.AlphaCorrection(value).labels,
    "parallel": lambda value: jv.Camera.looking_at(VOLUME, parallel=value).parallel_scale,
    "speckle": lambda value: jv.toroidal_phantom("shells", (9, 11, 17), speckle=value)[0].data,
}
"""What is made of an argument that is True or False."""


@pytest.mark.parametrize("name", FLAGS)
def test_a_flag_is_true_or_false_and_may_be_numpys(name):
    for wrong in ("yes", 1.0):
        with pytest.raises(ValueError, match=f"{name} must be .*got {wrong!r}"):
            FLAGS[name](wrong)
    for value in (False, True) if name not in ("antialias", "gradients") else ():
        found, expected = FLAGS[name](np.bool_(value)), FLAGS[name](value)
        assert type(found) is type(expected)
        np.testing.assert_array_equal(found, expected)


def test_a_very_long_number_is_shortened():
    for digits in (400, 5000):
        with pytest.raises(ValueError, match="ambient must be a number") as fault:
            Phong(HeadLight(), 10**digits)
        assert len(str(fault.value)) < 200


def test_rays_of_any_type_of_numbers_see_the_same():
    expected = jv.render_rays(
        VOLUME, TRANSFER, *(jax.device_put(np.asarray(part, np.float32)) for part in RAYS), march=MARCH
    ).rgba
    assert np.asarray(expected)[0, 3] > 0.1
    several: list[Callable[[Any], Any]] = [np.int8, np.float16, np.float64, lambda rays: rays]
    for convert in several:
        seen = jv.render_rays(VOLUME, TRANSFER, *(convert(part) for part in RAYS), march=MARCH).rgba
        np.testing.assert_array_equal(seen, expected)
    single: list[Callable[[Any], Any]] = [np.int64, lambda ray: ray]
    for convert in single:
        ray = [convert(part) for part in RAY]
        one = jax.eval_shape(lambda ray=ray: jv.render_ray_reference(VOLUME, TRANSFER, *ray, march=MARCH))
        assert (one.rgba.shape, one.rgba.dtype) == ((4,), jnp.float32)


def test_numbers_of_two_lengths_are_told_of_x64():
    with (
        in_float64(),
        pytest.raises(ValueError, match="made before jax_enable_x64 was set"),
    ):
        check_answer(TRANSFER, "add", np.float64(1), np.float32(1))


def test_images_that_may_not_fit_into_memory_are_told_of_before_they_are_begun(monkeypatch):
    module = importlib.import_module("jaxvol.render")

    def begun(*_: Any, **__: Any) -> Any:
        raise InterruptedError

    monkeypatch.setattr(module, "render_scene", begun)
    assert 0 < memory_available() <= memory_of_device()
    monkeypatch.setattr(module, "memory_available", lambda: 80 * 2**30)
    message = r"{} x {} pixels{} take some 50\.7 GiB of memory, and 80 GiB are left; .*camera\.crop"
    for side, antialias, rays in ((20_000, 1, ""), (5_000, 4, " of 4 x 4 rays")):
        with (
            pytest.warns(UserWarning, match=message.format(side, side, rays)),
            pytest.raises(InterruptedError),
        ):
            jv.render(VOLUME, TRANSFER, replace(CAMERA, size=side), MARCH, antialias=antialias)
    with pytest.raises(InterruptedError):  # without a warning, which would be an error here
        jv.render(VOLUME, TRANSFER, replace(CAMERA, size=17_000), MARCH)


# ---- numbers that are known only when a program runs ----


def cameras(x: Any, **more: Any) -> jv.Camera:
    return jv.Camera((3.0, x, 0.0), (0.0, 0.0, 0.0), size=(4, 4), **more)


def functions(x: Any) -> jv.TransferFunction:
    return jv.TransferFunction((0, 1), np.ones((2, 3)), (1, 1 + x))


INTRINSICS, EYE, UP = np.diag([4.0, 4.0, 1.0]), np.eye(3), (0.0, 1.0, 0.0)
PROBE = {"beta_range": (1.1, 2.0), "sigma_range": (1.1, 2.0), "gamma_range": (5.0, 30.0)}
TRACED: dict[str, tuple[Callable[[Any], Any], float, str]] = {
    "a voxel": (lambda x: jv.Volume(jnp.ones((2, 2, 2)).at[0, 1, 0].add(x)), np.inf, "data must be finite"),
    "spacing": (lambda x: jv.Volume(VOLUME.data, (1, 1 + x, 1)), -1, "spacing must be positive"),
    "origin": (lambda x: jv.Volume(VOLUME.data, origin=(x, 0, 0)), np.inf, "origin must be finite"),
    "axes": (lambda x: jv.Volume(VOLUME.data, direction=EYE * (1 + x)), 1, "direction must be"),
    "points": (lambda x: jv.TransferFunction((x, 1), EYE[:2], (0, 1)), 2, "values must increase"),
    "colours": (lambda x: jv.TransferFunction((0, 1), EYE[:2] + x, (0, 1)), np.inf, "colors must be finite"),
    "extinction": (functions, -2, "extinction must not be negative"),
    "opacities": (lambda x: jv.TransferFunction.from_points([(0, UP, x), (1, UP, 0)]), 2, "opacity must be"),
    "a unit": (
        lambda x: jv.TransferFunction.from_points([(0, UP, 0), (1, UP, 0)], 1 + x),
        -2,
        "unit_distance",
    ),
    "a table": (
        lambda x: jv.TransferFunction2D((0, 1), (0, 1 + x), np.ones((2, 2, 3)), EYE[:2, :2]),
        -3,
        "magn",
    ),
    "a label": (lambda x: jv.LabelTransferFunction([functions(0)]).with_opacity({0: 1 + x}), -2, "opacity"),
    "radiance": (lambda x: jv.RadianceField(1 + x), -2, "scale must not be negative"),
    "a camera": (cameras, np.inf, "position must be finite"),
    "up": (lambda x: cameras(0.0, view_up=(1, 1 + x, 0)), -1, "view_up must not be zero or point along"),
    "an angle": (
        lambda x: cameras(0.0, view_angle=30 + x),
        150,
        "view_angle must be greater than 0 and less",
    ),
    "a scale": (lambda x: cameras(0.0, parallel_scale=1 + x), -1, "parallel_scale must be greater than 0"),
    "a zoom": (lambda x: cameras(0.0).zoom(1 + x), -2, "zoom factor must be greater than 0"),
    "a side": (lambda x: jv.Camera.looking_at(VOLUME, (x, 0, 0)), 0, "direction must not be zero"),
    "K": (lambda x: jv.Camera.from_intrinsics(INTRINSICS + x, EYE, (0, 0, 1), 4), 1, "K must be"),
    "R": (
        lambda x: jv.Camera.from_intrinsics(INTRINSICS, EYE * (1 + x), (0, 0, 1), 4),
        1,
        "R must be a rotation",
    ),
    "a pitch": (
        lambda x: jv.Camera.from_detector((0, 0, 1), (0, 0, 0), EYE[0], EYE[1], 1 + x, 4),
        -2,
        "pixel_pitch",
    ),
    "a step": (lambda x: jv.March(1 + x), -1, "step must be greater than 0"),
    "a box": (lambda x: jv.Clip((x, 1, 0, 1, 0, 1)), 1.5, "box must be"),
    "a plane": (lambda x: jv.Clip(planes=[((0, 0, 0), (0, 0, 1 + x))]), -1, "must not be 0"),
    "an end": (lambda x: jv.EarlyTermination(0.5 + x), 1, "opacity_left must be"),
    "a probe": (lambda x: jv.ToroidalMap(20, 10 + x, **PROBE), -20, "gamma_range must begin beyond"),
    "a value": (lambda x: jv.Isosurface(x), np.inf, "value must be finite"),
    "a light": (lambda x: jv.lighting.DirectionalLight((0, 0, 1), (1, 1, 1 + x)), -2, "irradiance must not"),
    "a surface": (lambda x: Phong(specular_power=1 + x), -1, "specular_power must be greater"),
    "a material": (lambda x: Material(0.5, 1 + x), -1, "mean_free_path must be greater"),
}
"""What is made of a number 0, a wrong number, and the error's text."""


def test_wrong_numbers_are_nan_in_a_program_without_calls_of_the_host_and_named_without_jit():
    """All kinds share a program: each is wrong in turn."""

    @jax.jit
    def faults(x):
        parts = (make(x[k]) for k, (make, _, _) in enumerate(TRACED.values()))
        return jnp.stack([~all_finite(part) for part in parts])

    zeros = np.zeros(len(TRACED), np.float32)
    zeros[list(TRACED).index("a side")] = 1  # 0 is the wrong one
    assert "callback" not in str(jax.make_jaxpr(faults)(zeros))
    np.testing.assert_array_equal(faults(zeros), False)
    for k, (name, (make, wrong, message)) in enumerate(TRACED.items()):
        x = zeros.copy()
        x[k] = wrong
        np.testing.assert_array_equal(faults(x), np.arange(len(x)) == k, err_msg=name)
        with jax.disable_jit(), pytest.raises(ValueError, match=message):
            jax.jit(make)(np.float32(wrong))


WRONG = (np.inf, -2, np.nan, np.inf, -1.5, -1, -3, np.inf, -1, 151, np.nan)
"""By argument of `image_and_gradient`."""


@jax.jit
def image_and_gradient(x):
    """The gradient is of the lower pixels' sum."""

    def image(x):
        volume = jv.Volume(jnp.ones((2, 2, 2)) + x[0], (2.0, 2 + x[1], 2), (-1, -1, -1 + x[2]))
        transfer = jv.TransferFunction((0, 2), 0.5 + jnp.zeros((2, 3)).at[0].add(x[3]), (0.1, 1 + x[4]))
        march = jv.March(0.3 + x[5], (jv.Clip((-2, 0.5 + x[6], -2, 2, -2, 2)),))
        camera = jv.Camera((5.0, 1 + x[7], 0), (0, 0, 0), (0, 1 + x[8], 0), 30 + x[9], size=(2, 2))
        until = 9 + jnp.zeros((2, 2)).at[1, 0].add(x[10])
        rgba = jv.render(volume, transfer, camera, march, until=until, outputs="rgba").rgba
        return jnp.sum(rgba[1]), rgba

    (_, rgba), gradient = jax.value_and_grad(image, has_aux=True)(x)
    return rgba, gradient


def test_wrong_numbers_are_nan_in_image_and_gradient_of_a_program_and_of_the_same_exported(tmp_path):
    """The exported program runs in a process that has no jaxvol."""
    given = np.zeros((len(WRONG) + 1, len(WRONG)), np.float32)
    np.fill_diagonal(given, WRONG)
    images, gradients = (np.stack(each) for each in zip(*map(image_and_gradient, given), strict=True))
    seen = np.isnan(images).any(axis=-1)
    np.testing.assert_array_equal(np.isnan(images[..., :3]).all(axis=-1), seen)
    expected = np.zeros(seen.shape, bool)
    expected[:10], expected[10, 1, 0] = True, True  # all pixels, or that whose ray ends nowhere
    np.testing.assert_array_equal(seen, expected)
    np.testing.assert_array_equal(np.isnan(np.diagonal(gradients)), True)
    assert np.all(np.isfinite(gradients[-1]))
    assert np.sum(gradients[-1] != 0) >= 4

    program = jax.export.export(image_and_gradient)(jax.ShapeDtypeStruct(given.shape[1:], given.dtype))
    (tmp_path / "program").write_bytes(program.serialize())
    np.save(tmp_path / "given.npy", given)
    start = """import sys
sys.modules["jaxvol"] = None  # an import would raise ImportError
import jax.export, numpy as np
program = jax.export.deserialize(open("program", "rb").read())
images, gradients = zip(*map(program.call, np.load("given.npy")))
np.savez("found.npz", images=images, gradients=gradients)"""
    subprocess.run([sys.executable, "-I", "-c", start], cwd=tmp_path, check=True)
    with np.load(tmp_path / "found.npz") as found:
        np.testing.assert_allclose(found["images"], images, rtol=1e-6)
        np.testing.assert_allclose(found["gradients"], gradients, rtol=1e-5, atol=1e-6)
