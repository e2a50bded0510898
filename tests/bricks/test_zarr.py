"""Are Zarr arrays and OME-Zarr images, written by other programs, read as they were meant?"""

import json
import re
import shutil
import sys
from typing import Any

import numpy as np
import pytest
import tensorstore
import zarr

import jaxvol as jv
from jaxvol.bricks import sources
from jaxvol.bricks.opening import levels_of, source_of
from jaxvol.bricks.zarr import ZarrSource

from .test_sources import SHAPE, assert_reads, voxels


LAYOUTS = {
    "2": {"zarr_format": 2},
    "2, F": {"zarr_format": 2, "order": "F"},
    "2, nested": {"zarr_format": 2, "chunk_key_encoding": {"name": "v2", "separator": "/"}},
    "2, uncompressed": {"zarr_format": 2, "compressors": None},
    "3": {"zarr_format": 3},
    "3, sharded": {"zarr_format": 3, "shards": (16, 16, 32)},
    "3, v2 keys": {"zarr_format": 3, "chunk_key_encoding": {"name": "v2", "separator": "."}},
}
WHOLE = {"config": {"write_empty_chunks": True}}


def written(path, data, chunks=(8, 8, 16), **options):
    layout: dict[str, Any] = {"zarr_format": 3} | WHOLE | options
    array = zarr.create_array(path, shape=data.shape, dtype=data.dtype, chunks=chunks, **layout)
    array[...] = data
    return path


def chunk_files(path):
    return sorted(
        file for file in path.rglob("*") if file.is_file() and not file.name.startswith((".z", "zarr."))
    )


# ---- arrays ----


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("dtype", ["uint8", "int16", "float32"])
def test_arrays_of_the_zarr_package(dtype, layout, tmp_path):
    data = voxels(dtype)
    source = source_of(written(tmp_path / "a.zarr", data, **LAYOUTS[layout]))
    assert isinstance(source, ZarrSource)
    assert source.chunks == (8, 8, 16)
    assert_reads(source, data)


def test_arrays_that_are_open_are_read_from_their_folder(tmp_path):
    data = voxels("int16")
    array = zarr.create_array(
        tmp_path / "a.zarr",
        shape=data.T.shape,
        dtype="i2",
        chunks=(8, 8, 16),
        dimension_names=("z", "y", "x"),
    )
    array[...] = data.T
    assert_reads(source_of(array), data)
    group = zarr.create_group(tmp_path / "b.zarr")
    inner = group.create_array("inner", shape=SHAPE, dtype="i2", chunks=(8, 8, 16))
    inner[...] = data
    assert_reads(source_of(group["inner"]), data)
    with pytest.raises(ValueError, match=r"axes: .*no such option.*|no image|multiscales"):
        source_of(group)
    within = zarr.create_array({}, shape=SHAPE, dtype="i2")
    with pytest.raises(ValueError, match=r"source: .*Array.* no.* in a folder .* pass the path .*array\[:\]"):
        source_of(within)


@pytest.mark.parametrize("dtype", ["float64", "int64"])
def test_types_that_are_converted_are_read_layer_by_layer(dtype, tmp_path, monkeypatch):
    monkeypatch.setattr(sources, "AT_ONCE", 2**13)
    data = np.random.default_rng(0).integers(-99, 99, SHAPE).astype(dtype)
    assert_reads(source_of(written(tmp_path / "a.zarr", data, (5, 8, 16))), data.astype(np.float32))


@pytest.mark.parametrize("dtype", ["int8", "uint16", "float16", "float64", "int32", "bool"])
def test_other_types(dtype, tmp_path):
    data = np.random.default_rng(0).integers(0, 2, SHAPE).astype(dtype)
    source = source_of(written(tmp_path / "a.zarr", data))
    assert_reads(
        source, data.astype({"float64": "float32", "int32": "float32", "bool": "uint8"}.get(dtype, dtype))
    )


@pytest.mark.parametrize("dtype", ["uint16", "bfloat16"])
def test_arrays_of_tensorstore(dtype, tmp_path):
    data = voxels(dtype)
    spec = {
        "driver": "zarr3",
        "kvstore": {"driver": "file", "path": f"{tmp_path / 'a.zarr'}/"},
        "metadata": {
            "shape": SHAPE,
            "data_type": dtype,
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [32, 5, 7]}},
        },
    }
    tensorstore.open(spec, create=True).result()[...].write(data).result()
    assert_reads(source_of(tmp_path / "a.zarr"), data)


def test_other_byte_order(tmp_path):
    data = voxels("uint16").astype(">u2")
    assert_reads(source_of(written(tmp_path / "a.zarr", data, zarr_format=2)), data.astype("uint16"))


@pytest.mark.parametrize("axes", ["zyx", "yxz", "tczyx", "xyzc"])
def test_axes_by_name_in_any_order(axes, tmp_path):
    data = voxels("uint16")
    order = [axes.replace("t", "").replace("c", "").index(name) for name in "xyz"]
    stored = data.transpose(np.argsort(order))
    for axis, name in enumerate(axes):
        if name in "tc":
            stored = np.expand_dims(stored, axis)
    chunks = tuple(min(n, 8) for n in stored.shape)
    path = written(tmp_path / "a.zarr", stored, chunks, dimension_names=list(axes))
    assert_reads(source_of(path), data)
    path = written(tmp_path / "b.zarr", stored, chunks)
    assert_reads(source_of(path, axes=axes), data)
    path = written(
        tmp_path / "c.zarr", stored, chunks, zarr_format=2, attributes={"_ARRAY_DIMENSIONS": list(axes)}
    )
    assert_reads(source_of(path), data)


def test_an_index_chooses_along_other_axes(tmp_path):
    data = voxels("uint16", (2, 3, 9, 10, 11))
    path = written(tmp_path / "a.zarr", data, (1, 1, 8, 8, 8), dimension_names=list("tczyx"))
    source = source_of(path, index={"t": 1, "c": 2})
    assert_reads(source, data[1, 2].T)
    assert source.fingerprint() != source_of(path, index={"t": 1, "c": 1}).fingerprint()
    for index, message in (
        (None, "index must choose one of the 2 entries .* along 't'"),
        ({"t": 0}, "index must choose one of the 3 entries .* along 'c'"),
        ({"t": 2, "c": 0}, r"index\['t'\] must be an integer from 0 to 1; got 2"),
        ({"t": 0, "c": 0, "z": 1}, "index must name axes .* other than x, y, z"),
        ({"t": 0, "c": 0, "q": 1}, "index must name axes"),
    ):
        with pytest.raises(ValueError, match=message):
            source_of(path, index=index)


@pytest.mark.parametrize("axes", ["zy", "zzx", "zyxc", "abc", ["z", "y"], 3])
def test_axes_that_do_not_fit_are_refused(axes, tmp_path):
    path = written(tmp_path / "a.zarr", voxels("uint8"))
    with pytest.raises(ValueError, match="axes must name each of the 3 axes"):
        source_of(path, axes=axes)


def test_four_axes_without_names_are_refused(tmp_path):
    path = written(tmp_path / "a.zarr", voxels("uint8", (1, 4, 4, 4)), (1, 4, 4, 4))
    with pytest.raises(ValueError, match="axes must name each of the 4 axes"):
        source_of(path)


def test_complex_voxels_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"data must be of type uint8.*; got complex64"):
        source_of(written(tmp_path / "a.zarr", np.zeros(SHAPE, np.complex64)))


# ---- damage ----


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_missing_chunk_is_an_error_unless_it_means_fill(layout, tmp_path):
    data = voxels("uint16")
    path = written(tmp_path / "a.zarr", data, fill_value=7, **LAYOUTS[layout])
    chunk_files(path)[0].unlink()
    source = source_of(path)
    with pytest.raises(ValueError, match=r'a chunk is missing or damaged.*missing="fill"'):
        source.read((0, 0, 0), SHAPE)
    with pytest.raises(ValueError, match=r'a chunk is missing or damaged.*missing="fill"'):
        source.read_async((0, 0, 0), SHAPE).result()
    filled = source_of(path, missing="fill").read((0, 0, 0), SHAPE)
    expected = data.copy()
    expected[
        (slice(16), slice(16), slice(32)) if "sharded" in layout else (slice(8), slice(8), slice(16))
    ] = 7
    np.testing.assert_array_equal(filled, expected)
    assert source.fingerprint() != source_of(path, missing="fill").fingerprint()


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("content", ["cut", "foreign", "empty"])
def test_a_damaged_chunk_is_an_error(layout, content, tmp_path):
    path = written(tmp_path / "a.zarr", voxels("uint16"), **LAYOUTS[layout])
    chunk = chunk_files(path)[-1]
    whole = chunk.read_bytes()
    foreign = np.random.default_rng(0).bytes(len(whole) // 2)
    chunk.write_bytes({"cut": whole[: len(whole) // 2], "foreign": foreign, "empty": b""}[content])
    for missing in ("error", "fill"):
        with pytest.raises(ValueError, match=r"from .* to .* cannot be read: a chunk is missing or damaged"):
            source_of(path, missing=missing).read((0, 0, 0), SHAPE)


def test_damaged_metadata_is_an_error(tmp_path):
    path = written(tmp_path / "a.zarr", voxels("uint8"))
    metadata = json.loads((path / "zarr.json").read_text())
    for text in ("{", "[]", json.dumps(metadata | {"shape": "x"}), json.dumps(metadata | {"codecs": []})):
        (path / "zarr.json").write_text(text)
        with pytest.raises(ValueError, match=r"a\.zarr"):
            source_of(path)


def test_without_tensorstore_the_error_says_what_to_install(tmp_path, monkeypatch):
    path = written(tmp_path / "a.zarr", voxels("uint8"))
    monkeypatch.setitem(sys.modules, "tensorstore", None)
    with pytest.raises(ImportError, match=r'pip install "jaxvol\[bricks\]"'):
        source_of(path)


def test_a_fingerprint_changes_with_any_chunk_and_with_the_metadata(tmp_path):
    path = written(tmp_path / "a.zarr", voxels("uint8"))
    seen = [source_of(path).fingerprint()]
    assert source_of(path).fingerprint() == seen[0]
    for file in (chunk_files(path)[3], path / "zarr.json"):
        file.write_bytes(file.read_bytes())  # of the same content, but that is not known
        seen.append(source_of(path).fingerprint())
    chunk_files(path)[0].unlink()
    seen.append(source_of(path).fingerprint())
    assert all(a != b for i, a in enumerate(seen) for b in seen[:i])


# ---- OME-Zarr ----


def halved(data):
    """Means of 2 x 2 x 2 voxels."""
    x, y, z = (n // 2 for n in data.shape)
    return data[: 2 * x, : 2 * y, : 2 * z].reshape(x, 2, y, 2, z, 2).mean((1, 3, 5)).astype(data.dtype)


def pyramid(data, count):
    levels = [data]
    while len(levels) < count:
        levels.append(halved(levels[-1]))
    return levels


def ome_written(path, levels, version, spacing=(0.3, 0.4, 2.0), axes="tczyx", unit="micrometer"):
    """An OME-Zarr image whose levels halve the resolution, each voxel at the center of what it averages."""
    kinds = {"t": {"type": "time"}, "c": {"type": "channel"}}
    space = {"type": "space", "unit": unit}
    datasets = []
    for number, data in enumerate(levels):
        stored = data.transpose(["xyz".index(a) for a in axes if a in "xyz"])
        stored = stored.reshape([data.shape["xyz".index(a)] if a in "xyz" else 1 for a in axes])
        chunks = tuple(min(n, 16) for n in stored.shape)
        written(path / f"{number}", stored, chunks, zarr_format=2 if version == "0.4" else 3)
        scale = [2**number * spacing["xyz".index(a)] if a in "xyz" else 1 for a in axes]
        shift = [(2**number - 1) / 2 * spacing["xyz".index(a)] if a in "xyz" else 0 for a in axes]
        transformations = [{"type": "scale", "scale": scale}, {"type": "translation", "translation": shift}]
        datasets.append({"path": f"{number}", "coordinateTransformations": transformations})
    image = {"axes": [{"name": a} | kinds.get(a, space) for a in axes], "datasets": datasets, "name": "image"}
    write_image(path, image, version)
    return image


def write_image(path, image, version):
    if version == "0.4":
        (path / ".zgroup").write_text('{"zarr_format": 2}')
        (path / ".zattrs").write_text(json.dumps({"multiscales": [image | {"version": "0.4"}]}))
    else:
        ome = {"version": "0.5", "multiscales": [image]}
        group = {"zarr_format": 3, "node_type": "group", "attributes": {"ome": ome}}
        (path / "zarr.json").write_text(json.dumps(group))


@pytest.mark.parametrize("axes", ["zyx", "tczyx", "czyx", "xyz"])
@pytest.mark.parametrize("version", ["0.4", "0.5"])
def test_levels_of_ome_zarr(version, axes, tmp_path):
    levels = pyramid(voxels("uint16", (40, 36, 52)), 3)
    path = tmp_path / "image.ome.zarr"
    ome_written(path, levels, version, axes=axes)
    found = levels_of(path)
    assert len(found) == 3
    for number, (source, data) in enumerate(zip(found, levels, strict=True)):
        assert_reads(source, data)
        np.testing.assert_allclose(np.array(source.spacing), np.array([0.3, 0.4, 2.0]) * 2**number)
        np.testing.assert_allclose(np.array(source.origin), np.array([0.3, 0.4, 2.0]) * (2**number - 1) / 2)
        assert source.beside == tmp_path / f"image.ome.zarr.{number}"
    assert_reads(source_of(path), levels[0])


def test_a_real_volume_as_ome_zarr(real_volume, tmp_path):
    volume = jv.load(real_volume("tooth_103x94x161_uint8.raw"))
    levels = pyramid(np.asarray(volume.data), 2)
    ome_written(tmp_path / "tooth.ome.zarr", levels, "0.5")
    for source, data in zip(levels_of(tmp_path / "tooth.ome.zarr"), levels, strict=True):
        assert_reads(source, data)


def test_transformations_of_all_levels_come_after_their_own(tmp_path):
    image = ome_written(tmp_path, pyramid(voxels("uint8", (16, 16, 16)), 2), "0.5", axes="zyx")
    outer = [
        {"type": "scale", "scale": [10, 10, 10]},
        {"type": "identity"},
        {"type": "translation", "translation": [3, 2, 1]},
    ]
    write_image(tmp_path, image | {"coordinateTransformations": outer}, "0.5")
    second = levels_of(tmp_path)[1]
    np.testing.assert_allclose(np.array(second.spacing), (6, 8, 40))
    np.testing.assert_allclose(np.array(second.origin), (1.5 + 1, 2 + 2, 10 + 3))


def test_a_users_spacing_and_origin_move_all_levels(tmp_path):
    ome_written(tmp_path, pyramid(voxels("uint8", (16, 16, 16)), 2), "0.4")
    first, second = levels_of(tmp_path, spacing=(3, 4, 10), origin=(1, 1, 1))
    assert (first.spacing, first.origin) == ((3, 4, 10), (1, 1, 1))
    np.testing.assert_allclose(np.array(second.spacing), (6, 8, 20))
    np.testing.assert_allclose(np.array(second.origin), (2.5, 3, 6))


@pytest.mark.parametrize("version", ["0.4", "0.5"])
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ({"axes": None}, "axes of multiscales must be a list"),
        ({"axes": ["z", "y", "x"]}, "axes must be objects with a name"),
        ({"axes": [{"name": a} for a in "abc"]}, "a volume has the axes x, y and z"),
        (
            {"axes": [{"name": a, "unit": u} for a, u in zip("zyx", ("meter", None, None), strict=True)]},
            "x, y and z must have the same unit",
        ),
        ({"datasets": []}, "datasets of multiscales must be a list"),
        ({"datasets": [{"path": "../other"}]}, "datasets must name arrays within the group"),
        ({"datasets": [{"path": "5"}]}, "is no Zarr array"),
        ({"datasets": [{}]}, "datasets must name arrays"),
        (
            {"coordinateTransformations": [{"type": "affine"}]},
            "must be of type scale, translation or identity",
        ),
        (
            {"coordinateTransformations": [{"type": "scale", "scale": [1, 2]}]},
            "one number for each of 3 axes",
        ),
        ({"coordinateTransformations": [{"type": "scale", "path": "s"}]}, "one number for each of 3 axes"),
        ({"coordinateTransformations": [{"type": "scale", "scale": [1, 0, 1]}]}, "spacing must be positive"),
    ],
    ids=lambda value: str(value)[:50],
)
def test_metadata_that_do_not_follow_ome_zarr_are_refused(fault, message, version, tmp_path):
    image = ome_written(tmp_path, [voxels("uint8")], version, axes="zyx")
    write_image(tmp_path, image | fault, version)
    with pytest.raises(ValueError, match=message):
        source_of(tmp_path)


@pytest.mark.parametrize("version", ["0.4", "0.5"])
def test_levels_in_another_order_than_ome_zarr_prescribes_are_refused(version, tmp_path):
    image = ome_written(tmp_path, pyramid(voxels("uint8", (16, 16, 16)), 3), version, axes="zyx")
    first, second, third = image["datasets"]
    message = "datasets of multiscales must be ordered from the highest resolution to the lowest; got "
    for order, finer in (
        ([second, first, third], 0),
        ([first, third, second], 1),
        ([third, second, first], 1),
    ):
        write_image(tmp_path, image | {"datasets": order}, version)
        with pytest.raises(ValueError, match=re.escape(f"{tmp_path}: {message}{tmp_path / str(finer)},")):
            levels_of(tmp_path)


@pytest.mark.parametrize(
    "change", [{"scale": [2.0, 0.2, 0.3]}, {"scale": [2.0, 0.4, 0.3]}], ids=["finer voxels", "more voxels"]
)
def test_a_level_that_is_finer_along_one_axis_is_refused(change, tmp_path):
    """By its spacing, and by its number of voxels where the spacing does not tell."""
    data = voxels("uint8", (16, 16, 16))
    second = data if change["scale"][1] == 0.2 else np.repeat(data, 2, axis=1)
    image = ome_written(tmp_path, [data, second], "0.5", axes="zyx")
    image["datasets"][1]["coordinateTransformations"] = [{"type": "scale", **change}]
    write_image(tmp_path, image, "0.5")
    with pytest.raises(ValueError, match="must be ordered from the highest resolution"):
        levels_of(tmp_path)


def test_levels_coarser_along_some_axes_and_of_rounded_spacing_are_in_order(tmp_path):
    data = voxels("uint8", (16, 16, 16))
    image = ome_written(tmp_path, [data, data[::2, ::2]], "0.5", axes="zyx")
    image["datasets"][1]["coordinateTransformations"] = [{"type": "scale", "scale": [1.9999, 0.8, 0.6]}]
    write_image(tmp_path, image, "0.5")
    assert [level.shape for level in levels_of(tmp_path)] == [(16, 16, 16), (8, 8, 16)]


def test_groups_that_are_no_image_are_refused(tmp_path):
    zarr.create_group(tmp_path / "a")
    with pytest.raises(ValueError, match="is a Zarr group without the multiscales"):
        source_of(tmp_path / "a")
    zarr.create_group(tmp_path / "b", attributes={"ome": {"bioformats2raw.layout": 3}})
    with pytest.raises(ValueError, match="holds several images: give the path of one"):
        source_of(tmp_path / "b")


def test_a_level_that_was_deleted_is_an_error(tmp_path):
    ome_written(tmp_path, pyramid(voxels("uint8", (16, 16, 16)), 2), "0.5")
    shutil.rmtree(tmp_path / "1")
    with pytest.raises(ValueError, match="1 is no Zarr array"):
        levels_of(tmp_path)
