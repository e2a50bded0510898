"""The transpose of fetching cubes of voxels, as on a CPU and as on a GPU."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol._util import platform
from jaxvol._util.voxel_fetch import scatter_add


@pytest.mark.parametrize("name", ["cpu", "gpu"])
def test_cubes_are_added_to_the_voxels_that_they_were_fetched_from(name, monkeypatch):
    monkeypatch.setattr(platform, "platform", lambda: name)
    shape, random = (4, 5, 6), np.random.default_rng(0)
    nodes = random.integers(0, np.array(shape) - 1, (200, 3))
    nodes[:2] = (0, 0, 0), np.array(shape) - 2  # the last pair ends with the last voxel
    parts = random.normal(size=(200, 2, 2, 2)).astype(np.float32)
    parts[random.random((200, 2, 2)) < 0.5] = 0  # pairs to which nothing is added
    for half in (0, 1):  # or to one of them
        parts[..., half][random.random((200, 2, 2)) < 0.3] = 0
    expected = np.ones(shape)
    for node, part in zip(nodes, parts, strict=True):
        i, j, k = node
        expected[i : i + 2, j : j + 2, k : k + 2] += part
    base = jnp.asarray(np.ravel_multi_index(tuple(nodes.T), shape), jnp.int32)
    cube = [[[jnp.asarray(parts[:, x, y, z]) for z in (0, 1)] for y in (0, 1)] for x in (0, 1)]
    found = scatter_add(jnp.ones(np.prod(shape).item()), shape, [base], [cube])
    np.testing.assert_allclose(found.reshape(shape), expected, rtol=0, atol=1e-5)
