"""Are compiled programs kept where `keep_programs` says, whenever it is called?"""

import os
import subprocess
import sys

import jax

from jaxvol.programs import default_programs, keep_programs_by_default


SCRIPT = """
import sys
import jax, jax.numpy as jnp
import jaxvol as jv
jax.jit(lambda x: x + 1)(1.0)  # JAX has decided by now that it keeps no programs
print(jv.keep_programs(*sys.argv[1:]))
volume = jv.Volume(jnp.zeros((4, 4, 4)))
jv.render(volume, jv.colormap("gray", (0, 1)), jv.Camera.looking_at(volume, size=(8, 8)), jv.March(0.5))
"""


def ran(*arguments, **settings):
    quiet = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    command = [sys.executable, "-c", SCRIPT, *arguments]
    return subprocess.run(command, env=quiet | settings, capture_output=True, text=True, check=True).stdout


def test_programs_are_kept_in_the_folder_that_is_given(tmp_path):
    folder = tmp_path / "made" / "programs"
    assert ran(str(folder)).strip() == str(folder)
    assert any("march" in file.name or "image" in file.name for file in folder.iterdir())


def test_the_default_folder_is_jaxs_own_or_the_users(tmp_path, monkeypatch):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_programs() == tmp_path / "jaxvol" / "programs"
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "own"))
    assert default_programs() == tmp_path / "own"


def test_a_viewer_leaves_a_folder_that_was_chosen(tmp_path):
    chosen = getattr(jax.config, "jax_compilation_cache_dir")  # noqa: B009 (pyright does not know it)
    assert chosen  # the tests' own
    keep_programs_by_default()
    assert getattr(jax.config, "jax_compilation_cache_dir") == chosen  # noqa: B009
