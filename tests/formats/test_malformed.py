"""Is a malformed file read or refused by a message, at once, whatever is wrong with it?

Files of every kind are changed at random: bytes and numbers of their headers replaced, parts cut out,
repeated or put in. They are read in another process, which has little memory.
"""

import gzip
import io
import json
import select
import subprocess
import sys
import tempfile
from pathlib import Path

import hypothesis
import numpy as np
import pytest
from hypothesis import given, strategies as st

import jaxvol as jv

from .test_dicom import write_series
from .test_formats import ramp, raw_bytes, write_itk
from .test_kretz import kretz


pytest.importorskip("SimpleITK", reason="SimpleITK is not installed: pip install jaxvol[io]")
tifffile = pytest.importorskip("tifffile", reason="tifffile is not installed: pip install jaxvol[io]")
zarr = pytest.importorskip("zarr", reason="zarr is not installed: pip install zarr")

SECONDS = 2
"""Of computing time, for a file of at most some kB."""

SLACK = 2**25
"""Bytes that may be taken beyond twice the file's: buffers of fixed size, and what is allocated once."""

PATIENCE = 120
"""Seconds without an answer, on a busy machine, after which a reader hangs."""


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
    def write(folder):
        import SimpleITK as sitk

        return write_itk(sitk, folder / f"a{ending}", ramp("int16"), (1, 2, 3), compress=compress)

    return write


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
        array = zarr.create_array(
            folder / "a.zarr", shape=(5, 4, 3), chunks=(3, 4, 3), dtype="int16", zarr_format=version
        )
        array[:] = ramp("int16")
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


FILES = {
    "raw": (raw, "load"),
    "raw.gz": (packed_raw, "load"),
    "npy": (npy, "load"),
    "npz": (npz, "load"),
    "nii": (image(".nii"), "load"),
    "nii.gz": (image(".nii.gz", True), "load"),
    "mha": (image(".mha"), "load"),
    "mha, compressed": (image(".mha", True), "load"),
    "mhd": (image(".mhd"), "load"),
    "nrrd": (image(".nrrd"), "load"),
    "nrrd, compressed": (image(".nrrd", True), "load"),
    "dicom": (series, "load"),
    "tiff": (tiff(), "load"),
    "tiff, compressed": (tiff(compression="zlib"), "load"),
    "tiff, ImageJ": (tiff(imagej=True, metadata={"spacing": 2.0}), "load"),
    "tiff, folder": (tiff_folder, "load"),
    "kretz": (ultrasound, "ultrasound"),
    "raw as bricks": (raw, "bricks"),
    "npy as bricks": (npy, "bricks"),
    "zarr 2": (zarr_array(2), "bricks"),
    "zarr 3": (zarr_array(3), "bricks"),
    "ome-zarr": (ome_zarr, "bricks"),
}
"""By kind: what writes a good file into a folder, and how it is read."""

EXTREMES = [0, 1, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 0x7FF00000]
WORDS = ["0", "-1", "1e9", "99999", "4294967296", "nan", "1e-300", "", '"', "{", "../a"]

PLACE = st.one_of(st.integers(0, 500), st.floats(0, 1))
EDIT = st.one_of(
    st.tuples(st.just("flip"), PLACE, st.integers(0, 7)),
    st.tuples(st.just("set"), PLACE, st.binary(min_size=1, max_size=8)),
    st.tuples(st.just("number"), PLACE, st.sampled_from(EXTREMES)),
    st.tuples(st.just("word"), PLACE, st.sampled_from(WORDS)),
    st.tuples(st.just("cut"), PLACE, PLACE),
    st.tuples(st.just("repeat"), PLACE, PLACE),
    st.tuples(st.just("end"), PLACE, st.none()),
    st.tuples(st.just("insert"), PLACE, st.binary(min_size=1, max_size=20)),
)


def edited(content, kind, place, what):
    """The content with one change. A place is a byte's number, or its part of the whole."""

    def at(place):
        return min(int(place * len(content)) if isinstance(place, float) else place, max(len(content) - 1, 0))

    begin, content = at(place), bytearray(content)
    match kind:
        case "flip" if content:
            content[begin] ^= 1 << what
        case "set":
            content[begin : begin + len(what)] = what
        case "number":
            content[begin : begin + 4] = what.to_bytes(4, "little")
        case "word":  # in place of the next number in the text, if there is one
            digits = [i for i in range(begin, min(begin + 200, len(content))) if chr(content[i]).isdigit()]
            if digits:
                end = digits[0]
                while end < len(content) and chr(content[end]).isdigit():
                    end += 1
                content[digits[0] : end] = what.encode()
        case "cut":
            del content[slice(*sorted((begin, at(what))))]
        case "repeat":
            part = slice(*sorted((begin, at(what))))
            content[begin:begin] = content[part]
        case "end":
            del content[begin:]
        case "insert":
            content[begin:begin] = what
    return bytes(content)


class Worker:
    """The process that reads files. It is started again after it crashed."""

    def __init__(self):
        self.process = None

    def ask(self, how, path):
        if self.process is None:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "tests.formats.malformed"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                cwd=Path(__file__).parents[2],
            )
            for write, way in FILES.values():  # what libraries allocate once
                with tempfile.TemporaryDirectory() as folder:
                    good = self._answer(way, write(Path(folder)))
                    assert good["voxels"] >= 60, good
            self._answer("limit", "")
        return self._answer(how, path)

    def _answer(self, how, path):
        assert self.process is not None
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps([how, str(path)]) + "\n")
        self.process.stdin.flush()
        ready, _, _ = select.select([self.process.stdout], [], [], PATIENCE)
        line = self.process.stdout.readline() if ready else ""
        if line:
            return json.loads(line)
        self.stop()
        return {"kinds": ["crashed" if ready else "hung"], "message": "", "seconds": 0, "bytes": 0}

    def stop(self):
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process = None


@pytest.fixture(scope="module")
def worker():
    running = Worker()
    yield running
    running.stop()


def check(worker, kind, which, edits):
    write, how = FILES[kind]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = write(folder)
        files = sorted(file for file in folder.rglob("*") if file.is_file())
        chosen = files[which % len(files)]
        content = chosen.read_bytes()
        for edit in edits:
            content = edited(content, *edit)
        chosen.write_bytes(content)
        honest = sum(file.stat().st_size for file in files)
        answer = worker.ask(how, path)
    if "kinds" in answer:
        assert {"ValueError", "OSError", "ImportError"} & set(answer["kinds"]), answer
        assert len(answer["message"]) > 20, answer
        assert "allocate" not in answer["message"].lower(), answer
    assert answer["seconds"] < SECONDS, answer
    assert answer["bytes"] < 2 * honest + SLACK, answer


CHANGES = {
    "kind": st.sampled_from(list(FILES)),
    "which": st.integers(0, 20),
    "edits": st.lists(EDIT, min_size=1, max_size=3),
}
USUAL = {"deadline": None, "database": None, "suppress_health_check": list(hypothesis.HealthCheck)}


@hypothesis.settings(max_examples=300, **USUAL)
@given(**CHANGES)
def test_malformed_files_are_read_or_refused_at_once(worker, kind, which, edits):
    check(worker, kind, which, edits)


@pytest.mark.slow
@hypothesis.settings(max_examples=10_000, **USUAL)
@given(**CHANGES)
def test_ten_thousand_malformed_files_are_read_or_refused_at_once(worker, kind, which, edits):
    check(worker, kind, which, edits)


@pytest.mark.parametrize("kind", ["mha", "mhd", "nrrd", "nrrd, compressed", "nii", "tiff", "npy", "raw"])
def test_a_header_alone_takes_no_memory(worker, tmp_path, kind):
    """1000 times as many voxels along an axis as there are."""
    write, how = FILES[kind]
    path = write(tmp_path)
    for file in tmp_path.iterdir():
        content = file.read_bytes()
        if kind == "nii":
            content = content[:42] + np.array([5000, 4000, 3000], "<i2").tobytes() + content[48:]
        elif kind == "tiff":
            content = _lengthened(content)
        else:
            for old in (b"5 4 3", b"(5, 4, 3)", b"[5, 4, 3]"):
                content = content.replace(old, old.replace(b"5", b"5000").replace(b"4", b"4000"))
        file.write_bytes(content)
    answer = worker.ask(how, path)
    assert "ValueError" in answer["kinds"], answer
    assert "allocate" not in answer["message"], answer
    assert answer["bytes"] < SLACK


def _lengthened(content):
    """A TIFF file whose first image has 4000 times as many rows (tag 257)."""
    with tifffile.TiffFile(io.BytesIO(content)) as file:
        rows = file.pages.first.tags[257]
        at, size = rows.valueoffset, rows.valuebytecount
    return content[:at] + (16000).to_bytes(size, "little") + content[at + size :]
