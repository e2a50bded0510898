"""Do fits by samples of a residual find the truth, as near as they say?"""

from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from experiments.coverage import mean_free_path
from experiments.mean_free_path import balls, cameras, lights
from jaxvol.fitting.bijections import Positive, Unconstrained
from jaxvol.fitting.constraints import Free
from jaxvol.fitting.path_traced import SampledRun
from jaxvol.fitting.residuals import Triangles
from jaxvol.fitting.uncertainty import uncertainty


# -- a model whose noise is known -------------------------------------------------------------------------


X = np.linspace(0.5, 2, 30, dtype=np.float32)
TRUTH = np.array([0.8, 1.5], np.float32)


class Decay(eqx.Module):
    """p exp(-q x), of which each path shows p exp(-q x) (1 + noise): as a path tracer's, the noise depends on
    the parameters, and the derivative has the same."""

    seed: jax.Array
    off: jax.Array
    """By how much every other datum is above, the rest below what any parameters show."""
    unit: jax.Array
    """Of p and q."""

    def reach(self, at):
        return jax.tree.map(Unconstrained().reach, at)

    def sample(self, at, step):
        at = at[0] / self.unit
        key = jax.random.fold_in(jax.random.key(self.seed), step)
        noise = jax.random.normal(key, (2, X.size, 1)) * 0.5
        mean = jnp.exp(-at[1] * X)[:, None]
        derivative = jnp.concatenate([mean, -X[:, None] * at[0] * mean], axis=1) / self.unit
        data = TRUTH[0] * np.exp(-TRUTH[1] * X)[:, None] + self.off * (-1.0) ** np.arange(X.size)[:, None]
        error = at[0] * mean[None] * (1 + noise) - data[None]
        rows = jnp.concatenate([derivative[None] * (1 + noise), error], axis=-1)
        return rows[:, :, None, :] / np.sqrt(X.size).astype(np.float32)


@jax.jit
def fits(seeds: Any, off: Any, unit: Any) -> tuple[jax.Array, ...]:
    """After each step, of fits by other noise each: results, the standard errors that they report, losses,
    and the share of shortened steps."""

    def fit(seed):
        problem: Any = Decay(seed, off, unit)

        def step(state, _):
            state = state.advanced(problem)
            error = jnp.sqrt(jnp.diagonal(state.path_covariance))
            return state, (state.best[0] / unit, error / unit, state.loss, state.window.cut)

        start = (jnp.asarray([2.0, 0.5]) * unit,)
        return jax.lax.scan(step, SampledRun.of(problem, start), length=240)[1]

    return jax.vmap(fit)(seeds)


@cache
def found(off: float = 0.0, unit: float = 1.0) -> tuple[np.ndarray, ...]:
    given = jnp.float32(off), jnp.float32(unit)
    return tuple(map(np.asarray, fits(np.arange(40, dtype=np.int32), *given)))


def test_samples_of_independent_halves_lead_to_the_truth_as_near_as_is_said():
    """And the loss there, which is 0, has no bias by the noise."""
    y, error, loss, *_ = found()
    for steps in (60, 240):
        off = y[:, steps - 1] - TRUTH
        assert np.all(np.mean(np.abs(off) < 2 * error[:, steps - 1], axis=0) >= 0.85)
        assert np.all(np.abs(off.mean(axis=0)) < 3.5 * off.std(axis=0) / 40**0.5)
        assert np.all(off.std(axis=0) < 0.4 / steps**0.5)
        left = loss[:, steps - 1]
        assert np.abs(left.mean()) < 4 * left.std() / 40**0.5


def test_the_loss_has_no_bias_where_the_model_does_not_fit():
    loss, off = found(0.2)[2][:, -1], 0.2
    assert abs(loss.mean() - off**2 / 2) < 4 * loss.std(ddof=1) / 40**0.5 + 0.1 * off**2 / 2


def test_noise_falls_with_the_square_root_of_the_steps():
    few, many = (np.abs(found()[0][:, steps - 1] - TRUTH).mean() for steps in (15, 240))
    assert 2.5 < few / many < 8


@pytest.mark.parametrize("unit", [0.01, 100.0])
def test_any_unit_will_do(unit):
    """As mean free paths of millimetres. Far steps are shortened, and are known to be."""
    y, error, *_, cut = found(unit=unit)
    off = y[:, -1] - TRUTH
    assert np.all(np.mean(np.abs(off) < 2 * error[:, -1], axis=0) >= 0.85)
    assert (unit < 1) == np.all(cut[:, 3] == 0)
    np.testing.assert_array_equal(cut[:, -1], 0)


def test_a_fit_whose_steps_are_shortened_has_not_settled():
    problem: Any = Decay(jnp.int32(0), jnp.float32(0), jnp.float32(1))
    run = SampledRun.of(problem, (jax.device_put(np.float32([2, 0.5])),))
    assert run.settled
    for where in (lambda s: s.cut, lambda s: s.window.cut):
        assert not eqx.tree_at(where, run, jnp.float32(0.1)).settled


class Coated(eqx.Module):
    """Brightness p of a coat, and log λ of what it hides, shown by one path in 50 and hardly ever."""

    seed: jax.Array

    def reach(self, at):
        return jax.tree.map(jnp.ones_like, at)

    def sample(self, at, step):
        coat, path = at[0]
        key = jax.random.fold_in(jax.random.key(self.seed), step)
        noise, rare = jax.random.normal(key, (2, X.size)), jax.random.uniform(key, (2, X.size)) < 0.02
        hidden = 1e-3 * jnp.where(rare, 50, 0) * jnp.exp(path) / (1 + jnp.exp(path)) ** 2
        rows = jnp.stack([coat * (1 + noise), hidden, coat * (1 + 0.3 * noise) - 1], axis=-1)
        return rows[:, :, None] / np.sqrt(X.size).astype(np.float32)


def test_noise_moves_no_parameter_that_the_samples_do_not_show():
    """It has little effect here, none far away: it stays, and the fit has not settled. The other is found."""

    @jax.jit
    @jax.vmap
    def fit(seed):
        run = SampledRun.of(Coated(seed), (jnp.asarray([0.3, -1.0]),))
        run, moved = jax.lax.scan(lambda r, _: (r := r.advanced(Coated(seed)), r.best[0]), run, length=60)
        return moved, run.window.cut

    moved, cut = map(np.asarray, fit(jnp.arange(40, dtype=jnp.int32)))
    assert np.all(np.abs(moved[:, -1, 0] - 1) < 0.05)
    assert np.all(np.abs(moved[..., 1] + 1) < 2)
    assert np.all(cut > 0)


def test_parameters_that_noise_of_the_paths_hides_are_not_determined():
    free, y = Free.of({"λ": np.array([0.1, 20.0], np.float32)}, Positive(), None)
    triangles = Triangles(jnp.eye(3), jnp.eye(2), 100)
    errors = {}
    for name, variances in {"both": (0.25, 25.0), "one": (4.0, 0.25)}.items():
        errors[name] = uncertainty(triangles, 100, free, y, 1.0, None, jnp.diag(jnp.array(variances)))
    assert errors["both"].undetermined == []
    assert errors["one"].undetermined == [["['λ'][0]"]]
    assert np.isfinite(np.diag(errors["one"].covariance)).tolist() == [False, True]


# -- path-traced images -----------------------------------------------------------------------------------


def material(path: Any) -> jv.Material:
    return jv.Material(0.3, path, values=(60, 256))


BALL = balls(8, [(200, (0, 0, 0), 0.7)])
TRANSFER = jv.TransferFunction((60, 140, 255), np.tile((0.8, 0.6, 0.5), (3, 1)), (0.0, 1.0, 1.0))
"""Where it shows the material, the extinction is 1/λ, whatever it is here."""
PATH = 0.35


def scene(given, camera):
    return BALL, TRANSFER, camera, lights(), given


def references(size: int, paths: int, path: float = PATH) -> list[tuple[jv.Camera, jv.PathTraced]]:
    how: Any = {"paths": paths, "materials": material(path)}
    views = enumerate(cameras(size))
    return [(view, jv.path_trace(BALL, TRANSFER, view, lights(), key=99 + at, **how)) for at, view in views]


@pytest.fixture(scope="module")
def views():
    return references(8, 64)


@pytest.fixture(scope="module")
def residual(views):
    return jv.PathTracedResidual(scene, views, (0, 0, 0), paths=4)


def test_a_mean_free_path_is_found_within_three_standard_errors(residual, tmp_path):
    """And an interrupted fit goes on to the same bits."""
    how: Any = {"max_steps": 32}
    whole = jv.fit(residual, material(3 * PATH), **how)
    assert whole.uncertainty is not None
    error = whole.uncertainty.standard_errors[".mean_free_path"]
    assert abs(float(whole.parameters.mean_free_path) - PATH) < 3 * error < 0.3 * PATH
    assert whole.uncertainty.reduced_chi_squared == pytest.approx(1, abs=0.5)
    assert "noise of its own paths" in whole.message

    def broken_off(step, parameters, loss):
        if step == 5:
            raise KeyboardInterrupt

    file, steps = tmp_path / "a", []
    with pytest.raises(KeyboardInterrupt):
        jv.fit(residual, material(3 * PATH), checkpoint=file, callback=broken_off, **how)
    again = jv.fit(
        residual, material(3 * PATH), checkpoint=file, callback=lambda *a: steps.append(a[0]), **how
    )
    assert steps[0] == 6
    assert np.array_equal(again.losses, whole.losses)
    assert float(again.parameters.mean_free_path) == float(whole.parameters.mean_free_path)


def test_templates_come_first_and_paths_last(views, residual):
    """What templates, which do not fit, find becomes the start."""
    templates = jv.ImageResidual(mean_free_path(size=8, resolution=8).scene, views, (0, 0, 0))
    with pytest.warns(UserWarning, match="The model does not fit"):
        first = jv.fit(templates, material(2 * PATH), max_steps=12)
    last = jv.fit(residual, first.parameters, max_steps=12)
    before, after = (fit.uncertainty and fit.uncertainty.reduced_chi_squared for fit in (first, last))
    assert before is not None
    assert after is not None
    assert before > 1.5 > after
    assert abs(float(last.parameters.mean_free_path) - PATH) < 0.1 * PATH


BAD = [
    (lambda views: jv.PathTracedResidual(scene, views, paths=3), "paths must be even, .* got 3"),
    (lambda views: jv.PathTracedResidual(scene, views, key=-1), "key must be an integer"),
    (lambda views: jv.PathTracedResidual(scene, []), "views must hold at least one"),
    (lambda views: jv.PathTracedResidual(lambda given: given, views), r"scene must be a function of \(param"),
    (
        lambda views: jv.PathTracedResidual(scene, [(views[0][0], np.zeros((8, 8, 4), np.float32))]),
        "images must have 3 channels to be path-traced; got 4",
    ),
    (
        lambda views: jv.fit(jv.PathTracedResidual(lambda g, c: (BALL, TRANSFER, c, lights()), views), 1.0),
        r"scene must return \(volume, .*anisotropy\), .* got a tuple of length 4",
    ),
    (
        lambda views: jv.fit(jv.PathTracedResidual(scene, views), material(1), solver="bfgs"),
        "solver must be None for a PathTracedResidual, which has one; got 'bfgs'",
    ),
    (
        lambda views: jv.fit(jv.PathTracedResidual(scene, views), material(1), max_jacobian=1000),
        "max_jacobian leaves no room for the Jacobian of 1 parameters and all views, which takes 24576 bytes",
    ),
]


@pytest.mark.parametrize(("call", "message"), BAD)
def test_bad_input_is_named(views, call, message):
    with pytest.raises(ValueError, match=message):
        call(views)


@pytest.mark.slow
@pytest.mark.parametrize("thickness", [2.0, 8.0])
@pytest.mark.parametrize("off", [3.0, 1 / 3])
def test_a_mean_free_path_is_found_within_three_percent_from_three_times_off(thickness, off):
    path = 1.4 / thickness
    residual = jv.PathTracedResidual(scene, references(24, 512, path), (0, 0, 0))
    fit = jv.fit(residual, material(off * path))
    assert fit.parameters.mean_free_path == pytest.approx(path, rel=0.03)
