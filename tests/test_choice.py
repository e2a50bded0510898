"""Does `choose` choose the smallest model that held-out views support, and never more than the truth?"""

from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from experiments.choice import Candidate, choose, nested_points, refined, standard_error
from experiments.model_choice import nested_materials


# Polynomials through noisy points, which compile once for all trials. A view is a pair of arrays (x, y).

DEGREES = 3


class Polynomial(eqx.Module):
    """Residual of the coefficients, lowest first."""

    x: jax.Array
    y: jax.Array

    def __call__(self, coefficients):
        return jnp.polyval(coefficients[::-1], self.x) - self.y


def polynomial(views):
    return Polynomial(*(jnp.asarray(np.concatenate(each), jnp.float32) for each in zip(*views, strict=True)))


def one_more(coefficients):
    return jnp.asarray(np.append(coefficients, np.float32(0)))


def zeros(n):
    return jnp.asarray(np.zeros(n, np.float32))


POLYNOMIALS = [
    Candidate("1", zeros(1)),
    *(Candidate(str(n), grow=one_more) for n in range(2, DEGREES + 1)),
]


def views_of(truth, noise, seed):
    """Views of a polynomial of `truth` coefficients, each of order 1."""
    generator = np.random.default_rng([seed, truth])
    coefficients = generator.choice([-1, 1], truth) * generator.uniform(0.5, 1.5, truth)
    found = []
    for _ in range(6):
        x = generator.uniform(-1, 1, 60)
        found.append((x, np.polyval(coefficients[::-1], x) + noise * generator.normal(size=60)))
    return found


def of_views(views, candidates=POLYNOMIALS, **options):
    return choose(polynomial, candidates, views[4:], views=views[:4], **options)


@cache
def chosen(truth, noise, seed):
    return of_views(views_of(truth, noise, seed))


TRIALS = [(1 + seed % 2, seed) for seed in range(20)]


def test_the_truth_is_chosen_in_nine_of_ten_noisy_trials():
    """In some of which a larger model has the least held-out loss, which is not the rule."""
    found = [(truth, chosen(truth, 0.1, seed)) for truth, seed in TRIALS]
    assert np.mean([choice.name == str(truth) for truth, choice in found]) >= 0.9
    least = [np.argmin([row.held_out_loss for row in choice.candidates]) + 1 for _, choice in found]
    larger = [seed for seed, (best, (truth, _)) in enumerate(zip(least, found, strict=True)) if best > truth]
    assert len(larger) >= 3
    # with `errors=0` the held-out loss decides
    truth, seed = TRIALS[larger[0]]
    assert of_views(views_of(truth, 0.1, seed), errors=0).chosen == least[larger[0]] - 1


def test_without_noise_the_truth_is_chosen_and_never_more():
    for truth, seed in TRIALS[:8]:
        choice = chosen(truth, 0.0, seed)
        assert choice.name == str(truth)
        np.testing.assert_allclose(choice.parameters, choice.fit.parameters)


def test_numbers_of_the_table_are_those_of_their_definitions():
    views, choice = views_of(2, 0.1, 7), chosen(2, 0.1, 7)
    best = min(choice.candidates, key=lambda row: row.held_out_loss)

    def residuals(row, some):
        coefficients = np.asarray(row.fit.parameters, float)
        return np.array([np.polyval(coefficients[::-1], x) - y for x, y in some])

    for number, row in enumerate(choice.candidates):
        training, unseen = residuals(row, views[:4]), residuals(row, views[4:])
        of_best = residuals(best, views[4:])
        assert row.numbers == row.determined == number + 1
        assert row.fit.loss == pytest.approx(np.sum(training**2) / 2, rel=1e-4)
        assert row.held_out_loss == pytest.approx(np.sum(unseen**2) / 4, rel=1e-4)
        change = unseen - of_best
        equal = np.mean(of_best**2) * np.sum(change**2)
        expected = np.sqrt(max(np.sum((of_best * change) ** 2), equal)) / 2
        assert row.standard_error == pytest.approx(expected, rel=1e-3, abs=1e-6)


def test_a_misfit_in_few_pixels_counts_and_noise_that_is_shared_does_not():
    """In closed form: the standard error holds the noise of the difference alone."""
    noise = np.random.default_rng(0).normal(size=(20, 20, 1))
    wrong = np.zeros((20, 20, 1))
    wrong[7, 8] = 30.0
    for shape in ((400,), (20, 20, 1)):
        error = standard_error([(noise + wrong).reshape(shape)], [noise.reshape(shape)], 4)
        assert error == pytest.approx(30 * np.sqrt(np.mean(noise**2)))
    noise[7, 8] *= 5
    assert standard_error([noise + wrong], [noise], 4) == pytest.approx(abs(30 * noise[7, 8, 0]))
    wrong[6, 9] = 30.0  # of the same block
    summed = noise[7, 8, 0] + noise[6, 9, 0]
    assert standard_error([noise + wrong], [noise], 4) == pytest.approx(abs(30 * summed))


def test_the_table_marks_the_chosen_one():
    header, *rows = str(chosen(2, 0.1, 1)).splitlines()
    assert " ".join(header.split()) == "numbers determined training held out worse by fit"
    assert len(rows) == DEGREES
    assert [row for row in rows if row.startswith(">")] == [rows[1]]
    assert rows[1].startswith("> 2")
    assert rows[0].endswith(" converged")


def test_undetermined_directions_and_fits_out_of_steps_are_told():
    # three numbers in place of one, which it cannot tell apart
    apart = Candidate("apart", zeros(3), expand=lambda c: jnp.stack([0 * c[0], 0 * c[0], jnp.sum(c)]))
    views = views_of(3, 0.1, 1)
    choice = of_views(views, [*POLYNOMIALS[:2], apart])  # no warning: filterwarnings makes errors of them
    assert [(row.numbers, row.determined) for row in choice.candidates] == [(1, 1), (2, 2), (3, 1)]
    assert str(of_views(views, max_steps=1)).count("not converged") == 3


def test_an_interrupted_choice_continues_to_the_same_bits(tmp_path):
    file, views = tmp_path / "fit.ckpt", views_of(2, 0.1, 0)

    def stop(step, parameters, loss):
        if len(parameters) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        of_views(views, checkpoint=file, callback=stop)
    sizes = []
    again = of_views(views, checkpoint=file, callback=lambda step, found, loss: sizes.append(len(found)))
    assert set(sizes) == {2, 3}  # those that had ended are not repeated
    assert (tmp_path / "fit-3.ckpt").exists()
    assert not file.exists()
    whole = chosen(2, 0.1, 0)
    assert str(again) == str(whole)
    for one, other in zip(again.candidates, whole.candidates, strict=True):
        assert np.array_equal(one.fit.parameters, other.fit.parameters)


# -- candidates -------------------------------------------------------------------------------------------


PLAIN = jv.TransferFunction((0, 1), np.full((2, 3), 0.5), (0.5, 0.5))


def test_a_refined_transfer_function_is_the_same_function():
    values, colors = (0.0, 10.0, 10.0, 40.0), np.random.default_rng(0).random((4, 3))
    transfer = jv.TransferFunction(values, colors, (0.0, 3.0, 1.0, 2.0))
    finer = refined(transfer, 9)
    assert len(finer.values) == 9
    assert set(values) <= set(np.asarray(finer.values).tolist())
    at = np.array([-1.0, 3.0, 9.0, 10.0, 14.0, 27.5, 41.0], np.float32)
    one, other = (jax.jit(jax.vmap(each.__call__))(at) for each in (transfer, finer))
    for before, after in zip(one, other, strict=True):
        np.testing.assert_allclose(before, after, atol=1e-6)
    even = refined(refined(PLAIN, 3), 9)
    np.testing.assert_allclose(even.values, np.linspace(0, 1, 9), atol=1e-7)


def test_materials_share_what_they_have_in_common():
    parts = [jv.Material(0.5, path, values=(at, at + 1)) for at, path in enumerate((0.1, 0.2, 0.3))]
    one, two = nested_materials(parts, [(0, 0, 0), (0, 1, 1)])

    def paths(materials):
        return [round(float(material.mean_free_path), 4) for material in materials]

    assert paths(one.expand(one.start)) == [0.1, 0.1, 0.1]
    moved = (eqx.tree_at(lambda m: m.mean_free_path, one.start[0], jnp.asarray(0.7)),)
    assert two.grow is not None
    grown = two.grow(moved)
    assert paths(grown) == [0.7, 0.7]
    split = (grown[0], eqx.tree_at(lambda m: m.mean_free_path, grown[1], jnp.asarray(0.9)))
    assert paths(two.expand(split)) == [0.7, 0.9, 0.9]
    # where a material is, is its own
    assert [material.values.tolist() for material in two.expand(split)] == [[0, 1], [1, 2], [2, 3]]


# -- images -----------------------------------------------------------------------------------------------


VOLUME = jv.Volume(np.linspace(0, 1, 6**3, dtype=np.float32).reshape(6, 6, 6), (0.4,) * 3, (-1.0,) * 3)
MARCH = jv.March(0.4, (jv.AlphaCorrection(),), "midpoint")
DIRECTIONS = ((1, 0.3, 0.2), (-0.2, 1, 0.4), (0.3, -0.2, 1), (-1, -0.6, 0.5))


def scene(transfer, camera):
    return VOLUME, transfer, camera, MARCH


def blank(direction):
    """A view that nothing was rendered for."""
    return jv.Camera.looking_at(VOLUME, direction, size=(7, 6)), np.zeros((6, 7, 3), np.float32)


SEEN = [blank(direction) for direction in DIRECTIONS]


@pytest.mark.slow
def test_control_points_are_counted_from_images():
    """Candidates of 2 and 3 points, with only their extinction free, and a truth of each."""
    models = nested_points(PLAIN, (2, 3), where=lambda transfer: transfer.extinction)
    rng = np.random.default_rng(0)
    for points in ((0.2, 2.0), (0.2, 2.0, 0.5)):
        truth = jv.TransferFunction(np.linspace(0, 1, len(points)), np.full((len(points), 3), 0.5), points)
        clear = [(view, jv.render(*scene(truth, view)).image()) for view, _ in SEEN]
        noisy = [(view, image + 0.02 * rng.normal(size=image.shape)) for view, image in clear]
        for views in (noisy, clear):
            rows, columns = np.indices((6, 7))
            masks = dict(zip(map(id, views), [None, None, columns > 0, rows > 1], strict=True))

            def residual(some, masks=masks):
                return jv.ImageResidual(scene, some, weights=[masks[id(view)] for view in some])

            masked = [columns > 0, rows > 1]
            choice = choose(residual, models, views[2:], views=views[:2], max_steps=20)
            assert choice.name == f"{len(points)} points"
            assert [row.numbers for row in choice.candidates] == [2, 3]
            # the loss of an image is half its mean square error, and that of several is their mean
            images = [jv.render(*scene(choice.parameters, view)).image() for view, _ in views[2:]]
            errors = [(i - image) ** 2 for i, (_, image) in zip(images, views[2:], strict=True)]
            loss = np.mean([np.mean(e[mask]) for e, mask in zip(errors, masked, strict=True)]) / 2
            row = choice.candidates[choice.chosen]
            assert row.held_out_loss == pytest.approx(loss, rel=1e-3, abs=1e-10)
        assert isinstance(choice.parameters, jv.TransferFunction)
        np.testing.assert_allclose(choice.parameters.extinction, truth.extinction, rtol=1e-3)


# -- bad input --------------------------------------------------------------------------------------------


NOISY = views_of(2, 0.1, 0)


def one(name, n):
    return Candidate(name, zeros(n))


def given(*candidates, **changes):
    arguments = {
        "candidates": candidates or POLYNOMIALS,
        "held_out": NOISY[4:],
        "views": NOISY[:4],
        **changes,
    }
    return lambda: choose(arguments.pop("residual", polynomial), **arguments)


def points(*numbers, start: Any = PLAIN):
    return lambda: nested_points(start, numbers)


BAD = [
    (given(held_out=[]), "held_out must be a list of at least one"),
    (given(held_out=3), "held_out must be a list of at least one; got 3"),
    (given(candidates=[]), "candidates must be a list of at least one"),
    (given(candidates=POLYNOMIALS[0]), "candidates must be a list"),
    (given(3), r"candidates\[0\] must be a Candidate; got 3"),
    (given(one("b", 2), one("a", 1)), "candidates must be in order, .*'a', has 1 after 2"),
    (given(one("b", 2), one("a", 2)), "'a', has 2 after 2"),
    (given(*POLYNOMIALS[1:]), r"candidates\[0\] must have a start, or, after the first, grow"),
    (given(one("1", 1), Candidate("b", zeros(2), one_more)), r"\[1\] must have a start, or"),
    (given(held_out=NOISY[3:]), "held_out must not be among the views that are fitted"),
    (given(held_out=[tuple(map(np.array, NOISY[1]))]), "held_out must not be among the views"),
    (given(residual=jv.ImageResidual(scene, SEEN)), "residual must be a function of a list of views; got"),
    (given(views=None), "views must be a list of at least one; got None"),
    (given(residual=3), "residual must be a function of a list of views; got 3"),
    (given(errors=-1), "errors must not be negative; got -1"),
    (given(block=0), "block must be an integer of at least 1; got 0"),
    (given(where=np.sum, constraints=None), "constraints and where must be given with each Candidate"),
    (lambda: refined(PLAIN, 1), "points must be an integer of at least 2; got 1"),
    (points(4, 4), r"points must be increasing .*\(4, 4\)"),
    (points(2, start=zeros(3)), "start must be a TransferFunction; got a JAX array"),
]


@pytest.mark.parametrize(("call", "message"), BAD)
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
