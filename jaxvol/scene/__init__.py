"""The scene: volumes, transfer functions, cameras, and the result of a render."""
