"""Are files loaded as the volumes that their headers describe, and bad files refused with the reason?"""

import gzip
import io
import json
import pickle
import sys
import tracemalloc
import zipfile
import zlib

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import formats
from jaxvol._util import files
from jaxvol.formats import load, register, save
from jaxvol.volume import Volume


SHAPE = (5, 4, 3)
RAW_DTYPES = ("uint8", "int8", "uint16", "int16", "float16", "float32")


def ramp(dtype="uint8"):
    """A different value in every voxel, of both signs for signed types, so that no axes can be confused."""
    values = np.arange(60).reshape(SHAPE)
    return (values if np.dtype(dtype).kind == "u" else values - 20).astype(dtype)


def raw_bytes(data, order="<"):
    """The voxels' bytes, x fastest, in this byte order."""
    return data.astype(data.dtype.newbyteorder(order)).tobytes(order="F")


def write(path, content):
    path.write_bytes(gzip.compress(content) if path.name.endswith(".gz") else content)
    return path


def npy(data):
    stream = io.BytesIO()
    np.save(stream, data, allow_pickle=True)
    return stream.getvalue()


def npz(**arrays):
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def same(volume, data, spacing=(1, 1, 1), origin=(0, 0, 0)):
    assert volume.data.dtype == data.dtype
    np.testing.assert_array_equal(volume.data, data)
    np.testing.assert_allclose(volume.spacing, spacing, rtol=1e-6)
    np.testing.assert_allclose(volume.origin, origin, rtol=1e-6)
    return True


# Raw files


@pytest.mark.parametrize("ending", [".raw", ".raw.gz", ".RAW"])
@pytest.mark.parametrize("order", ["", "le", "be"])
@pytest.mark.parametrize("dtype", RAW_DTYPES)
def test_raw_round_trip_of_every_type_and_byte_order(tmp_path, dtype, order, ending):
    content = raw_bytes(ramp(dtype), ">" if order == "be" else "<")
    path = write(tmp_path / f"ramp_5x4x3_{dtype}{order}{ending}", content)
    assert same(load(path), ramp(dtype))


def test_x_is_fastest_in_a_raw_file(tmp_path):
    volume = load(write(tmp_path / "a_5x4x3_uint8.raw", bytes(range(60))))
    assert volume.shape == (5, 4, 3)
    assert [int(volume.data[v]) for v in ((1, 0, 0), (0, 1, 0), (0, 0, 1), (4, 3, 2))] == [1, 5, 20, 59]


def test_float64_follows_jax(tmp_path):
    path = write(tmp_path / "a_5x4x3_float64.raw", raw_bytes(ramp("float64")))
    assert same(load(path), ramp("float64").astype(jnp.asarray(0.0).dtype))


@pytest.mark.parametrize("dtype", ["int16be", "INT16BE", "Int16Be"])
def test_header_by_arguments(tmp_path, dtype):
    path = str(write(tmp_path / "plain.raw", raw_bytes(ramp("int16"), ">")))
    volume = load(path, shape=SHAPE, dtype=dtype, spacing=(1, 2, 3), origin=(4, 5, 6))
    assert same(volume, ramp("int16"), (1, 2, 3), (4, 5, 6))


@pytest.mark.parametrize("dtype", [np.uint16, np.dtype("uint16"), jnp.uint16])
def test_dtype_may_be_numpys_and_shape_an_array(tmp_path, dtype):
    path = write(tmp_path / "plain.raw", raw_bytes(ramp("uint16")))
    assert same(load(path, shape=np.array(SHAPE), dtype=dtype), ramp("uint16"))


@pytest.mark.parametrize("file", ["a.raw", "a.raw.gz"])
@pytest.mark.parametrize("appended", [True, False])
def test_header_by_json(tmp_path, file, appended):
    header = {"name": "A", "size": SHAPE, "type": "uint16be", "spacing": [1, 1, 2], "origin": [7, 8, 9]}
    (tmp_path / (f"{file}.json" if appended else "a.json")).write_text(json.dumps(header))
    volume = load(write(tmp_path / file, raw_bytes(ramp("uint16"), ">")))
    assert same(volume, ramp("uint16"), (1, 1, 2), (7, 8, 9))


def test_arguments_win_over_json_and_json_over_the_name(tmp_path):
    path = write(tmp_path / "a_3x4x5_int8.raw", raw_bytes(ramp()))
    assert load(path).shape == (3, 4, 5)
    beside = tmp_path / "a_3x4x5_int8.json"
    beside.write_text(json.dumps({"size": [4, 5, 3], "spacing": [2, 2, 2]}))
    volume = load(path)
    assert (volume.shape, volume.data.dtype, float(volume.spacing[0])) == ((4, 5, 3), "int8", 2.0)
    beside.write_text(
        json.dumps({"size": [4, 5, 3], "type": "float32", "spacing": [2, 2, 2], "origin": [1, 1, 1]})
    )
    assert same(
        load(path, shape=SHAPE, dtype="uint8", spacing=(3, 3, 3), origin=(5, 5, 5)),
        ramp(),
        (3,) * 3,
        (5,) * 3,
    )


def test_a_json_that_says_nothing_of_the_header_is_not_one(tmp_path):
    (tmp_path / "a_5x4x3_uint8.json").write_text('{"author": "me"}')
    assert same(load(write(tmp_path / "a_5x4x3_uint8.raw", raw_bytes(ramp()))), ramp())


# NumPy files


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", [*RAW_DTYPES, ">i2", ">f4"])
def test_npy_round_trip(tmp_path, dtype, order):
    np.save(tmp_path / "a.npy", np.asarray(ramp(dtype), order=order))
    native = np.dtype(dtype).name
    assert same(load(tmp_path / "a.npy", spacing=(1, 2, 3)), ramp(native), (1, 2, 3))


def test_npz_round_trip(tmp_path):
    labels = ramp("int16") % 3
    content = npz(data=ramp(), spacing=[1, 2, 3], origin=[4.0, 5, 6], labels=labels, more=[1])
    volume = load(write(tmp_path / "a.npz", content))
    assert same(volume, ramp(), (1, 2, 3), (4, 5, 6))
    np.testing.assert_array_equal(volume.labels, labels)
    assert same(load(tmp_path / "a.npz", spacing=(2, 2, 2), origin=(0, 0, 0)), ramp(), (2, 2, 2))


def test_npz_of_one_array_of_any_name(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", anything=ramp("float32"))
    assert same(load(tmp_path / "a.npz"), ramp("float32"))


# Bad files


class Bomb:
    """Fails the test if it is unpickled."""

    def __reduce__(self):
        return pytest.fail, ("a file was unpickled",)


def npy_header(shape):
    """The header of a .npy file of bytes of this shape, without any data."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "|u1", "fortran_order": False, "shape": shape})
    return stream.getvalue()


def zipped(**members):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return stream.getvalue()


def flipped(content, at):
    broken = bytearray(content)
    broken[at] ^= 0xFF
    return bytes(broken)


RAW = "a_5x4x3_uint8.raw"
GZ = "a_16x16x16_uint8.raw.gz"
PACKED = gzip.compress((np.arange(16**3) * 37).astype("uint8").tobytes())
NPY = npy(ramp())
BOMBS = np.full((2, 2, 2), Bomb())
HUGE = (2000, 1000, 1000)
NOT_FINITE = np.array([1, np.nan, 2, np.inf, 3, -np.inf, 4, 5], "float32").tobytes()

BAD_FILES = {
    "unknown ending": ("a.vti", b"II*", r"unknown ending; .*\.npy.*\.raw\.gz"),
    "empty": (RAW, b"", r"empty \(0 bytes\)"),
    "no header": ("a.raw", b"12", r"shape=.*name_XxYxZ_dtype\.raw.*a\.raw\.json"),
    "unknown dtype": ("a_5x4x3_rgb8.raw", b"1", "dtype must be uint8.*got 'rgb8'"),
    "zero axis": ("a_0x4x3_uint8.raw", b"1", r"shape must be three.*\(0, 4, 3\)"),
    "absurd shape": ("a_9999x9999x999999999_uint8.raw", b"1", r"less than 2\*\*31"),
    "axis of one voxel": ("a_60x1x1_uint8.raw", bytes(60), "at least 2 voxels.*60, 1, 1"),
    "cut short": (RAW, bytes(59), "cut short: it holds 59 bytes.*says 60"),
    "oversized": (RAW, bytes(90), "oversized: it holds 90 or more bytes.*says 60"),
    "NaN": ("a_2x2x2_float32.raw", NOT_FINITE, "data must be finite; got 3 of 8"),
    "gzip empty": (GZ, b"", r"empty \(0 bytes\)"),
    "gzip of too little": (GZ, gzip.compress(bytes(4095)), "cut short: it holds 4095 .*says 4096"),
    "gzip of too much": (GZ, gzip.compress(bytes(9999)), "oversized: it holds 4097 or more .*says 4096"),
    "gzip in name only": (GZ, bytes(4096), f"{GZ} cannot be read.*Not a gzipped file"),
    "gzip cut": (GZ, PACKED[:-20], f"{GZ} cannot be read.*ended before"),
    "gzip with bad checksum": (GZ, flipped(PACKED, -6), f"{GZ} cannot be read.*CRC"),
    "gzip with a flipped byte": (GZ, flipped(PACKED, len(PACKED) // 2), GZ),
    "npy empty": ("a.npy", b"", r"empty \(0 bytes\)"),
    "npy of objects": ("a.npy", npy(BOMBS), "type object.*pickles.*never read"),
    "npy that is a pickle": ("a.npy", pickle.dumps(Bomb()), r"no valid \.npy header"),
    "npy of text": ("a.npy", npy(np.full(SHAPE, "a")), "type <U1; expected integers"),
    "npy with a broken header": ("a.npy", NPY[:10] + b"{[(" + NPY[13:], r"no valid \.npy header"),
    "npy cut in its header": ("a.npy", NPY[:40], r"no valid \.npy header"),
    "npy cut short": ("a.npy", NPY[:-1], "cut short: it holds 59 .*says 60"),
    "npy oversized": ("a.npy", NPY + b"1", "oversized: it holds 61 .*says 60"),
    "npy promising too much": ("a.npy", npy_header(HUGE), "holds 0 bytes.*says 2000000000"),
    "npy beyond any volume": ("a.npy", npy_header((2**40,) * 3), r"1 to 2\*\*31 - 1 voxels"),
    "npy with a negative axis": ("a.npy", npy_header((-1, -1, 9)), r"voxels; got shape \(-1, -1, 9\)"),
    "npy of int64": ("a.npy", npy(ramp("int64") + 2**40), r"a\.npy: data must be whole numbers.*int64 from"),
    "npy in 2-D": ("a.npy", npy(np.ones((4, 4), "uint8")), r"shape \(4, 4\).*stack"),
    "npz in name only": ("a.npz", bytes(100), r"a\.npz cannot be read"),
    "npz of objects": ("a.npz", npz(data=BOMBS), "type object.*pickles.*never read"),
    "npz of several": ("a.npz", npz(a=ramp(), b=ramp()), r"called data.*\['a', 'b'\]"),
    "npz of no array": ("a.npz", zipped(data=b"hello"), r"no valid \.npy header"),
    "npz promising too much": ("a.npz", zipped(data=npy_header(HUGE)), "holds 0 bytes.*says 2000000000"),
    "npz with a flipped byte": ("a.npz", flipped(zipped(data=NPY), 170), r"a\.npz cannot be read.*CRC"),
    "npz with a spacing of two": (
        "a.npz",
        npz(data=ramp(), spacing=[1, 2]),
        r"spacing must have shape \(3,\)",
    ),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_a_bad_file_is_refused_with_its_reason(tmp_path, case):
    file, content, message = BAD_FILES[case]
    (tmp_path / file).write_bytes(content)
    with pytest.raises(ValueError, match=message):
        load(tmp_path / file)


def test_a_missing_file_and_a_directory_are_refused(tmp_path):
    with pytest.raises(ValueError, match=f"path: there is no file .*{RAW}"):
        load(tmp_path / RAW)
    (tmp_path / RAW).mkdir()
    for directory in (tmp_path, tmp_path / RAW):
        with pytest.raises(ValueError, match="is a directory"):
            load(directory)


@pytest.mark.parametrize("shape", [(5, 4), (5, 4, 3, 1), (5, 4, -3), (5.0, 4.0, 3.0), "543", 60, np.array(3)])
def test_a_bad_shape_is_refused(tmp_path, shape):
    with pytest.raises(ValueError, match="shape must be three positive integers"):
        load(write(tmp_path / "a.raw", b"1" * 60), shape=shape, dtype="uint8")


@pytest.mark.parametrize("dtype", ["uchar", "int32", "uint8xe", "le", "", 8, np.int64, np.dtype(">i2")])
def test_a_bad_dtype_is_refused(tmp_path, dtype):
    with pytest.raises(ValueError, match="dtype must be uint8"):
        load(write(tmp_path / "a.raw", b"1" * 60), shape=SHAPE, dtype=dtype)


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("{", "a.json is not JSON"),
        ("[" * 100_000, "a.json is not JSON"),
        ("\xff", "a.json is not JSON"),
        ("[5, 4, 3]", "must be a JSON object.*got list"),
        ('{"size": [5, 4], "type": "uint8"}', r"shape must be.*got \[5, 4\]"),
        ('{"size": [5, 4, 1e400], "type": "uint8"}', "shape must be.*inf"),
        ('{"size": [5, 4, 3], "type": null}', "dtype must be.*None"),
        ('{"size": [5, 4, 3], "type": "uint8", "spacing": "wide"}', "spacing must be numbers"),
        ('{"size": [5, 4, 3], "type": "uint8", "spacing": [0, 1, 1]}', "spacing must be positive"),
        ('{"size": [5, 4, 3], "type": "uint8", "origin": [NaN, 1, 1]}', "origin must be finite"),
    ],
)
def test_a_bad_json_is_refused(tmp_path, header, message):
    (tmp_path / "a.json").write_bytes(header.encode("latin-1"))
    with pytest.raises(ValueError, match=message):
        load(write(tmp_path / "a.raw", raw_bytes(ramp())))


@pytest.mark.parametrize("given", [{"shape": SHAPE}, {"dtype": "uint8"}])
@pytest.mark.parametrize("file", ["a.npy", "a.npz"])
def test_a_second_header_is_refused(tmp_path, file, given):
    np.save(tmp_path / "a.npy", ramp())
    np.savez(tmp_path / "a.npz", ramp())
    with pytest.raises(ValueError, match="shape and dtype are for raw files"):
        load(tmp_path / file, **given)


def sparse(path):
    """Write a sparse file of 8 GiB, which takes no disk space."""
    with path.open("wb") as stream:
        stream.truncate(2**33)


LOPSIDED = {
    "gzip bomb": ("a_8x8x8_uint8.raw.gz", lambda path: write(path, bytes(2**26))),
    "long file": ("a_8x8x8_uint8.raw", sparse),
    "gzip of nothing": ("a_2000x1000x1000_float32.raw.gz", lambda path: write(path, b"12")),
    "npy of nothing": ("a.npy", lambda path: write(path, npy_header(HUGE))),
    "npz of nothing": ("a.npz", lambda path: write(path, zipped(data=npy_header(HUGE)))),
}


@pytest.mark.parametrize("case", LOPSIDED)
def test_neither_a_file_nor_a_header_takes_memory_that_the_other_does_not_back(tmp_path, case):
    file, make = LOPSIDED[case]
    make(tmp_path / file)
    tracemalloc.start()
    with pytest.raises(ValueError, match="says"):
        load(tmp_path / file)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * files.CHUNK


def test_formats_may_be_added(tmp_path, monkeypatch):
    monkeypatch.setattr(formats, "READERS", dict(formats.READERS))

    def reader(path, header):
        header.refuse(path)
        return {"data": ramp(), "spacing": (1, 2, 3)}

    register(".Special.RAW", reader)
    path = write(tmp_path / "a_9x9x9_uint8.special.raw", b"1")
    assert same(load(path, origin=(1, 1, 1)), ramp(), (1, 2, 3), (1, 1, 1))
    with pytest.raises(ValueError, match="shape and dtype are for raw files"):
        load(path, shape=SHAPE)
    with pytest.raises(ValueError, match="ending must start with a dot"):
        register("vti", reader)


# Formats read by SimpleITK

ITK_ENDINGS = (".nii", ".nii.gz", ".mha", ".mhd", ".nrrd", ".nhdr")


@pytest.fixture
def sitk():
    return pytest.importorskip("SimpleITK", reason="SimpleITK is not installed: pip install jaxvol[io]")


def write_itk(sitk, path, data, spacing=(1, 1, 1), origin=(0, 0, 0), direction=None, compress=False):
    image = sitk.GetImageFromArray(np.ascontiguousarray(data.T))
    image.SetSpacing([float(s) for s in spacing])
    image.SetOrigin([float(o) for o in origin])
    image.SetDirection(np.ravel(np.eye(3) if direction is None else direction).tolist())
    sitk.WriteImage(image, str(path), compress)
    return path


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize("ending", ITK_ENDINGS)
def test_itk_round_trip(sitk, tmp_path, ending, compress):
    path = write_itk(sitk, tmp_path / f"a{ending}", ramp("int16"), (1, 2, 3), (4, 5, 6), compress=compress)
    assert same(load(path), ramp("int16"), (1, 2, 3), (4, 5, 6))
    assert same(load(path, spacing=(2, 2, 2), origin=(0, 0, 0)), ramp("int16"), (2, 2, 2))
    with pytest.raises(ValueError, match="shape and dtype are for raw files"):
        load(path, dtype="int16")


@pytest.mark.parametrize("ending", ITK_ENDINGS)
def test_a_turned_image_comes_out_along_left_back_and_head(sitk, tmp_path, ending):
    # axes of the file: toward the head, the right and the front
    direction = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    path = write_itk(sitk, tmp_path / f"a{ending}", ramp("int16"), (1, 2, 3), (10, 20, 30), direction)
    expected = ramp("int16").transpose(1, 2, 0)[::-1, ::-1, :]
    assert same(load(path), expected, (2, 3, 1), (10 - 3 * 2, 20 - 2 * 3, 30))


@pytest.mark.parametrize("ending", ITK_ENDINGS)
def test_an_oblique_image_keeps_its_voxels_and_its_direction(sitk, tmp_path, ending):
    c, s = np.cos(0.1), np.sin(0.1)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    path = write_itk(sitk, tmp_path / f"a{ending}", ramp("int16"), (1, 2, 3), (4, 5, 6), turn)
    volume = load(path)
    assert same(volume, ramp("int16"), (1, 2, 3), (4, 5, 6))
    np.testing.assert_allclose(np.array(volume.direction), turn, atol=1e-6)
    # turned by nearly a right angle as well, about z: the first axis to the back, the second to the right
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    volume = load(write_itk(sitk, path, ramp("int16"), (1, 2, 3), (4, 5, 6), turn @ quarter))
    corner = np.array([4, 5, 6]) + turn @ quarter @ (0, 3 * 2, 0)
    assert same(volume, ramp("int16").transpose(1, 0, 2)[::-1], (2, 1, 3), corner)
    np.testing.assert_allclose(np.array(volume.direction), turn, atol=1e-6)


def test_nifti_values_are_scaled(sitk, tmp_path):
    path = write_itk(sitk, tmp_path / "a.nii", ramp("int16"))
    content = bytearray(path.read_bytes())
    content[112:120] = np.array([0.5, -100], "float32").tobytes()  # scl_slope, scl_inter
    assert same(load(write(path, bytes(content))), ramp("float32") / 2 - 100)


@pytest.mark.parametrize(
    ("dtype", "low", "high", "becomes"),
    [
        ("float64", 0, 1, "float32"),
        ("int32", -(2**15), 2**15 - 1, "int16"),
        ("uint32", 0, 2**16 - 1, "uint16"),
        ("int64", -1, 2**16 - 1, "float32"),
        ("int64", -(2**24), 2**24, "float32"),
        ("int32", 0, 2**24 + 1, None),
        ("uint64", 0, 2**64 - 1, None),
        ("int32", 0, 255, "uint8"),
    ],
)
def test_wide_types_become_those_of_a_volume_where_no_value_is_lost(
    sitk, tmp_path, dtype, low, high, becomes
):
    data = np.zeros(SHAPE, dtype)
    data[0, 0, 0], data[-1, -1, -1] = low, high
    path = write_itk(sitk, tmp_path / "a.nrrd", data)
    if becomes:
        assert same(load(path), data.astype(becomes))
    else:
        with pytest.raises(ValueError, match=rf"a\.nrrd: data must .*got {dtype} from {low} to {high}"):
            load(path)


def test_images_that_are_not_3d_or_not_scalar_are_refused(sitk, tmp_path):
    for name, image in {
        "flat.mha": sitk.Image([4, 4], sitk.sitkUInt8),
        "film.nii": sitk.Image([4, 4, 4, 4], sitk.sitkUInt8),
        "vectors.nrrd": sitk.Image([4, 4, 4], sitk.sitkVectorFloat32, 3),
    }.items():
        sitk.WriteImage(image, str(tmp_path / name))
        with pytest.raises(ValueError, match="must be a 3-D image of one value per voxel"):
            load(tmp_path / name)


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize("ending", ITK_ENDINGS)
def test_an_itk_file_cut_short_is_refused(sitk, tmp_path, ending, compress):
    noise = np.random.default_rng(0).integers(0, 250, (20, 20, 20)).astype("uint8")
    path = write_itk(sitk, tmp_path / f"a{ending}", noise, compress=compress)
    held = max(tmp_path.iterdir(), key=lambda file: file.stat().st_size)  # for .mhd, the data file
    held.write_bytes(held.read_bytes()[:-1000])
    with pytest.raises(ValueError, match=f"a{ending}"):
        load(path)


def test_a_metaimage_without_its_other_file_is_refused(sitk, tmp_path):
    path = write_itk(sitk, tmp_path / "a.mhd", ramp(), compress=True)
    (tmp_path / "a.zraw").unlink()
    with pytest.raises(ValueError, match=r"a\.mhd cannot be read"):
        load(path)


@pytest.mark.parametrize(("msb", "order"), [(False, "<"), (True, ">")])
def test_a_metaimage_is_inflated_to_its_end_whatever_its_header_says_of_it(sitk, tmp_path, msb, order):
    # ITK reads CompressedDataSize bytes and leaves the rest unset, as in a well-known file of frog tissue
    packed = zlib.compress(raw_bytes(ramp("int16"), order))
    (tmp_path / "a.mhd").write_text(
        f"ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = {msb}\n"
        f"CompressedData = True\nCompressedDataSize = {len(packed) - 30}\n"
        "ElementSpacing = 1 2 3\nDimSize = 5 4 3\nElementType = MET_SHORT\nElementDataFile = a.zraw\n"
    )
    (tmp_path / "a.zraw").write_bytes(packed)
    assert same(load(tmp_path / "a.mhd"), ramp("int16"), (1, 2, 3))


def write_mhd(path, content, *lines, size="4 3 2", data="voxels.bin"):
    (path.parent / data).write_bytes(content)
    header = [
        "NDims = 3",
        f"DimSize = {size}",
        "ElementType = MET_UCHAR",
        *lines,
        f"ElementDataFile = {data}",
    ]
    path.write_text("\n".join(header) + "\n")
    return path


def test_a_metaimages_voxels_may_be_the_end_of_another_file(sitk, tmp_path):
    values = np.arange(24, dtype=np.uint8)
    path = write_mhd(tmp_path / "a.mhd", b"\xff" * 10 + values.tobytes(), "HeaderSize = -1")
    assert same(load(path), values.reshape(4, 3, 2, order="F"))
    np.testing.assert_array_equal(sitk.GetArrayFromImage(sitk.ReadImage(str(path))).T, load(path).data)
    path = write_mhd(tmp_path / "b.mhd", b"\xff" * 10 + values.tobytes(), "HeaderSize = 10")
    assert same(load(path), values.reshape(4, 3, 2, order="F"))
    for told, message in (("-2", "HeaderSize must be"), ("ten", "HeaderSize must be"), ("11", "cut short")):
        path = write_mhd(tmp_path / "c.mhd", b"\xff" * 10 + values.tobytes(), f"HeaderSize = {told}")
        with pytest.raises(ValueError, match=message):
            load(path)
    path = write_mhd(tmp_path / "d.mhd", b"\xff" * 10, "HeaderSize = -1")
    with pytest.raises(ValueError, match="cut short"):
        load(path)


def test_numbers_in_a_metaimages_text_fit_its_type(tmp_path):
    text = " ".join(map(str, range(24)))
    assert same(
        load(write_mhd(tmp_path / "a.mhd", text.encode(), "BinaryData = False")),
        np.arange(24, dtype=np.uint8).reshape(4, 3, 2, order="F"),
    )
    for wrong in ("300", "-1", "7.5", "nan"):
        path = write_mhd(tmp_path / "a.mhd", text.replace("23", wrong).encode(), "BinaryData = False")
        with pytest.raises(ValueError, match=rf"must hold integers from 0 to 255.*; got {wrong}"):
            load(path)
    for count in (23, 25, 10**6):
        path = write_mhd(tmp_path / "a.mhd", b"1 " * count, "BinaryData = False")
        with pytest.raises(ValueError, match=r"cut short|oversized"):
            load(path)


@pytest.mark.parametrize("digits", [3, 4])
def test_directions_that_a_file_has_rounded_are_taken_as_meant(tmp_path, digits):
    half = 0.5**0.5
    meant = np.array([[half, 0, half], [0, 1, 0], [-half, 0, half]])
    turn = np.round(meant, digits)
    text = " ".join(f"{number:g}" for number in turn.T.ravel())
    path = write_mhd(tmp_path / "a.mhd", bytes(24), f"TransformMatrix = {text}")
    np.testing.assert_allclose(np.asarray(load(path).direction), meant, atol=1e-6)
    path = write_mhd(tmp_path / "a.mhd", bytes(24), f"TransformMatrix = {text.replace('0.7', '0.8')}")
    with pytest.raises(ValueError, match="TransformMatrix must be orthogonal directions of length 1"):
        load(path)


def test_what_is_no_image_is_refused_without_text_of_itk(sitk, tmp_path, capfd):
    for ending in ITK_ENDINGS:
        with pytest.raises(ValueError, match=f"a{ending} cannot be read") as fault:
            load(write(tmp_path / f"a{ending}", b"not an image\n" * 99))
        assert "\n" not in str(fault.value)
        assert not any(word in str(fault.value) for word in ("ITK", ".cxx", "(0x", "ERROR"))
    assert capfd.readouterr().err == ""


def test_a_fault_that_only_itk_sees_is_told_in_one_line(sitk, tmp_path):
    path = save(Volume(ramp()), tmp_path / "a.nii")
    whole = bytearray(path.read_bytes())
    whole[70:72] = (9999).to_bytes(2, "little")  # the type of the voxels
    path.write_bytes(whole)
    with pytest.raises(ValueError, match=r"incomplete \(\S*a\.nii is not recognized as a NIFTI file\)\.$"):
        load(path)


def test_a_missing_simpleitk_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "SimpleITK", None)
    with pytest.raises(ImportError, match=r"pip install jaxvol\[io\]"):
        load(write(tmp_path / "a.nii", b"1"))


# Real volumes


@pytest.mark.parametrize(
    ("file", "shape", "dtype", "low", "high", "mean"),
    [
        ("engine_256x256x128_uint8.raw.gz", (256, 256, 128), "uint8", 0, 255, 22.3488),
        ("cthead_256x256x113_uint16le.raw.gz", (256, 256, 113), "uint16", 0, 3272, 379.5421),
        ("lidc0314_airway_256x192x200_int16le.raw.gz", (256, 192, 200), "int16", -1000, 1979, -286.5795),
    ],
)
def test_real_raw_volumes(real_volume, file, shape, dtype, low, high, mean):
    data = np.asarray(load(real_volume(file)).data)
    assert (data.shape, data.dtype, data.min(), data.max()) == (shape, dtype, low, high)
    assert data.mean(dtype=np.float64) == pytest.approx(mean, abs=1e-4)


def test_real_airway_lies_where_it_was_found(real_volume):
    data = load(real_volume("lidc0314_airway_256x192x200_int16le.raw.gz")).data
    assert np.mean(data[125:128, 46:49, 180:183]) < -920  # HU: air, in the trachea


@pytest.mark.parametrize(
    ("file", "shape", "high", "mean"),
    [
        ("seg3d_mr_head.nii.gz", (160, 232, 160), 255 * 2.007843, 55.6883 * 2.007843),
        ("ct_avm.nii.gz", (256, 242, 154), 255 * 2.208628, 2.3436 * 2.208628),
        ("vmtk_aorta.mha", (157, 393, 34), 2570.2048, 282.7251),
        ("us_spine_phantom.mha", (147, 106, 104), 251, 19.743),
        ("frogtissue.mhd", (500, 470, 136), 29, 0.38421),
    ],
)
def test_real_medical_volumes_come_out_scaled_and_whole(sitk, real_volume, file, shape, high, mean):
    volume = load(real_volume(file))
    data = np.asarray(volume.data)
    assert data.shape == shape
    assert data.min() == 0
    assert data.max() == pytest.approx(high, rel=1e-5)
    assert data.mean(dtype=np.float64) == pytest.approx(mean, rel=1e-4)
