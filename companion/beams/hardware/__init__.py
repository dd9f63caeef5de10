"""Weights for phased-array devices: quantised, calibrated, and written as their files."""
