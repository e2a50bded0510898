"""`jaxvol datasets`: lists public volumes, and fetches them."""

import argparse
import sys
from typing import Any

from ...io import datasets
from .options import add_command


def _datasets(options: argparse.Namespace) -> None:
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
        spacing = " ".join(f"{step:g}" for step in dataset.spacing)
        print(f"jaxvol render {path} --spacing {spacing}", file=sys.stderr)


def add_datasets(commands: Any) -> None:
    text = "list the public Open SciVis volumes; or print the path of one, downloaded if need be"
    parser = add_command(commands, "datasets", text, _datasets)
    parser.add_argument("action", choices=("list", "fetch"), help="what to do")
    parser.add_argument("name", nargs="?", help="of the volume to fetch, as listed")
