"""Does a fit recover parameters, report their uncertainty, and go on where it was interrupted?"""

import warnings
from functools import cache
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import curve_fit, least_squares

import jaxvol as jv
from jaxvol.fitting import Outcome
from jaxvol.fitting.bijections import Bijection
from jaxvol.fitting.constraints import Free
from jaxvol.fitting.residuals import Problem
from jaxvol.metrics import psnr

from ..scenes import RESOLUTION, SIZE, rendered, soft_transfer


WIDTH, HEIGHT = SIZE
SOFT = soft_transfer(0.3)
TRUTH = jv.TransferFunction(255 * np.asarray(SOFT.values), SOFT.colors, SOFT.extinction)
GREY = jv.TransferFunction(TRUTH.values, np.full((8, 3), 0.5), np.full(8, 0.5))
MARCH = jv.March(0.2, quadrature="midpoint")
DIRECTIONS = (0.5, -1, 0.4), (-1, 0.2, 0.1)


@cache
def head():
    return jv.phantom("head", RESOLUTION)


def camera(direction, size=SIZE):
    return jv.Camera.looking_at(head(), direction, size=size)


def seen(transfer, view):
    """The scene of a transfer function."""
    return head(), transfer, view, MARCH


def image(transfer, direction):
    return np.asarray(rendered(*seen(transfer, camera(direction))).image())


@cache
def views():
    return [(camera(direction), image(TRUTH, direction)) for direction in DIRECTIONS]


BLANK = np.zeros((HEIGHT, WIDTH, 3), np.float32)

THREE_ROWS = 4 * (32 + 1) * (3 * WIDTH * 3)
"""Bytes of the Jacobian of three rows of an image: the last tile reaches past the image."""


# A residual without a volume, which compiles quickly: a saturating curve through points.
X = np.linspace(0, 3, 40, dtype=np.float32)
DATA = 2 * (1 - np.exp(-0.8 * X)) + 0.01 * np.sin(37 * X)


def curve(p):
    return p["top"] * (1 - jnp.exp(-p["rate"] * X)) - DATA


BEGIN = {"top": np.float32(1.5), "rate": np.array([0.5], np.float32)}


def fitted(start=BEGIN, **how):
    return jv.fit(curve, start, constraints=jv.Positive(), atol=1e-4, **how)


def independent():
    """The curve by SciPy: top, rate, and their covariance."""
    return curve_fit(lambda x, top, rate: top * (1 - np.exp(-rate * x)), X.astype(float), DATA, (1, 0.2))


def same(fit, other):
    """Whether two fits ended alike, to the last bit."""
    pairs = zip(jax.tree.leaves(fit.parameters), jax.tree.leaves(other.parameters), strict=True)
    ended = fit.message == other.message and np.array_equal(fit.losses, other.losses)
    return ended and all(np.array_equal(a, b) for a, b in pairs)


# -- results ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def found():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # colours at transparent points are not determined
        return jv.fit(jv.ImageResidual(seen, views()), GREY, max_steps=40, max_jacobian=THREE_ROWS)


def test_a_transfer_function_is_recovered_from_grey_and_held_out_views_agree(found):
    for direction in ((0.2, 0.9, 0.5), (1, 0.1, -0.3)):
        assert psnr(image(found.parameters, direction), image(TRUTH, direction)) > 40
        assert psnr(image(GREY, direction), image(TRUTH, direction)) < 25
    assert np.array_equal(found.parameters.values, TRUTH.values)
    assert len(found.losses) <= 40
    assert found.loss < 1e-8 < 1e-3 < found.losses[0]
    # half the mean square error
    errors = [image(GREY, at) - target for at, (_, target) in zip(DIRECTIONS, views(), strict=True)]
    assert found.losses[0] == pytest.approx(float(np.mean(np.square(errors))) / 2, rel=1e-4)


def test_a_direction_that_nothing_shows_is_named():
    """No voxel's value lies in the last interval."""
    values = [0, 40, 70, 100, 130, 170, 300, 400]
    start = jv.TransferFunction(values, GREY.colors, GREY.extinction)
    residual = jv.ImageResidual(seen, views())
    with pytest.warns(UserWarning, match=r"of 32 directions are not determined .*\.extinction\[7\]"):
        result = jv.fit(residual, start, max_steps=3, max_jacobian=THREE_ROWS)
    uncertainty = result.uncertainty
    assert uncertainty is not None
    assert [".extinction[7]"] in uncertainty.undetermined
    for name in (".extinction[7]", ".colors[7, 0]", ".colors[7, 2]"):
        assert uncertainty.standard_errors[name] == np.inf
    for name in (".extinction[3]", ".colors[3, 0]", ".extinction[6]"):
        assert np.isfinite(uncertainty.standard_errors[name])
    assert np.array_equal(np.asarray(result.parameters.extinction)[7:], np.asarray(GREY.extinction)[7:])


def test_parameters_and_covariance_are_those_of_scipy():
    """Of the parameters, not of the free numbers, whose logarithms are nearly those of positive ones."""
    result, ((top, rate), covariance) = fitted(), independent()
    assert result.success, result.message
    assert float(result.parameters["top"]) == pytest.approx(top, rel=1e-3)
    np.testing.assert_allclose(result.parameters["rate"], [rate], rtol=1e-3)
    assert result.uncertainty is not None
    assert result.uncertainty.names == ["['rate'][0]", "['top']"]
    equal = result.uncertainty.covariance_of_equal_noise
    np.testing.assert_allclose(equal, covariance[::-1, ::-1], rtol=1e-2)
    assert result.uncertainty.undetermined == []
    assert result.uncertainty.reduced_chi_squared is None


def test_standard_errors_are_those_of_unequal_noise():
    """HC1 of White (1980), MacKinnon and White (1985), in float64, at SciPy's parameters."""
    (top, rate), _ = independent()
    decay = np.exp(-rate * X.astype(float))
    jac = np.stack([top * X * decay, 1 - decay], axis=1)
    scores = jac * (top * (1 - decay) - DATA)[:, None]
    inverse = np.linalg.inv(jac.T @ jac)
    expected = inverse @ scores.T @ scores @ inverse * len(X) / (len(X) - 2)
    found = fitted().uncertainty
    assert found is not None
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-2)
    assert found.standard_errors["['top']"] == pytest.approx(expected[1, 1] ** 0.5, rel=1e-2)


@pytest.mark.parametrize("solver", ["gauss_newton", "bfgs", "adam", "dogleg"])
def test_every_solver_finds_the_same_curve(solver):
    if solver == "adam":
        pytest.importorskip("optax", reason="pip install -e '.[fit]'")
    result = fitted(solver=optx.Dogleg(1e-5, 1e-5) if solver == "dogleg" else solver, max_steps=400)
    (top, rate), _ = independent()
    close = 2e-2 if solver == "adam" else 1e-3
    assert float(result.parameters["top"]) == pytest.approx(top, rel=close)
    np.testing.assert_allclose(result.parameters["rate"], [rate], rtol=close)
    assert (result.uncertainty is None) == (solver in ("bfgs", "adam"))


def test_images_are_blurred_as_by_scipy():
    """Weights of a Gaussian over the pixels that exist, as SciPy's with zeros around, divided by its blur of
    ones, or of the weights of pixels; of images that are not square."""
    target = np.random.default_rng(0).random((HEIGHT, WIDTH, 3), np.float32)
    residual = jv.ImageResidual(seen, [(camera(DIRECTIONS[0]), target)], blur=0.1)
    weights = np.random.default_rng(1).random((HEIGHT, WIDTH)) * (np.arange(WIDTH) > 3)
    weighted = jv.ImageResidual(seen, [(camera(DIRECTIONS[0]), target)], weights=[weights])

    @eqx.filter_jit
    def entries(residual):
        ((function, items),) = residual.tiles(residual.references.size())
        return function(TRUTH, jax.tree.map(lambda leaf: leaf[0], items), "forward")

    difference = (views()[0][1] - target).astype(np.float64)
    how = {"sigma": (0.1 * HEIGHT, 0.1 * HEIGHT, 0), "mode": "constant", "truncate": 20.0}
    for each, weight in ((residual, np.ones((HEIGHT, WIDTH))), (weighted, weights)):
        weight = np.tile(weight[..., None], (1, 1, 3))
        blurred = gaussian_filter(weight * difference, **how) / gaussian_filter(weight, **how)
        for blur, expected in ((0.0, difference), (0.1, blurred)):
            expected = np.sqrt(weight / weight.sum()) * np.where(weight > 0, expected, 0)
            found = np.asarray(entries(each.blurred(blur))).reshape(expected.shape)
            np.testing.assert_allclose(found, expected, atol=1e-7)


def thicker(factor, view):
    """The scene of a factor of the true extinctions."""
    return seen(eqx.tree_at(lambda t: t.extinction, TRUTH, TRUTH.extinction * factor), view)


def test_what_a_mask_leaves_counts_as_the_cropped_image_does():
    """All that a fit, its standard errors and χ² are made of; what the mask hides is far off."""
    (view, target), (left, top) = views()[0], (6, 4)
    target = target + np.float32(0.02) * np.random.default_rng(1).normal(size=target.shape).astype("f4")
    mask = 3 * (np.indices((HEIGHT, WIDTH))[0] >= top) * (np.indices((HEIGHT, WIDTH))[1] >= left)
    wrong = np.where(mask[..., None] > 0, target, np.float32(7))
    part = view.crop(left, top, WIDTH - left, HEIGHT - top), target[top:, left:]
    free, y = Free.of(np.float32(1.2), None, None)
    triangles = eqx.filter_jit(lambda problem, y: problem.condensed(y))
    found = []

    def listed(factor, view):
        volume, transfer, *rest = thicker(factor, view)
        return [volume], [transfer], *rest

    for scene, of_view, weights in ((thicker, (view, wrong), [mask]), (listed, part, None)):
        residual = jv.ImageResidual(scene, [of_view], noise=0.02, weights=weights)
        problem = Problem.of(residual, free, y, 2**20, True)
        *factors, informed = triangles(problem, y)
        squares = [np.asarray(factor).T @ np.asarray(factor) for factor in factors]
        noise = [float(part) for part in jax.tree.leaves(residual.references.noise)[:2]]
        found.append([*squares, informed, problem.count, problem.scale, noise])
    for masked, cropped in zip(*found, strict=True):
        np.testing.assert_allclose(masked, cropped, rtol=1e-4)


@pytest.mark.slow
def test_tiles_make_no_difference_and_the_gradient_is_that_of_the_triangle():
    """Of views of two sizes, one of them with transparency."""
    small = camera((0.2, 0.9, 0.5), (10, 8))
    residual = jv.ImageResidual(seen, [*views(), (small, jv.render(*seen(TRUTH, small)).rgba)])
    assert residual.references.count == 2 * WIDTH * HEIGHT * 3 + 10 * 8 * 4
    free, y = Free.of(GREY, None, None)
    triangles = eqx.filter_jit(lambda problem, y: problem.condensed(y))
    (whole, scores), (tiled, of_tiles) = (
        [np.asarray(each, np.float64) for each in triangles(of_tile, y)]
        for of_tile in (
            Problem(residual, free, residual.references.count, t, True)
            for t in (residual.references.count, 3 * WIDTH * 3)
        )
    )
    np.testing.assert_allclose(tiled, whole, rtol=0, atol=2e-6 * abs(whole).max())
    scores, of_tiles = scores.T @ scores, of_tiles.T @ of_tiles  # the rows' signs are arbitrary
    np.testing.assert_allclose(of_tiles, scores, rtol=0, atol=1e-5 * abs(scores).max())
    problem = Problem(residual, free, residual.references.count, residual.references.count, False)
    gradient = eqx.filter_jit(lambda p, y: jax.grad(p.loss)(y))(problem, y)
    flat = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(gradient)])
    np.testing.assert_allclose(whole[:, :-1].T @ whole[:, -1], flat, rtol=0, atol=1e-5 * abs(flat).max())


@pytest.mark.slow
def test_colours_are_recovered_from_the_first_visible_samples():
    """Extinctions, which do not show, are fixed."""
    how = jv.FirstVisible()
    targets = [(view, jv.render(*seen(TRUTH, view), compositing=how).image()) for view, _ in views()]
    residual = jv.ImageResidual(seen, targets, compositing=how)
    start = eqx.tree_at(lambda t: t.colors, TRUTH, jnp.full_like(TRUTH.colors, 0.5))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # colours of invisible points do not show either
        found = jv.fit(residual, start, where=lambda t: t.colors, max_steps=20)
    assert found.loss < 1e-6 * found.losses[0]


@pytest.mark.slow
def test_a_pose_is_found_from_ten_degrees_and_five_percent_off():
    truth = jv.Camera((1.5, -4.0, 0.8), (0.05, 0.0, -0.1), (0.1, 0.0, 1.0), size=(48, 40))
    volume = jv.phantom("head", 32)
    march = jv.March(0.04, (jv.AlphaCorrection(),), "midpoint")  # or the camera's gradient would miss jumps
    target = jv.render(volume, TRUTH, truth, march).image()
    turn = np.deg2rad(10) * np.asarray([0.48, -0.6, 0.64])
    off = {"rotation": jnp.asarray(turn, jnp.float32), "translation": jnp.asarray([0.03, -0.03, 0.0265])}
    residual = jv.ImageResidual(lambda camera, _: (volume, TRUTH, camera, march), [(truth, target)])
    result = jv.fit(residual, jv.Pose(truth).forward(off), max_steps=40)
    back = jv.Pose(truth).inverse(result.parameters)
    assert np.rad2deg(np.linalg.norm(back["rotation"])) < 0.05
    assert np.linalg.norm(back["translation"]) < 1e-3


# -- free parameters --------------------------------------------------------------------------------------


def kinds_of(free):
    named = {p: type(b).__name__ for p, b in zip(free.paths, free.bijections, strict=True)}
    return {p.removeprefix("parameters"): kind for p, kind in named.items() if kind != "Fixed"}


def test_what_is_free_and_how_by_default():
    volume = jv.Volume(np.ones((2, 2, 2), np.float32))
    scene = {"c": camera(DIRECTIONS[0]), "v": volume, "b": head(), "t": TRUTH, "m": MARCH, "f": 2.0}
    free, y = Free.of(scene, None, None)
    assert kinds_of(free) == {
        "['c']": "Pose",
        "['f']": "Unconstrained",
        "['t'].colors": "UnitInterval",
        "['t'].extinction": "Positive",
        "['v'].data": "Unconstrained",
    }
    assert np.all(np.asarray(free.forward(y)["t"].extinction) > 0)


def test_where_and_constraints_choose_what_is_free():
    gain = jax.device_put(np.ones(2, np.float32))
    parameters = {"transfer": TRUTH, "gain": gain, "name": "head", "count": 3}
    free, y = Free.of(parameters, None, lambda p: (p["transfer"].extinction, p["gain"]))
    assert [leaf.shape for leaf in jax.tree.leaves(y)] == [(2,), (8,)]
    back = free.forward(y)
    assert (back["name"], back["count"]) == ("head", 3)
    assert np.array_equal(back["transfer"].colors, TRUTH.colors)
    # constraints may be the beginning of a tree
    free, _ = Free.of({"a": TRUTH, "b": (1.0, 2.0)}, {"a": None, "b": jv.Positive()}, None)
    assert all(isinstance(b, Bijection) for b in free.bijections)
    assert list(kinds_of(free).values()) == ["UnitInterval", "Positive", "Positive", "Positive"]


# -- bad input --------------------------------------------------------------------------------------------


def unreachable(parameters):
    raise AssertionError("the residual was called before the arguments were checked")


def images(image: Any = BLANK, view=None, scene: Any = seen, **how):
    return jv.ImageResidual(scene, [(camera(DIRECTIONS[0]) if view is None else view, image)], **how)


def of_curve(residual=curve, start=BEGIN, **how):
    return lambda: jv.fit(residual, start, **how)


def of_images(scene=seen, max_jacobian=2**30, **how):
    return lambda: jv.fit(images(scene=scene, **how), GREY, max_jacobian=max_jacobian)


HERE = Path(__file__).parent
BAD = [
    (lambda: images(BLANK[:4]), r"views\[0\].*\(16, 20, n\).*\(4, 20, 3\)"),
    (lambda: images(BLANK[..., :2]), r"views\[0\].* must have 3 channels, or those of .*rgba; got 2"),
    (of_images(image=BLANK[..., [0, 1, 2, 0, 1]]), r"channels of Rendering\.rgba; got 4 .* 5 of the view"),
    (lambda: images(BLANK * np.nan), r"views\[0\].* must be finite"),
    (lambda: images(BLANK.astype(np.uint8)), r"views\[0\]: .*, floats .*; got uint8.*from_srgb"),
    (lambda: images(view=1), r"views\[0\] must be a pair .*got a tuple"),
    (lambda: images(scene=3), "scene must be a function"),
    (lambda: images(scene=lambda transfer: transfer), r"scene must be a function of \(parameters, camera\)"),
    (lambda: images(blur=-0.1), "blur must not be negative"),
    (lambda: images(noise=-0.1), "noise must not be negative; got -0.1"),
    (
        lambda: images(noise=BLANK),
        r"noise must be a number, or a list with an entry for each of 1 views; got",
    ),
    (lambda: images(noise=[0.1, 0.1]), "noise must be .* each of 1 views; got a list of length 2"),
    (
        lambda: images(noise=[BLANK[:4]]),
        r"noise\[0\] .* like its image, \(16, 20, 3\); got shape \(4, 20, 3\)",
    ),
    (lambda: images(noise=[np.inf]), r"noise\[0\] must be finite; got inf"),
    (lambda: images(weights=[-BLANK - 1]), r"weights\[0\] must not be negative"),
    (lambda: images(weights=[np.nan]), r"weights\[0\] must be finite"),
    (lambda: images(weights=[BLANK]), "weights must be positive for one pixel at least; got 0 for all"),
    (lambda: images(weights=[BLANK[:4, :, 0]]), r"weights\[0\] must be .* got shape \(4, 20\)"),
    (lambda: jv.ImageResidual(seen, []), "views must hold at least one pair"),
    (lambda: jv.ImageResidual(seen, [BLANK]), r"views\[0\] must be a pair"),
    (
        of_images(lambda t, c: (head(), t, c)),
        r"scene must return \(volume, .* got a tuple of length 3",
    ),
    (
        of_images(lambda t, c: (head(), c, t, MARCH)),
        "transfer must be .* That is the camera",
    ),
    (of_images(lambda t, c: seen(t, c.crop(0, 0, 2, 2))), r"view's size \(20, 16\); got \(2, 2\)"),
    (of_images(max_jacobian=THREE_ROWS, blur=0.1), "one blurred image has 960"),
    (of_images(max_jacobian=100), "max_jacobian must hold the triangle"),
    (of_images(max_jacobian=5000), "one row of an image has 60"),
    (of_curve(unreachable, checkpoint="/dev/null/a"), "checkpoint: /dev/null/a .*null is not a folder"),
    (of_curve(unreachable, checkpoint=HERE), "checkpoint: .*fitting cannot be written .it is a folder"),
    (of_curve(BLANK), "residual must be an ImageResidual, or a function"),
    (of_curve(GREY), r"residual .*; got a TransferFunction\. The order is fit\(residual, parameters\)"),
    (of_curve(lambda p: jnp.zeros(0)), "residual must return at least one number"),
    (of_curve(start={**BEGIN, "top": np.float32(np.nan)}), r"parameters\['top'\] must be finite"),
    (of_curve(start={"a": -1.0}, constraints=jv.Positive()), r"parameters\['a'\] must not be negative"),
    (lambda: fitted({**BEGIN, "top": np.float32(3e38)}), "residual must be finite at the parameters that"),
    (of_curve(start={"name": "x"}), "parameters must hold a float array that is free"),
    (of_curve(constraints={"tap": None}), "constraints must be a tree like"),
    (of_curve(constraints={"top": 1.0, "rate": None}), "constraints must hold bijections"),
    (of_curve(where=lambda p: p["tap"]), "where must return parts"),
    (of_curve(solver="newton"), "solver must be one of levenberg.*'newton'"),
    (of_curve(max_steps=0), "max_steps must be an integer of at least 1"),
    (of_curve(rtol=-1), "rtol must not be negative; got -1"),
    (of_curve(max_jacobian=100), "max_jacobian leaves room for 8 of the"),
]


@pytest.mark.parametrize(("call", "message"), BAD)
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# -- fits that fail ---------------------------------------------------------------------------------------


def test_running_out_of_steps_is_told():
    result = fitted(max_steps=2)
    assert not result.success
    assert result.solution.result == Outcome.nonlinear_max_steps_reached
    assert "maximum number of steps" in result.message
    assert len(result.losses) == 2


def test_a_derivative_that_leads_uphill_stalls():
    @jax.custom_jvp
    def f(p):
        return p - 3.0

    f.defjvp(lambda primal, tangent: (f(*primal), -tangent[0]))
    result = jv.fit(f, np.ones(1, np.float32), max_steps=60)
    assert not result.success
    assert "No step lowered the loss" in result.message
    np.testing.assert_allclose(result.parameters, [1], atol=1e-6)


def test_what_diverges_gives_back_the_best_seen():
    """From 2, Gauss–Newton steps on the arctangent diverge, each farther than the one before."""
    result = jv.fit(jnp.arctan, np.float32([2]), solver="gauss_newton", max_steps=50)
    assert not result.success
    assert result.message
    assert np.asarray(result.parameters) == 2
    assert result.loss == pytest.approx(float(np.arctan(2) ** 2 / 2))


def test_a_loss_that_is_not_finite_ends_a_fit():
    optax = pytest.importorskip("optax", reason="pip install -e '.[fit]'")
    result = jv.fit(jnp.log, np.float32([4]), solver=optax.sgd(15.0), max_steps=50)
    assert result.solution.result == Outcome.nonfinite
    assert "Nonfinite" in result.message
    assert np.asarray(result.parameters) == 4


def test_a_step_to_where_the_residual_is_not_finite_is_taken_back():
    """One parameter for one residual: its variance remains unknown."""
    result = jv.fit(lambda p: jnp.sqrt(p) - 0.1, np.float32([4]), max_steps=50)
    assert result.success
    np.testing.assert_allclose(result.parameters, [0.01], rtol=1e-3)
    assert result.uncertainty is not None
    assert np.all(result.uncertainty.covariance == np.inf)


def test_a_fit_to_noise_ends_at_the_minimum():
    """Within a small part of a standard error of it, and without steps that change nothing."""
    x = np.linspace(0, 1, 200)
    noisy = np.exp(-3 * x) + np.random.default_rng(0).normal(0, 0.05, x.shape)

    def residual(rate):
        return jnp.exp(-rate * x) - noisy

    fit = jv.fit(residual, np.float32(1))
    assert fit.success
    assert len(fit.losses) <= 8
    exact = least_squares(lambda rate: np.exp(-rate * x) - noisy, 1.0, xtol=1e-12).x[0]
    assert fit.uncertainty is not None
    (error,) = fit.uncertainty.standard_errors.values()
    assert abs(float(fit.parameters) - exact) < 0.05 * error


def test_the_callback_is_told_every_step():
    calls = []
    result = fitted(callback=lambda *a: calls.append(a))
    assert [step for step, _, _ in calls] == list(range(2, len(result.losses) + 1))
    assert [loss for _, _, loss in calls] == list(result.losses[1:])
    step = {name: np.asarray(value) for name, value in calls[-1][1].items()}
    residual = step["top"] * (1 - np.exp(-step["rate"] * X)) - DATA
    assert np.sum(residual**2) / 2 == pytest.approx(calls[-1][2], rel=1e-3)


# -- checkpoints ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", ["levenberg_marquardt", "bfgs"])
def test_a_fit_that_is_interrupted_goes_on_to_the_same_bits(solver, tmp_path):
    """By Ctrl-C, or by any other error."""
    stop = KeyboardInterrupt if solver == "bfgs" else RuntimeError

    def broken_off(step, parameters, loss):
        if step == 4:
            raise stop

    file, steps, how = tmp_path / "folder" / "a", [], {"solver": solver, "max_steps": 30}
    whole = fitted(**how)
    with pytest.raises(stop):
        fitted(checkpoint=file, callback=broken_off, **how)
    again = fitted(checkpoint=file, callback=lambda *a: steps.append(a[0]), **how)
    assert steps[0] == 5
    assert same(again, whole)
    # what has ended is not fitted again
    assert same(fitted(checkpoint=file, callback=lambda *a: steps.append(0), **how), whole)
    assert 0 not in steps


DAMAGE = {
    "truncated": lambda content: content[: len(content) // 2],
    "empty": lambda content: b"",
    "another file": lambda content: b"not a checkpoint at all",
}


def test_a_damaged_checkpoint_is_named_and_not_used(tmp_path):
    file = tmp_path / "curve.ckpt"
    whole = fitted(checkpoint=file)
    content = file.read_bytes()
    for damage in DAMAGE.values():
        file.write_bytes(damage(content))
        with pytest.raises(ValueError, match=r"checkpoint .*curve\.ckpt is damaged"):
            fitted(checkpoint=file)
    file.write_bytes(content)
    assert same(fitted(checkpoint=file), whole)


def test_a_checkpoint_of_another_fit_is_refused(tmp_path):
    file = tmp_path / "a.ckpt"
    fitted(checkpoint=file, max_steps=2)
    for what, how in {
        "solver": {"solver": "bfgs"},
        "loss at the start": {"start": {**BEGIN, "top": np.float32(1.2)}},
    }.items():
        with pytest.raises(ValueError, match=f"belongs to another fit: its {what} is"):
            fitted(checkpoint=file, **how)
