"""Does `choose` choose the smallest model that held-out views support, and never more than the truth?"""

from functools import cache

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
    return Polynomial(
        *(jax.device_put(np.float32(np.concatenate(each))) for each in zip(*views, strict=True))
    )


def one_more(coefficients):
    return jax.device_put(np.append(coefficients, np.float32(0)))


def zeros(n):
    return jax.device_put(np.zeros(n, np.float32))


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
        assert chosen(truth, 0.0, seed).name == str(truth)


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


def test_the_table_tells_what_is_chosen_undetermined_and_out_of_steps():
    header, *rows = str(chosen(2, 0.1, 1)).splitlines()
    assert " ".join(header.split()) == "numbers determined training held out worse by fit"
    assert [row.startswith(">") for row in rows] == [False, True, False]
    assert rows[0].endswith(" converged")
    # three numbers in place of one, which it cannot tell apart
    apart = Candidate("apart", zeros(3), expand=lambda c: jnp.stack([0 * c[0], 0 * c[0], jnp.sum(c)]))
    views = views_of(3, 0.1, 1)
    choice = of_views(views, [*POLYNOMIALS[:2], apart])  # no warning: filterwarnings makes errors of them
    assert [(row.numbers, row.determined) for row in choice.candidates] == [(1, 1), (2, 2), (3, 1)]
    assert str(of_views(views, max_steps=1)).count("not converged") == 3


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
    first, second = nested_points(PLAIN, (2, 4))
    assert second.grow is not None
    assert (len(first.start.values), len(second.grow(first.start).values)) == (2, 4)


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


@pytest.mark.slow
def test_control_points_are_counted_from_images():
    """Candidates of 2 and 3 points, with only their extinction free; the truth has 3. The loss of an image is
    half its mean square error, and that of several is their mean."""
    volume = jv.Volume(np.linspace(0, 1, 6**3, dtype=np.float32).reshape(6, 6, 6), (0.4,) * 3, (-1.0,) * 3)
    march = jv.March(0.4, (jv.AlphaCorrection(),), "midpoint")

    def scene(transfer, camera):
        return volume, transfer, camera, march

    truth = jv.TransferFunction([0, 0.5, 1], np.full((3, 3), 0.5), [0.2, 2.0, 0.5])
    directions = ((1, 0.3, 0.2), (-0.2, 1, 0.4), (0.3, -0.2, 1), (-1, -0.6, 0.5))
    cameras = [jv.Camera.looking_at(volume, direction, size=(7, 6)) for direction in directions]
    views = [(camera, np.asarray(jv.render(*scene(truth, camera)).image())) for camera in cameras]
    models = nested_points(PLAIN, (2, 3), where=lambda transfer: transfer.extinction)
    residual = lambda some: jv.ImageResidual(scene, some)  # noqa: E731
    choice = choose(residual, models, views[2:], views=views[:2], max_steps=20)
    assert choice.name == "3 points"
    np.testing.assert_allclose(choice.parameters.extinction, truth.extinction, rtol=1e-3)
    row = choice.candidates[0]
    errors = [jv.render(*scene(row.fit.parameters, camera)).image() - image for camera, image in views[2:]]
    assert row.held_out_loss == pytest.approx(np.mean(np.square(errors)) / 2, rel=1e-3)


def test_candidates_that_do_not_grow_and_views_of_both_sets_are_refused():
    noisy = views_of(2, 0.1, 0)
    with pytest.raises(ValueError, match=r"candidates must be in order, .*'a' has 2 after 2"):
        of_views(noisy, [Candidate("b", zeros(2)), Candidate("a", zeros(2))])
    with pytest.raises(ValueError, match="held_out must not be among the views"):
        choose(polynomial, POLYNOMIALS, [tuple(map(np.array, noisy[1]))], views=noisy[:4])
