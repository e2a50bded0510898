"""Are voxels stored in the smallest type in which the image stays what it is?"""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.compositing.blending import Over
from jaxvol.planning.probe import Probe, Setting
from jaxvol.planning.storage import stored
from jaxvol.scene.space import Affine

from ..scenes import scaled_phantom, soft_transfer


SPHERE, SOFT = scaled_phantom("sphere"), soft_transfer()

# range of values, what is done with these, error that is allowed; type, whether voxels are changed
CASES = {
    "whole numbers": (0, 255, np.round, 0.0, "uint8", False),
    "whole numbers below 0": (-1000, 3000, np.round, 0.0, "int16", False),
    "great whole numbers": (0, 60000, np.round, 0.0, "uint16", False),
    "fractions": (0, 255, np.array, 1e-2, "uint8", True),
    "between 0 and 1, not rounded to integers": (0, 1, np.array, 1e-2, "float16", True),
    "nothing may be rounded": (0, 1, lambda data: data + 1e-5, 0.0, "float32", False),
    "beyond float16": (0, 1e6, np.array, 1e-2, "float32", False),
}


@pytest.mark.parametrize("case", CASES)
def test_type_of_the_voxels(case):
    low, top, change, allowed, dtype, rounded = CASES[case]
    data = np.float32(change(low + (top - low) * np.asarray(SPHERE.data, float)))
    volume = jv.Volume(data, SPHERE.spacing, SPHERE.origin)
    assert volume.data.dtype == jnp.float32
    # shows these values alike
    transfer = jv.TransferFunction(low + (top - low) * np.asarray(SOFT.values), SOFT.colors, SOFT.extinction)
    camera = jv.Camera.looking_at(volume, (0.5, -1, 0.4), size=(64, 48))
    probe = Probe.of(camera, Affine(volume), jnp.asarray(np.ones((6, 6, 6), bool)), 0)
    march = jv.March(0.05, quadrature="midpoint")
    setting, error, said = stored(probe, Setting(volume, transfer, Over()), march, allowed)
    assert setting.volume.data.dtype == dtype
    assert said[-1][:2] == (f"voxels as {dtype}", True)
    assert all(not kept for _, kept, _ in said[:-1])
    if rounded:
        assert 0 < error <= allowed
    else:
        assert error == 0
        np.testing.assert_array_equal(np.asarray(setting.volume.data, np.float32), data)
