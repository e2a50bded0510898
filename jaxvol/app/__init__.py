"""Programs over the library: the command line, the viewer, and what is shown by default."""
