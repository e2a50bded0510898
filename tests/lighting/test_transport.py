"""Do templates by transport carry light as path tracing does? Against closed forms, path tracing, and
differences.

All images are of one structure, so that light and image have one program each.
"""

from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.lighting import (
    ConstantLight,
    DirectionalLight,
    Material,
    PointLight,
    ScattererTemplates,
    transport,
)
from jaxvol.lighting.materials import shares
from jaxvol.lighting.medium import FADE, MediumTransfer, scattering_at
from jaxvol.lighting.random_walks import unit_walks
from jaxvol.lighting.shading import Surroundings

from ..scenes import in_float64


SHAPE, NODES = (10, 12, 9), 20
CAMERA = jv.Camera((3.0, -4.0, 2.0), (0, 0, 0), (0, 0, 1), 30, size=(8, 8))
MARCH = jv.March(0.025, (jv.AlphaCorrection(),), "midpoint")
"""By steps of 0.1, images are brighter by 1 to 3 %."""
NIGHT = DirectionalLight((0, 0, 1), (0, 0, 0)), PointLight((9, 9, 9), (0, 0, 0)), ConstantLight((0, 0, 0))
SUN, LAMP = (
    DirectionalLight((0.5, 1.0, -0.7), (2.0, 1.0, 3.0)),
    PointLight((0.95, -0.95, 0.95), (0.6, 0.8, 0.4)),
)
SKY = ConstantLight((0.5, 1.0, 0.7))
STEPS, RAMPS = (10.0, 10.0, 60.0, 60.0, 100.0), (0.0, 20.0, 50.0, 70.0, 100.0)
"""Values at which the transfer functions have points."""
LEVELS = 24


def lit(*lights: Any) -> tuple[Any, ...]:
    """These lights, and a dark one of every other kind."""
    return tuple(next((one for one in lights if type(one) is type(out)), out) for out in NIGHT)


def nested(inner: float = 80.0, outer: float = 40.0) -> jv.Volume:
    """A ball in a ball, around the origin; air around them. No two axes are alike."""
    axes = np.meshgrid(*(np.linspace(-1, 1, n) for n in SHAPE), indexing="ij")
    far = np.sqrt(sum(axis**2 for axis in axes))
    data = outer * np.clip((0.85 - far) * 6, 0, 1) + (inner - outer) * np.clip((0.5 - far) * 6, 0, 1)
    return jv.Volume(data.astype(np.float32), [2 / (n - 1) for n in SHAPE], (-1.0, -1.0, -1.0))


def transfer(thin: float, color: Any = (0.8, 0.5, 0.9), *, least: float = 0.0) -> jv.TransferFunction:
    """By steps; or, where it is at least so much everywhere, without any."""
    extinction = [least, thin, thin, 2 * thin, 2 * thin]
    return jv.TransferFunction(RAMPS if least else STEPS, [color] * 5, extinction)


def materials(outer: float, inner: float, opacity: float = 0.1) -> tuple[Material, ...]:
    return Material(opacity, outer, values=(10, 60)), Material(opacity, inner, values=(60, 200))


def light_of(of_materials: Any, lights: Any, **how: Any) -> ScattererTemplates:
    how = {"nodes": NODES, "levels": LEVELS} | how
    return ScattererTemplates(of_materials, lights, form="transport", **how)


def image(volume: Any, function: Any, lighting: Any, adjoint: Any = "replay") -> Any:
    rendered = jv.render(volume, function, CAMERA, MARCH, lighting=lighting, adjoint=adjoint)
    return rendered.image((0.0, 0.0, 0.0))


# ---------------------------------------------------------------- the medium


def test_where_two_materials_meet_nothing_is_in_neither():
    values = np.linspace(5, 190, 400, dtype=np.float32)
    each = jax.jit(jax.vmap(lambda v: shares(materials(1, 1), lambda _: v, v, edge=FADE)))(values)
    np.testing.assert_allclose(np.sum(each, axis=0)[values > 13], 1, rtol=1e-6)
    assert np.interp(60, values, each[0]) == pytest.approx(0.5, abs=0.1)


def test_a_material_is_whole_at_the_ends_of_its_range():
    """Which are often the smallest and the largest value of a volume."""
    medium = MediumTransfer(transfer(3.0), (Material(0.25, 0.5, values=(60, 100)),))
    classify = jax.jit(jax.vmap(lambda value: medium.classifier()((value,))))
    albedo, extinction = classify(np.float32([60, 80, 100]))
    np.testing.assert_array_equal(extinction, 2)
    expected = 0.75 * np.array([0.8, 0.5, 0.9])
    np.testing.assert_allclose(np.stack(albedo, axis=-1), np.tile(expected, (3, 1)), rtol=1e-6)


def test_two_labels_of_one_material_are_one():
    labels = np.where(np.indices(SHAPE)[0] < 5, 1, 2).astype(np.uint8)
    volume = jv.Volume(np.ones(SHAPE, np.uint8), nested().spacing, nested().origin, labels)
    one = jv.TransferFunction([0, 1], [(0.8, 0.5, 0.9)] * 2, [5.0, 5.0])
    of_labels = tuple(Material(0.3, 0.5, label=label) for label in (1, 2))
    medium = MediumTransfer(jv.LabelTransferFunction({1: one, 2: one}), of_labels)
    places = np.random.default_rng(0).uniform(-0.95, 0.95, (3, 300)).astype(np.float32)

    @jax.jit
    @jax.vmap
    def scattering(*place: Any) -> Any:
        return scattering_at(Surroundings(volume, medium, MARCH.locate(volume)), place)

    found = scattering(*places)
    for albedo, color in zip(found.albedo, (0.8, 0.5, 0.9), strict=True):
        np.testing.assert_allclose(albedo, 0.7 * color, rtol=1e-6)
    np.testing.assert_allclose(found.extinction, 2, rtol=1e-6)


# ---------------------------------------------------------------- templates


def test_flights_have_the_mean_free_path_and_turn_anywhere():
    walks = jax.jit(lambda: unit_walks(jax.random.key(1), 4, 64, 4))()
    unit, length = np.swapaxes(np.asarray(walks[0]), 1, 2), np.asarray(walks[1])
    np.testing.assert_allclose(np.linalg.norm(unit, axis=-1), 1, rtol=1e-5)
    np.testing.assert_allclose(length.mean(), 1.0, rtol=0.01)
    np.testing.assert_allclose((length**2).mean(), 2.0, rtol=0.05)
    cosine = np.sum(unit[:, 1:] * unit[:, :-1], axis=-1)
    np.testing.assert_allclose(cosine.mean(), 0, atol=0.02)
    np.testing.assert_allclose(unit[:, 0].mean(axis=(0, 1)), 0, atol=0.02)


def test_flights_end_as_often_as_light_is_scattered():
    """Matter whose extinction grows with the distance, behind a gap: within each length, the mean weight is
    the probability of a collision. Steps are as for thinner and for denser matter."""
    number, length, gap = 2**16, 2.0, 0.3
    quantile, u = np.random.default_rng(0).uniform(size=(2, number)).astype(np.float32)

    @jax.jit
    def flights(quantile: Any, u: Any, rate: Any) -> Any:
        looks = jax.vmap(transport._looks, (None, None, 0))(rate, jnp.float32(length), u)
        extinction = jnp.where(looks.places > gap, looks.places - gap, 0)
        return jax.vmap(transport._ending)(extinction, looks, quantile)

    for rate in (0.5, 2.0, 8.0):
        distance, weight = (np.asarray(each, float) for each in flights(quantile, u, np.float32(rate)))
        assert weight.max() < 1.1  # no walk counts more than others
        for far in (0.5, 1.0, 1.5, length):
            expected = 1 - np.exp(-0.5 * (far - gap) ** 2)
            np.testing.assert_allclose(np.mean(weight * (distance < far)), expected, atol=0.04)


# ---------------------------------------------------------------- light


def test_in_a_white_furnace_matter_is_as_bright_as_the_sky():
    # thin enough that all light leaves within the levels of a walk
    function = transfer(0.8, (1.0, 1.0, 1.0))
    lighting = light_of(materials(1.2, 0.8, 0.0), lit(SKY))
    rgba = np.asarray(jv.render(nested(), function, CAMERA, MARCH, lighting=lighting).rgba)
    expected = rgba[..., 3:] * np.asarray(SKY.radiance)
    assert expected.max() > 0.3
    np.testing.assert_allclose(rgba[..., :3], expected, atol=2e-4)


def compared(lights: Any) -> tuple[np.ndarray, np.ndarray]:
    """Light of the whole image relative to path tracing, by channel, and the standard error of that. The
    transfer function's extinction, which has ramps at the edges of matter, is not that of the materials."""
    volume, of_materials = nested(), materials(0.5, 0.25)
    function = jv.TransferFunction((0.0, 40.0, 60.0, 80.0, 100.0), [(0.8, 0.5, 0.9)] * 5, (0.0, 0.5, 1, 9, 9))
    lighting = light_of(of_materials, lit(*lights))
    found = np.asarray(image(volume, function, lighting))
    traced = jv.path_trace(volume, function, CAMERA, lit(*lights), materials=of_materials, paths=3072)
    expected, error = (np.asarray(each) for each in (traced.radiance, traced.standard_error))
    total = expected.sum(axis=(0, 1))
    return found.sum(axis=(0, 1)) / total, np.sqrt((error**2).sum(axis=(0, 1))) / total


@pytest.mark.parametrize("lights", [(SUN,), (LAMP,), (SKY,)], ids=["sun", "lamp", "sky"])
def test_light_is_that_of_path_tracing(lights):
    ratio, error = compared(lights)
    assert np.all(error < 0.012)
    np.testing.assert_allclose(ratio, 1, atol=0.03)


def test_light_is_that_of_the_whole_volume_where_it_is_clipped():
    """And matter ends at the volume's face, where it ends for direct light."""
    volume = jv.Volume(np.full(SHAPE, 40.0, np.float32), [2 / (n - 1) for n in SHAPE], (-1.0, -1.0, -1.0))
    function, of_materials, lights = transfer(2.5), materials(0.4, 0.4), lit(SUN, SKY)

    @eqx.filter_jit
    def light(march: Any) -> Any:
        medium = MediumTransfer(function, of_materials)
        around = Surroundings(volume, medium, march.locate(volume))
        half, near, zero, one = (jnp.float32(number) for number in (0.5, 0.999, 0, 1))
        outwards = transport._exit(around.space, (half, half, near), (zero, zero, one))
        found = transport.Transport(around, lights, 0, 4, 4, 4).solved(6)
        return found.radiance, found.depths, outwards

    whole, clipped = light(MARCH), light(jv.March(0.1, (jv.Clip(box=(-1, 0, -1, 1, -1, 1)),)))
    for one, other in zip(whole, clipped, strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-5)
    np.testing.assert_allclose(whole[2], 0.001, rtol=1e-3)


def test_light_between_nodes_is_that_of_a_cubic_and_at_faces_of_a_line():
    def values(x: Any, y: Any, z: Any) -> Any:
        return np.stack([x**3 - 2 * x * y + 3 * z, x + 2 * y - z], axis=-1)

    coarse, fine = (
        np.meshgrid(*(np.linspace(0, 5, n) for n in ends), indexing="ij") for ends in ((6,) * 3, (11,) * 3)
    )
    found = np.asarray(jax.jit(transport.refined)(values(*coarse).astype(np.float32)))
    expected = values(*fine)
    np.testing.assert_allclose(found[2:-2, 2:-2, 2:-2], expected[2:-2, 2:-2, 2:-2], atol=1e-4)
    np.testing.assert_allclose(found[..., 1], expected[..., 1], atol=1e-5)


# ---------------------------------------------------------------- derivatives


def test_light_changes_with_the_mean_free_path_as_its_derivative_says():
    """Where the extinction jumps at surfaces, and flights end behind them."""
    volume = nested()

    @jax.jit
    def light(path: Any) -> Any:
        how: tuple[Any, ...] = (lit(SUN, SKY), 0, 64, 16, LEVELS)

        def total(path: Any) -> Any:
            medium = MediumTransfer(transfer(2.5), (Material(0.2, path),))
            around = Surroundings(volume, medium, MARCH.locate(volume))
            return jnp.mean(transport.Transport(around, *how).solved(12).radiance)

        return jax.jvp(total, (path,), (jnp.ones_like(path),))

    at, step = 0.4, 0.06
    less, more = (float(light(np.float32(path))[0]) for path in (at - step, at + step))
    np.testing.assert_allclose(light(np.float32(at))[1], (more - less) / (2 * step), rtol=0.08)


@pytest.mark.slow
def test_light_changes_in_the_mean_over_walks_as_its_derivatives_say():
    # no voxel has the value of a control point, where the extinction has two derivatives
    volume, function = nested(), transfer(2.0, least=0.5)
    start = jnp.float32(0.4), function.extinction, volume.data + 5
    random = np.random.default_rng(1)
    ways = tuple(random.normal(1, 1, leaf.shape).astype(np.float32) for leaf in start)

    def light(moved: Any, seed: Any) -> Any:
        path, extinction, data = (at + way * by for at, way, by in zip(start, ways, moved, strict=True))
        inside = eqx.tree_at(lambda volume: volume.data, volume, data)
        shown = eqx.tree_at(lambda function: function.extinction, function, extinction)
        how: tuple[Any, ...] = (lit(SUN, SKY), seed, 16, 8, LEVELS)
        medium = MediumTransfer(shown, (Material(0.2, path, values=(60, 200)),))
        around = Surroundings(inside, medium, MARCH.locate(volume))
        return jnp.mean(transport.Transport(around, *how).solved(10).radiance)

    value, gradient = jax.jit(light), jax.jit(jax.grad(light))
    steps, seeds = np.array([0.05, 0.04, 0.1], np.float32), range(24)
    found = np.array([gradient(jnp.zeros(3), seed) for seed in seeds])
    ends = np.array(
        [[[value(by, seed) for by in np.diag(sign * steps)] for sign in (1, -1)] for seed in seeds]
    )
    off = found - (ends[:, 0] - ends[:, 1]) / (2 * steps)
    error = off.std(axis=0, ddof=1) / np.sqrt(len(seeds))
    assert np.all(error < 0.1 * np.abs(found.mean(axis=0)))
    assert np.all(np.abs(off.mean(axis=0)) < 3 * error)


@pytest.mark.slow
def test_gradients_of_images_are_those_of_differences_and_forward_as_reverse():
    # no voxel has the value of a control point, where the extinction has two derivatives
    volume = eqx.tree_at(lambda volume: volume.data, nested(), nested().data + 5)
    scene = volume, transfer(2.0, least=0.5), materials(0.5, 0.25), lit(SUN, LAMP, SKY)
    weights = np.random.default_rng(0).uniform(0, 2, size=(8, 8, 3))

    def total(scene: Any, adjoint: Any = "replay") -> Any:
        volume, function, of_materials, lights = scene
        lighting = light_of(of_materials, lights)
        how: dict[str, Any] = {"lighting": lighting, "adjoint": adjoint}
        return jnp.sum(weights * jv.render(volume, function, *seen, **how).image((0.0, 0.0, 0.0)))

    leaves = {
        "opacity": lambda s: s[2][0].opacity,
        "colours": lambda s: s[1].colors,
        "irradiance": lambda s: s[3][0].irradiance,
        "direction": lambda s: s[3][0].direction,
        "intensity": lambda s: s[3][1].intensity,
        "radiance": lambda s: s[3][2].radiance,
    }
    moving_walks = {  # of which images have differences in the mean only
        "mean free path": lambda s: s[2][1].mean_free_path,
        "extinction": lambda s: s[1].extinction,
        "voxels": lambda s: s[0].data,
    }
    with in_float64():
        scene, seen = jax.tree.map(
            lambda leaf: jnp.asarray(leaf, jnp.float64) if eqx.is_inexact_array(leaf) else leaf,
            (scene, (CAMERA, MARCH)),
        )
        gradient = eqx.filter_grad(total)(scene)
        moving, fixed = eqx.partition(scene, eqx.is_inexact_array)
        pushed = jax.jit(
            lambda tangent: jax.jvp(lambda m: total(eqx.combine(m, fixed), "forward"), (moving,), (tangent,))[
                1
            ]
        )
        value = eqx.filter_jit(total)
        for name, where in {**leaves, **moving_walks}.items():
            leaf = where(scene)
            along = np.random.default_rng(1).normal(1, 1, size=leaf.shape)
            reverse = float(np.sum(np.asarray(where(gradient)) * along))
            tangent = eqx.tree_at(where, jax.tree.map(jnp.zeros_like, moving), jnp.asarray(along))
            np.testing.assert_allclose(reverse, float(pushed(tangent)), rtol=1e-6, err_msg=name)
            if name in leaves:
                ends = [float(value(eqx.tree_at(where, scene, leaf + by * along))) for by in (1e-6, -1e-6)]
                np.testing.assert_allclose(reverse, (ends[0] - ends[1]) / 2e-6, rtol=1e-3, err_msg=name)


# ---------------------------------------------------------------- use


def test_light_is_computed_once_for_all_images_of_a_scene(monkeypatch):
    from jaxvol.lighting import template_lighting

    calls = []
    solved = template_lighting._solved
    monkeypatch.setattr(template_lighting, "_solved", lambda *given: calls.append(1) or solved(*given))
    scene = nested(), transfer(0.8, (1.0, 1.0, 1.0)), light_of(materials(1.2, 0.8, 0.0), lit(SKY))
    first, again = (np.asarray(image(*scene)) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert len(calls) == 1
    image(*scene[:2], light_of(materials(1.1, 0.8, 0.0), lit(SKY)))
    assert len(calls) == 2


def test_light_that_was_computed_inside_a_program_serves_outside():
    scene = nested(), transfer(0.8), MARCH

    def prepared():
        lighting = light_of(materials(1.2, 0.8), lit(SUN), nodes=2, levels=1, templates=1, packets=1)
        return jax.tree.leaves(lighting.baked(*scene))

    jax.eval_shape(lambda x: (prepared(), x)[1], 0.0)
    assert not any(isinstance(leaf, jax.core.Tracer) for leaf in prepared())


@pytest.mark.parametrize(
    "option",
    [{"blend": True}, {"photons": 3}, {"occlusion": "hard"}, {"reach": (2.0,)}, {"cutoff": 0.1}],
    ids=lambda option: next(iter(option)),
)
def test_options_of_the_published_form_are_refused(option):
    with pytest.raises(ValueError, match=next(iter(option))):
        light_of(materials(1.0, 1.0), lit(SUN), **option)


def test_wrong_forms_and_unknown_lengths_are_refused():
    with pytest.raises(ValueError, match="form must be one of published, transport"):
        ScattererTemplates(materials(1.0, 1.0), SUN, form="diffusion")
    with pytest.raises(ValueError, match="levels must be given for a material of opacity 0"):
        ScattererTemplates(materials(1.0, 1.0, 0.0), SUN, form="transport")
