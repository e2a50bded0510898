"""Faults of fits, plans and metrics."""

from dataclasses import replace

from . import Fault


def last_is_best(step):
    def faulty(self, *scene):
        run, loss = step(self, *scene)
        return replace(run, best=run.evaluated), loss

    return faulty


def as_if_equal(found):
    return found._replace(covariance=found.covariance_of_equal_noise)


FAULTS: list[Fault] = [
    Fault(
        "fit: the last point is given back, not the best",
        "fitting.driver:_Run.step",
        last_is_best,
        ("fitting/test_fit.py::test_what_diverges_gives_back_the_best_seen",),
    ),
    Fault(
        "fit: the covariance is that of the free numbers",
        "fitting.constraints:Free.moved",
        lambda moved: lambda self, free: list(free),
        ("fitting/test_fit.py::test_parameters_and_covariance_are_those_of_scipy",),
    ),
    Fault(
        "fit: standard errors are those of equal noise",
        "fitting.driver:uncertainty",
        lambda uncertainty: lambda *given: as_if_equal(uncertainty(*given)),
        (
            "fitting/test_fit.py::test_standard_errors_are_those_of_unequal_noise",
            "fitting/test_noise.py::test_standard_errors_cover_the_truth_where_noise_differs_tenfold_and_no_misfit_"
            "is_told",
        ),
    ),
    Fault(
        "fit: pixels without noise count in the reduced chi-squared",
        "fitting.noise:Noise.reduced_chi_squared",
        lambda reduced: lambda self, *given: reduced(replace(self, noisy=self.noisy * 10), *given),
        ("fitting/test_noise.py::test_pixels_without_noise_do_not_count_in_the_reduced_chi_squared",),
    ),
    Fault(
        "fit: any residual may be due to chance",
        "fitting.noise:Noise.largest_by_chance",
        lambda limit: property(lambda self: 1000 * limit.fget(self)),
        (
            "fitting/test_noise.py::test_published_templates_do_not_fit_path_traced_images_and_the_fit_says_so",
            "fitting/test_noise.py::test_noise_exceeds_the_limit_once_in_741_even_if_it_is_correlated_within_blocks",
        ),
    ),
    Fault(
        "fit by the path tracer: squares of the same paths",
        "fitting.path_traced:Averages.minimum",
        lambda minimum: lambda self, reach: minimum(replace(self, products=0 * self.products), reach),
        (
            "fitting/test_path_traced_fit.py::test_samples_of_independent_halves_lead_to_the_truth_as_near_as_is_said",
        ),
    ),
    Fault(
        "fit by the path tracer: the first steps are never forgotten",
        "fitting.path_traced:FORGET",
        lambda forget: 1e9,
        (
            "fitting/test_path_traced_fit.py::test_samples_of_independent_halves_lead_to_the_truth_as_near_as_is_said",
        ),
    ),
    Fault(
        "fit by the path tracer: no step is longer than 1 in the parameters' own unit",
        "fitting.bijections:REACH",
        lambda _: 0.0,
        ("fitting/test_path_traced_fit.py::test_any_unit_will_do[100.0]",),
    ),
    Fault(
        "fit by the path tracer: steps are not damped where noise hides a parameter",
        "fitting.path_traced:Averages.minimum",
        lambda minimum: lambda self, reach: minimum(self, 1e9 * reach),
        ("fitting/test_path_traced_fit.py::test_noise_moves_no_parameter_that_the_samples_do_not_show",),
    ),
    Fault(
        "fit: checkpoints of other fits are used",
        "fitting.checkpoints:load",
        lambda load: lambda path, like, about: load(path, like, {}),
        ("fitting/test_fit.py::test_a_checkpoint_of_another_fit_is_refused",),
    ),
    Fault(
        "fit: images are not blurred",
        "fitting.residuals:_blurring",
        lambda blurring: lambda n, sigma: blurring(n, 0 * sigma),
        ("fitting/test_fit.py::test_images_are_blurred_as_by_scipy",),
    ),
    Fault(
        "probe geometry: samples lie behind the motor axis",
        "march.transforms.toroidal_map:ToroidalMap.nearest_to_axis",
        lambda nearest: property(lambda self: nearest.fget(self) + self.b),
        ("fitting/test_probe_geometry.py::test_every_free_number_is_a_valid_probe_with_a_finite_slope",),
    ),
    Fault(
        "plan: an error that is known from a part of the image is taken as it is",
        "planning.probe:CONFIDENT",
        lambda errors: 0.0,
        ("planning/test_probe.py::test_from_a_part_the_error_is_a_bound_in_most_cases",),
    ),
    Fault(
        "wood grain: what noise has by chance counts",
        "metrics:_share_of_largest",
        lambda share: lambda m, n: 0.0,
        ("test_metrics.py::test_white_noise_is_no_structure",),
    ),
]
