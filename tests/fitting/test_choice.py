"""Does `choose` choose the smallest model that held-out views support, and never more than the truth?"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.fitting.held_out import HeldOut

from ..scenes import in_float64


# Polynomials through noisy points, which compile once for all trials. A view is a pair of arrays (x, y).

DEGREES = 5


class Polynomial(eqx.Module):
    """Residual of the coefficients, lowest first."""

    x: jax.Array
    y: jax.Array

    def __call__(self, coefficients):
        return jnp.polyval(coefficients[::-1], self.x) - self.y


def polynomial(views):
    return Polynomial(*(jnp.concatenate(each) for each in zip(*views, strict=True)))


def one_more(coefficients):
    return jnp.append(coefficients, jnp.zeros(1))


POLYNOMIALS = [
    jv.Candidate("1", jnp.zeros(1)),
    *(jv.Candidate(str(n), grow=one_more) for n in range(2, DEGREES + 1)),
]


def views_of(truth, noise, seed):
    """Views of a polynomial of `truth` coefficients, each of order 1."""
    generator = np.random.default_rng([seed, truth])
    coefficients = generator.choice([-1, 1], truth) * generator.uniform(0.5, 1.5, truth)
    found = []
    for _ in range(6):
        x = generator.uniform(-1, 1, 60)
        y = np.polyval(coefficients[::-1], x) + noise * generator.normal(size=60)
        found.append((jnp.asarray(x, float), jnp.asarray(y, float)))
    return found


def chosen(truth, noise, seed, **options):
    views = views_of(truth, noise, seed)
    return jv.choose(polynomial, POLYNOMIALS, views[4:], views=views[:4], **options)


TRIALS = [(1 + seed % 4, seed) for seed in range(20)]


def test_the_truth_is_chosen_in_nine_of_ten_noisy_trials():
    found = [chosen(truth, 0.1, seed) for truth, seed in TRIALS]
    right = [choice.name == str(truth) for choice, (truth, _) in zip(found, TRIALS, strict=True)]
    assert np.mean(right) >= 0.9
    by_bic = [choice.by_bic == str(truth) for choice, (truth, _) in zip(found, TRIALS, strict=True)]
    assert np.mean(by_bic) >= 0.9


def test_without_noise_the_truth_is_chosen_and_never_more():
    for truth, seed in TRIALS:
        choice = chosen(truth, 0.0, seed)
        assert choice.name == choice.by_bic == str(truth)
        np.testing.assert_allclose(choice.parameters, choice.fit.parameters)


def test_a_larger_model_has_the_least_held_out_loss_in_some_trial_and_is_not_chosen():
    """Otherwise these trials could not tell the rule from the least held-out loss."""
    larger = 0
    for truth, seed in TRIALS:
        rows = chosen(truth, 0.1, seed).candidates
        larger += int(np.argmin([row.held_out_loss for row in rows])) > truth - 1
    assert larger >= 3


def test_the_share_of_too_large_choices_is_that_of_the_standard_errors():
    """Of two candidates that hold the truth, the larger one has the smaller held-out loss now and then; by
    more than two standard errors in 2.3 % of trials at most. With `errors=0` the held-out loss decides."""
    least, too_large, trials = 0, 0, 60
    for seed in range(trials):
        views = views_of(2, 0.1, 1000 + seed)
        choice = jv.choose(polynomial, POLYNOMIALS[:3], views[4:], views=views[:4])
        assert choice.chosen >= 1
        too_large += choice.chosen == 2
        best = int(np.argmin([row.held_out_loss for row in choice.candidates]))
        if best == 2 and not least:
            assert jv.choose(polynomial, POLYNOMIALS[:3], views[4:], views=views[:4], errors=0).chosen == 2
        least += best == 2
    assert least >= 0.2 * trials
    assert too_large <= 5  # of a share of 2.3 %, more have a probability of 0.3 %


def test_numbers_of_the_table_are_those_of_their_definitions():
    views = views_of(2, 0.1, 7)
    choice = jv.choose(polynomial, POLYNOMIALS[:3], views[4:], views=views[:4])
    best = min(choice.candidates, key=lambda row: row.held_out_loss)

    def residuals(row, some):
        coefficients = np.asarray(row.fit.parameters, float)
        return [np.polyval(coefficients[::-1], np.asarray(x, float)) - np.asarray(y) for x, y in some]

    for number, row in enumerate(choice.candidates):
        training, unseen = residuals(row, views[:4]), residuals(row, views[4:])
        assert row.numbers == number + 1
        assert row.training_loss == row.fit.loss == pytest.approx(np.sum(np.square(training)) / 2, rel=1e-4)
        losses = np.square(unseen) / 2
        assert row.held_out_loss == pytest.approx(losses.sum() / 2, rel=1e-4)
        own = np.std(losses, ddof=1) * np.sqrt(losses.size) / 2
        assert row.standard_error == pytest.approx(own, rel=1e-3)
        change = np.asarray(unseen) - residuals(best, views[4:])
        products = np.asarray(residuals(best, views[4:])) * change
        assert row.excess == pytest.approx(row.held_out_loss - best.held_out_loss, abs=1e-6)
        equal = np.mean(np.square(residuals(best, views[4:]))) * np.sum(change**2)
        expected = np.sqrt(max(np.sum(products**2), equal)) / 2
        assert row.excess_error == pytest.approx(expected, rel=1e-3, abs=1e-9)
        bic = 240 * np.log(2 * row.training_loss) + row.numbers * np.log(240)
        assert row.bic == pytest.approx(bic, rel=1e-6)


def test_a_misfit_in_few_pixels_counts_and_noise_that_is_shared_does_not():
    """In closed form: the standard error holds the noise of the difference alone."""
    count = 400
    noise = np.random.default_rng(0).normal(size=count)
    judge = HeldOut([jv.fitting.residuals.OwnResidual(lambda p: p, count)], 1)
    wrong = np.zeros(count)
    wrong[7] = 30.0
    excess, error = judge.excess(noise + wrong, noise)
    assert excess == pytest.approx(450 + 30 * noise[7])
    assert error == pytest.approx(30 * np.sqrt(np.mean(noise**2)))
    noise[7] *= 5
    assert judge.excess(noise + wrong, noise)[1] == pytest.approx(abs(30 * noise[7]))
    noise[7] /= 5
    loss, own = judge.loss(noise)
    assert (loss, own) == (
        pytest.approx(np.sum(noise**2) / 2),
        pytest.approx(np.sqrt(count) * np.std(noise**2 / 2, ddof=1)),
    )


def test_rounding_alone_decides_nothing():
    """Without the floor on losses, candidates of noise-free data would differ by rounding."""
    views = views_of(2, 0.0, 3)
    given = {"views": views[:4], "resolution": 0.0}
    choice = jv.choose(polynomial, POLYNOMIALS, views[4:], **given)
    assert all(np.isfinite(row.bic) for row in choice.candidates)
    rough = jv.choose(polynomial, POLYNOMIALS, views[4:], views=views[:4], resolution=10.0)
    assert rough.name == rough.by_bic == "1"


def test_losses_that_are_exactly_0_have_a_finite_bic():
    with in_float64():
        x = jnp.linspace(0, 1, 8)
        views = [(x, x), (x + 1, x + 1)]
        start = [jv.Candidate("1", jnp.zeros(1)), jv.Candidate("2", jnp.array([0.0, 1.0]))]
        choice = jv.choose(polynomial, start, views[1:], views=views[:1])
    assert choice.candidates[1].training_loss == 0
    assert choice.name == choice.by_bic == "2"
    assert np.isfinite(choice.candidates[1].bic)
    assert "nan" not in str(choice)


# images


VOLUME = jv.Volume(np.linspace(0, 1, 6**3, dtype=np.float32).reshape(6, 6, 6), (0.4,) * 3, (-1.0,) * 3)
MARCH = jv.March(0.4, (jv.AlphaCorrection(),), "midpoint")
PLAIN = jv.TransferFunction((0, 1), np.full((2, 3), 0.5), (0.5, 0.5))


def scene(transfer, camera):
    return VOLUME, transfer, camera, MARCH


def view(direction, transfer, noise=0.0, seed=0):
    camera = jv.Camera.looking_at(VOLUME, direction, size=(7, 6))
    image = np.asarray(jv.render(*scene(transfer, camera)).image())
    return camera, image + noise * np.random.default_rng(seed).normal(size=image.shape)


DIRECTIONS = ((1, 0.3, 0.2), (-0.2, 1, 0.4), (0.3, -0.2, 1), (-1, -0.6, 0.5))


def images(truth, noise):
    return [view(direction, truth, noise, seed) for seed, direction in enumerate(DIRECTIONS)]


def extinction(transfer):
    return transfer.extinction


@pytest.mark.slow
def test_control_points_are_counted_from_images():
    """Candidates of 2 and 3 points, with only their extinction free, and a truth of each."""
    models = jv.nested_points(PLAIN, (2, 3), where=extinction)
    steps = []
    for points in ((0.2, 2.0), (0.2, 2.0, 0.5)):
        values = np.linspace(0, 1, len(points))
        truth = jv.TransferFunction(values, np.full((len(points), 3), 0.5), points)
        for noise in (0.02, 0.0):
            views = images(truth, noise)
            choice = jv.choose(
                jv.ImageResidual(scene, views[:2]),
                *(models, views[2:]),
                max_steps=20,
                callback=lambda name, *_: steps.append(name),
            )
            assert choice.name == f"{len(points)} points"
            assert isinstance(choice.parameters, jv.TransferFunction)
            assert [row.numbers for row in choice.candidates] == [2, 3]
            # the loss of an image is half its mean square error, and that of several is their mean
            errors = [
                jv.render(*scene(choice.parameters, camera)).image() - image for camera, image in views[2:]
            ]
            row = choice.candidates[choice.chosen]
            assert row.held_out_loss == pytest.approx(np.mean(np.square(errors)) / 2, rel=1e-3, abs=1e-10)
        np.testing.assert_allclose(choice.parameters.extinction, truth.extinction, rtol=1e-3)
    assert set(steps) == {"2 points", "3 points"}


def test_blocks_are_squares_of_pixels_with_all_their_channels():
    residual = jv.ImageResidual(scene, [view(DIRECTIONS[0], PLAIN)])
    judge = HeldOut([residual, residual], 4)
    assert judge.blocks == 2 * 4  # 6 x 7 pixels: two blocks down, two across
    blocks = judge.block_of_entry[: 6 * 7 * 3].reshape(6, 7, 3)
    assert np.all(blocks[:4, :4] == 0)
    assert np.all(blocks[:4, 4:] == 1)
    assert np.all(blocks[4:, :4] == 2)
    assert np.all(blocks[4:, 4:] == 3)
    np.testing.assert_array_equal(judge.block_of_entry[6 * 7 * 3 :], blocks.reshape(-1) + 4)


# candidates


def test_a_refined_transfer_function_is_the_same_function():
    values, colors = (0.0, 10.0, 10.0, 40.0), np.random.default_rng(0).random((4, 3))
    transfer = jv.TransferFunction(values, colors, (0.0, 3.0, 1.0, 2.0))
    finer = jv.refined(transfer, 9)
    assert len(finer.values) == 9
    assert set(values) <= set(np.asarray(finer.values).tolist())
    for value in (-1.0, 3.0, 9.0, 10.0, 14.0, 27.5, 41.0):
        for one, other in zip(transfer(jnp.asarray(value)), finer(jnp.asarray(value)), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-6)
    even = jv.refined(jv.refined(PLAIN, 3), 9)
    np.testing.assert_allclose(even.values, np.linspace(0, 1, 9), atol=1e-7)


def grown_from(candidate, found):
    assert candidate.start is None
    assert candidate.grow is not None
    return candidate.grow(found)


def test_materials_share_what_they_have_in_common():
    parts = [jv.Material(0.5, path, values=(at, at + 1)) for at, path in enumerate((0.1, 0.2, 0.3))]
    one, two, three = jv.nested_materials(parts, [(0, 0, 0), (0, 1, 1), (0, 1, 2)])
    assert (one.name, two.name) == ("1 class: 0+1+2", "2 classes: 0, 1+2")

    def paths(materials):
        return [round(float(material.mean_free_path), 4) for material in materials]

    assert paths(one.expand(one.start)) == [0.1, 0.1, 0.1]
    moved = (eqx.tree_at(lambda m: m.mean_free_path, one.start[0], jnp.asarray(0.7)),)
    grown = grown_from(two, moved)
    assert paths(grown) == [0.7, 0.7]
    assert paths(two.expand(grown)) == [0.7, 0.7, 0.7]
    split = (grown[0], eqx.tree_at(lambda m: m.mean_free_path, grown[1], jnp.asarray(0.9)))
    assert paths(two.expand(split)) == paths(three.expand(grown_from(three, split))) == [0.7, 0.9, 0.9]
    # where a material is, is its own
    assert [material.values.tolist() for material in two.expand(split)] == [[0, 1], [1, 2], [2, 3]]


def test_transfer_functions_of_labels_are_merged_as_a_whole():
    parts = [PLAIN, jv.refined(PLAIN, 2)]
    one, two = jv.nested_materials(
        parts, [(0, 0), (0, 1)], constraints=jv.Fixed(), where=lambda transfer: transfer.extinction
    )
    assert one.expand(one.start) == (PLAIN, PLAIN)
    assert len(two.constraints) == 2
    assert two.where is not None
    assert [len(each) for each in two.where(grown_from(two, one.start))] == [2, 2]


def test_materials_are_counted():
    """Two balls of light behind one another: the mean of two parameters that are equal, or are not."""

    class Mixture(eqx.Module):
        weights: jax.Array
        seen: jax.Array

        def __call__(self, parts):
            return self.weights @ jnp.stack(parts) - self.seen

    def mixture(views):
        return Mixture(*(jnp.concatenate(each) for each in zip(*views, strict=True)))

    models = jv.nested_materials([jnp.asarray(1.0)] * 3, [(0, 0, 0), (0, 0, 1), (0, 1, 2)])
    for truth, classes in (((0.7, 0.7, 0.7), 1), ((0.7, 0.7, 1.5), 2), ((0.2, 0.7, 1.5), 3)):
        generator = np.random.default_rng(classes)
        views = []
        for noise in 4 * [0.1]:
            weights = generator.random((40, 3))
            seen = weights @ truth + noise * generator.normal(size=40)
            views.append((jnp.asarray(weights, float), jnp.asarray(seen, float)))
        choice = jv.choose(mixture, models, views[2:], views=views[:2])
        assert choice.name.startswith(f"{classes} class")
        np.testing.assert_allclose(jnp.stack(choice.parameters), truth, atol=0.1)


# what is told


def test_the_table_holds_a_row_for_each_candidate_and_marks_the_chosen_one():
    choice = chosen(2, 0.1, 1)
    header, *rows = str(choice).splitlines()
    assert header.split() == [
        "numbers",
        "training",
        "held",
        "out",
        *("worse", "by", "BIC", "fit", "undetermined"),
    ]
    assert len(rows) == DEGREES
    assert [row for row in rows if row.startswith(">")] == [rows[1]]
    assert rows[1].startswith("> 2")
    assert "best" in str(choice)
    assert "converged" in rows[0]
    assert all(len(row) <= 110 for row in rows)


def test_the_largest_candidate_and_a_fit_in_a_wrong_minimum_are_pointed_out():
    assert "a larger one may be better" in str(chosen(5, 0.1, 1))
    assert "a larger one may be better" not in str(chosen(4, 0.1, 1))
    views = views_of(3, 0.1, 1)
    # a third coefficient that is free in place of the second
    apart = jv.Candidate("apart", jnp.zeros(3), expand=lambda c: jnp.array([0.0, 0.0, 1.0]) * jnp.sum(c))
    choice = jv.choose(polynomial, [*POLYNOMIALS[:2], apart], views[4:], views=views[:4])
    assert "apart fits the training views worse than 2" in str(choice)


def test_undetermined_directions_and_fits_out_of_steps_are_in_the_table():
    views = views_of(2, 0.1, 1)
    twice = jv.Candidate("twice", jnp.zeros(3), expand=lambda c: jnp.stack([c[0] + c[2], c[1]]))
    choice = jv.choose(
        polynomial, [POLYNOMIALS[0], twice], views[4:], views=views[:4], max_steps=1
    )  # no warning: filterwarnings makes errors of them
    assert [row.undetermined for row in choice.candidates] == [0, 1]
    assert {row.ended for row in choice.candidates} == {"max_steps"}
    assert str(choice).splitlines()[2].split()[-2:] == ["max_steps", "1"]


def test_an_interrupted_choice_continues_to_the_same_bits(tmp_path):
    file = tmp_path / "fit.ckpt"

    def stop(name, step, parameters, loss):
        if name == "3":
            raise KeyboardInterrupt

    whole = chosen(3, 0.1, 0)
    with pytest.raises(KeyboardInterrupt):
        chosen(3, 0.1, 0, checkpoint=file, checkpoint_seconds=0, callback=stop)
    names = []
    again = chosen(3, 0.1, 0, checkpoint=file, callback=lambda name, *_: names.append(name))
    assert set(names) == {"3", "4", "5"}  # those that had ended are not repeated
    assert (tmp_path / "fit-5.ckpt").exists()
    assert not file.exists()
    assert str(again) == str(whole)
    for one, other in zip(again.candidates, whole.candidates, strict=True):
        assert np.array_equal(one.fit.parameters, other.fit.parameters)


# bad input


NOISY = views_of(2, 0.1, 0)
SEEN = [view(direction, PLAIN) for direction in DIRECTIONS]
OF_IMAGES = jv.ImageResidual(scene, SEEN[:2])
CLASSES = [(0, 0), (0, 1)]


def given(**changes):
    arguments = {"candidates": POLYNOMIALS, "held_out": NOISY[4:], "views": NOISY[:4], **changes}
    return jv.choose(arguments.pop("residual", polynomial), **arguments)


BAD = {
    "no held-out views": (lambda: given(held_out=[]), "held_out must hold at least one; got none"),
    "held_out": (lambda: given(held_out=3), "held_out must be a list; got 3"),
    "no models": (lambda: given(candidates=[]), "candidates must hold at least one; got none"),
    "one model": (lambda: given(candidates=POLYNOMIALS[0]), "candidates must be a list"),
    "no model": (lambda: given(candidates=[3]), r"candidates\[0\] must be a Candidate; got 3"),
    "order": (
        lambda: given(candidates=[jv.Candidate("b", jnp.zeros(2)), jv.Candidate("a", jnp.zeros(1))]),
        "candidates must be in order, each with more free parameters .*'a' has 1, and 'b' 2",
    ),
    "equal size": (
        lambda: given(candidates=[jv.Candidate("b", jnp.zeros(2)), jv.Candidate("a", jnp.zeros(2))]),
        "'a' has 2, and 'b' 2",
    ),
    "no start": (lambda: given(candidates=POLYNOMIALS[1:]), r"candidates\[0\], '2', must have a start"),
    "start and grow": (
        lambda: given(candidates=[POLYNOMIALS[0], jv.Candidate("b", jnp.zeros(2), one_more)]),
        r"candidates\[1\], 'b', must have either a start or grow",
    ),
    "names": (
        lambda: given(candidates=[POLYNOMIALS[0], jv.Candidate("1", jnp.zeros(2))]),
        "candidates must have different names",
    ),
    "both sets": (
        lambda: given(held_out=NOISY[3:]),
        r"held_out\[0\] must not be among the views that are fitted; it is the same as number 3",
    ),
    "both sets, a copy": (
        lambda: given(held_out=[NOISY[4], tuple(np.array(each) for each in NOISY[1])]),
        r"held_out\[1\] must not be among .* number 1",
    ),
    "both sets, of images": (
        lambda: jv.choose(OF_IMAGES, jv.nested_points(PLAIN), [SEEN[2], view(DIRECTIONS[1], PLAIN, 0.1)]),
        r"held_out\[1\] must not be among .* number 1",
    ),
    "views twice": (
        lambda: jv.choose(OF_IMAGES, jv.nested_points(PLAIN), SEEN[2:], views=SEEN[:2]),
        "views must not be given with an ImageResidual",
    ),
    "no views": (lambda: given(views=None), "views must be given with a function"),
    "residual": (lambda: given(residual=3), "residual must be an ImageResidual"),
    "errors": (lambda: given(errors=-1), "errors must be at least 0; got -1"),
    "resolution": (lambda: given(resolution=np.nan), "resolution must be finite"),
    "block": (lambda: given(block=0), "block must be an integer of at least 1; got 0"),
    "one block": (
        lambda: jv.choose(OF_IMAGES, jv.nested_points(PLAIN), SEEN[2:3], block=8),
        "block must leave two blocks of the held-out views at least; got 8",
    ),
    "where": (
        lambda: given(where=lambda p: p, constraints=None),
        "constraints and where must be given with each Candidate",
    ),
    "refined": (lambda: jv.refined(PLAIN, 1), "points must be an integer of at least 2; got 1"),
    "too fine": (
        lambda: jv.refined(jv.TransferFunction((1, 1 + 2e-7), np.zeros((2, 3)), (0, 0)), 99),
        "points must be few enough for float32",
    ),
    "points": (lambda: jv.nested_points(PLAIN, (4, 4)), r"points must be increasing .*\(4, 4\)"),
    "no transfer function": (
        lambda: jv.nested_points(jnp.zeros(3)),
        "start must be a TransferFunction; got a JAX array",
    ),
    "parts": (lambda: jv.nested_materials([], CLASSES), "parts must be a list"),
    "kinds": (lambda: jv.nested_materials([PLAIN, 1.0], CLASSES), "parts must be .* of one kind"),
    "partitions": (lambda: jv.nested_materials([1.0, 2.0], []), "partitions must hold the classes"),
    "gap": (lambda: jv.nested_materials([1.0, 2.0], [(0, 2)]), r"without gaps; got \(0, 2\)"),
    "too few": (lambda: jv.nested_materials([1.0, 2.0], [(0,)]), r"a class for each of 2 parts.*\(0,\)"),
    "not nested": (
        lambda: jv.nested_materials([1.0, 2.0, 3.0], [(0, 0, 1), (0, 1, 1)]),
        r"partitions must each divide .* got \(0, 0, 1\) and then \(0, 1, 1\)",
    ),
    "backwards": (lambda: jv.nested_materials([1.0, 2.0], CLASSES[::-1]), "partitions must each divide"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    call, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        call()
