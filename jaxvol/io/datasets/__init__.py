"""Public volumes by name: the Open SciVis Datasets, downloaded once by pooch, checked, and cached.

`volume = jv.datasets.load("engine")`. Files in the folder `$JAXVOL_DATA` are used in place. The list is from
klacansky.com/open-scivis-datasets, at the commit that `open_scivis.json` names.
"""

import json
import math
import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np

from ..._util.checks import described
from ..._util.files import MOST_VOXELS, check_size, refusing
from ..._util.texts import near
from ...scene.volume import Volume
from ..formats import load as load_file


OPEN_SCIVIS = "http://klacansky.com/open-scivis-datasets"


@dataclass(frozen=True)
class Dataset:
    """Metadata of a dataset.

    Attributes:
        name: name for `fetch` and `load`.
        title: as published.
        shape: number of voxels along x, y, z.
        dtype: type of the voxels, little-endian.
        spacing: of the voxels, in the units of the authors.
        sha512: of the raw file, in hexadecimal digits.
        acknowledgement: to cite wherever the data are shown.
    """

    name: str
    title: str
    shape: tuple[int, int, int]
    dtype: str
    spacing: tuple[float, float, float]
    sha512: str
    description: str
    acknowledgement: str

    @property
    def file(self) -> str:
        """Name of the raw file, x fastest."""
        return f"{self.name}_{'x'.join(map(str, self.shape))}_{self.dtype}.raw"

    @property
    def url(self) -> str:
        """URL of the raw file."""
        return f"{OPEN_SCIVIS}/{self.name}/{self.file}"

    @property
    def nbytes(self) -> int:
        """Size of the raw file in bytes."""
        return math.prod(self.shape) * np.dtype(self.dtype).itemsize


@cache
def registry() -> dict[str, Dataset]:
    """Datasets by name."""
    entries = json.loads(Path(__file__).with_name("open_scivis.json").read_text(encoding="utf-8"))["datasets"]
    keys = ("name", "size", "type", "spacing", "sha512sum", "description", "acknowledgement")
    return {
        name: Dataset(name, *cast(Any, [tuple(v) if isinstance(v := entry[k], list) else v for k in keys]))
        for name, entry in entries.items()
    }


def names() -> list[str]:
    """Names of all datasets.

    Returns:
        The names, sorted.
    """
    return sorted(registry())


def info(name: str) -> Dataset:
    """Look up the metadata of a dataset, without fetching it.

    Args:
        name: one of `names()`, or a published title; case is ignored.

    Returns:
        The entry in the published list.

    Raises:
        ValueError: for a name that is not in the list.
    """
    wanted = name.strip().lower() if isinstance(name, str) else None
    for dataset in registry().values():
        if wanted in (dataset.name, dataset.title.lower()):
            return dataset
    hint = near(name, registry()) if isinstance(name, str) else ""
    raise ValueError(f"name must be one of {', '.join(names())}; got {described(name)}.{hint}")


def fetch(name: str, *, folder: str | os.PathLike[str] | None = None, progress: bool = True) -> Path:
    """Return the path of a dataset's raw file, after downloading it if it is not on this machine.

    The file is searched in the folder of the environment variable `JAXVOL_DATA`, as `.raw` or `.raw.gz`, then
    in the cache, and downloaded if it is in neither (`pip install "jaxvol[datasets]"`). A download is kept if
    its SHA-512 is the published one; of existing files, only the size is checked.

    Args:
        name: one of `names()`; case is ignored. `info(name).nbytes` is the size of the download.
        folder: the cache; by default `jaxvol/datasets` in the user's (`$XDG_CACHE_HOME`).
        progress: show a progress bar of the download.

    Returns:
        The path of a file that `jv.load` reads, and, if it ends in `.raw`, `jv.render_bricks`.

    Raises:
        ValueError: for a name that is not in the list, a file of another size, or a download with another
            SHA-512.
        OSError: if the server cannot be reached, has no such file, or does not send all of it.
        ImportError: if a download needs pooch, and it is missing.
    """
    dataset = info(name)
    root = os.environ.get("JAXVOL_DATA")
    for path in (Path(root, dataset.file), Path(root, f"{dataset.file}.gz")) if root else ():
        if path.is_file():
            return _of_right_size(path, dataset)
    try:
        import pooch
    except ImportError as fault:
        raise ImportError(f"fetching {dataset.name} needs pooch: pip install 'jaxvol[datasets]'") from fault
    target = (Path(pooch.os_cache("jaxvol")) / "datasets" if folder is None else Path(folder)) / dataset.file
    if target.is_file():  # pooch would hash it in every call, which takes minutes for many GB
        return _of_right_size(target, dataset)
    pooch.get_logger().setLevel("WARNING")
    get: Any = pooch.HTTPDownloader(progressbar=progress, timeout=30)
    try:
        pooch.retrieve(dataset.url, f"sha512:{dataset.sha512}", target.name, target.parent, downloader=get)
    except OSError as fault:  # includes the errors of requests
        raise OSError(
            f"{dataset.url} cannot be fetched: {fault}. Without a connection: put {dataset.file} "
            f"({dataset.nbytes / 1e6:.1f} MB) or {dataset.file}.gz into a folder, and set the environment "
            "variable JAXVOL_DATA to the folder."
        ) from fault
    except ValueError as fault:
        raise ValueError(f"{dataset.url} has another SHA-512 than {dataset.name}; it is not kept.") from fault
    return target


def _of_right_size(path: Path, dataset: Dataset) -> Path:
    """Check the size of a dataset's file, unless compressed: `load` checks that."""
    if path.suffix != ".gz":
        with refusing(path):
            check_size(path.stat().st_size, dataset.nbytes)
    return path


def load(name: str, *, folder: str | os.PathLike[str] | None = None, progress: bool = True) -> Volume:
    """Load a dataset, after downloading it if it is not on this machine.

    Args:
        name: as for `fetch`.
        folder: as for `fetch`.
        progress: as for `fetch`.

    Returns:
        The volume, with the published spacing.

    Raises:
        ValueError: as `fetch`, and for one of 2³¹ voxels or more: give the path that `fetch` returns to
            `render_bricks`.
        OSError: as `fetch`.
        ImportError: as `fetch`.
    """
    dataset = info(name)
    voxels = math.prod(dataset.shape)
    if voxels > MOST_VOXELS:
        raise ValueError(
            f"{dataset.name} has {voxels} voxels, and a Volume fewer than 2**31. Use jv.render_bricks with "
            f"the path jv.datasets.fetch({dataset.name!r}) ({dataset.nbytes / 1e9:.0f} GB)."
        )
    path = fetch(name, folder=folder, progress=progress)
    return load_file(path, shape=dataset.shape, dtype=dataset.dtype, spacing=dataset.spacing)
