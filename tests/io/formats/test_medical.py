"""Are medical images (MetaImage, NRRD, NIfTI) read as SimpleITK wrote them, along left, back and head?"""

import zlib

import numpy as np
import pytest

from jaxvol.io.formats import load

from .test_formats import ramp, raw_bytes, same, write


sitk = pytest.importorskip("SimpleITK", reason="SimpleITK is not installed: pip install jaxvol[io]")

ENDINGS = (".nii", ".nii.gz", ".mha", ".mhd", ".nrrd", ".nhdr")


def write_itk(path, data, spacing=(1, 1, 1), origin=(0, 0, 0), direction=None, compress=False):
    image = sitk.GetImageFromArray(np.ascontiguousarray(data.T))
    image.SetSpacing([float(s) for s in spacing])
    image.SetOrigin([float(o) for o in origin])
    image.SetDirection(np.ravel(np.eye(3) if direction is None else direction).tolist())
    sitk.WriteImage(image, str(path), compress)
    return path


@pytest.mark.parametrize("ending", [".mha", ".mhd", ".nrrd"])
def test_of_several_values_and_times_one_is_chosen(tmp_path, ending):
    film = np.arange(60 * 4, dtype="int16").reshape(4, 3, 4, 5)  # t, z, y, x
    vectors = np.stack(list(film), axis=-1)
    for name, image in {
        "film": sitk.JoinSeries([sitk.GetImageFromArray(each) for each in film]),
        "vectors": sitk.GetImageFromArray(vectors, isVector=True),
    }.items():
        image.SetSpacing([1, 2, 3, 4][: image.GetDimension()])
        sitk.WriteImage(image, str(tmp_path / f"{name}{ending}"))
    film_path, vectors_path = tmp_path / f"film{ending}", tmp_path / f"vectors{ending}"
    assert same(load(film_path, time=2), film[2].T, (1, 2, 3))
    with pytest.raises(ValueError, match=r"time must be given, from 0 to 3: .* holds x 5, y 4, z 3, t 4"):
        load(film_path)
    assert same(load(vectors_path), np.moveaxis(film.T, 3, -1), (1, 2, 3))
    assert same(load(vectors_path, channel=1), film[1].T, (1, 2, 3))


@pytest.mark.parametrize("spacings", ["0 1 1", "-1 1 1", "nan nan nan", "inf 1 1"])
def test_nrrd_spacings_that_are_no_lengths_are_refused(tmp_path, spacings):
    header = f"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 5 4 3\nencoding: raw\nspacings: {spacings}\n\n"
    with pytest.raises(ValueError, match="spacing"):
        load(write(tmp_path / "a.nrrd", header.encode() + raw_bytes(ramp())))


WIDE = [
    ("float64", 0, 1, "float32"),
    ("int32", -(2**15), 2**15 - 1, "int16"),
    ("uint32", 0, 2**16 - 1, "uint16"),
    ("int64", -1, 2**16 - 1, "float32"),
    ("int64", -(2**24), 2**24, "float32"),
    ("int32", 0, 2**24 + 1, None),
    ("uint64", 0, 2**64 - 1, None),
    ("int32", 0, 255, "uint8"),
]


def test_wide_types_become_those_of_a_volume_where_no_value_is_lost(tmp_path):
    for dtype, low, high, becomes in WIDE:
        data = np.zeros((5, 4, 3), dtype)
        data[0, 0, 0], data[-1, -1, -1] = low, high
        path = write_itk(tmp_path / "a.nrrd", data)
        if becomes:
            assert same(load(path), data.astype(becomes))
        else:
            with pytest.raises(ValueError, match=rf"a\.nrrd: data must .*got {dtype} from {low} to {high}"):
                load(path)


def test_what_is_no_whole_image_of_a_volume_is_refused_without_text_of_itk(tmp_path, capfd):
    for ending in (".mha", ".nrrd", ".nii"):
        sitk.WriteImage(sitk.Image([4, 4], sitk.sitkUInt8), str(tmp_path / f"flat{ending}"))
        with pytest.raises(ValueError, match="must be a 3-D image"):
            load(tmp_path / f"flat{ending}")
    noise = np.random.default_rng(0).integers(0, 250, (20, 20, 20)).astype("uint8")
    for ending in ENDINGS:
        for compress in (False, True):
            folder = tmp_path / f"{ending}{compress}"
            folder.mkdir()
            path = write_itk(folder / f"a{ending}", noise, compress=compress)
            held = max(folder.iterdir(), key=lambda file: file.stat().st_size)  # for .mhd, the data file
            held.write_bytes(held.read_bytes()[:-1000])
            with pytest.raises(ValueError, match=f"a{ending}"):
                load(path)
        with pytest.raises(ValueError, match=f"b{ending} cannot be read") as fault:
            load(write(tmp_path / f"b{ending}", b"not an image\n" * 99))
        assert "\n" not in str(fault.value)
        assert not any(word in str(fault.value) for word in ("ITK", ".cxx", "(0x", "ERROR"))
    assert capfd.readouterr().err == ""
    path = write_itk(tmp_path / "c.mhd", ramp(), compress=True)
    (tmp_path / "c.zraw").unlink()
    with pytest.raises(ValueError, match=r"c\.mhd cannot be read"):
        load(path)


@pytest.mark.parametrize(("msb", "order"), [(False, "<"), (True, ">")])
def test_a_metaimage_is_inflated_to_its_end_whatever_its_header_says_of_it(tmp_path, msb, order):
    # ITK reads CompressedDataSize bytes and leaves the rest unset, as in a well-known file of frog tissue
    packed = zlib.compress(raw_bytes(ramp("int16"), order))
    (tmp_path / "a.mhd").write_text(
        f"ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = {msb}\n"
        f"CompressedData = True\nCompressedDataSize = {len(packed) - 30}\n"
        "ElementSpacing = 1 2 3\nDimSize = 5 4 3\nElementType = MET_SHORT\nElementDataFile = a.zraw\n"
    )
    (tmp_path / "a.zraw").write_bytes(packed)
    assert same(load(tmp_path / "a.mhd"), ramp("int16"), (1, 2, 3))


VALUES = np.arange(24, dtype=np.uint8)


def write_mhd(path, content, *lines):
    (path.parent / "voxels.bin").write_bytes(content)
    header = [
        "NDims = 3",
        "DimSize = 4 3 2",
        "ElementType = MET_UCHAR",
        *lines,
        "ElementDataFile = voxels.bin",
    ]
    path.write_text("\n".join(header) + "\n")
    return path


def test_a_metaimages_voxels_may_be_a_part_of_another_file(tmp_path):
    expected, longer = VALUES.reshape(4, 3, 2, order="F"), b"\xff" * 10 + VALUES.tobytes()
    path = tmp_path / "a.mhd"
    for size in (-1, 10):
        assert same(load(write_mhd(path, longer, f"HeaderSize = {size}")), expected)
    write_mhd(path, longer, "HeaderSize = -1")
    np.testing.assert_array_equal(sitk.GetArrayFromImage(sitk.ReadImage(str(path))).T, expected)
    for told, message in (("-2", "HeaderSize must be"), ("ten", "HeaderSize must be"), ("11", "cut short")):
        with pytest.raises(ValueError, match=message):
            load(write_mhd(path, longer, f"HeaderSize = {told}"))
    with pytest.raises(ValueError, match="cut short"):
        load(write_mhd(path, longer[:10], "HeaderSize = -1"))
    doubles = write_mhd(path, VALUES.astype("<f8").tobytes())
    doubles.write_text(doubles.read_text().replace("MET_UCHAR", "MET_DOUBLE"))
    assert same(load(doubles), expected.astype(np.float32))
    doubles.write_text(doubles.read_text().replace("MET_DOUBLE", "MET_STRING"))
    with pytest.raises(ValueError, match=r"ElementType must be one of .*got 'MET_STRING'"):
        load(doubles)
    with pytest.raises(ValueError, match=r"BinaryData true; got 'MET_UCHAR' and 'False'"):
        load(write_mhd(path, b"1 " * 24, "BinaryData = False"))
    for spacing in ("1 1", "1 1 far"):
        with pytest.raises(ValueError, match=f"ElementSpacing must be 3 numbers; got '{spacing}'"):
            load(write_mhd(path, VALUES.tobytes(), f"ElementSpacing = {spacing}"))


@pytest.mark.parametrize("digits", [3, 4])
def test_directions_that_a_file_has_rounded_are_taken_as_meant(tmp_path, digits):
    half = 0.5**0.5
    meant = np.array([[half, 0, half], [0, 1, 0], [-half, 0, half]])
    text = " ".join(f"{number:g}" for number in np.round(meant, digits).T.ravel())
    path = write_mhd(tmp_path / "a.mhd", bytes(24), f"TransformMatrix = {text}")
    np.testing.assert_allclose(np.asarray(load(path).direction), meant, atol=1e-6)
    path = write_mhd(tmp_path / "a.mhd", bytes(24), f"TransformMatrix = {text.replace('0.7', '0.8')}")
    with pytest.raises(ValueError, match="its place must be three directions of length 1"):
        load(path)


def test_a_real_medical_volume_comes_out_scaled_and_whole(real_volume):
    data = np.asarray(load(real_volume("seg3d_mr_head.nii.gz")).data)
    assert (data.shape, data.min()) == ((160, 232, 160), 0)
    assert data.max() == pytest.approx(255 * 2.007843, rel=1e-5)
    assert data.mean(dtype=np.float64) == pytest.approx(55.6883 * 2.007843, rel=1e-4)
