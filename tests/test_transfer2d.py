"""Transfer functions of value and gradient magnitude: the table, its bounds, images and gradients."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.engine.acceleration import VolumeAcceleration
from jaxvol.fitting.constraints import Free
from jaxvol.lighting import ConstantLight, Phong
from jaxvol.occupancy import BLOCK, Blocks

from .lighting.test_phong import SETS, of_reference, scene_of, shells, smooth_scene, soft
from .oracle import box_interval
from .scenes import in_float64, slow, to_float64


def random_table(n: int, m: int, seed: int = 0) -> jv.TransferFunction2D:
    """Values from 0 to 10, magnitudes from 0 to 5; a third of the extinctions are 0."""
    random = np.random.default_rng(seed)
    values, magnitudes = (np.sort(random.uniform(0, top, count)) for top, count in ((10, n), (5, m)))
    extinction = random.uniform(0, 2, (n, m)) * (random.random((n, m)) > 1 / 3)
    return jv.TransferFunction2D(values, magnitudes, random.random((n, m, 3)), extinction)


def looked_up(transfer: jv.TransferFunction2D, values: Any, magnitudes: Any) -> np.ndarray:
    """Colour and extinction, (points, 4)."""
    places = (jnp.asarray(each, jnp.float32) for each in (values, magnitudes))
    color, extinction = jax.jit(jax.vmap(transfer))(*places)
    return np.stack([*color, extinction], axis=-1)


# ---------------------------------------------------------------- the table


@pytest.mark.parametrize(("n", "m"), [(2, 2), (5, 3), (40, 30)])
def test_the_table_is_bilinear_and_constant_beyond_its_lines(n, m):
    transfer, random = random_table(n, m), np.random.default_rng(1)
    lines = np.asarray(transfer.values, float), np.asarray(transfer.magnitudes, float)
    places = np.concatenate(
        [
            random.uniform((-2, -1), (12, 6), (2000, 2)),
            np.stack(np.meshgrid(*lines), axis=-1).reshape(-1, 2),  # the corners themselves
        ]
    )
    table = np.concatenate([transfer.colors, transfer.extinction[..., None]], axis=-1)
    inside = np.clip(places, [line[0] for line in lines], [line[-1] for line in lines])
    expected = RegularGridInterpolator(lines, table.astype(float))(inside)
    # of lines that lie close together, places are rounded
    near = min(float(np.diff(line).min()) for line in lines)
    np.testing.assert_allclose(looked_up(transfer, *places.T), expected, atol=2e-6 + 4e-6 / near)


def test_two_equal_lines_make_a_step():
    """What lies below takes the first one's entries, what lies there or above the second's; also at ends."""
    extinction = np.array([[1.0, 1, 2, 2], [3, 3, 4, 4], [5, 5, 6, 6], [7, 7, 8, 8]])
    transfer = jv.TransferFunction2D((1, 1, 3, 3), (2, 4, 4, 5), np.zeros((4, 4, 3)), extinction)
    values, magnitudes = [0.9, 1, 2, 3, 0.9, 3], [2, 2, 2, 3.9, 4, 4]
    found = looked_up(transfer, values, magnitudes)[:, 3]
    np.testing.assert_allclose(found, [1, 3, 4, 7, 2, 8], rtol=1e-6)


def test_the_pull_of_many_samples_is_jaxs_derivative():
    """The faster one that engines use, for a table and for places on and beyond its ends."""
    transfer, random = random_table(5, 4), np.random.default_rng(2)
    value, magnitude = (jnp.asarray(random.uniform(-1, top, (3, 50)), jnp.float32) for top in (12, 6))
    value = value.at[0, 0].set(transfer.values[0]).at[0, 1].set(transfer.values[-1])
    places = value, magnitude
    r, g, b, of_extinction = (jnp.asarray(random.normal(size=(3, 50)), jnp.float32) for _ in range(4))

    def all_(transfer, places):
        color, extinction = jax.vmap(jax.vmap(transfer))(*places)
        return [*color, extinction]

    _, pull = jax.vjp(all_, transfer, places)
    expected, of_places = pull([r, g, b, of_extinction])
    search = jax.vmap(jax.vmap(lambda *place: transfer.search()(place)))
    found, of_measured = transfer.pull((*places, *search(*places)), (r, g, b), of_extinction)
    for a, b in zip(
        jax.tree.leaves((found, of_measured)), jax.tree.leaves((expected, of_places)), strict=True
    ):
        np.testing.assert_allclose(a, b, atol=1e-4, rtol=1e-4)


def test_emphasis_scales_the_extinction_by_the_magnitude():
    transfer = jv.TransferFunction2D.from_transfer(soft(), (2.0, 6.0), inside=0.25)
    values, magnitudes = np.linspace(-5, 260, 60), np.linspace(0, 9, 60)
    color, extinction = jax.vmap(soft())(jnp.asarray(values, jnp.float32))
    found = looked_up(transfer, values, magnitudes)
    factor = 0.25 + 0.75 * np.clip((magnitudes - 2) / 4, 0, 1)
    np.testing.assert_allclose(found[:, 3], extinction * factor, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(found[:, :3], np.stack(color, axis=-1), atol=1e-5)


POINTS = [
    (20.0, 6.0, (1.0, 0.0, 0.0), 0.5, (10.0, 4.0)),
    (60.0, 3.0, (0.0, 1.0, 0.0), 0.9, (20.0, 3.0)),
    (70.0, 4.0, (0.0, 0.0, 1.0), 0.2, (20.0, 2.0)),
]


def test_nothing_is_left_of_a_point_at_its_sides_and_beyond():
    """Where quotients that would be 1 are rounded, as of these numbers."""
    for seed in range(50):
        value, magnitude, reach, other = np.random.default_rng(seed).uniform(0.01, 1, 4).round(2)
        point = (value, magnitude, (1.0, 0.5, 0.2), 0.9, (reach, other))
        transfer = jv.TransferFunction2D.from_points([point])
        extinction = np.asarray(transfer.extinction)
        np.testing.assert_array_equal(extinction[[0, -1]], 0)
        np.testing.assert_array_equal(extinction[:, [0, -1]], 0)
        assert extinction.max() > 2


def test_points_are_tents_and_add_up():
    transfer = jv.TransferFunction2D.from_points(POINTS, unit_distance=2.0)
    random = np.random.default_rng(3)
    places = random.uniform((0, 0), (100, 12), (4000, 2))
    expected = np.zeros(len(places))
    for value, magnitude, _, opacity, (reach, other) in POINTS:
        tents = [
            np.maximum(1 - np.abs(at - center) / far, 0)
            for at, center, far in zip(places.T, (value, magnitude), (reach, other), strict=True)
        ]
        expected -= np.log(1 - opacity) / 2 * tents[0] * tents[1]
    found = looked_up(transfer, *places.T)
    np.testing.assert_allclose(found[:, 3], expected, atol=1e-5)
    alone = np.abs(places[:, 0] - 20) < 10  # of the first point alone, up to its sides
    np.testing.assert_allclose(found[alone & (expected > 0), :3], [[1, 0, 0]] * sum(alone & (expected > 0)))


# ---------------------------------------------------------------- the magnitude


RAMP, SPACING = np.array([3.0, -4.0, 12.0]), np.array([0.5, 0.25, 0.2])


def ramp(kind: str = "float32") -> jv.Volume:
    """Values that rise by `RAMP` from node to node."""
    data = 100 + np.indices((9, 7, 8)).reshape(3, -1).T @ RAMP
    return jv.Volume(data.reshape(9, 7, 8).astype(kind), SPACING)


@pytest.mark.parametrize("kind", ["uint8", *slow("float32")])
def test_the_magnitude_is_in_value_units_per_world_length(kind):
    """A ramp of constant gradient is a homogeneous fog: 1 - exp(-σ L), where σ is that of its magnitude."""
    volume, magnitude = ramp(kind), np.linalg.norm(RAMP / SPACING)
    extinction = np.array([[0, 1.2], [0, 1.2]])
    transfer = jv.TransferFunction2D((0, 300), (0, 2 * magnitude), np.ones((2, 2, 3)), extinction)
    camera = jv.Camera.looking_at(volume, (0.4, 0.3, 0.8), size=(6, 5))
    march = jv.March(0.11, (jv.AlphaCorrection(),))
    found = jv.render(volume, transfer, camera, march, outputs="rgba").rgba[..., 3]
    rays = (np.asarray(each, float).reshape(-1, 3) for each in camera.rays())
    first, last = box_interval(*rays, *(np.asarray(corner, float) for corner in volume.corners))
    expected = 1 - np.exp(-0.6 * np.maximum(last - first, 0))
    assert expected.max() > 0.3
    np.testing.assert_allclose(found.reshape(-1), expected, atol=5e-6)


# ---------------------------------------------------------------- bounds over blocks

KINDS = ["uint8", "uint16", "float32", "NaN"]


def patches(kind: str, seed: int = 0) -> jv.Volume:
    """Parts of noise, of a smooth wave, and of constant values, of 10 units at most. These end in steps that
    only nodes on faces of blocks see."""
    random = np.random.default_rng(seed)
    x, y, z = np.indices((22, 15, 17))
    data = np.where(x < 8, random.uniform(0, 10, x.shape), 5 + 4 * np.sin(0.3 * y + 0.2 * z))
    data = np.where(z > 8, np.where((x > 12) & (y > 9), 3.0, 7.0), data)
    volume = jv.Volume(np.round(data).astype("float32" if kind == "NaN" else kind), (0.9, 2.0, 1.3))
    if kind == "float32":
        volume = jv.Volume(data, volume.spacing)
    if kind == "NaN":
        volume = eqx.tree_at(lambda v: v.data, volume, volume.data.at[10, 5, 12].set(jnp.nan))
    return volume


@eqx.filter_jit
def at_places(volume, transfer, places):
    """Magnitude and extinction at grid coordinates."""
    classification = transfer.classification(volume)

    def at(place):
        measured = classification.at(apart(place))
        return measured[1], classification.classify(measured)[1]

    return jax.vmap(at)(places)


def measured_in_blocks(volume: jv.Volume, transfer: jv.TransferFunction2D) -> tuple[Any, ...]:
    """Magnitude and extinction at many places, and the block of each. Nodes are among them, those on faces as
    parts of the blocks on either side."""
    last = np.array(volume.shape) - 1
    nodes = np.indices(volume.shape).reshape(3, -1).T
    places = np.concatenate([np.random.default_rng(5).uniform(0, last, (60_000, 3)), nodes])
    blocks = np.concatenate([places // BLOCK, np.maximum(-(-nodes // BLOCK) - 1, 0)])
    places = jnp.asarray(np.concatenate([places, nodes]), jnp.float32)
    block = tuple(np.minimum(blocks, (last - 1) // BLOCK).astype(int).T)
    return *(np.asarray(each) for each in at_places(volume, transfer, places)), block


@eqx.filter_jit
def bounds(transfer, blocks):
    return transfer.majorant(blocks), transfer.visible(blocks)


@pytest.mark.parametrize("kind", KINDS)
def test_ranges_of_magnitude_and_majorants_hold_all_that_is_in_a_block(kind):
    volume = patches(kind)
    blocks = Blocks.of(volume, slopes=True)
    least, most = (np.asarray(each) for each in blocks.magnitudes)
    unordered = np.asarray(blocks.unordered)
    assert np.any(unordered) == (kind == "NaN")
    for seed in range(6):
        transfer = random_table(12, 9, seed)
        magnitude, extinction, block = measured_in_blocks(volume, transfer)
        # a node on a face is interpolated with those above it, also in the block below: 0 · NaN is NaN
        lost, above = np.isnan(extinction), np.s_[: -volume.data.size]
        assert np.all(unordered[block][above][lost[above]])
        known = ~unordered[block] & ~lost
        assert np.all((least[block] <= magnitude)[known])
        assert np.all((magnitude <= most[block])[known])
        bound, visible = (np.asarray(each) for each in bounds(transfer, blocks))
        assert np.all((extinction <= bound[block])[known])
        np.testing.assert_array_equal((bound > 0)[~unordered], visible[~unordered])


def test_slopes_of_large_doubles_are_not_lost():
    with in_float64():
        x = np.arange(9.0)
        volume = jv.Volume(np.broadcast_to((1e5 + 0.002 * np.sin(2 * x))[:, None, None], (9, 9, 9)))
        least, most = (np.asarray(each) for each in Blocks.of(volume, slopes=True).magnitudes)
        slopes = np.abs(np.gradient(np.asarray(volume.data), axis=0))
        for block in (0, 1):
            here = slopes[4 * block : 4 * block + 5]
            assert np.all(most[block] >= here.max())
            assert np.all(most[block] <= 1.01 * here.max())
            assert np.all(least[block] <= here.min())


def test_bounds_are_close_and_homogeneous_blocks_are_empty():
    volume = patches("float32")
    transfer = jv.TransferFunction2D.from_transfer(
        jv.TransferFunction((-1, 11), np.ones((2, 3)), (1.0, 1.0)), (0.2, 1.0)
    )
    blocks = Blocks.of(volume, slopes=True)
    constant = np.s_[:, :2, 3:]
    assert not np.any(transfer.visible(blocks)[constant])
    assert np.all(transfer.majorant(blocks)[constant] == 0)
    assert np.all(transfer.visible(blocks)[:2, :, :2])
    assert np.all(transfer.visible(Blocks.of(volume)))  # nothing is known about slopes
    # of the wave, whose slopes have one direction
    least, most = (np.asarray(each)[3:, :, 0] for each in blocks.magnitudes)
    magnitude, _, block = measured_in_blocks(volume, transfer)
    wave = (block[0] >= 3) & (block[2] == 0)
    greatest = np.full(blocks.low.shape, 0.0)
    np.maximum.at(greatest, tuple(each[wave] for each in block), magnitude[wave])
    assert np.all(most <= 1.1 * greatest[3:, :, 0] + 0.1)
    assert np.all(least <= most)


def test_the_greatest_of_a_table_is_that_of_its_lines():
    """By comparison with all of them, for ranges of every kind."""
    transfer, random = random_table(33, 17), np.random.default_rng(6)
    extinction = np.where(random.random((33, 17)) < 0.1, transfer.extinction, 0)
    transfer = eqx.tree_at(lambda t: t.extinction, transfer, jnp.asarray(extinction))
    lines = np.asarray(transfer.values), np.asarray(transfer.magnitudes)
    ends = np.sort(random.uniform(-1, (11, 6), (2, 4000, 2)), axis=0)
    ends[1, :1000] = ends[0, :1000] + 0.3 * random.random((1000, 2))
    ends[:, -50:, 0] = random.choice(lines[0], 50)
    ends = ends.astype(np.float32)

    class Given(Blocks):
        @property
        def magnitudes(self):
            return jnp.asarray(ends[0][:, 1, None, None]), jnp.asarray(ends[1][:, 1, None, None])

    blocks = Given(jnp.asarray(ends[0][:, 0, None, None]), jnp.asarray(ends[1][:, 0, None, None]), None)
    expected = np.zeros(len(ends[0]))
    for index, (low, high) in enumerate(zip(*ends, strict=True)):
        first = [max(np.sum(line <= at) - 1, 0) for line, at in zip(lines, low, strict=True)]
        last = [
            min(max(np.sum(line < at), np.sum(line <= at) - 1), len(line) - 1)
            for line, at in zip(lines, high, strict=True)
        ]
        expected[index] = extinction[first[0] : last[0] + 1, first[1] : last[1] + 1].max()
    found = np.asarray(transfer.majorant(blocks)).reshape(-1)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert 0.2 < np.mean(found == 0) < 0.8


# ---------------------------------------------------------------- images


def emphasised() -> jv.TransferFunction2D:
    return jv.TransferFunction2D.from_transfer(soft(), (50.0, 250.0), 0.0)


@pytest.mark.parametrize(
    ("transforms", "kind", "lit"),
    [
        ("everything", "uint8", False),
        *slow(
            *((name, kind, lit) for name in SETS for kind in ("uint8", "float32") for lit in (False, True))
        ),
    ],
)
def test_the_fast_engine_is_the_reference(transforms, kind, lit):
    """Which does not leap, and stores no slopes."""
    volume, _, camera, march = scene_of(SETS[transforms], kind=kind)
    scene, lighting = (volume, emphasised(), camera, march), Phong() if lit else None
    found = jv.render(*scene, lighting=lighting)
    assert found.rgba[..., :3].max() > 0.1
    np.testing.assert_allclose(found.rgba, of_reference(scene, lighting), atol=2e-5)


@pytest.mark.parametrize("method", slow("hierarchy", "distance", "beam"))
def test_leaping_shows_neither_in_the_image_nor_in_its_gradient(method):
    with in_float64():
        volume, _, camera, _ = to_float64(scene_of((), size=(40, 36), kind="float32"))

        def loss(parts, transforms):
            rgba = jv.render(*parts, march=jv.March(0.11, transforms)).rgba
            return jnp.sum(rgba**2), rgba

        always, parts = (jv.EmptySpaceJitter(4), jv.AlphaCorrection()), (volume, emphasised(), camera)
        (slope, whole), (other_slope, other) = (
            eqx.filter_grad(loss, has_aux=True)(parts, transforms)
            for transforms in (always, (*always, jv.SpaceLeaping(method)))
        )
        assert np.mean(emphasised().visible(Blocks.of(volume, slopes=True))) < 0.8
        np.testing.assert_allclose(whole, other, atol=1e-9)
        # leaps miss the derivative by an extinction of 0
        seen = emphasised().extinction > 0
        slopes = [
            eqx.tree_at(lambda s: s[1].extinction, each, jnp.where(seen, each[1].extinction, 0))
            for each in (slope, other_slope)
        ]
        for a, b in zip(*map(jax.tree.leaves, slopes), strict=True):
            assert np.linalg.norm(a - b) <= 1e-6 * max(np.linalg.norm(a), 1e-3)


def test_slopes_are_stored_for_a_transfer_function_that_reads_them():
    march = jv.March(0.1, (jv.SpaceLeaping(),))
    for transfer, stored in ((soft(), False), (emphasised(), True)):
        found = VolumeAcceleration.of(shells(), transfer, march)
        assert found.blocks is not None
        assert (found.slopes is not None) == (found.blocks.slopes is not None) == stored


@pytest.mark.slow
def test_a_path_traced_image_has_the_same_opacity():
    """Of a black fog, through which light passes straight."""
    volume, _, camera, _ = scene_of((), size=(8, 6))
    transfer = eqx.tree_at(lambda t: t.colors, emphasised(), replace_fn=jnp.zeros_like)
    march = jv.March(0.01, (jv.AlphaCorrection(),), "midpoint")
    traced = jv.path_trace(volume, transfer, camera, ConstantLight(), paths=2000)
    expected = jv.render(volume, transfer, camera, march).rgba[..., 3]
    np.testing.assert_allclose(traced.opacity, expected, atol=0.06)
    assert abs(np.mean(traced.opacity - expected)) < 0.005


# ---------------------------------------------------------------- gradients

LEAVES: dict[str, Callable[[Any], Any]] = {
    "voxels": lambda s: s[0].data,
    "spacing": lambda s: s[0].spacing,
    "origin": lambda s: s[0].origin,
    "extinction": lambda s: s[1].extinction,
    "colors": lambda s: s[1].colors,
    "position": lambda s: s[2].position,
    "focal point": lambda s: s[2].focal_point,
}


def smooth() -> Any:
    """Voxels of float64, and a table without zeros."""
    volume, _, camera = smooth_scene()
    volume = eqx.tree_at(lambda v: v.data, volume, jnp.asarray(volume.data, jnp.float64))
    random = np.random.default_rng(7)
    extinction = random.uniform(0.1, 0.9, (3, 4))
    lines = (-0.2, 0.3, 0.8), (0.1, 0.22, 0.27, 0.4)
    transfer = jv.TransferFunction2D(lines[0], lines[1], random.random((3, 4, 3)), extinction)
    return volume, transfer, camera, jv.March(0.23, (jv.AlphaCorrection(),), max_samples=32)


def of_bytes(*transforms: jv.Transform) -> Any:
    """8-bit voxels, whose slopes are stored, and blocks that are empty because nothing is steep there."""
    march = jv.March(0.23, (jv.AlphaCorrection(), *transforms), max_samples=32)
    volume, _, camera, _ = scene_of((), size=(6, 5))
    assert 0.2 < np.mean(emphasised().visible(Blocks.of(volume, slopes=True))) < 0.8
    return volume, emphasised(), camera, march


def leapt() -> Any:
    return of_bytes(jv.SpaceLeaping())


HOW = ("replay", False), ("forward", False)


@pytest.mark.parametrize(
    ("make", "adjoint", "lit"),
    [
        (of_bytes, "replay", False),
        *slow(*((smooth, *how) for how in (*HOW, ("replay", True), ("direct", False)))),
        *slow(*((leapt, *how) for how in (*HOW, ("replay", True)))),
    ],
)
def test_gradients_match_central_differences(make, adjoint, lit):
    """Of the transfer function, of the voxels through value and magnitude, of camera and spacing."""
    with in_float64():
        *scene, march = to_float64(make())
        lighting = to_float64(Phong()) if lit else None

        # not under jit, where 8-bit voxels are not packed
        def loss(scene, adjoint="replay"):
            options = {"lighting": lighting, "adjoint": adjoint, "outputs": "rgba"}
            rgba = jv.render(*scene, march=march, **options).rgba
            weights = jnp.asarray(np.random.default_rng(3).uniform(0.2, 1, rgba.shape))
            return jnp.sum(weights * rgba)

        def changed(where, leaf):
            return eqx.tree_at(where, scene, leaf)

        random = np.random.default_rng(4)
        leaves = {n: where for n, where in LEAVES.items() if eqx.is_inexact_array(where(scene))}
        directions = {n: jnp.asarray(random.normal(size=where(scene).shape)) for n, where in leaves.items()}
        # leaps miss the derivative by an extinction of 0
        directions["extinction"] = jnp.where(scene[1].extinction > 0, directions["extinction"], 0)
        if adjoint == "forward":
            found = {
                name: jax.jvp(
                    lambda leaf, where=where: loss(changed(where, leaf), adjoint),
                    *((where(scene),), (directions[name],)),
                )[1]
                for name, where in leaves.items()
            }
        else:
            slopes = eqx.filter_grad(loss)(scene, adjoint)
            found = {n: jnp.sum(where(slopes) * directions[n]) for n, where in leaves.items()}
        for name, where in leaves.items():
            step = 1e-6 * directions[name]
            ahead, behind = (loss(changed(where, where(scene) + side * step)) for side in (1, -1))
            expected = float(ahead - behind) / 2e-6
            assert abs(expected) > 1e-3, name
            assert abs(float(found[name]) - expected) <= 1e-5 * abs(expected), name


def test_nothing_that_is_steep_has_no_gradient_by_its_magnitude():
    """Where the magnitude is 0, which has a kink there, its derivative is 0 and not NaN."""

    def loss(data):
        volume = jv.Volume(data)
        transfer = jv.TransferFunction2D((0, 1), (0, 1), np.ones((2, 2, 3)), [[0.5, 1], [0.5, 1]])
        measured = transfer.classification(volume).at(apart(jnp.full(3, 1.3)))
        return transfer.classifier()(measured)[1]

    np.testing.assert_array_equal(jax.grad(loss)(jnp.full((4, 4, 4), 0.5)), 0)


# ---------------------------------------------------------------- arguments

ONES = np.ones((2, 2, 3)), np.ones((2, 2))
make = jv.TransferFunction2D
points = make.from_points
WRONG: dict[str, tuple[Callable[[], Any], str]] = {
    "one value": (lambda: make((1,), (0, 1), *ONES), "values must hold at least 2"),
    "values": (lambda: make((2, 1), (0, 1), *ONES), "values must increase"),
    "magnitudes": (lambda: make((1, 2), (1, 0), *ONES), "magnitudes must increase"),
    "colors": (lambda: make((1, 2), (0, 1), np.ones((2, 3)), ONES[1]), r"colors must have shape \(2, 2, 3\)"),
    "extinction": (
        lambda: make((1, 2), (0, 1), ONES[0], np.ones((2, 3))),
        r"extinction must have shape \(2, 2\)",
    ),
    "negative": (lambda: make((1, 2), (0, 1), ONES[0], -ONES[1]), "extinction must not be negative"),
    "NaN": (lambda: make((1, 2), (0, np.nan), *ONES), "magnitudes must be finite"),
    "no function": (
        lambda: make.from_transfer(emphasised(), (0, 1)),
        "transfer must be a TransferFunction; got a T",
    ),
    "low and high": (lambda: make.from_transfer(soft(), (1, 1)), r"magnitudes must be \(low, high\)"),
    "inside": (lambda: make.from_transfer(soft(), (0, 1), 1.5), r"inside must be in \[0, 1\]"),
    "no points": (lambda: points([]), "points must be one or more of"),
    "triples": (lambda: points([(1, (1, 1, 1), 0.5)]), "points must be one or more of"),
    "opacity": (lambda: points([(1, 1, (1, 1, 1), 1.5, (1, 1))]), r"opacity must be in \[0, 1\]"),
    "reach": (lambda: points([(1, 1, (1, 1, 1), 0.5, (1, 0))]), "reaches must be positive"),
    "reaches": (lambda: points([(1, 1, (1, 1, 1), 0.5, 1)]), r"reaches must have shape \(1, 2\)"),
    "traced": (
        lambda: jax.jit(lambda v: points([(v, 1, (1, 1, 1), 0.5, (1, 1))]).extinction)(1.0),
        "must be numbers; some are traced",
    ),
    "written": (lambda: jv.write_transfer("never.json", emphasised()), "transfer must be a TransferFunction"),
}


@pytest.mark.parametrize("name", WRONG)
def test_bad_arguments_are_named(name):
    make, message = WRONG[name]
    with pytest.raises(ValueError, match=message):
        make()


def test_what_needs_more_than_a_sample_is_refused():
    volume, _, camera, march = scene_of(())
    scene = volume, emphasised(), camera
    with pytest.raises(ValueError, match="TransferFunction2D has no integrator"):
        jv.render(*scene, jv.March(march.step, (), "preintegrated"))
    with pytest.raises(ValueError, match="TransferFunction2D reads more"):
        jv.render(*scene, march, compositing="average")


def test_a_fit_changes_colours_and_extinction_alone():
    free, start = Free.of(emphasised(), None, None)
    assert {name.split("[")[0] for name in free.names(start)} == {".colors", ".extinction"}


def test_opacity_is_that_of_a_layer():
    transfer = make((0, 1), (0, 1), ONES[0], [[0.0, 1.0], [2.0, 3.0]])
    np.testing.assert_allclose(
        transfer.opacity(2.0), 1 - np.exp(-2 * np.asarray([[0, 1], [2, 3]])), rtol=1e-6
    )
