"""Are DICOM series read as the volumes that their slices make up, and incomplete or mixed ones refused?

The files are written by SimpleITK (GDCM), and changed on purpose.
"""

import locale

import numpy as np
import pytest

import jaxvol as jv
from jaxvol.io.formats import dicom


sitk = pytest.importorskip("SimpleITK", reason="SimpleITK is not installed: pip install jaxvol[io]")

SHAPE = (7, 6, 5)
DATA = np.random.default_rng(0).integers(0, 4000, SHAPE).astype(np.int16)
VALUES = (DATA // 2) * 2
SPACING, ORIGIN = (0.7, 0.9, 2.5), (-100.0, -80.5, 12.25)


def turned(*degrees):
    """A matrix that turns about x, then y, then z."""
    matrix = np.eye(3)
    for axis, angle in enumerate(np.deg2rad(degrees)):
        c, s = np.cos(angle), np.sin(angle)
        i, j = [a for a in range(3) if a != axis]
        one = np.eye(3)
        one[i, i] = one[j, j] = c
        one[i, j], one[j, i] = (-s, s) if axis != 1 else (s, -s)
        matrix = one @ matrix
    return matrix


def write_slice(path, values, position, direction=None, tags=None, compressor=None):
    direction = np.eye(3) if direction is None else direction
    image = sitk.GetImageFromArray(np.ascontiguousarray(values.T)[None])
    image.SetSpacing((SPACING[0], SPACING[1], 1.0))
    fields = {
        "0008|0060": "CT",
        "0008|103e": "chest",
        "0020|000e": "1.2.3.4",
        "0020|0032": "\\".join(f"{p:.12g}"[:16] for p in position),
        "0020|0037": "\\".join(f"{d:.12f}"[:16] for d in direction[:, :2].T.ravel()),
        "0028|1052": "-1024",
        "0028|1053": "2",
        **(tags or {}),
    }
    for tag, value in fields.items():
        image.SetMetaData(tag, value)
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    writer.SetFileName(str(path))
    if compressor:
        writer.UseCompressionOn()
        writer.SetCompressor(compressor)
    before = locale.setlocale(locale.LC_ALL)
    writer.Execute(image)
    locale.setlocale(locale.LC_ALL, before)  # which GDCM sets to C, so that others would read text as ASCII
    return path


def write_series(folder, direction=None, **options):
    """Slices under names in another order than theirs. Returns their paths, from the first on.

    GDCM divides by the slope and subtracts the intercept as it writes, so that `VALUES` are read again."""
    folder.mkdir(exist_ok=True)
    direction = np.eye(3) if direction is None else direction
    paths = []
    for z, name in enumerate(np.random.default_rng(1).permutation(SHAPE[2])):
        position = np.array(ORIGIN) + direction[:, 2] * z * SPACING[2]
        paths.append(
            write_slice(folder / f"IM{name:03}.dcm", VALUES[:, :, z], position, direction, **options)
        )
    return paths


def edit(path, find, change):
    """Change what follows the first place where these bytes stand: `change` gets it, and returns it."""
    content = path.read_bytes()
    at = content.index(find) + len(find)
    path.write_bytes(content[:at] + change(content[at:]))


def with_value(rest, value):
    """An element's content, behind the tag and the type, with another value of a text's kind."""
    return len(value).to_bytes(2, "little") + value + rest[2 + int.from_bytes(rest[:2], "little") :]


def stored(path):
    """The numbers as stored, without their scale, from the bytes themselves."""
    return np.frombuffer(path.read_bytes()[-2 * 7 * 6 :], "<i2").reshape(6, 7).T


def test_a_shuffled_series_comes_out_sorted_and_rescaled(tmp_path):
    paths = write_series(tmp_path / "a")
    assert sorted(paths) != paths
    (tmp_path / "a" / "notes.txt").write_text("not DICOM")
    (tmp_path / "a" / "DICOMDIR").write_bytes(bytes(200))
    report = tmp_path / "a" / "report.dcm"  # left alone as well
    report.write_bytes(paths[0].read_bytes())
    edit(report, dicom.KIND, lambda rest: with_value(rest, (dicom.STORAGE + "88.22\0").encode()))
    for path in (tmp_path / "a", paths[2]):
        volume = jv.load(path)
        np.testing.assert_array_equal(volume.data, VALUES)
        np.testing.assert_allclose(volume.spacing, SPACING, rtol=1e-6)
        np.testing.assert_allclose(volume.origin, ORIGIN, rtol=1e-6)
        assert volume.direction is None
    np.testing.assert_array_equal(VALUES[:, :, 0], stored(paths[0]) * 2.0 - 1024)
    with pytest.raises(ValueError, match="shape and dtype are for raw files"):
        jv.load(tmp_path / "a", dtype="int16")
    # each slice has its own scale
    edit(paths[4], b"\x28\x00\x53\x10", lambda rest: rest[:4] + b".5" + rest[6:])
    data = np.asarray(jv.load(tmp_path / "a").data)
    np.testing.assert_array_equal(data[:, :, 4], stored(paths[4]) * 0.5 - 1024)
    np.testing.assert_array_equal(data[:, :, :4], VALUES[:, :, :4])


def test_a_series_lies_where_it_was_scanned(tmp_path):
    for name, direction in (("a", turned(20, 0, 0)), ("b", turned(10, -25, 30))):
        write_series(tmp_path / name, direction)
        volume = jv.load(tmp_path / name)
        np.testing.assert_allclose(np.array(volume.direction), direction, atol=1e-6)
        np.testing.assert_array_equal(volume.data, VALUES)
        np.testing.assert_allclose(volume.origin, ORIGIN, rtol=1e-6)
    write_series(tmp_path / "rounded", np.round(turned(0, 45, 0), 3))
    meant = np.asarray(jv.load(tmp_path / "rounded").direction)
    np.testing.assert_allclose(meant, turned(0, 45, 0), atol=1e-6)


def test_a_sagittal_series_is_brought_along_the_axes_of_the_patient(tmp_path):
    direction = np.array([[0, 0, 1], [1, 0, 0], [0, -1, 0]], float)  # rows to the back, columns to the feet
    write_series(tmp_path / "a", direction)
    volume = jv.load(tmp_path / "a")
    assert volume.direction is None
    np.testing.assert_array_equal(volume.data, VALUES.transpose(2, 0, 1)[:, :, ::-1])
    np.testing.assert_allclose(volume.spacing, (SPACING[2], SPACING[0], SPACING[1]), rtol=1e-6)
    np.testing.assert_allclose(volume.origin, (ORIGIN[0], ORIGIN[1], ORIGIN[2] - 5 * SPACING[1]), rtol=1e-6)


def tilted(folder, paths):
    for z, path in enumerate(paths):
        write_slice(path, DATA[:, :, z], np.array(ORIGIN) + np.array([0, 0.5 * z, z * SPACING[2]]))


def unreadable(folder, paths):
    uid = b"1.2.840.10008.1.2.4.201\x00"
    head = paths[3].read_bytes()
    longer = len(uid) - int.from_bytes(head[head.index(dicom.SYNTAX) + 6 :][:2], "little")
    edit(paths[3], dicom.SYNTAX, lambda rest: with_value(rest, uid))
    content = paths[3].read_bytes()  # the length of the meta information, its first element
    length = int.from_bytes(content[140:144], "little") + longer
    paths[3].write_bytes(content[:140] + length.to_bytes(4, "little") + content[144:])


def test_a_tilted_gantry_makes_a_sheared_volume(tmp_path):
    tilted(tmp_path, write_series(tmp_path))
    volume = jv.load(tmp_path)
    step = np.array([0, 0.5, SPACING[2]])
    expected = np.column_stack([np.eye(3)[:, :2], step / np.linalg.norm(step)])
    np.testing.assert_allclose(np.asarray(volume.direction), expected, atol=1e-6)
    np.testing.assert_allclose(volume.spacing, [*SPACING[:2], float(np.linalg.norm(step))], rtol=1e-6)
    np.testing.assert_allclose(volume.origin, ORIGIN, rtol=1e-6)


def replace(paths, *words):
    for path in paths:
        path.write_bytes(path.read_bytes().replace(*words, 1))


def test_values_shown_inverted_are_kept_as_stored(tmp_path):
    paths = {"scaled": write_series(tmp_path / "scaled")}
    for dtype in ("int16", "uint16", "uint8"):
        (tmp_path / dtype).mkdir()
        paths[dtype] = [tmp_path / dtype / f"{z}.dcm" for z in range(2)]
        for z, path in enumerate(paths[dtype]):
            tags = {"0028|1052": "0", "0028|1053": "1"}
            write_slice(path, (DATA[:, :, z] % 256).astype(dtype), np.add(ORIGIN, (0, 0, z)), tags=tags)
    for name, files in paths.items():
        before = np.asarray(jv.load(tmp_path / name).data)
        replace(files, b"MONOCHROME2 ", b"MONOCHROME1 ")
        np.testing.assert_array_equal(jv.load(tmp_path / name).data, before)


def test_spacing_is_that_of_the_detector_or_given_where_pixels_have_none(tmp_path):
    paths = write_series(tmp_path, np.array([[0, 0, 1], [1, 0, 0], [0, -1, 0]], float))
    expected = jv.load(tmp_path)
    pixel, imager, other = b"\x28\x00\x30\x00", b"\x18\x00\x64\x11", b"\x28\x00\x31\x00"
    replace(paths, pixel, imager)
    volume = jv.load(tmp_path)
    np.testing.assert_allclose(volume.spacing, expected.spacing, rtol=1e-6)
    np.testing.assert_array_equal(volume.data, expected.data)
    replace(paths, imager, other)
    with pytest.raises(ValueError, match=r"does not say how far .*PixelSpacing.* Give spacing=\(x, y, z\)"):
        jv.load(tmp_path)
    volume = jv.load(tmp_path, spacing=expected.spacing)
    np.testing.assert_allclose(volume.origin, expected.origin, rtol=1e-6)


def no_place(folder, paths):
    content = paths[3].read_bytes()
    paths[3].write_bytes(content.replace(b"\x20\x00\x32\x00", b"\x20\x00\x33\x00", 1))


def misspell(paths, element):
    for path in paths:
        edit(path, element, lambda rest: rest[:4] + b"a" + rest[5:])


def huge(folder, paths):
    """300 rows and columns in 1.5 kB."""
    for path in paths:
        for tag in (b"\x28\x00\x10\x00\x02\x00\x00\x00", b"\x28\x00\x11\x00\x02\x00\x00\x00"):
            edit(path, tag, lambda rest: (300).to_bytes(2, "little") + rest[2:])


OTHER = {"0020|000e": "9.9", "0008|103e": "head"}
BAD = {
    "a slice beside the others": (
        lambda folder, paths: write_slice(paths[2], DATA[:, :, 2], np.add(ORIGIN, (0, 0.5, 5))),
        r"evenly spaced.*; 0 too far along their normal, and 0\.5 sideways, lies IM\d+\.dcm",
    ),
    "a slice is missing": (
        lambda folder, paths: paths[2].unlink(),
        r"evenly spaced.*; 1 of 2\.5 mm is missing between IM\d+\.dcm and IM\d+\.dcm",
    ),
    "a slice is there twice": (
        lambda folder, paths: (folder / "copy.dcm").write_bytes(paths[1].read_bytes()),
        r"evenly spaced.*; 0 mm for 2\.5: a slice is repeated or shifted between .*\.dcm",
    ),
    "two series": (
        lambda folder, paths: write_slice(paths[0], DATA[:, :, 0], ORIGIN, tags=OTHER),
        r"holds several series: .*(chest|head) \(as IM\d+.dcm\).*file of the series",
    ),
    "an overview": (
        lambda folder, paths: write_slice(paths[0], DATA[:, :, 0], ORIGIN, turned(90, 0, 0)),
        r"must agree.*overview",
    ),
    "one slice": (lambda folder, paths: [path.unlink() for path in paths[1:]], "at least 2 slices"),
    "a file cut short": (
        lambda folder, paths: paths[3].write_bytes(paths[3].read_bytes()[:-1]),
        r"IM\d+\.dcm cannot be read: .*Is it cut short, or of a kind that is not supported",
    ),
    "no position": (
        lambda folder, paths: edit(
            paths[3], b"\x20\x00", lambda rest: rest.replace(b"\x20\x00\x32\x00", b"\x20\x00\x33\x00", 1)
        ),
        r"say where it lies: ImagePositionPatient must be 3 numbers; got ''",
    ),
    "no numbers as spacing": (
        lambda folder, paths: misspell(paths, b"\x28\x00\x30\x00"),
        r"PixelSpacing or ImagerPixelSpacing must be 2 positive numbers; got 'a",
    ),
    "no numbers as directions": (
        lambda folder, paths: misspell(paths, b"\x20\x00\x37\x00"),
        r"ImageOrientationPatient must be 6 numbers; got 'a",
    ),
    "HTJ2K": (unreadable, r"is stored in the transfer syntax 1\.2\.840\.10008\.1\.2\.4\.201, which"),
    "huge sizes": (huge, "cannot be read|cut short"),
    "no DICOM": (
        lambda folder, paths: [path.rename(path.with_suffix(".txt")).write_text("no") for path in paths],
        "a directory without DICOM and TIFF files",
    ),
    "an empty slice": (
        lambda folder, paths: (paths[4].write_bytes(b""), (folder / "._IM000.dcm").write_bytes(b"of a Mac")),
        r"IM\d+.dcm is no DICOM file",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_series_is_refused_with_its_reason(tmp_path, case):
    make, message = BAD[case]
    make(tmp_path / "a", write_series(tmp_path / "a"))
    with pytest.raises(ValueError, match=message):
        jv.load(tmp_path / "a")


def test_one_of_two_series_is_chosen_by_a_file_of_it(tmp_path):
    paths = write_series(tmp_path / "a")
    for z in range(3):
        place = np.array(ORIGIN) + np.array([0, 0, 7.0 * z])
        write_slice(tmp_path / "a" / f"z{z}.dcm", DATA[:, :, z], place, tags={"0020|000e": "9"})
    other = jv.load(tmp_path / "a" / "z1.dcm")
    assert (other.shape, float(other.spacing[2])) == ((7, 6, 3), 7)
    # what is no slice does not refuse the other
    write_slice(tmp_path / "a" / "flat.dcm", DATA[:, :1, 0], ORIGIN, tags={"0020|000e": "9"})
    np.testing.assert_array_equal(jv.load(paths[0]).data, VALUES)
    with pytest.raises(ValueError, match="must agree"):
        jv.load(tmp_path / "a" / "z1.dcm")


def test_what_simpleitk_decompresses_is_read(tmp_path):
    slices = np.random.default_rng(2).integers(0, 4000, (64, 64, 2)).astype(np.int16)
    for name, syntax in (("JPEG", "1.2.840.10008.1.2.4.70"), ("JPEG2000", "1.2.840.10008.1.2.4.90")):
        folder = tmp_path / name
        folder.mkdir()
        for z in range(2):
            tags = {"0028|1052": "0", "0028|1053": "1"}
            write_slice(folder / f"{z}.dcm", slices[:, :, z], (0, 0, z), tags=tags, compressor=name)
        assert dicom._meta(folder / "0.dcm", dicom.SYNTAX) == syntax
        np.testing.assert_array_equal(jv.load(folder).data, slices)


def test_a_slice_is_known_by_its_content_where_its_name_has_no_ending(tmp_path):
    paths = write_series(tmp_path / "a")
    for path in paths:
        path.rename(path.with_suffix(""))
    np.testing.assert_array_equal(jv.load(paths[1].with_suffix("")).data, VALUES)
    for name, content, message in (
        ("b", bytes(500), "has an unknown ending"),
        ("b.dcm", b"no" * 100, "is no DICOM file"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=message):
            jv.load(tmp_path / name)
