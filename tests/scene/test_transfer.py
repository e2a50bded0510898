"""Colour and extinction between control points; presets, colormaps, and invalid arguments."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol._util import piecewise_linear
from jaxvol._util.piecewise_linear import points_below, positive_between
from jaxvol.scene.occupancy import Blocks
from jaxvol.scene.presets import SHADED, fitted_range, preset_name
from jaxvol.scene.transfer import Transfer, with_shared_points

from ..scenes import anisotropic_noise


FEW, MANY = 8, 40
"""Numbers of control points: few are compared with a value, many are searched."""


def test_an_activation_that_overflows_has_no_gradient():
    field = jv.RadianceField(2.0, density=jnp.exp)

    @jax.jit
    @jax.value_and_grad
    def extinction(density):
        zero = jnp.zeros((), jnp.float32)
        return field.classifier()((zero, zero, zero, density))[1]

    for stored, value, slope in ((2.0, 2 * np.exp(2), 2 * np.exp(2)), (95.0, 2e30, 0.0), (80.0, 2e30, 0.0)):
        found = extinction(np.float32(stored))
        np.testing.assert_allclose(found, (value, slope), rtol=1e-5)
    assert np.isnan(extinction(np.float32(np.nan))[0])


def table(n, seed=0, *steps):
    """A random transfer function; at these indices, points are at the value of the one before."""
    random = np.random.default_rng(seed)
    values = np.sort(random.uniform(0, 255, n)).astype(np.float32)
    for index in steps:
        values[index] = values[index - 1]
    extinction = random.random(n) * (random.random(n) < 0.7)
    return jv.TransferFunction(values, random.random((n, 3)), extinction)


TABLES = {
    "few": table(FEW),
    "few, with steps": table(FEW, 1, 1, 4, 7),
    "many": table(MANY),
    "many, with steps": table(MANY, 1, 1, 9, 39),
}


@eqx.filter_jit
def looked_up(transfer, values):
    """Colour and extinction; the gradient of a sum of them by JAX; and the same by `vjp`, as engines do."""

    def summed(transfer, values):
        (r, g, b), sigma = jax.vmap(transfer)(values)
        return jnp.sum(r + 2 * g + 3 * b + 4 * sigma), (jnp.stack([r, g, b], axis=-1), sigma)

    expected, found = jax.grad(summed, (0, 1), has_aux=True)(transfer, values)
    search, one = transfer.search(), jnp.ones_like(values)
    measured = (values,) if search is None else (values, *jax.vmap(lambda v: search((v,)))(values))
    return found, expected, transfer.vjp(measured, (one, 2 * one, 3 * one), 4 * one)


@pytest.mark.parametrize("case", TABLES)
def test_tables_are_linear_between_points_and_constant_beyond_the_ends(case):
    """Below a step the first of its points counts, at it and above the second. Gradients are finite."""
    transfer = TABLES[case]
    values, colors, extinction = map(np.asarray, (transfer.values, transfer.colors, transfer.extinction))
    steps = np.flatnonzero(values[1:] == values[:-1])
    assert len(steps) == (3 if "steps" in case else 0)
    where = np.linspace(-50, 300, 541, dtype=np.float32)
    where = np.concatenate([where, values, np.nextafter(values, np.float32(-np.inf))])
    (color, sigma), expected, (found, (of_value, *_)) = looked_up(transfer, where)
    # NumPy takes the second point at a step, but for that at an end
    at_end, before = where >= values[-1], where < values[0]
    for channel, column in zip(np.asarray(color).T, colors.T, strict=True):
        line = np.where(at_end, column[-1], np.where(before, column[0], np.interp(where, values, column)))
        np.testing.assert_allclose(channel, line, atol=2e-5)
    line = np.where(
        at_end, extinction[-1], np.where(before, extinction[0], np.interp(where, values, extinction))
    )
    np.testing.assert_allclose(sigma, line, atol=2e-5)
    for name in ("values", "colors", "extinction"):
        assert np.isfinite(getattr(found, name)).all()
        np.testing.assert_allclose(getattr(found, name), getattr(expected[0], name), rtol=1e-5, atol=1e-4)
    np.testing.assert_array_equal(found.values, 0)
    np.testing.assert_allclose(of_value, expected[1], rtol=1e-5, atol=1e-5)
    # Σ of the shares of all points is the number of values
    np.testing.assert_allclose(np.asarray(found.extinction).sum(), 4 * len(where), rtol=1e-5)


@pytest.mark.parametrize("n", [FEW, MANY])
def test_negative_extinction_counts_as_zero_and_has_no_gradient(n):
    """As after an optimiser's step."""
    values = np.linspace(-50, 300, 541, dtype=np.float32)
    values = np.concatenate([values, TABLES["few" if n == FEW else "many"].values, np.zeros(n, np.float32)])
    transfer = table(n)
    less = np.asarray(transfer.extinction) - np.float32(0.3)
    stepped, clipped = (
        eqx.tree_at(lambda t: t.extinction, transfer, jax.device_put(each)) for each in (less, less.clip(0))
    )
    found, expected = looked_up(stepped, values), looked_up(clipped, values)
    jax.tree.map(np.testing.assert_array_equal, found[0], expected[0])
    negative = np.asarray(stepped.extinction) < 0
    for gradient in (found[1][0], found[2][0]):  # by JAX, and by `vjp`
        np.testing.assert_array_equal(np.asarray(gradient.extinction)[negative], 0)
        kept = np.where(negative, 0, expected[2][0].extinction)
        np.testing.assert_allclose(gradient.extinction, kept, rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(gradient.colors, expected[2][0].colors, rtol=1e-5, atol=1e-4)


def test_zero_extinction_is_exactly_transparent():
    extinction = np.where(np.arange(FEW) == 3, 1.0, 0)
    transfer = jv.TransferFunction(np.arange(FEW), np.ones((FEW, 3)), extinction)
    where = np.linspace(-1, FEW, 541 + 2 * FEW, dtype=np.float32)  # as many as above
    (_, sigma), *_ = looked_up(transfer, where)
    np.testing.assert_array_equal(np.asarray(sigma) > 0, (where > 2) & (where < 4))


def test_visibility_of_ranges_at_a_step():
    """For ranges that end or begin exactly at a step, the second point counts and the first one does not."""
    low, high = np.meshgrid(np.arange(50.0, 71, dtype=np.float32), np.arange(50.0, 71, dtype=np.float32))
    ordered = high >= low
    for n in (FEW, MANY):
        values = np.array([0, 60, 60, *np.linspace(80, 255, n - 3)], np.float32)
        for first in (0.0, 1.0):  # invisible below the step, or above it
            extinction = np.where(np.arange(n) < 2, first, 1 - first).astype(np.float32)
            seen = np.asarray(jax.jit(positive_between)(values, extinction, low, high))
            expected = high >= 60 if first == 0 else low < 60
            np.testing.assert_array_equal(seen[ordered], expected[ordered])


# ---- opacities, presets, colormaps ----


def test_opacity_of_a_unit_distance_converts_exactly():
    """An opacity of 1 is the largest float below; numbers of any library are taken."""
    opacities = [0.0, 0.1, 0.5, 0.9]
    points = [(float(i), (1, 1, 1), a) for i, a in enumerate(opacities)]
    transfer = jv.TransferFunction.from_points(points, unit_distance=2.5)
    opacity = jax.jit(jv.TransferFunction.opacity, static_argnums=1)
    np.testing.assert_allclose(opacity(transfer, 2.5), opacities, atol=1e-7)
    # half the distance: 1 - sqrt(1 - a)
    np.testing.assert_allclose(opacity(transfer, 1.25), 1 - np.sqrt(1 - np.array(opacities)), atol=1e-7)
    kinds = (
        [np.int16(0), jnp.float32(1), np.float64(2), 3],
        [jnp.zeros(()), np.float32(0.1), 0.5, np.array(0.9)],
    )
    mixed = [(value, [1, 1, np.array(1)], opacity) for value, opacity in zip(*kinds, strict=True)]
    mixed = jv.TransferFunction.from_points(mixed, jnp.float32(2.5))
    np.testing.assert_allclose(mixed.extinction, transfer.extinction, rtol=1e-6)
    opaque = jv.TransferFunction.from_points([*points[:3], (3.0, (1, 1, 1), 1.0)])
    assert np.isfinite(opaque.extinction).all()
    assert 1 - np.asarray(opacity(opaque, 1.0))[3] <= 2**-23


@pytest.mark.parametrize("name", ["ct_bone", "engine", "bonsai"])
def test_presets_are_stretched_to_a_range(name):
    transfer, stretched = jv.preset(name), jv.preset(name, clim=(0, 4000), unit_distance=2.0)
    low, high = jv.PRESETS[name][1]
    values = (np.asarray(transfer.values, float) - low) / (high - low) * 4000
    np.testing.assert_allclose(stretched.values, values, rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(stretched.extinction, np.asarray(transfer.extinction) / 2, rtol=1e-5)
    np.testing.assert_array_equal(stretched.colors, transfer.colors)


def test_presets_show_something_and_hide_something():
    for name, (_, (low, high), points) in jv.PRESETS.items():
        values, _, opacities = zip(*points, strict=True)
        own = not name.startswith(("CT", "MR", "DTI"))  # 3D Slicer's are fainter, and may reach beyond
        assert opacities[0] == 0, name
        assert max(opacities) > (0.25 if own else 0.1), name
        assert not own or low <= min(values), name
        assert not own or max(values) <= high, name


def test_presets_of_slicer_are_found_by_any_spelling_and_have_its_values():
    for name in ("CT-Bones", "ct_bones", "ct bones", "CTBONES"):
        assert preset_name(name) == "CT-Bones"
    assert list(map(preset_name, ("ct_bone", "CT-Bone"))) == ["ct_bone", "CT-Bone"]  # ours, and theirs
    assert {"CT-AAA", "MR-Default"} <= SHADED
    assert not {"MR-MIP", "CT-Fat"} & SHADED
    found = jv.preset("CT-Bone")  # of presets.xml
    assert np.asarray(found.values).tolist() == pytest.approx([-3024, -16.4458, 641.385, 3071])
    display = np.array([[0.729412, 0.254902, 0.301961], [0.905882, 0.815686, 0.552941]])
    np.testing.assert_allclose(np.asarray(found.colors)[1:3], ((display + 0.055) / 1.055) ** 2.4, rtol=1e-3)
    opacity = -np.expm1(-np.asarray(found.extinction))
    np.testing.assert_allclose(opacity, [0, 0, 0.715686, 0.705882], atol=1e-6)
    # MR has no unit, and is stretched; CT is not, and it is said that it does not fit
    low, middle, high = np.array([0, 250]), np.array([-1000, 2000]), np.array([0, 900])
    assert fitted_range("MR-Default", low) == fitted_range("CT-Bone", middle) == (None, None)
    clim, told = fitted_range("mr default", high)
    assert clim == pytest.approx((0, 900), rel=2e-3)
    assert told is not None
    assert "Hounsfield" in str(fitted_range("CT-Bone", low)[1])


def test_colormaps_have_the_colours_of_matplotlib_in_linear_light():
    import matplotlib

    def display(cmap):
        return np.asarray(jv.to_srgb(jv.colormap(cmap, (0, 1), n_colors=256).colors))

    between = np.linspace(0, 1, 256)
    np.testing.assert_allclose(display("viridis"), matplotlib.colormaps["viridis"](between)[:, :3], atol=1e-5)
    np.testing.assert_array_equal(display(matplotlib.colormaps["magma"]), display("magma"))
    tomato = np.array([255, 99, 71]) / 255
    for one in ("tomato", "#ff6347", tuple(tomato), [tomato], np.array([tomato]), [jnp.asarray(tomato)]):
        np.testing.assert_allclose(display(one), np.tile(tomato, (256, 1)), atol=1e-6)
    three = np.array([(1, 0, 0), (0, 0, 1), (0, 1, 0)])
    expected = np.stack([np.interp(between, [0, 0.5, 1], channel) for channel in three.T], axis=-1)
    for each in (["red", "b", "#00ff00"], three):
        np.testing.assert_allclose(display(each), expected, atol=1e-6)


def test_opacity_ramps():
    ramps = "linear", "sigmoid", [0.0, 0.8, 0.2]
    found = jax.jit(lambda: [jv.colormap("gray", (0, 1), ramp, n_colors=101).opacity() for ramp in ramps])()
    linear, sigmoid, given = map(np.asarray, found)
    np.testing.assert_allclose(linear[:-1], np.linspace(0, 1, 101)[:-1], atol=1e-6)
    np.testing.assert_allclose(sigmoid[50], 0.5, atol=1e-6)
    np.testing.assert_allclose(sigmoid + sigmoid[::-1], 1, atol=1e-6)
    np.testing.assert_allclose(given[::25], [0, 0.4, 0.8, 0.5, 0.2], atol=1e-6)


POINTS = np.array([0.0, 1]), np.ones((2, 3)), np.ones(2)


def test_a_colormaps_opacity_is_that_of_a_voxel_of_what_is_rendered():
    """0.3 a voxel, whose size is the geometric mean 0.2 of the spacing, which may be traced."""
    march = jv.March(0.05, (jv.AlphaCorrection(),))

    @jax.jit
    def opacity(spacing):
        shown = jv.colormap("gray", (0, 2), [0.3, 0.3], n_colors=2)
        volume = jv.Volume(np.ones((3, 4, 5), np.float32), spacing)
        ray = np.array([[-1.0, 0.1, 0.1]]), np.array([[1.0, 0.0, 0.0]])
        return jv.render_rays(volume, shown, *ray, march).rgba[0, 3]

    for spacing in np.array([[0.1, 0.2, 0.4], [0.4, 0.1, 0.2]]):
        voxels = 2 * spacing[0] / np.prod(spacing) ** (1 / 3)
        np.testing.assert_allclose(opacity(spacing.astype(np.float32)), 1 - 0.7**voxels, rtol=1e-5)
    with pytest.raises(ValueError, match="functions must count lengths in world length"):
        jv.LabelTransferFunction({1: jv.TransferFunction(*POINTS, per_voxel=True)})


def test_colormaps_and_presets_can_be_made_inside_a_program():
    both = lambda: (jv.colormap("viridis", (1, 3)), jv.preset("bonsai", clim=(0, 255)))  # noqa: E731
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6), jax.jit(both)(), both())


# ---- bad input ----


WHITE, TWO, table_of = (1.0, 1.0, 1.0), np.ones((2, 3)), jv.TransferFunction
points_of = jv.TransferFunction.from_points
BAD = [
    (lambda: points_of([(0, WHITE, 0.5)]), "at least 2 control points; got 1"),
    (lambda: points_of([(1, WHITE, 0.5), (0, WHITE, 0.5)]), "values must increase.*Sort"),
    (lambda: points_of([(0, WHITE, 0.5), (1, WHITE, 1.5)]), r"opacity must be in \[0, 1\]"),
    (lambda: points_of([(0, WHITE, 0), (1, WHITE, 1)], 0), "unit_distance must be greater than 0; got 0"),
    (
        lambda: table_of([1] * 3, np.ones((3, 3)), [0] * 3),
        r"must increase.*; got \[1\. 1\. 1\.\].*no three be equal",
    ),
    (
        lambda: table_of([0, 1e39], TWO, [0, 1]),
        r"values must be finite in float32; got \[0\.e\+00 1\.e\+39\]",
    ),
    (lambda: table_of([0, 1], TWO, [0, -1]), "extinction must not be negative"),
    (lambda: table_of([0, 1], TWO, [0, np.inf]), "extinction must be finite"),
    (
        lambda: table_of([0, 1], np.ones((2, 4)), [0, 1]),
        r"colors must have shape \(2, 3\); got shape \(2, 4\)",
    ),
    (lambda: jv.colormap("redd", (0, 1)), "cmap must be a .*; got 'redd'"),
    (lambda: jv.colormap("viridi", (0, 1)), "cmap must be .*; got 'viridi'. Did you mean viridis"),
    (lambda: jv.colormap([], (0, 1)), r"cmap must be .*; got \[\]"),
    (lambda: jv.colormap([(255, 0, 0)], (0, 1)), r"cmap must be .* in \[0, 1\]; got \[\("),
    (lambda: jv.colormap("gray", (0, 1), n_colors=1), "n_colors must be an integer of at least 2"),
    (lambda: jv.colormap("gray", (0, 1), "cubic"), "opacity must be"),
    (lambda: jv.preset("ct-bnoe"), "preset must be one of ct_bone.*got 'ct-bnoe'"),
    (lambda: jv.preset("engine", clim=(5, 5)), "clim must be .*low < high"),
]


@pytest.mark.parametrize(("make", "message"), BAD, ids=[message for _, message in BAD])
def test_bad_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_points_that_lie_nearly_evenly_are_counted_exactly():
    """4096 points with slightly uneven gaps: those in the middle lie several intervals away from where evenly
    spaced ones would."""
    n = 4096
    gaps = np.where(np.arange(n - 1) < n / 2, 1 - 9e-4, 1 + 9e-4)
    values = np.concatenate([[0], np.cumsum(gaps)]).astype(np.float32)
    between = (values[1:] + values[:-1]) / 2
    found = jax.jit(lambda *given: [points_below(*given, strictly=strictly) for strictly in (False, True)])
    for each in found(values, between):
        np.testing.assert_array_equal(each, np.arange(1, n))


class Gained(Transfer):
    """A transfer function times a gain of its own: the least that a user may write."""

    function: jv.TransferFunction
    gain: jax.Array

    def classifier(self):
        classify = self.function

        def gained(measured):
            color, extinction = classify(measured[0])
            return color, self.gain * extinction

        return gained

    def __call__(self, value):
        return self.classifier()((value,))


def test_nothing_is_proven_of_a_classifier_of_ones_own():
    """It may show what the points do not. Its derivative is that of its own look-up."""
    volume = anisotropic_noise()
    blocks = Blocks.of(volume)

    @eqx.filter_jit
    def known(*of: Any):
        return [(t.visible(blocks), t.majorant(blocks)) for t in of]

    for n in (FEW, MANY):
        points = np.linspace(0, 1, n), np.full((n, 3), 0.5), np.zeros(n)
        gain, own = jax.device_put(np.float32(2)), jv.TransferFunction(*points)
        proven, (shown, bound) = jax.device_get(known(own, Gained(own, gain)))
        assert not np.any(proven[0])
        assert not np.any(proven[1])
        assert np.all(shown)
        assert np.all(np.isinf(bound))
        values = np.linspace(-0.2, 1.2, 555, dtype=np.float32)
        visible = jv.TransferFunction(*points[:2], np.linspace(1, 3, n))
        _, (expected, slope), (pulled, (of_value,)) = looked_up(Gained(visible, gain), values)
        assert float(pulled.gain) > 1
        np.testing.assert_allclose(pulled.gain, expected.gain, rtol=1e-4)
        for name in ("colors", "extinction"):
            found, want = (getattr(of.function, name) for of in (pulled, expected))
            np.testing.assert_allclose(found, want, rtol=1e-4)
        np.testing.assert_allclose(of_value, slope, rtol=1e-4)


@pytest.mark.parametrize("fast", [True, False])
def test_a_row_of_a_dozen_is_compared_with_or_looked_up(fast, monkeypatch):
    monkeypatch.setattr(piecewise_linear, "gathers_are_fast", lambda: fast)
    assert (piecewise_linear.few() == piecewise_linear.COMPARED) is fast
    at = np.linspace(0, 11, 12, dtype=np.float32)
    table = jv.TransferFunction(at, np.stack([at, at, at], -1) % 3 / 3, at % 5)
    values = np.linspace(-1, 12, 40, dtype=np.float32)
    color, extinction = jax.jit(jax.vmap(table))(values)
    np.testing.assert_allclose(extinction, np.interp(values, at, at % 5), atol=1e-6)
    np.testing.assert_allclose(color[1], np.interp(values, at, at % 3 / 3), atol=1e-6)
    shared = with_shared_points(table).values.shape[0]
    assert shared == (12 if fast else 16)
