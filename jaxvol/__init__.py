"""Differentiable direct volume rendering in JAX.

A camera generates rays; a march steps along them, and each of its transforms changes one aspect of
it. A volume gives values, a transfer function maps them to colour and extinction, and the cells are
composited front to back into a `Rendering`.
"""

# before what takes long to load
from ._util import interruption as _interruption  # noqa: F401  # pyright: ignore[reportUnusedImport]


# isort: split
import sys

import lazy_loader

from ._util.version import __version__ as __version__


# names are those of `__init__.pyi`; a module is imported when the first of its names is used
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

if "ipykernel" in sys.modules:  # a notebook keeps its programs, as `show` and the command do
    from .xla.persistent_cache import keep_programs_by_default as _keep_programs_by_default

    _keep_programs_by_default()
