"""Which version of jaxvol is this?"""

from importlib import metadata


try:
    VERSION = metadata.version("jaxvol")
except metadata.PackageNotFoundError:  # run from a checkout
    VERSION = "(not installed)"
