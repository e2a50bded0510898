"""Commands without rendering: what they ask for is noted; they get a picture that only the camera changes."""

import jax
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.scene.rendering import Details


class Drawn:
    """Stands in for `jaxvol.render`. `scenes`, `how`: what it was called with. `level`: of all opacities."""

    def __init__(self):
        self.scenes, self.how, self.level = [], [], 1.0

    def __call__(self, volume, transfer, camera, march, **how):
        self.scenes.append((volume, transfer, camera, march))
        self.how.append(how)
        width, height = camera.size
        level = self.level * (0.5 + 0.3 * np.sin(np.sum(np.asarray(camera.position))))
        alpha = np.linspace(0, level, width * height, dtype=np.float32).reshape(height, width, 1)
        rgba = alpha * np.array([0.9, 0.5, 0.1, 1], np.float32)
        depth = np.full((height, width), 7.5, np.float32)
        depth[0, 0] = np.inf
        exhausted, samples = np.zeros((height, width), bool), np.ones_like(depth, np.int32)
        rgba, exhausted, depth, samples = jax.device_put((rgba, exhausted, depth, samples))
        return jv.Rendering(rgba, exhausted, Details(depth, samples))


@pytest.fixture
def drawn(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # where `show` writes a file if there is no display
    drawn = Drawn()
    monkeypatch.setattr("jaxvol.app.picture.render", drawn)
    return drawn
