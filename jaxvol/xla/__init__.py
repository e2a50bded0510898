"""Control of XLA: memory, loops, devices, differentiation, and programs kept in files."""
