"""Are images of xarray, nibabel, SimpleITK and VTK taken with their axes and their place?"""

import sys

import numpy as np
import pytest

import jaxvol as jv

from ..io.formats.test_dicom import turned


xarray = pytest.importorskip("xarray", reason="xarray is not installed: pip install xarray")

DATA = np.arange(60, dtype=np.int16).reshape(5, 4, 3)
COORDINATES = {"x": 10 + 0.5 * np.arange(5), "y": -np.arange(4.0), "z": np.arange(3) * 2}


def test_named_axes_are_put_in_order_and_coordinates_give_the_place():
    array = xarray.DataArray(DATA.T, dims=("z", "y", "x"), coords=COORDINATES)
    volume = jv.Volume(array)
    np.testing.assert_array_equal(volume.data, DATA[:, ::-1])
    np.testing.assert_array_equal(volume.spacing, (0.5, 1, 2))
    np.testing.assert_array_equal(volume.origin, (10, -3, 0))
    given = jv.Volume(array, spacing=(1, 1, 1), origin=(0, 0, 0))
    np.testing.assert_array_equal(given.spacing, (1, 1, 1))
    np.testing.assert_array_equal(given.origin, (0, 0, 0))


def test_other_names_are_taken_as_they_come():
    volume = jv.Volume(xarray.DataArray(DATA, dims=("a", "b", "c"), coords={"b": [0, 3, 6, 9]}))
    np.testing.assert_array_equal(volume.data, DATA)
    np.testing.assert_array_equal(volume.spacing, (1, 3, 1))
    np.testing.assert_array_equal(jv.Volume(xarray.DataArray(DATA)).spacing, (1, 1, 1))


@pytest.mark.parametrize("coordinate", [[0, 1, 3], [0, np.nan, 2], ["a", "b", "c"]])
def test_uneven_coordinates_are_refused(coordinate):
    with pytest.raises(ValueError, match="evenly spaced numbers as coordinates"):
        jv.Volume(xarray.DataArray(DATA, dims=("x", "y", "z"), coords={"z": coordinate}))


def test_a_stack_of_scikit_image_is_an_array_like_any_other():
    stack = np.zeros((3, 4, 5), bool)  # plane, row, column
    stack[2, 1, 4] = True
    assert int(jv.Volume(stack.T).data[4, 1, 2]) == 1


PLACE = (1.0, 2.0, 3.0), (4.0, 5.0, 6.0), turned(10, -20, 140)


def of_simple_itk(data):
    sitk = pytest.importorskip("SimpleITK")
    image = sitk.GetImageFromArray(np.swapaxes(data, 0, 2), isVector=data.ndim > 3)
    image.SetSpacing(PLACE[0])
    image.SetOrigin(PLACE[1])
    image.SetDirection(PLACE[2].ravel().tolist())
    return image


def of_nibabel(data):
    nibabel = pytest.importorskip("nibabel")
    affine = np.eye(4)
    affine[:3] = np.diag([-1, -1, 1]) @ np.column_stack([PLACE[2] * PLACE[0], PLACE[1]])
    return nibabel.Nifti1Image(data, affine)


def of_vtk(data):
    """Of an image that begins at the point (2, 1, 0) of its grid."""
    vtk = pytest.importorskip("vtk")
    numpy_to_vtk = pytest.importorskip("vtk.util.numpy_support").numpy_to_vtk
    image = vtk.vtkImageData()
    image.SetExtent(2, 6, 1, 4, 0, 2)
    image.SetSpacing(PLACE[0])
    image.SetOrigin(PLACE[1] - PLACE[2] @ (2 * 1.0, 1 * 2.0, 0.0))
    image.SetDirectionMatrix(*PLACE[2].ravel())
    numbers = np.swapaxes(data, 0, 2).reshape(data.size // data[0, 0, 0].size, -1).copy()
    image.GetPointData().SetScalars(numpy_to_vtk(numbers, deep=True))
    return image


@pytest.mark.parametrize("made", [of_simple_itk, of_nibabel, of_vtk])
def test_images_of_other_libraries_are_taken_with_their_place(made):
    for data in (DATA, np.stack([DATA, DATA + 1, DATA + 2], axis=-1)):
        volume = jv.Volume(made(data))
        np.testing.assert_array_equal(volume.data, data)
        np.testing.assert_allclose(volume.spacing, PLACE[0], rtol=1e-6)
        np.testing.assert_allclose(volume.origin, PLACE[1], rtol=1e-5)
        np.testing.assert_allclose(np.asarray(volume.direction), PLACE[2], atol=1e-6)
    np.testing.assert_array_equal(jv.Volume(made(DATA), (3, 3, 3), direction=np.eye(3)).spacing, (3, 3, 3))


def test_what_only_looks_like_an_image_of_itk_is_refused(monkeypatch):
    monkeypatch.delitem(sys.modules, "itk", raising=False)
    names = "GetSpacing", "GetOrigin", "GetDirection", "GetNumberOfComponentsPerPixel"
    image = type("itkImageF3", (), dict.fromkeys(names, lambda self: None))()
    with pytest.raises(ValueError, match="data must be an image of SimpleITK or itk; got itkImageF3"):
        jv.Volume(image)
