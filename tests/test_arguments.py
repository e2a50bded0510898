"""Errors for wrong arguments in place of a volume, transfer function, camera or march, and their advice."""

import inspect
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol._util.checks import check_answer
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
