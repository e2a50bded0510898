"""Phong: normals, highlights and colours against theory, the engines against each other, gradients."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.engine.driver import render_scene
from jaxvol.engine.packing import slopes_of, with_words, words_of
from jaxvol.engine.scene import Scene
from jaxvol.engine.tiling import Tiling
from jaxvol.lighting import ConstantLight, Deferred, DirectionalLight, HeadLight, Phong, PointLight
from jaxvol.lighting.shading import Sample, Surroundings, shade_sample
from jaxvol.space import Affine, world_gradient

from ..scenes import FEW, TRANSFORMS, in_float64, slow, to_float64


SUN = DirectionalLight((0.4, 0.9, -0.6), (0.9, 1.0, 1.2))
LAMP = PointLight((0.6, -2.0, 1.3), (5.0, 4.0, 3.0))
LIGHTS: dict[str, Any] = {"head": HeadLight((1.0, 0.9, 0.8)), "sun": SUN, "all": (HeadLight(), SUN, LAMP)}


def accelerated(volume: jv.Volume) -> jv.Volume:
    """The volume as engines fetch it, with slopes stored where they can be."""
    return with_words(volume, words_of(volume), slopes_of(volume))


# ---------------------------------------------------------------- slopes


def noise(kind: Any, shape: tuple[int, int, int] = (6, 5, 7)) -> jv.Volume:
    data = np.random.default_rng(0).uniform(0, 255, shape)
    return jv.Volume(data.astype(kind), (0.5, 0.8, 1.1), (0.3, -1.2, 0.4))


def coordinates(shape: tuple[int, ...], low: float, high: float, count: int = 400) -> np.ndarray:
    """Random coordinates so many nodes inside the first and the last node."""
    span = np.asarray(shape) - 1
    return np.random.default_rng(1).uniform(low, span - high, (count, 3)).astype(np.float32)


def gradients(volume: jv.Volume, at: np.ndarray) -> np.ndarray:
    return np.asarray(jax.vmap(lambda c: jnp.stack(volume.gradient(apart(c))))(jnp.asarray(at)))


@pytest.mark.parametrize("kind", ["uint8", "int8", "int16", "float32"])
def test_the_gradient_is_interpolated_between_central_differences(kind):
    """At the border, too, where differences are one-sided, and also where slopes are stored."""
    data = np.random.default_rng(0).uniform(-100, 100, (6, 5, 7)) + (100 if kind == "uint8" else 0)
    volume = jv.Volume(data.astype(kind), (0.5, 0.8, 1.1))
    at = np.concatenate([coordinates(volume.shape, 0, 0), np.indices((6, 5, 7)).reshape(3, -1).T])
    nodes = np.gradient(np.asarray(volume.data, float), *np.asarray(volume.spacing, float))
    expected = np.stack([map_coordinates(part, at.T, order=1) for part in nodes], axis=-1)
    assert (slopes_of(volume) is not None) == (kind in ("uint8", "int8"))
    for each in (volume, accelerated(volume)):
        np.testing.assert_allclose(gradients(each, at), expected, atol=2e-3)


def test_inside_it_is_the_difference_of_values_one_node_to_either_side():
    volume = noise("float32")
    at = coordinates(volume.shape, 1, 1)

    def difference(axis: int) -> np.ndarray:
        one = np.eye(3, dtype=np.float32)[axis]
        value = jax.vmap(lambda c: volume.value(apart(c)))
        return np.asarray(value(jnp.asarray(at + one)) - value(jnp.asarray(at - one))) / 2

    expected = np.stack([difference(axis) for axis in range(3)], axis=-1) / np.asarray(volume.spacing)
    np.testing.assert_allclose(gradients(volume, at), expected, atol=2e-3)


def test_two_nodes_along_an_axis_have_one_slope():
    volume = jv.Volume(np.arange(8, dtype=np.uint8).reshape(2, 2, 2) ** 2, (0.5, 0.8, 1.1))
    at = coordinates(volume.shape, 0, 0, 50)
    nodes = np.gradient(np.asarray(volume.data, float), *np.asarray(volume.spacing, float))
    expected = np.stack([map_coordinates(part, at.T, order=1) for part in nodes], axis=-1)
    for each in (volume, accelerated(volume)):
        np.testing.assert_allclose(gradients(each, at), expected, atol=1e-4)


# ---------------------------------------------------------------- normals


def ball(points: np.ndarray) -> np.ndarray:
    """A ball of radius 1, whose values fall from 255 to 0 within a distance of 0.3."""
    return np.clip(127.5 - 850 * (np.linalg.norm(points, axis=-1) - 1), 0, 255)


def bell(points: np.ndarray) -> np.ndarray:
    return 255 * np.exp(-2 * np.sum(points**2, axis=-1))


FIELDS: dict[str, Callable[[np.ndarray], np.ndarray]] = {"ball": ball, "bell": bell}
KINDS = {"uint8": 1.0, "uint16": 200.0, "float32": 1.0}


def sampled(field: str, kind: str, spacing: tuple[float, float, float]) -> jv.Volume:
    """A field at the nodes of a grid over [-1.4, 1.4]³."""
    shape = [int(2.8 / step) for step in spacing]
    axes = (step * (np.arange(n) - (n - 1) / 2) for n, step in zip(shape, spacing, strict=True))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    data = FIELDS[field](points) * KINDS[kind]
    origin = [-step * (n - 1) / 2 for n, step in zip(shape, spacing, strict=True)]
    return jv.Volume((np.round(data) if kind != "float32" else data).astype(kind), spacing, origin)


def normals(volume: jv.Volume, space: Any, points: np.ndarray) -> np.ndarray:
    """Unit gradients at world points."""
    gradient = jax.jit(jax.vmap(lambda point: jnp.stack(world_gradient(volume, space, apart(point)))))
    found = np.asarray(gradient(jnp.asarray(points, jnp.float32)))
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles in degrees between unit vectors; the chord, as a cosine near 1 is rounded."""
    return np.rad2deg(2 * np.arcsin(np.linalg.norm(a - b, axis=-1) / 2))


@pytest.mark.parametrize("spacing", [(0.05, 0.05, 0.05), (0.04, 0.05, 0.06)])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("field", FIELDS)
def test_normals_are_within_half_a_degree(field, kind, spacing):
    """In 8 bits on average: where a field rises by 40 from node to node, rounding turns a normal by up to 0.7
    degrees, more where it rises less."""
    volume = sampled(field, kind, spacing)
    outward = np.random.default_rng(2).normal(size=(500, 3))
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    radius = {"ball": 1.0, "bell": 0.5}[field]
    off = angles(normals(accelerated(volume), Affine(volume), radius * outward), -outward)
    assert np.mean(off) < 0.5
    if kind != "uint8":
        assert np.max(off) < 0.5


def test_normals_are_those_of_the_world_under_a_toroidal_map():
    probe = jv.ToroidalMap(20.0, 30.0, (0.9, 2.3), (0.8, 2.4), (0.0, 60.0))
    shape = (64, 60, 56)
    empty = jv.Volume(np.zeros(shape, np.float32))
    space = probe.locate(Affine(empty), empty)
    nodes = np.indices(shape).reshape(3, -1).T.astype(np.float32)
    points = np.asarray(jax.vmap(lambda c: jnp.stack(space.point(apart(c))))(jnp.asarray(nodes)))
    ramp = np.array([0.5, -0.7, 0.4]) / np.linalg.norm([0.5, -0.7, 0.4])
    volume = jv.Volume((points @ ramp).astype(np.float32).reshape(shape))
    inner = coordinates(shape, 2, 2)
    places = np.asarray(jax.vmap(lambda c: jnp.stack(space.point(apart(c))))(jnp.asarray(inner)))
    assert np.max(angles(normals(volume, space, places), ramp[None])) < 0.5


# ---------------------------------------------------------------- colours of single samples

COLOR = np.array([0.8, 0.5, 0.3])


def lit(
    lighting: Phong, gradient: Any, direction: Any, point: Any = (0.1, 0.2, 0.3), scale: float = 1.0
) -> np.ndarray:
    """The colour of a sample in a volume whose values have this gradient."""
    nodes = np.indices((4, 4, 4)).reshape(3, -1).T - 1.5
    data = (nodes @ np.asarray(gradient, float) * scale).reshape(4, 4, 4)
    volume = jv.Volume(data.astype(np.float32), origin=(-1.5, -1.5, -1.5))
    direction = np.asarray(direction, float) / np.linalg.norm(direction)
    place, along = (jnp.asarray(p, jnp.float32) for p in (point, direction))
    return np.asarray(color_of(lighting, volume, place, along))


@eqx.filter_jit
def color_of(lighting: Phong, volume: jv.Volume, point: Any, direction: Any) -> Any:
    around = Surroundings(volume, jv.colormap("gray", (0.0, 1.0)), Affine(volume))
    one, zero = jnp.ones(()), jnp.zeros((), jnp.int32)
    color = apart(jnp.asarray(COLOR, jnp.float32))
    sample = Sample(apart(point), apart(direction), (), color, one, one, (zero, zero))
    return jnp.stack(shade_sample(lighting.shading(around), around, sample))


def by_formula(normal: Any, toward: Any, viewer: Any, irradiance: Any, power: float = 10.0) -> np.ndarray:
    """Phong's formula with the default coefficients, of unit vectors."""
    normal = np.asarray(normal) * (-1 if np.dot(normal, viewer) < 0 else 1)
    facing = np.dot(normal, toward)
    if facing <= 0:
        return 0.1 * COLOR
    reflected = 2 * facing * normal - toward
    highlight = max(np.dot(reflected, viewer), 0) ** power
    return COLOR * (0.1 + 0.7 * facing * np.asarray(irradiance)) + 0.2 * highlight * np.asarray(irradiance)


def unit(*vector: float) -> np.ndarray:
    return np.asarray(vector) / np.linalg.norm(vector)


IRRADIANCE = np.array([1.0, 2.0, 3.0])
VIEWS = [unit(0, 0, 1), unit(0.3, -0.2, 0.9), unit(-0.8, 0.5, 0.1), unit(0.1, 0.2, -0.9)]


@pytest.mark.parametrize("normal", VIEWS)
def test_a_sample_is_lit_by_the_formula(normal):
    for viewer in VIEWS:
        head = lit(Phong(HeadLight(IRRADIANCE)), normal, -viewer)
        np.testing.assert_allclose(head, by_formula(normal, viewer, viewer, IRRADIANCE), atol=2e-5)
        for toward in VIEWS:
            sun = lit(Phong(DirectionalLight(-3 * toward, IRRADIANCE)), normal, -viewer)
            np.testing.assert_allclose(sun, by_formula(normal, toward, viewer, IRRADIANCE), atol=2e-5)
            far = np.array([0.1, 0.2, 0.3]) + 2 * toward
            lamp = lit(Phong(PointLight(far, IRRADIANCE)), normal, -viewer)
            np.testing.assert_allclose(lamp, by_formula(normal, toward, viewer, IRRADIANCE / 4), atol=2e-5)


def test_lights_add_up_and_ambient_light_counts_once():
    view, normal = VIEWS[1], VIEWS[0]
    several = (HeadLight(IRRADIANCE), DirectionalLight(-VIEWS[1], IRRADIANCE))
    alone = [lit(Phong(light), normal, -view) for light in several]
    np.testing.assert_allclose(lit(Phong(several), normal, -view), sum(alone) - 0.1 * COLOR, atol=2e-5)


def test_a_plane_that_faces_the_head_light_has_vtks_colour():
    """A light of irradiance 1 is VTK's light of colour 1."""
    np.testing.assert_allclose(lit(Phong(), VIEWS[1], VIEWS[1]), 0.8 * COLOR + 0.2, atol=2e-5)


def test_both_sides_are_lit_alike():
    for light in LIGHTS.values():
        front, back = (lit(Phong(light), side * VIEWS[1], -VIEWS[0]) for side in (1, -1))
        np.testing.assert_allclose(front, back, atol=1e-6)
        assert np.all(front > 0.15 * COLOR)


def test_the_length_of_the_gradient_does_not_matter():
    for scale in (1e-15, 1e-6, 1e6, 1e15):
        found = lit(Phong(SUN), VIEWS[1], -VIEWS[0], scale=scale)
        np.testing.assert_allclose(found, lit(Phong(SUN), VIEWS[1], -VIEWS[0]), atol=2e-5)


@pytest.mark.parametrize("light", ["head", *slow("sun", "all")])
def test_without_a_gradient_there_is_ambient_light_and_no_derivative(light):
    np.testing.assert_allclose(lit(Phong(LIGHTS[light]), (0, 0, 0), (0, 0, 1)), 0.1 * COLOR, rtol=1e-6)

    def loss(data: Any) -> Any:
        volume = jv.Volume(data)
        transfer = jv.TransferFunction((0.0, 1.0), ((0.8, 0.5, 0.3),) * 2, (1.0, 1.0))
        camera = jv.Camera.looking_at(volume, (0.3, 0.8, 0.5), size=(6, 5))
        march = jv.March(0.5, (jv.AlphaCorrection(),), max_samples=24)
        image = jv.render(volume, transfer, camera, march, lighting=Phong(LIGHTS[light])).rgba
        return jnp.sum(image), image

    slope, image = jax.grad(loss, has_aux=True)(jnp.full((4, 4, 4), 0.5))
    image = np.asarray(image)
    np.testing.assert_allclose(image[..., :3], image[..., 3:] * (0.1 * COLOR), atol=1e-6)
    np.testing.assert_array_equal(slope, 0)


@pytest.mark.parametrize("light", LIGHTS)
def test_a_highlight_lies_where_the_light_is_mirrored(light):
    """On an opaque ball, seen from far away; for several lights, of the brightest one."""
    volume = sampled("ball", "uint8", (0.05, 0.05, 0.05))
    lighting = Phong(
        {"head": HeadLight(), "sun": SUN, "all": (SUN, HeadLight((0.1, 0.1, 0.1)))}[light], 0, 0, 1, 60
    )
    transfer = jv.TransferFunction((100, 160), np.ones((2, 3)), (0.0, 400.0))
    camera = jv.Camera((0, 0, 5), (0, 0, 0), (0, 1, 0), size=(64, 64), parallel_scale=1.1)
    image = jv.render(volume, transfer, camera, jv.March(0.01), lighting=lighting, outputs="rgba").rgba
    red = np.asarray(image[..., 0])
    row, column = (np.average(axis, weights=red**4) for axis in np.indices(red.shape))
    found = np.array([(column - 31.5), (31.5 - row)]) / 32 * 1.1
    viewer = np.array([0.0, 0.0, 1.0])
    toward = viewer if light == "head" else -unit(*np.asarray(SUN.direction))
    assert np.linalg.norm(found - unit(*(viewer + toward))[:2]) < 0.04


# ---------------------------------------------------------------- images


def shells(kind: str = "uint8", resolution: int = 20) -> jv.Volume:
    """Two nested balls with empty space around them, in values of 0 to 255."""
    axis = np.linspace(-1.4, 1.4, resolution)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    away, beside = np.linalg.norm(points, axis=-1), np.linalg.norm(points - [0.3, 0.2, -0.1], axis=-1)
    data = np.clip(160 * (1.1 - away), 0, 80) + np.clip(400 * (0.6 - beside), 0, 170)
    step = 2.8 / (resolution - 1)
    return jv.Volume(np.round(data).astype(kind), (step, step, step), (-1.4, -1.4, -1.4))


def soft() -> jv.TransferFunction:
    points = [
        (0.0, (0.1, 0.2, 0.9), 0.0),
        (12.0, (0.2, 0.3, 0.8), 0.0),
        (60.0, (0.3, 0.9, 0.2), 0.2),
        (120.0, (0.9, 0.4, 0.1), 0.3),
        (255.0, (0.9, 0.8, 0.2), 0.9),
    ]
    return jv.TransferFunction.from_points(points, 0.2)


def scene_of(
    transforms: tuple[jv.Transform, ...], size: tuple[int, int] = (20, 16), kind: str = "uint8"
) -> Any:
    volume = shells(kind)
    camera = jv.Camera.looking_at(volume, (0.5, -0.9, 0.4), size=size)
    return volume, soft(), camera, jv.March(0.11, transforms, max_samples=64)


EVERYTHING = (
    jv.EmptySpaceJitter(4),
    jv.AlphaCorrection(),
    jv.SpaceLeaping(),
    jv.EarlyTermination(0.05),
    jv.AdaptiveSampling(0.01, longest=4),
)
SETS = {name: TRANSFORMS[name] for name in FEW} | {"everything": EVERYTHING}


def of_reference(scene: Any, lighting: Any) -> np.ndarray:
    """The image by the reference engine, ray by ray, with slopes that are not stored."""
    volume, transfer, camera, march = scene
    origins, directions = camera.rays()

    @jax.jit
    @partial(jax.vmap, in_axes=(None, 0))
    @partial(jax.vmap, in_axes=(0, None))
    def image(column: Any, row: Any) -> Any:
        line = volume, transfer, origins[row, column], directions[row, column], march
        return jv.render_ray_reference(*line, pixel=(column, row), lighting=lighting).rgba

    width, height = camera.size
    return np.asarray(image(jnp.arange(width), jnp.arange(height)))


@pytest.mark.parametrize(
    ("transforms", "kind", "light"),
    [
        ("everything", "uint8", "all"),
        *slow(*((name, kind, light) for name in SETS for kind in ("uint8", "float32") for light in LIGHTS)),
    ],
)
def test_the_fast_engine_is_the_reference(transforms, kind, light):
    scene, lighting = scene_of(SETS[transforms], kind=kind), Phong(LIGHTS[light])
    found = jv.render(*scene, lighting=lighting)
    assert found.rgba[..., :3].max() > 0.1
    np.testing.assert_allclose(found.rgba, of_reference(scene, lighting), atol=2e-5)


@pytest.mark.parametrize("quadrature", ["preintegrated", *slow("midpoint")])
def test_quadratures_shade_where_they_sample(quadrature):
    volume, transfer, camera, march = scene_of((jv.AlphaCorrection(),))
    scene = volume, transfer, camera, jv.March(0.11, march.transforms, quadrature, max_samples=64)
    found = jv.render(*scene, lighting=Phong(), outputs="rgba")
    np.testing.assert_allclose(found.rgba, of_reference(scene, Phong()), atol=2e-5)


@pytest.mark.slow
def test_leaping_and_tiles_show_neither_in_the_image_nor_in_its_gradient():
    """By many tiles, as a larger image has; with 8-bit voxels."""
    volume, transfer, camera, _ = scene_of((), size=(40, 36))
    lighting, tiling = Phong(LIGHTS["all"]), Tiling(tile=4, batch=20)

    def image(parts: Any, march: jv.March, tiling: Tiling | None) -> Any:
        transfer, camera, lighting = parts
        scene = Scene(volume, transfer, camera, march, lighting=lighting)
        return render_scene(scene, "all", "replay", tiling).rgba

    def loss(parts: Any, march: jv.March, tiling: Tiling | None) -> Any:
        rgba = image(parts, march, tiling)
        return jnp.sum(rgba**2), rgba

    parts = transfer, camera, lighting
    always = jv.EmptySpaceJitter(4), jv.AlphaCorrection()
    (slope, leapt), (other_slope, other) = (
        eqx.filter_grad(loss, has_aux=True)(parts, jv.March(0.11, transforms), how)
        for transforms, how in ((always, None), ((*always, jv.SpaceLeaping()), tiling))
    )
    assert np.mean(np.asarray(leapt[..., 3]) == 0) > 0.1
    np.testing.assert_allclose(leapt, other, atol=1e-6)
    # of an extinction of 0 only what is not leapt over has a gradient
    slope, other_slope = (
        eqx.tree_at(lambda parts: parts[0].extinction, each, each[0].extinction[2:])
        for each in (slope, other_slope)
    )
    for a, b in zip(jax.tree.leaves(slope), jax.tree.leaves(other_slope), strict=True):
        assert np.linalg.norm(a - b) <= 1e-5 * max(np.linalg.norm(a), 1e-3)


@pytest.mark.slow
def test_outputs_programs_and_batches_give_the_same_image():
    scene, lighting = scene_of((jv.SpaceLeaping(), jv.AlphaCorrection())), Phong(SUN)
    whole = jv.render(*scene, lighting=lighting)
    rgba = jv.render(*scene, lighting=lighting, outputs="rgba").rgba
    inside = eqx.filter_jit(lambda lighting: jv.render(*scene, lighting=lighting, outputs="rgba").rgba)
    powers = jnp.asarray([10.0, 3.0])

    def of_power(power: Any) -> Any:
        changed = eqx.tree_at(lambda phong: phong.specular_power, lighting, power)
        return jv.render(*scene, lighting=changed, outputs="rgba").rgba

    both = jax.vmap(of_power)(powers)
    for other in (rgba, inside(lighting), both[0]):
        np.testing.assert_allclose(whole.rgba, other, atol=1e-6)
    assert np.abs(both[1] - both[0]).max() > 0.01


def test_slopes_are_stored_for_those_who_read_them():
    from jaxvol.engine.acceleration import VolumeAcceleration

    volume, march = shells(), jv.March(0.1)
    for lighting, stored in ((None, False), (Phong(), True), (Deferred(Phong()), True)):
        found = VolumeAcceleration.of(volume, soft(), march, lighting)
        assert (found.slopes is not None) == stored
    assert VolumeAcceleration.of(shells("float32"), soft(), march, Phong()).slopes is None


def test_a_ray_can_be_shaded_once():
    """As its samples are, where it meets an opaque plane."""
    ramp = np.broadcast_to(np.arange(0, 256, 15)[:, None, None], (18, 18, 18))
    volume = jv.Volume(ramp.astype(np.uint8))
    transfer = jv.TransferFunction((120, 122), np.tile(COLOR, (2, 1)), (0.0, 500.0))
    camera = jv.Camera.looking_at(volume, (1, 0.4, 0.3), size=(20, 16)).zoom(2)
    march = jv.March(0.01, (jv.EarlyTermination(1e-3),))
    each, once = (
        jv.render(volume, transfer, camera, march, lighting=how, outputs="rgba").rgba
        for how in (Phong(SUN), Deferred(Phong(SUN)))
    )
    assert np.mean(each[..., 3] > 0.99) > 0.5
    np.testing.assert_allclose(each, once, atol=2e-3)


# ---------------------------------------------------------------- gradients


def smooth_scene() -> Any:
    """A float64 scene without samples where a formula has a kink: all normals face viewer and lights."""
    axis = np.arange(7.0)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    data = 0.12 * z + 0.03 * np.sin(x) + 0.04 * np.cos(0.7 * y + 0.3 * z)
    volume = jv.Volume(data, (0.3, 0.4, 0.5), (-0.9, -1.2, -1.5))
    transfer = jv.TransferFunction(
        (-0.2, 0.3, 0.8), ((0.9, 0.5, 0.2), (0.2, 0.8, 0.4), (0.5, 0.6, 0.9)), (0.2, 0.9, 0.4)
    )
    camera = jv.Camera((0.7, -0.6, 7.0), (0.1, 0.05, 0.0), (0, 1, 0), 25.0, size=(4, 3))
    return volume, transfer, camera


LEAVES: dict[str, Callable[[Any], Any]] = {
    "ambient": lambda s: s[3].ambient,
    "diffuse": lambda s: s[3].diffuse,
    "specular": lambda s: s[3].specular,
    "specular_power": lambda s: s[3].specular_power,
    "irradiance of the head light": lambda s: s[3].lights[0].irradiance,
    "direction": lambda s: s[3].lights[1].direction,
    "irradiance": lambda s: s[3].lights[1].irradiance,
    "position of the lamp": lambda s: s[3].lights[2].position,
    "intensity": lambda s: s[3].lights[2].intensity,
    "voxels": lambda s: s[0].data,
    "spacing": lambda s: s[0].spacing,
    "extinction": lambda s: s[1].extinction,
    "colors": lambda s: s[1].colors,
    "position": lambda s: s[2].position,
}


@pytest.mark.parametrize("adjoint", ["replay", *slow("forward", "direct")])
def test_gradients_match_central_differences(adjoint):
    with in_float64():
        lights = HeadLight(), DirectionalLight((-0.2, 0.3, -1.0)), PointLight((0.5, 0.4, 6.0), (20, 18, 16))
        scene = to_float64((*smooth_scene(), Phong(lights)))
        scene = eqx.tree_at(lambda s: s[0].data, scene, jnp.asarray(scene[0].data, jnp.float64))
        march = to_float64(jv.March(0.23, (jv.AlphaCorrection(),), max_samples=32))

        @eqx.filter_jit
        def loss(scene: Any, adjoint: str = "replay") -> Any:
            volume, transfer, camera, lighting = scene
            rgba = jv.render(volume, transfer, camera, march, lighting=lighting, adjoint=adjoint).rgba
            weights = jnp.asarray(np.random.default_rng(3).uniform(0.2, 1, rgba.shape))
            return jnp.sum(weights * rgba)

        def changed(where: Callable[[Any], Any], leaf: Any) -> Any:
            return eqx.tree_at(where, scene, leaf)

        random = np.random.default_rng(4)
        directions = {n: jnp.asarray(random.normal(size=where(scene).shape)) for n, where in LEAVES.items()}
        if adjoint == "forward":
            along = eqx.filter_jit(
                lambda where, leaf, direction: jax.jvp(
                    lambda leaf: loss(changed(where, leaf), adjoint), (leaf,), (direction,)
                )[1]
            )
            found = {n: along(where, where(scene), directions[n]) for n, where in LEAVES.items()}
        else:
            slopes = eqx.filter_grad(loss)(scene, adjoint)
            found = {n: jnp.sum(where(slopes) * directions[n]) for n, where in LEAVES.items()}
        for name, where in LEAVES.items():
            step = 1e-5 * directions[name]
            ahead, behind = (loss(changed(where, where(scene) + side * step)) for side in (1, -1))
            expected = float(ahead - behind) / 2e-5
            assert abs(expected) > 1e-3, name
            assert abs(float(found[name]) - expected) <= 1e-5 * abs(expected), name


class Bell(jv.Field):
    """255 exp(-sharpness r²) around the middle of the volume."""

    sharpness: Any

    def value(self, volume: jv.Volume, coordinate: Any) -> Any:
        middle = [(n - 1) / 2 for n in volume.shape]
        square = sum((c - m) ** 2 * h**2 for c, m, h in zip(coordinate, middle, volume.spacing, strict=True))
        return 255 * jnp.exp(-self.sharpness * square)


def test_fields_are_shaded_and_have_gradients():
    """Whose parameters the replay must pull back from the normals, too."""
    _, _, camera, march = scene_of((jv.AlphaCorrection(),), size=(8, 6))
    constant = jv.TransferFunction((0.0, 255.0), np.ones((2, 3)), (0.5, 0.5))

    @partial(eqx.filter_jit)
    def loss(sharpness: Any, adjoint: str) -> Any:
        volume = jv.Volume(np.zeros((8, 8, 8), np.float32), (0.4,) * 3, (-1.4,) * 3, field=Bell(sharpness))
        # a light from the side: head light on a sphere does not change with its sharpness
        how = {"lighting": Phong(SUN), "adjoint": adjoint, "outputs": "rgba"}
        return jnp.sum(jv.render(volume, constant, camera, march, **how).rgba[..., :3])

    at, step = jnp.asarray(1.3), 1e-2
    found, known = (jax.grad(loss)(at, adjoint) for adjoint in ("replay", "direct"))
    expected = float(loss(at + step, "replay") - loss(at - step, "replay")) / (2 * step)
    assert abs(expected) > 1e-3
    np.testing.assert_allclose(found, known, rtol=1e-3)
    np.testing.assert_allclose(found, expected, rtol=3e-2)


# ---------------------------------------------------------------- arguments

WRONG: dict[str, tuple[Callable[[], Any], str]] = {
    "constant light": (lambda: Phong(ConstantLight()), "lights must hold jaxvol lights.*HeadLight"),
    "no lights": (lambda: Phong(()), "lights must be"),
    "no light": (lambda: Phong("sun"), "lights must be"),
    "ambient": (lambda: Phong(ambient=-0.1), "ambient must not be negative"),
    "diffuse": (lambda: Phong(diffuse=np.nan), "diffuse must be finite"),
    "specular": (lambda: Phong(specular=(1, 2)), "specular must have shape"),
    "specular power": (lambda: Phong(specular_power=0), "specular_power must be positive"),
    "irradiance": (lambda: HeadLight((1, -1, 1)), "irradiance must not be negative"),
}


@pytest.mark.parametrize("name", WRONG)
def test_bad_arguments_are_named(name):
    make, message = WRONG[name]
    with pytest.raises(ValueError, match=message):
        make()


def test_the_defaults_are_vtks_names():
    phong = Phong()
    assert isinstance(phong.lights[0], HeadLight)
    values = phong.ambient, phong.diffuse, phong.specular, phong.specular_power
    np.testing.assert_allclose(values, (0.1, 0.7, 0.2, 10), rtol=1e-6)
