"""Where do the methods of jaxvol fail? The entries of the failure atlas, a file for each family of them."""

from . import faces, fits, leaping, light, opacity, precision, probe, sampling  # noqa: F401
from .entry import ENTRIES as ENTRIES
