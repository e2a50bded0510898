"""A grid that a user places: the shell of docs/add_a_transform.md, against chords and differences."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv

from ..scenes import in_float64
from ..test_documents import examples


SHELL: dict[str, Any] = {}
(EXAMPLE,) = (block for block in examples("docs/add_a_transform.md") if "class Shell" in block)
exec(EXAMPLE[: EXAMPLE.index("height, latitude, _ =")], SHELL)
RADII = np.array([1.5, 2.5])
RAYS = 48


def rays() -> tuple[np.ndarray, np.ndarray]:
    """Rays from outside, through the shell, its hole, or past it; some from within hole and shell."""
    random = np.random.default_rng(0)
    unit = random.normal(size=(2, RAYS, 3))
    unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
    origins = 4 * unit[0]
    origins[:4], origins[4:8] = 0.5 * unit[0, :4], 2 * unit[0, 4:8]
    directions = random.uniform(0.2, 2.8, (RAYS, 1)) * unit[1] - origins
    return origins, directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def inside(origins: np.ndarray, directions: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Length of each ray within the shell, by Pythagoras."""
    nearest = -np.sum(origins * directions, axis=-1)
    square = np.sum((origins + nearest[:, None] * directions) ** 2, axis=-1)

    def of_ball(radius: float) -> np.ndarray:
        half = np.sqrt(np.maximum(radius**2 - square, 0))
        return np.maximum(nearest + half, 0) - np.maximum(nearest - half, 0)

    return of_ball(radii[1]) - of_ball(radii[0])


def march(radii: Any, step: Any = 0.07) -> jv.March:
    transforms = SHELL["Shell"](radii), jv.AlphaCorrection(), jv.SpaceLeaping("distance")
    return jv.March(step, transforms, "midpoint", max_samples=128)


def data() -> np.ndarray:
    """Matter around the north pole, and on both sides of where the longitude jumps; at all heights."""
    latitude, longitude = np.linspace(-1, 1, 17)[:, None], np.linspace(-1, 1, 33)
    shown = np.maximum(latitude - 0.6, 0) + np.maximum(np.abs(longitude) - 0.8, 0) * (np.abs(latitude) < 0.4)
    return np.broadcast_to(shown, (5, 17, 33)) * np.linspace(0.5, 1, 5)[:, None, None]


@pytest.fixture(scope="module")
def opacities() -> Any:
    """Opacity of the rays by the extinction of value 1, the radii and the offset of all origins, and the
    gradient of its weighted sum; by voxels, adjoint, and whether rays leap."""

    @eqx.filter_jit
    def image(voxels: Any, given: Any, way: Any, adjoint: Any) -> Any:
        def loss(given: Any) -> Any:
            extinction, radii, offset = given
            points = jnp.array([0.0, 0.5, 1.0])
            transfer = jv.TransferFunction(points, jnp.ones((3, 3)), jnp.array([0.0, 0.5, 1.0]) * extinction)
            found = jv.render_rays(
                jv.Volume(voxels), transfer, way[0] + offset[None], way[1], march(radii), adjoint=adjoint
            )
            weights = jnp.cos(jnp.arange(RAYS, dtype=float))
            return jnp.sum(found.opacity * weights), found

        return jax.value_and_grad(loss, has_aux=True)(given)

    return image


def test_a_homogeneous_shell_is_as_opaque_as_its_chords_and_has_the_gradient_of_differences(opacities):
    with in_float64():
        way, at = rays(), [np.array(0.6), RADII, np.array([0.1, -0.05, 0.02])]
        given = jax.device_put(at)
        (_, found), gradient = opacities(np.ones((5, 17, 33)), given, way, "replay")
        expected = inside(way[0] + at[2], way[1], RADII)
        np.testing.assert_allclose(np.asarray(found.rgba)[..., 3], 1 - np.exp(-0.6 * expected), atol=1e-12)
        assert (expected == 0).any()
        assert (expected > 1.5).any()
        assert not np.asarray(found.exhausted).any()

        def loss(extinction, radii, offset):
            return np.sum(
                (1 - np.exp(-extinction * inside(way[0] + offset, way[1], radii))) * np.cos(range(RAYS))
            )

        for i, leaf in enumerate(map(np.asarray, gradient)):
            for k in range(leaf.size):
                ends = []
                for h in (1e-6, -1e-6):
                    moved = [part.copy() for part in at]
                    moved[i].reshape(-1)[k] += h
                    ends.append(loss(*moved))
                assert leaf.reshape(-1)[k] == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-6, abs=1e-8)


def test_in_a_shell_rays_leap_and_show_what_the_reference_shows(opacities):
    with in_float64():
        way, given = rays(), jax.device_put([np.array(9.0), RADII, np.zeros(3)])
        results = {adjoint: opacities(data(), given, way, adjoint) for adjoint in ("replay", "direct")}
        (_, leapt), gradient = results["replay"]
        (_, whole), expected = results["direct"]
        np.testing.assert_allclose(leapt.rgba, whole.rgba, atol=1e-12)
        fewer = np.asarray(leapt.samples) < np.asarray(whole.samples) / 2
        assert fewer.sum() > RAYS / 4, (leapt.samples, whole.samples)
        assert (np.asarray(whole.rgba)[..., 3] > 0.1).sum() > RAYS / 4
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9), gradient, expected)


def test_a_cell_that_is_empty_reaches_nothing_visible():
    """By points of the grid, none of whose cubes may be empty if its block is visible."""
    random = np.random.default_rng(1)
    visible = random.random((1, 4, 8)) < 0.1
    volume = jv.Volume(data().astype(np.float32))

    @jax.jit
    def cells_of(radii, visible):
        cells = march(radii, 0.1).locate(volume).occupancy(visible)
        return cells.occupied, jnp.stack(cells.origin), jnp.stack(cells.size)

    cells, low, size = map(np.asarray, cells_of(RADII.astype(np.float32), visible))
    coordinate = random.uniform(0, 1, (20_000, 3)) * (4, 16, 32)
    block = np.minimum(coordinate // 4, (0, 3, 7)).astype(int)
    radius = RADII[0] + coordinate[:, 0] / 4
    latitude, longitude = np.pi * (coordinate[:, 1] / 16 - 0.5), np.pi * (coordinate[:, 2] / 16 - 1)
    point = np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], 0
    )
    x, y, z = (((radius * point).T - low) / size).T.astype(int)
    occupied = cells[x, y, z]
    shown = visible[tuple(block.T)]
    assert occupied[shown].all()
    assert occupied[~shown].mean() < 0.5
