"""Are values, order, axes, lengths and place of files those that their writers meant?"""

import warnings
from typing import Any

import h5py
import nibabel
import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
import tifffile
import xarray
import zarr
from PIL import Image

import jaxvol as jv
from jaxvol._util.units import axis_letters, length_of

from .test_dicom import ORIGIN, SPACING, VALUES, write_series, write_slice


def of(name, number) -> Any:
    return {name: number}


RAMP = np.arange(120, dtype=np.int16).reshape(4, 5, 6)  # z, y, x


def test_units_in_all_their_spellings():
    spelled = {
        1.0: "mm millimeter millimeters millimetre MM",
        1e-3: "um µm \u03bcm \\u00b5m \\u00B5m micron microns micrometer micrometres Micron",
        1e-6: "nm nanometer nanometers",
        1e3: "m meter metre meters",
        1e-7: "Å \u212b angstrom Angstrom angstroms ang",
        10.0: "cm centimeter",
        25.4: "in inch inches",
    }
    for length, names in spelled.items():
        for name in names.split():
            assert length_of(name) == pytest.approx(length), name
    for unknown in (None, "", "px", "pixel", "pixels", "voxel", "degrees_north", "furlong"):
        assert length_of(unknown) is None


def test_axes_by_their_names_or_not_at_all():
    told = []
    for names, letters in (
        (("lev", "lat", "lon"), "zyx"),
        (("T", "C", "Z", "Y", "X"), "tczyx"),
        (("depth", "height", "width"), "zyx"),
        (("height", "lat", "lon"), "zyx"),
        (("k", "j", "i"), "zyx"),
        (("plane", "row", "col"), "zyx"),
    ):
        assert axis_letters("data", names, told.append) == letters
    assert told == []
    assert axis_letters("data", ("a", "b", "c"), told.append) == "xyz"
    assert axis_letters("data", ("depth_um", "y", "x"), told.append) == "zyx"
    assert told == ["axes 'a', 'b', 'c': taken as x, y, z", "axes 'depth_um': taken as z"]
    for names in (("p", "q", "y", "x"), ("z", "depth", "x")):
        with pytest.raises(ValueError, match="axes named such as x, y, z"):
            axis_letters("data", names, told.append)


def test_an_unknown_unit_is_said_and_not_dropped(tmp_path):
    metadata = {"axes": "ZYX", "unit": "px", "spacing": 2.0}
    tifffile.imwrite(tmp_path / "a.tif", RAMP, imagej=True, resolution=(2, 2), metadata=metadata)
    with pytest.warns(UserWarning, match="unit 'px': taken as 1"):
        np.testing.assert_allclose(jv.load(tmp_path / "a.tif").spacing, (0.5, 0.5, 2))
    told = {"axes": "ZYX", "PhysicalSizeX": 0.5, "PhysicalSizeY": 0.5}
    tifffile.imwrite(tmp_path / "a.ome.tif", RAMP, metadata=told)
    with pytest.warns(UserWarning, match="distance along z: taken as 1, in the unit of the others"):
        np.testing.assert_allclose(jv.load(tmp_path / "a.ome.tif").spacing, (5e-4, 5e-4, 1e-3), rtol=1e-5)


def test_a_calibration_of_imagej_and_of_gdal_gives_values(tmp_path):
    stored = (RAMP.astype(np.int32) - 1000 + 32768).astype(np.uint16)
    line = {"axes": "ZYX", "cf": 0, "c0": -32768.0, "c1": 1.0}
    tifffile.imwrite(tmp_path / "a.tif", stored, imagej=True, metadata=line)
    volume = jv.load(tmp_path / "a.tif")
    np.testing.assert_array_equal(volume.data, RAMP.T - 1000)
    assert volume.data.dtype == np.int16
    tifffile.imwrite(tmp_path / "a.tif", stored, imagej=True, metadata=line | {"cf": 3})
    with pytest.warns(UserWarning, match="calibration function 3 is not read"):
        np.testing.assert_array_equal(jv.load(tmp_path / "a.tif").data, stored.T)


def test_pages_are_planes_as_ome_says_also_of_several_files(tmp_path):
    def xml(planes, own, z=4):
        tiff = "".join(
            f'<TiffData FirstZ="{k}" IFD="{ifd}" PlaneCount="1">'
            f'<UUID FileName="{name}">urn:uuid:{name}</UUID>'
            "</TiffData>"
            for k, (name, ifd) in enumerate(planes)
        )
        return (
            '<?xml version="1.0" encoding="UTF-8"?>'
            '<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" '
            f'UUID="urn:uuid:{own}"><Image ID="Image:0"><Pixels ID="Pixels:0" DimensionOrder="XYZCT" '
            f'Type="uint8" SizeX="6" SizeY="5" SizeZ="{z}" SizeC="1" SizeT="1">'
            f'<Channel ID="Channel:0:0" SamplesPerPixel="1"/>{tiff}</Pixels></Image></OME>'
        )

    planes = [("b.ome.tif", 1), ("b.ome.tif", 0), ("a.ome.tif", 0), ("a.ome.tif", 1)]
    for name, values in (("a.ome.tif", (2, 3)), ("b.ome.tif", (1, 0))):
        pages = np.stack([np.full((5, 6), value, np.uint8) for value in values])
        how = {"photometric": "minisblack", "metadata": None, "description": xml(planes, name)}
        tifffile.imwrite(tmp_path / name, pages, **how)
    np.testing.assert_array_equal(np.asarray(jv.load(tmp_path / "a.ome.tif").data)[0, 0], range(4))
    (tmp_path / "b.ome.tif").unlink()
    with pytest.raises(ValueError, match=r"b\.ome\.tif is not beside it"):
        jv.load(tmp_path / "a.ome.tif")
    few = xml([("c.ome.tif", 0), ("c.ome.tif", 1)], "c.ome.tif", 3)
    pages = np.stack([np.full((5, 6), value, np.uint8) for value in (7, 8)])
    tifffile.imwrite(tmp_path / "c.ome.tif", pages, photometric="minisblack", metadata=None, description=few)
    with pytest.warns(UserWarning, match="1 of 3 planes are not in the file: filled with 0"):
        assert np.asarray(jv.load(tmp_path / "c.ome.tif").data)[0, 0].tolist() == [7, 8, 0]


@pytest.mark.parametrize("axes", ["TZYX", "CZYX", None])
def test_what_tifffile_knows_of_axes_is_asked_for(tmp_path, axes):
    data = np.stack([RAMP, RAMP + 1, RAMP + 2])
    tifffile.imwrite(
        tmp_path / "a.tif", data, photometric="minisblack", metadata={"axes": axes} if axes else {}
    )
    name = "channel" if axes == "CZYX" else "time"
    with pytest.raises(ValueError, match=f"{name} must be given, from 0 to 2"):
        jv.load(tmp_path / "a.tif")
    np.testing.assert_array_equal(jv.load(tmp_path / "a.tif", **of(name, 2)).data, RAMP.T + 2)
    with tifffile.TiffWriter(tmp_path / "b.tif") as file:
        for stack in data[:2]:
            file.write(stack, photometric="minisblack")
    with pytest.raises(ValueError, match=r"must hold one stack .* got 2 stacks"):
        jv.load(tmp_path / "b.tif")


def test_names_that_count_twice_are_channels_or_times_or_refused(tmp_path):
    def write(folder, name):
        (tmp_path / folder).mkdir()
        for z in range(3):
            for c in (1, 2):
                image = Image.fromarray(np.full((5, 6), 10 * c + z, np.uint8))
                image.save(tmp_path / folder / name.format(z=z, c=c))
        return tmp_path / folder

    for folder, name, how in (
        ("a", "stack_z{z:03d}_c{c}.png", "channel"),
        ("b", "c{c}_z{z:03d}.png", "channel"),
        ("c", "t{c:02d}_{z:04d}.png", "time"),
    ):
        path = write(folder, name)
        with pytest.raises(ValueError, match=f"{how} must be given, from 0 to 1"):
            jv.load(path)
        assert np.asarray(jv.load(path, **of(how, 1)).data)[0, 0].tolist() == [20, 21, 22]
    with pytest.raises(ValueError, match="holds 2 series of 3 images"):
        jv.load(write("d", "{c}_{z:04d}.png"))
    path = write("e", "x{z:03d}_{c}.png")
    for file in [*path.iterdir()]:
        file.rename(path / file.name.replace("_1.", "_gfp.").replace("_2.", "_dapi."))
    with pytest.raises(ValueError, match=r"holds 2 series of images: 3 named .*gfp"):
        jv.load(path)


def test_a_chunk_that_is_left_out_has_the_fill_value(tmp_path):
    data = np.full((8, 8, 8), 3, np.uint8)
    data[:4] = 200
    layouts: list[tuple[str, dict[str, Any]]] = [
        ("2", {"zarr_format": 2}),
        ("3", {}),
        ("s", {"shards": (8, 8, 8)}),
    ]
    for name, how in layouts:
        array = zarr.create_array(
            tmp_path / name, shape=(8, 8, 8), chunks=(4, 4, 4), dtype="u1", fill_value=3, **how
        )
        array[:] = data
        np.testing.assert_array_equal(jv.load(tmp_path / name).data, data)


def test_missing_values_become_the_least_or_what_is_asked_for(tmp_path):
    data = np.full((4, 5, 6), 2.0)
    data[0, 0] = np.nan
    encoding = {"v": {"dtype": "int16", "scale_factor": 0.5, "add_offset": 1.0, "_FillValue": -7}}
    xarray.Dataset({"v": (("z", "y", "x"), data)}).to_netcdf(
        tmp_path / "a.nc", engine="h5netcdf", encoding=encoding
    )
    with pytest.warns(UserWarning, match="6 of 120 values are missing: shown as 2"):
        np.testing.assert_array_equal(jv.load(tmp_path / "a.nc").data, 2)
    values = np.asarray(jv.load(tmp_path / "a.nc", nan=-100.0).data)
    np.testing.assert_array_equal(np.unique(values), (-100, 2))
    source = jv.bricks.source_of(tmp_path / "a.nc", nan=-100.0)
    np.testing.assert_array_equal(source.read((0, 0, 0), (6, 5, 4)), values)


def test_whole_numbers_under_a_slope_stay_distinct(tmp_path):
    image = nibabel.Nifti1Image((16777217 + np.arange(64, dtype=np.int32)).reshape(4, 4, 4), np.eye(4))
    image.header.set_slope_inter(2, 0)
    nibabel.save(image, tmp_path / "a.nii")
    with pytest.warns(UserWarning, match=r"beyond 2\*\*24.*numbered"):
        volume = jv.load(tmp_path / "a.nii")
    assert volume.label_ids is not None
    assert len(np.unique(volume.data)) == 64


def test_directions_and_positions_of_a_data_array_are_read():
    k, j, i = np.meshgrid(np.arange(4), np.arange(5), np.arange(6), indexing="ij")
    places = {"z": 30 + 3.0 * k, "y": 20 + 2.0 * j, "x": 10 - 1.0 * i}
    coords = {name: (("k", "j", "i"), numbers) for name, numbers in places.items()}
    volume = jv.Volume(xarray.DataArray(RAMP, dims=("k", "j", "i"), coords=coords))
    np.testing.assert_allclose(volume.bounds, (5, 10, 20, 28, 30, 39))
    flat = {
        "z": ("k", 30 + 3.0 * np.arange(4)),
        "y": ("j", 20 + 2.0 * np.arange(5)),
        "x": ("i", 10 - np.arange(6.0)),
    }
    other = jv.Volume(xarray.DataArray(RAMP, dims=("k", "j", "i"), coords=flat))
    np.testing.assert_allclose(other.bounds, volume.bounds)
    curved = coords | {"x": (("k", "j", "i"), 10.0 + i**2)}
    with pytest.raises(ValueError, match="curved grid"):
        jv.Volume(xarray.DataArray(RAMP, dims=("k", "j", "i"), coords=curved))
    image = sitk.GetImageFromArray(RAMP)
    image.SetOrigin((10, 20, 30))
    image.SetDirection((-1, 0, 0, 0, -1, 0, 0, 0, 1))
    coords = {"z": 30 + np.arange(4.0), "y": 20 + np.arange(5.0), "x": 10 + np.arange(6.0)}
    turn = {"direction": np.diag([1.0, -1, -1])}
    volume = jv.Volume(xarray.DataArray(RAMP, dims=("z", "y", "x"), coords=coords, attrs=turn))
    np.testing.assert_allclose(volume.bounds, jv.Volume(image).bounds)


def test_an_orientation_of_ome_zarr_is_that_of_a_patient(tmp_path):
    told = {"z": "inferior-to-superior", "y": "posterior-to-anterior", "x": "left-to-right"}
    axes = [
        {"name": n, "type": "space", "orientation": {"type": "anatomical", "value": v}}
        for n, v in told.items()
    ]
    place = [{"type": "scale", "scale": [3.0, 2, 1]}, {"type": "translation", "translation": [30.0, 20, 10]}]
    group = zarr.open_group(tmp_path / "a.zarr", mode="w")
    group.create_array("0", data=RAMP)
    image = {"axes": axes, "datasets": [{"path": "0", "coordinateTransformations": place}]}
    group.attrs["ome"] = {"version": "0.5", "multiscales": [image]}
    volume = jv.load(tmp_path / "a.zarr")
    np.testing.assert_allclose(volume.bounds, (5, 10, 12, 20, 30, 39))
    np.testing.assert_array_equal(volume.data, RAMP.T[::-1, ::-1])
    source = jv.bricks.source_of(tmp_path / "a.zarr")
    np.testing.assert_array_equal(source.read((1, 1, 0), (4, 3, 2)), np.asarray(volume.data)[1:4, 1:3, :2])
    np.testing.assert_allclose((source.spacing, source.origin), (volume.spacing, volume.origin))


def test_lengths_and_axes_of_nrrd_and_metaimage(tmp_path):
    head = "NRRD0005\ntype: short\nendian: little\ndimension: 3\nsizes: 6 5 4\nencoding: raw\n"
    space = (
        "space: right-anterior-superior\nspace directions: (0.5,0,0) (0,1,0) (0,0,2)\nspace origin: (1,2,3)\n"
    )
    units = 'space units: "um" "um" "um"\n\n'
    (tmp_path / "a.nrrd").write_bytes((head + space + units).encode() + RAMP.tobytes())
    volume = jv.load(tmp_path / "a.nrrd")
    np.testing.assert_allclose(volume.bounds, np.array([-3.5, -1, -6, -2, 3, 9]) * 1e-3, rtol=1e-5)
    np.testing.assert_array_equal(volume.data, RAMP.T[::-1, ::-1])
    head = "ObjectType = Image\nNDims = 3\nElementSpacing = 1 1 -2\nDistanceUnits = um\nDimSize = 6 5 4\n"
    head += "ElementType = MET_SHORT\nElementDataFile = LOCAL\n"
    (tmp_path / "a.mha").write_bytes(head.encode() + RAMP.tobytes())
    volume = jv.load(tmp_path / "a.mha")
    np.testing.assert_allclose(volume.bounds, np.array([0, 5, 0, 4, -6, 0]) * 1e-3, atol=1e-9)
    np.testing.assert_array_equal(volume.data, RAMP.T[:, :, ::-1])


def test_voxels_without_a_header_have_any_name(tmp_path):
    data = np.arange(60, dtype="<f4").reshape(5, 4, 3)
    for name in ("a.vol", "a.dat", "a.bin", "a.img", "a.f32", "a", "a.rec"):
        (tmp_path / name).write_bytes(b"head" + data.tobytes(order="F"))
        volume = jv.load(tmp_path / name, shape=(5, 4, 3), dtype="float32", offset=4)
        np.testing.assert_array_equal(volume.data, data)
    for dtype in ("int32", "uint32be", "int64"):
        kind = np.dtype(dtype.removesuffix("be")).newbyteorder(">" if dtype.endswith("be") else "<")
        (tmp_path / "b.raw").write_bytes(data.astype(kind).tobytes(order="F"))
        np.testing.assert_array_equal(jv.load(tmp_path / "b.raw", shape=(5, 4, 3), dtype=dtype).data, data)


def test_tables_of_values_in_dicom_are_applied(tmp_path):
    for path in write_series(tmp_path / "a", tags={"0028|1052": "0", "0028|1053": "1"}):
        header = pydicom.dcmread(path)
        table = pydicom.Dataset()
        table.LUTDescriptor, table.ModalityLUTType = [4000, 0, 16], "US"
        table.add_new("LUTData", "OW", (7 * np.arange(4000) % 4096).astype("<u2").tobytes())
        header.ModalityLUTSequence = [table]
        del header.RescaleSlope, header.RescaleIntercept
        header.save_as(path)
    np.testing.assert_array_equal(jv.load(tmp_path / "a").data, 7 * VALUES.astype(int) % 4096)


def test_of_several_images_at_a_place_one_is_chosen(tmp_path):
    (tmp_path / "b").mkdir()
    for time in (1, 2):
        for z in range(4):
            place = np.add(ORIGIN, (0, 0, SPACING[2] * z))
            tags = {"0020|0012": str(time), "0028|1052": str(1000 * time), "0028|1053": "1"}
            write_slice(tmp_path / "b" / f"t{time}z{z}.dcm", VALUES[:, :, z] + 1000 * time, place, tags=tags)
    with pytest.raises(
        ValueError, match=r"2 images at each of 4 places \(acquisition number 1, 2\): time must"
    ):
        jv.load(tmp_path / "b")
    first, second = (np.asarray(jv.load(tmp_path / "b", time=time).data) for time in (0, 1))
    np.testing.assert_array_equal(second - first, 1000)
    with pytest.raises(ValueError, match=r"time: .* has no such axis"):
        jv.load(write_series(tmp_path / "c")[0], time=0)


def test_a_disc_is_read_by_its_index_or_its_folders_are_named(tmp_path):
    write_series(tmp_path / "disc")
    (tmp_path / "IMAGES").mkdir()
    (tmp_path / "disc").rename(tmp_path / "IMAGES" / "SE1")
    (tmp_path / "DICOMDIR").write_bytes(bytes(200))
    np.testing.assert_array_equal(jv.load(tmp_path / "DICOMDIR").data, VALUES)
    for folder, name in ((tmp_path, "IMAGES/SE1"), (tmp_path / "IMAGES", "SE1")):
        with pytest.raises(ValueError, match=f"holds DICOM images in {name}: give its path"):
            jv.load(folder)


def test_frames_of_one_file_lie_as_each_says(tmp_path):
    path = write_series(tmp_path)[0]
    whole, groups = pydicom.dcmread(path), []
    for z in range(3):
        place, group = pydicom.Dataset(), pydicom.Dataset()
        place.ImagePositionPatient = [ORIGIN[0], ORIGIN[1], ORIGIN[2] + 4.0 * z]
        scale = pydicom.Dataset()
        scale.RescaleSlope, scale.RescaleIntercept, scale.RescaleType = 1, 100 * z, "US"
        group.PlanePositionSequence, group.PixelValueTransformationSequence = [place], [scale]
        groups.append(group)
    whole.NumberOfFrames, whole.PerFrameFunctionalGroupsSequence = 3, groups
    del whole.ImagePositionPatient
    stored = np.arange(3 * 6 * 7, dtype="<i2").reshape(3, 6, 7)
    whole.PixelData = stored.tobytes()
    whole.save_as(tmp_path / "frames.dcm")
    for file in tmp_path.glob("IM*.dcm"):
        file.unlink()
    volume = jv.load(tmp_path / "frames.dcm")
    np.testing.assert_array_equal(
        volume.data, (stored + np.array([0, 100, 200])[:, None, None]).transpose(2, 1, 0)
    )
    np.testing.assert_allclose(volume.spacing, (*SPACING[:2], 4.0), rtol=1e-6)


def test_names_of_dimensions_in_hdf5_count(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        array = file.create_dataset("v", data=RAMP.T)
        for dimension, name in zip(array.dims, "xyz", strict=True):
            dimension.label = name
    np.testing.assert_array_equal(jv.load(tmp_path / "a.h5").data, RAMP.T)


def test_the_record_is_printed(tmp_path, capsys):
    from jaxvol.app.cli import main

    metadata = {"axes": "ZYX", "unit": "um", "spacing": 2.0, "cf": 0, "c0": -5.0, "c1": 2.0}
    tifffile.imwrite(tmp_path / "a.tif", RAMP, imagej=True, resolution=(4, 4), metadata=metadata)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert main(["info", str(tmp_path / "a.tif")]) == 0
    printed = capsys.readouterr().out
    assert "stored       int16, Z 4 of 2 um, Y 5 of 0.25 um, X 6 of 0.25 um" in printed
    assert "scale        value = 2 x stored + -5" in printed
