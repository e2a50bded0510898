"""Every test runs with shapes and types checked, and with JAX's silent conversions forbidden."""

import os
from pathlib import Path

import jax
import pytest
from jaxtyping import install_import_hook

from . import typechecker  # noqa: F401  (the hook looks it up by name)


with install_import_hook("jaxvol", "tests.typechecker.check"):
    import jaxvol  # noqa: F401  (every module that it brings is checked from here on)

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture(scope="module", autouse=True)
def room_for_programs():
    """Compiled programs take memory maps, of which Linux gives a process 65 530; past that XLA crashes."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > 30_000:
        jax.clear_caches()


@pytest.fixture
def real_volume():
    """Path of a real volume by file name; skips where the data are not there."""

    def path(name: str) -> Path:
        folder = os.environ.get("JAXVOL_DATA")
        if not folder:
            pytest.skip("JAXVOL_DATA is not set: it names the folder of real volumes")
        file = Path(folder) / name
        if not file.is_file():
            pytest.skip(f"{name} is not in the folder that JAXVOL_DATA names")
        return file

    return path
