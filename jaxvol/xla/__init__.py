"""What XLA needs to be told, or told in a certain way: memory, loops, devices, kept programs."""
