"""Are stacks of TIFF images read with x along the rows, and bad stacks refused with their reason?"""

import sys

import numpy as np
import pytest

import jaxvol as jv


tifffile = pytest.importorskip("tifffile", reason="tifffile is not installed: pip install jaxvol[io]")

DATA = np.random.default_rng(0).integers(0, 60000, (7, 6, 5)).astype(np.uint16)


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16", "float32"])
@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}, {"byteorder": ">"}, {"bigtiff": True}])
def test_pages_are_slices_and_rows_are_y(tmp_path, dtype, options):
    data = (DATA // 256).astype(dtype)
    tifffile.imwrite(tmp_path / "a.tif", data.T, photometric="minisblack", **options)
    volume = jv.load(tmp_path / "a.tif", spacing=(1, 2, 3))
    assert volume.data.dtype == dtype
    np.testing.assert_array_equal(volume.data, data)
    np.testing.assert_array_equal(volume.spacing, (1, 2, 3))
    with pytest.raises(ValueError, match="shape and dtype are for raw files"):
        jv.load(tmp_path / "a.tif", dtype=dtype)


def test_imagej_tells_spacing(tmp_path):
    metadata = {"spacing": 2.5, "unit": "um", "axes": "ZYX"}
    tifffile.imwrite(tmp_path / "a.tif", DATA.T, imagej=True, resolution=(4, 2), metadata=metadata)
    volume = jv.load(tmp_path / "a.tif")
    np.testing.assert_array_equal(volume.data, DATA)
    np.testing.assert_allclose(volume.spacing, (0.25e-3, 0.5e-3, 2.5e-3), rtol=1e-5)


def test_ome_tells_spacing(tmp_path):
    sizes = {"PhysicalSizeX": 0.25, "PhysicalSizeY": 0.5, "PhysicalSizeZ": 2.5}
    tifffile.imwrite(tmp_path / "a.ome.tif", DATA.T, metadata={"axes": "ZYX", **sizes})
    volume = jv.load(tmp_path / "a.ome.tif")
    np.testing.assert_array_equal(volume.data, DATA)
    np.testing.assert_allclose(volume.spacing, (0.25e-3, 0.5e-3, 2.5e-3), rtol=1e-5)  # µm, if not said
    units = {f"PhysicalSize{axis}Unit": "mm" for axis in "XYZ"}
    tifffile.imwrite(tmp_path / "a.ome.tif", DATA.T, metadata={"axes": "ZYX", **sizes, **units})
    np.testing.assert_allclose(jv.load(tmp_path / "a.ome.tif").spacing, (0.25, 0.5, 2.5), rtol=1e-5)
    tifffile.imwrite(tmp_path / "a.ome.tif", np.stack([DATA.T] * 2), metadata={"axes": "CZYX"})
    with pytest.raises(ValueError, match=r"must hold one volume of one channel; .* of 2 chan"):
        jv.load(tmp_path / "a.ome.tif")


def write_folder(folder, numbers=(8, 9, 10, 11, 12), data=DATA):
    folder.mkdir()
    for z, number in enumerate(numbers):
        tifffile.imwrite(folder / f"slice{number}.tif", data[:, :, z].T)
    return folder


def test_a_folder_of_images_is_sorted_by_number(tmp_path):
    np.testing.assert_array_equal(jv.load(write_folder(tmp_path / "a")).data, DATA)


def test_bad_stacks_are_refused_with_their_reason(tmp_path):
    with pytest.raises(ValueError, match=r"slices are missing.*slice10\.tif is followed by slice12\.tif"):
        jv.load(write_folder(tmp_path / "gap", (8, 9, 10, 12, 13)))
    folder = write_folder(tmp_path / "sizes")
    tifffile.imwrite(folder / "slice10.tif", DATA[:, :4, 0].T)
    with pytest.raises(
        ValueError, match=r"same size and type.*slice8\.tif has \(6, 7\).*slice10.tif \(4, 7\)"
    ):
        jv.load(folder)
    tifffile.imwrite(tmp_path / "one.tif", DATA[:, :, 0].T)
    with pytest.raises(ValueError, match="at least 2 images; got 1"):
        jv.load(tmp_path / "one.tif")
    tifffile.imwrite(tmp_path / "rgb.tif", np.zeros((4, 8, 9, 3), np.uint8), photometric="rgb")
    with pytest.raises(ValueError, match="one value per pixel"):
        jv.load(tmp_path / "rgb.tif")
    tifffile.imwrite(tmp_path / "a.tif", DATA.T, photometric="minisblack")
    content = (tmp_path / "a.tif").read_bytes()
    for length in (4, 100, len(content) // 2, len(content) - 20):
        (tmp_path / "cut.tif").write_bytes(content[:length])
        with pytest.raises(ValueError, match=r"cut\.tif"):
            jv.load(tmp_path / "cut.tif")


def test_without_tifffile_it_is_said_how_to_install_it(tmp_path, monkeypatch):
    (tmp_path / "a.tiff").write_bytes(b"II")
    monkeypatch.setitem(sys.modules, "tifffile", None)
    with pytest.raises(ImportError, match=r"pip install jaxvol\[io\]"):
        jv.load(tmp_path / "a.tiff")
