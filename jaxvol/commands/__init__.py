"""Subcommands of the command `jaxvol`, one a file: each adds its own parser."""
