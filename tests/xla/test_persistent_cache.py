"""Are compiled programs kept where `keep_programs` says, whenever it is called? Does an import compute?"""

import os
import subprocess
import sys
from pathlib import Path

import jax
from jax._src import compilation_cache

from jaxvol.xla.persistent_cache import default_programs, keep_programs, keep_programs_by_default


SCRIPT = """
import socket, sys
import jax, jaxvol as jv
from jaxvol.xla import persistent_cache

# so far nothing is computed: JAX can still be told of other processes, whose devices are to take part
with socket.create_server(("localhost", 0)) as free:
    port = free.getsockname()[1]
jax.distributed.initialize(f"localhost:{port}", 1, 0)
jax.jit(lambda x: x + 1)(1.0)  # JAX has decided by now that it keeps no programs
persistent_cache.SHORTEST = 0.0
print(jv.keep_programs(sys.argv[1]))
jax.jit(lambda x: x + 2)(1.0)
"""


def test_programs_are_kept_in_the_folder_that_is_given(tmp_path):
    folder = tmp_path / "made" / "programs"
    quiet = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    command = [sys.executable, "-c", SCRIPT, str(folder)]
    ran = subprocess.run(command, env=quiet, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr[-2000:]
    assert ran.stdout.strip() == str(folder)
    assert list(folder.glob("*-cache"))


def test_programs_are_compressed_alike_whatever_else_is_installed():
    """JAX compresses by zstandard where it is installed, under other keys; so it is a dependency."""
    assert compilation_cache.compress_executable(b"program").startswith(b"\x28\xb5\x2f\xfd")


def test_a_folder_that_cannot_be_made_is_no_fault(tmp_path):
    (tmp_path / "file").touch()
    code = "from jaxvol.xla.persistent_cache import keep_programs_by_default as keep; keep()"
    quiet = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    quiet["XDG_CACHE_HOME"] = str(tmp_path / "file")
    subprocess.run([sys.executable, "-c", code], env=quiet, check=True)


def test_the_default_folder_is_jaxs_own_or_the_users(tmp_path, monkeypatch):
    chosen = getattr(jax.config, "jax_compilation_cache_dir")  # noqa: B009 (pyright does not know it)
    assert chosen  # the tests' own, which a viewer leaves
    keep_programs_by_default()
    assert keep_programs(chosen) == Path(chosen)
    assert getattr(jax.config, "jax_compilation_cache_dir") == chosen  # noqa: B009
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_programs() == tmp_path / "jaxvol" / "programs"
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "own"))
    assert default_programs() == tmp_path / "own"
