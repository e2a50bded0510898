"""Helpers that need nothing else of jaxvol: checks, files, arrays of voxels, tables, random numbers, XLA."""
