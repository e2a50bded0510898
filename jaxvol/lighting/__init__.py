"""Lighting of samples: light sources, and the materials that scatter their light."""

import lazy_loader


# names are those of `__init__.pyi`; a module is imported when the first of its names is used
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
