"""`jaxvol datasets`: lists public volumes, and fetches them."""

import argparse
import sys

from ...io import datasets
from .options import ARGUMENT, SHARED, Command, Option


def _list() -> None:
    for dataset in map(datasets.info, datasets.names()):
        shape = " x ".join(map(str, dataset.shape))
        print(f"{dataset.name:34} {shape:>20} {dataset.dtype:8} {_bytes(dataset.nbytes):>9}  {dataset.title}")


def _fetch(options: argparse.Namespace) -> None:
    where = {"folder": options.folder, "mirror": options.mirror}
    path = datasets.fetch(options.name, **where, progress=sys.stderr.isatty())
    print(path)  # nothing else on stdout, for "$(jaxvol datasets fetch engine)"
    dataset = datasets.info(options.name)
    print(f"{dataset.description} Acknowledgement: {dataset.acknowledgement}", file=sys.stderr)
    spacing = " ".join(f"{step:g}" for step in dataset.spacing)
    if dataset.spacing != (1, 1, 1):
        print(f"jaxvol render {path} --spacing {spacing}", file=sys.stderr)


def _bytes(number: float) -> str:
    for unit in ("B", "kB", "MB", "GB"):
        if number < 1000:
            return f"{number:.3g} {unit}"
        number /= 1000
    return f"{number:.3g} TB"


def _datasets(options: argparse.Namespace) -> None:
    if options.action == "list":
        _list()
    elif options.name is None:
        raise ValueError("fetch needs a NAME: jaxvol datasets list prints them.")
    else:
        _fetch(options)


DATASETS = Command(
    "datasets",
    "list the public Open SciVis volumes; or print the path of one, and download it first if need be",
    (
        *SHARED,
        Option("action", "what to do", choices=("list", "fetch"), required=True, group=ARGUMENT),
        Option("name", "of the volume to fetch, as listed", group=ARGUMENT),
        Option("folder", "where to keep it (default: $JAXVOL_DATA, or a cache of the user's)"),
        Option("mirror", "a server that has the files in place of klacansky.com", values="URL"),
    ),
    _datasets,
)
