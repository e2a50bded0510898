"""Faults of readers, writers, the command, the viewer, what is shown by default."""

from contextlib import contextmanager

import equinox as eqx
import jax.numpy as jnp

from . import Fault


@contextmanager
def in_place(path):
    yield path


class Everything:
    def __contains__(self, _):
        return True


def all_shown(transfer):
    return eqx.tree_at(
        lambda t: (t.shown, t.opacity), transfer, (transfer.shown | True, 0 * transfer.opacity + 1)
    )


FAULTS: list[Fault] = [
    Fault(
        "command: control characters of a file reach the terminal",
        "_util.checks:printable",
        lambda _: lambda text: text,
        ("app/commands/test_command.py::test_bad_files_are_told_in_one_line",),
    ),
    Fault(
        "DICOM: slices in the order of their names",
        "io.formats.dicom:_values",
        lambda values: lambda slices: values(sorted(slices, key=lambda each: each.file)),
        ("io/formats/test_dicom.py::test_a_shuffled_series_comes_out_sorted_and_rescaled",),
    ),
    Fault(
        "files: an axis is reversed, and the origin stays",
        "_util.image_record:ImageRecord.oriented",
        lambda oriented: lambda record, sizes, **how: oriented(record, (1, 1, 1), **how),
        ("io/formats/test_places.py::test_a_box_comes_back_at_its_place_with_its_values[by_simple_itk]",),
    ),
    Fault(
        "files: a scale is not applied",
        "_util.image_record:ImageRecord.decode",
        lambda _: lambda record, stored: (stored, None),
        ("io/formats/test_meaning.py::test_a_calibration_of_imagej_and_of_gdal_gives_values",),
    ),
    Fault(
        "pictures: padding is a class of its own",
        "app.automatic:_strays",
        lambda _: lambda kinds, counts, most: 0,
        ("app/test_automatic.py::test_padding_fill_values_and_strays_are_no_class[circle--3024]",),
    ),
    Fault(
        "files: any shear is taken for rounding",
        "_util.affine:SHEARED",
        lambda _: 1.0,
        (
            "io/formats/test_dicom.py::test_a_tilted_gantry_makes_a_sheared_volume",
            "io/formats/test_save.py::test_a_volume_comes_back_as_it_was[.nrrd]",
            "io/formats/test_nifti.py::test_voxels_lie_and_are_scaled_as_nibabel_says",
        ),
    ),
    Fault(
        "files: ids are numbered, and lost",
        "_util.image_record:numbered",
        lambda numbered: lambda ids: {"data": numbered(ids)["data"]},
        ("io/formats/test_save.py::test_ids_of_labels_are_numbered_and_kept",),
    ),
    Fault(
        "Kretz: uneven angles are taken as even ones",
        "io.formats.kretz:UNEVEN",
        lambda _: 1.0,
        ("io/formats/test_kretz.py::test_a_bad_file_is_refused_with_its_reason[uneven angles]",),
    ),
    Fault(
        "files: a file is written in place, and left half written after an error",
        "_util.whole_files:whole_file",
        lambda _: in_place,
        ("_util/test_whole_files.py::test_after_an_error_all_is_as_it_was",),
    ),
    Fault(
        "command: the light does not reach the image",
        "app.picture:_lighting",
        lambda _: lambda options, mode, **_how: None,
        ("app/commands/test_render.py::test_options_of_the_look_make_the_scene[an isosurface]",),
    ),
    Fault(
        "display: sRGB without its linear part",
        "_util.srgb:to_srgb",
        lambda _: lambda linear: 1.055 * jnp.clip(jnp.asarray(linear), 0, 1) ** (1 / 2.4) - 0.055,
        ("io/test_display.py::test_srgb_and_back",),
    ),
    Fault(
        "viewer: a drag turns what is seen against the pointer",
        "app.viewer.state:Orbit.turned",
        lambda turned: lambda self, right, down: turned(self, -right, -down),
        ("app/viewer/test_orbit.py::test_the_front_of_what_is_seen_follows_a_drag",),
    ),
    Fault(
        "viewer: a fine image is finished before a newer request is drawn",
        "app.viewer.model:Model._cancelled",
        lambda _: lambda self, seconds: False,
        ("app/viewer/test_requests.py::test_a_newer_request_cancels_a_fine_image_between_two_parts",),
    ),
    Fault(
        "viewer: pages of others may connect",
        "app.viewer.page:OWN_NAMES",
        lambda _: Everything(),
        ("app/viewer/test_page.py::test_only_its_own_pages_may_connect",),
    ),
    Fault(
        "labels: the node below instead of the nearest",
        "scene.volume:Volume.label",
        lambda label: lambda self, coordinate: label(self, tuple(c - 0.5 for c in coordinate)),
        ("scene/test_volume.py::test_values_are_trilinear_and_voxels_keep_their_type[uint8]",),
    ),
    Fault(
        "labels: hidden ones are not leapt over",
        "scene.labels:LabelTransferFunction._greatest",
        lambda greatest: lambda self, *given: greatest(all_shown(self), *given),
        ("scene/test_labels.py::test_hidden_labels_are_leapt_over",),
    ),
    Fault(
        "direction: rows are taken for columns",
        "_util.vec3:Frame.of",
        lambda of: classmethod(lambda cls, direction: of.__func__(cls, direction.T)),
        ("march/test_direction.py::test_nodes_lie_where_numpy_puts_them",),
    ),
    Fault(
        "GPU: zeros are added, all to the same place",
        "xla.memory:without_zeros",
        lambda _: lambda index, rows, end: index,
        ("xla/test_memory.py::test_zeros_are_left_out_and_the_rows_of_one_index_are_dealt_to_copies",),
    ),
]
