"""Antenna array: geometry, elements, steering vectors and coverage."""
