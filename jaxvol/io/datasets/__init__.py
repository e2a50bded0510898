"""Public volumes by name: the Open SciVis Datasets, downloaded once by pooch, checked, and cached.

`volume = jv.datasets.load("engine")`. Files in the folder `$JAXVOL_DATA` are used in place. The list is that
of klacansky.com/open-scivis-datasets, of the commit that `open_scivis.json` names.
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
    """What is known of a dataset without fetching it.

    Attributes:
        name: what `fetch` and `load` call it.
        title: as published.
        shape: number of voxels along x, y, z.
        dtype: their type, little-endian.
        spacing: between neighbouring voxels, in the units of its authors.
        sha512: of the raw file, in hexadecimal digits.
        acknowledgement: to cite where the data are shown.
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
        """Where it is published."""
        return f"{OPEN_SCIVIS}/{self.name}/{self.file}"

    @property
    def nbytes(self) -> int:
        """Size of the raw file."""
        return math.prod(self.shape) * np.dtype(self.dtype).itemsize


@cache
def registry() -> dict[str, Dataset]:
    """All datasets, by name."""
    fields = json.loads(Path(__file__).with_name("open_scivis.json").read_text(encoding="utf-8"))["datasets"]
    keys = ("name", "size", "type", "spacing", "sha512sum", "description", "acknowledgement")
    return {
        name: Dataset(name, *cast(Any, [tuple(v) if isinstance(v := each[k], list) else v for k in keys]))
        for name, each in fields.items()
    }


def names() -> list[str]:
    """Names of all datasets.

    Returns:
        The names, sorted.
    """
    return sorted(registry())


def info(name: str | Any) -> Dataset:
    """What is known of a dataset; nothing is fetched.

    Args:
        name: one of `names()`, or the title that it was published under; case is ignored.

    Returns:
        Its entry in the published list.

    Raises:
        ValueError: for a name that is not in the list.
    """
    wanted = name.strip().lower() if isinstance(name, str) else None
    for dataset in registry().values():
        if wanted in (dataset.name, dataset.title.lower()):
            return dataset
    hint = near(name, registry()) if isinstance(name, str) else ""
    raise ValueError(f"name must be one of {', '.join(names())}; got {described(name)}.{hint}")


def fetch(name: str | Any, *, folder: str | os.PathLike[str] | None = None, progress: bool = True) -> Path:
    """The path of a dataset's raw file, which is fetched if it is not on this machine yet.

    It is looked for in the folder that the environment variable `JAXVOL_DATA` names, as `.raw` or as
    `.raw.gz`, then in the cache. If it is in neither, it is downloaded (`pip install "jaxvol[datasets]"`),
    and kept if its SHA-512 is the published one.

    Args:
        name: one of `names()`; case is ignored. `info(name).nbytes` tells how much will be fetched.
        folder: the cache; by default `jaxvol/datasets` in the user's (`$XDG_CACHE_HOME`).
        progress: show a progress bar of what is downloaded.

    Returns:
        The path of a file that `jv.load` reads, and, if it ends in `.raw`, `jv.render_bricks`. Of one that
        was there before, only the size is checked.

    Raises:
        ValueError: for a name that is not in the list, a file of another size, or a download with another
            SHA-512.
        OSError: where the server cannot be reached, has no such file, or does not send all of it.
        ImportError: if a download needs pooch, and it is missing.
    """
    dataset = info(name)
    own = os.environ.get("JAXVOL_DATA")
    for path in (Path(own, dataset.file), Path(own, f"{dataset.file}.gz")) if own else ():
        if path.is_file():
            return _of_right_size(path, dataset)
    try:
        import pooch
    except ImportError as fault:
        raise ImportError(f"fetching {dataset.name} needs pooch: pip install 'jaxvol[datasets]'") from fault
    target = (Path(pooch.os_cache("jaxvol")) / "datasets" if folder is None else Path(folder)) / dataset.file
    if target.is_file():  # pooch would hash it each time, which takes minutes for many GB
        return _of_right_size(target, dataset)
    pooch.get_logger().setLevel("WARNING")
    get: Any = pooch.HTTPDownloader(progressbar=progress, timeout=30)
    try:
        pooch.retrieve(dataset.url, f"sha512:{dataset.sha512}", target.name, target.parent, downloader=get)
    except OSError as fault:  # those of requests are among them
        raise OSError(
            f"{dataset.url} cannot be fetched: {fault}. Without a connection: put {dataset.file} "
            f"({dataset.nbytes / 1e6:.1f} MB) or {dataset.file}.gz into a folder, and set the environment "
            "variable JAXVOL_DATA to that."
        ) from fault
    except ValueError as fault:
        raise ValueError(
            f"{dataset.url} has another SHA-512 than {dataset.name} is published with. It was not kept."
        ) from fault
    return target


def _of_right_size(path: Path, dataset: Dataset) -> Path:
    """A dataset's file, after checking its size; of a packed one, `load` checks it."""
    if path.suffix != ".gz":
        with refusing(path):
            check_size(path.stat().st_size, dataset.nbytes)
    return path


def load(name: str | Any, *, folder: str | os.PathLike[str] | None = None, progress: bool = True) -> Volume:
    """A dataset as a `Volume`; it is fetched first, if it is not on this machine yet.

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
