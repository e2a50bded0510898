"""Unbiased path tracing of light that a volume scatters any number of times."""

from .path_trace import path_trace as path_trace
from .result import PathTraced as PathTraced
