"""Where do the methods of jaxvol fail? The entries of the failure atlas, a file for each family of them."""

from . import adaptive, bricks, faces, fits, leaping, light, normals, opacity, precision, probe, sampling
from .entry import Entry


FAMILIES = {
    "jitter and sampling": (sampling.HAZE, faces.CUT, faces.LABELS, sampling.SHEETS, sampling.OFFSETS),
    "opacity and its gradient": opacity.ENTRIES,
    "adaptive strides": adaptive.ENTRIES,
    "space leaping": leaping.ENTRIES,
    "float types": precision.ENTRIES,
    "faces of labels": (faces.FACES,),
    "clips": (faces.BEHIND,),
    "toroidal maps": probe.ENTRIES,
    "bricks": bricks.ENTRIES,
    "isosurfaces": (sampling.SURFACES,),
    "scatterer templates": light.ENTRIES,
    "shading": normals.ENTRIES,
    "fits": fits.ENTRIES,
}
"""All entries, by family. A new method joins by a row."""

ENTRIES: dict[str, Entry] = {entry.name: entry for family in FAMILIES.values() for entry in family}
