"""Are files loaded as the volumes that their headers describe, and bad files refused with the reason?"""

import gzip
import io
import json
import os
import pickle
import sys
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol._util import files
from jaxvol.io.formats import READERS, load


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


def test_raw_files_of_every_type_and_byte_order(tmp_path):
    for dtype in RAW_DTYPES:
        for order in ("", "le", "be"):
            content = raw_bytes(ramp(dtype), ">" if order == "be" else "<")
            for ending in (".raw", ".raw.gz", ".RAW"):
                assert same(load(write(tmp_path / f"a_5x4x3_{dtype}{order}{ending}", content)), ramp(dtype))
    doubles = write(tmp_path / "a_5x4x3_float64.raw", raw_bytes(ramp("float64")))
    assert same(load(doubles), ramp("float64").astype(jnp.result_type(float)))
    x_fastest = np.asarray(load(write(tmp_path / "b_5x4x3_uint8.raw", bytes(range(60)))).data)
    assert [int(x_fastest[v]) for v in ((1, 0, 0), (0, 1, 0), (0, 0, 1), (4, 3, 2))] == [1, 5, 20, 59]


def test_arguments_win_over_json_and_json_over_the_name(tmp_path):
    path = write(tmp_path / "plain.raw", raw_bytes(ramp("int16"), ">"))
    place: dict[str, Any] = {"spacing": (1, 2, 3), "origin": (4, 5, 6)}
    for shape, dtype in ((SHAPE, "int16be"), (np.array(SHAPE), "Int16Be")):
        assert same(load(str(path), shape=shape, dtype=dtype, **place), ramp("int16"), *place.values())
    path = write(tmp_path / "plain.raw", raw_bytes(ramp("uint16")))
    for dtype in (np.uint16, np.dtype("uint16"), jnp.uint16):
        assert same(load(path, shape=SHAPE, dtype=dtype), ramp("uint16"))

    path, beside = write(tmp_path / "a_3x4x5_int8.raw", raw_bytes(ramp())), tmp_path / "a_3x4x5_int8.json"
    beside.write_text('{"author": "me"}')
    assert load(path).shape == (3, 4, 5)
    beside.write_text(json.dumps({"size": [4, 5, 3], "spacing": [2, 2, 2]}))
    assert same(load(path), ramp().astype("int8").reshape(-1, order="F").reshape(4, 5, 3, order="F"), [2] * 3)
    beside.write_text(
        json.dumps({"size": [4, 5, 3], "type": "float32", "spacing": [2] * 3, "origin": [1] * 3})
    )
    given = load(path, shape=SHAPE, dtype="uint8", spacing=(3, 3, 3), origin=(5, 5, 5))
    assert same(given, ramp(), (3, 3, 3), (5, 5, 5))


def test_the_page_of_files_names_every_ending():
    page = (Path(__file__).parents[3] / "docs" / "files.md").read_text(encoding="utf-8")
    rows = " ".join(line.split("|")[1] for line in page.splitlines() if line.startswith("| "))
    assert [ending for ending in READERS if f"`{ending}`" not in rows] == []


def test_a_json_file_is_found_under_either_name(tmp_path):
    header = {"name": "A", "size": SHAPE, "type": "uint16be", "spacing": [1, 1, 2], "origin": [7, 8, 9]}
    for file in ("a.raw", "b.raw.gz"):
        for beside in (f"{file}.json", f"{file[0]}.json"):
            (tmp_path / beside).write_text(json.dumps(header))
            volume = load(write(tmp_path / file, raw_bytes(ramp("uint16"), ">")))
            assert same(volume, ramp("uint16"), (1, 1, 2), (7, 8, 9))
            (tmp_path / beside).unlink()


def test_files_of_numpy(tmp_path):
    for dtype in (*RAW_DTYPES, ">i2", ">f4"):
        for order in ("C", "F"):
            np.save(tmp_path / "a.npy", np.asarray(ramp(dtype), order=order))
            assert same(load(tmp_path / "a.npy", spacing=(1, 2, 3)), ramp(np.dtype(dtype).name), (1, 2, 3))
    labels = ramp("int16") % 3
    content = npz(data=ramp(), spacing=[1, 2, 3], origin=[4.0, 5, 6], labels=labels, more=[1])
    volume = load(write(tmp_path / "a.npz", content))
    assert same(volume, ramp(), (1, 2, 3), (4, 5, 6))
    np.testing.assert_array_equal(volume.labels, labels)
    assert same(load(tmp_path / "a.npz", spacing=(2, 2, 2), origin=(0, 0, 0)), ramp(), (2, 2, 2))
    np.savez_compressed(tmp_path / "b.npz", anything=ramp("float32"))
    assert same(load(tmp_path / "b.npz"), ramp("float32"))


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
    "npz with a flipped byte": ("a.npz", flipped(zipped(data=NPY), 170), r"a\.npz cannot be read.*CRC"),
    "npy empty": ("a.npy", b"", r"empty \(0 bytes\)"),
    "npy cut short": ("a.npy", NPY[:-1], "cut short: it holds 59 .*says 60"),
    "unknown ending": ("a.xyz", b"II*", r"unknown ending; .*\.npy.*\.raw\.gz"),
    "empty": (RAW, b"", r"empty \(0 bytes\)"),
    "no header": ("a.raw", b"12", r"shape=.*name_XxYxZ_dtype\.raw.*a\.raw\.json"),
    "unknown dtype": ("a_5x4x3_rgb8.raw", b"1", "dtype must be uint8.*got 'rgb8'"),
    "axis of one voxel": ("a_60x1x1_uint8.raw", bytes(60), "at least 2 voxels.*60, 1, 1"),
    "cut short": (RAW, bytes(59), "cut short: it holds 59 bytes.*says 60"),
    "oversized": (RAW, bytes(90), "oversized: it holds 90 or more bytes.*says 60"),
    "NaN": ("a_2x2x2_float32.raw", NOT_FINITE, "data must be finite; got 3 of 8"),
    "gzip of too little": (GZ, gzip.compress(bytes(4095)), "cut short: it holds 4095 .*says 4096"),
    "gzip of too much": (GZ, gzip.compress(bytes(9999)), "oversized: it holds 4097 or more .*says 4096"),
    "gzip in name only": (GZ, bytes(4096), f"{GZ} cannot be read.*Not a gzipped file"),
    "gzip cut": (GZ, PACKED[:-20], f"{GZ} cannot be read.*ended before"),
    "gzip with bad checksum": (GZ, flipped(PACKED, -6), f"{GZ} cannot be read.*CRC"),
    "npy of objects": ("a.npy", npy(BOMBS), "type object.*pickles.*never read"),
    "npy that is a pickle": ("a.npy", pickle.dumps(Bomb()), r"no valid \.npy header"),
    "npy with a broken header": ("a.npy", NPY[:10] + b"{[(" + NPY[13:], r"no valid \.npy header"),
    "npy oversized": ("a.npy", NPY + b"1", "oversized: it holds 61 .*says 60"),
    "npy promising too much": ("a.npy", npy_header(HUGE), "holds 0 bytes.*says 2000000000"),
    "npy beyond any volume": ("a.npy", npy_header((2**40,) * 3), r"1 to 2\*\*31 - 1 voxels"),
    "npy of int64": ("a.npy", npy(ramp("int64") + 2**40), r"a\.npy: data must be whole numbers.*int64 from"),
    "npz in name only": ("a.npz", bytes(100), r"a\.npz cannot be read"),
    "npz of objects": ("a.npz", npz(data=BOMBS), "type object.*pickles.*never read"),
    "npz of several": ("a.npz", npz(a=ramp(), b=ramp()), r"called data.*\['a', 'b'\]"),
    "npz of no array": ("a.npz", zipped(data=b"hello"), r"no valid \.npy header"),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_a_bad_file_is_refused_with_its_reason(tmp_path, case):
    file, content, message = BAD_FILES[case]
    (tmp_path / file).write_bytes(content)
    with pytest.raises(ValueError, match=message):
        load(tmp_path / file)


def test_bad_paths_and_arguments_are_refused(tmp_path):
    with pytest.raises(ValueError, match=f"path: there is no file .*{RAW}"):
        load(tmp_path / RAW)
    (tmp_path / RAW).mkdir()
    for directory in (tmp_path, tmp_path / RAW):
        with pytest.raises(ValueError, match="is a directory"):
            load(directory)
    path = write(tmp_path / "a.raw", b"1" * 60)
    for shape in ((5, 4), (5, 4, 3, 1), (5, 4, -3), (5.0, 4.0, 3.0), "543", 60, np.array(3)):
        with pytest.raises(ValueError, match="shape must be three positive integers"):
            load(path, shape=shape, dtype="uint8")
    for dtype in ("uchar", "int128", "uint8xe", "le", "", 8, np.complex64, np.dtype(">i2")):
        with pytest.raises(ValueError, match="dtype must be uint8"):
            load(path, shape=SHAPE, dtype=dtype)
    np.save(tmp_path / "a.npy", ramp())
    np.savez(tmp_path / "a.npz", ramp())
    for file in ("a.npy", "a.npz"):
        with pytest.raises(ValueError, match="shape and dtype are for raw files"):
            load(tmp_path / file, shape=SHAPE)
        with pytest.raises(ValueError, match="shape and dtype are for raw files"):
            load(tmp_path / file, dtype="uint8")


NAN = np.array([1, np.nan, 2, np.inf, 3, -np.inf, 4, 5], "float32").reshape(2, 2, 2)
WRITERS = {
    "a.npy": lambda path: np.save(path, NAN),
    "a.npz": lambda path: np.savez(path, data=NAN),
    "a_2x2x2_float32.raw": lambda path: path.write_bytes(raw_bytes(NAN)),
    "a.tif": lambda path: pytest.importorskip("tifffile").imwrite(path, NAN.T, photometric="minisblack"),
    "a.zarr": lambda path: pytest.importorskip("zarr").create_array(path, data=NAN),
    **{
        f"a{ending}": lambda path: written_by_itk(NAN, path)
        for ending in (".nii", ".nii.gz", ".nrrd", ".mha")
    },
}


def written_by_itk(data, path):
    sitk = pytest.importorskip("SimpleITK")
    sitk.WriteImage(sitk.GetImageFromArray(data.T), str(path))


@pytest.mark.parametrize("name", WRITERS)
def test_voxels_that_are_nan_or_infinite_are_refused_or_replaced_by_every_reader(tmp_path, name):
    WRITERS[name](tmp_path / name)
    with pytest.raises(ValueError, match=r"(data|voxels) must be finite"):
        load(tmp_path / name)
    expected = np.where(np.isfinite(NAN), NAN, np.float32(-7))
    np.testing.assert_array_equal(load(tmp_path / name, nan=-7).data, expected)
    with pytest.raises(ValueError, match="nan must be finite"):
        load(tmp_path / name, nan=np.nan)


BAD_JSON = [
    ("{", "a.json is not JSON"),
    ("[" * 5000, "a.json is not JSON"),
    ("\xff", "a.json is not JSON"),
    ("[5, 4, 3]", "must be a JSON object.*got list"),
    ('{"size": [5, 4], "type": "uint8"}', r"shape must be.*got \[5, 4\]"),
    ('{"size": [5, 4, 1e400], "type": "uint8"}', "shape must be.*inf"),
    ('{"size": [5, 4, 3], "type": null}', "dtype must be.*None"),
    ('{"size": [5, 4, 3], "type": "uint8", "spacing": "wide"}', "spacing must be numbers"),
    ('{"size": [5, 4, 3], "type": "uint8", "spacing": [0, 1, 1]}', "spacing must be positive"),
    ('{"size": [5, 4, 3], "type": "uint8", "origin": [NaN, 1, 1]}', "origin must be finite"),
]


def test_a_bad_json_is_refused(tmp_path):
    path = write(tmp_path / "a.raw", raw_bytes(ramp()))
    for header, message in BAD_JSON:
        (tmp_path / "a.json").write_bytes(header.encode("latin-1"))
        with pytest.raises(ValueError, match=message):
            load(path)


def test_neither_a_file_nor_a_header_takes_memory_that_the_other_does_not_back(tmp_path):
    for name, content, length in (
        ("a_8x8x8_uint8.raw.gz", bytes(2**26), None),
        ("b_8x8x8_uint8.raw", b"", 2**33),  # which takes no disk space
        ("a_2000x1000x1000_float32.raw.gz", b"12", None),
        ("a.npy", npy_header(HUGE), None),
        ("a.npz", zipped(data=npy_header(HUGE)), None),
    ):
        path = write(tmp_path / name, content)
        if length is not None:
            os.truncate(path, length)
        tracemalloc.start()
        with pytest.raises(ValueError, match="says"):
            load(path)
        assert tracemalloc.get_traced_memory()[1] < 4 * files.CHUNK, name
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("module", "ending"),
    [("nibabel", ".nii"), ("pydicom", ".dcm"), ("tifffile", ".tiff"), ("mrcfile", ".mrc"), ("xarray", ".h5")],
)
def test_a_missing_library_says_how_to_install_it(tmp_path, monkeypatch, module, ending):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=r"pip install 'jaxvol\[io\]'"):
        load(write(tmp_path / f"a{ending}", bytes(128) + b"DICM"))


def test_a_real_volume_of_signed_values_lies_where_it_was_found(real_volume):
    data = np.asarray(load(real_volume("lidc0314_airway_256x192x200_int16le.raw.gz")).data)
    assert (data.shape, data.dtype, data.min(), data.max()) == ((256, 192, 200), "int16", -1000, 1979)
    assert data.mean(dtype=np.float64) == pytest.approx(-286.5795, abs=1e-4)
    assert np.mean(data[125:128, 46:49, 180:183]) < -920  # HU: air, in the trachea
