"""Are public datasets fetched whole, checked and kept, and every failure named? By a server in the test."""

import gzip
import hashlib
import os
import re
import socket
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

import jaxvol as jv
from jaxvol.app.cli import main
from jaxvol.io import datasets
from jaxvol.io.datasets import Dataset, registry


pytest.importorskip("pooch", reason="pooch is not installed: pip install jaxvol[datasets]")

FOLDER = os.environ.get("JAXVOL_DATA", "")

SHAPE = (40, 30, 80)
DATA = np.random.default_rng(0).integers(0, 2**16, SHAPE, dtype=np.uint16)
CONTENT = DATA.astype("<u2").tobytes(order="F")
SUM = hashlib.sha512(CONTENT).hexdigest()
NOISE = Dataset("noise", "Noise of 2026", SHAPE, "uint16", (1.0, 2.0, 3.0), SUM, "", "")


@pytest.fixture(autouse=True)
def listed(monkeypatch):
    """A dataset of 192 kB in the list, and no folder of data."""
    monkeypatch.setitem(registry(), "noise", NOISE)
    monkeypatch.delenv("JAXVOL_DATA", raising=False)


class Server:
    """An HTTP server on this machine.

    - `files`: content by path. `sends`: the number of bytes after which it closes the connection.
    - `requests`: the paths asked for.
    """

    def __init__(self, files):
        self.files, self.sends, self.requests = files, None, []
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                content = outer.files.get(self.path)
                outer.requests.append(self.path)
                if content is None:
                    self.send_error(404)
                    return
                self.send_response(200)
                self.send_header("Content-Length", str(len(content)))
                self.end_headers()
                self.wfile.write(content[: outer.sends])

            def log_message(self, format, *arguments):
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()


@pytest.fixture
def server(monkeypatch):
    running = Server({f"/noise/{NOISE.file}": CONTENT})
    monkeypatch.setattr(datasets, "OPEN_SCIVIS", running.url)
    yield running
    running.server.shutdown()
    running.server.server_close()


def test_the_list_is_what_was_published():
    names = jv.datasets.names()
    assert len(names) == 56  # with the one of this file
    assert names == sorted(names)
    engine = jv.datasets.info("Engine")
    assert engine is jv.datasets.info("engine")
    assert (engine.shape, engine.dtype, engine.nbytes) == ((256, 256, 128), "uint8", 2**23)
    assert engine.url == "http://klacansky.com/open-scivis-datasets/engine/engine_256x256x128_uint8.raw"
    for each in map(jv.datasets.info, names):
        assert re.fullmatch("[0-9a-f]{128}", each.sha512), each
        assert min(each.spacing) > 0
        assert jv.datasets.info(each.title) is each
    for name in ("", "engin", 3, None, "../engine"):
        for use in (jv.datasets.info, jv.datasets.fetch, jv.datasets.load):
            with pytest.raises(ValueError, match=r"name must be one of 3d_neurons.*aneurism"):
                use(name)
    with pytest.raises(ValueError, match=r"woodbranch has 8589934592 voxels.*render_bricks.*17 GB"):
        jv.datasets.load("woodbranch")


def test_a_good_file_is_fetched_once_and_loaded(server, tmp_path, monkeypatch, capsys):
    path = jv.datasets.fetch("noise", folder=tmp_path / "cache")
    assert path == tmp_path / "cache" / "noise_40x30x80_uint16.raw"
    assert path.read_bytes() == CONTENT
    assert "100%" in capsys.readouterr().err
    volume = jv.datasets.load("noise", folder=tmp_path / "cache")
    np.testing.assert_array_equal(volume.data, DATA)
    np.testing.assert_array_equal(volume.spacing, (1, 2, 3))
    assert server.requests == [f"/noise/{NOISE.file}"]
    assert list(path.parent.iterdir()) == [path]
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))  # by default, the user's
    path = jv.datasets.fetch("noise", progress=False)
    assert path == tmp_path / "jaxvol" / "datasets" / NOISE.file
    assert capsys.readouterr().err == ""


def fetched(folder):
    return jv.datasets.fetch("noise", folder=folder).read_bytes()


def test_a_file_of_another_content_is_refused_and_not_kept(server, tmp_path):
    there = f"/noise/{NOISE.file}"
    server.files[there] = bytes(len(CONTENT))
    with pytest.raises(ValueError, match="another SHA-512 than noise"):
        fetched(tmp_path)
    server.files[there], server.sends = CONTENT, 150_000
    with pytest.raises(OSError, match=r"cannot be fetched: .*150000 bytes read, 42000 more expected"):
        fetched(tmp_path)
    assert not list(tmp_path.iterdir())
    server.sends = None
    assert fetched(tmp_path) == CONTENT
    (tmp_path / NOISE.file).write_bytes(CONTENT[:-2])
    with pytest.raises(ValueError, match="cut short: it holds 191998"):
        fetched(tmp_path)


def test_what_is_missing_is_told_with_what_to_do(server, tmp_path, monkeypatch):
    server.files.clear()
    with pytest.raises(OSError, match=r"cannot be fetched: 404 .*Not Found.*into a folder.*JAXVOL_DATA"):
        fetched(tmp_path)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))  # nobody listens
        monkeypatch.setattr(datasets, "OPEN_SCIVIS", f"http://127.0.0.1:{free.getsockname()[1]}")
        with pytest.raises(OSError, match=r"cannot be fetched: .*Connection refused.*noise_40.*\(0\.2 MB\)"):
            fetched(tmp_path)
    monkeypatch.setitem(sys.modules, "pooch", None)
    with pytest.raises(ImportError, match=r"pip install 'jaxvol\[datasets\]'"):
        fetched(tmp_path)


@pytest.mark.parametrize("packed", [False, True])
def test_files_in_the_data_folder_come_first(tmp_path, monkeypatch, packed):
    monkeypatch.setenv("JAXVOL_DATA", str(tmp_path))
    path = tmp_path / (NOISE.file + ".gz" * packed)
    path.write_bytes(gzip.compress(CONTENT) if packed else CONTENT)
    monkeypatch.setitem(sys.modules, "pooch", None)  # not needed
    assert jv.datasets.fetch("noise") == path
    volume = jv.datasets.load("noise")
    np.testing.assert_array_equal(volume.data, DATA)
    np.testing.assert_array_equal(volume.spacing, (1, 2, 3))
    path.write_bytes(gzip.compress(CONTENT[:-2]) if packed else CONTENT[:-2])
    with pytest.raises(ValueError, match="cut short: it holds 191998"):
        jv.datasets.load("noise")


@pytest.mark.parametrize("name", ["engine", "nucleon"])
def test_real_files_are_those_of_the_list(name, real_volume, monkeypatch):
    monkeypatch.setenv("JAXVOL_DATA", FOLDER)
    dataset = jv.datasets.info(name)
    packed = not os.path.exists(os.path.join(FOLDER, dataset.file))
    path = real_volume(dataset.file + ".gz" * packed)
    assert jv.datasets.fetch(name) == path
    content = gzip.decompress(path.read_bytes()) if packed else path.read_bytes()
    assert hashlib.sha512(content).hexdigest() == dataset.sha512
    assert jv.datasets.load(name).shape == dataset.shape


def test_the_command_lists_and_fetches(tmp_path, monkeypatch, capsys):
    assert main(["datasets", "list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 56
    assert [line for line in lines if re.search(r"^engine +256 x 256 x 128 uint8 +8.39 MB  Engine$", line)]
    monkeypatch.setenv("JAXVOL_DATA", str(tmp_path))
    (tmp_path / NOISE.file).write_bytes(CONTENT)
    assert main(["datasets", "fetch", "Noise"]) == 0
    printed = capsys.readouterr()
    assert printed.out == f"{tmp_path / NOISE.file}\n"  # alone, so that a shell can pass it on
    assert "Acknowledgement" in printed.err
    assert main(["datasets", "fetch", "nois"]) == 2
    assert "error: name must be one of 3d_neurons" in capsys.readouterr().err
