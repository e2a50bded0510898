"""Are stacks of TIFF images read with x along the rows, and bad stacks refused with their reason?"""

import importlib

import numpy as np
import pytest

import jaxvol as jv


tifffile = pytest.importorskip("tifffile", reason="tifffile is not installed: pip install jaxvol[io]")

DATA = np.random.default_rng(0).integers(0, 60000, (7, 6, 5)).astype(np.uint16)


def test_pages_are_slices_and_rows_are_y(tmp_path):
    for dtype in ("uint8", "uint16", "int16", "float32"):
        for options in ({}, {"compression": "zlib"}, {"byteorder": ">"}, {"bigtiff": True}):
            data = (DATA // 256).astype(dtype)
            tifffile.imwrite(tmp_path / "a.tif", data.T, photometric="minisblack", **options)
            volume = jv.load(tmp_path / "a.tif", spacing=(1, 2, 3))
            assert volume.data.dtype == dtype
            np.testing.assert_array_equal(volume.data, data)
            np.testing.assert_array_equal(volume.spacing, (1, 2, 3))
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:  # page by page
        for z in range(DATA.shape[2]):
            file.write(DATA[:, :, z].T, photometric="minisblack", contiguous=False)
    np.testing.assert_array_equal(jv.load(tmp_path / "a.tif").data, DATA)
    with pytest.raises(ValueError, match="shape and dtype are for raw files"):
        jv.load(tmp_path / "a.tif", dtype="uint8")


def test_one_of_several_channels_and_times_is_chosen(tmp_path):
    tifffile.imwrite(tmp_path / "a.ome.tif", np.stack([DATA.T] * 2), metadata={"axes": "CZYX"})
    tifffile.imwrite(tmp_path / "a.tif", np.stack([DATA.T] * 2, 1), imagej=True, metadata={"axes": "ZCYX"})
    for name in ("a.ome.tif", "a.tif"):
        np.testing.assert_array_equal(jv.load(tmp_path / name, channel=1).data, DATA)
        with pytest.raises(ValueError, match=r"channel must be given, from 0 to 1: .*x 7, y 6, z 5, c 2\."):
            jv.load(tmp_path / name)
    film = np.stack([DATA.T, DATA.T + 1])[:, :, None]
    tifffile.imwrite(tmp_path / "a.ome.tif", film, metadata={"axes": "TZCYX"})
    np.testing.assert_array_equal(jv.load(tmp_path / "a.ome.tif", time=1).data, DATA + 1)


def test_what_imagecodecs_decompresses_is_read_and_without_it_named(tmp_path, monkeypatch):
    pytest.importorskip("imagecodecs", reason="pip install jaxvol[io]")
    for compression in ("lzw", "jpeg2000", "zstd"):
        options = {"compression": compression, "photometric": "minisblack"}
        tifffile.imwrite(tmp_path / "a.tif", DATA.T, **options)
        np.testing.assert_array_equal(jv.load(tmp_path / "a.tif").data, DATA)
    tifffile.imwrite(tmp_path / "a.tif", DATA.T, compression="lzw", photometric="minisblack")
    program = tifffile.tifffile
    monkeypatch.setattr(program, "imagecodecs", importlib.import_module("tifffile._imagecodecs"))
    monkeypatch.setattr(program.TIFF, "DECOMPRESSORS", program.CompressionCodec(encode=False), raising=False)
    with pytest.raises(ImportError, match=r"a\.tif needs imagecodecs .*pip install 'jaxvol\[io\]'"):
        jv.load(tmp_path / "a.tif")


def write_folder(folder, numbers=(8, 9, 10, 11, 12)):
    folder.mkdir()
    for z, number in enumerate(numbers):
        tifffile.imwrite(folder / f"slice{number}.tif", DATA[:, :, z].T)
    return folder


def test_a_folder_of_images_is_sorted_by_number_and_bad_stacks_are_refused(tmp_path):
    folder = write_folder(tmp_path / "a")
    np.testing.assert_array_equal(jv.load(folder).data, DATA)
    tifffile.imwrite(folder / "slice10.tif", DATA[:, :4, 0].T)
    write_folder(tmp_path / "gap", (8, 9, 10, 12, 13))
    tifffile.imwrite(tmp_path / "one.tif", DATA[:, :, 0].T)
    tifffile.imwrite(tmp_path / "rgb.tif", np.zeros((4, 8, 9, 3), np.uint8), photometric="rgb")
    tifffile.imwrite(tmp_path / "b.tif", DATA.T, photometric="minisblack")
    with tifffile.TiffWriter(tmp_path / "sizes.tif") as file:
        for width in (7, 7, 5):
            file.write(DATA[:width, :, 0].T, photometric="minisblack", contiguous=False)
    tifffile.imwrite(write_folder(tmp_path / "stacks") / "slice8.tif", DATA.T, photometric="minisblack")
    write_folder(tmp_path / "single", (8,))
    content = (tmp_path / "b.tif").read_bytes()
    cut = {f"cut{length}.tif": length for length in (4, 100, len(content) // 2, len(content) - 20)}
    for name, length in cut.items():
        (tmp_path / name).write_bytes(content[:length])
    bad = {
        "a": r"same size and type.*slice8\.tif has \(6, 7\) of uint16, and slice10\.tif 1 of \(4, 7\)",
        "gap": r"slices are missing.*slice10\.tif is followed by slice12\.tif",
        "one.tif": r"at least 2 voxels along each axis; got shape \(7, 6, 1\)",
        "sizes.tif": "must hold one stack of images of one size.* pages of 2 kinds",
        "stacks": r"must hold one image .*, and slice8\.tif 5 of \(6, 7\)",
        "single": "at least 2 voxels along each axis",
        **{name: name for name in cut},
    }
    assert jv.load(tmp_path / "rgb.tif").data.shape == (9, 8, 4, 3)
    assert jv.load(tmp_path / "rgb.tif", channel=2).shape == (9, 8, 4)
    for name, message in bad.items():
        with pytest.raises(ValueError, match=message):
            jv.load(tmp_path / name)
