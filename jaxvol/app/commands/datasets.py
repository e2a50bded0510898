"""`jaxvol datasets`: lists public volumes, and fetches them."""

import argparse
import sys
from typing import Any

from ...io import datasets


def add_datasets(commands: Any, shared: argparse.ArgumentParser) -> None:
    """Add the subcommand. `commands`: what `add_subparsers` returned."""
    parser = commands.add_parser(
        "datasets",
        help="list or fetch the public Open SciVis volumes",
        description="The Open SciVis Datasets. Files in the folder $JAXVOL_DATA are taken from there.",
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    listing = actions.add_parser("list", parents=[shared], help="print name, shape, type and size of each")
    listing.set_defaults(run=_list)
    fetching = actions.add_parser(
        "fetch", parents=[shared], help="print the path of one; download it first, and check it, if need be"
    )
    fetching.add_argument("name", metavar="NAME", help="as listed")
    fetching.add_argument("--folder", help="where to keep it (default: a cache of the user's)")
    fetching.add_argument(
        "--mirror", metavar="URL", help="a server that has the files in place of klacansky.com"
    )
    fetching.set_defaults(run=_fetch)


def _list(options: argparse.Namespace) -> None:
    for dataset in map(datasets.info, datasets.names()):
        shape = " x ".join(map(str, dataset.shape))
        print(f"{dataset.name:34} {shape:>20} {dataset.dtype:8} {_bytes(dataset.nbytes):>9}  {dataset.title}")


def _fetch(options: argparse.Namespace) -> None:
    where = {"folder": options.folder, "mirror": options.mirror}
    path = datasets.fetch(options.name, **where, progress=sys.stderr.isatty())
    print(path)  # alone on stdout, for "$(jaxvol datasets fetch engine)"
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
