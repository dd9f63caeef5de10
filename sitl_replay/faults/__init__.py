"""Faults to inject into traffic, with a seed: pure functions of a stream of frames."""
