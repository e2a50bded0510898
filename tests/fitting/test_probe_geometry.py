"""Does `fit` find the geometry of a swept probe, and does it say what the data leave open?"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

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
NAMES = [".a", ".b", ".beta_range[0]", ".beta_range[1]", ".sigma_range[0]", ".sigma_range[1]", ".gamma_range"]


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


@eqx.filter_jit
def forward(bijection, free):
    return bijection.forward(free)


@pytest.mark.parametrize("name", PROBES)
def test_forward_undoes_inverse_and_free_numbers_are_of_order_one(name):
    probe = jv.ToroidalMap(*PROBES[name])
    for start in (probe, moved(probe, 0.01)):
        bijection = jv.ProbeGeometry(start)
        free = bijection.inverse(probe)
        size = float(probe.b + probe.gamma_range[1])
        np.testing.assert_allclose(flat(forward(bijection, free)), flat(probe), atol=2e-6 * size)
        assert np.abs(flat(free)).max() < 7  # log of MARGIN


def test_every_free_number_is_a_valid_probe_with_a_finite_slope():
    bijection = jv.ProbeGeometry(jv.ToroidalMap(*PROBES["apex behind the axis"]))
    start = bijection.inverse(bijection.start)

    @jax.jit
    @jax.vmap
    def at(free):
        _, unravel = ravel_pytree(start)

        def numbers(free):
            return ravel_pytree(bijection.forward(unravel(free)))[0]

        return numbers(free), jax.jacfwd(numbers)(free)

    draws = np.random.default_rng(0).normal(size=(200, 7)).astype(np.float32)
    draws[100:] *= 5
    probes, slopes = (np.asarray(part, float) for part in at(draws))
    a, b, b0, b1, s0, s1, first, last = probes.T
    for low, high in ((b0, b1), (s0, s1)):
        assert np.all((low >= 0) & (high >= low) & (high <= np.float32(np.pi)))
    assert np.all((b + first > 0) & (last > first))
    nearest = a + (b + first) * np.sin([s0, s1]).min(axis=0)  # of the outermost beams, to the motor axis
    assert np.all(nearest > -1e-5 * (np.abs(a) + b + last))
    assert np.isfinite(slopes).all()


class Placed(eqx.Module):
    """How far fixed places in the grid lie from where they are known to be: a module, so that all fits of it
    share a program."""

    target: jax.Array

    def __call__(self, probe):
        return placed(probe) - self.target


@eqx.filter_jit
def placed(probe):
    """World points of fixed places in the grid, by 100 mm."""
    ends = jnp.stack([probe.beta_range, probe.sigma_range, probe.gamma_range])
    points = jnp.asarray(np.random.default_rng(0).uniform(0.05, 0.95, (60, 3)), ends.dtype)
    return probe.to_world(ends[None, :, 0] + points * (ends[:, 1] - ends[:, 0])[None]) / 100


@pytest.mark.parametrize("name", ["across the middle", "apex behind the axis"])
def test_a_probe_is_found_from_points_twenty_percent_off(name):
    truth = jv.ToroidalMap(*PROBES[name])
    target = np.asarray(placed(truth))
    noise = 1e-3 * np.random.default_rng(1).normal(size=target.shape).astype(np.float32)
    start = moved(truth, 0.2 if name == "across the middle" else 0.05)
    found, noisy = (jv.fit(Placed(jax.device_put(target + n)), start) for n in (0 * noise, noise))
    np.testing.assert_allclose(flat(found.parameters), flat(truth), rtol=1e-3, atol=1e-4)
    assert noisy.uncertainty is not None
    assert noisy.uncertainty.names == NAMES
    assert noisy.uncertainty.undetermined == []
    off = np.delete(flat(noisy.parameters) - flat(truth), 6)
    assert 0 < np.abs(off / np.sqrt(np.diag(noisy.uncertainty.covariance))).max() < 3.5


BAD = {
    "no probe to start from": (lambda: jv.ProbeGeometry((20.0, 30.0)), "start must be a ToroidalMap; got a"),
    "no probe": (
        lambda: jv.ProbeGeometry(jv.ToroidalMap(*PROBES["b below 0"])).inverse(3.0, "probe"),
        "probe must be a ToroidalMap; got 3.0",
    ),
    "samples behind the axis": (
        lambda: Free.of(jv.ToroidalMap(-26.0, 30.0, (1, 2), (1, 2), (0, 60)), None, None),
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


@pytest.mark.slow
def test_a_probe_is_found_from_images_twenty_percent_off_within_half_a_percent():
    """Spheres, wires and speckle, from two known cameras, with noise of 1 %, in converged references; from
    coarse to fine. The covariance says how far off the numbers are, and that the scene determines them."""
    scene, truth = experiment.phantom(48, seed=0)
    targets = experiment.views(scene, truth, experiment.cameras(24), experiment.NOISE, 0, 8)
    start = experiment.moved(truth, np.array([1, -1, -1, 1, 1, 1, -1]))
    row = experiment.recovered(scene, targets, truth, start)
    assert row["worst"] < 0.005
    assert row["undetermined"] == []
    ratios = [row["errors"][name] / row["standard errors"][name] for name in experiment.NAMES]
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.7


@pytest.mark.slow
def test_the_covariance_says_which_numbers_the_scene_leaves_open():
    """Of shells through a window, whose ends are not in view, the angles at which the beams end."""
    found = experiment.left_open("shells through a window", 24, 16, 0)["standard errors"]
    left_open = [name for name, error in found.items() if not np.isfinite(error)]
    assert left_open == ["first β", "last β", "first σ", "last σ"]
    assert all(error > 0 for error in found.values())
