"""What does light make of a volume when it is scattered any number of times? Unbiased, by tracing paths."""

from .path_trace import path_trace as path_trace
from .result import PathTraced as PathTraced
