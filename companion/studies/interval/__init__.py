"""Report rate that a UAV needs."""
