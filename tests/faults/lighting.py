"""Faults of light, and path tracing."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from . import Fault


PHOTONS, SHADING = "lighting/test_photons.py::", "lighting/test_shading.py::"
PHONG, PATHS = "lighting/test_phong.py::", "path_tracing/test_path_trace.py::"
SLOPES, REPLAY = "path_tracing/test_derivatives.py::", "path_tracing/test_replay.py::"
TRANSPORT, LIGHT_FIT = "lighting/test_transport.py::", "fitting/test_light_fit.py::"


def between_ends(values, extinction, low, high):
    return jnp.maximum(jnp.interp(low, values, extinction), jnp.interp(high, values, extinction))


FAULTS: list[Fault] = [
    Fault(
        "light: what lies behind a photon does not hide it",
        "lighting.photons:PhotonShading._visible",
        lambda f: (
            lambda self, offset, extinctions: f(
                self, offset, [extinctions[0]] + [0 * e for e in extinctions[1:]]
            )
        ),
        (f"{PHOTONS}test_each_step_is_that_of_the_paper",),
    ),
    Fault(
        "light: a material shines by itself at its soft edge",
        "lighting.photons:_matter",
        lambda f: sum,
        (
            f"{PHOTONS}test_what_is_no_material_keeps_its_colour_and_materials_do_not_shine_by_themselves[soft]",
        ),
    ),
    Fault(
        "light: the loop over photons ends before the cutoff is reached",
        "lighting.photons:PhotonShading.thresholds",
        lambda f: lambda self: 2 * f(self),
        (f"{SHADING}test_samples_shaded_together_are_shaded_as_each_alone[hard]",),
    ),
    Fault(
        "light: photons lie as far away whatever the mean free path is",
        "lighting.packet_tree:PacketTree.template",
        lambda f: (
            lambda self, optics, *more: f(
                self, optics._replace(mean_free_path=0.3 + 0 * optics.mean_free_path), *more
            )
        ),
        (f"{LIGHT_FIT}test_a_scan_finds_the_mean_free_path_and_brightness_of_a_render_of_templates[hard]",),
    ),
    Fault(
        "light: volumes of colours are refused whatever their materials are",
        "lighting.template_lighting:ScattererTemplates.reads_value",
        lambda _: property(lambda self: True),
        ("lighting/test_arguments.py::test_volumes_of_colours_are_lit_if_materials_are_labels[published]",),
    ),
    Fault(
        "light: photons below the threshold are kept",
        "lighting.packet_tree:PacketTree.faded",
        lambda f: lambda self, opacity, light: light,
        ("lighting/test_template.py::test_a_conserving_template_holds_what_the_threshold_leaves",),
    ),
    Fault(
        "light: materials have as many levels as the one that has most",
        "lighting.packet_tree:PacketTree.template",
        lambda f: lambda self, optics, key, levels, merge, own=None: f(self, optics, key, levels, merge),
        (
            "lighting/test_template.py::"
            "test_whole_levels_are_those_of_each_material_and_depend_on_nothing_traced",
        ),
    ),
    Fault(
        "light: nothing shadows a sample but what is near",
        "lighting.transport:interpolated",
        lambda f: lambda rows, at: f(rows, at) * (rows.shape[-1] == 3),
        (f"{TRANSPORT}test_light_is_that_of_path_tracing[sun]",),
    ),
    Fault(
        "light: flights are longer than the mean free path",
        "lighting.transport:unit_walks",
        lambda f: lambda *given: (lambda turns, lengths: (turns, 1.5 * lengths))(*f(*given)),
        (f"{TRANSPORT}test_light_is_that_of_path_tracing[sky]",),
    ),
    Fault(
        "light: of flights, none leaves",
        "lighting.transport:_ending",
        lambda f: lambda *given: (f(*given)[0], 0 * f(*given)[1] + 1),
        (f"{TRANSPORT}test_flights_end_as_often_as_light_is_scattered",),
    ),
    Fault(
        "light: flights end as they do, whatever the derivative of the matter they meet",
        "lighting.transport:_ending",
        lambda f: lambda extinction, *of: f(jax.lax.stop_gradient(extinction), *of),
        (f"{TRANSPORT}test_light_changes_with_the_mean_free_path_as_its_derivative_says",),
    ),
    Fault(
        "light: flights look at the same places each time",
        "lighting.transport:_looks",
        lambda f: lambda rate, length, u: f(rate, length, 0 * u),
        (f"{TRANSPORT}test_flights_end_as_often_as_light_is_scattered",),
    ),
    Fault(
        "light: by transport, what is clipped away lets light in",
        "march.transforms.clip:_Clipped.whole",
        lambda _: property(lambda self: self),
        (f"{TRANSPORT}test_light_is_that_of_the_whole_volume_where_it_is_clipped",),
    ),
    Fault(
        "light: where two materials meet, some of the matter is in neither",
        "lighting.materials:smoothstep",
        lambda f: lambda x: f(x) * f(x),
        (f"{TRANSPORT}test_where_two_materials_meet_nothing_is_in_neither",),
    ),
    Fault(
        "light by transport: computed while something is traced, it is kept as tracers",
        "lighting.template_lighting:computed_now",
        lambda f: lambda function, *of: function(*of),
        (f"{TRANSPORT}test_light_that_was_computed_inside_a_program_serves_outside",),
    ),
    Fault(
        "Phong: samples are shaded where their cells begin",
        "engine.shading:_inline_sample",
        lambda f: lambda pipeline, ray, cell: f(pipeline, ray, replace(cell, width=0 * cell.width)),
        (f"{PHONG}test_images_are_those_of_the_reference",),
    ),
    Fault(
        "path tracing: a majorant overlooks control points between its ends",
        "_util.piecewise_linear:upper_bound_between",
        lambda f: between_ends,
        ("path_tracing/test_tracking.py::test_no_extinction_exceeds_its_majorant",),
    ),
    Fault(
        "path tracing: what survives Russian roulette is not raised",
        "path_tracing.walks:_roulette",
        lambda f: lambda importance, uniform: (jnp.where(importance > 0.25 * uniform, 1.0, 0.0), importance),
        (f"{PATHS}test_light_scattered_many_times_is_reflected_as_by_chandrasekhar",),
    ),
    Fault(
        "path tracing: derivatives are by the paths of images, which nothing that is transparent scatters",
        "path_tracing.likelihood:OF_DERIVATIVES",
        lambda f: f._replace(margin=1, collisions=0),
        (f"{SLOPES}test_derivatives_of_light_scattered_once_are_those_of_quadrature_and_errors_are_as_told",),
    ),
    Fault(
        "path tracing: the probability of a direction counts as a constant",
        "path_tracing.likelihood:likelihood",
        lambda f: jnp.ones_like,
        (f"{SLOPES}test_derivatives_of_light_scattered_often_are_those_of_images_of_the_same_key",),
    ),
    Fault(
        "path tracing: a factor of 0 of a throughput has no gradient in reverse mode",
        "path_tracing.walks:DARK",
        lambda _: -1.0,
        (f"{REPLAY}test_the_gradient_is_that_of_forward_mode",),
    ),
    Fault(
        "path tracing: light from lights has no gradient in reverse mode",
        "path_tracing.replay:Replay.advanced",
        lambda f: lambda self, ahead: f(self, ahead)._replace(transmittance=self.transmittance),
        (
            f"{REPLAY}test_the_gradient_is_that_of_forward_mode",
            f"{REPLAY}test_the_gradient_by_voxels_is_that_of_quadrature",
        ),
    ),
]
