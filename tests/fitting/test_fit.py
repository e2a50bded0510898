"""Does a fit recover parameters, report their uncertainty correctly, and resume after it was killed?"""

import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import jaxvol as jv
from jaxvol.fitting import Outcome, checkpoints
from jaxvol.fitting.bijections import Bijection
from jaxvol.fitting.constraints import Free
from jaxvol.fitting.residuals import OwnResidual, Problem
from jaxvol.fitting.uncertainty import Uncertainty
from jaxvol.metrics import psnr

from ..scenes import in_float64


SIZE = (24, 20)
POINTS = [
    (0, (0.1, 0.2, 0.9), 0.0),
    (40, (0.2, 0.3, 0.8), 0.0),
    (70, (0.8, 0.5, 0.3), 0.1),
    (100, (0.9, 0.4, 0.1), 0.3),
    (130, (0.9, 0.8, 0.2), 0.2),
    (170, (0.6, 0.6, 0.6), 0.6),
    (210, (0.9, 0.9, 0.9), 0.8),
    (255, (1.0, 1.0, 1.0), 0.9),
]
HEAD = jv.phantom("head", 24)
MARCH = jv.March(0.05, (jv.AlphaCorrection(),), "midpoint")
TRUTH = jv.TransferFunction.from_points(POINTS, unit_distance=0.3)
GREY = jv.TransferFunction(TRUTH.values, np.full((8, 3), 0.5), np.full(8, 0.5))


def camera(direction, size=SIZE):
    return jv.Camera.looking_at(HEAD, direction, size=size)


def image(transfer, view):
    return jv.render(HEAD, transfer, view, MARCH).image()


def seen(transfer, view):
    """The scene of a transfer function."""
    return HEAD, transfer, view, MARCH


CAMERAS = [camera((0.5, -1, 0.4)), camera((-1, 0.2, 0.1))]
VIEWS = [(view, image(TRUTH, view)) for view in CAMERAS]
RESIDUAL = jv.ImageResidual(seen, VIEWS)


@eqx.filter_jit
def triangle(problem, y):
    return problem.condensed(y)


def same(tree, other):
    """Whether two trees are equal to the last bit."""
    return all(
        np.array_equal(a, b) for a, b in zip(jax.tree.leaves(tree), jax.tree.leaves(other), strict=True)
    )


# A residual without a volume, which compiles quickly: a saturating curve through points.
X = jnp.linspace(0, 3, 40)
CURVE = {"top": jnp.asarray(2.0), "rate": jnp.asarray([0.8])}
DATA = CURVE["top"] * (1 - jnp.exp(-CURVE["rate"] * X)) + 0.01 * jnp.sin(37 * X)


def curve(p):
    return p["top"] * (1 - jnp.exp(-p["rate"] * X)) - DATA


BEGIN = {"top": jnp.asarray(1.5), "rate": jnp.asarray([0.5])}


# results of fits


@pytest.fixture(scope="module")
def found():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # colours at transparent points are not determined
        return jv.fit(RESIDUAL, GREY, max_steps=40)


def test_a_transfer_function_is_recovered_from_grey_and_held_out_views_agree(found):
    for direction in ((0.2, 0.9, 0.5), (1, 0.1, -0.3)):
        view = camera(direction)
        assert psnr(image(found.parameters, view), image(TRUTH, view)) > 40
    assert psnr(image(GREY, view), image(TRUTH, view)) < 25
    assert np.array_equal(found.parameters.values, TRUTH.values)
    assert len(found.losses) <= 40
    assert found.loss < 1e-8 < 1e-3 < found.losses[0]


@pytest.mark.slow
def test_colours_are_recovered_from_the_first_visible_samples():
    """Extinctions, which do not show, are fixed."""

    def shown(transfer, view):
        return jv.render(*seen(transfer, view), compositing=jv.FirstVisible()).image()

    views = [(view, shown(TRUTH, view)) for view, _ in VIEWS]
    residual = jv.ImageResidual(seen, views, compositing=jv.FirstVisible())
    start = eqx.tree_at(lambda t: t.colors, TRUTH, jnp.full_like(TRUTH.colors, 0.5))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # colours of invisible points do not show either
        found = jv.fit(residual, start, where=lambda t: t.colors, max_steps=20)
    assert found.loss < 1e-6 * found.losses[0]


@pytest.mark.slow
def test_a_residual_is_composited_as_it_was_told():
    (view, _), how = VIEWS[0], jv.FirstVisible()
    target = jv.render(*seen(TRUTH, view), compositing=how).image()
    (tiles,) = jv.ImageResidual(seen, [(view, target)], compositing=how).tiles(10**6)
    residual = tiles.residual(TRUTH, jax.tree.map(lambda leaf: leaf[0], tiles.items), "forward")
    np.testing.assert_allclose(residual, 0, atol=1e-7)
    assert float(jnp.abs(target - image(TRUTH, view)).max()) > 0.1


def test_the_loss_is_half_the_mean_square_error(found):
    errors = [image(GREY, view) - target for view, target in VIEWS]
    assert found.losses[0] == pytest.approx(float(np.mean(np.square(errors))) / 2, rel=1e-4)


@pytest.mark.parametrize("solver", ["levenberg_marquardt", "gauss_newton", "bfgs"])
def test_every_solver_finds_the_same_curve(solver):
    result = jv.fit(curve, BEGIN, solver=solver, rtol=1e-4, atol=1e-4, constraints=jv.Positive())
    # rounding of the loss stops BFGS's line search
    assert result.success or solver == "bfgs", result.message
    with in_float64():
        truth = np.asarray(X, float), np.asarray(DATA, float)
        from scipy.optimize import curve_fit

        (top, rate), _ = curve_fit(lambda x, top, rate: top * (1 - np.exp(-rate * x)), *truth, p0=(1, 0.2))
    assert float(result.parameters["top"]) == pytest.approx(top, rel=1e-3)
    assert float(result.parameters["rate"][0]) == pytest.approx(rate, rel=1e-3)


@pytest.mark.slow
def test_adam_lowers_the_loss_of_an_image_by_the_gradient_alone():
    pytest.importorskip("optax", reason="pip install -e '.[fit]'")
    result = jv.fit(RESIDUAL, GREY, solver="adam", max_steps=30)
    assert result.loss < result.losses[0] / 3
    assert result.solution.result == Outcome.nonlinear_max_steps_reached
    assert result.uncertainty is None


def test_solvers_of_optimistix_and_optax_are_taken():
    optax = pytest.importorskip("optax", reason="pip install -e '.[fit]'")
    for solver in (optx.Dogleg(1e-5, 1e-5), optx.LBFGS(1e-5, 1e-5), optax.adam(0.1)):
        result = jv.fit(curve, BEGIN, solver=solver, max_steps=400)
        assert result.loss < 2e-3, type(solver)


@pytest.mark.slow
def test_gradient_of_the_loss_is_that_of_the_triangle():
    free, y = Free.of(GREY, None, None)
    problem = Problem(RESIDUAL, free, RESIDUAL.count())
    whole = np.asarray(triangle(problem, y), np.float64)
    gradient = eqx.filter_jit(lambda p, y: jax.grad(p.loss)(y))(problem, y)
    flat = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(gradient)])
    np.testing.assert_allclose(whole[:, :-1].T @ whole[:, -1], flat, rtol=0, atol=1e-5 * abs(flat).max())


@pytest.mark.slow
def test_tiles_make_no_difference():
    """Three of 20 rows of a view at a time, so that the last tile reaches past the image."""
    free, y = Free.of(GREY, None, None)
    whole = np.asarray(triangle(Problem(RESIDUAL, free, RESIDUAL.count()), y))
    tiled = np.asarray(triangle(Problem(RESIDUAL, free, 3 * 24 * 3), y))
    np.testing.assert_allclose(tiled, whole, rtol=0, atol=2e-6 * abs(whole).max())


@pytest.mark.slow
def test_views_may_differ_in_size_and_channels():
    small = camera((0.2, 0.9, 0.5), (10, 8))
    rgba = jv.render(HEAD, TRUTH, small, MARCH).rgba
    residual = jv.ImageResidual(seen, [*VIEWS, (small, rgba)])
    assert residual.count() == 2 * 24 * 20 * 3 + 10 * 8 * 4
    free, y = Free.of(TRUTH, jv.Unconstrained(), None)
    assert float(Problem(residual, free, residual.count()).loss(y)) < 1e-12


# uncertainty


def uncertainty_of(found: jv.Fit) -> Uncertainty:
    assert found.uncertainty is not None
    return found.uncertainty


def test_covariance_of_a_line_is_that_of_the_textbook():
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(30, 3)).astype(np.float32)
    data = (matrix @ [1.0, -2.0, 0.5] + 0.1 * rng.normal(size=30)).astype(np.float32)
    result = jv.fit(lambda p: jnp.asarray(matrix) @ p - data, jnp.zeros(3))
    solution, square, *_ = np.linalg.lstsq(matrix.astype(float), data.astype(float))
    np.testing.assert_allclose(result.parameters, solution, rtol=1e-4)
    expected = square / (30 - 3) * np.linalg.inv(matrix.T.astype(float) @ matrix)
    uncertainty = uncertainty_of(result)
    np.testing.assert_allclose(uncertainty.covariance, expected, rtol=1e-3, atol=1e-3 * abs(expected).max())
    assert uncertainty.names == ["[0]", "[1]", "[2]"]
    assert uncertainty.standard_errors["[1]"] == pytest.approx(np.sqrt(expected[1, 1]), rel=1e-3)
    assert uncertainty.undetermined == []


def test_covariance_is_of_the_parameters_and_not_of_the_free_numbers():
    free = uncertainty_of(jv.fit(curve, CURVE, constraints=jv.Unconstrained(), rtol=1e-6))
    bound = uncertainty_of(jv.fit(curve, CURVE, constraints=jv.Positive(), rtol=1e-6))
    np.testing.assert_allclose(free.covariance, bound.covariance, rtol=1e-2)
    assert free.names == ["['rate'][0]", "['top']"]


@pytest.mark.slow
def test_covariance_is_the_scatter_of_repeated_fits():
    rng = np.random.default_rng(1)
    noise = 0.05 * rng.normal(size=(200, 40)).astype(np.float32)

    class Noisy(eqx.Module):
        """A module, so that fits of different data share one program."""

        noise: jnp.ndarray

        def __call__(self, p):
            return p["top"] * (1 - jnp.exp(-p["rate"] * X)) - (DATA + self.noise)

    fits = [jv.fit(Noisy(jnp.asarray(n)), CURVE) for n in noise]
    scatter = np.cov(
        [[float(f.parameters["rate"][0]), float(f.parameters["top"])] for f in fits], rowvar=False
    )
    reported = np.mean([uncertainty_of(f).covariance for f in fits], axis=0)
    np.testing.assert_allclose(np.sqrt(np.diag(reported)), np.sqrt(np.diag(scatter)), rtol=0.2)


def test_a_direction_that_nothing_shows_is_named():
    """No voxel's value lies in the last interval."""
    values = [0, 40, 70, 100, 130, 170, 300, 400]
    start = jv.TransferFunction(values, GREY.colors, GREY.extinction)
    with pytest.warns(UserWarning, match=r"of 32 directions are not determined .*\.extinction\[7\]"):
        result = jv.fit(RESIDUAL, start, max_steps=3)
    uncertainty = uncertainty_of(result)
    assert [".extinction[7]"] in uncertainty.undetermined
    for name in (".extinction[7]", ".colors[7, 0]", ".colors[7, 2]"):
        assert uncertainty.standard_errors[name] == np.inf
    for name in (".extinction[3]", ".colors[3, 0]", ".extinction[6]"):
        assert np.isfinite(uncertainty.standard_errors[name])
    assert np.array_equal(result.parameters.extinction[7:], GREY.extinction[7:])


def test_as_many_parameters_as_residuals_leave_the_variance_unknown():
    result = jv.fit(lambda p: p**2 - jnp.asarray([4.0, 9.0]), jnp.asarray([1.0, 1.0]))
    np.testing.assert_allclose(result.parameters, [2, 3], rtol=1e-4)
    assert np.all(np.diag(uncertainty_of(result).covariance) == np.inf)


# free parameters


def test_where_chooses_what_is_free():
    parameters = {"transfer": TRUTH, "gain": jnp.ones(2), "name": "head", "count": 3}
    free, y = Free.of(parameters, None, lambda p: (p["transfer"].extinction, p["gain"]))
    assert [leaf.shape for leaf in jax.tree.leaves(y)] == [(2,), (8,)]
    back = free.forward(y)
    assert (back["name"], back["count"]) == ("head", 3)
    assert np.array_equal(back["transfer"].colors, TRUTH.colors)


def test_usual_constraints():
    view = CAMERAS[0]
    volume = jv.Volume(np.ones((2, 2, 2), np.float32))
    free, y = Free.of({"c": view, "v": volume, "b": HEAD, "t": TRUTH, "m": MARCH, "f": 2.0}, None, None)
    kinds = {p: type(b).__name__ for p, b in zip(free.paths, free.bijections, strict=True)}
    fitted = {p.removeprefix("parameters"): kind for p, kind in kinds.items() if kind != "Fixed"}
    assert fitted == {
        "['c']": "Pose",
        "['f']": "Unconstrained",
        "['t'].colors": "UnitInterval",
        "['t'].extinction": "Positive",
        "['v'].data": "Unconstrained",
    }
    assert np.all(free.forward(y)["t"].extinction > 0)


def test_constraints_may_be_the_beginning_of_a_tree():
    free, _ = Free.of({"a": TRUTH, "b": (1.0, 2.0)}, {"a": None, "b": jv.Positive()}, None)
    kinds = [type(b) for b in free.bijections if not isinstance(b, jv.Fixed)]
    assert kinds == [jv.UnitInterval, jv.Positive, jv.Positive, jv.Positive]
    assert all(isinstance(b, Bijection) for b in free.bijections)


# bad input


def unreachable(parameters):
    raise AssertionError("the residual was called before the arguments were checked")


NAN = np.full((20, 24, 3), np.nan, np.float32)
SMALL = np.zeros((4, 5, 3), np.float32)
BAD = {
    "size": (
        lambda: jv.ImageResidual(seen, [(CAMERAS[0], SMALL)]),
        r"views\[0\].*\(20, 24, 3\).*\(4, 5, 3\)",
    ),
    "NaN": (lambda: jv.ImageResidual(seen, [VIEWS[1], (CAMERAS[0], NAN)]), r"views\[1\].*finite; 1440"),
    "8 bits": (
        lambda: jv.ImageResidual(seen, [(CAMERAS[0], np.zeros((20, 24, 3), np.uint8))]),
        r"views\[0\]: the image must be linear RGB, floats .*; got uint8.*from_srgb",
    ),
    "checkpoint": (
        lambda: jv.fit(unreachable, BEGIN, checkpoint="/dev/null/a"),
        r"checkpoint: /dev/null/a cannot be written \(/dev/null is not a folder\)",
    ),
    "checkpoint a folder": (
        lambda: jv.fit(unreachable, BEGIN, checkpoint=Path(__file__).parent),
        r"checkpoint: .*fitting cannot be written \(it is a folder\)",
    ),
    "no views": (lambda: jv.ImageResidual(seen, []), "views must hold at least one pair"),
    "views": (lambda: jv.ImageResidual(seen, [VIEWS[0][1]]), "views must be pairs"),
    "no camera": (lambda: jv.ImageResidual(seen, [(1, SMALL)]), r"views\[0\] must be a pair .*got int first"),
    "scene": (lambda: jv.ImageResidual(3, VIEWS), "scene must be a function"),
    "scene's result": (
        lambda: jv.fit(jv.ImageResidual(lambda t, c: (HEAD, t, c), VIEWS), GREY),
        r"scene must return \(volume, transfer, camera, march\), and lighting if it is lit; got \['Volume'",
    ),
    "scene's camera": (
        lambda: jv.fit(jv.ImageResidual(lambda t, c: seen(t, c.crop(0, 0, 2, 2)), VIEWS), GREY),
        r"scene must return a camera of its view's size \(24, 20\); got \(2, 2\)",
    ),
    "solver": (lambda: jv.fit(curve, BEGIN, solver="newton"), "solver must be one of levenberg.*'newton'"),
    "residual": (lambda: jv.fit(VIEWS, GREY), "residual must be an ImageResidual, or a function"),
    "residual and parameters swapped": (
        lambda: jv.fit(GREY, RESIDUAL),
        r"residual must be .*; got a TransferFunction\. The order is fit\(residual, parameters\)",
    ),
    "start": (
        lambda: jv.fit(curve, {**BEGIN, "top": jnp.asarray(np.nan)}),
        r"parameters\['top'\] must be finite",
    ),
    "bounds": (
        lambda: jv.fit(curve, {**BEGIN, "top": -1.0}, constraints=jv.Positive()),
        r"parameters\['top'\] must not be negative",
    ),
    "residual at the start": (
        lambda: jv.fit(lambda p: jnp.log(p), jnp.asarray([-1.0])),
        "residual must be finite at the parameters that the fit starts from",
    ),
    "nothing free": (lambda: jv.fit(curve, {"name": "x"}), "parameters must hold a float array that is free"),
    "tree": (lambda: jv.fit(curve, BEGIN, constraints={"tap": None}), "constraints must be a tree like"),
    "no bijection": (
        lambda: jv.fit(curve, BEGIN, constraints={"top": 1.0, "rate": None}),
        "constraints must",
    ),
    "where": (lambda: jv.fit(curve, BEGIN, where=lambda p: p["tap"]), "where must choose parts"),
    "max_steps": (lambda: jv.fit(curve, BEGIN, max_steps=0), "max_steps must be an integer of at least 1"),
    "rtol": (lambda: jv.fit(curve, BEGIN, rtol=-1), "rtol must be a finite number of at least 0; got -1"),
    "max_jacobian": (lambda: jv.fit(curve, BEGIN, max_jacobian=100), "max_jacobian leaves room for 8 of the"),
    "triangle": (lambda: jv.fit(RESIDUAL, GREY, max_jacobian=100), "max_jacobian must hold the triangle"),
    "row": (lambda: jv.fit(RESIDUAL, GREY, max_jacobian=5000), "one row of an image has 72"),
    "empty": (lambda: jv.fit(lambda p: jnp.zeros(0), BEGIN), "residual must return at least one number"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    make, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        make()


# fits that fail


def test_running_out_of_steps_is_told():
    result = jv.fit(curve, BEGIN, max_steps=2)
    assert not result.success
    assert result.solution.result == Outcome.nonlinear_max_steps_reached
    assert "maximum number of steps" in result.message
    assert len(result.losses) == 2


def test_a_derivative_that_leads_uphill_stalls():
    @jax.custom_jvp
    def f(p):
        return p - 3.0

    f.defjvp(lambda primal, tangent: (f(*primal), -tangent[0]))
    result = jv.fit(f, jnp.asarray([1.0, 2.0]), max_steps=60)
    assert not result.success
    assert "No step lowered the loss" in result.message
    np.testing.assert_allclose(result.parameters, [1, 2], atol=1e-6)


def test_what_diverges_gives_back_the_best_seen():
    """From 2, Gauss–Newton steps on the arctangent diverge, each farther than the one before."""
    result = jv.fit(jnp.arctan, jnp.asarray([2.0]), solver="gauss_newton", max_steps=50)
    assert not result.success
    assert result.message
    assert float(result.parameters[0]) == 2
    assert result.loss == pytest.approx(float(np.arctan(2) ** 2 / 2))


def test_a_loss_that_is_not_finite_ends_a_fit():
    optax = pytest.importorskip("optax", reason="pip install -e '.[fit]'")
    result = jv.fit(jnp.log, jnp.asarray([4.0]), solver=optax.sgd(15.0), max_steps=50)
    assert result.solution.result == Outcome.nonfinite
    assert "Nonfinite" in result.message
    assert float(result.parameters[0]) == 4


def test_a_step_to_where_the_residual_is_not_finite_is_taken_back():
    result = jv.fit(lambda p: jnp.sqrt(p) - 0.1, jnp.asarray([4.0]), max_steps=50)
    assert result.success
    assert float(result.parameters[0]) == pytest.approx(0.01, rel=1e-3)


# checkpoints


def test_a_fit_that_is_broken_off_goes_on_to_the_same_bits(tmp_path):

    class Stop(Exception):
        pass

    def stop(step, parameters, loss):
        if step == 4:
            raise Stop

    for solver in ("levenberg_marquardt", "bfgs"):
        whole = jv.fit(curve, BEGIN, solver=solver, max_steps=30)
        file = tmp_path / solver
        with pytest.raises(Stop):
            jv.fit(curve, BEGIN, solver=solver, checkpoint=file, checkpoint_seconds=0, callback=stop)
        steps = []

        def record(step, parameters, loss, steps=steps):
            steps.append(step)

        again = jv.fit(curve, BEGIN, solver=solver, checkpoint=file, max_steps=30, callback=record)
        assert steps[0] == 4  # the callback is called before the checkpoint is written
        assert same(again.parameters, whole.parameters)
        assert np.array_equal(again.losses, whole.losses)
        assert again.message == whole.message


def test_a_fit_that_is_interrupted_keeps_its_steps(tmp_path):
    whole = jv.fit(curve, BEGIN, max_steps=30)

    def interrupt(step, parameters, loss):
        if step == 3:
            raise KeyboardInterrupt

    file = tmp_path / "folder" / "a"
    with pytest.raises(KeyboardInterrupt) as stop:
        jv.fit(curve, BEGIN, checkpoint=file, callback=interrupt)
    assert stop.value.__notes__ == [
        f"fit: stopped after 3 steps, saved in {file}; the same call continues from there."
    ]
    steps = []
    again = jv.fit(curve, BEGIN, max_steps=30, checkpoint=file, callback=lambda *a: steps.append(a[0]))
    assert steps[0] == 4
    assert same(again.parameters, whole.parameters)


def test_a_finished_fit_is_not_fitted_again(tmp_path):
    first = jv.fit(curve, BEGIN, checkpoint=tmp_path / "a")
    calls = []
    second = jv.fit(curve, BEGIN, checkpoint=tmp_path / "a", callback=lambda *a: calls.append(a))
    assert calls == []
    assert same(first.parameters, second.parameters)


DAMAGE = {
    "truncated": lambda content: content[: len(content) // 2],
    "empty": lambda content: b"",
    "one byte": lambda content: content[:600] + bytes([content[600] ^ 1]) + content[601:],
    "another file": lambda content: b"not a checkpoint at all",
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_checkpoint_is_named_and_the_one_before_it_used(kind, tmp_path):
    file = tmp_path / "curve.ckpt"
    whole = jv.fit(curve, BEGIN, checkpoint=file, checkpoint_seconds=0)
    file.write_bytes(DAMAGE[kind](file.read_bytes()))
    steps = []
    with pytest.warns(UserWarning, match=r"checkpoint .*curve\.ckpt is damaged"):
        again = jv.fit(curve, BEGIN, checkpoint=file, callback=lambda *a: steps.append(a[0]))
    assert steps == [len(whole.losses)]
    assert same(again.parameters, whole.parameters)


def test_with_both_checkpoints_damaged_a_fit_starts_anew(tmp_path):
    file = tmp_path / "a"
    whole = jv.fit(curve, BEGIN, checkpoint=file, checkpoint_seconds=0)
    for damaged in (file, checkpoints.before(file)):
        damaged.write_bytes(b"")
    with pytest.warns(UserWarning, match="damaged") as warned:
        again = jv.fit(curve, BEGIN, checkpoint=file)
    assert len(warned) == 2
    assert same(again.parameters, whole.parameters)


def test_a_checkpoint_of_an_earlier_version_is_refused(tmp_path):
    file = tmp_path / "a.npz"
    np.savez(file, a0=np.zeros(2), losses=np.ones(3))
    with pytest.raises(ValueError, match=r"checkpoint .*a\.npz is a zip archive, as earlier versions"):
        jv.fit(curve, BEGIN, checkpoint=file)


@pytest.mark.parametrize("what", ["solver", "parameters", "loss at the start", "number of residuals"])
def test_a_checkpoint_of_another_fit_is_refused(what, tmp_path):
    jv.fit(curve, BEGIN, checkpoint=tmp_path / "a")
    residual, start, solver = curve, BEGIN, "levenberg_marquardt"
    if what == "solver":
        solver = "bfgs"
    elif what == "parameters":
        residual, start = (lambda p: curve(p[0])), (BEGIN,)
    elif what == "loss at the start":
        start = {**BEGIN, "top": 1.2}
    else:
        residual = lambda p: curve(p)[:20]  # noqa: E731
    with pytest.raises(ValueError, match=f"belongs to another fit: its {what} is"):
        jv.fit(residual, start, solver=solver, checkpoint=tmp_path / "a")


def test_of_a_checkpoint_of_other_parameters_the_first_that_differs_is_told(tmp_path):
    def of(number):
        start = {"offset": jnp.zeros(number), "scale": jnp.ones(())}
        jv.fit(lambda p: p["offset"] * p["scale"] - 1, start, checkpoint=tmp_path / "a")

    of(3)
    with pytest.raises(
        ValueError, match=r"its state is of float32\[3\], where that of this fit is of float32\[2\]\. Choose"
    ):
        of(2)


KILLED = """
import time
import sys
import jax.numpy as jnp
import numpy as np
import jaxvol as jv

x = jnp.linspace(0, 3, 40)
data = 2 * (1 - jnp.exp(-0.8 * x)) + 0.01 * jnp.sin(37 * x)

def residual(p):
    return p[0] * (1 - jnp.exp(-p[1] * x)) - data

def slowly(step, parameters, loss):
    print(step, flush=True)
    time.sleep(0.02)

fit = jv.fit(residual, jnp.asarray([1.0, 0.2]), solver="adam", max_steps=100, rtol=0, atol=0,
             checkpoint=sys.argv[1], checkpoint_seconds=0, callback=slowly)
np.save(sys.argv[2], np.asarray(fit.parameters))
"""


@pytest.mark.slow
def test_a_fit_that_is_killed_at_random_ends_with_the_same_bits(tmp_path):
    pytest.importorskip("optax", reason="pip install -e '.[fit]'")
    rng = np.random.default_rng()

    def start(name):
        command = [
            sys.executable,
            "-c",
            KILLED,
            str(tmp_path / f"{name}.ckpt"),
            str(tmp_path / f"{name}.npy"),
        ]
        root = str(Path(__file__).parent.parent.parent)
        return subprocess.Popen(
            command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": root}
        )

    run = start("whole")
    assert run.wait() == 0
    for _ in range(3):
        run = start("killed")
        assert run.stdout is not None
        run.stdout.readline()  # wait until it has started
        time.sleep(rng.uniform(0, 1))
        run.send_signal(signal.SIGKILL)
        run.wait()
    assert not (tmp_path / "killed.npy").exists() or run.returncode == 0
    assert start("killed").wait() == 0
    assert np.array_equal(np.load(tmp_path / "killed.npy"), np.load(tmp_path / "whole.npy"))


# the pose of a camera


@pytest.mark.slow
def test_a_pose_is_found_from_ten_degrees_and_five_percent_off():
    volume = jv.phantom("head", 32)
    march = jv.March(0.04, (jv.AlphaCorrection(),), "midpoint")
    truth = jv.Camera((1.5, -4.0, 0.8), (0.05, 0.0, -0.1), (0.1, 0.0, 1.0), size=(48, 40))
    target = jv.render(volume, TRUTH, truth, march).image()
    turn = np.deg2rad(10) * np.asarray([0.48, -0.6, 0.64])
    off = {"rotation": jnp.asarray(turn, jnp.float32), "translation": jnp.asarray([0.03, -0.03, 0.0265])}
    start = jv.Pose(truth).forward(off)
    residual = jv.ImageResidual(lambda camera, _: (volume, TRUTH, camera, march), [(truth, target)])
    result = jv.fit(residual, start, max_steps=40)
    back = jv.Pose(truth).inverse(result.parameters)
    assert np.rad2deg(np.linalg.norm(back["rotation"])) < 0.05
    assert np.linalg.norm(back["translation"]) < 1e-3


def test_progress_and_callback_tell_every_step(capfd):
    pytest.importorskip("tqdm", reason="pip install -e '.[fit]'")
    calls = []
    result = jv.fit(curve, BEGIN, progress=True, callback=lambda *a: calls.append(a))
    assert [step for step, _, _ in calls] == list(range(2, len(result.losses) + 1))
    assert [loss for _, _, loss in calls] == list(result.losses[1:])
    assert float(jnp.sum(curve(calls[-1][1]) ** 2) / 2) == pytest.approx(calls[-1][2], rel=1e-3)
    assert "loss=" in capfd.readouterr().err


def test_own_residuals_may_be_trees():
    residual = OwnResidual.of(lambda p: {"a": p, "b": [p[:1], 2 * p]}, jnp.ones(3))
    assert residual.count() == 7
