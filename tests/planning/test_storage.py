"""Are voxels stored in the smallest type in which the image stays what it is?"""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.compositing import Over
from jaxvol.planning.probe import Probe, Setting
from jaxvol.planning.storage import stored
from jaxvol.space import Affine

from ..scenes import scaled_phantom, soft_transfer


MARCH = jv.March(0.05, quadrature="midpoint")


def found(data: np.ndarray, transfer: jv.TransferFunction, allowed: float):
    like = scaled_phantom("sphere")
    volume = jv.Volume(data.astype(np.float32), like.spacing, like.origin)
    assert volume.data.dtype == jnp.float32
    camera = jv.Camera.looking_at(volume, (0.5, -1, 0.4), size=(64, 48))
    probe = Probe.of(camera, Affine(volume), jnp.ones((6, 6, 6), bool), 0)
    return stored(probe, Setting(volume, transfer, Over()), MARCH, allowed)


def stretched(top: float, low: float = 0.0) -> tuple[np.ndarray, jv.TransferFunction]:
    """Values from `low` to `top`, and a transfer function that shows them alike."""
    soft = soft_transfer()
    values = low + (top - low) * np.asarray(soft.values)
    data = low + (top - low) * np.asarray(scaled_phantom("sphere").data)
    return data, jv.TransferFunction(values, soft.colors, soft.extinction)


@pytest.mark.parametrize(
    ("low", "top", "dtype"), [(0, 255, "uint8"), (-1000, 3000, "int16"), (0, 60000, "uint16")]
)
def test_whole_numbers_become_integers(low, top, dtype):
    data, transfer = stretched(top, low)
    setting, change, said = found(np.round(data), transfer, 0.0)
    assert setting.volume.data.dtype == dtype
    assert change == 0
    np.testing.assert_array_equal(np.asarray(setting.volume.data, np.float64), np.round(data))
    assert said == [(f"voxels as {dtype}", True, "no voxel changes")]


def test_fractions_are_rounded_where_the_image_allows_it():
    data, transfer = stretched(255.0)
    setting, change, _ = found(data, transfer, 1e-2)
    assert setting.volume.data.dtype == jnp.uint8
    assert 0 < change <= 1e-2


def test_values_between_0_and_1_are_not_rounded_to_integers():
    data, transfer = stretched(1.0)
    setting, change, said = found(data, transfer, 1e-2)
    assert setting.volume.data.dtype == jnp.float16
    assert 0 < change <= 1e-2
    assert [kept for _, kept, _ in said] == [False, True]


def test_nothing_is_rounded_where_nothing_is_allowed():
    data, transfer = stretched(1.0)
    setting, change, said = found(data + 1e-5, transfer, 0.0)
    assert setting.volume.data.dtype == jnp.float32
    assert change == 0
    assert said[-1][0] == "voxels as float32"


def test_values_beyond_float16_are_kept():
    data, transfer = stretched(1e6)
    assert found(data, transfer, 1e-2)[0].volume.data.dtype == jnp.float32
