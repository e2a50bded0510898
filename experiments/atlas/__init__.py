"""Where do the methods of jaxvol fail? The entries of the failure atlas, a file for each family of them."""

from . import opacity, sampling
from .entry import Entry


FAMILIES = {
    "jitter and sampling": sampling.ENTRIES,
    "opacity and its gradient": opacity.ENTRIES,
}
"""All entries, by family. A new method joins by a row."""

ENTRIES: dict[str, Entry] = {entry.name: entry for family in FAMILIES.values() for entry in family}
