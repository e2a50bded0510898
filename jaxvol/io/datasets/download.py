"""How does a file come over HTTP, whole or in parts, with its progress shown?"""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .catalogue import Dataset


TIMEOUT = 30
"""Seconds without an answer, or without a byte, after which a server counts as gone."""

CHUNK = 2**16
"""Bytes that are written at a time. Of an interrupted download, less than this is lost."""

PART = ".part"
"""What is appended to the name of a file of which only the beginning has come."""


def downloader(dataset: Dataset, target: Path, progress: bool) -> Callable[[str, str, Any], None]:
    """A downloader for pooch that goes on where an interrupted download ended.

    What has come so far stays beside `target`. Pooch compares the hash of the whole file, and removes it if
    it differs, so that the next attempt begins anew.
    """

    def download(url: str, output: str, pooch: Any) -> None:
        part = target.with_name(target.name + PART)
        begin = part.stat().st_size if part.exists() else 0
        if begin < dataset.nbytes:
            _check_space(dataset, target.parent, begin)
            begin = _get(url, part, begin, dataset, progress)
        if begin > dataset.nbytes:
            part.unlink()
            raise ValueError(f"{url} holds more than the {dataset.nbytes} bytes of {dataset.name}.")
        os.replace(part, output)

    return download


def _get(url: str, part: Path, begin: int, dataset: Dataset, progress: bool) -> int:
    """Append the rest of a file; the number of bytes that are then there: at most one more than expected."""
    import requests
    from tqdm import tqdm

    headers = {"Range": f"bytes={begin}-"} if begin else {}
    # as it is: bytes that are compressed for the way could not be continued
    headers["Accept-Encoding"] = "identity"
    with requests.get(url, headers=headers, stream=True, timeout=TIMEOUT) as response:
        if response.status_code == requests.codes.requested_range_not_satisfiable:
            part.unlink()
        response.raise_for_status()
        goes_on = response.status_code == requests.codes.partial_content
        if not goes_on or not response.headers.get("Content-Range", "").startswith(f"bytes {begin}-"):
            if goes_on:
                raise requests.ConnectionError(f"asked for bytes from {begin} on, got others")
            begin = 0
        bar = tqdm(
            initial=begin,
            total=dataset.nbytes,
            unit="B",
            unit_scale=True,
            desc=dataset.name,
            disable=not progress,
        )
        with part.open("ab" if begin else "wb") as stream, bar:
            for chunk in response.iter_content(CHUNK):
                chunk = chunk[: dataset.nbytes + 1 - begin]
                stream.write(chunk)
                begin += len(chunk)
                bar.update(len(chunk))
                if begin > dataset.nbytes:
                    break
    if begin < dataset.nbytes:
        raise requests.ConnectionError(f"the connection ended after {begin} of {dataset.nbytes} bytes")
    return begin


def _check_space(dataset: Dataset, folder: Path, there: int) -> None:
    free, needed = shutil.disk_usage(folder).free, dataset.nbytes - there
    if free < needed:
        raise OSError(
            f"{dataset.name} needs {needed / 1e9:.1f} GB on the disk of {folder}, which has "
            f"{free / 1e9:.1f} GB left."
        )
