"""Are real volumes loaded with the right shape, place and values, and shown by the command line alone?

They are those of the folder JAXVOL_DATA; its `manifest.json` says what they hold.
"""

import itertools
import json
import os
from pathlib import Path

import numpy as np
import pytest

from jaxvol.app.cli import main


def entries():
    path = Path(os.environ.get("JAXVOL_DATA", "")) / "manifest.json"
    return json.loads(path.read_text())["volumes"] if path.is_file() else []


ENTRIES = {entry["name"]: entry for entry in entries()}
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not ENTRIES, reason="JAXVOL_DATA, the folder of real volumes, has no manifest.json"),
]
NAMES = list(ENTRIES) or ["none"]
SHOWN = ["engine", "seg3d_mr_head", "lidc0314_airway", "vmtk_aorta"]
"""Those of which a picture is made: scans of each kind, signed and scaled."""


def words_of(entry):
    """The file, and the spacing of those that do not hold it themselves."""
    name = entry["file"].replace(".zraw", ".mhd")
    raw = name.endswith((".raw", ".raw.gz")) and entry["spacing_xyz"] is not None
    spacing = ["--spacing", *map(str, entry["spacing_xyz"])] if raw else []
    return [str(Path(os.environ["JAXVOL_DATA"]) / name), *spacing]


def bounds_by_itk(path):
    """Bounds of the nodes in the world (LPS), by SimpleITK alone."""
    import SimpleITK as sitk

    image = sitk.ReadImage(path)
    ends = [(0, n - 1) for n in image.GetSize()]
    corners = [image.TransformIndexToPhysicalPoint(index) for index in itertools.product(*ends)]
    return np.stack([np.min(corners, axis=0), np.max(corners, axis=0)], axis=1)


@pytest.mark.parametrize("name", NAMES)
def test_info_tells_what_the_manifest_says(name, capsys):
    entry = ENTRIES[name]
    words = words_of(entry)
    assert main(["info", *words]) == 0
    told = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert told["shape"].startswith(f"{' x '.join(map(str, entry['dims_xyz']))} voxels (x, y, z)")
    numbers, assumed, _ = told["spacing"].partition(" (assumed")
    assert bool(assumed) == (entry["spacing_xyz"] is None)
    spacing = np.array(numbers.split(), float)
    np.testing.assert_allclose(spacing, entry["spacing_xyz"] or (1, 1, 1), rtol=1e-4)
    slope, shift = entry.get("scl_slope_inter", (1, 0))
    low, high = (slope * entry[end] + shift for end in ("min", "max"))
    values, mean = told["values"].split(", mean ")
    np.testing.assert_allclose(np.array(values.split(" to "), float), (low, high), rtol=1e-5)
    assert float(mean) == pytest.approx(slope * entry["mean"] + shift, rel=1e-4, abs=1e-4)
    if (kind := entry["dtype"]) != "float32" and slope == 1:
        assert told["type"].startswith(f"{kind}, ")
    bounds = np.array([part.split()[1::2] for part in told["bounds"].split(", ")], float)
    if ".raw" in words[0]:
        expected = [(0, (n - 1) * s) for n, s in zip(entry["dims_xyz"], spacing, strict=True)]
    else:
        expected = bounds_by_itk(words[0])
    np.testing.assert_allclose(bounds, expected, rtol=1e-4, atol=1e-2)
    axes = told["direction"] == "along the axes of the world"
    assert axes or "x along" in told["direction"]


def picture(name, tmp_path):
    """Of the file alone. A step given saves the time of planning."""
    step = str(float(np.min(ENTRIES[name]["spacing_xyz"] or 1)))
    words = [*words_of(ENTRIES[name]), "--size", "128", "128", "--step", step, "--transparent"]
    assert main(["render", *words, "-o", str(tmp_path / "x.npy")]) == 0
    return np.load(tmp_path / "x.npy")


@pytest.mark.parametrize("name", SHOWN)
def test_a_picture_of_the_file_alone_shows_the_object(name, tmp_path):
    """Neither fog nor a block nor next to nothing: some pixels are opaque, some see past the object, the rest
    is shaded."""
    rgba = picture(name, tmp_path)
    opacity = rgba[..., 3]
    assert 0.1 < (opacity > 0.05).mean() < 0.95  # the object fills the picture, and not all of it
    assert (opacity > 0.8).mean() > 0.02  # something is solid
    assert (opacity[[0, 0, -1, -1], [0, -1, 0, -1]] < 0.3).all()  # corners show the background
    brightness = rgba[opacity > 0.8][:, :3].mean(axis=1)
    assert np.percentile(brightness, 99) < 0.98  # not blown out
    assert 0.1 < np.median(brightness) < 0.8
    assert brightness.std() > 0.05  # shaded


def test_a_label_volume_has_a_colour_for_each_label(tmp_path):
    rgba = picture("frogtissue_labels", tmp_path).reshape(-1, 4)
    colors = rgba[rgba[:, 3] > 0.8][:, :3]
    coloured = colors[np.ptp(colors, axis=1) > 0.1]
    hues = {tuple((each > each.mean()).tolist()) for each in coloured}
    assert len(hues) >= 4
