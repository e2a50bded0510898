"""Where are compiled programs kept, so that the next process need not compile them again?"""

import os
from contextlib import suppress
from pathlib import Path

import jax


SHORTEST = 0.02
"""Seconds of compilation from which on a program is kept: what is faster to compile than to read is not."""


_CHOSEN: set[str] = set()
"""Folders that `keep_programs` was told of."""


def default_programs() -> Path:
    """Folder of kept programs: `JAX_COMPILATION_CACHE_DIR`, or one in the user's cache."""
    chosen = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(chosen) if chosen else caches / "jaxvol" / "programs"


def keep_programs(folder: str | os.PathLike[str] | None = None) -> Path:
    """Keeps compiled programs in a folder, so that the first image of the next process takes less time.

    XLA compiles a few programs for each kind of scene (transforms, light, size of the image), which takes
    some 4 s. Call this before the first image of a script: it turns on JAX's persistent compilation cache for
    this process, and keeps traced programs beside it (`kept_programs`), unless code of one's own is a part of
    them, or a `jax.jit` is around them. The command `jaxvol` does so by itself, and so do notebooks, `show`,
    `view` and the page of `jaxvol view`, unless JAX has a folder already; `jaxvol warm` fills it. Programs
    are those of this machine, this version of jaxvol and of JAX; others are added. To be rid of them, delete
    the folder. Keep it where nobody else can write: programs in it are executed.

    Args:
        folder: made if it does not exist. By default the folder that `JAX_COMPILATION_CACHE_DIR` names, or
            else `jaxvol/programs` in `$XDG_CACHE_HOME` or `~/.cache`.

    Returns:
        The folder.

    Raises:
        OSError: for a folder that cannot be made.
    """
    path = default_programs() if folder is None else Path(folder)
    path.mkdir(parents=True, exist_ok=True)
    if _folder() != str(path):
        jax.config.update("jax_compilation_cache_dir", str(path))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST)
        # JAX decides once, at the first program, whether there is a cache; in a notebook that may be long ago
        from jax.experimental.compilation_cache import compilation_cache

        compilation_cache.reset_cache()
    _CHOSEN.add(str(path))
    return path


def keep_programs_by_default() -> None:
    """`keep_programs()`, unless JAX keeps them somewhere already, or the folder cannot be made."""
    if not _folder():
        with suppress(OSError):
            keep_programs()


def kept_folder() -> str | None:
    """Where lowered programs are kept, too (`kept_programs`); None where they are not."""
    folder = _folder()
    on = folder in _CHOSEN and getattr(jax.config, "jax_enable_compilation_cache", True)
    return folder if on else None


def _folder() -> str | None:
    return getattr(jax.config, "jax_compilation_cache_dir", None)
