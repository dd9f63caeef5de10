"""Faults that traffic is given on demand, seeded: pure functions of a stream of frames."""
