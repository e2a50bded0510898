"""What comes from files and goes into them: volumes, datasets, phantoms, images."""

import lazy_loader


__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, ["datasets"])
