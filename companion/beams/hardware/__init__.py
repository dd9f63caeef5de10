"""Weights for phased-array devices: quantisation, calibration, and the devices' file formats."""
