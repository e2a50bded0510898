"""Is it said why an image shows nothing? (Of scenes that are marched: `commands/test_render.py`.)"""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.app import empty_image
from jaxvol.compositing.blending import Over


VOLUME = jv.Volume(np.zeros((2, 2, 2), np.float32))
GRAY = np.full((3, 3), 0.5)
NEVER = jv.TransferFunction([0, 1, 2], GRAY, [0, 0, 0])

CASES = {
    "values above": (
        jv.TransferFunction([100, 110, 120], GRAY, [0, 0, 1]),
        "shows values between 110 and inf. A clim",
    ),
    "values below": (
        jv.TransferFunction([1, 2, 3], GRAY, [1, 0, 0]),
        "shows values between -inf and 2. A clim from 20 to",
    ),
    "between": (jv.TransferFunction([1, 2, 3], GRAY, [0, 1, 0]), "shows values between 1 and 3. A clim"),
    "no value": (NEVER, "the transfer function's opacity is 0 everywhere"),
    "labels": (jv.LabelTransferFunction([NEVER]), "shows none of them"),
}


@pytest.mark.parametrize("case", CASES)
def test_the_values_that_are_shown_are_compared_with_those_there_are(case, monkeypatch):
    found = np.ones(1, bool), np.asarray([[20.0, 90.0]])
    monkeypatch.setattr(empty_image, "_values_along", lambda *_: found)
    transfer, expected = CASES[case]
    empty = jv.Rendering(jnp.zeros((1, 4)), jnp.zeros(1, bool))
    said = empty_image.why_empty(VOLUME, transfer, jv.Camera.looking_at(VOLUME), jv.March(0.1), empty, Over())
    assert said is not None
    assert said.startswith("the volume's values along the rays run from 20 to 90, and the transfer function")
    assert expected in said
