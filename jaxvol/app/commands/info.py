"""`jaxvol info`: what a volume file holds, and where it lies in the world."""

import argparse
from typing import Any

import numpy as np

from ...io.formats import says_its_spacing
from ...scene.volume import Volume
from .data import volume_of
from .options import DATA, Command


BARS = " ▁▂▃▄▅▆▇█"

BINS = 64

SHARES = (1, 25, 50, 75, 99)


def _info(options: argparse.Namespace) -> None:
    volume = volume_of(options)
    assumed = options.spacing is None and not says_its_spacing(options.file)
    print(described_volume(volume, assumed=assumed))


def described_volume(volume: Volume, *, assumed: bool = False) -> str:
    """Lines of text about a volume: its voxels, its place in the world, its values. `assumed`: whether its
    spacing is an assumption.

    The bars are a histogram of 64 bins from the least to the greatest value, each as high as the logarithm of
    its count.
    """
    data = np.asarray(volume.data)
    low, high = float(data.min()), float(data.max())
    shape = " x ".join(map(str, volume.shape))
    rows = [
        ("shape", f"{shape} voxels (x, y, z), {data.size / 1e6:.3g} million"),
        ("type", f"{data.dtype}, {data.nbytes / 1e6:.3g} MB of memory"),
        ("spacing", _numbers(volume.spacing) + (" (assumed: the file does not say)" if assumed else "")),
        ("origin", _numbers(volume.origin)),
        ("direction", _direction(volume)),
        (
            "bounds",
            "x {} to {}, y {} to {}, z {} to {}".format(*(f"{e:g}" for e in np.asarray(volume.bounds))),
        ),
        ("values", f"{low:g} to {high:g}, mean {data.mean(dtype=np.float64):.6g}"),
        ("percentiles", ", ".join(f"{p} %: {v:g}" for p, v in zip(SHARES, _percentiles(data), strict=True))),
        ("lowest", f"{np.mean(data == data.min()):.1%} of the voxels have the least value"),
        ("histogram", f"{low:g} |{_bars(data)}| {high:g}, heights by logarithm"),
    ]
    if volume.labels is not None:
        found = np.unique(np.asarray(volume.labels))
        rows.append(("labels", f"{found.size}, from {found[0]} to {found[-1]}"))
    return "\n".join(f"{name:12} {text}" for name, text in rows)


def _direction(volume: Volume) -> str:
    if volume.direction is None:
        return "along the axes of the world"
    columns = zip("xyz", np.asarray(volume.direction).T, strict=True)
    return "; ".join(f"{name} along ({', '.join(f'{c:.4f}' for c in column)})" for name, column in columns)


def _percentiles(data: np.ndarray) -> np.ndarray:
    # of every k-th voxel of a large volume: sorting all takes seconds and memory
    return np.percentile(data.ravel()[:: max(1, data.size // 4_000_000)].astype(np.float32), SHARES)


def _bars(data: np.ndarray) -> str:
    counts = np.log1p(np.histogram(data, BINS)[0])
    heights = np.ceil(counts / max(counts.max(), 1e-9) * (len(BARS) - 1)).astype(int)
    return "".join(BARS[height] for height in heights)


def _numbers(values: Any) -> str:
    return " ".join(f"{value:.6g}" for value in np.asarray(values))


INFO = Command(
    "info",
    "print shape, type, place in the world and values of a volume file, as jaxvol loads it",
    DATA,
    _info,
)
