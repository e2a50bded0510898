"""Unbiased path tracing of light that a volume scatters any number of times."""

from .path_trace import PathTraced as PathTraced, path_trace as path_trace
