"""Public volumes by name: the Open SciVis Datasets, fetched once, checked, and kept.

    jv.datasets.names()
    jv.datasets.info("engine")
    volume = jv.datasets.load("engine")

Files that lie in the folder `$JAXVOL_DATA` are taken from there.
"""

import os
from pathlib import Path
from typing import Any, NoReturn

from ..._util.files import MOST_VOXELS, check_size, gzip_size
from ...scene.volume import Volume
from ..formats import load as load_file
from .catalogue import Dataset as Dataset, info as info, names as names
from .download import PART, downloader


def fetch(
    name: str | Any,
    *,
    folder: str | os.PathLike[str] | None = None,
    mirror: str | None = None,
    progress: bool = True,
) -> Path:
    """The path of a dataset's raw file, which is fetched if it is not on this machine yet.

    It is looked for in the folder that the environment variable `JAXVOL_DATA` names, as `.raw` or as
    `.raw.gz`, then in the cache. If it is in neither, it is downloaded (`pip install jaxvol[datasets]`), and
    kept if its SHA-512 is the published one. A download that was interrupted goes on where it ended.

    **Arguments:**

    - `name`: one of `names()`; case is ignored. `info(name).nbytes` tells how much will be fetched.
    - `folder`: the cache; by default `jaxvol/io/datasets` in the user's (`$XDG_CACHE_HOME`).
    - `mirror`: address of a server that has the files in place of klacansky.com, as
      `<mirror>/engine/engine_256x256x128_uint8.raw`.
    - `progress`: show a progress bar of what is downloaded.

    **Returns:** the path of a file that `jv.load` reads, and, if it ends in `.raw`, `jv.render_bricks`. Of a
    file in `$JAXVOL_DATA`, only the size is checked, and not its content.

    **Raises:** `ValueError` for a name that is not in the list, a file of another size, or a download with
    another SHA-512; `OSError` where the server cannot be reached, has no such file, or does not send all of
    it, and for a disk that is too full; `ImportError` if a download needs pooch, and it is missing.
    """
    dataset = info(name)
    if (own := _in_data_folder(dataset)) is not None:
        return own
    try:
        import pooch
    except ImportError as fault:
        raise ImportError(f"fetching {dataset.name} needs pooch: pip install jaxvol[datasets]") from fault
    target = (Path(pooch.os_cache("jaxvol")) / "datasets" if folder is None else Path(folder)) / dataset.file
    if target.is_file():
        # by its size alone: it was compared when it came, and a file of many GB takes minutes to hash
        check_size(target, target.stat().st_size, dataset.nbytes)
        return target
    url = dataset.url if mirror is None else f"{mirror.rstrip('/')}/{dataset.name}/{dataset.file}"
    pooch.get_logger().setLevel("WARNING")
    try:
        return Path(
            pooch.retrieve(
                url,
                known_hash=f"sha512:{dataset.sha512}",
                fname=target.name,
                path=target.parent,
                downloader=downloader(dataset, target, progress),  # pyright: ignore[reportArgumentType]
            )
        )
    except ValueError as fault:
        if "hash" not in str(fault):
            raise
        raise ValueError(
            f"{url} has another SHA-512 than {dataset.name} is published with: it was changed, either there "
            "or on the way. It was not kept."
        ) from fault
    except OSError as fault:  # requests' own errors are among these
        _explain(dataset, url, target, fault)


def load(
    name: str | Any,
    *,
    folder: str | os.PathLike[str] | None = None,
    mirror: str | None = None,
    progress: bool = True,
) -> Volume:
    """A dataset as a `Volume`; it is fetched first, if it is not on this machine yet.

    **Arguments:** `name`, `folder`, `mirror`, `progress`: as for `fetch`.

    **Returns:** the volume, with the published spacing.

    **Raises:** as `fetch`, and `ValueError` for one of 2³¹ voxels or more: it is to be fetched, and its path
    given to `render_bricks`.
    """
    dataset = info(name)
    voxels = dataset.shape[0] * dataset.shape[1] * dataset.shape[2]
    if voxels > MOST_VOXELS:
        raise ValueError(
            f"{dataset.name} has {voxels} voxels, and a Volume fewer than 2**31. Use jv.render_bricks with "
            f"the path jv.datasets.fetch({dataset.name!r}) ({dataset.nbytes / 1e9:.0f} GB)."
        )
    path = fetch(name, folder=folder, mirror=mirror, progress=progress)
    return load_file(path, shape=dataset.shape, dtype=dataset.dtype, spacing=dataset.spacing)


def _in_data_folder(dataset: Dataset) -> Path | None:
    """The dataset's file in `$JAXVOL_DATA`, if it is there."""
    folder = os.environ.get("JAXVOL_DATA")
    for ending in ("", ".gz") if folder else ():
        path = Path(str(folder)) / (dataset.file + ending)
        if path.is_file():
            if ending:
                check_size(path, gzip_size(path), dataset.nbytes % 2**32)
            else:
                check_size(path, path.stat().st_size, dataset.nbytes)
            return path
    return None


def _explain(dataset: Dataset, url: str, target: Path, fault: OSError) -> NoReturn:
    import requests

    if not isinstance(fault, requests.RequestException):
        raise fault
    answer = fault.response
    if answer is not None:
        what = f"{url}: the server answered {answer.status_code} {answer.reason}."
    else:
        what = f"{url} cannot be fetched: {_innermost(fault)}."
    part = target.with_name(target.name + PART)
    came = part.stat().st_size if part.exists() else 0
    so_far = f" The {came} bytes that came are kept, and a second try goes on." if came else ""
    raise OSError(
        f"{what}{so_far} Without a connection: put {dataset.file} ({dataset.nbytes / 1e6:.1f} MB) or "
        f"{dataset.file}.gz into a folder, and set the environment variable JAXVOL_DATA to that."
    ) from fault


def _innermost(fault: BaseException) -> str:
    """What the chain of errors around a failed connection began with, in a few words."""
    while fault.__context__ is not None:
        fault = fault.__context__
    return getattr(fault, "strerror", None) or str(fault) or type(fault).__name__
