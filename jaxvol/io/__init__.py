"""What comes from files and goes into them: volumes, datasets, phantoms, images."""
