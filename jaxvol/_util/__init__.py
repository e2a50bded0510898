"""Helpers for any numerical package, independent of volumes and images."""
