"""How do cells become a pixel? Every mode over fragments of rays, compared with NumPy; what is refused."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.compositing import blending, modes
from jaxvol.compositing.blending import Fragment
from jaxvol.lighting import ConstantLight, Material, ScattererTemplates
from jaxvol.march.march import Cell
from jaxvol.scene.occupancy import Blocks

from ..modes import MODES, Additive
from ..scenes import anisotropic_noise, around, in_float64, soft_transfer, uniform_transfer


RAYS, CELLS = 64, 12
NOISE = anisotropic_noise()
SCENE = NOISE, soft_transfer(), around(NOISE)


@pytest.fixture(scope="module")
def fragments():
    """Random fragments of rays, some of them transparent, and some no samples. One ray sees nothing, one has
    NaN in some cells, one equal values everywhere."""
    random = np.random.default_rng(0)
    valid, opaque = random.random((2, RAYS, CELLS)) < 0.7
    alpha = np.where(valid & opaque, random.random((RAYS, CELLS)), 0)
    value = random.random((RAYS, CELLS))
    alpha[0], value[1], valid[1] = 0, 0.5, True
    alpha[2, 4:6] = value[2, 4:6] = np.nan
    valid[2] = True
    front = np.cumsum(random.random((RAYS, CELLS)), axis=1)
    return alpha, value, valid, front, random.random((RAYS, CELLS, 3))


@pytest.fixture(scope="module")
def composited(fragments):
    """Colours, opacities and depths by mode, all of one program; those of two parts of the rays, joined."""

    @jax.jit
    @jax.vmap
    def of_ray(alpha, value, valid, front, color):
        def state(mode, begin, end):
            """After the fragments, and the transmittance in front of each."""

            def add(state, numbers):
                alpha, value, valid, front, color = numbers
                cell = Cell(front, jnp.full_like(front, 0.25), ~valid)
                fragment = Fragment(alpha, front, cell, (value, (value,), (value,)), tuple(color), valid)
                return mode.add(state, fragment), mode.transmittance(state)

            part = jax.tree.map(lambda leaf: leaf[begin:end], (alpha, value, valid, front, color))
            return jax.lax.scan(add, mode.begin(jnp.zeros(()), "all"), part)

        over = MODES["over"]
        found = {name: mode.end(state(mode, 0, CELLS)[0]) for name, mode in MODES.items()}
        joined = over.end(blending.joined(state(over, 0, 5)[0], state(over, 5, CELLS)[0]))
        return {**found, "joined": joined}, {name: state(mode, 0, CELLS)[1] for name, mode in MODES.items()}

    return of_ray(*(part.astype(np.float32 if part.dtype == float else bool) for part in fragments))


def back_to_front(alpha, own):
    """C ← α c + (1 - α) C, from the last cell to the first: a second derivation of "over"."""
    behind = np.zeros(own.shape[::2])
    for a, c in zip(alpha.T[::-1], np.moveaxis(own, 1, 0)[::-1], strict=True):
        behind = a[:, None] * c + (1 - a[:, None]) * behind
    return behind


def test_weightings_sum_cells_as_numpy_does(fragments, composited):
    alpha, _, _, front, color = fragments
    own = np.concatenate([color, np.ones_like(front)[..., None], front[..., None]], axis=-1)
    sums = {
        "over": back_to_front(alpha, own),
        "joined": back_to_front(alpha, own),
        "additive": 0.01 * np.sum(alpha[..., None] * own, axis=1),
        "average": np.sum(-np.log1p(-alpha)[..., None] * own, axis=1),
    }
    for name, expected in sums.items():
        rgba, depth = composited[0][name]
        np.testing.assert_allclose(rgba, expected[:, :4], rtol=2e-5, atol=1e-6)
        mean = np.full(RAYS, np.inf)
        np.divide(expected[:, 4], expected[:, 3], out=mean, where=~(expected[:, 3] <= 0))
        np.testing.assert_allclose(depth, mean, rtol=2e-5)
    hidden = np.cumprod(np.concatenate([np.zeros((RAYS, 1)), alpha[:, :-1]], axis=1) * -1 + 1, axis=1)
    np.testing.assert_allclose(composited[1]["over"], hidden, atol=1e-6)
    for name in MODES.keys() - {"over"}:  # what is in front hides nothing
        np.testing.assert_array_equal(composited[1][name], 1)


def test_selections_choose_what_numpy_does(fragments, composited):
    """Of equal values the nearest; NaN ranks above all, and is visible."""
    alpha, value, valid, front, _ = fragments
    rank = np.where(valid, np.where(np.isnan(value), 9, value), -9)
    visible = ~(alpha <= 0)
    seen = visible.any(axis=1)
    first = np.argmax(visible, axis=1)
    chosen = {
        "maximum": (np.argmax(rank, axis=1), valid.any(axis=1), front),
        "minimum": (
            np.argmax(np.where(rank == 9, 9, np.where(valid, -rank, -9)), axis=1),
            valid.any(axis=1),
            front,
        ),
        "first visible": (first, seen, front),
        "isosurface": (first, seen, front + 0.25),
    }
    for name, (index, found, depths) in chosen.items():
        rgba, depth = composited[0][name]
        np.testing.assert_allclose(depth, np.where(found, depths[np.arange(RAYS), index], np.inf), rtol=1e-6)
        np.testing.assert_array_equal(rgba, found[:, None] * [0.0, 0, 0, 1])
    assert not seen.all()


def test_slopes_are_those_of_jax():
    """The derivative of Σ w q by the optical depth of every cell; of Σ w q alone behind what is opaque."""
    random = np.random.default_rng(1)
    weightings = [mode for mode in MODES.values() if isinstance(mode, jv.Weighting)]
    with in_float64():
        depths, worths = jax.device_put([*random.uniform(0.1, 2, (2, 7))])

        def sums(mode, depths):
            def add(sums, cell):
                depth, worth = cell
                weight = mode.weight(-jnp.expm1(-depth), sums[0])
                sums = sums[0] + weight, sums[1] + weight * worth
                return sums, sums

            return jax.lax.scan(add, (jnp.zeros(()), jnp.zeros(())), (depths, worths))

        def slopes(mode, depths):
            (_, whole), (opacity, front) = sums(mode, depths)
            return mode.slope(-jnp.expm1(-depths), opacity, worths, whole - front)

        @jax.jit
        def compared(depths):
            slope_of_jax = jax.grad(lambda depths, mode: sums(mode, depths)[0][1])
            return [(slopes(mode, depths), slope_of_jax(depths, mode)) for mode in weightings]

        for found, expected in compared(depths):
            np.testing.assert_allclose(found, expected, rtol=1e-12)
        # an opaque cell and what lies behind it, where `behind` is nothing but rounding
        found, _ = compared(np.where(np.arange(7) == 3, 80.0, np.asarray(depths)))[0]
        np.testing.assert_array_equal(np.asarray(found)[3:], 0)


def test_leaps_are_over_what_cannot_win_alone():
    """A block of the greatest values hides others, also where it shows nothing itself."""
    low, high = (np.asarray(end, np.float32).reshape(-1, 1, 1) for end in ([0.0, 0.2, 0.7], [0.1, 0.6, 0.8]))
    visible = jv.TransferFunction([0.0, 0.3, 0.4, 0.5, 0.65, 1.0], np.ones((6, 3)), [0.0, 0, 1, 0, 0, 0])
    labels = np.array([1, 1, 2], np.uint32).reshape(-1, 1, 1)
    by_label = jv.LabelTransferFunction([uniform_transfer(0.5), uniform_transfer(0.0)])

    @jax.jit
    def occupied(low, high, labels):
        marched = {name: mode.marched(visible, jv.March(0.1), NOISE)[0] for name, mode in MODES.items()}
        each = {name: mode.occupied(marched[name], Blocks(low, high, None)) for name, mode in MODES.items()}
        return each, MODES["maximum"].occupied(by_label, Blocks(low, high, labels))

    found, of_labels = jax.device_get(occupied(low, high, labels))
    assert np.all(of_labels)
    for name, expected in (
        ("over", [False, True, False]),
        ("first visible", [False, True, False]),
        ("isosurface", [False, True, False]),
        ("maximum", [False, True, True]),
        ("minimum", [True, True, False]),
    ):
        np.testing.assert_array_equal(found[name][:, 0, 0], expected, err_msg=name)


# ---- what is refused, before anything is compiled ----


traced = eqx.filter_eval_shape
"""Runs a function of arrays, but for what XLA would compute."""


class Scaled(Additive):
    """With a number that is neither an array nor static."""

    by: float = 1.0


def average_of_labels():
    labelled = jv.Volume(NOISE.data, NOISE.spacing, labels=np.zeros(NOISE.shape, np.uint8))
    transfer = jv.LabelTransferFunction([soft_transfer()] * 2)
    traced(lambda: jv.render(labelled, transfer, SCENE[2], jv.March(0.11), compositing="average"))


def average_that_is_lit():
    light = ScattererTemplates(
        Material(0.8, 0.1, 1.4), ConstantLight((1.0, 1.0, 1.0)), templates=1, photons=2
    )
    traced(lambda: jv.render(*SCENE, jv.March(0.11), compositing="average", lighting=light))


class Gained(jv.Over):
    """A mode with `resolved`, whose cells are marched without light."""

    def resolved(self, classification, sums):
        return 2 * sums


def gained_that_is_lit():
    traced(lambda: jv.render(*SCENE, jv.March(0.11), compositing=Gained(), lighting=jv.lighting.Phong()))


def first_hits_of(mode):
    march = jv.March(0.11, (jv.SpaceLeaping("min_distance"),))
    return lambda: traced(lambda: jv.render(*SCENE, march, compositing=mode))


def gradient_of_forward():
    """Of a selection."""

    def total(colors):
        transfer = eqx.tree_at(lambda t: t.colors, SCENE[1], colors)
        march = jv.March(0.11, max_samples=8)
        image = jv.render(NOISE, transfer, SCENE[2], march, compositing="maximum", adjoint="forward")
        return jnp.sum(image.rgba)

    return traced(jax.grad(total), SCENE[1].colors)


REFUSED = {
    "unknown": (
        lambda: modes.compositing_of("under"),
        r'must be one of "over", "maximum", .* or Selection; got \'under\'',
    ),
    "a class": (lambda: modes.compositing_of(jv.Over), "got the class Over"),
    "a field": (
        lambda: modes.compositing_of(Scaled(0.1, 2.0)),
        r"fields of a Scaled must be JAX arrays, .*; got 2.0",
    ),
    "average, labels": (average_of_labels, "value alone; LabelTransferFunction reads more"),
    "average, light": (average_that_is_lit, "lighting must be None"),
    "resolved, light": (gained_that_is_lit, "lighting must be None under Gained"),
    "grad of forward": (gradient_of_forward, 'adjoint="replay"'),
    **{
        f"first hits, {name}": (
            first_hits_of(MODES[name]),
            f"first visible sample; got compositing {type(MODES[name]).__name__}, which may show",
        )
        for name in ("maximum", "minimum", "average", "isosurface")
    },
    **{
        f"{mode.__name__}({thickness})": (lambda m=mode, t=thickness: m(t), "thickness must be ")
        for mode in (jv.Maximum, jv.Minimum, jv.Average)
        for thickness in (0.0, -1.0, np.nan, "thin")
    },
    **{
        f"Isosurface({value})": (lambda v=value: jv.Isosurface(v), "value must ")
        for value in (np.nan, np.inf, "high", [0.1, 0.2], None)
    },
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_refused_is_named(case):
    make, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        make()


def test_names_stand_for_modes():
    for name in modes.MODES:
        assert type(modes.compositing_of(name)) is type(MODES[name])
        assert all(float(leaf) == 1 for leaf in jax.tree.leaves(modes.compositing_of(name)))  # thicknesses


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
        traced(lambda: jv.render(*SCENE, march, compositing=Wrong(method)))
    if method != "occupied":
        ray = jnp.asarray([-1.0, 0.0, 0.8]), jnp.asarray([1.0, 0.0, 0.0])
        with pytest.raises(ValueError, match=rf"Wrong.{method} must return .*; got "):
            traced(lambda: jv.render_ray_reference(*SCENE[:2], *ray, march, compositing=Wrong(method)))


def test_what_a_rendering_does_not_hold_is_named():
    def render(mode, outputs):
        return traced(lambda: jv.render(*SCENE, jv.March(0.11), compositing=mode, outputs=outputs))

    for rendering in (render(MODES["isosurface"], "rgba"), render("over", "all"), render("maximum", "all")):
        with pytest.raises(
            AttributeError, match="normal is not part of this rendering: composite by an Isosurf"
        ):
            _ = rendering.normal


def test_no_rays_make_no_pixels():
    def rays(none):
        return jv.render_rays(*SCENE[:2], none, none, jv.March(0.11), compositing="maximum").rgba

    assert traced(rays, np.zeros((0, 3), np.float32)).shape == (0, 4)
