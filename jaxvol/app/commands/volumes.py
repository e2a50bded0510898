"""`jaxvol datasets`, `info`, `view`: fetch, describe or show volumes. Slow imports are inside functions."""

import argparse
import sys
import threading
import webbrowser
from typing import Any

import numpy as np

from ..settings import header_of
from .options import SWITCH, Parser, add_others, add_transfer, add_volume


def run_datasets(options: argparse.Namespace) -> None:
    from ...io import datasets

    if options.action == "list":
        for dataset in map(datasets.info, datasets.names()):
            shape, size = " x ".join(map(str, dataset.shape)), f"{dataset.nbytes / 1e6:.3g} MB"
            print(f"{dataset.name:34} {shape:>20} {dataset.dtype:8} {size:>12}  {dataset.title}")
        return
    if options.name is None:
        raise ValueError("fetch needs a NAME: jaxvol datasets list prints them.")
    path = datasets.fetch(options.name, progress=sys.stderr.isatty())
    print(path)  # nothing else on stdout, for "$(jaxvol datasets fetch engine)"
    dataset = datasets.info(options.name)
    print(f"{dataset.description} Acknowledgement: {dataset.acknowledgement}", file=sys.stderr)
    if dataset.spacing != (1, 1, 1):
        print(f"jaxvol render {path} --spacing {_numbers(dataset.spacing)}", file=sys.stderr)


def add_datasets(parser: Parser) -> None:
    parser.add_argument("action", choices=("list", "fetch"), help="what to do")
    parser.add_argument("name", nargs="?", help="of the volume to fetch, as listed")


def run_info(options: argparse.Namespace) -> None:
    from ..._util.image_record import volume_arguments
    from ...io.formats import labelled, read_record
    from ...scene.volume import Volume

    header = header_of(options)
    choice = {name: header.pop(name) for name in ("nan", "channel")} | {"time": header["time"]}
    record = read_record(options.file, **header)
    arguments = volume_arguments(record, **choice)
    if options.spacing is not None:
        arguments["spacing"] = options.spacing
    volume = Volume(**arguments)
    if options.labels is not None:
        volume = labelled(volume, options.labels)
    data = np.asarray(volume.data)
    assumed = "spacing" not in arguments
    # every k-th voxel of a large volume: sorting all takes seconds and memory
    sample, shares = data.ravel()[:: max(1, data.size // 4_000_000)].astype(np.float32), (1, 25, 50, 75, 99)
    percentiles = zip(shares, np.percentile(sample, shares), strict=True)
    counts, bars = np.log1p(np.histogram(data, 64)[0]), " ▁▂▃▄▅▆▇█"
    heights = np.ceil(counts / counts.max() * (len(bars) - 1)).astype(int)
    low, high = f"{float(data.min()):g}", f"{float(data.max()):g}"
    turn = np.eye(3) if volume.direction is None else np.asarray(volume.direction)
    reach = turn * ((np.array(volume.shape) - 1) * np.asarray(volume.spacing))
    ends = [np.asarray(volume.origin) + end(reach, 0).sum(axis=1) for end in (np.minimum, np.maximum)]
    bounds = zip("xyz", np.transpose(ends), strict=True)
    axes = (f"{name} along ({_numbers(column, ', ')})" for name, column in zip("xyz", turn.T, strict=True))
    rows = record.rows() | {
        "shape": f"{_numbers(volume.shape, ' x ')} voxels (x, y, z), {data.size / 1e6:.3g} million",
        "type": f"{data.dtype}, {data.nbytes / 1e6:.3g} MB of memory",
        "spacing": _numbers(volume.spacing) + (" (assumed: the file does not say)" if assumed else ""),
        "origin": _numbers(volume.origin),
        "direction": "; ".join(axes),
        "bounds": ", ".join(f"{name} {_numbers(ends, ' to ')}" for name, ends in bounds),
        "values": f"{low} to {high}, mean {data.mean(dtype=np.float64):.6g}",
        "percentiles": ", ".join(f"{share} %: {value:g}" for share, value in percentiles),
        "lowest": f"{np.mean(data == data.min()):.1%} of the voxels have the least value",
        "histogram": f"{low} |{''.join(bars[height] for height in heights)}| {high}, heights by logarithm",
    }
    if volume.labels is not None:
        labels = np.unique(np.asarray(volume.labels))
        rows["labels"] = f"{labels.size}, from {labels[0]} to {labels[-1]}"
    if ids := volume.label_ids:
        rows["ids"] = f"{len(ids)}, from {ids[0]} to {ids[-1]}; voxels hold their numbers"
    for name, text in rows.items():
        print(f"{name:12} {text}")


def _numbers(values: Any, between: str = " ") -> str:
    return between.join(f"{value + 0:.6g}" for value in np.asarray(values))  # 0 in place of -0


def add_info(parser: Parser) -> None:
    add_volume(parser)


def run_view(options: argparse.Namespace) -> None:
    from ..picture import is_automatic, look_of, other_of, volume_of
    from ..viewer import serve

    pairs = tuple(map(other_of, options.others or ()))
    look = (volume_of(options), None) if is_automatic(options) else look_of(options)
    page = serve(*look, lit=options.shade, title=options.file.name, others=pairs, port=options.port)
    print(f"{options.file}: {page.url} (Ctrl-C ends it)", flush=True)
    if options.browser:
        webbrowser.open(page.url)
    threading.Event().wait()


def add_view(parser: Parser) -> None:
    add_volume(parser)
    add_transfer(parser)
    add_others(parser)
    parser.add_argument("--shade", action=SWITCH, default=True, help="with light at first")
    text = "of the page (default: 8080, or the next free)"
    parser.add_argument("--port", type=int, default=8080, help=text)
    parser.add_argument("--browser", action=SWITCH, default=True, help="open it")
