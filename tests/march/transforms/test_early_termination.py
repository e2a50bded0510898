"""When a ray ends. (`test_agreement` has its images among all other transforms.)"""

import numpy as np

import jaxvol as jv

from ... import oracle
from ...scenes import around, scaled_phantom, soft_transfer


EXAMPLES = {"termination": lambda values: jv.EarlyTermination(values.left)}


def ended(termination, camera):
    left = float(termination.opacity_left)
    return oracle.Meaning(stop=lambda transmittance: transmittance <= left)


MEANINGS = {jv.EarlyTermination: ended}


def test_early_termination_errs_by_less_than_what_is_left():
    volume, transfer = scaled_phantom("head"), soft_transfer(0.1)
    camera = around(volume)

    def image(*transforms):
        found = jv.render(volume, transfer, camera, jv.March(0.05, transforms))
        return np.asarray(found.rgba), np.asarray(found.samples)

    full, most = image()
    for left in (1 / 255, 0.1):
        ended, samples = image(jv.EarlyTermination(left))
        off = full - ended
        assert (off > -1e-6).all()
        assert 0 < off.max() <= left
        assert (samples <= most).all()
        assert samples.sum() < most.sum()
    sooner, as_many = image(jv.EarlyTermination(0.1, interval=3))
    np.testing.assert_allclose(sooner, ended, atol=1e-6)
    np.testing.assert_array_equal(as_many, samples)
