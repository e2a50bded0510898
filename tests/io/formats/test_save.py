"""Do volumes come back from the files that they were saved to, as they were? And labels of other files?"""

import sys

import numpy as np
import pytest

import jaxvol as jv

from .test_dicom import turned
from .test_formats import ramp
from .test_medical import write_itk


SPACING, ORIGIN = (0.7, 1.3, 2.1), (-10.3, 20.7, 5.9)
MEDICAL = (".nrrd", ".mha", ".nii", ".nii.gz")


@pytest.mark.parametrize("ending", [".npz", *MEDICAL])
def test_a_volume_comes_back_as_it_was(tmp_path, ending):
    sheared = turned(10, -20, 15) @ [[1, 0.05, 0], [0, 1, -0.2], [0, 0, 1]]  # as by a tilted gantry
    turns = turned(10, -20, 15), turned(10, -20, 15), sheared / np.linalg.norm(sheared, axis=0)
    for dtype, turn in zip(("uint8", "int16", "float32"), turns, strict=True):
        volume = jv.Volume(ramp(dtype), SPACING, ORIGIN, direction=turn)
        path = jv.save(volume, tmp_path / "folder" / f"a{ending}")
        again = jv.load(path)
        assert again.data.dtype == dtype
        np.testing.assert_array_equal(again.data, volume.data)
        exact = 0 if ending == ".npz" else 2e-7
        np.testing.assert_allclose(again.spacing, volume.spacing, rtol=exact)
        np.testing.assert_array_equal(again.origin, volume.origin)
        np.testing.assert_allclose(np.array(again.direction), np.array(volume.direction), rtol=0, atol=exact)
        plain = jv.load(jv.save(jv.Volume(ramp(dtype), SPACING, ORIGIN), path))  # replaces the other
        assert plain.direction is None
        np.testing.assert_array_equal(plain.origin, volume.origin)
        assert not [file for file in path.parent.iterdir() if file.is_dir()]


def test_npz_keeps_labels_and_float16(tmp_path):
    volume = jv.Volume(ramp("float16"), labels=ramp() % 5)
    again = jv.load(jv.save(volume, tmp_path / "a.NPZ"))
    assert again.data.dtype == "float16"
    np.testing.assert_array_equal(again.labels, volume.labels)


def place(volume, value):
    """Where the voxel of this value lies in the world."""
    (index,) = np.argwhere(np.asarray(volume.data) == value)
    direction = np.eye(3) if volume.direction is None else np.asarray(volume.direction)
    return np.asarray(volume.origin) + direction @ (index * np.asarray(volume.spacing))


def test_a_volume_turned_by_more_comes_back_in_the_same_place(tmp_path):
    volume = jv.Volume(ramp("int16"), SPACING, ORIGIN, direction=turned(100, 20, 200))
    again = jv.load(jv.save(volume, tmp_path / "a.nrrd"))
    assert sorted(again.shape) == sorted(volume.shape)
    for value in (-20, 7, 39):
        np.testing.assert_allclose(place(again, value), place(volume, value), atol=1e-4)


def test_what_cannot_be_saved_is_refused(tmp_path, monkeypatch):
    volume = jv.Volume(ramp(), labels=ramp())
    cases = [
        (ramp(), "a.npz", "volume must be a Volume"),
        (volume, 5, "path must be a str or a path; got 5"),
        (volume, "a.vti", r"path must end in \.mha"),
        (volume, "a.nii", "has labels, for which a.nii has no place"),
        (jv.Volume(ramp("float16")), "a.nrrd", "voxels of float16, which a.nrrd cannot hold"),
        (jv.Volume(np.asarray(jv.Volume(ramp()).data, "bfloat16")), "a.npz", "voxels of bfloat16"),
    ]
    for what, name, message in cases:
        with pytest.raises(ValueError, match=message):
            jv.save(what, tmp_path / "deep" / name if isinstance(name, str) else name)
    with pytest.raises(ValueError, match=r"volume must be a Volume; .* The volume comes first, as in save"):
        jv.save("a.npz", volume)
    monkeypatch.setitem(sys.modules, "SimpleITK", None)
    with pytest.raises(ImportError, match=r"pip install 'jaxvol\[io\]'"):
        jv.save(jv.Volume(ramp()), tmp_path / "deep" / "a.nrrd")
    assert not list(tmp_path.iterdir())


def test_labels_come_from_another_file(tmp_path):
    turn = turned(0, 10, 0)
    write_itk(tmp_path / "ct.nrrd", ramp("int16"), SPACING, ORIGIN, turn)
    write_itk(tmp_path / "parts.nii.gz", ramp("uint8") % 7, SPACING, ORIGIN, turn)
    volume = jv.load(tmp_path / "ct.nrrd", labels=tmp_path / "parts.nii.gz")
    np.testing.assert_array_equal(volume.labels, ramp("uint8") % 7)
    np.testing.assert_array_equal(volume.data, ramp("int16"))
    write_itk(tmp_path / "moved.nrrd", ramp("uint8"), SPACING, (0, 0, 0), turn)
    # the other way round, and within the same bounds
    low, steps = np.asarray(volume.bounds)[::2], (np.array(ramp().shape) - 1) * SPACING
    other = low - np.minimum(turn.T * steps, 0).sum(axis=1)
    write_itk(tmp_path / "turned.nrrd", ramp("uint8"), SPACING, other, turn.T)
    write_itk(tmp_path / "halves.nrrd", ramp("float32") / 2, SPACING, ORIGIN, turn)
    away, kind = "must lie where the volume does", "must hold integers"
    for name, message in (("moved", away), ("turned", away), ("halves", kind)):
        with pytest.raises(ValueError, match=rf"labels: .*{name}\.nrrd {message}"):
            jv.load(tmp_path / "ct.nrrd", labels=tmp_path / f"{name}.nrrd")


def test_ids_of_labels_are_numbered_and_kept(tmp_path):
    kinds = {
        "small": (0, 7, 255),
        "wide": (0, 997, 614454277),
        "signed": (-5, 0, 2**40),
        "large": (0, 2**24, 2**63 + 5),
    }
    number = np.repeat([0, 1, 2], 8 * 12).reshape(24, 4, 3)
    np.save(tmp_path / "ct.npy", number)
    for name, ids in kinds.items():
        np.save(tmp_path / f"{name}.npy", np.array(ids, "uint64" if min(ids) == 0 else "int64")[number])
        volume = jv.load(tmp_path / "ct.npy", labels=tmp_path / f"{name}.npy")
        expected = np.array(ids)[number] if name == "small" else number
        np.testing.assert_array_equal(volume.labels, expected)
        assert volume.label_ids == (None if name == "small" else ids)
        again = jv.load(jv.save(volume, tmp_path / "a.npz"))
        assert again.label_ids == volume.label_ids
        assert np.asarray(again.labels).dtype == np.asarray(volume.labels).dtype == "uint8"
    # a segmentation by itself, which voxels cannot hold; but grey values are never numbered
    volume = jv.load(tmp_path / "wide.npy")
    np.testing.assert_array_equal(volume.data, number)
    assert volume.label_ids == kinds["wide"]
    with pytest.raises(ValueError, match=r"has labels, for which a\.nrrd has no place"):
        jv.save(volume, tmp_path / "a.nrrd")
    for ids in (5, [0.5, 1.0], [[1, 2]]):
        with pytest.raises(ValueError, match="label_ids"):
            jv.Volume(number, label_ids=ids)
    np.save(tmp_path / "counts.npy", ramp("int64") * 2**25)
    with pytest.raises(ValueError, match=r"data must be whole numbers from -2\*\*24"):
        jv.load(tmp_path / "counts.npy")
