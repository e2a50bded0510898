"""Subcommands of the command `jaxvol`, one a file, which adds its own parser; and what they share."""
