"""What is looked at: volumes, transfer functions, cameras, and what a render returns."""
