"""What any numerical package has: of no volume, and no image."""
