"""Faults to inject into traffic, random by a seed: pure functions of a stream of frames."""
