"""Every test runs with shapes and types checked, and with JAX's silent conversions forbidden."""

import os
import shutil
import tempfile
from pathlib import Path

import hypothesis
import jax
import pytest
from jaxtyping import install_import_hook

from . import typechecker  # noqa: F401  (the hook looks it up by name)


with install_import_hook("jaxvol", "tests.typechecker.check"):
    import jaxvol  # noqa: F401  (every module that it brings is checked from here on)

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Properties take the same examples in each run, so that none fails by chance.
hypothesis.settings.register_profile("jaxvol", derandomize=True)
hypothesis.settings.load_profile("jaxvol")

PROGRAMS = pytest.StashKey[str]()
"""The folder in which all processes of this session keep what they compile."""


def pytest_configure(config):
    """Compile each program once a session, whichever worker, kernel or subprocess asks for it first.

    The folder is new every time and removed at the end, so that nothing old is tested."""
    if hasattr(config, "workerinput"):
        return  # a worker of pytest-xdist: the environment tells it
    if config.option.markexpr == "not slow":
        # The fast tests spend most of their time compiling. LLVM at its first level, without expensive
        # passes, and XLA's older way to emit fused kernels halve that, for programs that are somewhat slower
        # and compute the same numbers. The slow tests, and those that are chosen in another way, compile
        # as users do.
        less = (
            "--xla_backend_optimization_level=1 --xla_llvm_disable_expensive_passes=true "
            "--xla_cpu_use_fusion_emitters=false"
        )
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {less}"
    folder = config.stash[PROGRAMS] = tempfile.mkdtemp(prefix="jaxvol-programs-")
    settings = {
        "jax_compilation_cache_dir": folder,
        "jax_persistent_cache_min_compile_time_secs": 0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }
    for name, value in settings.items():
        os.environ[name.upper()] = str(value)
        jax.config.update(name, value)


def pytest_unconfigure(config):
    if PROGRAMS in config.stash:
        shutil.rmtree(config.stash[PROGRAMS], ignore_errors=True)


@pytest.fixture(autouse=True)
def room_for_programs():
    """Forget programs before a worker holds 3 GB of them, and long before their memory maps are as many as
    Linux gives a process (65 530), past which XLA crashes. What is asked for again lies in the folder."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > 15_000:
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
