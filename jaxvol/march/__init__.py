"""Where the samples of a ray are: marches, transforms, and the beams that leap over empty space."""
