"""Does a box come back at its place in the world, in mm, with its values, from each library's files?

Witnesses are a closed form, and the library's own reader where it has one."""

from typing import Any

import h5py
import mrcfile
import numpy as np
import pytest
import SimpleITK as sitk
import tensorstore
import tifffile
import vtk
import xarray
import zarr
from hypothesis import given, settings, strategies as st
from vtk.util.numpy_support import numpy_to_vtk  # pyright: ignore[reportMissingImports]

import jaxvol as jv

from .test_dicom import turned


UNITS = {"mm": 1.0, "micrometer": 1e-3, "nanometer": 1e-6, "cm": 10.0}


def box(draw):
    """Stored numbers [x, y, z] of 7 in a box, else 1; and a spacing, an origin, and a grid's directions."""
    shape = [draw(st.integers(4, 8)) for _ in "xyz"]
    data = np.ones(shape, draw(st.sampled_from([np.uint8, np.int16, np.uint16, np.float32])))
    low = [draw(st.integers(0, n - 2)) for n in shape]
    high = [draw(st.integers(a + 1, n)) for a, n in zip(low, shape, strict=True)]
    data[tuple(map(slice, low, high))] = 7
    spacing = np.array([draw(st.integers(1, 40)) / 8 for _ in "xyz"])
    origin = np.array([draw(st.integers(-80, 80)) / 4 for _ in "xyz"])
    turn = turned(*(draw(st.sampled_from([0, 90, 180, 20, -35])) for _ in "xyz"))
    return data, spacing, origin, turn


def center(data, affine, bright=7.0):
    """World position of the middle of what is bright."""
    at = np.argwhere(np.isclose(data, bright)).mean(axis=0)
    return affine[:3, :3] @ at + affine[:3, 3]


def affine_of(spacing, origin, turn):
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = turn * spacing, origin
    return affine


def check(volume, data, affine, slope=1.0, intercept=0.0):
    turn = np.eye(3) if volume.direction is None else np.asarray(volume.direction, float)
    own = affine_of(np.asarray(volume.spacing, float), np.asarray(volume.origin, float), turn)
    found = np.asarray(volume.data, float)
    bright, dark = 7 * slope + intercept, slope + intercept
    np.testing.assert_allclose(
        np.sort(np.unique(found)), np.unique([dark, bright][: len(np.unique(data))]), rtol=1e-6
    )
    unit = np.abs(affine[:3, :3]).max()
    np.testing.assert_allclose(center(found, own, bright), center(data, affine), rtol=1e-5, atol=1e-4 * unit)
    far = np.isclose(found, bright).sum()
    assert far == (data == 7).sum()


def by_simple_itk(draw, folder, data, spacing, origin, turn):
    image = sitk.GetImageFromArray(np.ascontiguousarray(data.T))
    image.SetSpacing(spacing.tolist())
    image.SetOrigin(origin.tolist())
    image.SetDirection(turn.ravel().tolist())
    path = folder / f"a{draw(st.sampled_from(['.nii.gz', '.nrrd', '.mha', '.mhd', '.nhdr', '.nii']))}"
    sitk.WriteImage(image, str(path), draw(st.booleans()))
    check(jv.load(path), data, affine_of(spacing, origin, turn))
    check(jv.Volume(sitk.ReadImage(str(path))), data, affine_of(spacing, origin, turn))


def by_tifffile(draw, folder, data, spacing, origin, turn):
    unit, length = draw(
        st.sampled_from([("um", 1e-3), ("µm", 1e-3), ("nm", 1e-6), ("mm", 1.0), ("microns", 1e-3)])
    )
    x, y, z = spacing
    compression = draw(st.sampled_from([None, "zlib"]))
    if data.dtype in (np.uint8, np.uint16, np.float32) and unit.isascii() and draw(st.booleans()):
        told = {"axes": "ZYX", "unit": unit} | ({"spacing": z} if z != 1 else {})
        tifffile.imwrite(
            folder / "a.tif",
            data.T,
            imagej=True,
            photometric="minisblack",
            resolution=(1 / x, 1 / y),
            metadata=told,
        )
        path = folder / "a.tif"
    else:
        unit, length = ("µm", 1e-3) if unit in ("um", "microns") else (unit, length)
        sizes = {f"PhysicalSize{a}": s for a, s in zip("XYZ", spacing, strict=True)}
        sizes |= {f"PhysicalSize{a}Unit": unit for a in "XYZ"}
        tifffile.imwrite(
            folder / "a.ome.tif",
            data.T,
            ome=True,
            photometric="minisblack",
            compression=compression,
            metadata={"axes": "ZYX"} | sizes,
        )
        path = folder / "a.ome.tif"
    np.testing.assert_array_equal(tifffile.imread(path).T, data)
    check(jv.load(path), data, affine_of(length * spacing, np.zeros(3), np.eye(3)))


def by_zarr(draw, folder, data, spacing, origin, turn):
    unit, length = draw(st.sampled_from([("micrometer", 1e-3), ("millimeter", 1.0), ("nanometer", 1e-6)]))
    axes = draw(st.sampled_from(["zyx", "xyz"]))
    order = ["xyz".index(a) for a in axes]
    axis = [{"name": a, "type": "space", "unit": unit} for a in axes]
    place = [
        {"type": "scale", "scale": spacing[order].tolist()},
        {"type": "translation", "translation": origin[order].tolist()},
    ]
    group = zarr.open_group(folder / "a.zarr", mode="w", zarr_format=3)
    chunks = tuple(draw(st.integers(2, 4)) for _ in axes)
    array = group.create_array(
        "0", shape=data.transpose(order).shape, dtype=data.dtype, chunks=chunks, fill_value=1
    )
    array[:] = data.transpose(order)  # chunks of the fill value alone are left out
    image = {"axes": axis, "datasets": [{"path": "0", "coordinateTransformations": place}], "name": "a"}
    group.attrs["ome"] = {"version": "0.5", "multiscales": [image]}
    check(jv.load(folder / "a.zarr"), data, affine_of(length * spacing, length * origin, np.eye(3)))


def by_tensorstore(draw, folder, data, spacing, origin, turn):
    driver = draw(st.sampled_from(["zarr", "zarr3"]))
    spec = {"driver": driver, "kvstore": {"driver": "file", "path": f"{folder}/b/"}}
    store = tensorstore.open(spec, create=True, dtype=data.dtype.name, shape=data.shape).result()
    store[...] = data
    check(jv.load(folder / "b"), data, np.eye(4))


def by_xarray(draw, folder, data, spacing, origin, turn):
    names = draw(
        st.sampled_from(
            [("z", "y", "x"), ("lev", "lat", "lon"), ("Z", "Y", "X"), ("depth", "height", "width")]
        )
    )
    signs = np.array([draw(st.sampled_from([1, -1])) for _ in "xyz"])
    slope, intercept = draw(st.sampled_from([(0.5, -3.0), (2.0, 0.0)]))
    unit = draw(st.sampled_from(["mm", "micrometer", "cm"]))
    at = [(name, o + s * step * np.arange(n), {"units": unit}) for name, o, s, step, n in
          zip(names[::-1], origin, signs, spacing, data.shape, strict=True)]  # fmt: skip
    coords = {name: (name, numbers, told) for name, numbers, told in at}
    array = xarray.DataArray((data * slope + intercept).T, dims=names, coords=coords)
    affine = UNITS[unit] * affine_of(signs * spacing, origin, np.eye(3))
    check(jv.Volume(array), data, affine, slope, intercept)
    packed = {"v": {"dtype": "int16", "scale_factor": slope, "add_offset": intercept, "_FillValue": -99}}
    how = draw(st.sampled_from(["netcdf3", "netcdf4", "zarr"]))
    dataset = xarray.Dataset({"v": array})
    if how == "zarr":
        dataset.to_zarr(folder / "c", zarr_format=3, encoding=packed, mode="w", consolidated=False)
        check(jv.load(folder / "c" / "v"), data, affine, slope, intercept)
        return
    engine, kind = ("scipy", "NETCDF3_64BIT") if how == "netcdf3" else ("h5netcdf", "NETCDF4")
    dataset.to_netcdf(folder / "a.nc", engine=engine, format=kind, encoding=packed)
    check(jv.load(folder / "a.nc"), data, affine, slope, intercept)


def by_mrcfile(draw, folder, data, spacing, origin, turn):
    stored = data.astype(np.int16) if data.dtype == np.uint8 else data
    with mrcfile.new(folder / "a.mrc", overwrite=True) as file:
        file.set_data(np.ascontiguousarray(stored.T))
        file.voxel_size = tuple(spacing.tolist())
        header: Any = file.header
        for axis, number in zip("xyz", origin, strict=True):
            header.origin[axis] = number
    check(jv.load(folder / "a.mrc"), data, 1e-7 * affine_of(spacing, origin, np.eye(3)))


def by_vtk(draw, folder, data, spacing, origin, turn):
    image = vtk.vtkImageData()
    image.SetDimensions(*data.shape)
    image.SetSpacing(*spacing)
    image.SetOrigin(*origin)
    image.GetPointData().SetScalars(numpy_to_vtk(data.ravel(order="F").copy(), deep=True))
    if draw(st.booleans()):
        image.SetDirectionMatrix(*turn.ravel())
        writer, path = vtk.vtkXMLImageDataWriter(), folder / "a.vti"
        getattr(writer, f"SetDataModeTo{draw(st.sampled_from(['Ascii', 'Binary', 'Appended']))}")()
        writer.SetEncodeAppendedData(draw(st.booleans()))
        getattr(writer, f"SetCompressorTypeTo{draw(st.sampled_from(['None', 'ZLib']))}")()
    else:
        writer, path, turn = vtk.vtkStructuredPointsWriter(), folder / "a.vtk", np.eye(3)
        writer.SetFileType(draw(st.sampled_from([1, 2])))
    writer.SetFileName(str(path))
    writer.SetInputData(image)
    writer.Write()
    check(jv.load(path), data, affine_of(spacing, origin, turn))
    check(jv.Volume(image), data, affine_of(spacing, origin, turn))


def by_h5py(draw, folder, data, spacing, origin, turn):
    with h5py.File(folder / "a.h5", "w") as file:
        file.create_dataset("more", data=np.zeros((2, 2, 2)))
        array = file.create_dataset(
            "g/v", data=data.T, chunks=(2, 3, 4), compression=draw(st.sampled_from([None, "gzip"]))
        )
        array.attrs["element_size_um"] = spacing[::-1]
    check(jv.load(f"{folder / 'a.h5'}::/g/v"), data, 1e-3 * affine_of(spacing, np.zeros(3), np.eye(3)))


WRITERS = (
    by_simple_itk,
    by_tifffile,
    by_zarr,
    by_tensorstore,
    by_xarray,
    by_mrcfile,
    by_vtk,
    by_h5py,
)


@pytest.mark.parametrize("write", WRITERS)
def test_a_box_comes_back_at_its_place_with_its_values(write, tmp_path_factory):
    @settings(deadline=None, max_examples=25, database=None, derandomize=True)
    @given(st.data())
    def tried(data):
        write(data.draw, tmp_path_factory.mktemp("a"), *box(data.draw))

    tried()
