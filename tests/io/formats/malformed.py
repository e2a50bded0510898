"""Breaks good files of every kind at random, and reads them, with little memory: for `test_malformed.py`.

`python -m tests.io.formats.malformed COUNT` reads so many files: bytes and numbers of headers are replaced,
parts cut out, repeated or put in. Each must be read or refused by a message, at once. It stops at the first
that is not, and prints its number: `... 1 NUMBER` reads it again. A process of its own,
since a reader may crash, hang or take all memory.
"""

import faulthandler
import gzip
import resource
import sys
import tempfile
import time
import tracemalloc
from pathlib import Path
from typing import Any

import h5py
import mrcfile
import nibabel
import numpy as np
import tensorstore  # noqa: F401  (before the limit of memory is set)
import tifffile
import vtk
import xarray
import zarr
from PIL import Image
from vtk.util.numpy_support import numpy_to_vtk  # pyright: ignore[reportMissingImports]

import jaxvol as jv
from jaxvol import bricks
from jaxvol.io.formats import READERS

from .test_dicom import write_series
from .test_formats import ramp, raw_bytes
from .test_kretz import kretz
from .test_medical import write_itk


SECONDS = 2
"""Of computing time, for a file of at most some kB."""
PATIENCE = 120
"""Seconds after which a reader hangs."""
SLACK = 2**25
"""Bytes that may be taken beyond twice the file's: buffers of fixed size, and what is allocated once."""
ROOM = 2**28
"""Bytes of address space beyond those of the imported libraries."""


def raw(folder):
    (folder / "a.raw.json").write_text('{"size": [5, 4, 3], "type": "uint8", "spacing": [1, 2, 3]}')
    (folder / "a.raw").write_bytes(raw_bytes(ramp()))
    return folder / "a.raw"


def packed_raw(folder):
    (folder / "a.raw.gz").write_bytes(gzip.compress(raw_bytes(ramp())))
    (folder / "a.json").write_text('{"size": [5, 4, 3], "type": "uint8"}')
    return folder / "a.raw.gz"


def npy(folder):
    np.save(folder / "a.npy", ramp("int16"))
    return folder / "a.npy"


def npz(folder):
    return jv.save(jv.Volume(ramp("int16"), (1, 2, 3), labels=ramp()), folder / "a.npz")


def image(ending, compress=False):
    return lambda folder: write_itk(folder / f"a{ending}", ramp("int16"), (1, 2, 3), compress=compress)


def series(folder):
    write_series(folder)
    return folder


def tiff(**options):
    def write(folder):
        tifffile.imwrite(folder / "a.tif", ramp("uint16").T, photometric="minisblack", **options)
        return folder / "a.tif"

    return write


def tiff_folder(folder):
    for z in range(3):
        tifffile.imwrite(folder / f"{z}.tif", ramp()[:, :, z].T)
    return folder


def ultrasound(folder):
    (folder / "a.vol").write_bytes(kretz())
    return folder / "a.vol"


def zarr_array(version):
    def write(folder):
        how = {"shape": (5, 4, 3), "chunks": (3, 4, 3), "dtype": "int16", "zarr_format": version}
        zarr.create_array(folder / "a.zarr", **how)[:] = ramp("int16")
        return folder / "a.zarr"

    return write


def ome_zarr(folder):
    scale = {"type": "scale", "scale": [3, 2, 1]}
    image = {
        "axes": [{"name": name, "type": "space", "unit": "micrometer"} for name in "zyx"],
        "datasets": [{"path": "0", "coordinateTransformations": [scale]}],
        "version": "0.4",
    }
    group = zarr.create_group(folder / "a.zarr", zarr_format=2, attributes={"multiscales": [image]})
    group.create_array("0", data=ramp("int16").T)
    return folder / "a.zarr"


def vtk_grid(data):
    image = vtk.vtkImageData()
    image.SetDimensions(*data.shape)
    image.GetPointData().SetScalars(numpy_to_vtk(data.ravel(order="F").copy(), deep=True))
    return image


def vtk_image(ending, mode: Any = "Ascii", compress: Any = False):
    def write(folder):
        is_xml = ending == ".vti"
        writer = vtk.vtkXMLImageDataWriter() if is_xml else vtk.vtkStructuredPointsWriter()
        writer.SetFileName(str(folder / f"a{ending}"))
        writer.SetInputData(vtk_grid(ramp("int16")))
        if is_xml:
            getattr(writer, f"SetDataModeTo{mode}")()
            getattr(writer, f"SetCompressorTypeTo{'ZLib' if compress else 'None'}")()
        else:
            getattr(writer, f"SetFileTypeTo{'Binary' if mode != 'Ascii' else 'ASCII'}")()
        writer.Write()
        return folder / f"a{ending}"

    return write


def hdf5(folder):
    with h5py.File(folder / "a.h5", "w") as file:
        file.create_dataset("v", data=ramp("int16"), chunks=(2, 4, 3), compression="gzip")
    return folder / "a.h5"


def netcdf(engine):
    def write(folder):
        variable = xarray.DataArray(ramp("int16"), dims=("x", "y", "z"), coords={"x": np.arange(5.0)})
        kind = "NETCDF3_64BIT" if engine == "scipy" else "NETCDF4"
        xarray.Dataset({"v": variable}).to_netcdf(folder / "a.nc", engine=engine, format=kind)
        return folder / "a.nc"

    return write


def mrc(folder):
    with mrcfile.new(folder / "a.mrc") as file:
        file.set_data(ramp("int16"))
        file.voxel_size = 1.5
    return folder / "a.mrc"


def nibabel_image(kind, ending):
    def write(folder):
        nibabel.save(kind(ramp("float32"), np.diag([-1.0, 2, 3, 1])), folder / f"a{ending}")
        return folder / f"a{ending}"

    return write


def pictures(folder):
    for z in range(3):
        Image.fromarray(ramp()[:, :, z]).save(folder / f"{z}.png")
    return folder


def loaded(path):
    return jv.load(path).data.size


def in_bricks(path):
    """Voxels of all levels, some of which are read."""
    return sum(
        source.read((0, 0, 0), tuple(min(n, 16) for n in source.shape)).size
        for source in bricks.levels_of(path)
    )


FILES = [
    *((kind, loaded) for kind in (raw, packed_raw, npy, npz, series, tiff_folder, ome_zarr)),
    *((image(ending), loaded) for ending in (".nii", ".mha", ".mhd", ".nrrd")),
    *((image(ending, compress=True), loaded) for ending in (".nii.gz", ".mha", ".nrrd")),
    (tiff(), loaded),
    *((tiff(compression=how), loaded) for how in ("zlib", "lzw")),
    (tiff(imagej=True, metadata={"spacing": 2.0}), loaded),
    (tiff(ome=True, metadata={"axes": "ZYX", "PhysicalSizeX": 2.0}), loaded),
    *((vtk_image(".vti", *how), loaded) for how in (("Ascii",), ("Binary", True), ("Appended",))),
    *((vtk_image(".vtk", mode), loaded) for mode in ("Ascii", "Binary")),
    *((kind, loaded) for kind in (hdf5, netcdf("scipy"), netcdf("h5netcdf"), mrc, pictures)),
    (nibabel_image(nibabel.AnalyzeImage, ".img"), loaded),
    (nibabel_image(nibabel.MGHImage, ".mgz"), loaded),
    (ultrasound, lambda path: jv.load_ultrasound(path)[0].data.size),
    *((kind, in_bricks) for kind in (raw, npy, zarr_array(2), zarr_array(3), ome_zarr)),
]
"""What writes a good file into a folder, and how many voxels are read of it."""

EXTREMES = [0, 1, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 0x7FF00000]
WORDS = ["0", "-1", "1e9", "99999", "4294967296", "nan", "1e-300", "", '"', "{", "../a"]


def edited(content, rng):
    """The content with one change."""
    length, content = len(content), bytearray(content)
    begin, end = np.sort(
        rng.integers(0, [length + 1, min(length, 500) + 1])
    )  # headers are changed more often
    match rng.integers(8):
        case 0 if length:
            content[rng.integers(length)] ^= 1 << rng.integers(8)
        case 1:
            content[begin : begin + 4] = rng.bytes(rng.integers(1, 8))
        case 2:
            content[begin : begin + 4] = int(rng.choice(EXTREMES)).to_bytes(4, "little")
        case 3:  # in place of the next number in the text, if there is one
            digits = [i for i in range(begin, min(begin + 200, length)) if chr(content[i]).isdigit()]
            if digits:
                behind = digits[0]
                while behind < length and chr(content[behind]).isdigit():
                    behind += 1
                content[digits[0] : behind] = str(rng.choice(WORDS)).encode()
        case 4:
            del content[begin:end]
        case 5:
            content[begin:begin] = content[begin:end]
        case 6:
            del content[end:]
        case 7:
            content[begin:begin] = rng.bytes(rng.integers(1, 20))
    return bytes(content)


def fault(number):
    """What is wrong with how a broken file is read; None if nothing is."""
    rng = np.random.default_rng(number)
    write, read = FILES[number % len(FILES)]
    with tempfile.TemporaryDirectory() as folder:
        path = write(Path(folder))
        files = sorted(file for file in Path(folder).rglob("*") if file.is_file())
        broken = files[rng.integers(len(files))]
        for _ in range(rng.integers(1, 4)):
            broken.write_bytes(edited(broken.read_bytes(), rng))
        honest = sum(file.stat().st_size for file in files)
        faulthandler.dump_traceback_later(PATIENCE, exit=True)
        tracemalloc.reset_peak()
        before, begun, found = tracemalloc.get_traced_memory()[0], time.process_time(), None
        try:
            read(path)
        except (ValueError, OSError, ImportError) as error:
            if len(str(error)) <= 20 or "allocate" in str(error).lower():
                found = f"a message that tells nothing: {error!r}"
        except BaseException as error:
            found = f"another error: {error!r}"
        seconds, taken = time.process_time() - begun, tracemalloc.get_traced_memory()[1] - before
        faulthandler.cancel_dump_traceback_later()
    if seconds > SECONDS or taken > 2 * honest + SLACK:
        found = f"{seconds:.1f} s, {taken} bytes"
    return None if found is None else f"{broken.name} of {path.name}: {found}"


def main(count, first=0):
    readers = set(READERS.values())
    for write, read in FILES:  # what libraries allocate once
        with tempfile.TemporaryDirectory() as folder:
            path = write(Path(folder))
            assert read(path) >= 60
        readers -= {reader for ending, reader in READERS.items() if path.name.endswith(ending)}
    assert not readers, "each reader of a kind of file has a good file in FILES"
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, used + ROOM))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    tracemalloc.start()
    for number in range(first, first + count):
        print(number, end=" ", flush=True)  # the last one, if it crashes
        if (found := fault(number)) is not None:
            sys.exit(f"number {number}, {found}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
