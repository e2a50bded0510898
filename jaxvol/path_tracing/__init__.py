"""Unbiased path tracing of light that a volume scatters any number of times."""

from .path_trace import (
    PathTraced as PathTraced,
    mean_and_standard_error as mean_and_standard_error,
    path_trace as path_trace,
)
