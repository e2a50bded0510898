"""Are Zarr arrays and OME-Zarr images, written by other programs, read as they were meant?"""

import json
import shutil
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import tensorstore
import zarr

from jaxvol.bricks import opening, sources
from jaxvol.bricks.opening import levels_of, source_of
from jaxvol.io.formats import load

from .test_sources import SHAPE, assert_reads, voxels


LAYOUTS: dict[str, dict[str, Any]] = {
    "2": {"zarr_format": 2},
    "2, F": {"zarr_format": 2, "order": "F"},
    "2, uncompressed": {"zarr_format": 2, "compressors": None},
    "3": {"zarr_format": 3},
    "3, sharded": {"zarr_format": 3, "shards": (16, 16, 32)},
    "3, v2 keys": {"zarr_format": 3, "chunk_key_encoding": {"name": "v2", "separator": "."}},
}


def written(path, data, chunks=(8, 8, 16), **options):
    layout: dict[str, Any] = {"zarr_format": 3, "config": {"write_empty_chunks": True}} | options
    array = zarr.create_array(path, shape=data.shape, dtype=data.dtype, chunks=chunks, **layout)
    array[...] = data
    return path


def test_no_memory_is_taken_for_chunks_far_larger_than_the_array(tmp_path, monkeypatch):
    path = written(tmp_path / "a", np.zeros((5, 4, 3), np.uint8), (10, 10, 3))
    assert source_of(path).shape == (5, 4, 3)
    monkeypatch.setattr(opening, "LARGE", 64)
    monkeypatch.setattr(opening, "BEYOND", 2)
    with pytest.raises(ValueError, match=r"got chunks of \(10, 10, 3\) voxels, 300 bytes"):
        source_of(path)


def chunk_files(path):
    return sorted(f for f in path.rglob("*") if f.is_file() and not f.name.startswith((".z", "zarr.")))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_zarr_arrays_of_every_layout_and_their_damage(layout, tmp_path):
    data = voxels("uint16")
    path = written(tmp_path / "a.zarr", data, fill_value=7, **LAYOUTS[layout])
    source = source_of(path)
    assert source.chunks == (8, 8, 16)
    assert_reads(source, data)
    first, *_, last = chunk_files(path)
    first.unlink()
    filled, expected = source_of(path).read((0, 0, 0), SHAPE), data.copy()
    expected[(slice(16), slice(16), slice(32)) if "sharded" in layout else np.s_[:8, :8, :16]] = 7
    np.testing.assert_array_equal(filled, expected)
    last.write_bytes(last.read_bytes()[:-20])
    with pytest.raises(ValueError, match=r"from .* to .* cannot be read .* Fetch it again"):
        source_of(path).read((0, 0, 0), SHAPE)


@pytest.mark.parametrize("dtype", ["float16", "float64", "int64", "bool", "bfloat16", ">u2"])
def test_zarr_arrays_of_other_types_are_read_layer_by_layer(dtype, tmp_path, monkeypatch):
    monkeypatch.setattr(sources, "AT_ONCE", 2**13)
    read = {"float64": "float32", "int64": "float32", "bool": "uint8", ">u2": "uint16"}.get(dtype, dtype)
    if dtype == "bfloat16":
        data = voxels(dtype)
        spec = {"driver": "zarr3", "kvstore": {"driver": "file", "path": f"{tmp_path / 'a.zarr'}/"}}
        tensorstore.open(spec, create=True, dtype=tensorstore.bfloat16, shape=SHAPE).result()[...] = data
        assert_reads(source_of(tmp_path / "a.zarr"), data)
        return
    data = np.random.default_rng(0).integers(0, 2, SHAPE).astype(dtype)
    path = written(tmp_path / "a.zarr", data, (5, 8, 16), zarr_format=2 if dtype == ">u2" else 3)
    assert_reads(source_of(path), data.astype(read))


@pytest.mark.parametrize("axes", ["zyx", "yxz", "tczyx", "xyzc"])
def test_axes_by_name_in_any_order(axes, tmp_path):
    data = voxels("uint16")
    order = [axes.replace("t", "").replace("c", "").index(name) for name in "xyz"]
    stored = data.transpose(np.argsort(order))
    for axis, name in enumerate(axes):
        if name in "tc":
            stored = np.expand_dims(stored, axis)
    chunks = tuple(min(n, 8) for n in stored.shape)
    assert_reads(source_of(written(tmp_path / "a", stored, chunks, dimension_names=list(axes))), data)
    of_xarray = {"zarr_format": 2, "attributes": {"_ARRAY_DIMENSIONS": list(axes)}}
    assert_reads(source_of(written(tmp_path / "c", stored, chunks, **of_xarray)), data)


def test_time_and_channel_choose_along_other_axes(tmp_path):
    data = voxels("uint16", (2, 3, 9, 10, 11))
    path = written(tmp_path / "a.zarr", data, (1, 1, 8, 8, 8), dimension_names=list("tczyx"))
    source = source_of(path, time=1, channel=2)
    assert_reads(source, data[1, 2].T)
    for chosen, message in (
        ({"channel": 0}, "time must be given, from 0 to 1"),
        ({"time": 0}, "channel must be given, from 0 to 2"),
        ({"time": 2, "channel": 0}, "time must be an integer from 0 to 1; got 2"),
    ):
        with pytest.raises(ValueError, match=message):
            source_of(path, **chosen)
    with pytest.raises(ValueError, match=r"a has 5 axes without names\. Pass an xarray"):
        source_of(written(tmp_path / "a", data, (1, 1, 8, 8, 8)))


def test_what_is_no_zarr_array_or_cannot_be_read_says_so(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"data must be of type uint8.*; got complex64"):
        source_of(written(tmp_path / "c.zarr", np.zeros(SHAPE, np.complex64)))
    path = written(tmp_path / "a.zarr", voxels())
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "tensorstore", None)
        with pytest.raises(ImportError, match=r'pip install "jaxvol\[bricks\]"'):
            source_of(path)
    for text in ("{", "[]", json.dumps(json.loads((path / "zarr.json").read_text()) | {"codecs": []})):
        (path / "zarr.json").write_text(text)
        with pytest.raises(ValueError, match=r"a\.zarr"):
            source_of(path)
    zarr.create_group(tmp_path / "e")
    with pytest.raises(ValueError, match=r"does not follow OME-Zarr 0\.5"):
        source_of(tmp_path / "e")
    zarr.create_group(tmp_path / "g", zarr_format=2)
    (tmp_path / "g" / ".zattrs").unlink(missing_ok=True)
    with pytest.raises(ValueError, match=r"does not follow OME-Zarr 0\.4 .*such as its folder 0"):
        source_of(tmp_path / "g")
    zarr.create_group(tmp_path / "f", attributes={"ome": {"bioformats2raw.layout": 3}})
    with pytest.raises(ValueError, match="such as its folder 0"):
        source_of(tmp_path / "f")


# ---- OME-Zarr ----


def pyramid(data, count):
    """Levels, of means of 2 x 2 x 2 voxels."""
    levels = [data]
    while len(levels) < count:
        x, y, z = (n // 2 for n in levels[-1].shape)
        parts = levels[-1][: 2 * x, : 2 * y, : 2 * z].reshape(x, 2, y, 2, z, 2)
        levels.append(parts.mean((1, 3, 5)).astype(data.dtype))
    return levels


def ome_written(path, levels, version, spacing=(0.3, 0.4, 2.0), axes="tczyx"):
    """An OME-Zarr image whose levels halve the resolution, each voxel at the center of what it averages."""
    kinds = {"t": {"type": "time"}, "c": {"type": "channel"}}
    space = {"type": "space", "unit": "micrometer"}
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


@pytest.mark.parametrize(("version", "axes"), [("0.4", "tczyx"), ("0.5", "zyx"), ("0.5", "xyz")])
def test_levels_of_ome_zarr(version, axes, tmp_path):
    levels, path = pyramid(voxels("uint16", (40, 36, 52)), 3), tmp_path / "image.ome.zarr"
    image = ome_written(path, levels, version, axes=axes)
    for number, (source, data) in enumerate(zip(levels_of(path), levels, strict=True)):
        assert_reads(source, data)
        np.testing.assert_allclose(source.spacing, np.array([3e-4, 4e-4, 2e-3]) * 2**number)  # mm
        np.testing.assert_allclose(source.origin, np.array([3e-4, 4e-4, 2e-3]) * (2**number - 1) / 2)
    with pytest.raises(TypeError, match=r"^spacing, origin: the OME-Zarr image .* has its own"):
        levels_of(path, spacing=(3, 4, 10), origin=(1, 1, 1))
    # transformations of all levels come after their own
    outer = [{"type": "scale", "scale": [10] * len(axes)}]
    outer += [{"type": "translation", "translation": [3] * len(axes)}]
    write_image(path, image | {"coordinateTransformations": outer}, version)
    second = levels_of(path)[1]
    np.testing.assert_allclose((second.spacing, second.origin), ((6e-3, 8e-3, 40e-3), (4.5e-3, 5e-3, 13e-3)))


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ({"axes": ["z", "y", "x"]}, "does not follow OME-Zarr"),
        ({"axes": [{"name": a, "type": "space"} for a in "abc"]}, "must have axes x, y and z; got"),
        ({"datasets": [{"path": "../other"}]}, "does not follow OME-Zarr.*not a valid Zarr node name"),
        ({"coordinateTransformations": [{"type": "scale", "path": "s"}]}, "does not follow OME-Zarr"),
        (
            {"coordinateTransformations": [{"type": "scale", "scale": [1, 0, 1]}]},
            "finite, with steps longer than 0",
        ),
    ],
)
@pytest.mark.parametrize("version", ["0.4", "0.5"])
def test_metadata_that_do_not_follow_ome_zarr_are_refused(fault, message, version, tmp_path):
    image = ome_written(tmp_path / version, [voxels()], version, axes="zyx")
    write_image(tmp_path / version, image | fault, version)
    with pytest.raises(ValueError, match=message):
        source_of(tmp_path / version)


def test_load_reads_the_finest_level_that_fits(tmp_path, monkeypatch):
    levels, path = pyramid(voxels("uint16", (40, 36, 52)), 3), tmp_path / "image.ome.zarr"
    write_image(path, ome_written(path, levels, "0.5", axes="zyx"), "0.5")
    for k, room in enumerate((1 << 30, levels[0].nbytes * 4 - 1)):
        monkeypatch.setattr(opening, "memory_of_device", lambda room=room: room)
        volume, source = load(path), levels_of(path)[k]
        np.testing.assert_array_equal(volume.data, levels[k])
        np.testing.assert_allclose(volume.spacing, source.spacing, rtol=1e-6)
        np.testing.assert_allclose(volume.origin, source.origin, rtol=1e-6)
    monkeypatch.setattr(opening, "memory_of_device", lambda: 100)
    with pytest.raises(ValueError, match=r"must fit into .* Read it in bricks: jv\.render_bricks"):
        load(path)
    with pytest.raises(ValueError, match="shape and dtype are for raw files"):
        load(path, shape=SHAPE)
    monkeypatch.undo()
    data = np.stack([voxels("uint8"), voxels("uint8") // 2])
    written(tmp_path / "a", data, (1, 8, 8, 16), dimension_names=["c", "x", "y", "z"])
    np.testing.assert_array_equal(load(tmp_path / "a", channel=1).data, data[1])
    with pytest.raises(ValueError, match="channel must be given, from 0 to 1"):
        load(tmp_path / "a")


def test_load_knows_zarr_before_anything_else_of_jaxvol_is_used(tmp_path):
    zarr.create_array(tmp_path / "a.zarr", data=np.ones((3, 4, 5), np.uint8))
    code = "import sys, jaxvol as jv; print(jv.load(sys.argv[1]).shape)"
    ran = subprocess.run([sys.executable, "-c", code, tmp_path / "a.zarr"], capture_output=True, text=True)
    assert ran.stdout.strip() == "(3, 4, 5)", ran.stderr[-500:]


def test_levels_become_coarser_and_none_is_missing(tmp_path):
    image = ome_written(tmp_path, pyramid(voxels("uint8", (16, 16, 16)), 3), "0.5", axes="zyx")
    write_image(tmp_path, image | {"datasets": image["datasets"][::-1]}, "0.5")
    with pytest.raises(ValueError, match="not ordered from highest to lowest resolution"):
        levels_of(tmp_path)
    shutil.rmtree(tmp_path / "1")
    write_image(tmp_path, image, "0.5")
    with pytest.raises(ValueError, match="1 is no Zarr array within the group"):
        levels_of(tmp_path)
