"""Is a malformed file read or refused by a message, at once, whatever is wrong with it?"""

import subprocess
import sys
from pathlib import Path

import pytest

from ...scenes import slow


@pytest.mark.parametrize("count", [120, *slow(3000)])
def test_malformed_files_are_read_or_refused_at_once(count):
    for module in ("SimpleITK", "tifffile", "zarr", "tensorstore"):
        pytest.importorskip(module)
    command = [sys.executable, "-m", "tests.io.formats.malformed", str(count)]
    run = subprocess.run(command, cwd=Path(__file__).parents[3], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout[-20:] + run.stderr[-3000:]
