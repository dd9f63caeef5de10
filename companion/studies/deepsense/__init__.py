"""Measured beams of the DeepSense 6G scenarios, predicted from positions."""
