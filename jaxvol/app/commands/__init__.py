"""Subcommands of `jaxvol`, and their shared options."""
