"""Are the derivatives of path tracing right, and their standard errors?

With respect to all kinds of parameters at once, so that tests share one program; compared with differences of
quadrature in float64 (light scattered once), with Chandrasekhar's half-space, and with differences of images
of the same random numbers.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.lighting import DirectionalLight, Material, PointLight

from ..half_space import cube, far, reflected
from ..scenes import around
from .test_path_trace import (
    COLORS,
    EXTINCTION,
    LAMP,
    NOISE,
    POINTS,
    SKY,
    SUN,
    lit,
    matter,
    middles_of,
    once_scattered,
    regions,
    trace,
    z_of_regions,
)


GROUPS = 16
KINDS = ["empty", "dense", "color", "opacity", "path", "anisotropy", "sun", "lamp", "sky"]
"""What the components of a vector of parameters change: see `Scene.changed`."""


def half_empty() -> jv.Volume:
    """Noise, and nothing beyond the middle along z."""
    data = np.where(np.arange(24) < 11, np.asarray(NOISE.data), np.float32(0.1))
    return jv.Volume(data, NOISE.spacing, NOISE.origin)


class Scene(NamedTuple):
    """A scene with two materials."""

    volume: jv.Volume
    camera: jv.Camera
    extinction: Any
    lights: tuple[Any, ...]
    materials: Any
    colors: Any = COLORS
    anisotropy: Any = np.float32(0.4)  # an array, so that all share one program

    def changed(self, by: Any) -> "Scene":
        """The scene, changed by a vector."""
        change = dict(zip(KINDS, by, strict=True))
        first, second = self.materials
        first = Material(
            first.opacity + change["opacity"],
            first.mean_free_path * (1 + change["path"]),
            values=first.values,
        )
        sun, lamp, sky = self.lights
        brighter = [
            eqx.tree_at(lambda light: light.irradiance, sun, sun.irradiance * (1 + change["sun"])),
            eqx.tree_at(lambda light: light.intensity, lamp, lamp.intensity * (1 + change["lamp"])),
            eqx.tree_at(lambda light: light.radiance, sky, sky.radiance * (1 + change["sky"])),
        ]
        extinction = self.extinction + np.eye(8)[0] * change["empty"] + np.eye(8)[1] * change["empty"]
        return self._replace(
            extinction=extinction * (1 + np.eye(8)[3] * change["dense"]),
            colors=self.colors * (1 - change["color"]),
            materials=(first, second),
            lights=tuple(brighter),
            anisotropy=self.anisotropy + change["anisotropy"],
        )

    @property
    def transfer(self) -> jv.TransferFunction:
        return jv.TransferFunction(POINTS, self.colors, self.extinction)

    def traced(self, **how: Any) -> jv.PathTraced:
        given = self.volume, self.transfer, self.camera, self.lights
        return trace(*given, materials=self.materials, anisotropy=self.anisotropy, groups=GROUPS, **how)


NOWHERE = Material(0.5, 1.0, values=(5.0, 6.0))
VOLUME = half_empty()
SCENE = Scene(VOLUME, around(VOLUME), EXTINCTION, lit(SUN, LAMP, SKY), (NOWHERE, NOWHERE))


def derivatives(scene: Scene, **how: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Images by groups, with their opacity; their derivatives, (groups, height, width, 4, parameters); and
    the derivatives of the image of all paths."""

    how = {**how, "key": np.int32(how.get("key", 0))}
    groups, *tangents = _derivatives(scene, how)
    found, of_all = (np.asarray(each, float) for each in tangents)
    return np.asarray(groups), found, of_all


@eqx.filter_jit  # by themselves, the operations are a hundred programs
def _derivatives(scene: Scene, how: dict[str, Any]) -> tuple[jax.Array, ...]:
    def images(by: Any) -> tuple[jax.Array, ...]:
        traced = scene.changed(by).traced(**how)
        assert traced.groups is not None
        return traced.groups, jnp.concatenate([traced.radiance, traced.opacity[..., None]], axis=-1)

    def along(tangent: Any) -> Any:
        return jax.jvp(images, (jnp.zeros(len(KINDS)),), (tangent,))

    (groups, _), tangents = jax.vmap(along, out_axes=(None, -1))(jnp.eye(len(KINDS)))
    return groups, *tangents


def estimated(groups: Any) -> tuple[np.ndarray, np.ndarray]:
    """Mean, and its standard error, in NumPy, which compiles nothing."""
    return np.mean(groups, axis=0), np.std(groups, axis=0, ddof=1) / np.sqrt(len(groups))


def unit(kind: str) -> np.ndarray:
    return np.eye(len(KINDS))[KINDS.index(kind)]


def difference(image: Any, direction: np.ndarray, step: float, *, one_sided: bool = False) -> Any:
    """Derivative of `image` along a direction, by differences of second order."""
    if one_sided:
        now, once, twice = (image(n * step * direction) for n in (0, 1, 2))
        return (4 * once - 3 * now - twice) / (2 * step)
    return (image(step * direction) - image(-step * direction)) / (2 * step)


def once_scattered_by(scene: Scene) -> np.ndarray:
    """The image with its opacity, by quadrature."""
    sun, lamp, _ = scene.lights
    assert isinstance(sun, DirectionalLight)
    assert isinstance(lamp, PointLight)
    of = scene.volume, scene.transfer, scene.camera
    radiance = once_scattered(*of, (sun, lamp), float(scene.anisotropy), 192, 48)
    _, extinction, exits = matter(*of[:2])
    points, _, width = middles_of(scene.camera, exits, 1024)
    opacity = -np.expm1(-extinction(points).sum(axis=1) * width).reshape(radiance.shape[:2])
    return np.concatenate([radiance, opacity[..., None]], axis=-1)


def test_derivatives_of_light_scattered_once_are_those_of_quadrature_and_errors_are_as_told():
    """Also with respect to an extinction of 0, in half the volume."""
    scene = SCENE._replace(lights=lit(SUN, LAMP))
    groups, found, of_all = derivatives(scene, max_scatterings=1)
    np.testing.assert_array_equal(groups, np.asarray(scene.traced(max_scatterings=1).groups))
    np.testing.assert_allclose(found.mean(axis=0), of_all, atol=1e-5 * np.abs(of_all).max())
    assert not found[..., KINDS.index("opacity")].any()  # of a material that is nowhere
    of_regions = []
    for kind in ("empty", "dense", "color", "anisotropy", "sun", "lamp"):
        derivative, error = estimated(found[..., KINDS.index(kind)])
        expected = difference(
            lambda by: once_scattered_by(scene.changed(by)), unit(kind), 1e-3, one_sided=kind == "empty"
        )
        away, seen = derivative - expected, slice(4 if kind in ("empty", "dense") else 3)
        total = np.sqrt(np.sum(error**2, axis=(0, 1)))[seen]
        assert np.all(total < 0.2 * abs(expected.sum(axis=(0, 1))).max()), kind
        assert np.all(abs(away.sum(axis=(0, 1))[seen]) < 3 * total), kind
        size = abs(regions(expected))
        of_regions.append(z_of_regions(away, error**2)[size > 0.1 * size.max(axis=(0, 1))])
        assert abs(of_regions[-1]).max() < 4.5, kind
    z = np.concatenate(of_regions)
    assert len(z) > 100
    assert 0.6 < np.std(z) < 1.5  # derivatives by different parameters are correlated


@pytest.mark.slow
def test_the_standard_error_of_a_derivative_is_its_standard_deviation_over_keys():
    scene, means, errors = SCENE._replace(lights=lit(SUN, LAMP)), [], []
    for key in range(48):
        found = derivatives(scene, max_scatterings=1, key=key)[1].mean(axis=(1, 2))[:, :3]
        mean, error = estimated(found[..., np.array([0, 1, 2, 5, 6, 7])])
        means.append(mean)
        errors.append(error)
    ratio = np.std(means, axis=0, ddof=1) / np.sqrt(np.mean(np.square(errors), axis=0))
    # each has a standard deviation of 0.1
    assert np.all((ratio > 0.7) & (ratio < 1.3))


def test_the_derivative_of_a_half_space_by_its_opacity_is_chandrasekhars():
    volume, colors, opacity, step = cube(), np.array([0.5, 0.8, 0.95]), 0.2, 1e-4
    sun = DirectionalLight((0.8, 0.0, 0.6), np.ones(3) * np.pi)
    materials = Material(opacity, 1 / 60, values=(-1.0, 2.0)), NOWHERE
    camera, extinction = far(volume, 0.01), np.full(8, 1.0)
    scene = Scene(volume, camera, extinction, lit(sun), materials, np.tile(colors, (8, 1)), np.float32(0))
    _, found, _ = derivatives(scene)
    derivative, error = estimated(found.mean(axis=(1, 2)))
    ends = (np.pi * reflected(colors * (1 - opacity - side * step), 1.0, 0.6) for side in (1, -1))
    away = derivative[:3, KINDS.index("opacity")] - np.subtract(*ends) / (2 * step)
    assert np.all(error[:3, KINDS.index("opacity")] < 0.02 * abs(derivative[:3, KINDS.index("opacity")]))
    assert np.all(abs(away) < 3 * error[:3, KINDS.index("opacity")])
    # a half-space of half the mean free path looks the same
    assert np.all(abs(derivative[:3, KINDS.index("path")]) < 3.5 * error[:3, KINDS.index("path")])
    assert np.all(error[:3, KINDS.index("path")] < 0.1)


IN_MATERIALS = SCENE._replace(
    extinction=3 * EXTINCTION,
    materials=(Material(0.3, 0.2, values=(0.32, 0.45)), Material(0.1, 0.4, values=(0.95, 1.0))),
)


def compared(scene: Scene, directions: np.ndarray, steps: dict[int, float], keys: int) -> None:
    """Derivatives of the mean image, along rows of `directions`, are differences of images of the same keys:
    central ones, or one-sided where a step is negative."""

    def mean(by: np.ndarray, key: int) -> np.ndarray:
        groups = scene.changed(by).traced(key=key).groups
        return np.asarray(groups, float).mean(axis=(0, 1, 2))

    found = np.concatenate([derivatives(scene, key=key)[1].mean(axis=(1, 2)) for key in range(keys // 2)])
    for row, step in steps.items():
        direction = directions[row]
        derivative, error = estimated(found @ direction)
        by_keys = [
            difference(lambda by, key=key: mean(by, key), direction, abs(step), one_sided=step < 0)
            for key in range(100, 100 + keys)
        ]
        expected, its_error = estimated(np.stack(by_keys))
        assert np.all(np.hypot(error, its_error)[:3] < 0.2 * abs(expected[:3]).max()), direction
        assert np.all(abs(derivative - expected) < 3 * np.hypot(error, its_error) + 1e-7), direction


def test_derivatives_of_light_scattered_often_are_those_of_images_of_the_same_key():
    every = sum(unit(kind) for kind in KINDS if kind not in ("empty", "anisotropy")) - unit("anisotropy") / 2
    compared(IN_MATERIALS, every[None], {0: 0.05}, 6)


@pytest.mark.slow
def test_the_derivative_by_each_kind_of_parameter_is_that_of_images_of_the_same_key():
    steps = {"empty": -0.05, "anisotropy": 0.02}
    each = {at: steps.get(kind, 0.05) for at, kind in enumerate(KINDS)}
    compared(IN_MATERIALS, np.eye(len(KINDS)), each, 12)


@eqx.filter_jit
def pulled(scene: Scene, weights: Any) -> jax.Array:
    """Derivatives of the weighted sum of images by groups, in reverse mode."""

    def total(by: Any) -> jax.Array:
        groups = scene.changed(by).traced(key=np.int32(0)).groups
        assert groups is not None
        return jnp.sum(groups * weights)

    return jax.grad(total)(jnp.zeros(len(KINDS)))


def test_reverse_mode_agrees_with_forward_mode():
    """Which walks the same paths. The extinction of 0 inside a material is in neither mode defined."""
    groups, found, _ = derivatives(IN_MATERIALS)
    weights = np.random.default_rng(0).normal(size=groups.shape).astype(np.float32)
    expected = np.einsum("ghwc,ghwck->k", weights, found)
    np.testing.assert_allclose(pulled(IN_MATERIALS, weights), expected, rtol=1e-4)
    everywhere = Material(0.3, 0.2, values=(-1.0, 2.0))
    by_kind = dict(
        zip(KINDS, pulled(IN_MATERIALS._replace(materials=(everywhere, NOWHERE)), weights), strict=True)
    )
    assert np.isnan(by_kind["empty"])
    assert np.all(np.isfinite([by_kind[kind] for kind in ("opacity", "path", "anisotropy", "sun")]))


def test_an_extinction_of_0_in_a_material_has_no_derivative():
    everywhere = Material(0.3, 0.2, values=(-1.0, 2.0))
    _, found, _ = derivatives(SCENE._replace(materials=(everywhere, NOWHERE)), max_scatterings=1)
    undefined = np.isnan(found).any(axis=(0, 1, 2, 3))
    assert undefined.tolist() == [kind == "empty" for kind in KINDS]


@pytest.mark.slow
def test_the_derivative_by_voxels_is_that_of_images_of_the_same_key():
    change = 0.1 * (1 + jnp.sin(jnp.arange(24.0)))[:, None, None] * jnp.ones((24,) * 3)

    def mean(by: Any, key: int) -> jax.Array:
        volume = eqx.tree_at(lambda volume: volume.data, NOISE, NOISE.data + by * change)
        traced = Scene(volume, around(NOISE), 0.3 + EXTINCTION, lit(SUN, SKY), None).traced(key=key)
        assert traced.groups is not None
        return traced.groups.mean(axis=(1, 2))

    found = [jax.jvp(lambda by, key=key: mean(by, key), (0.0,), (1.0,))[1] for key in range(8)]
    derivative, error = estimated(np.concatenate(found).astype(float))
    by_keys = [
        (mean(0.05, key).mean(axis=0) - mean(-0.05, key).mean(axis=0)) / 0.1 for key in range(100, 116)
    ]
    expected, its_error = estimated(np.stack(by_keys).astype(float))
    assert np.sum(abs(expected) > 5 * np.hypot(error, its_error)) == 3  # less and more light cancel in green
    assert np.all(abs(derivative - expected) < 3 * np.hypot(error, its_error))


MOVED: dict[str, Any] = {
    "camera": lambda scene: scene.camera.position,
    "spacing, origin and direction": lambda scene: scene.volume.spacing,
    "voxels where there are materials": lambda scene: scene.volume.data,
    "values of materials": lambda scene: scene.materials[0].values,
    "directions and positions of lights": lambda scene: scene.lights[1].position,
}


@pytest.mark.parametrize("name", MOVED)
def test_what_moves_paths_is_refused_by_name(name):
    def image(part: Any) -> jax.Array:
        return eqx.tree_at(MOVED[name], IN_MATERIALS, part).traced().radiance

    part = MOVED[name](IN_MATERIALS)
    with pytest.raises(RuntimeError, match=rf"no derivative with respect to .*{name}.*stop_gradient"):
        jax.eval_shape(lambda part: jax.jvp(image, (part,), (part,)), part)


def test_control_points_and_their_steps_are_refused():
    def image(transfer: jv.TransferFunction, data: Any = NOISE.data) -> jax.Array:
        volume = eqx.tree_at(lambda volume: volume.data, NOISE, data)
        return trace(volume, transfer, SCENE.camera, SCENE.lights).radiance

    with pytest.raises(RuntimeError, match="control points' values of transfer"):
        jax.eval_shape(lambda transfer: jax.jvp(image, (transfer,), (transfer,)), SCENE.transfer)
    step = jv.TransferFunction(np.where(np.arange(8) == 3, POINTS[4], POINTS), COLORS, EXTINCTION)
    with pytest.raises(RuntimeError, match="voxels under a transfer function with a step"):
        jax.jvp(partial(image, step), (NOISE.data,), (NOISE.data,))


def test_images_by_groups_are_over_a_background():
    traced, background = SCENE._replace(lights=lit(SUN, LAMP)).traced(max_scatterings=1), (0.2, 0.5, 1.0)
    assert traced.groups is not None
    other = SCENE._replace(lights=lit(SUN, LAMP)).traced(max_scatterings=1, key=1)

    @eqx.filter_jit  # by themselves, the operations are thirty programs
    def all_of(traced: jv.PathTraced, other: jv.PathTraced) -> Any:
        assert traced.groups is not None
        both = traced.joined(other)
        images = [(each.images(background), each.image(background)) for each in (traced, both)]
        return images, traced.groups, traced.standard_error

    (own, joined), groups, of_paths = jax.device_get(all_of(traced, other))
    of_groups = estimated(groups[..., :3])[1]
    for images, image in (own, joined):
        np.testing.assert_allclose(images.mean(axis=0), image, atol=1e-6)
    assert 0.9 < of_groups.mean() / of_paths.mean() < 1.1
    with pytest.raises(ValueError, match="groups must divide paths; got groups = 3"):
        trace(VOLUME, SCENE.transfer, SCENE.camera, SCENE.lights, groups=3)
    with pytest.raises(ValueError, match="images are by groups of paths"):
        eqx.tree_at(lambda traced: traced.groups, traced, None).images()
