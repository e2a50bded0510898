"""Are NIfTI files read as nibabel reads them, and wrong headers refused by the name of the field?"""

import gzip
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from jaxvol.io.formats import load, save
from jaxvol.scene.volume import Volume

from .test_dicom import turned
from .test_formats import ramp, raw_bytes


nibabel = pytest.importorskip("nibabel", reason="nibabel is not installed: pip install jaxvol[test]")


def header(version=1, order="<", **fields):
    """A header of 5 x 4 x 3 bytes whose codes are 0, with these fields changed."""
    made = (nibabel.Nifti1Header if version == 1 else nibabel.Nifti2Header)(endianness=order)
    made["magic"], made["vox_offset"] = (b"n+1", 352) if version == 1 else (b"n+2\0\r\n\x1a\n", 544)
    made.set_data_dtype("uint8")
    made.set_data_shape((5, 4, 3))
    made["pixdim"][:4] = 1, 1, 2, 3
    for name, value in fields.items():
        made[name] = value
    return made


def write(path, made, data=None):
    data = ramp(made.get_data_dtype().newbyteorder("=")) if data is None else data
    begin = made.binaryblock + bytes(4)  # no extensions
    content = begin + raw_bytes(data, made.endianness)
    path.write_bytes(gzip.compress(content) if path.name.endswith(".gz") else content)
    return path


def places(data, affine):
    """Where the voxels lie, in the order of their values, and these."""
    world = np.indices(data.shape).reshape(3, -1).T @ affine[:3, :3].T + affine[:3, 3]
    order = np.argsort(data, axis=None)
    return world[order], np.ravel(data)[order]


def affine_of(volume):
    turn = np.eye(3) if volume.direction is None else np.asarray(volume.direction)
    return np.column_stack([turn * np.asarray(volume.spacing), np.asarray(volume.origin)])


numbers = st.floats(-3, 3, width=32)


@settings(deadline=None, max_examples=60, database=None, derandomize=True)
@given(st.data())
def test_voxels_lie_and_are_scaled_as_nibabel_says(tmp_path_factory, data):
    draw = data.draw
    made = header(draw(st.sampled_from([1, 2])), draw(st.sampled_from("<>")))
    made.set_data_dtype(draw(st.sampled_from(["uint8", "int16", "int32", "float32", "float64", "uint16"])))
    made["pixdim"][:4] = draw(st.sampled_from([-1, 1])), *(draw(st.floats(0.125, 9, width=32)) for _ in "xyz")
    made["qform_code"], made["sform_code"] = codes = [draw(st.integers(0, 4)) for _ in "qs"]
    vector = np.array([draw(numbers) for _ in "bcd"])
    vector /= max(np.linalg.norm(vector), 1) * draw(st.floats(1, 4))
    for name, value in zip("bcd", vector, strict=True):
        made[f"quatern_{name}"], made[f"qoffset_{'xyz'['bcd'.index(name)]}"] = value, 7 * value + 1
    turn = np.diag(np.sign([draw(numbers) or 1.0 for _ in "xyz"]))[draw(st.permutations(range(3)))]
    shear = np.array([[draw(st.floats(-0.3, 0.3)) for _ in "xyz"] for _ in "xyz"])
    sform = np.column_stack([(turn + shear) * [draw(st.floats(0.1, 9)) for _ in "xyz"], vector * 20])
    for row, name in zip(sform, "xyz", strict=True):
        made[f"srow_{name}"] = row
    made["scl_slope"], made["scl_inter"] = draw(st.sampled_from([0, 1, 0.5, -2, np.nan])), draw(numbers)
    made["xyzt_units"], unit = draw(st.sampled_from([(0, 1), (1, 1e3), (2 + 8, 1), (3, 1e-3)]))
    path = write(tmp_path_factory.mktemp("a") / draw(st.sampled_from(["a.nii", "a.nii.gz"])), made)

    volume, image = load(path), nibabel.load(path)
    # where both codes are 0, nibabel turns the first axis, and centres: we leave axes as they are in the file
    affine = image.affine if max(codes) > 0 else np.diag([-1, -1, 1, 1] * np.append(made.get_zooms(), 1))
    found = places(np.asarray(volume.data, float), affine_of(volume))
    expected = places(image.get_fdata(), unit * np.diag([-1, -1, 1, 1]) @ affine)
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-4, atol=1e-3 * unit)
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-6, atol=1e-6)
    same = Volume(image)  # its axes stay in the file's order
    again = places(np.asarray(same.data, float), affine_of(same))
    np.testing.assert_allclose(again[0], found[0], rtol=1e-4, atol=1e-3 * unit)
    np.testing.assert_allclose(again[1], found[1], rtol=1e-6, atol=1e-6)


BAD = {
    "vox_offset NaN": ({"vox_offset": np.nan}, "cannot be read: cannot convert float NaN"),
    "vox_offset 1e30": ({"vox_offset": 1e30}, "vox_offset must be|cannot be read|cut short"),
    "vox_offset -5": ({"vox_offset": -5}, "vox offset -5 too low"),
    "vox_offset within the header": ({"vox_offset": 300}, "vox offset 300 too low"),
    "Analyze": ({"magic": b""}, "cannot be read: .*file type"),
    "voxels in another file": ({"magic": b"ni1"}, "in the same file; got b'ni1'"),
    "pixdim 0": ({"pixdim": [1, 0, 1, 1, 0, 0, 0, 0]}, "pixdim must be positive"),
    "pixdim NaN": ({"pixdim": [1, 1, np.nan, 1, 0, 0, 0, 0]}, "pixdim must be positive"),
    "pixdim negative": ({"pixdim": [1, 1, 1, -1, 0, 0, 0, 0], "qform_code": 1}, "pixdim.* positive"),
    "an sform of zeros": ({"sform_code": 1}, "its place must be finite, with steps longer than 0"),
    "an sform in a plane": (
        {"sform_code": 2, "srow_x": [1, 0, 1, 0], "srow_y": [0, 1, 0, 0], "srow_z": [0, 0, 0, 0]},
        "its place must be three directions of length 1, not all in a plane",
    ),
    "a quaternion too long": ({"qform_code": 1, "quatern_b": 2}, "w2 should be positive"),
    "an infinite intercept": ({"scl_slope": 2, "scl_inter": np.inf}, "invalid intercept"),
    "no such type": ({"datatype": 32}, "datatype must be that of integers"),
    "two axes": ({"dim": [2, 5, 4, 1, 1, 1, 1, 1]}, "must be a 3-D image"),
    "cut short": ({"dim": [3, 5, 5, 3, 1, 1, 1, 1]}, "cut short: it holds 60 .*says 75"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_wrong_header_is_refused_by_name(tmp_path, case):
    fields, message = BAD[case]
    with pytest.raises(ValueError, match=f"a.nii.*{message}"):
        load(write(tmp_path / "a.nii", header(**fields), ramp()))


def test_one_of_several_volumes_is_chosen_by_its_time_and_channel(tmp_path):
    made = header(dim=[5, 5, 4, 3, 2, 6, 1, 1])
    data = np.arange(60 * 12, dtype="uint16").reshape(5, 4, 3, 2, 6)
    made.set_data_dtype("uint16")
    path = write(tmp_path / "a.nii", made, data)
    np.testing.assert_array_equal(load(path, time=1, channel=4).data, data[..., 1, 4])
    wrong: list[tuple[Any, str]] = [
        ({}, r"channel must be given, from 0 to 5: .*a.nii holds x 5, y 4, z 3, t 2, c 6\."),
        ({"channel": 0}, "time must be given, from 0 to 1"),
        ({"channel": 0, "time": 2}, "time must be an integer from 0 to 1; got 2"),
    ]
    for index, message in wrong:
        with pytest.raises(ValueError, match=message):
            load(path, **index)
    colors = header(datatype=128)
    path = write(tmp_path / "b.nii", colors, np.moveaxis(data[..., 0, :3], 3, 0).astype("uint8"))
    np.testing.assert_array_equal(load(path).data, data[..., 0, :3].astype("uint8"))
    np.testing.assert_array_equal(load(path, channel=2).data, data[..., 0, 2].astype("uint8"))
    with pytest.raises(ValueError, match=r"time: .*b.nii has no such axis; it holds x 5, y 4, z 3, s 3"):
        load(path, time=0)


def test_nibabel_reads_what_is_saved(tmp_path):
    sheared = np.array([[1, 0.1, 0], [0, 1, 0.2], [0, 0, -1]])
    for turn in (np.eye(3), turned(10, -20, 140), turned(170, 0, 5) * (1, 1, -1), sheared):
        turn = turn / np.linalg.norm(turn, axis=0)
        volume = Volume(ramp("int16"), (1, 2, 3), (4, 5, 6), direction=turn)
        image = nibabel.load(save(volume, tmp_path / "a.nii"))
        expected = np.diag([-1, -1, 1]) @ affine_of(volume)
        np.testing.assert_allclose(image.affine[:3], expected, atol=1e-5)
        if image.header["qform_code"]:
            np.testing.assert_allclose(image.get_qform()[:3], expected, atol=1e-4)
        np.testing.assert_array_equal(image.dataobj, volume.data)
    assert image.header["qform_code"] == 0  # which cannot hold a shear


def minc(path, data, affine):
    """A file of MINC 2 as its own tools write it: axes z, y, x, and a range of values."""
    h5py = pytest.importorskip("h5py", reason="h5py is not installed: pip install jaxvol[test]")
    with h5py.File(path, "w") as file:
        axes, image = (file.create_group(f"minc-2.0/{name}") for name in ("dimensions", "image/0"))
        for i in (2, 1, 0):
            step = np.linalg.norm(affine[:3, i])
            axis = axes.create_dataset(f"{'xyz'[i]}space", data=np.int32(0))
            start = float(affine[:3, i] @ affine[:3, 3] / step)
            told = {"length": np.int32(data.shape[i]), "start": start, "step": step}
            axis.attrs.update(told | {"direction_cosines": affine[:3, i] / step})
        voxels = image.create_dataset("image", data=data.T)
        voxels.attrs["dimorder"] = np.bytes_("zspace,yspace,xspace")
        voxels.attrs["valid_range"] = np.array([data.min(), data.max()], float)
        for name, value in (("image-min", data.min()), ("image-max", data.max())):
            image.create_dataset(name, data=float(value)).attrs["dimorder"] = np.bytes_("")


@pytest.mark.parametrize("ending", [".mnc", ".mgz", ".mgh", ".img"])
def test_other_formats_of_nibabel_are_read_where_it_reads_them(tmp_path, ending):
    data = np.random.default_rng(0).integers(-100, 1000, (5, 4, 3)).astype(np.int16)
    data[3, 1, 2] = 2000
    affine = np.array([[0.5, 0, 0, 1], [0, 1.5, 0, -5], [0, 0, 2, 10], [0, 0, 0, 1]])
    path = tmp_path / f"a{ending}"
    if ending == ".mnc":
        minc(path, data, affine)
    else:
        kind = nibabel.Spm99AnalyzeImage if ending == ".img" else nibabel.MGHImage
        nibabel.save(kind(data, affine), path)
    known, volume = nibabel.load(path), load(path)
    np.testing.assert_allclose(np.sort(np.ravel(volume.data)), np.sort(np.ravel(known.dataobj)), atol=1e-3)
    place = known.affine @ (*np.unravel_index(np.argmax(known.dataobj), known.shape), 1)
    turn = np.eye(3) if volume.direction is None else np.asarray(volume.direction)
    found = np.unravel_index(np.argmax(np.asarray(volume.data)), volume.shape)
    found = np.asarray(volume.origin) + turn @ (np.asarray(volume.spacing) * found)
    np.testing.assert_allclose(found, (-place[0], -place[1], place[2]), atol=1e-4)
