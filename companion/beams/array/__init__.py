"""The antenna array: its geometry, its elements, steering vectors, and where it may point."""
