"""Are DICOM series read as the volumes that their slices make up, and incomplete or mixed ones refused?

The files are written by SimpleITK (GDCM), and changed on purpose.
"""

import locale

import numpy as np
import pytest

import jaxvol as jv
from jaxvol.formats import dicom


sitk = pytest.importorskip("SimpleITK", reason="SimpleITK is not installed: pip install jaxvol[io]")

SHAPE = (7, 6, 5)
DATA = np.random.default_rng(0).integers(0, 4000, SHAPE).astype(np.int16)
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


def write_slice(path, values, position, direction, tags=None, compressor=None):
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
    """Slices under names in another order than theirs. **Returns** their paths, from the first on.

    GDCM divides by the slope and subtracts the intercept as it writes, so that `DATA` are the values."""
    folder.mkdir(exist_ok=True)
    direction = np.eye(3) if direction is None else direction
    names = np.random.default_rng(1).permutation(SHAPE[2])
    values = (DATA // 2) * 2
    paths = []
    for z in range(SHAPE[2]):
        position = np.array(ORIGIN) + direction[:, 2] * z * SPACING[2]
        paths.append(
            write_slice(folder / f"IM{names[z]:03}.dcm", values[:, :, z], position, direction, **options)
        )
    return paths


VALUES = (DATA // 2) * 2


def test_a_shuffled_series_comes_out_sorted_and_rescaled(tmp_path):
    paths = write_series(tmp_path / "a")
    assert sorted(paths) != paths
    (tmp_path / "a" / "notes.txt").write_text("not DICOM")
    (tmp_path / "a" / "DICOMDIR").write_bytes(bytes(200))
    for path in (tmp_path / "a", paths[2]):
        volume = jv.load(path)
        np.testing.assert_array_equal(volume.data, read(paths))
        np.testing.assert_allclose(volume.spacing, SPACING, rtol=1e-6)
        np.testing.assert_allclose(volume.origin, ORIGIN, rtol=1e-6)
        assert volume.direction is None
    with pytest.raises(ValueError, match="shape and dtype are for raw files"):
        jv.load(tmp_path / "a", dtype="int16")


def read(paths):
    """The slices' values as SimpleITK reads each alone."""
    return np.stack([sitk.GetArrayFromImage(sitk.ReadImage(str(path)))[0].T for path in paths], axis=-1)


def test_slope_and_intercept_are_those_of_the_file(tmp_path):
    # the stored numbers, without their scale, from the bytes themselves
    path = write_series(tmp_path / "a")[0]
    stored = np.frombuffer(path.read_bytes()[-2 * 7 * 6 :], "<i2").reshape(6, 7).T
    np.testing.assert_array_equal(np.asarray(jv.load(tmp_path / "a").data)[:, :, 0], stored * 2.0 - 1024)


def test_each_slice_has_its_own_scale(tmp_path):
    paths = write_series(tmp_path / "a")
    content = paths[4].read_bytes()
    at = content.index(b"\x28\x00\x53\x10\x02\x00\x00\x00") + 8
    paths[4].write_bytes(content[:at] + b".5" + content[at + 2 :])
    data = np.asarray(jv.load(tmp_path / "a").data)
    stored = np.frombuffer(paths[4].read_bytes()[-2 * 7 * 6 :], "<i2").reshape(6, 7).T
    np.testing.assert_array_equal(data[:, :, 4], stored * 0.5 - 1024)
    np.testing.assert_array_equal(data[:, :, :4], read(paths[:4]))


@pytest.mark.parametrize("angles", [(20, 0, 0), (10, -25, 30)])
def test_an_oblique_series_lies_where_it_was_scanned(tmp_path, angles):
    direction = turned(*angles)
    paths = write_series(tmp_path / "a", direction)
    volume = jv.load(tmp_path / "a")
    np.testing.assert_allclose(np.array(volume.direction), direction, atol=1e-6)
    np.testing.assert_array_equal(volume.data, read(paths))
    np.testing.assert_allclose(volume.origin, ORIGIN, rtol=1e-6)


def test_a_sagittal_series_is_brought_along_the_axes_of_the_patient(tmp_path):
    direction = np.array([[0, 0, 1], [1, 0, 0], [0, -1, 0]], float)  # rows to the back, columns to the feet
    paths = write_series(tmp_path / "a", direction)
    volume = jv.load(tmp_path / "a")
    assert volume.direction is None
    np.testing.assert_array_equal(volume.data, read(paths).transpose(2, 0, 1)[:, :, ::-1])
    np.testing.assert_allclose(volume.spacing, (SPACING[2], SPACING[0], SPACING[1]), rtol=1e-6)
    np.testing.assert_allclose(volume.origin, (ORIGIN[0], ORIGIN[1], ORIGIN[2] - 5 * SPACING[1]), rtol=1e-6)


def gap(folder):
    write_series(folder)[2].unlink()


def copy(folder):
    (folder / "copy.dcm").write_bytes(write_series(folder)[1].read_bytes())


def mixed(folder):
    path = write_series(folder)[0]
    write_slice(path, DATA[:, :, 0], ORIGIN, np.eye(3), {"0020|000e": "9.9", "0008|103e": "head"})


def other_size(folder):
    write_slice(write_series(folder)[4], DATA[:5, :, 4], ORIGIN, np.eye(3))


def overview(folder):
    write_slice(write_series(folder)[0], DATA[:, :, 0], ORIGIN, turned(90, 0, 0))


def tilted(folder):
    for z, path in enumerate(write_series(folder)):
        write_slice(path, DATA[:, :, z], np.array(ORIGIN) + np.array([0, 0.5 * z, z * SPACING[2]]), np.eye(3))


def alone(folder):
    for path in write_series(folder)[1:]:
        path.unlink()


def truncated(folder):
    path = write_series(folder)[3]
    path.write_bytes(path.read_bytes()[:-1])


def no_place(folder):
    path = write_series(folder)[3]
    content = path.read_bytes()
    at = content.index(b"\x20\x00\x32\x00")  # image position
    path.write_bytes(content[:at] + b"\x20\x00\x33\x00" + content[at + 4 :])


def unreadable(folder):
    path = write_series(folder)[3]
    content = path.read_bytes()
    at = content.index(b"\x02\x00\x10\x00UI")
    length = int.from_bytes(content[at + 6 : at + 8], "little")
    uid = b"1.2.840.10008.1.2.4.201\x00"
    content = content[: at + 6] + len(uid).to_bytes(2, "little") + uid + content[at + 8 + length :]
    # the length of the meta information, its first element
    head = int.from_bytes(content[140:144], "little") + len(uid) - length
    path.write_bytes(content[:140] + head.to_bytes(4, "little") + content[144:])


def huge(folder):
    """65 500 rows and columns in 1.5 kB."""
    for path in write_series(folder):
        content = path.read_bytes()
        for tag in (b"\x28\x00\x10\x00\x02\x00\x00\x00", b"\x28\x00\x11\x00\x02\x00\x00\x00"):
            at = content.index(tag) + len(tag)
            content = content[:at] + (65500).to_bytes(2, "little") + content[at + 2 :]
        path.write_bytes(content)


def empty(folder):
    folder.mkdir()
    (folder / "notes.txt").write_text("nothing here")


BAD = {
    "a slice is missing": (
        gap,
        r"unevenly spaced slices, or some are missing: the median distance is 2\.5, .* are 5",
    ),
    "a slice is there twice": (
        copy,
        r"1 slices that lie where another one does: IM\d+.dcm and copy.dcm|copy",
    ),
    "two series": (mixed, r"holds 2 series \(.*(chest|head) \(.*file of the series"),
    "another size": (other_size, r"must agree; IM\d+.dcm has size \[\d\.0, 6\.0\]"),
    "an overview": (overview, r"must agree.*overview image"),
    "a tilted gantry": (tilted, r"shifted sideways by up to 2.*tilted gantry"),
    "one slice": (alone, "at least 2 slices"),
    "a file cut short": (truncated, r"IM\d+\.dcm cannot be read: corrupt, cut short"),
    "no position": (no_place, r"say where it lies: element \(0020,0032\) must be 3 numbers"),
    "HTJ2K": (unreadable, r"is stored as HTJ2K lossless \(transfer syntax 1\.2\.840\.10008\.1\.2\.4\.201\)"),
    "huge sizes": (huge, "cannot be read|cut short"),
    "no DICOM": (empty, "a directory without DICOM and TIFF files"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_series_is_refused_with_its_reason(tmp_path, case):
    make, message = BAD[case]
    make(tmp_path / "a")
    with pytest.raises(ValueError, match=message):
        jv.load(tmp_path / "a")


def test_one_of_two_series_is_chosen_by_a_file_of_it(tmp_path):
    paths = write_series(tmp_path / "a")
    for z in range(3):
        position = np.array(ORIGIN) + np.array([0, 0, 7.0 * z])
        write_slice(tmp_path / "a" / f"z{z}.dcm", DATA[:, :, z], position, np.eye(3), {"0020|000e": "9"})
    assert jv.load(paths[0]).shape == SHAPE
    other = jv.load(tmp_path / "a" / "z1.dcm")
    assert other.shape == (7, 6, 3)
    assert float(other.spacing[2]) == 7


def test_what_simpleitk_decompresses_is_read(tmp_path):
    slices = np.random.default_rng(2).integers(0, 4000, (64, 64, 2)).astype(np.int16)
    tags = {"0028|1052": "0", "0028|1053": "1"}
    for z in range(2):
        place = np.array([0.0, 0, z])
        for name in ("JPEG", "JPEG2000"):
            folder = tmp_path / name
            folder.mkdir(exist_ok=True)
            write_slice(folder / f"{z}.dcm", slices[:, :, z], place, np.eye(3), tags, name)
    for name, kind in (("JPEG", "JPEG lossless"), ("JPEG2000", "JPEG 2000")):
        syntax = dicom._meta(tmp_path / name / "0.dcm", dicom.SYNTAX)
        assert dicom.READABLE[str(syntax)].startswith(kind)
        np.testing.assert_array_equal(jv.load(tmp_path / name).data, slices)


def test_a_file_that_is_no_dicom_is_refused(tmp_path):
    (tmp_path / "a.dcm").write_bytes(b"no" * 100)
    with pytest.raises(ValueError, match="is no DICOM file"):
        jv.load(tmp_path / "a.dcm")


def test_a_slice_is_known_by_its_content_where_its_name_has_no_ending(tmp_path):
    paths = write_series(tmp_path / "a")
    for path in paths:
        path.rename(path.with_suffix(""))
    np.testing.assert_array_equal(jv.load(paths[1].with_suffix("")).data, VALUES)
    (tmp_path / "b").write_bytes(bytes(500))
    with pytest.raises(ValueError, match="has an unknown ending"):
        jv.load(tmp_path / "b")


def test_reports_beside_a_series_are_left_alone(tmp_path):
    paths = write_series(tmp_path / "a")
    content = paths[0].read_bytes()
    at = content.index(dicom.KIND)
    length = int.from_bytes(content[at + 6 : at + 8], "little")
    report = (dicom.STORAGE + "88.22\0").encode()
    changed = content[: at + 6] + len(report).to_bytes(2, "little") + report + content[at + 8 + length :]
    (tmp_path / "a" / "report.dcm").write_bytes(changed)
    np.testing.assert_array_equal(jv.load(tmp_path / "a").data, VALUES)


def test_an_unreadable_file_of_another_series_does_not_refuse_the_one_that_is_wanted(tmp_path):
    paths = write_series(tmp_path / "a")
    other = write_slice(
        tmp_path / "a" / "other.dcm", DATA[:, :, 0], ORIGIN, np.eye(3), {"0020|000e": "1.2.3.45"}
    )
    other.write_bytes(other.read_bytes()[:-40])
    np.testing.assert_array_equal(jv.load(paths[0]).data, VALUES)
    with pytest.raises(ValueError, match=r"other\.dcm .*give the path of one file of the series"):
        jv.load(tmp_path / "a")
    paths[-1].write_bytes(paths[-1].read_bytes()[:-40])  # one of its own slices
    with pytest.raises(ValueError, match=rf"{paths[-1].name} cannot be read"):
        jv.load(paths[0])


def test_rounded_directions_of_an_oblique_series_are_taken_as_meant(tmp_path):
    write_series(tmp_path / "a", np.round(turned(0, 45, 0), 3))
    np.testing.assert_allclose(np.asarray(jv.load(tmp_path / "a").direction), turned(0, 45, 0), atol=1e-6)


def test_what_is_named_as_a_slice_and_is_none_is_not_left_out_unsaid(tmp_path):
    paths = write_series(tmp_path / "a")
    (tmp_path / "a" / "._IM000.dcm").write_bytes(b"of a Mac")
    assert jv.load(tmp_path / "a").shape == SHAPE
    paths[-1].write_bytes(b"")
    for path in (tmp_path / "a", paths[0]):
        with pytest.raises(ValueError, match=rf"{paths[-1].name} is no DICOM file"):
            jv.load(path)
