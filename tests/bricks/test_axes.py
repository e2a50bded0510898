"""Does it matter in which order voxels are stored? Boxes and images are the same, and no voxel is moved."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol._util.axes import inverse
from jaxvol.bricks import raw, source_of, summary_of
from jaxvol.bricks.summary import scan

from ..scenes import slow


ORDERS: Any = list(itertools.permutations(range(3)))
SHAPE = 20, 25, 18
TRANSFER = jv.TransferFunction.from_points(
    [(60, (1, 1, 1), 0.0), (90, (1, 0, 1), 0.02), (250, (0, 1, 1), 0.1)]
)
PLACE = {"spacing": (1.0, 1.1, 0.9), "origin": (3.0, -2.0, 5.0)}
CAMERA = jv.Camera((60, 40, -30), (13, 11, 13), (0, 1, 0), 40.0, size=(24, 16))
MARCH = jv.March(0.5, (jv.SpaceLeaping(), jv.AlphaCorrection(), jv.Jitter(3)))


def noise(dtype: Any = np.uint8):
    return np.random.default_rng(0).integers(0, 255, SHAPE).astype(dtype)


def file_of(folder, data, name):
    path = folder / f"noise_{name}.raw"
    path.write_bytes(data.tobytes(order="F"))
    return path


def stored_in(data, axes):
    """The same array, with its voxels in another order in memory."""
    return np.ascontiguousarray(data.transpose(axes)).transpose(inverse(axes))


def zarr_of(folder, data, axes):
    """A Zarr array whose axes, and so whose chunks, have another order."""
    zarr = pytest.importorskip("zarr")
    array = np.ascontiguousarray(data.transpose(axes))
    stored = zarr.create_array(
        store=str(folder / "noise.zarr"), shape=array.shape, chunks=(8, 8, 8), dtype="u1"
    )
    stored[:] = array
    return folder / "noise.zarr", "".join("xyz"[axis] for axis in axes)


@pytest.mark.parametrize("name", ["uint8", "uint16le", "uint16be", "float32be"])
@pytest.mark.parametrize("box", [((0, 0, 0), SHAPE), ((3, 4, 5), (20, 25, 16)), ((0, 7, 5), (20, 20, 6))])
def test_a_file_is_read_in_any_order_of_axes(tmp_path, name, box):
    stored = {"uint16le": "<u2", "uint16be": ">u2", "float32be": ">f4"}.get(name, name)
    data = noise(stored)
    source, part = raw(file_of(tmp_path, data, name), SHAPE, name), tuple(map(slice, *box))
    assert source.order == (2, 1, 0)
    for axes in ORDERS:
        found = source.read(box[0], box[1], axes)
        assert found.flags.c_contiguous
        assert found.dtype.isnative
        np.testing.assert_array_equal(found, data[part].transpose(axes))


def test_wide_gaps_between_rows_are_not_read(tmp_path, monkeypatch):
    from jaxvol.bricks import files

    data = noise()
    source = raw(file_of(tmp_path, data, "uint8"), SHAPE, "uint8")
    with_gaps = source.touched((4, 5, 6))
    monkeypatch.setattr(files, "GAP", 3)
    np.testing.assert_array_equal(source.read((3, 4, 5), (7, 9, 11), (2, 1, 0)), data[3:7, 4:9, 5:11].T)
    assert source.touched((4, 5, 6)) < with_gaps == 6 * 5 * SHAPE[0]


@pytest.mark.parametrize("axes", ORDERS, ids=str)
def test_an_array_is_read_in_any_order_of_axes(axes):
    data = noise()
    source = source_of(stored_in(data, axes))
    assert source.order == axes
    low, high = (2, 1, 3), (9, 12, 8)
    box = data[tuple(map(slice, low, high))]
    for asked in ORDERS:
        np.testing.assert_array_equal(source.read(low, high, asked), box.transpose(asked))
    array = stored_in(data, axes)
    whole = source_of(array).read((0, 0, 0), SHAPE, axes)
    assert np.shares_memory(whole, array)  # in the order of storage, no voxel is moved


def test_ranges_are_found_in_the_order_of_storage(tmp_path, monkeypatch):
    data, asked = noise(np.int16), []
    source = raw(file_of(tmp_path, data, "int16"), SHAPE, "int16")
    read = source.read
    monkeypatch.setattr(source, "read", lambda *box: asked.append(box[2]) or read(*box))
    found, expected = scan(source), scan(source_of(data))
    assert {*asked} == {(2, 1, 0)}
    for end in ("low", "high"):
        np.testing.assert_array_equal(found.ranges[end], expected.ranges[end])


@pytest.mark.parametrize("bricks", [None, (2, 3, 1)])
def test_images_do_not_depend_on_the_order_of_storage(tmp_path, bricks):
    data = noise()
    data[:, 16:] = 3  # so that a brick of these is not read
    whole = jv.render(jv.Volume(data, **PLACE), TRANSFER, CAMERA, MARCH)
    zarr, names = zarr_of(tmp_path, data, (2, 0, 1))
    sources = {
        "in memory": (np.asfortranarray(data), {}),
        "raw": (file_of(tmp_path, data, "uint8"), {"shape": SHAPE, "dtype": "uint8"}),
        "zarr": (zarr, {"axes": names}),
    }
    for name, (source, options) in sources.items():
        found = jv.render_bricks(
            source, TRANSFER, CAMERA, MARCH, **PLACE, **options, cache=None, bricks=bricks
        )
        np.testing.assert_allclose(found.rgba, whole.rgba, atol=2e-6, err_msg=name)
        np.testing.assert_allclose(found.depth, whole.depth, atol=1e-4, err_msg=name)
        assert found.bricks.counts == (bricks or (1, 1, 1)), name  # along x, y, z
        assert found.bricks.stored == SHAPE, name  # with what is read around bricks


WORDS = "xyz", "xzy", "yxz", "yzx", "zxy", "zyx"


@pytest.mark.parametrize(("order", "least"), [("yzx", 0), *slow(*((order, 60000) for order in WORDS))])
def test_a_lit_surface_does_not_depend_on_the_order_of_storage(order, least):
    """From 60 000 on, values are so large against their differences that their rounding moves a surface by
    1e-3 of a voxel, and turns the normal and the light by more than images may differ. (The fast tests'
    programs, other than those of users, round sums in other orders, too.)"""
    axes: Any = tuple("xyz".index(name) for name in order)
    data = (least + np.random.default_rng(0).integers(0, 40, SHAPE)).astype(np.uint16)
    transfer = jv.TransferFunction.from_points(
        [(least, (1, 0, 1), 0.0), (least + 40, (0, 1, 1), 0.1)], unit_distance=1.0
    )
    how = {"compositing": jv.Isosurface(least + 20.0), "lighting": jv.lighting.Phong()}
    whole = jv.render(jv.Volume(data, **PLACE), transfer, CAMERA, MARCH, **how)
    stored = stored_in(data, axes)
    found = jv.render_bricks(stored, transfer, CAMERA, MARCH, **PLACE, **how, bricks=(2, 1, 2))
    assert np.mean(np.isfinite(whole.depth)) > 0.1
    np.testing.assert_allclose(found.rgba, whole.rgba, rtol=0, atol=2e-5)
    np.testing.assert_allclose(found.depth, whole.depth, rtol=1e-6)
    np.testing.assert_allclose(found.normal, whole.normal, rtol=0, atol=2e-5)


def test_an_image_of_one_channel_of_an_array_of_five_axes(tmp_path):
    zarr, data = pytest.importorskip("zarr"), noise()
    array = np.stack([data.T, 255 - data.T])[None]
    stored = zarr.create_array(
        store=str(tmp_path / "a.zarr"), shape=array.shape, chunks=(1, 1, 8, 8, 8), dtype="u1"
    )
    stored[:] = array
    how = {"axes": "tczyx", "index": {"c": 1}, "cache": None}
    found = jv.render_bricks(tmp_path / "a.zarr", TRANSFER, CAMERA, MARCH, **PLACE, **how)
    whole = jv.render(jv.Volume(255 - data, **PLACE), TRANSFER, CAMERA, MARCH)
    np.testing.assert_allclose(found.rgba, whole.rgba, atol=2e-6)


def test_an_array_of_xarray_is_taken_by_its_names():
    xarray = pytest.importorskip("xarray")
    data = noise()
    at = {
        name: PLACE["origin"][i] + PLACE["spacing"][i] * np.arange(SHAPE[i]) for i, name in enumerate("xyz")
    }
    named = xarray.DataArray(data, dims=("x", "y", "z"), coords=at).transpose("z", "x", "y")
    whole = jv.render(jv.Volume(data, **PLACE), TRANSFER, CAMERA, MARCH)
    found = jv.render_bricks(named, TRANSFER, CAMERA, MARCH)
    np.testing.assert_allclose(found.rgba, whole.rgba, atol=1e-5)
    moved = jv.render_bricks(named, TRANSFER, CAMERA, MARCH, spacing=(2, 2, 2))
    assert np.max(np.abs(moved.rgba - whole.rgba)) > 0.01


def test_gradients_do_not_depend_on_the_order_of_storage():
    data = noise()

    def through(array, how):
        def loss(spacing, position, factor):
            transfer = jv.TransferFunction.from_points(
                [(60, (1, 1, 1), 0.0), (90, (1, 0, 1), 0.02 * factor), (250, (0, 1, 1), 0.1 * factor)]
            )
            camera = jv.Camera(position, (13, 11, 13), (0, 1, 0), 40.0, size=(24, 16))
            return jnp.sum(how(array, spacing, transfer, camera).rgba[:, :12])

        at = jnp.asarray(PLACE["spacing"]), jnp.asarray(CAMERA.position), jnp.asarray(1.0)
        return jax.grad(loss, argnums=(0, 1, 2))(*at)

    def by_bricks(array, spacing, transfer, camera):
        place = {"spacing": spacing, "origin": PLACE["origin"]}
        return jv.render_bricks(array, transfer, camera, MARCH, **place, cache=None, bricks=(2, 1, 2))

    def in_memory(array, spacing, transfer, camera):
        return jv.render(jv.Volume(array, spacing, PLACE["origin"]), transfer, camera, MARCH)

    found, expected = through(np.asfortranarray(data), by_bricks), through(data, in_memory)
    for own, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(own, other, rtol=2e-4, atol=1e-4 * float(jnp.max(jnp.abs(other))))


def test_errors_tell_places_along_x_y_and_z(tmp_path):
    data = noise(np.float32)
    path, how = file_of(tmp_path, data, "float32"), {"shape": SHAPE, "dtype": "float32"}
    jv.render_bricks(path, TRANSFER, CAMERA, MARCH, **how)
    stale = np.asfortranarray(data)
    [kept] = tmp_path.glob("*.npz")
    source = raw(path, SHAPE, "float32")
    summary = summary_of(source)
    assert kept.exists()
    summary.ranges["high"][:] = 7
    from jaxvol.bricks import render as module

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "summary_of", lambda *_, **__: summary)
        bright = jv.TransferFunction.from_points([(0, (1, 1, 1), 0.1), (250, (1, 1, 1), 0.1)])
        with pytest.raises(ValueError, match=r"changed since .* \(0, 0, 0\) to \(20, 25, 18\)"):
            jv.render_bricks(path, bright, CAMERA, MARCH, **how)
    stale[4, 9, 2] = np.nan
    path.write_bytes(stale.tobytes(order="F"))
    with pytest.raises(ValueError, match=r"the first at \(4, 9, 2\)"):
        jv.render_bricks(path, TRANSFER, CAMERA, MARCH, **how)
