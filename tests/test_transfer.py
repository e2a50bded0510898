"""Colour and extinction between control points; presets, colormaps, and invalid arguments."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol._util.piecewise_linear import points_below, positive_between
from jaxvol.occupancy import Blocks
from jaxvol.variation import Windows


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


def test_numbers_of_any_library_are_taken():
    plain = jv.TransferFunction.from_points([(0, (1, 0, 0), 0), (2, (0, 0, 1), 0.5)], 2)
    mixed = jv.TransferFunction.from_points(
        [(np.int16(0), [1, 0, 0], jnp.zeros(())), (jnp.float32(2), np.array([0, 0, 1]), np.float64(0.5))],
        jnp.asarray(2.0),
    )
    for one, other in zip(jax.tree.leaves(plain), jax.tree.leaves(mixed), strict=True):
        np.testing.assert_array_equal(one, other)


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


def test_colormaps_and_presets_can_be_made_inside_a_program():
    for make in (lambda: jv.colormap("viridis", (1, 3)), lambda: jv.preset("bonsai", clim=(0, 255))):
        jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6), jax.jit(make)(), make())


def test_colours_make_colormaps():
    import matplotlib

    def display(cmap):
        return np.asarray(jv.to_srgb(jv.colormap(cmap, (0, 1), n_colors=5).colors))

    tomato = np.array([255, 99, 71]) / 255
    for one in ("tomato", "#ff6347", tuple(tomato), [tomato], np.array([tomato]), [jnp.asarray(tomato)]):
        np.testing.assert_allclose(display(one), np.tile(tomato, (5, 1)), atol=1e-6)
    expected = [(1, 0, 0), (0.5, 0, 0.5), (0, 0, 1), (0, 0.5, 0.5), (0, 1, 0)]
    for three in (["red", "b", "#00ff00"], np.array([(1, 0, 0), (0, 0, 1), (0, 1, 0)])):
        np.testing.assert_allclose(display(three), expected, atol=1e-6)
    np.testing.assert_array_equal(display(matplotlib.colormaps["magma"]), display("magma"))


STEPS = {
    "a step up": ([60.0, 60.0], [0.0, 0.5]),
    "between others": ([20.0, 60.0, 60.0, 200.0], [0.1, 0.2, 0.7, 0.3]),
    "a step down at the end": ([20.0, 60.0, 60.0], [0.0, 0.4, 0.0]),
    "many points": (np.sort([*np.arange(20.0), 7.0, 12.0]), np.linspace(0.1, 0.9, 22)),
}


@pytest.mark.parametrize("case", STEPS)
def test_two_equal_points_are_a_step(case):
    values, extinction = (np.asarray(part, np.float32) for part in STEPS[case])
    colors = np.linspace(0, 1, 3 * len(values)).reshape(-1, 3)
    transfer = jv.TransferFunction(values, colors, extinction)
    for at in np.flatnonzero(values[1:] == values[:-1]):
        step = values[at]
        below, there, above = (np.nextafter(step, step + side) for side in (-1, 0, 1))
        color, sigma = evaluate(transfer, [below, there, above])
        np.testing.assert_allclose(sigma, extinction[[at, at + 1, at + 1]], rtol=1e-5)
        np.testing.assert_allclose(color, colors[[at, at + 1, at + 1]], rtol=1e-5)
    # everywhere else as without steps; at a step, numpy also takes the second point
    where = np.concatenate([np.linspace(-10, 260, 541), values]).astype(np.float32)
    inside = where >= values[0]
    expected = np.where(inside, np.interp(where, values, extinction), extinction[0])
    if values[-1] == values[-2]:
        expected = np.where(where >= values[-1], extinction[-1], expected)
    np.testing.assert_allclose(evaluate(transfer, where)[1], expected, atol=1e-5)


@pytest.mark.parametrize("case", STEPS)
def test_the_derivative_at_a_step_is_finite_and_that_of_jax(case):
    values, extinction = (np.asarray(part, np.float32) for part in STEPS[case])
    transfer = jv.TransferFunction(values, np.linspace(0, 1, 3 * len(values)).reshape(-1, 3), extinction)
    where = jnp.asarray(np.concatenate([np.linspace(-10, 260, 541), values]), jnp.float32)

    def summed(transfer, where):
        (r, g, b), sigma = jax.vmap(transfer)(where)
        return jnp.sum(r + 2 * g + 3 * b + 4 * sigma)

    expected, slope = jax.jit(jax.grad(summed, (0, 1)))(transfer, where)
    search, one = transfer.search(), jnp.ones_like(where)
    measured = (where,) if search is None else (where, *jax.vmap(lambda v: search((v,)))(where))
    pull = jax.jit(lambda transfer, *given: transfer.pull(*given))
    found, (of_value, *_) = pull(transfer, measured, (one, 2 * one, 3 * one), 4 * one)
    for name in ("colors", "extinction"):
        assert np.isfinite(getattr(found, name)).all()
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(of_value, slope, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("many", [False, True])
def test_visibility_of_ranges_at_a_step(many):
    """For ranges that end or begin exactly at a step, the second point counts and the first one does not."""
    filler = np.linspace(80, 255, 20) if many else [255.0]
    up = jv.TransferFunction(
        [0, 60, 60, *filler], np.ones((3 + len(filler), 3)), [0, 0, 1, *np.ones(len(filler))]
    )
    down = jv.TransferFunction(up.values, up.colors, [1, 1, 0, *np.zeros(len(filler))])
    low, high = np.meshgrid(np.arange(50.0, 71), np.arange(50.0, 71), indexing="ij")
    for transfer in (up, down):
        seen = positive_between(transfer.values, transfer.extinction, jnp.asarray(low), jnp.asarray(high))
        dense = evaluate(transfer, np.linspace(50, 70, 2001).astype(np.float32))[1] > 0
        for i, j in zip(*np.nonzero(high >= low), strict=True):
            within = slice(int(low[i, j] - 50) * 100, int(high[i, j] - 50) * 100 + 1)
            assert seen[i, j] == dense[within].any(), (low[i, j], high[i, j])


@pytest.mark.slow
def test_a_step_is_rendered_and_differentiated_alike_with_and_without_leaps():
    data = np.zeros((24, 20, 20), np.uint8)
    data[4:9, 5:15, 5:15] = 100
    data[15:20, 8:12, 3:12] = 200
    volume = jv.Volume(data)
    step = jv.TransferFunction.from_points(
        [(0, (0, 0, 0), 0), (60, (0.1, 0.2, 0.9), 0), (60, (0.9, 0.5, 0.1), 0.3), (255, (1, 1, 1), 0.6)]
    )
    camera = jv.Camera.looking_at(volume, (1, 0.3, 0.2), size=(24, 24)).zoom(1.6)
    leaping, plain = jv.March(0.5, (jv.SpaceLeaping(),)), jv.March(0.5)

    def image(transfer, march, adjoint="replay"):
        return jv.render(volume, transfer, camera, march, outputs="rgba", adjoint=adjoint).rgba

    def loss(transfer, march, adjoint="replay"):
        rgba = image(transfer, march, adjoint)
        return jnp.sum(rgba**2), rgba

    # any direction without extinctions of 0, whose derivatives leaping omits
    random = np.random.default_rng(0)
    ways = jv.TransferFunction(
        step.values, random.random((4, 3)), np.sign(np.asarray(step.extinction)) * random.random(4)
    )
    ways = eqx.tree_at(lambda t: t.values, ways, jnp.zeros(4))

    def forward(transfer):
        """Slope and image, from one program."""
        return jax.jvp(lambda t: loss(t, plain, "forward"), (transfer,), (ways,), has_aux=True)[1:]

    gradient, rgba = jax.grad(loss, has_aux=True)(step, leaping)
    slope, whole = forward(step)
    np.testing.assert_allclose(rgba, whole, atol=2e-6)
    assert 0.1 < float((rgba[..., 3] > 0).mean()) < 0.9
    # compare with the steepest ramp that needs no step
    ramp = jv.TransferFunction([0, np.nextafter(np.float32(60), 0), 60, 255], step.colors, step.extinction)
    np.testing.assert_allclose(rgba, forward(ramp)[1], atol=1e-5)
    assert np.isfinite(gradient.extinction).all()
    products = [jnp.vdot(a, b) for a, b in zip(*map(jax.tree.leaves, (gradient, ways)), strict=True)]
    np.testing.assert_allclose(sum(products), slope, rtol=1e-4)


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
    "three equal": (
        lambda: jv.TransferFunction([1, 1, 1], np.ones((3, 3)), [0, 0, 0]),
        r"values must increase.*; got \[1\. 1\. 1\.\].*no three be equal",
    ),
    "points that are colours": (
        lambda: jv.TransferFunction.from_points([(0, "red", 0), (1, "red", 1)]),
        r"colors must be numbers of shape \(2, 3\)",
    ),
    "no colour": (lambda: jv.colormap("redd", (0, 1)), "cmap must be a .*; got 'redd'"),
    "no colours": (lambda: jv.colormap([], (0, 1)), r"cmap must be .*; got \[\]"),
    "colours of 8 bits": (
        lambda: jv.colormap([(255, 0, 0)], (0, 1)),
        r"cmap must be .* in \[0, 1\]; got \[\(",
    ),
    "a number": (lambda: jv.colormap(3, (0, 1)), "cmap must be .*; got 3"),
    "n_colors": (
        lambda: jv.colormap("gray", (0, 1), n_colors=1),
        "n_colors must be an integer of at least 2",
    ),
    "beyond float32": (
        lambda: jv.TransferFunction([0, 1e39], np.ones((2, 3)), [0, 1]),
        r"values must be finite in float32; got \[0\.e\+00 1\.e\+39\]",
    ),
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
    "a list for a preset": (lambda: jv.preset(["engine"]), r"preset must be one of .*; got \['engine'\]"),
    "unknown colormap": (
        lambda: jv.colormap("viridi", (0, 1)),
        r"cmap must be a matplotlib colormap .*; got 'viridi'\. Did you mean viridis",
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


def test_points_that_lie_nearly_evenly_are_counted_exactly():
    """4096 points with slightly uneven gaps: those in the middle lie several intervals away from where evenly
    spaced ones would."""
    n = 4096
    gaps = np.where(np.arange(n - 1) < n / 2, 1 - 9e-4, 1 + 9e-4)
    values = np.concatenate([[0], np.cumsum(gaps)]).astype(np.float32)
    between = (values[1:] + values[:-1]) / 2
    for strictly in (False, True):
        found = points_below(jnp.asarray(values), jnp.asarray(between), strictly=strictly)
        np.testing.assert_array_equal(found, np.arange(1, n))


class Gained(jv.TransferFunction):
    """Multiplies its extinction by a leaf of its own."""

    gain: jax.Array

    def __init__(self, *points):
        super().__init__(*points)
        self.gain = jnp.asarray(2.0)

    def classifier(self):
        classify = super().classifier()

        def gained(measured):
            color, extinction = classify(measured)
            return color, self.gain * extinction

        return gained


def test_nothing_is_proven_of_a_classifier_of_ones_own():
    """It may show what the points do not."""
    points = np.linspace(0, 1, 4), np.full((4, 3), 0.5), np.zeros(4)
    volume = jv.Volume(np.random.default_rng(0).random((9, 9, 9), np.float32))
    blocks, windows = Blocks.of(volume), Windows.of(volume)
    plain, gained = jv.TransferFunction(*points), Gained(*points)
    assert not np.any(plain.visible(blocks))
    assert not np.any(plain.majorant(blocks))
    assert np.all(plain.variation(windows).total == 0)
    assert np.all(gained.visible(blocks))
    assert np.all(np.isinf(gained.majorant(blocks)))
    assert np.all(np.isinf(gained.variation(windows).total))


def test_vjp_of_a_custom_transfer_function_matches_its_look_up():
    for n in (4, 40):
        function = Gained(np.linspace(0, 1, n), np.full((n, 3), 0.5), np.linspace(1, 3, n))
        value = jnp.asarray([0.1, 0.45, 0.8])

        @jax.jit
        def pull(function, value):
            search, ones = function.search(), jnp.ones(3)
            measured = (value,) if search is None else (value, *search((value,)))
            return function.pull(measured, (0 * ones,) * 3, ones)

        pulled, (of_value, *_) = pull(function, value)
        np.testing.assert_allclose(pulled.gain, np.sum(1 + 2 * value), rtol=1e-5)
        np.testing.assert_allclose(jnp.sum(pulled.extinction), 2 * 3, rtol=1e-5)
        np.testing.assert_allclose(of_value, 2 * 2, rtol=1e-4)
