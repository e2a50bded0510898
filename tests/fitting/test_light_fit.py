"""Are mean free paths recovered from lit images, and reported as undetermined where they are?"""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from experiments.mean_free_path import GOAL, RADIUS, balls, lights, marching, three_materials
from experiments.mean_free_path_scan import PAPER, nearest, scan
from jaxvol.lighting import ScattererTemplates

from ..scenes import rendered, slow


@pytest.mark.parametrize("occlusion", ["hard", *slow("soft")])
def test_a_scan_finds_the_mean_free_path_and_brightness_of_a_render_of_templates(occlusion):
    """With the paper's parameters, for a λ that is none of the scan's steps: within one of 2 %."""
    volume, path, octaves, brightness = balls(12, [(200, (0, 0, 0), RADIUS)]), 0.3, 0.3, 0.7
    transfer = jv.TransferFunction((60, 140, 255), np.full((3, 3), 0.5), (0, 4, 4))
    camera, march = jv.Camera((0, -4, 1), (0, 0, 0), (0, 0, 1), 26, size=(12, 12)), marching(volume)

    def seen(factor):
        material = jv.Material(0.5, factor * path, values=(60, 256))
        lighting = ScattererTemplates(material, lights(), **PAPER, occlusion=occlusion)
        return np.asarray(rendered(volume, transfer, camera, march, lighting=lighting).rgba)[..., :3]

    reference = brightness * seen(2**octaves)
    view: Any = SimpleNamespace(radiance=reference, standard_error=np.full_like(reference, 1e-3))
    found = scan(lambda factor: nearest([seen(factor)], [view]))
    assert abs(np.log2(found["ratio"]) - octaves) < 1 / 32
    assert found["brightness"] == pytest.approx(brightness, rel=0.03)
    assert found["error"] < 0.05 < min(error for factor, error in found["profile"] if not 0.5 < factor < 3)


@pytest.mark.slow
def test_three_mean_free_paths_are_found_from_three_times_off():
    found = three_materials(size=24, resolution=24)
    np.testing.assert_allclose(found["found"], 1, atol=GOAL)


@pytest.mark.slow
def test_a_mean_free_path_much_longer_than_the_object_is_said_to_be_undetermined():
    volume = balls(24, [(200, (0, 0, 0), 0.3)])
    transfer = jv.TransferFunction((60, 140, 255), np.full((3, 3), 0.5), (0, 8, 8))
    march = marching(volume)
    camera = jv.Camera((0, -4, 1), (0, 0, 0), (0, 0, 1), 20, size=(16, 16))

    def scene(material, camera):
        lighting = ScattererTemplates(material, lights(), templates=2, photons=8, levels=2, reach=(2.0,))
        return volume, transfer, camera, march, lighting

    def fitted(path):
        truth, start = (jv.Material(0.5, p, values=(60, 256)) for p in (path, path * 1.5))
        *plain, lighting = scene(truth, camera)
        residual = jv.ImageResidual(scene, [(camera, jv.render(*plain, lighting=lighting).rgba)])
        found = jv.fit(residual, start, max_steps=15)
        assert found.uncertainty is not None
        return found.parameters, found.uncertainty.undetermined

    known, undetermined = fitted(0.1)
    assert undetermined == []
    assert jnp.allclose(known.mean_free_path, 0.1, rtol=GOAL)
    with pytest.warns(UserWarning, match="mean_free_path"):
        _, undetermined = fitted(300.0)
    assert undetermined == [[".mean_free_path"]]
