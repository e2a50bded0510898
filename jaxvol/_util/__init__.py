"""Helpers that need nothing of jaxvol but `xla`: checks, files, arrays of voxels, tables, random numbers."""
