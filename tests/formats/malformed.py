"""Reads files in a process of its own, for `test_malformed.py`: a reader may crash, hang or take memory.

`python -m tests.formats.malformed` reads a line of JSON for each file, and answers with one. It has little
more memory than it needs for honest files.
"""

import json
import resource
import sys
import time
import tracemalloc
from pathlib import Path

import numpy as np

import jaxvol as jv
from jaxvol import bricks


ROOM = 2**28
"""Bytes of address space beyond those of the imported libraries."""


def read(how, path):
    """The number of voxels that a file holds, which are all read."""
    if how == "ultrasound":
        return jv.load_ultrasound(path)[0].data.size
    if how == "bricks":
        total = 0
        for source in bricks.levels_of(path):
            high = tuple(min(n, 16) for n in source.shape)
            total += np.asarray(source.read((0, 0, 0), high)).size
        return total
    return jv.load(path).data.size


def answer(how, path):
    """What came of a file: its voxels, or the kind of error and its message; time and memory that it took."""
    tracemalloc.reset_peak()
    before, begin = tracemalloc.get_traced_memory()[0], time.process_time()
    try:
        outcome = {"voxels": int(read(how, path))}
    except BaseException as fault:
        kinds = [kind.__name__ for kind in type(fault).__mro__]
        outcome = {"kinds": kinds, "message": str(fault)[:2000]}
    took, peak = time.process_time() - begin, tracemalloc.get_traced_memory()[1] - before
    return outcome | {"seconds": took, "bytes": peak}


def main():
    import SimpleITK  # noqa: F401
    import tensorstore  # noqa: F401
    import tifffile  # noqa: F401

    jv.Volume([[[0, 1], [0, 1]], [[0, 1], [0, 1]]])  # starts JAX
    for line in sys.stdin:
        how, path = json.loads(line)
        if how == "limit":
            used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, used + ROOM))
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            tracemalloc.start()
            reply = {"limit": used + ROOM}
        else:
            reply = answer(how, path)
        print(json.dumps(reply), flush=True)


if __name__ == "__main__":
    main()
