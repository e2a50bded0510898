"""The transforms of a march: each is one idea from one paper. `jaxvol/__init__.pyi` names the public ones."""
