"""How often a UAV must report."""
