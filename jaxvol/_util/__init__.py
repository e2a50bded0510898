"""Helpers that depend only on `jaxvol.xla`: checks, files, arrays of voxels, tables, random numbers."""
