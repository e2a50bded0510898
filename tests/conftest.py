"""Configures all tests: shapes and types are checked, and JAX's implicit conversions are errors."""

import gc
import os
import platform
import shutil
import sys
import tempfile
from pathlib import Path

import hypothesis
import jax
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache
from jaxtyping import install_import_hook

from . import faults, programs, typechecker


def import_with_types_checked():
    """Imports the library so that shapes and types are checked at every call, which takes seven seconds."""
    if os.environ.get("NOHOOK"):
        return
    typechecker.adapt_decorator()
    with install_import_hook("jaxvol", "tests.typechecker.check"):
        import jaxvol

        for name in dir(jaxvol):  # each is imported when it is first used
            getattr(jaxvol, name)


jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Hypothesis draws the same examples in every run, so that no test fails by chance, and reports the first that
# fails: to look for a simpler one takes minutes where examples are images.
hypothesis.settings.register_profile(
    "jaxvol", derandomize=True, deadline=None, phases=[hypothesis.Phase.explicit, hypothesis.Phase.generate]
)
hypothesis.settings.load_profile("jaxvol")

FOLDER = pytest.StashKey[str]()
"""The compilation cache that all processes of this session share, where it is removed at the end."""


def pytest_addoption(parser):
    parser.addoption("--most-programs", type=int, help="fail if the session compiles more programs than this")
    parser.addoption("--fault", help="inject a fault of `tests.faults`")


def pytest_configure(config):
    """Compile each program once per session, for all workers, kernels and subprocesses.

    The cache folder is new in each session and removed at its end, unless JAX_COMPILATION_CACHE_DIR names one
    to keep, with which a second session takes less than half the time."""
    chosen = config.option.markexpr in ("not slow", "slow")
    gc.set_threshold(100_000)  # what is traced is no garbage, and looking through it takes time
    worker = hasattr(config, "workerinput")  # of pytest-xdist; it inherits the environment variables
    deals = not worker and getattr(config.option, "numprocesses", None)  # it runs no test itself
    if not deals and config.option.fault is None:
        import_with_types_checked()
    if not worker:
        os.environ["FLAGS_OF_USERS"] = os.environ.get("XLA_FLAGS", "")
        if chosen:
            # Tests spend most of their time compiling. Without LLVM's optimizations, and by XLA's older
            # emitter of fused kernels, it is half as long, and programs run somewhat slower. LLVM would then
            # fuse multiplications and additions in some programs and not in others, which round differently:
            # an instruction set without them rounds all alike. Notebooks, documents and the demo, and any
            # other selection of tests (`-m ""`), compile as users do.
            flags = ["--xla_backend_optimization_level=0", "--xla_llvm_disable_expensive_passes=true"]
            if platform.machine() in ("x86_64", "AMD64"):
                flags.append("--xla_cpu_max_isa=AVX")
            if jax.__version_info__ < (0, 11):  # later ones have only the newer emitter, and stop at the flag
                flags.append("--xla_cpu_use_fusion_emitters=false")
            os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *flags])
        if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
            config.stash[FOLDER] = tempfile.mkdtemp(prefix="jaxvol-programs-")
            os.environ["JAX_COMPILATION_CACHE_DIR"] = config.stash[FOLDER]
    folder = os.environ["JAX_COMPILATION_CACHE_DIR"]
    settings = {
        "jax_compilation_cache_dir": folder,
        "jax_persistent_cache_min_compile_time_secs": 0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }
    for name, value in settings.items():
        os.environ[name.upper()] = str(value)
        jax.config.update(name, value)
    if config.option.fault is not None and not deals:
        faults.all_faults()[config.option.fault].inject()
    config.pluginmanager.register(programs.Programs(Path(folder), config.option.most_programs), "programs")


def pytest_unconfigure(config):
    if FOLDER in config.stash:
        shutil.rmtree(config.stash[FOLDER], ignore_errors=True)


@pytest.fixture(autouse=True)
def limit_programs_in_memory():
    """Drop compiled programs before a worker holds 3 GB of them, and long before their memory maps reach
    Linux's limit per process (65 530), where XLA crashes. Programs needed again are in the cache folder."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > 15_000:
        jax.clear_caches()


@pytest.fixture(autouse=True)
def programs_of_this_session():
    """All programs are kept, and so counted, after tests of the command, too, which keeps only some."""
    yield
    folder = os.environ["JAX_COMPILATION_CACHE_DIR"]
    if getattr(jax.config, "jax_compilation_cache_dir", None) != folder:
        jax.config.update("jax_compilation_cache_dir", folder)
        compilation_cache.reset_cache()
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    # without lowered ones: a fault that is injected is not in their key
    sys.modules["jaxvol.xla.persistent_cache"]._CHOSEN.clear()


@pytest.fixture
def volume_file(tmp_path):
    """A raw file of a small volume, whose name tells its shape and type."""
    import jaxvol

    volume = jaxvol.phantom("engine", 24)
    path = tmp_path / "engine_24x24x24_uint8.raw"
    path.write_bytes(np.asarray(volume.data).transpose(2, 1, 0).tobytes())
    return path


@pytest.fixture
def real_volume():
    """Path of a real volume by its file name; skips the test if the file is missing."""

    def path(name: str) -> Path:
        folder = os.environ.get("JAXVOL_DATA")
        if not folder:
            pytest.skip("JAXVOL_DATA, the folder of real volumes, is not set")
        file = Path(folder) / name
        if not file.is_file():
            pytest.skip(f"{name} is not in the folder JAXVOL_DATA")
        return file

    return path
