"""Which version of jaxvol is this?"""

from importlib import metadata


try:
    __version__ = metadata.version("jaxvol")
except metadata.PackageNotFoundError:  # run from a checkout
    __version__ = "(not installed)"
