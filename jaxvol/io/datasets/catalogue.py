"""Which public datasets are there, and what is known of each?

The list is that of the Open SciVis Datasets (klacansky.com/open-scivis-datasets), of the commit that
`open_scivis.json` names.
"""

import difflib
import json
import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.checks import described


OPEN_SCIVIS = "http://klacansky.com/open-scivis-datasets"


@dataclass(frozen=True)
class Dataset:
    """What is known of a dataset without fetching it.

    - `name`: what `fetch` and `load` call it. `title`: as published.
    - `shape`, `dtype`: number of voxels along x, y, z, and their type, little-endian.
    - `spacing`: between neighbouring voxels, in the units of its authors.
    - `sha512`: of the raw file, in hexadecimal digits.
    - `acknowledgement`: to cite where the data are shown.
    """

    name: str
    title: str
    category: str
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
def catalogue() -> dict[str, Dataset]:
    """All datasets, by name."""
    fields = json.loads(Path(__file__).with_name("open_scivis.json").read_text(encoding="utf-8"))["datasets"]
    return {
        name: Dataset(
            name,
            each["name"],
            each["category"],
            tuple(each["size"]),
            each["type"],
            tuple(each["spacing"]),
            each["sha512sum"],
            each["description"],
            each["acknowledgement"],
        )
        for name, each in fields.items()
    }


def names() -> list[str]:
    """Names of all datasets.

    **Returns:** the names, sorted."""
    return sorted(catalogue())


def info(name: str | Any) -> Dataset:
    """What is known of a dataset; nothing is fetched.

    **Arguments:** `name`: one of `names()`, or the title that it was published under; case is ignored.

    **Returns:** its entry in the published list.

    **Raises:** `ValueError` for a name that is not in the list.
    """
    wanted = name.strip().lower() if isinstance(name, str) else None
    for dataset in catalogue().values():
        if wanted in (dataset.name, dataset.title.lower()):
            return dataset
    near = difflib.get_close_matches(str(name), names(), 1)
    meant = f" Did you mean {near[0]}?" if near else ""
    raise ValueError(f"name must be one of {', '.join(names())}; got {described(name)}.{meant}")
