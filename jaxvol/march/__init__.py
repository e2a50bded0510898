"""Marches and their transforms, which place the samples of rays, and tables of empty space."""
