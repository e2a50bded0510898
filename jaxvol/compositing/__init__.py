"""Compositing modes: they turn the cells of a ray into a pixel."""
