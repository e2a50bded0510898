"""Are majorants upper bounds of the extinction, and is tracking with them unbiased?"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

import jaxvol as jv
from jaxvol._util.noise import hashed_uniforms_4
from jaxvol._util.piecewise_linear import upper_bound_between
from jaxvol._util.vec3 import apart
from jaxvol.lighting import Material
from jaxvol.path_tracing.medium import Medium
from jaxvol.path_tracing.tracking import Flight, fly
from jaxvol.scene.occupancy import Blocks

from ..scenes import anisotropic_noise


SHAPE = (9, 6, 14)


def random_transfer(random: np.random.Generator, points: int) -> jv.TransferFunction:
    values = np.cumsum(random.random(points) ** 4 + 1e-3)
    values = (values - values[0]) / (values[-1] - values[0])
    extinction = random.random(points) * 10.0 ** random.integers(-3, 4, points)
    extinction[random.random(points) < 0.4] = 0
    return jv.TransferFunction(values, random.random((points, 3)), extinction)


def random_labelled(random: np.random.Generator, points: int) -> jv.LabelTransferFunction:
    return jv.LabelTransferFunction([random_transfer(random, points), None, random_transfer(random, points)])


def random_volume(random: np.random.Generator) -> jv.Volume:
    smooth = np.cumsum(random.normal(size=SHAPE), axis=random.integers(3))
    data = (smooth - smooth.min()) / np.ptp(smooth)
    data[random.random(SHAPE) < 0.2] = 0
    labels = (np.arange(SHAPE[0])[:, None, None] // random.integers(2, 6) + np.zeros(SHAPE, int)) % 4
    return jv.Volume(data.astype(np.float32), (0.1, 0.2, 0.15), labels=labels.astype(np.int16))


def random_materials(random: np.random.Generator) -> tuple[Material, ...]:
    low, high = np.sort(random.random(2))
    paths = 10.0 ** random.uniform(-3, 2, 3)
    return (
        Material(0.5, paths[0], values=(low, high + 1e-3)),
        Material(0.2, paths[1], label=2),
        Material(0.9, paths[2], values=(0.0, low)),
    )


def places(random: np.random.Generator) -> np.ndarray:
    """Grid coordinates: anywhere, at nodes, and on faces of blocks."""
    last = np.array(SHAPE) - 1
    anywhere = random.random((1500, 3)) * last
    nodes = random.integers(0, last + 1, (300, 3)).astype(float)
    faces = random.random((300, 3)) * last
    axis = random.integers(3, size=300)
    faces[np.arange(300), axis] = np.minimum(4 * random.integers(0, 4, 300), last[axis])
    return np.concatenate([anywhere, nodes, faces]).astype(np.float32)


@jax.jit
def extinction_and_majorant(volume, blocks, transfer, materials, coordinates):
    medium = Medium.of(volume, blocks, transfer, materials)
    majorants = medium.majorants

    def at(coordinate):
        place = apart(coordinate)
        extinction, albedo = medium.classify(medium.measure(place))
        return extinction, jnp.stack(albedo), majorants.at(majorants.holding(place))

    return jax.vmap(at)(coordinates)


@pytest.mark.parametrize(
    ("transfers", "points", "with_materials"), [(random_labelled, 40, True), (random_transfer, 6, False)]
)
def test_no_extinction_exceeds_its_majorant(transfers, points, with_materials):
    for seed in range(25):
        random = np.random.default_rng(seed)
        volume, transfer = random_volume(random), transfers(random, points)
        materials = random_materials(random) if with_materials else ()
        given = volume, Blocks.of(volume), transfer, materials, places(random)
        extinction, albedo, entry = (np.asarray(a) for a in extinction_and_majorant(*given))
        assert extinction.max() > 0
        assert np.all(extinction <= np.maximum(entry, 0))
        assert np.all((albedo >= 0) & (albedo <= 1))


def test_a_material_has_the_extinction_of_its_mean_free_path_and_the_albedo_of_its_opacity():
    """Where the transfer function shows something; of materials that overlap the first."""
    found = np.zeros(3)
    for seed in range(10):
        random = np.random.default_rng(seed)
        volume, transfer = random_volume(random), random_labelled(random, 40)
        materials = random_materials(random)
        nodes = np.resize(np.indices(SHAPE, np.float32).reshape(3, -1).T, places(random).shape)
        given = volume, Blocks.of(volume), transfer, materials, nodes
        extinction, albedo, _ = (np.asarray(a) for a in extinction_and_majorant(*given))
        values, labels = (np.resize(np.asarray(leaf), len(nodes)) for leaf in (volume.data, volume.labels))
        shown, seen = extinction > 0, np.zeros(len(nodes), bool)
        assert not shown[labels == 1].any()
        for number, material in enumerate(materials):
            here = labels == material.label
            if material.values is not None:
                low, high = np.asarray(material.values)
                here = (values >= low) & (values <= high)
            here &= shown & ~seen
            seen |= here
            found[number] += here.sum()
            np.testing.assert_allclose(extinction[here], 1 / np.asarray(material.mean_free_path), rtol=1e-6)
            for label in (0, 2):
                function, of_label = transfer.stacked, here & (labels == label)
                points, colors = (np.asarray(part)[label] for part in (function.values, function.colors))
                color = [np.interp(values[of_label], points, part) for part in colors.T]
                expected = np.stack(color, axis=1) * (1 - np.asarray(material.opacity))
                np.testing.assert_allclose(albedo[of_label], expected, atol=1e-3)
    assert np.all(found > 100)


def test_bounds_are_no_larger_than_need_be():
    random = np.random.default_rng(0)
    bounds = jax.jit(upper_bound_between)
    for points in (2, 33):
        transfer = random_transfer(random, points)
        low, high = np.sort(random.uniform(-0.1, 1.1, (2, 200)), axis=0).astype(np.float32)
        bound = np.asarray(bounds(transfer.values, transfer.extinction, low, high))
        values, extinction = (np.asarray(a, float) for a in (transfer.values, transfer.extinction))
        for a, b, upper in zip(low, high, bound, strict=True):
            inside = values[(values >= a) & (values <= b)]
            least = np.interp([a, b, *inside], values, extinction).max()
            assert least <= upper <= least * 1.0001 + 1e-5 * extinction.max()


FLIGHTS = {
    # start (grid coordinate), direction (world), length (world)
    "across": ((0.0, 3.2, 1.0), (0.7, 0.5, 0.6), np.inf),
    "backwards": ((22.9, 20.0, 21.5), (-0.6, -0.7, -0.2), np.inf),
    "along an axis, in a face": ((8.0, 8.0, 0.0), (0.0, 0.0, 1.0), np.inf),
    "from the middle, on to a place within": ((11.5, 12.0, 7.3), (0.3, -0.8, 0.5), 0.5),
    "in a corner's diagonal": ((0.0, 0.0, 0.0), (0.05, 0.08, 0.11), np.inf),
}
COUNT = 40_000


@jax.jit
def tracked(volume, transfer, start, direction, length):
    """Transmittances by ratio tracking, whether delta tracking passes, which flights are done, and steps."""
    medium = Medium.of(volume, Blocks.of(volume), transfer)
    majorants = medium.majorants
    triples = [tuple(jnp.full(COUNT, a) for a in apart(vector)) for vector in (start, direction)]
    flights = jax.vmap(
        lambda start, direction: Flight.to(majorants, start, direction, apart(volume.spacing), length)
    )(*triples)

    def go(state):
        flights, left, passes, done, step = state
        lane = jnp.arange(COUNT, dtype=jnp.uint32)
        zero = jnp.zeros_like(lane)
        draw, decide, _, _ = hashed_uniforms_4(lane, zero, zero + step.astype(jnp.uint32), zero)
        flights, candidate = jax.vmap(lambda flight, u: fly(majorants, flight, u))(flights, draw)
        extinction, _ = jax.vmap(lambda coordinate: medium.classify(medium.measure(coordinate)))(
            candidate.coordinate
        )
        share = extinction / jnp.maximum(candidate.majorant, 1e-30)
        counts = candidate.hit & ~done
        left = jnp.where(counts, left * (1 - share), left)
        return flights, left, passes & ~(counts & (decide < share)), done | candidate.ended, step + 1

    no = jnp.zeros(COUNT, bool)
    state = flights, jnp.ones(COUNT), ~no, no, jnp.zeros((), jnp.int32)
    _, left, passes, done, step = jax.lax.while_loop(
        lambda state: ~jnp.all(state[3]) & (state[4] < 5000), go, state
    )
    return left, passes, done, step


@pytest.mark.parametrize("name", FLIGHTS)
def test_transmittance_is_that_of_the_optical_depth(name):
    start, direction, length = FLIGHTS[name]
    volume = anisotropic_noise()
    values = np.linspace(0, 1, 8)
    transfer = jv.TransferFunction(values, np.ones((8, 3)), [0, 0, 0, 3, 0, 0.2, 1.5, 6])
    direction = np.asarray(direction) / np.linalg.norm(direction)
    given = (np.asarray(part, np.float32) for part in (start, direction, length))
    left, passes, done, _ = jax.device_get(tracked(volume, transfer, *given))
    assert np.all(done)

    rate = direction / np.asarray(volume.spacing, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (np.where(rate > 0, 23, 0) - np.asarray(start)) / rate
    end = min(np.min(ends[rate != 0]), length)
    depths = (np.arange(200_000) + 0.5) * end / 200_000
    coordinates = np.asarray(start) + depths[:, None] * rate
    value = map_coordinates(np.asarray(volume.data, float), coordinates.T, order=1, mode="nearest")
    expected = np.exp(-np.interp(value, values, np.asarray(transfer.extinction, float)).mean() * end)

    assert 0.05 < expected < 0.95
    ratio = np.asarray(left, float)
    assert abs(ratio.mean() - expected) < 3.5 * ratio.std() / np.sqrt(COUNT)
    assert abs(np.mean(passes) - expected) < 3.5 * np.sqrt(expected * (1 - expected) / COUNT)
    assert ratio.std() < np.std(passes)
