"""A receiver behind the carrier's array, which measures the directions of simulated UAVs."""
