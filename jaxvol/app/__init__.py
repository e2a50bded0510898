"""Applications of the library: command line, viewer, default transfer functions and cameras."""
