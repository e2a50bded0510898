"""Are arrays of xarray taken with their axes and coordinates?"""

import numpy as np
import pytest

import jaxvol as jv


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
