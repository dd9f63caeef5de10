"""Measured beams of the DeepSense 6G scenarios, and how well a position tells them."""
