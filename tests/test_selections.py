"""Modes that select a depth, in both engines and all adjoints: a maximum and an isosurface of one's own."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.engine.driver import render_scene
from jaxvol.engine.scene import Scene
from jaxvol.engine.tiling import Tiling
from jaxvol.lighting import DirectionalLight, Material, ScattererTemplates

from .modes import check_gradients, reference_image
from .scenes import CAMERAS, anisotropic_noise, around, in_float64, slow, soft_transfer, uniform_transfer


class Maximum(jv.Selection):
    """The sample of the greatest value, as opaque as a layer of this thickness."""

    thickness: float = eqx.field(static=True, default=0.5)

    def begin(self, zero, outputs):
        return zero - jnp.inf, zero + jnp.inf

    def add(self, state, fragment):
        value, depth = state
        greater = fragment.valid & ~(fragment.value <= value) & ~jnp.isnan(value)
        return jnp.where(greater, fragment.value, value), jnp.where(greater, fragment.depth, depth)

    def depth(self, state):
        return state[1]

    def pixel(self, sampler, state):
        (r, g, b), extinction = sampler.shaded(state[1])
        opacity = 1 - jnp.exp(-extinction * self.thickness)
        return opacity * jnp.stack([r, g, b, jnp.ones_like(r)]), state[1]


class Isosurface(jv.Selection):
    """Where a ray first crosses a value; the root of the interpolated value, by bisection."""

    value: jax.Array

    def begin(self, zero, outputs):
        # the last depth and whether it lies above the value; and the ends of the first crossing
        return zero - jnp.inf, zero < 0, zero + jnp.inf, zero + jnp.inf

    def add(self, state, fragment):
        last, above, near, far = state
        now = fragment.value >= self.value
        crosses = fragment.valid & (last >= 0) & (now != above) & (far == jnp.inf)
        last = jnp.where(fragment.valid, fragment.depth, last)
        above = jnp.where(fragment.valid, now, above)
        return last, above, jnp.where(crosses, state[0], near), jnp.where(crosses, fragment.depth, far)

    def finished(self, state):
        return state[3] < jnp.inf

    def depth(self, state):
        return state[3]

    def occupied(self, transfer, blocks):
        value = self.value.astype(blocks.low.dtype)
        return (blocks.low <= value) & (blocks.high >= value)

    def pixel(self, sampler, state):
        _, above, near, far = state  # `above`: behind the crossing

        def halved(_, ends):
            near, far = ends
            middle = (near + far) / 2
            behind = (sampler.measured(middle)[0] >= self.value) == above
            return jnp.where(behind, near, middle), jnp.where(behind, middle, far)

        root = jax.lax.stop_gradient(jax.lax.fori_loop(0, 40, halved, (near, far))[1])
        # the implicit function theorem: v(s) = value, so that ds = (dvalue - dv) / v'
        value, slope = jax.jvp(lambda s: sampler.measured(s)[0], (root,), (jnp.ones_like(root),))
        root = root + (self.value - value) / jax.lax.stop_gradient(slope)
        color, _ = sampler.shaded(root)
        return jnp.stack([*color, jnp.ones_like(root)]), root


NOISE = anisotropic_noise()
TRANSFORMS = jv.EmptySpaceJitter(4), jv.AlphaCorrection(), jv.EarlyTermination(0.05)
MODES = {
    "first visible": jv.FirstVisible(),
    "maximum": Maximum(),
    "isosurface": Isosurface(jnp.asarray(0.45)),
}


def test_a_maximum_is_that_of_the_samples():
    """Along rays through the middles of voxels, the samples are the voxels."""
    data = np.random.default_rng(0).random((9, 6, 7), np.float32)
    volume, transfer = jv.Volume(data), jv.colormap("gray", (0.0, 1.0), unit_distance=0.5)
    y, z = np.meshgrid(np.arange(6.0), np.arange(7.0), indexing="ij")
    origins = np.stack([np.full_like(y, -3.0), y, z], -1)
    origins[..., 1:] = np.clip(origins[..., 1:], 1e-3, [4.999, 5.999])  # a ray along a face misses it
    directions = np.broadcast_to([1.0, 0.0, 0.0], origins.shape)
    rendering = jv.render_rays(volume, transfer, origins, directions, jv.March(1.0), compositing=Maximum())
    samples = data[:8]  # the exit is no sample
    _, extinction = jax.vmap(jax.vmap(transfer))(jnp.asarray(samples.max(axis=0)))
    np.testing.assert_allclose(rendering.rgba[..., 3], 1 - np.exp(-0.5 * extinction), atol=5e-3)
    np.testing.assert_allclose(rendering.depth, 3 + samples.argmax(axis=0), atol=1e-5)
    np.testing.assert_array_equal(rendering.samples, 8)


def test_an_isosurface_is_where_the_value_is_reached():
    """A value that falls linearly with the distance from a plane."""
    x = np.linspace(0.0, 1.0, 11, dtype=np.float32)
    volume = jv.Volume(np.broadcast_to(x[:, None, None], (11, 5, 5)).copy(), spacing=[0.1] * 3)
    transfer = jv.colormap("gray", (0.0, 1.0))
    straight, steep = [1.0, 0.0, 0.0], [0.8, 0.0, 0.6]
    origins, directions = [[-1.0, 0.2, 0.21]] * 2, [straight, steep]  # the second one misses
    for value in (0.33, 0.777):
        found = jv.render_rays(
            volume, transfer, origins, directions, jv.March(0.07), compositing=Isosurface(jnp.asarray(value))
        )
        np.testing.assert_allclose(found.depth, [1 + value, np.inf], rtol=1e-6)
        color, _ = transfer(jnp.asarray(value))
        np.testing.assert_allclose(found.rgba, [[*color, 1.0], [0.0] * 4], atol=1e-5)


@pytest.mark.parametrize("mode", ["isosurface", *slow("first visible", "maximum")])
@pytest.mark.parametrize("camera", ["around", *slow("inside")])
def test_selections_are_those_of_the_reference(mode, camera):
    """With leaps and without, where samples shift."""
    camera = CAMERAS[camera](NOISE)
    plain, leaping = (jv.March(0.11, (*TRANSFORMS, *more)) for more in ((), (jv.SpaceLeaping(),)))
    rgba, depth = reference_image(NOISE, soft_transfer(), camera, plain, MODES[mode])
    finite = np.isfinite(depth)
    assert finite.mean() > 0.1
    for march in (plain, leaping):
        found = jv.render(NOISE, soft_transfer(), camera, march, compositing=MODES[mode])
        np.testing.assert_allclose(found.rgba, rgba, atol=2e-4)
        np.testing.assert_array_equal(np.isfinite(found.depth), finite)
        np.testing.assert_allclose(found.depth[finite], depth[finite], rtol=1e-4)


def test_rays_shift_where_they_are_transparent_alone():
    """Here nowhere, although blocks in which the isosurface cannot lie are leapt over."""

    class FirstAbove(Isosurface):
        """At the sample behind the crossing."""

        def pixel(self, sampler, state):
            return jnp.ones(4), state[3]

    x = np.append(np.zeros(20), np.linspace(0.0, 1.0, 21)).astype(np.float32)
    volume = jv.Volume(np.broadcast_to(x[:, None, None], (41, 9, 9)).copy(), spacing=[0.1] * 3)
    y, z = np.meshgrid(np.linspace(0.1, 0.7, 8), np.linspace(0.1, 0.7, 8))
    origins = np.stack([np.full_like(y, -1.0), y, z], -1)
    found = jv.render_rays(
        *(volume, uniform_transfer(1.0), origins, np.broadcast_to([1.0, 0.0, 0.0], origins.shape)),
        jv.March(0.11, (jv.EmptySpaceJitter(4), jv.SpaceLeaping())),
        compositing=FirstAbove(jnp.asarray(0.93)),
    )
    # the value is reached at x = 3.86, and 36 steps are 3.96
    np.testing.assert_allclose(found.depth, 1 + 36 * 0.11, rtol=1e-6)


def test_a_finished_ray_takes_no_more_samples():
    """The value 0.33 lies between the fifth sample and the sixth."""
    x = np.linspace(0.0, 1.0, 11, dtype=np.float32)
    volume = jv.Volume(np.broadcast_to(x[:, None, None], (11, 5, 5)).copy(), spacing=[0.1] * 3)
    found = jv.render_rays(
        *(volume, jv.colormap("gray", (0.0, 1.0)), [[-1.0, 0.2, 0.2]], [[1.0, 0.0, 0.0]], jv.March(0.07)),
        compositing=Isosurface(jnp.asarray(0.33)),
    )
    np.testing.assert_array_equal(found.samples, 6)


@pytest.mark.slow
def test_more_tiles_than_one_show_nothing():
    camera = around(NOISE, (37, 50))
    scene = NOISE, soft_transfer(), camera, jv.March(0.11, (jv.SpaceLeaping(),))
    whole = jv.render(*scene, compositing=Maximum())
    small = render_scene(Scene(*scene, Maximum()), "all", "replay", Tiling(tile=6, batch=5))
    np.testing.assert_array_equal(whole.rgba, small.rgba)
    np.testing.assert_array_equal(whole.depth, small.depth)


@pytest.mark.slow
def test_a_selected_sample_is_lit():
    """By the same light in both engines."""
    lighting = ScattererTemplates(
        Material(0.8, 0.1, 1.4), DirectionalLight((0.3, -1.0, 0.2)), templates=1, photons=2
    )
    camera, march = around(NOISE, (12, 10)), jv.March(0.11)
    found = jv.render(NOISE, soft_transfer(), camera, march, compositing=jv.FirstVisible(), lighting=lighting)
    rgba, _ = reference_image(NOISE, soft_transfer(), camera, march, jv.FirstVisible(), lighting)
    unlit = jv.render(NOISE, soft_transfer(), camera, march, compositing=jv.FirstVisible())
    assert np.abs(found.rgba - unlit.rgba).max() > 0.1
    np.testing.assert_allclose(found.rgba, rgba, atol=2e-4)


@pytest.mark.parametrize("mode", ["maximum", *slow("first visible")])
def test_nan_is_passed_on(mode):
    """From voxels into the pixels whose rays meet them, and from the transfer function into all."""
    volume = eqx.tree_at(lambda v: v.data, NOISE, NOISE.data.at[10:14, 10:14, 10:14].set(jnp.nan))
    camera, march = around(NOISE), jv.March(0.11, (jv.SpaceLeaping(),))
    hidden = jv.TransferFunction.from_points([(0.0, (1, 1, 1), 0.0), (1.0, (1, 1, 1), 0.0)])
    hurt = jv.render(volume, hidden, camera, march, compositing=MODES[mode])
    assert 0 < np.isnan(hurt.rgba).any(axis=-1).mean() < 0.3
    broken = eqx.tree_at(lambda t: t.extinction, hidden, jnp.full(2, jnp.nan))
    image = jv.render(NOISE, broken, camera, march, compositing=MODES[mode])
    assert np.isnan(image.rgba).all()


@pytest.mark.slow
def test_a_face_between_labels_is_seen_from_the_side_of_its_cell():
    """Cells begin at faces between labels; the pixel is of the label that the march found there."""
    labels = np.random.default_rng(2).integers(0, 3, NOISE.shape)
    volume = jv.Volume(NOISE.data, NOISE.spacing, NOISE.origin, labels=labels)
    colors = np.eye(3)
    transfer = jv.LabelTransferFunction(
        {0: uniform_transfer(0.0), 1: uniform_transfer(9.0, colors[1]), 2: uniform_transfer(9.0, colors[2])}
    )
    march = jv.March(0.11, (jv.AlphaCorrection(labels=True),))
    camera = around(volume, (40, 40))
    found = jv.render(volume, transfer, camera, march, compositing=jv.FirstVisible())
    expected, _ = reference_image(volume, transfer, camera, march, jv.FirstVisible())
    assert np.mean(np.abs(found.rgba - expected).max(axis=-1) > 1e-3) < 2e-3


@pytest.mark.parametrize("mode", ["isosurface", *slow("first visible", "maximum")])
def test_an_image_of_nothing_has_the_gradient_0(mode):
    camera = jv.Camera.looking_at(NOISE, size=(12, 10))
    away = eqx.tree_at(lambda c: c.focal_point, camera, 2 * camera.position - camera.focal_point)

    def loss(scene):
        camera, march, volume = scene
        return jnp.sum(jv.render(volume, soft_transfer(), camera, march, compositing=MODES[mode]).rgba)

    gradient = eqx.filter_grad(loss)((away, jv.March(0.11), NOISE))
    for leaf in jax.tree.leaves(gradient):
        np.testing.assert_array_equal(leaf, 0)
    # and among pixels that see something
    gradient = eqx.filter_grad(loss)((around(NOISE, (12, 10)), jv.March(0.11), NOISE))
    for leaf in jax.tree.leaves(gradient):
        assert np.isfinite(leaf).all()


def test_no_rays_make_no_pixels():
    none = np.zeros((0, 3))
    found = jv.render_rays(NOISE, soft_transfer(), none, none, jv.March(0.11), compositing=Maximum())
    assert found.rgba.shape == (0, 4)


def test_a_selection_names_the_wrong_mode_of_differentiation():
    camera, march = around(NOISE, (9, 8)), jv.March(0.11, max_samples=8)

    def total(colors, adjoint):
        transfer = eqx.tree_at(lambda t: t.colors, soft_transfer(), colors)
        image = jv.render(NOISE, transfer, camera, march, compositing=Maximum(), adjoint=adjoint)
        return jnp.sum(image.rgba)

    colors = soft_transfer().colors
    with pytest.raises(ValueError, match='adjoint="forward"'):
        jax.jvp(lambda c: total(c, "replay"), (colors,), (colors,))
    with pytest.raises(ValueError, match='adjoint="replay"'):
        jax.grad(lambda c: total(c, "forward"))(colors)


def test_first_hits_are_refused_where_something_else_is_selected():
    march = jv.March(0.11, (jv.SpaceLeaping("min_distance"),))
    with pytest.raises(ValueError, match="Maximum may show"):
        jv.render(NOISE, soft_transfer(), around(NOISE), march, compositing=Maximum())


class Wrong(jv.FirstVisible):
    """Answers that a mode must not give."""

    method: str = eqx.field(static=True, default="")

    def add(self, state, fragment):
        state = super().add(state, fragment)
        return state.astype(jnp.int32) if self.method == "add" else state

    def finished(self, state):
        return state if self.method == "finished" else super().finished(state)

    def occupied(self, transfer, blocks):
        return jnp.ones(3, bool) if self.method == "occupied" else super().occupied(transfer, blocks)

    def pixel(self, sampler, state):
        return (jnp.ones(3), state) if self.method == "pixel" else super().pixel(sampler, state)


@pytest.mark.parametrize("method", ["add", "finished", "occupied", "pixel"])
def test_a_wrong_answer_of_a_mode_is_named(method):
    march = jv.March(0.11, (jv.SpaceLeaping(),))
    with pytest.raises(ValueError, match=rf"Wrong.{method} must return .*; got "):
        jv.render(NOISE, soft_transfer(), around(NOISE), march, compositing=Wrong(method))
    if method != "occupied":
        ray = jnp.asarray([-1.0, 0.0, 0.8]), jnp.asarray([1.0, 0.0, 0.0])
        with pytest.raises(ValueError, match=rf"Wrong.{method} must return .*; got "):
            jv.render_ray_reference(NOISE, soft_transfer(), *ray, march, compositing=Wrong(method))


class Fog(Maximum):
    """Farther maxima are darker."""

    def pixel(self, sampler, state):
        rgba, depth = super().pixel(sampler, state)
        return rgba * jnp.exp(-0.3 * sampler.differentiable_depth(depth)), depth


@pytest.mark.parametrize("mode", ["fog", *slow("isosurface")])
@pytest.mark.parametrize("adjoint", ["replay", *slow("forward", "direct")])
def test_gradients_are_central_differences(mode, adjoint):
    """Of colours and depths. An isosurface is opaque, and its root is that of any step."""
    with in_float64():
        volume = jv.Volume(np.asarray(NOISE.data, np.float64), NOISE.spacing)
        if mode == "fog":
            check_gradients(volume, Fog(), {}, adjoint)
        else:
            own = {"value": lambda mode: mode.value}
            shown = Isosurface(jnp.asarray(0.45, jnp.float64))
            check_gradients(volume, shown, own, adjoint, constant={"extinction", "step"})
