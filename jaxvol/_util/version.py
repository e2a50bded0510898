"""Versions of jaxvol and of other installed packages."""

from importlib import metadata


def version_of(package: str) -> str:
    """Version of an installed package."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:  # run from a checkout
        return "(not installed)"


__version__ = version_of("jaxvol")
