"""Does `fit` find the geometry of a swept probe, and does it say what the data leave open?"""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.ndimage import gaussian_filter

import jaxvol as jv
from experiments import probe_geometry as experiment
from jaxvol.fitting.constraints import Free


HALF = np.pi / 2
PROBES = {
    "across the middle": (20.0, 30.0, (0.9, 2.3), (0.8, 2.4), (0.0, 60.0)),
    "apex behind the axis": (
        -30.0,
        52.7,
        (HALF - 0.95, HALF + 0.95),
        (HALF - 0.67, HALF + 0.67),
        (0.0, 69.6),
    ),
    "b below 0": (5.0, -5.0, (0.3, 1.2), (1.7, 2.9), (25.0, 95.0)),
    "apex on the axis": (0.0, 25.0, (1.0, 2.0), (0.9, 2.4), (0.0, 40.0)),
}
NAMES = [".a", ".b", ".beta_range[0]", ".beta_range[1]", ".sigma_range[0]", ".sigma_range[1]", ".last_gamma"]


def flat(probe):
    return np.concatenate([np.atleast_1d(leaf) for leaf in jax.tree.leaves(probe)])


def moved(probe, part, seed=0):
    """The probe with each number but the first depth this part away, in random directions; angles by that
    part of half their range."""
    signs = np.random.default_rng(seed).choice([-1, 1], 7)
    scale = np.abs(flat(probe))
    scale[2:4], scale[4:6] = np.ptp(flat(probe)[2:4]) / 2, np.ptp(flat(probe)[4:6]) / 2
    a, b, b0, b1, s0, s1, first, last = flat(probe) + part * scale * [*signs[:6], 0, signs[6]]
    return jv.ToroidalMap(a, b, (b0, b1), (s0, s1), (first, last))


@pytest.mark.parametrize("name", PROBES)
def test_forward_undoes_inverse(name):
    probe = jv.ToroidalMap(*PROBES[name])
    for start in (probe, moved(probe, 0.01)):
        bijection = jv.ProbeGeometry(start)
        found = bijection.forward(bijection.inverse(probe))
        size = float(probe.b + probe.gamma_range[1])
        np.testing.assert_allclose(flat(found), flat(probe), atol=2e-6 * size)


def test_free_numbers_are_of_order_one():
    for probe in (jv.ToroidalMap(*PROBES[name]) for name in PROBES):
        free = jax.tree.leaves(jv.ProbeGeometry(probe).inverse(probe))
        assert np.abs(np.concatenate([np.atleast_1d(leaf) for leaf in free])).max() < 7  # log of MARGIN


def test_every_free_number_is_a_valid_probe_with_a_finite_slope():
    bijection = jv.ProbeGeometry(jv.ToroidalMap(*PROBES["apex behind the axis"]))
    free, unravel = ravel_pytree(bijection.inverse(bijection.start))
    rng = np.random.default_rng(0)
    slope = jax.jit(
        jax.jacfwd(
            lambda free: jnp.concatenate(
                [jnp.atleast_1d(leaf) for leaf in jax.tree.leaves(bijection.forward(unravel(free)))]
            )
        )
    )
    for scale in (1.0, 5.0):
        for draw in rng.normal(size=(100, len(free))).astype(np.float32) * scale:
            probe = bijection.forward(unravel(jnp.asarray(draw)))
            ranges = probe.beta_range, probe.sigma_range, probe.gamma_range
            if all(np.diff(ends) > 1e-6 for ends in ranges):  # else float32 has no numbers in between
                jv.ToroidalMap(probe.a, probe.b, *ranges)
            assert np.isfinite(slope(draw)).all()


def test_it_is_the_default_of_a_probe():
    probe = jv.ToroidalMap(*PROBES["across the middle"])
    free, start = Free.of({"probe": probe}, None, None)
    assert free.names(start) == [f"['probe']{name}" for name in NAMES]


POINTS = np.random.default_rng(0).uniform(0.05, 0.95, (60, 3))


def placed(probe):
    """World points of fixed places in the grid."""
    ends = jnp.stack([probe.beta_range, probe.sigma_range, probe.gamma_range])
    points = jnp.asarray(POINTS, ends.dtype)
    return probe.to_world(ends[None, :, 0] + points * (ends[:, 1] - ends[:, 0])[None]) / 100


@pytest.mark.parametrize("name", ["across the middle", "apex behind the axis"])
def test_a_probe_is_found_from_points_twenty_percent_off(name):
    truth = jv.ToroidalMap(*PROBES[name])
    target = placed(truth)
    noise = 1e-3 * np.random.default_rng(1).normal(size=target.shape).astype(np.float32)
    start = moved(truth, 0.2 if truth.a > 0 else 0.05)
    found = jv.fit(lambda probe: placed(probe) - target, start)
    np.testing.assert_allclose(flat(found.parameters), flat(truth), rtol=1e-3, atol=1e-4)
    noisy = jv.fit(lambda probe: placed(probe) - target - noise, start)
    assert noisy.uncertainty is not None
    assert noisy.uncertainty.names == NAMES
    assert noisy.uncertainty.undetermined == []
    off = np.delete(flat(noisy.parameters) - flat(truth), 6)
    deviations = np.sqrt(np.diag(noisy.uncertainty.covariance))
    assert np.abs(off / deviations).max() < 3.5
    assert np.abs(off).max() > 0


def test_where_depth_begins_is_not_determined_if_it_is_free():
    truth = jv.ToroidalMap(*PROBES["across the middle"])
    target = placed(truth)
    free = jax.tree.map(lambda _: jv.Unconstrained(), truth)
    with pytest.warns(UserWarning, match="1 of 8 directions are not determined"):
        found = jv.fit(lambda probe: placed(probe) - target, truth, constraints=free, max_steps=1)
    assert found.uncertainty is not None
    assert found.uncertainty.undetermined == [[".b", ".gamma_range[0]", ".gamma_range[1]"]]


def test_scale_is_not_determined_if_the_camera_may_be_scaled():
    truth = jv.ToroidalMap(*PROBES["across the middle"])
    target = placed(truth)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = jv.fit(lambda p: placed(p[0]) / p[1] - target, (truth, jnp.float32(1.0)), max_steps=1)
    assert found.uncertainty is not None
    (changed,) = found.uncertainty.undetermined
    assert {"[0].a", "[0].b", "[0].last_gamma"} >= set(changed) - {"[1]"}
    assert "[0].last_gamma" in changed


BAD = {
    "no probe to start from": (
        lambda: jv.ProbeGeometry((20.0, 30.0)),
        "start must be a ToroidalMap; got a",
    ),
    "no probe": (
        lambda: jv.ProbeGeometry(jv.ToroidalMap(*PROBES["b below 0"])).inverse(3.0, "probe"),
        "probe must be a ToroidalMap; got 3.0",
    ),
    "samples behind the axis": (
        lambda: jv.fit(lambda probe: probe.a, jv.ToroidalMap(-26.0, 30.0, (1, 2), (1, 2), (0, 60))),
        r"parameters must not have samples behind the motor axis to be fitted: .* -0\.7",
    ),
    "another first depth": (
        lambda: jv.ProbeGeometry(jv.ToroidalMap(*PROBES["b below 0"])).inverse(
            jv.ToroidalMap(*PROBES["apex on the axis"]), "probe"
        ),
        r"probe must begin at the same depth as the start, gamma_range\[0\] = 25\.0; got 0\.0",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_probes_are_named(case):
    make, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        make()


# ---- images ----


def test_starts_of_the_experiment_are_twenty_percent_off():
    """All numbers, and lengths by their own size, angles by half of their range."""
    _, truth = experiment.phantom(24)
    lengths = 20.0, 30.0, 100.0
    scales = [*lengths[:2], *[np.radians(35)] * 2, *[np.radians(40)] * 2, lengths[2]]
    for signs in experiment.directions(np.random.default_rng(0), 2).values():
        off = experiment.numbers(experiment.moved(truth, signs)) - experiment.numbers(truth)
        np.testing.assert_allclose(off, 0.2 * signs * scales, atol=1e-5)


@pytest.mark.slow
def test_a_probe_is_found_from_images_twenty_percent_off_within_half_a_percent():
    """Spheres, wires and speckle, from two known cameras, with noise of 1 %, in converged references; and the
    covariance says how far off the numbers are, and that the scene determines all of them."""
    starts = [[1, -1, -1, 1, 1, 1, -1], [-1] * 7, [-1, -1, 1, 1, 1, 1, 1]]
    ratios = []
    for seed, signs in enumerate(starts):
        scene, truth = experiment.phantom(64, seed=seed)
        targets = experiment.views(scene, truth, 32, experiment.NOISE, seed, 8)
        row = experiment.recovered(scene, targets, truth, experiment.moved(truth, np.array(signs)))
        assert row["worst"] < 0.005
        assert row["undetermined"] == []
        ratios += [row["errors"][name] / row["standard errors"][name] for name in experiment.NAMES]
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.7


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variant", "left_open"),
    [
        ("spheres and wires", []),
        ("all eight numbers", ["b", "last γ"]),
        ("cameras up to scale", ["a", "b", "last γ"]),
        ("shells through a window", ["first β", "last β", "first σ", "last σ"]),
    ],
)
def test_the_covariance_says_which_numbers_the_scene_determines(variant, left_open):
    found = experiment.VARIANTS[variant](24, 16, 0)["standard errors"]
    assert [name for name, error in found.items() if not np.isfinite(error)] == left_open
    assert all(error > 0 for error in found.values())


def test_the_loss_of_blurred_images_is_that_of_scipys_blur():
    """Weights of a Gaussian over the pixels that exist, as SciPy's with zeros around, divided by its blur of
    ones; of images that are not square."""
    volume = jv.phantom("gaussian", 24)
    transfer, camera = jv.colormap("gray", (0, 1), (0.0, 0.5)), jv.Camera.looking_at(volume, size=(20, 16))
    rng = np.random.default_rng(0)
    target = rng.random((16, 20, 3), np.float32)
    views = [(camera, target)]
    rendered = jv.render(volume, transfer, camera, jv.March(0.1)).image(background=(1, 1, 1))
    difference = np.asarray(rendered, np.float64) - target
    expected = {None: difference, 0.0: difference}
    sigma = 0.1 * 16
    how = {"sigma": (sigma, sigma, 0), "mode": "constant", "truncate": 20.0}
    expected[0.1] = gaussian_filter(difference, **how) / gaussian_filter(np.ones_like(difference), **how)
    for blur, each in expected.items():
        residual = jv.ImageResidual(lambda d, c: (volume, transfer, c, jv.March(d)), views, blur=blur)
        found = jv.fit(residual, jnp.float32(0.1), solver="bfgs", max_steps=1).losses[0]
        assert found == pytest.approx(np.mean(each**2) / 2, rel=1e-4)


def test_blurred_images_are_not_split():
    volume = jv.phantom("gaussian", 24)
    transfer, camera = jv.colormap("gray", (0, 1), (0.0, 0.5)), jv.Camera.looking_at(volume, size=(20, 16))
    views = [(camera, np.zeros((16, 20, 3), np.float32))]
    residual = jv.ImageResidual(lambda t, c: (volume, t, c, jv.March(0.1)), views, blur=0.1)
    numbers = transfer.extinction.size
    with pytest.raises(ValueError, match="blurred images are not split: one has 960"):
        jv.fit(
            *(residual, transfer),
            where=lambda t: t.extinction,
            max_jacobian=4 * (numbers + 1) * max(numbers + 1, 100),
        )
    with pytest.raises(ValueError, match="blur must not be negative"):
        jv.ImageResidual(lambda t, c: None, views, blur=-0.1)


def test_coarse_to_fine_is_one_fit_after_the_other():
    volume = jv.phantom("gaussian", 24)
    transfer, camera = jv.colormap("gray", (0, 1), (0.0, 0.5)), jv.Camera.looking_at(volume, size=(20, 16))
    march = jv.March(0.1)

    def scene(unit, camera):
        return (
            volume,
            eqx.tree_at(lambda t: t.extinction, transfer, transfer.extinction * unit),
            camera,
            march,
        )

    views = [(camera, np.full((16, 20, 3), 0.5, np.float32))]
    residual = jv.ImageResidual(scene, views, blur=0.3)
    how = {"solver": "bfgs", "max_steps": 3}
    fits = jv.fit_coarse_to_fine(residual, jnp.float32(1.0), blurs=(0.2, None), **how)
    at = jnp.float32(1.0)
    for blur, found in zip((0.2, None), fits, strict=True):
        alone = jv.fit(
            jv.ImageResidual(scene, [(camera, residual.groups[0].images[0])], blur=blur), at, **how
        )
        at = alone.parameters
        np.testing.assert_array_equal(found.losses, alone.losses)
        np.testing.assert_array_equal(found.parameters, at)
    assert fits[0].parameters != 1


def test_bad_arguments_of_coarse_to_fine_are_named():
    volume = jv.phantom("gaussian", 24)
    camera = jv.Camera.looking_at(volume, size=(20, 16))
    residual = jv.ImageResidual(lambda p, c: None, [(camera, np.zeros((16, 20, 3), np.float32))])
    with pytest.raises(ValueError, match="residual must be an ImageResidual, to be blurred; got"):
        jv.fit_coarse_to_fine(lambda x: x, jnp.float32(1.0))
    with pytest.raises(ValueError, match="blurs must hold at least one"):
        jv.fit_coarse_to_fine(residual, jnp.float32(1.0), blurs=())
    with pytest.raises(ValueError, match="blur must not be negative"):
        jv.fit_coarse_to_fine(residual, jnp.float32(1.0), blurs=(-0.5,))
    with pytest.raises(ValueError, match="checkpoint is of one fit"):
        jv.fit_coarse_to_fine(residual, jnp.float32(1.0), checkpoint="fit.npz")
