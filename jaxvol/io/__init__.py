"""Input and output: files of volumes and images, datasets, phantoms."""

import lazy_loader


__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, ["datasets"])
