"""How the cells of a ray become a pixel."""
