"""`jaxvol info`: what a volume file holds, and where it lies in the world."""

import argparse
from typing import Any

import numpy as np

from ...io.formats import says_its_spacing
from .data import volume_of
from .options import add_command, add_volume


BARS = " ▁▂▃▄▅▆▇█"

SHARES = (1, 25, 50, 75, 99)


def _info(options: argparse.Namespace) -> None:
    volume = volume_of(options)
    data = np.asarray(volume.data)
    assumed = options.spacing is None and not says_its_spacing(options.file)
    # of every k-th voxel of a large volume: sorting all takes seconds and memory
    some = data.ravel()[:: max(1, data.size // 4_000_000)].astype(np.float32)
    percentiles = zip(SHARES, np.percentile(some, SHARES), strict=True)
    counts = np.log1p(np.histogram(data, 64)[0])
    heights = np.ceil(counts / counts.max() * (len(BARS) - 1)).astype(int)
    low, high = f"{float(data.min()):g}", f"{float(data.max()):g}"
    bounds = zip("xyz", np.asarray(volume.bounds).reshape(3, 2), strict=True)
    direction = "along the axes of the world"
    if volume.direction is not None:
        columns = zip("xyz", np.asarray(volume.direction).T, strict=True)
        direction = "; ".join(f"{name} along ({_numbers(column, ', ')})" for name, column in columns)
    rows = {
        "shape": f"{_numbers(volume.shape, ' x ')} voxels (x, y, z), {data.size / 1e6:.3g} million",
        "type": f"{data.dtype}, {data.nbytes / 1e6:.3g} MB of memory",
        "spacing": _numbers(volume.spacing) + (" (assumed: the file does not say)" if assumed else ""),
        "origin": _numbers(volume.origin),
        "direction": direction,
        "bounds": ", ".join(f"{name} {_numbers(ends, ' to ')}" for name, ends in bounds),
        "values": f"{low} to {high}, mean {data.mean(dtype=np.float64):.6g}",
        "percentiles": ", ".join(f"{share} %: {value:g}" for share, value in percentiles),
        "lowest": f"{np.mean(data == data.min()):.1%} of the voxels have the least value",
        "histogram": f"{low} |{''.join(BARS[height] for height in heights)}| {high}, heights by logarithm",
    }
    if volume.labels is not None:
        found = np.unique(np.asarray(volume.labels))
        rows["labels"] = f"{found.size}, from {found[0]} to {found[-1]}"
    for name, text in rows.items():
        print(f"{name:12} {text}")


def _numbers(values: Any, between: str = " ") -> str:
    return between.join(f"{value:.6g}" for value in np.asarray(values))


def add_info(commands: Any) -> None:
    text = "print shape, type, place in the world and values of a volume file, as jaxvol loads it"
    add_volume(add_command(commands, "info", text, _info))
