"""The fast engine of `render`: marches images, and computes their gradients."""
