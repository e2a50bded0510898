"""Colour and extinction between control points; presets, colormaps, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv


def evaluate(transfer, values):
    color, extinction = jax.vmap(transfer)(jnp.asarray(values, jnp.float32))
    return np.stack(color, axis=-1), np.asarray(extinction)


@pytest.mark.parametrize("n", [2, 9, 256])
def test_linear_between_points_and_constant_beyond_the_ends(n):
    random = np.random.default_rng(n)
    values = np.sort(random.uniform(-500, 1500, n))
    colors, extinction = random.random((n, 3)), random.random(n)
    transfer = jv.TransferFunction(values, colors, extinction)
    where = np.concatenate([np.linspace(-1000, 2000, 997), values]).astype(np.float32)
    color, sigma = evaluate(transfer, where)
    np.testing.assert_allclose(sigma, np.interp(where, values, extinction), atol=2e-4)
    for channel in range(3):
        np.testing.assert_allclose(color[:, channel], np.interp(where, values, colors[:, channel]), atol=2e-4)


def test_opacity_of_a_unit_distance_converts_exactly():
    opacities = [0.0, 0.1, 0.5, 0.9]
    points = [(float(i), (1, 1, 1), a) for i, a in enumerate(opacities)]
    transfer = jv.TransferFunction.from_points(points, unit_distance=2.5)
    np.testing.assert_allclose(transfer.opacity(2.5), opacities, atol=1e-7)
    # half the distance: 1 - sqrt(1 - a)
    np.testing.assert_allclose(transfer.opacity(1.25), 1 - np.sqrt(1 - np.array(opacities)), atol=1e-7)


def test_opacity_one_is_the_largest_float_below():
    transfer = jv.TransferFunction.from_points([(0, (1, 1, 1), 0.0), (1, (1, 1, 1), 1.0)])
    assert np.isfinite(transfer.extinction).all()
    assert 1 - float(transfer.opacity()[1]) <= 2**-23


def test_zero_extinction_is_exactly_transparent():
    transfer = jv.TransferFunction([0, 1, 2, 3], np.ones((4, 3)), [0, 0, 1, 0])
    _, sigma = evaluate(transfer, np.linspace(-1, 1, 101))
    assert (sigma == 0).all()


def test_colors_and_extinction_carry_gradients_and_values_none():
    transfer = jv.TransferFunction([0.0, 1.0, 3.0], np.ones((3, 3)), [0.0, 1.0, 2.0])
    gradient = jax.grad(lambda t: t(jnp.float32(1.5))[1] + 2 * t(jnp.float32(1.5))[0][1])(transfer)
    np.testing.assert_allclose(gradient.extinction, [0, 0.75, 0.25], atol=1e-6)
    np.testing.assert_allclose(gradient.colors[:, 1], [0, 1.5, 0.5], atol=1e-6)
    np.testing.assert_array_equal(gradient.values, 0)


@pytest.mark.parametrize("name", jv.PRESETS)
def test_presets_show_something_and_hide_something(name):
    transfer = jv.preset(name)
    assert float(transfer.extinction.max()) > 0.3
    assert float(transfer.extinction[0]) == 0
    low, high = jv.PRESETS[name][1]
    stretched = jv.preset(name, clim=(0, 4000), unit_distance=2.0)
    where = np.linspace(low, high, 50)
    expected = evaluate(transfer, where)[1] / 2
    np.testing.assert_allclose(
        evaluate(stretched, (where - low) / (high - low) * 4000)[1], expected, rtol=2e-3, atol=1e-5
    )


def test_colormap_has_the_colours_of_matplotlib_in_linear_light():
    import matplotlib

    transfer = jv.colormap("viridis", (0, 255), "linear")
    display = np.asarray(jv.to_srgb(transfer.colors))
    np.testing.assert_allclose(
        display, matplotlib.colormaps["viridis"](np.linspace(0, 1, 256))[:, :3], atol=1e-5
    )
    np.testing.assert_allclose(transfer.opacity()[:-1], np.linspace(0, 1, 256)[:-1], atol=1e-6)


def test_opacity_ramps():
    sigmoid = jv.colormap("gray", (0, 1), "sigmoid", n_colors=101).opacity()
    np.testing.assert_allclose(sigmoid[50], 0.5, atol=1e-6)
    np.testing.assert_allclose(sigmoid + sigmoid[::-1], 1, atol=1e-6)
    given = jv.colormap("gray", (0, 1), [0.0, 0.8, 0.2], n_colors=5).opacity()
    np.testing.assert_allclose(given, [0, 0.4, 0.8, 0.5, 0.2], atol=1e-6)


white = (1.0, 1.0, 1.0)
BAD = {
    "a single point": (
        lambda: jv.TransferFunction.from_points([(0, white, 0.5)]),
        "at least 2 control points; got 1",
    ),
    "no points": (lambda: jv.TransferFunction.from_points([]), "points must be triples"),
    "unsorted": (
        lambda: jv.TransferFunction.from_points([(1, white, 0.5), (0, white, 0.5)]),
        "values must increase.*Sort",
    ),
    "equal": (lambda: jv.TransferFunction([1, 1], np.ones((2, 3)), [0, 0]), "values must increase"),
    "opacity above 1": (
        lambda: jv.TransferFunction.from_points([(0, white, 0.5), (1, white, 1.5)]),
        r"opacity must be in \[0, 1\]",
    ),
    "negative opacity": (
        lambda: jv.TransferFunction.from_points([(0, white, -0.1), (1, white, 1)]),
        r"opacity must be in \[0, 1\]",
    ),
    "negative extinction": (
        lambda: jv.TransferFunction([0, 1], np.ones((2, 3)), [0, -1]),
        "extinction must not be negative",
    ),
    "infinite extinction": (
        lambda: jv.TransferFunction([0, 1], np.ones((2, 3)), [0, np.inf]),
        "extinction must be finite",
    ),
    "NaN value": (lambda: jv.TransferFunction([0, np.nan], np.ones((2, 3)), [0, 1]), "values must be finite"),
    "four channels": (
        lambda: jv.TransferFunction([0, 1], np.ones((2, 4)), [0, 1]),
        r"colors must have shape \(2, 3\); got shape \(2, 4\)",
    ),
    "no unit distance": (
        lambda: jv.TransferFunction.from_points([(0, white, 0), (1, white, 1)], unit_distance=0),
        "unit_distance must be greater than 0; got 0",
    ),
    "unknown preset": (lambda: jv.preset("ct-bone"), "preset must be one of ct_bone.*got 'ct-bone'"),
    "unknown colormap": (
        lambda: jv.colormap("viridi", (0, 1)),
        "cmap must be a matplotlib colormap; got 'viridi'",
    ),
    "unknown ramp": (lambda: jv.colormap("gray", (0, 1), "cubic"), "opacity must be"),
    "ramp above 1": (lambda: jv.colormap("gray", (0, 1), [0, 2]), r"opacity must be in \[0, 1\]"),
    "clim": (lambda: jv.preset("engine", clim=(5, 5)), "clim must be .*low < high"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    make, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        make()
