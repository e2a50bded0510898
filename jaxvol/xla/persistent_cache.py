"""Folder of compiled programs, so that later processes need not compile them."""

import os
from contextlib import suppress
from pathlib import Path

import jax


SHORTEST = 0.02  # least compile time of a kept program, seconds: faster ones take longer to read
_CHOSEN: set[str] = set()  # folders chosen by `keep_programs`


def default_programs() -> Path:
    """Folder of kept programs: `JAX_COMPILATION_CACHE_DIR`, or one in the user's cache."""
    chosen = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(chosen) if chosen else caches / "jaxvol" / "programs"


def keep_programs(folder: str | os.PathLike[str] | None = None) -> Path:
    """Keeps compiled programs in a folder, so that the first image of the next process takes less time.

    XLA compiles a few programs for each kind of scene (transforms, light, size of the image), which takes
    some 4 s. Call this before the first image of a script: it turns on JAX's persistent compilation cache for
    this process, and keeps traced programs in the same folder (`kept_programs`), except programs that contain
    custom code or run inside a `jax.jit`. The command `jaxvol`, notebooks, `show`, `view` and the page of
    `jaxvol view` call it, unless JAX already has a folder; `jaxvol warm` fills it. Programs are specific to
    the machine and the versions of jaxvol and JAX. Delete the folder to remove them. Nobody else should have
    write access: programs in it are executed.

    Args:
        folder: a folder, created if missing. By default the folder that `JAX_COMPILATION_CACHE_DIR` names, or
            else `jaxvol/programs` in `$XDG_CACHE_HOME` or `~/.cache`.

    Returns:
        The folder.

    Raises:
        OSError: for a folder that cannot be created.
    """
    path = default_programs() if folder is None else Path(folder)
    path.mkdir(parents=True, exist_ok=True)
    if _folder() != str(path):
        jax.config.update("jax_compilation_cache_dir", str(path))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST)
        # JAX checks for a cache once, at the first program, which a notebook may already have compiled
        from jax.experimental.compilation_cache import compilation_cache

        compilation_cache.reset_cache()
    _CHOSEN.add(str(path))
    return path


def keep_programs_by_default() -> None:
    """Calls `keep_programs()`, unless JAX already has a folder. Ignores a folder that cannot be created."""
    if not _folder():
        with suppress(OSError):
            keep_programs()


def kept_folder() -> str | None:
    """Folder of lowered programs (`kept_programs`), or None if they are not kept."""
    folder = _folder()
    on = folder in _CHOSEN and getattr(jax.config, "jax_enable_compilation_cache", True)
    return folder if on else None


def _folder() -> str | None:
    return getattr(jax.config, "jax_compilation_cache_dir", None)
