"""Does `jaxvol info` tell what a file holds?"""

import re

import numpy as np
import pytest

from jaxvol.app.cli import main


def test_info_tells_shape_place_and_values(tmp_path, capsys):
    data = np.arange(60, dtype=np.int16).reshape(5, 4, 3) - 20
    data[0] = -20
    np.savez(tmp_path / "a.npz", data=data, spacing=(1, 2, 3.5), origin=(-7, 8, 9), labels=data % 7)
    assert main(["info", str(tmp_path / "a.npz")]) == 0
    told = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert told["shape"].startswith("5 x 4 x 3 voxels")
    assert told["type"] == "int16, 0.00012 MB of memory"
    assert told["spacing"] == "1 2 3.5"
    assert told["origin"] == "-7 8 9"
    assert told["bounds"] == "x -7 to -3, y 8 to 14, z 9 to 16"
    assert told["values"] == f"-20 to 39, mean {data.mean():.6g}"
    assert f"50 %: {np.median(data):g}," in told["percentiles"]
    assert told["lowest"].startswith("20.0%")
    bars = told["histogram"].split("|")[1]
    assert len(bars) == 64
    assert bars[0] == "█"  # most voxels have the least value
    assert " " in bars  # 48 values in 64 bins
    assert told["labels"] == "7, from 0 to 6"


def test_info_takes_the_header_of_a_raw_file(tmp_path, capsys):
    (tmp_path / "a.raw").write_bytes(bytes(range(24)))
    assert main(["info", str(tmp_path / "a.raw")]) == 2
    assert "jaxvol info: error: the shape and dtype" in capsys.readouterr().err
    header = ["--shape", "4", "3", "2", "--dtype", "uint8", "--spacing", "1", "1", "2"]
    assert main(["info", str(tmp_path / "a.raw"), *header]) == 0
    told = capsys.readouterr().out
    assert "4 x 3 x 2 voxels" in told
    assert "assumed" not in told
    assert main(["info", str(tmp_path / "a.raw"), *header[:-4]]) == 0
    assert re.search(r"spacing +1 1 1 \(assumed: the file does not say\)", capsys.readouterr().out)
    (tmp_path / "a.raw.json").write_text('{"spacing": [1, 1, 1]}')
    assert main(["info", str(tmp_path / "a.raw"), *header[:-4]]) == 0
    assert "assumed" not in capsys.readouterr().out


def test_info_says_what_is_assumed_of_other_files(tmp_path, capsys):
    tifffile = pytest.importorskip("tifffile", reason="tifffile is not installed: pip install jaxvol[io]")
    data = np.arange(210, dtype=np.uint8).reshape(6, 5, 7)
    np.savez(tmp_path / "bare.npz", data=data)
    np.savez(tmp_path / "told.npz", data=data, spacing=(1, 1, 1))
    tifffile.imwrite(tmp_path / "bare.tif", data, photometric="minisblack")
    tifffile.imwrite(tmp_path / "told.tif", data, imagej=True, resolution=(1, 1), metadata={"spacing": 1.0})
    (tmp_path / "bare").mkdir()
    for z in range(7):
        tifffile.imwrite(tmp_path / "bare" / f"{z}.tif", data[:, :, z])
    for name in ("bare.npz", "told.npz", "bare.tif", "told.tif", "bare"):
        assert main(["info", str(tmp_path / name)]) == 0
        assert ("assumed" in capsys.readouterr().out) == name.startswith("bare")


def test_info_says_what_to_do_about_nan_and_several_images(tmp_path, capsys):
    data = np.full((4, 4, 4, 2), -5, np.float32)
    data[0] = np.nan
    np.save(tmp_path / "a.npy", data)
    assert main(["info", str(tmp_path / "a.npy"), "--channel", "1"]) == 2
    assert "got 16 of 64 voxels that are NaN or infinite" in capsys.readouterr().err
    assert main(["info", str(tmp_path / "a.npy"), "--channel", "1", "--nan", "-7"]) == 0
    assert "-7 to -5, mean -5.5" in capsys.readouterr().out
    assert main(["info", str(tmp_path / "a.npy"), "--time", "0"]) == 2
    assert "time: " in capsys.readouterr().err
